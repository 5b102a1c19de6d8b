"""A password that somebody else knows: nothing but safe orders until it is changed."""

from collections.abc import Callable, Iterator
from pathlib import Path

import httpx
import pytest
from typer.testing import CliRunner
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from heliotrope.cli import app
from heliotrope.console.client import Client
from heliotrope.console.people import FIRST, first_start
from heliotrope.store.keeper import Keeper
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]
GIVEN, OWN = "a given password", "a password of one's own"
TEXT = "change your password first"


@pytest.fixture
def newcomer(console: LiveConsole, person: Ask) -> Iterator[httpx.Client]:
    """Somebody who has signed in with the password that an engineer made."""
    person("engineer", "POST", "accounts", {"name": "new", "role": "operator", "password": GIVEN})
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        answer = client.post("session", json={"name": "new", "password": GIVEN})
        assert answer.json().get("owes") == "password", answer.text
        client.headers["X-CSRF-Token"] = answer.json()["csrf"]
        yield client
    console.keeper.people.remove("new")
    console.calm()


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("GET", "summary", None),
        ("GET", "field", None),
        ("POST", "authority", {}),
        ("POST", "automatic", {"heliostats": []}),
        ("POST", "commands", {"command": "TRACK", "heliostats": []}),
        ("DELETE", "emergency", None),
        ("POST", "tokens", {"label": "x", "role": "viewer", "own_password": GIVEN}),
        ("GET", "openapi.json", None),
    ],
)
def test_nothing_else_works(newcomer: httpx.Client, method: str, path: str, body: object) -> None:
    answer = newcomer.request(method, path, json=body)
    assert answer.status_code == 403, answer.text
    assert TEXT in answer.json()["detail"]
    assert "\n" not in answer.json()["detail"]


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("emergency", {"act": "DEFOCUS", "reason": "smoke"}),
        ("stow", {"heliostats": []}),
        ("defocus", {"heliostats": []}),
        ("commands", {"command": "STOW", "heliostats": []}),
        ("commands", {"command": "DEFOCUS", "heliostats": []}),
    ],
)
def test_safe_orders_work(newcomer: httpx.Client, path: str, body: object) -> None:
    answer = newcomer.post(path, json=body)
    assert answer.status_code == 200, answer.text


def test_the_page_leads_to_the_account(console: LiveConsole, newcomer: httpx.Client) -> None:
    page = newcomer.get(f"{console.address}account")
    assert page.status_code == 200
    assert page.text.index('id="password"') < page.text.index('id="emergency"')
    assert httpx.get(f"{console.address}account", trust_env=False).headers["location"] == "/login"


def test_the_stream_is_closed(console: LiveConsole, newcomer: httpx.Client) -> None:
    url = f"ws{console.address.removeprefix('http')}api/v1/live"
    cookie = {"Cookie": f"heliotrope_session={newcomer.cookies['heliotrope_session']}"}
    refused = pytest.raises(ConnectionClosed, match=TEXT)
    with connect(url, additional_headers=cookie, proxy=None) as socket, refused:
        socket.recv(timeout=60.0)


def test_the_change_opens_everything(console: LiveConsole, newcomer: httpx.Client) -> None:
    same = newcomer.put("session/password", json={"old": GIVEN, "new": GIVEN})
    assert same.status_code == 422
    assert newcomer.put("session/password", json={"old": GIVEN, "new": OWN}).status_code == 204
    with Client(url=console.address) as client:
        client.sign_in("new", OWN)
        assert client.get("session")["owes"] == ""
        assert client.get("summary")["name"]


def test_a_reset_password_is_due_again(
    console: LiveConsole, newcomer: httpx.Client, person: Ask
) -> None:
    console.settle("new", OWN)
    for method, path, body in (
        ("POST", "accounts/new/password", None),
        ("PATCH", "accounts/new", {"password": GIVEN}),
    ):
        made = person("engineer", method, path, body).json()
        word = made.get("password", GIVEN)
        answer = newcomer.post("session", json={"name": "new", "password": word})
        assert answer.json()["owes"] == "password", path
        console.settle("new", OWN)
    # Neither a new role nor disabling touches it.
    person("engineer", "PATCH", "accounts/new", {"role": "viewer"})
    answer = newcomer.post("session", json={"name": "new", "password": OWN})
    assert answer.json()["owes"] == ""


def test_ctl_says_so_and_changes_it(console: LiveConsole, newcomer: httpx.Client) -> None:
    del newcomer
    run, at = CliRunner().invoke, ("ctl", "--url", console.address)
    token = (*at, "token", "job", "--name", "new")
    refused = run(app, [*token, "--password", GIVEN])
    assert refused.exit_code != 0
    assert TEXT in str(refused.exception or refused.output)
    done = run(app, [*at, "password", "--name", "new"], input=f"{GIVEN}\n{OWN}\n{OWN}\n")
    assert done.exit_code == 0, done.output
    assert run(app, [*token, "--password", OWN]).exit_code == 0


def test_the_first_account_is_due(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path / "store.sqlite", inline=True)
    try:
        first_start(keeper.people, 0.0)
        account = keeper.people.account(FIRST)
        assert account is not None
        assert account.password_due
        keeper.people.open_session(FIRST, 0.0, 10.0)
        (session,) = keeper.people.valid(1.0).sessions
        assert session.password_due
    finally:
        keeper.close()
