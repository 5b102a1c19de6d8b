"""Render photographs of a simulated flight: ground, shadows, mirrors, sky and lamp.

Light is measured in units of the sensor's full scale. The fraction of a pixel that a facet covers
is exact, and the lamp's reflections are at the exact positions from `heliotrope.airborne.mirror`.
Lens and motion blur are applied to the whole picture, followed by noise, clipping, the sRGB curve
and JPEG.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne._photo_metadata import RTK_FIXED, Metadata, exif_and_xmp
from heliotrope.airborne.coded_targets import CELLS, CodedTarget, white_cells
from heliotrope.airborne.coded_targets import MARGIN as SHEET_MARGIN
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.photo import LedCamera, Photo, gimbal_of_rotation, write_camera
from heliotrope.airborne.simulate.simulation import Flight, exact_reflections
from heliotrope.airborne.standing import MirrorPoses, write_commands
from heliotrope.errors import InputError
from heliotrope.field.camera import undistort
from heliotrope.files.text import write_file
from heliotrope.geometry import FloatArray, as_float, direction, enu_to_geodetic, normalize
from heliotrope.optics.coverage import coverage

Light = npt.NDArray[np.float32]
Picture = npt.NDArray[np.uint8]

#: Relative blue, green and red of sky, ground and lamp.
SKY_TINT, GROUND_TINT, LED_TINT = (1.25, 1.0, 0.80), (0.72, 0.95, 1.15), (1.0, 1.0, 1.0)
_TEXTURE, _TEXEL = 1024, 0.04
#: Light of a coded target's sheet and ink, as fractions of full scale.
PAPER, INK = 0.55, 0.02


@dataclass(frozen=True)
class Conditions:
    """Light, lens and sensor.

    Attributes
    ----------
    sky
        Light from the sky at 45° elevation, as a fraction of full scale.
    ground
        Mean light from the ground, as a fraction of full scale.
    contrast
        Relative standard deviation of the ground's texture.
    sun
        Azimuth and elevation of the sun, rad, for shadows; None for no shadows.
    led
        Light of the lamp's reflection, summed over its pixels, for a flat mirror with the lamp and
        the camera 100 m away. The light decreases with the square of the distance.
    led_spread
        Standard deviation of the lamp's spot on the mirror due to the roughness of the glass, m.
    blur
        Standard deviation of the lens blur, pixels.
    motion
        Motion of the image during the exposure, pixels to the right and down.
    electrons
        Number of electrons at full scale.
    read_noise
        Electrons.
    quality
        JPEG quality, 1 to 100.
    clouds
        Relative standard deviation of the sky's light due to clouds. Each facet shows a uniform
        value.
    speed, exposure
        Speed of the drone to the right, m/s, and exposure time, s, during which the image moves.
    """

    sky: float = 0.55
    ground: float = 0.16
    contrast: float = 0.25
    sun: tuple[float, float] | None = (math.radians(150.0), math.radians(50.0))
    led: float = 6.0
    led_spread: float = 0.01
    blur: float = 0.8
    motion: tuple[float, float] = (0.0, 0.0)
    electrons: float = 9000.0
    read_noise: float = 6.0
    quality: int = 95
    clouds: float = 0.0
    speed: float = 0.0
    exposure: float = 0.001

    def __post_init__(self) -> None:
        lights = ("sky", "ground", "contrast", "led", "led_spread", "blur", "read_noise")
        for name in (*lights, "clouds", "speed", "exposure"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"conditions: {name} must be 0 or more, not {value}")
        if not (self.electrons > 0.0 and 1 <= self.quality <= 100):
            raise InputError(
                "conditions: electrons must be above 0 and quality between 1 and 100, not "
                f"{self.electrons} and {self.quality}"
            )


def night(led: float = 6.0) -> Conditions:
    """Return conditions of a moonlit night, with a longer exposure and a dimmed lamp."""
    return Conditions(sky=0.05, ground=0.012, sun=None, led=led, electrons=2500.0, read_noise=8.0)


def dark(led: float = 6.0) -> Conditions:
    """Return conditions of a moonless night, in which only the lamp is visible in the mirrors."""
    return Conditions(sky=4e-4, ground=1e-4, sun=None, led=led, electrons=2500.0, read_noise=8.0)


@dataclass(frozen=True)
class FlightScene:
    """Content of a photograph.

    Attributes
    ----------
    stand, shapes
        The mirrors.
    ground
        Height of the ground, ENU m.
    conditions
        Light, lens and sensor.
    targets
        Coded targets on the ground.
    """

    stand: MirrorPoses
    shapes: Sequence[MirrorShape]
    ground: float = 0.0
    conditions: Conditions = field(default_factory=Conditions)
    targets: Sequence[CodedTarget] = ()


def render(
    scene: FlightScene, camera: LedCamera, photo: Photo, lamp: Reflections, seed: int = 0
) -> Picture:
    """Return the photograph, blue-green-red, uint8 (H, W, 3).

    Parameters
    ----------
    scene
        Mirrors, ground and light.
    camera, photo
        Lens, and true exterior orientation.
    lamp
        The lamp's reflections in this photograph; ``heliostat`` is the index of the mirror in the
        scene.
    seed
        Seed of the noise, 0 or more.
    """
    conditions = scene.conditions
    image = _ground(camera, photo, scene)
    order = np.argsort(-np.linalg.norm(scene.stand.vertex - photo.position, axis=-1))
    if conditions.sun is not None:
        _shadows(image, camera, photo, scene)
    for target in scene.targets:
        _target(image, camera, photo, target)
    hit = {int(h): np.flatnonzero(lamp.heliostat == h) for h in np.unique(lamp.heliostat)}
    for row in order:
        # Nearer mirrors hide mirrors and spots behind them.
        _mirror(image, camera, photo, scene, int(row))
        for k in hit.get(int(row), ()):
            _spot(image, camera, photo, scene, lamp, int(k))
    return _expose(_blurred(image, conditions), conditions, seed)


def sky_light(ray: npt.ArrayLike, conditions: Conditions) -> FloatArray:
    """Return the sky's light (...) in unit directions (..., 3), brighter towards the horizon."""
    unit = as_float(ray)
    up = np.clip(unit[..., 2], 0.0, 1.0)
    light = conditions.sky * (1.0 + 0.5 * (math.sqrt(0.5) - up))
    if conditions.clouds > 0.0:
        # The texture of the cloud layer repeats every 0.5 rad overhead.
        cell = unit[..., :2] / np.maximum(up, 0.05)[..., None] * (2 * _TEXTURE)
        i, j = np.moveaxis(np.floor(cell).astype(np.intp) % _TEXTURE, -1, 0)
        light = light * np.clip(1.0 + conditions.clouds * _texture()[i, j], 0.2, 1.7)
    return as_float(light)


# -- parts of a picture ----------------------------------------------------------------


@lru_cache(maxsize=1)
def _texture() -> Light:
    """Return a ground texture that repeats every 41 m, with mean 0 and spread 1."""
    rng = np.random.default_rng(20)
    k = np.hypot(*np.meshgrid(*[np.fft.fftfreq(_TEXTURE)] * 2)) * _TEXTURE
    spectrum = np.fft.fft2(rng.standard_normal((_TEXTURE, _TEXTURE)))
    rough = np.fft.ifft2(spectrum / np.maximum(k, 3.0) ** 0.8).real
    return np.asarray(rough / rough.std(), np.float32)


def _ground(camera: LedCamera, photo: Photo, scene: FlightScene) -> Light:
    import cv2

    width, height = camera.size
    conditions, step = scene.conditions, 16
    columns, rows = width // step + 2, height // step + 2
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1) * float(step)
    plane = undistort(camera, grid)
    rays = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1) @ photo.rotation.T
    down = -rays[..., 2] / np.linalg.norm(rays, axis=-1)
    # Rays to the horizon or above see haze.
    depth = (photo.position[2] - scene.ground) / np.maximum(-rays[..., 2], 0.02)
    place = (photo.position[:2] + depth[..., None] * rays[..., :2]) / _TEXEL
    place = np.mod(place - place.min(axis=(0, 1)), 1e7).astype(np.float32)
    matrix = np.array([[1.0 / step, 0.0, 0.0], [0.0, 1.0 / step, 0.0]])
    turned: dict[str, Any] = {"flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP}
    maps = [
        np.mod(cv2.warpAffine(place[..., k], matrix, (width, height), **turned), _TEXTURE)
        for k in (0, 1)
    ]
    grains = cv2.remap(
        _texture(),
        maps[0],
        maps[1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_WRAP,
    )
    light = conditions.ground * np.maximum(1.0 + conditions.contrast * grains, 0.05)
    if (down < 0.05).any():
        share = cv2.warpAffine((down < 0.05).astype(np.float32), matrix, (width, height), **turned)
        light = light + share * (conditions.sky - light)
    return np.asarray(light[..., None] * np.array(GROUND_TINT, np.float32), np.float32)


def _shadows(image: Light, camera: LedCamera, photo: Photo, scene: FlightScene) -> None:
    sun = scene.conditions.sun
    if sun is None or sun[1] <= 0.05:
        return
    ray = -direction(*sun)
    corners = scene.stand.corners
    fall = (corners[..., 2] - scene.ground) / -ray[2]
    for outline in corners + fall[..., None] * ray:
        pixels = photo.pixels(camera, outline)
        if np.isfinite(pixels).all():
            _cover(image, pixels, np.zeros(3), 0.55)


def _target(image: Light, camera: LedCamera, photo: Photo, target: CodedTarget) -> None:
    """Draw a coded target with its white sheet, black square and white cells."""
    rows, columns = np.nonzero(white_cells(target.number))
    low = np.array([-SHEET_MARGIN, 0.0, *columns])
    top = np.array([-SHEET_MARGIN, 0.0, *rows])
    wide = np.array([CELLS + 2.0 * SHEET_MARGIN, CELLS, *np.ones(len(rows))])
    right, down = np.array([0.0, 1.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0, 1.0])
    squares = target.at(low[:, None] + wide[:, None] * right, top[:, None] + wide[:, None] * down)
    pixels = photo.pixels(camera, squares)
    if np.isfinite(pixels).all():
        for k, outline in enumerate(pixels):
            _cover(image, outline, np.full(3, INK if k == 1 else PAPER), 1.0)


def _mirror(image: Light, camera: LedCamera, photo: Photo, scene: FlightScene, row: int) -> None:
    shape, turned = scene.shapes[row], scene.stand.rotation[row]
    vertex = scene.stand.vertex[row]
    away = photo.position - vertex
    if away @ turned[:, 2] <= 0.0:
        return
    corners = vertex + shape.corners @ turned.T
    middle = vertex + shape.center @ turned.T
    pixels = photo.pixels(camera, corners)
    width, height = camera.size
    inside = np.isfinite(pixels).all()
    if (
        not inside
        or (pixels.max(axis=(0, 1)) < 0).any()
        or (pixels.min((0, 1)) > [width, height]).any()
    ):
        return
    ray = normalize(photo.position - middle)
    normals = shape.axes[:, 2] @ turned.T
    back = 2.0 * np.sum(ray * normals, axis=-1, keepdims=True) * normals - ray
    light = sky_light(back, scene.conditions)
    for outline, bright in zip(pixels, light, strict=True):
        _cover(image, outline, bright * np.asarray(SKY_TINT), 1.0)


def _cover(image: Light, outline: FloatArray, colour: FloatArray, strength: float) -> None:
    """Blend a colour over a polygon (K, 2), into each pixel by its covered fraction."""
    height, width = image.shape[:2]
    low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2, [width, height])
    if (high <= low).any():
        return
    share = coverage([outline - low], (high[1] - low[1], high[0] - low[0])).astype(np.float32)
    part = image[low[1] : high[1], low[0] : high[0]]
    alpha = (np.float32(strength) * share)[..., None]
    part += alpha * (colour.astype(np.float32) - part)


def _spot(
    image: Light, camera: LedCamera, photo: Photo, scene: FlightScene, lamp: Reflections, k: int
) -> None:
    row, facet = int(lamp.heliostat[k]), lamp.facet[k : k + 1]
    point = scene.shapes[row].point_at(facet, lamp.xy[k : k + 1])[0]
    place = scene.stand.vertex[row] + scene.stand.rotation[row] @ point
    pixel = photo.pixels(camera, place)
    width, height = camera.size
    if not np.isfinite(pixel).all():
        return
    distance = float(np.linalg.norm(place - photo.position))
    # Below a third of a pixel, the width of the spot no longer matters.
    sigma = max(scene.conditions.led_spread * camera.focal / distance, 0.3)
    reach = math.ceil(4.0 * sigma) + 1
    x, y = (np.arange(round(c) - reach, round(c) + reach + 1) for c in pixel.tolist())
    spread = [_bell(axis, c, sigma) for axis, c in zip((x, y), pixel, strict=True)]
    light = scene.conditions.led * (100.0 / distance) ** 2 * np.outer(spread[1], spread[0])
    keep_x, keep_y = (x >= 0) & (x < width), (y >= 0) & (y < height)
    if not (keep_x.any() and keep_y.any()):
        return
    part = image[y[keep_y][0] : y[keep_y][-1] + 1, x[keep_x][0] : x[keep_x][-1] + 1]
    part += np.asarray(light[keep_y][:, keep_x, None] * np.asarray(LED_TINT), np.float32)


def _bell(cells: npt.NDArray[np.intp], center: float, sigma: float) -> FloatArray:
    """Return the fraction of a normal distribution that falls in each cell of width 1."""
    from scipy.special import ndtr

    edges = np.concatenate([cells - 0.5, cells[-1:] + 0.5])
    return as_float(np.diff(ndtr((edges - center) / sigma)))


def _blurred(image: Light, conditions: Conditions) -> Light:
    import cv2

    edge = cv2.BORDER_REPLICATE
    if conditions.blur > 0.0:
        reach = 2 * math.ceil(3.5 * conditions.blur) + 1
        smooth = cv2.GaussianBlur(image, (reach, reach), conditions.blur, borderType=edge)
        image = np.asarray(smooth, np.float32)
    length = math.hypot(*conditions.motion)
    if length > 0.0:
        reach = math.ceil(0.5 * length) + 1
        line = np.zeros((2 * reach + 1, 2 * reach + 1))
        count = 8 * reach
        for part in (np.arange(count) + 0.5) / count - 0.5:
            u, v = (reach + part * m for m in conditions.motion)
            i, j = int(v), int(u)
            a, b = u - j, v - i
            line[i : i + 2, j : j + 2] += np.outer((1 - b, b), (1 - a, a)) / count
        image = np.asarray(cv2.filter2D(image, -1, line[::-1, ::-1], borderType=edge), np.float32)
    return image


@lru_cache(maxsize=1)
def _curve() -> npt.NDArray[np.uint8]:
    share = np.linspace(0.0, 1.0, 16384)
    curve = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)
    return np.round(255.0 * curve).astype(np.uint8)


def _expose(image: Light, conditions: Conditions, seed: int) -> Picture:
    if seed < 0:
        raise InputError(f"render: seed must be 0 or more, not {seed}")
    rng = np.random.Generator(np.random.SFC64(seed))
    flat = image.reshape(-1)
    out = np.empty(flat.size, np.uint8)
    curve, block = _curve(), 2**20
    variance = np.float32((conditions.read_noise / conditions.electrons) ** 2)
    per = np.float32(1.0 / conditions.electrons)
    for a in range(0, flat.size, block):
        level = flat[a : a + block]
        noise = rng.standard_normal(level.size, dtype=np.float32)
        level = level + noise * np.sqrt(level * per + variance)
        index = np.clip(level, 0.0, 1.0) * np.float32(len(curve) - 1) + np.float32(0.5)
        out[a : a + block] = curve[index.astype(np.uint16)]
    return out.reshape(image.shape)


# -- files -----------------------------------------------------------------------------


def write_photo(
    path: str | Path,
    picture: Picture,
    recorded: Photo,
    origin: tuple[float, float, float],
    quality: int = 95,
) -> None:
    """Write a JPEG with the drone's metadata in EXIF and in DJI's XMP.

    Parameters
    ----------
    path
        The file.
    picture
        Blue-green-red, (H, W, 3).
    recorded
        Position, rotation and time as recorded.
    origin
        Latitude and longitude (degrees) and height (m) of the ENU origin.
    quality
        JPEG quality, 1 to 100.
    """
    import cv2

    latitude, longitude, height = enu_to_geodetic(recorded.position, origin)
    yaw, pitch, roll = (math.degrees(a) for a in gimbal_of_rotation(recorded.rotation))
    exif, xmp = exif_and_xmp(
        Metadata(
            (picture.shape[1], picture.shape[0]),
            recorded.time,
            float(latitude),
            float(longitude),
            float(height),
            yaw,
            pitch,
            roll,
            recorded.sigma_position,
            RTK_FIXED,
        )
    )
    good, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, int(quality)])
    if not good:
        raise InputError(f"{path}: the picture cannot be encoded as JPEG")
    data = encoded.tobytes()
    segments = b""
    for body in (exif, b"http://ns.adobe.com/xap/1.0/\0" + xmp):
        segments += b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body
    whole = data[:2] + segments + data[2:]
    write_file(path, lambda stream: stream.write(whole))


def render_flight(
    flight: Flight,
    folder: str | Path,
    origin: tuple[float, float, float],
    *,
    conditions: Conditions | None = None,
    seed: int = 0,
    progress: Any = None,
) -> Reflections:
    """Write the photographs, camera and commands of a flight; return its true reflections.

    Parameters
    ----------
    flight
        A flight simulated by `heliotrope.airborne.simulate.simulation.fly`.
    folder
        Folder, created if it does not exist.
    origin
        See `write_photo`.
    conditions
        Light, lens and sensor; default: a clear day.
    seed
        Seed of the noise.
    progress
        Called with the numbers of photographs (done, total).
    """
    light = conditions or Conditions()
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    exact = exact_reflections(flight)
    ground = float(np.median(flight.heliostats.position[:, 2]))
    scene = FlightScene(flight.truth, flight.shapes, ground, light)
    write_camera(place / "camera.toml", flight.known_camera)
    write_commands(place / "commands.csv", flight.heliostats.names, flight.counts)
    middle = flight.truth.vertex.mean(axis=0)
    for k, (taken, recorded) in enumerate(zip(flight.taken, flight.recorded, strict=True)):
        if light.speed > 0.0:
            away = float(np.linalg.norm(taken.position - middle))
            moved = light.speed * light.exposure * flight.camera.focal / away
            scene = replace(scene, conditions=replace(light, motion=(-moved, 0.0)))
        lamp = exact.take(np.flatnonzero(exact.photo == k))
        picture = render(scene, flight.camera, taken, lamp, seed + k)
        write_photo(place / recorded.name, picture, recorded, origin, light.quality)
        if progress is not None:
            progress(k + 1, len(flight.taken))
    return exact
