"""Synthetic frames: a camera's view of a target with beams, and the ground truth.

Light is expressed as the irradiance (W/m²) that would make perfectly white diffuse paint equally
bright. Paint, borders and marks cover pixels by exact areas; beams are averaged over pixels. See
docs/explanation/rendering.md.
"""

from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.camera import project
from heliotrope.field.marks import Mark
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.imaging.frame import Frame, Pixels
from heliotrope.imaging.synthetic._kernels import ambient_field, expose, sample_plane
from heliotrope.imaging.synthetic._painting import Image, Plane, mark_shapes, painted_scene
from heliotrope.imaging.synthetic.scenes import (
    LensEffects,
    Paint,
    Scene,
    Sensor,
    Shadow,
    Surroundings,
    Thrown,
    example_camera,
    example_target,
    exposed,
)
from heliotrope.optics.coverage import coverage
from heliotrope.optics.mirror_image import deposit

__all__ = [
    "BeamTruth",
    "LensEffects",
    "MarkTruth",
    "Paint",
    "Rendered",
    "Scene",
    "Sensor",
    "Shadow",
    "Surroundings",
    "Thrown",
    "example_camera",
    "example_target",
    "exposed",
    "point_spread",
    "render",
]

#: Blue, green and red of beams and of ambient light in colour frames, relative to grey.
BEAM_TINT, AMBIENT_TINT = (0.80, 1.0, 1.08), (1.15, 1.0, 0.88)
#: A mark is lit if beams add this fraction of the ambient light, and covered if its contrast is
#: below this many standard deviations of the noise.
LIT, COVERED = 0.5, 3.0


@dataclass(frozen=True)
class BeamTruth:
    """The true position of a beam.

    Attributes
    ----------
    target
        Name of the target.
    centroid, point, pixel
        Centre of the energy on the plane, including light beyond the border: metres to the right of
        and above the target centre (2,), ENU metres (3,), and the pixel of that point (2,).
    centroid_on_target, pixel_on_target
        Centroid and pixel of the energy that falls on the target; NaN if none does.
    share_on_target
        Fraction of the energy on the target.
    share_clipped
        Fraction of the beam's light in the frame that falls on clipped pixels.
    peak
        Pixel value at the brightest point of the beam, as a fraction of full scale, before
        clipping.
    """

    target: str
    centroid: FloatArray
    point: FloatArray
    pixel: FloatArray
    centroid_on_target: FloatArray
    pixel_on_target: FloatArray
    share_on_target: float
    share_clipped: float
    peak: float


@dataclass(frozen=True)
class MarkTruth:
    """The true appearance of a mark.

    Attributes
    ----------
    target, name
        Names of the target and of the mark.
    pixel
        Pixel of the mark's point, (2,).
    in_frame
        Whether the pixel is in the frame.
    light
        Mean flux of the beams on the mark relative to the ambient light.
    contrast
        Mean pixel value of the paint minus that of the mark, after clipping, as a fraction of full
        scale.
    lit
        Whether ``light`` is above one half.
    covered
        Whether the contrast is below three standard deviations of the pixel noise.
    """

    target: str
    name: str
    pixel: FloatArray
    in_frame: bool
    light: float
    contrast: float
    lit: bool
    covered: bool


@dataclass(frozen=True)
class Rendered:
    """A frame and its ground truth.

    Attributes
    ----------
    frame
        The camera's frame.
    beams, marks
        Truth of beams and marks, in the order of the scene.
    clipped
        Fraction of the pixel values that are at full scale.
    level
        Pixel values without noise, clipping and encoding, as fractions of full scale, float32, in
        the shape of the frame; None unless requested.
    """

    frame: Frame
    beams: tuple[BeamTruth, ...]
    marks: tuple[MarkTruth, ...]
    clipped: float
    level: Image | None = None


def render(
    scene: Scene,
    seed: int,
    *,
    name: str = "",
    time: datetime | None = None,
    level: bool = False,
) -> Rendered:
    """Return a frame of a scene with its ground truth; equal seeds produce equal noise.

    Parameters
    ----------
    scene
        The scene. Its constant part (camera, targets, paint, surroundings) is cached for
        the last four combinations.
    seed
        Seed of the noise, 0 or more.
    name, time
        Name and time of the frame.
    level
        Whether to return the pixel values without noise as well.

    Raises
    ------
    InputError
        If the camera has no pose, or does not see the front of a target.
    """
    static = painted_scene(scene)
    ambient = static.sky * np.float32(scene.surroundings.sky)
    images: list[tuple[slice, slice, Image]] = []
    thrown = [replace(t, beam=t.beam.swept(t.motion)) for t in scene.beams]
    beams = np.zeros_like(ambient)
    for plane in static.planes:
        _add_ambient(scene, plane, ambient)
    for throw in thrown:
        index = [t.name for t in scene.targets].index(throw.target)
        rows, columns, light = _beam_image(scene, static.planes[index], index, throw)
        beams[rows, columns] += light
        images.append((rows, columns, light))
    readings = _through_lens(scene, ambient, beams)
    pixels, clipped = _expose(scene.sensor, readings, seed)
    highest = readings if readings.ndim == 2 else readings.max(axis=2)
    truths = tuple(
        _beam_truth(scene, t, image, highest) for t, image in zip(thrown, images, strict=True)
    )
    sensor = scene.sensor
    return Rendered(
        Frame(pixels, name, time, exposure=sensor.exposure, gain=sensor.gain),
        truths,
        _mark_truths(scene, thrown),
        clipped,
        readings if level else None,
    )


def _ambient_terms(scene: Scene) -> tuple[float, ...]:
    shadow = scene.shadow or Shadow(left=1.0)
    into = (np.cos(shadow.angle), np.sin(shadow.angle))
    terms = (*scene.gradient, *shadow.point, *into, shadow.softness, shadow.left)
    return tuple(float(term) for term in terms)


def _add_ambient(scene: Scene, plane: Plane, image: Image) -> None:
    light: Image = plane.reflectance * np.float32(scene.ambient)
    if scene.shadow is not None or any(scene.gradient):
        relative = np.empty_like(image)
        ambient_field(plane.u, plane.v, plane.share, _ambient_terms(scene), relative)
        light *= relative
    image += light


def _beam_image(
    scene: Scene, plane: Plane, index: int, thrown: Thrown
) -> tuple[slice, slice, Image]:
    """Return the rows and columns that a beam illuminates, and its reflected light there, W/m²."""
    width, height = scene.camera.size
    outline = thrown.beam.corners
    ends = np.roll(outline, -1, axis=0)
    part = np.linspace(0.0, 1.0, 8, endpoint=False)[:, None, None]
    border = project(
        scene.camera, scene.targets[index].point(outline + part * (ends - outline))
    ).reshape(-1, 2)
    if np.isfinite(border).all():
        low, high = np.floor(border.min(axis=0)) - 3, np.ceil(border.max(axis=0)) + 4
    else:
        low, high = np.zeros(2), np.array([width, height])
    left, top = np.clip(low, 0, [width, height]).astype(int).tolist()
    right, bottom = np.clip(high, 0, [width, height]).astype(int).tolist()
    rows, columns = slice(top, max(bottom, top)), slice(left, max(right, left))
    u, v, share, reflectance = (
        np.ascontiguousarray(a[rows, columns])
        for a in (plane.u, plane.v, plane.share, plane.reflectance)
    )
    light = np.zeros_like(u)
    if light.size:
        # A pixel sees at most eight samples in each direction.
        pixel = float(np.abs(np.gradient(u, axis=1)).max()) if u.shape[1] > 1 else 0.0
        beam = thrown.beam.coarser(int(pixel / (8.0 * thrown.beam.step)))
        sample_plane(u, v, share, beam.flux, beam.origin, beam.step, light)
    return rows, columns, light * reflectance * np.float32(thrown.strength * scene.cloud)


def _through_lens(scene: Scene, ambient: Image, beams: Image) -> Image:
    """Return readings without noise and clipping, as fractions of full scale."""
    lens, sensor = scene.lens, scene.sensor
    if sensor.colour:
        light = np.stack(
            [
                ambient * np.float32(a) + beams * np.float32(b)
                for a, b in zip(AMBIENT_TINT, BEAM_TINT, strict=True)
            ],
            axis=-1,
        )
    else:
        light = ambient + beams
    light = _blurred(light, lens.rest)
    level = light * np.float32(sensor.scale)
    level += np.float32(sensor.offset + lens.veil * float(level.mean()))
    if lens.ghost > 0.0:
        _add_ghost(level, lens)
    return level


def _blurred(image: Image, lens: LensEffects) -> Image:
    import cv2

    moved = float(np.hypot(*lens.shake))
    if lens.defocus == 0.0 and moved == 0.0:
        return image
    edge = cv2.BORDER_REPLICATE
    if not lens.disc and moved == 0.0:
        line = _bell(lens.defocus)
        return np.asarray(cv2.sepFilter2D(image, -1, line, line, borderType=edge), np.float32)
    return np.asarray(cv2.filter2D(image, -1, point_spread(lens), borderType=edge), np.float32)


def _bell(sigma: float) -> FloatArray:
    reach = int(np.ceil(4.0 * sigma))
    value = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    return as_float(value / value.sum())


def point_spread(lens: LensEffects) -> FloatArray:
    """Return the symmetric blur kernel (K, K), with sum 1, of a lens and its shake."""
    from scipy.signal import convolve2d

    spread = np.ones((1, 1))
    if lens.defocus > 0.0 and lens.disc:
        reach = int(np.ceil(lens.defocus + 0.5))
        around = np.arange(128) * (2.0 * np.pi / 128)
        circle = lens.defocus * np.stack([np.cos(around), np.sin(around)], axis=-1)
        spread = coverage([circle + reach], (2 * reach + 1, 2 * reach + 1))
    elif lens.defocus > 0.0:
        spread = np.outer(_bell(lens.defocus), _bell(lens.defocus))
    shake = as_float(lens.shake)
    if shake.any():
        reach = int(np.ceil(0.5 * np.abs(shake).max()))
        count = 8 * reach + 2
        places = ((np.arange(count) + 0.5) / count - 0.5)[:, None] * shake + reach
        trail = deposit(places, np.full(count, 1.0 / count), (2 * reach + 1, 2 * reach + 1))
        spread = convolve2d(spread, trail)
    return as_float(spread / spread.sum())


def _add_ghost(level: Image, lens: LensEffects) -> None:
    height, width = level.shape[:2]
    x = np.exp(-0.5 * ((np.arange(width) - lens.ghost_at[0]) / lens.ghost_radius) ** 2)
    y = np.exp(-0.5 * ((np.arange(height) - lens.ghost_at[1]) / lens.ghost_radius) ** 2)
    blob = lens.ghost * np.outer(y, x).astype(np.float32)
    level += blob if level.ndim == 2 else blob[:, :, None]


def _expose(sensor: Sensor, level: Image, seed: int) -> tuple[Pixels, float]:
    """Return the pixels, and the fraction of clipped readings."""
    if seed < 0:
        raise InputError(f"render: seed must be 0 or more, not {seed}")
    # NumPy's fastest generator; the noise needs no cryptographic strength.
    rng = np.random.Generator(np.random.SFC64(seed))
    noise = rng.standard_normal(level.size, dtype=np.float32)
    out: Pixels = np.empty(level.shape, np.uint8 if sensor.bits == 8 else np.uint16)
    per_electron = sensor.gain / sensor.electrons
    curve = _srgb(np.linspace(0.0, 1.0, 4096)) if sensor.srgb else np.empty(0)
    clipped = expose(
        level.reshape(-1),
        noise,
        float(sensor.read_noise),
        per_electron,
        float(sensor.offset),
        curve,
        2**sensor.bits - 1,
        out.reshape(-1),
    )
    return out, clipped / level.size


def _srgb(share: FloatArray) -> FloatArray:
    """Encode linear light, 0 to 1, with the sRGB curve (IEC 61966-2-1)."""
    return np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1.0 / 2.4) - 0.055)


# -- truth -----------------------------------------------------------------------------


def _beam_truth(
    scene: Scene, thrown: Thrown, image: tuple[slice, slice, Image], level: Image
) -> BeamTruth:
    target = _target(scene, thrown.target)
    share, landed = thrown.beam.on_target(target)
    centroid = thrown.beam.centroid
    both = target.point(np.stack([centroid, np.where(share > 0.0, landed, 0.0)]))
    pixels = project(scene.camera, both)
    rows, columns, light = image
    under = level[rows, columns]
    total = float(light.sum(dtype=np.float64))
    clipped, peak = 0.0, float("nan")
    if total > 0.0:
        clipped = float(light[under >= 1.0].sum(dtype=np.float64)) / total
        peak = float(under[np.unravel_index(int(light.argmax()), light.shape)])
    return BeamTruth(
        target=thrown.target,
        centroid=centroid,
        point=both[0],
        pixel=pixels[0],
        centroid_on_target=landed,
        pixel_on_target=pixels[1] if share > 0.0 else np.full(2, np.nan),
        share_on_target=share,
        share_clipped=clipped,
        peak=peak,
    )


def _target(scene: Scene, name: str) -> Target:
    return next(target for target in scene.targets if target.name == name)


def _mark_truths(scene: Scene, thrown: list[Thrown]) -> tuple[MarkTruth, ...]:
    truths = []
    tints = (AMBIENT_TINT, BEAM_TINT) if scene.sensor.colour else ((1.0,), (1.0,))
    for target in scene.targets:
        for mark in target.marks:
            # The grid covers the extent of the mark, both paint and strokes.
            corners = np.concatenate(mark_shapes(target, mark))
            low, high = corners.min(axis=0), corners.max(axis=0)
            part = (np.arange(5) + 0.5) / 5
            places = low + np.stack(np.meshgrid(part, part), axis=-1) * (high - low)
            ambient = scene.ambient * _relative_ambient(scene, places)
            flux = np.zeros(places.shape[:-1])
            for throw in thrown:
                if throw.target == target.name:
                    flux += throw.strength * scene.cloud * throw.beam.at(places)
            truths.append(_mark_truth(scene, target, mark, ambient, flux, tints))
    return tuple(truths)


def _mark_truth(
    scene: Scene,
    target: Target,
    mark: Mark,
    ambient: FloatArray,
    flux: FloatArray,
    tints: tuple[tuple[float, ...], tuple[float, ...]],
) -> MarkTruth:
    sensor = scene.sensor
    # The darkest channel loses its contrast last.
    light = sensor.scale * np.min([a * ambient + b * flux for a, b in zip(*tints, strict=True)], 0)
    white, dark = (
        np.minimum(sensor.offset + r * light, 1.0)
        for r in (scene.paint.reflectance, scene.paint.mark)
    )
    contrast = float((white - dark).mean())
    electrons = np.maximum(white.mean() - sensor.offset, 0.0) * sensor.electrons / sensor.gain
    noise = np.sqrt(electrons + sensor.read_noise**2) * sensor.gain / sensor.electrons
    pixel = project(scene.camera, mark.point)
    width, height = scene.camera.size
    relative = float(flux.mean() / ambient.mean()) if ambient.mean() > 0.0 else float("inf")
    return MarkTruth(
        target=target.name,
        name=mark.name,
        pixel=pixel,
        in_frame=bool(-0.5 <= pixel[0] < width - 0.5 and -0.5 <= pixel[1] < height - 0.5),
        light=relative,
        contrast=contrast,
        lit=relative > LIT,
        covered=bool(contrast < COVERED * noise),
    )


def _relative_ambient(scene: Scene, places: FloatArray) -> FloatArray:
    """Return the relative ambient light (gradient, shadow) at positions (..., 2) of the plane."""
    u, v = (np.ascontiguousarray(places[..., k], dtype=np.float32) for k in (0, 1))
    out = np.empty_like(u)
    ambient_field(u, v, np.ones_like(u), _ambient_terms(scene), out)
    return as_float(out)
