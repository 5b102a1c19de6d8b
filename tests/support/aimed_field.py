"""A field of mirrors about a receiver, without a plant."""

from dataclasses import replace

import numpy as np

from heliotrope.aims.candidates import middles
from heliotrope.geometry import bisector, normalize
from heliotrope.optics.scene import Mirrors, Scene
from heliotrope.optics.surfaces import Cylinder, Plate, Surface

UP, NORTH = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
SUN = normalize(np.array([0.2, -0.5, 0.8]))
MIDDLE = np.array([0.0, 0.0, 80.0])
CYLINDER = Cylinder("receiver", MIDDLE, UP, NORTH, 3.0, 6.0, shape=(18, 28))
PLATE = Plate("plate", MIDDLE, np.array([-1.0, 0.0, 0.0]), UP, 6.0, 6.0, (18, 18))


def field(count: int, surface: Surface = CYLINDER, error: float = 0.0) -> Scene:
    k = np.arange(count) + 0.5
    turn, radius = k * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(150.0 / np.pi * k + 60.0**2)
    north = np.abs(np.cos(turn)) if isinstance(surface, Plate) else np.cos(turn)
    place = np.stack([radius * np.sin(turn), radius * north, 0.0 * k], axis=-1)
    mirrors = Mirrors.of(
        place, bisector(SUN, normalize(MIDDLE - place)), (6.0, 5.0), MIDDLE,
        pointing=error**2 * np.eye(2),
    )  # fmt: skip
    return Scene(SUN, 900.0, mirrors, (surface,))


def in_the_middle(scene: Scene) -> Scene:
    return replace(scene, mirrors=scene.mirrors.toward(scene.sun, middles(scene)))
