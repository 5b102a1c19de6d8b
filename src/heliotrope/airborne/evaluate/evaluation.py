"""Evaluate one pose of a field: convert photographs to reflections on mirrors.

All photographs together determine the exterior orientation of each photograph and the common RTK
offset (`heliotrope.airborne.evaluate.bundle`). Then the ray of each spot is intersected with its
mirror (`heliotrope.airborne.evaluate.rays`). On a moonless night no corner is visible, and
`heliotrope.airborne.evaluate.night` replaces the bundle adjustment.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.bundle import Adjusted, Corners, Priors, State, adjust, residuals
from heliotrope.airborne.evaluate.night import turn_together
from heliotrope.airborne.evaluate.rays import ShapeOf, spot_reflections
from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.evaluate.reflections import Reflections
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Shift of a mirror's edges, the same in all photographs, due to objects beside it, px. Where
#: shadows touch the lower edges, rendered mirrors are 0.03 px off. All eight mirrors of a row share
#: this error, so it matters as much as independent errors of 0.06 px.
EDGE_BIAS = 0.06
#: The stated corner errors are kept if the residuals agree with them within this factor.
_AGREE = 1.15


@dataclass(frozen=True)
class FlightEvaluation:
    """Result from the photographs of a pose.

    Attributes
    ----------
    photos
        Photographs used, with the estimated exterior orientation.
    recorded
        The same photographs, as recorded by the drone.
    seen
        What each photograph shows.
    adjusted
        The bundle adjustment.
    stand
        The mirrors, with poses determined from their corners.
    place_covariance
        Covariance of each mirror's position relative to the drone, m², (N, 3, 3). All reflections
        on the mirror share this error.
    reflections
        One record per spot on a mirror; ``photo`` is an index into the used photographs.
    problems
        A message for each photograph that was not used.
    """

    photos: tuple[Photo, ...]
    recorded: tuple[Photo, ...]
    seen: tuple[PhotoReading, ...]
    adjusted: Adjusted
    stand: MirrorPoses
    place_covariance: FloatArray
    reflections: Reflections
    problems: tuple[str, ...]


def evaluate(
    photos: Sequence[Photo],
    seen: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    shape: ShapeOf,
    *,
    priors: Priors | None = None,
    owner: npt.ArrayLike | None = None,
) -> FlightEvaluation:
    """Return the reflections of a pose and the exterior orientation of its photographs.

    Parameters
    ----------
    photos, seen
        Photographs as recorded, and their readings.
    camera
        The camera with its lamp.
    stand
        The mirrors in their expected poses.
    shape
        Function that returns the surface of a mirror, given its index; slopes do not matter here.
    priors
        Prior standard deviations of the bundle adjustment.
    owner
        Heliostat index of each mirror, if some heliostats are present in several poses
        (`heliotrope.airborne.evaluate.bundle.adjust`).

    Raises
    ------
    InputError
        If no photograph can be used, or none shows a reflection.
    """
    known = priors or Priors()
    good = [k for k, s in enumerate(seen) if s.has_corners]
    problems = tuple(s.why_unused() for s in seen if not s.has_corners)
    if not good:
        dark = [k for k, s in enumerate(seen) if s.has_lights]
        if dark and owner is None:
            own = [photos[k] for k in dark], [seen[k] for k in dark]
            lines = tuple(s.why_unused() for s in seen if s.problem)
            return _evaluate_dark(*own, camera, stand, shape, known, lines)
        first = f"; the first: {problems[0]}" if problems else ""
        raise InputError(f"none of {len(seen)} photographs can be used{first}")
    recorded, used = [photos[k] for k in good], [seen[k] for k in good]
    corners = corners_of(used)
    adjusted = adjust_photos(recorded, used, camera, stand, known, owner)
    state = adjusted.state
    places = [
        photo.moved(place, turned)
        for photo, place, turned in zip(recorded, state.position, state.rotation, strict=True)
    ]
    shifts = _local_shifts(adjusted, corners, len(used), len(stand))
    reflections = spot_reflections(places, used, camera, state.stand, shape, shifts=shifts)
    if not len(reflections):
        raise InputError(
            f"no reflection on the mirrors in {len(used)} photographs; check that the lamp was on "
            "and that the mirrors were commanded towards the drone (commands.csv)"
        )
    return FlightEvaluation(
        tuple(places),
        tuple(recorded),
        tuple(used),
        adjusted,
        state.stand,
        adjusted.place_covariance,
        reflections,
        problems,
    )


def _evaluate_dark(
    recorded: Sequence[Photo],
    readings: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    shape: ShapeOf,
    priors: Priors,
    problems: tuple[str, ...],
) -> FlightEvaluation:
    """Evaluate a dark flight, with attitudes from the lights alone and positions from RTK."""
    start = [p.moved(p.position, s.rotation) for p, s in zip(recorded, readings, strict=True)]
    turned = turn_together(start, readings, camera, stand, shape)
    position = as_float([p.position for p in recorded])
    state = State(
        position,
        as_float([p.rotation for p in turned.photos]),
        np.zeros_like(position),
        np.zeros(3),
        turned.stand,
        np.zeros((len(stand), 3)),
    )
    place = float(np.linalg.norm([priors.offset, priors.position, priors.kinematics]))
    places = turned.place_covariance(place)
    adjusted = Adjusted(
        state,
        priors.offset**2 * np.eye(3),
        np.full(position.shape, np.nan),
        places,
        # The rotation common to all photographs dominates.
        places.mean(axis=0),
        np.empty((0, 2)),
        float("nan"),
        np.empty(0, np.bool_),
        0,
        True,
    )
    return FlightEvaluation(
        turned.photos,
        tuple(recorded),
        tuple(readings),
        adjusted,
        turned.stand,
        places,
        turned.reflections,
        problems,
    )


def corners_of(readings: Sequence[PhotoReading]) -> Corners:
    """Return the corners found in photographs, for the adjustment."""
    parts = []
    for k, reading in enumerate(readings):
        row, corner = np.nonzero(np.isfinite(reading.corners).all(axis=-1))
        parts.append(
            (
                np.full(len(row), k),
                reading.mirror[row],
                corner,
                reading.corners[row, corner],
                reading.corner_sigma[row],
            )
        )
    joined = [np.concatenate(p) for p in zip(*parts, strict=True)]
    return Corners(
        joined[0].astype(np.intp),
        joined[1].astype(np.intp),
        joined[2].astype(np.intp),
        as_float(joined[3]),
        as_float(joined[4]),
    )


def adjust_photos(
    recorded: Sequence[Photo],
    readings: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    priors: Priors,
    owner: npt.ArrayLike | None = None,
) -> Adjusted:
    """Adjust photographs that show corners.

    The priors are widened by the possible error of the mirror edges. If the corners scatter more or
    less than stated, the adjustment is repeated with their standard deviations rescaled.
    """
    corners = corners_of(readings)
    places = as_float([p.position for p in recorded])
    spreads = as_float([p.sigma_position for p in recorded])
    turns = as_float([s.rotation for s in readings])
    distance = float(np.median(np.linalg.norm(stand.vertex - places.mean(axis=0), axis=-1)))
    bias = EDGE_BIAS * distance / camera.focal
    known = replace(priors, kinematics=float(np.hypot(priors.kinematics, bias)))
    adjusted = adjust(places, spreads, turns, stand, corners, known, owner=owner)
    if disagrees(adjusted):
        scaled = replace(corners, sigma=corners.sigma * adjusted.deviation)
        adjusted = adjust(
            places, spreads, adjusted.state.rotation, stand, scaled, known, owner=owner
        )
    return adjusted


def disagrees(adjusted: Adjusted) -> bool:
    """Return whether the corners scatter more or less than their standard deviations imply."""
    return bool(np.isfinite(adjusted.deviation) and not 1.0 / _AGREE < adjusted.deviation < _AGREE)


def _local_shifts(adjusted: Adjusted, corners: Corners, photos: int, mirrors: int) -> FloatArray:
    """Return the mean residual of each mirror's corners in each photograph, (P, N, 2).

    Errors of the lens model displace a mirror and its spots equally.
    """
    kept = ~adjusted.outlier
    gap, _ = residuals(adjusted.state, corners, derivative=False)
    where = corners.photo * mirrors + corners.mirror
    count = np.bincount(where[kept], minlength=photos * mirrors)
    shift = np.stack(
        [
            np.bincount(where[kept], weights=gap[kept, i], minlength=photos * mirrors)
            for i in (0, 1)
        ],
        axis=-1,
    )
    mean = shift / np.maximum(count, 1)[:, None]
    return as_float(np.where((count >= 3)[:, None], mean, 0.0).reshape(photos, mirrors, 2))
