"""Forecast: where a learnt heliostat will throw its beam, and how surely."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.learn.learning import Learned, predict
from heliotrope.calibration.sightings import sightings
from heliotrope.errors import InputError
from heliotrope.field.target import Receiver, Target, point_of
from heliotrope.frames import ACROSS, ENU, Framed, Labelled, Variable
from heliotrope.frames import times as as_times
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.optics.beam import ExpectedError
from heliotrope.sun import Site, Times, unix_seconds
from heliotrope.values import Card, Value, span

#: Standard deviation of a sighting where none was learnt from, rad of beam.
USUAL_SIGMA = 5e-4


@dataclass(frozen=True, eq=False, repr=False)
class Forecast(Value, Framed):
    """Expected beams of one heliostat at T times.

    Attributes
    ----------
    heliostat
        Name, or row.
    time
        Unix seconds (UTC), (T,).
    sun
        Unit vectors to the apparent sun, ENU, (T, 3).
    aim
        ENU metres, (3,).
    counts
        Drive counts to which the heliostat is steered, (T, D).
    error
        Expected beam error to the right of and above the aim as seen from the mirror, rad, (T, 2).
    covariance
        Covariance of the error as a sighting would show it: parameters, drift and noise, rad²,
        (T, 2, 2).
    reachable
        Whether the sun is up and the aim within reach, (T,); all else is NaN where it is not.
    """

    heliostat: str
    time: FloatArray
    sun: FloatArray
    aim: FloatArray
    counts: FloatArray
    error: FloatArray
    covariance: FloatArray
    reachable: npt.NDArray[np.bool_]

    @property
    def beam(self) -> FloatArray:
        """Length of the expected error, rad, (T,)."""
        return np.asarray(np.linalg.norm(self.error, axis=-1))

    @property
    def rms(self) -> FloatArray:
        """Root mean square of the error with its uncertainty, two-dimensional, rad, (T,)."""
        spread = np.trace(self.covariance, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(self.beam**2 + spread))

    @property
    def ellipse(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The 90 % ellipse about the expected error; see `ExpectedError.ellipse`."""
        return ExpectedError(self.covariance, self.reachable).ellipse

    def _card(self) -> Card:
        many = f"{len(self.time)} times, {int(self.reachable.sum())} within reach"
        long, short, _ = self.ellipse
        rows = [
            ("expected error", span(self.beam, 1e3, "mrad")),
            ("RMS with uncertainty", span(self.rms, 1e3, "mrad")),
            ("90 % ellipse, longer", span(long, 1e3, "mrad")),
            ("90 % ellipse, shorter", span(short, 1e3, "mrad")),
        ]
        return Card(f"{self.heliostat}, {many}", ("beam", "range"), rows)

    def _labelled(self) -> Labelled:
        row, (long, short, angle) = ("time",), self.ellipse
        return Labelled(
            row,
            {
                "time": as_times(self.time),
                "across": ACROSS,
                "across_2": ACROSS,
                "axis": ENU,
                "drive": np.arange(1, self.counts.shape[-1] + 1),
            },
            {
                "error": Variable((*row, "across"), self.error, "rad"),
                "rms": Variable(row, self.rms, "rad"),
                "ellipse_long": Variable(row, long, "rad"),
                "ellipse_short": Variable(row, short, "rad"),
                "ellipse_angle": Variable(row, angle, "rad"),
                "covariance": Variable((*row, "across", "across_2"), self.covariance, "rad2"),
                "count": Variable((*row, "drive"), self.counts),
                "sun": Variable((*row, "axis"), self.sun),
                "reachable": Variable(row, self.reachable),
            },
            notes={"heliostat": self.heliostat},
        )


def forecast(
    learned: Learned,
    heliostat: int | str,
    times: Times,
    target: str | Target | Receiver | npt.ArrayLike,
    *,
    site: Site | None = None,
    steered: Mechanism | None = None,
    sigma: float | None = None,
) -> Forecast:
    """Return the expected beams of one heliostat; see `Learned.forecast`."""
    row = learned.row(heliostat)
    place = site or learned.around.site
    if place is None:
        raise InputError(
            "forecast: it was learnt from mechanisms alone, so the sun above them is unknown; give "
            "site=Site(latitude, longitude, height), or learn from plant[name] or the plant"
        )
    when = np.atleast_1d(unix_seconds(times))
    if when.ndim != 1:
        raise InputError(f"times: shape {when.shape}; give a list of times, (T,)")
    light, aim = solar.vector(when, place), point_of(target, learned.around.targets)
    mine = learned.sightings.heliostat == row
    if steered is None:
        seen = learned.sightings.time[mine & learned.used]
        last = float(np.nanmax(seen)) if np.isfinite(seen).any() else np.nan
        steered = learned.mechanism_at([row], last)[0]
    found = track(steered, light, aim)
    good = np.asarray(found.reachable & (light[:, 2] > 0.0))
    if sigma is None:
        sigma = float(np.median(learned.sightings.sigma[mine])) if mine.any() else USUAL_SIGMA
    made = sightings(
        np.full(int(good.sum()), row),
        found.best_counts[good].reshape(-1, found.counts.shape[-1]),
        light[good],
        aim,
        time=when[good],
        sigma=sigma,
    )
    expected = predict(learned, made)
    good[good] = expected.usable
    known = expected.usable

    def spread(values: FloatArray) -> FloatArray:
        whole = np.full((len(when), *values.shape[1:]), np.nan)
        whole[good] = values[known]
        return as_float(whole)

    name = learned.heliostats[row] if learned.heliostats else str(row)
    return Forecast(
        name,
        when,
        light,
        aim,
        spread(made.counts),
        spread(expected.plane),
        spread(expected.covariance),
        good,
    )
