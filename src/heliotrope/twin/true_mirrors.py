"""True mirrors of a simulated field, as its cameras see them."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.optics import Mirrors, Scene, Shading, centroid_shift, equal_facets
from heliotrope.twin.boards.board import Board

#: Light farther from a target's centre than this many half diagonals is omitted.
NEAR = 2.0
#: Cosine of incidence below which the light of a mirror is too weak to draw.
GRAZING = 0.05


@dataclass(frozen=True)
class TrueMirror:
    """True position and size of a mirror.

    Attributes
    ----------
    heliostat
        Name.
    vertex
        Vertex of the mirror, ENU, m, (3,).
    normal
        Unit normal, (3,).
    width, height
        m.
    neighbours
        Mirrors that may shade or block this mirror; None if there are none.
    """

    heliostat: str
    vertex: FloatArray
    normal: FloatArray
    width: float = 3.0
    height: float = 2.0
    neighbours: Mirrors | None = None

    def lit_centroid(self, target: Target, sun: FloatArray) -> tuple[FloatArray, float]:
        """Return the beam centroid on a target's plane, ENU, m, (3,), and the mirror's lit share.

        NaN and 0 if neighbours hide the whole mirror. The facets are canted at the target's
        distance.
        """
        point = self.on(target, sun)
        if self.neighbours is None or not np.isfinite(point).all():
            return point, 1.0
        slant = float(np.linalg.norm(point - self.vertex))
        facets = equal_facets(self.width, self.height, (1, 1), slant)
        effect = centroid_shift(
            target,
            self.vertex,
            sun,
            self.normal,
            facets,
            self.neighbours,
            facet_focal=slant,
        )
        return point + effect.shift @ target.axes, 1.0 - effect.hidden

    def on(self, target: Target, sun: FloatArray) -> FloatArray:
        """Return where the reflected ray meets a target's plane, ENU, m, (3,); NaN if nowhere."""
        if not float(self.normal @ sun) > GRAZING:
            return np.full(3, np.nan)
        return target.intersect(self.vertex, reflect(sun, self.normal))


def mirrors_of(
    boards: Mapping[str, Board], width: float = 3.0, height: float = 2.0
) -> Callable[[], Sequence[TrueMirror]]:
    """Return a function that looks up the mirrors of boards by name; all have one size in m."""

    def mirrors() -> Sequence[TrueMirror]:
        return [TrueMirror(name, *board.mirror(), width, height) for name, board in boards.items()]

    return mirrors


def mirrors_near(
    target: Target,
    sun: FloatArray,
    stand: tuple[FloatArray, FloatArray],
    names: tuple[str, ...],
    sizes: FloatArray,
    reach: float = NEAR,
    beside: npt.NDArray[np.intp] | None = None,
) -> list[TrueMirror]:
    """Return the mirrors whose rays meet the plane of a target near its centre.

    Parameters
    ----------
    target
        Target, of which only the corners and the normal are used.
    sun
        Unit vector to the sun, (3,).
    stand
        Unit normals and vertices of N mirrors, each (N, 3).
    names
        Names of the N heliostats.
    sizes
        Width and height of the mirrors, m, (N, 2).
    reach
        Largest distance from the centre, in half diagonals of the target.
    beside
        Indices of the neighbours of each mirror, (N, J); None if no neighbour hides anything.
    """
    middle = np.asarray(target.corners).mean(axis=0)
    limit = reach * 0.5 * float(np.hypot(target.width, target.height))
    facing, vertex = stand
    cosine = facing @ sun
    rays = 2.0 * cosine[:, None] * facing - sun
    with np.errstate(divide="ignore", invalid="ignore"):
        along = ((middle - vertex) @ target.normal) / (rays @ target.normal)
    away = np.linalg.norm(vertex + along[:, None] * rays - middle, axis=-1)
    hits = np.flatnonzero((cosine > GRAZING) & (along > 0.0) & (away <= limit)).tolist()
    hiding: dict[int, Mirrors] = {}
    if beside is not None and beside.shape[1] and hits:
        rows = np.unique(np.concatenate([np.array(hits), beside[hits].ravel()]))
        aims = vertex + np.linalg.norm(middle - vertex, axis=-1, keepdims=True) * rays
        there = Mirrors.of(vertex[rows], facing[rows], tuple(sizes[rows].T), aims[rows])
        shading = Shading(Scene(sun, 0.0, there, ()))
        for i, row in zip(hits, np.searchsorted(rows, hits).tolist(), strict=True):
            if len(others := shading.hiding(row)):
                hiding[i] = there.take(others)
    return [
        TrueMirror(
            names[i], vertex[i], facing[i], float(sizes[i, 0]), float(sizes[i, 1]), hiding.get(i)
        )
        for i in hits
    ]


def within(target: Target, point: FloatArray, share: float = 0.0) -> bool:
    """Return whether a point lies within a multiple of a target's half diagonal from its centre."""
    if not np.isfinite(point).all():
        return False
    away = np.abs(target.plane_coordinates(point) - target.plane_coordinates(_middle(target)))
    half = 0.5 * np.array([target.width, target.height])
    if share > 0.0:
        return bool(np.linalg.norm(away) <= share * np.linalg.norm(half))
    return bool((away <= half).all())


def _middle(target: Target) -> FloatArray:
    return np.asarray(target.corners.mean(axis=0))
