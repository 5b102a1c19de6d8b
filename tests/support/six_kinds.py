"""Plants whose groups have different kinds of mechanism."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from heliotrope.field.heliostats import Heliostats
from heliotrope.field.layouts import lay_out
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive, rotary
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.mechanism.tracking import track
from support.machines import jacks

RATE = 8000.0
UP = np.array([0.0, 0.0, 1.0])


def turning() -> tuple[Drive, Drive]:
    """Two stepper drives of 400,000 steps a turn, free from -200° to 200°."""
    stops = {"min_angle": -np.radians(200.0), "max_angle": np.radians(200.0)}
    gear = {"microsteps": 4, "speed": RATE, **stops}
    return rotary(200, 500.0, **gear), rotary(200, 500.0, **gear)


def northwards(mechanism: Mechanism) -> Mechanism:
    """Turn mechanisms that look south, as those of Jülich, by half a turn."""
    turned = np.broadcast_to(np.diag([-1.0, -1.0, 1.0]), (len(mechanism), 3, 3))
    return replace(mechanism, orientation=turned)


#: Builders by kind, from positions (N, 3) and the point that target-aligned axes look at.
BUILDERS: dict[str, Callable[[FloatArray, FloatArray], Mechanism]] = {
    "azimuth_elevation": lambda p, a: kinds.azimuth_elevation(
        p, pivot_height=2.0, pivot_offset=0.1, drives=turning()
    ),
    "tilt_roll": lambda p, a: kinds.tilt_roll(
        p, pivot_height=2.0, spacing=0.15, pivot_offset=0.1, drives=turning()
    ),
    "target_aligned": lambda p, a: kinds.target_aligned(
        p, a, pivot_height=2.0, pivot_offset=0.1, drives=turning()
    ),
    "pitch_roll": lambda p, a: kinds.pitch_roll(
        p, 0.3, pivot_height=2.0, spacing=0.1, pivot_offset=0.1, drives=turning()
    ),
    "polar": lambda p, a: kinds.polar(
        p, np.radians(-28.0), pivot_height=2.0, pivot_offset=0.1, drives=turning()
    ),
    "two_axis": lambda p, a: kinds.two_axis(
        p,
        (0.1, -0.05, 1.0),
        (1.0, 0.1, 0.18),
        (0.02, -0.05, 1.0),
        origin_1=(0.1, 0.0, 2.0),
        origin_2=(0.1, -0.1, 0.3),
        vertex=(0.05, -0.03, 0.2),
        drives=turning(),
    ),
    "two_jacks": lambda p, a: northwards(
        kinds.two_jacks(
            p,
            jacks(),
            joint_translation_1=(0.0, 0.0, 2.0),
            concentrator_translation=(0.0, 0.175, 0.0),
        )
    ),
}


def machine(mechanism: Mechanism, like: Machine) -> Machine:
    """Return a machine table for a mechanism, (): at stow its mirror looks up."""
    found = track(mechanism, UP, mechanism.position + 1000.0 * UP)
    jack = mechanism.kind == "two_jacks"
    low, high = (0, 80_000) if jack else (-222_000, 222_000)
    stow = np.clip(np.round(found.best_counts), low, high).astype(np.int64).reshape(2)
    axis = AxisLimits(low, high, int(RATE), 16_000, 40)
    return replace(like, axes=(axis, axis), stow=(int(stow[0]), int(stow[1])), defocus=(0.1, 0.05))


def mixed(kinds_wanted: list[str], each: int = 1, cluster: str = "C") -> Plant:
    """Return a plant with a group of each kind, on a cluster of its own."""
    design = lay_out("radial", each * len(kinds_wanted))
    (whole,) = design.groups.values()
    groups = {}
    for k, kind in enumerate(kinds_wanted):
        part = whole.take(np.arange(k * each, (k + 1) * each))
        made = BUILDERS[kind](part.position, np.asarray(design.receivers[0].center))
        groups[f"{k + 1} {kind}"] = Heliostats(
            part.names,
            made,
            part.width,
            part.height,
            cluster=(f"{cluster}{k + 1}",) * each,
            machines=tuple(machine(made[i], part.machines[i]) for i in range(each)),
        )
    return replace(design, groups=groups)
