"""Fields that tests of flight planning share."""

import numpy as np

from heliotrope.field.example import azimuth_elevation, example_plant
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray

#: Half a side of a facet, m; four of them stand with a gap of 20 mm.
HALF, CENTRE = 0.79, 0.8


def radial(count: int, first: float = 60.0, spacing: float = 6.0) -> FloatArray:
    """Places of a radial staggered field about the tower, (count, 3)."""
    rings: list[FloatArray] = []
    radius, number = first, 0
    while sum(map(len, rings)) < count:
        many = int(2.0 * np.pi * radius / spacing)
        angle = (np.arange(many) + 0.5 * (number % 2)) * 2.0 * np.pi / many
        rings.append(np.stack([radius * np.sin(angle), radius * np.cos(angle), 0 * angle], -1))
        radius += spacing * (0.85 + 0.4 * radius / 600.0)
        number += 1
    return np.concatenate(rings)[:count]


def staggered(count: int, canting: float = np.inf) -> Plant:
    """A plant of heliostats with four facets, canted to a focal length if one is given."""
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    centre = np.column_stack([CENTRE * signs, np.zeros(4)])
    slope = -centre[:, :2] / (2.0 * canting)
    right, up = np.zeros((4, 3)), np.zeros((4, 3))
    right[:, 0], up[:, 1] = HALF, HALF
    right[:, 2], up[:, 2] = -HALF * slope[:, 0], -HALF * slope[:, 1]
    facets = Facets(*(np.broadcast_to(a, (count, 4, 3)) for a in (centre, right, up)))
    group = Heliostats(
        tuple(f"H{i:05d}" for i in range(count)),
        azimuth_elevation(radial(count)),
        np.full(count, 3.2),
        np.full(count, 3.2),
        facets=facets,
    )
    receiver = Receiver(
        "receiver", "planar", np.array([0.0, 0.0, 80.0]), np.array([0.0, 1.0, 0.0]), 6.0, 6.0
    )
    return Plant("staggered", example_plant().site, {"azel": group}, receivers=(receiver,))
