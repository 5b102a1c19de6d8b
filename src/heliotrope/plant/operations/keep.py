"""What the automatic work keeps of calibrations and holds over a restart, and recalls."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from heliotrope.calibration.fit.estimator import fit
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.book import CalibrationBook
from heliotrope.plant.operations.views import CalibrationEntry, Hold
from heliotrope.plant.visits.calibration_cycle import CycleResult
from heliotrope.plant.visits.centring import CentringCycle
from heliotrope.store.records import Records, StoreError, VisitEntry, version_of

#: Old events are looked for so often, s.
_DAY = 86_400.0


@runtime_checkable
class Forgetting(Protocol):
    """Records that can let go of what is old."""

    def forget_events(self, before: float) -> None:
        """Let go of events before a time, and of alarms that were over and acknowledged."""
        ...


class Keeper:
    """Keeps and recalls; without records it does nothing.

    Parameters
    ----------
    plant, book, cycle
        Whose calibration it is.
    records
        Where it is kept; None: nowhere.

    Attributes
    ----------
    lost
        The last error at keeping, "" if there was none.
    """

    def __init__(
        self,
        plant: PlantController,
        records: Records | None,
        book: CalibrationBook,
        cycle: CentringCycle | None,
    ) -> None:
        self._plant, self._records, self._book, self._cycle = plant, records, book, cycle
        self._numbers: dict[str, list[int]] = {}
        self.lost = ""
        self._forgot_at = -np.inf

    @property
    def problem(self) -> str:
        """Why nothing can be kept now, "" if it can."""
        return self.lost or (self._records.problem if self._records is not None else "")

    def holds(self) -> dict[str, Hold]:
        """Return the holds that were kept."""
        if self._records is None:
            return {}
        kept = self._records.holds(self._plant.clock.utc().timestamp())
        return {
            name: Hold(name, hold.person, hold.reason, hold.since)
            for name, hold in kept.items()
            if name in self._plant.field.index
        }

    def hold(self, heliostats: Sequence[str], reason: str, who: str, at: float) -> None:
        """Keep holds."""
        if self._records is not None:
            self._records.hold(heliostats, reason, who, at)

    def unhold(self, heliostats: Sequence[str], who: str, at: float) -> None:
        """Keep that heliostats were given back."""
        if self._records is not None:
            self._records.unhold(heliostats, who, at)

    def forget(self, now: float, days: float) -> None:
        """Let go of events older than some days, once a day; ``now`` in POSIX s."""
        kept: object = self._records
        if now - self._forgot_at < _DAY or not isinstance(kept, Forgetting):
            return
        self._forgot_at = now
        try:
            kept.forget_events(now - days * _DAY)
        except StoreError as error:
            self.lost = str(error)

    def recall(self) -> None:
        """Take up all calibrations that were kept; local controllers that differ are told."""
        if self._records is None or self._cycle is None:
            return
        cycle, plant = self._cycle, self._plant
        latest = self._records.latest_parameters(plant.field.names)
        kept = self._records.sightings(plant.field.names)
        for name, version in latest.items():
            seen = kept.of(name)
            if name not in plant.field.index or not len(seen):
                continue
            cycle.known[name] = seen
            cycle.values[name] = version.parameters
            mechanism = cycle.mechanism(name)[1]
            row = plant.field.place(name)
            plant.beams.replace(row, mechanism[0].armature.table, mechanism[0].drives.table)
            plant.wanted.set(name, items_of(mechanism[0]))
            self._book.learn(name, version.parameters, mechanism, seen, version.at)
            self._book.sightings[row] = len(seen)
            place = kept.names.index(name)
            mine = kept.identities[kept.sightings.heliostat == place]
            self._numbers[name] = [int(number) for number in mine]

    def keep(
        self, entry: CalibrationEntry, begun: float, sigma: float, result: CycleResult | None
    ) -> None:
        """Keep what a visit brought."""
        if self._records is None:
            return
        try:
            self._keep(self._records, entry, begun, sigma, result)
            self.lost = ""
        except StoreError as error:
            self.lost = str(error)

    def _keep(
        self,
        records: Records,
        entry: CalibrationEntry,
        begun: float,
        sigma: float,
        result: CycleResult | None,
    ) -> None:
        name, new, version = entry.heliostat, 0, 0
        numbers = self._numbers.setdefault(name, [])
        if result is not None and result.sightings is not None:
            fresh = result.sightings.take(np.arange(len(numbers), len(result.sightings)))
            new = len(fresh)
            if new:
                made = records.record_sightings((name,), fresh, target=entry.target)
                numbers.extend(int(number) for number in made)
            if entry.good and self._cycle is not None:
                nominal = self._cycle.mechanism(name)[0]
                fitted = fit(nominal, result.sightings, self._cycle.model)
                version = records.record_parameters(
                    version_of(
                        name,
                        entry.at,
                        fitted,
                        nominal,
                        result.sightings,
                        numbers,
                        model=self._cycle.model_name,
                        person="automat",
                        pushed=result.pushed,
                    )
                )
        records.record_visit(
            VisitEntry(
                name,
                entry.target,
                begun,
                entry.at,
                entry.good,
                entry.text,
                sigma_before=sigma,
                sigma_after=entry.predicted,
                error_before=entry.before,
                error_after=entry.after,
                sightings=new,
                version=version,
            )
        )
