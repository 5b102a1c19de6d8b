"""Drone flights imported into the plant, and what its mirrors reveal about shared errors.

The fit of a heliostat needs the information from all other heliostats about the errors that they
share, but must not count its own information twice. The information is therefore stored separately
for each heliostat (`CommonFit.information`).
"""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.common import CommonErrors
from heliotrope.calibration.flights import Flight
from heliotrope.calibration.learn.present import Flown
from heliotrope.calibration.record import Identities
from heliotrope.calibration.sightings import Sightings, join
from heliotrope.geometry import FloatArray

#: Maximum number of flights that fits use, the latest ones. Each further flight adds its shared
#: errors to the fit of every heliostat.
MOST = 8


@dataclass(frozen=True)
class TakenFlight:
    """A flight that was imported into the plant.

    Attributes
    ----------
    flight
        The flight.
    identities
        Numbers of its sightings in the store, (M,); 0 if there is no store.
    at
        When it was imported, POSIX s.
    person
        Who imported it.
    left_out
        Heliostats to which records were wrongly attributed; these records are left out of all fits.
    """

    flight: Flight
    identities: Identities
    at: float
    person: str
    left_out: frozenset[str] = frozenset()


class Flights:
    """The flights of a plant; importing a flight creates a new object.

    Parameters
    ----------
    taken
        Flights in the order in which they were imported.
    parts
        What each heliostat reveals about the shared errors of ``taken``: information and pull.
    """

    def __init__(
        self,
        taken: Sequence[TakenFlight] = (),
        parts: Mapping[str, tuple[FloatArray, FloatArray]] | None = None,
    ) -> None:
        self._parts = dict(parts or {})
        self._set(tuple(taken))

    def _set(self, taken: tuple[TakenFlight, ...]) -> None:
        self._taken = taken
        sizes = [len(flown.flight.shared) for flown in taken]
        self._edges = np.concatenate([[0], np.cumsum(sizes, dtype=np.intp)])
        empty = np.zeros(0, np.intp)
        self._rows: dict[str, list[npt.NDArray[np.intp]]] = {}
        for k, flown in enumerate(taken):
            for name, rows in flown.flight.rows_by_heliostat().items():
                if name not in flown.left_out:
                    self._rows.setdefault(name, [empty] * len(taken))[k] = rows

    def __len__(self) -> int:
        return len(self._taken)

    def __iter__(self) -> Iterator[TakenFlight]:
        """Iterate over the flights in the order in which they were imported."""
        return iter(self._taken)

    def __contains__(self, heliostat: str) -> bool:
        return heliostat in self._rows

    def count(self, heliostat: str) -> int:
        """Return the number of flight records of a heliostat."""
        return sum(map(len, self._rows.get(heliostat, ())))

    def adding(self, new: TakenFlight) -> "Flights":
        """Return the flights with a new flight added, but only the last `MOST` flights."""
        taken = (*self._taken, new)
        oldest = len(taken) - MOST if len(taken) > MOST else 0
        first, size = self._edges[oldest], len(new.flight.shared)
        parts = {
            name: (
                np.pad(information[first:, first:], ((0, size), (0, size))),
                np.pad(pull[first:], (0, size)),
            )
            for name, (information, pull) in self._parts.items()
        }
        return Flights(taken[oldest:], parts)

    def learn(self, heliostat: str, information: FloatArray, pull: FloatArray) -> None:
        """Store the information about the shared errors from the last fit of a heliostat.

        A fit that began before the last flight was imported lacks the errors of that flight, and is
        ignored.
        """
        if heliostat in self._rows and len(pull) == self._edges[-1]:
            self._parts[heliostat] = information, pull

    def leave_out(self, heliostats: Collection[str]) -> None:
        """Exclude these heliostats' records from the last flight from all fits.

        The records belong to other heliostats.
        """
        last = replace(self._taken[-1], left_out=frozenset(heliostats))
        self._set((*self._taken[:-1], last))

    def number(self, flight: str, identities: Identities) -> None:
        """Remember the numbers that the store assigned to the sightings of a flight, (M,)."""
        self._set(
            tuple(
                replace(flown, identities=identities) if flown.flight.name == flight else flown
                for flown in self._taken
            )
        )

    def shared(self, but: Collection[str] = ()) -> tuple[FloatArray, FloatArray]:
        """Return the mean (K,) and the covariance (K, K) of all shared errors.

        Parameters
        ----------
        but
            Heliostats whose information is left out.
        """
        count = int(self._edges[-1])
        known, drawn = np.zeros((count, count)), np.zeros(count)
        for flown, first, last in zip(self._taken, self._edges[:-1], self._edges[1:], strict=True):
            known[first:last, first:last] = np.linalg.inv(flown.flight.covariance)
        for name, (information, pull) in self._parts.items():
            if name not in but:
                known += information
                drawn += pull
        covariance = np.linalg.inv(known)
        return covariance @ drawn, 0.5 * (covariance + covariance.T)

    def of_flight(self, number: int) -> tuple[FloatArray, FloatArray]:
        """Return the mean and the covariance of the shared errors of one flight, counted from 0."""
        mean, covariance = self.shared()
        part = slice(self._edges[number], self._edges[number + 1])
        return mean[part], covariance[part, part]

    def identities(self, heliostat: str) -> Identities:
        """Return the numbers of a heliostat's flight records, in the order of `common`."""
        rows = self._rows.get(heliostat, [])
        parts = [flown.identities[r] for flown, r in zip(self._taken, rows, strict=bool(rows))]
        return np.concatenate([np.zeros(0, np.int64), *parts])

    def common(
        self, heliostats: Sequence[str], photographed: Sequence[Sightings | None]
    ) -> tuple[Sightings, CommonErrors]:
        """Return all sightings of some heliostats, photographs first, and their common errors.

        Parameters
        ----------
        heliostats
            N names; the sightings refer to them by index from 0.
        photographed
            Each heliostat's sightings from photographs, with heliostat index 0; None if there are
            none.
        """
        parts: list[Sightings] = []
        shifts: list[FloatArray] = []
        turned: list[npt.NDArray[np.bool_]] = []
        turn, count = np.zeros(len(heliostats)), int(self._edges[-1])
        for i, (name, photographs) in enumerate(zip(heliostats, photographed, strict=True)):
            if photographs is not None and len(photographs):
                parts.append(_as_row(photographs, i))
                shifts.append(np.zeros((len(photographs), 3, count)))
                turned.append(np.zeros(len(photographs), np.bool_))
            rows_of = self._rows.get(name) or [np.zeros(0, np.intp)] * len(self._taken)
            for k, (flown, rows) in enumerate(zip(self._taken, rows_of, strict=True)):
                if not len(rows):
                    continue
                flight = flown.flight
                parts.append(_as_row(flight.sightings.take(rows), i))
                shift = np.zeros((len(rows), 3, count))
                shift[:, :, self._edges[k] : self._edges[k + 1]] = flight.shift[rows]
                shifts.append(shift)
                turned.append(np.ones(len(rows), np.bool_))
                turn[i] = max(turn[i], flight.turn_sigma[flight.heliostats.index(name)])
        mean, covariance = self.shared(set(heliostats))
        errors = CommonErrors(
            np.concatenate(shifts), mean, covariance, np.concatenate(turned), turn
        )
        return join(parts), errors

    def flown(self, heliostat: str) -> tuple[Flown, ...]:
        """Return a heliostat's records, flight by flight, with the errors that they share.

        The shared errors are estimated from all other heliostats. Correlations between the errors
        of two flights are neglected.
        """
        mean, covariance = self.shared({heliostat})
        parts = []
        rows_of = self._rows.get(heliostat, ())
        for k, (taken, rows) in enumerate(zip(self._taken, rows_of, strict=bool(rows_of))):
            if not len(rows):
                continue
            part, flight = slice(self._edges[k], self._edges[k + 1]), taken.flight
            sightings = _as_row(flight.sightings.take(rows), 0)
            away = flight.shift[rows] @ mean[part]
            sightings = replace(
                sightings,
                source=np.where(
                    sightings.source_at_infinity[:, None], sightings.source, sightings.source - away
                ),
                destination=np.where(
                    sightings.destination_at_infinity[:, None],
                    sightings.destination,
                    sightings.destination - away,
                ),
            )
            turn = float(flight.turn_sigma[flight.heliostats.index(heliostat)])
            parts.append(Flown(sightings, flight.shift[rows], covariance[part, part], turn))
        return tuple(parts)


def _as_row(sightings: Sightings, row: int) -> Sightings:
    return sightings.renumbered(np.full(len(sightings), row))
