"""Receiver visits: mirrors measured where they shine, on the receiver, by small coded movements.

Mirrors drive, clusters poll and the plant commands as in operation; only the light is drawn by the
simulated camera, from where the mirrors truly stand.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.errors import InputError
from heliotrope.field import ReceiverSettings
from heliotrope.field.example import roughly_installed
from heliotrope.field.layout_tower import watching_camera
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import bisector, reflect
from heliotrope.imaging.coded import SeparatedBeam, Verdict
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.coded_visits import ReceiverVisits
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.operations.views import PictureRow
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.visits import CalibrationCycle, Centring, CycleResult, Unhidden
from heliotrope.plant.visits.receiver_cycle import ReceiverCycle
from heliotrope.plant.visits.receiver_layout import caught
from heliotrope.plant.visits.target_light import judged
from heliotrope.plant.workers import at_once
from support.live import LiveOptions, LivePlant
from support.visit_scene import CYCLE, ENGINEER, START, VisitScene, believe, in_command

OPERATOR = Person("Olga", Role.OPERATOR)
VERA = Person("Vera", Role.ENGINEER)


def design_of(count: int, **chosen: float) -> Plant:
    """A plant whose receiver is seen by a camera."""
    plain = malan_plant(count)
    face = plain.receivers[0].face
    # Far above the ground the camera would look along the aperture: it stands in front of it.
    camera = replace(watching_camera(face, "eye", 120.0, 30.0, 10.0), targets=("left",))
    settings = ReceiverSettings("eye", face.name, **{"power": 0.01} | chosen)  # type: ignore[arg-type]
    return replace(plain, cameras=(*plain.cameras, camera), receiver_visits=settings)


@dataclass(kw_only=True)
class Scene(VisitScene):
    """A plant whose heliostats track the receiver, and an engineer in command."""

    cycle: ReceiverCycle

    @property
    def face(self) -> Target:
        return self.live.design.receivers[0].face

    async def run(self, *names: str) -> dict[str, CycleResult]:
        found = await self.cycle.run(
            ENGINEER, self.token, names or self.names, "receiver", self.tell
        )
        return {result.heliostat: result for result in found}

    async def until(self, what: Callable[[], bool], limit: float = 600.0) -> None:
        end = self.live.clock.monotonic() + limit
        while not what():
            assert self.live.clock.monotonic() < end, self.states()
            await asyncio.sleep(0.5)

    def tracking(self) -> bool:
        field_, now = self.live.plant.field, self.live.plant.now()
        return bool(field_.among((states.TRACKING,), now).all())


def production(
    scene: Callable[[Scene], Awaitable[None]],
    count: int = 6,
    *,
    rendered: bool = False,
    least: int = 8,
    pictures: Pictures | None = None,
) -> None:
    """Play a scene in virtual time: the beams stand about the middle of the receiver."""

    async def main(clock: VirtualClock) -> None:
        options = LiveOptions(
            rendered=rendered,
            threads=0,
            installed=partial(roughly_installed, seed=3, scale=0.03),
            work=AutomaticSettings(wanted=True, calibrate=False),
            cycle=CYCLE,
        )
        live = LivePlant(design_of(count, least=least), clock, options, pictures=pictures)
        plant = live.plant
        async with live.running():
            try:
                unhidden = Unhidden(plant, at_once)
                whole = CalibrationCycle(plant, live.cameras, CYCLE, Centring(), unhidden)
                assert live.design.receiver_visits is not None
                cycle = ReceiverCycle(plant, live.cameras, whole, live.design.receiver_visits)
                here = Scene(live=live, token=0, cycle=cycle)
                await here.until(here.tracking)
                await live.operations.automatic.halt()
                believe(live, 3e-4)
                here.token = plant.take_authority(ENGINEER).token
                await in_command(here, lambda: _aimed(here, scene))
            finally:
                await live.operations.automatic.halt()
                await live.end()

    run_virtual(main, start=START)


async def _aimed(made: Scene, scene: Callable[[Scene], Awaitable[None]]) -> None:
    turn = 2.0 * np.pi * np.arange(len(made.names)) / len(made.names)
    places = 1.5 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    aims = dict(zip(made.names, made.face.point(places), strict=True))
    await asyncio.sleep(3.0)  # the clusters hear of the command authority
    ticket = made.live.plant.aim(ENGINEER, made.token, aims)
    assert await ticket.end(60.0), ticket.text
    await asyncio.sleep(20.0)
    await scene(made)


def test_mirrors_in_production_are_calibrated_where_they_shine() -> None:
    async def scene(here: Scene) -> None:
        plant = here.live.plant
        aims, before = plant.aims.copy(), here.live.errors()
        lowest = [1.0]
        flux = here.live.world.flux
        assert flux is not None
        full = flux.share()
        here.during = lambda stage: (
            lowest.append(flux.share() / full) if stage.startswith("photograph") else None
        )
        results = await here.run()
        assert here.photographs() == 16, "six mirrors, each with a code of its own"
        others = [stage for stage in here.stages if not stage.startswith("photograph")]
        assert others == [
            "checking that the sun is steady",
            "back to the aims",
            "separating the beams",
            "learning from 6 proven beams",
        ]
        assert min(lowest) > 0.99, "the beams stay on the receiver"
        for name, result in results.items():
            assert result.verdict is None, result
            assert result.new == 1, result
            seen, row = plant.beliefs.known(name), here.live.names.index(name)
            assert seen is not None
            assert seen.targets == ("receiver",)
            true = here.live.truth[np.array([row])]
            assert beam_errors(true, seen.sightings).beam[0] < 0.5e-3, "what it saw is true"
        changed = [r.outcome is CalibrationOutcome.CALIBRATED for r in results.values()]
        assert any(changed)
        await here.until(here.tracking)
        np.testing.assert_array_equal(plant.aims, aims)
        assert not plant.movements.names
        await asyncio.sleep(20.0)
        after = here.live.errors()
        assert np.median(after[changed]) < np.median(before[changed])

    production(scene)


def spoil(scene: Scene, stuck: str = "", traded: tuple[str, ...] = (), cloudy: str = "") -> None:
    """From the first photograph on a mirror stands still, two send their beams crosswise.

    A cloud stands over a fourth one all the time: none of its light comes.
    """
    live, face = scene.live, scene.face
    true, held = live.field.stand, {}
    aims = live.plant.aims.copy()

    def stand() -> tuple[np.ndarray, np.ndarray]:
        normals, vertices = (np.array(each) for each in true())
        if cloudy:
            normals[live.names.index(cloudy)] = (0.0, 0.0, -1.0)
        if scene.photographs():
            light = live.world.sun()
            if stuck:
                row = live.names.index(stuck)
                normals[row] = held.setdefault(stuck, normals[row].copy())
            rows = [live.names.index(name) for name in traded]
            points = face.intersect(vertices, reflect(light, normals))
            places = [live.plant.field.place(name) for name in traded]
            for row, mine, other in zip(rows, places, places[::-1], strict=True):
                there = points[row] + aims[other] - aims[mine]
                way = there - vertices[row]
                normals[row] = bisector(light, way / np.linalg.norm(way))
        return normals, vertices

    live.field.stand = stand  # type: ignore[method-assign]


def test_drawn_photographs_prove_nothing_of_a_stuck_mirror_or_an_exchanged_pair() -> None:
    async def scene(here: Scene) -> None:
        plant = here.live.plant
        stuck, one, other, shaded = (here.names[i] for i in (1, 2, 5, 6))
        spoil(here, stuck, (one, other), shaded)
        version = {name: plant.beliefs.record(name) for name in here.names}
        results = await here.run()
        bad = {name: r.verdict for name, r in results.items() if r.verdict is not None}
        assert bad == {
            stuck: Verdict.FAINT,
            one: Verdict.EXCHANGED,
            other: Verdict.EXCHANGED,
            shaded: Verdict.FAINT,
        }, results
        assert f"({other})" in results[one].text
        for name in bad:
            assert results[name].outcome is CalibrationOutcome.NOT_PROVEN
            assert plant.beliefs.record(name) is version[name], "nothing is pushed"
            assert plant.beliefs.known(name) is None
        good = [r for name, r in results.items() if name not in bad]
        assert all(r.new == 1 for r in good), results

    production(scene, 7, rendered=True)


def test_an_emergency_another_person_or_a_cloud_ends_it_with_the_aims_as_they_were() -> None:
    async def scene(here: Scene) -> None:
        plant, camera = here.live.plant, here.live.cameras
        aims = plant.aims.copy()

        # Another person takes the command authority: the visit goes on, and the beams go back.
        def at_fourth(act: Callable[[], object]) -> Callable[[str], None]:
            return lambda stage: act() and None if stage.startswith("photograph 4 ") else None

        def handed_over() -> None:
            assert np.abs(plant.aims - aims).max() > 0.05, "the beams are beside their aims"
            plant.release_authority(ENGINEER, here.token)
            plant.take_authority(OPERATOR)

        here.during = at_fourth(handed_over)
        results = await here.run()
        assert {r.new for r in results.values()} == {1}, results
        await here.until(lambda: not plant.movements.names, 30.0)
        np.testing.assert_array_equal(plant.aims, aims)
        assert here.tracking(), "production goes on"
        assert plant.authority.grant is None, "Olga has gone, and it went on"
        here.token = plant.take_authority(ENGINEER).token
        await asyncio.sleep(3.0)

        # A cancelled task: nobody waits, the plant takes the beams back.
        here.stages.clear()
        here.during = lambda _: None
        task = asyncio.create_task(here.run())
        await here.until(lambda: here.photographs() >= 3)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await here.until(lambda: not plant.movements.names, 30.0)
        np.testing.assert_array_equal(plant.aims, aims)

        # A cloud over the whole field.
        here.stages.clear()
        real = camera.light

        async def clouded(*given: object) -> object:
            seen = await real(*given)  # type: ignore[arg-type]
            shade = 0.3 if here.photographs() > 5 else 1.0
            return replace(seen, values=seen.values * shade)

        camera.light = clouded  # type: ignore[method-assign, assignment]
        results = await here.run()
        assert {r.verdict for r in results.values()} == {Verdict.CLOUD}
        camera.light = real  # type: ignore[method-assign]

        # An emergency in the middle of a movement goes before everything.
        here.stages.clear()
        here.during = at_fourth(lambda: plant.raise_emergency("anybody"))
        with pytest.raises(RefusedError, match="emergency"):
            await here.run()
        await asyncio.sleep(10.0)
        assert set(here.states().values()) == {"DEFOCUSED"}
        assert plant.movements.names, "no order follows an emergency"
        (call,) = plant.sentinel.calls
        plant.withdraw_emergency(ENGINEER, call.who)
        await asyncio.sleep(4.0)
        plant.acknowledge(ENGINEER, "operator_emergency")
        await here.until(lambda: not plant.movements.names, 60.0)
        np.testing.assert_array_equal(plant.aims, aims)
        left = set(here.states().values())
        assert left <= {"DEFOCUSED", "STOWING", "STOWED"}, "nothing returns by itself after it"
        assert {plant.beliefs.count(name) for name in here.names} == {1}, "of the first visit only"

    production(scene)


def test_a_persons_order_takes_one_out_of_production_and_the_others_go_on() -> None:
    async def scene(here: Scene) -> None:
        plant, (gone, *others) = here.live.plant, here.names
        aims = plant.aims.copy()
        begun = list[str]()

        def stowed(stage: str) -> None:
            if stage.startswith("photograph 3 ") and not begun:
                begun.append(stage)
                plant.seize_authority(VERA, "measured enough")
                plant.stow("Vera", (gone,))

        here.during = stowed
        results = await here.run()
        assert results[gone].outcome is CalibrationOutcome.TAKEN_OUT
        assert "it dropped out of the visit: Vera ordered STOW" in results[gone].text
        # A sixth of the light has gone with it, and stays away: the turn has begun anew.
        assert {results[name].new for name in others} == {1}, results
        await here.until(lambda: here.states()[gone] == "STOWED")
        await here.until(lambda: not plant.movements.names and not plant.locks.names, 60.0)
        assert {here.states()[name] for name in others} == {"TRACKING"}
        np.testing.assert_array_equal(plant.aims, aims)

    production(scene)


def test_an_emergency_while_parameters_are_written_leaves_none_locked() -> None:
    async def scene(here: Scene) -> None:
        plant = here.live.plant
        visit = asyncio.create_task(here.run())

        def locked() -> bool:
            return bool(plant.field.among((states.LOCKED,), plant.now()).any())

        await here.until(lambda: locked() or visit.done())
        assert not visit.done(), "some mirror is locked"
        plant.raise_emergency("Vera")
        await visit
        await asyncio.sleep(150.0)
        report = plant.sentinel.order.report(plant.now()) if plant.sentinel.order else None
        assert report is not None
        assert report.complete, report.text
        (call,) = plant.sentinel.calls
        plant.withdraw_emergency(ENGINEER, call.who)
        await asyncio.sleep(4.0)
        plant.acknowledge(ENGINEER, "operator_emergency")
        await here.until(lambda: set(here.states().values()) == {"STOWED"}, 120.0)
        await here.until(lambda: not plant.movements.names and not plant.locks.names, 60.0)

    production(scene)


def test_a_movement_is_refused_that_leaves_the_receiver_or_its_neighbourhood() -> None:
    async def scene(here: Scene) -> None:
        plant, face = here.live.plant, here.face
        name = here.names[0]
        row = plant.field.place(name)
        aim = plant.aims[row].copy()
        beside = {name: aim + 0.6 * face.axes[0]}
        with pytest.raises(BeamError, match="a movement is limited to 3 mrad"):
            plant.commands.move(ENGINEER, here.token, beside)
        small = aim + 0.1 * face.axes[0]
        stowed = here.names[1]
        assert await plant.stow("Vera", (stowed,)).end(300.0)
        with pytest.raises(BeamError, match="it does not track the receiver"):
            plant.commands.move(ENGINEER, here.token, {stowed: small})
        assert await plant.commands.move(ENGINEER, here.token, {name: small}).end(30.0)
        np.testing.assert_array_equal(plant.aims[row], small)
        # A new aim of a person is not undone.
        other = face.point((0.5, 0.5))
        assert await plant.aim(ENGINEER, here.token, {name: other}).end(30.0)
        assert not plant.movements.names
        # Nobody renews the movement: after a while the beam goes back.
        assert await plant.commands.move(
            ENGINEER, here.token, {name: other + 0.1 * face.axes[1]}
        ).end(30.0)
        await here.until(lambda: not plant.movements.names, 200.0)
        np.testing.assert_array_equal(plant.aims[row], other)
        edge = face.point((3.45, 0.0))
        assert await plant.aim(ENGINEER, here.token, {name: edge}).end(30.0)
        with pytest.raises(BeamError, match="not on a flat receiver"):
            plant.commands.move(ENGINEER, here.token, {name: face.point((3.55, 0.0))})
        results = await here.run(name, stowed)
        assert "inside the edge of receiver" in results[name].text
        assert "does not track receiver" in results[stowed].text

    production(scene, 2)


def test_automatic_control_measures_those_that_track_the_receiver(tmp_path: Path) -> None:
    pictures = Pictures(tmp_path)

    async def scene(here: Scene) -> None:
        plant, operations, names = here.live.plant, here.live.operations, here.names
        plant.release_authority(ENGINEER, here.token)
        operations.automatic.want(names, wanted=True)
        operations.automatic.switch(on=True)
        await here.until(lambda: operations.automatic.view().on)
        operations.calibrate(ENGINEER, names[4], together=names[2:4], receiver=True)
        assert operations.automatic.view().asked == (names[4], *names[2:4])
        with pytest.raises(RefusedError, match="neither searches for a beam"):
            operations.calibrate(ENGINEER, names[0], search=True, receiver=True)
        seen: set[str] = set()

        def told() -> list[str]:
            for one in operations.automatic.view().running:
                if one.target == "receiver":
                    seen.update(one.heliostats)
            events = here.live.assembly.logbook.events(100)
            return [e.text for e in events if e.who == "receiver"]

        await here.until(lambda: len(told()) > 0)
        assert seen == set(names[2:5]), "what a person asked for comes first"
        assert told() == ["receiver visit: the beams of 3 of 3 heliostats were identified together"]
        # The others are measured by themselves; who was measured already waits for its time.
        await here.until(lambda: len(told()) > 1, 1200.0)
        assert all(plant.beliefs.count(name) for name in names)
        operations.automatic.switch(on=False)
        # The prediction hears how long they took.
        schedule = here.live.assembly.schedule
        assert schedule is not None
        first = schedule.scheduler.receiver_visits[0]
        assert (first.mirrors, first.lit) == (3, len(names))
        assert 20.0 < first.seconds < 300.0
        # The last photographs are kept once; each of the heliostats finds them with its own result.
        kept: list[list[PictureRow]] = []
        for name in names[2:5]:
            pictures.find(name, 100, kept.append)  # type: ignore[arg-type]
        one, *others = ([row for row in rows if row.target == "receiver"] for rows in kept)
        assert len(one) >= 8
        assert {(row.heliostat, row.outcome, row.used) for row in one} == {
            (names[2], "calibrated", True)
        }
        assert all({r.identity for r in rows} >= {r.identity for r in one} for rows in others)

    production(scene, least=1, pictures=pictures)


class Rows(SimpleNamespace):
    """A field of six."""

    def __len__(self) -> int:
        return 6


def chooser(error: float = 1e-3, **chosen: float) -> tuple[ReceiverVisits, SimpleNamespace]:
    """Six heliostats that track the receiver, and the plant's clock."""
    names = tuple("ABCDEF")
    face = malan_plant(1).receivers[0].face
    clock = SimpleNamespace(at=1000.0)
    everyone = np.ones(6, dtype=np.bool_)
    plant = SimpleNamespace(
        field=Rows(names=names, place=names.index, among=lambda *_: everyone),
        aims=np.tile(face.center, (6, 1)),
        now=lambda: clock.at,
    )
    settings = ReceiverSettings("eye", "receiver", **({"most": 4, "least": 2} | chosen))  # type: ignore[arg-type]
    cycle = SimpleNamespace(settings=settings, face=lambda name: face)
    book = SimpleNamespace(error=np.full(6, error))
    made = ReceiverVisits(plant, book, cycle, lambda alarm: None)  # type: ignore[arg-type]
    return made, clock


def told(name: str, verdict: Verdict | None = None, new: int = 1) -> CycleResult:
    return CycleResult(name, CalibrationOutcome.UNCHANGED, "x", new=new, verdict=verdict)


def test_those_whose_errors_may_be_largest_are_measured_first_and_then_wait() -> None:
    made, clock = chooser()
    ready = np.ones(6, dtype=np.bool_)
    made._book.error[[2, 5]] = 1.4e-3
    made._book.error[0] = np.nan
    assert made.chosen(ready) == ("C", "F", "B", "D")
    made._book.error[1] = 1.6e-3  # its beam may be off by more than three quarters of 4 mrad
    assert made.chosen(ready) == ("C", "F", "D", "E")
    assert made.concluded([told(n) for n in "CFDE"]) == ()
    assert made.chosen(ready) == ()
    clock.at += 7200.0
    assert len(made.chosen(ready)) == 4
    ready[2:] = False
    made.requests.ask(("A", "F"), "")
    assert made.chosen(ready) == (), "persons wait until all of them track the receiver"
    ready[5] = True
    assert made.chosen(ready) == ("A", "F")
    assert made.requests.asked == ()
    made.requests.ask(("A", "B"), "")
    made.requests.withdraw(("B",))
    assert made.requests.asked == ("A",)


def test_one_that_is_refused_again_and_again_goes_to_a_target() -> None:
    made, clock = chooser()
    ready = np.ones(6, dtype=np.bool_)
    no_report = CycleResult("D", CalibrationOutcome.REFUSED, "no report shows where it is now")
    visit = [told("A"), told("B"), told("C"), no_report]
    for _ in range(2):
        assert made.concluded(visit) == ()
        clock.at += 7200.0
        assert "D" in made.chosen(ready)
    (retry,) = made.mirrors.shown(clock.at)
    assert (retry.subject, retry.count, retry.reason) == ("D", 2, no_report.text)
    assert made.concluded(visit) == ("D",)
    clock.at += 7200.0
    assert "D" not in made.chosen(ready)
    clock.at += 86_400.0
    assert "D" in made.chosen(ready)
    assert made.concluded([told(name) for name in "ABCD"]) == ()
    assert not made.mirrors.counts
    # A visit that measures nobody is not the mirror's failure.
    assert made.concluded([replace(no_report, heliostat=name) for name in "ABCD"]) == ()
    assert not made.mirrors.counts


def test_the_odd_ones_go_to_a_target_unless_the_light_is_to_blame() -> None:
    made, clock = chooser()
    odd = [told("A"), told("B"), told("C", Verdict.FAINT, 0), told("D", Verdict.EXCHANGED, 0)]
    assert made.concluded(odd) == ("C", "D")
    surprise = CycleResult("E", CalibrationOutcome.NOT_VERIFIED, "x")
    assert made.concluded([told("A"), surprise]) == ("E",)
    clock.at += 7200.0
    assert made.concluded([told("A"), *(told(n, Verdict.FAINT, 0) for n in "BCD")]) == ()
    made, clock = chooser()
    ready = np.ones(6, dtype=np.bool_)
    assert made.concluded([told(n, Verdict.CLOUD, 0) for n in "ABCD"]) == ()
    assert made.chosen(ready) == (), "it is tried again after ten minutes"
    clock.at += 600.0
    assert len(made.chosen(ready)) == 4


def test_a_beam_too_bright_or_too_dim_for_its_mirror_is_joined_with_other_light() -> None:
    def beam(name: str, power: float, verdict: Verdict = Verdict.PROVEN) -> SeparatedBeam:
        at = np.zeros(2)
        return SeparatedBeam(name, verdict, at, np.eye(2), np.eye(2), power, np.nan, np.nan)

    powers = np.array([1.0, 1.0, 2.0, 1.0, 1.0])
    seen = [beam("A", 5.0), beam("B", 5.2), beam("C", 9.9), beam("D", 9.0)]
    found = judged([*seen, beam("E", 0.0, Verdict.FAINT)], powers)
    proven = Verdict.PROVEN
    verdicts = [proven, proven, proven, Verdict.JOINED, Verdict.FAINT]
    assert [b.verdict for b in found] == verdicts
    assert found[2].gain == pytest.approx(4.95 / 5.1)
    dim = judged([*seen[:3], beam("D", 2.0)], powers[:4])
    assert dim[3].verdict is Verdict.JOINED


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"least": 9, "most": 8}, "least 9 is above most 8; least must be the smaller"),
        ({"movement": 0.003}, "movement_mrad .coded.* above 0 and at most 2, not 3$"),
        ({"power": 0.02}, "power .* must be above 0 and at most 0.01, not 0.02$"),
        ({"known": 0.0}, "known_mrad .* must be above 0 and at most 20, not 0$"),
        ({"steady": 0.9}, "steady .* must be above 0 and at most 0.5, not 0.9$"),
        ({"again": 0.5}, "again .* must be between 1 and 10, not 0.5$"),
        ({"visit": -1e-3}, "visit_mrad .* must be 0 or more, not -1$"),
        ({"settle": float("nan")}, "settle_s .* must be between 0 and 60, not nan$"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, float], said: str) -> None:
    with pytest.raises(InputError, match=said):
        ReceiverSettings("eye", "receiver", **wrong)  # type: ignore[arg-type]


def test_a_plant_refuses_receiver_visits_without_a_camera_or_a_face() -> None:
    whole = design_of(2)
    unplaced = tuple(replace(c, position=None, R_enu_camera=None) for c in whole.cameras)
    with pytest.raises(InputError, match="its position is unknown"):
        replace(whole, cameras=unplaced)
    around = replace(whole.receivers[0], kind="external_cylinder")
    with pytest.raises(InputError, match="only planar receivers have one"):
        replace(whole, receivers=(around,))
    face = replace(whole.receivers[0], corners=None).face
    np.testing.assert_allclose(face.corners, whole.receivers[0].face.corners, atol=1e-9)


def test_a_face_catches_half_of_a_beam_on_its_edge_and_nothing_of_one_beside_it() -> None:
    face = malan_plant(1).receivers[0].face
    corners = face.plane_coordinates(face.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, narrow = 0.5 * (low + high), 1e-4 * np.eye(2)
    assert caught(face, middle, narrow) == pytest.approx(1.0)
    assert caught(face, high, narrow) == pytest.approx(0.25)
    for edge, out in ((low, -1.0), (high, 1.0)):
        for k in range(2):
            place = middle.copy()
            place[k] = edge[k]
            assert caught(face, place, narrow) == pytest.approx(0.5)
            place[k] += out
            assert caught(face, place, narrow) == pytest.approx(0.0, abs=1e-9)
