"""Mechanisms of every kind with every imperfection, for the tests."""

import numpy as np

from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive, linear_paint, rotary

GEAR = {"microsteps": 16, "worm_ratio": 40.0}


def steppers() -> tuple[Drive, Drive]:
    """Two stepper drives."""
    return rotary(200, 2400, **GEAR), rotary(200, 2400, zero=0.1, sense=-1, **GEAR)


def jacks() -> tuple[Drive, Drive]:
    """Two jacks with the constants of Jülich's AA39."""
    first = linear_paint(
        154166.6667,
        0.077412795,
        0.335308,
        0.338095,
        0.039009536 - np.pi / 2,
        clockwise=0,
        worm_ratio=500.0,
    )
    second = linear_paint(
        154166.6667, 0.077522286, 0.340771, 0.3191, 0.943922248, clockwise=1, worm_ratio=500.0
    )
    return first, second


def every_kind() -> dict[str, Mechanism]:
    """One perfect mechanism of each kind, by name."""
    place = (25.0, -60.0, 0.3)
    return {
        "azimuth_elevation": kinds.azimuth_elevation(
            place, pivot_height=1.5, pivot_offset=0.3, drives=steppers()
        ),
        "tilt_roll": kinds.tilt_roll(
            place, pivot_height=1.0, spacing=0.15, pivot_offset=0.2, drives=steppers()
        ),
        "target_aligned": kinds.target_aligned(
            place, (0.0, 0.0, 40.0), pivot_height=1.0, pivot_offset=0.2, drives=steppers()
        ),
        "pitch_roll": kinds.pitch_roll(
            place, 0.3, pivot_height=1.0, spacing=0.1, pivot_offset=0.2, drives=steppers()
        ),
        "polar": kinds.polar(place, -0.6, pivot_height=1.0, pivot_offset=0.2, drives=steppers()),
        "two_axis": kinds.two_axis(
            place,
            (0.1, -0.05, 1.0),
            (1.0, 0.1, 0.18),
            (0.02, -0.05, 1.0),
            origin_1=(0.1, 0.0, 1.2),
            origin_2=(0.2, -0.1, 0.3),
            vertex=(0.05, -0.03, 0.4),
            drives=steppers(),
        ),
        "two_jacks": kinds.two_jacks(
            place,
            jacks(),
            joint_translation_1=(0.01, 0.02, 1.5),
            joint_translation_2=(0.03, 0.01, 0.02),
            concentrator_translation=(0.0, 0.175, 0.0),
        ),
        "single_axis": kinds.single_axis(
            place, (0.1, 1.0, 0.0), pivot_height=0.5, vertex=(0.0, 0.0, 0.2), drives=steppers()[:1]
        ),
    }


def imperfect(mechanism: Mechanism, seed: int = 0, size: float = 0.01) -> Mechanism:
    """The mechanism with all its parameters moved, angles by about ``size`` rad."""
    rng = np.random.default_rng(seed)
    scale = {"rad": size, "m": size, "1": size}
    values = {
        name: rng.uniform(-1.0, 1.0, mechanism.shape)
        * scale[row.unit]
        * (0.1 if "worm" in name or row.name.endswith(("offset", "radius")) else 1.0)
        for name, row in mechanism.parameters.items()
        if not name.endswith("worm_ratio")  # it is searched and no imperfection of a machine
    }
    return mechanism.with_parameters(values)


def random_counts(mechanism: Mechanism, rows: int, seed: int = 0) -> np.ndarray:
    """Counts over the whole workspace, (rows, D)."""
    rng = np.random.default_rng(seed)
    if mechanism.kind == "two_jacks":
        return rng.uniform(500.0, 68000.0, (rows, 2))
    return rng.uniform(-np.pi, np.pi, (rows, len(mechanism.driven))) / (
        2.0 * np.pi / (200 * 16 * 2400)
    )
