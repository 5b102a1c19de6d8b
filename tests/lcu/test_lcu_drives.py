"""Drives of a local controller: the same angles and steps as the mechanism's drives."""

import math

import numpy as np
import pytest

from heliotrope.lcu import drives
from heliotrope.mechanism.drives import Drive, linear_paint, rotary
from support.lcu_machines import numbers_of, single
from support.machines import jacks, steppers


def every_drive() -> dict[str, tuple[Drive, int, int]]:
    """Drives with and without imperfections, and the range of their counts."""
    errors = {
        "bias": 0.02, "scale": -0.003, "worm_cos": 4e-4, "worm_sin": -7e-4, "sag": 3e-3,
        "sag_phase": 0.4,
    }  # fmt: skip
    turn = 200 * 16 * 2400 // 2
    found = {}
    for name, known in zip(("first", "second"), jacks(), strict=True):
        found[f"{name} jack"] = (known, 500, 68_000)
        found[f"{name} jack, imperfect"] = (known.replace(**errors), 500, 68_000)
    for name, known in zip(("rising", "falling"), steppers(), strict=True):
        found[name] = (known, -turn, turn)
        found[f"{name}, imperfect"] = (known.replace(**errors), -turn, turn)
    found["coarse"] = (rotary(200, 60, zero=1.0, **errors, worm_ratio=30.0), -6000, 6000)
    return found


@pytest.mark.parametrize("name", every_drive())
def test_angles_and_steps_agree_with_the_mechanism(name: str) -> None:
    known, low, high = every_drive()[name]
    own = drives.Drive(*numbers_of(known))
    counts = np.unique(np.linspace(low, high, 800).round())
    angles = known.angles(counts)
    for count, angle in zip(counts, angles, strict=True):
        assert own.angle(count) == pytest.approx(angle, abs=1e-12)
        assert own.steps(angle) == pytest.approx(count, abs=2e-3)
        assert own.nearest(angle) == count
    between = 0.5 * (angles[1:] + angles[:-1])
    steps = known.counts(between)
    for angle, wanted in zip(between, steps, strict=True):
        assert own.steps(angle) == pytest.approx(wanted, abs=2e-3)


@pytest.mark.parametrize("name", every_drive())
def test_single_precision(name: str) -> None:
    """Within a microradian of double, or half a step where that is more."""
    known, low, high = every_drive()[name]
    kind, numbers, bias = numbers_of(known)
    single("pointing")
    board = single("drives").Drive(kind, tuple(map(np.float32, numbers)), np.float32(bias))
    counts = np.unique(np.linspace(low, high, 250).round())
    for count, angle in zip(counts, known.angles(counts), strict=True):
        assert isinstance(board.angle(int(count)), np.float32)
        assert board.angle(int(count)) == pytest.approx(angle, abs=1e-6)
        there = float(known.angles(board.nearest(np.float32(angle))))
        step = abs(float(known.radians_per_count(count)))
        assert there == pytest.approx(angle, abs=1e-6 + 0.5 * step)


def test_a_jack_stops_at_its_end() -> None:
    own = drives.Drive(*numbers_of(jacks()[1]))
    straight = own.numbers[drives.OFFSET] + own.numbers[drives.RADIUS]
    end = (straight - own.numbers[drives.STROKE]) / own.numbers[drives.RATE]
    # The angle falls as the jack grows; 10 rad below is beyond its end.
    assert own.steps(own.angle(0) - 10.0) == pytest.approx(end)
    short = linear_paint(150_000.0, 0.08, 0.34, 0.33, 0.0)
    assert drives.Drive(*numbers_of(short)).steps(10.0) == pytest.approx(
        float(short.counts(10.0)), abs=1e-6
    )


@pytest.mark.parametrize(
    ("kind", "change", "text"),
    [
        (7, {}, "kind"),
        (0, {drives.ZERO: math.nan}, "finite"),
        (0, {drives.RATE: 0.0}, "cannot move"),
        (0, {drives.SCALE: -1.0}, "cannot move"),
        (1, {drives.STROKE: 5.0}, "triangle"),
        (0, {drives.WORM_SIN: 0.1, drives.WORM_RATIO: 40.0}, "reverse its direction"),
    ],
)
def test_drives_that_cannot_work_are_refused(
    kind: int, change: dict[int, float], text: str
) -> None:
    numbers = [0.0, 1e-6, 0.5, 0.34, 0.33, 0.0, 0.0, 0.0, 0.0, 0.0]
    for place, value in change.items():
        numbers[place] = value
    with pytest.raises(ValueError, match=text):
        drives.Drive(kind, tuple(numbers), 0.0)
