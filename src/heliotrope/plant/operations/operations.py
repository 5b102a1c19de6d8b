"""The running plant: the single object that a console, an API and the command line talk to.

It executes operator commands, and runs automatic control, which raises the field and calibrates it
with the camera of every target. A failure in one part of automatic control becomes an event or an
alarm, and the rest continues. Its parts are accessed by name: `viewer` for the field and a
heliostat as plain values, `logbook` for alarms, events and packets, `automatic` for calibration,
plan and timetable.

Operator commands pass through here so that automatic control knows what operators want: a heliostat
that an operator has stowed, defocused or locked stays so until an operator gives it back. If a
heliostat is lost after an operator has raised it, automatic control does not raise it again.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy.typing as npt

from heliotrope import sun
from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.field.target import Target
from heliotrope.lcu import messages
from heliotrope.links.clock import sleep_until
from heliotrope.plant import refusals
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import ORDERED, EmergencyOrder
from heliotrope.plant.field.lockouts import TOWER
from heliotrope.plant.operations.aiming import Aiming, AimsView
from heliotrope.plant.operations.approvals import Approvals
from heliotrope.plant.operations.automatic import AUTOMATIC, AutomaticControl
from heliotrope.plant.operations.errands import Errands
from heliotrope.plant.operations.explaining import explain
from heliotrope.plant.operations.flux_check import EVERY as COMPARED
from heliotrope.plant.operations.flux_check import FluxCheck
from heliotrope.plant.operations.history import History, figures
from heliotrope.plant.operations.logbook import MOST_NAMED, Logbook
from heliotrope.plant.operations.marking import Marking
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.operations.plant_file import PlantFile
from heliotrope.plant.operations.predicted_flux import PredictedFlux
from heliotrope.plant.operations.report import ShiftReport, period, report
from heliotrope.plant.operations.security import SecurityLog
from heliotrope.plant.operations.trends import Quantity, Trend, quantities, trend
from heliotrope.plant.operations.typed_parameters import TypedParameters
from heliotrope.plant.operations.viewing import Viewer
from heliotrope.plant.operations.views import (
    CameraView,
    Explanation,
    PredictedView,
    Summary,
    SunView,
)
from heliotrope.plant.orders.authority import Grant, Person, Role
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.workers import Worker, at_once
from heliotrope.safety import Act
from heliotrope.store.records import NOTE, JournalEntry, JournalQuery, Kind, Records
from heliotrope.values import amount

T = TypeVar("T")

#: Commands that take heliostats from automatic control, and that give them to it.
_TAKES_FROM_AUTOMATIC = messages.having("manual")
_GIVES_TO_AUTOMATIC = messages.having("automatic")

_DAY = 86_400.0
#: Interval between checks of the security events, s.
_LOOKED = 5.0
#: Interval between checks of operations in progress, s.
_FOLLOWED = 1.0
#: Time limits of a calibration requested by an operator, and of the path to stow, s.
_ASKED, _PARKED = 3600.0, 600.0
#: Row of the summary with the reason why the last link was refused.
REFUSED_LINK = "refused link"


class Photographer(Protocol):
    """A source of target photographs for display."""

    def view(self, target: str) -> CameraView:
        """Return the latest photograph."""
        ...

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return the light in a new photograph."""
        ...


@dataclass(frozen=True)
class Photography:
    """How a plant takes, stores and displays photographs.

    Attributes
    ----------
    cameras
        Latest photographs of the targets for display, by target name.
    pictures
        Stores photographs with their results; None: they are not stored.
    marking
        Takes views that users mark; None: there is no camera.
    """

    cameras: Mapping[str, Photographer] = field(default_factory=dict)
    pictures: Pictures | None = None
    marking: Marking | None = None


class Operations:
    """A running plant.

    Parameters
    ----------
    plant
        The controller; its ``on_alarm`` is ``logbook.take_alarm`` and its links are
        ``logbook.tapped(links)``. The owner runs it.
    logbook
        Alarms, events and packets.
    automatic
        Automatic control of the plant.
    photography
        Cameras, stored photographs, and the marking of views.
    records
        Store of everything that survives a restart; None: nothing is stored.
    extra
        Function that returns additional rows for the summary, such as the speed of a twin.
    worker
        Where computations run; see `Worker`.
    file
        The plant file; None: the plant has no file of its own.

    Attributes
    ----------
    plant, logbook, automatic, viewer, security, pictures, parameters, approvals, marking,
    flux_check, plant_file
        The parts of the plant; see their classes. Callers access them directly.
    telemetry
        Folder of the telemetry; None: no telemetry is archived.
    begun
        Event that is set once the plant is running.
    """

    def __init__(
        self,
        plant: PlantController,
        logbook: Logbook,
        automatic: AutomaticControl,
        *,
        photography: Photography = Photography(),
        records: Records | None = None,
        extra: Callable[[], Mapping[str, Any]] | None = None,
        worker: Worker = at_once,
        file: Path | None = None,
    ) -> None:
        self.plant, self.logbook, self.automatic, self._extra = plant, logbook, automatic, extra
        self.pictures, self.marking = photography.pictures, photography.marking
        self._cameras = photography.cameras
        self.errands = Errands(plant.clock)
        self.security = SecurityLog(logbook, plant.clock)
        self.viewer = Viewer(plant, self.automatic)
        self.parameters = TypedParameters(plant, logbook, records)
        self.approvals = Approvals(plant, logbook, self.parameters, self.errands, records)
        self.plant_file = PlantFile(
            file, plant, logbook, self.marking, self._visited, worker, records
        )
        self.telemetry: Path | None = None
        self._history = History(plant, records, self._figures)
        self._records = records
        self._flux = PredictedFlux(plant, self.viewer, automatic.book, automatic.installed, worker)
        self.flux_check = FluxCheck(plant, self._flux, logbook)
        self._aiming = Aiming(plant, logbook, automatic, self.flux_check, worker, records)
        self._closing, self.begun = asyncio.Event(), asyncio.Event()

    # -- running ---------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until closed; the owner runs the plant controller itself."""
        self.logbook.event("plant", "", f"{self.plant.design.name}: operations begin")
        self.approvals.recall()
        self.plant_file.recall()
        self._aiming.recall()
        self.begun.set()
        async with contextlib.aclosing(self._flux), asyncio.TaskGroup() as group:
            work = group.create_task(self.automatic.run())
            parts = self._look, self._follow, self._compare, self._history.run, self._aiming.run
            beside = [group.create_task(part()) for part in parts]
            await self._closing.wait()
            self.automatic.stop()
            work.cancel()
            for task in beside:
                task.cancel()
        self.errands.end("the plant's program has ended")
        self.security.close()
        self.logbook.event("plant", "", f"{self.plant.design.name}: operations end")

    async def _look(self) -> None:
        """Check the security events."""
        while True:
            facts = {} if self._extra is None else self._extra()
            self.security.look(str(facts.get(REFUSED_LINK, "")))
            await asyncio.sleep(_LOOKED)

    async def _compare(self) -> None:
        """Compare the flux on the receiver with the predicted flux."""
        while True:
            # The worker process may have ended, in which case another one is started.
            with contextlib.suppress(HeliotropeError):
                await self.flux_check.look()
            await sleep_until(self.plant.clock, self.plant.now() + COMPARED)

    async def _follow(self) -> None:
        """Track the operators' operations until they end."""
        while True:
            self.approvals.step()
            self.plant_file.step()
            self.errands.look()
            await sleep_until(self.plant.clock, self.plant.now() + _FOLLOWED)

    async def close(self) -> None:
        """Stop automatic control; beams stay where they are, so stow the field first."""
        self._closing.set()

    def _visited(self) -> dict[str, str]:
        """Return the heliostat of the visit on each target in use."""
        return {visit.target: visit.heliostat for visit in self.automatic.view().running}

    # -- the field -------------------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """The N heliostats, in the order of all arrays."""
        return self.plant.field.names

    @property
    def targets(self) -> tuple[str, ...]:
        """Names of the calibration targets."""
        return tuple(target.name for target in self.plant.design.targets)

    @property
    def receivers(self) -> tuple[str, ...]:
        """Names of the receivers."""
        return tuple(receiver.name for receiver in self.plant.design.receivers)

    @property
    def simulated(self) -> bool:
        """Whether the field is a twin, whose true errors are known."""
        return self.automatic.truth.known

    def summary(self) -> Summary:
        """Return the state of the whole plant."""
        now, grant = self.plant.now(), self.plant.authority.grant
        field = self.plant.field
        alive = sum(now - at <= field.limit for at in field.status_at.values())
        extra = dict(self._extra()) if self._extra is not None else {}
        return Summary(
            self.plant.design.name,
            self.plant.clock.utc(),
            len(field),
            len(field.clusters),
            field.counted(now),
            alive,
            grant.holder.name if grant else "",
            grant.holder.role.name.lower() if grant else "",
            self.plant.waiting,
            self.logbook.open_alarms,
            self.plant.sentinel.on,
            self.automatic.to_resume,
            float(extra.pop("pace", 1.0)),
            self.plant.sentinel.table.shown(now),
            extra,
        )

    def why(self, heliostat: str) -> Explanation:
        """Explain why a heliostat tracks or not; see `Explanation`.

        Raises
        ------
        UnknownNameError
            If there is no such heliostat.
        """
        on = self.viewer.aim_names[int(self.viewer.frame().on[self.plant.field.place(heliostat)])]
        by_hand = self._aiming.by_hand(heliostat)
        return explain(self.plant, self.automatic, self.logbook, heliostat, on, by_hand=by_hand)

    async def journal(self, query: JournalQuery) -> list[JournalEntry]:
        """Return the events, alarms and commands of all days, the latest first.

        Raises
        ------
        InputError
            If the plant keeps no records.
        """
        return await self._read("journal", lambda records: records.journal(query))

    async def report(self, since: float, until: float) -> ShiftReport:
        """Return the report for a time span; see `report.period`.

        Raises
        ------
        InputError
            If the plant keeps no records, or the time span is invalid.
        """
        name, now = self.plant.design.name, self.plant.clock.utc().timestamp()
        first, last = period(since, until, now)
        return await self._read(
            "report",
            lambda records: report(name, records, first, last, now, AUTOMATIC.name),
        )

    async def quantities(self) -> tuple[Quantity, ...]:
        """Return the quantities that have trends.

        Raises
        ------
        InputError
            If the plant keeps no records.
        """
        now = self.plant.clock.utc().timestamp()
        return await self._read("trends", lambda records: quantities(records, now))

    async def trend(
        self, quantity: str, heliostat: str, since: float, until: float, points: int
    ) -> Trend:
        """Return a quantity of the plant or of a heliostat over time; see `trends.trend`.

        The time span ends now if no end is specified, and begins one day before its end if no start
        is specified.
        """
        if heliostat:
            self.plant.field.place(heliostat)
        until = until or self.plant.clock.utc().timestamp()
        since = since or until - _DAY
        return await self._read(
            "trend",
            lambda records: trend(
                records, self.telemetry, quantity, heliostat, since, until, points
            ),
        )

    def note(self, person: Person, text: str) -> None:
        """Store an operator's note, such as one for the next shift, in the journal.

        Raises
        ------
        RefusedError
            If the person is a viewer.
        InputError
            If the note is empty.
        """
        _operator(person, "note")
        if not text.strip():
            raise InputError("note: the text is empty; write what the next shift needs to know")
        self._tell(person, text.strip(), NOTE)

    async def _read(self, what: str, read: Callable[[Records], T]) -> T:
        """Return data read from the store in a thread, including the latest records."""
        if self._records is None:
            raise InputError(f"{what}: this plant keeps no records; run it with a data folder")
        await self._records.confirm()
        return await self._records.read(read)

    async def _figures(self) -> dict[str, float]:
        try:
            power = {name: view.power for name, view in (await self._flux.everywhere()).items()}
        except HeliotropeError:
            power = {}  # the worker process has ended, and another one is started
        return figures(self.viewer.frame(), self.summary(), self.sun(), power)

    # -- light -----------------------------------------------------------------------------

    def sun(self) -> SunView:
        """Return the position of the sun."""
        at = self.plant.clock.utc()
        found = sun.position(at, self.plant.design.site)
        return SunView(at, self.plant.sun_vector(), float(found.azimuth), float(found.elevation))

    async def receiver_flux(self, name: str = "") -> PredictedView:
        """Return the predicted flux on a receiver ("": the first receiver); see `PredictedFlux`.

        Raises
        ------
        UnknownNameError
            If there is no such receiver.
        """
        if not name and not self.receivers:
            raise UnknownNameError("receiver", name, self.receivers)
        receiver = self.plant.design.receiver(name or self.receivers[0])
        view = (await self._flux.everywhere())[receiver.name]
        return replace(view, measured=self.flux_check.measured(receiver.name))

    def aims(self) -> AimsView:
        """Return how aims are chosen, and how far the flux is from its limit."""
        return self._aiming.view()

    # -- calibration -----------------------------------------------------------------------

    def switch_calibration(self, person: Person, on: bool) -> None:
        """Switch automatic calibration on or off.

        Raises
        ------
        RefusedError
            If the person is a viewer.
        """
        _operator(person, "calibration")
        self.automatic.switch(on)
        self._tell(person, f"calibration switched {'on' if on else 'off'}")

    def calibrate(
        self,
        person: Person,
        heliostat: str,
        target: str = "",
        *,
        search: bool = False,
        together: Sequence[str] = (),
        receiver: bool = False,
    ) -> Ticket:
        """Calibrate a heliostat, or only search for its beam, before all others.

        With other heliostats (``together``), the heliostat is calibrated in one joint visit, as
        soon as all are ready. With ``receiver``, the heliostats are measured while they track the
        receiver, as soon as all do. The ticket ends with the result of the visit.

        Raises
        ------
        RefusedError
            If the person is a viewer, or automatic control cannot calibrate the heliostat now.
        UnknownNameError
            If there is no such heliostat or target.
        """
        _operator(person, "calibration")
        self.automatic.calibrate(
            heliostat, target, search=search, together=together, receiver=receiver
        )
        what = "search for the beam" if search else "calibration"
        what = "joint visit" if together else what
        what = "receiver visit" if receiver else what
        names = tuple(dict.fromkeys((heliostat, *together)))
        self._tell(person, f"requested a {what} of {', '.join(names)}{target and f' on {target}'}")
        since = self.plant.clock.utc().timestamp()
        return self.errands.begin(
            "SEARCH_BEAM" if search else "CALIBRATE",
            names,
            partial(self.automatic.calibrating, since),
            _ASKED,
            self.automatic.drop,
        )

    async def photograph(self, person: Person, target: str) -> CameraView:
        """Photograph a target now, with whatever beam is on it; return the findings.

        Raises
        ------
        RefusedError
            If the person is a viewer.
        UnknownNameError
            If no camera covers the target.
        FetchError
            If its camera delivers no frame.
        """
        _operator(person, "photograph")
        before = self.camera(target).version
        shot = await self._cameras[target].photograph(self.plant.design.target(target), "")
        view = self.camera(target)
        if self.pictures is not None and view.version != before:
            self.pictures.keep(view, shot, person.name)
        self._tell(person, f"photographed {target}")
        return view

    def learn(self, person: Person, group: str = "") -> None:
        """Learn a heliostat group ("": all groups) now; see `Learning.order`."""
        self.automatic.learning.order(person, group)
        self._tell(person, f"requested learning for {group or 'all groups'}")

    def camera(self, target: str) -> CameraView:
        """Return the latest photograph of a target.

        Raises
        ------
        UnknownNameError
            If no camera covers the target.
        """
        if target not in self._cameras:
            raise UnknownNameError("target with a camera", target, self._cameras)
        return self._cameras[target].view(target)

    def hold(
        self,
        person: Person,
        heliostats: Sequence[str] = (),
        reason: str = "",
        hours: float = math.nan,
        *,
        targets: Sequence[str] = (),
        receivers: Sequence[str] = (),
        tower: bool = False,
    ) -> Ticket:
        """Lock heliostats, targets, receivers or the tower with a person's own lock.

        Locked heliostats go to stow, and nobody can move them. The same applies to heliostats whose
        beams are aimed at a locked target or receiver, and to all heliostats if the tower is
        locked. A locked object returns to service when everyone has removed their lock. The ticket
        is done for a heliostat once it is parked.

        Parameters
        ----------
        person
            The owner of the lock.
        heliostats, targets, receivers, tower
            What to lock.
        reason
            Reason for the lock.
        hours
            Expected time until return to service, h; NaN if unknown. The lock remains beyond that
            time.

        Raises
        ------
        RefusedError
            If the person is a viewer or states no reason.
        UnknownNameError
            If there is no such heliostat, target or receiver.
        """
        _operator(person, "out of service")
        if not reason.strip():
            raise refusals.REASON_MISSING.error(what="out of service")
        places = self._places(heliostats, targets, receivers, tower=tower)
        names = self.automatic.hold(person, places, reason, hours)
        self._tell(person, f"{_named(places)} out of service: {reason}", "command", names)
        progress = partial(self.automatic.service.progress, places)
        return self.errands.begin("OUT_OF_SERVICE", names, progress, _PARKED)

    def unhold(
        self,
        person: Person,
        heliostats: Sequence[str] = (),
        *,
        targets: Sequence[str] = (),
        receivers: Sequence[str] = (),
        tower: bool = False,
        owner: str = "",
        reason: str = "",
    ) -> None:
        """Remove a person's own locks; no heliostat moves.

        An engineer may remove the locks of an ``owner`` who cannot remove them, stating a reason.

        Raises
        ------
        RefusedError
            If the person is a viewer, has no lock on an object that other persons have locked, or
            removes another person's lock without being an engineer or without a reason.
        UnknownNameError
            If there is no such heliostat, target or receiver.
        """
        _operator(person, "give back")
        places = self._places(heliostats, targets, receivers, tower=tower)
        other = owner not in ("", person.name)
        if other:
            person.must_be(Role.ENGINEER, f"remove {owner}'s lock")
        if other and not reason.strip():
            raise refusals.REASON_MISSING.error(what=f"remove {owner}'s lock")
        removed = self.automatic.service.give_back(person, places, owner)
        for lock in removed if other else ():
            text = f"removed {lock.who}'s lock ({lock.text}): {reason}"
            self._tell(person, f"{_named([(lock.kind, lock.name)])}: {text}", "command")
        locks = self.plant.lockouts
        still = [place for place in places if locks.on(*place)]
        back = [place for place in places if not locks.on(*place)]
        if back:
            text = f"{_named(back)} back in service"
            self._tell(person, text, "command", [_named([place]) for place in back])
        for kind, name in still:
            text = (
                f"{person.name} has returned a lock, but other locks remain: "
                f"{locks.text(kind, name)}"
            )
            self._tell(person, f"{_named([(kind, name)])}: {text}", "command")

    def _places(
        self,
        heliostats: Sequence[str],
        targets: Sequence[str],
        receivers: Sequence[str],
        *,
        tower: bool,
    ) -> list[tuple[Kind, str]]:
        """Return the places to lock or unlock, by kind and name."""
        for name in heliostats:
            self.plant.field.place(name)
        for name in targets:
            self.plant.design.target(name)
        for name in receivers:
            self.plant.design.receiver(name)
        places = [(Kind.HELIOSTAT, name) for name in dict.fromkeys(heliostats)]
        places += [(Kind.TARGET, name) for name in dict.fromkeys(targets)]
        places += [(Kind.RECEIVER, name) for name in dict.fromkeys(receivers)]
        places += [(Kind.TOWER, TOWER)] if tower else []
        if not places:
            raise InputError(
                "the order names no heliostat, target, receiver or tower; name at least one"
            )
        return places

    # -- the authority ---------------------------------------------------------------------

    def take_authority(self, person: Person) -> Grant:
        """Take the command authority; automatic control yields at once.

        Raises
        ------
        RefusedError
            If another person holds it, or the person is a viewer.
        """
        _operator(person, "authority")
        self.automatic.give_way()
        grant = self.plant.take_authority(person)
        self._tell(person, "has the command authority", "authority")
        return grant

    def seize_authority(self, person: Person, reason: str) -> Grant:
        """Take the command authority away from another person.

        Raises
        ------
        RefusedError
            See `PlantController.seize_authority`.
        """
        _operator(person, "authority")
        self.automatic.give_way()
        grant = self.plant.seize_authority(person, reason)
        self._tell(person, f"has seized the command authority: {reason}", "authority")
        return grant

    def release_authority(self, person: Person, token: int) -> None:
        """Release the command authority; automatic control continues.

        Raises
        ------
        RefusedError
            If the person does not hold it.
        """
        self.plant.release_authority(person, token)
        self._tell(person, "has given the command authority back", "authority")

    # -- commands --------------------------------------------------------------------------

    def command(
        self,
        person: Person,
        token: int,
        name: str,
        heliostats: Sequence[str] = (),
        values: Sequence[float] = (),
    ) -> Ticket:
        """Give a command; see `PlantController.command`."""
        ticket = self.plant.command(person, token, name, heliostats, values)
        self._meant(name, ticket.heliostats)
        self._told(person, ticket)
        return ticket

    def aim(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Aim heliostats at points; they keep these aims. See `PlantController.aim`."""
        ticket = self.plant.aim(person, token, points)
        self._aiming.by_person(ticket.heliostats, aimed=True)
        self._told(person, ticket)
        return ticket

    def aim_at(
        self,
        person: Person,
        token: int,
        heliostats: Sequence[str],
        where: str,
        place: tuple[float, float] | None = None,
    ) -> Ticket:
        """Aim heliostats at a receiver or target by its name, or at a point of a receiver.

        Parameters
        ----------
        person, token
            The person commanding, and the token of the command authority.
        heliostats
            Names; () for all.
        where
            Receiver or target. For the first receiver, the aims are the aims of the design, or the
            aims under the flux limit; for any other surface, the centre.
        place
            Point on the unrolled receiver, right of and above its middle, m; see `Receiver.point`.

        Raises
        ------
        InputError
            If the point is not on the receiver, or a point is specified and ``where`` is a target.
        UnknownNameError
            If there is no receiver or target of that name.
        """
        names = tuple(heliostats) or self.names
        points: Mapping[str, npt.ArrayLike]
        if place is not None:
            if where not in self.receivers:
                raise InputError(
                    f"aim: right and up refer to a receiver, but {where!r} is not a receiver"
                )
            points = dict.fromkeys(names, self.plant.design.receiver(where).point(*place))
        elif where in self.receivers[:1]:
            points = self._aiming.points(names)
        elif where in self.receivers:
            points = dict.fromkeys(names, self.plant.design.receiver(where).center)
        elif where in self.targets:
            center = self.plant.design.target(where).center
            points = dict.fromkeys(names, center)
        else:
            raise UnknownNameError("receiver or target", where, self.receivers + self.targets)
        ticket = self.aim(person, token, points)
        if place is None and where in self.receivers[:1]:
            self._aiming.by_person(ticket.heliostats, aimed=False)
        return ticket

    def standby(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Set standby points; see `PlantController.standby`."""
        ticket = self.plant.standby(person, token, points)
        self._told(person, ticket)
        return ticket

    def stow(self, person: Person, heliostats: Sequence[str] = ()) -> Ticket:
        """Send heliostats (() for all) to stow; anyone may order this."""
        ticket = self.plant.stow(person.name, heliostats)
        self._meant("STOW", ticket.heliostats)
        self._told(person, ticket)
        return ticket

    def defocus(self, person: Person, heliostats: Sequence[str] = ()) -> Ticket:
        """Move beams off the receiver; anyone may order this."""
        ticket = self.plant.defocus(person.name, heliostats)
        self._meant("DEFOCUS", ticket.heliostats)
        self._told(person, ticket)
        return ticket

    def emergency(self, person: Person, act: str = "DEFOCUS", reason: str = "") -> EmergencyOrder:
        """Order a field-wide DEFOCUS or STOW, whose execution is checked; anyone may order this.

        Raises
        ------
        InputError
            If ``act`` is neither DEFOCUS nor STOW.
        RefusedError
            See `PlantController.raise_emergency`.
        """
        before = self.plant.sentinel.calls
        order = self.plant.raise_emergency(person.name, _act(act), reason)
        if self.plant.sentinel.calls != before:
            self.automatic.give_up("an emergency took it out of automatic control")
            self.logbook.event("command", person.name, f"EMERGENCY {act}: {reason or 'no reason'}")
        return order

    def withdraw(self, person: Person, owner: str = "") -> None:
        """Withdraw the person's own emergency order; an engineer may withdraw an ``owner``'s order.

        Raises
        ------
        RefusedError
            See `PlantController.withdraw_emergency`.
        """
        told = self.plant.withdraw_emergency(person, owner)
        left = "; ".join(call.text for call in self.plant.sentinel.calls)
        whose = f"{owner}'s emergency" if owner not in ("", person.name) else "emergency"
        about = [f"{whose} withdrawn", told, left and f"still ordered by {left}"]
        self._tell(person, "; ".join(filter(None, about)), "command")

    def acknowledge(self, person: Person, condition: str, subject: str = "") -> None:
        """Acknowledge an alarm, and its row of the safety table.

        Raises
        ------
        RefusedError
            If the role is too low, or the cause of a latched row persists.
        """
        _operator(person, "acknowledge")
        if not self.logbook.is_plain(condition):
            self.plant.acknowledge(person, condition, subject)
        self.logbook.acknowledge(person.name, condition, subject)
        self._tell(person, f"acknowledged {condition} {subject}".strip(), "command")

    def give_back(self, person: Person, heliostats: Sequence[str] = ()) -> Ticket:
        """Return heliostats (() for all) to automatic control, which raises and calibrates them.

        The ticket is done for a heliostat once the heliostat follows automatic control; otherwise
        it states why the heliostat does not.

        Raises
        ------
        RefusedError
            If the person is a viewer.
        """
        _operator(person, "give back")
        names = tuple(dict.fromkeys(heliostats)) or self.names
        self.automatic.want(names, wanted=True)
        self._aiming.by_person(names, aimed=False)
        text = f"put {amount(len(names), 'heliostat')} under automatic control"
        self._tell(person, text, "command", names)
        progress = partial(self.automatic.following, self.plant.now())
        return self.errands.begin("AUTOMATIC", names, progress, self.automatic.follows_within)

    def resume(self, person: Person) -> None:
        """Let automatic control resume with its heliostats, after a large loss or an emergency.

        This also acknowledges an emergency whose orders are all withdrawn.

        Raises
        ------
        RefusedError
            If the person is a viewer, an order is active, or something else requires the emergency.
        """
        _operator(person, "resume")
        sentinel = self.plant.sentinel
        if sentinel.on:
            if sentinel.ends_by(ORDERED):
                self.acknowledge(person, ORDERED)
            else:
                causes = "; ".join(f"{who}: {text}" for who, text in sentinel.causes().items())
                raise refusals.EMERGENCY_GOES_ON.error(causes=causes)
        count = self.automatic.resume()
        back = f": {count} heliostats are under it again" if count else ""
        self._tell(person, f"automatic control resumed{back}", "command")

    # -- notes -----------------------------------------------------------------------------

    def _meant(self, name: str, heliostats: Sequence[str]) -> None:
        if name in _TAKES_FROM_AUTOMATIC:
            self.automatic.want(heliostats, wanted=False)
        elif name in _GIVES_TO_AUTOMATIC:
            self.automatic.want(heliostats, wanted=True, by_person=True)

    def _told(self, person: Person, ticket: Ticket) -> None:
        text = f"{ticket.name} {_some(ticket.heliostats)}"
        self._tell(person, text, "command", ticket.heliostats)

    def _tell(
        self,
        person: Person,
        text: str,
        kind: str = "calibration",
        heliostats: Sequence[str] = (),
    ) -> None:
        self.logbook.event(kind, person.name, text, heliostats=heliostats)


def _some(heliostats: Sequence[str]) -> str:
    left = len(heliostats) - MOST_NAMED
    more = f" and {left} more" if left > 0 else ""
    return ", ".join(heliostats[:MOST_NAMED]) + more


def _named(places: Sequence[tuple[Kind, str]]) -> str:
    """Return the locked places in words; heliostats appear as bare names."""
    bare = (Kind.HELIOSTAT, Kind.TOWER)
    return _some([name if kind in bare else f"{kind} {name}" for kind, name in places])


def _act(name: str) -> Act:
    if name not in Act.__members__:
        raise UnknownNameError("act of an emergency", name, sorted(messages.SAFE))
    return Act[name]


def _operator(person: Person, what: str) -> None:
    person.must_be(Role.OPERATOR, what)
