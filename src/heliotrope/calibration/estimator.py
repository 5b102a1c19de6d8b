r"""The estimator: maximum a posteriori parameters of every heliostat.

For each heliostat the deviations x of the model's parameters minimise

.. math:: \sum_i ρ(|W_i\,(n_i(x) - b_i(x))|^2 / s^2) + \sum_p (x_p / σ_p)^2

with n the mechanism's normal, b the bisector of source and destination as seen from its
vertex, W the whitening by the sighting's standard deviation, s the scale of the
residuals found from themselves, ρ a robust loss and σ the priors of the parameter table.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.calibration import _fit_kernels as kernels
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, tangent_axes, wrap_signed
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.parallel import run_blocks

Loss = Literal["square", "huber", "cauchy"]
_LOSSES = {"square": kernels.SQUARE, "huber": kernels.HUBER, "cauchy": kernels.CAUCHY}

#: A start is sought globally where the nominal mechanism misses by more than this, rad.
FAR = 0.1


class Outcome(IntEnum):
    """How the fit of a heliostat ended."""

    CONVERGED = kernels.CONVERGED
    NOT_CONVERGED = kernels.NOT_CONVERGED
    TOO_FEW = kernels.TOO_FEW
    FAILED = kernels.FAILED

    @property
    def text(self) -> str:
        """One sentence on what it means."""
        return _TEXTS[self]


_TEXTS = {
    Outcome.CONVERGED: "converged",
    Outcome.NOT_CONVERGED: "the iteration did not settle; the parameters may not be the best",
    Outcome.TOO_FEW: "no sightings: the parameters are the prior's",
    Outcome.FAILED: "the residuals are not finite from the start; check the nominal mechanism",
}


@dataclass(frozen=True)
class Calibration:
    """What was learnt of N heliostats in P parameters.

    Attributes
    ----------
    names
        The P parameters.
    values
        Deviations from the nominal mechanism, rad, m or 1, (N, P).
    covariance
        Of the values, (N, P, P), with the noise scaled to the residuals.
    prior
        Standard deviations of the priors, (N, P).
    scale
        Noise found, in units of the sightings' sigma, (N,).
    lengths
        Length of each sighting's whitened residual in units of ``scale``, (M,).
    count
        Sightings used of each heliostat, (N,).
    iterations, outcome
        (N,); :class:`Outcome` as integers.
    """

    names: tuple[str, ...]
    values: FloatArray
    covariance: FloatArray
    prior: FloatArray
    scale: FloatArray
    lengths: FloatArray
    count: npt.NDArray[np.int64]
    iterations: npt.NDArray[np.int64]
    outcome: npt.NDArray[np.int8]

    @property
    def parameters(self) -> dict[str, FloatArray]:
        """Values by name, each (N,)."""
        return {name: self.values[:, p] for p, name in enumerate(self.names)}

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the values, (N, P)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


def fit(
    mechanism: Mechanism,
    sightings: Sightings,
    model: str | tuple[str, ...],
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    loss: Loss = "cauchy",
    adapt_scale: bool = True,
    keep: npt.ArrayLike | None = None,
    max_iterations: int = 100,
) -> Calibration:
    """Return the maximum a posteriori parameters of each mechanism.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, batch shape (N,).
    sightings
        Of these heliostats, in any order.
    model
        Name of a model of the parameter table, or names of parameters.
    priors
        Standard deviations that replace the table's, by name, (N,) or scalars.
    loss
        "square", "huber" or "cauchy".
    adapt_scale
        Find the noise from the residuals; otherwise the sightings' sigma is believed.
    keep
        Mask of the sightings to use, (M,).
    max_iterations
        Of Levenberg-Marquardt for each heliostat and round of the scale.

    Raises
    ------
    InputError
        If the sightings name heliostats that are not there, or a prior is not above 0.
    UnknownNameError
        If the model or one of its parameters is not known.
    """
    if len(mechanism.shape) != 1:
        raise InputError(f"fit: mechanisms of shape {mechanism.shape}; give one batch axis (N,)")
    count, rows = len(mechanism), len(sightings)
    if rows and int(sightings.heliostat.max()) >= count:
        raise InputError(
            f"fit: a sighting is of heliostat row {int(sightings.heliostat.max())}; there are "
            f"{count} heliostats"
        )
    names = (
        parameter_table.model(model, mechanism.parameters) if isinstance(model, str) else model
    )
    sigma = _priors(mechanism, names, priors or {})
    used = np.ones(rows, dtype=np.bool_) if keep is None else np.asarray(keep, dtype=np.bool_)
    order = _canonical_order(sightings)
    ordered = sightings.take(order)
    begin = _far_starts(mechanism, ordered, names)
    shape = (count, len(names))
    result = Calibration(
        names=names,
        values=np.empty(shape),
        covariance=np.empty((*shape, len(names))),
        prior=sigma,
        scale=np.empty(count),
        lengths=np.full(rows, np.nan),
        count=np.bincount(sightings.heliostat[used], minlength=count),
        iterations=np.empty(count, dtype=np.int64),
        outcome=np.empty(count, dtype=np.int8),
    )
    codes = mechanism.codes(names)
    started = mechanism.with_parameters({n: begin[:, p] for p, n in enumerate(names)})
    data = _data(started, ordered, used[order])
    offsets = np.searchsorted(ordered.heliostat, np.arange(count + 1))
    squares, costs = np.full(rows, np.nan), np.empty(count)
    arrays = started.kernel_arrays
    run_blocks(
        lambda a, b: kernels.fit_block(
            arrays, codes, sigma, offsets, data, _LOSSES[loss], 4 if adapt_scale else 0,
            max_iterations, 1e-3, result.values, result.covariance, result.scale, squares, costs,
            result.iterations, result.outcome, a, b,
        ),
        count,
        minimum_rows=2,
    )  # fmt: skip
    # The prior stands around the start: a zero that is off by a radian is a wrong entry,
    # not an improbable installation.
    result.values[:] += begin
    result.lengths[order] = np.sqrt(squares) / result.scale[ordered.heliostat]
    return result


def _priors(
    mechanism: Mechanism, names: tuple[str, ...], given: Mapping[str, npt.ArrayLike]
) -> FloatArray:
    for name in given:
        mechanism.parameter(name)
    columns = []
    for name in names:
        value = as_float(given.get(name, mechanism.parameter(name).prior))
        if not (np.isfinite(value) & (value > 0)).all():
            raise InputError(f"prior of {name}: {value} must be above 0 and finite")
        columns.append(np.broadcast_to(value, (len(mechanism),)))
    return np.stack(columns, axis=-1) if columns else np.empty((len(mechanism), 0))


def _canonical_order(s: Sightings) -> npt.NDArray[np.intp]:
    """Heliostat by heliostat, and within one an order that does not depend on the rows'."""
    keys = (*s.destination.T, *s.source.T, *s.counts.T, s.time, s.heliostat)
    return np.lexsort(keys)


def _data(
    mechanism: Mechanism, s: Sightings, keep: npt.NDArray[np.bool_]
) -> tuple[np.ndarray, ...]:
    """The sightings as the kernels read them; axes and whitening are those of the start."""
    axes, whiten = np.zeros((len(s), 2, 3)), np.zeros((len(s), 2, 2))
    if len(s):
        vertex = mechanism[s.heliostat].pose(s.counts).vertex
        source, way = ray_directions(s, vertex)
        total = source + way
        size = np.linalg.norm(total, axis=-1, keepdims=True)
        normal = total / size
        axes = tangent_axes(normal)
        # A turn of the ray t by ε moves the bisector by its part across the normal over
        # |s + t|: the whole of it across the plane of incidence, cos i of it within.
        spread = np.eye(3) - way[:, :, None] * way[:, None, :]
        across = axes / size[:, :, None]
        covariance = across @ spread @ np.swapaxes(across, -1, -2) * s.sigma[:, None, None] ** 2
        whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    return (
        s.counts, s.source, s.source_at_infinity, s.destination, s.destination_at_infinity, axes,
        whiten, keep,
    )  # fmt: skip


def _far_starts(mechanism: Mechanism, s: Sightings, names: tuple[str, ...]) -> FloatArray:
    """Starting values: zero, but the two zero angles where the nominal ones are far off.

    Each sighting says at which joint angles the nominal axes would produce it; the
    difference to the angles of the drives is the zero's error, the same for all
    sightings of a heliostat if that is what is wrong. Its median over them is the start.
    """
    begin = np.zeros((len(mechanism), len(names)))
    zeros = [_zero_parameter(mechanism, names, d) for d in range(len(mechanism.driven))]
    if None in zeros or len(zeros) != 2 or not len(s):
        return begin
    every = mechanism[s.heliostat]
    pose = every.pose(s.counts)
    source, way = ray_directions(s, pose.vertex)
    total = source + way
    cosine = np.sum(total * pose.normal, axis=-1) / np.linalg.norm(total, axis=-1)
    miss = np.arccos(np.clip(cosine, -1.0, 1.0))
    rows = np.arange(len(mechanism) + 1)
    offsets = np.searchsorted(s.heliostat, rows)
    for i in range(len(mechanism)):
        part = slice(int(offsets[i]), int(offsets[i + 1]))
        if part.start == part.stop or np.median(miss[part]) < FAR:
            continue
        one = mechanism[i]
        counts = s.counts[part]
        aim = np.where(
            s.destination_at_infinity[part, None],
            pose.vertex[part] + 1e6 * s.destination[part],
            s.destination[part],
        )
        solved = track(one.armature, source[part], aim)
        drives = one.drives.angles(counts)
        gaps = wrap_signed(solved.angles - drives[:, None, :])
        shifts = [_circular_median(gaps[:, branch]) for branch in (0, 1)]
        costs = [
            float(np.median(np.abs(wrap_signed(gaps[:, b] - shifts[b])).max(axis=-1)))
            for b in (0, 1)
        ]
        best = int(np.argmin(costs))
        for d, place in enumerate(zeros):
            begin[i, place] = shifts[best][d]
    return begin


def _zero_parameter(mechanism: Mechanism, names: tuple[str, ...], drive: int) -> int | None:
    joint = mechanism.joints[mechanism.driven[drive]]
    for suffix in ("initial_angle", "bias"):
        if f"{joint}_{suffix}" in names:
            return names.index(f"{joint}_{suffix}")
    return None


def _circular_median(angles: FloatArray) -> FloatArray:
    """Median of angles (M, 2) about their densest place, per column."""
    found = []
    for column in angles.T:
        near = np.abs(wrap_signed(column[:, None] - column[None, :]))
        centre = column[int(np.argmin(np.sum(np.minimum(near, 0.05), axis=1)))]
        found.append(centre + np.median(wrap_signed(column - centre)))
    return wrap_signed(np.array(found))
