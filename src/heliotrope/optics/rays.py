"""An independent check of the flux: random rays traced through triangles by `embreex`.

The tracer shares only the scene and the random sun rays with the flux engine. Each ray begins on a
mirror, at a random point with a random slope error. It is traced backwards to a random point of the
sun; an object on this path shades it. It is also reflected forwards; an object before a surface
blocks it. The tracer is not meant for production, because 10⁷ rays take about half a minute.

As in the engine, two effects are neglected: the sagitta of the mirrors, which are treated as flat
when they obstruct their neighbours, and the shading of one surface by another.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.tower import Tower
from heliotrope.geometry import FloatArray, as_float, normalize, tangent_axes
from heliotrope.optics.attenuation import air_loss
from heliotrope.optics.scene import Scene
from heliotrope.optics.sun_shape import SunShape
from heliotrope.optics.surfaces import Cavity, Cylinder, Mesh, Plate, Surface

#: Number of rays traced at once.
_BATCH = 250_000
#: Limits of the number of rays.
RAYS = (1_000, 1_000_000_000)
#: Rays start in front of their mirror, at this fraction of the field's size, so that they do not
#: hit it: a few steps of single precision. A centimetre would lift them over 1 % of a small shadow.
_OFF = 5e-7
#: Number of sides of a tower.
_SIDES = 96


@dataclass(frozen=True, eq=False)
class RayTrace:
    """Ray-traced results for a scene with H mirrors and K surfaces.

    Attributes
    ----------
    flux, error
        Flux on each surface, W/m², and its standard error, in the shape of the surface's cells.
    power, power_error
        Power on each surface, W, and its standard error, (K,).
    cosine, shading, blocking, lit, intercept
        Efficiencies of each mirror, (H,), as in `Efficiencies`; NaN where no ray was traced.
    count
        Number of rays from each mirror, (H,).
    """

    flux: tuple[FloatArray, ...]
    error: tuple[FloatArray, ...]
    power: FloatArray
    power_error: FloatArray
    cosine: FloatArray
    shading: FloatArray
    blocking: FloatArray
    lit: FloatArray
    intercept: FloatArray
    count: FloatArray


def trace(
    scene: Scene,
    rays: float = 1e6,
    *,
    sun: str | SunShape = "limb",
    air: str | float = "clear",
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> RayTrace:
    """Trace random rays through a scene.

    Parameters
    ----------
    scene
        Mirrors, surfaces, towers, and a sun vector.
    rays
        Number of rays from the whole field, 1e3 to 1e9; each mirror gets rays in proportion to its
        area.
    sun, air
        As for `FieldFlux`.
    seed
        Seed of the random numbers.
    progress
        Called with the numbers of rays (done, total).

    Raises
    ------
    InputError
        If the number of rays is out of range, a name is unknown, or `embreex` is not installed.
    """
    if not RAYS[0] <= rays <= RAYS[1]:
        raise InputError(f"rays must be between {RAYS[0]:,} and {RAYS[1]:,}, not {rays:g}")
    shape = SunShape.of(sun)
    tracer = _Tracer(scene, shape, np.random.default_rng(seed))
    power, total = tracer.power(air), int(rays)
    # Each patch gets rays in proportion to its power, rounded from a random start; all rays carry
    # the same power.
    ends = np.cumsum(power) / power.sum() * total if power.sum() > 0.0 else np.zeros(len(power))
    begins = np.floor(np.append(0.0, ends) + tracer.rng.random()).astype(np.int64)
    counts = np.diff(begins)
    tally = _Tally(scene, float(power.sum()) / total)
    done = 0
    for first in range(0, int(counts.sum()), _BATCH):
        last = min(first + _BATCH, int(counts.sum()))
        rows = np.searchsorted(np.cumsum(counts), np.arange(first, last), side="right")
        tally.add(*tracer.batch(rows))
        done = last
        if progress is not None:
            progress(done, int(counts.sum()))
    return tally.result()


class _Tracer:
    """Patches (mirrors, or their facets) and everything that rays can meet."""

    def __init__(self, scene: Scene, shape: SunShape, rng: np.random.Generator) -> None:
        self.scene, self.shape, self.rng = scene, shape, rng
        mirrors, facets = scene.mirrors, scene.mirrors.facets
        if facets is None:
            self.mirror = np.arange(len(mirrors))
            self.center, self.tilt = np.zeros((len(mirrors), 2)), np.zeros((len(mirrors), 2))
            self.half = 0.5 * np.stack([mirrors.width, mirrors.height], axis=-1)
            self.focal, self.slope = mirrors.focal, mirrors.slope
        else:
            real = facets.half.min(axis=-1)[mirrors.kind] > 0.0
            self.mirror, column = np.nonzero(real)
            row = mirrors.kind[self.mirror]
            self.center, self.tilt = facets.center[row, column], facets.tilt[row, column]
            self.half, self.focal = facets.half[row, column], facets.focal[row, column]
            own = 0.0 if facets.slope is None else facets.slope[row, column]
            self.slope = as_float(np.hypot(mirrors.slope[self.mirror], own))
        self.origin = mirrors.center.mean(axis=0)
        size = np.linalg.norm(mirrors.center - self.origin, axis=-1).max(initial=0.0)
        self.off = _OFF * max(100.0, float(size))
        self.solids = _embree([*self._panels(), *map(_sides, scene.towers)], self.origin)
        self.meshes = {id(m): _embree([m.corners], self.origin) for m in _meshes(scene.surfaces)}
        across, along = tangent_axes(scene.sun)
        self.axes = np.stack([across, along])

    def _panels(self) -> list[FloatArray]:
        """Return two triangles for each patch; gaps between facets let light through."""
        m, k = self.scene.mirrors, self.mirror
        a, b = self.half[:, :1] * m.right[k], self.half[:, 1:] * m.up[k]
        middle = m.center[k] + self.center[:, :1] * m.right[k] + self.center[:, 1:] * m.up[k]
        corners = [middle - a - b, middle + a - b, middle + a + b, middle - a + b]
        return [np.stack([corners[i] for i in three], axis=1) for three in ((0, 1, 2), (0, 2, 3))]

    def power(self, air: str | float) -> FloatArray:
        """Return the unobstructed power from each patch, after atmospheric attenuation, W."""
        scene, m, k = self.scene, self.scene.mirrors, self.mirror
        sent = scene.dni * m.reflectivity * m.clean * (1.0 - air_loss(m.slant, air))
        sent = sent * np.maximum(m.normal @ scene.sun, 0.0)
        if scene.dark is not None:
            sent = np.where(scene.dark, 0.0, sent)
        return as_float(sent[k] * 4.0 * self.half.prod(axis=-1))

    def batch(self, rows: np.ndarray) -> tuple[Any, ...]:
        """Trace a ray from each row of patches.

        Returns
        -------
        mirror, weight
            The mirror where each ray starts, and its power relative to the mean, (R,).
        shaded, blocked
            Masks of the shaded and the blocked rays, (R,).
        surface, cell
            The surface and the cell that each ray hits if it is not blocked, (R,); −1 if none. A
            ray through the aperture of a cavity hits the cavity, whether or not it then hits a
            cell.
        """
        m, k, rng, count = self.scene.mirrors, self.mirror[rows], self.rng, len(rows)
        place = (2.0 * rng.random((count, 2)) - 1.0) * self.half[rows]
        right, up, normal = m.right[k], m.up[k], m.normal[k]
        x, y = (self.center[rows] + place).T[..., None]
        point = m.center[k] + x * right + y * up
        # The normals of a concave mirror lean towards its axis.
        tilt = self.tilt[rows] - place / (2.0 * self.focal[rows])[:, None]
        tilt = tilt + self.slope[rows][:, None] * rng.standard_normal((count, 2))
        lean = normalize(normal + tilt[:, :1] * right + tilt[:, 1:] * up)
        light = normalize(self.scene.sun + self.shape.sample(count, rng) @ self.axes)
        ray = 2.0 * _dot(light, lean)[:, None] * lean - light
        ray = self._pointed(ray, k)
        weight = _dot(light, normal) / np.maximum(normal @ self.scene.sun, 1e-12)
        surface, cell, distance = self._met(point, ray)
        start = point + self.off * normal
        shaded = self._stopped(start, light, np.full(count, 1e6))
        blocked = self._stopped(start, ray, np.where(surface >= 0, distance, m.slant[k]))
        return k, weight, shaded, blocked, surface, cell

    def _pointed(self, ray: FloatArray, k: np.ndarray) -> FloatArray:
        """Rotate rays by random pointing errors, right and up as seen from the mirror."""
        spread = self.scene.mirrors.pointing
        if not spread.any():
            return ray
        root = np.linalg.cholesky(spread + 1e-18 * np.eye(2))[k]
        error = (root @ self.rng.standard_normal((len(ray), 2, 1)))[..., 0]
        right = normalize(np.cross(ray, [0.0, 0.0, 1.0]))
        return normalize(ray + error[:, :1] * right + error[:, 1:] * np.cross(right, ray))

    def _stopped(self, start: FloatArray, ray: FloatArray, length: FloatArray) -> np.ndarray:
        origin, along = _single(start - self.origin), _single(ray)
        hit = self.solids.run(
            origin, along, dists=_single(length - 2.0 * self.off), query="OCCLUDED"
        )
        return np.asarray(hit >= 0)

    def _met(self, point: FloatArray, ray: FloatArray) -> tuple[Any, Any, FloatArray]:
        """Return, for each ray, the first surface that it hits, the cell, and the distance."""
        surface = np.full(len(point), -1)
        cell, nearest = np.full(len(point), -1), np.full(len(point), np.inf)
        for j, receiver in enumerate(self.scene.surfaces):
            where, distance, hit = self._cell(receiver, point, ray)
            first = hit & (distance < nearest)
            surface[first], cell[first], nearest[first] = j, where[first], distance[first]
        return surface, cell, nearest

    def _cell(
        self, surface: Surface, point: FloatArray, ray: FloatArray
    ) -> tuple[Any, FloatArray, Any]:
        """Return, for each ray, the cell that it hits, the distance, and whether it hits a cell.

        A ray hits a cell only from the cell's lit side; the cell is −1 if it hits none.
        """
        if isinstance(surface, Plate | Cylinder):
            on = _on_plate if isinstance(surface, Plate) else _on_cylinder
            cell, distance = on(surface, point, ray)  # type: ignore[arg-type]
            return cell, distance, cell >= 0
        inner = surface if isinstance(surface, Mesh) else surface.inner
        crossed = self.meshes[id(inner)].run(
            _single(point - self.origin), _single(ray), output=True
        )
        cell, distance = crossed["primID"], as_float(crossed["tfar"])
        front = (cell >= 0) & (_dot(inner.cells.normal[cell], ray) < 0.0)
        if isinstance(surface, Mesh):
            return np.where(front, cell, -1), distance, front
        reached, before = _on_plate(surface.aperture, point, ray)
        return np.where(front & (reached >= 0), cell, -1), before, reached >= 0


def _on_plate(plate: Plate, point: FloatArray, ray: FloatArray) -> tuple[Any, FloatArray]:
    towards = ray @ plate.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (plate.center - point) @ plate.normal / towards
        at = point + distance[:, None] * ray - plate.center
    rows, columns = plate.shape
    x, y = at @ plate.right / plate.width + 0.5, at @ plate.up / plate.height + 0.5
    hit = (towards < 0.0) & (distance > 0.0) & (x >= 0.0) & (x < 1.0) & (y >= 0.0) & (y < 1.0)
    x, y = np.where(hit, x, 0.0), np.where(hit, y, 0.0)
    cell = (y * rows).astype(np.int64) * columns + (x * columns).astype(np.int64)
    return np.where(hit, cell, -1), as_float(distance)


def _on_cylinder(pipe: Cylinder, point: FloatArray, ray: FloatArray) -> tuple[Any, FloatArray]:
    """Return the cell in which each ray enters a cylinder from outside, and the distance.

    The cell is −1 if the ray does not enter.
    """
    frame = np.stack([pipe.front, pipe.side, pipe.axis])
    p, d = (point - pipe.center) @ frame.T, ray @ frame.T
    a, b = np.sum(d[:, :2] ** 2, axis=-1), np.sum(p[:, :2] * d[:, :2], axis=-1)
    c = np.sum(p[:, :2] ** 2, axis=-1) - pipe.radius**2
    square = b * b - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (-b - np.sqrt(square)) / a
        at = p + distance[:, None] * d
    first, last = pipe.span
    turn = np.mod(np.arctan2(at[:, 1], at[:, 0]) - first, 2.0 * np.pi) / (last - first)
    y = at[:, 2] / pipe.height + 0.5
    hit = (square > 0.0) & (distance > 0.0) & (turn < 1.0) & (y >= 0.0) & (y < 1.0)
    x, y = np.where(hit, turn, 0.0), np.where(hit, y, 0.0)
    rows, columns = pipe.shape
    cell = (y * rows).astype(np.int64) * columns + (x * columns).astype(np.int64)
    return np.where(hit, cell, -1), as_float(distance)


class _Tally:
    """Sums over rays, each of ``unit`` W on average."""

    def __init__(self, scene: Scene, unit: float) -> None:
        self.scene, self.unit = scene, unit
        self.sums = np.zeros((5, len(scene.mirrors)))
        self.cells = [np.zeros((2, len(s.cells.area))) for s in scene.surfaces]
        self.caught = np.zeros((len(scene.surfaces), 2))

    def add(
        self, mirror: Any, weight: FloatArray, shaded: Any, blocked: Any, surface: Any, cell: Any
    ) -> None:
        lit = ~(shaded | blocked)
        shares = (np.ones(len(weight)), ~shaded, ~blocked, lit, lit & (surface >= 0))
        for row, share in enumerate(shares):
            self.sums[row] += np.bincount(mirror, share, minlength=self.sums.shape[1])
        for j, sums in enumerate(self.cells):
            arrived = lit & (surface == j)
            on = arrived & (cell >= 0)
            for row in (0, 1):
                self.caught[j, row] += float((weight[arrived] ** (row + 1)).sum())
                got = weight[on] ** (row + 1)
                sums[row] += np.bincount(cell[on], got, minlength=sums.shape[1])

    def result(self) -> RayTrace:
        count, unshaded, unblocked, lit, caught = self.sums
        flux, error, power, spread = [], [], [], []
        for surface, (first, second), whole in zip(
            self.scene.surfaces, self.cells, self.caught, strict=True
        ):
            cells = surface.cells
            flux.append((self.unit * first / cells.area).reshape(cells.shape))
            error.append((self.unit * np.sqrt(second) / cells.area).reshape(cells.shape))
            power.append(self.unit * whole[0])
            # The number of rays that hit is binomially distributed, which determines the error.
            share = whole[0] / max(count.sum(), 1.0)
            spread.append(self.unit * np.sqrt(whole[1] * max(1.0 - share, 0.0)))
        with np.errstate(invalid="ignore", divide="ignore"):
            return RayTrace(
                tuple(flux),
                tuple(error),
                np.array(power),
                np.array(spread),
                cosine=self.scene.incidence,
                shading=as_float(unshaded / count),
                blocking=as_float(unblocked / count),
                lit=as_float(lit / count),
                intercept=as_float(caught / lit),
                count=as_float(count),
            )


def _embree(triangles: list[FloatArray], origin: FloatArray) -> Any:
    """Return an Embree scene of triangles, each (T, 3, 3), about an origin."""
    try:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene
    except ImportError:
        raise InputError(
            "rays: embreex is not installed; run pip install 'heliotrope[rays]'"
        ) from None
    scene = EmbreeScene()
    TriangleMesh(scene, _single(np.concatenate(triangles) - origin))
    return scene


def _sides(tower: Tower) -> FloatArray:
    """Return the sides of a prism inscribed in a tower as triangles."""
    turn = np.linspace(0.0, 2.0 * np.pi, _SIDES + 1)
    edge = tower.radius * np.stack([np.sin(turn), np.cos(turn)], axis=-1)
    edge = edge + [tower.east, tower.north]
    low, high = (np.insert(edge, 2, z, axis=1) for z in (tower.bottom, tower.top))
    lower = np.stack([low[:-1], low[1:], high[1:]], axis=1)
    return np.concatenate([lower, np.stack([low[:-1], high[1:], high[:-1]], axis=1)])


def _meshes(surfaces: tuple[Surface, ...]) -> list[Mesh]:
    inner = [s.inner if isinstance(s, Cavity) else s for s in surfaces]
    return [s for s in inner if isinstance(s, Mesh)]


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return as_float(np.einsum("ij,ij->i", a, b))


def _single(values: FloatArray) -> np.ndarray:
    """Return values in the form that Embree requires."""
    return np.ascontiguousarray(values, dtype=np.float32)
