"""Import of drone flights: all heliostats fitted together, new parameters applied safely.

A flight never moves a beam. A small change is applied while the heliostat is at stow or locked,
because then its local controller may be written to. A large change, and a first calibration, wait
for a visit to a target, which fits the records of the flight together with its photographs and
verifies the result by one more photograph. Until then a heliostat that the flight found far from
its expected pose stays off the receiver.
"""

import asyncio
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import Enum

import numpy as np

from heliotrope.calibration.flights import Flight, FlightDocument
from heliotrope.calibration.record import Provenance
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.flights import Flights, TakenFlight
from heliotrope.plant.operations.keeping import Keeping
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.views import FlightView
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.orders.parameters import TAKES_POSE
from heliotrope.plant.visits.fitting import (
    WRONG,
    JudgedFit,
    change_of,
    fit_flights,
    follow_flights,
)
from heliotrope.plant.visits.settings import CycleSettings
from heliotrope.store.records import FlightEntry

#: Largest permissible fraction of a flight's heliostats whose fits are wrong.
_MOST_WRONG = 0.5
#: A photograph may be this much later than the plant's time, s.
_LATE = 300.0
_LINES = 10


class _Way(Enum):
    """How the fit of a heliostat from a flight is handled."""

    IN_USE = "in use"
    AT_STOW = "at stow"
    AT_TARGET = "at a target"
    UNCHANGED = "unchanged"


@dataclass(frozen=True)
class _Waiting:
    """A heliostat with the fit from a flight, and the version with which the fit was compared.

    ``astray``: the flight observed the heliostat far from where its parameters place it.
    """

    way: _Way
    fit: JudgedFit
    version: int
    astray: bool = False


class FlightIntake:
    """Imports flights into the beliefs of a plant.

    Parameters
    ----------
    plant, log, keeping
        The controller, the logbook for events, and the store of results.
    settings
        Model and limits of fits.
    """

    def __init__(
        self, plant: PlantController, log: Logbook, keeping: Keeping, settings: CycleSettings
    ) -> None:
        self._plant, self._log, self._keeping = plant, log, keeping
        self._settings = settings
        self._waiting: dict[str, _Waiting] = {}
        self._busy = ""

    # -- taking ----------------------------------------------------------------------------

    async def take(self, person: Person, document: FlightDocument, text: str) -> FlightView:
        """Import a flight; the fits are made in a thread.

        Parameters
        ----------
        person
            An engineer.
        document, text
            The flight, and the text of its file for the store.

        Raises
        ------
        RefusedError
            If the role is too low, the flight was imported before, or it contradicts the field.
        InputError, UnknownNameError
            If the flight does not belong to this plant.
        StoreError
            If it cannot be stored.
        """
        flight = self._checked(person, document)
        self._busy = flight.name
        try:
            taken = TakenFlight(
                flight, np.zeros(len(flight.sightings), np.int64), self._utc(), person.name
            )
            flights = self._plant.beliefs.flights.adding(taken)
            fits = await asyncio.to_thread(self._fitted, flights, flight)
        finally:
            self._busy = ""
        return self._conclude(taken, flights, fits, text)

    def take_now(self, person: Person, document: FlightDocument, text: str) -> FlightView:
        """Import a flight as `take` does, but within the caller's thread."""
        flight = self._checked(person, document)
        taken = TakenFlight(
            flight, np.zeros(len(flight.sightings), np.int64), self._utc(), person.name
        )
        flights = self._plant.beliefs.flights.adding(taken)
        return self._conclude(taken, flights, self._fitted(flights, flight), text)

    def _checked(self, person: Person, document: FlightDocument) -> Flight:
        """Return a flight that this plant can import."""
        person.must_be(Role.ENGINEER, "flight")
        flight, beliefs = Flight.of(document), self._plant.beliefs
        for item in beliefs.flights:
            if item.flight.name == flight.name:
                raise refusals.FLIGHT_KNOWN.error(
                    name=flight.name, person=item.person, at=_day(item.at)
                )
        if self._busy:
            raise refusals.FLIGHT_BUSY.error(name=flight.name, other=self._busy)
        for name in flight.heliostats:
            if name not in self._plant.field.index:
                raise UnknownNameError("heliostat", name, self._plant.field.names)
            group, _ = beliefs.design.find(name)
            drives = len(group.mechanism.driven)
            if drives != flight.sightings.counts.shape[1]:
                raise InputError(
                    f"flight {flight.name}: each record has {flight.sightings.counts.shape[1]} "
                    f"step counts, but {name} has {drives} drives"
                )
        latest = float(flight.sightings.time.max())
        if latest > self._utc() + _LATE:
            raise InputError(
                f"flight {flight.name}: a photograph is dated {_day(latest)}, but it is now "
                f"{_day(self._utc())}; set the drone's clock"
            )
        return flight

    def _fitted(self, flights: Flights, flight: Flight) -> dict[str, JudgedFit]:
        beliefs, settings = self._plant.beliefs, self._settings
        joint = fit_flights(beliefs, flights, settings, flight.heliostats)
        return follow_flights(beliefs, flights, settings, joint)

    def _conclude(
        self, taken: TakenFlight, flights: Flights, fits: Mapping[str, JudgedFit], text: str
    ) -> FlightView:
        """Adopt a flight that does not contradict the field; decide what its heliostats do."""
        flight, wrong = taken.flight, [n for n, f in fits.items() if f.outcome in WRONG]
        if len(wrong) > _MOST_WRONG * len(fits):
            first = f"{wrong[0]}: {fits[wrong[0]].problem}"
            raise refusals.FLIGHT_CONTRADICTS.error(
                name=flight.name, wrong=len(wrong), all=len(fits), first=first
            )
        entry = FlightEntry(flight.name, taken.at, taken.person, text)
        numbers = self._keeping.keep_flight(flight, entry)
        flights.number(flight.name, numbers)
        flights.leave_out(wrong)
        self._plant.beliefs.flights = flights
        named = {name: replace(fit, flown=flights.identities(name)) for name, fit in fits.items()}
        self._waiting.update({name: self._sorted(fit) for name, fit in named.items()})
        self.look()
        view = next(v for v in self.views() if v.name == flight.name)
        self._log.event(
            "calibration",
            taken.person,
            f"flight {flight.name}: {view.orientations} orientations of {view.heliostats} "
            f"heliostats; new parameters for {view.in_use} now, {view.at_stow} at stow, "
            f"{view.at_target} after a photograph; {view.unchanged} unchanged",
        )
        self._plant.note(
            Person(taken.person, Role.ENGINEER), "FLIGHT", f"{flight.name}: {view.heliostats}"
        )
        return view

    def _sorted(self, fit: JudgedFit) -> _Waiting:
        beliefs = self._plant.beliefs
        record = beliefs.record(fit.name)
        version = 0 if record is None else record.version
        if fit.problem:
            return _Waiting(_Way.UNCHANGED, fit, version)
        change = change_of(beliefs.present(fit.name), fit.mechanism, fit.sightings)
        large = change > self._settings.large
        # A calibration visit fits each heliostat with its own model, which may have more
        # parameters.
        other = record is None or set(record.names) != set(fit.fitted.names)
        way = _Way.AT_TARGET if large or other else _Way.AT_STOW
        return _Waiting(way, fit, version, large and record is not None)

    # -- afterwards ------------------------------------------------------------------------

    def recall(self) -> None:
        """Repeat the fits of flights from before a restart; fits that were waiting wait again."""
        beliefs, fits = self._plant.beliefs, dict[str, JudgedFit]()
        known, beliefs.flights = tuple(beliefs.flights), Flights()
        for taken in known:
            flights = beliefs.flights.adding(taken)
            result = fit_flights(beliefs, flights, self._settings, taken.flight.heliostats)
            flights.leave_out([n for n, fit in result.items() if fit.outcome in WRONG])
            beliefs.flights = flights
            fits.update(result)
        done = set()
        for name in fits:
            record = beliefs.record(name)
            last = max(f.at for f in known if name in f.flight.heliostats)
            if record is not None and record.at >= last:
                done.add(name)
        # Only waiting fits are repeated; with many flights the start would take minutes otherwise.
        rest = {name: fit for name, fit in fits.items() if name not in done}
        fits |= follow_flights(beliefs, beliefs.flights, self._settings, rest)
        for name, fit in fits.items():
            waiting = self._sorted(fit)
            self._waiting[name] = replace(waiting, way=_Way.IN_USE) if name in done else waiting
        self.look()

    def look(self) -> None:
        """Adopt the waiting fits of heliostats whose parameters may now be written."""
        field, beliefs = self._plant.field, self._plant.beliefs
        resting = field.among(TAKES_POSE, self._plant.now())
        for name, waiting in list(self._waiting.items()):
            if waiting.way not in (_Way.AT_STOW, _Way.AT_TARGET):
                continue
            record = beliefs.record(name)
            if record is not None and record.version > waiting.version:
                # A calibration visit has fitted the flight's records together with its photographs.
                self._waiting[name] = replace(waiting, way=_Way.IN_USE)
            elif waiting.way is _Way.AT_STOW and resting[field.place(name)]:
                self._waiting[name] = replace(waiting, way=_Way.IN_USE)
                last = [f for f in beliefs.flights if name in f.flight.heliostats][-1]
                beliefs.take(
                    waiting.fit.record(
                        beliefs,
                        self._utc(),
                        person=last.person,
                        provenance=Provenance.DRONE,
                        campaign=last.flight.name,
                    )
                )

        self._plant.doubtful.keep_off(
            name
            for name, waiting in self._waiting.items()
            if waiting.way is _Way.AT_TARGET and waiting.astray
        )

    def first(self) -> frozenset[str]:
        """Return the heliostats whose large change waits for a photograph."""
        return frozenset(n for n, w in self._waiting.items() if w.way is _Way.AT_TARGET)

    def views(self) -> tuple[FlightView, ...]:
        """Return the flights, the last imported first."""
        flights = self._plant.beliefs.flights
        return tuple(self._view(k, item) for k, item in enumerate(flights))[::-1]

    def _view(self, number: int, taken: TakenFlight) -> FlightView:
        flight = taken.flight
        mine = {n: self._waiting[n] for n in flight.heliostats if n in self._waiting}
        ways = Counter(w.way for w in mine.values())
        mean, covariance = self._plant.beliefs.flights.of_flight(number)
        sigma = np.sqrt(np.diagonal(covariance))
        rejected = [
            f"{name}: {w.fit.problem}" for name, w in mine.items() if w.way is _Way.UNCHANGED
        ]
        return FlightView(
            flight.name,
            taken.at,
            taken.person,
            len(flight.sightings),
            len(flight.heliostats),
            ways[_Way.IN_USE],
            ways[_Way.AT_STOW],
            ways[_Way.AT_TARGET],
            ways[_Way.UNCHANGED],
            tuple(
                (word, float(m), float(s))
                for word, m, s in zip(flight.shared, mean, sigma, strict=True)
            ),
            tuple(rejected[:_LINES]),
        )

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()


def _day(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M UTC")
