"""Places of beams in a joint visit, and who drops out: refused, disobedient, or not there."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.layouts import malan_plant
from heliotrope.field.target import Target
from heliotrope.geometry import direction
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.mechanism.drives import SLOTS
from heliotrope.plant import refusals
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.motion.proofs import BeamError
from heliotrope.plant.orders.authority import Mandate, Person, Role
from heliotrope.plant.visits.coded_layout import SentBeam, beams_of, coded
from heliotrope.plant.visits.coded_visit import CodedVisit
from heliotrope.plant.visits.joint_layout import _places, _too_bright
from heliotrope.plant.visits.visit import ARRIVED, SILENT

NAMES = ("A", "B", "C")


class Member:
    """One that takes part, tracks, and is as far from its aim as it is told."""

    state = states.TRACKING

    def __init__(self, row: int, left: float) -> None:
        self.row, self._left = row, left

    def left(self) -> float:
        return self._left

    def there(self) -> bool:
        return self._left < ARRIVED

    def note(self) -> None:
        pass


class Order:
    """A ticket that has ended."""

    name = "AIM"

    def __init__(self, waits: tuple[str, ...] = (), refusals: dict[str, str] | None = None) -> None:
        self.waits, self.refusals = waits, refusals or {}

    async def end(self, limit: float) -> bool:
        return not (self.waits or self.refusals)

    def waiting(self, names: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(name for name in names if name in self.waits)


def visit_of(clock: VirtualClock, left: dict[str, float]) -> Any:
    """A visit of a plant that reports a row of step counts each second."""
    found = object.__new__(CodedVisit)
    counted = SimpleNamespace(counted_at=np.zeros(len(NAMES)))

    def now() -> float:
        counted.counted_at[:] = np.floor(clock.monotonic())
        return clock.monotonic()

    found.plant = SimpleNamespace(clock=clock, now=now, field=counted)
    found.visits = {name: Member(row, left[name]) for row, name in enumerate(NAMES)}
    found.lost, found._away = {}, set()
    found.mandate = Mandate(Person("Egon", Role.ENGINEER), 1, "left", set(NAMES))
    return found


def play(left: dict[str, float], scene: Any) -> Any:
    async def main(clock: VirtualClock) -> Any:
        visit = visit_of(clock, left)
        await scene(visit, clock)
        return visit

    return run_virtual(main)


def test_the_order_is_given_again_without_those_that_it_is_refused_for() -> None:
    asked = []

    def order(names: tuple[str, ...]) -> Order:
        assert len(asked) < 3, "it is asked for ever"
        asked.append(names)
        if "B" in names:
            raise BeamError("AIM", {"B": "its beam enters the walkway"})
        return Order()

    async def scene(visit: Any, _: VirtualClock) -> None:
        await visit._obeyed("AIM", order, NAMES, 60.0)

    visit = play(dict.fromkeys(NAMES, 0.0), scene)
    assert asked == [NAMES, ("A", "C")]
    assert visit.names == ("A", "C")
    assert visit.lost == {"B": "AIM B: its beam enters the walkway"}


def test_a_refusal_that_names_none_of_them_ends_the_visit() -> None:
    def order(names: tuple[str, ...]) -> Order:
        raise BeamError("AIM", {"X": "another's"})

    async def scene(visit: Any, _: VirtualClock) -> None:
        with pytest.raises(BeamError, match="another's"):
            await visit._obeyed("AIM", order, NAMES, 60.0)

    assert play(dict.fromkeys(NAMES, 0.0), scene).names == NAMES


def test_who_does_not_obey_in_time_drops_out_with_the_reason() -> None:
    async def scene(visit: Any, _: VirtualClock) -> None:
        await visit._obeyed("AIM", lambda _: Order(("A",), {"C": "not in this state"}), NAMES, 60.0)

    visit = play(dict.fromkeys(NAMES, 0.0), scene)
    assert visit.names == ("B",)
    assert visit.lost == {
        "A": "AIM A: not done within 60 s",
        "C": "AIM C: not in this state",
    }


@pytest.mark.parametrize("accepted", [False, True])
def test_an_order_refused_for_a_reason_that_passes_is_given_again(accepted: bool) -> None:
    asked: list[tuple[str, ...]] = []

    async def scene(visit: Any, clock: VirtualClock) -> None:
        begin = clock.monotonic()

        def order(names: tuple[str, ...]) -> Order:
            asked.append(names)
            if "B" not in names or clock.monotonic() - begin > 3.0:
                return Order()
            wrong = {"B": refusals.STILL_MOVING.text}
            if not accepted:
                raise BeamError("IDLE", wrong)
            return Order((), wrong)

        await visit._obeyed("IDLE", order, NAMES, 60.0)

    visit = play(dict.fromkeys(NAMES, 0.0), scene)
    assert visit.names == NAMES
    assert asked[0] == NAMES
    assert asked[-1] == (("B",) if accepted else NAMES)


def test_a_reason_that_does_not_pass_in_time_ends_a_members_visit() -> None:
    took = []

    async def scene(visit: Any, clock: VirtualClock) -> None:
        begin = clock.monotonic()

        def order(names: tuple[str, ...]) -> Order:
            return Order((), {"B": refusals.PLACE_UNKNOWN.text} if "B" in names else {})

        await visit._obeyed("IDLE", order, NAMES, 60.0)
        took.append(clock.monotonic() - begin)

    visit = play(dict.fromkeys(NAMES, 0.0), scene)
    assert visit.lost == {"B": f"IDLE B: {refusals.PLACE_UNKNOWN.text}"}
    assert SILENT <= took[0] < SILENT + 1.0


def test_two_rows_in_place_are_waited_for_and_who_is_not_there_by_then_drops_out() -> None:
    took = []

    async def scene(visit: Any, clock: VirtualClock) -> None:
        begin = clock.monotonic()
        await visit._arrived(10.0)
        took.append(clock.monotonic() - begin)

    visit = play({"A": 0.0, "B": 0.9 * ARRIVED, "C": 0.0}, scene)
    assert visit.names == NAMES
    assert 1.5 < took[0] <= 2.5, "one row may have been on its way before the order"
    visit = play({"A": 0.0, "B": 1.1 * ARRIVED, "C": 0.0}, scene)
    assert 10.0 <= took[1] < 11.0
    assert visit.lost == {"B": "B: not at its aim in fine steps within 10 s"}


def test_who_does_not_go_to_standby_at_the_end_is_taken_off_the_target() -> None:
    sent: list[tuple[str, ...]] = []

    async def scene(visit: Any, clock: VirtualClock) -> None:
        field, visit._away = visit.plant.field, set(NAMES)
        field.place, field.live = NAMES.index, lambda _: np.ones(len(NAMES), dtype=bool)
        field.rows = {"state": np.full(len(NAMES), states.TRACKING)}
        begin = clock.monotonic()

        def command(*given: Any) -> Order:
            moves = clock.monotonic() - begin < 3.0
            wrong = {"C": "not in this state"} | (
                {"B": refusals.STILL_MOVING.text} if moves else {}
            )
            return Order(("A",), {name: wrong[name] for name in given[-1] if name in wrong})

        visit.plant.command = command
        visit.plant.defocus = lambda _, names: sent.append(names)
        await visit.home()

    play(dict.fromkeys(NAMES, 0.0), scene)
    assert sent == [("A", "C")]


@pytest.mark.parametrize("before", [0.5, -0.5])
def test_only_a_mirror_before_the_plane_of_a_target_sends_its_beam_there(before: float) -> None:
    design = malan_plant(1)
    like, beams = design.targets[0], BeamCheck(design, design.names)
    center = beams.position[0] + 50.0 * like.axes[0] - before * like.normal
    target = Target("aside", like.corners - like.center + center, center)
    plant: Any = SimpleNamespace(
        field=SimpleNamespace(place=lambda _: 0),
        design=design,
        beams=beams,
        sun_vector=lambda: direction(np.radians(180.0), np.radians(60.0)),
    )
    name = design.names[0]
    sent, blocked = beams_of(plant, target, {name: 1e-3}, JointSettings())
    assert list(sent if before > 0.0 else blocked) == [name]
    assert blocked.get(name, "").endswith("" if before > 0.0 else "the front of aside")


@pytest.mark.parametrize(
    ("along", "sizes"), [(1, (0.025, 0.04, 0.025)), (None, (0.025, 0.12, 0.1))]
)
def test_a_coarse_mirror_moves_by_two_of_its_steps(
    along: int | None, sizes: tuple[float, ...]
) -> None:
    target = malan_plant(1).targets[0]
    steps = np.array([(0.0, 0.0), (0.06, 0.02), (0.05, 0.01)])
    known = {
        name: SentBeam(50.0, np.eye(2), np.eye(2), 1e-8, 1.0, step)
        for name, step in zip(NAMES, steps, strict=True)
    }
    layout = coded(target, known, np.zeros((3, 2)), np.arange(3), 5e-4, along)
    np.testing.assert_allclose(np.abs(layout.moves).max(axis=(0, 2)), sizes)


def test_a_mirror_with_steps_too_coarse_for_a_joint_visit_takes_no_part() -> None:
    design = malan_plant(1)
    target, beams = design.targets[0], BeamCheck(design, design.names)
    beams.machines.clear()
    plant: Any = SimpleNamespace(
        field=SimpleNamespace(place=lambda _: 0),
        design=design,
        beams=beams,
        sun_vector=lambda: direction(np.radians(80.0), np.radians(30.0)),
    )
    errors = {design.names[0]: 1e-3}
    assert list(beams_of(plant, target, errors, JointSettings())[0]) == [design.names[0]]
    beams.drives.table[0, :, SLOTS["rate"]] *= 200.0
    blocked = beams_of(plant, target, errors, JointSettings())[1]
    assert "its drives move its beam in steps of" in blocked[design.names[0]]


def test_beams_in_one_place_are_too_bright_wherever_it_is_and_those_apart_are_not() -> None:
    beam = SentBeam(50.0, np.eye(2), 0.04 * np.eye(2), 1e-8, 1.0, np.zeros(2))
    peak = 1.0 / (2.0 * np.pi * 0.04)
    known = dict.fromkeys(NAMES, beam)
    together = np.array([(-2.0, -1.5), (2.0, 1.0), (2.0, 1.0)])
    assert _too_bright(known, together, 2.1 * peak) == ""
    assert _too_bright(known, together, 1.9 * peak) == "B"
    apart = np.array([(-2.0, -1.0), (2.0, 1.0), (0.0, 0.0)])
    assert _too_bright(known, apart, 1.1 * peak) == ""


@pytest.mark.parametrize(("wide", "high"), [(12.0, 3.0), (3.0, 12.0), (6.0, 6.0)])
def test_beams_stand_in_a_grid_of_the_targets_shape(wide: float, high: float) -> None:
    target = malan_plant(1).targets[0]
    plane = target.plane_coordinates(target.corners)
    corners = 0.5 * np.array([wide, high]) * np.sign(plane)
    target = Target("wide", target.center + corners @ target.axes, target.center)
    beam = SentBeam(50.0, 1e-6 * np.eye(2), 1e-6 * np.eye(2), 1e-8, 1.0, np.zeros(2))
    places = _places(target, {str(number): beam for number in range(16)})
    columns, rows = (len(np.unique(np.round(places[:, k], 6))) for k in (0, 1))
    assert len(np.unique(np.round(places, 6), axis=0)) == 16
    assert columns * rows == 16
    assert columns / rows == pytest.approx(wide / high, rel=0.01)
    assert (np.abs(places) < 0.5 * np.array([wide, high])).all()
