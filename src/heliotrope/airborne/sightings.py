r"""Orientations that a drone measured, as sightings for the calibration.

A sighting's rays meet at the mirror's vertex; a reflection stands anywhere on the mirror, on a
facet that is canted. Both ways are therefore moved to the vertex and turned by the rotation
that takes the normal measured at the point to the normal that the whole mirror has if this
point is right; the distances stay. Bisector and lever are then those of the reflection.
"""

from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.mirror import measured_normal
from heliotrope.airborne.orientation import FEWEST, Orientation, Orientations, turned
from heliotrope.calibration.sightings import Sightings, drone, join
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, rotation

#: What makes one sighting.
Per = Literal["reflection", "orientation"]

# Standard deviation of a difference where there are too few points to tell it, rad.
_UNTOLD = 1e-3


def to_sightings(
    orientations: Orientations,
    counts: npt.ArrayLike,
    *,
    time: npt.ArrayLike = np.nan,
    per: Per = "reflection",
    systematic: bool = True,
) -> Sightings:
    """Return the sightings of one pose of a field.

    Parameters
    ----------
    orientations
        Of the N heliostats.
    counts
        Of their drives in this pose, (N, D).
    time
        Unix seconds, () or (N,).
    per
        "reflection" makes one of each reflection that is no outlier, "orientation" one of
        each orientation.
    systematic
        Whether σ holds what all points of a mirror share. Leave it out if the fit estimates
        the positions, which are the larger part of it.

    Returns
    -------
    With a σ such that all sightings of an orientation together weigh what σ_tot (or σ_mean)
    says, however many they are; those of single reflections as the mean over the mirror weighs
    them. So both ways give a fit the same; single ones let it find outliers of its own.

    Raises
    ------
    InputError
        If no orientation was found, the counts are not those of N heliostats, or ``per`` is
        another word.
    """
    if per not in ("reflection", "orientation"):
        raise InputError(f"to_sightings: per={per!r}; give 'reflection' or 'orientation'")
    if not orientations.found:
        raise InputError("to_sightings: no heliostat has an orientation; nothing to calibrate with")
    n = len(orientations.names)
    table = np.atleast_2d(as_float(counts))
    if len(table) != n:
        raise InputError(f"to_sightings: counts of {len(table)} heliostats for {n} names")
    times = np.broadcast_to(as_float(time), (n,))
    make = _of_points if per == "reflection" else _of_mean
    return join([
        make(o, table[o.heliostat], float(times[o.heliostat]), systematic)
        for o in orientations.found
    ])  # fmt: skip


def _sigma(o: Orientation, systematic: bool) -> float:
    """Return the standard deviation per axis of an orientation, rad."""
    mean = o.sigma_mean
    if o.count < FEWEST or not np.isfinite(mean).all():
        mean = np.full(2, _UNTOLD / np.sqrt(o.count))
    variance = mean**2 + (o.systematic**2 if systematic else 0.0)
    return float(np.sqrt(variance.mean()))


def _of_mean(o: Orientation, counts: FloatArray, time: float, systematic: bool) -> Sightings:
    # A lamp in the camera, on the normal: the ray turns by twice the normal's error.
    place = o.vertex + o.distance * o.normal
    sigma = 2.0 * _sigma(o, systematic)
    return drone([o.heliostat], counts[None], place, place, time=time, sigma=sigma)


def _of_points(o: Orientation, counts: FloatArray, time: float, systematic: bool) -> Sightings:
    # A weight below a tenth of the usual (it may be negative, behind others) is no sighting.
    share = np.maximum(o.weight, 0.1 / max(o.count, 1))
    kept = np.flatnonzero(~o.outlier)
    share = share[kept] / share[kept].sum()
    seen, point = o.reflections.take(kept), o.point[kept]
    measured = measured_normal(point, seen.camera, seen.led)
    wanted = np.array([turned(o.rotation, omega)[:, 2] for omega in o.difference[kept]])
    axis = np.cross(measured, wanted)
    sine = np.linalg.norm(axis, axis=-1)
    turn = rotation(axis, np.arctan2(sine, np.sum(measured * wanted, axis=-1)))
    led, camera = (
        o.vertex + np.einsum("nij,nj->ni", turn, end - point) for end in (seen.led, seen.camera)
    )
    sigma = 2.0 * _sigma(o, systematic) / np.sqrt(share)
    return drone(
        np.full(len(kept), o.heliostat), np.tile(counts, (len(kept), 1)), led, camera,
        time=time, sigma=sigma,
    )  # fmt: skip
