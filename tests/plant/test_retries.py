"""Loops of automatic control: each has an end, and what failed takes no time from others."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import FetchError, HeliotropeError
from heliotrope.imaging.coded import Verdict
from heliotrope.lcu import names as meanings
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.attempts import Attempts
from heliotrope.plant.emergency.sentinel import _TABLE
from heliotrope.plant.operations import Logbook, calibrating
from heliotrope.plant.operations.automatic import AutomaticControl, AutomaticSettings
from heliotrope.plant.operations.calibrating import FRESH, PLACES, Calibrating
from heliotrope.plant.operations.raising import RAISING
from heliotrope.plant.operations.views import CalibrationEntry, Running
from heliotrope.plant.orders.authority import RefusedError, TakenOutError
from heliotrope.plant.schedule.scheduler import VISITS
from heliotrope.plant.visits import CycleResult
from heliotrope.safety import Act, Alarm
from heliotrope.store.records import PlannedVisit
from support.plant_bench import ENGINEER, OPERATOR, Bench, in_one_cluster, running

NAME = "P1A"
READY = 1 << meanings.FLAGS.index("READY")


class InOrder:
    """A schedule in which all ready heliostats are due, in the order of the field."""

    def __init__(self, names: Sequence[str]) -> None:
        self.names, self.attempts, self.reason = names, Attempts(VISITS), ""
        self.entries: list[CalibrationEntry] = []

    def next(self, target: str, ready: np.ndarray, beside: bool = False) -> PlannedVisit | None:
        del beside
        row = int(np.argmax(ready))
        return PlannedVisit(self.names[row], target, 0.0, 1e-3) if ready[row] else None

    def done(self, entry: CalibrationEntry) -> None:
        self.entries.append(entry)


class Visits:
    """A single visit that ends as the test says, and takes a minute."""

    def __init__(self, bench: Bench) -> None:
        self.ends: Exception | CalibrationOutcome = CalibrationOutcome.CALIBRATED
        self.bench, self.names = bench, list[str]()

    async def run(self, person: object, token: int, heliostat: str, *_: object) -> CycleResult:
        del person, token
        self.names.append(heliostat)
        authority = self.bench.plant.authority
        for _ in range(60):
            await self.bench.wait(1.0)
            if authority.grant is not None:
                authority.keep(OPERATOR, authority.grant.token)
        if isinstance(self.ends, Exception):
            raise self.ends
        return CycleResult(heliostat, self.ends, "x", new=3)


class Scene:
    """Automatic calibration on a bench, whose alarms are noted."""

    def __init__(self, bench: Bench, token: int) -> None:
        self.bench, self.plant, self.token = bench, bench.plant, token
        self.alarms: list[Alarm] = []
        self.visits, self.schedule = Visits(bench), InOrder(bench.plant.field.names)
        silent = SimpleNamespace(
            event=lambda *_, **__: None, keep=lambda *_: None, take_alarm=self.alarms.append
        )
        book: Any = SimpleNamespace(error=np.zeros(len(self.plant.field)), conclude=lambda _: None)
        unknown: Any = SimpleNamespace(now=lambda: np.full(64, np.nan))
        self.first: frozenset[str] = frozenset()
        made_by: Any = self.visits, self.schedule
        chosen = calibrating.Visits(*made_by)
        made: Any = (self.plant, silent, chosen, book, silent, unknown)
        self.calibrating = Calibrating(*made, lambda: self.first)
        self.ready = np.ones(len(self.plant.field), dtype=np.bool_)

    async def visit(self) -> tuple[str, ...]:
        return await self.calibrating.visit("target", self.ready, ENGINEER, self.token)

    async def joint_visit(self, results: tuple[CycleResult, ...]) -> None:
        async def run(*_: object) -> tuple[CycleResult, ...]:
            return results

        cycle: Any = SimpleNamespace(run=run, kind="joint visit")
        names = tuple(result.heliostat for result in results)
        await self.calibrating._coded_visit(cycle, names, "target", ENGINEER, self.token)


def play(folder: Path, scene: Callable[[Scene], Awaitable[None]]) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, folder, design=in_one_cluster())
        async with running(bench):
            made = Scene(bench, await bench.commanded())
            await scene(made)

    run_virtual(main)


def test_a_heliostat_that_stays_first_leaves_the_target_to_all_others(tmp_path: Path) -> None:
    """One that a flight has changed, and that each visit leaves so, came again without end."""

    async def scene(here: Scene) -> None:
        names = here.plant.field.names
        here.first = frozenset([names[3]])
        for _ in range(8):
            await here.visit()
        assert here.visits.names[0] == names[3]
        assert len(set(here.visits.names)) == 8
        await here.bench.wait(FRESH)
        here.visits.names.clear()
        await here.visit()
        assert here.visits.names == [names[3]], "it is first again after the others"
        here.ready[:] = False
        here.ready[3] = True
        await here.visit()
        assert here.visits.names == [names[3]] * 2, "a target is not idle for it"

    play(tmp_path, scene)


def test_a_choice_leaves_out_whom_another_visit_has_taken_meanwhile(tmp_path: Path) -> None:
    """Simulated day 51133: a receiver visit began while a target chose, with the same mirror."""

    async def scene(here: Scene) -> None:
        names, now = here.plant.field.names, 0.0

        async def chosen(*_: object) -> tuple[str, ...]:
            here.calibrating._running["receiver"] = Running(names[0], "receiver", "", now)
            return names[:1]

        made: dict[str, Any] = {"chosen": chosen, "awaited": lambda *_: False}
        made |= {"alone": np.zeros_like, "concluded": lambda _: None, "again": lambda _: False}
        requests = SimpleNamespace(next=lambda *_: (), asked=())
        here.calibrating._joint = SimpleNamespace(requests=requests, **made)  # type: ignore[assignment]
        assert await here.visit() == names[1:2]

    play(tmp_path, scene)


def test_what_a_person_or_an_emergency_has_ended_is_no_failure(tmp_path: Path) -> None:
    async def scene(here: Scene) -> None:
        here.visits.ends = RefusedError("command authority: nobody has it")
        here.plant.release_authority(OPERATOR, here.token)
        assert await here.visit() == here.plant.field.names[:1]
        assert here.schedule.entries == []
        assert here.calibrating.retries() == ()

    play(tmp_path, scene)


def test_a_heliostat_that_a_person_orders_out_of_its_visit_has_not_failed(tmp_path: Path) -> None:
    async def scene(here: Scene) -> None:
        here.visits.ends = TakenOutError("it dropped out of the visit: Vera ordered STOW")
        (name,) = await here.visit()
        assert here.schedule.entries == []
        assert here.calibrating.retries() == (), "nor has the target"
        entry = here.calibrating.result(name, 0.0)
        assert isinstance(entry, CalibrationEntry)
        assert entry.outcome is CalibrationOutcome.TAKEN_OUT
        # What is refused otherwise counts as ever.
        here.visits.ends = RefusedError("it is not at its aim in fine steps within 120 s")
        (name,) = await here.visit()
        assert [one.heliostat for one in here.schedule.entries] == [name]

    play(tmp_path, scene)


def test_an_order_that_a_heliostat_has_caused_is_its_failure(tmp_path: Path) -> None:
    async def scene(here: Scene) -> None:
        plant, names = here.plant, here.plant.field.names
        first, second, *others = names
        plant.release_authority(OPERATOR, here.token)
        token = plant.take_authority(ENGINEER).token
        with plant.authority.mandate(ENGINEER, token, names, "target") as mandate:
            # A beam where none may be, by a wrong parameter or a faulty board.
            plant.sentinel.send_safe(_TABLE, Act.DEFOCUS, (first,), "keep_out_predicted")
            plant.stow("Vera", (second,))
            assert mandate.taken.keys() == {first, second}
            assert mandate.blameless == {second}
            plant.raise_emergency("Vera")
            assert mandate.blameless == {second, *others}

    play(tmp_path, scene)


@pytest.mark.parametrize("taken", [True, False])
def test_only_the_others_of_a_joint_visit_have_failed(tmp_path: Path, taken: bool) -> None:
    async def scene(here: Scene) -> None:
        names = here.plant.field.names[:3]
        out = CalibrationOutcome.TAKEN_OUT if taken else CalibrationOutcome.REFUSED
        outcomes = (out, CalibrationOutcome.NOT_VERIFIED, CalibrationOutcome.CALIBRATED)

        results = tuple(CycleResult(n, o, "x") for n, o in zip(names, outcomes, strict=True))
        await here.joint_visit(results)
        assert [one.heliostat for one in here.schedule.entries] == list(names[taken:])

    play(tmp_path, scene)


@pytest.mark.parametrize(
    "problem", [FetchError("camera left: no frame for 15 s"), HeliotropeError("x")]
)
def test_a_blind_camera_blames_no_heliostat_and_its_target_waits(
    tmp_path: Path, problem: Exception
) -> None:
    async def scene(here: Scene) -> None:
        here.visits.ends = problem
        begun, waits = here.bench.clock.monotonic(), []
        for _ in range(5):
            while not await here.visit():
                await here.bench.wait(1.0)
                here.plant.authority.keep(OPERATOR, here.token)
            waits.append(here.bench.clock.monotonic() - begun - 60.0)
            begun = here.bench.clock.monotonic()
        assert waits == pytest.approx([0.0, 10.0, 20.0, 40.0, 80.0], abs=1.5)
        assert here.schedule.entries == []
        (alarm,) = here.alarms
        assert (alarm.condition, alarm.subject) == ("visits_fail", "target")
        assert await here.visit() == ()
        (retry,) = here.calibrating.retries()
        assert retry.given_up
        assert retry.left <= PLACES.rest
        # A person need not wait; and a good visit ends it.
        here.visits.ends = CalibrationOutcome.CALIBRATED
        here.calibrating.ask(NAME, "")
        assert await here.visit() == (NAME,)
        assert [alarm.active for alarm in here.alarms] == [True, False]
        assert here.calibrating.retries() == ()

    play(tmp_path, scene)


def test_a_flight_gives_one_that_was_given_up_new_visits(tmp_path: Path) -> None:
    async def scene(here: Scene) -> None:
        for at in range(5):
            here.schedule.attempts.failed(NAME, "no beam", float(at))
        assert [alarm.condition for alarm in here.alarms] == ["calibration_given_up"]
        assert NAME in here.schedule.attempts.given_up
        here.first = frozenset([NAME])
        await here.bench.wait(1.0)
        here.calibrating._pressing()
        assert here.schedule.attempts.given_up == []
        here.schedule.attempts.failed(NAME, "no beam", 9.0)
        here.calibrating._pressing()
        assert here.schedule.attempts.counts == {NAME: 1}, "the same flight says nothing new"

    play(tmp_path, scene)


def test_a_heliostat_that_is_raised_in_vain_is_left_alone(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        bench = Bench(clock, tmp_path, design=in_one_cluster())
        for cluster in bench.clusters.values():
            cluster.set(states.IDLE)
            cluster.rows["flags"] = READY
        async with running(bench):
            await bench.wait(2.0)
            cluster, log = bench.cluster_of(NAME), Logbook(clock)
            settings = AutomaticSettings(wanted=True, calibrate=False)
            control = AutomaticControl(bench.plant, log, settings=settings)
            working = asyncio.create_task(control.run())
            # It comes to standby, and is not able to go on from there.
            cluster.rows["flags"][cluster.names.index(NAME)] = 0
            await bench.wait(1500.0)
            assert len(cluster.commands("APPROACH")) == RAISING.most - 1
            assert cluster.rows["state"][cluster.names.index(NAME)] == states.STOWED
            (alarm,) = (a for a in log.alarms() if a.active and a.condition == "raising_given_up")
            assert "could not continue from its position" in alarm.text
            (retry,) = control.retries()
            assert (retry.subject, retry.given_up) == (NAME, True)
            # A person who gives it back gives it new turns.
            cluster.rows["flags"][cluster.names.index(NAME)] = READY
            control.want([NAME], wanted=True)
            await bench.until(lambda: bench.count(states.IDLE) == len(bench.plant.field.names))
            assert not [a for a in log.alarms() if a.active and a.condition == "raising_given_up"]
            working.cancel()
            await asyncio.gather(working, return_exceptions=True)

    run_virtual(main)


def test_clouds_on_a_joint_visit_are_no_failure_of_its_heliostats(tmp_path: Path) -> None:
    async def scene(here: Scene) -> None:
        names = here.plant.field.names[:4]
        clouded = tuple(
            CycleResult(name, CalibrationOutcome.NOT_PROVEN, "unchanged: x", verdict=Verdict.CLOUD)
            for name in names
        )

        await here.joint_visit(clouded)
        assert here.schedule.entries == []
        (retry,) = here.calibrating.retries()
        assert (retry.subject, retry.count) == ("target", 1)

    play(tmp_path, scene)
