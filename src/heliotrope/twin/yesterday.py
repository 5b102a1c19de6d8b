"""Yesterday's calibrations of a simulated field, as its plant would have measured them.

A simulated plant may begin on its second day of commissioning. This module creates the first day
within a second, without simulating it step by step: the true heliostats send beams to the targets
for yesterday's sun positions, centroids have the noise that the visits state, and the plant's
estimator fits all heliostats at once. The errors of these calibrations therefore agree with their
covariances, provided that the true heliostats differ from the plant file as the priors say.

The heliostats nearest to a target are visited first, as in the schedule for a new field, because a
search for a beam takes the least time there. When all heliostats have been visited once, the first
of them are visited again. Drives do not drift overnight, although the plant allows for drift.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, time, timedelta

import numpy as np
import numpy.typing as npt

from heliotrope import sun as solar
from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.fit.estimator import FitOutcome, fit
from heliotrope.calibration.growth import default_growth
from heliotrope.calibration.plan.planning import aim_at
from heliotrope.calibration.record import CalibrationOutcome, HeliostatCalibration
from heliotrope.calibration.sightings import Sightings, camera_target
from heliotrope.calibration.uncertainty import expected_error
from heliotrope.errors import InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect, tangent_axes
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import track
from heliotrope.plant.field.aims import default_aims
from heliotrope.plant.schedule.settings import Settings
from heliotrope.plant.visits.fitting import first_model
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.records import CampaignEntry, Records, VisitEntry
from heliotrope.twin.live.live import CYCLE

#: Default number of heliostats measured, and the share of these that was visited twice.
COUNT, AGAIN = 1500, 0.5
#: Name of the campaign in the store, and the remark on each calibration.
CAMPAIGN = "yesterday"
NOTE = "simulated: computed when the run began, from photographs that nobody took"
#: Variance of a centroid in the plane of its target, m².
CENTROID = 1e-5
#: Share of a target's width and height over which the beam positions of a visit are spread.
_SPREAD = 0.5

Rows = npt.NDArray[np.intp]


@dataclass(frozen=True)
class Yesterday:
    """A day of calibration visits.

    Attributes
    ----------
    names
        The heliostats of the plant, which the sightings refer to by index.
    sightings, targets
        The M sightings, and each sighting's target by name, (M,).
    calibrations
        One calibration per visit, older versions before newer ones; their sightings refer to rows
        of ``sightings``.
    visits
        The visits in order of time.
    """

    names: tuple[str, ...]
    sightings: Sightings
    targets: npt.NDArray[np.str_]
    calibrations: tuple[HeliostatCalibration, ...]
    visits: tuple[VisitEntry, ...]

    async def keep(self, records: Records) -> None:
        """Save the day in a store, as a plant saves its own days.

        Raises
        ------
        InputError
            If the store already has calibrations of these heliostats.
        StoreError
            If the store cannot be written.
        """
        numbers = np.zeros(len(self.sightings), np.int64)
        for target in np.unique(self.targets).tolist():
            rows = np.flatnonzero(self.targets == target)
            some = self.sightings.take(rows)
            numbers[rows] = records.record_sightings(
                self.names, some, target=target, campaign=CAMPAIGN
            )
        kept = [replace(r, sightings=numbers[r.sightings]) for r in self.calibrations]
        # Written together, because one at a time takes seconds; a later version replaces an earlier
        # one.
        for version in sorted({record.version for record in kept}):
            records.record_calibration(*(r for r in kept if r.version == version))
        for visit in self.visits:
            records.record(visit)
        if self.visits:
            first, last = self.visits[0].begun, self.visits[-1].finished
            model = self.calibrations[0].model
            records.record(CampaignEntry(CAMPAIGN, first, last, model, NOTE))
        await records.confirm()


@dataclass(frozen=True)
class StoredParameters:
    """Parameters of K heliostats, by name, each (K,); a `mechanism.chain.Calibrated`."""

    heliostats: tuple[str, ...]
    parameters: Mapping[str, FloatArray]


async def begin_second_day(
    records: Records,
    design: Plant,
    truth: Mechanism,
    start: datetime,
    *,
    count: int = COUNT,
    seed: int = 0,
) -> Plant:
    """Save yesterday in a new store, and return the plant with the store's calibrations.

    In a world made from that plant, the local controllers store these calibrations. The plant
    program loads the same calibrations from the unchanged design and the store. Nothing is added to
    a store that already has calibrations.

    Parameters
    ----------
    records
        The store.
    design, truth, start, count, seed
        See `measure_yesterday`.

    Raises
    ------
    InputError
        See `measure_yesterday`.
    StoreError
        If the store cannot be written.
    """
    if not records.latest_calibrations(design.names):
        day = measure_yesterday(design, truth, start, count=count, seed=seed)
        await day.keep(records)
    return with_records(design, list(records.latest_calibrations(design.names).values()))


def with_records(design: Plant, records: Sequence[HeliostatCalibration]) -> Plant:
    """Return a plant with the parameters of calibrations, at most one calibration per heliostat."""
    for stored in by_model(records):
        design = design.with_calibration(stored)
    return design


def by_model(records: Sequence[HeliostatCalibration]) -> list[StoredParameters]:
    """Return the parameters of calibrations, grouped by parameter set."""
    models: dict[tuple[str, ...], list[HeliostatCalibration]] = {}
    for record in records:
        models.setdefault(record.names, []).append(record)
    return [
        StoredParameters(
            tuple(record.heliostat for record in members),
            dict(zip(names, np.stack([r.values for r in members], axis=1), strict=True)),
        )
        for names, members in models.items()
    ]


def measure_yesterday(
    design: Plant,
    truth: Mechanism,
    start: datetime,
    *,
    count: int = COUNT,
    seed: int = 0,
    cycle: CycleSettings = CYCLE,
) -> Yesterday:
    """Return the visits of the day before ``start``, and the resulting calibrations.

    Parameters
    ----------
    design, truth
        The plant, and its true mechanisms in the order of ``design.names``, (N,).
    start
        Time on the present day, with a time zone.
    count
        Number of heliostats to be measured. A visit is omitted if it can use no target.
    seed
        Seed of the noise.
    cycle
        Settings of a visit: photographs, noise and model.

    Raises
    ------
    InputError
        If the count is below 0, or the plant has no target.
    """
    if count < 0 or not design.targets:
        raise InputError(
            f"yesterday: {count} heliostats on {len(design.targets)} targets; specify 0 or more "
            "heliostats, and a plant with a target"
        )
    rows, begun = _timetable(design, start, count)
    made, targets = _photographed(design, truth, rows, begun, cycle, np.random.default_rng(seed))
    # Rows of the sightings of each visit, (V, shots); first visits precede second ones.
    shots = np.arange(len(made)).reshape(-1, cycle.shots)
    visited = made.heliostat[shots[:, 0]]
    once = np.unique(visited, return_index=True)[1]
    again = np.setdiff1d(np.arange(len(visited)), once)
    earlier = once[np.searchsorted(visited[once], visited[again])]
    passes = (shots[once], np.concatenate([shots[earlier], shots[again]], axis=1))
    found: list[tuple[HeliostatCalibration, VisitEntry]] = []
    offset = 0
    for group in design.groups.values():
        work, span = _Fits(design, group, offset, cycle), range(offset, offset + len(group))
        for used in passes:
            mine = used[np.isin(made.heliostat[used[:, 0]], span)]
            found += work.fit(made, targets, mine) if len(mine) else []
        offset += len(group)
    visits = sorted((visit for _, visit in found), key=lambda visit: visit.begun)
    records = tuple(record for record, _ in found)
    return Yesterday(design.names, made, targets, records, tuple(visits))


def _timetable(design: Plant, start: datetime, count: int) -> tuple[Rows, FloatArray]:
    """Return the heliostats of all visits, (V,), and the start times, POSIX s, (V,)."""
    centers = np.stack([target.center for target in design.targets])
    away = np.linalg.norm(design.position[:, None] - centers, axis=-1).min(axis=1)
    order = np.argsort(away, kind="stable")[:count].astype(np.intp)
    day = solar.solar_day(start, design.site) - timedelta(days=1)
    noon = datetime.combine(day, time(12), UTC).timestamp() - 240.0 * design.site.longitude_deg
    minutes = noon + 60.0 * np.arange(-720, 720)
    lowest = Settings().limits.min_elevation
    light = minutes[solar.position(minutes, design.site).elevation >= lowest]
    if not len(light):
        return order[:0], np.zeros(0)
    rows = np.concatenate([order, order[: round(AGAIN * len(order))]])
    return rows, light[0] + np.ptp(light) * (np.arange(len(rows)) + 0.5) / max(len(rows), 1)


def _photographed(
    design: Plant,
    truth: Mechanism,
    rows: Rows,
    begun: FloatArray,
    cycle: CycleSettings,
    rng: np.random.Generator,
) -> tuple[Sightings, npt.NDArray[np.str_]]:
    """Return the sightings of all visits that have a usable target, and the targets.

    Each heliostat uses the target that its beam meets at the smallest angle of incidence.
    """
    moments = begun[:, None] + cycle.interval * np.arange(1, cycle.shots + 1)
    suns = solar.vector(moments.ravel(), design.site).reshape(*moments.shape, 3)
    limits, mirrors = Settings().limits, truth[rows]
    aimed = [aim_at(mirrors, suns[:, 0], target, limits) for target in design.targets]
    slope = np.stack([np.where(each.able, each.obliquity, np.inf) for each in aimed])
    best = np.argmin(slope, axis=0)
    counts, spots = np.zeros((*moments.shape, 2)), np.full(suns.shape, np.nan)
    covariance = np.zeros((*moments.shape, 3, 3))
    for t, target in enumerate(design.targets):
        here = np.flatnonzero((best == t) & np.isfinite(slope[t]))
        counts[here], spots[here] = _thrown(mirrors[here], suns[here], target, cycle.sigma, rng)
        covariance[here] = CENTROID * target.axes.T @ target.axes
    seen = np.isfinite(spots).all(axis=(1, 2))
    made = camera_target(
        np.repeat(rows[seen], cycle.shots),
        counts[seen].reshape(-1, 2),
        suns[seen].reshape(-1, 3),
        spots[seen].reshape(-1, 3),
        time=moments[seen].ravel(),
        sigma=cycle.sigma,
        centroid_covariance=covariance[seen].reshape(-1, 3, 3),
    )
    names = np.array([target.name for target in design.targets])
    return made, np.repeat(names[best[seen]], cycle.shots)


def _thrown(
    truth: Mechanism, suns: FloatArray, target: Target, sigma: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return step counts (V, S, 2) and measured centroids (V, S, 3) of V beams on a target.

    Parameters
    ----------
    truth
        True mechanisms, (V,); each has its own aim point for each photograph.
    suns
        Unit vectors to the sun, (V, S, 3).
    target, sigma, rng
        The target, the standard deviation of a beam, rad, and the source of the noise.
    """
    count, shots = suns.shape[:2]
    mirrors, sun = truth[np.repeat(np.arange(count), shots)], suns.reshape(-1, 3)
    plane = rng.uniform(-0.5, 0.5, (len(sun), 2)) * _SPREAD * (target.width, target.height)
    counts = np.round(track(mirrors, sun, target.point(plane)).best_counts)
    pose = mirrors.pose(counts)
    ray = reflect(sun, pose.normal)
    ray = ray + np.einsum("ma,mak->mk", rng.normal(0.0, sigma, (len(sun), 2)), tangent_axes(ray))
    spot = target.intersect(pose.vertex, ray)
    spot = spot + rng.normal(0.0, np.sqrt(CENTROID), (len(sun), 2)) @ target.axes
    return counts.reshape(count, shots, 2), spot.reshape(count, shots, 3)


class _Fits:
    """Fits of a group's heliostats, visit by visit.

    Parameters
    ----------
    design, group, offset
        The plant, one of its groups, and the index of the group's first heliostat.
    cycle
        Settings of a visit.
    """

    def __init__(self, design: Plant, group: Heliostats, offset: int, cycle: CycleSettings) -> None:
        self._design, self._offset, self._cycle = design, offset, cycle
        self._model = first_model(cycle, group.mechanism)
        self._growth = default_growth(group.mechanism)
        #: The group as believed, the covariance of its parameters, and each heliostat's number of
        #: visits.
        size = len(self._model.parameters)
        self._group, self._visits = group, 0
        self._covariance = np.full((len(group), size, size), np.nan)

    def fit(
        self, made: Sightings, targets: npt.NDArray[np.str_], used: Rows
    ) -> list[tuple[HeliostatCalibration, VisitEntry]]:
        """Return the calibrations of K heliostats, and the last visit of each.

        Fits that do not converge are omitted.

        Parameters
        ----------
        made, targets
            All sightings, and each sighting's target by name, (M,).
        used
            Indices of each heliostat's sightings, in order of time, (K, S).
        """
        group, (count, size) = self._group, used.shape
        rows = made.heliostat[used[:, 0]] - self._offset
        nominal, names = group.mechanism[rows], tuple(group.names[row] for row in rows)
        seen = made.take(used.ravel()).renumbered(np.repeat(np.arange(count), size))
        # The noise is known, and there are no outliers.
        fitted = fit(nominal, seen, self._model.parameters, loss="square", adapt_scale=False)
        fitted = replace(fitted, heliostats=names)
        present, new = group.calibrated[rows], nominal.with_parameters(fitted.parameters)
        errors = [beam_errors(mechanism, seen) for mechanism in (nominal, present, new)]
        offsets = [error.offset.reshape(count, size, 2) for error in errors]
        missed = [
            np.sqrt(np.mean(error.beam.reshape(count, size) ** 2, axis=1)).tolist()
            for error in errors
        ]
        suns = made.source[used[:, -1]]
        before = self._predicted(present, rows, self._covariance[rows], suns)
        after = self._predicted(new, rows, fitted.covariance, suns)
        self._group, self._covariance[rows] = group.with_calibration(fitted), fitted.covariance
        self._visits += 1
        shots, interval = self._cycle.shots, self._cycle.interval
        found = []
        for k in np.flatnonzero(fitted.outcome == FitOutcome.CONVERGED).tolist():
            at = float(made.time[used[k, -1]]) + interval
            record = HeliostatCalibration(
                names[k],
                at,
                fitted.names,
                fitted.values[k],
                fitted.covariance[k],
                fitted.prior[k],
                missed[0][k],
                missed[2][k],
                float(fitted.scale[k]),
                sightings=used[k],
                residual_before=offsets[0][k],
                residual_after=offsets[2][k],
                model=self._model.name,
                campaign=CAMPAIGN,
                note=NOTE,
                version=self._visits,
                growth=self._growth,
            )
            better = f"beam error {1e3 * missed[1][k]:.2f} to {1e3 * missed[2][k]:.2f} mrad RMS"
            visit = VisitEntry(
                names[k],
                str(targets[used[k, -1]]),
                float(made.time[used[k, -shots]]) - interval,
                at,
                CalibrationOutcome.CALIBRATED,
                f"calibrated: {better} over {size} sightings (simulated)",
                sigma_before=before[k],
                sigma_after=after[k],
                error_before=missed[1][k],
                error_after=missed[2][k],
                sightings=shots,
                version=self._visits,
                campaign=CAMPAIGN,
            )
            found.append((record, visit))
        return found

    def _predicted(
        self, mechanism: Mechanism, rows: Rows, covariance: FloatArray, suns: FloatArray
    ) -> list[float]:
        """Return the predicted errors of K normals at their aims, rad, (K,); NaN if unknown."""
        names = [self._group.names[row] for row in rows]
        given = default_aims(self._design, names, self._group.position[rows], None)
        aims = np.stack([given[name] for name in names])
        expected = expected_error(mechanism, self._model.parameters, covariance, suns, aims)
        predicted: list[float] = (0.5 * expected.rms).tolist()
        return predicted
