r"""The streaming learner: the belief about one heliostat, updated with each new sighting.

The model is that of `drift`, written as a state instead of a covariance between sightings: the
constants, the offsets of the zeros in the present regime, and the Ornstein-Uhlenbeck processes,

$$ d(t + Δ) = e^{-Δ/τ} d(t) + w, \qquad \langle w^2 \rangle = a^2 (1 - e^{-2Δ/τ}). $$

A sighting is linear in the state, so the belief remains Gaussian (Kalman 1960), and equals the
batch posterior for the same derivatives and events. It is unknown what happened since the previous
sighting: perhaps nothing, or a step of the zeros, or the start or the end of a regime, or the
sighting itself is faulty. Each possibility is a hypothesis. Its weight is multiplied by the
probability density of each sighting, so that later sightings decide between the hypotheses (a
Gaussian sum filter: Alspach & Sorenson 1972, IEEE Transactions on Automatic Control 17). All
inputs, including the time, are arguments, and every function returns a new belief.
"""

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import _stream_kernels as kernels
from heliotrope.calibration.learn.drift import STEP_GAP, Hyperparameters
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism

#: New regimes per day (after a lost reference or a repair), and returns from a regime per day. The
#: Jülich training data contain two new regimes in 18,000 heliostat days, and 24 faulty sightings
#: among 925.
LOST, FOUND = 1.0 / 10_000.0, 1.0 / 200.0
#: Fraction of sightings that do not show the heliostat's beam.
MISTAKES = 0.025
#: Standard deviation of a faulty sighting, in units of its stated sigma (50 mrad for 0.5 mrad).
FAR = 100.0
#: The lightest hypotheses, with less than this total weight, do not widen a 90 % ellipse.
IGNORED = 0.05


class Event(IntEnum):
    """What happened between two sightings; `UNKNOWN` allows for every possibility."""

    UNKNOWN = kernels.UNKNOWN
    NOTHING = kernels.NOTHING
    STEP = kernels.STEP
    REGIME = kernels.REGIME
    RETURN = kernels.RETURN


@dataclass(frozen=True)
class Layout:
    """Indices into the state, and the hyperparameters that `kernels.update` needs.

    Attributes
    ----------
    view
        Matrix from the state to the parameters, (P, S).
    zeros, offsets
        Indices of the constants of the drive zeros, and of their offsets in a regime, (Z,).
    first
        Index of the first process.
    step, lost
        Variances of a step and of the offset in a regime, (Z,).
    tau
        Time constant of each process, days, (C,).
    """

    view: FloatArray
    zeros: npt.NDArray[np.int64]
    offsets: npt.NDArray[np.int64]
    first: int
    step: FloatArray
    lost: FloatArray
    tau: FloatArray


def layout_of(hyper: Hyperparameters) -> Layout:
    """Return the layout of the state for given hyperparameters."""
    zeros = np.flatnonzero(hyper.step > 0).astype(np.int64)
    size, first = len(hyper.names), len(hyper.names) + len(zeros)
    offsets = size + np.arange(len(zeros), dtype=np.int64)
    view = np.zeros((size, first + len(hyper.processes)))
    view[:, :size] = np.eye(size)
    view[zeros, offsets] = 1.0
    view[hyper.part, first + np.arange(len(hyper.processes))] = 1.0
    step, lost = hyper.step[zeros] ** 2, hyper.regime[zeros] ** 2
    return Layout(view, zeros, offsets, first, step, lost, hyper.tau[hyper.group])


@dataclass(frozen=True)
class Belief:
    """The belief about one heliostat after its sightings so far.

    Attributes
    ----------
    hyper
        Hyperparameters of the heliostat, with P names.
    layout
        Transition model derived from the hyperparameters.
    centre
        Centre of the priors, (P,).
    weight
        Weights of the K hypotheses, the heaviest first, (K,).
    mean, covariance
        Mean and covariance of the state under each hypothesis, (K, S) and (K, S, S). The state
        consists of constants minus ``centre``, offsets, and processes.
    regime
        Whether the zeros are shifted under each hypothesis, (K,).
    time
        Time of the latest sighting, days; NaN before the first.
    count
        Number of sightings.
    mistaken
        Probability that the latest sighting was faulty.
    density
        Log probability density of all sightings.
    """

    hyper: Hyperparameters
    layout: Layout
    centre: FloatArray
    weight: FloatArray
    mean: FloatArray
    covariance: FloatArray
    regime: npt.NDArray[np.bool_]
    time: float = np.nan
    count: int = 0
    mistaken: float = 0.0
    density: float = 0.0

    def document(self) -> dict[str, Any]:
        """Return the state as a JSON object, without the hyperparameters of the field."""
        return {
            "centre": self.centre.tolist(),
            "weight": self.weight.tolist(),
            "mean": self.mean.tolist(),
            "covariance": self.covariance.tolist(),
            "regime": self.regime.tolist(),
            "time_days": None if math.isnan(self.time) else self.time,
            "count": self.count,
            "mistaken": self.mistaken,
            "density": self.density,
        }

    def at(self, time: float) -> tuple[FloatArray, FloatArray]:
        """Return parameters (P,) and their covariance (P, P) at a time in days, not in the past.

        The hypotheses are averaged by weight; the lightest are ignored as long as their weights sum
        to less than `IGNORED`. NaN means an unknown time.
        """
        h, state, gap = self.hyper, self.layout, self.days_since(time)
        many = int(np.searchsorted(np.cumsum(self.weight), 1.0 - IGNORED)) + 1
        weight = self.weight[:many] / self.weight[:many].sum()
        mean, covariance = kernels.moments(
            weight,
            self.mean[:many],
            self.covariance[:many],
            state.first,
            h.amplitude,
            state.tau,
            gap,
        )
        spread = state.view @ covariance @ state.view.T
        if math.isfinite(gap):
            places = np.arange(len(h.names))
            spread[places, places] += h.rate * gap * h.step**2
        return self.centre + state.view @ mean, spread

    def days_since(self, time: float) -> float:
        """Return the days since the latest sighting; infinity if the time is unknown."""
        if not math.isfinite(time):
            return math.inf
        return 0.0 if math.isnan(self.time) else max(time - self.time, 0.0)


def read_belief(hyper: Hyperparameters, document: dict[str, Any]) -> Belief:
    """Return the belief from a document created by `Belief.document`."""
    time = document["time_days"]
    return Belief(
        hyper=hyper,
        layout=layout_of(hyper),
        centre=np.array(document["centre"]),
        weight=np.array(document["weight"]),
        mean=np.array(document["mean"]),
        covariance=np.array(document["covariance"]),
        regime=np.array(document["regime"], dtype=np.bool_),
        time=np.nan if time is None else float(time),
        count=int(document["count"]),
        mistaken=float(document["mistaken"]),
        density=float(document["density"]),
    )


def begin(
    hyper: Hyperparameters,
    centre: FloatArray | None = None,
    own: npt.NDArray[np.bool_] | None = None,
) -> Belief:
    """Return the belief before the first sighting.

    Parameters
    ----------
    hyper
        Hyperparameters of the field or the heliostat.
    centre, own
        Centre of the priors, and which parameters start far from nominal, without a population
        mean, (P,); default: the nominal mechanism.
    """
    size = len(hyper.names)
    middle = np.zeros(size) if centre is None else np.asarray(centre, dtype=np.float64)
    far = np.zeros(size, dtype=np.bool_) if own is None else np.asarray(own, dtype=np.bool_)
    state = layout_of(hyper)
    mean = np.zeros(state.view.shape[1])
    mean[:size] = np.where(far, 0.0, hyper.mean)
    variance = np.zeros(len(mean))
    variance[:size] = np.where(far, hyper.wide, hyper.spread) ** 2
    variance[state.first :] = hyper.amplitude**2
    return Belief(
        hyper=hyper,
        layout=state,
        centre=middle,
        weight=np.ones(1),
        mean=mean[None],
        covariance=np.diag(variance)[None],
        regime=np.zeros(1, dtype=np.bool_),
    )


def with_constants(belief: Belief, names: tuple[str, ...], spread: FloatArray) -> Belief:
    """Return the belief with more constants, of mean 0 and standard deviations ``spread`` (K,).

    Such constants may be errors that some sightings share, for example those of one flight.
    `without_constants` removes them after these sightings.
    """
    h, place = belief.hyper, len(belief.hyper.names)
    nothing, more = np.zeros(len(names)), np.asarray(spread, dtype=np.float64)
    hyper = replace(
        h,
        names=h.names + names,
        mean=np.concatenate([h.mean, nothing]),
        spread=np.concatenate([h.spread, more]),
        regime=np.concatenate([h.regime, nothing]),
        step=np.concatenate([h.step, nothing]),
        wide=np.concatenate([h.wide, more]),
    )
    old = np.delete(np.arange(belief.mean.shape[1] + len(names)), place + np.arange(len(names)))
    new = place + np.arange(len(names))
    mean = np.zeros((len(belief.mean), len(old) + len(new)))
    mean[:, old] = belief.mean
    covariance = np.zeros((*mean.shape, mean.shape[1]))
    covariance[:, old[:, None], old] = belief.covariance
    covariance[:, new, new] = more**2
    centre = np.concatenate([belief.centre, nothing])
    return replace(
        belief,
        hyper=hyper,
        layout=layout_of(hyper),
        centre=centre,
        mean=mean,
        covariance=covariance,
    )


def without_constants(belief: Belief, names: tuple[str, ...]) -> Belief:
    """Return the belief without some of its constants, averaged over their possible values."""
    h = belief.hyper
    removed = np.array([h.names.index(name) for name in names], dtype=np.intp)
    kept = np.delete(np.arange(belief.mean.shape[1]), removed)
    hyper = replace(
        h,
        names=tuple(np.delete(np.array(h.names, dtype=object), removed)),
        mean=np.delete(h.mean, removed),
        spread=np.delete(h.spread, removed),
        regime=np.delete(h.regime, removed),
        step=np.delete(h.step, removed),
        wide=np.delete(h.wide, removed),
    )
    return replace(
        belief,
        hyper=hyper,
        layout=layout_of(hyper),
        centre=np.delete(belief.centre, removed),
        mean=np.ascontiguousarray(belief.mean[:, kept]),
        covariance=np.ascontiguousarray(belief.covariance[:, kept[:, None], kept]),
    )


def update(
    belief: Belief,
    jacobian: FloatArray,
    value: FloatArray,
    time: float,
    event: Event = Event.UNKNOWN,
) -> Belief:
    """Return the belief after one more sighting, linear in the parameters as in `drift.Linear`.

    Parameters
    ----------
    belief
        Belief before the sighting.
    jacobian
        Whitened derivatives, (2, P).
    value
        Residual to be explained by the deviations of the parameters from the centre, (2,).
    time
        Time in days, not before the previous sighting. NaN if unknown; the sighting then shares no
        drift with other sightings.
    event
        Event known to have happened before the sighting, for example from a maintenance log.
    """
    h, state = belief.hyper, belief.layout
    rows, noise = jacobian @ state.view, h.noise**2 * np.eye(2)
    days = belief.days_since(time)
    if not math.isfinite(days):
        drift = rows[:, state.first :] * h.amplitude
        noise += drift @ drift.T
        rows[:, state.first :] = 0.0
        days = 0.0
    updated = kernels.update(
        belief.weight, belief.mean, belief.covariance, belief.regime, rows, value, noise, days,
        int(event), state.zeros, state.offsets, state.first, state.step, state.lost,
        h.amplitude, state.tau, _chances(h.rate, days), FAR**2,
    )  # fmt: skip
    weight, mean, covariance, regime, density, mistaken = updated
    return replace(
        belief,
        weight=weight,
        mean=mean,
        covariance=covariance,
        regime=regime,
        time=time if math.isfinite(time) else belief.time,
        count=belief.count + 1,
        mistaken=float(mistaken),
        density=belief.density + float(density),
    )


def _chances(rate: float, days: float) -> FloatArray:
    """Return the prior probabilities of the events before a sighting, and of a faulty one, (5,)."""
    chance = np.zeros(5)
    chance[kernels.BLUNDER] = MISTAKES
    if days > STEP_GAP:
        chance[kernels.STEP] = -math.expm1(-rate * days)
        chance[kernels.REGIME] = -math.expm1(-LOST * days)
        chance[kernels.RETURN] = -math.expm1(-FOUND * days)
    chance[kernels.NOTHING] = max(1.0 - chance.sum(), 0.01)
    return chance


def observe(
    belief: Belief, mechanism: Mechanism, sighting: Sightings, event: Event = Event.UNKNOWN
) -> Belief:
    """Return the belief after one sighting, linearised about the belief at its time.

    Parameters
    ----------
    belief
        Belief before the sighting.
    mechanism
        Nominal mechanism of the heliostat, (1,).
    sighting
        One sighting, with heliostat index 0. A sighting beyond the reach of the drives changes
        nothing.
    event
        As for `update`.
    """
    names = belief.hyper.names
    time = float(sighting.time[0]) / 86400.0
    values, _ = belief.at(time)
    moved = mechanism.with_parameters({n: values[p : p + 1] for p, n in enumerate(names)})
    line = linearise(moved, sighting, names)
    if not is_usable(line)[0]:
        return belief
    value = line.jacobian[0] @ (values - belief.centre) - line.residual[0]
    return update(belief, line.jacobian[0], value, time, event)
