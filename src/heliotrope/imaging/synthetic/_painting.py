"""The constant part of frames: the point that each pixel sees, and the paint at that point."""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera, project, undistort
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.imaging.synthetic._kernels import sample_plane
from heliotrope.imaging.synthetic.scenes import Paint, Scene, Surroundings
from heliotrope.imaging.targets.marks import polygons
from heliotrope.optics.coverage import coverage

Image = npt.NDArray[np.float32]

#: Spacing of the pixels at which the lens is inverted; interpolation by cubic splines has an error
#: of 1e-6 px.
_KNOTS = 16
#: Length of the pieces into which polygon edges are cut, px; a lens bends a piece by less than 1e-4
#: px.
_PIECE = 4.0
#: Subdivision of pixels for blurring paint, and size of a tile, px, in each direction.
_FINE, _TILE = 5, 64


@dataclass(frozen=True)
class Plane:
    """A target's plane in the frame: positions, m, visible fraction and reflectance, (H, W)."""

    u: Image
    v: Image
    share: Image
    reflectance: Image


@dataclass(frozen=True)
class PaintedScene:
    """The part of a scene that is independent of light and beams: target planes and sky."""

    planes: tuple[Plane, ...]
    sky: Image


@dataclass(frozen=True)
class SceneKey:
    """A camera and targets as a cache key; equal keys have the same effect on the picture."""

    key: tuple[object, ...]
    camera: Camera = field(compare=False)
    targets: tuple[Target, ...] = field(compare=False)


def _key(camera: Camera, targets: tuple[Target, ...]) -> tuple[object, ...]:
    arrays: list[npt.ArrayLike] = [camera.matrix, camera.distortion]
    if camera.position is not None and camera.R_enu_camera is not None:
        arrays += [camera.position, camera.R_enu_camera]
    parts: list[object] = [camera.size]
    for target in targets:
        arrays += [target.corners, target.center]
        for mark in target.marks:
            arrays.append(mark.point)
            parts.append((mark.kind, mark.size, mark.stroke, mark.turn, mark.code))
        parts.append(len(target.marks))
    return (*parts, *(as_float(array).tobytes() for array in arrays))


def painted_scene(scene: Scene) -> PaintedScene:
    """Return the constant part of a scene; the last four results are cached.

    Raises
    ------
    InputError
        If the camera has no pose, or does not see the front of a target.
    """
    view = SceneKey(_key(scene.camera, scene.targets), scene.camera, scene.targets)
    return _painted(view, scene.paint, scene.surroundings, scene.lens.base)


@lru_cache(maxsize=4)
def _painted(view: SceneKey, paint: Paint, around: Surroundings, blur: float) -> PaintedScene:
    areas, walls, free = _areas(view, around.wall, blur)
    planes = []
    for k, target in enumerate(view.targets):
        u, v = _plane_map(SceneKey(_key(view.camera, (target,)), view.camera, (target,)))
        brush = _Brush(view.camera, target, blur)
        white = _paint_target(brush, paint, (u, v, areas[k]), k)
        grey = _paint_wall(brush, around, (u, v, walls[k]), k)
        reflectance: Image = areas[k] * white + walls[k] * grey
        planes.append(Plane(u, v, areas[k] + walls[k], reflectance))
    return PaintedScene(tuple(planes), free * _sky(view.camera.size[::-1], around))


@lru_cache(maxsize=4)
def _areas(
    view: SceneKey, wall: tuple[float, float, float, float], blur: float
) -> tuple[list[Image], list[Image], Image]:
    """Return the pixel fractions covered by targets, their walls and the sky, (H, W) each."""
    camera, shape = view.camera, view.camera.size[::-1]
    free = np.ones(shape, dtype=np.float32)
    areas: list[Image] = []
    walls: list[Image] = []
    # Targets hide walls, and earlier targets hide later ones.
    for target in view.targets:
        _check_seen(camera, target)
        border = _projected(camera, target, target.plane_coordinates(target.corners))
        areas.append(np.minimum(soft_coverage([border], shape, blur), free))
        free -= areas[-1]
    for target in view.targets:
        # A wall covers the fraction that is left by everything in front of it.
        outline = _projected(camera, target, _wall(target, wall))
        behind = soft_coverage([outline], shape, blur) - (1.0 - free)
        walls.append(np.maximum(behind, np.float32(0.0)))
        free -= walls[-1]
    return areas, walls, free


def _check_seen(camera: Camera, target: Target) -> None:
    pixels = project(camera, target.corners)
    assert camera.position is not None
    front = (camera.position - target.center) @ target.normal
    if front <= 0.0 or not np.isfinite(pixels).all():
        raise InputError(
            f"camera {camera.name}: it cannot see the front of target {target.name}; place it in "
            "front of the target, facing it"
        )


def soft_coverage(polygons: list[FloatArray], shape: tuple[int, int], blur: float) -> Image:
    """Return the fraction of each pixel that polygons cover after a Gaussian blur, (H, W).

    The blur is applied before pixels sample the image, as a lens does. Blurring pixels afterwards
    would move edges by up to 0.02 px, depending on their subpixel position. Polygons (K, 2) and
    ``blur``, a standard deviation, are in pixels.
    """
    import cv2

    if blur == 0.0:
        return coverage(polygons, shape).astype(np.float32)
    margin = int(np.ceil(4.0 * blur)) + 1
    taps = np.arange(-_FINE * margin, _FINE * margin + 1) / (_FINE * blur)
    kernel = np.convolve(np.exp(-0.5 * taps**2), np.ones(_FINE), mode="same")
    kernel /= kernel.sum()
    out = coverage(polygons, shape).astype(np.float32)
    # Blur matters only near edges.
    window = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    near = np.asarray(cv2.dilate(out, window)) - np.asarray(cv2.erode(out, window)) > 0.0
    first = _FINE * margin + _FINE // 2
    for top in range(0, shape[0], _TILE):
        for left in range(0, shape[1], _TILE):
            tile = out[top : top + _TILE, left : left + _TILE]
            if not near[top : top + _TILE, left : left + _TILE].any():
                continue
            moved = [_FINE * (p - [left, top]) + first for p in polygons]
            fine = coverage(moved, tuple(_FINE * (n + 2 * margin) for n in tile.shape))
            soft = np.asarray(cv2.sepFilter2D(fine.astype(np.float32), -1, kernel, kernel))
            tile[:] = soft[first::_FINE, first::_FINE][: tile.shape[0], : tile.shape[1]]
    return out


@lru_cache(maxsize=4)
def _plane_map(view: SceneKey) -> tuple[Image, Image]:
    """Return the positions that pixels see, m right of and above the centre, (H, W) each."""
    from scipy.interpolate import RectBivariateSpline

    camera, target = view.camera, view.targets[0]
    width, height = camera.size
    assert camera.position is not None
    assert camera.R_enu_camera is not None
    gap = float((target.center - camera.position) @ target.normal)
    x, y = (np.arange(-_KNOTS, n + 4 * _KNOTS, _KNOTS, dtype=np.float64) for n in (width, height))
    knots = undistort(camera, np.stack(np.meshgrid(x, y), axis=-1))
    rows, columns = np.arange(height), np.arange(width)
    a, b = (RectBivariateSpline(y, x, knots[..., k])(rows, columns) for k in (0, 1))
    # A ray p + λ d, d = R_enu_camera (a, b, 1), ends on the plane at λ = gap / (d·N).
    R = camera.R_enu_camera
    n, right, up = target.normal @ R, target.axes[0] @ R, target.axes[1] @ R
    towards = a * n[0] + b * n[1] + n[2]
    meets = towards < 0.0
    length = np.where(meets, gap / np.where(meets, towards, 1.0), 0.0)
    start = target.plane_coordinates(camera.position)
    u = start[0] + length * (a * right[0] + b * right[1] + right[2])
    v = start[1] + length * (a * up[0] + b * up[1] + up[2])
    return u.astype(np.float32), v.astype(np.float32)


def _projected(camera: Camera, target: Target, polygon: FloatArray) -> FloatArray:
    """Return a polygon (K, 2) in the plane, m, as pixels (L, 2), distorted by the lens."""
    ends = np.roll(polygon, -1, axis=0)
    rough = project(camera, target.point(np.stack([polygon, ends])))
    if not np.isfinite(rough).all():
        raise InputError(
            f"camera {camera.name}: part of the wall around target {target.name} is behind it; "
            "make the surroundings' wall smaller"
        )
    pieces = np.ceil(np.linalg.norm(rough[1] - rough[0], axis=-1) / _PIECE).astype(int)
    fine = [
        start + (np.arange(max(n, 1)) / max(n, 1))[:, None] * (end - start)
        for start, end, n in zip(polygon, ends, np.minimum(pieces, 4096), strict=True)
    ]
    return project(camera, target.point(np.concatenate(fine)))


def _wall(target: Target, wall: tuple[float, float, float, float]) -> FloatArray:
    left, right, up, down = wall
    corners = target.plane_coordinates(target.corners)
    low, high = corners.min(axis=0) - [left, down], corners.max(axis=0) + [right, up]
    return np.array([(low[0], high[1]), high, (high[0], low[1]), low])


def _texture(
    rng: np.random.Generator, low: FloatArray, high: FloatArray, coarse: float, amplitude: float
) -> tuple[FloatArray, float]:
    """Return smooth noise around 1 over a rectangle, of grain size ``coarse`` m, and its step."""
    from scipy.ndimage import zoom

    columns, rows = (np.ceil((high - low) / coarse).astype(int) + 4).tolist()
    values = zoom(rng.standard_normal((rows, columns)), 6, order=3, grid_mode=True, mode="nearest")
    return np.maximum(1.0 + amplitude * as_float(values), 0.05), coarse / 6.0


@dataclass(frozen=True)
class _Brush:
    """Paints polygons of a target's plane over a picture."""

    camera: Camera
    target: Target
    blur: float

    def lay(self, reflectance: Image, shapes: list[FloatArray], value: float) -> None:
        """Paint polygons of the plane (m) over the picture."""
        outlines = [_projected(self.camera, self.target, shape) for shape in shapes]
        corners = np.concatenate(outlines)
        size = np.array(reflectance.shape[::-1])
        margin = 1 + int(np.ceil(4.0 * self.blur))
        low = np.clip(np.floor(corners.min(axis=0)).astype(int) - margin, 0, size)
        high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + margin + 1, 0, size)
        if (high <= low).any():
            return
        window = reflectance[low[1] : high[1], low[0] : high[0]]
        extent = (window.shape[0], window.shape[1])
        share = soft_coverage([shape - low for shape in outlines], extent, self.blur)
        window += share * (np.float32(value) - window)


def _paint_target(
    brush: _Brush, paint: Paint, place: tuple[Image, Image, Image], number: int
) -> Image:
    target = brush.target
    rng = np.random.default_rng([1, paint.seed, number])
    corners = target.plane_coordinates(target.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    grid, step = _texture(rng, low, high, 0.3, paint.wear)
    origin = low - 0.3
    y, x = (np.arange(n) * step for n in grid.shape)
    for _ in range(paint.stains):
        middle, size = rng.uniform(low, high) - origin, rng.uniform(0.1, 0.8, 2)
        spot = np.exp(-0.5 * ((y - middle[1]) / size[1]) ** 2)[:, None]
        spot = spot * np.exp(-0.5 * ((x - middle[0]) / size[0]) ** 2)
        grid = grid * (1.0 - rng.uniform(0.0, paint.stain) * spot)
    white = np.zeros_like(place[0])
    sample_plane(*place, grid * paint.reflectance, origin, step, white)
    if paint.patch > 0.0:
        half, middle = rng.uniform(0.3, 0.8, 2), rng.uniform(low + 1.0, high - 1.0)
        box = middle + np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) * half
        brush.lay(white, [box], paint.patch)
    seams = []
    for axis in (0, 1):
        for k in range(1, paint.panels[axis]):
            at = low[axis] + (high - low)[axis] * k / paint.panels[axis]
            edges = np.array([low, high])
            edges[:, axis] = at - 0.5 * paint.seam_width, at + 0.5 * paint.seam_width
            (x0, y0), (x1, y1) = edges
            seams.append(np.array([(x0, y1), (x1, y1), (x1, y0), (x0, y0)]))
    if paint.seam_width > 0.0:
        for seam in seams:
            brush.lay(white, [seam], paint.seam)
    for mark in target.marks:
        brush.lay(white, mark_shapes(target, mark), paint.mark)
    return white


def mark_shapes(target: Target, mark: Mark) -> list[FloatArray]:
    """Return a mark's dark polygons, in metres right of and above the target's centre."""
    point = target.plane_coordinates(mark.point)
    return [point + shape for shape in polygons(mark)]


def _paint_wall(
    brush: _Brush, around: Surroundings, place: tuple[Image, Image, Image], number: int
) -> Image:
    target = brush.target
    rng = np.random.default_rng([2, around.seed, number])
    ends = _wall(target, around.wall)
    low, high = ends.min(axis=0), ends.max(axis=0)
    grid, step = _texture(rng, low, high, 1.5, around.texture)
    grey = np.zeros_like(place[0])
    sample_plane(*place, grid * around.reflectance, low - 1.5, step, grey)
    reach = np.array([target.width, target.height])
    near_low, near_high = np.maximum(low, -1.2 * reach), np.minimum(high, 1.2 * reach)
    for _ in range(around.clutter):
        half = 0.5 * np.exp(rng.uniform(np.log(0.05), np.log(1.5), 2))
        box = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)]) * half
        # The boxes stand beside the target, which would otherwise hide them.
        middle = rng.uniform(near_low, near_high)
        k = int(np.argmax(np.abs(middle) / reach))
        if abs(middle[k]) < 0.55 * reach[k]:
            middle[k] = (1.0 if middle[k] > 0.0 else -1.0) * rng.uniform(0.55, 0.7) * reach[k]
        box = box + middle
        brush.lay(grey, [box], rng.uniform(0.04, 0.8))
    return grey


def _sky(shape: tuple[int, int], around: Surroundings) -> Image:
    import cv2

    rng = np.random.default_rng([3, around.seed])
    rough = rng.standard_normal((8, 10)).astype(np.float32)
    clouds = cv2.resize(rough, shape[::-1], interpolation=cv2.INTER_CUBIC)
    # The sky is brighter towards the horizon.
    height = np.linspace(0.85, 1.15, shape[0], dtype=np.float32)[:, None]
    return np.maximum(height * (1.0 + np.float32(around.texture) * np.asarray(clouds)), 0.0)
