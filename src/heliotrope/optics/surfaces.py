"""Surfaces that beams fall on, divided into cells: plates, cylinders, cavities and meshes.

Rows go upwards. Columns go to the right as seen from the front of a plate, and clockwise as seen
from above (with the azimuth) around an upright cylinder.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.target import Receiver, Target
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize

#: Default rows and columns of a plate, and of a full cylinder.
PLATE_CELLS, CYLINDER_CELLS = (24, 24), (24, 84)


@dataclass(frozen=True, eq=False)
class Cells:
    """C cells of a surface, row after row.

    Attributes
    ----------
    center, normal
        Centre, ENU m, and unit normal out of the lit side, (C, 3).
    area
        m², (C,).
    shape
        Rows and columns; (C,) for a mesh.
    """

    center: FloatArray
    normal: FloatArray
    area: FloatArray
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Plate:
    """A flat rectangle, lit from its front.

    Attributes
    ----------
    name
        Name of the receiver or target.
    center, right, up
        Centre, ENU m, and unit axes in the plane as seen from the front, (3,).
    width, height
        m.
    shape
        Rows and columns of cells.
    """

    name: str
    center: FloatArray
    right: FloatArray
    up: FloatArray
    width: float
    height: float
    shape: tuple[int, int] = PLATE_CELLS

    def __post_init__(self) -> None:
        _check(self.name, self.shape, width=self.width, height=self.height)

    @property
    def normal(self) -> FloatArray:
        """Unit normal out of the front, (3,)."""
        return as_float(np.cross(self.right, self.up))

    @cached_property
    def corners(self) -> FloatArray:
        """Lower left, lower right, upper right and upper left corners, ENU m, (4, 3)."""
        across, along = 0.5 * self.width * self.right, 0.5 * self.height * self.up
        signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
        return np.stack([self.center + a * across + b * along for a, b in signs])

    @cached_property
    def cells(self) -> Cells:
        """Cells of equal size."""
        rows, columns = self.shape
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * self.width
        y = ((np.arange(rows) + 0.5) / rows - 0.5) * self.height
        across, along = np.meshgrid(x, y)
        center = self.center + across[..., None] * self.right + along[..., None] * self.up
        count = rows * columns
        area = np.full(count, self.width * self.height / count)
        normal = np.broadcast_to(self.normal, (count, 3))
        return Cells(center.reshape(-1, 3), normal, area, self.shape)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder, or a sector of one, lit from outside.

    Attributes
    ----------
    name
        Name of the receiver.
    center
        Midpoint of the axis, ENU m, (3,).
    axis, front
        Unit vector along the axis, upwards, and a unit vector across it from which the columns
        are counted, clockwise as seen from the top, (3,); north for a full cylinder.
    radius, height
        m.
    span
        Angles where the columns begin and end, rad; (0, 2π) for a full cylinder.
    shape
        Rows and columns of cells.
    """

    name: str
    center: FloatArray
    axis: FloatArray
    front: FloatArray
    radius: float
    height: float
    span: tuple[float, float] = (0.0, 2.0 * np.pi)
    shape: tuple[int, int] = CYLINDER_CELLS

    def __post_init__(self) -> None:
        _check(self.name, self.shape, radius=self.radius, height=self.height)
        if not 0.0 < self.span[1] - self.span[0] <= 2.0 * np.pi + 1e-9:
            raise InputError(f"receiver {self.name}: columns from {self.span[0]} to {self.span[1]}")

    @property
    def side(self) -> FloatArray:
        """Unit vector a quarter turn clockwise from ``front``, (3,); east for a full cylinder."""
        return as_float(np.cross(self.front, self.axis))

    @property
    def edges(self) -> FloatArray:
        """Angles of the column edges, rad, (columns + 1,)."""
        return np.linspace(*self.span, self.shape[1] + 1)

    def outward(self, angle: FloatArray) -> FloatArray:
        """Return the unit normals at angles (...), (..., 3)."""
        a = as_float(angle)[..., None]
        return as_float(np.cos(a) * self.front + np.sin(a) * self.side)

    @cached_property
    def cells(self) -> Cells:
        """Cells of equal size; their centres lie on the curved surface."""
        rows, columns = self.shape
        edges = self.edges
        normal = self.outward(0.5 * (edges[1:] + edges[:-1]))
        z = ((np.arange(rows) + 0.5) / rows - 0.5) * self.height
        center = self.center + z[:, None, None] * self.axis + self.radius * normal
        turn = self.span[1] - self.span[0]
        area = np.full(rows * columns, turn * self.radius * self.height / (rows * columns))
        normals = np.broadcast_to(normal, (rows, columns, 3)).reshape(-1, 3)
        return Cells(center.reshape(-1, 3), normals, area, self.shape)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles, each a cell, lit from the side out of which their normals point.

    A cell that is hidden by another cell receives no light through it; see the flux engine.

    Attributes
    ----------
    name
        Name of the receiver.
    vertices
        ENU m, (V, 3).
    faces
        Vertices of each triangle, counter-clockwise as seen from its lit side, (C, 3).
    """

    name: str
    vertices: FloatArray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices, faces = as_vectors(self.vertices, f"mesh {self.name}"), np.asarray(self.faces)
        if vertices.ndim != 2 or faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
            raise InputError(
                f"mesh {self.name}: vertices {vertices.shape} and faces {faces.shape}; expected "
                "(V, 3) and (C, 3)"
            )
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(
                f"mesh {self.name}: a face uses vertex {faces.max()}, but the last is "
                f"{len(vertices) - 1}"
            )
        if not (self.cells.area > 1e-12).all():
            k = int(np.flatnonzero(self.cells.area <= 1e-12)[0])
            raise InputError(f"mesh {self.name}: face {k} has no area; remove it")

    @property
    def center(self) -> FloatArray:
        """Mean of the cells, weighted by area, ENU m, (3,)."""
        return as_float(self.cells.area @ self.cells.center / self.cells.area.sum())

    @cached_property
    def corners(self) -> FloatArray:
        """Vertices of each triangle, ENU m, (C, 3, 3)."""
        return as_float(self.vertices[self.faces])

    @cached_property
    def cells(self) -> Cells:
        """The triangles as cells."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        cross = np.cross(b - a, c - a)
        length = np.linalg.norm(cross, axis=-1)
        normal = cross / np.maximum(length, 1e-300)[:, None]
        return Cells((a + b + c) / 3.0, normal, 0.5 * length, (len(self.faces),))


@dataclass(frozen=True, eq=False)
class Cavity:
    """A mesh behind an aperture: light that misses the aperture is lost.

    Attributes
    ----------
    aperture
        Flat rectangle whose front faces the field.
    inner
        Mesh that is lit from inside the cavity.
    """

    aperture: Plate
    inner: Mesh

    @property
    def name(self) -> str:
        """Name of the receiver, which is the name of the aperture."""
        return self.aperture.name

    @property
    def center(self) -> FloatArray:
        """Centre of the aperture, ENU m, (3,)."""
        return self.aperture.center

    @property
    def cells(self) -> Cells:
        """Cells of the inner surface."""
        return self.inner.cells


#: Anything that catches light.
Surface = Plate | Cylinder | Mesh | Cavity


def surface_of(item: Receiver | Target, shape: tuple[int, int] | None = None) -> Surface:
    """Return a plant's receiver or target with cells.

    Parameters
    ----------
    item
        The receiver or target. A planar one becomes a plate; a cylinder, or a sector of a cylinder,
        becomes a cylinder. The triangles of a mesh, or of a cavity's inner surface, become its
        cells.
    shape
        Rows and columns; None: `PLATE_CELLS` or `CYLINDER_CELLS`.
    """
    if isinstance(item, Receiver) and item.mesh is not None:
        mesh = Mesh(item.name, item.center + item.mesh.vertices @ item.frame, item.mesh.faces)
        return mesh if item.kind == "mesh" else Cavity(_plate(item.aperture, PLATE_CELLS), mesh)
    if isinstance(item, Receiver) and item.kind != "planar":
        full = item.kind == "external_cylinder"
        upright = np.array([0.0, 0.0, 1.0])
        if full:
            axis, front, span = upright, np.array([0.0, 1.0, 0.0]), (0.0, 2.0 * np.pi)
            radius, center = item.radius or 0.5 * item.width, item.center
        else:
            axis = normalize(upright - item.normal[2] * item.normal)
            front, half = item.normal, 0.5 * item.opening_angle
            radius = item.radius
            # The centre of the receiver lies on the curved surface, in the middle of the sector.
            center, span = item.center - radius * item.normal, (-half, half)
        cells = shape or CYLINDER_CELLS
        return Cylinder(item.name, center, axis, front, radius, item.height, span, cells)
    return _plate(item.face if isinstance(item, Receiver) else item, shape or PLATE_CELLS)


def _plate(face: Target, shape: tuple[int, int]) -> Plate:
    middle, size = face.corners.mean(axis=0), (face.width, face.height)
    return Plate(face.name, middle, face.axes[0], face.axes[1], *size, shape)


def _check(name: str, shape: tuple[int, int], **sizes: float) -> None:
    for what, size in sizes.items():
        if not (np.isfinite(size) and size > 0.0):
            raise InputError(f"receiver {name}: {what} must be above 0 and finite, not {size} m")
    if min(shape) < 1:
        raise InputError(
            f"receiver {name}: cells must have at least 1 row and 1 column, not {shape}"
        )
