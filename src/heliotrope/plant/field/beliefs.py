"""The plant's beliefs about its heliostats: the single owner of calibrations and their sightings.

A new `HeliostatCalibration` is accepted here once and passed to all subscribers: the controller
(beam checks and desired parameters), automatic control, the schedule, the store and the pages. A
calibration loaded from the store is passed on in the same way.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.evaluation import beam_errors
from heliotrope.calibration.growth import Growth, default_growth
from heliotrope.calibration.learn.drift import Hyperparameters
from heliotrope.calibration.record import HeliostatCalibration, Identities
from heliotrope.calibration.sightings import Sightings, join
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant.field.flights import Flights

#: Function that stores sightings of a heliostat on a target and returns their numbers, (M,), 0 on
#: failure.
Numbering = Callable[[str, str, Sightings], Identities]
Subscriber = Callable[[HeliostatCalibration], None]


@dataclass(frozen=True)
class KnownSightings:
    """The M known sightings of one heliostat, in order of time.

    Attributes
    ----------
    sightings
        The sightings, with heliostat index 0.
    identities
        Numbers assigned by the store, (M,); 0 for a sighting that is not stored.
    targets
        Name of the target of each sighting, M.
    missed
        Beam error under the mechanism that was believed when the sighting was taken, rad, (M,); NaN
        if the sighting was recalled.
    """

    sightings: Sightings
    identities: Identities
    targets: tuple[str, ...]
    missed: FloatArray

    def __len__(self) -> int:
        return len(self.sightings)


class Beliefs:
    """Nominal mechanism, sightings and current calibration of each heliostat.

    Parameters
    ----------
    design
        The plant.

    Attributes
    ----------
    design
        The plant.
    flights
        Drone flights; importing a flight replaces the object.
    """

    def __init__(self, design: Plant) -> None:
        self.design, self.flights = design, Flights()
        self._records: dict[str, HeliostatCalibration] = {}
        self._known: dict[str, KnownSightings] = {}
        self._subscribers: list[Subscriber] = []
        self._number: Numbering = _unkept
        self._drifting: list[Subscriber] = []
        self._hyper: dict[str, Hyperparameters] = {}
        self._growth: dict[str, Growth] = {}
        for group in design.groups.values():
            self._growth |= dict.fromkeys(group.names, default_growth(group.mechanism))

    def subscribe(self, subscriber: Subscriber, *, held: bool = True) -> None:
        """Call a function with each new calibration.

        If ``held``, also call it now with each current calibration.
        """
        self._subscribers.append(subscriber)
        for record in self._records.values() if held else ():
            subscriber(record)

    def subscribe_drift(self, subscriber: Subscriber) -> None:
        """From now on, call a function with each calibration whose covariance growth changes."""
        self._drifting.append(subscriber)

    def number_with(self, numbering: Numbering) -> None:
        """Connect the store that keeps and numbers new sightings."""
        self._number = numbering

    # -- looking -------------------------------------------------------------------------------

    def nominal(self, heliostat: str) -> Mechanism:
        """Return the mechanism of the design, batch shape (1,)."""
        group, row = self.design.find(heliostat)
        return group.mechanism[np.array([row])]

    def present(self, heliostat: str) -> Mechanism:
        """Return the present believed mechanism, batch shape (1,).

        Before the first calibration, this is the mechanism in the plant file, with its parameters.
        """
        record = self._records.get(heliostat)
        if record is not None:
            return record.mechanism(self.nominal(heliostat))
        group, row = self.design.find(heliostat)
        values = {name: float(v[row]) for name, v in group.parameters.items()}
        return self.nominal(heliostat).with_parameters(values)

    def record(self, heliostat: str) -> HeliostatCalibration | None:
        """Return the current calibration of a heliostat; None before its first."""
        return self._records.get(heliostat)

    def growth(self, heliostat: str) -> Growth:
        """Return how the covariance of a heliostat's calibration grows with time."""
        return self._growth[heliostat]

    def hyper(self, heliostat: str) -> Hyperparameters | None:
        """Return the hyperparameters of a heliostat's group; None while the defaults apply."""
        return self._hyper.get(heliostat)

    def known(self, heliostat: str) -> KnownSightings | None:
        """Return the known sightings of a heliostat; None if there are none."""
        return self._known.get(heliostat)

    def count(self, heliostat: str) -> int:
        """Return the number of known sightings of a heliostat, from photographs and flights."""
        known = self._known.get(heliostat)
        return (0 if known is None else len(known)) + self.flights.count(heliostat)

    def __len__(self) -> int:
        return len(self._records)

    def __iter__(self) -> Iterator[HeliostatCalibration]:
        """Iterate over the current calibrations."""
        return iter(self._records.values())

    # -- taking --------------------------------------------------------------------------------

    def note(self, heliostat: str, target: str, new: Sightings) -> KnownSightings:
        """Add sightings of a heliostat on a target; return all its known sightings.

        The new sightings have heliostat index 0.

        Sightings that the store failed to keep earlier are offered to it again.
        """
        missed = beam_errors(self.present(heliostat), new).beam
        added = KnownSightings(new, np.zeros(len(new), np.int64), (target,) * len(new), missed)
        known = _joined(self._known.get(heliostat), added)
        identities = known.identities.copy()
        for name in dict.fromkeys(known.targets):
            mine = np.array([target == name for target in known.targets], dtype=np.bool_)
            rows = np.flatnonzero((identities == 0) & mine)
            if len(rows):
                identities[rows] = self._number(heliostat, name, known.sightings.take(rows))
        self._known[heliostat] = KnownSightings(
            known.sightings, identities, known.targets, known.missed
        )
        return self._known[heliostat]

    def take(self, record: HeliostatCalibration) -> HeliostatCalibration:
        """Make a calibration the heliostat's current calibration, and pass it to all subscribers.

        From now on the covariance of the calibration grows with the drift of the heliostat's group.
        The calibration is returned.
        """
        record = record.growing(self.growth(record.heliostat))
        self._records[record.heliostat] = record
        for subscriber in self._subscribers:
            subscriber(record)
        return record

    def adopt(self, group: str, hyper: Hyperparameters, source: str) -> None:
        """Put the hyperparameters of a group of the design into force.

        Later fits use them for the drift. From now on they determine how the covariances of present
        calibrations grow; the calibrated values stay unchanged until the next visit.
        """
        growth, names = Growth.of(hyper, source), self.design.groups[group].names
        self._hyper |= dict.fromkeys(names, hyper)
        self._growth |= dict.fromkeys(names, growth)
        for name in names:
            record = self._records.get(name)
            if record is not None:
                self._records[name] = record = record.growing(growth)
                for subscriber in self._drifting:
                    subscriber(record)

    def recall(
        self,
        record: HeliostatCalibration,
        sightings: Sightings,
        identities: Identities,
        targets: Sequence[str],
    ) -> None:
        """Restore a calibration, and its sightings, that were stored before a restart."""
        if len(sightings):
            unknown = np.full(len(sightings), np.nan)
            self._known[record.heliostat] = KnownSightings(
                sightings, identities, tuple(targets), unknown
            )
        self.take(record)


def _joined(known: KnownSightings | None, added: KnownSightings) -> KnownSightings:
    if known is None:
        return added
    return KnownSightings(
        join([known.sightings, added.sightings]),
        np.concatenate([known.identities, added.identities]),
        (*known.targets, *added.targets),
        np.concatenate([known.missed, added.missed]),
    )


def _unkept(heliostat: str, target: str, sightings: Sightings) -> Identities:
    del heliostat, target
    return np.zeros(len(sightings), np.int64)
