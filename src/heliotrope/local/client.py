"""The calling side of the local interface."""

import asyncio
import contextlib
import socket
from pathlib import Path
from typing import Any

from heliotrope.errors import HeliotropeError
from heliotrope.local.frames import (
    ANSWER_BLOB,
    ANSWER_HEAD,
    PREFIX,
    REQUEST_BLOB,
    REQUEST_HEAD,
    Frame,
    FrameError,
    head_of,
    lengths,
    pack,
    read_frame,
)
from heliotrope.local.sockets import connect


class AwayError(HeliotropeError):
    """The plant's process cannot be reached, or does not reply."""


class CallError(HeliotropeError):
    """The plant's process refused a call; ``kind`` is the kind of error."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


def value_of(answer: Frame) -> Any:
    """Return the value of a reply.

    Raises
    ------
    CallError
        If the reply is an error.
    """
    if "error" in answer.head:
        raise CallError(str(answer.head["error"]), str(answer.head.get("text", "")))
    return answer.head.get("value")


class LocalConnection:
    """A persistent connection, which is reopened whenever it ends.

    Parameters
    ----------
    path
        Socket of the plant.
    hello
        First frame: ``{"key": ...}``, ``{"token": ...}``, or ``{"user": True}``, which is
        authenticated only by the user of this process.
    timeout
        Timeout for connecting and for each reply, s.
    """

    def __init__(self, path: Path, hello: dict[str, Any], timeout: float = 30.0) -> None:
        self._path, self._hello, self._timeout = path, hello, timeout
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: dict[int, asyncio.Future[Frame]] = {}
        self._number = 0
        self._turn = asyncio.Lock()

    async def run(self, pause: float = 0.25) -> None:
        """Maintain the connection until cancelled."""
        while True:
            with contextlib.suppress(HeliotropeError, EOFError, OSError, TimeoutError):
                await self._live()
            await asyncio.sleep(pause)

    async def _live(self) -> None:
        """Connect, and receive replies until the connection ends."""
        raw = await self._connect()
        raw.setblocking(False)
        reader, writer = await asyncio.open_unix_connection(sock=raw)
        try:
            async with asyncio.timeout(self._timeout):
                writer.write(pack(self._hello))
                value_of(await read_frame(reader))
            self._writer = writer
            while True:
                frame = await read_frame(reader)
                waiting = self._waiting.pop(frame.head.get("id", 0), None)
                if waiting is not None and not waiting.done():
                    waiting.set_result(frame)
        finally:
            self._writer = None
            writer.transport.abort()
            for waiting in self._waiting.values():
                if not waiting.done():
                    waiting.set_exception(self._away("the connection has ended"))
            self._waiting.clear()

    async def _connect(self) -> socket.socket:
        """Connect in a thread; close the socket if this is cancelled meanwhile."""
        loop = asyncio.get_running_loop()
        connecting = loop.run_in_executor(None, connect, self._path, 2.0)
        try:
            return await asyncio.shield(connecting)
        except asyncio.CancelledError:
            with contextlib.suppress(OSError):
                (await connecting).close()
            raise

    def _away(self, why: str) -> AwayError:
        return AwayError(f"the plant's process does not answer ({why}); check that it is running")

    @property
    def up(self) -> bool:
        """Whether the connection is established."""
        return self._writer is not None

    async def ask(
        self,
        call: str,
        arguments: dict[str, Any],
        blob: bytes = b"",
        *,
        on_behalf: Any = None,
        within: float | None = None,
    ) -> tuple[Any, bytes]:
        """Make a call; return the value and the blob of the reply.

        ``within`` is a separate timeout for this call, s.

        Raises
        ------
        CallError
            If the plant refuses the call.
        AwayError
            If the plant cannot be reached, or does not reply in time.
        FrameError
            If a request exceeds the plant's limit; nothing is sent.
        """
        writer = self._writer
        if writer is None:
            raise self._away("no connection")
        self._number += 1
        number = self._number
        head = {"id": number, "call": call, "arguments": arguments, "for": on_behalf}
        data = pack(head, blob)
        # The plant disconnects a caller that sends more, and would drop all other requests on the
        # connection.
        lengths(data[:PREFIX], REQUEST_HEAD, REQUEST_BLOB)
        future = asyncio.get_running_loop().create_future()
        self._waiting[number] = future
        limit = self._timeout if within is None else within
        try:
            async with asyncio.timeout(limit):
                async with self._turn:
                    writer.write(data)
                    await writer.drain()
                answer = await future
        except TimeoutError:
            raise self._away(f"no answer within {limit:g} s") from None
        except OSError:
            raise self._away("the connection has ended") from None
        finally:
            self._waiting.pop(number, None)
            if future.done() and not future.cancelled():
                future.exception()  # it may have failed after the deadline
        return value_of(answer), answer.blob


def ask_once(
    path: Path,
    hello: dict[str, Any],
    call: str,
    arguments: dict[str, Any],
    blob: bytes = b"",
    timeout: float = 30.0,
) -> Any:
    """Connect, make one call and return the value of the reply; see `fetch_once`."""
    return fetch_once(path, hello, call, arguments, blob, timeout)[0]


def fetch_once(
    path: Path,
    hello: dict[str, Any],
    call: str,
    arguments: dict[str, Any],
    blob: bytes = b"",
    timeout: float = 30.0,
) -> tuple[Any, bytes]:
    """Connect, make one call and return the reply's value and blob, without an event loop.

    Raises
    ------
    CallError
        If the plant refuses the call.
    AwayError
        If the plant cannot be reached.
    """
    try:
        with connect(path, timeout) as raw:
            raw.sendall(pack(hello))
            value_of(_receive(raw))
            raw.sendall(pack({"id": 1, "call": call, "arguments": arguments}, blob))
            answer = _receive(raw)
            return value_of(answer), answer.blob
    except (OSError, EOFError, FrameError) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise AwayError(
            f"the plant at {path} does not answer ({why}); check that it is running, and that "
            "you are its user or root"
        ) from None


def _receive(raw: socket.socket) -> Frame:
    head, blob = lengths(_exactly(raw, PREFIX), ANSWER_HEAD, ANSWER_BLOB)
    text = _exactly(raw, head)
    return Frame(head_of(text), _exactly(raw, blob))


def _exactly(raw: socket.socket, count: int) -> bytes:
    received = bytearray()
    while len(received) < count:
        part = raw.recv(min(count - len(received), 1 << 20))
        if not part:
            raise EOFError("the connection has ended")
        received += part
    return bytes(received)
