"""The whole API by its own description, as an engineer and as a stranger (schemathesis).

A console of its own: an engineer's random orders may stop its field, sign people out and more.
"""

from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings

from support.live_console import LiveConsole

FEW = {"deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}


@pytest.fixture(scope="module")
def described(
    console: LiveConsole, tokens: dict[str, str]
) -> Iterator[tuple[Any, dict[str, dict[str, str]]]]:
    headers = {"Authorization": f"Bearer {tokens['engineer']}"}
    url = f"{console.address}api/v1/openapi.json"
    yield schemathesis.openapi.from_url(url, headers=headers), {"engineer": headers, "": {}}
    # Whatever was ordered, the plant and its console are still at work.
    assert httpx.get(f"{console.address}api/v1/health", trust_env=False).json()["ok"]
    summary = httpx.get(f"{console.address}api/v1/summary", headers=headers, trust_env=False)
    assert summary.is_success


@pytest.mark.parametrize("cases", [1, pytest.param(20, marks=pytest.mark.slow)])
@pytest.mark.parametrize("role", ["engineer", ""])
def test_each_request_is_answered_as_described(
    described: tuple[Any, dict[str, dict[str, str]]], role: str, cases: int
) -> None:
    schema, headers = described
    checks = [
        schemathesis.checks.not_a_server_error,
        schemathesis.specs.openapi.checks.status_code_conformance,
        schemathesis.specs.openapi.checks.response_schema_conformance,
    ]
    count = 0
    for found in schema.get_all_operations():
        operation = found.ok()
        count += 1

        @settings(max_examples=cases, **FEW)
        @given(case=operation.as_strategy())
        def check(case: Any) -> None:
            answer = case.call(headers=headers[role])
            case.validate_response(answer, checks=checks)
            if not role and not case.path.endswith(("/health", "/session")):
                assert answer.status_code in (401, 403, 404, 405, 413, 422, 429), case.path

        check()
    assert count > 60
