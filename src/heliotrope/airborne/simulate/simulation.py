"""Simulate a flight with its ground truth: the true mirror poses, and the drone's records.

A flight exists in two versions. The *true* version has mechanisms with imperfections, surveyed
positions with errors, facets with slope errors, and the actual camera positions. The *recorded*
version has the plant file, the commands, and for each photograph an RTK position and the gimbal
angles. `fly` creates both; `reflections_of` returns the reflections that an image evaluation would
find, without images; `heliotrope.airborne.simulate.rendering` renders the images.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.reflections import Reflections, join, reflections
from heliotrope.airborne.mirror import MirrorShape, ideal, reflection_points
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.slopes import smooth_slopes
from heliotrope.airborne.standing import MirrorPoses, standing
from heliotrope.errors import InputError
from heliotrope.field.camera import look_at
from heliotrope.field.heliostats import Heliostats
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize, rotation
from heliotrope.mechanism.tracking import TrackingStatus, track

#: Standard deviations of the parameters of roughly aligned mechanisms, rad.
ADJUSTED: Mapping[str, float] = {
    "tilt_north": 1e-3,
    "tilt_east": 1e-3,
    "azimuth_bias": 2e-3,
    "elevation_bias": 2e-3,
}


@dataclass(frozen=True)
class Errors:
    """Standard deviations of recorded minus true values; ``rtk_offset`` is a fixed value.

    Attributes
    ----------
    rtk
        Error of each position to the east, to the north and up, independent for each photograph, m,
        (3,).
    rtk_offset
        Recorded minus true position, the same in all photographs, m, (3,).
    gimbal
        Error of each of three rotations of the camera, rad.
    survey
        Error of each coordinate of a heliostat's position, m.
    slope
        RMS of each component of the mirrors' slope deviations, rad.
    slope_length
        Correlation length of the slopes, m.
    reflection
        Error of the detected position of a reflection on the mirror, x and y, m.
    mechanism
        Errors of the mechanism parameters, rad.
    kinematics
        Error of each coordinate of a vertex in one pose, in addition to mechanism and survey
        errors, m.
    canting
        Error of each component of a facet normal, rad; the mean over a mirror is 0.
    map_error
        RMS of each component of a slope map's deviation from the mirror, rad.
    lens
        Displacement of a corner of the frame caused by errors in the camera file, px.
    hover
        Distance of the drone from its planned position along each axis, which RTK measures, m.
    """

    rtk: tuple[float, float, float] = (0.008, 0.008, 0.008)
    rtk_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gimbal: float = float(np.radians(0.5))
    survey: float = 0.005
    slope: float = 0.8e-3
    slope_length: float = 0.3
    reflection: float = 0.015
    mechanism: Mapping[str, float] = field(default_factory=lambda: ADJUSTED)
    kinematics: float = 0.0
    canting: float = 0.0
    map_error: float = 0.0
    lens: float = 0.0
    hover: float = 0.0

    def __post_init__(self) -> None:
        for name in ("kinematics", "canting", "map_error", "hover"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"errors: {name} must be 0 or more, not {value}")


#: Errors of a real flight. Survey, kinematics and maps are as HelioPoint states them; the rest is
#: ours.
REAL = Errors(survey=0.010, kinematics=0.030, canting=0.3e-3, map_error=0.1e-3, lens=0.5, hover=0.1)


@dataclass(frozen=True)
class Flight:
    """A simulated flight over N heliostats with P photographs.

    Attributes
    ----------
    camera
        The camera with its lamp.
    heliostats
        Heliostats as in the plant file.
    counts
        Drive positions during the flight, (N, D).
    truth
        True poses of the mirrors.
    shapes
        Surfaces of the N mirrors, with slope deviations.
    taken
        Photographs with their true exterior orientation.
    recorded
        The same photographs, as recorded by the drone.
    known_camera
        The camera as stated in its file.
    maps
        Slope maps as measured, (F, H, W, 2) each; None for a mirror without slope deviations.
    """

    camera: LedCamera
    heliostats: Heliostats
    counts: FloatArray
    truth: MirrorPoses
    shapes: tuple[MirrorShape, ...]
    taken: tuple[Photo, ...]
    recorded: tuple[Photo, ...]
    known_camera: LedCamera
    maps: tuple[FloatArray | None, ...]


@dataclass(frozen=True)
class Installed:
    """The truth about N heliostats: mechanisms, and surfaces with slope deviations."""

    heliostats: Heliostats
    shapes: tuple[MirrorShape, ...]


def look_counts(heliostats: Heliostats, point: npt.ArrayLike) -> FloatArray:
    """Return the drive counts (N, D) at which all heliostats face one point.

    Raises
    ------
    InputError
        If a heliostat cannot face the point.
    """
    to = as_vectors(point, "point")
    mechanism = heliostats.calibrated
    vertex = mechanism.position
    for _ in range(4):
        # A mirror faces the point to which it returns light, and its vertex moves with the pose.
        result = track(mechanism, normalize(to - vertex), to)
        vertex = result.chosen(result.vertex)
    status = result.chosen(result.status)
    if (status != TrackingStatus.OK).any():
        i = int(np.flatnonzero(status != TrackingStatus.OK)[0])
        raise InputError(
            f"heliostat {heliostats.names[i]}: cannot turn to {to.tolist()} m; choose another point"
        )
    return result.best_counts


def hover_grid(
    center: npt.ArrayLike, focus: npt.ArrayLike, columns: int, rows: int, step: float
) -> FloatArray:
    """Return hover positions (columns · rows, 3) across the line from ``focus`` to ``center``.

    Parameters
    ----------
    center
        Middle of the pattern, ENU metres.
    focus
        Point at which the camera looks.
    columns, rows
        Number of positions horizontally and along the slope.
    step
        Distance between neighbours, m. Rows are flown back and forth.
    """
    turned = look_at(center, focus)
    across = (np.arange(columns) - 0.5 * (columns - 1)) * step
    along = (np.arange(rows) - 0.5 * (rows - 1)) * step
    places = [
        as_float(center) + x * turned[:, 0] + y * turned[:, 1]
        for k, y in enumerate(along)
        for x in (across if k % 2 == 0 else across[::-1])
    ]
    return as_float(places).reshape(-1, 3)


def fly(
    heliostats: Heliostats,
    camera: LedCamera,
    counts: npt.ArrayLike,
    positions: npt.ArrayLike,
    focus: npt.ArrayLike,
    *,
    errors: Errors | None = None,
    focal: npt.ArrayLike = np.inf,
    start: datetime = datetime(2026, 6, 21, 10, 0, tzinfo=UTC),
    interval: float = 3.0,
    seed: int = 0,
    installed: Installed | None = None,
    flight: int = 0,
) -> Flight:
    """Return a flight over heliostats with its truth; equal seeds produce equal flights.

    Parameters
    ----------
    heliostats
        Heliostats as in the plant file.
    camera
        The camera with its lamp.
    counts
        Drive positions, (N, D).
    positions
        Planned positions of the photographs, ENU metres, (P, 3).
    focus
        Point at which the camera is aimed, ENU metres, (3,).
    errors
        Standard deviations; by default those of `Errors`.
    focal
        Focal length of the facets, m; inf for flat facets.
    start, interval
        Time of the first photograph, and interval between photographs, s.
    seed
        Seed of all random numbers.
    installed
        True heliostats from `install`, to use the same heliostats in several flights; ``focal`` is
        then ignored.
    flight
        Index of this flight among several, so that its photographs have their own errors.
    """
    applied = errors or Errors()
    rng = np.random.default_rng(seed)
    if installed is None:
        really = _installed(heliostats, applied, rng)
        shapes = tuple(_shape(heliostats, r, focal, applied, rng) for r in range(len(heliostats)))
    else:
        really, shapes = installed.heliostats, installed.shapes
        rng = np.random.default_rng([seed, flight])
    places = as_vectors(positions, "positions").reshape(-1, 3)
    times = [start + timedelta(seconds=k * interval) for k in range(len(places))]
    pairs = [
        _photograph(f"DJI_{k + 1:04d}.JPG", time, place, as_float(focus), applied, rng)
        for k, (time, place) in enumerate(zip(times, places, strict=True))
    ]
    # These errors are drawn last, so that flights without them are the same as before the errors
    # were added.
    stand = standing(really, counts)
    if applied.kinematics > 0.0:
        off = applied.kinematics * rng.normal(0.0, 1.0, stand.vertex.shape)
        stand = replace(stand, vertex=stand.vertex + off)
    own = np.random.default_rng([seed, 1])
    return Flight(
        camera,
        heliostats,
        as_float(counts),
        stand,
        shapes,
        tuple(p[0] for p in pairs),
        tuple(p[1] for p in pairs),
        miscalibrated(camera, applied.lens),
        tuple(_measured_map(shape, applied, own) for shape in shapes),
    )


def miscalibrated(camera: LedCamera, lens: float) -> LedCamera:
    """Return a camera whose first radial coefficient displaces a corner by ``lens`` px."""
    radius = float(np.hypot(*camera.size)) / (2.0 * camera.focal)
    distortion = camera.distortion.copy()
    distortion[0] += lens / (camera.focal * radius**3)
    return replace(camera, distortion=distortion)


def _measured_map(
    shape: MirrorShape, errors: Errors, rng: np.random.Generator
) -> FloatArray | None:
    """Return the slope map that deflectometry would find."""
    if shape.slope is None or errors.map_error <= 0.0:
        return shape.slope
    off = smooth_slopes(
        shape, rng, errors.map_error, length=errors.slope_length, cells=shape.slope.shape[1]
    )
    return as_float(shape.slope + off)


def install(
    heliostats: Heliostats,
    rows: npt.ArrayLike,
    errors: Errors,
    focal: npt.ArrayLike = np.inf,
    seed: int = 0,
) -> Installed:
    """Return the truth about some heliostats of a field.

    Parameters
    ----------
    heliostats
        The whole field, as in the plant file.
    rows
        Indices in the field.
    errors, focal, seed
        See `fly`. The truth about a heliostat does not depend on which other heliostats are
        requested.
    """
    index = np.asarray(rows, dtype=np.intp)
    really = _installed(heliostats, errors, np.random.default_rng(seed)).take(index)
    shapes = tuple(
        _shape(heliostats, row, focal, errors, np.random.default_rng([seed, row]))
        for row in index.tolist()
    )
    return Installed(really, shapes)


def _shape(
    heliostats: Heliostats,
    row: int,
    focal: npt.ArrayLike,
    errors: Errors,
    rng: np.random.Generator,
) -> MirrorShape:
    shape = ideal(heliostats, row, focal)
    if errors.slope <= 0.0 and errors.canting <= 0.0:
        return shape
    slope = np.zeros((len(shape), 2, 2, 2))
    if errors.slope > 0.0:
        slope = smooth_slopes(shape, rng, errors.slope, length=errors.slope_length)
    if errors.canting > 0.0:
        # Canting is a slope of the whole facet, so that a map shows it as deflectometry does.
        turn = errors.canting * rng.normal(0.0, 1.0, (len(shape), 2))
        area = np.prod(shape.half_size, axis=-1)
        slope = slope + (turn - (area / area.sum()) @ turn)[:, None, None, :]
    return shape.with_slopes(slope)


def _installed(heliostats: Heliostats, errors: Errors, rng: np.random.Generator) -> Heliostats:
    """Return the truth about the heliostats."""
    count = len(heliostats)
    sizes = {f"position_{axis}": errors.survey for axis in ("east", "north", "up")}
    moved = dict(heliostats.parameters)
    for name, sigma in {**sizes, **errors.mechanism}.items():
        moved[name] = moved.get(name, 0.0) + sigma * rng.normal(0.0, 1.0, count)
    return heliostats.with_parameters(moved)


def _photograph(
    name: str,
    time: datetime,
    place: FloatArray,
    focus: FloatArray,
    errors: Errors,
    rng: np.random.Generator,
) -> tuple[Photo, Photo]:
    """Return a photograph with its true orientation, and as the drone records it."""
    if errors.hover > 0.0:
        place = place + errors.hover * rng.normal(0.0, 1.0, 3)
    # The drone steers by its own RTK, so it records the position to which it was sent.
    true = place - np.asarray(errors.rtk_offset) + rng.normal(0.0, 1.0, 3) * errors.rtk
    attitude = look_at(place, focus)
    lean = errors.gimbal * rng.normal(0.0, 1.0, 3)
    turned = rotation(lean, np.linalg.norm(lean)) @ attitude
    return (
        Photo(name, time, true, turned),
        Photo(name, time, place, attitude, np.maximum(errors.rtk, 1e-4)),
    )


def exact_reflections(flight: Flight) -> Reflections:
    """Return every reflection of a flight, from the exact law of reflection at true positions.

    ``sigma`` is 1e-9 m. Obstruction by other mirrors is ignored.
    """
    camera = as_float([p.position for p in flight.taken]).reshape(-1, 3)
    led = as_float([p.led_position(flight.camera) for p in flight.taken]).reshape(-1, 3)
    parts = []
    for row, shape in enumerate(flight.shapes):
        stand = flight.truth
        points = reflection_points(shape, stand.rotation[row], stand.vertex[row], camera, led)
        if len(points):
            parts.append(
                reflections(
                    points.position,
                    row,
                    points.facet,
                    points.xy,
                    camera[points.position],
                    led[points.position],
                    1e-9,
                )
            )
    joined = join(parts)
    return joined.take(np.lexsort((joined.heliostat, joined.photo)))


def reflections_of(
    flight: Flight, errors: Errors | None = None, *, seed: int = 0, corrected: bool = False
) -> Reflections:
    """Return the reflections that an evaluation would find, without images.

    Parameters
    ----------
    flight
        A flight simulated by `fly`.
    errors
        Errors, of which only ``reflection``, the noise of the positions on the mirror, is used.
    seed
        Seed of the noise.
    corrected
        Whether the common RTK offset is known and removed, as in an evaluation of images. The
        camera attitude, which determines the lamp position, is known to 0.1 mrad from the images
        and is assumed to be true.
    """
    applied = errors or Errors()
    exact = exact_reflections(flight)
    rng = np.random.default_rng(seed)
    noisy = exact.xy + applied.reflection * rng.normal(0.0, 1.0, (len(exact), 2))
    recorded = as_float([p.position for p in flight.recorded]).reshape(-1, 3)
    true = as_float([p.position for p in flight.taken]).reshape(-1, 3)
    off = (recorded - true).mean(axis=0) if corrected and len(recorded) else np.zeros(3)
    camera = recorded[exact.photo] - off
    return replace(
        exact,
        x=noisy[:, 0],
        y=noisy[:, 1],
        camera=camera,
        led=camera + exact.led - exact.camera,
        sigma=np.full(len(exact), max(applied.reflection, 1e-6)),
    )
