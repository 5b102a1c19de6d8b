"""The one-time link: it signs in once, soon, on this machine, and at a simulated plant alone."""

import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import httpx
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.console.people import FIRST, first_start, without_password
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import InputError
from heliotrope.plant.interface.one_time_link import VALID, OneTimeLink
from heliotrope.plant.operations.operations import Operations
from heliotrope.store.keeper import Keeper
from heliotrope.store.people import UNSET
from support.live_console import LiveConsole

NAME, NEW = "first one", "a password of one's own"


@pytest.fixture
def browser_at(console: LiveConsole) -> Iterator[httpx.Client]:
    """A browser without a page, and without a session."""
    with httpx.Client(base_url=console.address, trust_env=False, timeout=60.0) as client:
        yield client


@pytest.fixture
def link(console: LiveConsole) -> Iterator[str]:
    """A link of an engineer who has no password yet."""
    console.keeper.people.add(NAME, UNSET, "engineer", time.time())
    yield console.interface.one_time_link(NAME, console.address)
    console.keeper.people.remove(NAME)


def events(console: LiveConsole) -> list[str]:
    """Return the security events, newest first."""
    logbook = console.live.operations.logbook
    found = console.call(lambda: list(logbook.events()))
    return [one.text for one in found if one.kind == "security"]


def test_it_signs_in_once_and_leaves_the_address_bar(
    console: LiveConsole, browser_at: httpx.Client, link: str
) -> None:
    answer = browser_at.get(link)
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cache-control"] == "no-store"
    cookie = answer.headers["set-cookie"].lower()
    assert "httponly" in cookie
    assert "samesite=strict" in cookie
    who = browser_at.get("api/v1/session").json()
    assert (who["name"], who["role"], who["owes"]) == (NAME, "engineer", "")
    assert who["no_password"] is True
    assert any("signed in: by the one-time link" in text for text in events(console))

    other = httpx.get(link, trust_env=False)
    assert other.status_code == 410
    assert "set-cookie" not in other.headers
    for words in ("This link is not valid", "it prints a new link", 'href="/login"'):
        assert words in other.text
    assert any("failed to sign in: by the one-time link" in text for text in events(console))


@pytest.mark.parametrize("headers", [None, {"Sec-Purpose": "prefetch;prerender"}])
def test_a_program_that_only_looks_leaves_it_valid(
    browser_at: httpx.Client, link: str, headers: dict[str, str] | None
) -> None:
    looked = browser_at.get(link, headers=headers) if headers else browser_at.head(link)
    assert looked.status_code == 503
    assert "set-cookie" not in looked.headers
    assert browser_at.get(link).status_code == 303


@pytest.mark.parametrize("word", ["", "?once=", "?once=x", f"?once={'x' * 3000}", "?once=%ff"])
def test_no_other_word_signs_in(browser_at: httpx.Client, link: str, word: str) -> None:
    assert browser_at.get(f"enter{word}").status_code == 410
    assert browser_at.post(link).status_code == 404
    assert browser_at.get(link).status_code == 303


def test_its_person_sets_a_first_password_and_nothing_else_before(
    browser_at: httpx.Client, link: str
) -> None:
    browser_at.get(link)
    browser_at.headers["X-CSRF-Token"] = browser_at.get("api/v1/session").json()["csrf"]
    token = {"label": "x", "role": "viewer", "own_password": "none yet"}
    refused = browser_at.post("api/v1/tokens", json=token)
    assert refused.status_code == 403
    assert "has none yet" in refused.json()["detail"]
    given = {"name": NAME, "password": UNSET}
    assert httpx.post(f"{browser_at.base_url}api/v1/session", json=given).status_code == 401

    own = {"old": "", "new": NEW}
    assert browser_at.put("api/v1/session/password", json=own).status_code == 204
    assert browser_at.get("api/v1/session").status_code == 401
    given["password"] = NEW
    signed_in = browser_at.post("api/v1/session", json=given).json()
    assert (signed_in["no_password"], signed_in["owes"]) == (False, "")
    browser_at.headers["X-CSRF-Token"] = signed_in["csrf"]
    # From now on the password is asked for.
    again = browser_at.put("api/v1/session/password", json={"old": "", "new": NEW + "!"})
    assert again.status_code == 403


def test_it_is_over_after_ten_minutes_and_when_another_is_made() -> None:
    now = 1000.0
    link = OneTimeLink(lambda: now)
    old = link.make(FIRST)
    secret = link.make(FIRST)
    assert len(secret) >= 43, "256 bits"
    assert link.use(old) is None
    assert secret not in repr(vars(link)), "only the hash is kept"
    now += VALID - 1.0
    assert link.use("another") is None
    assert link.use(secret) == FIRST
    assert link.use(secret) is None
    secret = link.make(FIRST)
    now += VALID
    assert link.use(secret) is None


def test_another_machine_is_refused_and_leaves_it_valid(tmp_path: Path) -> None:
    # The address of a request is that which a trusted proxy says, or the other end's.
    made = LiveConsole(tmp_path, 3, settings=ConsoleSettings(port=0, proxies=("127.0.0.1",)))
    try:
        link = made.interface.one_time_link("engineer", made.address)
        for address, status in (("10.0.0.7", 403), ("::ffff:10.0.0.7", 403), ("::1", 303)):
            answer = httpx.get(link, headers={"X-Forwarded-For": address}, trust_env=False)
            assert answer.status_code == status
            assert ("set-cookie" in answer.headers) == (status == 303)
        assert any(
            "from another machine (from 10.0.0.7 via 127.0.0.1)" in text for text in events(made)
        )
    finally:
        made.close()


def test_a_real_plant_makes_none(console: LiveConsole) -> None:
    with (
        patch.object(Operations, "simulated", False),
        pytest.raises(InputError, match="not available for a real plant"),
    ):
        console.interface.one_time_link(FIRST, console.address)


@pytest.mark.parametrize(
    ("settings", "allowed"),
    [
        ({}, True),
        ({"host": "localhost"}, True),
        ({"host": "::1"}, True),
        ({"host": "0.0.0.0", "plain": True}, False),
        ({"certificate": Path("a.pem"), "key": Path("a.key")}, False),
        ({"proxies": ("127.0.0.1",)}, False),
        ({"plain": True}, False),
        ({"second_factor": "engineer"}, False),
    ],
)
def test_it_is_for_browsers_of_this_machine(settings: dict[str, object], allowed: bool) -> None:
    assert ConsoleSettings(**settings).for_one is allowed  # type: ignore[arg-type]


def test_a_store_without_a_password_gets_one_at_a_real_plant(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path / "store.sqlite")
    people, now = keeper.people, time.time()
    try:
        assert without_password(people, now)
        assert without_password(people, now), "the next start of the simulated plant"
        password = first_start(people, now)
        assert password is not None
        found = people.account(FIRST)
        assert found is not None
        assert (found.no_password, found.password_due) == (False, True)
        assert first_start(people, now) is None
        assert not without_password(people, now)
    finally:
        keeper.close()


def test_ctl_says_that_an_account_without_a_password_needs_one(
    console: LiveConsole, link: str
) -> None:
    assert link
    words = ["ctl", "--url", console.address, "token", "job", "--name", NAME]
    refused = CliRunner().invoke(app, words, input=f"{NEW}\n")
    assert refused.exit_code != 0
    said = str(refused.exception or refused.output)
    assert "has no password until you set one on the console's /account page" in said
