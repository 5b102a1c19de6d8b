r"""Exterior orientation of all photographs of a flight, from a joint bundle adjustment.

The mirror corners are marks at approximately known positions. The unknowns are: for each
photograph, a rotation φ of the camera and the error t of its RTK position; the offset b common to
all positions; for each mirror in each pose, the error δ of its vertex, a rotation ψ, and the
relative error g of its apparent width and height; and for each heliostat measured in several poses,
the error d of its surveyed position. A corner c of a mirror (vertex v, rotation M) is seen from the
recorded position p at

$$ X = (R e^{[φ]})^T (v + d + δ + M e^{[ψ]} (c + g c) - (p - b + t)) $$

in camera axes, at (X/Z, Y/Z) without distortion. The unknown g is needed because a shadow along the
edges of all mirrors may shift the edges by a tenth of a pixel. Mirrors that look smaller would then
be assumed to be farther away, which would move the camera by a decimetre.

If the mirrors are seen from one place only, the camera attitude absorbs a shift of all mirrors, and
survey errors leave an error in b of several times their mean. Views from several sides separate
survey errors from b, so flights over the same heliostats go into one adjustment.

All unknowns have priors: the stated standard deviations of RTK, survey and commands; the prior of φ
is wide. The normal equations (Gauss-Newton, with Huber weights beyond 2.5 standard deviations) are
sparse and are solved by SuperLU, which also provides the covariances. A least-squares solver that
does not form the normal matrix would not provide them.

Derivatives, with [X]_× for the matrix of the cross product:
$∂X/∂φ = [X]_×$, $∂X/∂t = -R^T = -∂X/∂b$, $∂X/∂δ = ∂X/∂d = R^T$,
$∂X/∂ψ = -R^T M [c]_×$, $∂X/∂g = R^T M diag(c)$.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, cross_matrix, rotation

if TYPE_CHECKING:
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import SuperLU

#: Residuals beyond this many standard deviations receive less weight.
HUBER = 2.5
_MOST_ROUNDS = 25
#: With more photographs than this, the standard deviations of their positions are not computed.
MOST_POSITIONS = 400
#: Smaller steps than this no longer matter, m and rad.
_STILL = 2e-6
#: Narrowest prior of a position, m.
_FIRM = 1e-6
#: Unknowns of a mirror: δ, ψ, g.
_OF_MIRROR = 8


@dataclass(frozen=True)
class Corners:
    """K corners of mirrors seen in photographs.

    Attributes
    ----------
    photo, mirror, corner
        Indices, (K,).
    place
        X/Z and Y/Z in camera axes, without distortion, (K, 2).
    sigma
        Standard deviation of each coordinate, (K,).
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
    """Prior standard deviations of the unknowns.

    Attributes
    ----------
    offset
        Common RTK offset, m.
    position
        Surveyed position of a heliostat, per axis, m; the same in all poses.
    kinematics
        Vertex of a mirror in one pose, relative to the surveyed position, m.
    turn
        Rotation of a mirror about each of its axes, rad.
    growth
        Relative error of the apparent width and height of an outline.
    """

    offset: float = 1.0
    position: float = 0.01
    kinematics: float = 0.0
    turn: float = 0.005
    growth: float = 0.02


@dataclass(frozen=True)
class State:
    """The unknowns, and the values from which the adjustment starts.

    Attributes
    ----------
    recorded
        Recorded positions, ENU m, (P, 3).
    rotation
        Rotation from camera axes to ENU, (P, 3, 3).
    error
        Error t of each position, m, (P, 3).
    offset
        Common offset b, recorded minus true, m, (3,).
    stand
        Poses of the mirrors.
    survey
        Error d of each heliostat's position, m, (H, 3); zeros if all were flown in a single pose.
    """

    recorded: FloatArray
    rotation: FloatArray
    error: FloatArray
    offset: FloatArray
    stand: MirrorPoses
    survey: FloatArray

    @property
    def position(self) -> FloatArray:
        """True positions of the photographs, ENU m, (P, 3)."""
        return self.recorded - self.offset + self.error


@dataclass(frozen=True)
class _Layout:
    """Order of the unknowns: φ and t of each photograph, b, δ, ψ and g of each mirror, d.

    Attributes
    ----------
    photos, mirrors, heliostats
        Numbers of photographs, mirrors and heliostats; 0 heliostats if each was flown in one pose.
    owner
        Index of each mirror's heliostat, (N,).
    """

    photos: int
    mirrors: int
    heliostats: int
    owner: npt.NDArray[np.intp]

    @classmethod
    def of(cls, photos: int, mirrors: int, owner: npt.ArrayLike | None) -> "_Layout":
        rows = np.arange(mirrors) if owner is None else np.asarray(owner, dtype=np.intp)
        if rows.shape != (mirrors,):
            raise InputError(f"bundle: owners of shape {rows.shape} for {mirrors} mirrors")
        shared = int(rows.max()) + 1 if len(np.unique(rows)) < mirrors else 0
        return cls(photos, mirrors, shared, rows)

    @property
    def offset(self) -> int:
        return 6 * self.photos

    @property
    def mirror(self) -> int:
        return 6 * self.photos + 3

    @property
    def survey(self) -> int:
        return self.mirror + _OF_MIRROR * self.mirrors

    @property
    def size(self) -> int:
        return self.survey + 3 * self.heliostats


@dataclass(frozen=True)
class Adjusted:
    """The result of a bundle adjustment.

    Attributes
    ----------
    state
        Adjusted unknowns.
    offset_covariance
        Covariance of b, m², (3, 3).
    position_sigma
        Standard deviations of the positions, m, (P, 3); NaN beyond `MOST_POSITIONS`.
    place_covariance
        Covariance of each mirror's position relative to the mean position of the photographs that
        show it, m², (N, 3, 3). All reflections on the mirror share this error.
    common_covariance
        Part of ``place_covariance`` that is common to all mirrors, namely that of their mean
        position, m², (3, 3).
    residual
        Residuals of the corners, in standard deviations, (K, 2).
    deviation
        RMS of the residuals without outliers; 1 if the stated standard deviations are right.
    outlier
        Mask of the corners beyond four standard deviations, (K,).
    rounds
        Number of iterations.
    converged
        Whether the last step was negligible.
    """

    state: State
    offset_covariance: FloatArray
    position_sigma: FloatArray
    place_covariance: FloatArray
    common_covariance: FloatArray
    residual: FloatArray
    deviation: float
    outlier: npt.NDArray[np.bool_]
    rounds: int
    converged: bool


def residuals(
    state: State, corners: Corners, *, derivative: bool = True
) -> tuple[FloatArray, tuple[FloatArray, ...]]:
    """Return observed minus expected coordinates (K, 2), and derivatives of the expected ones.

    Returns
    -------
    Residuals, and ∂place/∂φ, ∂t, ∂b, ∂δ, ∂ψ, (K, 2, 3) each, and ∂g, (K, 2, 2); the derivatives are
    computed only if requested.
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
    recorded: npt.ArrayLike,
    sigma: npt.ArrayLike,
    rotations: npt.ArrayLike,
    stand: MirrorPoses,
    corners: Corners,
    priors: Priors | None = None,
    *,
    owner: npt.ArrayLike | None = None,
) -> Adjusted:
    """Return the exterior orientation of all photographs, and the mirrors' poses.

    Parameters
    ----------
    recorded, sigma
        Recorded positions, and their standard deviations without the common part, ENU m, (P, 3).
    rotations
        Initial attitudes, accurate to a few mrad, (P, 3, 3).
    stand
        Mirrors as surveyed and commanded, one entry per pose.
    corners
        Mirror corners seen in the photographs.
    priors
        Prior standard deviations; by default those of `Priors`.
    owner
        Index of each mirror's heliostat, (N,); by default each mirror belongs to a different
        heliostat.

    Raises
    ------
    InputError
        If no corner was seen.
    """
    known = priors or Priors()
    places, spreads = as_float(recorded), as_float(sigma)
    if not len(corners):
        raise InputError("bundle: no corner of a mirror was seen in any photograph")
    layout = _Layout.of(len(places), len(stand), owner)
    state = State(
        places,
        as_float(rotations),
        np.zeros_like(places),
        np.zeros(3),
        stand,
        np.zeros((int(layout.owner.max()) + 1, 3)),
    )
    start, moved, converged, rounds = stand, np.zeros((len(stand), _OF_MIRROR)), False, 0
    solver: SuperLU | None = None
    for rounds in range(1, _MOST_ROUNDS + 1):
        gap, parts = residuals(state, corners)
        scaled = np.linalg.norm(gap, axis=-1) / corners.sigma
        # In the first round a poor start may make all residuals large, so none is an outlier yet.
        limit = HUBER if rounds > 1 else max(HUBER, 3.0 * float(np.median(scaled)))
        scale = np.sqrt(np.minimum(1.0, limit / np.maximum(scaled, 1e-9))) / corners.sigma
        prior, pull = _priors(layout, state, spreads, known, moved)
        solver, right = _normal_equations(layout, corners, gap, parts, scale, prior, pull)
        step = solver.solve(right)
        state, moved = _step(layout, state, start, moved, step)
        if np.abs(step).max() < _STILL:
            converged = True
            break
    assert solver is not None  # There is at least one round.
    return _result(layout, state, corners, solver, rounds, converged)


def _result(
    layout: _Layout,
    state: State,
    corners: Corners,
    solver: "SuperLU",
    rounds: int,
    converged: bool,
) -> Adjusted:
    gap, _ = residuals(state, corners, derivative=False)
    scaled = gap / corners.sigma[:, None]
    outlier = np.linalg.norm(scaled, axis=-1) > 4.0
    kept = scaled[~outlier]
    freedom = max(kept.size - layout.mirror, 1)
    deviation = float(np.sqrt(np.sum(kept**2) / freedom)) if kept.size else float("nan")
    unit = np.eye(3)
    covariance = _covariance(solver, layout.size, [(layout.offset, unit)])
    positions = np.full((layout.photos, 3), np.nan)
    if layout.photos <= MOST_POSITIONS:
        for k in range(layout.photos):
            parts = [(6 * k + 3, unit), (layout.offset, -unit)]
            positions[k] = np.sqrt(np.diag(_covariance(solver, layout.size, parts)))
    places = _place_covariances(layout, corners, solver)
    return Adjusted(
        state, covariance, positions, *places, scaled, deviation, outlier, rounds, converged
    )


def _place_covariances(
    layout: _Layout, corners: Corners, solver: "SuperLU"
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance of d + δ + b minus the mean t of each mirror's photographs, (N, 3, 3).

    The second result is the covariance of the mean of this quantity over all mirrors that were
    seen, (3, 3).
    """
    unit = np.eye(3)
    covariances = np.empty((layout.mirrors, 3, 3))
    pairs = np.unique(np.stack([corners.mirror, corners.photo]), axis=1)
    count = len(np.unique(pairs[0]))
    whole: dict[int, FloatArray] = {}
    for n in range(layout.mirrors):
        mine = pairs[1, pairs[0] == n]
        parts = [(6 * int(k) + 3, -unit / len(mine)) for k in mine]
        parts += [(layout.offset, unit), (layout.mirror + _OF_MIRROR * n, unit)]
        if layout.heliostats:
            parts.append((layout.survey + 3 * int(layout.owner[n]), unit))
        covariances[n] = _covariance(solver, layout.size, parts)
        for place, share in parts if len(mine) else ():
            whole[place] = whole.get(place, 0.0) + share / count
    return covariances, _covariance(solver, layout.size, list(whole.items()))


def _priors(
    layout: _Layout, state: State, spreads: FloatArray, known: Priors, moved: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the weights of all priors, and the right-hand side that they add."""
    prior, pull = np.zeros(layout.size), np.zeros(layout.size)
    photo = slice(0, layout.offset)
    own, drawn = (a[photo].reshape(-1, 6) for a in (prior, pull))
    own[:, :3], own[:, 3:] = 1e-2, 1.0 / spreads**2
    drawn[:, 3:] = -state.error / spreads**2
    common = slice(layout.offset, layout.mirror)
    prior[common], pull[common] = 1.0 / known.offset**2, -state.offset / known.offset**2
    mirror = slice(layout.mirror, layout.survey)
    rest = prior[mirror].reshape(-1, _OF_MIRROR)
    alone = known.kinematics if layout.heliostats else np.hypot(known.kinematics, known.position)
    rest[:, :3] = 1.0 / max(alone, _FIRM) ** 2
    rest[:, 3:6], rest[:, 6:] = 1.0 / known.turn**2, 1.0 / known.growth**2
    pull[mirror] = -(rest * moved).reshape(-1)
    if layout.heliostats:
        prior[layout.survey :] = 1.0 / max(known.position, _FIRM) ** 2
        pull[layout.survey :] = -state.survey.reshape(-1) * prior[layout.survey :]
    return prior, pull


def _normal_equations(
    layout: _Layout,
    corners: Corners,
    gap: FloatArray,
    parts: tuple[FloatArray, ...],
    scale: FloatArray,
    prior: FloatArray,
    pull: FloatArray,
) -> "tuple[SuperLU, FloatArray]":
    """Return the factorised normal matrix and the right-hand side."""
    from scipy.sparse.linalg import splu

    jacobian = jacobian_matrix(corners, parts, layout)
    rows = np.repeat(scale, 2)
    weighted = jacobian.multiply(rows[:, None]).tocsc()
    normal: csc_array = (weighted.T @ weighted).tocsc()
    normal.setdiag(normal.diagonal() + prior)
    solver = splu(
        normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
    )
    return solver, weighted.T @ (gap.reshape(-1) * rows) + pull


def jacobian_matrix(
    corners: Corners, parts: tuple[FloatArray, ...], layout: _Layout
) -> "csc_array":
    """Return the sparse derivative of all coordinates with respect to all U unknowns, (2K, U)."""
    from scipy.sparse import csc_array

    count = len(corners)
    mirror = layout.mirror + _OF_MIRROR * corners.mirror
    starts = [
        6 * corners.photo, 6 * corners.photo + 3, np.full(count, layout.offset), mirror,
        mirror + 3, mirror + 6,
    ]  # fmt: skip
    blocks = list(parts)
    if layout.heliostats:
        # d moves a mirror as δ does.
        starts.append(layout.survey + 3 * layout.owner[corners.mirror])
        blocks.append(parts[3])
    values, rows, columns = [], [], []
    for start, part in zip(starts, blocks, strict=True):
        line = np.arange(2 * count).reshape(count, 2, 1)
        column = start[:, None, None] + np.arange(part.shape[2])
        values.append(part.ravel())
        rows.append(np.broadcast_to(line, part.shape).ravel())
        columns.append(np.broadcast_to(column, part.shape).ravel())
    place = (np.concatenate(rows), np.concatenate(columns))
    return csc_array((np.concatenate(values), place), shape=(2 * count, layout.size))


def _step(
    layout: _Layout, state: State, start: MirrorPoses, moved: FloatArray, step: FloatArray
) -> tuple[State, FloatArray]:
    own = step[: layout.offset].reshape(-1, 6)
    total = moved + step[layout.mirror : layout.survey].reshape(-1, _OF_MIRROR)
    survey = state.survey
    if layout.heliostats:
        survey = survey + step[layout.survey :].reshape(-1, 3)
    return replace(
        state,
        rotation=state.rotation @ _turns(own[:, :3]),
        error=state.error + own[:, 3:],
        offset=state.offset + step[layout.offset : layout.mirror],
        survey=survey,
        stand=replace(
            start,
            vertex=start.vertex + total[:, :3] + survey[layout.owner],
            # ψ is small, and its prior refers to the starting pose.
            rotation=start.rotation @ _turns(total[:, 3:6]),
            outline=start.outline * (1.0 + np.pad(total[:, None, 6:], ((0, 0), (0, 0), (0, 1)))),
        ),
    ), total


def _turns(small: FloatArray) -> FloatArray:
    return rotation(small, np.linalg.norm(small, axis=-1))


def _covariance(
    solver: "SuperLU", size: int, parts: Sequence[tuple[int, FloatArray]]
) -> FloatArray:
    """Return the covariance of a sum of matrices times three-vectors of unknowns, (3, 3)."""
    unit = np.zeros((size, 3))
    for at, factor in parts:
        unit[at : at + 3] += factor.T
    return as_float(unit.T @ solver.solve(unit))
