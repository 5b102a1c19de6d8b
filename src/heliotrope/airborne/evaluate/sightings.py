r"""Convert orientations measured by a drone to sightings for the calibration.

The rays of a sighting meet at the mirror vertex, but a reflection may lie anywhere on the mirror,
on a canted facet. Both rays are therefore moved to the vertex and rotated from the normal measured
at the point to the normal that the whole mirror would have if this measurement were exact. The
distances, the bisector and the lever arm remain those of the reflection.

Without a slope map, slope deviations make a mirror appear rotated to the drone, by the same angle
in all poses. The centroid of a mirror's image on a target, in contrast, represents the mean over
the whole mirror. In a joint fit of both, the apparent rotation is therefore an additional unknown
(`fit_together`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.orientation import Orientation, Orientations, turned
from heliotrope.airborne.mirror import measured_normal
from heliotrope.calibration.fit.common import CommonErrors, fit_common
from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.sightings import Sightings, drone, join
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, rotation
from heliotrope.mechanism.chain import Mechanism
from heliotrope.sun import Times, unix_seconds

#: One sighting for each reflection, or for each orientation.
Per = Literal["reflection", "orientation"]

# Standard deviation of the apparent rotation of a mirror that no flight has measured, rad.
_UNTOLD = 1e-3
# The scatter of the poses is estimated if there are at least this many degrees of freedom.
_ENOUGH = 8
# Minimum scatter, as a fraction of the stated standard deviation.
_LEAST = 0.1


def to_sightings(
    orientations: Orientations,
    counts: npt.ArrayLike,
    *,
    time: Times = np.nan,
    per: Per = "reflection",
    systematic: bool = True,
) -> Sightings:
    """Return the sightings from one pose of a field.

    Parameters
    ----------
    orientations
        Orientations of the N heliostats.
    counts
        Drive counts of the heliostats in this pose, (N, D).
    time
        See `heliotrope.sun.Times`, () or (N,); NaN if unknown.
    per
        "reflection" creates one sighting per reflection that is not an outlier; "orientation"
        creates one sighting per orientation.
    systematic
        Whether σ includes the error common to all points of a mirror. Exclude it if the fit
        estimates the positions, which cause the larger part of that error.

    Returns
    -------
    Sightings. Their σ is such that all sightings of an orientation together have the weight that
    follows from σ_tot (or σ_mean), however many there are. Reflections share this weight as in the
    mean over the mirror. Both choices of ``per`` produce the same fit, but with single reflections
    the fit can find outliers by itself.

    Raises
    ------
    InputError
        If there is no orientation, the counts are not those of N heliostats, or ``per`` has a
        different value.
    """
    if per not in ("reflection", "orientation"):
        raise InputError(f"to_sightings: per={per!r}; use 'reflection' or 'orientation'")
    if not orientations.found:
        raise InputError("to_sightings: no heliostat has an orientation; nothing to calibrate with")
    n = len(orientations.names)
    table = np.atleast_2d(as_float(counts))
    if len(table) != n:
        raise InputError(f"to_sightings: counts of {len(table)} heliostats for {n} names")
    times = np.broadcast_to(unix_seconds(time, unknown=True), (n,))
    make = _of_points if per == "reflection" else _of_mean
    return join(
        [
            make(o, table[o.heliostat], float(times[o.heliostat]), systematic)
            for o in orientations.found
        ]
    )


def mean_sigma(o: Orientation, *, systematic: bool = False) -> float:
    """Return the standard deviation per axis of an orientation, rad."""
    variance = o.sigma_mean**2 + (o.systematic**2 if systematic else 0.0)
    return float(np.sqrt(variance.mean()))


def _of_mean(o: Orientation, counts: FloatArray, time: float, systematic: bool) -> Sightings:
    # If the lamp is at the camera, on the normal, the ray rotates by twice the error of the normal.
    place = o.vertex + o.distance * o.normal
    sigma = 2.0 * mean_sigma(o, systematic=systematic)
    return drone([o.heliostat], counts[None], place, place, time=time, sigma=sigma)


def _of_points(o: Orientation, counts: FloatArray, time: float, systematic: bool) -> Sightings:
    # Kriging weights of points behind other points may be negative, so they are limited to at least
    # a tenth of the mean weight.
    share = np.maximum(o.weight, 0.1 / max(o.count, 1))
    kept = np.flatnonzero(~o.outlier)
    share = share[kept] / share[kept].sum()
    reflections, point = o.reflections.take(kept), o.point[kept]
    measured = measured_normal(point, reflections.camera, reflections.led)
    normals = np.array([turned(o.rotation, omega)[:, 2] for omega in o.difference[kept]])
    axis = np.cross(measured, normals)
    sine = np.linalg.norm(axis, axis=-1)
    turn = rotation(axis, np.arctan2(sine, np.sum(measured * normals, axis=-1)))
    led, camera = (
        o.vertex + np.einsum("nij,nj->ni", turn, end - point)
        for end in (reflections.led, reflections.camera)
    )
    sigma = 2.0 * mean_sigma(o, systematic=systematic) / np.sqrt(share)
    return drone(
        np.full(len(kept), o.heliostat),
        np.tile(counts, (len(kept), 1)),
        led,
        camera,
        time=time,
        sigma=sigma,
    )


# -- together with others --------------------------------------------------------------


@dataclass(frozen=True)
class Together:
    """A joint fit of drone sightings and other sightings.

    Attributes
    ----------
    calibration
        Calibration of N heliostats. Its covariance accounts for the unknown rotation.
    turn
        Rotation that each mirror appears to have to the drone in all poses, about the
        concentrator's x and y axes, rad, (N, 2).
    turn_covariance
        Covariance of ``turn``, rad², (N, 2, 2).
    noise
        Scatter of the poses apart from the rotation, in units of the drone sightings' sigma, (N,);
        1 if there are too few poses to estimate it.
    """

    calibration: FieldFit
    turn: FloatArray
    turn_covariance: FloatArray
    noise: FloatArray


def fit_together(
    mechanism: Mechanism,
    others: Sightings,
    flights: Sightings,
    model: str | tuple[str, ...],
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
) -> Together:
    """Fit drone sightings and other sightings jointly, for mirrors without slope maps.

    An apparent rotation of each mirror, common to all its poses, is an additional unknown. Its
    prior is as wide as the stated standard deviation of the mirror normal in the drone sightings
    (half of their sigma, which refers to the beam). The remaining error of the drone sightings is
    estimated from their scatter about a separate fit. The loss is quadratic, so outliers must be
    removed beforehand.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, batch shape (N,).
    others
        Camera-target sightings, in which a centroid represents the mean over the whole mirror.
    flights
        Drone sightings, one per orientation (``per="orientation"``), without the systematic part.
    model, priors
        See `heliotrope.calibration.fit.estimator.fit`.

    Raises
    ------
    InputError, UnknownNameError
        See `heliotrope.calibration.fit.estimator.fit`.

    Notes
    -----
    In simulation (4 facets, slopes 0.8 mrad, 5 camera-target and 15 drone sightings, 24 mirrors),
    normals in other poses are predicted to 0.77 mrad from the camera-target sightings alone, 0.16
    mrad from the drone sightings alone, 0.16 mrad from both with `estimator.fit`, and 0.08 mrad
    with this function.
    """
    alone = fit(mechanism, flights, model, priors=priors, loss="square", adapt_scale=False)
    count = len(mechanism)
    noise = _scatter(alone, flights)
    known = replace(flights, sigma=flights.sigma * noise[flights.heliostat])
    turned = np.arange(len(others) + len(known)) >= len(others)
    common = CommonErrors(
        np.zeros((len(turned), 3, 0)),
        np.zeros(0),
        np.zeros((0, 0)),
        turned,
        _shared_spread(flights, count),
    )
    joint = fit_common(
        mechanism,
        join([others, known]),
        model,
        common,
        priors=priors,
        loss="square",
        adapt_scale=False,
    )
    return Together(joint.fitted, joint.turn, joint.turn_covariance, noise)


def _shared_spread(flights: Sightings, count: int) -> FloatArray:
    """Return the standard deviation of the apparent rotation of each normal, rad, (N,)."""
    number = np.bincount(flights.heliostat, minlength=count)
    square = np.bincount(flights.heliostat, weights=flights.sigma**2, minlength=count)
    return np.where(number > 0, 0.5 * np.sqrt(square / np.maximum(number, 1)), _UNTOLD)


def _scatter(alone: FieldFit, flights: Sightings) -> FloatArray:
    """Return the scatter of poses about a fit to these poses, in units of their sigma, (N,)."""
    count = len(alone.values)
    free = 2 * np.bincount(flights.heliostat, minlength=count) - len(alone.names)
    square = np.bincount(flights.heliostat, weights=alone.lengths**2, minlength=count)
    joint = np.clip(np.sqrt(square / np.maximum(free, 1)), _LEAST, None)
    return np.where(free >= _ENOUGH, joint, 1.0)
