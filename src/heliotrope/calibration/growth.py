r"""Growth of a calibration's covariance with time, due to drift after the last photograph.

The parameters drift as `heliotrope.calibration.learn.drift` describes. If a heliostat keeps its
calibrated values, its error after a time Δ is the distance that its drift processes have moved in
the meantime:

$$ \langle (d(t + Δ) - d(t))^2 \rangle = 2 a^2 (1 - e^{-Δ/τ}) + r Δ s^2 , $$

which is the structure function of an Ornstein-Uhlenbeck process with standard deviation a and time
constant τ, plus steps of standard deviation s that occur r times a day.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn import drift
from heliotrope.calibration.learn.drift import Hyperparameters
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism.chain import Mechanism


@dataclass(frozen=True)
class Growth:
    """Growth of the variances of parameters with time; by default nothing grows.

    Objects with equal values compare as equal, so that the heliostats of a group can be computed
    together.

    Attributes
    ----------
    source
        Source of the values, for display.
    processes, variance, tau
        Parameter, variance and time constant (days) of each of the C processes.
    stepping, rate
        The Z parameters that step, and the growth of their variances per day, (Z,).
    """

    source: str = "nothing grows"
    processes: tuple[str, ...] = ()
    variance: tuple[float, ...] = ()
    tau: tuple[float, ...] = ()
    stepping: tuple[str, ...] = ()
    rate: tuple[float, ...] = ()

    @classmethod
    def of(cls, hyper: Hyperparameters, source: str) -> "Growth":
        """Return the growth that follows from hyperparameters.

        Processes on the scale of hours are left out, because they decay before the next calibration
        visit and are already part of the noise of each sighting.
        """
        slow = [c for c, process in enumerate(hyper.processes) if process.group != "hours"]
        steps = np.flatnonzero(hyper.step > 0.0)
        return cls(
            source,
            tuple(hyper.processes[c].parameter for c in slow),
            tuple((hyper.amplitude[slow] ** 2).tolist()),
            tuple(hyper.tau[hyper.group[slow]].tolist()),
            tuple(hyper.names[p] for p in steps),
            tuple((hyper.rate * hyper.step[steps] ** 2).tolist()),
        )

    def variances(self, names: Sequence[str], days: npt.ArrayLike) -> FloatArray:
        """Return how much the variances of parameters grow over a number of days, (..., P).

        Parameters
        ----------
        names
            Names of P parameters; the variance of a parameter that does not drift does not grow.
        days
            Days since the calibration, (...); negative values add nothing.
        """
        since = np.maximum(as_float(days), 0.0)[..., None]
        of_processes = 2.0 * as_float(self.variance) * -np.expm1(-since / as_float(self.tau))
        return as_float(
            of_processes @ _places(self.processes, names)
            + since * (as_float(self.rate) @ _places(self.stepping, names))
        )

    def grown(
        self, covariance: npt.ArrayLike, names: Sequence[str], days: npt.ArrayLike
    ) -> FloatArray:
        """Return what covariances (..., P, P) have grown to after ``days`` (...)."""
        added = self.variances(names, days)
        return as_float(as_float(covariance) + added[..., None] * np.eye(len(names)))


def default_growth(mechanism: Mechanism) -> Growth:
    """Return the growth to assume for a kind of mechanism before its field has any sightings."""
    hyper = drift.start(mechanism, drift.zeros(mechanism))
    tau, rate = drift.START_DAYS["slow"], drift.step_rate(())
    wander = f"zeros wander by {1e3 * drift.START_RAD['slow']:g} mrad over {tau:.0f} days"
    steps = f"step by {1e3 * drift.STEP_RAD:g} mrad in {1.0 / rate:.0f}"
    return Growth.of(replace(hyper, rate=rate), f"default: {wander} and {steps}")


def _places(parameters: tuple[str, ...], names: Sequence[str]) -> FloatArray:
    """Return the matrix (C, P) that assigns each process to the parameter of the same name."""
    columns = np.array(names, dtype=np.str_)
    rows = np.array(parameters, dtype=np.str_)
    return as_float(rows[:, None] == columns)
