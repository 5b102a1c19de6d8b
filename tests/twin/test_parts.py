"""Parts of the twin: flash, motors, clocks, the bus and its faults, many runs."""

import ast
import asyncio
import contextlib
import math
import random
from collections.abc import Sequence
from contextvars import copy_context
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.lcu import ticks, wire
from heliotrope.links.clock import VirtualClock, VirtualLoop, context_of, run_virtual
from heliotrope.links.link import LinkClosedError, SendOutcome
from heliotrope.links.messages import Command, Emergency, Lease, encode
from heliotrope.plant.orders.audit import AuditError, Record
from heliotrope.plant.orders.authority import Person
from heliotrope.safety import Alarm, Severity
from heliotrope.sun import vector
from heliotrope.twin import invariants
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import BusFaults, TwinBus
from heliotrope.twin.boards.clocks import DriftingClock, SimulatedTime, TickCounter
from heliotrope.twin.boards.flash import NorFlash, PowerCutError
from heliotrope.twin.boards.motors import MotorAxis
from heliotrope.twin.boards.outfit import RECEIVER, outfits
from heliotrope.twin.invariants.invariants import InvariantError, Judge
from heliotrope.twin.invariants.plant_observer import TURN_WITHIN, PlantObserver
from heliotrope.twin.invariants.runs import RunAccount
from heliotrope.twin.invariants.sensors import LIMITS as SENSORS
from heliotrope.twin.invariants.sensors import SensorObserver
from heliotrope.twin.records import RecordsDisk
from heliotrope.twin.world.operator import ENGINEER, OPERATOR
from heliotrope.twin.world.pod import PlantEar
from heliotrope.twin.world.scene import USUAL, scene_of
from heliotrope.twin.world.simulation import SETTINGS, RunPlan, Simulation
from heliotrope.twin.world.soak import run_many


def test_flash_takes_what_came_before_the_cut() -> None:
    flash = NorFlash(1)
    flash.budget = 3
    with pytest.raises(PowerCutError, match="flash: the supply failed within 8 bytes at 16"):
        flash.write(16, bytes(8))
    held = flash.read(16, 8)
    assert held[:3] == bytes(3)
    assert held[4:] == b"\xff" * 4
    with pytest.raises(ValueError, match="flash: 1 bytes at 16 are already written; erase"):
        flash.write(16, b"\0")
    flash.erase(0)
    assert flash.read(16, 8) == b"\xff" * 8


def test_motors_play_in_time_with_backlash_and_lose_what_is_queued() -> None:
    axis = MotorAxis(100, play=10.0)
    axis.take(1, 50, 1000, now=0.0)
    axis.play_to(0.0245)
    assert axis.turned == 125
    axis.play_to(1.0)
    assert (axis.turned, axis.joint, axis.emitted) == (150, 150.0, 150)
    axis.take(-1, 30, 1000, now=1.0)
    axis.play_to(1.0095)
    assert (axis.turned, axis.joint) == (140, 150.0)
    assert axis.stop() == -20
    assert axis.emitted == axis.turned == 140
    missing = MotorAxis(0, miss=1.0, chance=random.Random(1))
    missing.take(1, 5, 1000, now=0.0)
    missing.play_to(1.0)
    assert (missing.turned, missing.missed, missing.emitted) == (4, 1, 5)


def test_clocks_drift_wrap_and_jump() -> None:
    counter = TickCounter(ticks.PERIOD - 500, drift=0.01)
    assert ticks.diff(counter.at(10.0), counter.at(0.0)) == 10_100
    counter.jump(-2000)
    assert ticks.diff(counter.at(10.0), counter.at(0.0)) == 10_100
    clock = VirtualClock()
    drifting = DriftingClock(clock.monotonic, clock.utc(), drift=1e-3)
    told = SimulatedTime(drifting)
    clock.advance(100.0)
    assert drifting.monotonic() == pytest.approx(100.1)
    before = told.time().gps_s
    told.jump(5.0)
    assert told.time().gps_s - before == pytest.approx(5.0)
    assert told.time().jumped
    told.detects = False
    assert not told.time().jumped
    told.quality = "none"
    assert told.time().error == float("inf")
    with pytest.raises(
        InputError, match=r"drifting clock: the drift must be below 0.5, such as 50e-6, not 0.6"
    ):
        DriftingClock(clock.monotonic, clock.utc(), drift=0.6)


class Echo:
    """A station that keeps what it hears, and answers."""

    def __init__(self) -> None:
        self.heard: list[bytes] = []

    def hear(self, data: bytes, now: float) -> bytes:
        del now
        self.heard.append(data)
        return b"answer\0"


def test_the_bus_does_to_frames_what_its_faults_say() -> None:
    async def main(clock: VirtualClock) -> None:
        echo = Echo()
        bus = TwinBus(clock, [echo], seed=1)
        begin = clock.monotonic()
        assert await bus.transact(b"frame\0", 0.1) == b"answer\0"
        assert clock.monotonic() - begin == pytest.approx(13 * 10 / 115200 + 0.002, abs=1e-5)
        bus.faults = BusFaults(loss=1.0)
        assert await bus.transact(b"lost\0", 0.1) == b""
        bus.faults = BusFaults(duplication=1.0)
        await bus.transmit(b"twice\0")
        assert echo.heard[-2:] == [b"twice\0", b"twice\0"]
        bus.faults = BusFaults(corruption=1.0)
        await bus.transmit(bytes(20))
        assert sum(value.bit_count() for value in echo.heard[-1]) == 1
        bus.faults = BusFaults(late=1.0)
        await bus.transmit(b"first\0")
        bus.faults = BusFaults()
        await bus.transmit(b"second\0")
        assert echo.heard[-2:] == [b"second\0", b"first\0"]
        bus.faults = BusFaults(delay=1.0)
        took = []
        for _ in range(20):
            begin = clock.monotonic()
            assert await bus.transact(b"slow\0", 0.1) == b"answer\0"
            took.append(clock.monotonic() - begin)
        assert min(took) > 0.003
        assert 0.05 < max(took) <= 0.101
        bus.faults = BusFaults(stuck=True)
        assert await bus.transact(b"stuck\0", 0.1) == b""
        bus.faults = BusFaults()
        bus.plugged = False
        assert await bus.transmit(b"x\0") is SendOutcome.DISCONNECTED
        bus.plugged = True
        assert await bus.transmit(b"x\0", expires=clock.monotonic()) is SendOutcome.EXPIRED
        with pytest.raises(InputError, match=r"bus: the timeout must be above 0, not 0.0 s"):
            await bus.transact(b"x\0", 0.0)
        await bus.close()
        with pytest.raises(LinkClosedError, match="bus: it is closed"):
            await bus.transmit(wire.encode(wire.Frame(1, 0, 1, 1, b"")))

    run_virtual(main)
    with pytest.raises(
        InputError, match=r"bus faults: the probability of loss must be between 0 and 1, not 1.5"
    ):
        BusFaults(loss=1.5)


def test_a_soak_goes_on_where_it_stopped(tmp_path: Path) -> None:
    plans = [RunPlan(seed, 5.0, 1) for seed in range(3)]
    kept = tmp_path / "soak.jsonl"
    first = run_many(plans[:2], progress=kept)
    told = []
    both = run_many(plans, progress=kept, tell=lambda found: told.append(found.runs))
    assert (first.runs, both.runs, told) == (2, 3, [3])
    assert both.checks == run_many(plans).checks
    assert run_many(plans, budget=0.0).runs == 0
    kept.write_text('{"seed": 1}\n')
    with pytest.raises(FormatError, match=r"soak.jsonl: line 1: not a run of a soak; name another"):
        run_many(plans, progress=kept)
    with pytest.raises(InputError, match="a soak needs 1 process or more, not 0"):
        run_many(plans, processes=0)


def test_a_run_that_does_not_end_is_told_and_the_soak_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    live = Simulation.live

    async def stuck() -> None:
        while True:
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.Event().wait()

    async def haunted(simulation: Simulation) -> None:
        if simulation.plan.seed == 1:
            kept.append(asyncio.get_running_loop().create_task(stuck()))
        await live(simulation)

    kept: list[asyncio.Task[None]] = []
    monkeypatch.setattr(Simulation, "live", haunted)
    found = run_many([RunPlan(seed, 2.0, 1) for seed in range(3)])
    assert found.runs == 3
    assert [text.split(":")[0] for text in found.broken] == ["the run does not end"]
    assert "--seed 1" in found.broken[0]


def test_a_bus_carries_no_more() -> None:
    with pytest.raises(InputError, match="a bus must have 1 to 32 heliostats, not 33"):
        outfits(33)


def test_a_frozen_program_stands_still_and_catches_up() -> None:
    async def main(clock: VirtualClock) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)
        echo, ticks_of = Echo(), {"one": 0, "two": 0}
        bus = TwinBus(clock, [echo])

        async def tick(name: str) -> None:
            while True:
                await asyncio.sleep(1.0)
                ticks_of[name] += 1

        async def program(name: str) -> None:
            async with asyncio.TaskGroup() as group:
                group.create_task(tick(name))
                await bus.transmit(b"frame\0")

        tasks = [loop.create_task(program(n), context=context_of(n)) for n in ticks_of]
        await asyncio.sleep(1e-5)
        loop.freeze("one")
        await asyncio.sleep(10.5)
        assert ticks_of == {"one": 0, "two": 10}
        assert echo.heard == [b"frame\0"], "the port sends what was written to it"
        loop.thaw("one")
        await asyncio.sleep(1.5)
        assert ticks_of["one"] == 2
        loop.freeze("two")
        for task in tasks:
            task.cancel()
        loop.thaw("two")
        await asyncio.gather(*tasks, return_exceptions=True)

    run_virtual(main)


@pytest.mark.parametrize("seed", range(4))
def test_a_program_that_is_killed_while_frozen_does_nothing_more(seed: int) -> None:
    """Its tasks end, and neither timers nor messages that came meanwhile let them go on."""
    did: list[str] = []

    async def main(clock: VirtualClock) -> None:
        loop, rings = asyncio.get_running_loop(), asyncio.Event()
        assert isinstance(loop, VirtualLoop)

        async def wait(what: str) -> None:
            await (rings.wait() if what == "message" else asyncio.sleep(1.0))
            did.append(what)

        async def program() -> None:
            async with asyncio.TaskGroup() as group:
                for what in ("message", "timer") * 3:
                    group.create_task(wait(what))

        task = loop.create_task(program(), context=context_of("one"))
        await asyncio.sleep(0.5)
        loop.freeze("one")
        rings.set()
        await asyncio.sleep(5.0)
        task.cancel()
        loop.kill("one")
        async with asyncio.timeout(10.0):
            await asyncio.gather(task, return_exceptions=True)
        assert task.cancelled()

    run_virtual(main, seed)
    assert not did


def test_imperfections_are_counted_once() -> None:
    fit = outfits(1, seed=4)[0]
    same = fit.with_causes(fit.causes)
    np.testing.assert_allclose(same.armature.table, fit.mechanism.armature.table, atol=1e-12)
    assert any(abs(value) > 1e-3 for value in fit.causes.values())


def test_a_record_of_a_command_that_was_given_up_belongs_to_nothing_and_says_so() -> None:
    plant = SimpleNamespace(
        field=SimpleNamespace(live=lambda now: np.zeros(0, dtype=bool)),
        sentinel=SimpleNamespace(order=None),
        orders=(),
        authority=SimpleNamespace(visited=dict),
    )
    for result, good in (("PARAMETERS: 1 failed (H1: not sent: too late)", True), ("done", False)):
        disk = RecordsDisk()
        observer = PlantObserver(0.0, disk, SETTINGS, [])
        record = Record("x-1", "plant", "plant", "PARAMETERS", "", result=result)
        observer.look(plant, 0.0)  # type: ignore[arg-type]
        disk.records["x-1"] = record
        observer.look(plant, 1.0)  # type: ignore[arg-type]
        if good:
            observer.look(plant, 4.0)  # type: ignore[arg-type]
        else:
            with pytest.raises(InvariantError, match="record x-1 belongs to nothing"):
                observer.look(plant, 4.0)  # type: ignore[arg-type]


def test_an_own_order_of_the_plant_waits_for_its_turn_for_a_time_only() -> None:
    waiting = SimpleNamespace(identity="x-1", sent=False)
    plant: Any = SimpleNamespace(
        field=SimpleNamespace(live=lambda now: np.zeros(0, dtype=bool)),
        sentinel=SimpleNamespace(order=None),
        orders=(waiting,),
        authority=SimpleNamespace(visited=dict),
    )
    disk = RecordsDisk()
    observer = PlantObserver(0.0, disk, SETTINGS, [])
    disk.records["x-1"] = Record("x-1", "plant", "plant", "TRACK", "")
    for now in np.arange(0.0, TURN_WITHIN, 1.0):
        observer.look(plant, float(now))
    with pytest.raises(InvariantError, match="record x-1 has been waiting for 61 s"):
        observer.look(plant, TURN_WITHIN + 1.0)


def test_a_lease_of_automatic_control_may_leave_after_a_person_has_the_authority() -> None:
    """Simulated run 990686: it took the authority and gave way before it leased with it."""

    def leased(token: int, told: int, visited: float = -1.0, had: Person | None = None) -> None:
        observer = PlantObserver(0.0, RecordsDisk(), SETTINGS, [], automatic=True)
        observer._visited_at = visited
        observer.gave_way(1.0, told)
        if had is not None:
            observer.granted(had, 5, 0.5, seized=False)
        observer.granted(ENGINEER, 8, 1.0, seized=had is not None)
        for now in (1.0, 1.2):
            observer.posted((), Lease(token, 5.0, 60.0, "one"), now)

    leased(8, 7)
    leased(7, 7)
    leased(6, 0, 0.9)  # the plant's own, under which a visit went on
    for token, told in ((6, 7), (7, 0)):
        with pytest.raises(InvariantError, match="given the command authority, which engineer had"):
            leased(token, told)
    with pytest.raises(InvariantError, match="given the command authority, which engineer had"):
        leased(6, 0, 0.9, OPERATOR)  # the plant has no token of its own while a person commands


def test_a_slow_disk_works_in_order_and_loses_what_waits() -> None:
    async def main(clock: VirtualClock) -> None:
        disk, done = RecordsDisk(), []
        queue = disk.queue(clock, copy_context())

        def work(name: str) -> None:
            queue.do(lambda: done.append(name), done.append)

        work("at once")
        disk.set_slow(clock.monotonic(), 2.0)
        work("first")
        disk.set_slow(clock.monotonic(), 0.0)
        work("second")
        assert done == ["at once", None]
        assert disk.busy(clock.monotonic())
        await asyncio.sleep(2.1)
        assert done == ["at once", None, "first", None, "second", None]
        assert not disk.busy(clock.monotonic())
        disk.set_full(clock.monotonic(), full=True)
        queue.do(disk.check, lambda error: done.append(type(error)))
        assert done[-1] is AuditError
        disk.set_slow(clock.monotonic(), 2.0)
        work("lost")
        disk.lose()
        await asyncio.sleep(5.0)
        assert "lost" not in done

    run_virtual(main)


def test_a_drawn_scene_has_sun_and_free_mirrors() -> None:
    assert scene_of(("calm",), 3, 60.0, 4) == USUAL
    for seed in range(30):
        scene = scene_of(("place",), seed, 600.0, 6)
        assert scene == scene_of(("place",), seed, 600.0, 6)
        for at in (0.0, 600.0):
            assert vector(scene.start.timestamp() + at, scene.site)[2] > 0.13
        for middle, radius in scene.keep_outs:
            assert math.dist(middle, RECEIVER) > radius + 5.0
            assert all(math.dist(middle, (*place, 2.0)) > radius + 5.0 for place in scene.places)
        # Nothing can take a beam elsewhere at stow.
        fits = outfits(6, seed, scene.places)
        for at in (0.0, 250.0, 600.0):
            sun = vector(scene.start.timestamp() + at, scene.site)
            for fit in fits:
                board = Board(fit)
                assert board.miss(sun, RECEIVER) > 6.0
                assert all(board.miss(sun, ball) > radius for ball, radius in scene.keep_outs)


def test_the_run_that_is_obeyed_is_the_only_one_while_its_leases_come() -> None:
    runs = RunAccount()
    runs.leased("a", 3.0, 0.0)
    runs.leased("b", 3.0, 0.5)
    assert runs.obeyed(["a-1.1"], 1.0) == ""
    runs.leased("a", 3.0, 2.0)
    # Either may be meant where both gave the same order.
    assert runs.obeyed(["a-2.1", "b-1.1"], 4.0) == ""
    wrong = runs.obeyed(["b-2.1"], 4.0)
    assert wrong == (
        "run b is obeyed although run a, which was obeyed before, still holds the lease for 1.00 s"
    )
    assert runs.obeyed(["b-2.1"], 5.0) == ""
    assert runs.obeyed(["a-3.1"], 5.5) == ""  # b's lease came at 0.5 s, and is over


def test_a_lease_that_comes_too_late_proves_nothing() -> None:
    runs = RunAccount()
    runs.leased("a", 3.0, 0.0)
    assert runs.obeyed(["a-1.1"], 1.0) == ""
    runs.leased("a", 3.0, 3.5)
    assert runs.obeyed(["b-1.1"], 4.0) == ""
    runs.forget()
    assert runs.obeyed(["a-2.1"], 4.1) == ""


def test_an_alarm_of_a_sensor_outlives_a_frozen_plant_but_not_a_killed_one() -> None:
    """Simulated run 911317: a plant that was thawed had raised its alarm before."""
    for killed in (False, True):
        observer = SensorObserver(0.0, {})
        observer.look(set(), 0.0, runs=True)
        for name in SENSORS:
            condition = SENSORS[name][0][0]
            alarm = Alarm(condition, "", Severity.ALARM, "no reading", active=True)
            observer.on_alarm(alarm, 0.0)
        observer.look(set(), 10.0, runs=True)
        observer.look(set(), 20.0, runs=False)
        if killed:
            observer.on_end(21.0)
        observer.look(set(), 30.0, runs=True)
        if killed:
            with pytest.raises(InvariantError, match="no alarm names it"):
                observer.look(set(), 60.0, runs=True)
        else:
            observer.look(set(), 60.0, runs=True)


def test_what_a_killed_plant_still_posts_is_not_judged() -> None:
    """Simulated run 911645: a visit that is cancelled takes its beam off the target."""
    posted: list[tuple[str, ...]] = []

    async def main(clock: VirtualClock) -> None:
        pod = SimpleNamespace(addresses={"H1": 1}, judges=())
        plant = SimpleNamespace(posted=lambda members, message, now: posted.append(members))
        panel = SimpleNamespace(plant=plant, each=())
        ear = PlantEar(pod, panel)  # type: ignore[arg-type]
        data = encode(Emergency("r-1.1", "DEFOCUS", ("H1",)))
        await ear.posted(data, 0.0)
        ear.end()
        await ear.posted(data, 1.0)

    run_virtual(main)
    assert posted == [("H1",)]


class _Log(Judge):
    """An observer that notes what it hears, in the order in which it hears it."""

    def __init__(self, name: str, heard: list[tuple[str, str]]) -> None:
        super().__init__(0.0)
        self._name, self._heard = name, heard

    def on_lease(self, token: int, now: float) -> None:
        del token, now
        self._heard.append((self._name, "lease"))

    def on_emergency(self, name: str, heliostats: Sequence[str], now: float) -> None:
        del now
        self._heard.append((self._name, f"{name} {' '.join(heliostats)}"))

    def on_write(self, heliostat: str, what: str, now: float) -> None:
        del now
        self._heard.append((self._name, f"{what} {heliostat}"))


def test_each_observer_hears_in_its_turn_of_what_leaves_the_plant() -> None:
    heard: list[tuple[str, str]] = []
    calls: Any = SimpleNamespace(known=lambda token: True, until=lambda token, at: at)
    own: Any = SimpleNamespace(emergency=lambda *args, **kwargs: None, ordered=lambda order: None)
    pod: Any = SimpleNamespace(
        addresses={"H1": 1, "H2": 2},
        file={},
        judges=(_Log("line", heard),),
        observer=own,
        carried=lambda now: True,
    )
    panel: Any = SimpleNamespace(plant=calls, each=(_Log("beams", heard), _Log("work", heard)))
    ear = PlantEar(pod, panel)
    ear.sent(encode(Lease(7)), 0.0)
    assert heard == [("line", "lease"), ("beams", "lease"), ("work", "lease")]
    heard.clear()
    ear.sent(encode(Emergency("r-1.1", "STOW")), 1.0)
    assert heard == [("beams", "STOW H1 H2"), ("work", "STOW H1 H2")]
    heard.clear()
    ear.sent(encode(Command("r-1.2", "ZERO", (0.0, 0.0), ("H2",), 7)), 2.0)
    assert heard == [("beams", "ZERO H2"), ("work", "ZERO H2")]


def test_an_observer_replaces_only_hooks_that_something_calls() -> None:
    """A misspelt hook would never be called, and what it judges never judged."""
    hooks = {name for name in vars(Judge) if name.startswith("on_")}
    world = Path(invariants.__path__[0]).parent / "world"
    text = "".join(page.read_text(encoding="utf-8") for page in world.glob("*.py"))
    assert {name for name in hooks if f".{name}(" not in text} == set()
    observers = [kind for kind in Judge.__subclasses__() if kind is not _Log]
    assert len(observers) > 12
    for kind in observers:
        assert {name for name in vars(kind) if name.startswith("on_")} <= hooks, kind


def test_no_observer_takes_a_table_from_the_code_that_it_observes() -> None:
    """An error in the table would then be an error of both, which no run finds."""
    tiers = ("cluster", "lcu", "links", "plant", "safety")
    pages = sorted(Path(invariants.__path__[0]).glob("*.py"))
    seen, taken = 0, []
    for page in pages:
        for node in ast.walk(ast.parse(page.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or (node.module or "").count(".") < 1:
                continue
            if (node.module or "").split(".")[1] not in tiers:
                continue
            for alias in node.names:
                value = getattr(import_module(node.module or ""), alias.name)
                seen += 1
                if isinstance(value, (tuple, list, set, frozenset, dict)):
                    taken.append(f"{page.name}: {node.module}.{alias.name}")
    assert seen > 20
    assert taken == []
