"""The step counts of a visit at a photograph, between rows that are heard once a second."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.field.layouts import malan_plant
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.authority import Person, RefusedError, Role
from heliotrope.plant.visits.visit import Visit

DESIGN = malan_plant(1)
GOAL = 100_000


def visit(clock: VirtualClock) -> tuple[Visit, Any]:
    names = ("primary", "secondary", "primary_goal", "secondary_goal")
    rows = np.zeros(1, [(name, float) for name in names])
    field = SimpleNamespace(place=lambda _: 0, rows=rows, counted_at=np.array([-np.inf]))
    drives = SimpleNamespace(table=DESIGN.drives.table)
    plant = SimpleNamespace(
        field=field, now=clock.monotonic, clock=clock, beams=SimpleNamespace(drives=drives)
    )
    person = Person("Egon", Role.ENGINEER)
    made = Visit(plant, person, 1, DESIGN.names[0], DESIGN.targets[0])  # type: ignore[arg-type]
    return made, field


def hear(made: Visit, field: Any, at: float, off: float) -> None:
    """Hear the axes at a time, the first ``off`` steps from its goal, which follows the sun."""
    goal = GOAL - 3.0 * at
    field.rows[0] = (goal + off, GOAL, goal, GOAL)
    field.counted_at[0] = at
    made.note()


def test_a_row_from_a_swing_is_left_out() -> None:
    async def main(clock: VirtualClock) -> None:
        made, field = visit(clock)
        for at, off in ((1.0, 0.0), (2.0, 0.0), (3.0, -40.0), (4.0, 0.0)):
            hear(made, field, at, off)
        np.testing.assert_allclose(await made.counts_at(2.5), (GOAL - 7.5, GOAL))

    run_virtual(main)


def test_a_mirror_that_is_not_heard_at_its_aim_is_not_measured() -> None:
    async def main(clock: VirtualClock) -> None:
        made, field = visit(clock)
        for at, off in ((1.0, 0.0), (2.0, 0.0), (3.0, -40.0)):
            hear(made, field, at, off)
        with pytest.raises(RefusedError, match="not heard at its aim within 10 s of the photo"):
            await made.counts_at(2.5)

    run_virtual(main)
