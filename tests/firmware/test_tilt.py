"""The accelerometer: a LIS3DH by its registers."""

import math
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from support.board_chips import Lis3dh, World, board_path

MRAD = 1e-3


def gravity(pitch: float, roll: float = 0.0) -> tuple[float, float, float]:
    """What the chip feels at rest, in g, after a turn about x and one about y."""
    return (
        -math.sin(roll),
        math.cos(roll) * math.sin(pitch),
        math.cos(roll) * math.cos(pitch),
    )


class Bench:
    """A chip and its driver."""

    def __init__(self, **chip: Any) -> None:
        self.world = World()
        with board_path("rp2", self.world) as load:
            module: ModuleType = load("tilt")
        self.chip = type("Chip", (Lis3dh,), {"world": self.world, **chip})()
        self.sensor = module.Lis3dh(self.chip)

    def read(self, wait_ms: float = 500.0) -> tuple[float, float] | None:
        self.world.advance(1000.0 * wait_ms)
        found: tuple[float, float] | None = self.sensor.read()
        return found


@pytest.mark.parametrize(
    ("pitch", "roll"), [(0.0, 0.0), (1.5, 0.0), (-0.3, 0.2), (0.7, -1.0), (math.pi / 2, 0.0)]
)
def test_a_turn_is_measured_to_a_third_of_a_milliradian(pitch: float, roll: float) -> None:
    bench = Bench()
    found = []
    for nudge in (0.0, 0.02):
        bench.chip.gravity = gravity(pitch + nudge, roll)
        found.append(bench.read())
    np.testing.assert_allclose(found[0], (pitch, roll), atol=1.0 * MRAD)
    # The scatter of one reading is 0.7 mg: the mean of 32 has a sixth of it.
    np.testing.assert_allclose(np.subtract(found[1], found[0]), (0.02, 0.0), atol=0.8 * MRAD)


def test_nothing_is_measured_without_a_chip_or_by_another_one() -> None:
    assert Bench(there=False).read() is None
    assert Bench(identity=0x32).read() is None


def test_no_reading_is_made_of_nothing_or_of_a_shake() -> None:
    bench = Bench()
    assert bench.read(0.0) is None  # no measurement is there yet
    assert bench.read() is not None
    bench.chip.gravity = (0.6, 0.0, 1.0)
    assert bench.read() is None


def test_a_chip_that_lost_its_supply_is_set_up_anew() -> None:
    bench = Bench()
    assert bench.read() is not None
    bench.chip.there = False
    assert bench.read() is None
    bench.chip.there = True
    bench.chip.registers = {0x0F: 0x33, 0x20: 0x07}
    assert bench.read() is None  # set up by this call
    assert bench.read() is not None
