"""People whom a trusted proxy signs in: who is believed, with which role, and who is not."""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx
import pytest
from starlette.datastructures import Headers

from heliotrope.console import _secrets
from heliotrope.console.by_proxy import ByProxy
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import FormatError, InputError
from support.live_console import PASSWORD, LiveConsole

DEPLOY = Path(__file__).parents[2] / "docs" / "how-to" / "deploy.md"
WORD = "0123456789abcdef" * 4
PAGE = DEPLOY.read_text("utf-8")
FILE = re.findall(r'```toml\n(format = "heliotrope-proxy".*?)```', PAGE, re.S)[0]
HEADERS = {"X-Heliotrope-Person": "ada", "X-Heliotrope-Groups": "staff, solar-operators",
           "X-Heliotrope-Secret": WORD}  # fmt: skip


def written(folder: Path, text: str = FILE, word: str = WORD, mode: int = 0o600) -> Path:
    secret, file = folder / "proxy.secret", folder / "people.toml"
    secret.write_text(word + "\n")
    secret.chmod(mode)
    file.write_text(text)
    return file


@pytest.fixture
def behind(console: LiveConsole, tmp_path: Path) -> Iterator[httpx.Client]:
    """Requests as they come through the proxy, for somebody whom it has signed in."""
    here = console.server.app.state.console
    before = here.settings
    file = written(tmp_path)
    settings = ConsoleSettings(
        port=0, proxies=("127.0.0.1",), people_by_proxy=file, second_factor="viewer"
    )

    def put(chosen: ConsoleSettings, by_proxy: ByProxy | None) -> None:
        here.settings, here.by_proxy = chosen, by_proxy
        here.roster.forget()

    console.call(lambda: put(settings, ByProxy.read(file)))
    with httpx.Client(base_url=console.address, trust_env=False, headers=HEADERS) as client:
        yield client
    console.call(lambda: put(before, None))
    for account in console.keeper.people.accounts():
        if account.by_proxy:
            console.keeper.people.remove(account.name)
    console.calm()


def test_the_person_enters_with_the_role_of_the_groups(
    console: LiveConsole, behind: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = behind.get("login")
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    who = behind.get("api/v1/session").json()
    assert (who["name"], who["role"], who["owes"]) == ("ada", "operator", "")
    account = console.keeper.people.account("ada")
    assert account is not None
    assert account.by_proxy
    # Nobody signs in to it with a password, and it changes no accounts.
    guess = behind.post("api/v1/session", json={"name": "ada", "password": account.password_hash})
    assert guess.status_code == 401
    # A guess takes as long as for any other name: a hash is checked all the same.
    checked: list[Any] = []
    monkeypatch.setattr(_secrets, "verify_password", lambda kept, _: checked.append(kept))
    guess = behind.post("api/v1/session", json={"name": "ada", "password": "another guess"})
    assert guess.status_code == 401
    assert checked == [None]
    csrf = {"X-CSRF-Token": who["csrf"]}
    token = {"label": "x", "role": "viewer", "own_password": "anything"}
    refused = behind.post("api/v1/tokens", json=token, headers=csrf)
    assert refused.status_code == 403
    assert "has none here" in refused.json()["detail"]


def test_a_session_ends_when_the_proxy_says_another_thing(behind: httpx.Client) -> None:
    behind.get("login")
    csrf = {"X-CSRF-Token": behind.get("api/v1/session").json()["csrf"]}
    for other in (
        {"X-Heliotrope-Person": "grace"},
        {"X-Heliotrope-Groups": "solar-guests"},
        {"X-Heliotrope-Groups": "staff"},
        {"X-Heliotrope-Secret": "0" * 64},
        {"X-Heliotrope-Person": ""},
    ):
        assert behind.get("api/v1/session", headers=other).status_code == 401, other
        order = behind.post("api/v1/emergency", json={"reason": "x"}, headers={**csrf, **other})
        assert order.status_code == 200, other  # a safe order never waits for the proxy
    behind.get("login", headers={"X-Heliotrope-Groups": "solar-engineers"})
    engineer = {"X-Heliotrope-Groups": "solar-engineers"}
    assert behind.get("api/v1/session", headers=engineer).json()["role"] == "engineer"


def test_a_name_may_have_any_letters(console: LiveConsole, behind: httpx.Client) -> None:
    """Headers are bytes: those of UTF-8 are no two letters of Latin-1 each."""
    for composed in ("\u00e9lise", "e\u0301lise"):
        person = {"X-Heliotrope-Person": composed.encode()}
        assert behind.get("login", headers=person).status_code == 303
        assert behind.get("api/v1/session", headers=person).json()["name"] == "\u00e9lise"
    behind.cookies.clear()
    broken = behind.get("login", headers={"X-Heliotrope-Person": b"\xe9lise"})
    assert "set-cookie" not in broken.headers
    assert console.keeper.people.account("\u00e9lise") is not None


@pytest.mark.parametrize(
    ("line", "groups", "role"),
    [
        ("", "guests,solar-engineers", "engineer"),
        ('separator = "|"', "guests,solar-engineers", ""),
        ('separator = "|"', "guests,solar-engineers|solar-guests", "viewer"),
        ('separator = "|"', "solar-guests | solar-operators", "operator"),
    ],
)
def test_groups_end_where_the_file_says(tmp_path: Path, line: str, groups: str, role: str) -> None:
    """A provider that allows commas in names of groups needs another separator."""
    file = FILE.replace("[roles]", f"{line}\n[roles]")
    found = ByProxy.read(written(tmp_path, file)).introduced(
        Headers({**HEADERS, "X-Heliotrope-Groups": groups})
    )
    assert found is not None
    assert found.role == role


def test_an_address_is_believed_of_the_proxy_alone_and_shown_as_its_word(
    console: LiveConsole, behind: httpx.Client
) -> None:
    """Other programs on the proxy's machine can send the same headers, but not the secret."""
    guess = {"name": "viewer", "password": "not the password"}
    for secret in (WORD, "0" * 64):
        headers = {"X-Forwarded-For": "203.0.113.5", "X-Heliotrope-Secret": secret}
        assert behind.post("api/v1/session", json=guess, headers=headers).status_code == 401
    events = console.call(lambda: console.live.operations.logbook.events(50))
    failed = [event for event in events if "failed to sign in" in event.text]
    found = [event.text for event in failed if event.who == "viewer"]
    assert sorted(text.partition("(from ")[2] for text in found) == [
        "127.0.0.1)",
        "203.0.113.5 via 127.0.0.1)",
    ]


@pytest.mark.parametrize(
    ("headers", "text"),
    [
        ({"X-Heliotrope-Person": "engineer"}, "has a password here"),
        ({"X-Heliotrope-Groups": "staff"}, "none of your groups has a role"),
    ],
)
def test_who_stays_out(behind: httpx.Client, headers: dict[str, str], text: str) -> None:
    answer = behind.get("login", headers=headers)
    assert answer.status_code == 403
    assert text in answer.json()["detail"]
    assert "set-cookie" not in answer.headers


def test_without_the_secret_it_is_a_stranger(behind: httpx.Client) -> None:
    for secret in ("", WORD[:-1], "0" * 64):
        answer = behind.get("login", headers={"X-Heliotrope-Secret": secret})
        assert answer.status_code == 200  # the page to sign in
        assert "set-cookie" not in answer.headers


def test_other_addresses_are_not_believed(console: LiveConsole, behind: httpx.Client) -> None:
    here = console.server.app.state.console
    settings = here.settings
    others = ConsoleSettings(port=0, proxies=("192.0.2.1",))
    console.call(lambda: setattr(here, "settings", others))
    assert "set-cookie" not in behind.get("login").headers
    console.call(lambda: setattr(here, "settings", settings))
    assert "set-cookie" in behind.get("login").headers


@pytest.mark.parametrize("name", ["PLANT/ada", "a/password", "50 % ? # &", "a" * 100])
def test_an_account_of_any_name_is_disabled_and_has_no_factor_to_remove(
    console: LiveConsole, behind: httpx.Client, name: str
) -> None:
    here = console.server.app.state.console
    console.call(lambda: setattr(here, "settings", replace(here.settings, second_factor="")))
    assert behind.get("login", headers={"X-Heliotrope-Person": name}).status_code == 303
    path = f"accounts/{quote(name, safe='')}"
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        who = client.post("session", json={"name": "engineer", "password": PASSWORD}).json()
        client.headers["X-CSRF-Token"] = who["csrf"]
        own = {"own_password": PASSWORD}
        assert client.patch(path, json={"disabled": True, **own}).json()["name"] == name
        reset = client.post(f"{path}/password", json=own)
        assert (reset.status_code, "signs in through the proxy" in reset.text) == (409, True)
        factor = client.request("DELETE", f"{path}/factor", json=own)
        assert "set up your own second factor first" in factor.json()["detail"]
    account = console.keeper.people.account(name)
    assert account is not None
    assert account.disabled


@pytest.mark.parametrize("name", [".", "..", "a" * 101])
def test_a_name_that_no_path_can_name_gets_no_account(
    console: LiveConsole, behind: httpx.Client, name: str
) -> None:
    answer = behind.get("login", headers={"X-Heliotrope-Person": name})
    assert answer.status_code == 422
    assert "the name must have 1 to 100" in answer.json()["detail"]
    assert console.keeper.people.account(name) is None


def test_a_disabled_account_stays_out(console: LiveConsole, behind: httpx.Client) -> None:
    behind.get("login")
    console.keeper.people.change("ada", 1.0, disabled=True)
    assert "is disabled" in behind.get("login").json()["detail"]


def test_the_example_of_nginx_sets_each_header(tmp_path: Path) -> None:
    found = ByProxy.read(written(tmp_path))
    (block,) = re.findall(r"```text\n(server \{.*?)```", PAGE, re.S)
    (plant,) = re.findall(r"location / \{(.*?)\n    \}", block, re.S)
    given: dict[str, str] = dict(re.findall(r"proxy_set_header (\S+) (\S+);", plant))
    assert given[found.person] == "$person"
    assert given[found.groups] == "$groups"
    assert given[found.secret] == "SECRET"
    assert given["X-Forwarded-For"] == "$proxy_add_x_forwarded_for"
    for variable in ("$person", "$groups"):
        assert f"auth_request_set {variable} $upstream_http_x_auth_request_" in plant


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"text": FILE.replace("heliotrope-proxy", "other")}, "format is 'other'"),
        ({"text": FILE.replace('"viewer"', '"boss"')}, "roles.solar-guests"),
        ({"text": FILE.replace("X-Heliotrope-Person", "X Person")}, "person"),
        ({"text": FILE.replace("groups =", "group =")}, "'groups' is missing"),
        ({"word": "short"}, "at least 32 letters"),
        ({"text": FILE.replace("[roles]", 'separator = ""\n[roles]')}, "separator"),
        ({"mode": 0o644}, "others may read it"),
    ],
)
def test_files_that_are_refused(tmp_path: Path, change: dict[str, Any], text: str) -> None:
    with pytest.raises(FormatError, match=text):
        ByProxy.read(written(tmp_path, **change))


def test_it_needs_the_address_of_the_proxy(tmp_path: Path) -> None:
    file = written(tmp_path)
    assert tomllib.loads(FILE)["version"] == 1
    with pytest.raises(InputError, match="trusts only the addresses of --proxy"):
        ConsoleSettings(people_by_proxy=file)
    given = ConsoleSettings(people_by_proxy=file, proxies=("::1",))
    assert ConsoleSettings.of(given.values) == given
