"""Records that survive a restart: sightings, calibrations, visits, heliostats out of service."""

import functools
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.flights import Flight, parse_flight
from heliotrope.calibration.record import HeliostatCalibration, Identities
from heliotrope.calibration.sightings import Sightings
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.field.flights import TakenFlight
from heliotrope.plant.operations.views import CalibrationEntry
from heliotrope.store.records import (
    Fact,
    FlightEntry,
    KeptSightings,
    Kind,
    LearningEntry,
    Lockout,
    Outlook,
    Records,
    StoreError,
    TimetableRecord,
    VisitEntry,
)

#: Time between removals of old events, s.
_DAY = 86_400.0


@runtime_checkable
class Forgetting(Protocol):
    """Records whose old events can be removed."""

    def forget_events(self, before: float) -> None:
        """Remove events before a time, and alarms cleared and acknowledged by that time."""
        ...


class Keeping:
    """The plant's memory of its calibrations, in a store; without a store it does nothing.

    For the plant's beliefs, it stores each new calibration, and stores and numbers sightings.

    Parameters
    ----------
    names
        Heliostats of the plant.
    beliefs
        Beliefs of the plant.
    records
        The store; None: nothing is kept.

    Attributes
    ----------
    lost
        The last failure to keep a record; empty if the last attempt succeeded.
    """

    def __init__(self, names: Sequence[str], beliefs: Beliefs, records: Records | None) -> None:
        self._names, self._beliefs, self._records = names, beliefs, records
        self.lost = ""
        self._forgot_at = -np.inf

    @property
    def problem(self) -> str:
        """Why records cannot be kept now; empty if they can."""
        return self.lost or (self._records.problem if self._records is not None else "")

    def recall(self) -> None:
        """Load the stored calibrations into the plant's beliefs, and from now on keep new ones."""
        records = self._records
        if records is None:
            return
        kept = records.sightings(self._names)
        flown = np.array([kind == "drone" for kind in kept.kinds], dtype=np.bool_)
        # Flights first: calibrations are predictions of all that is known.
        self._recall_flights(records, kept, flown)
        for name, record in records.latest_calibrations(self._names).items():
            rows = np.zeros(0, np.intp)
            if name in kept.names:
                mine = kept.sightings.heliostat == kept.names.index(name)
                rows = np.flatnonzero(mine & ~flown)
            targets = [kept.targets[row] for row in rows]
            seen = kept.sightings.take(rows).renumbered(np.zeros(len(rows)))
            self._beliefs.recall(record, seen, kept.identities[rows], targets)
        self._beliefs.number_with(self._number)
        self._beliefs.subscribe(functools.partial(self._keep, records), held=False)

    def _recall_flights(
        self, records: Records, kept: KeptSightings, flown: npt.NDArray[np.bool_]
    ) -> None:
        for entry in records.flights():
            flight = Flight.of(parse_flight(entry.document))
            if not set(flight.heliostats) <= set(self._names):
                continue  # the plant file has changed; the store still has it
            there = np.array([name == entry.name for name in kept.campaigns], dtype=np.bool_)
            numbers = np.sort(kept.identities[flown & there])
            if len(numbers) != len(flight.sightings):
                numbers = np.zeros(len(flight.sightings), np.int64)
            taken = TakenFlight(flight, numbers, entry.at, entry.person)
            self._beliefs.flights = self._beliefs.flights.adding(taken)

    def keep_flight(self, flight: Flight, entry: FlightEntry) -> Identities:
        """Keep a flight; return the numbers of its sightings (0 if there is no store).

        Raises
        ------
        StoreError
            If the flight cannot be kept.
        """
        if self._records is None:
            return np.zeros(len(flight.sightings), np.int64)
        self._records.record(entry)
        return self._records.record_sightings(
            flight.heliostats, flight.sightings, kind="drone", campaign=flight.name
        )

    def record(self, fact: Fact) -> None:
        """Keep a record; if this fails, `lost` says why."""
        if self._records is None:
            return
        try:
            self._records.record(fact)
        except StoreError as error:
            self.lost = str(error)

    def learnings(self) -> list[LearningEntry]:
        """Return the last result of learning for each group."""
        return [] if self._records is None else self._records.learnings()

    def timetable(self) -> TimetableRecord | None:
        """Return the timetable that an operator last activated; None if no operator has."""
        kept = [] if self._records is None else self._records.timetables()
        return kept[0] if kept else None

    def outlooks(self, since: float) -> list[Outlook]:
        """Return the predictions made since a time, oldest first."""
        return [] if self._records is None else self._records.outlooks(since)

    def _number(self, name: str, target: str, new: Sightings) -> Identities:
        """Keep sightings; return their numbers (0 where they could not be kept)."""
        assert self._records is not None
        try:
            return self._records.record_sightings((name,), new, target=target)
        except StoreError as error:
            self.lost = str(error)
            return np.zeros(len(new), np.int64)

    def _keep(self, records: Records, record: HeliostatCalibration) -> None:
        if (record.sightings == 0).any():
            return  # the sightings could not be kept; `lost` says why
        try:
            records.record_calibration(record)
        except StoreError as error:
            self.lost = str(error)

    def results(self, limit: int) -> tuple[CalibrationEntry, ...]:
        """Return the results of the last visits before the program started, oldest first.

        An error that was not stored is NaN.
        """
        visits = [] if self._records is None else self._records.visits(limit)
        nan, known, found = float("nan"), dict[str, int](), list[CalibrationEntry]()
        for visit in visits:
            name = visit.heliostat
            if name not in self._names:
                continue  # the plant file has changed
            count = known.get(name, self._beliefs.count(name))
            known[name] = max(0, count - visit.sightings)
            found.append(
                CalibrationEntry(
                    visit.finished,
                    name,
                    visit.target,
                    visit.outcome,
                    visit.error_before,
                    visit.error_after,
                    nan,
                    visit.sigma_after,
                    nan,
                    nan,
                    count,
                    visit.sightings,
                    visit.text,
                    visit.version,
                )
            )
        return tuple(reversed(found))

    def keep(self, entry: CalibrationEntry, begun: float, sigma: float) -> None:
        """Keep the result of a visit.

        Parameters
        ----------
        entry
            The result.
        begun
            Start of the visit, POSIX s.
        sigma
            Predicted error of the normal before the visit, rad.
        """
        if self._records is None:
            return
        visit = VisitEntry(
            entry.heliostat,
            entry.target,
            begun,
            entry.at,
            entry.outcome,
            entry.text,
            sigma_before=sigma,
            sigma_after=entry.predicted,
            error_before=entry.before,
            error_after=entry.after,
            sightings=entry.new,
            version=entry.version,
        )
        try:
            self._records.record(visit)
            seen = self._beliefs.known(entry.heliostat)
            if seen is None or (seen.identities > 0).all():
                self.lost = ""
        except StoreError as error:
            self.lost = str(error)

    # -- heliostats out of service, and events ---------------------------------------------

    def lockouts(self) -> tuple[Lockout, ...]:
        """Return the personal locks in force, including locks past their expected end."""
        if self._records is None:
            return ()
        return tuple(
            lock
            for lock in self._records.holds()
            if lock.kind is not Kind.HELIOSTAT or lock.name in self._names
        )

    def lock_out(self, lockouts: Sequence[Lockout]) -> None:
        """Keep locks."""
        if self._records is not None:
            self._records.hold(lockouts)

    def put_back(self, lockouts: Sequence[Lockout], who: str, at: float) -> None:
        """Record that locks have been removed."""
        if self._records is not None:
            self._records.unhold(lockouts, who, at)

    def forget(self, now: float, days: float) -> None:
        """Remove events older than some days, once a day; ``now`` in POSIX s."""
        kept: object = self._records
        if now - self._forgot_at < _DAY or not isinstance(kept, Forgetting):
            return
        self._forgot_at = now
        try:
            kept.forget_events(now - days * _DAY)
        except StoreError as error:
            self.lost = str(error)
