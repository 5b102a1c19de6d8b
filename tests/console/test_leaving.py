"""What stays in a browser, and what a caller learns who does not belong here."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import argon2
import httpx
import pytest
from fastapi import Response
from starlette.requests import HTTPConnection
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.console import _secrets
from heliotrope.console.headers import host_known, secret_of
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.sign_in import drop_cookie, set_cookie
from heliotrope.store.people import BY_PROXY, UNSET
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]
BEHIND_TLS = ConsoleSettings(port=0, plain=True)


def test_no_browser_keeps_an_answer_of_the_api(console: LiveConsole, ask: Ask) -> None:
    """Neither photographs nor anything else can be seen after signing out."""
    target = console.live.operations.targets[0]
    for path in (f"targets/{target}/photograph", "photographs/1", "photographs", "field", "alarms"):
        answer = ask("viewer", "GET", path)
        assert answer.headers["cache-control"] == "no-store", path


def asked_with(cookies: str) -> HTTPConnection:
    return HTTPConnection({"type": "http", "headers": [(b"cookie", cookies.encode())]})


@pytest.mark.parametrize("settings", [ConsoleSettings(port=0), BEHIND_TLS])
def test_behind_tls_the_cookie_is_of_this_host_alone(settings: ConsoleSettings) -> None:
    class Here:
        pass

    here: Any = Here()
    here.settings = settings
    for change in (
        lambda answer: set_cookie(here, answer, "a" * 64),
        lambda a: drop_cookie(here, a),
    ):
        answer = Response()
        change(answer)
        parts = answer.headers["set-cookie"].split("; ")
        name = parts[0].partition("=")[0]
        assert name == ("__Host-" if settings.plain else "") + "heliotrope_session"
        assert ("Secure" in parts) is settings.plain
        assert {"HttpOnly", "Path=/", "SameSite=strict"} <= set(parts)
        assert not any(part.lower().startswith("domain") for part in parts)
    # What another machine of the domain, or a page without TLS, can set is not taken.
    both = "heliotrope_session=theirs; __Host-heliotrope_session=ours"
    wanted = "ours" if settings.plain else "theirs"
    assert secret_of(settings, asked_with(both)) == ("session", wanted)
    theirs = secret_of(settings, asked_with("heliotrope_session=theirs"))
    assert theirs == (None if settings.plain else ("session", "theirs"))


def test_a_host_name_is_known_in_any_letters() -> None:
    settings = ConsoleSettings(port=0, names=("Plant.Example.org",))
    for name in ("plant.example.org", "PLANT.example.org:8080", "Plant.Example.Org:443"):
        assert host_known(settings, name)
    assert not host_known(settings, "plant.example.com")


@pytest.mark.parametrize("kept", [None, BY_PROXY, UNSET])
def test_where_there_is_no_password_one_is_checked_all_the_same(
    monkeypatch: pytest.MonkeyPatch, kept: str | None
) -> None:
    """So the time of an answer does not say which accounts there are, and which have none."""
    checked: list[str] = []

    class Hasher:
        def verify(self, digest: str, password: str) -> bool:
            checked.append(digest)
            return argon2.PasswordHasher().verify(digest, password)

    monkeypatch.setattr(_secrets, "_HASHER", Hasher())
    assert not _secrets.verify_password(kept, "a long password")
    assert len(checked) == 1
    assert checked[0].startswith("$argon2id$")


def test_no_password_stands_on_a_command_line(tmp_path: Path) -> None:
    """Every user of the machine can read it there, and the shell keeps it."""
    del tmp_path
    for command in (["token", "a"], ["password"], ["account", "a"], ["factor"]):
        done = CliRunner().invoke(app, ["ctl", *command, "--password", "a long password"])
        assert done.exit_code == 2
        assert "No such option" in done.output
