"""Joint visits: several mirrors of a simulated plant on one target, told apart by their movements.

Mirrors drive, clusters poll and the plant commands as in operation; only the light is drawn by the
test's cameras, from where the mirrors truly stand.
"""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.plan.on_target import LOOKS
from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.errors import FetchError, InputError
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.layouts import malan_plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import Verdict
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant import refusals
from heliotrope.plant.attempts import Attempts
from heliotrope.plant.operations.calibrating import Calibrating, TrueErrors, Visits
from heliotrope.plant.operations.coded_visits import JointVisits
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.operations.views import PictureRow
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.schedule.scheduler import VISITS
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits import CycleResult, JointCycle
from heliotrope.plant.visits.joint_layout import arranged, errors_on
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.target_light import Exposed
from heliotrope.store.records import PlannedVisit
from support.joint_scene import Scene, joint, spoil
from support.live import LiveOptions, LivePlant
from support.visit_scene import BIASES, ENGINEER, START, believe

_CALIBRATED = CalibrationOutcome.CALIBRATED


def rows_in_the_loop(here: Scene) -> list[int]:
    """Return a list that grows by the rows of each solution that is computed in the loop."""
    beams, held = here.live.plant.beams, list[int]()
    poses = beams.poses

    def counted(rows: Any, *given: Any) -> Any:
        held.append(len(rows))
        return poses(rows, *given)

    beams.poses = counted  # type: ignore[method-assign]
    return held


def test_mirrors_on_one_target_are_calibrated_together() -> None:
    async def scene(here: Scene) -> None:
        plant = here.live.plant
        before, aims = here.live.errors(), plant.aims.copy()
        held = rows_in_the_loop(here)
        results = await here.run()
        assert {r.outcome for r in results.values()} == {_CALIBRATED}, results
        assert 0 < max(held) <= len(here.names), "a stack's rows are computed beside the loop"
        assert all(r.verdict is None and r.new == 1 for r in results.values())
        await asyncio.sleep(30.0)
        after = here.live.errors()
        assert np.median(after) < 0.75 * np.median(before)
        for name in here.names:
            seen, row = plant.beliefs.known(name), here.live.names.index(name)
            assert seen is not None
            true = here.live.truth[np.array([row])]
            assert beam_errors(true, seen.sightings).beam[0] < 0.6e-3, "what it saw is true"
        assert here.photographs() == 8, "three codes are enough for six beams on 12 m"
        # They tracked the receiver before, and do so again.
        assert set(here.states().values()) == {"TRACKING"}
        np.testing.assert_array_equal(plant.aims, aims)
        assert here.lit() == []

    joint(scene)


def test_drawn_photographs_name_a_stuck_mirror_and_an_exchanged_pair() -> None:
    async def scene(here: Scene) -> None:
        stuck, one, other = here.names[1], here.names[2], here.names[3]
        spoil(here, stuck, (one, other))
        version = {name: here.live.plant.beliefs.record(name) for name in here.names}
        results = await here.run()
        bad = {name: r.verdict for name, r in results.items() if r.verdict is not None}
        assert bad == {
            stuck: Verdict.STUCK,
            one: Verdict.EXCHANGED,
            other: Verdict.EXCHANGED,
        }, results
        assert f"({other})" in results[one].text
        for name in bad:
            assert results[name].outcome is CalibrationOutcome.NOT_PROVEN
            assert here.live.plant.beliefs.record(name) is version[name]
            assert here.live.plant.beliefs.known(name) is None
        good = [r for name, r in results.items() if name not in bad]
        assert {r.outcome for r in good} == {_CALIBRATED}, results

    joint(scene, rendered=True)


def test_a_cloud_teaches_nothing_and_leaves_what_local_controllers_store() -> None:
    async def scene(here: Scene) -> None:
        plant, cameras = here.live.plant, here.live.cameras
        stored = {name: await plant.stored(name) for name in here.names}
        records = {name: plant.beliefs.record(name) for name in here.names}
        real = cameras.light

        async def clouded(*given: object) -> object:
            picture = await real(*given)  # type: ignore[arg-type]
            shade, paint = (0.1 if here.photographs() % 2 else 1.0), 0.05
            return replace(picture, values=paint + shade * (picture.values - paint))

        cameras.light = clouded  # type: ignore[method-assign, assignment]
        results = await here.run()
        assert {r.verdict for r in results.values()} == {Verdict.CLOUD}, results
        assert {r.outcome for r in results.values()} == {CalibrationOutcome.NOT_PROVEN}
        for name in here.names:
            assert plant.beliefs.known(name) is None
            assert plant.beliefs.record(name) is records[name]
            assert await plant.stored(name) == stored[name]

    joint(scene)


def test_one_that_is_stowed_meanwhile_drops_out_and_the_others_go_on() -> None:
    async def scene(here: Scene) -> None:
        gone, plant = here.names[4], here.live.plant
        sent: list[str] = []
        defocus = plant.defocus

        def during(stage: str) -> None:
            if stage.startswith("photograph 3 "):
                here.during = lambda _: None
                plant.stow("Vera", (gone,))

        def noted(who: str, names: tuple[str, ...]) -> object:
            sent.extend(names)
            return defocus(who, names)

        here.during, plant.defocus = during, noted  # type: ignore[assignment, method-assign]
        results = await here.run()
        assert gone not in sent, "what is on its way to stow is off the target"
        assert results[gone].outcome is CalibrationOutcome.TAKEN_OUT
        assert "it dropped out of the visit: Vera ordered STOW" in results[gone].text
        good = [r for name, r in results.items() if name != gone]
        assert {r.outcome for r in good} == {_CALIBRATED}, results
        # The codes of the others begin anew: eight photographs in a row without the light of it.
        assert 8 < here.photographs() < 20
        await asyncio.sleep(120.0)
        assert here.states()[gone] == "STOWED", "a person's order is not undone"

    joint(scene)


def test_neighbours_count_as_they_stood_in_the_middle_of_the_stack() -> None:
    async def scene(here: Scene) -> None:
        cycle, apart = here.cycle.cycle, list[float]()
        alone = cycle.alone

        async def noted(target: Target, name: str, shot: Shot, standing: Any) -> Shot:
            apart.append(float(np.abs(standing.at - shot.at).max()))
            return await alone(target, name, shot, standing)

        cycle.alone = noted  # type: ignore[method-assign]
        results = await here.run()
        assert {r.outcome for r in results.values()} == {_CALIBRATED}, results
        # Eight photographs take 16 s and more.
        assert len(apart) == len(here.names)
        assert max(apart) < 5.0

    joint(scene, count=3)


def test_movements_on_a_target_wait_for_no_turn_to_join_the_receiver() -> None:
    async def scene(here: Scene) -> None:
        times: dict[str, float] = {}
        here.during = lambda stage: times.setdefault(stage, here.live.clock.monotonic()) and None
        results = await here.run()
        assert {r.outcome for r in results.values()} == {_CALIBRATED}, results
        begin, end = times["photograph 1 of 8, 6 beams"], times["6 on the way back"]
        # At the receiver's rate four of six beams would wait two seconds each, for each photograph.
        assert 8 * 2.0 <= end - begin + 1e-6 < 8 * 4.0

    joint(scene, settings=PlantSettings(join_rate=0.5, join_burst=2))


def test_movements_beside_a_target_wait_for_no_turn_but_those_near_a_receiver_do() -> None:
    """A beam that misses is looked for beside the target, in a stack with others."""

    async def scene(here: Scene) -> None:
        plant, name = here.live.plant, here.names[0]
        target, receiver = here.live.design.targets[0], here.live.design.receivers[0]

        async def seconds(point: FloatArray) -> float:
            begin = plant.now()
            assert await plant.aim(ENGINEER, here.token, {name: point}).end(10.0)
            return plant.now() - begin

        beside = target.center + 0.8 * target.width * target.axes[0]
        assert not target.holds(beside)
        assert np.linalg.norm(beside - receiver.center) > 10.0
        await seconds(beside)
        for step in (0.5, -0.5, 0.5):
            assert await seconds(beside + step * target.axes[0]) < 1.0
        # Each of these takes a turn, one in five seconds: far from the last point, near a receiver.
        edge = 0.5 * np.hypot(receiver.width, receiver.height)
        await seconds(receiver.center + np.array([0.0, 0.0, edge + 2.0]))
        assert await seconds(receiver.center + np.array([0.0, 0.0, edge + 1.5])) > 3.0
        assert await seconds(beside) > 3.0

    joint(scene, settings=PlantSettings(join_rate=0.2, join_burst=1))


def test_a_photograph_that_cannot_be_read_ends_the_visit_soon() -> None:
    """Photographs are read while the beams move on, two of them at most."""

    async def scene(here: Scene) -> None:
        camera = here.live.cameras
        real, count = camera.expose, iter(range(100))

        async def exposed(*given: Any) -> Exposed:
            seen = await real(*given)
            if next(count) != 2:
                return seen
            bad = asyncio.get_running_loop().create_future()
            bad.set_exception(InputError("target left: no mark is found"))
            return replace(seen, light=bad)

        camera.expose = exposed  # type: ignore[method-assign]
        with pytest.raises(InputError, match="no mark is found"):
            await here.run()
        assert next(count) == 4
        assert set(here.states().values()) == {"TRACKING"}, "back where they came from"

    joint(scene)


def test_an_emergency_or_a_blind_camera_ends_it_cleanly() -> None:
    async def scene(here: Scene) -> None:
        plant, camera = here.live.plant, here.live.cameras
        real = camera.light

        async def blind(*_: object) -> None:
            if here.photographs() > 2:
                raise FetchError("camera left: no frame for 15 s")
            return await real(here.live.design.targets[0])

        camera.light = blind  # type: ignore[method-assign, assignment]
        with pytest.raises(FetchError, match="no frame"):
            await here.run()
        assert set(here.states().values()) == {"TRACKING"}
        assert here.lit() == []
        camera.light = real  # type: ignore[method-assign]

        here.stages.clear()
        here.during = lambda stage: (
            plant.raise_emergency("anybody") and None if stage.startswith("photograph 4 ") else None
        )
        with pytest.raises(RefusedError, match="emergency"):
            await here.run()
        await asyncio.sleep(10.0)
        assert not set(here.states().values()) & {"TRACKING", "IDLE"}
        assert here.lit() == []
        assert all(plant.beliefs.known(name) is None for name in here.names)

    joint(scene)


def test_who_is_not_known_well_enough_or_would_be_too_bright_has_no_place() -> None:
    async def scene(here: Scene) -> None:
        plant, target = here.live.plant, here.live.design.targets[0]
        name, at = here.names[0], here.live.clock.utc().timestamp()
        wide = np.diag([1e-5, 1e-5])
        plant.beliefs.take(
            HeliostatCalibration(name, at, BIASES, np.zeros(2), wide, np.full(2, 5e-3))
        )
        book, everyone = here.live.operations.automatic.book, np.arange(len(here.names))
        on_target = np.hypot(book.error_on(target, everyone), np.sqrt(2.0) * JointSettings().visit)
        for row, one in enumerate(here.names):
            error = errors_on(plant, target, [one], JointSettings())
            assert on_target[row] == pytest.approx(error[one]), "one by one, and all at once"
        layout = arranged(plant, target, here.names, JointSettings())
        wrong = layout.left_out
        assert list(wrong) == [name]
        assert "known to" in wrong[name]
        assert layout.names == here.names[1:]
        away = np.abs(target.plane_coordinates(layout.aims))
        assert (away < 0.5 * target.width - 1.0).all(), "the beams keep off the border"
        sizes = np.abs(layout.moves).max(axis=(0, 2))
        slant = np.linalg.norm(plant.beams.armature.origin_1[1:] - target.center, axis=-1)
        np.testing.assert_allclose(sizes, 5e-4 * slant)
        alone = arranged(plant, target, here.names[1:2], JointSettings(brightest=0.1))
        assert len(alone.names) == 1
        crowd = replace(target, corners=target.center + 0.3 * (target.corners - target.center))
        dim = JointSettings(brightest=5.0)
        fewer = arranged(plant, crowd, here.names[1:], dim)
        wrong = fewer.left_out
        assert 0 < len(fewer.names) < 5
        assert all("would exceed 5 suns" in text for text in wrong.values())
        most = arranged(plant, target, here.names[1:], JointSettings(most=3, least=2))
        wrong = most.left_out
        assert len(most.names) == 3
        assert len(wrong) == 2

    joint(scene)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"least": 9, "most": 8}, "least 9 is above most 8; least must be the smaller"),
        ({"movement": 0.0}, "movement_mrad .coded.* must be above 0 and at most 5, not 0$"),
        ({"brightest": 0.0}, "brightest_suns .* must be above 0, not 0$"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        JointSettings(**wrong)  # type: ignore[arg-type]


def test_automatic_control_sends_those_that_are_known_together(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)

    async def scene(here: Scene) -> None:
        plant, operations = here.live.plant, here.live.operations
        names = here.names
        believe(here.live, 1e-3)
        plant.release_authority(ENGINEER, here.token)
        operations.automatic.want(names, wanted=True)
        operations.automatic.switch(on=True)
        until = here.live.clock.monotonic() + 400.0
        while not operations.automatic.view().on:
            assert here.live.clock.monotonic() < until
            await asyncio.sleep(0.5)
        operations.calibrate(ENGINEER, names[5], "right", together=names[3:5])
        assert operations.automatic.view().asked == (names[5], *names[3:5])
        seen: dict[str, set[str]] = {}
        log = here.live.assembly.logbook
        told: list[str] = []
        while not (
            any("3 of 3" in text for text in told) and max(map(len, seen.values()), default=0) > 3
        ):
            told = [e.text for e in log.events(50) if e.who == "right"]
            assert here.live.clock.monotonic() < until
            for one in operations.automatic.view().running:
                if one.others:
                    seen.setdefault(one.target, set()).update(one.heliostats)
            await asyncio.sleep(1.0)
        operations.automatic.switch(on=False)
        assert seen["right"] >= set(names[3:]), "what a person asked for"
        assert "joint visit: the beams of 3 of 3 heliostats were identified together" in told
        assert all(plant.beliefs.count(name) for name in names)
        # The photographs are kept once, and each of the heliostats has them with its own result.
        kept: dict[str, list[PictureRow]] = {}
        for name in names[3:]:
            pictures.find(name, 100, lambda rows, name=name: kept.setdefault(name, rows))
        stacks = [
            [row.identity for row in rows if row.target == "right" and row.used]
            for rows in kept.values()
        ]
        assert stacks[0] == stacks[1] == stacks[2]
        assert len(stacks[0]) >= 8
        assert {row.heliostat for row in kept[names[3]]} == {names[3]}

    joint(scene, pictures=pictures)


def test_a_plant_file_without_joint_visits_refuses_them() -> None:
    """Automatic control has a heliostat, but calibrates each alone; a person hears it."""

    async def main(clock: VirtualClock) -> None:
        design = replace(malan_plant(6), joint_visits=None)
        live = LivePlant(design, clock, LiveOptions(rendered=False, threads=0))
        async with live.running():
            try:
                until = clock.monotonic() + 600.0
                while not live.operations.automatic.view().on:
                    assert clock.monotonic() < until
                    await asyncio.sleep(1.0)
                first, second = live.names[:2]
                with pytest.raises(RefusedError, match="does not allow joint visits; request one"):
                    live.operations.calibrate(ENGINEER, first, together=[second])
                assert not live.operations.automatic.view().asked
                live.operations.calibrate(ENGINEER, first)
                assert live.operations.automatic.view().asked == (first,)
            finally:
                await live.operations.automatic.halt()
                await live.end()

    run_virtual(main, start=START)


class _Alarms(list):  # type: ignore[type-arg]
    def active(self) -> list[tuple[str, bool]]:
        return [(alarm.subject, alarm.active) for alarm in self]


def joint_visits(
    known: float, first: int, together: int = 5, approaching: tuple[int, ...] = ()
) -> tuple[JointVisits, _Alarms, np.ndarray]:
    """Six heliostats, ``first`` of them without a calibration; three have a place at once.

    The others are known to ``known`` on the target, and hardly at all on the receiver.
    """
    names = tuple("ABCDEF")
    at = np.array([np.nan] * first + [1.0] * (6 - first))
    coming = np.isin(np.arange(6), approaching)
    field = SimpleNamespace(place=names.index, names=names, among=lambda *_: coming)
    design = SimpleNamespace(targets=("left",), target=lambda name: name)
    now = iter(range(0, 10_000, 40))
    beliefs = SimpleNamespace(record=lambda name: at[names.index(name)] > 0.0 or None)
    plant = SimpleNamespace(field=field, design=design, now=lambda: next(now), beliefs=beliefs)
    book = SimpleNamespace(
        calibrated_at=at,
        error=np.full(6, 10e-3),
        error_on=lambda target, rows: np.full(len(rows), known),
    )
    told = _Alarms()
    settings = JointSettings(most=5, least=2, first=together)
    cycle = JointCycle(plant, None, None, settings)  # type: ignore[arg-type]
    cycle.having_place = lambda names, target: names[:3]  # type: ignore[method-assign, misc]
    made = JointVisits(plant, book, cycle, told.append)  # type: ignore[arg-type]
    return made, told, np.ones(6, dtype=np.bool_)


def follow(target: str, ready: np.ndarray, beside: bool) -> PlannedVisit | None:
    del beside
    row = int(np.argmax(ready))
    return PlannedVisit("ABCDEF"[row], target, 0.0, 1e-3, "") if ready[row] else None


def test_joint_visits_leave_every_second_visit_to_those_without_a_calibration() -> None:
    made, _, ready = joint_visits(2e-3, first=2, together=0)
    assert asyncio.run(made.chosen("left", ready, follow)) == ("C", "D", "E", "F")
    made.begun("left")
    assert asyncio.run(made.chosen("left", ready, follow)) == ()
    assert asyncio.run(made.chosen("left", ready, follow)) == ("C", "D", "E", "F")
    made, _, ready = joint_visits(2e-3, first=0)
    made.begun("left")
    assert asyncio.run(made.chosen("left", ready, follow)) == ("A", "B", "C", "D", "E")


@pytest.mark.parametrize("verdict", [Verdict.FAINT, Verdict.CLOUD])
def test_a_new_beam_that_leaves_the_target_dark_is_searched_at_another_place(
    verdict: Verdict,
) -> None:
    made, _, _ = joint_visits(2e-3, first=2)
    unknown, known = (
        CycleResult(name, CalibrationOutcome.NOT_PROVEN, "x", verdict=verdict) for name in "AF"
    )
    made.cycle._plant.beliefs.record = {"F": 1}.get  # type: ignore[method-assign]
    made.cycle.note(unknown)
    assert made.cycle.attempts.counts == {"A": 1}
    assert made.again(unknown)
    made.cycle.note(known)
    alone = () if verdict is Verdict.CLOUD else ("F",)
    assert tuple(made.cycle.attempts.given_up) == alone


def test_a_party_is_chosen_while_the_target_waits_for_nothing() -> None:
    made, _, ready = joint_visits(2e-3, first=0)

    async def main(clock: VirtualClock) -> None:
        begin = clock.monotonic()
        assert await made.chosen("left", ready, follow) == ("A", "B", "C", "D", "E")
        assert clock.monotonic() == begin

    run_virtual(main)


def test_the_error_on_the_target_decides_who_shares_codes() -> None:
    """With what is drawn anew at each visit it may be 3.8 mrad; on the receiver it may be more."""
    sure, _, ready = joint_visits(3.7e-3, first=0)
    assert asyncio.run(sure.chosen("left", ready, follow)) == ("A", "B", "C", "D", "E")
    vague, _, ready = joint_visits(3.75e-3, first=0)
    assert asyncio.run(vague.chosen("left", ready, follow)) == ("A", "B", "C"), (
        "assign different codes"
    )
    vague, _, ready = joint_visits(3.75e-3, first=0, together=0)
    assert asyncio.run(vague.chosen("left", ready, follow)) == ()
    # A mirror that cannot reach the target is neither.
    lost, _, ready = joint_visits(np.nan, first=0)
    assert asyncio.run(lost.chosen("left", ready, follow)) == ()


def test_joint_visits_of_new_heliostats_come_first() -> None:
    made, told, ready = joint_visits(2e-3, first=4)
    # Four are new, and three of them have a place; the other waits for the next visit.
    assert asyncio.run(made.chosen("left", ready, follow)) == ("A", "B", "C")
    for name in "ABC":
        made.begun("left")
        joined = CycleResult(name, CalibrationOutcome.NOT_PROVEN, "x", verdict=Verdict.JOINED)
        made.concluded(joined)
    assert told.active() == [], "nobody knows where the beam of a new mirror ought to be"
    assert made.alone(ready).tolist() == [True, True, True, False, False, False]
    # One new heliostat is no joint visit: those that go alone are next, then those that are known.
    assert asyncio.run(made.chosen("left", ready, follow)) == ()
    assert asyncio.run(made.chosen("left", ready, follow)) == ("E", "F")


@pytest.mark.parametrize(
    "verdicts",
    [
        (Verdict.FAINT,) * LOOKS,
        (Verdict.ELSEWHERE, *(Verdict.STUCK,) * (LOOKS - 1)),
        (Verdict.FAINT, Verdict.JOINED),
        (Verdict.STUCK, Verdict.EXCHANGED),
    ],
    ids=["never seen", "light at its place that is another's", "joined", "exchanged"],
)
def test_the_search_for_a_beam_in_joint_visits_ends(verdicts: tuple[Verdict, ...]) -> None:
    made, _, ready = joint_visits(2e-3, first=4)
    for verdict in verdicts:
        assert not made.alone(ready)[0]
        result = CycleResult("A", CalibrationOutcome.NOT_PROVEN, "x", verdict=verdict)
        made.concluded(result)
    assert not made.again(result)
    assert made.alone(ready).tolist() == [True] + [False] * 5
    (shown,) = made.cycle.attempts.shown(0.0)
    assert shown.subject == "A"
    assert shown.given_up
    assert shown.following == "it goes to a target alone, with a search for its beam"
    made.concluded(CycleResult("A", _CALIBRATED, "calibrated", new=3))
    assert not made.alone(ready).any()
    assert made.cycle.attempts.shown(0.0) == ()


def test_a_beam_that_is_looked_for_comes_again_and_a_cloud_is_no_mirrors_fault() -> None:
    made, _, ready = joint_visits(2e-3, first=4)
    faint = CycleResult("A", CalibrationOutcome.NOT_PROVEN, "x", verdict=Verdict.FAINT)
    cloud = CycleResult("C", CalibrationOutcome.NOT_PROVEN, "x", verdict=Verdict.CLOUD)
    made.concluded(faint)
    made.concluded(cloud)
    assert made.again(faint)
    assert not made.alone(ready).any()
    assert made.cycle.attempts.counts == {"A": 1, "C": 1}
    for _ in range(2 * LOOKS):
        made.concluded(cloud)
        assert not made.alone(ready).any()
    for _ in range(LOOKS):
        made.concluded(replace(cloud, heliostat="F"))  # it has a calibration
    assert made.cycle.attempts.counts == {"A": 1, "C": LOOKS - 1}


def test_two_targets_share_the_new_heliostats() -> None:
    made, _, ready = joint_visits(1e-3, first=6)
    made._plant.design.targets = ("left", "right")
    asked: list[int] = []

    def following(target: str, left: np.ndarray, beside: bool) -> PlannedVisit | None:
        asked.append(int(left.sum()))
        return follow(target, left, beside)

    assert asyncio.run(made.chosen("left", ready, following)) == ("A", "B", "C")
    assert asked == [6, 5, 4], "three of six are left to the other target"


def test_a_target_waits_a_minute_for_heliostats_that_are_raised() -> None:
    made, _, ready = joint_visits(1e-3, first=6, approaching=(4, 5))
    ready[3:] = False
    assert made.awaited("left", ready)
    assert made.awaited("left", ready), "40 s later"
    assert not made.awaited("left", ready)
    assert not joint_visits(1e-3, first=6, together=3, approaching=(4, 5))[0].awaited("left", ready)
    assert not joint_visits(1e-3, first=6)[0].awaited("left", ready), "nobody comes"


def test_who_was_disproved_goes_alone_and_has_an_alarm_until_it_is_seen() -> None:
    made, told, ready = joint_visits(1e-3, first=0)
    bad = CycleResult("B", CalibrationOutcome.NOT_PROVEN, "unchanged: x", verdict=Verdict.STUCK)
    made.concluded(bad)
    assert told.active() == [("B", True)]
    assert "B: in a joint visit, x." in told[0].text
    assert "B" not in asyncio.run(made.chosen("left", ready, follow))
    made.concluded(CycleResult("B", _CALIBRATED, "calibrated", new=3))
    assert told.active() == [("B", True), ("B", False)]
    assert "B" in asyncio.run(made.chosen("left", ready, follow))
    faint = CycleResult("C", CalibrationOutcome.NOT_PROVEN, "unchanged", verdict=Verdict.FAINT)
    made.concluded(faint)
    assert len(told) == 2, "light that is missing is no fault of the mirror"
    assert "C" not in asyncio.run(made.chosen("left", ready, follow))


def calibrating_of(
    made: JointVisits,
    event: Callable[..., None],
    done: list[str],
    truth: Callable[[], np.ndarray] = lambda: np.full(6, np.nan),
) -> Calibrating:
    """Automatic control of joint visits whose outcome a test writes."""
    plant = made._plant
    plant.clock = SimpleNamespace(utc=lambda: START)  # type: ignore[misc]
    plant.beliefs.count = lambda name: 0  # type: ignore[method-assign, misc]
    silent = SimpleNamespace(event=event, keep=lambda *_: None, take_alarm=lambda alarm: None)
    book = SimpleNamespace(error=np.full(6, 1e-3), conclude=lambda entry: None)
    schedule = SimpleNamespace(
        done=lambda entry: done.append(entry.heliostat), attempts=Attempts(VISITS)
    )
    found = Calibrating(
        plant,
        silent,  # type: ignore[arg-type]
        Visits(made.cycle, schedule),  # type: ignore[arg-type]
        book,  # type: ignore[arg-type]
        silent,  # type: ignore[arg-type]
        TrueErrors(plant, truth),
        lambda: (),
    )
    found._joint = made
    return found


def test_what_a_joint_visit_disproves_is_an_alarm_when_it_ends() -> None:
    made, alarms, ready = joint_visits(1e-3, first=0)
    results = (
        CycleResult("A", _CALIBRATED, "calibrated", new=3),
        CycleResult("B", CalibrationOutcome.NOT_PROVEN, "unchanged: x", verdict=Verdict.STUCK),
        CycleResult("C", CalibrationOutcome.NOT_PROVEN, "unchanged: x", verdict=Verdict.CLOUD),
    )

    async def run(*_: object) -> tuple[CycleResult, ...]:
        return results

    made.cycle.run = run  # type: ignore[method-assign]
    done = list[str]()
    errors = iter((np.arange(6.0), np.arange(6.0, 12.0)))
    calibrating = calibrating_of(made, lambda *_, **__: None, done, lambda: next(errors))
    calibrating.ask_together(("A", "B", "C"), "left")
    assert asyncio.run(calibrating.visit("left", ready, ENGINEER, 1)) == ("A", "B", "C")
    assert list(errors) == [], "the whole field, once before the visit and once after it"
    shown = [calibrating._last[name] for name in "ABC"]
    assert [entry.truth_before for entry in shown] == [0.0, 1.0, 2.0]
    assert [entry.truth_after for entry in shown] == pytest.approx(
        [6.0, np.nan, np.nan], nan_ok=True
    )
    assert alarms.active() == [("B", True)]
    assert made.alone(ready).tolist() == [False, True, False, False, False, False]
    assert done == ["A", "B"], "a cloud is no failure of a mirror"


def test_a_joint_visit_that_is_refused_is_one_event_and_not_one_of_each() -> None:
    made, _, ready = joint_visits(1e-3, first=0)

    async def run(*_: object) -> tuple[CycleResult, ...]:
        raise refusals.OTHER_AUTHORITY.error(holder="Egon", person="automatic control")

    made.cycle.run = run  # type: ignore[method-assign]
    made._plant.sentinel = SimpleNamespace(on=True)  # type: ignore[assignment]
    made._plant.authority = SimpleNamespace(grant=None)  # type: ignore[assignment]
    noted, done = list[tuple[str, ...]](), list[str]()
    calibrating = calibrating_of(made, lambda *words, **_: noted.append(words), done)
    calibrating.ask_together(("A", "B", "C"), "left")
    assert asyncio.run(calibrating.visit("left", ready, ENGINEER, 1)) == ("A", "B", "C")
    text = (
        "joint visit: the beams of 0 of 3 heliostats were identified together; command authority: "
        "Egon has it, so the order of automatic control was not sent; take command first"
    )
    assert noted == [("calibration", "left", text)]
    assert not done, "no heliostat is to blame"


def test_persons_wait_until_all_are_ready_and_can_withdraw() -> None:
    made, _, ready = joint_visits(1e-3, first=0)
    made.requests.ask(("A", "C", "E"), "left")
    ready[2] = False
    assert made.requests.next("left", ready) == ()
    ready[2] = True
    assert made.requests.next("right", ready) == ()
    made.requests.withdraw(("C",))
    assert made.requests.next("left", ready) == ("A", "E")
    assert made.requests.asked == ()
