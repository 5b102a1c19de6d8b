"""How well the heliostats of one group are known, and how that fades with time.

The covariance of the parameters is that of priors and sightings; the zeros of the drives
creep, so that it grows with the time since the last calibration. What an error of the parameters
does to the beam over the year is a quadratic form, which changes slowly over the field: it is
computed for some heliostats and taken from the nearest of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn.drift import DAY, zeros
from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.plan.planning import Aimed, SightingLimits, aim_at, sighting_jacobian
from heliotrope.calibration.sightings import Sightings
from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.drives import SLOTS
from heliotrope.sun import Site

#: Heliostats whose form is computed; in between it changes by less than a per cent.
SAMPLES = 200

Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Look:
    """What a visit of K heliostats to a target would be, at one sun.

    Attributes
    ----------
    able
        Within stops and limits, (K,).
    normal
        Of the mirrors, (K, 3).
    drive
        Time to get there, s, (K,); 0 where speeds or counts are not known.
    slope
        Whitened derivative of all photographs of the visit together, (K, 2, P).
    gain
        Fall of the expected squared beam error, rad², (K,).
    square
        Expected squared beam error at the photograph, its noise included, rad², (K,).
    """

    able: npt.NDArray[np.bool_]
    normal: FloatArray
    drive: FloatArray
    slope: FloatArray
    gain: FloatArray
    square: FloatArray


class Knowledge:
    """Of n heliostats of one kind.

    Parameters
    ----------
    heliostats
        Group of the design.
    aim
        Where they aim in operation, ENU m, (3,).
    site, year
        Whose suns count.
    model
        Parameters: a name of the table, or names.
    priors
        Standard deviations that replace the table's, by name.
    creep
        Of the drives' zeros, rad in a day; it grows with the root of time.

    Attributes
    ----------
    names
        P parameters.
    since
        Last calibration, unix s, (n,); NaN before the first.
    """

    def __init__(
        self,
        heliostats: Heliostats,
        aim: FloatArray,
        site: Site,
        year: int,
        *,
        model: str | tuple[str, ...],
        priors: Mapping[str, float],
        creep: float,
    ) -> None:
        self.mechanism = heliostats.calibrated
        known = self.mechanism.parameters
        self.names = parameter_table.model(model, known) if isinstance(model, str) else model
        self._priors = {name: value for name, value in priors.items() if name in self.names}
        count = len(heliostats)
        self._prior = as_float(
            np.linalg.inv(precision(self.mechanism, self.names, priors=self._priors))
        )
        self.covariance = self._prior.copy()
        self.since = np.full(count, np.nan)
        sample = np.unique(np.linspace(0, count - 1, min(count, SAMPLES)).astype(np.intp))
        suns = suns_of_year(site, year, days=6)
        self._form = error_form(self.mechanism[sample], aim, suns, self.names)
        self._like = _nearest(heliostats.position, heliostats.position[sample])
        self._noise = np.zeros((len(self.names), len(self.names)))
        for zero in set(zeros(self.mechanism)) & set(self.names):
            place = self.names.index(zero)
            self._noise[place, place] = creep**2
        self.first = self._squares(self._prior, np.arange(count))
        self._known = self.first.copy()
        self._rate = np.einsum("npq,qp->n", self._form, self._noise)[self._like]

    def copy(self) -> "Knowledge":
        """Return one that can be changed without changing this."""
        other = object.__new__(Knowledge)
        other.__dict__ |= self.__dict__
        other.covariance, other.since = self.covariance.copy(), self.since.copy()
        other._known = self._known.copy()
        return other

    def _squares(self, covariance: FloatArray, rows: Rows) -> FloatArray:
        form = self._form[self._like[rows]]
        return np.asarray(np.einsum("npq,nqp->n", form, covariance))

    def expected(self, now: float) -> FloatArray:
        """Return the expected squared beam error over the year, rad², (n,)."""
        age = np.nan_to_num(np.maximum(now - self.since, 0.0)) / DAY
        return np.asarray(np.minimum(self._known + self._rate * age, self.first))

    def faded(self, rows: Rows, now: float) -> FloatArray:
        """Return the covariance of heliostats at a time, (K, P, P); never beyond the prior."""
        age = np.nan_to_num(np.maximum(now - self.since[rows], 0.0)) / DAY
        grown = self.covariance[rows] + age[:, None, None] * self._noise
        lost = self._known[rows] + self._rate[rows] * age >= self.first[rows]
        grown[lost] = self._prior[rows[lost]]
        return np.asarray(grown)

    def look(
        self,
        rows: Rows,
        now: float,
        sun: FloatArray,
        target: Target,
        limits: SightingLimits,
        *,
        shots: int,
        sigma: float,
        counts: FloatArray | None = None,
    ) -> Look:
        """Return what visits of heliostats at ``rows`` (K,) to a target would be.

        Parameters
        ----------
        rows
            Of the group.
        now, sun
            Unix s and unit vector ENU, (3,).
        target, limits
            Where to, and what is allowed.
        shots, sigma
            Photographs of a visit, and the standard deviation of the beam in each, rad.
        counts
            Where the drives stand, (K, 2), if known.
        """
        some = self.mechanism[rows]
        aimed = aim_at(some, sun, target, limits, counts)
        able = np.asarray(aimed.able)
        slope = np.zeros((len(rows), 2, len(self.names)))
        good = np.flatnonzero(able)
        if good.size:
            many = np.broadcast_to(sun, (len(good), 3))
            slope[good] = sighting_jacobian(
                some[good], aimed.counts[good], many, target, self.names, sigma
            )
        covariance = self.faded(rows, now)
        seen = np.einsum("kip,kpq,kiq->k", slope, covariance, slope)
        # The photographs of a visit are of nearly one sun: they only lessen the noise.
        slope = np.sqrt(shots) * slope
        gain = _gain.variance_gain(covariance, slope, self._form[self._like[rows]])
        drive = _drive_time(some.drives.table, aimed, counts)
        return Look(able, aimed.normal, drive, slope, gain, sigma**2 * (seen + 2.0))

    def assume(self, row: int, slope: FloatArray, now: float) -> None:
        """Take it that a visit of that slope (2, P) has been made."""
        rows = np.array([row], dtype=np.intp)
        self.covariance[row] = _gain.updated(self.faded(rows, now)[0], slope)
        self._set(rows, now)

    def learn(self, row: int, seen: Sightings, now: float) -> None:
        """Take all the sightings that a heliostat's parameters now rest on (its row is 0)."""
        rows = np.array([row], dtype=np.intp)
        information = precision(self.mechanism[rows], self.names, seen, priors=self._priors)
        self.covariance[rows] = np.linalg.inv(information)
        self._set(rows, now)

    def doubt(self, row: int, factor: float) -> None:
        """Take the variances to be ``factor`` times as large: it was found elsewhere."""
        self.covariance[row] *= factor
        self._set(np.array([row], dtype=np.intp), float(self.since[row]))

    def _set(self, rows: Rows, now: float) -> None:
        square = self._squares(as_float(self.covariance[rows]), rows)
        lost = square >= self.first[rows]
        self.covariance[rows[lost]] = self._prior[rows[lost]]
        self._known[rows] = np.minimum(square, self.first[rows])
        self.since[rows] = now


def _nearest(places: FloatArray, samples: FloatArray) -> Rows:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(samples).query(places)[1], dtype=np.intp)


def _drive_time(table: FloatArray, aimed: Aimed, counts: FloatArray | None) -> FloatArray:
    """The slower axis from where the drives stand, s, (K,)."""
    if counts is None:
        return np.zeros(len(table))
    speed = table[..., SLOTS["speed"]]
    way = np.abs(np.nan_to_num(aimed.counts) - counts)
    return np.asarray((way / speed).max(axis=-1))
