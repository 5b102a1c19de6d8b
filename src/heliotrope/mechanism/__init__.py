"""Heliostat mechanisms, single or in arrays: joints, drives, parameters, armature, tracking.

A mechanism is data: a chain of joints from the ground to the mirror, two of which are driven. Build
one with `azimuth_elevation`, `two_jacks`, … (`kinds`), give it drives (`rotary`, `linear_paint`,
…), set its imperfections with `Mechanism.with_parameters`, and point it with `track`. `Machine`
holds the motor limits and the rest positions.

Access the names in these modules through the module:

- `guo`: Guo's closed-form solution for azimuth-elevation heliostats, a cross-check of `track`.
- `parameters`: the parameter table and the models.
- `board_items`: the bytes that a local controller stores for a mechanism and its machine.
- `board_motion`: where local controllers send their heliostats, computed over arrays.
- `kernels`: the compiled code.
"""

from heliotrope.mechanism.armature import (
    Armature,
    check_axes,
)
from heliotrope.mechanism.chain import (
    Calibrated,
    Jacobian,
    Mechanism,
    Pose,
    join_mechanisms,
)
from heliotrope.mechanism.drives import (
    SLOTS,
    Drive,
    direct,
    linear_grigoriev,
    linear_guo,
    linear_paint,
    rotary,
)
from heliotrope.mechanism.kinds import (
    azimuth_elevation,
    pitch_roll,
    polar,
    single_axis,
    target_aligned,
    tilt_roll,
    two_axis,
    two_jacks,
)
from heliotrope.mechanism.machine import (
    AxisLimits,
    Machine,
)
from heliotrope.mechanism.parameters import (
    MODELS,
    Parameter,
)
from heliotrope.mechanism.path import (
    Slew,
    TrackedPath,
    track_path,
)
from heliotrope.mechanism.tracking import (
    Branch,
    Steered,
    Tracking,
    TrackingStatus,
    track,
)

__all__ = [
    "MODELS",
    "SLOTS",
    "Armature",
    "AxisLimits",
    "Branch",
    "Calibrated",
    "Drive",
    "Jacobian",
    "Machine",
    "Mechanism",
    "Parameter",
    "Pose",
    "Slew",
    "Steered",
    "TrackedPath",
    "Tracking",
    "TrackingStatus",
    "azimuth_elevation",
    "check_axes",
    "direct",
    "join_mechanisms",
    "linear_grigoriev",
    "linear_guo",
    "linear_paint",
    "pitch_roll",
    "polar",
    "rotary",
    "single_axis",
    "target_aligned",
    "tilt_roll",
    "track",
    "track_path",
    "two_axis",
    "two_jacks",
]
