"""Knowledge about the heliostats of a plant, and its decay with time.

A heliostat's parameters have the covariance of its calibration or, before the first calibration, of
the priors. The zeros of the drives drift, so the covariance grows with the time since the
calibration. The effect of parameter errors on the beam over the year is a quadratic form that
varies slowly over the field: it is computed for a sample of heliostats, and every other heliostat
uses the form of the nearest sample.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from heliotrope.calibration.growth import Growth, default_growth
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.plan import gain as _gain
from heliotrope.calibration.plan.fleets import Fleet
from heliotrope.calibration.plan.planning import Aimed, SightingLimits, aim_at, sighting_jacobian
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year
from heliotrope.errors import InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.drives import SLOTS
from heliotrope.optics.shading import nearest
from heliotrope.plant.schedule.settings import Settings
from heliotrope.sun import Site

#: Heliostats in the sample; between neighbours of the sample the form differs by less than 1 %.
SAMPLES = 200
#: Neighbours that can shade or block a mirror.
NEIGHBOURS = 32

Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class VisitYield:
    """The expected yield of a visit of each of K heliostats to a target, at one sun position.

    Attributes
    ----------
    able
        Whether the heliostat is within stops and limits, (K,).
    normal
        Mirror normals, (K, 3).
    drive
        Travel time to the target, s, (K,); 0 if speeds or counts are unknown.
    slope
        Whitened derivative of all photographs of the visit together, (K, 2, P).
    gain
        Reduction of the expected squared beam error, rad², (K,).
    square
        Expected squared beam error at the photograph, including its noise, rad², (K,).
    """

    able: npt.NDArray[np.bool_]
    normal: FloatArray
    drive: FloatArray
    slope: FloatArray
    gain: FloatArray
    square: FloatArray


class Knowledge:
    """Knowledge of n heliostats of one group.

    Parameters
    ----------
    heliostats
        A group of the design.
    aim
        Aim point in operation, ENU, m, (3,).
    site, year
        Location and calendar year of the sun positions used.
    model
        Parameters: a name of the table, or names.
    priors
        Standard deviations that replace the values in the table, by name.

    Attributes
    ----------
    names
        The P parameters.
    since
        Last calibration, POSIX s, (n,); NaN before the first.
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
    ) -> None:
        self.mechanism, self._aim = heliostats.calibrated, aim
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
        # Drift adds only to the variances, so the diagonal of the form is enough.
        self._weight = np.diagonal(self._form, axis1=-2, axis2=-1)
        self._growths: tuple[Growth, ...] = (default_growth(self.mechanism),)
        self._grows = np.zeros(count, dtype=np.intp)
        self.first = self._squares(self._prior, np.arange(count))
        self._known = self.first.copy()

    def copy(self) -> "Knowledge":
        """Return a copy to change independently."""
        other = object.__new__(Knowledge)
        other.__dict__ |= self.__dict__
        other.covariance, other.since = self.covariance.copy(), self.since.copy()
        other._known, other._grows = self._known.copy(), self._grows.copy()
        return other

    def _squares(self, covariance: FloatArray, rows: Rows) -> FloatArray:
        form = self._form[self._like[rows]]
        return np.asarray(np.einsum("npq,nqp->n", form, covariance))

    def expected(self, now: float) -> FloatArray:
        """Return the expected squared beam error over the year, rad², (n,)."""
        rows = np.arange(len(self.since))
        added = np.einsum("np,np->n", self._weight[self._like], self._added(rows, now))
        return np.asarray(np.minimum(self._known + added, self.first))

    def faded(self, rows: Rows, now: float) -> FloatArray:
        """Return the covariances of heliostats at a time, (K, P, P), never above the prior."""
        added = self._added(rows, now)
        grown = self.covariance[rows] + added[:, :, None] * np.eye(len(self.names))
        more = np.einsum("np,np->n", self._weight[self._like[rows]], added)
        lost = self._known[rows] + more >= self.first[rows]
        grown[lost] = self._prior[rows[lost]]
        return np.asarray(grown)

    def _added(self, rows: Rows, now: float) -> FloatArray:
        """Return the growth of the variances since the last calibration, (K, P)."""
        days, kind = np.nan_to_num(now - self.since[rows]) / DAY, self._grows[rows]
        found = np.empty((len(rows), len(self.names)))
        for k, growth in enumerate(self._growths):
            mine = kind == k
            found[mine] = growth.variances(self.names, days[mine])
        return found

    def grow_as(self, row: int, growth: Growth) -> None:
        """Set a heliostat's drift from its record; a group shares one drift object."""
        if growth not in self._growths:
            used = np.unique(np.delete(self._grows, row))
            self._growths = (*(self._growths[k] for k in used), growth)
            self._grows = np.searchsorted(used, self._grows)
        self._grows[row] = self._growths.index(growth)

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
    ) -> VisitYield:
        """Return the expected yield of visits of heliostats to a target.

        Parameters
        ----------
        rows
            Rows of the group, (K,).
        now, sun
            POSIX s and unit vector ENU, (3,).
        target, limits
            The target, and the limits on sun positions and angles.
        shots, sigma
            Photographs of a visit, and the standard deviation of the beam in each, rad.
        counts
            Present step counts of the drives, (K, 2), if known.
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
        # The photographs of a visit are taken at nearly the same sun position, so more of them only
        # reduce the noise.
        slope = np.sqrt(shots) * slope
        gain = _gain.variance_gain(covariance, slope, self._form[self._like[rows]])
        drive = _drive_time(some.drives.table, aimed, counts)
        return VisitYield(able, aimed.normal, drive, slope, gain, sigma**2 * (seen + 2.0))

    def fleet(self, labels: Sequence[str], now: float, sigma: float) -> Fleet:
        """Return all heliostats at a time, for a plan, with covariances instead of information."""
        form = self._form[self._like]
        known = self.faded(np.arange(len(self.since)), now)
        return Fleet(self.mechanism, self.names, known, form, self._aim, sigma, tuple(labels))

    def assume(self, row: int, slope: FloatArray, now: float) -> None:
        """Assume that a visit with the derivative ``slope`` (2, P) has been made."""
        rows = np.array([row], dtype=np.intp)
        self.covariance[row] = _gain.updated(self.faded(rows, now)[0], slope)
        self._set(rows, now)

    def learn(self, row: int, record: HeliostatCalibration) -> None:
        """Accept a new calibration; parameters that it lacks keep their prior."""
        covariance = self._prior[row].copy()
        shared = [name for name in self.names if name in record.names]
        mine = [self.names.index(name) for name in shared]
        theirs = [record.names.index(name) for name in shared]
        covariance[mine, :] = covariance[:, mine] = 0.0
        covariance[np.ix_(mine, mine)] = record.covariance[np.ix_(theirs, theirs)]
        self.covariance[row] = covariance
        self.grow_as(row, record.growth)
        self._set(np.array([row], dtype=np.intp), record.at)

    def doubt(self, row: int, factor: float) -> None:
        """Multiply the variances by a factor, because the beam was far from its prediction."""
        self.covariance[row] *= factor
        self._set(np.array([row], dtype=np.intp), float(self.since[row]))

    def _set(self, rows: Rows, now: float) -> None:
        square = self._squares(as_float(self.covariance[rows]), rows)
        lost = square >= self.first[rows]
        self.covariance[rows[lost]] = self._prior[rows[lost]]
        self._known[rows] = np.minimum(square, self.first[rows])
        self.since[rows] = now


class FieldKnowledge:
    """Knowledge of all N heliostats of a plant, group by group, in one order of indices.

    Parameters
    ----------
    design
        The plant.
    settings
        Settings of the schedule.
    names
        Order of the rows.
    begin, year
        Time from which the age of an uncalibrated heliostat counts, POSIX s; year of the sun
        positions.

    Attributes
    ----------
    row
        Row of each heliostat, by name.
    position, size
        Feet of the heliostats, and width and height of the mirrors, m, (N, 3) and (N, 2).
    near
        Rows of the nearest neighbours, (N, K).
    worth
        How much a smaller squared error of each heliostat counts beside the others, (N,).

    Raises
    ------
    InputError
        If the names differ from the names in the design.
    """

    def __init__(
        self, design: Plant, settings: Settings, names: Sequence[str], begin: float, year: int
    ) -> None:
        if sorted(names) != sorted(design.names):
            raise InputError(
                f"schedule: {len(names)} names for {len(design)} heliostats; list each name of the "
                "design once"
            )
        self.row = {name: i for i, name in enumerate(names)}
        self._settings, self._begin, count = settings, begin, len(names)
        aim = (design.receivers or design.targets)[0].center
        groups = list(design.groups.values())
        self._groups: list[Knowledge] = [
            Knowledge(
                group,
                aim,
                design.site,
                year,
                model=settings.model,
                priors=settings.priors,
            )
            for group in groups
        ]
        # Rows of the heliostats of each group, and the inverse.
        self._rows = [np.array([self.row[n] for n in g.names], dtype=np.intp) for g in groups]
        self.group, self._place = np.empty((2, count), dtype=np.intp)
        self.position, self.size = np.empty((count, 3)), np.empty((count, 2))
        self.worth = np.ones(count)
        for g, (group, rows) in enumerate(zip(groups, self._rows, strict=True)):
            self.group[rows], self._place[rows] = g, np.arange(len(rows))
            self.position[rows] = group.position
            self.size[rows] = np.stack([group.width, group.height], axis=1)
        self.near = nearest(self.position, NEIGHBOURS)

    def __len__(self) -> int:
        return len(self.row)

    def copy(self) -> "FieldKnowledge":
        """Return a copy to change independently."""
        other = copy(self)
        other._groups = [known.copy() for known in self._groups]  # noqa: SLF001 - its own kind
        return other

    def squares(self, now: float) -> FloatArray:
        """Return the squared beam errors over the year, as expected at a given time, rad², (N,)."""
        found = np.empty(len(self))
        for known, rows in zip(self._groups, self._rows, strict=True):
            found[rows] = known.expected(now)
        return found

    def ages(self, now: float) -> FloatArray:
        """Return the time since each heliostat's last calibration, or since ``begin``, s, (N,)."""
        since = np.empty(len(self))
        for known, rows in zip(self._groups, self._rows, strict=True):
            since[rows] = known.since
        return np.asarray(now - np.where(np.isnan(since), self._begin, since))

    def look(
        self,
        rows: npt.NDArray[np.intp],
        now: float,
        sun: FloatArray,
        target: Target,
        counts: FloatArray | None,
    ) -> VisitYield:
        """Return the expected yield of visits by heliostats of one group; see `Knowledge.look`."""
        settings, known = self._settings, self._groups[int(self.group[rows[0]])]
        return known.look(
            self._place[rows],
            now,
            sun,
            target,
            settings.limits,
            shots=settings.shots,
            sigma=settings.sigma,
            counts=counts,
        )

    def fleets(self, now: float) -> tuple[tuple[Fleet, ...], Rows]:
        """Return the heliostats for a plan, and their indices; see `Knowledge.fleet`."""
        names = np.array(list(self.row))
        sigma = self._settings.sigma
        found = tuple(
            known.fleet(names[rows].tolist(), now, sigma)
            for known, rows in zip(self._groups, self._rows, strict=True)
        )
        return found, np.concatenate(self._rows)

    def assume(self, row: int, slope: FloatArray, now: float) -> None:
        """Assume that a visit with the derivative ``slope`` (2, P) has been made."""
        self._groups[self.group[row]].assume(int(self._place[row]), slope, now)

    def learn(self, row: int, record: HeliostatCalibration) -> None:
        """Accept a new calibration of a heliostat."""
        self._groups[self.group[row]].learn(int(self._place[row]), record)

    def grow_as(self, row: int, growth: Growth) -> None:
        """Change a heliostat's drift since its last calibration."""
        self._groups[self.group[row]].grow_as(int(self._place[row]), growth)

    def doubt(self, row: int, factor: float) -> None:
        """Multiply the variances of a heliostat by a factor."""
        self._groups[self.group[row]].doubt(int(self._place[row]), factor)


def _nearest(places: FloatArray, samples: FloatArray) -> Rows:
    return np.asarray(cKDTree(samples).query(places)[1], dtype=np.intp)


def _drive_time(table: FloatArray, aimed: Aimed, counts: FloatArray | None) -> FloatArray:
    """Return the time that the slower axis needs to reach the pose, s, (K,)."""
    if counts is None:
        return np.zeros(len(table))
    speed = table[..., SLOTS["speed"]]
    way = np.abs(np.nan_to_num(aimed.counts) - counts)
    return np.asarray((way / speed).max(axis=-1))
