"""The wire that other tests are run over: it takes its time, and spoils what meets on it."""

import asyncio
import os
import select
import threading
import time
import tty
from collections.abc import Callable, Iterator

import pytest

from heliotrope.cluster.serial_bus import BusSettings, SerialBus
from heliotrope.lcu import wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import running
from support.paced_pty import PacedBus

PATIENCE = 90.0


@pytest.fixture
def bus() -> Iterator[PacedBus]:
    with PacedBus(3, 115200) as made:
        yield made


class Station:
    """A port of the bus, read and written by hand."""

    def __init__(self, path: str) -> None:
        self.end = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.end)

    def say(self, data: bytes) -> None:
        assert os.write(self.end, data) == len(data)

    def hear(self, count: int) -> bytes:
        data, deadline = b"", time.monotonic() + PATIENCE
        while len(data) < count and time.monotonic() < deadline:
            if select.select([self.end], [], [], 0.1)[0]:
                data += os.read(self.end, count - len(data))
        return data

    def silent(self) -> bool:
        return not select.select([self.end], [], [], 0.05)[0]

    def close(self) -> None:
        os.close(self.end)


@pytest.fixture
def stations(bus: PacedBus) -> Iterator[list[Station]]:
    made = [Station(path) for path in bus.paths]
    yield made
    for station in made:
        station.close()


def test_all_others_hear_what_one_says_unaltered_and_not_before_its_time(
    bus: PacedBus, stations: list[Station]
) -> None:
    first, second, third = stations
    data = bytes(range(256)) * 4
    begin = time.monotonic()
    first.say(data)
    assert second.hear(len(data)) == data
    assert time.monotonic() - begin >= len(data) * 10 / 115200
    assert third.hear(len(data)) == data
    assert first.silent()
    third.say(b"answer")
    assert (first.hear(6), second.hear(6)) == (b"answer", b"answer")
    counts = bus.statistics()
    assert counts["bytes"] == [1024, 0, 6]
    assert (counts["spoilt"], counts["lost"]) == (0, 0)
    assert counts["busy_s"] == pytest.approx(1030 * 10 / 115200)


def test_who_speaks_at_once_spoils_both(bus: PacedBus, stations: list[Station]) -> None:
    first, second, third = stations
    first.say(b"\xff" * 1000)  # 87 ms
    second.say(b"\xff" * 1000)
    heard = third.hear(2000)
    assert heard.count(0x55) > 500
    assert bus.statistics()["spoilt"] == heard.count(0x55)


def test_who_does_not_read_holds_up_nobody() -> None:
    with PacedBus(3, 4_000_000) as bus:
        first, second = Station(bus.paths[0]), Station(bus.paths[1])
        for _ in range(100):
            first.say(bytes(1000))
            assert second.hear(1000) == bytes(1000)
            if lost := bus.statistics()["lost"]:
                break
        assert lost > 0
        first.say(b"still here")
        assert second.hear(10) == b"still here"
        first.close()
        second.close()


def test_a_transaction_over_it_takes_the_time_of_its_bytes(bus: PacedBus) -> None:
    node, over = Station(bus.paths[1]), threading.Event()
    reader = wire.Reader()

    def answer() -> None:
        while not over.is_set():
            if select.select([node.end], [], [], 0.02)[0]:
                for frame in reader.feed(os.read(node.end, 4096)):
                    sender = Sender(frame.to, 1)
                    sender.count = frame.sequence - 1
                    node.say(sender.frame(0, "STEPS", frame.to, 2, 3, 4))

    async def main() -> None:
        clock, sender = SystemClock(), Sender(0, 1)
        master = SerialBus(bus.paths[0], clock, BusSettings())
        async with asyncio.timeout(PATIENCE), running(master):
            await master.opened()
            for address in range(1, 9):
                question = sender.frame(address, "QUERY_STEPS")
                begin = clock.monotonic()
                heard = await master.transact(question, 2.0)
                took = clock.monotonic() - begin
                (frame,) = wire.Reader().feed(heard)
                assert frame.values() == (address, 2, 3, 4)
                assert took >= (len(question) + len(heard)) * 10 / 115200
            assert master.statistics.answered == 8

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        asyncio.run(main())
    finally:
        over.set()
        thread.join()
        node.close()
    assert bus.statistics()["spoilt"] == 0


@pytest.mark.parametrize("make", [lambda: PacedBus(1), lambda: PacedBus(2, 50)])
def test_what_is_no_bus_is_refused(make: Callable[[], PacedBus]) -> None:
    with pytest.raises(ValueError, match="make no bus"):
        make()
