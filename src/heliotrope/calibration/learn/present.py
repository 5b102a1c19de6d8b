"""Present parameters of one heliostat, from all its photographs in chronological order.

A fit of constants weights last year's photographs as much as today's. Here that fit only provides
the linearisation point of each sighting and marks suspect sightings; the values come from a state
that follows the drift (`stream`). That state discounts old sightings as the drive drifts, and
allows for steps, regimes and faulty sightings. The whole history is replayed each time, so only the
sightings have to be stored.
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

#: Number of sightings that are linearised at once.
BLOCK = 1000
#: The values apply this many days after a visit, when motion within hours has returned to its mean.
AHEAD = 1.0
#: Names of the rotations due to slope deviations about the mirror's two axes, which are constants
#: of the state, and the standard deviation that keeps a rotation at 0 where none occurs, rad.
TURN, NO_TURN = ("turn about x", "turn about y"), 1e-9


@dataclass(frozen=True)
class Flown:
    """R orientations of one mirror, seen from the air in one flight.

    Attributes
    ----------
    sightings
        Sightings of heliostat 0, (R,), corrected for the mean of the errors that the flight's
        measurements share.
    shift
        Displacement of the ends of the sightings by one unit of each of K shared errors, ENU, m,
        (R, 3, K).
    covariance
        Covariance of these errors, from everything known about them except this mirror, (K, K).
    turn_sigma
        Standard deviation of the rotation common to all measurements of this mirror, rad.
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
    """Return the belief about a heliostat after its sightings.

    The errors that the measurements of a flight share are also constants of the state, from the
    flight's first measurement to its last. The mirror's rotation is a constant from the first
    measurement of all flights onwards.

    Parameters
    ----------
    mechanism
        Mechanism from which the fit starts, batch shape (1,).
    sightings
        M photographs of heliostat 0.
    fitted
        A robust fit of all sightings, (1,), whose names are the first in ``hyper``.
    hyper
        Hyperparameters of the heliostat's group, for the same parameters.
    flown
        The heliostat's measurements from flights.
    """
    count = len(fitted.names)
    values, centre = np.zeros(len(hyper.names)), np.zeros(len(hyper.names))
    values[:count] = fitted.values[0]
    # A start near nominal only helped the search, so the prior stays centred on nominal.
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
    # Sightings at unknown times come first, because they say nothing about drift and a belief
    # cannot go back in time.
    order = np.argsort(np.nan_to_num(time, nan=-np.inf), kind="stable")
    for k in order:
        belief = _updated(belief, which[k], parts[which[k]], int(place[k]))
    return belief


@dataclass(frozen=True)
class _Rows:
    """Sightings from one source, linear in the parameters, and the constants that they share."""

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
        """Return a flight's linearised sightings, scaled so that their noise is their sigma."""
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
    """Return the belief after sighting k of a source: 0 for photographs, or the flight number."""
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
    """Return the hyperparameters of one heliostat (1,) for the parameters of its fit (1,).

    Parameters
    ----------
    mechanism, fitted
        The heliostat's mechanism, and its fit.
    group
        Hyperparameters of the heliostat's group. Default values apply to the parameters and
        processes that the group lacks, or to all of them if there is no group.
    """
    hyper = drift.start(mechanism, tuple(fitted.names), priors=fitted.prior[0])
    hyper = replace(hyper, rate=drift.step_rate(()))
    return hyper if group is None else _applied(group, hyper)


def _applied(group: Hyperparameters, own: Hyperparameters) -> Hyperparameters:
    """Return a heliostat's hyperparameters, replaced by the group's wherever the group has them."""
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
    """Return a fit (1,) with a belief's values and covariance `AHEAD` days after ``time``, s."""
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
    """Return the fit of a heliostat, with its values after the latest sighting.

    Parameters
    ----------
    mechanism
        Mechanism from which the fit starts, batch shape (1,).
    sightings
        M sightings of heliostat 0.
    fitted
        A robust fit of the sightings, (1,). A failed fit is returned unchanged.
    group
        Hyperparameters of the heliostat's group; default: none.
    flown
        The heliostat's measurements from flights.
    """
    times = np.concatenate([sightings.time, *(flight.sightings.time for flight in flown)])
    known = times[np.isfinite(times)]
    if int(fitted.outcome[0]) != FitOutcome.CONVERGED or not len(known):
        return fitted
    hyper = hyper_of(mechanism, fitted, group)
    belief = replayed(mechanism, sightings, fitted, hyper, flown)
    return at_present(fitted, belief, float(known.max()))
