"""Learn a field: estimate, from sightings, parameters that predict beams with an uncertainty.

1. Fit each heliostat robustly, maximum a posteriori (`fit.estimator`).
2. Find regimes in time (`regimes`), and fit again the regime with the common zeros.
3. From a sample of the field, find the population of the parameters, their drift and the noise
  (`drift`), leaving out the outliers (`outliers`).
4. Compute the posterior of each heliostat given its own sightings and these hyperparameters.

Steps 1, 2 and 4 treat every heliostat independently; only step 3 needs several heliostats.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from heliotrope.calibration.fit.estimator import (
    BY_HELIOSTAT,
    FieldFit,
    Loss,
    canonical_order,
    fit,
    mask_of,
    names_of,
)
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import drift
from heliotrope.calibration.learn.drift import DAY, Hyperparameters, Linear, Posterior
from heliotrope.calibration.learn.learned import Learned, moved_by
from heliotrope.calibration.learn.misfits import Misfit, find_misfits, scattered
from heliotrope.calibration.learn.regimes import find_regimes
from heliotrope.calibration.learn.unusable import find_unusable, is_usable
from heliotrope.calibration.named import Field, Members, members
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism.chain import Mechanism
from heliotrope.parallel import threads

#: Hyperparameters are learnt only from heliostats with at least this many sightings.
FEWEST = 8
#: Maximum number of heliostats from which the hyperparameters are learnt.
SAMPLE = 60
#: A start this many prior standard deviations away indicates a mistake in the plant data.
MISTAKE = 5.0
#: Residuals of the robust fit longer than this, in units of its scale, are suspect.
SUSPECT = 8.0
#: Number of repeated linearisations; on the Jülich data a second repetition changes nothing.
LINEARISED = 1
#: Maximum number of repetitions of the regime search and the fit on the common regime.
TURNS = 4
#: Factor between the repeatability of residuals within a day and the residuals of a good model.
REPEATS = 3.0
#: Number of expectation-maximisation rounds over the population.
ROUNDS = 6

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Prepared:
    """Result of steps 1 and 2 for some heliostats."""

    static: FieldFit
    regime: npt.NDArray[np.int64]
    field: tuple[Linear, ...]
    rows: tuple[npt.NDArray[np.intp], ...]
    unusable: npt.NDArray[np.bool_]


def prepare(
    mechanism: Mechanism,
    sightings: Sightings,
    model: tuple[str, ...],
    names: tuple[str, ...],
    used: npt.NDArray[np.bool_],
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    loss: Loss = "cauchy",
) -> Prepared:
    """Fit each heliostat, divide its history into regimes, and linearise its sightings."""
    zeros = drift.zeros(mechanism)
    regime = np.where(used, 0, -1)
    offsets, order = _by_heliostat(sightings, used, len(mechanism))
    static = fit(mechanism, sightings, model, keep=used, priors=priors, loss=loss)
    unusable = used & find_unusable(mechanism, sightings, static)
    if unusable.any():
        used = used & ~unusable
        regime[unusable] = -1
        offsets, order = _by_heliostat(sightings, used, len(mechanism))
        static = fit(mechanism, sightings, model, keep=used, priors=priors, loss=loss)
    for turn in range(TURNS):
        moved = mechanism.with_parameters(static.parameters)
        # Regimes shift a pair of zeros, so a mechanism with one drive has no regimes.
        if len(zeros) != 2:
            break
        new = regime.copy()
        line = linearise(moved[sightings.heliostat], sightings, zeros)
        for i in range(len(mechanism)):
            part = order[offsets[i] : offsets[i + 1]]
            rest = line.residual[part]
            scale = max(min(float(static.scale[i]), repeatability(sightings.time[part], rest)), 0.3)
            new[part] = find_regimes(
                sightings.time[part], rest / scale, line.jacobian[part] / scale
            )
        settled, regime = np.array_equal(new, regime), new
        if turn == TURNS - 1 or settled:
            break
        static = fit(mechanism, sightings, model, keep=regime == 0, priors=priors, loss=loss)
    moved = mechanism.with_parameters(static.parameters)
    line = linearise(moved[sightings.heliostat], sightings, names)
    at = np.zeros((len(mechanism), len(names)))
    centre = np.zeros_like(at)
    at[:, : len(model)], centre[:, : len(model)] = static.values, static.centre
    # A start near nominal only helped the search, so the prior stays centred on nominal.
    centre[(np.abs(static.centre) < MISTAKE * static.prior).all(axis=1)] = 0.0
    field, rows = [], []
    for i in range(len(mechanism)):
        part = order[offsets[i] : offsets[i + 1]]
        jacobian = np.ascontiguousarray(line.jacobian[part])
        field.append(
            Linear(
                jacobian=jacobian,
                value=jacobian @ (at[i] - centre[i]) - line.residual[part],
                time=sightings.time[part] / DAY,
                regime=regime[part],
                centre=centre[i],
                own=centre[i] != 0.0,
                steps=np.empty(0),
                suspect=(regime[part] == 0) & (static.lengths[part] > SUSPECT),
            )
        )
        rows.append(part)
    prepared = Prepared(static, regime, tuple(field), tuple(rows), unusable)
    return _without_unusable(prepared, is_usable(line)[order])


def _without_unusable(prepared: Prepared, usable: npt.NDArray[np.bool_]) -> Prepared:
    """Leave out unusable sightings.

    ``usable`` is ordered heliostat by heliostat, as the prepared sightings are.
    """
    if usable.all():
        return prepared
    regime, unusable = prepared.regime.copy(), prepared.unusable.copy()
    removed = np.concatenate(prepared.rows)[~usable]
    regime[removed], unusable[removed] = -1, True
    cuts = np.cumsum([len(d) for d in prepared.field])[:-1]
    parts = np.split(usable, cuts)
    return Prepared(
        prepared.static,
        regime,
        tuple(d.take(good) for d, good in zip(prepared.field, parts, strict=True)),
        tuple(r[good] for r, good in zip(prepared.rows, parts, strict=True)),
        unusable,
    )


def relinearise(
    mechanism: Mechanism, sightings: Sightings, prepared: Prepared, members: Sequence[Posterior]
) -> Prepared:
    """Relinearise each sighting about its heliostat's posterior at that time.

    This is a Gauss-Newton step on the whole history. It is needed because the robust fit may lie
    far from the posterior that accounts for population, regimes and drift, and because a jack is
    not linear.
    """
    names = members[0].hyper.names
    rows = np.concatenate(prepared.rows)
    if not len(rows):
        return prepared
    values = np.concatenate(
        [m.at(d.time, d.regime)[0] for m, d in zip(members, prepared.field, strict=True)]
    )
    most = np.array([mechanism.most(name) for name in names])
    lost = (np.abs(values) > most).any(axis=1)
    values[lost] = 0.0
    observed = sightings.take(rows)
    line = linearise(moved_by(mechanism, observed.heliostat, names, values), observed, names)
    offsets = np.concatenate([[0], np.cumsum([len(d) for d in prepared.field])])
    field = []
    for k, d in enumerate(prepared.field):
        part = slice(int(offsets[k]), int(offsets[k + 1]))
        jacobian = np.ascontiguousarray(line.jacobian[part])
        value = np.einsum("nap,np->na", jacobian, values[part] - d.centre) - line.residual[part]
        field.append(replace(d, jacobian=jacobian, value=value))
    # Parameters that no mechanism can have were extrapolated from uninformative sightings.
    return _without_unusable(replace(prepared, field=tuple(field)), is_usable(line) & ~lost)


def repeatability(time: FloatArray, residual: FloatArray) -> float:
    """Return `REPEATS` times the repeatability of residuals within a day; inf if unknown.

    When regimes are mixed, the scale of all residuals is meaningless, but differences between
    consecutive sightings still show the noise.
    """
    order = np.argsort(time, kind="stable")
    order = order[np.isfinite(time[order])]
    near = np.diff(time[order]) < DAY
    if near.sum() < FEWEST:
        return float("inf")
    steps = np.linalg.norm(np.diff(residual[order], axis=0)[near], axis=1)
    # The length of the difference of two residuals is Rayleigh distributed with √2 σ, so its median
    # is 1.1774 √2 σ.
    return float(REPEATS * np.median(steps) / (1.1774 * np.sqrt(2.0)))


def _by_heliostat(
    s: Sightings, used: npt.NDArray[np.bool_], count: int
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Return where each heliostat's used sightings begin, (N + 1,), and their order."""
    order = canonical_order(s)
    order = order[used[order]]
    return np.searchsorted(s.heliostat[order], np.arange(count + 1)), order


def learn_field(
    hyper: Hyperparameters,
    mechanism: Mechanism,
    sightings: Sightings,
    prepared: Prepared,
    rounds: int = ROUNDS,
) -> Hyperparameters:
    """Return the hyperparameters of the field from prepared heliostats (step 3)."""
    table = np.where(hyper.spread > 0, hyper.spread, 0.0)
    teachers = [k for k, d in enumerate(prepared.field) if len(d) >= FEWEST]
    if not teachers:
        return hyper
    # Use the field's value, because a faulty heliostat has a large noise of its own.
    usual = max(float(np.nanmedian(prepared.static.scale[teachers])), hyper.noise)
    for _ in range(LINEARISED):
        known = [finish(replace(hyper, noise=usual), d, own=False)[0] for d in prepared.field]
        prepared = relinearise(mechanism, sightings, prepared, known)
    everything = [prepared.field[k] for k in teachers]
    clean = [_without_outliers(replace(hyper, noise=usual), d) for d in everything]
    for turn in range(rounds):
        if turn in (0, 2, rounds - 1):
            hyper, _ = drift.fit_hyperparameters(hyper, drift.typical(hyper, clean))
        if turn in (1, 3):
            clean = [_without_outliers(hyper, d) for d in everything]
        members = [drift.posterior(hyper, d) for d in clean]
        hyper = drift.fit_population(hyper, table, members)
    final = [finish(hyper, d)[0] for d in everything]
    removed = sum(len(d) for d in everything) - sum(len(m.data) for m in final)
    return replace(hyper, rate=drift.step_rate(final), heavy=drift.heavy_tails(final, removed))


def _without_outliers(hyper: Hyperparameters, data: Linear) -> Linear:
    return data.take(~drift.find_outliers(hyper, data))


def finish(
    hyper: Hyperparameters, data: Linear, own: bool = True
) -> tuple[Posterior, npt.NDArray[np.bool_]]:
    """Return one heliostat's posterior under the field's ``hyper``, and a mask of its outliers.

    If ``own`` is true, the heliostat's noise and drift may differ from those of the field.
    """
    if len(data) >= FEWEST and hyper.processes:
        outlier = drift.find_outliers(drift.permissive(hyper), data)
        data = replace(data, steps=drift.find_steps(hyper, data.take(~outlier)))
        if own:
            hyper = drift.refine(hyper, data.take(~drift.find_outliers(hyper, data)))
    outlier = drift.find_outliers(hyper, data)
    return drift.posterior(hyper, data.take(~outlier)), outlier


def learn(
    mechanism: Field,
    sightings: Sightings,
    model: str | tuple[str, ...],
    *,
    used: npt.ArrayLike | None = None,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    processes: tuple[drift.Process, ...] | None = None,
    hyper: Hyperparameters | None = None,
    loss: Loss = "cauchy",
    own: bool = True,
    rounds: int = ROUNDS,
    misfits: tuple[Misfit, ...] | None = None,
    runner: "Runner | None" = None,
    chunk: int = 100,
    progress: Progress | None = None,
) -> Learned:
    """Learn parameters, regimes, drift and noise of every heliostat.

    A heliostat that does not fit its sightings keeps its nominal parameters and does not influence
    the field; the result lists it in ``misfits`` with the reason.

    Parameters
    ----------
    mechanism
        Nominal mechanisms of the heliostats, (N,) or (); or ``plant[name]``, a group, or a plant of
        one kind of heliostat, whose nominal mechanisms are then used. The last three also supply
        names.
    sightings
        M sightings of these heliostats, in any order.
    model
        Name of a model in the parameter table, or names of parameters.
    used
        Mask of the sightings to learn from, (M,).
    priors
        Standard deviations that replace those of the table, by name.
    processes
        Drift processes; ``()`` for no drift. Default: `drift.default_processes`.
    hyper
        Hyperparameters of the field, if already known.
    loss
        Loss function of the robust fit.
    own
        Whether each heliostat's noise and drift may differ from those of the field.
    rounds
        Number of expectation-maximisation rounds over the population.
    misfits
        The heliostats to exclude, if already known; default: `find_misfits`.
    runner, chunk
        Runner that learns chunks of this many heliostats elsewhere, for example
        `heliotrope.calibration.learn.on_dask.runner`. The results are identical bit for bit.
    progress
        Called with the numbers of heliostats (done, total).

    Raises
    ------
    InputError
        As for `heliotrope.calibration.fit.fit`.
    """
    field = members(mechanism)
    nominal, sightings = field.mechanism, field.rows_of(sightings)
    constant = names_of(model, nominal)
    keep = mask_of(used, len(sightings), "used")
    if misfits is None:
        misfits = find_misfits(nominal, sightings, keep, field.around.targets)
    keep = keep & ~np.isin(sightings.heliostat, [misfit.row for misfit in misfits])
    task = Task(constant, dict(priors or {}), loss, own)
    with threadpool_limits(1, "blas"):
        if hyper is None:
            hyper = field_of(nominal, sightings, keep, task, processes, rounds)
    whole = np.arange(len(nominal))
    if runner is None:
        parts = [learn_part(nominal, sightings, keep, task, hyper, progress)]
        pieces = [whole]
    else:
        pieces = np.array_split(whole, max(1, -(-len(whole) // chunk)))
        cut = [_cut(nominal, sightings, keep, task, piece) for piece in pieces]
        parts = runner([(*c[:4], hyper) for c in cut], progress)
    return _join(field, sightings, keep, constant, hyper, misfits, pieces, parts)


@dataclass(frozen=True)
class Task:
    """Model and options of learning, common to all heliostats."""

    model: tuple[str, ...]
    priors: dict[str, npt.ArrayLike]
    loss: Loss = "cauchy"
    own: bool = True

    def of(self, rows: npt.NDArray[np.intp], count: int) -> "Task":
        """Return the task for some of the heliostats, with the priors for these heliostats."""
        cut = {
            n: as_float(v)[rows] if as_float(v).shape == (count,) else v
            for n, v in self.priors.items()
        }
        return replace(self, priors=cut)


@dataclass(frozen=True)
class Part:
    """Result for some heliostats; its indices count only the sightings of these heliostats."""

    prepared: Prepared
    members: tuple[Posterior, ...]
    outlier: npt.NDArray[np.bool_]


#: Function that learns a list of (mechanism, sightings, used, task, hyper), in this process or
#: elsewhere.
Runner = Callable[
    [
        list[tuple[Mechanism, Sightings, npt.NDArray[np.bool_], Task, Hyperparameters]],
        Progress | None,
    ],
    list[Part],
]


def learn_part(
    mechanism: Mechanism,
    sightings: Sightings,
    used: npt.NDArray[np.bool_],
    task: Task,
    hyper: Hyperparameters,
    progress: Progress | None = None,
) -> Part:
    """Learn some heliostats, given the field's ``hyper``: steps 1, 2 and 4."""
    with threadpool_limits(1, "blas"):
        prepared = prepare(
            mechanism, sightings, task.model, hyper.names, used, priors=task.priors, loss=task.loss
        )
        for _ in range(LINEARISED):
            known, _ = _finish_all(hyper, prepared, len(sightings), False, None)
            prepared = relinearise(mechanism, sightings, prepared, known)
        members, outlier = _finish_all(hyper, prepared, len(sightings), task.own, progress)
    return Part(prepared, members, outlier)


def _cut(
    mechanism: Mechanism,
    sightings: Sightings,
    used: npt.NDArray[np.bool_],
    task: Task,
    rows: npt.NDArray[np.intp],
) -> tuple[Mechanism, Sightings, npt.NDArray[np.bool_], Task, npt.NDArray[np.intp]]:
    """Select the heliostats ``rows`` of a field, with their sightings and options.

    Returns the mechanisms, the sightings with heliostat indices from 0, the mask of used sightings,
    the task, and the indices of the sightings in the field.
    """
    place = np.full(len(mechanism), -1)
    place[rows] = np.arange(len(rows))
    mine = np.flatnonzero(place[sightings.heliostat] >= 0)
    part = sightings.take(mine)
    part = part.renumbered(place[part.heliostat])
    return mechanism[rows], part, used[mine], task.of(rows, len(mechanism)), mine


def _join(
    field: Members,
    sightings: Sightings,
    used: npt.NDArray[np.bool_],
    model: tuple[str, ...],
    hyper: Hyperparameters,
    misfits: tuple[Misfit, ...],
    pieces: list[npt.NDArray[np.intp]],
    parts: list[Part],
) -> Learned:
    regime = np.full(len(sightings), -1)
    outlier = np.zeros(len(sightings), dtype=np.bool_)
    unusable = outlier.copy()
    lengths = np.full(len(sightings), np.nan)
    rows: list[npt.NDArray[np.intp]] = []
    for piece, part in zip(pieces, parts, strict=True):
        mine = np.flatnonzero(np.isin(sightings.heliostat, piece))
        regime[mine], outlier[mine] = part.prepared.regime, part.outlier
        unusable[mine] = part.prepared.unusable
        lengths[mine] = part.prepared.static.lengths
        rows += [mine[r] for r in part.prepared.rows]
    fits = [part.prepared.static for part in parts]
    names = field.names or sightings.names
    static = FieldFit(
        names=model,
        lengths=lengths,
        rows=sightings.heliostat,
        heliostats=names,
        **{name: np.concatenate([getattr(fit, name) for fit in fits]) for name in BY_HELIOSTAT},
    )
    members = tuple(m for part in parts for m in part.members)
    for i, member in enumerate(members):
        kept = rows[i][~outlier[rows[i]]]
        if len(kept) < FEWEST:
            continue
        white = np.linalg.norm(member.left_out()[1], axis=1)
        misfit = scattered(i, white, sightings.sigma[kept])
        misfits += () if misfit is None else (misfit,)
    for misfit in misfits:
        static.outcome[misfit.row] = misfit.outcome
    return Learned(
        field.mechanism,
        sightings,
        model,
        used,
        static,
        hyper,
        members,
        regime,
        outlier,
        unusable,
        tuple(rows),
        names,
        field.around,
        misfits,
    )


def field_of(
    mechanism: Mechanism,
    sightings: Sightings,
    used: npt.NDArray[np.bool_],
    task: Task,
    processes: tuple[drift.Process, ...] | None = None,
    rounds: int = ROUNDS,
) -> Hyperparameters:
    """Return the hyperparameters of a field, learnt from at most ``SAMPLE`` of its heliostats."""
    counts = np.bincount(sightings.heliostat[used], minlength=len(mechanism))
    able = np.flatnonzero(counts >= FEWEST)
    if len(able) > SAMPLE:
        able = able[np.linspace(0, len(able) - 1, SAMPLE).round().astype(np.intp)]
    first = drift.start(
        mechanism, task.model, processes, _prior_row(task.model, mechanism, task.priors)
    )
    machines, part, keep, mine, _ = _cut(mechanism, sightings, used, task, able)
    prepared = prepare(
        machines, part, task.model, first.names, keep, priors=mine.priors, loss=task.loss
    )
    return learn_field(first, machines, part, prepared, rounds)


def _prior_row(
    model: tuple[str, ...], mechanism: Mechanism, priors: Mapping[str, npt.ArrayLike] | None
) -> FloatArray:
    """Return one prior standard deviation per parameter: the median over the heliostats."""
    table = [as_float((priors or {}).get(n, mechanism.parameter(n).prior)) for n in model]
    return np.array([np.median(t) for t in table], dtype=np.float64)


def _finish_all(
    hyper: Hyperparameters, prepared: Prepared, rows: int, own: bool, progress: Progress | None
) -> tuple[tuple[Posterior, ...], npt.NDArray[np.bool_]]:
    outlier = np.zeros(rows, dtype=np.bool_)
    members = []
    with ThreadPoolExecutor(threads(), thread_name_prefix="heliotrope-learn") as pool:
        results = pool.map(lambda data: finish(hyper, data, own), prepared.field)
        for k, (member, mine) in enumerate(results):
            members.append(member)
            outlier[prepared.rows[k]] = mine
            if progress:
                progress(k + 1, len(prepared.field))
    return tuple(members), outlier
