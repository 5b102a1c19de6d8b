r"""The estimator: maximum a posteriori parameters of every heliostat.

For each heliostat the fit finds the deviations x of the model's parameters that minimise

$$ \sum_i ρ(|W_i\,(n_i(x) - b_i(x))|^2 / s^2) + \sum_p (x_p / σ_p)^2 $$

where n is the mirror normal that the mechanism predicts, b the bisector of source and destination
as seen from the mirror vertex, W the matrix that whitens by the sighting's covariance, s the scale
of the residuals (estimated from the residuals themselves), ρ a robust loss and σ the prior standard
deviations from the parameter table.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope import jit
from heliotrope.calibration.fit import _fit_kernels as kernels
from heliotrope.calibration.fit.residuals import whitening
from heliotrope.calibration.named import Field, members
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.errors import InputError, UnknownNameError, kind_of, require
from heliotrope.frames import Framed, Labelled, Variable
from heliotrope.geometry import (
    FloatArray,
    angle_between,
    as_numbers,
    bisector,
    wrap_signed,
)
from heliotrope.jit import as_input
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism, Pose
from heliotrope.mechanism.drives import SLOTS, Drive
from heliotrope.mechanism.tracking import track
from heliotrope.parallel import run_blocks
from heliotrope.values import Card, Value, amount

Loss = Literal["square", "huber", "cauchy"]
_LOSSES = {"square": kernels.SQUARE, "huber": kernels.HUBER, "cauchy": kernels.CAUCHY}

#: If the nominal mechanism misses by more than this, rad, starting values are searched globally.
FAR = 0.15


class FitOutcome(IntEnum):
    """Outcome of the fit of one heliostat."""

    CONVERGED = kernels.CONVERGED
    NOT_CONVERGED = kernels.NOT_CONVERGED
    TOO_FEW = kernels.TOO_FEW
    FAILED = kernels.FAILED
    MISFIT = kernels.FAILED + 1
    UNMOVED = kernels.FAILED + 2
    CLOCK = kernels.FAILED + 3

    @property
    def text(self) -> str:
        """Return the outcome in one clause, for display."""
        return _TEXTS[self]


_TEXTS = {
    FitOutcome.CONVERGED: "converged",
    FitOutcome.NOT_CONVERGED: (
        "the iteration did not converge; the parameters may not be the best fit"
    ),
    FitOutcome.TOO_FEW: "no sightings, so the parameters stay at their prior values",
    FitOutcome.FAILED: "the residuals are not finite from the start; check the nominal mechanism",
    FitOutcome.MISFIT: (
        "no plausible parameters explain the sightings; the parameters stay at their prior values"
    ),
    FitOutcome.UNMOVED: "the mirror did not move, so the parameters stay at their prior values",
    FitOutcome.CLOCK: "the clock may be wrong, and the parameters would absorb its error",
}


@dataclass(frozen=True, eq=False, repr=False)
class FieldFit(Value, Framed):
    """Fitted parameters of N heliostats, or of a single mechanism without the axis N.

    Attributes
    ----------
    names
        Names of the P parameters.
    values
        Deviations from the nominal mechanism, rad, m or 1, (N, P).
    covariance
        Covariance of the values, (N, P, P), with the noise scaled to match the residuals.
    prior
        Standard deviations of the priors, (N, P).
    scale
        Estimated noise in units of the sightings' sigma, (N,).
    lengths, rows
        Length of each sighting's whitened residual in units of ``scale``, and the index of its
        heliostat, (M,).
    count
        Number of sightings used, (N,).
    iterations, outcome
        Number of iterations, and `FitOutcome` as an integer, (N,).
    centre
        Centre of the priors, (N, P): zero, or a start value far from nominal.
    heliostats
        Names, (N,); () if unknown.
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
    centre: FloatArray
    rows: npt.NDArray[np.int64]
    heliostats: tuple[str, ...] = ()

    def _card(self) -> Card:
        ends = [FitOutcome(int(o)) for o in np.atleast_1d(self.outcome)]
        counts = ", ".join(
            f"{ends.count(o)} {o.name.lower().replace('_', ' ')}" for o in FitOutcome if o in ends
        )
        line = f"{amount(len(self.names), 'parameter')} of {amount(len(ends), 'heliostat')} from "
        line += f"{amount(int(self.count.sum()), 'sighting')}: {counts}"
        many = len(ends) > 1
        header = ("parameter", "median size" if many else "value", "median σ" if many else "σ")
        sizes = np.abs(self.values) if many else np.atleast_2d(self.values)
        return Card(line, header, parameter_rows(self.names, sizes, np.atleast_2d(self.sigma)))

    def _labelled(self) -> Labelled:
        row, units = ("heliostat",), tuple(map(parameter_table.unit_of, self.names))
        size = len(self.names)

        def table(values: FloatArray) -> Variable:
            return Variable((*row, "parameter"), values.reshape(-1, size), units)

        return Labelled(
            row,
            {
                "heliostat": self.heliostats or np.arange(np.size(self.scale)),
                "parameter": self.names,
                "parameter_2": self.names,
            },
            {
                "value": table(self.values),
                "sigma": table(self.sigma),
                "prior": table(self.prior),
                "centre": table(self.centre),
                "covariance": Variable(
                    (*row, "parameter", "parameter_2"), self.covariance.reshape(-1, size, size)
                ),
                "scale": Variable(row, np.atleast_1d(self.scale)),
                "sightings": Variable(row, np.atleast_1d(self.count)),
                "outcome": Variable(row, np.atleast_1d(self.outcome)),
            },
            frozenset({"covariance"}),
            on_request=frozenset({"prior", "centre"}),
        )

    @property
    def parameters(self) -> dict[str, FloatArray]:
        """Return the values by name, (N,) each, in the form that `with_calibration` accepts."""
        return {name: self.values[..., p] for p, name in enumerate(self.names)}

    @property
    def sigma(self) -> FloatArray:
        """Return the standard deviations of the values, (N, P)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    def __getitem__(self, heliostat: int | str) -> "FieldFit":
        """Return the fit of one heliostat, given by name or index, without the axis N.

        Raises
        ------
        InputError
            If there is no such index.
        UnknownNameError
            If there is no such name.
        """
        if isinstance(heliostat, str):
            if heliostat not in self.heliostats:
                raise UnknownNameError("heliostat (fitted)", heliostat, self.heliostats)
            heliostat = self.heliostats.index(heliostat)
        count = np.size(self.scale)
        if not 0 <= heliostat < count:
            raise InputError(
                f"heliostat {heliostat}: the fit has {count} heliostats; pass an index or a name"
            )
        return self.of_one(heliostat) if np.ndim(self.scale) else self

    def only(self, row: int) -> "FieldFit":
        """Return the fit of one heliostat, keeping the axis N with length 1."""
        mine = self.rows == row
        values = {name: getattr(self, name)[row : row + 1] for name in BY_HELIOSTAT}
        rows = np.zeros(int(mine.sum()), dtype=np.int64)
        names = self.heliostats[row : row + 1]
        return replace(self, lengths=self.lengths[mine], rows=rows, heliostats=names, **values)

    def of_one(self, row: int = 0) -> "FieldFit":
        """Return the fit of one heliostat without the axis N."""
        fitted = self.only(row)
        return replace(fitted, **{name: getattr(fitted, name)[0] for name in BY_HELIOSTAT})


#: The arrays of a fit that have the axis N.
BY_HELIOSTAT = (
    "values",
    "covariance",
    "prior",
    "scale",
    "count",
    "iterations",
    "outcome",
    "centre",
)


def parameter_rows(
    names: tuple[str, ...], values: FloatArray, sigma: FloatArray
) -> list[tuple[str, str, str]]:
    """Return one table row per parameter, with the median value and the median sigma."""
    rows = []
    for p, name in enumerate(names):
        scale, unit = parameter_table.shown_in(name)
        figures = [
            scale * float(np.median(x[..., p])) if x.size else np.nan for x in (values, sigma)
        ]
        rows.append((name, *(f"{x:.4g} {unit}".strip() for x in figures)))
    return rows  # type: ignore[return-value]


def is_compiled() -> bool:
    """Return whether the fit kernels are already compiled."""
    return jit.is_compiled(kernels.fit_block)


def fit(
    mechanism: Field,
    sightings: Sightings,
    model: str | tuple[str, ...],
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    loss: Loss = "cauchy",
    adapt_scale: bool = True,
    keep: npt.ArrayLike | None = None,
    max_iterations: int = 100,
) -> FieldFit:
    """Return the maximum a posteriori parameters of each mechanism.

    Parameters
    ----------
    mechanism
        Nominal mechanisms of the heliostats, batch shape (N,) or (); or ``plant[name]``, a group or
        a plant, whose nominal mechanisms are then fitted.
    sightings
        Sightings of these heliostats, in any order.
    model
        Name of a model in the parameter table, or names of parameters.
    priors
        Standard deviations that replace those of the table, by name, (N,) or scalars.
    loss
        "square", "huber" or "cauchy".
    adapt_scale
        Whether to estimate the noise from the residuals; otherwise the sightings' sigma is used.
    keep
        Mask of the sightings to fit, (M,).
    max_iterations
        Maximum number of Levenberg-Marquardt steps, per heliostat and per estimate of the scale.

    Raises
    ------
    InputError
        If a sighting refers to a heliostat that does not exist, a prior is not above 0, or the
        model includes the ratio of a worm.
    UnknownNameError
        If the model, one of its parameters or the loss is unknown.
    """
    _check_options(loss, max_iterations)
    field = members(mechanism)
    fitted = _fit(
        field.mechanism,
        field.rows_of(sightings),
        model,
        priors or {},
        loss,
        adapt_scale,
        keep,
        max_iterations,
    )
    fitted = replace(fitted, heliostats=field.names or sightings.names)
    return fitted.of_one() if field.single else fitted


def _fit(
    mechanism: Mechanism,
    sightings: Sightings,
    model: str | tuple[str, ...],
    priors: Mapping[str, npt.ArrayLike],
    loss: Loss,
    adapt_scale: bool,
    keep: npt.ArrayLike | None,
    max_iterations: int,
) -> FieldFit:
    count, rows = len(mechanism), len(sightings)
    names = names_of(model, mechanism)
    sigma = _priors(mechanism, names, priors)
    used = mask_of(keep, rows, "keep")
    order = canonical_order(sightings)
    ordered = sightings.take(order)
    pose = mechanism[ordered.heliostat].pose(ordered.counts)
    begin = _far_starts(mechanism, ordered, used[order], pose, names)
    shape = (count, len(names))
    result = FieldFit(
        names=names,
        values=np.empty(shape),
        covariance=np.empty((*shape, len(names))),
        prior=sigma,
        scale=np.empty(count),
        lengths=np.full(rows, np.nan),
        count=np.bincount(sightings.heliostat[used], minlength=count),
        iterations=np.empty(count, dtype=np.int64),
        outcome=np.empty(count, dtype=np.int8),
        centre=begin,
        rows=sightings.heliostat,
    )
    codes = mechanism.codes(names)
    started = mechanism.with_parameters({n: begin[:, p] for p, n in enumerate(names)})
    if begin.any():
        pose = started[ordered.heliostat].pose(ordered.counts)
    data = _data(ordered, pose.vertex, used[order])
    offsets = np.searchsorted(ordered.heliostat, np.arange(count + 1))
    squares, costs = np.full(rows, np.nan), np.empty(count)
    arrays = started.kernel_arrays
    run_blocks(
        lambda a, b: kernels.fit_block(
            arrays,
            codes,
            sigma,
            offsets,
            data,
            _LOSSES[loss],
            4 if adapt_scale else 0,
            max_iterations,
            1e-3,
            result.values,
            result.covariance,
            result.scale,
            squares,
            costs,
            result.iterations,
            result.outcome,
            a,
            b,
        ),
        count,
        minimum_rows=2,
    )
    # The prior is centred on the start, because a drive zero that is off by a radian is a wrong
    # entry in the plant file, not an improbable installation.
    result.values[:] += begin
    _reject(result, mechanism)
    result.lengths[order] = np.sqrt(squares) / result.scale[ordered.heliostat]
    return result


def _reject(result: FieldFit, mechanism: Mechanism) -> None:
    """Reject impossible parameters, so that the heliostat keeps its nominal parameters."""
    most = np.array([mechanism.most(name) for name in result.names])
    beyond = ~(np.abs(result.values) <= most).all(axis=1)
    result.outcome[beyond & (result.outcome != FitOutcome.FAILED)] = FitOutcome.MISFIT
    result.values[beyond], result.centre[beyond] = 0.0, 0.0
    result.covariance[beyond] = result.prior[beyond, :, None] ** 2 * np.eye(len(result.names))


def _check_options(loss: str, max_iterations: int) -> None:
    if loss not in _LOSSES:
        raise UnknownNameError("loss", str(loss), _LOSSES)
    if not max_iterations >= 1:
        raise InputError(f"max_iterations must be at least 1, not {max_iterations}")


def names_of(model: str | Sequence[str], mechanism: Mechanism) -> tuple[str, ...]:
    """Return the parameter names of a model or of an explicit list.

    Raises
    ------
    InputError
        If the argument is neither a name nor a list of names.
    UnknownNameError
        If there is no such model or parameter.
    """
    if isinstance(model, str):
        return parameter_table.model(model, mechanism.parameters)
    if not isinstance(model, list | tuple):
        raise InputError(
            f"model: {kind_of(model)}; pass the name of a model or a list of parameter names"
        )
    for name in model:
        if not isinstance(name, str):
            raise InputError(
                f"model: {kind_of(name)} is not the name of a parameter; pass parameter names "
                "(to fit error terms of your own, use fit_terms)"
            )
        mechanism.parameter(name)
    return tuple(model)


def mask_of(selection: npt.ArrayLike | None, rows: int, name: str) -> npt.NDArray[np.bool_]:
    """Return a mask of M sightings; None selects all of them.

    Raises
    ------
    InputError
        If the mask has another shape, or contains anything but true and false.
    """
    if selection is None:
        return np.ones(rows, dtype=np.bool_)
    mask = np.asarray(selection)
    if mask.shape != (rows,) or (mask.dtype != np.bool_ and rows):
        raise InputError(
            f"{name}: {mask.dtype} of shape {mask.shape}; pass a boolean mask of shape ({rows},)"
        )
    return mask.astype(np.bool_)


def _priors(
    mechanism: Mechanism, names: tuple[str, ...], priors: Mapping[str, npt.ArrayLike]
) -> FloatArray:
    require("priors", priors, Mapping, "standard deviations by parameter name")
    for name in priors:
        mechanism.parameter(name)
    for name in names:
        if name.endswith("_worm_ratio"):
            raise InputError(
                f"fit: {name} is found by a search, not by a fit; set worm_ratio in the plant "
                "file, or use model auto"
            )
    columns = []
    for name in names:
        value = as_numbers(priors.get(name, mechanism.parameter(name).prior), f"prior of {name}")
        if not (np.isfinite(value) & (value > 0)).all():
            raise InputError(f"prior of {name} must be above 0 and finite, not {value}")
        if value.shape not in ((), (len(mechanism),)):
            raise InputError(
                f"prior of {name}: shape {value.shape}; pass one number or {len(mechanism)} numbers"
            )
        columns.append(np.broadcast_to(value, (len(mechanism),)))
    return np.stack(columns, axis=-1) if columns else np.empty((len(mechanism), 0))


def canonical_order(s: Sightings) -> npt.NDArray[np.intp]:
    """Return sighting indices sorted by heliostat, then in an order independent of the input."""
    first = (s.counts[:, -1], s.time, s.heliostat)
    order = np.lexsort(first)
    alike = np.ones(max(len(order) - 1, 0), dtype=np.bool_)
    for key in first:
        # Unknown times compare as equal.
        alike &= ~(key[order[1:]] != key[order[:-1]]) | np.isnan(key[order[1:]].astype(float))
    if alike.any():
        more = (
            *s.source_covariance.reshape(len(s), -1).T,
            *s.destination_covariance.reshape(len(s), -1).T,
            s.sigma,
        )
        order = np.lexsort((*more, *s.destination.T, *s.source.T, *s.counts.T, *first[1:]))
    return order


def _data(s: Sightings, vertex: FloatArray, keep: npt.NDArray[np.bool_]) -> tuple[np.ndarray, ...]:
    """Return the arrays that the kernels read, with axes and whitening at the starting values."""
    axes, whiten = np.zeros((len(s), 2, 3)), np.zeros((len(s), 2, 2))
    if len(s):
        axes, whiten = whitening(s, vertex)
    return (
        *map(as_input, (s.counts, s.source, s.source_at_infinity)),
        *map(as_input, (s.destination, s.destination_at_infinity)),
        axes,
        whiten,
        as_input(keep),
    )


def _far_starts(
    mechanism: Mechanism,
    s: Sightings,
    used: npt.NDArray[np.bool_],
    pose: Pose,
    names: tuple[str, ...],
) -> FloatArray:
    """Return starting values: 0, except for drive zeros and strokes that are far off as stated.

    For each sighting, the joint angles at which the nominal axes would produce it are computed.
    These are compared with the drives' own angles by one regression per joint. The zero is the
    median of the differences; for a jack, lengths at 0 counts are tried over the range that its
    triangle allows. A start is used only where it explains the sightings far better.
    """
    begin = np.zeros((len(mechanism), len(names)))
    places = [_start_parameters(mechanism, names, d) for d in range(len(mechanism.driven))]
    if len(places) != 2 or any(zero is None for zero, _ in places) or not len(s):
        return begin
    source, destination = ray_directions(s, pose.vertex)
    miss = angle_between(pose.normal, bisector(source, destination))
    for i in np.unique(s.heliostat[used & (miss > FAR)]):
        part = np.flatnonzero(used & (s.heliostat == i))
        if len(part) < 3 or np.median(miss[part]) < FAR:
            continue
        far = s.destination_at_infinity[part, None]
        aim = np.where(far, pose.vertex[part] + 1e6 * s.destination[part], s.destination[part])
        solved = track(mechanism[i].armature, source[part], aim)
        trials = [
            [
                _regress(
                    Drive(mechanism.drives.table[i, d]),
                    s.counts[part, d],
                    solved.angles[:, branch, d],
                    stroke is not None,
                )
                for d, (_, stroke) in enumerate(places)
            ]
            for branch in (0, 1)
        ]
        # Both joints are on the same branch; on the wrong branch the zeros are off by half a turn.
        scores = [sum(f[0] * (1.0 + abs(f[1])) for f in both) for both in trials]
        for (zero, stroke), (_, shift, longer) in zip(
            places, trials[int(np.argmin(scores))], strict=True
        ):
            if zero is not None:
                begin[i, zero] = shift
            if stroke is not None:
                begin[i, stroke] = longer
    return begin


def _regress(
    drive: Drive, counts: FloatArray, angles: FloatArray, jack: bool
) -> tuple[float, float, float]:
    """Return (spread of the residuals, shift of the zero, added stroke) of one drive."""
    trials = [0.0]
    if jack:
        row = drive.table
        stroke, c, r = (row[SLOTS[n]] for n in ("stroke_offset", "offset", "pivot_radius"))
        ends = (
            stroke
            + np.array([0.0, 0.0])
            + np.array([counts.min(), counts.max()]) * row[SLOTS["rate"]]
        )
        low = abs(c - r) + 1e-3 + stroke - min(ends.min(), stroke)
        high = c + r - 1e-3 + stroke - max(ends.max(), stroke)
        # If the counts span more than the triangle allows, there is no length to try.
        trials += list(np.linspace(low, high, 200) - stroke) if low < high else []
    # All lengths are tried at once; one after another, they took a third of a model search.
    table = np.tile(drive.table, (len(trials), 1, 1))
    table[..., SLOTS["stroke_offset"]] += np.array(trials)[:, None]
    gaps = wrap_signed(angles - Drive(table).angles(counts))
    # The median of angles is defined once the circle is cut opposite to their mean direction.
    centre = np.arctan2(np.sin(gaps).sum(axis=-1), np.cos(gaps).sum(axis=-1))
    rest = wrap_signed(gaps - centre[:, None])
    middle = np.median(rest, axis=-1)
    shifts = wrap_signed(centre + middle)
    spreads = np.median(np.abs(rest - middle[:, None]), axis=-1)
    best = (np.inf, 0.0, 0.0)
    for longer, shift, spread in zip(trials, shifts, spreads, strict=True):
        # A change of stroke must halve the spread: two parameters always fit better than one.
        if spread < (0.5 if best[2] == 0.0 and longer != 0.0 else 1.0) * best[0]:
            best = (float(spread), float(shift), float(longer))
    return best


def _start_parameters(
    mechanism: Mechanism, names: tuple[str, ...], drive: int
) -> tuple[int | None, int | None]:
    """Return the indices of a drive's zero and stroke among the names; None if absent."""
    joint = mechanism.joints[mechanism.driven[drive]]

    def place(*suffixes: str) -> int | None:
        rows = [names.index(f"{joint}_{x}") for x in suffixes if f"{joint}_{x}" in names]
        return rows[0] if rows else None

    return place("initial_angle", "bias"), place("stroke_offset")
