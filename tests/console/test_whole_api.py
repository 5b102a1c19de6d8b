"""The whole API by its own description, in each role and as a stranger (schemathesis).

A console of its own: an engineer's random orders may stop its field, sign people out and more. The
slow test goes on for two minutes, or for ``HELIOTROPE_API_MINUTES``, against `heliotrope run`.
"""

import itertools
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, seed, settings
from schemathesis.specs.openapi import checks as openapi

from support.attacked_plant import LEASE, PASSWORD, Target, health, plant
from support.bystander import signed_in
from support.live_console import LiveConsole

FEW = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}
CHECKS = [
    schemathesis.checks.not_a_server_error,
    openapi.status_code_conformance,
    openapi.response_schema_conformance,
]
#: Time for the slow test, min; memory that it may take from its first to its last third, MB,
#: longest answer of the console meanwhile, s, and patience with any answer, s.
MINUTES = float(os.environ.get("HELIOTROPE_API_MINUTES", "2"))
GROWTH, ANSWER, PATIENCE = 150.0, 5.0, 60.0


@pytest.fixture(scope="module")
def described(
    console: LiveConsole, tokens: dict[str, str]
) -> Iterator[tuple[Any, dict[str, dict[str, str]]]]:
    bearers = {role: {"Authorization": f"Bearer {token}"} for role, token in tokens.items()}
    url, headers = f"{console.address}api/v1/openapi.json", bearers["engineer"]
    yield schemathesis.openapi.from_url(url, headers=headers, timeout=PATIENCE), {**bearers, "": {}}
    # Whatever was ordered, the plant and its console are still at work.
    assert httpx.get(f"{console.address}api/v1/health", trust_env=False).json()["ok"]
    summary = httpx.get(f"{console.address}api/v1/summary", headers=headers, trust_env=False)
    assert summary.is_success


def asked(operation: Any, cases: int, number: int, take: Callable[[Any], None]) -> None:
    """Take some random requests of an operation; another number makes other requests."""

    @seed(number)
    @settings(max_examples=cases, derandomize=False, **FEW)
    @given(case=operation.as_strategy())
    def check(case: Any) -> None:
        take(case)

    check()


@pytest.mark.parametrize("cases", [1, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("role", ["viewer", "operator", "engineer", ""])
def test_each_request_is_answered_as_described(
    described: tuple[Any, dict[str, dict[str, str]]], role: str, cases: int
) -> None:
    schema, headers = described

    def take(case: Any) -> None:
        answer = case.call(headers=headers[role], timeout=PATIENCE)
        case.validate_response(answer, checks=CHECKS)
        if not role and not case.path.endswith(("/health", "/session")):
            assert answer.status_code in (401, 403, 404, 405, 413, 422, 429), case.path

    count = 0
    for found in schema.get_all_operations():
        count += 1
        asked(found.ok(), cases, 0, take)
    assert count > 60


# -- for longer ----------------------------------------------------------------------------------


@dataclass
class Watch:
    """Notes the memory of a plant, and how long its console takes to answer, until it is over."""

    target: Target
    over: threading.Event = field(default_factory=threading.Event)
    memory: list[float] = field(default_factory=list)
    answers: list[float] = field(default_factory=list)

    def run(self) -> None:
        while not self.over.wait(2.0):
            self.memory.append(self.target.memory())
            self.answers.append(health(self.target))

    @property
    def growth(self) -> float:
        """Growth of the memory from the first to the last third of the time, MB."""
        third = len(self.memory) // 3
        return max(self.memory[-third:]) - max(self.memory[:third])


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    with plant(tmp_path_factory.mktemp("plant"), None, heliostats=32) as running:
        yield running


def bearers(target: Target) -> list[dict[str, str]]:
    """Return the headers of a viewer, an operator and an engineer."""
    given = {"label": "hours", "days": 1, "own_password": PASSWORD, "role": "engineer"}
    with signed_in(target, "engineer") as engineer:
        made = engineer.post("tokens", json=given).raise_for_status().json()
    secrets = (target.token, target.operator, made["secret"])
    return [{"Authorization": f"Bearer {secret}"} for secret in secrets]


@pytest.mark.slow
def test_use_of_the_whole_api_for_a_long_time(target: Target) -> None:
    people, watch, since = bearers(target), Watch(target), time.time()
    url = f"{target.url}api/v1/openapi.json"
    schema = schemathesis.openapi.from_url(url, headers=people[-1], timeout=PATIENCE)
    operations = [found.ok() for found in schema.get_all_operations()]
    until, statuses = time.monotonic() + 60.0 * MINUTES, Counter[int]()
    begun = [(since, "nothing")]
    watching = threading.Thread(target=watch.run)
    watching.start()
    try:
        for number, operation in enumerate(itertools.cycle(operations)):
            if time.monotonic() > until:
                break
            headers = people[number // len(operations) % len(people)]

            def take(case: Any, headers: dict[str, str] = headers) -> None:
                begun.append((time.time(), f"{case.method} {case.path}"))
                answer = case.call(headers=headers, timeout=PATIENCE)
                statuses[answer.status_code] += 1
                case.validate_response(answer, checks=CHECKS)

            asked(operation, 3, number, take)
    finally:
        watch.over.set()
        watching.join()
    rows = target.noted(since)
    at, lag, _, _ = max(rows, key=lambda row: row[1])
    lease = max(row[2] for row in rows)
    during = [what for when, what in begun if when < at][-3:]
    print(
        f"{MINUTES:g} min: {dict(sorted(statuses.items()))}, memory {watch.memory[0]:.0f} to "
        f"{watch.memory[-1]:.0f} MB, growth {watch.growth:.0f} MB, longest answer "
        f"{max(watch.answers):.2f} s, loop behind {lag:.2f} s "
        f"at {during}, lease {lease:.2f} s"
    )
    assert statuses[200] > 100
    assert watch.growth < GROWTH
    assert max(watch.answers) < ANSWER
    assert lease < LEASE
    assert target.process.poll() is None
