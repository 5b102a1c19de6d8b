"""Connections to the console: limits, deadlines, and whose place a new one takes."""

import errno
import logging
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace

import httpx
import pytest

from heliotrope.console._logs import MOST, SPAN, Repeated
from heliotrope.console.connections import Connection, Limits, Listener, Stage, _rank
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]


@pytest.fixture
def listener(console: LiveConsole) -> Iterator[Listener]:
    """Return the console's listener without strangers; its limits are put back afterwards.

    The server may see later than the next test that a test's connections are gone, and would take
    their places away first.
    """
    found = console.server.listener
    limits = found.limits
    until = time.monotonic() + 60.0
    while len(found) and time.monotonic() < until:
        time.sleep(0.05)
    yield found
    found.limits = limits


def opened(console: LiveConsole, stack: ExitStack, text: bytes = b"") -> socket.socket:
    """Open a connection and send the beginning of a request."""
    host, port = console.address.removeprefix("http://").rstrip("/").split(":")
    line = stack.enter_context(socket.create_connection((host, int(port)), timeout=10.0))
    line.sendall(text)
    return line


#: Stages as long as this end in no test: what is closed here is closed for another reason.
NEVER = 3600.0
PATIENT = {"handshake": NEVER, "header": NEVER, "body": NEVER, "idle": NEVER}


def is_open(line: socket.socket, seconds: float = 0.0) -> bool:
    """Whether the other side has not closed a connection within some time."""
    until = time.monotonic() + seconds
    while True:
        line.settimeout(max(until - time.monotonic(), 1e-3))
        try:
            if line.recv(65_536) == b"":
                return False
        except (TimeoutError, BlockingIOError):
            return True
        except ConnectionError:
            return False


@pytest.mark.parametrize("text", [b"", b"GET /api/v1/health HTTP/1.1\r\nHost:"])
def test_idle_connections_shut_nobody_out(
    console: LiveConsole, listener: Listener, tokens: dict[str, str], text: bytes
) -> None:
    """A kept connection of a known caller stays, and a new one is answered, from one address."""
    listener.limits = Limits(most=60, strangers=40, **PATIENT)
    headers = {"Authorization": f"Bearer {tokens['viewer']}"}
    with httpx.Client(base_url=console.address, trust_env=False, headers=headers) as kept:
        assert kept.get("api/v1/summary").status_code == 200
        with ExitStack() as stack:
            lines = [opened(console, stack, text) for _ in range(300)]
            assert len(listener) <= 60
            answer = httpx.get(
                f"{console.address}api/v1/summary", headers=headers, trust_env=False, timeout=60.0
            )
            assert answer.status_code == 200
            assert kept.get("api/v1/summary", timeout=60.0).status_code == 200
            assert not is_open(lines[0], 60.0)
            assert sum(map(is_open, lines)) <= 41


def test_one_address_has_some_of_the_places(console: LiveConsole, listener: Listener) -> None:
    listener.limits = Limits(address=10, strangers=40, **PATIENT)
    shared, listener._shared = listener._shared, frozenset[str]()
    try:
        with ExitStack() as stack:
            lines = [opened(console, stack) for _ in range(30)]
            assert not is_open(lines[19], 60.0)
            assert is_open(lines[-1], 0.2)
            assert sum(map(is_open, lines)) <= 11
    finally:
        listener._shared = shared


def test_a_handshake_gives_no_later_place() -> None:
    """Who came first goes first, though its handshake ended after a later one came."""
    with socket.socket() as line:
        first, second = Connection("192.0.2.1", line, 1.0), Connection("192.0.2.1", line, 1.5)
        first.enter(Stage.HEADER, 1.6)
        assert min((second, first), key=_rank) is first


@pytest.mark.parametrize(
    ("stage", "text"),
    [
        ("header", b""),
        ("header", b"POST /api/v1/session HTTP/1.1\r\nHost: "),
        ("body", b"POST /api/v1/session HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n{"),
        ("idle", b"GET /api/v1/health HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
    ],
)
def test_each_stage_has_its_deadline(
    console: LiveConsole, listener: Listener, stage: str, text: bytes
) -> None:
    listener.limits = replace(Limits(), **{stage: 0.5})
    with ExitStack() as stack:
        line = opened(console, stack, text)
        if stage == "idle":
            line.settimeout(10.0)
            assert line.recv(4096).startswith(b"HTTP/1.1 200")
        begun = time.monotonic()
        assert not is_open(line, 10.0)
        assert time.monotonic() - begun > 0.3


def test_a_live_stream_outlasts_strangers_and_deadlines(
    console: LiveConsole, listener: Listener, tokens: dict[str, str]
) -> None:
    from websockets.sync.client import connect

    listener.limits = Limits(most=20, strangers=10, header=0.5, idle=0.5, answer=0.5)
    url = console.address.replace("http", "ws", 1) + "api/v1/live"
    headers = {"Authorization": f"Bearer {tokens['viewer']}"}
    with connect(url, additional_headers=headers, proxy=None) as live, ExitStack() as stack:
        live.recv(10.0)
        for _ in range(60):
            opened(console, stack)
        begun = time.monotonic()
        while time.monotonic() - begun < 2.0:
            live.recv(10.0)


def test_a_long_header_is_refused(console: LiveConsole) -> None:
    with ExitStack() as stack:
        line = opened(console, stack, b"GET / HTTP/1.1\r\nX: ")
        line.settimeout(10.0)
        with suppress(ConnectionError):
            for _ in range(100):
                line.sendall(b"x" * 10_000)
        assert not is_open(line, 4.0)


def test_without_descriptors_it_waits(
    console: LiveConsole,
    ask: Ask,
    listener: Listener,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """It tries again a few times a second, not thousands, and writes few lines."""
    tries = []

    class Full:
        def accept(self) -> None:
            tries.append(0)
            raise OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as patch, ExitStack() as stack:
        patch.setattr(listener, "sockets", (Full(),))
        opened(console, stack)
        time.sleep(1.5)
    assert 1 <= len(tries) < 200
    assert len([r for r in caplog.records if "can be accepted" in r.getMessage()]) <= MOST
    assert ask("viewer", "GET", "summary").status_code == 200


def test_few_descriptors_make_few_places() -> None:
    limits = Limits()
    assert limits.within(5000) == limits
    few = limits.within(300)
    assert (few.most, few.strangers, few.address) == (300, 60, 30)
    assert limits.within(-50).most == 8


def test_repeated_lines_are_counted() -> None:
    times = [0.0]
    repeated = Repeated(lambda: times[-1])

    def line(text: str = "no connection (%s)", number: int = 7) -> logging.LogRecord:
        return logging.LogRecord("uvicorn.error", logging.WARNING, "", number, text, ("why",), None)

    assert [repeated.filter(line()) for _ in range(20)] == [True] * MOST + [False] * (20 - MOST)
    assert not any(repeated.filter(line(f"another {k}")) for k in range(20))
    assert repeated.filter(line(number=8))
    times.append(SPAN)
    last = line()
    assert repeated.filter(last)
    assert last.getMessage() == "no connection (why) (35 more like this were left out)"
    for number in range(1000):
        repeated.filter(line(number=number))
    assert len(repeated._counts) <= 500


def test_time_that_the_server_lost_is_nobodys_fault(
    console: LiveConsole, listener: Listener
) -> None:
    listener.limits = Limits(header=1.5)
    with ExitStack() as stack:
        line = opened(console, stack, b"GET /api/v1/health HTTP/1.1\r\n")
        time.sleep(0.5)
        console.console_call(lambda: time.sleep(3.0))
        host = console.address.removeprefix("http://").rstrip("/")
        line.sendall(f"Host: {host}\r\n\r\n".encode())
        line.settimeout(60.0)
        assert line.recv(4096).startswith(b"HTTP/1.1 200")
