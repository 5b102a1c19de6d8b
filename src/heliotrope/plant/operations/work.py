"""The work that goes on by itself: the field raised, calibrated target by target, stowed at night.

It commands as a person of its own, with the authority while no other person has it, and gives way
at once. A heliostat is only moved if it is *wanted*: what a person stows, defocuses or locks is
not, nor is anything after an emergency, until a person gives it back. A beam that was never
calibrated goes to the receiver only if it would miss every target by a wide margin.
"""

import asyncio
import functools
import math
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError, InputError
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.links.clock import sleep_until
from heliotrope.plant._beam_watch import BeamError
from heliotrope.plant.authority import Person, RefusedError, Role
from heliotrope.plant.controller import PlantController
from heliotrope.plant.operations.book import CalibrationBook
from heliotrope.plant.operations.keep import Keeper
from heliotrope.plant.operations.log import Logbook
from heliotrope.plant.operations.views import (
    CalibrationEntry,
    CalibrationView,
    CameraView,
    Hold,
    Planned,
    Running,
)
from heliotrope.plant.tickets import Ticket
from heliotrope.plant.visits.calibration_cycle import CycleResult
from heliotrope.plant.visits.centring import CentringCycle
from heliotrope.safety import alarms
from heliotrope.store.records import Records

#: Who it is.
AUTOMAT = Person("automat", Role.ENGINEER)
_UP = (states.APPROACHING, states.IDLE, states.TRACKING, states.SEARCHING, states.DEFOCUSED)
_READY = (states.IDLE, states.TRACKING)


#: Looks at the sun, s apart.
_SUN_EVERY = 30.0
#: Whose beam would enter a keep-out volume is tried again after this time, s.
_BLOCKED = 300.0


class Photographer(Protocol):
    """Has photographs of targets for people to look at."""

    def view(self, target: str) -> CameraView:
        """Return the last one."""
        ...


class Scheduling(Protocol):
    """Says which heliostat is calibrated next."""

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], book: CalibrationBook
    ) -> Planned | None:
        """Return the next of the ready heliostats (N,) for a free target, None if none is due."""
        ...

    def plan(
        self, ready: npt.NDArray[np.bool_], book: CalibrationBook, limit: int
    ) -> Sequence[Planned]:
        """Return what is to come."""
        ...

    def done(self, entry: CalibrationEntry) -> None:
        """Take what became of a measurement."""
        ...


@dataclass(frozen=True)
class WorkSettings:
    """Of the automatic work.

    Attributes
    ----------
    wanted
        Whether the whole field is wanted from the start; else what `give_back` names.
    calibrate
        Whether calibration is on at the start.
    rate
        Heliostats that leave stow, and that go to the receiver, in a second.
    beat
        Between looks at the field, s.
    lowest
        Sun below which the field is stowed, rad of elevation.
    again
        A calibrated heliostat is measured again if its predicted error is above this, rad.
    pause
        A heliostat is not measured again within this time, s.
    patience
        What was commanded is not commanded again within this time, s.
    margin
        Beams that were never calibrated must miss targets by so many standard deviations.
    events
        Events, and alarms that are over and acknowledged, are kept so long, days.
    """

    wanted: bool = False
    calibrate: bool = True
    rate: float = 10.0
    beat: float = 2.0
    lowest: float = math.radians(8.0)
    again: float = 4e-4
    pause: float = 1200.0
    patience: float = 60.0
    margin: float = 3.0
    events: float = 400.0

    def __post_init__(self) -> None:
        if not (0.0 < self.rate <= 100.0 and 0.0 < self.beat <= 60.0 and self.margin >= 0.0):
            raise InputError(
                f"work: {self.rate} heliostats a second, a beat of {self.beat} s, a margin of "
                f"{self.margin}; give above 0 to 100, above 0 to 60 s, 0 or more"
            )
        if not self.events > 0.0:
            raise InputError(f"work: events of {self.events} days are kept; give above 0")


class Automat:
    """The automatic work of a plant; see `operations.Operations` for the parameters.

    Attributes
    ----------
    book
        What is known of each heliostat's calibration.
    holds
        By heliostat.
    installed
        Tracking error that the priors allow a heliostat that was never calibrated, rad.
    """

    def __init__(
        self,
        plant: PlantController,
        logbook: Logbook,
        cycle: CentringCycle | None,
        *,
        scheduler: Scheduling | None,
        records: Records | None,
        truth: Callable[[], FloatArray] | None,
        settings: WorkSettings,
    ) -> None:
        self._plant, self._log, self._cycle = plant, logbook, cycle
        self._settings, self._truth = settings, truth
        count = len(plant.field)
        self.book = CalibrationBook(plant, "malan8" if cycle is None else cycle.model)
        self.installed = self.book.installed()
        self._keeper = Keeper(plant, records, self.book, cycle)
        self.holds: dict[str, Hold] = self._keeper.holds()
        self._scheduler: Scheduling = scheduler or LeastKnown(plant, settings)
        self._wanted = np.full(count, settings.wanted, dtype=np.bool_)
        self._busy_until = np.full(count, -math.inf)
        self._told_in = np.full(count, -1, dtype=np.int16)
        self._blocked: set[str] = set()
        self._joins: list[Ticket] = []  # whose turn has not come for all
        self._running: dict[str, Running] = {}
        self._on, self._day, self._gave_way_at = settings.calibrate, True, -math.inf
        self._true: tuple[float, FloatArray] | None = None
        self._token, self._sun_at, self._troubled = 0, -math.inf, False
        self._stopped = False
        if cycle is not None:
            cycle.on_stage = self._stage
        self._aims = plant.default_aims() if plant.design.receivers else {}
        self._clear = self._clear_of_targets()
        self._keeper.recall()

    # -- what people say -------------------------------------------------------------------

    @property
    def model(self) -> tuple[str, ...]:
        """Parameters that are fitted."""
        return self.book.model

    def switch(self, on: bool) -> None:
        """Switch calibration on or off."""
        self._on = on

    def want(self, heliostats: Sequence[str], *, wanted: bool) -> None:
        """Take heliostats into the automatic work, or out of it."""
        rows = [self._plant.field.place(name) for name in heliostats]
        self._wanted[rows] = wanted
        self._busy_until[rows] = -math.inf

    def hold(self, who: str, heliostats: Sequence[str], reason: str) -> None:
        """Keep heliostats out of calibration."""
        now = self._utc()
        for name in heliostats:
            self._plant.field.place(name)
        for name in heliostats:
            self.holds[name] = Hold(name, who, reason, now)
        self._keeper.hold(heliostats, reason, who, now)

    def unhold(self, who: str, heliostats: Sequence[str]) -> None:
        """Give heliostats back to calibration."""
        for name in heliostats:
            self._plant.field.place(name)
            self.holds.pop(name, None)
        self._keeper.unhold(heliostats, who, self._utc())

    def stop(self) -> None:
        """Begin nothing any more; to be called before `run` is cancelled."""
        self._stopped = True

    async def halt(self, limit: float = 5.0) -> None:
        """Want nothing any more, and wait until what goes on is given up, ``limit`` s at most."""
        self._wanted[:] = self._on = False
        self.give_way()
        until = self._plant.now() + limit
        while self._running and self._plant.now() < until:
            await self._sleep(0.5)

    def give_way(self) -> None:
        """Give the authority to a person; what goes on is given up, its beams taken away."""
        self._gave_way_at = self._plant.now()
        if self._has_authority():
            self._plant.release_authority(AUTOMAT, self._token)

    # -- what is shown ---------------------------------------------------------------------

    def held_rows(self) -> npt.NDArray[np.bool_]:
        """Return which heliostats are held, (N,)."""
        held = np.zeros(len(self._plant.field), dtype=np.bool_)
        held[[self._plant.field.place(name) for name in self.holds]] = True
        return held

    def truth_errors(self) -> FloatArray | None:
        """Return tracking errors that a twin knows, rad, (N,), made every five seconds."""
        if self._truth is None:
            return None
        now = self._plant.now()
        if self._true is None or now - self._true[0] >= 5.0:
            self._true = now, self._truth()
        return self._true[1]

    def view(self) -> CalibrationView:
        """Return how far calibration has come."""
        reason = self._why_not()
        return CalibrationView(
            not reason,
            reason,
            self.book.calibrated,
            len(self._plant.field) - self.book.calibrated,
            self.book.failed,
            tuple(self._running.values()),
            tuple(list(self.book.results)[:-51:-1]),
            tuple(self.book.quality),
        )

    def plan(self, limit: int) -> tuple[Planned, ...]:
        """Return the next measurements."""
        return tuple(self._scheduler.plan(self._ready(), self.book, limit))

    # -- running ---------------------------------------------------------------------------

    async def run(self) -> None:
        """Work until cancelled."""
        async with asyncio.TaskGroup() as group:
            for part in (self._govern, self._raise, self._look):
                group.create_task(self._again(part, self._settings.beat))
            if self._cycle is not None:
                for target in self._plant.design.targets:
                    group.create_task(self._again(self._visits(target.name), 1.0))

    async def _again(self, part: Callable[[], Awaitable[None]], pause: float) -> None:
        """Do a part of the work again and again; a failure is told, and ends nothing."""
        failed, name = False, getattr(part, "__name__", "").strip("_")
        # A visit that is cancelled brings its beam home, and may end with another error then.
        while not self._stopped:
            try:
                await part()
                if failed:
                    self._log.take_alarm(alarms.WORK.ended(name))
                failed = False
            except RefusedError as error:
                self._log.event("calibration", AUTOMAT.name, str(error))
            except Exception as error:  # noqa: BLE001 - the work survives whatever fails in a part
                failed, text = True, f"{type(error).__name__}: {error}"
                self._log.take_alarm(alarms.WORK.raised(name, error=text))
                await self._sleep(5.0)
            await self._sleep(pause)

    async def _sleep(self, seconds: float) -> None:
        await sleep_until(self._plant.clock, self._plant.now() + seconds)

    def _utc(self) -> float:
        return self._plant.clock.utc().timestamp()

    # -- authority and day -----------------------------------------------------------------

    def _has_authority(self) -> bool:
        grant = self._plant.authority.grant
        return grant is not None and grant.holder == AUTOMAT and grant.token == self._token

    def _why_not(self) -> str:
        """Return why nothing is calibrated now, "" if it is."""
        if self._cycle is None:
            return "there is no camera"
        if not self._on:
            return "it is switched off"
        return self._why_idle()

    def _why_idle(self) -> str:
        """Return why nothing is moved now, "" if it may be."""
        if self._plant.emergency_on:
            return "an emergency holds"
        if not self._day:
            return "the sun is too low"
        if not self._has_authority():
            grant = self._plant.authority.grant
            return f"{grant.holder.name} has the authority" if grant else "it waits to begin"
        return ""

    async def _govern(self) -> None:
        """Hold the authority while nobody wants it; see to emergencies and to the night."""
        plant = self._plant
        if plant.emergency_on:
            self._wanted[:] = False
        grant, since = plant.authority.grant, plant.now() - self._gave_way_at
        if self._has_authority():
            plant.authority.keep(AUTOMAT, self._token)
        elif grant is None and since > 5.0 and (self._wanted.any() or self._on):
            self._token = plant.take_authority(AUTOMAT).token
        await self._night()

    async def _night(self) -> None:
        """Stow what is wanted before the sun is low."""
        now = self._plant.now()
        if now - self._sun_at < _SUN_EVERY:
            return
        self._sun_at = now
        elevation = math.asin(float(np.clip(self._plant.sun_vector()[2], -1.0, 1.0)))
        lowest = self._settings.lowest
        if self._day and elevation < lowest:
            self._day = False
            up = self._plant.field.among(_UP, self._plant.now()) & self._wanted
            if up.any():
                self._plant.stow(AUTOMAT.name, self._names(np.flatnonzero(up)))
            self._log.event("plant", AUTOMAT.name, f"the sun is low: {int(up.sum())} to stow")
        elif not self._day and elevation > lowest + math.radians(1.0):
            self._day = True
            self._log.event("plant", AUTOMAT.name, "the sun is high enough")

    # -- raising ---------------------------------------------------------------------------

    def _clear_of_targets(self) -> npt.NDArray[np.bool_]:
        """Return whose beams miss all targets on the receiver although uncalibrated, (N,)."""
        plant, aims = self._plant, self._aims
        if not aims:
            return np.zeros(len(plant.field), dtype=np.bool_)
        points = np.stack([aims[name] for name in plant.field.names])
        slant = np.linalg.norm(points - plant.beams.armature.origin_1, axis=-1)
        room = np.full(len(points), math.inf)
        for target in plant.design.targets:
            middle = np.asarray(target.corners).mean(axis=0)
            reach = 0.5 * math.hypot(target.width, target.height)
            room = np.minimum(room, np.linalg.norm(points - middle, axis=-1) - reach)
        # The beam is off by twice what the normal is; its error is of two dimensions.
        return np.asarray(self._settings.margin * math.sqrt(2.0) * self.installed * slant < room)

    async def _raise(self) -> None:
        """Bring wanted heliostats from stow to standby and to the receiver, some at a time."""
        if self._why_idle():
            return
        plant, now = self._plant, self._plant.now()
        self._look_at_blocked()
        most = max(1, round(self._settings.rate * self._settings.beat))
        busy = (self._busy_until >= now) & (self._told_in == plant.field.rows["state"])
        free = self._wanted & ~busy
        free[[plant.field.place(run.heliostat) for run in self._running.values()]] = False
        for state, name in ((states.STOWED, "APPROACH"), (states.DEFOCUSED, "IDLE")):
            rows = np.flatnonzero(free & plant.field.among((state,), now))[:most]
            if len(rows):
                give = functools.partial(plant.command, AUTOMAT, self._token, name)
                self._give(rows, state, give)
        able = free & (self._clear | np.isfinite(self.book.calibrated_at))
        rows = np.flatnonzero(able & plant.field.among((states.IDLE,), now))[:most]
        if len(rows) and self._aims and plant.waiting < most:
            await self._join(rows)

    async def _join(self, rows: npt.NDArray[np.intp]) -> None:
        """Give heliostats their aims on the receiver, and send them there."""
        plant, aims = self._plant, self._aims
        given = self._give(
            rows,
            states.IDLE,
            lambda names: plant.aim(AUTOMAT, self._token, {n: aims[n] for n in names}),
        )
        if given is None:
            return
        names, ticket = given
        await ticket.end(10.0)
        done = tuple(name for name in names if name not in ticket.refusals)
        # A visit may have begun meanwhile: its aim must not be undone.
        visited = {run.heliostat for run in self._running.values()}
        done = tuple(name for name in done if name not in visited)
        if done:
            self._joins.append(plant.command(AUTOMAT, self._token, "TRACK", done))

    def _give(
        self, rows: npt.NDArray[np.intp], state: int, give: Callable[[tuple[str, ...]], Ticket]
    ) -> tuple[tuple[str, ...], Ticket] | None:
        """Give a command to those whose beams may do it; the others wait, and are named."""
        names = self._names(rows)
        while names:
            try:
                ticket = give(names)
            except BeamError as error:
                refusals = error.refusals
            else:
                self._note_told(np.array([self._plant.field.place(n) for n in names]), state)
                self._block(ticket.blocked, state)
                return names, ticket
            self._block(refusals, state)
            names = tuple(name for name in names if name not in refusals)
        return None

    def _block(self, refusals: Mapping[str, str], state: int) -> None:
        """Leave heliostats where they are until the sun has moved on."""
        for name, text in refusals.items():
            row = self._plant.field.place(name)
            self._busy_until[row], self._told_in[row] = self._plant.now() + _BLOCKED, state
            self._blocked.add(name)
            self._log.take_alarm(alarms.BEAM_BLOCKED.raised(name, reason=text))

    def _look_at_blocked(self) -> None:
        """Name who was refused when its turn to join came; who is elsewhere now is not any more."""
        for ticket in [ticket for ticket in self._joins if ticket.finished]:
            self._joins.remove(ticket)
            self._block(ticket.blocked, states.IDLE)
        for name in sorted(self._blocked):
            row = self._plant.field.place(name)
            if self._plant.field.rows["state"][row] != self._told_in[row]:
                self._blocked.remove(name)
                self._log.take_alarm(alarms.BEAM_BLOCKED.ended(name))

    def _note_told(self, rows: npt.NDArray[np.intp], state: int) -> None:
        """Note who was commanded in which state: not again before something has come of it."""
        self._busy_until[rows] = self._plant.now() + self._settings.patience
        self._told_in[rows] = state

    def _names(self, rows: npt.NDArray[np.intp]) -> tuple[str, ...]:
        return tuple(self._plant.field.names[row] for row in rows)

    # -- looking ---------------------------------------------------------------------------

    async def _look(self) -> None:
        """Predict errors anew, and note how good the field is."""
        self.book.refresh()
        self.book.point(self._utc(), self.truth_errors())
        self._keeper.forget(self._utc(), self._settings.events)
        problem = self._keeper.problem
        if problem or self._troubled:
            kind = alarms.RECORDS
            self._log.take_alarm(kind.raised(problem=problem) if problem else kind.ended())
        self._troubled = bool(problem)
        await self._sleep(10.0)

    # -- calibration -----------------------------------------------------------------------

    def _ready(self) -> npt.NDArray[np.bool_]:
        """Return who may be measured now, (N,)."""
        ready = self._plant.field.among(_READY, self._plant.now()) & self._wanted
        ready &= ~self.held_rows()
        ready[[self._plant.field.place(run.heliostat) for run in self._running.values()]] = False
        return ready

    def _stage(self, heliostat: str, target: str, stage: str) -> None:
        known = self._running.get(target)
        since = known.since if known is not None else self._utc()
        self._running[target] = Running(heliostat, target, stage, since)

    def _visits(self, target: str) -> Callable[[], Awaitable[None]]:
        async def visit() -> None:
            if self._why_not():
                return
            chosen = self._scheduler.next(target, self._ready(), self.book)
            if chosen is not None:
                await self._visit(chosen)

        visit.__name__ = f"target {target}"
        return visit

    async def _visit(self, chosen: Planned) -> None:
        assert self._cycle is not None
        name, target = chosen.heliostat, chosen.target
        row = self._plant.field.place(name)
        self._stage(name, target, "on the way")
        truth, old = self._true_error(row), self._cycle.mechanism(name)[1]
        begun, text, result = self._utc(), "", None
        try:
            result = await self._cycle.run(AUTOMAT, self._token, name, target)
        except RefusedError as error:
            text = str(error)
        except HeliotropeError as error:
            text = f"{type(error).__name__}: {error}"
        finally:
            self._running.pop(target, None)
        self._busy_until[row] = -math.inf
        self._conclude(chosen, begun, truth, old, result, text)

    def _true_error(self, row: int) -> float:
        self._true = None
        found = self.truth_errors()
        return math.nan if found is None else float(found[row])

    def _conclude(
        self,
        chosen: Planned,
        begun: float,
        truth: float,
        old: Any,
        result: CycleResult | None,
        text: str,
    ) -> None:
        """Note what a visit brought."""
        assert self._cycle is not None
        name, now = chosen.heliostat, self._utc()
        row = self._plant.field.place(name)
        good = result is not None and result.text.startswith("calibrated")
        sigma = float(self.book.error[row])
        if result is not None:
            text = "; ".join((result.text, *result.rejected[:2]))
            if result.sightings is not None:
                self.book.note(name, chosen.target, result.sightings, old)
            if good and result.sightings is not None:
                new = self._cycle.mechanism(name)[1]
                self.book.learn(name, result.values, new, result.sightings, now)
        self.book.failed += not good
        entry = CalibrationEntry(
            now,
            name,
            chosen.target,
            good,
            result.before if result else math.nan,
            result.after if result else math.nan,
            float(self.book.error[row]),
            truth,
            self._true_error(row) if good else math.nan,
            int(self.book.sightings[row]),
            text,
        )
        self.book.results.append(entry)
        self._scheduler.done(entry)
        self._log.event("calibration", name, f"at {chosen.target}: {text}")
        self._keeper.keep(entry, begun, sigma, result)


class LeastKnown:
    """The plain schedule: who was seen on another target only, who was never, then the worst.

    Parameters
    ----------
    plant
        Whose heliostats.
    settings
        When one is due again.
    """

    def __init__(self, plant: PlantController, settings: WorkSettings) -> None:
        self._plant, self._settings = plant, settings
        count = len(plant.field)
        self._tried = np.full(count, -math.inf)
        self._seen = {t.name: np.zeros(count, dtype=np.bool_) for t in plant.design.targets}
        place = np.asarray(plant.beams.armature.origin_1)
        targets = plant.design.targets
        self._slant = {t.name: np.linalg.norm(place - t.center, axis=-1) for t in targets}

    def _order(
        self, target: str, ready: npt.NDArray[np.bool_], book: CalibrationBook
    ) -> npt.NDArray[np.intp]:
        now, seen = self._plant.clock.utc().timestamp(), self._seen[target]
        known = np.isfinite(book.error)
        recent = now - np.where(known, book.calibrated_at, -math.inf) < self._settings.pause
        # A second target tells at once what the first could not.
        due = ready & ~(recent & seen) & ~(book.error <= self._settings.again)
        rows = np.flatnonzero(due & (now - self._tried >= self._settings.pause))
        rank = np.where(~known, 1, np.where(seen, 2, 0))[rows]
        worst = np.where(known, -book.error, 0.0)[rows]
        return rows[np.lexsort((self._slant[target][rows], worst, rank))]

    def next(
        self, target: str, ready: npt.NDArray[np.bool_], book: CalibrationBook
    ) -> Planned | None:
        """Return the first of `plan` for a target."""
        rows = self._order(target, ready, book)
        return self._planned(int(rows[0]), target, 0, book) if len(rows) else None

    def plan(
        self, ready: npt.NDArray[np.bool_], book: CalibrationBook, limit: int
    ) -> Sequence[Planned]:
        """Return what is to come, each target in turn."""
        targets = tuple(self._slant)
        found: list[Planned] = []
        if targets:
            rows = self._order(targets[0], ready, book)[:limit]
            for k, row in enumerate(rows):
                found.append(self._planned(int(row), targets[k % len(targets)], k, book))
        return found

    def _planned(self, row: int, target: str, place: int, book: CalibrationBook) -> Planned:
        new = not math.isfinite(book.error[row])
        at = self._plant.clock.utc().timestamp() + 60.0 * (place // max(len(self._slant), 1))
        return Planned(
            self._plant.field.names[row],
            target,
            at,
            math.nan if new else float(book.error[row]),
            "never calibrated" if new else "its predicted error has grown",
        )

    def done(self, entry: CalibrationEntry) -> None:
        """Leave a heliostat alone for a while whose measurement failed."""
        row = self._plant.field.place(entry.heliostat)
        if entry.good:
            self._seen[entry.target][row] = True
        else:
            self._tried[row] = entry.at
