"""A common error of the clock, tested as a hypothesis over all mirrors of a field.

The sun's direction is computed from the time. A clock that is fast by a minute moves all suns by
4 mrad, and each mirror's parameters take up most of that; what they cannot take up shows the error.
Every trial moves the suns by the same time along their path and fits all mirrors again. The error
is that of the lowest total cost, and its uncertainty comes from the curvature and from the scatter
between mirrors. It is stated, never corrected: the times, or the suns, are the plant's to mend.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar

from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.learn.misfits import costs
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray, rotation
from heliotrope.mechanism.chain import Mechanism
from heliotrope.values import amount

#: The sky turns by this, rad/s (a mean solar day: the sun).
RATE = 2.0 * np.pi / 86400.0
#: Trials reach this far, in steps of this, s: all zones of the Earth.
REACH, STEP = 14 * 3600.0, 3600.0
#: An error of the clock is stated from this many standard deviations on.
CLEAR = 3.0
#: Mirrors and sightings of each for the test: those with the most; fewer for the first search.
MIRRORS, MOST, FIRST = 10, 60, 20
#: Fewest sightings of a mirror that say something about the clock.
FEWEST = 8
#: Weight of the stated sigma in the estimate of the noise, degrees of freedom.
FREEDOM = 5.0


@dataclass(frozen=True)
class ClockCheck:
    """A common error of the clock.

    Attributes
    ----------
    error, sigma
        Recorded less true time, and its standard deviation, s.
    gain
        Cost without the error less the cost with it, in units of the noise.
    heliostats
        Number of mirrors that were tested.
    """

    error: float
    sigma: float
    gain: float
    heliostats: int

    @property
    def found(self) -> bool:
        """Whether the error explains the sightings far better than the clock as it is."""
        return self.gain > CLEAR**2 and abs(self.error) > CLEAR * self.sigma

    def __str__(self) -> str:
        """One line."""
        if not self.found:
            least = abs(self.error) + CLEAR * self.sigma
            return (
                f"clock: no error shows, {self.error:+.0f} ± {self.sigma:.0f} s; one below "
                f"{least:.0f} s ({1e3 * RATE * least:.1f} mrad of the sun) would not, so check it "
                "by other means"
            )
        side = "fast" if self.error > 0.0 else "slow"
        return (
            f"the clock may be wrong by {abs(self.error):.0f} s ± {self.sigma:.0f} s ({side}): by "
            f"that the sightings of {amount(self.heliostats, 'heliostat')} fit far better "
            f"({np.sqrt(self.gain):.0f} standard deviations). Check clock and time zone, correct "
            "times and suns, and calibrate again; the plant file keeps its parameters"
        )

    def document(self) -> dict[str, float | bool]:
        """Return the figures for JSON."""
        return {
            "error_s": self.error,
            "sigma_s": self.sigma,
            "gain": self.gain,
            "found": self.found,
        }


def check_clock(
    mechanism: Mechanism,
    sightings: Sightings,
    model: tuple[str, ...],
    latitude: float,
) -> ClockCheck | None:
    """Return the common error of the clock that explains the sightings best.

    Parameters
    ----------
    mechanism
        Nominal, (N,).
    sightings
        M of these heliostats; those with other light than the sun's say nothing.
    model
        The parameters to fit.
    latitude
        Of the plant, rad.

    Returns
    -------
    None if no mirror has `FEWEST` sightings of the sun.
    """
    suns = sightings.take(sightings.source_at_infinity)
    counts = np.bincount(suns.heliostat, minlength=len(mechanism))
    chosen = np.argsort(-counts, kind="stable")[:MIRRORS]
    chosen = chosen[counts[chosen] >= FEWEST]
    if not len(chosen):
        return None
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])

    def cost(seen: Sightings, shift: float) -> FloatArray:
        moved = _moved(seen, pole, shift)
        return costs(fit(mechanism[chosen], moved, model, adapt_scale=False), mechanism[chosen])

    few, many = (_part(suns, chosen, most) for most in (FIRST, MOST))
    trials = np.arange(-REACH, REACH + 1.0, STEP)
    totals = [float(cost(few, shift).sum()) for shift in trials]
    best = [
        minimize_scalar(
            lambda shift: float(cost(many, shift).sum()),
            bounds=(middle - STEP, middle + STEP),
            method="bounded",
            options={"xatol": 2.0},
        )
        for middle in dict.fromkeys((0.0, float(trials[int(np.argmin(totals))])))
    ]
    shift = float(min(best, key=lambda found: found.fun).x)
    least = cost(many, shift)
    noise = (float(least.sum()) + FREEDOM) / (2.0 * len(many) + FREEDOM)
    sigma = _sigma(cost(many, shift - 60.0), least, cost(many, shift + 60.0), noise)
    gain = (float(cost(many, 0.0).sum()) - float(least.sum())) / noise
    return ClockCheck(-shift, sigma, gain, len(chosen))


def _moved(seen: Sightings, pole: FloatArray, shift: float) -> Sightings:
    """Return the sightings with the suns as they stood ``shift`` s later."""
    turn = rotation(pole, -RATE * shift)
    far = seen.destination_at_infinity[:, None]
    return replace(
        seen,
        source=seen.source @ turn.T,
        # A sun sensor looks at the sun too.
        destination=np.where(far, seen.destination @ turn.T, seen.destination),
    )


def _part(suns: Sightings, chosen: npt.NDArray[np.intp], most: int) -> Sightings:
    """Return at most so many sightings of each of some mirrors, spread over theirs."""
    rows, place = [], []
    for k, row in enumerate(chosen):
        mine = np.flatnonzero(suns.heliostat == row)
        kept = mine[np.linspace(0, len(mine) - 1, min(most, len(mine))).round().astype(np.intp)]
        rows.append(kept)
        place.append(np.full(len(kept), k))
    return suns.take(np.concatenate(rows)).renumbered(np.concatenate(place))


def _sigma(before: FloatArray, least: FloatArray, after: FloatArray, noise: float) -> float:
    """Return the standard deviation of the shift from the costs of mirrors 60 s beside it, s."""
    curvature = np.maximum((before + after - 2.0 * least) / 60.0**2, 1e-12)
    total = float(curvature.sum())
    variance = noise * 2.0 / total
    if len(least) > 2:
        # Where mirrors disagree by more than their noise, their scatter is the uncertainty.
        away = (before - after) / (2.0 * 60.0 * curvature)
        scatter = float((curvature * away**2).sum()) / total / (len(least) - 1)
        variance = max(variance, scatter)
    return float(np.sqrt(variance))
