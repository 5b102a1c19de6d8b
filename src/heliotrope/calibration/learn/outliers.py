"""Find outliers with the generalised extreme Studentized deviate test.

The test is that of Rosner (1983, Technometrics 25). The sighting farthest from the prediction of
the others is removed repeatedly. The outliers are all sightings removed up to and including the
last one that was farther away than chance allows. Two similar outliers therefore cannot hide each
other. The squared distance in two components is χ² with two degrees of freedom, so the largest of n
exceeds 2 ln(n / α) with probability α.
"""

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray

#: Probability of a false outlier among the sightings of a heliostat.
ALPHA = 1e-3
#: Largest fraction of the sightings that may be outliers.
SHARE = 0.25


def generalised_esd(
    residual: npt.ArrayLike,
    covariance: npt.ArrayLike,
    *,
    alpha: float = ALPHA,
    share: float = SHARE,
) -> npt.NDArray[np.bool_]:
    """Return the mask of outliers among n two-component residuals.

    Parameters
    ----------
    residual
        Residuals with expectation zero, (n, 2).
    covariance
        Joint covariance of the residuals, including noise, (2 n, 2 n).
    alpha
        Probability of a false outlier in the whole set.
    share
        Largest fraction of the residuals that may be outliers.

    Raises
    ------
    InputError
        If ``alpha`` or ``share`` is not between 0 and 1, or the covariance is singular.
    """
    for name, value in (("alpha", alpha), ("share", share)):
        if not 0.0 < value < 1.0:
            raise InputError(f"{name} must be between 0 and 1, not {value}")
    rest = np.ascontiguousarray(residual, dtype=np.float64)
    n = len(rest)
    mask = np.zeros(n, dtype=np.bool_)
    most = min(int(share * n), n - 3)
    if most < 1:
        return mask
    try:
        inverse = np.linalg.inv(np.asarray(covariance, dtype=np.float64))
    except np.linalg.LinAlgError:
        raise InputError("covariance of the residuals: singular; add the noise") from None
    which, squares = _remove_farthest(inverse, rest, most)
    beyond = np.flatnonzero(squares > critical(n - np.arange(most), alpha))
    if len(beyond):
        mask[which[: beyond[-1] + 1]] = True
    return mask


def left_out(inverse: FloatArray, alpha: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return each sighting's distance from the prediction of all other sightings.

    ``inverse`` is K⁻¹ (2 n, 2 n), ``alpha`` K⁻¹ r (2 n,). Returns (z² (n,), error (n, 2),
    covariance (n, 2, 2)); z² is χ² with two degrees of freedom. (Rasmussen & Williams,
    Gaussian Processes for Machine Learning, (5.12), in blocks of two.)
    """
    a, b = np.diagonal(inverse)[::2], np.diagonal(inverse, 1)[::2]
    c = np.diagonal(inverse)[1::2]
    determinant = a * c - b * b
    spread = np.stack([c, -b, -b, a], axis=-1) / determinant[:, None]
    x, y = alpha[::2], alpha[1::2]
    error = np.stack([spread[:, 0] * x + spread[:, 1] * y, spread[:, 2] * x + spread[:, 3] * y], -1)
    return x * error[:, 0] + y * error[:, 1], error, spread.reshape(-1, 2, 2)


def _remove_farthest(
    inverse: FloatArray, residual: FloatArray, most: int
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Remove the sighting that is farthest from the remaining sightings, ``most`` times.

    Returns the indices of the removed sightings and their z², in the order of removal.
    """
    inverse, flat = inverse.copy(), residual.ravel().copy()
    which, squares = np.empty(most, dtype=np.intp), np.empty(most)
    removed = np.zeros(len(residual), dtype=np.bool_)
    for step in range(most):
        square, _, spread = left_out(inverse, inverse @ flat)
        best = int(np.argmax(np.where(removed, -np.inf, square)))
        which[step], squares[step] = best, square[best]
        removed[best] = True
        # Schur complement: the inverse without the rows and columns of ``best``.
        rows = slice(2 * best, 2 * best + 2)
        pair = inverse[:, rows].copy()
        inverse -= pair @ spread[best] @ pair.T
        inverse[rows], inverse[:, rows], flat[rows] = 0.0, 0.0, 0.0
        inverse[rows, rows] = np.eye(2)
    return which, squares


def critical(count: npt.ArrayLike, alpha: float = ALPHA) -> FloatArray:
    """Return the squared distance that the farthest of ``count`` exceeds with probability alpha."""
    return np.asarray(2.0 * np.log(np.asarray(count, dtype=np.float64) / alpha))
