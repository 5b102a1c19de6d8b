"""Malan's prototype: the eighteen heliostats on the roof laboratory at Stellenbosch.

The thesis specifies: three triangular structures of six heliostats, one cluster each (5.2, 5.3);
mirrors of 0.3 m by 0.3 m; 200-step motors with eighth steps behind a 30:1 worm gear, which results
in 48,000 steps per revolution, 0.13 mrad each (5.1.2); two targets of 2 m by 2 m on an 18 m lattice
tower in the north-west, about 40 m from the upper target to the middle of the heliostats (6.1),
with the lower target 13 m above ground (4.3); the heliostat of 6.3, 30.8 m south and 19.2 m east of
the tower with its pivot 1.2 m above ground; and stow, with the mirror upright and facing north
(6.5). Beams go to the upper target, which serves as the receiver, or to the lower target for
calibration.

The thesis does not state the size of a structure, the positions of the other heliostats, the
bearing of the targets, the motor speed, the camera position or the latitude; these are our own
assumptions.
"""

from dataclasses import replace

import numpy as np

from heliotrope.field import layouts
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.layout_tower import square_target, watching_camera
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float, direction
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.mechanism.machine import Machine, Stepping
from heliotrope.sun import Site

#: Steps per motor revolution, microsteps per step, and worm revolutions per joint revolution.
STEPS, MICROSTEPS, WORM = 200, 8, 30
#: The heliostat of 6.3: m east, north, and up to its pivot.
_PLACE, _PIVOT_HEIGHT = (19.2, -30.8), 1.2
#: Side of a mirror and of a target; heights of the targets' centres, m.
_MIRROR, _TARGET = 0.3, 2.0
_LOWER, _UPPER = 13.0, 17.0
#: Distance between neighbouring heliostats of a structure, and between the structures' centres, m.
_SPACING, _APART = 0.75, 3.0
#: The camera, m: in front of the lower target, above the ground, and to the right of the target.
#: From here, no sun position above 8° comes nearer than 17° to the camera's line of sight in a
#: year; from the middle, the winter sun is behind the target for an hour in the afternoon.
_CAMERA = (30.0, 3.0, -20.0)
#: Steps/s of the motors: 7.5 °/s of the joint.
_RATE = 1000.0


def prototype() -> Plant:
    """Return Malan's prototype: 18 heliostats in three clusters, on stepper motors."""
    bearing = float(np.arctan2(_PLACE[0], _PLACE[1]))  # of the heliostats from the tower
    mechanism = _mechanism(_places(bearing))
    count = len(mechanism.position)
    upper = _standing("upper", _UPPER, bearing)
    receiver = Receiver(
        "receiver", "planar", upper.center, upper.normal, _TARGET, _TARGET, upper.corners
    )
    lower = _standing("target", _LOWER, bearing)
    return Plant(
        # All 18 together, in 32 photographs.
        joint_visits=JointSettings(first=63),
        name="Malan's prototype",
        site=Site(-33.93, 18.87, 120.0, name="Stellenbosch"),
        groups={
            "azel": Heliostats(
                names=tuple(f"S{1 + k // 6}{'ABCDEF'[k % 6]}" for k in range(count)),
                mechanism=mechanism,
                width=np.full(count, _MIRROR),
                height=np.full(count, _MIRROR),
                cluster=tuple(f"structure-{1 + k // 6}" for k in range(count)),
                machines=(_machine(mechanism, receiver),) * count,
            )
        },
        targets=(lower,),
        receivers=(receiver,),
        cameras=(watching_camera(lower, "camera", *_CAMERA),),
    )


def _standing(name: str, height: float, bearing: float) -> Target:
    return square_target(name, as_float([0.0, 0.0, height]), _TARGET, bearing)


def _places(bearing: float) -> FloatArray:
    """Return the feet of the heliostats, (18, 3), structure by structure.

    The heliostat of section 6.3 is B of the last structure.
    """
    depth = 0.5 * np.sqrt(3.0) * _SPACING
    # A heliostat at each corner and at the middle of each side: right, and away from the tower.
    triangle = np.array(
        [(0, -depth), (-0.5 * _SPACING, 0), (0.5 * _SPACING, 0),
         (-_SPACING, depth), (0, depth), (_SPACING, depth)]
    )  # fmt: skip
    outward = direction(bearing, 0.0)[:2]
    right = direction(bearing + 0.5 * np.pi, 0.0)[:2]
    # Structures side by side, the middle one with its point away from the tower, as in figure 5.5.
    feet = []
    for k in range(3):
        own = triangle * [1.0, -1.0 if k == 1 else 1.0] + [(k - 1) * _APART, 0.0]
        feet.append(own[:, :1] * right + own[:, 1:] * outward)
    flat = np.concatenate(feet)
    flat += np.array(_PLACE) - flat[6 * 2 + 1]
    return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)


def _mechanism(position: FloatArray) -> Mechanism:
    gear = {"microsteps": MICROSTEPS, "speed": _RATE, "worm_ratio": float(WORM)}
    azimuth = rotary(STEPS, WORM, min_angle=-np.radians(200), max_angle=np.radians(200), **gear)
    elevation = rotary(STEPS, WORM, min_angle=-np.radians(3.6), max_angle=np.radians(93.6), **gear)
    return kinds.azimuth_elevation(
        position, pivot_height=_PIVOT_HEIGHT, pivot_offset=0.05, drives=(azimuth, elevation)
    )


def _machine(mechanism: Mechanism, receiver: Receiver) -> Machine:
    """Return the limits, the stow position, and motor drivers that switch off at rest (6.2).

    At stow the mirror is upright and faces north; both step counts are 0.
    """
    made = layouts.stepped_machine(mechanism, receiver)
    # Elastic cords and the mirror's weight keep the gears on one flank (5.1.3).
    first, second = (replace(axis, backlash=0) for axis in made.axes)
    stepping = Stepping((MICROSTEPS, MICROSTEPS), rests=True)
    return replace(made, axes=(first, second), stow=(0, 0), stepping=stepping, stow_lights=True)
