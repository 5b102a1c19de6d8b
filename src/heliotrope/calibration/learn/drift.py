r"""Parameter drift learnt from a field: slow creep of the zeros, fast motion of the normal.

The parameters of a heliostat at time t are

$$ x_p(t) = μ_p + s_p + ρ_p[\text{regime}(t)] + \sum_c d_{pc}(t) $$

where μ is the mean of the field, s the deviation of the heliostat (variance τ², learnt from the
field), ρ an offset of the two drive zeros in each regime and after each step, and d
Ornstein-Uhlenbeck processes: the drive zeros creep over months (*slow*) and optionally over
*weeks*, and the mirror normal moves within *hours* (temperature, wind, direction of approach). The
model is linear in x and Gaussian, so everything follows in closed form (Rasmussen & Williams 2006,
Gaussian Processes for Machine Learning, (2.23)-(2.24), (5.8)-(5.12)).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from heliotrope.calibration.learn import _drift_kernels as kernels
from heliotrope.calibration.learn.outliers import ALPHA, critical, generalised_esd, left_out
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.optics.beam import CHI_SQUARE_90
from heliotrope.parallel import run_blocks

DAY = 86400.0
#: Names of the time scales of the processes.
GROUPS = ("slow", "weeks", "hours")
#: Starting values of the search, and the prior standard deviation of their logarithms.
START_DAYS = {"slow": 300.0, "weeks": 5.0, "hours": 0.1}
START_RAD = {"slow": 1e-3, "weeks": 1e-3, "hours": 2.5e-4}
START_NOISE = 0.5
STRAY = 0.7
#: Standard deviation of one heliostat's logarithms about those of the field; half as much for time
#: constants.
OWN_STRAY = 0.4
#: Minimum number of sightings needed to find outliers.
FEWEST = 4
#: Fraction of the heliostats from which the hyperparameters are learnt.
TYPICAL = 0.85
#: The prior from the table is widened by this factor if the fit needed a far start.
WIDE = 10.0
#: Standard deviation of a zero after a re-reference or repair, rad.
REGIME_RAD = 0.020
#: Standard deviation of a step, rad, such as a slipped jack or a displaced limit switch.
STEP_RAD = 0.001
#: Gain in log evidence that a step must bring, beyond the logarithm of the number of positions
#: tried, and the minimum number of sightings before and after the step.
STEP_GAIN, AFTER_STEP = 4.0, 3
#: Minimum time between two sightings with a step between them, days.
STEP_GAP = 1.0 / 24.0
#: Maximum number of steps per heliostat.
MOST_STEPS = 12


@dataclass(frozen=True)
class Process:
    """One Ornstein-Uhlenbeck process: its parameter and its time scale (one of `GROUPS`)."""

    parameter: str
    group: str


def zeros(mechanism: Mechanism) -> tuple[str, ...]:
    """Return the names of the drives' zeros."""
    joints = [mechanism.joints[k] for k in mechanism.driven]
    known = mechanism.parameters
    return tuple(
        f"{j}_initial_angle" if f"{j}_initial_angle" in known else f"{j}_bias" for j in joints
    )


def default_processes(mechanism: Mechanism) -> tuple[Process, ...]:
    """Return the usual processes of a kind of mechanism: creep of the zeros, motion of the normal.

    A process over weeks is possible too, but for the Jülich measurements it adds nothing to what
    the steps explain.
    """
    processes = [Process(name, "slow") for name in zeros(mechanism)]
    normal = [n for n in ("canting", "canting_secondary") if n in mechanism.parameters]
    return tuple(processes + [Process(name, "hours") for name in normal])


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of a field or, when refined, of one heliostat.

    Attributes
    ----------
    names
        Names of the P parameters, including those that only drift.
    processes
        C processes.
    mean, spread
        Population mean and standard deviation of the constant part, in the parameters'
        units, (P,).
    regime
        Standard deviation of the offset in a regime, (P,).
    step
        Standard deviation of a step of the zeros, (P,).
    wide
        Standard deviation of the constant part if its nominal value turned out to be wrong, (P,).
    amplitude
        Standard deviation of each process, (C,).
    tau
        Time constants of the time scales in use, days, (G,).
    noise
        Noise of a sighting, in units of its stated sigma.
    rate
        Steps per day.
    heavy
        Factor on the noise variance that puts 90 % of the sightings into their 90 % ellipse.
    """

    names: tuple[str, ...]
    processes: tuple[Process, ...]
    mean: FloatArray
    spread: FloatArray
    regime: FloatArray
    step: FloatArray
    wide: FloatArray
    amplitude: FloatArray
    tau: FloatArray
    noise: float
    rate: float = 0.0
    heavy: float = 1.0

    @property
    def groups(self) -> tuple[str, ...]:
        """The time scales in use, in the order of ``tau``."""
        return tuple(g for g in GROUPS if any(p.group == g for p in self.processes))

    @property
    def part(self) -> npt.NDArray[np.int64]:
        """Index of each process's parameter among the names, (C,)."""
        return np.array([self.names.index(p.parameter) for p in self.processes], dtype=np.int64)

    @property
    def group(self) -> npt.NDArray[np.int64]:
        """Index of each process's time constant in ``tau``, (C,)."""
        groups = self.groups
        return np.array([groups.index(p.group) for p in self.processes], dtype=np.int64)

    @property
    def vector(self) -> FloatArray:
        """Logarithms of noise, amplitudes and time constants: the variables of the optimisation."""
        return np.asarray(np.log(np.concatenate([[self.noise], self.amplitude, self.tau])))

    def with_vector(self, vector: FloatArray) -> "Hyperparameters":
        """Return a copy with noise, amplitudes and time constants set from a log vector."""
        values = np.exp(vector)
        c = len(self.processes)
        return replace(
            self, noise=float(values[0]), amplitude=values[1 : 1 + c], tau=values[1 + c :]
        )


def start(
    mechanism: Mechanism,
    model: tuple[str, ...],
    processes: tuple[Process, ...] | None = None,
    priors: FloatArray | None = None,
) -> Hyperparameters:
    """Return the hyperparameters before any measurement.

    Parameters
    ----------
    mechanism
        One or more mechanisms of the field.
    model
        Constant parameters to be estimated.
    processes
        Drift processes; ``()`` for none. Default: `default_processes`.
    priors
        Standard deviations of the model's parameters. Default: those in the parameter table.
    """
    moving = default_processes(mechanism) if processes is None else processes
    extra = [p.parameter for p in moving] + list(zeros(mechanism))
    names = tuple(dict.fromkeys([*model, *extra]))
    table = [mechanism.parameter(n).prior for n in model] if priors is None else priors
    spread, regime, step = np.zeros(len(names)), np.zeros(len(names)), np.zeros(len(names))
    spread[: len(model)] = table
    for name in zeros(mechanism):
        regime[names.index(name)] = REGIME_RAD
        step[names.index(name)] = STEP_RAD
    groups = tuple(g for g in GROUPS if any(p.group == g for p in moving))
    return Hyperparameters(
        names=names,
        processes=moving,
        mean=np.zeros(len(names)),
        spread=spread,
        regime=regime,
        step=step,
        wide=WIDE * spread,
        amplitude=np.array([START_RAD[p.group] for p in moving]),
        tau=np.array([START_DAYS[g] for g in groups]),
        noise=START_NOISE,
    )


@dataclass(frozen=True)
class Linear:
    """Sightings of one heliostat, linear in its parameters: y = J x(t) + noise.

    Attributes
    ----------
    jacobian
        Whitened derivatives J, (n, 2, P).
    value
        Values y, to be explained by the parameters' deviations from ``centre``, (n, 2).
    time
        Time in days, (n,).
    regime
        (n,).
    centre
        Centre of the prior, (P,).
    own
        Whether the centre is a start far from nominal, to which no population mean applies, (P,).
    steps
        Times at which the zeros stepped, days, ascending, (K,).
    suspect
        Whether a sighting is far from the robust fit, and is therefore used only if the other
        sightings agree with it, (n,).
    """

    jacobian: FloatArray
    value: FloatArray
    time: FloatArray
    regime: npt.NDArray[np.int64]
    centre: FloatArray
    own: npt.NDArray[np.bool_]
    steps: FloatArray
    suspect: npt.NDArray[np.bool_]

    @property
    def epoch(self) -> npt.NDArray[np.int64]:
        """Number of steps before each sighting, (n,)."""
        return self.epoch_at(self.time)

    def epoch_at(self, time: FloatArray) -> npt.NDArray[np.int64]:
        """Return the number of steps before times (m,) in days; 0 where a time is NaN."""
        number = np.searchsorted(self.steps, time, side="right")
        return np.asarray(np.where(np.isfinite(time), number, 0), dtype=np.int64)

    def __len__(self) -> int:
        return len(self.time)

    def gap(self, time: FloatArray) -> FloatArray:
        """Return the days from times (m,) to the nearest sighting; 0 for unknown times."""
        known = self.time[np.isfinite(self.time)]
        if not len(known):
            return np.zeros(len(time))
        return np.asarray(np.nan_to_num(np.abs(time[:, None] - known).min(axis=1), nan=0.0))

    def take(self, rows: npt.ArrayLike) -> "Linear":
        """Return the sightings at given indices."""
        index = np.asarray(rows)
        return replace(
            self,
            jacobian=self.jacobian[index],
            value=self.value[index],
            time=self.time[index],
            regime=self.regime[index],
            suspect=self.suspect[index],
        )

    def mean(self, hyper: Hyperparameters) -> FloatArray:
        """Population mean that applies to this heliostat, (P,)."""
        return np.where(self.own, 0.0, hyper.mean)

    def spread(self, hyper: Hyperparameters) -> FloatArray:
        """Standard deviation of the constants that applies to this heliostat, (P,)."""
        return np.where(self.own, hyper.wide, hyper.spread)

    def rest(self, hyper: Hyperparameters) -> FloatArray:
        """Value minus the part that the population mean explains, (n, 2)."""
        return np.ascontiguousarray(self.value - self.jacobian @ self.mean(hyper))


def _gram(hyper: Hyperparameters, a: Linear, b: Linear | None = None) -> FloatArray:
    other = a if b is None else b
    tau = hyper.tau[hyper.group]
    gram: FloatArray = kernels.gram(
        a.jacobian,
        a.time,
        a.regime,
        a.epoch,
        other.jacobian,
        other.time,
        other.regime,
        other.epoch,
        b is None,
        a.spread(hyper) ** 2,
        hyper.regime**2,
        hyper.step**2,
        hyper.part,
        hyper.amplitude,
        tau,
    )
    return gram


def covariance(hyper: Hyperparameters, data: Linear) -> FloatArray:
    """Return the covariance of the values, including noise, (2 n, 2 n)."""
    return _gram(hyper, data) + hyper.noise**2 * np.eye(2 * len(data))


def fit_hyperparameters(
    hyper: Hyperparameters, field: Sequence[Linear], iterations: int = 25
) -> tuple[Hyperparameters, float]:
    """Return the most probable noise, amplitudes and time constants, and the negative log evidence.

    A weak prior, with standard deviation ``STRAY`` about the logarithms of the starting values,
    holds the values that the data do not determine.

    Parameters
    ----------
    hyper
        Starting values of the search.
    field
        Heliostats to learn from.
    iterations
        Maximum number of L-BFGS iterations.
    """
    centre = start_vector(hyper)
    return _search(hyper, field, centre, np.full(len(centre), STRAY), iterations)


def typical(
    hyper: Hyperparameters, field: Sequence[Linear], share: float = TYPICAL
) -> list[Linear]:
    """Return the fraction ``share`` of the heliostats that ``hyper`` explains best per sighting.

    Leaving out the worst heliostats prevents one faulty heliostat from increasing the drift of the
    whole field.
    """
    rows = [d for d in field if len(d)]
    if len(rows) < 4:
        return rows
    losses = [-posterior(hyper, d).log_evidence() / len(d) for d in rows]
    best = np.argsort(losses, kind="stable")[: int(np.ceil(share * len(rows)))]
    return [rows[k] for k in sorted(best)]


def start_vector(hyper: Hyperparameters) -> FloatArray:
    """Return the centre of the weak prior: the start values of a search."""
    amplitudes = [START_RAD[p.group] for p in hyper.processes]
    times = [START_DAYS[g] for g in hyper.groups]
    return np.asarray(np.log(np.array([START_NOISE, *amplitudes, *times])))


def refine(hyper: Hyperparameters, data: Linear, iterations: int = 30) -> Hyperparameters:
    """Return one heliostat's own hyperparameters.

    They stay close to the field's unless the heliostat's data differ.
    """
    spread = np.full(len(hyper.vector), OWN_STRAY)
    spread[1 + len(hyper.processes) :] = 0.5 * OWN_STRAY
    return _search(hyper, [data], hyper.vector, spread, iterations)[0]


def _search(
    hyper: Hyperparameters,
    field: Sequence[Linear],
    centre: FloatArray,
    spread: FloatArray,
    iterations: int,
) -> tuple[Hyperparameters, float]:
    rows = [d for d in field if len(d)]
    if not rows:
        return hyper, 0.0
    offsets = np.concatenate([[0], np.cumsum([len(d) for d in rows])])
    jacobian = np.concatenate([d.jacobian for d in rows])
    time = np.concatenate([d.time for d in rows])
    label = np.concatenate([d.regime for d in rows])
    epoch = np.concatenate([d.epoch for d in rows])
    rest = np.concatenate([d.rest(hyper) for d in rows])
    static = np.stack([d.spread(hyper) ** 2 for d in rows])
    regime, part, group = hyper.regime**2, hyper.part, hyper.group
    costs, gradients = np.empty(len(rows)), np.empty((len(rows), len(centre)))

    def cost(vector: FloatArray) -> tuple[float, FloatArray]:
        h = hyper.with_vector(vector)
        run_blocks(
            lambda a, b: kernels.pooled_block(
                jacobian,
                time,
                label,
                epoch,
                rest,
                offsets,
                static,
                regime,
                hyper.step**2,
                part,
                group,
                h.amplitude,
                h.tau,
                h.noise,
                costs,
                gradients,
                a,
                b,
            ),
            len(rows),
            minimum_rows=2,
        )
        stray = (vector - centre) / spread
        total = float(costs.sum() + 0.5 * stray @ stray)
        slope = gradients.sum(axis=0) + stray / spread
        return total, slope

    bounds = [(c - 4.0 * s, c + 4.0 * s) for c, s in zip(centre, spread, strict=True)]
    begin = np.clip(hyper.vector, centre - 4.0 * spread, centre + 4.0 * spread)
    solution = minimize(
        cost, begin, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations}
    )
    return hyper.with_vector(solution.x), float(solution.fun)


def _no_less_than_nothing(covariances: FloatArray, before: FloatArray) -> FloatArray:
    """Remove negative eigenvalues caused by rounding from covariances (m, P, P).

    Where the data determine a direction almost exactly, its variance is the difference of nearly
    equal numbers. In units of the prior standard deviations (variances ``before``, (m, P)), no
    direction is assumed to be known better than to 1e-6.
    """
    scale = np.sqrt(before)
    both = scale[:, :, None] * scale[:, None, :]
    ratio = np.divide(covariances, both, out=np.zeros_like(covariances), where=both > 0)
    values, vectors = np.linalg.eigh(0.5 * (ratio + np.swapaxes(ratio, -1, -2)))
    better = (vectors * np.maximum(values, 1e-12)[:, None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(both * better)


@dataclass(frozen=True)
class Posterior:
    """Posterior of one heliostat's parameters at any time, given its sightings.

    Created by `posterior`; ``inverse`` is the inverse covariance of the values of ``data``, and
    ``alpha`` is its product with these values.
    """

    hyper: Hyperparameters
    data: Linear
    inverse: FloatArray
    alpha: FloatArray

    def at(
        self, time: FloatArray, regime: npt.NDArray[np.int64], wander: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Return parameters (m, P) and their covariance (m, P, P).

        Parameters
        ----------
        time
            Time in days, (m,); NaN if unknown.
        regime
            (m,).
        wander
            Whether to include the drift processes; otherwise only the constant part and the regime
            offset are included.
        """
        h, data = self.hyper, self.data
        m, size = len(time), len(h.names)
        base = data.centre + data.mean(h)
        constant = data.spread(h) ** 2
        own = np.where(regime[:, None] != 0, h.regime**2, 0.0) + constant
        share = np.broadcast_to(constant, (m, len(data), size)).copy()
        epoch = data.epoch_at(time)
        if wander:
            # Long before or after all sightings, steps may have occurred that no sighting shows.
            own = own + (h.rate * data.gap(time))[:, None] * h.step**2
        own = own + epoch[:, None] * h.step**2
        share += np.minimum(epoch[:, None], data.epoch)[:, :, None] * h.step**2
        same = (regime[:, None] == data.regime) & (regime[:, None] != 0)
        share += same[:, :, None] * h.regime**2
        if wander:
            apart = np.abs(time[:, None] - data.time)
            for c, p in enumerate(h.part):
                decay = np.exp(-apart / h.tau[h.group[c]])
                share[:, :, p] += h.amplitude[c] ** 2 * np.nan_to_num(decay, nan=0.0)
                own[:, p] += h.amplitude[c] ** 2
        # Covariance of each parameter with each component of each sighting, (m, P, 2 n).
        cross = np.einsum("mnp,nap->mpna", share, data.jacobian).reshape(m, size, 2 * len(data))
        values = base + cross @ self.alpha
        covariances = -(cross @ self.inverse) @ np.swapaxes(cross, -1, -2)
        diagonal = np.arange(size)
        covariances[:, diagonal, diagonal] += own
        return values, _no_less_than_nothing(covariances, own)

    def left_out(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predict each sighting from the other sightings of the heliostat.

        Returns z² (n,), the errors (n, 2) and their covariances (n, 2, 2).
        """
        return left_out(self.inverse, self.alpha)

    def log_predictive(self) -> FloatArray:
        """Return the log probability density of each sighting, given the other sightings, (n,)."""
        square, _, spread = self.left_out()
        half_log = 0.5 * np.log(np.linalg.det(spread)) if len(square) else np.empty(0)
        return np.asarray(-0.5 * square - half_log - np.log(2.0 * np.pi))

    def log_evidence(self) -> float:
        """Return the log probability density of all sightings."""
        value = self.data.rest(self.hyper).ravel()
        _, log_inverse = np.linalg.slogdet(self.inverse)
        fit = float(value @ self.alpha)
        return float(-0.5 * fit + 0.5 * log_inverse - 0.5 * len(value) * np.log(2.0 * np.pi))


def find_outliers(
    hyper: Hyperparameters, data: Linear, alpha: float = ALPHA
) -> npt.NDArray[np.bool_]:
    """Return a mask of outliers: suspects that the other sightings contradict, then ESD outliers.

    The generalised ESD test alone would start from a fit that bad sightings have distorted. If a
    third of the sightings were bad, it would remove good ones.
    """
    mask = np.zeros(len(data), dtype=np.bool_)
    if len(data) < FEWEST:
        return mask
    if data.suspect.any() and (~data.suspect).sum() >= FEWEST:
        others = posterior(hyper, data.take(~data.suspect))
        asked = data.take(data.suspect)
        values, spread = others.at(asked.time, asked.regime)
        gap = asked.value - np.einsum("nap,np->na", asked.jacobian, values - data.centre)
        cov = asked.jacobian @ spread @ np.swapaxes(asked.jacobian, -1, -2)
        cov += hyper.noise**2 * np.eye(2)
        square = np.einsum("na,nab,nb->n", gap, np.linalg.inv(cov), gap)
        mask[data.suspect] = square > critical(len(data), alpha)
    rest = np.flatnonzero(~mask)
    part = data.take(rest)
    mask[rest] = generalised_esd(part.rest(hyper), covariance(hyper, part), alpha=alpha)
    return mask


def posterior(hyper: Hyperparameters, data: Linear) -> Posterior:
    """Return the posterior of ``data`` under ``hyper``."""
    if not len(data):
        return Posterior(hyper, data, np.zeros((0, 0)), np.zeros(0))
    inverse = np.linalg.inv(covariance(hyper, data))
    inverse = 0.5 * (inverse + inverse.T)
    return Posterior(hyper, data, inverse, inverse @ data.rest(hyper).ravel())


def permissive(hyper: Hyperparameters) -> Hyperparameters:
    """Return ``hyper`` changed so that the zeros may move by as much as a step within days.

    A sighting that is an outlier even then is not evidence of a step.
    """
    moving = [n for n, size in zip(hyper.names, hyper.step, strict=True) if size > 0]
    if not moving or "weeks" in hyper.groups:
        return hyper
    more = tuple(Process(name, "weeks") for name in moving)
    tau = dict(zip(hyper.groups, hyper.tau, strict=True))
    tau["weeks"] = START_DAYS["weeks"]
    sizes = [hyper.step[hyper.names.index(name)] for name in moving]
    return replace(
        hyper,
        processes=hyper.processes + more,
        amplitude=np.concatenate([hyper.amplitude, sizes]),
        tau=np.array([tau[g] for g in GROUPS if g in tau]),
    )


def find_steps(hyper: Hyperparameters, data: Linear) -> FloatArray:
    """Return the times (days) of steps of the zeros that the evidence supports.

    The best time of one step is found in closed form, then that of the next step given the first,
    and so on as long as the log evidence increases enough.
    """
    moving = np.flatnonzero(hyper.step > 0)
    order = np.argsort(data.time, kind="stable")
    order = order[np.isfinite(data.time[order])]
    n = len(order)
    steps = np.empty(0)
    if n < 2 * AFTER_STEP or not len(moving):
        return steps
    sorted_data = replace(data.take(order), steps=steps)
    places = np.arange(AFTER_STEP, n - AFTER_STEP + 1)
    places = places[sorted_data.time[places] - sorted_data.time[places - 1] > STEP_GAP]
    limit = STEP_GAIN + np.log(max(len(places), 1))
    for _ in range(MOST_STEPS):
        now = posterior(hyper, replace(sorted_data, steps=steps))
        slope = np.ascontiguousarray(sorted_data.jacobian[:, :, moving])
        gains = kernels.step_gains(now.inverse, now.alpha, slope, hyper.step[moving] ** 2)
        if not len(places) or gains[places].max() < limit:
            break
        k = int(places[np.argmax(gains[places])])
        steps = np.sort(np.append(steps, 0.5 * (sorted_data.time[k - 1] + sorted_data.time[k])))
        places = places[places != k]
    return steps


def step_rate(members: Sequence["Posterior"]) -> float:
    """Return the steps per day over the time that the members' sightings span.

    The prior is one step in 1000 days.
    """
    days, steps = 1000.0, 1.0
    for member in members:
        known = member.data.time[np.isfinite(member.data.time)]
        if len(known) >= 2 * AFTER_STEP:
            days += float(np.ptp(known))
            steps += len(member.data.steps)
    return steps / days


#: The table's priors count as this many heliostats in the population.
TABLE_WORTH = 2.0
#: Degrees of freedom of the population's t distribution, so that one wrongly installed heliostat
#: does not widen it.
POPULATION_FREEDOM = 4.0
#: Minimum number of heliostats from which a group is learnt; fewer heliostats say less than the
#: priors in the table.
TEACHERS = 4


def fit_population(
    hyper: Hyperparameters, table: FloatArray, members: Sequence[Posterior]
) -> Hyperparameters:
    """Return ``hyper`` with a new mean and spread of the population (one EM step).

    With fewer than `TEACHERS` heliostats the mean is kept, because one heliostat says little about
    the others.

    Parameters
    ----------
    hyper
        Hyperparameters with which the members were computed.
    table
        Standard deviations from the parameter table, (P,); 0 for a parameter that only drifts.
    members
        Heliostats.
    """
    size = len(hyper.names)
    still = np.flatnonzero(table > 0)
    values, variances, used = [], [], []
    for member in members:
        x, c = member.at(np.array([np.nan]), np.zeros(1, dtype=np.int64), wander=False)
        values.append((x[0] - member.data.centre)[still])
        variances.append(np.diagonal(c[0])[still])
        used.append(~member.data.own[still])
    if len(values) < TEACHERS:
        return hyper
    x, c, ok = np.array(values), np.maximum(np.array(variances), 0.0), np.array(used)
    mean, spread = hyper.mean[still].copy(), np.maximum(hyper.spread[still], 1e-3 * table[still])
    prior = table[still]
    for _ in range(30):
        square = ((x - mean) ** 2 + c) / spread**2
        weight = ok * (POPULATION_FREEDOM + 1.0) / (POPULATION_FREEDOM + square)
        precision = (weight / spread**2).sum(axis=0)
        mean = (weight * x / spread**2).sum(axis=0) / (precision + 1.0 / prior**2)
        scatter = (weight * ((x - mean) ** 2 + c)).sum(axis=0)
        spread = np.sqrt((TABLE_WORTH * prior**2 + scatter) / (TABLE_WORTH + ok.sum(axis=0)))
        spread = np.maximum(spread, 0.05 * prior)
    all_mean, all_spread = np.zeros(size), np.zeros(size)
    all_mean[still], all_spread[still] = mean, spread
    return replace(hyper, mean=all_mean, spread=all_spread)


def heavy_tails(members: Sequence[Posterior], outliers: int) -> float:
    """Return the factor (at least 1) on the noise variance that makes the ellipses cover 90 %.

    Each sighting is predicted from the others to judge the coverage. In addition, ``outliers``
    sightings count as outside their ellipses.
    """
    parts = [m.left_out() for m in members if len(m.data) > 3]
    if not parts:
        return 1.0
    error = np.concatenate([p[1] for p in parts])
    spread = np.concatenate([p[2] for p in parts])
    noise = np.concatenate(
        [np.full(len(m.data), m.hyper.noise**2) for m in members if len(m.data) > 3]
    )

    def inside(factor: float) -> float:
        wider = spread + ((factor - 1.0) * noise)[:, None, None] * np.eye(2)
        square = np.einsum("na,nab,nb->n", error, np.linalg.inv(wider), error)
        return float((square <= CHI_SQUARE_90).sum()) / (len(square) + outliers)

    low, high = 1.0, 25.0
    if inside(low) >= 0.9:
        return low
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if inside(middle) < 0.9 else (low, middle)
    return high
