"""The outline of a keep-out volume on a map holds all of it, and no more."""

import numpy as np
import pytest
from matplotlib.path import Path as Polygon

from heliotrope.field.target import Receiver
from heliotrope.field.volumes import Box, Cylinder, Prism, Sphere, Volume, around, outline
from heliotrope.optics import clearance


@pytest.mark.parametrize(
    "volume",
    [
        Box("house", (20.0, -60.0, 3.0), (12.0, 8.0, 6.0), np.radians(30.0)),
        Sphere("drone", (-5.0, 4.0, 50.0), 7.0),
        Cylinder("mast", (0.0, 0.0, 0.0), (0.0, 0.0, 60.0), 1.5),
        Cylinder("pipe", (-10.0, 5.0, 8.0), (20.0, 12.0, 8.0), 2.0),
        Cylinder("slope", (10.0, 0.0, 30.0), (-4.0, 9.0, 4.0), 3.0),
        Prism("walkway", [(-5, -20), (5, -20), (5, -18), (0, -15), (-5, -18)], 4.0, 8.0),
    ],
    ids=lambda volume: volume.name,
)
def test_the_outline_holds_all_points_of_the_volume_and_no_more(volume: Volume) -> None:
    rng = np.random.default_rng(3)
    corners = outline(volume)
    low, high = corners.min(axis=0) - 3.0, corners.max(axis=0) + 3.0
    flat = rng.uniform(low, high, (4000, 2))
    heights = np.arange(-5.0, 70.0, 0.25)
    points = np.concatenate(
        [np.repeat(flat, len(heights), axis=0), np.tile(heights, len(flat))[:, None]], axis=1
    )
    depth = clearance(points, [volume])[:, 0].reshape(len(flat), len(heights)).min(axis=1)
    inside = Polygon(corners).contains_points(flat)
    # A circle is a polygon of 24 corners here: a hundredth of the radius lies outside.
    assert inside[depth < -0.1].all()
    assert not inside[depth > 0.15].any()
    assert inside.sum() > 100


@pytest.mark.parametrize("kind", ["planar", "convex_cylinder", "external_cylinder"])
def test_a_volume_around_a_receiver_holds_it_and_some_room(kind: str) -> None:
    rng = np.random.default_rng(8)
    receiver = Receiver(
        "r", kind, np.array([1.0, -2.0, 50.0]), np.array([0.6, -0.8, 0.0]), 6.0, 8.0
    )
    turn, across, up = rng.uniform((0.0, -3.0, -4.0), (2.0 * np.pi, 3.0, 4.0), (500, 3)).T
    right = np.array([0.8, 0.6, 0.0])
    points = receiver.center + up[:, None] * [0.0, 0.0, 1.0]
    if kind == "external_cylinder":
        points += 3.0 * np.stack([np.sin(turn), np.cos(turn), np.zeros(500)], axis=-1)
    else:
        points += across[:, None] * right
    assert clearance(points, [around(receiver, 0.5)]).max() < -0.45
    # It is no larger than the ball about the receiver's diagonal and that room.
    away = receiver.center + 5.8 * np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    assert clearance(away, [around(receiver, 0.5)]).min() > 0.0
