"""A page that was left open: the view stays, orders ask again, safe orders never."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import httpx
import pytest

from heliotrope.console.presence import Presence
from support.live_console import PASSWORD, LiveConsole


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_a_session_without_orders_is_away_after_a_while() -> None:
    clock = Clock()
    presence = Presence(600.0, clock)
    assert not presence.away("a")
    clock.now = 599.0
    assert not presence.away("a")
    presence.seen("a")
    clock.now = 1198.0
    assert (presence.away("a"), presence.away("b")) == (False, False)
    clock.now = 1199.0
    assert (presence.away("a"), presence.away("b")) == (True, False)
    presence.seen("a")
    assert not presence.away("a")
    clock.now = 1e6
    assert not Presence(0.0, clock).away("a")


@pytest.fixture
def idle(console: LiveConsole) -> Iterator[Callable[[float], None]]:
    """Let time pass for the lock of pages alone."""
    here, clock = console.server.app.state.console, Clock()
    before = here.presence
    console.call(lambda: setattr(here, "presence", Presence(600.0, clock)))

    def wait(seconds: float) -> None:
        clock.now += seconds

    yield wait
    console.call(lambda: setattr(here, "presence", before))
    console.calm()


def test_the_view_stays_and_orders_ask_again(
    signed_in: httpx.Client, idle: Callable[[float], None]
) -> None:
    assert signed_in.post("authority").is_success
    idle(601.0)
    # What the page shows, and what it sends by itself, goes on.
    assert signed_in.get("summary").is_success
    assert signed_in.put("authority").is_success
    for method, path, body in (
        ("POST", "authority", None),
        ("POST", "commands", {"command": "IDLE", "heliostats": []}),
        ("POST", "automatic/resume", None),
    ):
        refused = signed_in.request(method, path, json=body)
        assert refused.status_code == 423, path
        assert "enter your password again" in refused.json()["detail"]
    # Safe orders never ask, and are no proof that the person is there.
    for path, safe in (("stow", {"heliostats": []}), ("defocus", {"heliostats": []}),
                       ("commands", {"command": "STOW", "heliostats": []}),
                       ("emergency", {"reason": "smoke"})):  # fmt: skip
        assert signed_in.post(path, json=safe).is_success, path
    assert signed_in.request("DELETE", "emergency").status_code == 423
    wrong = signed_in.put("session/presence", json={"own_password": "not it"})
    assert wrong.status_code == 403
    assert signed_in.post("automatic/resume").status_code == 423
    assert signed_in.put("session/presence", json={"own_password": PASSWORD}).status_code == 204
    assert signed_in.request("DELETE", "emergency").is_success
    assert signed_in.post("authority").is_success


def test_a_program_with_a_token_is_never_asked(
    ask: Callable[..., httpx.Response], idle: Callable[[float], None]
) -> None:
    assert ask("operator", "POST", "authority").is_success
    idle(6000.0)
    assert ask("operator", "POST", "authority").is_success
    assert ask("operator", "DELETE", "authority").is_success


def test_the_notice_is_shown_to_everybody_who_is_about_to_sign_in(console: LiveConsole) -> None:
    here = console.server.app.state.console
    before = here.settings
    assert 'id="notice" hidden>' in httpx.get(f"{console.address}login", trust_env=False).text
    told = replace(before, notice="Authorised persons only.\n<b>All</b> is recorded.")
    console.call(lambda: setattr(here, "settings", told))
    text = httpx.get(f"{console.address}login", trust_env=False).text
    console.call(lambda: setattr(here, "settings", before))
    assert '"notice">Authorised persons only.\n&lt;b&gt;All&lt;/b&gt; is recorded.</p>' in text
