"""A plant at work with its console, for all tests of this folder."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import argon2
import httpx
import pytest

from heliotrope.console import _secrets
from support.live_console import PASSWORD, ROLES, LiveConsole
from support.pages import browsers, entering


@pytest.fixture(scope="session", autouse=True)
def cheap_hashes() -> Iterator[None]:
    """Hashes of passwords that take no time: a real one takes 50 ms of a core."""
    with pytest.MonkeyPatch.context() as patch:
        hasher = argon2.PasswordHasher(time_cost=1, memory_cost=64, parallelism=1)
        patch.setattr(_secrets, "_HASHER", hasher)
        patch.setattr(_secrets, "_NOBODY", hasher.hash("nobody"))
        yield


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveConsole]:
    """Two clusters of 32 heliostats, at eight times the speed of real time, without the page."""
    made = LiveConsole(tmp_path_factory.mktemp("console"), 64, speed=8.0)
    yield made
    made.close()


@pytest.fixture(scope="module")
def tokens(console: LiveConsole) -> dict[str, str]:
    """An API token of each role."""
    import time

    people, now = console.keeper.people, time.time()
    return {role: people.add_token(role, "tests", role, now)[1] for role in ROLES}


@pytest.fixture
def ask(console: LiveConsole, tokens: dict[str, str]) -> Iterator[Callable[..., httpx.Response]]:
    """Send a request as somebody of a role ("" for nobody)."""
    with httpx.Client(
        base_url=f"{console.address}api/v1/", trust_env=False, timeout=60.0
    ) as client:

        def send(role: str, method: str, path: str, body: Any = None) -> httpx.Response:
            headers = {"Authorization": f"Bearer {tokens[role]}"} if role else {}
            return client.request(method, path, json=body, headers=headers)

        yield send


@pytest.fixture
def signed_in(console: LiveConsole) -> Iterator[httpx.Client]:
    """A browser without a page: an operator with a session."""
    with httpx.Client(
        base_url=f"{console.address}api/v1/", trust_env=False, timeout=60.0
    ) as client:
        answer = client.post("session", json={"name": "operator", "password": PASSWORD})
        assert answer.status_code == 200
        client.headers["X-CSRF-Token"] = answer.json()["csrf"]
        yield client


@pytest.fixture
def person(console: LiveConsole) -> Iterator[Callable[..., httpx.Response]]:
    """Send a request as somebody of a role who has signed in and gives their password again."""
    with contextlib.ExitStack() as stack:
        clients: dict[str, httpx.Client] = {}

        def send(role: str, method: str, path: str, body: Any = None) -> httpx.Response:
            if role not in clients:
                made = httpx.Client(
                    base_url=f"{console.address}api/v1/", trust_env=False, timeout=60.0
                )
                client = clients[role] = stack.enter_context(made)
                answer = client.post("session", json={"name": role, "password": PASSWORD})
                client.headers["X-CSRF-Token"] = answer.json()["csrf"]
            body = {"own_password": PASSWORD, **(body or {})}
            return clients[role].request(method, path, json=body)

        yield send


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A browser for this module alone."""
    yield from browsers()


@pytest.fixture
def enter(field: LiveConsole, browser: Any) -> Iterator[Callable[..., Any]]:
    """Sign in to the plant of the module as somebody of a role."""
    try:
        yield from entering(field.address, browser)
    finally:
        field.release()
