"""What a plant learns at night of its groups of mirrors, and what is done with it."""

import asyncio
import json
import signal
import subprocess
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.growth import Growth
from heliotrope.calibration.learn import group, present, worker
from heliotrope.calibration.learn.group import GroupHistory, LearntGroup
from heliotrope.calibration.learn.own_model import OwnModel
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.example import example_plant
from heliotrope.field.layouts import malan_plant
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism import parameters
from heliotrope.plant.field.learner import LearnerProcess
from heliotrope.plant.operations.automatic import AUTOMATIC, AutomaticSettings
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.learning import EVERY, Learning
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.schedule.scheduler import Scheduler
from heliotrope.plant.schedule.settings import Settings
from heliotrope.plant.visits.fitting import Believed, fit_heliostat
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.keeper import Keeper
from support.drifting import BEGIN, DAY, history
from support.live import LiveOptions, LivePlant
from support.plant_bench import ENGINEER, OPERATOR, Bench

DESIGN = example_plant()
NAME, NAMES = "azel", DESIGN.groups["azel"].names
MODEL = parameters.model("malan8", DESIGN.groups[NAME].mechanism.parameters)
SEEN = tuple(history(DESIGN, name, 16, 5) for name in NAMES[:5])
NOW = datetime.fromtimestamp(BEGIN + 17 * DAY, UTC)


class Here:
    """Learns in the loop, as virtual time needs it; ``answer`` replaces the result."""

    def __init__(self) -> None:
        self.asked: list[GroupHistory] = []
        self.answer: Callable[[LearntGroup], LearntGroup] = lambda found: found

    async def learn(self, history: GroupHistory) -> LearntGroup:
        self.asked.append(history)
        return self.answer(learnt_once(history))


_DONE: dict[int, LearntGroup] = {}


def learnt_once(history: GroupHistory) -> LearntGroup:
    """The same photographs teach the same: they are learnt once for all tests of this file."""
    task = group.gathered(history)
    if len(task.sightings) not in _DONE:
        _DONE[len(task.sightings)] = group.learn_group(task)
    return _DONE[len(task.sightings)]


class Night:
    """A plant that has seen its mirrors, in the night."""

    def __init__(self, folder: Path, seen: int = 5) -> None:
        clock = VirtualClock(start=NOW)
        self.keeper = Keeper(folder / "store.sqlite", inline=True)
        self.bench = Bench(clock, folder, design=DESIGN)
        self.clock, self.plant, self.here = clock, self.bench.plant, Here()
        self.log = Logbook(clock, self.keeper)
        keeping = Keeping(self.plant.field.names, self.plant.beliefs, self.keeper)
        keeping.recall()
        self.learning = Learning(self.plant, self.log, keeping, "malan8", self.here, AUTOMATIC)
        self.learning.recall()
        for name, each in list(zip(NAMES, SEEN, strict=False))[:seen]:
            if self.plant.beliefs.known(name) is None:
                self.plant.beliefs.note(name, "target", each)

    def step(self, *, night: bool = True) -> None:
        asyncio.run(self.learning.step(night=night))

    def close(self) -> None:
        self.keeper.close()
        self.bench.audit.close()

    def calibrate(self, name: str) -> None:
        """Calibrate a heliostat by what has been seen of it."""
        beliefs = self.plant.beliefs
        seen = beliefs.known(name)
        assert seen is not None
        settings = CycleSettings(left=1.0, most=50.0)
        fit = fit_heliostat(
            Believed.of(beliefs, name), settings, OwnModel("malan8", MODEL), seen.sightings
        )
        beliefs.take(fit.record(beliefs, float(seen.sightings.time[-1]), person="Egon"))


def test_a_night_puts_in_force_what_it_learns_and_a_restart_brings_it_back(
    tmp_path: Path,
) -> None:
    night = Night(tmp_path)
    beliefs = night.plant.beliefs
    night.calibrate(NAMES[0])
    scheduler = Scheduler(DESIGN, Settings(model="malan8"), now=NOW, names=night.plant.field.names)
    beliefs.subscribe(scheduler.learn)
    beliefs.subscribe_drift(scheduler.drift)
    later, row = NOW.fromtimestamp(BEGIN + 26 * DAY, UTC), night.plant.field.place(NAMES[0])
    before, record = scheduler.expected(later)[row], beliefs.record(NAMES[0])
    assert record is not None
    assert beliefs.hyper(NAMES[0]) is None
    night.step(night=False)
    assert not night.here.asked
    night.step()
    (asked,) = night.here.asked
    assert asked.model == MODEL
    (view,) = night.learning.views()
    assert (view.group, view.version, view.heliostats, view.sightings) == (NAME, 1, 5, 240)
    assert view.gain > 0.3
    assert "version 1, from 240 photographs of 5 heliostats" in view.said
    # Its covariance grows otherwise from its fit on, for all who hold it.
    now = beliefs.record(NAMES[0])
    assert now is not None
    assert now.growth == beliefs.growth(NAMES[0]) != record.growth
    assert now.growth.source.startswith("learnt 2026-06-18 from 240 photographs of 5 heliostats")
    assert now.version == record.version
    np.testing.assert_array_equal(now.values, record.values)
    wider = now.sigma_at(record.at + 9 * DAY) / record.sigma_at(record.at + 9 * DAY)
    assert wider.max() > 1.3
    assert scheduler.expected(later)[row] > 1.3 * before
    assert any("version 1, from 240" in row.text for row in night.log.events(20))
    (entry,) = night.keeper.learnings()
    assert (entry.group, entry.version, entry.person) == (NAME, 1, AUTOMATIC.name)
    drift = view.drift
    night.close()
    again = Night(tmp_path)
    (view,) = again.learning.views()
    assert (view.version, view.drift) == (1, drift)
    assert view.said == "version 1 of 2026-06-18 is in force"
    assert again.plant.beliefs.growth(NAMES[0]) == now.growth
    # Later versions begin from it.
    again.step()
    assert again.here.asked[0].before.noise == pytest.approx(entry_noise(entry.document))
    assert again.learning.views()[0].version == 2
    again.close()


def entry_noise(document: str) -> float:
    return float(json.loads(document)["hyper"]["noise"])


def test_visits_follow_the_drift_as_it_was_learnt(tmp_path: Path) -> None:
    night = Night(tmp_path)
    beliefs = night.plant.beliefs
    night.calibrate(NAMES[0])
    default = beliefs.record(NAMES[0])
    night.step()
    night.calibrate(NAMES[0])
    learnt, seen, hyper = beliefs.record(NAMES[0]), SEEN[0], beliefs.hyper(NAMES[0])
    assert default is not None
    assert learnt is not None
    assert hyper is not None
    constants = fit(beliefs.nominal(NAMES[0]), seen, MODEL)
    now = present.fitting_present(beliefs.nominal(NAMES[0]), seen, constants, hyper)
    np.testing.assert_allclose(learnt.values, now.values[0])
    assert np.abs(learnt.values - default.values).max() > 1e-5
    night.close()


def test_one_attempt_a_night_and_only_for_new_photographs(tmp_path: Path) -> None:
    night = Night(tmp_path)
    night.step()
    night.step()
    night.clock.advance(EVERY)
    night.step()
    assert len(night.here.asked) == 1
    shifted = replace(SEEN[0], time=SEEN[0].time + 16 * DAY)
    night.plant.beliefs.note(NAMES[0], "target", shifted.take(np.arange(3)))
    night.step()
    assert len(night.here.asked) == 1
    night.clock.advance(EVERY)
    night.step()
    assert len(night.here.asked) == 2
    night.close()


def test_too_few_photographs_keep_the_defaults_and_say_so(tmp_path: Path) -> None:
    night = Night(tmp_path, seen=3)
    night.step()
    (view,) = night.learning.views()
    assert view.version == 0
    said = "nothing new was learnt: 3 heliostats with 8 photographs on different days; 4 are needed"
    assert view.said == f"{said}; the defaults stay in force"
    assert night.plant.beliefs.hyper(NAMES[0]) is None
    assert any(said in row.text for row in night.log.events(20))
    night.close()


def test_a_failure_and_what_is_no_better_leave_in_force_what_is(tmp_path: Path) -> None:
    night = Night(tmp_path)

    def fails(found: LearntGroup) -> LearntGroup:
        raise InputError("its process ended with code -9")

    night.step()
    for answer, said in (
        (fails, "nothing new was learnt: its process ended with code -9; version 1 stays in force"),
        (
            lambda found: replace(found, gain=-0.1),
            "240 photographs of 5 heliostats: new values would not predict them better, so",
        ),
        (
            lambda found: replace(found, gain=float("nan")),
            "240 photographs of 5 heliostats: new values would not",
        ),
    ):
        night.here.answer = answer
        night.learning.order(ENGINEER)
        night.step(night=False)
        (view,) = night.learning.views()
        assert said in view.said
        assert view.version == 1
    assert len(night.keeper.learnings()) == 1
    night.close()


def test_a_person_orders_it_by_day(tmp_path: Path) -> None:
    night = Night(tmp_path)
    with pytest.raises(RefusedError, match="learn: Olga is operator"):
        night.learning.order(OPERATOR)
    with pytest.raises(UnknownNameError, match="nobody"):
        night.learning.order(ENGINEER, "nobody")
    night.learning.order(ENGINEER, NAME)
    assert night.learning.views()[0].said.startswith("learning is queued; ")
    night.step(night=False)
    (view,) = night.learning.views()
    assert (view.version, view.person) == (1, ENGINEER.name)
    night.close()


def test_what_no_longer_fits_the_plant_file_is_named_and_left(tmp_path: Path) -> None:
    night = Night(tmp_path)
    night.step()
    (entry,) = night.keeper.learnings()
    text = entry.document.replace('"tilt_east"', '"tilt_of_old"')
    for version, document in ((2, text), (3, "{}")):
        night.keeper.record(replace(entry, version=version, document=document))
    night.keeper.record(replace(entry, group="gone"))
    night.close()
    again = Night(tmp_path)
    (view,) = again.learning.views()
    assert view.version == 0
    assert "version 3 cannot be used" in view.said
    again.close()


def test_automatic_control_learns_at_night_and_the_audit_has_it(tmp_path: Path) -> None:
    here, design = Here(), malan_plant(4)
    audit = JsonLines(tmp_path / "audit.jsonl", NOW)

    async def main(clock: VirtualClock) -> None:
        options = LiveOptions(rendered=False, threads=0, work=AutomaticSettings(wanted=False))
        live = LivePlant(design, clock, options, learner=here, audit=audit)
        for name in design.names:
            live.plant.beliefs.note(name, "left", history(design, name, 10, 6))
        async with live.running() as plant:
            await asyncio.sleep(30.0)
            (view,) = plant.operations.automatic.learning.views()
            assert (view.version, view.person) == (1, AUTOMATIC.name)
            plant.operations.learn(ENGINEER)
            await asyncio.sleep(10.0)
            await plant.end()

    run_virtual(main, start=NOW.replace(hour=22))
    assert len(here.asked) == 2
    kept = [json.loads(line) for line in (tmp_path / "audit.jsonl").read_text().splitlines()]
    done = [(line["who"], line["what"]) for line in kept if "what" in line]
    assert (AUTOMATIC.name, "LEARNT") in done
    assert (ENGINEER.name, "LEARN") in done


# -- the process -----------------------------------------------------------------------------------


def whole() -> GroupHistory:
    mechanism = DESIGN.groups[NAME].mechanism
    return GroupHistory(mechanism[:5], SEEN, MODEL, group.defaults(mechanism, MODEL))


def test_a_process_learns_the_same_as_this_one() -> None:
    found, here = asyncio.run(LearnerProcess().learn(whole())), learnt_once(whole())
    assert (found.heliostats, found.sightings) == (here.heliostats, here.sightings)
    assert found.gain == pytest.approx(here.gain, rel=1e-6)
    one, two = (Growth.of(each.hyper, "") for each in (found, here))
    np.testing.assert_allclose(one.variance, two.variance, rtol=1e-6)


def test_a_process_is_ended_with_the_plant_and_after_too_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    begun: list[subprocess.Popen[bytes]] = []
    really = subprocess.Popen

    def start(*values: object, **named: object) -> object:
        begun.append(really(["sleep", "600"], stdin=subprocess.PIPE, stdout=subprocess.PIPE))
        return begun[-1]

    monkeypatch.setattr("heliotrope.plant.field.learner.subprocess.Popen", start)

    async def cancelled() -> None:
        task = asyncio.create_task(LearnerProcess().learn(whole()))
        async with asyncio.timeout(60.0):
            while not begun:
                await asyncio.sleep(0.01)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancelled())
    assert begun[0].wait(60.0) == -signal.SIGKILL
    with pytest.raises(InputError, match="ended after 1e-05 h"):
        asyncio.run(LearnerProcess(longest=0.036).learn(whole()))
    assert begun[1].wait(60.0) == -signal.SIGKILL


def test_a_process_that_fails_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "asked", lambda task: b"not a pickle")
    with pytest.raises(InputError, match=r"^UnpicklingError: ") as error:
        asyncio.run(LearnerProcess().learn(whole()))
    assert "\n" not in str(error.value)
    monkeypatch.setattr("heliotrope.plant.field.learner._MODULE", "heliotrope.no_such_module")
    with pytest.raises(InputError, match="its process ended with code 1"):
        asyncio.run(LearnerProcess().learn(whole()))
