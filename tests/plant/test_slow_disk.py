"""A slow disk and a full one: leases and emergencies go on, commands wait, no record is lost."""

import asyncio
import errno
import itertools
import os
import time
from collections import deque
from pathlib import Path

import numpy as np
import pytest

from heliotrope.files.disk import DiskBusyError, DiskThread
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual, sleep_until
from heliotrope.links.messages import Command, Emergency, Lease, Stage
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.field.assigned import AssignedFile
from heliotrope.plant.orders.audit import read
from heliotrope.safety import Act
from heliotrope.store.records import Kind, Lockout
from support.midsummer import DayClock
from support.plant_bench import ENGINEER, OPERATOR, Bench, SlowDisk, running

AIM = {"P1A": (0.1, 0.2, 16.5)}


def play(folder: Path, scene) -> Bench:  # type: ignore[no-untyped-def]
    """Run a scene in virtual time with a slow disk, the field idle at its begin."""
    made: list[Bench] = []

    async def main(clock: VirtualClock) -> None:
        disk = SlowDisk(clock)
        bench = Bench(clock, folder, disk=disk)
        made.append(bench)
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
        async with running(bench):
            await scene(bench, disk)

    run_virtual(main)
    return made[0]


def sent(bench: Bench, name: str) -> list[tuple[float, Command]]:
    """Return the commands of a name that clusters took, with their times."""
    found = [pair for cluster in bench.clusters.values() for pair in cluster.taken]
    return [(at, m) for at, m in found if isinstance(m, Command) and m.name == name]


def test_a_command_waits_for_its_record_and_an_emergency_for_nothing(tmp_path: Path) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        token = await bench.commanded()
        disk.delay = 1.0
        begun = plant.now()
        ticket = plant.command(OPERATOR, token, "LOCK", ("P1A",))
        assert not ticket.recorded
        stow = plant.stow("a passer-by", ("P2A",))
        assert await stow.reached(Stage.ACKNOWLEDGED, 1.0)
        assert plant.now() - begun < 1.0
        assert not sent(bench, "LOCK")
        assert await ticket.end(5.0)
        assert ticket.recorded
        (at, _), *others = sent(bench, "LOCK")
        assert not others
        assert 1.0 <= at - begun < 1.5
        points = plant.aim(OPERATOR, token, AIM)
        assert await points.end(10.0), points.text
        disk.delay = 0.0
        await bench.wait(10.0)

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert [r.what for r in records if r.who in (OPERATOR.name, "a passer-by")].count("LOCK") == 1
    assert {"LOCK", "STOW", "AIM"} <= {r.what for r in records}
    assert all(r.result for r in records)


@pytest.mark.parametrize("act", [Act.DEFOCUS, Act.STOW])
def test_nothing_that_waited_for_its_record_follows_an_emergency(tmp_path: Path, act: Act) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        token = await bench.commanded()
        disk.delay = 1.0
        track = plant.command(OPERATOR, token, "TRACK", ("P1A",))
        idle = plant.command(OPERATOR, token, "APPROACH", ("P1B", "P1C"))
        (plant.defocus if act is Act.DEFOCUS else plant.stow)("a passer-by", ("P1A", "P1B"))
        disk.delay = 0.0
        await bench.wait(5.0)
        assert track.refusals["P1A"] == f"not sent, because {act.name} came first"
        assert idle.refusals == {"P1B": f"not sent, because {act.name} came first"}
        assert not sent(bench, "TRACK")
        assert [m.heliostats for _, m in sent(bench, "APPROACH")] == [("P1C",)]

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert "came first" in next(r.result for r in records if r.what == "TRACK")


def test_a_record_that_comes_too_late_sends_nothing(tmp_path: Path) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        token = await bench.commanded()
        disk.delay = 4.0
        ticket = plant.command(OPERATOR, token, "TRACK", ("P1A",))
        push = plant.aim(OPERATOR, token, AIM)
        assert not await ticket.end(3.0)
        assert "its record was not written to disk within 2 s" in ticket.text
        disk.delay = 0.0
        await bench.wait(12.0)
        assert not sent(bench, "TRACK")
        assert not sent(bench, "AIM")
        assert push.finished
        assert "P1A" not in plant.wanted.items

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    ended = {r.what: r.result for r in records}
    assert "not sent" in ended["TRACK"]
    assert "not sent" in ended["AIM"]


def test_a_silent_disk_refuses_new_motion_and_lets_leases_and_emergencies_go(
    tmp_path: Path,
) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        disk.delay = 60.0
        leases = plant.counters.leases
        await bench.wait(20.0)
        assert plant.counters.leases - leases >= 19 * len(bench.clusters)
        told = {alarm.condition for alarm in plant.alarms if alarm.active}
        assert told == {"database_unwritable", "authority_lost"}
        at = plant.now()
        order = plant.raise_emergency("a visitor")
        await bench.until(lambda: bench.count(states.DEFOCUSED) == 18, 1.0)
        assert plant.now() - at < 1.0
        await bench.wait(2.0)
        assert not order.report(plant.now()).unacknowledged
        disk.delay = 0.0
        await bench.wait(120.0)

    bench = play(tmp_path, scene)
    records, _ = read(bench.audit.path)
    assert [r.what for r in records if r.who == "a visitor"] == ["DEFOCUS"]
    assert all(r.result for r in records)


def test_commands_that_wait_for_their_records_do_not_overtake_each_other(tmp_path: Path) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        token = await bench.commanded()
        await plant.aim(OPERATOR, token, dict.fromkeys(plant.field.names, AIM["P1A"])).end(10.0)
        disk.delay = 0.2
        track = plant.command(OPERATOR, token, "TRACK")
        plant.command(OPERATOR, token, "LOCK")
        disk.delay = 0.0
        await bench.wait(5.0)
        (locked, _), *_ = sent(bench, "LOCK")
        assert not [at for at, _ in sent(bench, "TRACK") if at > locked]
        assert "superseded by LOCK" in track.refusals.values()

    play(tmp_path, scene)


def test_what_was_proven_is_proven_again_after_the_wait(tmp_path: Path) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        token = await bench.commanded()
        disk.delay = 1.0
        approach = plant.command(OPERATOR, token, "APPROACH", ("P1A", "P1B"))
        aim = plant.aim(OPERATOR, token, AIM)
        plant.lockouts.put([Lockout(Kind.HELIOSTAT, "P1A", OPERATOR.name, "washing", 0.0)])
        await bench.wait(1.2)
        assert [m.heliostats for _, m in sent(bench, "APPROACH")] == [("P1B",)]
        assert "washing" in approach.refusals["P1A"]
        plant.raise_emergency("a visitor")
        disk.delay = 0.0
        await bench.wait(5.0)
        assert "an emergency is active" in aim.text
        assert not sent(bench, "AIM")

    play(tmp_path, scene)


def test_points_that_are_not_sent_are_neither_assigned_nor_stored(tmp_path: Path) -> None:
    store = AssignedFile(tmp_path / "assigned.json")

    async def main(clock: VirtualClock) -> None:
        disk = SlowDisk(clock)
        bench = Bench(clock, tmp_path, disk=disk, assigned=store)
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
        async with running(bench):
            plant = bench.plant
            token = await bench.commanded()
            first = {**AIM, "P1B": AIM["P1A"]}
            assert await plant.aim(OPERATOR, token, first).end(10.0)
            moved = {"P1A": (0.3, 0.2, 16.5)}
            disk.delay = 4.0
            late = plant.aim(OPERATOR, token, moved)
            disk.delay = 0.0
            await bench.wait(8.0)
            assert "not written to disk within 2 s" in late.text
            np.testing.assert_allclose(plant.aims[plant.field.place("P1A")], AIM["P1A"])
            assert len(sent(bench, "AIM")) == 1

    run_virtual(main)
    assert store.read()["AIM"] == {"P1A": AIM["P1A"], "P1B": AIM["P1A"]}


def test_parameters_whose_record_fails_are_not_wanted(tmp_path: Path) -> None:
    async def scene(bench: Bench, disk: SlowDisk) -> None:
        plant = bench.plant
        bench.cluster_of("P1A").set(states.STOWED)
        await bench.wait(2.0)
        token = await bench.commanded(ENGINEER)
        disk.delay = 4.0
        items = items_of(plant.beliefs.present("P1A")[0])
        ticket = plant.parameters(ENGINEER, token, "P1A", items)
        disk.delay = 0.0
        await bench.wait(12.0)
        assert "not written to disk within 2 s" in ticket.text
        assert "P1A" not in plant.wanted.items

    play(tmp_path, scene)


# -- with a file and a thread --------------------------------------------------------------------


class Sync:
    """The system's `fsync`, which may be slow or refuse."""

    def __init__(self) -> None:
        self.delay, self.full, self.longest = 0.0, False, 0.0

    def __call__(self, file: int) -> None:
        time.sleep(self.delay)
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        _FSYNC(file)


_FSYNC = os.fsync
#: The machine may be busy; still less than one record takes, and than a lease lasts, s.
PATIENCE = 2.9


@pytest.mark.parametrize("kind", ["slow", "full"])
def test_a_slow_or_full_file_holds_up_no_lease_and_no_emergency(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """In real time, with a real file whose syncing takes seconds, or fails."""
    sync = Sync()
    monkeypatch.setattr("heliotrope.plant.orders.audit.os.fsync", sync)
    disk = DiskThread()
    audited: list[Path] = []

    async def main() -> None:
        clock = DayClock()
        bench = Bench(clock, tmp_path, disk=disk)  # type: ignore[arg-type]
        audited.append(bench.audit.path)
        for cluster in bench.clusters.values():
            cluster.set(states.TRACKING)
        async with running(bench):
            token = await bench.commanded()
            sync.delay, sync.full = (3.0, False) if kind == "slow" else (0.0, True)
            begun = clock.monotonic()
            ticket = bench.plant.command(OPERATOR, token, "LOCK", ("P1A",))
            for name in ("P1B", "P1C", "P2A"):
                bench.plant.defocus("a passer-by", (name,))
            await sleep_until(clock, clock.monotonic() + 3.5)
            assert not await ticket.end(1.0)
            assert "not sent" in ticket.text
            at = clock.monotonic()
            bench.plant.raise_emergency("a visitor")
            took = await bench.until(lambda: bench.count(states.DEFOCUSED) == 18, 5.0)
            assert took < PATIENCE
            sync.delay, sync.full = 0.0, False
            for cluster in bench.clusters.values():
                heard = [t for t, m in cluster.taken if isinstance(m, Lease) and t > begun - 2.0]
                assert max(b - a for a, b in itertools.pairwise(heard)) < PATIENCE
                assert not cluster.commands("LOCK")
                assert any(t - at < PATIENCE for t, m in cluster.taken if isinstance(m, Emergency))
            await sleep_until(clock, clock.monotonic() + 4.0)

    asyncio.run(main())
    disk.close()
    records, torn = read(audited[0])
    assert not torn
    assert [r.what for r in records if r.who in ("a passer-by", "a visitor")] == ["DEFOCUS"] * 4
    assert all(r.result for r in records)


def test_the_thread_works_in_order_is_bounded_and_ends_its_work() -> None:
    disk = DiskThread(most=3)
    done: deque[int] = deque()
    errors: list[Exception | None] = []

    def fail() -> None:
        raise ValueError("no")

    async def main() -> None:
        disk.do(lambda: time.sleep(0.3), errors.append)
        await asyncio.sleep(0.1)
        disk.do(fail, errors.append)
        for i in (1, 2):
            disk.do(lambda i=i: done.append(i), errors.append)  # type: ignore[misc]
        with pytest.raises(DiskBusyError, match="3 records are waiting to be written"):
            disk.do(fail, errors.append)
        await asyncio.sleep(0.6)
        assert [type(error) for error in errors] == [type(None), ValueError, *[type(None)] * 2]
        disk.do(lambda: done.append(3), errors.append)

    asyncio.run(main())
    disk.close()
    assert list(done) == [1, 2, 3]
