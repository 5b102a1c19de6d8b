"""RTK positions compared with photogrammetry, after appendix A of HelioPoint.

The paper's flight photographs coded targets on the ground; ours uses the mirrors of the field.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.airborne.evaluate.bundle import Priors, adjust
from heliotrope.airborne.evaluate.evaluation import adjust_photos, corners_of, disagrees
from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float


@dataclass(frozen=True)
class RtkCheck:
    """Positions by RTK against those by photogrammetry.

    Attributes
    ----------
    names
        Names of the photographs.
    difference
        RTK less photogrammetry, east, north, up, m, (P, 3).
    mean, mean_sigma
        Offset common to all positions and its standard deviation, from the adjustment, m, (3,).
    covariance
        Covariance of a single position about the mean, m², (3, 3): RTK and photogrammetry together.
    photogrammetry
        Mean standard deviation of the photogrammetric positions relative to each other, m, (3,).
    """

    names: tuple[str, ...]
    difference: FloatArray
    mean: FloatArray
    mean_sigma: FloatArray
    covariance: FloatArray
    photogrammetry: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviation of a single position per axis, m, (3,)."""
        return as_float(np.sqrt(np.diag(self.covariance)))


def check_rtk(
    photos: Sequence[Photo],
    seen: Sequence[PhotoReading],
    camera: LedCamera,
    stand: MirrorPoses,
    priors: Priors | None = None,
) -> tuple[RtkCheck, tuple[str, ...]]:
    """Return how RTK positions scatter about those from the images alone.

    The adjustment runs twice: as usual, for the common offset, and with positions free to a
    metre, for the error of each photograph.

    Raises
    ------
    InputError
        If fewer than three photographs can be used.
    """
    good = [k for k, s in enumerate(seen) if s.has_corners]
    problems = tuple(s.why_unused() for s in seen if s.problem)
    if len(good) < 3:
        first = f"; the first: {problems[0]}" if problems else ""
        raise InputError(f"{len(good)} photographs can be used, three are needed{first}")
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
        # The mirrors stay where the first adjustment put them: their errors are not RTK's.
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
    ), problems
