"""The HTTP API against a plant at work: roles, sessions, commands, emergency."""

import asyncio
import contextlib
import logging
import re
import shutil
import ssl
import subprocess
import threading
import time
from collections.abc import Callable
from http.client import HTTPConnection
from pathlib import Path

import httpx
import pytest

from heliotrope.console._files import KEPT, STATIC
from heliotrope.console.client import Client, RemoteError
from heliotrope.console.people import FIRST, first_start
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import InputError
from heliotrope.field.volumes import outline
from heliotrope.plant.orders import audit
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import StoreError
from support.live_console import GATE, PASSWORD, LiveConsole, serving
from support.papers import certificate as renewed

Ask = Callable[..., httpx.Response]
ORDER = ("", "viewer", "operator", "engineer")
#: The least role of every route; "" is open to all. A route that is not here fails the test.
NEEDED = {
    ("GET", "health"): "",
    ("POST", "session"): "",
    **{("GET", path): "viewer" for path in (
        "aims", "alarms", "authority", "calibration", "clusters", "commands", "commands/{identity}",
        "emergency", "events", "field", "flights", "heliostats/{name}", "holds", "learning",
        "packets", "heliostats/{name}/parameters", "receivers/{name}/flux", "retries", "schedule",
        "session",
        "summary", "sun", "targets/{name}", "timetable",
        "targets/{name}/photograph", "tokens", "photographs", "photographs/{identity}")},
    ("POST", "emergency"): "viewer",
    ("DELETE", "session"): "viewer",
    ("POST", "tokens"): "viewer",
    ("DELETE", "tokens/{key}"): "viewer",
    **{("POST", path): "operator" for path in (
        "aim", "alarms/acknowledge", "authority", "authority/seize", "automatic",
        "automatic/resume", "calibration/next", "targets/{name}/photograph", "commands",
        "defocus", "holds", "holds/release", "standby", "stow")},
    ("PUT", "authority"): "operator",
    ("DELETE", "authority"): "operator",
    ("PUT", "calibration"): "operator",
    ("PUT", "timetable"): "operator",
    ("DELETE", "emergency"): "operator",
    ("PUT", "session/password"): "viewer",
    ("PUT", "session/presence"): "viewer",
    **{(method, "session/factor"): "viewer" for method in ("POST", "PUT", "DELETE")},
    ("DELETE", "accounts/{name}/factor"): "engineer",
    ("POST", "accounts/{name}/password"): "engineer",
    ("POST", "flights"): "engineer",
    ("POST", "learning"): "engineer",
    ("POST", "parameters"): "engineer",
    ("GET", "events/{number}/heliostats"): "viewer",
    ("GET", "parameters/waiting"): "viewer",
    ("POST", "parameters/waiting/{number}/approve"): "engineer",
    ("POST", "parameters/waiting/{number}/refuse"): "engineer",
    ("DELETE", "parameters/waiting/{number}"): "engineer",
    ("PUT", "readings/{name}"): "engineer",
    ("POST", "clusters/{name}/frames"): "engineer",
    ("POST", "targets/{name}/marks/picture"): "engineer",
    ("POST", "targets/{name}/marks"): "engineer",
    ("GET", "pictures-to-mark/{identity}"): "engineer",
    ("GET", "heliostats/{name}/why"): "viewer",
    ("GET", "journal"): "viewer",
    ("GET", "heliostats/{name}/versions"): "viewer",
    ("GET", "report"): "viewer",
    ("GET", "trends"): "viewer",
    ("GET", "trend"): "viewer",
    ("POST", "notes"): "operator",
    **{(method, f"plant-file{path}"): "engineer" for method, path in (
        ("GET", ""), ("PUT", ""), ("GET", "/versions/{name}"),
        ("POST", "/check"), ("POST", "/waiting/{number}/approve"),
        ("POST", "/waiting/{number}/refuse"), ("DELETE", "/waiting/{number}"))},
    ("GET", "plant-file/help"): "viewer",
    ("GET", "accounts"): "engineer",
    ("POST", "accounts"): "engineer",
    ("PATCH", "accounts/{name}"): "engineer",
}  # fmt: skip
#: What would change something with an empty body; told by tests of its own.
ACTS = {("POST", "emergency"), ("DELETE", "emergency"), ("POST", "stow"), ("POST", "defocus"),
        ("POST", "automatic"), ("POST", "automatic/resume"), ("POST", "authority"),
        ("POST", "holds/release"), ("DELETE", "authority")}  # fmt: skip


def test_every_route_has_its_role(console: LiveConsole, ask: Ask) -> None:
    described = console.call(console.server.app.openapi)["paths"]
    routes = {
        (method.upper(), path.removeprefix("/api/v1/"))
        for path, methods in described.items()
        for method in methods
    }
    assert routes == set(NEEDED)
    for (method, path), needed in NEEDED.items():
        where = path.format(name="nobody", identity="nobody", key="nobody", number="1")
        for role in ORDER:
            enough = ORDER.index(role) >= ORDER.index(needed)
            if enough and (method, path) in ACTS:
                continue
            status = ask(role, method, where, None if method == "GET" else {}).status_code
            expected = set() if enough else {403 if role else 401}
            if enough:
                assert status not in (401, 403, 500), (method, path, role)
            else:
                assert status in expected, (method, path, role, status)


def test_the_field_shows_where_no_beam_may_be(ask: Ask) -> None:
    (gate,) = ask("viewer", "GET", "field").json()["keep_outs"]
    assert gate["name"] == "gate"
    assert gate["outline"] == outline(GATE).round(2).tolist()


def test_the_page_of_the_api_has_every_route() -> None:
    place = Path(__file__).parents[2] / "docs" / "reference" / "api-http.md"
    page = place.read_text("utf-8")
    rows = re.findall(r"^\| `([A-Z]+) (\S+)` \| (\w+) \| \S", page, re.MULTILINE)
    assert {(method, path): role for method, path, role in rows} == {
        route: role or "none" for route, role in NEEDED.items()
    }
    assert len(rows) == len(NEEDED)


def test_what_a_session_needs(console: LiveConsole, signed_in: httpx.Client) -> None:
    cookie = console.address + "api/v1/"
    assert signed_in.get("session").json()["role"] == "operator"
    word = signed_in.headers.pop("X-CSRF-Token")
    for headers in ({}, {"X-CSRF-Token": "0" * 64}):
        assert signed_in.put("authority", headers=headers).status_code == 403
    foreign = {"X-CSRF-Token": word, "Origin": "https://elsewhere.example"}
    assert signed_in.put("authority", headers=foreign).status_code == 403
    own = {"X-CSRF-Token": word, "Origin": console.address.rstrip("/")}
    assert signed_in.post("automatic", headers=own, json={}).status_code == 200
    assert signed_in.delete("session", headers=own).status_code == 204
    assert signed_in.get(cookie + "session").status_code == 401


def test_the_cookie_is_out_of_reach(console: LiveConsole) -> None:
    answer = httpx.post(
        f"{console.address}api/v1/session",
        json={"name": "viewer", "password": PASSWORD},
        trust_env=False,
    )
    (cookie,) = answer.headers.get_list("set-cookie")
    assert "HttpOnly" in cookie
    assert "SameSite=strict" in cookie
    assert PASSWORD not in answer.text


def test_other_names_of_this_machine_are_refused(console: LiveConsole) -> None:
    answer = httpx.get(
        f"{console.address}api/v1/health", headers={"Host": "rebound.example"}, trust_env=False
    )
    assert answer.status_code == 421
    assert "not known here" in answer.json()["detail"]


def test_bodies_have_a_length_and_a_limit(console: LiveConsole) -> None:
    url = f"{console.address}api/v1/session"
    chunked = httpx.post(url, content=iter([b"{}"]), trust_env=False)
    assert chunked.status_code == 411
    host, port = console.address.removeprefix("http://").rstrip("/").split(":")
    connection = HTTPConnection(host, int(port), timeout=10.0)
    connection.putrequest("POST", "/api/v1/session")
    connection.putheader("Content-Length", str(1 << 30))
    connection.endheaders()
    assert connection.getresponse().status == 413
    connection.close()


@pytest.mark.parametrize(
    "path", ["", "account", "api/v1/health", "login", "emergency", f"{KEPT[1:]}/live.js"]
)
def test_safe_headers(console: LiveConsole, signed_in: httpx.Client, path: str) -> None:
    answer = signed_in.get(console.address + path)
    assert answer.status_code == 200
    headers, policy = answer.headers, answer.headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'; " in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["x-frame-options"] == "DENY"
    assert headers["referrer-policy"] == "no-referrer"
    assert "server" not in headers


def test_guessing_is_slowed(console: LiveConsole) -> None:
    url = f"{console.address}api/v1/session"
    with httpx.Client(trust_env=False) as client:
        texts = set()
        for _ in range(5):
            answer = client.post(url, json={"name": "nobody here", "password": "x" * 12})
            assert answer.status_code == 401
            texts.add(answer.json()["detail"])
        assert texts == {"name or password is wrong"}
        answer = client.post(url, json={"name": "nobody here", "password": "x" * 12})
        assert answer.status_code == 429
        assert 0 < int(answer.headers["retry-after"]) <= 60


def test_a_disabled_account_is_out_at_once(console: LiveConsole, ask: Ask, person: Ask) -> None:
    given = {"name": "guest", "role": "viewer", "password": "a long password"}
    assert person("engineer", "POST", "accounts", given).status_code == 201
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        client.post("session", json={"name": "guest", "password": "a long password"})
        assert client.get("session").status_code == 200
        changed = person("engineer", "PATCH", "accounts/guest", {"disabled": True})
        assert changed.json()["disabled"]
        assert client.get("session").status_code == 401
        again = client.post("session", json={"name": "guest", "password": "a long password"})
        assert again.status_code == 401


def test_no_secret_is_in_logs_or_files(
    console: LiveConsole,
    ask: Ask,
    person: Ask,
    tokens: dict[str, str],
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Log-ins, good and bad, tokens, new passwords: what is logged and kept holds none of it."""
    caplog.set_level(logging.DEBUG)
    given = {"name": "desk-5", "role": "operator", "password": "a very own password"}
    person("engineer", "POST", "accounts", given)
    console.settle("desk-5", given["password"])
    with _client(console) as client:
        wrong = {"name": "desk-5", "password": "not quite the password"}
        assert client.post("session", json=wrong).status_code == 401
        answer = client.post("session", json={"name": "desk-5", "password": given["password"]})
        session, csrf = client.cookies["heliotrope_session"], answer.json()["csrf"]
        client.headers["X-CSRF-Token"] = csrf
        label = {"label": "nightly", "role": "viewer", "own_password": given["password"]}
        token = client.post("tokens", json=label).json()["secret"]
        with Client(token, console.address) as program:
            program.get("summary")
            with pytest.raises(RemoteError):
                program.ask("POST", "stow", {"heliostats": ["nobody"]})
    made = person("engineer", "POST", "accounts/desk-5/password").json()["password"]
    ask("engineer", "GET", "events")
    # What the clients of this test log of their own requests is not the console's.
    ours = [r.getMessage() for r in caplog.records if not r.name.startswith("http")]
    assert ours
    told = "\n".join(ours) + "".join(capfd.readouterr())
    files = [file.read_bytes() for file in console.folder.iterdir() if file.is_file()]
    assert any(b"desk-5" in data for data in files)
    secrets = (
        given["password"],
        wrong["password"],
        session,
        csrf,
        token,
        made,
        PASSWORD,
        *tokens.values(),
    )
    for secret in secrets:
        assert secret not in told
        assert not any(secret.encode() in data for data in files)


def _client(console: LiveConsole) -> httpx.Client:
    return httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False)


def test_a_new_password_is_told_once_and_ends_sessions(
    console: LiveConsole, ask: Ask, person: Ask
) -> None:
    given = {"name": "desk-2", "role": "viewer", "password": "a long password"}
    assert person("engineer", "POST", "accounts", given).status_code == 201
    with _client(console) as client:
        client.post("session", json={"name": "desk-2", "password": "a long password"})
        assert client.get("session").status_code == 200
        made = person("engineer", "POST", "accounts/desk-2/password").json()
        assert client.get("session").status_code == 401
        old = client.post("session", json={"name": "desk-2", "password": "a long password"})
        assert old.status_code == 401
        again = client.post("session", json=made)
        assert again.status_code == 200
    events = ask("viewer", "GET", "events").text
    assert "created a new password: desk-2" in events
    assert made["password"] not in events + ask("engineer", "GET", "accounts").text
    assert person("engineer", "POST", "accounts/engineer/password").status_code == 409
    assert person("engineer", "POST", "accounts/nobody/password").status_code == 404


def test_the_own_password(console: LiveConsole, ask: Ask, person: Ask) -> None:
    given = {"name": "desk-3", "role": "viewer", "password": "a long password"}
    assert person("engineer", "POST", "accounts", given).status_code == 201
    change = {"old": "not this one", "new": "another password"}
    with _client(console) as client, _client(console) as elsewhere:
        for one in (client, elsewhere):
            answer = one.post("session", json={"name": "desk-3", "password": "a long password"})
            one.headers["X-CSRF-Token"] = answer.json()["csrf"]
        refused = client.put("session/password", json=change)
        assert refused.status_code == 403
        assert "current password" in refused.json()["detail"]
        change["old"] = "a long password"
        assert client.put("session/password", json={**change, "new": "short"}).status_code == 422
        assert client.put("session/password", json=change).status_code == 204
        assert client.get("session").status_code == 401
        assert elsewhere.get("session").status_code == 401
        signed = client.post("session", json={"name": "desk-3", "password": "another password"})
        assert signed.status_code == 200
    # Programs have no business with passwords.
    assert ask("viewer", "PUT", "session/password", change).status_code == 403


def test_guessing_the_own_password_is_slowed(console: LiveConsole, ask: Ask, person: Ask) -> None:
    given = {"name": "desk-4", "role": "viewer", "password": "a long password"}
    assert person("engineer", "POST", "accounts", given).status_code == 201
    with _client(console) as client:
        answer = client.post("session", json={"name": "desk-4", "password": "a long password"})
        client.headers["X-CSRF-Token"] = answer.json()["csrf"]
        guess = {"old": "x" * 12, "new": "another password"}
        seen = [client.put("session/password", json=guess).status_code for _ in range(6)]
    assert seen == [403] * 5 + [429]


def test_nobody_takes_away_their_own_role(person: Ask) -> None:
    answer = person("engineer", "PATCH", "accounts/engineer", {"role": "viewer"})
    assert answer.status_code == 409


def test_sessions_and_tokens_end(console: LiveConsole, ask: Ask, person: Ask) -> None:
    people, now = console.keeper.people, time.time()
    old = people.open_session("operator", now - 100.0, 50.0)
    _, late = people.add_token("operator", "late", "operator", now - 100.0, 50.0)
    kept, word = people.add_token("operator", "kept", "operator", now)
    url = f"{console.address}api/v1/summary"
    with httpx.Client(trust_env=False) as client:
        cookie = {"Cookie": f"heliotrope_session={old}"}
        assert client.get(url, headers=cookie).status_code == 401
        bearer = {"Authorization": f"Bearer {late}"}
        assert client.get(url, headers=bearer).status_code == 401
        bearer = {"Authorization": f"Bearer {word}"}
        assert client.get(url, headers=bearer).status_code == 200
        assert person("operator", "DELETE", f"tokens/{kept.key}").status_code == 204
        assert client.get(url, headers=bearer).status_code == 401


def test_what_has_expired_leaves_the_store(console: LiveConsole) -> None:
    people, now = console.keeper.people, time.time()
    old, _ = people.add_token("operator", "old", "operator", now - 100.0, 50.0)
    new, _ = people.add_token("operator", "new", "operator", now, 50.0)

    async def begin() -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(1.0):
                await console.server.app.state.console.forget_expired()

    console.console_wait(begin())
    console.until(lambda: old.key not in {one.key for one in people.tokens()})
    assert new.key in {one.key for one in people.tokens()}
    people.revoke_token(new.key)


def test_the_store_is_asked_beside_the_loop(
    console: LiveConsole, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    people, threads = console.keeper.people, []
    look = people.valid

    def noted(now: float, used: list[str]) -> object:
        threads.append(threading.current_thread())
        return look(now, used)

    monkeypatch.setattr(people, "valid", noted)
    # The roster is read again now and then: it forgets after whoever reads it is noted.
    console.console_call(console.server.app.state.console.roster.forget)
    assert ask("viewer", "GET", "sun").status_code == 200
    loops = {console.call(threading.current_thread), console.console_call(threading.current_thread)}
    assert threads
    assert not loops & set(threads)
    # Nor in the thread of the sockets, where all requests of the console wait.
    assert threads[0].name.startswith("plant people")


def test_a_token_is_made_in_a_session_only(signed_in: httpx.Client, ask: Ask) -> None:
    given = {"label": "script", "role": "operator", "own_password": PASSWORD}
    assert ask("operator", "POST", "tokens", given).status_code == 403
    made = signed_in.post("tokens", json=given)
    assert made.status_code == 201
    listed = signed_in.get("tokens").json()
    assert {one["name"] for one in listed} == {"operator"}
    assert made.json()["secret"] not in str(listed)
    above = signed_in.post("tokens", json={**given, "role": "engineer"})
    assert above.status_code == 403


#: Changes of accounts and tokens, which take over the plant in the wrong hands.
CHANGES = (
    ("POST", "accounts", {"name": "mallory", "role": "engineer", "password": "a long password"}),
    ("PATCH", "accounts/viewer", {"role": "engineer"}),
    ("PATCH", "accounts/viewer", {"disabled": True}),
    ("PATCH", "accounts/operator", {"password": "a long password"}),
    ("POST", "accounts/viewer/password", {}),
    ("POST", "tokens", {"label": "script", "role": "viewer"}),
    ("DELETE", "tokens/{key}", {}),
)


@pytest.mark.parametrize(("method", "path", "body"), CHANGES)
def test_accounts_change_in_a_session_with_the_own_password_only(
    console: LiveConsole, ask: Ask, person: Ask, method: str, path: str, body: dict[str, object]
) -> None:
    """A stolen token changes none, and neither does a stolen session without the password."""
    people = console.keeper.people
    key = people.tokens("viewer")[0].key
    before = people.accounts(), {one.key for one in people.tokens()}
    where, word = path.format(key=key), {"own_password": PASSWORD}
    assert ask("engineer", method, where, {**body, **word}).status_code == 403
    assert person("engineer", method, where, {**body, "own_password": "not it"}).status_code == 403
    assert ask("engineer", method, where, body).status_code in (403, 422)
    assert (people.accounts(), {one.key for one in people.tokens()}) == before


def test_the_password_of_ones_own_name_needs_the_old_one(person: Ask) -> None:
    change = {"password": "a long password"}
    refused = person("engineer", "PATCH", "accounts/engineer", change)
    assert refused.status_code == 409
    assert "your own password" in refused.json()["detail"]


@pytest.mark.parametrize(("role", "days"), [("engineer", 91), ("operator", 91), ("viewer", 366)])
def test_no_token_lasts_long(person: Ask, role: str, days: int) -> None:
    given = {"label": "long", "role": role, "days": days}
    assert person("engineer", "POST", "tokens", given).status_code == 422
    made = person("engineer", "POST", "tokens", {**given, "days": days - 1}).json()
    assert made["expires"] - made["created"] == pytest.approx(86_400.0 * (days - 1))
    assert person("engineer", "DELETE", f"tokens/{made['key']}").status_code == 204


def test_tokens_end_with_the_password_of_their_owner(console: LiveConsole, person: Ask) -> None:
    given = {"name": "desk-6", "role": "viewer", "password": "a long password"}
    assert person("engineer", "POST", "accounts", given).status_code == 201
    _, secret = console.keeper.people.add_token("desk-6", "old", "viewer", time.time())
    with Client(secret, console.address) as program:
        program.get("summary")
        assert person("engineer", "POST", "accounts/desk-6/password").status_code == 200
        with pytest.raises(RemoteError, match="sign in"):
            program.get("summary")


def _take(ask: Ask, role: str = "operator") -> None:
    until = time.monotonic() + 90.0
    while (answer := ask(role, "POST", "authority")).status_code != 200:
        assert time.monotonic() < until, answer.text
        time.sleep(0.2)


def test_a_command_has_one_record(console: LiveConsole, ask: Ask) -> None:
    console.until(lambda: console.live.operations.summary().states.get("STOWED", 0) < 64)
    name = console.live.names[3]
    order = {"command": "LOCK", "heliostats": [name]}
    ask("operator", "DELETE", "authority")
    early = ask("operator", "POST", "commands", order)
    assert early.status_code == 409
    assert "take command first" in early.json()["detail"]
    _take(ask)
    answer = ask("operator", "POST", "commands", order)
    assert answer.status_code == 200, answer.text
    identity = answer.json()["identity"]
    until = time.monotonic() + 90.0
    while not (seen := ask("viewer", "GET", f"commands/{identity}").json())["finished"]:
        assert time.monotonic() < until, seen
        time.sleep(0.2)
    assert seen["good"], seen
    assert console.until(lambda: console.live.operations.viewer.heliostat(name).state == "LOCKED")
    records, torn = audit.read(console.folder / "audit.jsonl")
    mine = [record for record in records if record.identity == identity]
    assert torn == 0
    assert [(r.who, r.role, r.what, r.heliostats) for r in mine] == [
        ("operator", "operator", "LOCK", (name,))
    ]
    assert mine[0].result
    assert ask("operator", "DELETE", "authority").json()["holder"] != "operator"


@pytest.mark.parametrize("name", ["JOG", "ZERO"])
def test_what_only_an_engineer_may(ask: Ask, console: LiveConsole, name: str) -> None:
    order = {"command": name, "heliostats": [console.live.names[0]], "values": [0, 10]}
    answer = ask("operator", "POST", "commands", order)
    assert answer.status_code == 403
    assert "needs engineer" in answer.json()["detail"]


def test_zero_goes_to_one_heliostat(ask: Ask, console: LiveConsole) -> None:
    _take(ask, "engineer")
    order = {"command": "ZERO", "heliostats": [], "values": [0, 10]}
    refused = ask("engineer", "POST", "commands", order)
    assert refused.status_code == 409
    assert "between heliostats; specify one heliostat" in refused.json()["detail"]
    order["heliostats"] = [console.live.names[0]]
    given = ask("engineer", "POST", "commands", order)
    assert given.status_code == 200, given.text
    assert (given.json()["command"], given.json()["heliostats"]) == ("ZERO", 1)
    ask("engineer", "DELETE", "authority")


def test_answers_that_all_share_are_packed(console: LiveConsole, tokens: dict[str, str]) -> None:
    headers = {"Authorization": f"Bearer {tokens['viewer']}"}
    with _client(console) as client:
        for path in ("field", "clusters"):
            packed = client.get(path, headers={**headers, "Accept-Encoding": "gzip"})
            plain = client.get(path, headers={**headers, "Accept-Encoding": "identity"})
            assert "content-encoding" not in plain.headers
            assert packed.headers.get("content-encoding") == (
                "gzip" if len(plain.content) > 1024 else None
            )
            assert len(packed.json()) == len(plain.json())
        assert packed.headers["cache-control"] == "no-store"


def test_files_of_the_page_are_kept_by_browsers(console: LiveConsole) -> None:
    with httpx.Client(base_url=console.address, trust_env=False) as client:
        path = f"{KEPT[1:]}/live.js"
        plain = client.get(path, headers={"Accept-Encoding": "identity"})
        assert plain.content == (STATIC / "live.js").read_bytes()
        assert plain.headers["content-type"] == "text/javascript; charset=utf-8"
        assert "immutable" in plain.headers["cache-control"]
        tag = {"If-None-Match": plain.headers["etag"]}
        assert client.get(path, headers=tag).status_code == 304
        packed = client.get(path, headers={"Accept-Encoding": "gzip"})
        assert packed.headers["content-encoding"] == "gzip"
        assert packed.content == plain.content
        for missing in ("nothing.js", "../app.py", "console.html", "../static/live.js"):
            assert client.get(f"{KEPT[1:]}/{missing}").status_code == 404
        assert client.get(path, headers={"Host": "x"}).status_code == 421


def test_the_pages_name_files_that_there_are(console: LiveConsole, signed_in: httpx.Client) -> None:
    for path in ("", "account", "emergency", "login"):
        text = signed_in.get(console.address + path).text
        files = re.findall(r'(?:src|href)="(/console/[^"]+)"', text)
        assert files
        for file in files:
            assert signed_in.get(console.address + file[1:]).status_code == 200


def test_the_page_preloads_each_module(console: LiveConsole, signed_in: httpx.Client) -> None:
    text = signed_in.get(console.address).text
    preloaded = set(re.findall(r'"modulepreload" href="[^"]+/(\w+\.js)"', text))
    seen, todo = set[str](), ["console.js"]
    while todo:
        source = signed_in.get(f"{console.address}{KEPT[1:]}/{todo.pop()}").text
        todo += (found := set(re.findall(r'from "\./(\w+\.js)"', source)) - seen)
        seen |= found
    assert preloaded == seen


def test_tls_by_file(console: LiveConsole, tmp_path: Path) -> None:
    """A certificate and a key in files, really served."""
    certificate, key = tmp_path / "console.pem", tmp_path / "console.key"
    subprocess.run(
        [
            "openssl",
            "req",
            "-x509",
            "-newkey",
            "ec",
            "-pkeyopt",
            "ec_paramgen_curve:prime256v1",
            "-nodes",
            "-days",
            "2",
            "-subj",
            "/CN=localhost",
            "-addext",
            "subjectAltName=IP:127.0.0.1,DNS:localhost",
            "-keyout",
            key,
            "-out",
            certificate,
        ],
        check=True,
        capture_output=True,
    )
    settings = ConsoleSettings(port=0, certificate=certificate, key=key)

    second = serving(console.interface, settings)
    _, address = console.console_wait(second.__aenter__())
    try:
        assert address.startswith("https://")
        known = ssl.create_default_context(cafile=certificate)
        with httpx.Client(base_url=address, verify=known, trust_env=False) as client:
            given = {"name": "viewer", "password": PASSWORD}
            answer = client.post("api/v1/session", json=given)
            assert answer.status_code == 200
            assert "; Secure" in answer.headers["set-cookie"]
            assert "max-age" in answer.headers["strict-transport-security"]
        with pytest.raises(httpx.HTTPError):
            httpx.get(f"http{address[5:]}api/v1/health", trust_env=False)
        # Renewed in its place: taken without a restart, and the one before is gone.
        for new, old in zip(renewed(tmp_path, 90.0), (certificate, key), strict=True):
            shutil.copy(new, old)
        trusting = ssl.create_default_context(cafile=certificate)
        until, status = time.monotonic() + 60.0, 0
        while status != 200:
            assert time.monotonic() < until, "the renewed certificate is not served"
            time.sleep(0.2)
            with contextlib.suppress(httpx.ConnectError):
                status = httpx.get(
                    f"{address}api/v1/health", verify=trusting, trust_env=False
                ).status_code
        with pytest.raises(httpx.ConnectError):
            httpx.get(f"{address}api/v1/health", verify=known, trust_env=False)
    finally:
        console.console_wait(second.__aexit__(None, None, None))


def test_emergency_does_not_wait_for_the_store(
    console: LiveConsole, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who was known lately may call it, also when the store cannot be read any more."""

    def gone(**_: object) -> None:
        raise StoreError("store: cannot be read (gone)")

    assert ask("viewer", "GET", "summary").status_code == 200
    monkeypatch.setattr(console.keeper.people, "valid", gone)
    console.console_call(console.server.app.state.console.roster.forget)
    assert ask("viewer", "GET", "summary").status_code == 503
    try:
        assert ask("viewer", "POST", "emergency").json()["on"]
    finally:
        monkeypatch.undo()
        assert ask("engineer", "DELETE", "emergency", {"owner": "viewer"}).status_code == 200
        console.calm()


def test_the_authority_of_another(ask: Ask) -> None:
    _take(ask, "engineer")
    refused = ask("operator", "POST", "authority")
    assert refused.status_code == 409
    assert "engineer has it" in refused.json()["detail"]
    assert ask("operator", "POST", "authority/seize", {"reason": "why"}).status_code == 409
    assert not ask("operator", "GET", "authority").json()["mine"]
    ask("engineer", "DELETE", "authority")


def test_the_authority_is_kept_up_in_a_fast_plant(ask: Ask) -> None:
    _take(ask)
    # 15 s of the plant are 2 s here.
    time.sleep(4.0)
    assert ask("operator", "GET", "authority").json()["mine"]
    ask("operator", "DELETE", "authority")


@pytest.mark.parametrize(
    ("path", "body", "status", "text"),
    [
        ("stow", {"heliostats": ["nobody"]}, 404, "nobody"),
        ("stow", {"heliostats": [], "quickly": True}, 422, "quickly"),
        ("aim", {}, 422, "either where"),
        ("commands", {"command": "FLY"}, 403, "FLY"),
        ("holds", {"heliostats": ["P0001A"], "reason": " "}, 409, "reason"),
        ("alarms/acknowledge", {"condition": ""}, 422, "condition"),
    ],
)
def test_what_cannot_be_used(ask: Ask, path: str, body: object, status: int, text: str) -> None:
    answer = ask("operator", "POST", path, body)
    assert answer.status_code == status, answer.text
    assert text in answer.text


def test_holds(ask: Ask, console: LiveConsole) -> None:
    name = console.live.names[5]
    order = {"heliostats": [name], "reason": "being painted"}
    ticket = ask("operator", "POST", "holds", order).json()
    assert (ticket["command"], ticket["finished"]) == ("OUT_OF_SERVICE", False)
    assert ticket["steps"][name].startswith("on its way to stow: ")
    found = ask("viewer", "GET", "holds")
    locked = [(one["kind"], one["name"], one["who"]) for one in found.json()]
    assert locked == [("heliostat", name, "operator")]
    until = time.monotonic() + 90.0
    while not ticket["finished"]:
        assert time.monotonic() < until, ticket
        time.sleep(0.5)
        ticket = ask("viewer", "GET", f"commands/{ticket['identity']}").json()
    assert ticket["good"], ticket
    assert "parked in stow and locked out" in ticket["text"]
    assert ask("viewer", "GET", f"heliostats/{name}").json()["state"] == "STOWED"
    assert isinstance(ask("viewer", "GET", "retries").json(), list)
    assert "being painted" in ask("viewer", "GET", f"heliostats/{name}").json()["hold"]
    # Another person's lock on it too: it stays out until both are returned.
    target = console.live.operations.targets[0]
    both = {"heliostats": [name], "targets": [target], "reason": "a ladder"}
    assert ask("engineer", "POST", "holds", both).status_code == 200
    left = ask("operator", "POST", "holds/release", {"heliostats": [name]}).json()
    assert [(one["name"], one["who"]) for one in left] == [(name, "engineer"), (target, "engineer")]
    refused = ask("operator", "POST", "holds/release", {"heliostats": [name]})
    assert refused.status_code == 409
    assert "operator has no lock on" in refused.text
    assert ask("engineer", "POST", "holds/release", {}).status_code == 422
    back = {"heliostats": [name], "targets": [target]}
    assert ask("engineer", "POST", "holds/release", back).json() == []


def test_an_emergency_of_a_viewer(console: LiveConsole, ask: Ask) -> None:
    try:
        found = ask("viewer", "POST", "emergency", {"reason": "smoke"}).json()
        assert (found["on"], found["act"], found["who"]) == (True, "DEFOCUS", "viewer")
        assert found["heliostats"] == 64
        until = time.monotonic() + 90.0
        while ask("viewer", "GET", "emergency").json()["acknowledged"] < 64:
            assert time.monotonic() < until
            time.sleep(0.1)
        console.until(lambda: "TRACKING" not in console.live.operations.summary().states)
        assert ask("viewer", "DELETE", "emergency").status_code == 403
    finally:
        assert ask("operator", "DELETE", "emergency").status_code == 409
        owner = {"owner": "viewer"}
        assert ask("operator", "DELETE", "emergency", owner).status_code in (403, 409)
        assert ask("engineer", "DELETE", "emergency", owner).json()["calls"] == []
        console.calm()


def test_first_start_makes_one_account(tmp_path_factory: pytest.TempPathFactory) -> None:
    keeper = Keeper(tmp_path_factory.mktemp("first") / "store.sqlite", inline=True)
    try:
        password = first_start(keeper.people, 0.0)
        assert password is not None
        assert len(password) > 20
        assert first_start(keeper.people, 1.0) is None
        (made,) = keeper.people.accounts()
        assert (made.name, made.role) == (FIRST, "engineer")
        assert password not in made.password_hash
        assert made.password_hash.startswith("$argon2id$")
    finally:
        keeper.close()


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"port": 70_000}, "for a free port, not 70000"),
        ({"host": "0.0.0.0"}, "without TLS passwords"),
        ({"certificate": "a.pem"}, "both files"),
        ({"period": 0.0}, "period"),
        ({"session_s": 0.0}, "a session must be 0.25 to 168 hours, not 0"),
        ({"idle_s": -1.0}, "the idle lock must be 0 to 600 minutes, not"),
        ({"sign_ins": 2}, "the limit on sign-ins must be 3 to 100 an hour, not 2"),
    ],
)
def test_settings_that_are_refused(options: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        ConsoleSettings(**options)  # type: ignore[arg-type]
