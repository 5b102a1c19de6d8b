"""Attacks on a plant (`attacked_plant.py`), each a function that goes on until it is over.

All of them are bounded and stay on loopback.
"""

import contextlib
import itertools
import json
import socket
import struct
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx

from heliotrope.errors import HeliotropeError
from heliotrope.local import EMERGENCY, ORDINARY, ask_once, pack, socket_folder

#: Connections that an attack holds.
CONNECTIONS = 1100
#: Nested JSON of some 16 MB.
_NESTED = b"[" * 900 + b"]" * 900
FLOOD = b'{"name":[' + b",".join([_NESTED] * (16_000_000 // len(_NESTED))) + b"]}"


@dataclass
class Place:
    """The plant under attack: its ports, tokens of a viewer and of an operator, its folder.

    ``cluster`` is the port for clusters. The attackers are Vera, a viewer, and Mallory, an
    operator.
    """

    port: int
    urgent: int
    cluster: int
    token: str
    operator: str
    data: Path

    @property
    def url(self) -> str:
        """Address of the console."""
        return f"http://127.0.0.1:{self.port}/"


Attack = Callable[[Place, threading.Event], None]


# -- helpers -------------------------------------------------------------------------------------


def _bytes(place: Place, data: bytes, port: int = 0, wait: float = 5.0) -> bytes:
    """Send bytes over a new connection; return the beginning of the answer."""
    with (
        contextlib.suppress(OSError),
        socket.create_connection(("127.0.0.1", port or place.port), timeout=wait) as line,
    ):
        line.sendall(data)
        return line.recv(1000)
    return b""


def _head(place: Place, line: str, *more: str) -> bytes:
    lines = (f"{line} HTTP/1.1", f"Host: 127.0.0.1:{place.port}", *more, "", "")
    return "\r\n".join(lines).encode()


def _repeat(place: Place, over: threading.Event, data: bytes, port: int = 0) -> None:
    while not over.wait(0.002):
        _bytes(place, data, port)


def _held(place: Place, over: threading.Event, text: bytes, count: int = CONNECTIONS) -> None:
    """Hold connections at both ports."""
    with contextlib.ExitStack() as stack:
        for number in range(count):
            port = place.port if number % 4 else place.urgent
            with contextlib.suppress(OSError):
                line = socket.create_connection(("127.0.0.1", port), timeout=2.0)
                stack.enter_context(line).sendall(text)
            if over.is_set():
                return
        over.wait()


@contextlib.contextmanager
def _client(place: Place, token: str = "") -> Iterator[httpx.Client]:
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    with httpx.Client(base_url=place.url, trust_env=False, timeout=30.0, headers=headers) as client:
        yield client


def _requests(
    place: Place,
    over: threading.Event,
    make: Callable[[httpx.Client, int], object],
    token: str = "",
) -> None:
    """Make requests as fast as they are answered."""
    with _client(place, token) as client:
        for number in itertools.count():
            if over.wait(0.001):
                return
            with contextlib.suppress(httpx.HTTPError):
                make(client, number)


# -- strangers: bodies ---------------------------------------------------------------------------


def nothing(place: Place, over: threading.Event) -> None:
    """No attack: what the measurement itself takes."""
    del place
    over.wait()


def nested(place: Place, over: threading.Event) -> None:
    """16 MB of nested JSON to the sign-in."""
    head = _head(place, "POST /api/v1/session", f"Content-Length: {len(FLOOD)}")
    while not over.is_set():
        _bytes(place, head + FLOOD, wait=30.0)


def unauthorised(place: Place, over: threading.Event) -> None:
    """16 MB of nested JSON to a route that needs a role."""
    head = _head(place, "POST /api/v1/aim", f"Content-Length: {len(FLOOD)}")
    while not over.is_set():
        _bytes(place, head + FLOOD, wait=30.0)


def small_nested(place: Place, over: threading.Event) -> None:
    """4 KB of the deepest JSON that a stranger may send, to the sign-in."""
    body = b"[" * 2000 + b"]" * 2000
    _repeat(place, over, _head(place, "POST /api/v1/session", "Content-Length: 4000") + body)


def uploads(place: Place, over: threading.Event) -> None:
    """Files of 16 MB to the page."""
    head = _head(place, "POST /", "Content-Length: 16000000",
                 "Content-Type: multipart/form-data; boundary=x")  # fmt: skip
    _repeat(place, over, head + b"--x\r\n" + bytes(500_000))


def chunks(place: Place, over: threading.Event) -> None:
    """A body without a length, which never ends."""
    head = _head(place, "POST /api/v1/session", "Transfer-Encoding: chunked")
    _repeat(place, over, head + b"4000\r\n" + bytes(0x4000) + b"\r\n")


def slow_bodies(place: Place, over: threading.Event) -> None:
    """300 bodies that come a byte at a time."""
    head = _head(place, "POST /api/v1/session", "Content-Length: 4000")
    with contextlib.ExitStack() as stack:
        lines = []
        for _ in range(300):
            with contextlib.suppress(OSError):
                line = socket.create_connection(("127.0.0.1", place.port), timeout=2.0)
                lines.append(stack.enter_context(line))
                line.sendall(head)
        while not over.wait(0.5):
            for line in lines:
                with contextlib.suppress(OSError):
                    line.sendall(b"x")


# -- strangers: connections ----------------------------------------------------------------------


def idle(place: Place, over: threading.Event) -> None:
    """1,100 connections that send nothing."""
    _held(place, over, b"")


def half_open(place: Place, over: threading.Event) -> None:
    """1,100 connections with half a request."""
    _held(place, over, b"POST /api/v1/emergency HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Slow:")


def churn(place: Place, over: threading.Event) -> None:
    """Connections that are opened and closed at once, at both ports."""
    while not over.wait(0.001):
        for port in (place.port, place.urgent):
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", port), timeout=2.0).close()


def resets(place: Place, over: threading.Event) -> None:
    """Connections that end with a reset in the middle of a request."""
    while not over.wait(0.001):
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", place.port), timeout=2.0) as line,
        ):
            line.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            line.sendall(_head(place, "GET /api/v1/health"))


def unread(place: Place, over: threading.Event) -> None:
    """200 connections with pipelined requests, whose answers nobody reads."""
    _held(place, over, _head(place, "GET /login") * 50, 200)


def pipelining(place: Place, over: threading.Event) -> None:
    """50 requests at once over each connection."""
    _repeat(place, over, _head(place, "GET /api/v1/health") * 50)


# -- strangers: requests -------------------------------------------------------------------------


def header_bombs(place: Place, over: threading.Event) -> None:
    """Headers of 1 MB."""
    more = [f"X-{k}: {'x' * 1000}" for k in range(1000)]
    _repeat(place, over, _head(place, "GET /login", *more))


def long_paths(place: Place, over: threading.Event) -> None:
    """Paths of 60 KB, escaped."""
    _repeat(place, over, _head(place, f"GET /{'%2e%2e/' * 8500}etc/passwd"))


def unknown_paths(place: Place, over: threading.Event) -> None:
    """Unknown paths, which a framework would answer with pages of its own."""
    _requests(place, over, lambda client, number: client.get(f"nothing/{number}"))


def methods(place: Place, over: threading.Event) -> None:
    """Methods that nothing has."""
    names = ("TRACE", "PROPFIND", "PATCH", "OPTIONS", "X" * 20)
    _requests(place, over, lambda client, k: client.request(names[k % 5], "api/v1/emergency"))


def not_http(place: Place, over: threading.Event) -> None:
    """A TLS greeting, a preface of HTTP/2, and noise."""
    texts = (b"\x16\x03\x01\x02\x00\x01\x00" + bytes(500), b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
             bytes(range(256)) * 20)  # fmt: skip
    for number in itertools.count():
        if over.wait(0.002):
            return
        _bytes(place, texts[number % 3], place.port if number % 2 else place.urgent, 1.0)


def foreign_hosts(place: Place, over: threading.Event) -> None:
    """Requests for host names of somebody else, each a security event."""
    host = {"Host": "evil.example"}
    _requests(place, over, lambda client, _: client.get("api/v1/health", headers=host))


def foreign_sockets(place: Place, over: threading.Event) -> None:
    """Sockets from another site, to an address that has none."""
    data = _socket(place, "/nothing")
    while not over.wait(0.005):
        if b" 101 " in _bytes(place, data):
            sys.exit("attack: a socket from another site was accepted")


def stranger_streams(place: Place, over: threading.Event) -> None:
    """Live streams of strangers."""
    _repeat(place, over, _socket(place, "/api/v1/live"))


def _socket(place: Place, path: str) -> bytes:
    return _head(
        place, f"GET {path}", "Origin: http://evil.example", "Connection: Upgrade",
        "Upgrade: websocket", "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
    )  # fmt: skip


# -- strangers: guessing -------------------------------------------------------------------------


def wrong_passwords(place: Place, over: threading.Event) -> None:
    """Wrong passwords for the engineer."""
    guess = {"name": "engineer", "password": "not the password"}
    _requests(place, over, lambda client, _: client.post("api/v1/session", json=guess))


def many_names(place: Place, over: threading.Event) -> None:
    """Wrong passwords for as many names as there are."""
    _requests(
        place,
        over,
        lambda client, k: client.post("api/v1/session", json={"name": f"n{k}", "password": "x"}),
    )


def wrong_tokens(place: Place, over: threading.Event) -> None:
    """Tokens that nobody has, each a question to the store."""
    _requests(
        place,
        over,
        lambda client, k: client.get(
            "api/v1/summary", headers={"Authorization": f"Bearer {k:064}"}
        ),
    )


def wrong_cookies(place: Place, over: threading.Event) -> None:
    """Sessions that nobody has, on the way for EMERGENCY alone."""
    for number in itertools.count():
        if over.wait(0.002):
            return
        cookie = f"Cookie: heliotrope_session={number:064}"
        order = _head(place, "POST /api/v1/emergency", cookie, "Content-Length: 2") + b"{}"
        _bytes(place, order, place.urgent)


def _scattered(number: int) -> str:
    """Return one of 65,536 addresses, each a stranger's of its own."""
    return f"127.77.{number // 256 % 256}.{number % 256}"


def _from(place: Place, number: int, data: bytes, port: int = 0, wait: float = 5.0) -> bytes:
    """Send bytes from another address than ever before; return the beginning of the answer."""
    with contextlib.suppress(OSError), socket.socket() as line:
        line.settimeout(max(wait, 0.5))
        line.bind((_scattered(number), 0))
        line.connect(("127.0.0.1", port or place.port))
        line.sendall(data)
        return line.recv(1000) if wait else b""
    return b""


def _guess(place: Place, name: str) -> bytes:
    body = json.dumps({"name": name, "password": "not the password"}).encode()
    length = f"Content-Length: {len(body)}"
    return _head(place, "POST /api/v1/session", "Content-Type: application/json", length) + body


_NUMBERS = itertools.count(1)


def scattered_guesses(place: Place, over: threading.Event) -> None:
    """Guesses for ever new names from ever new addresses, which do not wait for the answer."""
    while not over.wait(0.01):
        number = next(_NUMBERS)
        _from(place, number, _guess(place, f"name {number}"), wait=0.0 if number % 4 else 0.1)


def scattered_guesses_for_one(place: Place, over: threading.Event) -> None:
    """Guesses for the engineer from ever new addresses."""
    while not over.wait(0.01):
        _from(place, next(_NUMBERS), _guess(place, "engineer"))


def scattered_tokens(place: Place, over: threading.Event) -> None:
    """Tokens that nobody has, from 48 addresses, on the way for EMERGENCY alone."""
    while not over.wait(0.001):
        number = next(_NUMBERS)
        bearer = f"Authorization: Bearer {number:064}"
        order = _head(place, "POST /api/v1/emergency", bearer, "Content-Length: 2") + b"{}"
        _from(place, number % 48, order, place.urgent)


def pages(place: Place, over: threading.Event) -> None:
    """The sign-in page and its files again and again, each over a connection of its own."""
    paths = ("login", "", "account", "emergency", "console/static/console.js", "nothing")
    while not over.wait(0.001):
        number = next(_NUMBERS)
        _from(place, number % 48, _head(place, f"GET /{paths[number % 6]}"))


# -- people who are signed in --------------------------------------------------------------------


def viewer_reads(place: Place, over: threading.Event) -> None:
    """A viewer reads the largest views."""
    paths = ("events?limit=2000", "packets?limit=2000", "field", "heliostats/A1", "schedule")
    _requests(place, over, lambda client, k: client.get(f"api/v1/{paths[k % 5]}"), place.token)


def viewer_orders(place: Place, over: threading.Event) -> None:
    """A viewer gives orders, each refused and a security event."""
    order = {"heliostats": []}
    _requests(place, over, lambda client, _: client.post("api/v1/stow", json=order), place.token)


def viewer_streams(place: Place, over: threading.Event) -> None:
    """300 live streams of a viewer, which nobody reads."""
    data = _socket(place, "/api/v1/live").replace(b"Origin: http://evil.example\r\n", b"")
    token = f"\r\nAuthorization: Bearer {place.token}\r\n".encode()
    _held(place, over, data.replace(b"\r\n", token, 1), 300)


def viewer_sends(place: Place, over: threading.Event) -> None:
    """A viewer's streams that send long messages, parts of endless ones, and pings."""
    data = _socket(place, "/api/v1/live").replace(b"Origin: http://evil.example\r\n", b"")
    token = f"\r\nAuthorization: Bearer {place.token}\r\n".encode()
    opening = data.replace(b"\r\n", token, 1)
    long = b"\x82\xff" + struct.pack(">Q", 9_999_999_999) + bytes(1 << 16)
    parts = b"\x02\x80" + bytes(4) + (b"\x00\x80" + bytes(4)) * 10_000
    pings = (b"\x89\xfd" + bytes(129)) * 500
    for text in itertools.cycle((long, parts, pings)):
        if over.wait(0.01):
            return
        with (
            contextlib.suppress(OSError),
            socket.create_connection(("127.0.0.1", place.port), timeout=1.0) as line,
        ):
            line.sendall(opening)
            line.recv(1000)
            for _ in range(200):
                line.sendall(text)


def viewer_emergencies(place: Place, over: threading.Event) -> None:
    """A viewer orders EMERGENCY as fast as it is answered."""
    order = {"reason": "attack"}
    _requests(
        place, over, lambda client, _: client.post("api/v1/emergency", json=order), place.token
    )


def operator_orders(place: Place, over: threading.Event) -> None:
    """An operator gives orders as fast as they are answered."""
    order = {"command": "IDLE", "heliostats": []}

    def give(client: httpx.Client, number: int) -> None:
        if number % 20 == 0:
            client.post("api/v1/authority")
        client.post("api/v1/commands", json=order)

    _requests(place, over, give, place.operator)


def operator_stows(place: Place, over: threading.Event) -> None:
    """An operator stows the whole field again and again: safe orders have no bound."""
    order = {"heliostats": []}
    _requests(place, over, lambda client, _: client.post("api/v1/stow", json=order), place.operator)


def large_orders(place: Place, over: threading.Event) -> None:
    """An operator sends orders of 10 MB with points for names that there are not."""
    points = {f"no heliostat {k}": [1.0, 2.0, 3.0] for k in range(190_000)}
    body = json.dumps({"points": points}).encode()
    sent = {"Content-Type": "application/json"}
    _requests(
        place,
        over,
        lambda client, _: client.post("api/v1/aim", content=body, headers=sent),
        place.operator,
    )


# -- the port for clusters -----------------------------------------------------------------------


def cluster_strangers(place: Place, over: threading.Event) -> None:
    """Half handshakes, TLS where none is expected, empty frames, noise, huge frames, silence."""
    half, noise = (100).to_bytes(4, "big") + bytes(40), bytes(range(256)) * 40
    texts = (b"", half, b"\x16\x03\x01\x02" + bytes(500), bytes(200_000), noise, b"\xff" * 8)
    held: deque[socket.socket] = deque()
    with contextlib.ExitStack() as stack:
        for text in itertools.cycle(texts):
            with contextlib.suppress(OSError):
                line = socket.create_connection(("127.0.0.1", place.cluster), timeout=1.0)
                stack.callback(line.close)
                held.append(line)
                line.sendall(text)
            if len(held) > 200:
                held.popleft().close()
            if over.wait(0.001):
                return


# -- programs on the plant's machine -------------------------------------------------------------


def local_strangers(place: Place, over: threading.Event) -> None:
    """Wrong tokens at the plant's own socket."""
    path = socket_folder(place.data) / ORDINARY
    while not over.wait(0.001):
        with contextlib.suppress(HeliotropeError, OSError):
            ask_once(path, {"token": "no token"}, "summary", {}, timeout=5.0)


def local_idle(place: Place, over: threading.Event) -> None:
    """Connections to both sockets of the plant that send half a frame."""
    with contextlib.ExitStack() as stack:
        for number in range(400):
            path = socket_folder(place.data) / (EMERGENCY if number % 2 else ORDINARY)
            line = stack.enter_context(socket.socket(socket.AF_UNIX))
            line.settimeout(1.0)
            with contextlib.suppress(OSError):
                line.connect(str(path))
                line.sendall(b"\x00\x00")
            if over.is_set():
                return
        over.wait()


def local_frames(place: Place, over: threading.Event) -> None:
    """Frames that claim 4 GB, noise, and text that cannot be written anywhere."""
    path, odd = socket_folder(place.data) / ORDINARY, b'{"key":"\\ud800"}'
    said = b"HLP1" + struct.pack("<II", len(odd), 0) + odd
    for data in itertools.cycle((b"\xff" * 16, bytes(range(256)) * 16, said)):
        if over.wait(0.001):
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as line:
            line.settimeout(1.0)
            line.connect(str(path))
            line.sendall(data)
            line.recv(100)


def local_blobs(place: Place, over: threading.Event) -> None:
    """A viewer's requests with 8 MB each that no call takes."""
    _unread(place, over, pack({"id": 1, "call": "schedule", "arguments": {}}, bytes(8 << 20)))


def local_unread(place: Place, over: threading.Event) -> None:
    """A viewer asks for the largest view again and again, and reads no answer."""
    _unread(place, over, pack({"id": 1, "call": "field", "arguments": {}}))


def _unread(place: Place, over: threading.Event, request: bytes) -> None:
    """Send a viewer's request as often as it is taken, over 16 connections; read nothing."""
    with contextlib.ExitStack() as stack:
        lines = [_Unread(place, request) for _ in range(16)]
        for line in lines:
            stack.callback(line.close)
        while not over.wait(0.002):
            for line in lines:
                line.push()


class _Unread:
    """A connection to the plant's own socket that is opened again where it is cut off."""

    def __init__(self, place: Place, request: bytes) -> None:
        self._path, self._request = socket_folder(place.data) / ORDINARY, request
        self._hello = pack({"token": place.token})
        self._line: socket.socket | None = None
        self._rest = b""

    def push(self) -> None:
        """Send as much as goes out at once."""
        try:
            if self._line is None:
                self._line, self._rest = socket.socket(socket.AF_UNIX), self._hello
                self._line.setblocking(False)
                self._line.connect(str(self._path))
            self._rest = self._rest[self._line.send(self._rest) :] or self._request
        except BlockingIOError:
            if self._rest is self._hello:  # others wait to be taken
                self.close()
        except OSError:
            self.close()

    def close(self) -> None:
        """End the connection."""
        if self._line is not None:
            self._line.close()
            self._line = None


def local_orders(place: Place, over: threading.Event) -> None:
    """Views and orders by an operator's token at the plant's own socket, past the console."""
    path = socket_folder(place.data) / ORDINARY
    calls = (("field", {}), ("take_authority", {}), ("automatic", {"heliostats": []}))
    for call, given in itertools.cycle(calls):
        if over.wait(0.001):
            return
        with contextlib.suppress(HeliotropeError, OSError):
            ask_once(path, {"token": place.operator}, call, given, timeout=10.0)


#: The attacks by name.
ATTACKS: dict[str, Attack] = {
    one.__name__.replace("_", "-"): one
    for one in (
        nothing, nested, unauthorised, small_nested, uploads, chunks, slow_bodies, idle, half_open,
        churn, resets, unread, pipelining, header_bombs, long_paths, unknown_paths, methods,
        not_http, foreign_hosts, foreign_sockets, stranger_streams, wrong_passwords, many_names,
        wrong_tokens, wrong_cookies, scattered_guesses, scattered_guesses_for_one,
        scattered_tokens, pages, viewer_reads, viewer_orders, viewer_streams, viewer_sends,
        viewer_emergencies, operator_orders, operator_stows, large_orders, cluster_strangers,
        local_strangers, local_idle, local_frames, local_blobs, local_unread, local_orders,
    )
}  # fmt: skip
