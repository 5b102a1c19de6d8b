"""The local interface by itself: frames, and a listener under clients of every kind."""

import asyncio
import contextlib
import os
import socket
import struct
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from heliotrope.errors import HeliotropeError, InputError
from heliotrope.local import (
    AwayError,
    CallError,
    Frame,
    FrameError,
    LocalConnection,
    LocalLimits,
    LocalServer,
    ask_once,
    pack,
)
from heliotrope.local.frames import HELLO_HEAD, MARK, head_of, lengths
from heliotrope.local.sockets import connect, listen, make_folder, user_of

HELLO = {"token": "good"}
SHORT = LocalLimits(strangers=4, callers=4, under_way=4, hello_s=0.5, answer_s=0.5, pace_s=0.001)
#: A call that takes no blob.
BARE = "bare"


@dataclass
class _Caller:
    reserved: bool


class _Echo:
    """Answers with its arguments; ``wait`` holds an answer back, ``large`` makes it long."""

    def __init__(self) -> None:
        self.most = self.now = self.held = 0
        self.asked = self.answered = 0
        self.valid = "good"

    async def caller(self, hello: dict[str, Any], user: int) -> _Caller | None:
        assert user == os.getuid()
        self.asked += 1
        if hello.get("key") == "console":
            return _Caller(reserved=True)
        return _Caller(reserved=False) if hello.get("token") == self.valid else None

    async def answer(self, _: _Caller, frame: Frame) -> tuple[Any, bytes]:
        given = frame.head["arguments"]
        self.now += 1
        self.most = max(self.most, self.now)
        self.held += len(frame.blob)
        try:
            await asyncio.sleep(given.get("wait", 0.0))
        finally:
            self.now -= 1
            self.answered += 1
            self.held -= len(frame.blob)
        if frame.head["call"] == "refuse":
            raise InputError("no")
        if frame.head["call"] == "break":
            raise ZeroDivisionError
        return given, frame.blob * given.get("large", 1)


@asynccontextmanager
async def _serving(folder: Path, limits: LocalLimits = SHORT) -> AsyncIterator[tuple[Path, _Echo]]:
    make_folder(folder)
    echo = _Echo()
    server = LocalServer(
        folder / "plant.sock",
        echo.caller,
        echo.answer,
        lambda e: ("input", str(e)),
        lambda _, head: head.get("call") != BARE,
        limits,
    )
    server.open()
    async with asyncio.TaskGroup() as group:
        serving = group.create_task(server.run())
        yield folder / "plant.sock", echo
        serving.cancel()


def _run(
    folder: Path, work: Callable[[Path, _Echo], Awaitable[None]], limits: LocalLimits = SHORT
) -> None:
    async def main() -> None:
        async with asyncio.timeout(60.0), _serving(folder / "interface", limits) as (path, echo):
            await work(path, echo)

    asyncio.run(main())


async def _ask(path: Path, call: str = "echo", blob: bytes = b"", **arguments: Any) -> Any:
    return await asyncio.to_thread(ask_once, path, HELLO, call, arguments, blob, 5.0)


def _ended(raw: socket.socket, within: float = 5.0) -> bool:
    """Whether the server cuts a connection off."""
    raw.settimeout(within)
    try:
        while raw.recv(1 << 16):
            pass
    except TimeoutError:
        return False
    except OSError:
        return True
    return True


# -- frames ------------------------------------------------------------------------------------


def test_a_request_too_large_for_the_plant_cuts_off_nobody(tmp_path: Path) -> None:
    """It is refused where it begins, and what others have asked through the connection goes on."""

    async def work(path: Path, _: _Echo) -> None:
        line = LocalConnection(path, HELLO)
        async with asyncio.TaskGroup() as group:
            running = group.create_task(line.run())
            while not line.up:
                await asyncio.sleep(0.01)
            other = group.create_task(line.ask("echo", {"wait": 0.3}))
            await asyncio.sleep(0.05)
            for names, blob in ([["x" * (1 << 20)], b""], [[], bytes((8 << 20) + 1)]):
                with pytest.raises(FrameError, match="limits are 1048576"):
                    await line.ask("echo", {"names": names}, blob)
            assert (await other)[0] == {"wait": 0.3}
            running.cancel()

    _run(tmp_path / "local", work)


def test_a_frame_there_and_back() -> None:
    data = pack({"id": 1, "call": "a"}, b"xyz")
    head, blob = lengths(data[:12], 100, 100)
    assert head_of(data[12 : 12 + head]) == {"id": 1, "call": "a"}
    assert data[12 + head :] == b"xyz"
    assert blob == 3


@pytest.mark.parametrize(
    ("prefix", "text"),
    [
        (b"GET / HTTP/1", "do not begin with HLP1"),
        (MARK + struct.pack("<II", 101, 0), "a head of 101"),
        (MARK + struct.pack("<II", 0, 101), "a blob of 101"),
    ],
)
def test_what_is_no_frame(prefix: bytes, text: str) -> None:
    with pytest.raises(FrameError, match=text):
        lengths(prefix, 100, 100)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[1]",
        b"{",
        b'{"a": NaN}',
        b'{"a": 1e999}',
        b"[" * 100_000,
        b"\xff{}",
        b'{"key": "\\ud800"}',
        b'{"key": "\xed\xa0\x80"}',
        b'{"\\udfff": 1}',
        '{"a": 1}'.encode("utf-16"),
    ],
)
def test_what_is_no_head(data: bytes) -> None:
    with pytest.raises(FrameError, match="local interface"):
        head_of(data)


# -- the listener ------------------------------------------------------------------------------


def test_answers_and_errors(tmp_path: Path) -> None:
    async def work(path: Path, _: _Echo) -> None:
        assert await _ask(path, a=[1, "two"]) == {"a": [1, "two"]}
        for call, kind in (("refuse", "input"), ("break", "internal")):
            with pytest.raises(CallError) as caught:
                await _ask(path, call)
            assert caught.value.kind == kind
        with pytest.raises(CallError, match="not valid"):
            await asyncio.to_thread(ask_once, path, {"token": "bad"}, "echo", {})

    _run(tmp_path, work)


def test_only_this_user_may_enter(tmp_path: Path) -> None:
    async def work(path: Path, _: _Echo) -> None:
        assert path.stat().st_mode & 0o777 == 0o600
        assert path.parent.stat().st_mode & 0o777 == 0o700
        with connect(path, 1.0) as raw:
            assert user_of(raw) == os.getuid()
        assert await _ask(path) == {}

    _run(tmp_path, work)
    assert not (tmp_path / "interface" / "plant.sock").exists()


def test_a_folder_of_another_kind_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        make_folder(tmp_path / "file")
    (tmp_path / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="not a folder owned by this user"):
        make_folder(tmp_path / "link")


def test_a_folder_with_a_long_name_has_sockets_too(tmp_path: Path) -> None:
    async def work(path: Path, _: _Echo) -> None:
        assert len(os.fsencode(path)) > 200
        assert await _ask(path, a=1) == {"a": 1}

    _run(tmp_path / ("x" * 100) / ("y" * 100), work)


def test_a_stale_socket_is_replaced(tmp_path: Path) -> None:
    listen(tmp_path / "a.sock").close()
    listen(tmp_path / "a.sock").close()
    with pytest.raises(AwayError, match="check that it is running"):
        ask_once(tmp_path / "a.sock", HELLO, "echo", {})


def test_strangers_are_cut_off_and_never_keep_a_caller_out(tmp_path: Path) -> None:
    """Many connections that say nothing, say nonsense, or a first frame that is too large."""

    async def work(path: Path, _: _Echo) -> None:
        raws = [await asyncio.to_thread(connect, path, 2.0) for _ in range(40)]
        raws[-1].sendall(b"GET / HTTP/1.1\r\n\r\n")
        raws[-2].sendall(MARK + struct.pack("<II", HELLO_HEAD + 1, 0))
        raws[-3].sendall(MARK + struct.pack("<II", 10, 1))
        begin = time.monotonic()
        assert await _ask(path, a=1) == {"a": 1}
        assert time.monotonic() - begin < 2.0
        assert all([await asyncio.to_thread(_ended, raw) for raw in raws])
        for raw in raws:
            raw.close()

    _run(tmp_path, work)


def test_a_frame_that_is_too_large_ends_its_connection_only(tmp_path: Path) -> None:
    async def work(path: Path, _: _Echo) -> None:
        with connect(path, 2.0) as raw:
            raw.sendall(pack(HELLO) + MARK + struct.pack("<II", 1 << 31, 0))
            assert await asyncio.to_thread(_ended, raw)
        assert await _ask(path, a=1) == {"a": 1}

    _run(tmp_path, work)


@pytest.mark.parametrize(
    "head",
    [b'{"key":"\\ud800"}', b'{"token":"\\udfff"}', b'{"token":1e999}', b"[]", b'{"key":{}}'],
)
def test_whatever_a_stranger_says_leaves_no_trace_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, head: bytes
) -> None:
    """A traceback for each connection would fill the journal, 200 times a second."""

    async def work(path: Path, _: _Echo) -> None:
        with connect(path, 2.0) as raw:
            raw.sendall(MARK + struct.pack("<II", len(head), 0) + head)
            assert await asyncio.to_thread(_ended, raw)
        assert await _ask(path, a=1) == {"a": 1}

    _run(tmp_path, work)
    assert not caplog.records


@pytest.mark.parametrize(
    "head",
    [
        b'{"id":1e999,"call":"echo","arguments":{}}',
        b'{"id":[1],"call":"echo","arguments":{}}',
        b'{"id":true,"call":"echo","arguments":{}}',
        b'{"call":"echo","arguments":{}}',
        b'{"id":1,"call":"echo","arguments":{"a":"\\ud800"}}',
    ],
)
def test_a_request_that_no_answer_fits_ends_its_connection_only(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, head: bytes
) -> None:
    async def work(path: Path, echo: _Echo) -> None:
        with connect(path, 2.0) as raw:
            raw.sendall(pack(HELLO) + MARK + struct.pack("<II", len(head), 0) + head)
            assert await asyncio.to_thread(_ended, raw)
        assert not echo.most
        assert await _ask(path, a=1) == {"a": 1}

    _run(tmp_path, work)
    assert not caplog.records


def test_a_blob_that_no_call_asked_for_takes_no_memory(tmp_path: Path) -> None:
    """Callers hold as many requests of 8 MB as they may; none of it is kept."""
    blob = bytes(8 << 20)

    async def work(path: Path, echo: _Echo) -> None:
        hold = [
            asyncio.create_task(_ask(path, call, blob, wait=3.0)) for call in (BARE, BARE, "echo")
        ]
        while echo.now < len(hold):
            await asyncio.sleep(0.01)
        assert echo.held == len(blob)
        assert await asyncio.gather(*hold) == [{"wait": 3.0}] * len(hold)

    _run(tmp_path, work)


def test_a_console_has_more_requests_under_way_than_others(tmp_path: Path) -> None:
    async def work(path: Path, echo: _Echo) -> None:
        line = LocalConnection(path, {"key": "console"})
        async with asyncio.TaskGroup() as group:
            running = group.create_task(line.run())
            while not line.up:
                await asyncio.sleep(0.01)
            asked = [group.create_task(line.ask("echo", {"wait": 0.5})) for _ in range(20)]
            await asyncio.gather(*asked)
            running.cancel()
        assert echo.most == 20

    _run(tmp_path, work)


def test_a_socket_of_another_user_is_given_no_token(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever made the folder that --data names could otherwise collect tokens."""
    listener = listen(tmp_path / "a.sock")
    monkeypatch.setattr("heliotrope.local.sockets.os.getuid", lambda: 12345)
    monkeypatch.setattr("heliotrope.local.sockets.user_of", lambda _: None)
    with pytest.raises(AwayError, match="another user is listening on it"):
        ask_once(tmp_path / "a.sock", HELLO, "echo", {})
    connection, _ = listener.accept()
    connection.settimeout(5.0)
    assert connection.recv(100) == b""
    connection.close()
    listener.close()


def test_a_connection_that_is_cancelled_while_it_connects_closes_its_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the system closes it much later, and the plant counts a caller too many."""
    made, begun = list[socket.socket](), threading.Event()

    def slowly(path: Path, timeout: float) -> socket.socket:
        made.append(connect(path, timeout))
        begun.set()
        time.sleep(0.1)
        return made[0]

    async def work(path: Path, _: _Echo) -> None:
        monkeypatch.setattr("heliotrope.local.client.connect", slowly)
        async with asyncio.TaskGroup() as group:
            running = group.create_task(LocalConnection(path, HELLO).run())
            await asyncio.to_thread(begun.wait)
            running.cancel()
        assert made[0].fileno() == -1

    _run(tmp_path, work)


def test_requests_under_way_are_bounded(tmp_path: Path) -> None:
    """More requests than a connection may have wait in the client's own buffers."""

    async def work(path: Path, echo: _Echo) -> None:
        line = LocalConnection(path, HELLO)
        async with asyncio.TaskGroup() as group:
            running = group.create_task(line.run())
            while not line.up:
                await asyncio.sleep(0.01)
            asked = [group.create_task(line.ask("echo", {"wait": 0.05})) for _ in range(40)]
            await asyncio.gather(*asked)
            running.cancel()
        assert echo.most == SHORT.under_way

    _run(tmp_path, work)


def test_a_client_that_never_reads_is_cut_off(tmp_path: Path) -> None:
    async def work(path: Path, echo: _Echo) -> None:
        with connect(path, 2.0) as raw:
            raw.sendall(pack(HELLO))
            request = pack({"id": 1, "call": "echo", "arguments": {"large": 1000}}, b"x" * 4096)
            begin = time.monotonic()
            with pytest.raises(OSError):  # noqa: PT011, PT012 - broken pipe, or reset
                while time.monotonic() - begin < 10.0:
                    await asyncio.to_thread(raw.sendall, request)
        assert echo.most <= SHORT.under_way
        assert await _ask(path, a=1) == {"a": 1}

    _run(tmp_path, work)


def test_answers_to_one_who_was_cut_off_leave_no_trace_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As many requests as may be under way, so that nothing more is read: not even the end."""

    async def work(path: Path, echo: _Echo) -> None:
        request = pack({"id": 1, "call": "echo", "arguments": {"wait": 0.5}}, b"x" * 4096)
        with connect(path, 2.0) as raw:
            raw.sendall(pack(HELLO) + 21 * request)
            while echo.now < 20:
                await asyncio.sleep(0.01)
        while echo.now:
            await asyncio.sleep(0.01)
        assert await _ask(path, a=1) == {"a": 1}

    _run(tmp_path, work, LocalLimits(under_way=20))
    assert not caplog.records


def test_the_oldest_caller_gives_way_and_a_console_never(tmp_path: Path) -> None:
    async def work(path: Path, _: _Echo) -> None:
        with connect(path, 2.0) as console:
            console.sendall(pack({"key": "console"}))
            raws = []
            for _ in range(10):
                raws.append(await asyncio.to_thread(connect, path, 2.0))
                raws[-1].sendall(pack(HELLO))
                await asyncio.sleep(0.05)
            assert all([await asyncio.to_thread(_ended, raw) for raw in raws[:6]])
            assert not await asyncio.to_thread(_ended, raws[-1], 0.2)
            assert not await asyncio.to_thread(_ended, console, 0.2)
            for raw in raws:
                raw.close()

    _run(tmp_path, work)


@pytest.mark.parametrize("idle", [False, True])
def test_a_connection_ends_with_its_token(tmp_path: Path, idle: bool) -> None:
    """A request on a standing connection has no more rights than a new connection would have."""

    async def work(path: Path, echo: _Echo) -> None:
        raw = await asyncio.to_thread(connect, path, 2.0)
        with raw:
            await asyncio.to_thread(raw.sendall, pack(HELLO) + pack(_request(1)))
            while echo.answered < 1:
                await asyncio.sleep(0.01)
            echo.valid = "another"
            if idle:
                assert await asyncio.to_thread(_ended, raw)
                return
            await asyncio.sleep(2.0 * limits.trusted_s)
            with contextlib.suppress(OSError):
                await asyncio.to_thread(raw.sendall, pack(_request(2)) * 3)
            assert await asyncio.to_thread(_ended, raw)
        assert echo.answered == 1

    limits = replace(SHORT, trusted_s=0.1 if idle else 0.3)
    _run(tmp_path / "local", work, limits)


def test_a_caller_is_asked_for_no_more_often_than_needed(tmp_path: Path) -> None:
    async def work(path: Path, echo: _Echo) -> None:
        line = LocalConnection(path, HELLO)
        async with asyncio.TaskGroup() as group:
            running = group.create_task(line.run())
            while not line.up:
                await asyncio.sleep(0.01)
            for _ in range(50):
                await line.ask("echo", {})
            running.cancel()
        assert echo.asked == 1

    _run(tmp_path / "local", work, replace(SHORT, trusted_s=60.0))


def _request(number: int) -> dict[str, Any]:
    return {"id": number, "call": "echo", "arguments": {}}


def test_a_connection_comes_back(tmp_path: Path) -> None:
    async def main() -> None:
        path = tmp_path / "interface" / "plant.sock"
        line = LocalConnection(path, HELLO, timeout=5.0)
        async with asyncio.TaskGroup() as group:
            running = group.create_task(line.run(0.05))
            with pytest.raises(AwayError, match="no connection"):
                await line.ask("echo", {})
            for _ in range(2):
                async with _serving(path.parent):
                    while not line.up:
                        await asyncio.sleep(0.01)
                    assert await line.ask("echo", {"a": 1}, b"b") == ({"a": 1}, b"b")
                    lost = group.create_task(_lost(line))
                    await asyncio.sleep(0.1)
                assert "ended" in str(await lost)
            running.cancel()

    async def _lost(line: LocalConnection) -> HeliotropeError:
        with pytest.raises(AwayError) as caught:
            await line.ask("echo", {"wait": 20.0})
        return caught.value

    asyncio.run(main())
