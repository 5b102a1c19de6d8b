"""The observer of results: the results of visits, compared with the photographs taken.

The camera reports each photograph to the observer, which reads the step counts of the true
heliostat at that moment. A sighting that the plant stores must have the time, the point and the
step counts of a photograph, and the true sun vector. A result must state the number of sightings
that it added, and its errors must be those of the two calibrations, before and after. The store and
the logbook must contain it, and a restarted program must know what the previous program knew
(invariant 16). Visits without any result must not continue indefinitely (L2).
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite, nan

import numpy as np

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.views import CalibrationEntry, EventRow
from heliotrope.store.records import Records
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.invariants import L2, Judge

#: The times of a sighting and of its photograph agree to within this, s.
SAME = 1e-3
#: Tolerance of a sighting's sun vector from the true one, rad; and of its point from the measured
#: point, m.
SUN_WITHIN, POINT_WITHIN = 1e-4, 1e-6
#: Step counts of a sighting, interpolated between replies of a board, differ by at most this from
#: those at the photograph, steps.
COUNTS_WITHIN = 60.0
#: A result is shown within this time after it is made, s.
SHOWN_WITHIN = 1.0
#: Errors of a result agree with the observer's own to within this share, and this, rad.
SHARE, ERROR_WITHIN = 0.05, 2e-5
#: Number of consecutive visits of one heliostat that may yield nothing and that no operator has
#: requested: nine joint visits in which its beam is searched for, and some visits alone.
RETRIES = 14
#: Number of consecutive visits alone in which a beam may be searched for in vain and that no
#: operator has requested: the plant waits for longer than a day of `days` after each.
SEARCHES = 3
#: Among this many consecutive results (or all of the field but one) from this many visits, at least
#: one must yield something, if photographs show the heliostats and no visit was broken off.
BARREN, BARREN_VISITS = 5, 4
#: Results at one target within this time belong to one visit, s.
_ONE_VISIT = 5.0
#: Outcomes of visits that were broken off, whose results are not counted.
_BROKEN = (
    CalibrationOutcome.REFUSED,
    CalibrationOutcome.TAKEN_OUT,
    CalibrationOutcome.ERROR,
)


@dataclass(frozen=True)
class Picture:
    """A photograph of one beam.

    Its time on the clock, s, its target, the measured point, and the heliostat's true step counts.
    """

    at: float
    target: str
    point: FloatArray
    counts: FloatArray


@dataclass
class _Account:
    """The observer's record of the photographs and results of one heliostat."""

    pictures: list[Picture] = field(default_factory=list)
    kept: int = 0
    last: int = 0  # sightings at its last result
    version: int = 0
    result_version: int = 0  # version at its last result
    before: Mechanism | None = None
    vain: int = 0  # consecutive visits that yielded nothing
    searched: int = 0  # consecutive visits in which a search found no beam
    typed: int = 0  # times that an operator has set parameters, which the plant will believe


class ResultObserver(Judge):
    """Checks sightings and results; see the module.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats.
    records
        The store, which outlives the plant program.
    sun
        Function that returns the true direction to the sun, (3,), at a time in s.
    zero
        POSIX time at 0 s of the clock.
    dark
        Heliostats about which the plant file is wrong, or whose mirror is covered, so that no
        photograph shows their beams.
    together
        Whether heliostats are measured together, so that a single lamp or cloud that spoils all of
        them is rare.

    """

    def __init__(
        self,
        start: float,
        boards: Sequence[Board],
        records: Records,
        sun: Callable[[float], FloatArray],
        zero: float,
        dark: Collection[str] = (),
        *,
        together: bool = False,
    ) -> None:
        super().__init__(start)
        self._records, self._sun, self._zero = records, sun, zero
        self._boards = {board.outfit.name: board for board in boards}
        self._accounts = {name: _Account() for name in self._boards}
        self._dark, self._together = frozenset(dark), together
        self._barren: list[CalibrationEntry] = []  # consecutive results
        self._results: set[tuple[str, float]] = set()
        self._program: Operations | None = None
        self._checked_at = start

    def photographed(self, heliostat: str, target: str, point: FloatArray, now: float) -> None:
        """Record a photograph at the moment of its exposure."""
        board = self._boards[heliostat]
        counts = np.array([axis.turned for axis in board.axes], dtype=np.float64) - board.slip
        self._accounts[heliostat].pictures.append(Picture(now, target, point, counts))

    def asked(self, heliostats: Sequence[str]) -> None:
        """Record that an operator requests a calibration now, whatever the previous result was."""
        for name in heliostats:
            self._accounts[name].vain = self._accounts[name].searched = 0

    def typed(self, heliostats: Sequence[str]) -> None:
        """Record that an operator has set parameters.

        The next version may then be the operator's, and not the result of a visit.
        """
        for name in heliostats:
            self._accounts[name].typed += 1

    def look(self, operations: Operations | None, now: float) -> None:
        """Check the results since the last check; ``operations`` is None while no plant runs."""
        if operations is None:
            return
        begins = operations is not self._program
        self._program = operations
        for name in self._boards:
            self._sightings(operations, name, now, begins=begins)
        results = operations.automatic.view().results
        new = [result for result in results if (result.heliostat, result.at) not in self._results]
        for entry in reversed(new):
            self._results.add((entry.heliostat, entry.at))
            # A result from just before the program froze is seen once the program continues.
            old = max(self._checked_at, self.start) - (entry.at - self._zero)
            passed = now - self._checked_at
            saw = f"a result that was not there {passed:.1f} s ago is {old:.1f} s older"
            self.check(16, old <= SHOWN_WITHIN, now, entry.heliostat, saw)
            self._concluded(operations, entry, now)
        self._checked_at = now

    # -- sightings ---------------------------------------------------------------------------

    def _sightings(self, operations: Operations, name: str, now: float, *, begins: bool) -> None:
        account, beliefs = self._accounts[name], operations.plant.beliefs
        record, stored = beliefs.record(name), beliefs.known(name)
        count = 0 if stored is None else len(stored)
        version = 0 if record is None else record.version
        if account.typed and version > account.version and count <= account.kept:
            account.typed = max(0, account.typed - version + account.version)
            account.kept, account.last = count, min(account.last, count)
            account.version, account.before = version, beliefs.present(name)
            account.result_version = version
        if begins:
            # Sightings are stored with the calibration that they result in.
            saw = (
                f"the restarted program knows calibration {version}, but the one before knew "
                f"{account.version}"
            )
            self.check(16, version >= account.version, now, name, saw)
            saw = (
                f"the restarted program knows {count} sightings, but the one before knew "
                f"{account.kept}"
            )
            self.check(16, count >= account.kept or version == 0, now, name, saw)
            account.last, account.result_version, account.searched = count, version, 0
        elif count > account.kept and stored is not None:
            new = stored.sightings.take(np.arange(account.kept, count))
            self._photographs(name, new, stored.targets[account.kept :], now)
        saw = f"the plant knows {count} sightings, but knew {account.kept} before"
        self.check(16, begins or count >= account.kept, now, name, saw)
        if account.before is None or begins:
            account.before = beliefs.present(name)
        account.kept, account.version = count, version

    def _photographs(self, name: str, new: Sightings, targets: Sequence[str], now: float) -> None:
        """Check that sightings match photographs, with the true sun and counts at their times."""
        account = self._accounts[name]
        for k, target in enumerate(targets):
            at = float(new.time[k]) - self._zero
            away = float(np.linalg.norm(new.source[k] - self._sun(at)))
            saw = f"a sighting has a sun direction {1e3 * away:.2f} mrad from the true one"
            self.check(16, away <= SUN_WITHIN, now, name, saw)
            own = [shot for shot in account.pictures if abs(shot.at - at) < SAME]
            if not own:
                continue  # of a stack, which `VisitObserver` judges
            picture = own[0]
            saw = f"a sighting on {target} is a photograph of {picture.target}"
            self.check(16, target == picture.target, now, name, saw)
            off = float(np.linalg.norm(new.destination[k] - picture.point))
            saw = f"a sighting is {off:.3f} m from the point that was photographed"
            self.check(16, off <= POINT_WITHIN, now, name, saw)
            steps = float(np.abs(new.counts[k] - picture.counts).max())
            saw = f"a sighting's counts are {steps:.0f} steps from those at its photograph"
            self.check(16, steps <= COUNTS_WITHIN, now, name, saw)

    # -- results -----------------------------------------------------------------------------

    def _concluded(self, operations: Operations, entry: CalibrationEntry, now: float) -> None:
        name, account = entry.heliostat, self._accounts[entry.heliostat]
        plant, at = operations.plant, entry.at - self._zero
        record, stored = plant.beliefs.record(name), plant.beliefs.known(name)
        self.check(16, at <= now + SAME, now, name, f"a result is dated {at - now:.1f} s ahead")
        brought = account.kept - account.last
        new, version = account.version != account.result_version, account.version
        before = account.before
        account.last, account.result_version, account.before = (
            account.kept,
            version,
            plant.beliefs.present(name),
        )
        self._noted(operations, entry, now)
        saw = f"a visit to {entry.target} failed with an error: {entry.text}"
        self.check(16, entry.outcome is not CalibrationOutcome.ERROR, now, name, saw)
        if entry.outcome in _BROKEN:
            return
        account.vain = 0 if entry.new else account.vain + 1
        saw = f"{account.vain} visits in a row have had no result; the last: {entry.text}"
        self.check(L2, account.vain <= RETRIES, now, name, saw)
        missed = entry.outcome is CalibrationOutcome.NO_BEAM
        account.searched = account.searched + 1 if missed else 0
        saw = f"its beam was searched for without success {account.searched} times in a row"
        self.check(L2, account.searched <= SEARCHES, now, name, saw)
        if name not in self._dark:
            self._barren = [] if entry.new else [*self._barren, entry]
            count = len(self._barren)
            saw = f"{count} results in a row have gained nothing; the last: {entry.text}"
            few = count < max(BARREN, len(self._boards) - 1)
            few |= _visits(self._barren) < BARREN_VISITS
            self.check(16, few or not self._together, now, name, saw)
        saw = f"a result counts {entry.new} new sightings, but there were {brought}"
        self.check(16, entry.new == brought, now, name, saw)
        saw = f"a result counts {entry.sightings} sightings, but {account.kept} are known"
        self.check(16, entry.sightings == account.kept, now, name, saw)
        saw = f"a result is {entry.outcome.value}, but calibration {version} is in use"
        self.check(16, entry.good == new, now, name, saw)
        saw = f"a result names calibration {entry.version}, but {version} is in use"
        self.check(16, entry.version == (version if new else 0), now, name, saw)
        if stored is None or before is None or brought == 0:
            return
        latest = stored.sightings.take(np.arange(len(stored) - brought, len(stored)))
        self._error(entry.measured, "its photographs missed", before, latest, now, name)
        self._error(entry.before, "they missed before", before, stored.sightings, now, name)
        if new and record is not None:
            after = record.mechanism(plant.beliefs.nominal(name))
            self._error(entry.after, "they miss now", after, stored.sightings, now, name)

    def _error(
        self, said: float, what: str, by: Mechanism, sightings: Sightings, now: float, name: str
    ) -> None:
        """Check the error that a result states.

        One photograph may have been taken after the calibration, to verify it.
        """
        if not isfinite(said):
            return
        errors = _misses(by, sightings)
        own = [_rms(errors), _rms(errors[:-1])] if len(errors) > 1 else [_rms(errors)]
        near = min(abs(said - rms) for rms in own)
        words = " or ".join(f"{1e3 * rms:.2f}" for rms in own)
        saw = f"a result says {what} by {1e3 * said:.2f} mrad; by the observer it is {words} mrad"
        self.check(16, near <= ERROR_WITHIN + SHARE * max(own), now, name, saw)

    def _noted(self, operations: Operations, entry: CalibrationEntry, now: float) -> None:
        """Check that the logbook and the store contain a result."""
        name, start = entry.heliostat, f"at {entry.target}: {entry.text}"
        events = operations.logbook.events(200)
        logged = any(
            record.kind == "calibration"
            and ((record.who, record.text) == (name, start) or _of_all(record, entry))
            for record in events
            if abs(record.at - entry.at) < SHOWN_WITHIN
        )
        self.check(16, logged, now, name, "a result is not in the logbook")
        # Visits to two targets may be refused at once.
        kept = [
            record
            for record in self._records.visits(5, name)
            if abs(record.finished - entry.at) < SAME and record.begun <= record.finished
            if record.target == entry.target
        ]
        self.check(16, bool(kept), now, name, "a result is not in the store")
        expected = entry.outcome, entry.new, entry.version
        same = any(
            (record.outcome, record.sightings, record.version) == expected for record in kept
        )
        self.check(16, same, now, name, f"the store has a result as {kept[0]}")
        kept_sightings = self._records.sightings((name,))
        count = len(kept_sightings)
        known = self._accounts[name].kept
        saw = f"the store has {count} sightings; the plant knows {known}"
        self.check(16, count >= known, now, name, saw)


def _visits(results: Sequence[CalibrationEntry]) -> int:
    """Return the number of visits from which results, sorted by time, come."""
    last: dict[str, float] = {}
    count = 0
    for entry in results:
        count += entry.at - last.get(entry.target, -inf) > _ONE_VISIT
        last[entry.target] = entry.at
    return count


def _of_all(event: EventRow, entry: CalibrationEntry) -> bool:
    """Return whether an event reports a joint visit that was refused as a whole."""
    return event.who == entry.target and event.text.endswith(f" identified together; {entry.text}")


def _misses(by: Mechanism, sightings: Sightings) -> FloatArray:
    """Return the angles by which a mechanism misses sightings, rad, (M,)."""
    pose = by.pose(sightings.counts)
    direction = sightings.destination - pose.vertex
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    rays = reflect(sightings.source, pose.normal)
    return np.asarray(np.linalg.norm(np.cross(rays, direction), axis=-1))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else nan
