"""Points of a receiver by their place on its unrolled surface."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.target import Receiver

CENTER, SOUTH = [1.0, 2.0, 50.0], [0.0, -1.0, 0.0]


def test_on_a_plate_right_is_that_of_who_stands_before_it() -> None:
    # Whoever looks north at a face that looks south has east on the right.
    plate = Receiver("r", "planar", CENTER, SOUTH, 6.0, 4.0)
    assert plate.point(1.5, -2.0) == pytest.approx([2.5, 2.0, 48.0])


def test_around_a_cylinder_a_quarter_of_its_turn_is_a_quarter_turn() -> None:
    drum = Receiver("r", "external_cylinder", CENTER, SOUTH, 8.0, 10.0)
    assert drum.point(0.0, 5.0) == pytest.approx([1.0, -2.0, 55.0])
    assert drum.point(0.5 * np.pi * 4.0, 0.0) == pytest.approx([5.0, 2.0, 50.0])
    up = Receiver("r", "external_cylinder", CENTER, [0.0, 0.0, 1.0], 8.0, 10.0)
    assert up.point(0.0, 0.0) == pytest.approx([1.0, 6.0, 50.0])


def test_on_a_sector_the_middle_is_its_centre() -> None:
    sector = Receiver(
        "r", "convex_cylinder", CENTER, SOUTH, 6.0, 4.0, radius=3.0, opening_angle=np.pi
    )
    assert sector.point(0.0, 0.0) == pytest.approx(CENTER)
    # At its right edge, a quarter turn on, it looks east.
    assert sector.point(1.5 * np.pi, 1.0) == pytest.approx([4.0, 5.0, 51.0])


@pytest.mark.parametrize(("right", "up"), [(3.1, 0.0), (0.0, -2.1), (float("nan"), 0.0)])
def test_beside_it_is_refused(right: float, up: float) -> None:
    plate = Receiver("r", "planar", CENTER, SOUTH, 6.0, 4.0)
    with pytest.raises(
        InputError, match=r"receiver r: a point .* is outside its surface; use at most"
    ):
        plate.point(right, up)
