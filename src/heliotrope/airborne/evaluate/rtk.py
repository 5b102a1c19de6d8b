"""Compare RTK positions with photogrammetry, following HelioPoint's appendix A.

In the paper, a flight photographs coded targets on the ground (`check_rtk_by_targets`). Any flight
over the field can be checked by its mirrors instead, although their edges are accurate only to
millimetres (`check_rtk`, our own method).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.airborne.evaluate.bundle import Priors, adjust
from heliotrope.airborne.evaluate.coded import SeenTargets
from heliotrope.airborne.evaluate.evaluation import adjust_photos, corners_of, disagrees
from heliotrope.airborne.evaluate.photogrammetry import Photogrammetry, compared, locate, usable
from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Trial standard deviations, and the 95 % point of chi-square with one degree of freedom.
_TRIALS, _CHI2_95 = 4001, 3.841


@dataclass(frozen=True)
class RtkCheck:
    """Comparison of RTK positions with positions from photogrammetry.

    Attributes
    ----------
    names
        Names of the photographs.
    difference
        RTK minus photogrammetry, east, north, up, m, (P, 3).
    mean, mean_sigma
        Offset common to all positions and its standard deviation, from the adjustment, m, (3,); NaN
        with coded targets, whose positions are unknown.
    covariance
        Covariance of a single difference about the mean, m², (3, 3), from RTK and photogrammetry
        together.
    photogrammetry
        Mean standard deviation of the photogrammetric positions relative to each other, m, (3,).
    rtk
        Standard deviation of a single position from RTK alone, m, (3,); 0 if photogrammetry
        explains the whole difference.
    rtk_range
        Lower and upper bound of the 95 % interval of ``rtk``, m, (2, 3).
    """

    names: tuple[str, ...]
    difference: FloatArray
    mean: FloatArray
    mean_sigma: FloatArray
    covariance: FloatArray
    photogrammetry: FloatArray
    rtk: FloatArray
    rtk_range: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of a single difference per axis, m, (3,)."""
        return as_float(np.sqrt(np.diag(self.covariance)))


def check_rtk(
    photos: Sequence[Photo],
    seen: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    priors: Priors | None = None,
) -> tuple[RtkCheck, tuple[str, ...]]:
    """Return the scatter of RTK positions about positions from the images alone.

    The adjustment runs twice. The usual form yields the common offset; a second one, with positions
    free within a metre, yields the error of each photograph.

    Raises
    ------
    InputError
        If fewer than three photographs can be used.
    """
    good = [k for k, s in enumerate(seen) if s.has_corners]
    problems = tuple(s.why_unused() for s in seen if s.problem)
    if len(good) < 3:
        first = f"; the first: {problems[0]}" if problems else ""
        raise InputError(f"{len(good)} photographs can be used; three are needed{first}")
    recorded, used = [photos[k] for k in good], [seen[k] for k in good]
    usual = adjust_photos(recorded, used, camera, stand, priors or Priors())
    places, corners = as_float([p.position for p in recorded]), corners_of(used)
    if disagrees(usual):
        corners = replace(corners, sigma=corners.sigma * max(usual.deviation, 0.1))
    free = adjust(
        places,
        np.ones_like(places),
        usual.state.rotation,
        usual.state.stand,
        corners,
        # The mirrors stay where the first adjustment placed them, because their errors are not due
        # to RTK.
        Priors(offset=1e-6, position=1e-6, turn=1e-6),
    )
    gap = places - free.state.position
    return RtkCheck(
        tuple(p.name for p in recorded),
        gap,
        usual.state.offset,
        np.sqrt(np.diag(usual.offset_covariance)),
        np.atleast_2d(np.cov(gap.T)),
        free.position_sigma.mean(axis=0),
        *share_of_rtk(gap, free.position_sigma),
    ), problems


def check_rtk_by_targets(
    photos: Sequence[Photo], targets: Sequence[SeenTargets], camera: LedCamera
) -> tuple[RtkCheck, Photogrammetry, tuple[str, ...]]:
    """Return the scatter of RTK positions about positions from coded targets (appendix A).

    The photogrammetric positions are fitted to the RTK positions by a similarity transform, so a
    common offset, rotation or scale cannot be determined.

    Raises
    ------
    InputError
        If too few photographs or targets can be used.
    """
    good, unusable = usable(targets)
    problems = tuple(f"{photos[k].name}: {reason}" for k, reason in unusable.items())
    recorded = [photos[k] for k in good]
    try:
        located = locate(recorded, [targets[k] for k in good], camera)
    except InputError as error:
        first = f"; the first of the others: {problems[0]}" if problems else ""
        raise InputError(f"{error}{first}") from None
    gap, _ = compared(as_float([p.position for p in recorded]), located.position)
    # The similarity transform uses seven of the 3P degrees of freedom, not only the three of the
    # mean.
    fair = gap * np.sqrt((len(gap) - 1.0) / (len(gap) - 7.0 / 3.0))
    unknown = np.full(3, np.nan)
    sigma = located.position_sigma
    return (
        RtkCheck(
            tuple(p.name for p in recorded),
            gap,
            unknown,
            unknown,
            np.cov(fair.T),
            as_float(np.sqrt(np.mean(sigma**2, axis=0))),
            *share_of_rtk(fair, sigma),
        ),
        located,
        problems,
    )


def share_of_rtk(gap: FloatArray, sigma: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the scatter of RTK without that of photogrammetry, and its 95 % interval.

    The scatter is estimated by restricted maximum likelihood for each axis. The variance of a
    difference is that of RTK, which is the same for all photographs, plus that of the
    photogrammetry for this photograph. The mean of the differences is unknown. (This method is
    ours; the photogrammetry in the paper, with coded targets, was good to less than a millimetre
    and is neglected there.)

    Parameters
    ----------
    gap
        RTK minus photogrammetry, m, (P, 3), with P at least 3.
    sigma
        Standard deviations of the photogrammetric positions, m, (P, 3).

    Returns
    -------
    Standard deviation, m, (3,), and lower and upper end of the interval, m, (2, 3).
    """
    scatter, ends = np.zeros(3), np.zeros((2, 3))
    for axis in range(3):
        g, c = gap[:, axis], sigma[:, axis]
        trial = np.linspace(0.0, 6.0 * max(float(np.std(g)), 1e-6), _TRIALS)
        variance = trial[:, None] ** 2 + np.maximum(c, 1e-9) ** 2
        weight = 1.0 / variance
        mean = (weight @ g) / weight.sum(axis=1)
        residual = np.sum(weight * (g - mean[:, None]) ** 2, axis=1)
        cost = np.log(variance).sum(axis=1) + np.log(weight.sum(axis=1)) + residual
        inside = trial[cost - cost.min() <= _CHI2_95]
        scatter[axis] = trial[cost.argmin()]
        ends[:, axis] = inside[0], inside[-1]
    return scatter, ends
