"""Present parameters of one heliostat, from all its photographs in chronological order.

A fit of constants weights last year's photographs as much as today's. Here that fit only provides
the linearisation point of each sighting and marks suspect sightings; the values come from the state
that follows the drift (`stream`), which discounts old sightings as the drive drifts, and weighs
steps, regimes and faulty sightings. The whole history is replayed, so only the sightings have to be
stored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from heliotrope.calibration.fit.common import derivative_by_shared, derivative_by_turn
from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import drift, stream
from heliotrope.calibration.learn.drift import DAY, Hyperparameters
from heliotrope.calibration.learn.learning import MISTAKE
from heliotrope.calibration.learn.stream import Belief
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism

#: Sightings that are linearised at a time.
BLOCK = 1000
#: The values hold for the days after a visit: motion within hours is at its mean by then, days.
AHEAD = 1.0
#: The turn by slope deviations about the mirror's two axes, as constants of the state, and the
#: standard deviation of one that does not occur, rad.
TURN, NO_TURN = ("turn about x", "turn about y"), 1e-9


@dataclass(frozen=True)
class Flown:
    """R orientations of one mirror, seen from the air in one flight.

    Attributes
    ----------
    sightings
        Of heliostat 0, less the mean of the errors that the flight's rows share, (R,).
    shift
        Displacement of their ends by one unit of each of K shared errors, ENU, m, (R, 3, K).
    covariance
        Of these errors, by all that is known of them but from this mirror, (K, K).
    turn_sigma
        Standard deviation of the turn that all rows of this mirror show alike, rad.
    """

    sightings: Sightings
    shift: FloatArray
    covariance: FloatArray
    turn_sigma: float


def replayed(
    mechanism: Mechanism,
    sightings: Sightings,
    fitted: FieldFit,
    hyper: Hyperparameters,
    flown: Sequence[Flown] = (),
) -> Belief:
    """Return the belief of a mirror after its sightings.

    Errors that rows of flights share are constants of the state too: each flight's from its first
    row to its last, and the mirror's turn from the first of all.

    Parameters
    ----------
    mechanism
        That the fit starts from, batch shape (1,).
    sightings
        M photographs of heliostat 0.
    fitted
        A robust fit of all, (1,), whose names are the first of ``hyper``.
    hyper
        Of the mirror's group, for the same parameters.
    flown
        Its rows of flights.
    """
    count = len(fitted.names)
    values, centre = np.zeros(len(hyper.names)), np.zeros(len(hyper.names))
    values[:count] = fitted.values[0]
    # A start near the nominal only helped the search; the prior stays centred on the nominal.
    if (np.abs(fitted.centre[0]) >= MISTAKE * fitted.prior[0]).any():
        centre[:count] = fitted.centre[0]
    moved = mechanism.with_parameters({n: values[p : p + 1] for p, n in enumerate(hyper.names)})
    blocks = []
    for first in range(0, len(sightings), BLOCK):
        some = sightings.take(np.arange(first, min(first + BLOCK, len(sightings))))
        blocks.append(_Rows.of(moved, some, hyper.names, values - centre))
    parts = [
        _Rows.joined(blocks),
        *(_Rows.of_flight(moved, f, hyper, values - centre) for f in flown),
    ]
    time = np.concatenate([part.time for part in parts])
    which = np.repeat(np.arange(len(parts)), [len(part.time) for part in parts])
    place = np.concatenate([np.arange(len(part.time)) for part in parts])
    belief = stream.begin(hyper, centre, centre != 0.0)
    if flown:
        turn = np.full(2, max(*(flight.turn_sigma for flight in flown), NO_TURN))
        belief = stream.with_constants(belief, TURN, turn)
    # Unknown times first: they say nothing about drift, and a belief does not go back.
    order = np.argsort(np.nan_to_num(time, nan=-np.inf), kind="stable")
    for k in order:
        belief = _updated(belief, which[k], parts[which[k]], int(place[k]))
    return belief


@dataclass(frozen=True)
class _Rows:
    """Sightings of one origin, linear in the parameters, and the constants that they share."""

    jacobian: FloatArray
    value: FloatArray
    time: FloatArray
    shared: int = 0

    @classmethod
    def of(
        cls, moved: Mechanism, sightings: Sightings, names: tuple[str, ...], off: FloatArray
    ) -> "_Rows":
        line = linearise(moved[sightings.heliostat], sightings, names)
        good = is_usable(line)
        value = line.jacobian @ off - line.residual
        return cls(line.jacobian[good], value[good], sightings.time[good] / DAY)

    @classmethod
    def joined(cls, parts: Sequence["_Rows"]) -> "_Rows":
        if not parts:
            return cls(np.zeros((0, 2, 0)), np.zeros((0, 2)), np.zeros(0))
        return cls(
            np.concatenate([part.jacobian for part in parts]),
            np.concatenate([part.value for part in parts]),
            np.concatenate([part.time for part in parts]),
        )

    @classmethod
    def of_flight(
        cls, moved: Mechanism, flown: Flown, hyper: Hyperparameters, off: FloatArray
    ) -> "_Rows":
        """Return a flight's rows; their sigma is their noise, whatever photographs have."""
        sightings = flown.sightings
        placed = moved[sightings.heliostat]
        line = linearise(placed, sightings, hyper.names)
        value = line.jacobian @ off - line.residual
        unit = flown.shift @ np.linalg.cholesky(flown.covariance)
        more = [
            derivative_by_turn(placed, sightings),
            derivative_by_shared(placed, sightings, unit),
        ]
        whole = np.concatenate([line.jacobian, *more], axis=-1)
        order = np.argsort(sightings.time, kind="stable")
        good = order[is_usable(line)[order]]
        scale = hyper.noise
        return cls(
            scale * whole[good], scale * value[good], sightings.time[good] / DAY, unit.shape[-1]
        )

    def names(self, number: int) -> tuple[str, ...]:
        return tuple(f"flight {number}: {k}" for k in range(self.shared))


def _updated(belief: Belief, number: int, rows: _Rows, k: int) -> Belief:
    """Return the belief after row k of one origin: 0 the photographs, or the number of a flight."""
    names = rows.names(number)
    if names and k == 0:
        belief = stream.with_constants(belief, names, np.ones(len(names)))
    jacobian = np.zeros((2, len(belief.hyper.names)))
    own = rows.jacobian.shape[-1] - rows.shared
    jacobian[:, :own] = rows.jacobian[k, :, :own]
    if names:
        first = belief.hyper.names.index(names[0])
        jacobian[:, first : first + len(names)] = rows.jacobian[k, :, own:]
    belief = stream.update(belief, jacobian, rows.value[k], rows.time[k])
    if names and k == len(rows.time) - 1:
        belief = stream.without_constants(belief, names)
    return belief


def hyper_of(
    mechanism: Mechanism, fitted: FieldFit, group: Hyperparameters | None = None
) -> Hyperparameters:
    """Return the hyperparameters of one mirror (1,) for the parameters of its fit (1,).

    Parameters
    ----------
    mechanism, fitted
        The mirror, and its fit.
    group
        Hyperparameters of its group; parameters and processes that it lacks, and all
        without it, have the defaults.
    """
    hyper = drift.start(mechanism, tuple(fitted.names), priors=fitted.prior[0])
    hyper = replace(hyper, rate=drift.step_rate(()))
    return hyper if group is None else _applied(group, hyper)


def _applied(group: Hyperparameters, own: Hyperparameters) -> Hyperparameters:
    """Return a mirror's hyperparameters with those of its group where both have them."""
    mean, spread = own.mean.copy(), own.spread.copy()
    for p, name in enumerate(own.names):
        # A parameter that only drifts in one of the models has no population there.
        if name in group.names and own.spread[p] > 0.0:
            k = group.names.index(name)
            if group.spread[k] > 0.0:
                mean[p], spread[p] = group.mean[k], group.spread[k]
    sizes = dict(zip(group.processes, group.amplitude, strict=True))
    times = dict(zip(group.groups, group.tau, strict=True))
    amplitude = [sizes.get(p, a) for p, a in zip(own.processes, own.amplitude, strict=True)]
    tau = [times.get(g, t) for g, t in zip(own.groups, own.tau, strict=True)]
    return replace(
        own,
        mean=mean,
        spread=spread,
        amplitude=np.array(amplitude),
        tau=np.array(tau),
        noise=group.noise,
        rate=group.rate,
        heavy=group.heavy,
    )


def at_present(fitted: FieldFit, belief: Belief, time: float) -> FieldFit:
    """Return a fit (1,) with the values and the covariance of a belief after a POSIX time, s."""
    count = len(fitted.names)
    values, covariance = belief.at(time / DAY + AHEAD)
    return replace(fitted, values=values[None, :count], covariance=covariance[None, :count, :count])


def fitting_present(
    mechanism: Mechanism,
    sightings: Sightings,
    fitted: FieldFit,
    group: Hyperparameters | None = None,
    flown: Sequence[Flown] = (),
) -> FieldFit:
    """Return the fit of a mirror as it is after its latest sighting.

    Parameters
    ----------
    mechanism
        That the fit starts from, batch shape (1,).
    sightings
        M of heliostat 0.
    fitted
        A robust fit of them, (1,). One that has failed is returned as it is.
    group
        Hyperparameters of its group; default: none.
    flown
        Its rows of flights.
    """
    times = np.concatenate([sightings.time, *(flight.sightings.time for flight in flown)])
    known = times[np.isfinite(times)]
    if int(fitted.outcome[0]) != FitOutcome.CONVERGED or not len(known):
        return fitted
    hyper = hyper_of(mechanism, fitted, group)
    belief = replayed(mechanism, sightings, fitted, hyper, flown)
    return at_present(fitted, belief, float(known.max()))
