"""One mirror's parameters now, from all of its photographs in the order in which they came.

A fit of constants lets a photograph of last year count as much as today's. Here the fit only says
where each sighting is linearised and who is suspect; the values come from the state that follows
the drift (`stream`): it forgets what the drive has lost since, and weighs steps, regimes and
mistakes. The whole history is replayed, so nothing but the sightings has to be kept.
"""

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import drift, stream
from heliotrope.calibration.learn.drift import DAY, Hyperparameters
from heliotrope.calibration.learn.learning import MISTAKE
from heliotrope.calibration.learn.stream import Belief
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.sightings import Sightings
from heliotrope.mechanism.chain import Mechanism

#: Sightings that are taken in one step of `replaying`.
AT_ONCE = 100
#: The values hold for the days after a visit: motion within hours is at its mean by then, days.
AHEAD = 1.0


def replaying(
    mechanism: Mechanism, sightings: Sightings, fitted: FieldFit, hyper: Hyperparameters
) -> Generator[None, None, Belief]:
    """Return the belief of a mirror after its sightings, in steps of some ten ms.

    Parameters
    ----------
    mechanism
        That the fit starts from, batch shape (1,).
    sightings
        M of heliostat 0.
    fitted
        A robust fit of them, (1,), whose names are the first of ``hyper``.
    hyper
        Of the mirror's group, for the same parameters.
    """
    count = len(fitted.names)
    values, centre = np.zeros(len(hyper.names)), np.zeros(len(hyper.names))
    values[:count] = fitted.values[0]
    # A start near the nominal only helped the search; the prior stays centred on the nominal.
    if (np.abs(fitted.centre[0]) >= MISTAKE * fitted.prior[0]).any():
        centre[:count] = fitted.centre[0]
    # Unknown times first: they say nothing about drift, and a belief does not go back.
    order = np.argsort(np.nan_to_num(sightings.time, nan=-np.inf), kind="stable")
    seen = sightings.take(order)
    moved = mechanism.with_parameters({n: values[p : p + 1] for p, n in enumerate(hyper.names)})
    line = linearise(moved[seen.heliostat], seen, hyper.names)
    value = line.jacobian @ (values - centre) - line.residual
    belief = stream.begin(hyper, centre, centre != 0.0)
    for done, k in enumerate(np.flatnonzero(is_usable(line))):
        if done and done % AT_ONCE == 0:
            yield
        belief = stream.update(belief, line.jacobian[k], value[k], seen.time[k] / DAY)
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
        What was learnt of its group; parameters and processes that it does not know, and all
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
) -> Generator[None, None, FieldFit]:
    """Return the fit of a mirror as it is after its latest sighting, in steps of some ten ms.

    Parameters
    ----------
    mechanism
        That the fit starts from, batch shape (1,).
    sightings
        M of heliostat 0.
    fitted
        A robust fit of them, (1,). One that has failed is returned as it is.
    group
        What was learnt of its group; default: nothing.
    """
    known = sightings.time[np.isfinite(sightings.time)]
    if int(fitted.outcome[0]) != FitOutcome.CONVERGED or not len(known):
        return fitted
    belief = yield from replaying(mechanism, sightings, fitted, hyper_of(mechanism, fitted, group))
    return at_present(fitted, belief, float(known.max()))
