"""Regimes: periods in which a heliostat's zeros are shifted, for example after a repair.

The history of a heliostat's sightings is divided into segments, each with the common zeros or with
zeros of its own. The division minimises the truncated squares of the residuals plus a penalty for
each cut and for each new pair of zeros (optimal partitioning: Jackson et al. 2005, IEEE Signal
Processing Letters 12; truncated loss: Fearnhead & Rigaill 2019, J. Am. Stat. Assoc. 114). Slow
creep is modelled in `drift`.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn._regime_kernels import FEWEST, partition
from heliotrope.geometry import FloatArray

#: Cuts are tried in at most this many positions, namely in the longest gaps.
PLACES = 300


def find_regimes(
    time: npt.ArrayLike, residual: npt.ArrayLike, jacobian: npt.ArrayLike, smallest: float = 6.0
) -> npt.NDArray[np.int64]:
    """Return the regime of each sighting of one heliostat: 0 for the common zeros, else from 1.

    Parameters
    ----------
    time
        Time in seconds, (n,); sightings with NaN are in regime 0.
    residual
        Residuals with the common zeros, in units of the noise, (n, 2).
    jacobian
        Derivatives of the residuals with respect to the two zeros, (n, 2, 2).
    smallest
        Minimum mean length of the shift, in units of the noise; smaller shifts count as drift.
    """
    times = np.asarray(time, dtype=np.float64)
    rest, slope = np.asarray(residual, dtype=np.float64), np.asarray(jacobian, dtype=np.float64)
    label = np.zeros(len(times), dtype=np.int64)
    order = np.argsort(times, kind="stable")
    order = order[np.isfinite(times[order])]
    if len(order) < 2 * FEWEST:
        return label
    gaps = np.diff(times[order])
    inner = 1 + np.sort(np.argsort(-gaps, kind="stable")[:PLACES])
    places = np.concatenate([[0], inner, [len(order)]])
    label[order] = partition(
        np.ascontiguousarray(rest[order]), np.ascontiguousarray(slope[order]), places, smallest
    )
    return label


def regime_at(
    time: FloatArray, label: npt.NDArray[np.int64], when: FloatArray
) -> npt.NDArray[np.int64]:
    """Return the regime at times ``when`` (m,), which is that of the sighting nearest in time."""
    known = np.flatnonzero(np.isfinite(time))
    if not len(known):
        return np.zeros(len(when), dtype=np.int64)
    order = known[np.argsort(time[known], kind="stable")]
    places = np.searchsorted(time[order], when)
    before = order[np.clip(places - 1, 0, len(order) - 1)]
    after = order[np.clip(places, 0, len(order) - 1)]
    nearer = np.where(np.abs(when - time[before]) <= np.abs(time[after] - when), before, after)
    return np.where(np.isfinite(when), label[nearer], 0).astype(np.int64)
