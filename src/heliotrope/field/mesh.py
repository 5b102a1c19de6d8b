"""Surfaces made of triangles, such as the panels of a receiver or the inside of a cavity."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_vectors

#: Maximum number of triangles of a mesh; with 10,000 mirrors, one sun position then takes half a
#: minute.
MOST_FACES = 100_000
#: Smallest triangle, m².
_LEAST_AREA = 1e-10


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Triangles; the lit side is the one from which their vertices run counterclockwise.

    Attributes
    ----------
    vertices
        m, (V, 3).
    faces
        Vertices of each triangle, (C, 3).
    """

    vertices: FloatArray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices, faces = as_vectors(self.vertices, "mesh: vertices"), np.asarray(self.faces)
        if vertices.ndim != 2 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise InputError(
                f"mesh: vertices {vertices.shape} and faces {faces.shape}; expected (V, 3) and (C, "
                "3)"
            )
        if len(faces) > MOST_FACES:
            raise InputError(
                f"mesh: {len(faces):,} triangles; use at most {MOST_FACES:,}; they need not be "
                "smaller than a mirror's beam"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(
                f"mesh: a face uses vertex {faces.max()}, but there are only {len(vertices)}"
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces.astype(np.int64))
        small = ~(np.linalg.norm(self._cross, axis=-1) > 2.0 * _LEAST_AREA)
        if small.any():
            k = int(np.flatnonzero(small)[0])
            raise InputError(f"mesh: triangle {k} has no area; remove it")

    @property
    def _cross(self) -> FloatArray:
        a, b, c = np.moveaxis(self.vertices[self.faces], 1, 0)
        return np.asarray(np.cross(b - a, c - a))

    @cached_property
    def center(self) -> FloatArray:
        """Middles of the triangles, m, (C, 3)."""
        return np.asarray(self.vertices[self.faces].mean(axis=1))

    @cached_property
    def normal(self) -> FloatArray:
        """Unit normals out of their lit sides, (C, 3)."""
        return np.asarray(self._cross / np.linalg.norm(self._cross, axis=-1, keepdims=True))


def cavity_wall(
    radius: float, opening: float, height: float, cells: tuple[int, int] = (18, 36)
) -> TriangleMesh:
    """Return the back wall of a cavity: a sector of an upright cylinder, lit from its axis.

    Parameters
    ----------
    radius, height
        Radius and height, m. The axis of the cylinder passes through the middle of the aperture, in
        the aperture's plane.
    opening
        Angle of the sector, half of it on each side of straight back, rad.
    cells
        Rows and columns of rectangles, each made of two triangles.

    Returns
    -------
    TriangleMesh
        The wall in the axes of the aperture: right and up as seen from its front, and outwards.
    """
    if not (radius > 0.0 and height > 0.0 and 0.0 < opening <= np.pi):
        raise InputError(
            f"cavity: radius {radius:g} m, height {height:g} m and opening angle {opening:g} rad; "
            "lengths must be above 0, and the angle above 0 and at most 3.14159 rad"
        )
    rows, columns = cells
    angle = np.linspace(-0.5 * opening, 0.5 * opening, columns + 1)
    level = np.linspace(-0.5 * height, 0.5 * height, rows + 1)
    y, a = np.meshgrid(level, angle, indexing="ij")
    vertices = np.stack([radius * np.sin(a), y, -radius * np.cos(a)], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    # From the inside, right is to the right as seen from the front.
    right, over = corner + 1, corner + columns + 1
    first = np.stack([corner, right, over + 1], axis=-1)
    other = np.stack([corner, over + 1, over], axis=-1)
    return TriangleMesh(vertices, np.stack([first, other], axis=1).reshape(-1, 3))
