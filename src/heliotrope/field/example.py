"""Our own example plant of 18 heliostats, with finer gears and larger mirrors than the prototype.

It has six groups of three heliostats of 2.2 m² each, south of a tower at Stellenbosch with a target
13 m above ground. One of them stands where Malan calibrated his heliostat (30.8 m south, 19.2 m
east, pivot height 1.2 m). Malan's own plant is `stellenbosch.prototype`.
"""

import numpy as np

from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float, direction
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.mechanism.parameters import model
from heliotrope.sun import Site

#: Centres of the six groups of three, metres east and north of the tower.
_PODS = ((-19.0, -24.0), (0.0, -24.0), (19.2, -24.0), (-19.0, -34.0), (0.0, -34.0), (19.2, -34.0))
#: Offsets from the centre of a group to its heliostats, m: a triangle that points north.
_RADIUS = 3.2
_PIVOT_HEIGHT = 1.2


def example_plant() -> Plant:
    """Return the example plant of 18 azimuth-elevation heliostats south of their tower."""
    names, positions, clusters = [], [], []
    for pod, (east, north) in enumerate(_PODS, start=1):
        for k in range(3):
            east_k, north_k, _ = _RADIUS * direction(k * 2.0 * np.pi / 3.0, 0.0)
            names.append(f"P{pod}{'ABC'[k]}")
            positions.append((east + east_k, north + north_k, 0.0))
            clusters.append(f"pod-{pod}")
    # Where the thesis calibrates its heliostat.
    positions[names.index("P6A")] = (19.2, -30.8, 0.0)
    position = np.array(positions)
    return Plant(
        name="example",
        site=Site(-33.93, 18.87, 120.0, name="Stellenbosch"),
        groups={
            "azel": Heliostats(
                names=tuple(names),
                mechanism=azimuth_elevation(position),
                width=np.full(len(names), 1.83),
                height=np.full(len(names), 1.22),
                cluster=tuple(clusters),
            )
        },
        targets=(Target("target", _square((0.0, 0.0, 13.0), 3.0), np.array([0.0, 0.0, 13.0])),),
        receivers=(
            Receiver(
                "receiver",
                "planar",
                np.array([0.0, 0.0, 16.5]),
                np.array([0.0, -1.0, 0.0]),
                1.5,
                1.5,
            ),
        ),
    )


def azimuth_elevation(position: FloatArray) -> Mechanism:
    """Return azimuth-elevation mechanisms on stepper motors at positions (N, 3).

    The motors have 200 steps per revolution and 16 microsteps, behind a 60:1 gearhead and a 40:1
    worm gear: one count turns the joint by 0.8 µrad, and 20,000 counts per second by 0.94 °/s.
    """
    gear = {"microsteps": 16, "speed": 2.0e4}
    azimuth = rotary(200, 2400, min_angle=-np.radians(200.0), max_angle=np.radians(200.0), **gear)
    elevation = rotary(
        200, 2400, min_angle=np.radians(-5.0), max_angle=np.radians(95.0), worm_ratio=40.0, **gear
    )
    return kinds.azimuth_elevation(
        position, pivot_height=_PIVOT_HEIGHT, pivot_offset=0.1, drives=(azimuth, elevation)
    )


def roughly_installed(nominal: Mechanism, seed: int = 0, scale: float = 1.0) -> Mechanism:
    """Return mechanisms with the errors of a rough installation, for simulations.

    Standard deviations: tilts 10 mrad, encoder offsets 5 mrad, non-orthogonality and canting 2
    mrad, position 20 mm; ``scale`` multiplies all of them.
    """
    rng = np.random.default_rng(seed)
    sizes = {
        "tilts": 10e-3,
        "biases": 5e-3,
        "non_orthogonality": 2e-3,
        "canting": 2e-3,
        "position": 0.02,
    }
    known = nominal.parameters
    return nominal.with_parameters(
        {
            name: rng.normal(0.0, scale * size, nominal.shape)
            for role, size in sizes.items()
            for name in model(role, known)
        }
    )


def _square(center: tuple[float, float, float], size: float) -> FloatArray:
    """Return the corners of an upright square facing south, from the upper left in front view."""
    # Seen by someone looking north, west is to the left.
    half = 0.5 * size
    shifts = np.array([(-half, half), (half, half), (half, -half), (-half, -half)])
    plane = np.stack([shifts[:, 0], 0 * shifts[:, 0], shifts[:, 1]], axis=-1)
    return as_float(np.array(center) + plane)
