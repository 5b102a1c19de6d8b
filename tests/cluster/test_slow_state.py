"""A cluster whose disk takes three seconds for each sync: leases, SUN and DEFOCUS go on."""

import asyncio
import json
import struct
import threading
from collections.abc import Callable
from contextvars import copy_context
from pathlib import Path

from heliotrope.cluster.memory import Kept
from heliotrope.files.disk import Disk, DiskThread, Then, Work
from heliotrope.links.clock import Clock, VirtualClock, run_virtual
from heliotrope.links.messages import ClusterStatus, Parameters, Stage
from heliotrope.twin.records import RecordsDisk
from support.clusters import AIM, LATER, TOKEN, Board, Field, boards_in

SYNC = 3.0


class LateDisk:
    """A disk in virtual time; it begins to be slow when the test says so."""

    def __init__(self) -> None:
        self.disk = RecordsDisk()
        self.inner: Disk | None = None
        self.given = 0

    def runs(self, clock: Clock) -> None:
        self.inner = self.disk.queue(clock, copy_context())
        self.disk.delay = SYNC

    def do(self, work: Work, then: Then) -> None:
        assert self.inner is not None
        self.given += 1
        self.inner.do(work, then)

    def close(self) -> None:
        pass


def alive(path: Path, main: Callable[[Field, LateDisk], object], state: str = "") -> None:
    """Run a field whose cluster keeps its state on a late disk."""
    boards, start = boards_in(state) if state else ([Board(1), Board(2)], LATER)

    async def live(clock: VirtualClock) -> None:
        late = LateDisk()
        late.runs(clock)
        field = Field(clock, boards=boards, kept=Kept(path, disk=late))
        async with field.alive():
            await main(field, late)  # type: ignore[misc]

    run_virtual(live, start=start)


async def defocused_at_once(field: Field) -> None:
    begin = field.clock.monotonic()
    await field.emergency("off", "DEFOCUS")
    await field.until(lambda: "TRACKING" not in field.states(), 5.0)
    assert field.clock.monotonic() - begin < 1.0


async def steady(field: Field, seconds: float) -> None:
    """Statuses come each second, with a lease, and the sun is fresh."""
    for _ in range(round(seconds)):
        before = len(field.plant.all(ClusterStatus))
        await asyncio.sleep(1.05)
        assert len(field.plant.all(ClusterStatus)) > before
        assert field.plant.status().lease_left > 1.0
        assert field.sun_is_fresh()


def test_a_new_epoch_waits_for_the_disk_and_nothing_else_does(tmp_path: Path) -> None:
    async def main(field: Field, late: LateDisk) -> None:
        await steady(field, 2.0)
        node = field.boards[0].node
        # As if it had heard frames of another sender that numbers far ahead.
        node.controller.gate.replay.count += 30000
        epoch = field.kept.epoch
        await field.order("aim", "AIM", *AIM, heliostats=("A1",), lifetime=20.0)
        await field.until(lambda: late.given == 1, 10.0)
        begin = field.clock.monotonic()
        await asyncio.sleep(1.5)
        # Not on the disk yet: all frames are of the old epoch.
        assert field.kept.epoch == field.cluster._exchange.sender.epoch == epoch
        await defocused_at_once(field)
        await field.until(lambda: field.cluster._exchange.sender.epoch > epoch, 10.0)
        assert SYNC - 0.1 <= field.clock.monotonic() - begin < SYNC + 2.0
        assert json.loads((tmp_path / "state.json").read_text())["epoch"] == field.kept.epoch
        await steady(field, 3.0)
        assert field.sun_is_fresh()

    alive(tmp_path / "state.json", main, "TRACKING")


def test_an_edition_that_is_not_reserved_waits_for_the_disk(tmp_path: Path) -> None:
    async def main(field: Field, late: LateDisk) -> None:
        await field.until(field.sun_is_fresh)
        # Another cluster has used far more editions than this one has reserved.
        for board in field.boards:
            board.node.controller.gate.edition = 500
            board.node.journal.store({"edition": struct.pack("<I", 500)})
        items = {"biases": struct.pack("<ff", 0.003, 0.0)}
        begin = field.clock.monotonic()
        await field.plant.send(Parameters.of("p", "A1", items, TOKEN))
        await steady(field, 2.0)
        assert Stage.DONE not in field.plant.stages("p", "A1")
        assert field.boards[0].node.controller.gate.edition == 500
        await field.until(lambda: Stage.DONE in field.plant.stages("p", "A1"), 10.0)
        assert field.clock.monotonic() - begin >= SYNC
        assert field.boards[0].node.controller.gate.edition == 501
        assert json.loads((tmp_path / "state.json").read_text())["edition"] >= 501

    alive(tmp_path / "state.json", main)


def test_editions_are_reserved_before_they_are_needed(tmp_path: Path) -> None:
    late = LateDisk()
    kept = Kept(tmp_path / "state.json", disk=late)
    kept.start(1)

    async def main(clock: VirtualClock) -> None:
        late.runs(clock)
        for expected in range(1, 130):
            assert kept.next_edition() == expected
            await asyncio.sleep(0.5)
        # Two blocks for 129 editions, and the one after them.
        assert late.given == 2

    run_virtual(main)


def test_what_the_disk_does_last_takes_nothing_back(tmp_path: Path) -> None:
    """An epoch and editions that are stored at the same time: neither undoes the other."""
    late = LateDisk()
    kept = Kept(tmp_path / "state.json", disk=late)
    kept.start(1)

    async def main(clock: VirtualClock) -> None:
        late.runs(clock)
        told: list[int] = []
        kept.begin(1000, lambda epoch, error: told.append(epoch))
        assert kept.next_edition(above=5000) is None
        await asyncio.sleep(2.5 * SYNC)
        assert told == [1000]
        assert kept.next_edition(above=5000) == 5001
        document = json.loads((tmp_path / "state.json").read_text())
        assert document["epoch"] == 1000
        assert document["edition"] > 5001

    run_virtual(main)


def test_the_thread_of_a_real_disk_holds_nothing_up(tmp_path: Path) -> None:
    """The write hangs until it is let go; the loop goes on, and then uses what is stored."""
    gate, written = threading.Event(), []

    class Held(Kept):
        def _write(self, epoch: int, reserved: int) -> None:
            if written:
                assert gate.wait(60.0)
            super()._write(epoch, reserved)
            written.append(epoch)

    async def main() -> None:
        disk = DiskThread()
        kept = Held(tmp_path / "state.json", disk=disk)
        kept.start(5)
        done = asyncio.Event()
        kept.begin(1000, lambda epoch, error: done.set())
        for _ in range(10):
            await asyncio.sleep(0.001)
        assert kept.epoch == 5
        assert not done.is_set()
        gate.set()
        async with asyncio.timeout(60.0):
            await done.wait()
        assert kept.epoch == 1000
        kept.close()

    asyncio.run(main())
