"""The step counts of a visit at a photograph, between rows that are heard once a second."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import direction
from heliotrope.lcu.states import DEFOCUSED, TRACKING
from heliotrope.links.clock import VirtualClock, run_virtual, sleep_until
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.orders.authority import Mandate, Person, RefusedError, Role
from heliotrope.plant.visits.photographs import Plain, Shot, measured
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.plant.visits.swings import swung
from heliotrope.plant.visits.visit import Visit

DESIGN = malan_plant(1)
BEAMS = BeamCheck(DESIGN, DESIGN.names)
TARGET = DESIGN.targets[0]
SUN = direction(np.radians(80.0), np.radians(30.0))
#: The mirror stands on the middle of the target, and so do the counts of the rows.
POSE = BEAMS.poses(np.array([0]), TARGET.center[None], SUN).best_counts[0]
GOAL = 100_000


def visit(clock: VirtualClock) -> tuple[Visit, Any]:
    names = ("primary", "secondary", "primary_goal", "secondary_goal", "boots", "state")
    rows = np.zeros(1, [(name, float) for name in names])
    field = SimpleNamespace(place=lambda _: 0, rows=rows, counted_at=np.array([-np.inf]))
    plant = SimpleNamespace(
        field=field,
        now=clock.monotonic,
        clock=clock,
        beams=BEAMS,
        sun_vector=lambda _: SUN,
        stepping=SimpleNamespace(coarse=lambda *_: ()),
    )
    mandate = Mandate(Person("Egon", Role.ENGINEER), 1, "left", {DESIGN.names[0]})
    made = Visit(plant, mandate, DESIGN.names[0], DESIGN.targets[0])  # type: ignore[arg-type]
    return made, field


def hear(
    made: Visit, field: Any, at: float, off: float, *, turned: float = 0.0, state: int = TRACKING
) -> None:
    """Hear the axes at a time, the first ``off`` steps from its goal, which follows the sun."""
    goal = GOAL - 3.0 * at + turned
    field.rows[0] = (goal + off, GOAL, goal, GOAL, 1, state)
    field.counted_at[0] = at
    made.note()


def test_a_row_from_a_swing_is_left_out() -> None:
    async def main(clock: VirtualClock) -> None:
        made, field = visit(clock)
        for at, off in ((1.0, 0.0), (2.0, 0.0), (3.0, -40.0), (4.0, 0.0)):
            hear(made, field, at, off)
        np.testing.assert_allclose(await made.counts_at(2.5), (GOAL - 7.5, GOAL))

    run_virtual(main)


def test_a_row_from_where_it_is_turned_away_is_left_out() -> None:
    """Simulated run 2300036: a mirror that was turned away is at its goals again, elsewhere."""

    async def main(clock: VirtualClock) -> None:
        made, field = visit(clock)
        hear(made, field, 1.0, 0.0)
        hear(made, field, 2.0, 0.0)
        hear(made, field, 4.0, 0.0, turned=5000.0, state=DEFOCUSED)
        with pytest.raises(
            RefusedError, match="no report of its position at its aim within 10 s of the photo"
        ):
            await made.counts_at(2.5)

    run_virtual(main)


@pytest.mark.parametrize(("fall", "turn"), [(10.0, 0), (10.0, 1), (0.0, 0), (-10.0, 0)])
def test_a_photograph_is_less_sure_where_an_axis_may_have_taken_up_its_play(
    fall: float, turn: int
) -> None:
    """A goal that falls begins a swing, which the rows at the goals before and after it miss."""

    async def main(clock: VirtualClock) -> Shot:
        made, field = visit(clock)
        for at in (1.0, 2.0, 3.0, 4.0):
            here = POSE - (fall * np.eye(2)[turn] if at > 2.5 else 0.0)
            field.rows[0] = (*here, *here, 1, TRACKING)
            field.counted_at[0] = at
            made.note()
        for early in (1.5, 3.5):
            clear, _ = await measured(made, Shot(TARGET.center, early, 1e-4))
            np.testing.assert_array_equal(clear.covariance, 1e-4 * np.eye(3))
        return (await measured(made, Shot(TARGET.center, 2.5, 1e-4)))[0]

    wider = TARGET.axes @ (np.asarray(run_virtual(main).covariance) - 1e-4 * np.eye(3))
    spread = np.sqrt(np.clip(np.linalg.eigvalsh(wider @ TARGET.axes.T), 0.0, None))
    if fall <= 0.0:
        assert not spread.any()
        return
    # 40 steps of play turn the beam by 1.26 mrad at most; the deepest point is 2 deviations away.
    slant = float(np.linalg.norm(TARGET.center - DESIGN.position[0]))
    assert spread[0] < 0.05 * spread[1]
    assert 0.3e-3 * slant < spread[1] < 1.26e-3 * slant


def test_the_play_is_reckoned_under_the_sun_of_the_exposure() -> None:
    async def main(clock: VirtualClock) -> list[float]:
        made, field = visit(clock)
        suns: list[float] = []

        def sun(ahead: float) -> Any:
            suns.append(clock.monotonic() + ahead)
            return SUN

        plant: Any = made.plant
        plant.sun_vector = sun
        for at in (1.0, 2.0, 3.0, 4.0):
            here = POSE - (10.0 if at > 2.5 else 0.0)
            field.rows[0] = (*here, *here, 1, TRACKING)
            field.counted_at[0] = at
            made.note()
        shot, _ = await measured(made, Shot(TARGET.center, 2.5, 1e-4))
        assert np.trace(np.asarray(shot.covariance)) > 4e-4, "it may have been in a swing"
        return suns

    assert set(run_virtual(main)) == {2.5}


def test_plain_photographs_are_an_interval_apart() -> None:
    async def main(clock: VirtualClock) -> list[float]:
        made, field = visit(clock)
        hear(made, field, 0.0, 0.0)
        field.live = lambda _: np.array([True])
        taken: list[float] = []

        async def photograph(*_: object) -> Shot:
            taken.append(clock.monotonic())
            return Shot(TARGET.center, taken[-1], reasons=("a cloud",))

        camera: Any = SimpleNamespace(photograph=photograph)
        settings = CycleSettings(shots=3, interval=20.0)
        found = await Plain(camera, settings).take(made, lambda _: None)
        assert found.rejected == [f"photograph {k}: a cloud" for k in (1, 2, 3)]
        assert clock.monotonic() == taken[-1], "after the last it waits no more"
        return taken

    assert np.diff(run_virtual(main)) == pytest.approx([20.0, 20.0], abs=1.0)


def test_a_swing_is_as_likely_as_the_reports_leave_it() -> None:
    axis = DESIGN.machine(DESIGN.names[0]).axes[0]
    close, far = swung(axis, 10.0, 1.0), swung(axis, 10.0, 10.0)
    assert close == pytest.approx(10.0 * far)
    assert swung(axis, 30.0, 10.0) == pytest.approx(3.0 * far)
    assert swung(axis, 1e4, 10.0) < axis.backlash**2
    assert swung(replace(axis, backlash=0), 10.0, 1.0) == 0.0


def test_a_swing_that_is_heard_beside_a_photograph_is_one() -> None:
    """Simulated run 2600429: heard 40 steps away 0.03 s before, the photograph was 37 off."""
    axis = DESIGN.machine(DESIGN.names[0]).axes[0]
    far, heard = swung(axis, 10.0, 10.0), swung(axis, 10.0, 10.0, 0.03)
    assert 0.5 * axis.backlash < np.sqrt(heard) < axis.backlash
    assert heard > 2.0 * far
    assert swung(axis, 10.0, 10.0, 5.0) == far
    assert swung(axis, 0.0, 10.0, 0.03) == 0.0
    made, field = visit(VirtualClock())
    assert made.heard_moving(2.5) == np.inf
    for at, off in ((1.0, 0.0), (2.0, 0.0), (3.0, -40.0), (4.0, 0.0)):
        hear(made, field, at, off)
    assert made.heard_moving(2.9) == pytest.approx(0.1)


def test_a_mirror_has_not_arrived_before_it_takes_fine_steps() -> None:
    async def main(clock: VirtualClock) -> None:
        made, field = visit(clock)
        hear(made, field, 0.0, 0.0)
        plant: Any = made.plant
        begin = clock.monotonic()
        plant.stepping.coarse = lambda names, _: names if clock.monotonic() < begin + 4.0 else ()
        assert not made.there()
        await sleep_until(clock, clock.monotonic() + 5.0)
        assert made.there()

    run_virtual(main)


def test_two_rows_in_place_are_waited_for_before_a_mirror_has_arrived() -> None:
    """The first may have been on its way before the order."""

    async def main(clock: VirtualClock) -> float:
        made, field = visit(clock)
        hear(made, field, 0.0, 0.0)
        field.live = lambda _: np.array([True])
        plant: Any = made.plant

        def now() -> float:
            field.counted_at[:] = np.floor(clock.monotonic())
            return clock.monotonic()

        plant.now = now
        begin = clock.monotonic()
        await made.arrived(10.0)
        return clock.monotonic() - begin

    assert 1.5 < run_virtual(main) <= 2.5


@pytest.mark.parametrize(
    "heard", [((1.0, 0.0), (2.0, 0.0), (3.0, -40.0)), ((2.5, 0.0), (3.0, -40.0))]
)
def test_a_mirror_that_is_not_heard_at_its_aim_is_not_measured(
    heard: tuple[tuple[float, float], ...],
) -> None:
    """Nor is one that was heard there once only, even if that was at the very instant."""

    async def main(clock: VirtualClock) -> None:
        made, field = visit(clock)
        for at, off in heard:
            hear(made, field, at, off)
        with pytest.raises(
            RefusedError, match="no report of its position at its aim within 10 s of the photo"
        ):
            await made.counts_at(2.5)

    run_virtual(main)
