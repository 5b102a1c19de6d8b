"""Correct sightings on targets for shading and blocking by neighbouring heliostats.

The position of each heliostat is known, but the pose of its neighbours at the time is not. Each
neighbour is assumed to track its own aim. As in the schedule, mirrors rotate about the foot of the
heliostat.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.sightings import Sightings
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, bisector, normalize
from heliotrope.optics.mirror_image import centroid_shift
from heliotrope.optics.mirror_surface import equal_facets
from heliotrope.optics.scene import Mirrors
from heliotrope.optics.shading import nearest

#: The focal length of a mirror with unknown facets is assumed to equal its distance from the
#: target, to within this fraction.
_FOCAL = 0.25
#: Fraction of a shift that remains uncertain, because the neighbours may not point where assumed.
UNKNOWN = 0.25
#: A destination is on a target if it is this close to the target's plane, m.
_ON_PLANE = 0.1


@dataclass(frozen=True)
class Unobstructed:
    """Sightings corrected as if no neighbour shaded or blocked the mirror.

    Attributes
    ----------
    sightings
        The sightings with corrected destinations; their covariances include the uncertainty of the
        correction.
    shift
        The shift that was removed, right and up on the target, m, (M, 2); 0 if nothing shades or
        blocks the mirror.
    hidden
        Fraction of the mirror that neighbours shaded or blocked, (M,).
    """

    sightings: Sightings
    shift: FloatArray
    hidden: FloatArray

    def __str__(self) -> str:
        """Return the result in one line."""
        figures = self.summary()
        if not figures["corrected"]:
            return "shading and blocking: no neighbour in the plant file hides any of the mirrors"
        return (
            f"shading and blocking: {figures['corrected']:,} of {figures['sightings']:,} "
            f"centroids corrected by {figures['median_shift_mm']:.0f} mm (median), "
            f"{figures['largest_shift_mm']:.0f} mm (largest)"
        )

    def summary(self) -> dict[str, float]:
        """Return the numbers of all and of corrected sightings, and the sizes of the shifts."""
        moved = self.hidden > 0.0
        size = 1e3 * np.linalg.norm(self.shift, axis=1)[moved]
        return {
            "sightings": len(self.hidden),
            "corrected": int(moved.sum()),
            "median_shift_mm": float(np.median(size)) if moved.any() else 0.0,
            "largest_shift_mm": float(size.max()) if moved.any() else 0.0,
        }


def unobstructed(
    heliostats: Heliostats, targets: tuple[Target, ...], sightings: Sightings, aim: FloatArray
) -> Unobstructed:
    """Return sightings corrected for shading and blocking.

    Parameters
    ----------
    heliostats
        All heliostats that may shade or block one another; the sightings refer to them by index.
    targets
        Targets. Sightings of the sun's beam on one of them are corrected; other sightings are
        unchanged.
    sightings
        The sightings.
    aim
        Aim point of neighbours that have no aim of their own, ENU metres, (3,).

    Notes
    -----
    Mirrors whose facets are not known are assumed to be canted for the target. The uncertainty of
    their shift includes how much the shift changes if the focal lengths are a quarter longer or
    shorter. In addition, every shift is uncertain by a quarter of its size.
    """
    place = heliostats.position
    own = np.full_like(place, np.nan) if heliostats.aim is None else heliostats.aim
    aims = np.where(np.isfinite(own), own, aim)
    near = nearest(place)
    shift, hidden = np.zeros((len(sightings), 2)), np.zeros(len(sightings))
    destination, covariance = sightings.destination.copy(), sightings.destination_covariance.copy()
    for m in np.flatnonzero(sightings.source_at_infinity & ~sightings.destination_at_infinity):
        target = _under(targets, sightings.destination[m])
        if target is None or not near.shape[1]:
            continue
        i, sun = int(sightings.heliostat[m]), sightings.source[m]
        others = near[i]
        directions = normalize(aims[others] - place[others])
        beside = Mirrors.of(
            place[others],
            bisector(np.broadcast_to(sun, directions.shape), directions),
            (heliostats.width[others], heliostats.height[others]),
            aims[others],
        )
        moved, spread, hidden[m] = shift_of(
            heliostats, i, target, sightings.destination[m], sun, place[i], beside
        )
        if not hidden[m] > 0.0 or not np.isfinite(moved).all():
            hidden[m] = 0.0
            continue
        shift[m] = moved
        destination[m] -= moved @ target.axes
        covariance[m] += target.axes.T @ spread @ target.axes
    corrected = replace(sightings, destination=destination, destination_covariance=covariance)
    return Unobstructed(corrected, shift, hidden)


def _under(targets: tuple[Target, ...], point: FloatArray) -> Target | None:
    """Return the target on which a point lies; None if it lies on no target."""
    for target in targets:
        across = np.abs(target.plane_coordinates(point) - target.plane_coordinates(target.center))
        off = abs(float((point - target.center) @ target.normal))
        if off <= _ON_PLANE and (across <= 0.5 * np.array([target.width, target.height])).all():
            return target
    return None


def shift_of(
    heliostats: Heliostats,
    i: int,
    target: Target,
    centroid: FloatArray,
    sun: FloatArray,
    center: FloatArray,
    neighbours: Mirrors,
    *,
    unknown: float = UNKNOWN,
) -> tuple[FloatArray, npt.NDArray[np.float64], float]:
    """Return a centroid's shift caused by neighbours, its covariance, and the obstructed fraction.

    Parameters
    ----------
    heliostats, i
        A group, and the index of the heliostat in it.
    target, centroid
        Target, and centroid on it, ENU metres, (3,).
    sun
        Unit vector to the sun, (3,).
    center
        Middle of the mirror, ENU metres, (3,).
    neighbours
        Neighbouring mirrors.
    unknown
        Fraction of the shift that remains uncertain.

    Returns
    -------
        The shift right and up on the target, m, (2,); its covariance, m², (2, 2); and the fraction
        of the mirror that is shaded or blocked. All are zero if nothing is obstructed.
    """
    slant = float(np.linalg.norm(centroid - center))
    normal = bisector(sun, (centroid - center) / slant)
    shifts = []
    for focal in (slant, slant / (1.0 + _FOCAL), slant * (1.0 + _FOCAL)):
        facets = _facets(heliostats, i, focal)
        shifts.append(
            centroid_shift(target, center, sun, normal, facets, neighbours, facet_focal=focal)
        )
        if not shifts[0].hidden:
            return np.zeros(2), np.zeros((2, 2)), 0.0
    usual = shifts[0].shift
    other = np.max([np.linalg.norm(candidate.shift - usual) for candidate in shifts[1:]])
    covariance = other**2 * np.eye(2) + unknown**2 * np.outer(usual, usual)
    return usual, covariance, shifts[0].hidden


def _facets(heliostats: Heliostats, i: int, focal: float) -> Facets:
    known = heliostats.facets
    if known is None:
        return equal_facets(float(heliostats.width[i]), float(heliostats.height[i]), (2, 2), focal)
    return known.take(np.array([i]))
