r"""Where the photographs of a flight were taken and how, from all of them together.

The corners of the mirrors are marks whose places are nearly known. Unknown are, for each
photograph, a rotation φ of the camera and the error t of its RTK position; the offset b that all
positions share; and for each mirror the error δ of its position, a rotation ψ, and by how much
its outline looks wider and higher than it is, g. A corner c of a mirror (vertex v, rotation M)
is seen from the told position p at

.. math:: X = (R e^{[φ]})^T (v + δ + M e^{[ψ]} (c + g c) - (p - b + t))

in camera axes, at (X/Z, Y/Z) without distortion. Without g a shadow beside the edges of all
mirrors, which shifts them by a tenth of a pixel, would move the camera by a decimetre: mirrors
that look smaller would be taken to be farther away.

All unknowns have priors: RTK's own deviation, the survey's, the commands'; those of φ and b are
wide. The normal equations (Gauss-Newton, with weights that fall for residuals beyond 2.5
standard deviations, after Huber) are sparse and are solved as such by SuperLU, which also gives
the covariance of b; a least-squares driver without the normal matrix would not.

Derivatives, with [X]_× for the matrix of the cross product:
:math:`∂X/∂φ = [X]_×`, :math:`∂X/∂t = -R^T = -∂X/∂b`, :math:`∂X/∂δ = R^T`,
:math:`∂X/∂ψ = -R^T M [c]_×`, :math:`∂X/∂g = R^T M diag(c)`.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.standing import Standing
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, cross_matrix, rotation

if TYPE_CHECKING:
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import SuperLU

#: Residuals beyond this many standard deviations weigh less.
HUBER = 2.5
_MOST_ROUNDS = 25
#: Of so many photographs the deviations of the positions are worked out.
MOST_POSITIONS = 400
#: Steps below this (m, rad) change nothing that matters.
_STILL = 2e-6
#: Unknowns of a mirror: δ, ψ, g.
_OF_MIRROR = 8


@dataclass(frozen=True)
class Corners:
    """Corners of mirrors seen in photographs: K rows.

    Attributes
    ----------
    photo, mirror, corner
        Which, (K,).
    place
        X/Z and Y/Z in camera axes, without distortion, (K, 2).
    sigma
        Standard deviation of each, (K,).
    """

    photo: npt.NDArray[np.intp]
    mirror: npt.NDArray[np.intp]
    corner: npt.NDArray[np.intp]
    place: FloatArray
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.photo)


@dataclass(frozen=True)
class Priors:
    """Standard deviations of what is nearly known.

    Attributes
    ----------
    offset
        Of RTK's common offset, m.
    position
        Of a mirror's vertex, each axis, m.
    turn
        Of a mirror's rotation about each of its axes, rad.
    growth
        Of how much wider or higher an outline looks, relative.
    """

    offset: float = 1.0
    position: float = 0.01
    turn: float = 0.005
    growth: float = 0.02


@dataclass(frozen=True)
class State:
    """All that is to be found, and what it starts from.

    Attributes
    ----------
    told
        Positions as told, ENU m, (P, 3).
    rotation
        Camera axes to ENU, (P, 3, 3).
    error
        t of each position, m, (P, 3).
    offset
        b, told less true, m, (3,).
    stand
        The mirrors as they stand.
    """

    told: FloatArray
    rotation: FloatArray
    error: FloatArray
    offset: FloatArray
    stand: Standing

    @property
    def position(self) -> FloatArray:
        """Where the photographs were taken, ENU m, (P, 3)."""
        return self.told - self.offset + self.error


@dataclass(frozen=True)
class Adjusted:
    """The outcome of a bundle adjustment.

    Attributes
    ----------
    state
        What was found.
    offset_covariance
        Of b, m², (3, 3).
    position_sigma
        Standard deviations of the positions, m, (P, 3); NaN beyond :data:`MOST_POSITIONS`.
    residual
        Of the corners in standard deviations, (K, 2).
    deviation
        Their RMS without outliers; 1 if the deviations that were given are true.
    outlier
        Corners beyond four standard deviations, (K,).
    rounds
        Until nothing moved any more.
    converged
        Whether that came within the limit.
    """

    state: State
    offset_covariance: FloatArray
    position_sigma: FloatArray
    residual: FloatArray
    deviation: float
    outlier: npt.NDArray[np.bool_]
    rounds: int
    converged: bool


def residuals(
    state: State, corners: Corners, *, derivative: bool = True
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return seen less expected places (K, 2), and the derivatives of the expected ones.

    Returns
    -------
    Residuals, and ∂place/∂φ, ∂t, ∂b, ∂δ, ∂ψ, each (K, 2, 3), and ∂g, (K, 2, 2); nothing
    unless asked for.
    """
    R = state.rotation[corners.photo]
    M = state.stand.rotation[corners.mirror]
    c = state.stand.outline[corners.mirror, corners.corner]
    point = state.stand.vertex[corners.mirror] + np.einsum("kij,kj->ki", M, c)
    X = np.einsum("kji,kj->ki", R, point - state.position[corners.photo])
    plane = X[:, :2] / X[:, 2:]
    gap = corners.place - plane
    if not derivative:
        return gap, ()
    slope = np.zeros((len(X), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = 1.0 / X[:, 2]
    slope[:, :, 2] = -plane / X[:, 2:]
    back = np.swapaxes(R, -1, -2)
    moved = slope @ back
    turned = slope @ cross_matrix(X)
    mirror = moved @ M
    grown = mirror[..., :2] * c[:, None, :2]
    return gap, (turned, -moved, moved, moved, -mirror @ cross_matrix(c), grown)


def adjust(
    told: npt.ArrayLike,
    sigma: npt.ArrayLike,
    rotations: npt.ArrayLike,
    stand: Standing,
    corners: Corners,
    priors: Priors | None = None,
) -> Adjusted:
    """Return the exterior orientation of all photographs, and the mirrors' places.

    Parameters
    ----------
    told, sigma
        Positions and their standard deviations without the common part, ENU m, (P, 3).
    rotations
        To start from, right to a few mrad, (P, 3, 3).
    stand
        Mirrors as surveyed and commanded.
    corners
        What was seen.
    priors
        By default those of :class:`Priors`.

    Raises
    ------
    InputError
        If no corner was seen.
    """
    known = priors or Priors()
    places, spreads = as_float(told), as_float(sigma)
    if not len(corners):
        raise InputError("bundle: no corner of a mirror was seen in any photograph")
    state = State(places, as_float(rotations), np.zeros_like(places), np.zeros(3), stand)
    start, moved, converged, rounds = stand, np.zeros((len(stand), _OF_MIRROR)), False, 0
    solver: SuperLU | None = None
    right = np.empty(0)
    for rounds in range(1, _MOST_ROUNDS + 1):
        gap, parts = residuals(state, corners)
        scaled = np.linalg.norm(gap, axis=-1) / corners.sigma
        # The first round may stand far off for want of a good start: nothing is an outlier yet.
        limit = HUBER if rounds > 1 else max(HUBER, 3.0 * float(np.median(scaled)))
        weight = np.minimum(1.0, limit / np.maximum(scaled, 1e-9))
        solver, right = _normal_equations(state, corners, gap, parts, weight, spreads, known, moved)
        step = solver.solve(right)
        state, moved = _step(state, start, moved, step)
        if np.abs(step).max() < _STILL:
            converged = True
            break
    assert solver is not None  # there is at least one round
    return _told(state, corners, solver, len(right), rounds, converged)


def _told(
    state: State, corners: Corners, solver: "SuperLU", size: int, rounds: int, converged: bool
) -> Adjusted:
    gap, _ = residuals(state, corners, derivative=False)
    scaled = gap / corners.sigma[:, None]
    outlier = np.linalg.norm(scaled, axis=-1) > 4.0
    kept = scaled[~outlier]
    photos = len(state.told)
    at = 6 * photos
    freedom = max(kept.size - at - 3, 1)
    deviation = float(np.sqrt(np.sum(kept**2) / freedom)) if kept.size else float("nan")
    covariance = _block(solver, at, size)
    positions = np.full((photos, 3), np.nan)
    if photos <= MOST_POSITIONS:
        for k in range(photos):
            positions[k] = np.sqrt(np.diag(_block_of_position(solver, k, at, size)))
    return Adjusted(state, covariance, positions, scaled, deviation, outlier, rounds, converged)


def _normal_equations(
    state: State, corners: Corners, gap: FloatArray, parts: tuple[FloatArray, ...],
    weight: FloatArray, spreads: FloatArray, known: Priors, moved: FloatArray,
) -> "tuple[SuperLU, FloatArray]":  # fmt: skip
    """Return the factorised normal matrix and the right-hand side.

    Unknowns in turn: φ and t of each photograph, b, δ, ψ and g of each mirror.
    """
    from scipy.sparse.linalg import splu

    jacobian = jacobian_matrix(corners, parts, len(state.told), len(state.stand))
    scale = np.repeat(np.sqrt(weight) / corners.sigma, 2)
    weighted = jacobian.multiply(scale[:, None]).tocsc()
    photos, mirrors = len(state.told), len(state.stand)
    size = 6 * photos + 3 + _OF_MIRROR * mirrors
    prior, pull = np.zeros(size), np.zeros(size)
    own = prior[: 6 * photos].reshape(photos, 6)
    own[:, :3], own[:, 3:] = 1e-2, 1.0 / spreads**2
    pull[: 6 * photos].reshape(photos, 6)[:, 3:] = -state.error / spreads**2
    at = 6 * photos
    prior[at : at + 3] = 1.0 / known.offset**2
    pull[at : at + 3] = -state.offset / known.offset**2
    rest = prior[at + 3 :].reshape(mirrors, _OF_MIRROR)
    rest[:, :3], rest[:, 3:6] = 1.0 / known.position**2, 1.0 / known.turn**2
    rest[:, 6:] = 1.0 / known.growth**2
    pull[at + 3 :] = -(rest * moved).reshape(-1)
    normal: csc_array = (weighted.T @ weighted).tocsc()
    normal.setdiag(normal.diagonal() + prior)
    return splu(normal), weighted.T @ (gap.reshape(-1) * scale) + pull


def jacobian_matrix(
    corners: Corners, parts: tuple[FloatArray, ...], photos: int, mirrors: int
) -> "csc_array":
    """Return the sparse derivative (2K, U) of all places by all U unknowns, per unit."""
    from scipy.sparse import csc_array

    count = len(corners)
    at = 6 * photos
    mirror = at + 3 + _OF_MIRROR * corners.mirror
    starts = (
        6 * corners.photo, 6 * corners.photo + 3, np.full(count, at), mirror, mirror + 3,
        mirror + 6,
    )  # fmt: skip
    values, rows, columns = [], [], []
    for start, part in zip(starts, parts, strict=True):
        line = np.arange(2 * count).reshape(count, 2, 1)
        column = start[:, None, None] + np.arange(part.shape[2])
        values.append(part.ravel())
        rows.append(np.broadcast_to(line, part.shape).ravel())
        columns.append(np.broadcast_to(column, part.shape).ravel())
    place = (np.concatenate(rows), np.concatenate(columns))
    shape = (2 * count, at + 3 + _OF_MIRROR * mirrors)
    return csc_array((np.concatenate(values), place), shape=shape)


def _step(
    state: State, start: Standing, moved: FloatArray, step: FloatArray
) -> tuple[State, FloatArray]:
    photos = len(state.told)
    own = step[: 6 * photos].reshape(photos, 6)
    at = 6 * photos
    total = moved + step[at + 3 :].reshape(-1, _OF_MIRROR)
    return replace(
        state,
        rotation=state.rotation @ _turns(own[:, :3]),
        error=state.error + own[:, 3:],
        offset=state.offset + step[at : at + 3],
        stand=replace(
            start,
            vertex=start.vertex + total[:, :3],
            # Small: the prior of ψ refers to where it started.
            rotation=start.rotation @ _turns(total[:, 3:6]),
            outline=start.outline * (1.0 + np.pad(total[:, None, 6:], ((0, 0), (0, 0), (0, 1)))),
        ),
    ), total


def _turns(small: FloatArray) -> FloatArray:
    return rotation(small, np.linalg.norm(small, axis=-1))


def _block(solver: "SuperLU", at: int, size: int) -> FloatArray:
    """Return the inverse's block of three unknowns from ``at`` on, (3, 3)."""
    unit = np.zeros((size, 3))
    unit[at : at + 3] = np.eye(3)
    return as_float(solver.solve(unit)[at : at + 3])


def _block_of_position(solver: "SuperLU", photo: int, offset: int, size: int) -> FloatArray:
    """Return the covariance of a photograph's position, t less b, (3, 3)."""
    unit = np.zeros((size, 3))
    at = 6 * photo + 3
    unit[at : at + 3] = np.eye(3)
    unit[offset : offset + 3] = -np.eye(3)
    found = solver.solve(unit)
    return as_float(found[at : at + 3] - found[offset : offset + 3])
