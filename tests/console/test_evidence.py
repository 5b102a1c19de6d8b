"""Security events: each leaves a record in the store, and patterns of them raise alarms."""

import asyncio
import contextlib
import os
import time
from collections.abc import Callable
from typing import Any

import httpx
import pytest
from starlette.requests import HTTPConnection

from heliotrope.cli._noted import note_use
from heliotrope.console.auth import Console
from heliotrope.local import ORDINARY, CallError, ask_once, name_here
from heliotrope.plant.operations.security import MOST, SecurityEvent
from heliotrope.store.records import Event
from support.live_console import PASSWORD, LiveConsole

Ask = Callable[..., httpx.Response]


def recorded(console: LiveConsole, text: str, since: float = 0.0) -> Event:
    """Return the newest security event with a text, once the store has it."""

    def find() -> Event | None:
        found = console.keeper.events(500)
        return next(
            (e for e in found if e.source == "security" and text in e.text and e.at >= since), None
        )

    found = console.until(find)
    assert isinstance(found, Event)
    return found


def test_sessions_leave_a_trace(console: LiveConsole) -> None:
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        wrong = {"name": "viewer", "password": "not the password"}
        assert client.post("session", json=wrong).status_code == 401
        answer = client.post("session", json={"name": "viewer", "password": PASSWORD})
        client.headers["X-CSRF-Token"] = answer.json()["csrf"]
        assert client.delete("session").status_code == 204
    for text in ("failed to sign in", "signed in", "signed out"):
        found = recorded(console, f"viewer: {text} (from 127.0.0.1)")
        assert "not the password" not in found.text
    assert recorded(console, "failed to sign in").severity == "warning"


def test_a_name_that_is_no_account_is_not_recorded(console: LiveConsole) -> None:
    """People type their password there."""
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        client.post("session", json={"name": "my dear password", "password": "viewer?????"})
    recorded(console, "failed to sign in")
    assert not any("my dear password" in event.text for event in console.keeper.events(500))


def test_expiry_leaves_a_trace(console: LiveConsole) -> None:
    people, now = console.keeper.people, time.time()
    people.open_session("operator", now - 100.0, 50.0)
    people.add_token("operator", "old report", "operator", now - 100.0, 50.0)

    async def begin() -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                await console.server.app.state.console.forget_expired()

    console.console_wait(begin())
    recorded(console, "operator: session expired")
    recorded(console, "operator: token expired: old report")


def test_sign_ins_of_one_person_leave_out_nobody_else(console: LiveConsole) -> None:
    """The console sends the plant the sum of those that it leaves out."""
    inside: Console = console.server.app.state.console
    scope = {"type": "http", "headers": [], "client": ("10.0.0.9", 1)}

    async def flood() -> None:
        for _ in range(MOST + 3):
            await inside.note(SecurityEvent.SIGNED_OUT, HTTPConnection(scope), "visitor")
        await inside.note(SecurityEvent.SIGNED_OUT, HTTPConnection(scope), "guide")
        for kind, who, more in inside.counter.sums(time.monotonic(), all_=True):
            await inside.plant.note(kind, who, more=more)

    console.console_wait(flood())
    recorded(console, "guide: signed out (from 10.0.0.9)")
    console.call(console.live.operations.security.close)
    recorded(console, "visitor: signed out: 3 more in a minute")


CHANGES: tuple[tuple[str, str, dict[str, Any], str], ...] = (
    (
        "POST",
        "accounts",
        {"name": "desk-8", "role": "viewer", "password": "a long password"},
        "created an account: desk-8, viewer",
    ),
    ("PATCH", "accounts/desk-8", {"role": "operator"}, "changed an account: desk-8, role operator"),
    ("PATCH", "accounts/desk-8", {"disabled": True}, "changed an account: desk-8, disabled"),
    ("POST", "accounts/desk-8/password", {}, "created a new password: desk-8"),
    ("POST", "tokens", {"label": "one", "role": "viewer"}, "created a token: one, viewer, 30 days"),
)


def test_changes_of_accounts_leave_a_trace(console: LiveConsole, person: Ask) -> None:
    for method, path, body, text in CHANGES:
        assert person("engineer", method, path, body).is_success, path
        recorded(console, f"engineer: {text} (from 127.0.0.1)")
    (token,) = [t for t in console.keeper.people.tokens("engineer") if t.label == "one"]
    assert person("engineer", "DELETE", f"tokens/{token.key}").status_code == 204
    recorded(console, "engineer: revoked a token: one of engineer")
    wrong = {"own_password": "not it"}
    assert person("engineer", "POST", "accounts/desk-8/password", wrong).status_code == 403
    recorded(console, "engineer: entered a wrong password for an account change")


def test_a_running_plant_records_what_people_do_with_its_records(console: LiveConsole) -> None:
    note_use(str(console.interface.folder.parent), "BACKED_UP", "/var/backups/today")
    me = name_here(os.geteuid())
    assert recorded(console, f"{me}: made a backup: /var/backups/today").severity == "info"
    folder, order = console.interface.folder, {"kind": "SIGNED_IN", "detail": "somebody else"}
    with pytest.raises(CallError, match="kind"):
        ask_once(folder / ORDINARY, {"user": True}, "note_use", order)


def test_strangers_leave_a_trace(console: LiveConsole, signed_in: httpx.Client) -> None:
    url = f"{console.address}api/v1/summary"
    httpx.get(url, headers={"Host": "rebound.example"}, trust_env=False)
    recorded(console, "unknown host name refused: rebound.example")
    httpx.get(url, headers={"Authorization": "Bearer 0123"}, trust_env=False)
    recorded(console, "a token was refused (from 127.0.0.1)")
    signed_in.put("authority", headers={"Origin": "https://elsewhere.example"})
    recorded(console, "operator: request from another site refused")


def test_refused_orders_raise_an_alarm(console: LiveConsole, ask: Ask) -> None:
    for _ in range(5):
        assert ask("viewer", "POST", "stow", {"heliostats": []}).status_code == 403
    recorded(console, "viewer: order refused: the role is too low: POST /api/v1/stow by token")
    alarms = {row.condition: row for row in console.call(console.live.operations.logbook.alarms)}
    assert alarms["orders_refused"].active
    assert "the role of viewer from 127.0.0.1 is too low" in alarms["orders_refused"].text


def test_a_lockout_raises_an_alarm(console: LiveConsole) -> None:
    wrong = {"name": "viewer", "password": "not the password"}
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        answers = [client.post("session", json=wrong).status_code for _ in range(12)]
    assert 429 in answers
    recorded(console, "viewer: sign-ins refused after too many failures")
    alarms = {row.condition: row for row in console.call(console.live.operations.logbook.alarms)}
    assert alarms["sign_in_lockout"].active
    attempts = console.server.app.state.console.attempts
    console.call(lambda: attempts.good("viewer", "127.0.0.1"))


def test_a_refused_link_leaves_a_trace(console: LiveConsole) -> None:
    text = "cluster C9: wrong key (1 so far)"
    console.call(lambda: console.live.operations.security.look(text))
    recorded(console, f"link refused: {text}")
