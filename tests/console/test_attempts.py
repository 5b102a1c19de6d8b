"""Failed sign-ins: whom they delay, for how long, and who is behind a proxy."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from starlette.requests import HTTPConnection

from heliotrope.console._attempts import AN_HOUR, SPAN, SignInFailures
from heliotrope.console.headers import address_of
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import InputError
from heliotrope.store.records import StoreError
from support.live_console import PASSWORD, LiveConsole

HOME, AWAY, PROXY = "192.0.2.1", "192.0.2.2", "192.0.2.9"


class Clock:
    """A time that moves when told."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def fail(attempts: SignInFailures, name: str, address: str, times: int) -> None:
    for _ in range(times):
        attempts.begin(name, address)


def guess(
    attempts: SignInFailures, clock: Clock, pick: Callable[[int], tuple[str, str]]
) -> list[float]:
    """Guess wrongly as fast as allowed for five hours; return the times."""
    times: list[float] = []
    end = clock.now + 5.0 * SPAN
    while True:
        name, address = pick(len(times))
        clock.now += attempts.wait(name, address)
        if clock.now >= end:
            return times
        attempts.begin(name, address)
        times.append(clock.now)
        clock.now += 0.1


def test_no_hour_has_more_than_twelve_guesses(clock: Clock) -> None:
    times = guess(SignInFailures(clock), clock, lambda _: ("ada", HOME))
    assert len(times) > AN_HOUR
    for begin in times:
        assert sum(begin <= at < begin + SPAN for at in times) <= AN_HOUR


@pytest.mark.parametrize("most", [3, 40])
def test_the_number_of_guesses_in_an_hour_is_a_setting(clock: Clock, most: int) -> None:
    attempts = SignInFailures(clock, an_hour=most)
    times = guess(attempts, clock, lambda _: ("ada", HOME))
    hours = [sum(begin <= at < begin + SPAN for at in times) for begin in times]
    assert max(hours) <= most
    assert most > 3 or max(hours) == most


def test_delays_grow_slowly(clock: Clock) -> None:
    attempts = SignInFailures(clock)
    fail(attempts, "ada", HOME, 4)
    assert attempts.wait("ada", HOME) == 0.0
    waits = []
    for _ in range(7):
        attempts.begin("ada", HOME)
        waits.append(attempts.wait("ada", HOME))
        clock.now += waits[-1]
    assert waits == sorted(waits)
    assert 0.0 < waits[0] <= 60.0
    assert waits[-1] <= 300.0


def test_others_at_the_same_address_go_on(clock: Clock) -> None:
    """Hole 7: five wrong passwords of one person locked everybody behind one address."""
    attempts = SignInFailures(clock)
    fail(attempts, "ada", HOME, 5)
    assert attempts.wait("ada", HOME) > 0.0
    assert attempts.wait("grace", HOME) == 0.0
    assert attempts.wait("ada", AWAY) <= 1.0


def test_an_own_sign_in_clears_nothing_of_others(clock: Clock) -> None:
    """Hole 7: a guesser's own good sign-in cleared the counter."""
    attempts = SignInFailures(clock)
    fail(attempts, "ada", HOME, AN_HOUR)
    fail(attempts, "grace", HOME, 30)
    before = attempts.wait("ada", HOME), attempts.wait("stranger", HOME)
    assert min(before) > 0.0
    attempts.good("mallory", HOME)
    attempts.good("ada", AWAY)
    assert (attempts.wait("ada", HOME), attempts.wait("stranger", HOME)) == before


def test_a_good_sign_in_clears_its_own_failures(clock: Clock) -> None:
    attempts = SignInFailures(clock)
    fail(attempts, "ada", HOME, 40)
    assert attempts.wait("grace", HOME) > 0.0
    attempts.good("ada", HOME)
    for name, address in (("ada", HOME), ("ada", AWAY), ("grace", HOME)):
        assert attempts.wait(name, address) == 0.0, (name, address)


def test_a_name_is_guessed_slowly_from_many_addresses(clock: Clock) -> None:
    attempts = SignInFailures(clock)
    attempts.good("ada", HOME)
    times = guess(attempts, clock, lambda k: ("ada", f"198.51.100.{k % 250}"))
    for begin in times[30:]:  # after the first hour
        assert sum(begin <= at < begin + SPAN for at in times) <= 14
    assert len(times) > 5 * 11  # and no lock-out: whoever waits has a turn
    attempts.begin("ada", "198.51.100.251")
    assert attempts.wait("ada", AWAY) > 0.0
    assert attempts.wait("ada", HOME) == 0.0  # she signs in where she did before


def test_an_attempt_that_was_no_guess_counts_no_more(clock: Clock) -> None:
    """A password that was right, and needs a code."""
    attempts = SignInFailures(clock)
    fail(attempts, "grace", HOME, 19)
    for _ in range(AN_HOUR):
        attempts.begin("ada", HOME)
        attempts.undo("ada", HOME)
    assert attempts.wait("ada", HOME) == 0.0
    attempts.begin("ada", HOME)
    assert attempts.wait("hedy", HOME) > 0.0  # those of others count on
    attempts.undo("nobody", AWAY)


def test_many_names_are_guessed_slowly_from_one_address(clock: Clock) -> None:
    times = guess(SignInFailures(clock), clock, lambda k: (f"name {k}", HOME))
    assert len(times) <= 5 * SPAN / 10.0 + 30


def test_a_proxy_is_not_one_caller(clock: Clock) -> None:
    attempts = SignInFailures(clock, (PROXY,))
    for k in range(100):
        attempts.begin(f"name {k}", PROXY)
    assert attempts.wait("ada", PROXY) == 0.0


def test_a_flood_of_names_does_not_forget_the_guessed_one(clock: Clock) -> None:
    attempts = SignInFailures(clock, largest=50)
    fail(attempts, "ada", HOME, 8)
    for k in range(40):
        attempts.begin(f"name {k}", f"198.51.100.{k}")
    attempts.begin("ada", HOME)
    for k in range(45):
        attempts.begin(f"other {k}", f"203.0.113.{k}")
    assert attempts.wait("ada", HOME) > 0.0


@pytest.mark.parametrize(
    ("other", "headers", "address"),
    [
        (HOME, [], HOME),
        (HOME, ["203.0.113.5"], HOME),  # nobody but a proxy is believed
        (PROXY, ["203.0.113.5"], "203.0.113.5"),
        (PROXY, ["203.0.113.5, 192.0.2.7"], "192.0.2.7"),  # the caller wrote the first
        (PROXY, ["203.0.113.5", "192.0.2.7"], "192.0.2.7"),
        (PROXY, [f"192.0.2.7, {PROXY}"], "192.0.2.7"),
        (PROXY, ["not an address"], PROXY),
        (PROXY, [], PROXY),
    ],
)
def test_only_a_proxy_names_the_caller(other: str, headers: list[str], address: str) -> None:
    console: Any = SimpleNamespace(settings=ConsoleSettings(proxies=(PROXY,)))
    raw = [(b"x-forwarded-for", text.encode()) for text in headers]
    found = HTTPConnection({"type": "http", "client": (other, 1), "headers": raw})
    assert address_of(console.settings, found) == address


def test_a_proxy_needs_an_address() -> None:
    for text in ("proxy.example", "10.0.0.0/8", "::0001"):
        with pytest.raises(InputError, match="IP address that the console sees"):
            ConsoleSettings(proxies=(text,))
    given = ConsoleSettings(proxies=(PROXY, "::1"))
    assert ConsoleSettings.of(given.values) == given


def test_a_colleague_signs_in_while_one_is_locked_out(console: LiveConsole) -> None:
    wrong = {"name": "viewer", "password": "not the password"}
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        seen = [client.post("session", json=wrong).status_code for _ in range(6)]
        assert seen == [401] * 5 + [429]
        other = {"name": "operator", "password": PASSWORD}
        assert client.post("session", json=other).status_code == 200
        right = {"name": "viewer", "password": PASSWORD}
        assert client.post("session", json=right).status_code == 429  # still too early
    attempts = console.server.app.state.console.attempts
    console.call(lambda: attempts.good("viewer", "127.0.0.1"))


def test_a_store_that_fails_counts_as_no_guess(
    console: LiveConsole, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(name: str) -> None:
        raise StoreError("store: cannot be read (gone)")

    given = {"name": "viewer", "password": PASSWORD}
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        with monkeypatch.context() as patch:
            patch.setattr(console.keeper.people, "account", gone)
            answers = [client.post("session", json=given) for _ in range(13)]
            assert {answer.status_code for answer in answers} == {503}
            assert "cannot be read (gone)" in answers[0].json()["detail"]
        assert client.post("session", json=given).status_code == 200
