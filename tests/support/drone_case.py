"""A small field, a camera and a flight over it, for the tests of the airborne package."""

import numpy as np

from heliotrope.airborne.photo import LedCamera
from heliotrope.airborne.simulate.simulation import Errors, Flight, fly, hover_grid, look_counts
from heliotrope.field.example import azimuth_elevation
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.sun import Site

SITE = Site(37.09, -2.36, 500.0, name="test")
ORIGIN = (SITE.latitude_deg, SITE.longitude_deg, SITE.height)
HOVER = np.array([0.0, -5.0, 45.0])


def field(rings: int = 4, per_ring: int = 5) -> Heliostats:
    """Radial staggered heliostats of 2.5 m × 2 m with four facets each."""
    positions, names = [], []
    for ring in range(rings):
        radius = 32.0 + 5.0 * ring
        for k in range(per_ring):
            angle = (k - 0.5 * (per_ring - 1) + 0.5 * (ring % 2)) * 0.15
            positions.append((radius * np.sin(angle), radius * np.cos(angle), 0.0))
            names.append(f"H{ring}{k}")
    n = len(names)
    center, half_width, half_height = (np.zeros((n, 4, 3)) for _ in range(3))
    center[..., 0] = np.array([-0.25, 0.25, -0.25, 0.25]) * 2.5
    center[..., 1] = np.array([-0.25, -0.25, 0.25, 0.25]) * 2.0
    half_width[..., 0], half_height[..., 1] = 0.615, 0.49
    return Heliostats(
        tuple(names),
        azimuth_elevation(np.array(positions)),
        np.full(n, 2.5),
        np.full(n, 2.0),
        Facets(center, half_width, half_height),
    )


def plant(heliostats: Heliostats) -> Plant:
    """The field as a plant."""
    return Plant("drone", SITE, {"azel": heliostats})


def camera(width: int = 1200, height: int = 900) -> LedCamera:
    """A lens with distortion, its principal point off the middle."""
    f = 0.95 * width
    matrix = np.array(
        [[f, 0.0, 0.5 * (width - 1) + 2.0], [0.0, 1.001 * f, 0.5 * (height - 1) - 3.0], [0, 0, 1.0]]
    )
    distortion = np.array([-0.08, 0.06, 3e-4, -2e-4, -0.01])
    return LedCamera((width, height), matrix, distortion, np.array([0.0, -0.12, 0.02]))


def flight(
    errors: Errors | None = None,
    columns: int = 3,
    rows: int = 3,
    step: float = 0.7,
    seed: int = 3,
    heliostats: Heliostats | None = None,
    lens: LedCamera | None = None,
) -> Flight:
    """A pattern of ``columns`` by ``rows`` over the field, all mirrors on its middle."""
    mirrors = heliostats or field()
    middle = mirrors.position.mean(axis=0) + [0.0, 0.0, 1.2]
    hover = hover_grid(HOVER, middle, columns, rows, step)
    counts = look_counts(mirrors, HOVER)
    return fly(mirrors, lens or camera(), counts, hover, middle, errors=errors, seed=seed)
