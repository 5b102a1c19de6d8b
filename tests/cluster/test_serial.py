"""The bus against real ports: a pseudo-terminal pair, and a serial server on a socket."""

import asyncio
import os
import select
import threading
import time
import tty
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest

from heliotrope.cluster.serial_bus import BusSettings, SerialBus, ends_in_zero
from heliotrope.errors import InputError
from heliotrope.lcu import messages, wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import LinkClosedError, LinkError, SendOutcome, running

QUICK = BusSettings(baud_rate=115200, first_pause=0.02, longest_pause=0.1)
PATIENCE = 90.0
#: Of an answer: long, since a busy machine may take its time; a test waits for it only if
#: nothing comes.
ANSWER = 2.0
NO_ANSWER = 0.1


def real(main: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(2.0 * PATIENCE):
            await main()

    asyncio.run(limited())


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.005)


class Line:
    """The far end of a pseudo-terminal: what is on the bus besides the master.

    Attributes
    ----------
    heard
        All bytes that came.
    answer
        Called with each piece that came; what it returns is sent back, piece by piece.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.heard = bytearray()
        self.answer: Callable[[bytes], list[bytes]] = lambda _: []
        self.pause = 0.0
        self._ending = threading.Event()
        self.plug_in()

    def plug_in(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._slave))
        self._ending.clear()
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def unplug(self) -> None:
        self._ending.set()
        self._thread.join()
        self.path.unlink()  # the terminal's number may be another test's at once
        for end in (self._master, self._slave):
            os.close(end)

    def say(self, data: bytes) -> None:
        os.write(self._master, data)

    def _listen(self) -> None:
        while not self._ending.is_set():
            if select.select([self._master], [], [], 0.02)[0]:
                data = os.read(self._master, 4096)
                self.heard += data
                for piece in self.answer(data):
                    os.write(self._master, piece)
                    time.sleep(self.pause)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    made = Line(tmp_path / "bus")
    yield made
    made.unplug()


class Controller:
    """Answers each frame of the wire like a local controller: what ends in a zero is whole."""

    def __init__(self, reply: Callable[[wire.Frame], list[bytes]]) -> None:
        self._reader = wire.Reader()
        self._reply = reply

    def __call__(self, data: bytes) -> list[bytes]:
        return [piece for frame in self._reader.feed(data) for piece in self._reply(frame)]


def status(frame: wire.Frame) -> bytes:
    sender = Sender(frame.to, 1)
    sender.count = frame.sequence - 1
    return sender.frame(0, "STEPS", frame.to, -2, 3, -4)


def bus_of(line: Line, settings: BusSettings = QUICK) -> SerialBus:
    return SerialBus(str(line.path), SystemClock(), settings)


def test_a_frame_of_the_wire_is_answered(line: Line) -> None:
    line.answer = Controller(lambda frame: [status(frame)[:7], status(frame)[7:]])
    line.pause = 0.01  # it comes in two pieces

    async def main() -> None:
        bus, sender = bus_of(line), Sender(0, 1)
        async with running(bus):
            await bus.opened()
            for address in (5, 6, 7):
                heard = await bus.transact(sender.frame(address, "QUERY_STEPS"), ANSWER)
                (frame,) = wire.Reader().feed(heard)
                assert frame.number == messages.NUMBER_OF["STEPS"]
                assert frame.values() == (address, -2, 3, -4)
            assert (bus.statistics.sent, bus.statistics.answered) == (3, 3)
            assert bus.statistics.last_received is not None
            assert bus.connected
            assert bus.problem == ""
        assert not bus.connected
        with pytest.raises(LinkClosedError):
            await bus.transact(b"\0", ANSWER)
        with pytest.raises(LinkClosedError):
            await bus.opened()

    real(main)


def test_silence_is_counted_and_a_late_answer_is_not_taken_for_the_next(line: Line) -> None:
    async def main() -> None:
        bus = bus_of(line)
        async with running(bus):
            await bus.opened()
            assert await bus.transact(b"\1a\0", NO_ANSWER) == b""
            assert bus.statistics.silent == 1
            line.say(b"late\0")
            await until(lambda: bus._port is not None and len(bus._port.data) == 5)
            line.answer = lambda _: [b"good\0"]
            assert await bus.transact(b"\1b\0", ANSWER) == b"good\0"
            assert bus.statistics.stray == 5
            assert bus.statistics.answered == 1

    real(main)


def test_the_codec_says_what_an_answer_is(line: Line) -> None:
    line.answer = lambda _: [b"\0\0", b"noise\0", b"answer\0"]
    line.pause = 0.005

    async def main() -> None:
        bus = bus_of(line)
        async with running(bus):
            await bus.opened()
            heard = await bus.transact(
                b"?\0", ANSWER, complete=lambda data: data.endswith(b"answer\0")
            )
            assert heard == b"\0\0noise\0answer\0"

    real(main)


def test_transactions_do_not_mix_and_the_urgent_goes_first(line: Line) -> None:
    spoken: list[bytes] = []

    def answer(data: bytes) -> list[bytes]:
        spoken.append(data)
        return [b"answer to " + data]

    line.answer = answer

    async def main() -> None:
        bus = bus_of(line)
        async with running(bus):
            await bus.opened()
            async with asyncio.TaskGroup() as group:
                polls = [
                    group.create_task(bus.transact(b"poll %d\0" % number, ANSWER))
                    for number in range(4)
                ]
                await asyncio.sleep(0)  # the first has its turn now
                late = group.create_task(bus.transact(b"gone\0", ANSWER))
                stow = group.create_task(bus.transact(b"stow\0", ANSWER, urgent=True))
                await asyncio.sleep(0)
                late.cancel()
            assert [poll.result() for poll in polls] == [
                b"answer to poll %d\0" % number for number in range(4)
            ]
            assert stow.result() == b"answer to stow\0"
            assert spoken == [b"poll 0\0", b"stow\0", b"poll 1\0", b"poll 2\0", b"poll 3\0"]

    real(main)


def test_what_has_expired_when_its_turn_comes_is_not_sent(line: Line) -> None:
    async def main() -> None:
        bus, clock = bus_of(line), SystemClock()
        async with running(bus):
            await bus.opened()
            async with asyncio.TaskGroup() as group:
                group.create_task(bus.transact(b"poll\0", NO_ANSWER))
                await asyncio.sleep(0)
                expires = clock.monotonic() + 0.5 * NO_ANSWER
                moving = group.create_task(bus.transmit(b"move\0", expires=expires))
                asking = group.create_task(bus.transact(b"ask\0", ANSWER, expires=expires))
            assert moving.result() is SendOutcome.EXPIRED
            assert asking.result() == b""
            assert bus.statistics.expired == 2
            assert (
                await bus.transmit(b"all\0", expires=clock.monotonic() + PATIENCE)
                is SendOutcome.SENT
            )
            await until(lambda: bytes(line.heard) == b"poll\0all\0")

    real(main)


def test_a_frame_follows_the_one_before_only_after_its_time_and_a_gap(line: Line) -> None:
    async def main() -> None:
        clock, settings = SystemClock(), BusSettings(baud_rate=9600, gap=0.02)
        bus = bus_of(line, settings)
        async with running(bus):
            await bus.opened()
            begin = clock.monotonic()
            for _ in range(3):
                await bus.transmit(bytes(48))
            # Three frames of 50 ms and the two gaps between them; more it may always be.
            assert clock.monotonic() - begin >= 3 * 0.05 + 2 * 0.02

    real(main)


def test_ones_own_echo_is_taken_out(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    # The far end is a thread, which a slow machine keeps waiting longer than an adapter would.
    monkeypatch.setattr("heliotrope.cluster.serial_bus._ECHO_LIMIT", PATIENCE)
    line.answer = lambda data: [data[:3], data[3:] + b"answer\0"]
    line.pause = 0.005
    settings = BusSettings(echo=True)

    async def main() -> None:
        bus = bus_of(line, settings)
        async with running(bus):
            await bus.opened()
            assert await bus.transact(b"question\0", ANSWER) == b"answer\0"
            line.answer = lambda data: [data]
            assert await bus.transact(b"nobody\0", 1.0) == b""
            assert await bus.transmit(b"to all\0") is SendOutcome.SENT
            assert (bus.statistics.spoilt, bus.statistics.silent) == (0, 1)

    real(main)


def test_an_echo_that_differs_spoils_the_transaction(line: Line) -> None:
    line.answer = lambda _: [b"quastion\0answer\0"]

    async def main() -> None:
        bus = bus_of(line, BusSettings(echo=True))
        async with running(bus):
            await bus.opened()
            assert await bus.transact(b"question\0", ANSWER) == b""
            assert bus.statistics.spoilt == 1
            line.answer = lambda _: []
            assert await bus.transmit(b"to all\0") is SendOutcome.SENT
            assert bus.statistics.spoilt == 2

    real(main)


def test_an_echo_that_comes_too_late_is_counted_as_stray(line: Line) -> None:
    async def main() -> None:
        bus = bus_of(line, BusSettings(echo=True))
        async with running(bus):
            await bus.opened()
            await bus.transmit(b"to all\0")
            port = bus._port
            assert port is not None
            before = port.last_at
            line.say(b"to all\0")
            await until(lambda: port.last_at > before)
            await bus.transmit(b"next\0")
            assert (bus.statistics.spoilt, bus.statistics.stray) == (2, 7)

    real(main)


def test_an_adapter_that_is_unplugged_is_found_again(line: Line) -> None:
    line.answer = lambda _: [b"answer\0"]

    async def main() -> None:
        bus = bus_of(line)
        async with running(bus):
            await bus.opened()
            assert await bus.transact(b"1\0", ANSWER) == b"answer\0"
            await asyncio.to_thread(line.unplug)
            await until(lambda: not bus.connected)
            assert str(line.path) in bus.problem
            assert await bus.transact(b"2\0", ANSWER) == b""
            assert await bus.transmit(b"2\0") is SendOutcome.DISCONNECTED
            assert bus.statistics.dropped == 2
            await asyncio.to_thread(line.plug_in)
            await bus.opened()
            assert await bus.transact(b"3\0", ANSWER) == b"answer\0"
            assert bus.statistics.reconnects == 1

    real(main)


def test_a_port_of_another_program_is_not_shared(line: Line) -> None:
    async def main() -> None:
        first, second = bus_of(line), bus_of(line)
        async with running(first):
            await first.opened()
            async with running(second):
                await until(lambda: second.statistics.failures >= 1)
                assert "cannot be opened" in second.problem
                await first.close()
                await second.opened()

    real(main)


@pytest.mark.parametrize("url", ["/dev/no-such-port", "nonsense://x", "socket://127.0.0.1"])
def test_a_port_that_is_not_there_is_named(url: str) -> None:
    async def main() -> None:
        bus = SerialBus(url, SystemClock(), QUICK)
        async with running(bus):
            await until(lambda: bus.statistics.failures >= 2)
            assert f"{url} cannot be opened" in bus.problem

    real(main)


def test_a_serial_server_in_the_network_is_a_bus_too() -> None:
    async def main() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            nonlocal talking
            talking = writer
            while data := await reader.read(100):
                writer.write(b"answer to " + data)
            writer.close()

        talking: asyncio.StreamWriter | None = None
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        bus = SerialBus(f"socket://127.0.0.1:{port}", SystemClock(), QUICK)
        async with running(bus):
            await bus.opened()
            assert await bus.transact(b"1\0", ANSWER) == b"answer to 1\0"
            assert talking is not None
            server.close()
            talking.close()
            await until(lambda: not bus.connected)
            await until(lambda: bus.statistics.failures >= 1)
            server = await asyncio.start_server(serve, "127.0.0.1", port)
            await bus.opened()
            assert await bus.transact(b"2\0", ANSWER) == b"answer to 2\0"
            assert bus.statistics.reconnects == 1
        server.close()
        await asyncio.sleep(0.05)  # for the server's own task to see its end

    real(main)


def test_a_bus_runs_once_and_refuses_what_it_cannot_do(line: Line) -> None:
    async def main() -> None:
        bus = bus_of(line)
        async with running(bus):
            await bus.opened()
            with pytest.raises(LinkError, match="it is already running"):
                await bus.run()
            with pytest.raises(InputError, match="the timeout must be above 0, not 0 s"):
                await bus.transact(b"", 0)

    real(main)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"baud_rate": 300}, "300 baud"),
        ({"gap": -1.0}, "a gap of -1.0 s"),
        ({"first_pause": 5.0}, "not above the longest"),
    ],
)
def test_settings_that_no_bus_has_are_refused(values: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        BusSettings(**values)  # type: ignore[arg-type]


def test_the_gap_is_that_of_modbus_unless_given() -> None:
    assert BusSettings(baud_rate=9600).quiet == pytest.approx(35 / 9600)
    assert BusSettings(baud_rate=115200).quiet == 0.00175
    assert BusSettings(gap=0.01).quiet == 0.01


def test_a_frame_needs_more_than_zeros() -> None:
    assert ends_in_zero(b"\0a\0")
    assert not ends_in_zero(b"\0\0")
    assert not ends_in_zero(b"a\0b")
