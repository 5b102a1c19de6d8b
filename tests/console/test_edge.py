"""What strangers and known callers may send to the console, and what it costs."""

import json
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from heliotrope.console import bodies, routes
from heliotrope.console.headers import network_of
from heliotrope.errors import InputError
from heliotrope.local import Buckets
from support.live_console import PASSWORD, LiveConsole

Ask = Callable[..., httpx.Response]
#: Nested JSON of 16 MB, as deep as its parser follows.
NESTED = b"[" * 900 + b"],[".join([b"[[1]]"] * 1000) + b"]" * 900
FLOOD = b'{"name":' + b",".join([NESTED] * ((16 << 20) // len(NESTED) - 1)) + b"}"

LOADS = json.loads


def send_raw(console: LiveConsole, head: str, body: bytes, seconds: float = 20.0) -> bytes:
    """Send a request as it is; return the answer, b"" if the connection is closed without one."""
    host, port = console.address.removeprefix("http://").rstrip("/").split(":")
    text = f"{head}\r\nHost: {host}:{port}\r\nContent-Length: {len(body)}\r\n\r\n".encode()
    with socket.create_connection((host, int(port)), timeout=seconds) as line:
        try:
            line.sendall(text)
            line.sendall(body)
        except OSError:
            pass  # it answers and closes before it has read everything
        try:
            return line.recv(65_536)
        except ConnectionResetError:
            return b""


@pytest.fixture
def stall(console: LiveConsole) -> Iterator[Callable[[], float]]:
    """Return the longest time so far that the loop of the console took for one turn, s."""
    import asyncio

    longest, over = [0.0], [False]

    async def look() -> None:
        last = time.monotonic()
        while not over[0]:
            await asyncio.sleep(0.0)
            longest[0], last = max(longest[0], time.monotonic() - last), time.monotonic()
            await asyncio.sleep(0.05)
            last = time.monotonic()

    loop = getattr(console, "_console_loop", console._loop)
    looking = asyncio.run_coroutine_threadsafe(look(), loop)
    yield lambda: longest[0]
    over[0] = True
    looking.result(10.0)


@pytest.mark.parametrize("path", ["session", "aim", "nothing"])
def test_a_body_of_a_stranger_is_not_read(
    console: LiveConsole, stall: Callable[[], float], path: str
) -> None:
    begun = time.monotonic()
    answer = send_raw(console, f"POST /api/v1/{path} HTTP/1.1", FLOOD)
    assert time.monotonic() - begun < 2.0
    assert len(answer) < 2000
    status = b"413" if path == "session" else b"401"
    assert answer[:12] in (b"HTTP/1.1 " + status, b"")
    assert stall() < 1.0


@pytest.mark.parametrize(
    ("role", "method", "path", "status"),
    [
        ("viewer", "POST", "aim", 403),
        ("operator", "POST", "nothing", 404),
        ("operator", "POST", "field", 405),
        ("operator", "POST", "emergency", 413),
        ("operator", "POST", "aim", 413),
        ("operator", "POST", "stow", 413),
    ],
)
def test_a_large_body_is_refused_unparsed(
    console: LiveConsole,
    tokens: dict[str, str],
    monkeypatch: pytest.MonkeyPatch,
    role: str,
    method: str,
    path: str,
    status: int,
) -> None:
    monkeypatch.setattr(json, "loads", _not_the_body)
    head = f"{method} /api/v1/{path} HTTP/1.1\r\nAuthorization: Bearer {tokens[role]}"
    answer = send_raw(console, head, FLOOD)
    assert answer[:12] in (f"HTTP/1.1 {status}".encode(), b"")
    assert len(answer) < 2000


def _not_the_body(data: bytes, **options: Any) -> Any:
    """Parse what the console hears from the plant, which is shorter than the body."""
    assert len(data) < len(FLOOD) // 16, "the body was parsed"
    return LOADS(data, **options)


def test_errors_do_not_echo_the_input(ask: Ask) -> None:
    word = "echo " * 100
    orders: list[dict[str, Any]] = [
        {"heliostats": [word] * 40},
        {"heliostats": [1] * 5000},
        {"where": {word: word}},
        {"points": {f"{word}{k}": [1, 2] for k in range(40)}},
        {f"{word}{k}": 1 for k in range(40)},
    ]
    for order in orders:
        answer = ask("operator", "POST", "aim", order)
        assert answer.status_code == 422, order
        assert len(answer.content) < 3000
        assert answer.text.count("echo") < 20


def test_json_is_bounded_before_it_is_parsed() -> None:
    deep = b"[" * bodies.DEEPEST + b"]" * bodies.DEEPEST
    bodies.check_json(deep)
    bodies.check_json(b'{"reason": "wind :[[[[[[[[[[[[[[[[[[[[[ \\"{{{{{{{{{{{{{{{{{{{ \\\\"}')
    bodies.check_json(json.dumps({f"H{k}": [1.5, 2.5, 3.5] for k in range(200_000)}).encode())
    for wrong in (b"[" + deep + b"]", b'{"a":' * 20, b"]" * 20):
        with pytest.raises(InputError, match="nested more than 16 deep"):
            bodies.check_json(wrong)
    for many in (
        b"[" + b"1," * 1_100_000 + b"1]",
        b"[" + b"[]," * 600_000 + b"1]",
        b"\\" * 3_000_000,
    ):
        with pytest.raises(InputError, match="more than 1000000 values"):
            bodies.check_json(many)


@pytest.mark.parametrize("body", [FLOOD, b'"' * (16 << 20), b"\\" * (16 << 20), b"[{" * (8 << 20)])
def test_the_check_itself_takes_little(body: bytes) -> None:
    begun = time.monotonic()
    with pytest.raises(InputError):
        bodies.check_json(body)
    assert time.monotonic() - begun < 1.0


def test_nothing_is_plain(console: LiveConsole, ask: Ask) -> None:
    with httpx.Client(base_url=console.address, trust_env=False) as client:
        for path in ("nothing", "x" * 200, "console/static/nothing.js"):
            answer = client.get(path)
            assert answer.status_code == 404
            assert len(answer.content) < 100
        assert client.get("api/v1/nothing").status_code == 401
        assert client.get("api/v1/openapi.json").status_code == 401
    assert ask("viewer", "GET", "nothing").status_code == 404
    answer = ask("viewer", "PUT", "field")
    assert answer.status_code == 405
    assert answer.headers["allow"] == "GET"


def test_strangers_are_counted_and_known_callers_are_not(
    console: LiveConsole, ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Requests of a stranger end at a limit; those of people at the same address do not."""
    slow = Buckets(0.5, 10.0, time.monotonic)
    monkeypatch.setattr(console.server.app.state.edge, "_stranger", slow)
    assert ask("viewer", "GET", "summary").status_code == 200
    with httpx.Client(trust_env=False) as client:
        seen = [client.get(f"{console.address}nothing") for _ in range(30)]
        refused = [answer for answer in seen if answer.status_code == 429]
        assert refused
        assert 1 <= int(refused[0].headers["retry-after"]) <= 2
        assert {ask("viewer", "GET", "summary").status_code for _ in range(50)} == {200}
        guess = {"Authorization": "Bearer guessed"}
        seen = [client.get(f"{console.address}api/v1/summary", headers=guess) for _ in range(30)]
        assert {answer.status_code for answer in seen} >= {429}


def test_known_people_share_no_bucket_with_strangers(
    console: LiveConsole, signed_in: httpx.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Strangers at many addresses have taken all that there is for strangers."""
    here = console.server.app.state
    monkeypatch.setattr(here.edge, "_strangers", Buckets(1.0, 0.0, lambda: 0.0))
    assert signed_in.get("session").status_code == 200
    person = {"name": "operator", "password": PASSWORD}
    unmet = console.keeper.people.add_token("viewer", "unmet", "viewer", time.time())[1]
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        bearer = {"Authorization": f"Bearer {unmet}"}
        assert client.get("summary", headers=bearer).status_code == 200
        # Nor do those share it who sign in where somebody is signed in.
        assert client.post("session", json=person).status_code == 200
        client.cookies.clear()
        monkeypatch.setattr(here.console.attempts, "is_home", lambda _: False)
        assert client.post("session", json=person).status_code == 429


def test_all_tokens_of_a_person_count_together(
    console: LiveConsole, tokens: dict[str, str], ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    edge = console.server.app.state.edge
    monkeypatch.setattr(edge, "_known", Buckets(1.0, 2.0, lambda: 0.0))
    other = console.keeper.people.add_token("viewer", "other", "viewer", time.time())[1]
    with httpx.Client(base_url=f"{console.address}api/v1/", trust_env=False) as client:
        seen = [
            client.get("summary", headers={"Authorization": f"Bearer {token}"}).status_code
            for token in (tokens["viewer"], other, tokens["viewer"], other)
        ]
    assert seen == [200, 200, 429, 429]
    assert ask("operator", "GET", "summary").status_code == 200


def test_a_bucket() -> None:
    times = [0.0]
    bucket = Buckets(2.0, 3.0, lambda: times[-1], largest=2)
    assert [bucket.take("a") for _ in range(4)] == [0.0, 0.0, 0.0, 0.5]
    assert bucket.take("b") == 0.0
    times.append(0.5)
    assert [bucket.take("a") for _ in range(2)] == [0.0, 0.5]
    bucket.take("c")  # drops "b", the longest unused
    bucket.take("b")  # drops "a"
    assert [bucket.take("a") for _ in range(3)] == [0.0] * 3


def test_addresses_are_counted_by_network() -> None:
    assert network_of("192.0.2.7") == "192.0.2.7"
    assert network_of("2001:db8:1:2:3:4:5:6") == network_of("2001:db8:1:2::9")
    assert network_of("2001:db8:1:2::9") != network_of("2001:db8:1:3::9")
    assert network_of("::ffff:192.0.2.7") == "192.0.2.7"
    assert network_of("a name") == "a name"


def test_one_large_body_at_a_time(console: LiveConsole, tokens: dict[str, str]) -> None:
    """A second one of the same caller is refused while the first is still on its way."""
    host, port = console.address.removeprefix("http://").rstrip("/").split(":")
    head = (
        f"POST /api/v1/aim HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Length: 20000\r\n"
        f"Authorization: Bearer {tokens['operator']}\r\n\r\n"
    ).encode()
    with socket.create_connection((host, int(port)), timeout=10.0) as one:
        one.sendall(head)
        time.sleep(0.5)
        with socket.create_connection((host, int(port)), timeout=10.0) as other:
            other.sendall(head)
            assert other.recv(4096).startswith(b"HTTP/1.1 429")
        one.sendall(b" " * 20_000)
        assert one.recv(4096).startswith(b"HTTP/1.1 422")


@pytest.mark.parametrize(
    ("cookie", "origin"),
    [(True, "http://evil.example"), (True, "http://["), (False, "own")],
)
def test_the_live_stream_is_for_the_page_of_a_known_person(
    console: LiveConsole, signed_in: httpx.Client, cookie: bool, origin: str
) -> None:
    word = signed_in.cookies["heliotrope_session"]
    headers = {"Cookie": f"heliotrope_session={word}"} if cookie else {}
    url = console.address.replace("http", "ws", 1)
    where = console.address.rstrip("/") if origin == "own" else origin
    given = {"origin": where, "additional_headers": headers, "proxy": None}
    with connect(f"{url}api/v1/live", **given) as line, pytest.raises(ConnectionClosed) as closed:
        line.recv(60.0)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 4401
    # There is no other socket.
    with pytest.raises(InvalidStatus) as refused:
        connect(f"{url}nothing", **given)
    assert refused.value.response.status_code == 403


def test_an_order_is_as_long_as_the_field_needs(
    console: LiveConsole, ask: Ask, tokens: dict[str, str]
) -> None:
    """The console has 64 heliostats: 21 kB of names and points are read, 30 kB are not."""
    names = [f"{k:03}{'n' * 61}" for k in range(160)]
    whole = {"points": dict.fromkeys(names, [-1234.5678901234567] * 3)}
    answer = ask("operator", "POST", "standby", whole)
    assert answer.status_code == 404 or "authority" in answer.text, answer.text
    more = json.dumps(
        {"points": {f"{name[:-1]}{k}": [1.0] * 3 for name in names for k in range(2)}}
    )
    head = f"POST /api/v1/standby HTTP/1.1\r\nAuthorization: Bearer {tokens['operator']}"
    assert send_raw(console, head, more.encode()).startswith(b"HTTP/1.1 413")


def test_every_route_has_a_limit() -> None:
    """Lists of heliostats and points are accepted for a whole field, forms are small."""
    from heliotrope.console.app import ROUTERS
    from heliotrope.plant.orders.authority import Role

    known = routes.Routes(ROUTERS, ["/login"], {})
    for method, path, role, largest in (
        ("POST", "/api/v1/aim", Role.OPERATOR, routes.LARGEST),
        ("POST", "/api/v1/stow", Role.OPERATOR, routes.LARGEST),
        ("POST", "/api/v1/session", None, routes.TINY),
        ("POST", "/api/v1/emergency", Role.VIEWER, routes.FORM),
        ("POST", "/api/v1/automatic/resume", Role.OPERATOR, routes.TINY),
        ("GET", "/api/v1/health", None, routes.TINY),
    ):
        found = known.find({"type": "http", "method": method, "path": path, "headers": []})
        assert (found.status, found.role, found.largest) == (200, role, largest), path
