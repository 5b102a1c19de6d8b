"""Test whether one clock error explains the sightings of all heliostats of a field.

The sun's direction is computed from the time. A clock that is fast by a minute shifts every sun
position by 4 mrad. The parameters of each heliostat absorb most of that shift, and the remainder
reveals the error. The check shifts all sun positions along the sun's path by one trial time offset
and refits all heliostats; the best offset is refined by Gauss-Newton. The uncertainty follows from
the noise, or from the scatter between heliostats if that is larger. The check only reports an error
and never corrects it, because times and sun vectors must be corrected at the plant.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.fit._fit_kernels import CAUCHY_WIDTH
from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.fit.residuals import linearise, whitening
from heliotrope.calibration.learn.misfits import costs
from heliotrope.calibration.plausibility import MOVED
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.geometry import FloatArray, angle_between, normalize, rotation
from heliotrope.mechanism.chain import Mechanism
from heliotrope.sun import Site
from heliotrope.values import amount

#: Mean rotation rate of the sun about the pole, rad/s (one turn per mean solar day).
RATE = 2.0 * np.pi / 86400.0
#: Range and step of the trial offsets, s: all time zones of the Earth.
REACH, STEP = 14 * 3600.0, 3600.0
#: A clock error is reported if it reaches this many standard deviations.
CLEAR = 3.0
#: Number of heliostats in the test (those with the most sightings), and of sightings per heliostat;
#: the first search uses fewer.
MIRRORS, MOST, FIRST = 10, 60, 20
#: A heliostat with fewer sightings than this says nothing about the clock.
FEWEST = 8
#: Maximum number of Gauss-Newton steps from each starting offset.
ROUNDS = 8
#: Weight of the stated sigma in the estimate of the noise, as a number of degrees of freedom.
FREEDOM = 5.0


@dataclass(frozen=True)
class ClockCheck:
    """A clock error common to all heliostats.

    Attributes
    ----------
    error, sigma
        Recorded minus true time, and its standard deviation, s.
    heliostats
        Number of heliostats that were tested.
    """

    error: float
    sigma: float
    heliostats: int

    @property
    def found(self) -> bool:
        """Whether the error explains the sightings far better than a correct clock does."""
        return abs(self.error) > CLEAR * self.sigma

    def __str__(self) -> str:
        """Return the result in one line."""
        if not self.found:
            least = abs(self.error) + CLEAR * self.sigma
            return (
                f"clock: no error found, {self.error:+.0f} ± {self.sigma:.0f} s; an error below "
                f"{least:.0f} s ({1e3 * RATE * least:.1f} mrad of sun movement) would not be "
                "detected, so check the clock by other means"
            )
        side = "fast" if self.error > 0.0 else "slow"
        return (
            f"the clock may be wrong by {abs(self.error):.0f} s ± {self.sigma:.0f} s ({side}): "
            f"with this correction the sightings of {amount(self.heliostats, 'heliostat')} fit "
            f"far better ({abs(self.error) / self.sigma:.0f} standard deviations). Check the "
            "clock and its time zone, correct times and sun directions, and calibrate again; the "
            "plant file keeps its parameters"
        )

    def document(self) -> dict[str, float | bool]:
        """Return the results as a JSON object."""
        return {
            "error_s": self.error,
            "sigma_s": self.sigma,
            "found": self.found,
        }


def check_clock(
    mechanism: Mechanism,
    sightings: Sightings,
    model: tuple[str, ...],
    site: Site,
) -> ClockCheck | None:
    """Return the common clock error that best explains the sightings.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, (N,).
    sightings
        M sightings of these heliostats; sightings whose light source is not the sun are ignored.
    model
        The parameters to fit.
    site
        Site of the plant, for the path of the sun.

    Returns
    -------
    None if no heliostat has `FEWEST` sightings of the sun.
    """
    suns = sightings.take(sightings.source_at_infinity)
    counts = np.bincount(suns.heliostat, minlength=len(mechanism))
    chosen = np.argsort(-counts, kind="stable")[:MIRRORS]
    chosen = chosen[counts[chosen] >= FEWEST]
    if not len(chosen):
        return None

    def cost(observed: Sightings, shift: float) -> FloatArray:
        moved = later(observed, site, shift)
        return costs(fit(mechanism[chosen], moved, model, adapt_scale=False), mechanism[chosen])

    few, many = (_part(suns, chosen, most) for most in (FIRST, MOST))
    trials = np.arange(-REACH, REACH + 1.0, STEP)
    totals = [float(cost(few, shift).sum()) for shift in trials]
    starts = dict.fromkeys((0.0, float(trials[int(np.argmin(totals))])))
    steps = [_settled(mechanism[chosen], many, model, site, start) for start in starts]
    best = min(steps, key=lambda step: float(cost(many, step.shift).sum()))
    return ClockCheck(-best.shift, best.sigma, len(chosen))


@dataclass(frozen=True)
class _Step:
    """The total shift that the sun positions need, and its standard deviation, s."""

    shift: float
    sigma: float


def _settled(
    mechanism: Mechanism, sightings: Sightings, model: tuple[str, ...], site: Site, shift: float
) -> _Step:
    """Return the shift at which the sightings need no further shift, searching from ``shift``."""
    for _ in range(ROUNDS):
        step = _step(mechanism, sightings, model, site, shift)
        done = abs(step.shift - shift) < 0.1 * step.sigma
        shift = float(np.clip(step.shift, shift - STEP, shift + STEP))
        if done:
            break
    return replace(step, shift=shift)


def _step(
    mechanism: Mechanism, sightings: Sightings, model: tuple[str, ...], site: Site, shift: float
) -> _Step:
    """Return the shift after one Gauss-Newton step from ``shift``.

    Let H be the normal matrix of a heliostat's own parameters, B their coupling with the shift and
    Z the normal matrix of the shift. The heliostat then provides the information Z - B^T H^-1 B on
    the shift (as in `fit.common`).
    """
    moved = later(sightings, site, shift)
    fitted = fit(mechanism, moved, model, adapt_scale=False)
    row, names = sightings.heliostat, fitted.names
    mechanisms = mechanism.with_parameters(fitted.parameters)[row]
    line = linearise(mechanisms, moved, names)
    vertex = mechanisms.pose(sightings.counts).vertex
    axes, whiten = whitening(moved, vertex)
    before, after = (
        np.sum(ray_directions(later(sightings, site, shift + side), vertex), axis=0)
        for side in (-1.0, 1.0)
    )
    rate = -0.5 * (normalize(after) - normalize(before))
    by_shift = np.einsum("mab,mbk,mk->ma", whiten, axes, rate)
    weight = 1.0 / (1.0 + (fitted.lengths * fitted.scale[row] / CAUCHY_WIDTH) ** 2)
    count = len(mechanism)
    normal = fitted.prior[:, :, None] ** -2.0 * np.eye(len(names))
    coupling, revealed, pulled = np.zeros((count, len(names))), np.zeros(count), np.zeros(count)
    for total, term in (
        (normal, np.einsum("m,map,maq->mpq", weight, line.jacobian, line.jacobian)),
        (coupling, np.einsum("m,map,ma->mp", weight, line.jacobian, by_shift)),
        (revealed, weight * (by_shift**2).sum(axis=1)),
        (pulled, weight * (by_shift * line.residual).sum(axis=1)),
    ):
        np.add.at(total, row, term)
    # The fit has converged, so the parameters alone require no change.
    information = revealed - (coupling * np.linalg.solve(normal, coupling[..., None])[..., 0]).sum(
        1
    )
    noise = _noise(fitted)
    information, pulled = np.maximum(information, 1e-12) / noise, pulled / noise
    known = float(information.sum())
    change, variance = -float(pulled.sum()) / known, 1.0 / known
    if count > 2:
        # If heliostats disagree by more than their noise, the uncertainty is taken from their
        # scatter.
        away = -pulled / information - change
        variance *= max(1.0, float((information * away**2).sum()) / (count - 1))
    return _Step(shift + change, float(np.sqrt(variance)))


def _noise(fitted: FieldFit) -> FloatArray:
    """Return how many times sigma² the variance of each heliostat's sightings is, (N,)."""
    square = (fitted.lengths * fitted.scale[fitted.rows]) ** 2
    robust = CAUCHY_WIDTH**2 * np.log1p(square / CAUCHY_WIDTH**2)
    count = len(fitted.scale)
    data = np.bincount(fitted.rows, robust, count)
    many = np.bincount(fitted.rows, minlength=count)
    return np.asarray((data + FREEDOM) / (2.0 * many + FREEDOM))


def later(sightings: Sightings, site: Site, shift: float) -> Sightings:
    """Return sightings of the sun with every sun position moved on by ``shift`` s.

    If the time is known and matches the stated sun vector, the sun position is computed for the
    shifted time; otherwise the stated vector is rotated about the pole.
    """
    latitude = np.radians(site.latitude_deg)
    turn = rotation(np.array([0.0, np.cos(latitude), np.sin(latitude)]), -RATE * shift)
    source = sightings.source @ turn.T
    rows = np.flatnonzero(np.isfinite(sightings.time))
    agree = angle_between(sightings.source[rows], solar.vector(sightings.time[rows], site)) < MOVED
    rows = rows[agree]
    source[rows] = solar.vector(sightings.time[rows] + shift, site)
    # A sun sensor also faces the sun.
    far = sightings.destination_at_infinity[:, None]
    return replace(
        sightings, source=source, destination=np.where(far, source, sightings.destination)
    )


def _part(suns: Sightings, chosen: npt.NDArray[np.intp], most: int) -> Sightings:
    """Return at most ``most`` sightings of each chosen heliostat, spread evenly over all."""
    rows, place = [], []
    for k, row in enumerate(chosen):
        mine = np.flatnonzero(suns.heliostat == row)
        kept = mine[np.linspace(0, len(mine) - 1, min(most, len(mine))).round().astype(np.intp)]
        rows.append(kept)
        place.append(np.full(len(kept), k))
    return suns.take(np.concatenate(rows)).renumbered(np.concatenate(place))
