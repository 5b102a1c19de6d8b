"""The plant controller: the central controller of a field of clusters.

It knows the state of every heliostat and the age of that information, holds the single command
authority, accepts operator commands, sends them to the clusters and tracks them to completion,
renews each cluster's lease every second, evaluates the safety table, and confirms that emergency
orders are carried out.

A command is accepted or refused at once (`RefusedError`, with the reason). An accepted command is
recorded in the audit before it is sent, and returns a `Ticket` to await. DEFOCUS and STOW are
accepted from anyone and wait for nothing. No heliostat moves without an order, neither at start-up
nor after an emergency.
"""

import asyncio
import math
import secrets
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.files.disk import AtOnce, Disk
from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.common_settings import settings_checksum
from heliotrope.links.link import Link
from heliotrope.links.messages import (
    Acknowledge,
    Answer,
    ClusterStatus,
    Lease,
    Progress,
    ProtocolError,
)
from heliotrope.mechanism.board_items import POSE_ITEMS, Wanted, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.plant import refusals
from heliotrope.plant.emergency import (
    EmergencyOrder,
    EmergencyRecord,
    PlantReadings,
    Sentinel,
    TableWatch,
)
from heliotrope.plant.field.agreement import Agreement
from heliotrope.plant.field.aims import BeamCheck, default_aims
from heliotrope.plant.field.assigned import Assigned, Points
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.field.cluster_alarms import ClusterAlarms
from heliotrope.plant.field.cluster_settings import ClusterSettings
from heliotrope.plant.field.clusters import QUESTION_LIFE, ClusterEnd, Clusters
from heliotrope.plant.field.doubtful_positions import DoubtfulPositions
from heliotrope.plant.field.drive_checks import DriveChecks
from heliotrope.plant.field.firmware import Firmware
from heliotrope.plant.field.identity import Identities
from heliotrope.plant.field.ledger import Ledger
from heliotrope.plant.field.lockouts import Lockouts
from heliotrope.plant.field.locks import Locks
from heliotrope.plant.field.part import Part
from heliotrope.plant.field.row_names import RowNames
from heliotrope.plant.field.second_plant import SecondPlant
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.field.witnesses import Witnesses
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.motion.proofs import BeamError, PathProofs
from heliotrope.plant.motion.watch import BeamWatch
from heliotrope.plant.orders.audit import Audit, Record
from heliotrope.plant.orders.authority import Authority, Grant, Person, Role
from heliotrope.plant.orders.commands import Commands
from heliotrope.plant.orders.dispatch import JoinDispatcher
from heliotrope.plant.orders.giving_back import GivingBack
from heliotrope.plant.orders.guards import Asked, Guards
from heliotrope.plant.orders.joining import JoinQueue
from heliotrope.plant.orders.movements import Movements
from heliotrope.plant.orders.parameters import ParameterSync, change_of_beam
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.stepping import Stepping
from heliotrope.plant.orders.taken import Taken
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.orders.unacknowledged import Unacknowledged
from heliotrope.plant.refusals import BEAM_REFUSED, NOT_NOW, OUT_OF_SERVICE
from heliotrope.plant.settings import Counters, PlantSettings, clusters_of
from heliotrope.safety import Act, Alarm, Condition, alarms, conditions, limited
from heliotrope.sun import fast_vector

#: If the same person repeats a DEFOCUS or STOW within this time, s, while the earlier one is still
#: in progress, both count as one order.
_SAME = 0.25
#: Pause between two passes over the parameters and the owed records, s.
_SLOW_BEAT = 1.0


@dataclass(frozen=True)
class Stores:
    """Stores that outlive one run of the plant program.

    Attributes
    ----------
    audit
        Audit of accepted commands.
    wanted
        Parameters that local controllers should store.
    assigned
        Store of aims and standby points; None: these points are lost when the program ends.
    record
        Store of the active emergency; None: the emergency is lost when the program ends.
    disk
        Runs work that waits for a disk; None: the work is done in the event loop, as virtual time
        requires.
    """

    audit: Audit
    wanted: Wanted = field(default_factory=Wanted)
    assigned: Assigned | None = None
    record: EmergencyRecord | None = None
    disk: Disk | None = None


class PlantController:
    """The central controller.

    Parameters
    ----------
    design
        Site, heliostats, receivers, targets.
    links
        Links by cluster name; the owner runs them, for example through a `TcpServer`.
    clock
        Clock of the plant; all timing uses its monotonic time.
    stores
        Stores that outlive this program.
    settings
        Times and limits.
    table
        Rows of the safety table; None: the rows of the design, with the autonomy from the settings.
    entropy
        Source of random bytes for tokens and identities.
    on_alarm
        Called with each alarm.

    Attributes
    ----------
    design, settings, field, ledger, authority, wanted, counters, beliefs, doubtful, witnesses,
    drive_checks
        See their classes.
    beams
        Check of beams against keep-out volumes; see `BeamCheck`.
    alarms
        The last alarms, oldest first.
    name
        Name of this plant run: UTC of its start, and random digits.
    join_rate
        Number of heliostats that may join the receiver per second.
    lockouts
        Personal locks; EMERGENCY, DEFOCUS and STOW override them.
    aims, standbys
        Points to which the beams are sent, ENU, m, (N, 3); NaN if there is none.
    commands, guards, sentinel
        The part that issues operator commands; the guards that block commands, apart from the path
        checks; and the sentinel, with the safety table and the active emergencies.
    worth
        How much a smaller squared error of each heliostat counts beside the others when a
        calibration is chosen, (N,).
    movements, locks, stepping
        Aims that visits have moved, heliostats that they have locked, and fine steps that they
        need; the plant restores whatever a visit leaves behind.

    Raises
    ------
    InputError
        If a cluster has no link, a link has no cluster, or a heliostat has no cluster.
    """

    def __init__(
        self,
        design: Plant,
        links: Mapping[str, Link],
        clock: Clock,
        stores: Stores,
        *,
        settings: PlantSettings | None = None,
        table: Iterable[Condition] | None = None,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
        on_alarm: Callable[[Alarm], None] | None = None,
    ) -> None:
        members = _checked(design, links)
        self.design, self.settings = design, settings or PlantSettings()
        self.clock, self._on_alarm = clock, on_alarm
        self.alarms, self.counters = deque[Alarm](maxlen=1000), Counters()
        self.field = FieldState(members, self.settings.stale)
        self.ledger = Ledger(self.field)
        self.authority = Authority(clock, self.settings.authority, entropy)
        self.wanted = stores.wanted
        self.beams = BeamCheck(design, self.field.names)
        self.beliefs = Beliefs(design)
        self.beliefs.subscribe(self._believe)
        self.lockouts = Lockouts(design)
        points = Points(self.field.names, stores.assigned)
        self.aims, self.standbys = points.aims, points.standbys
        self.movements = Movements(design.receivers, self.beams.armature)
        resting = (name for name, each in self.beams.machines.items() if each.rests)
        self.stepping = Stepping(self.field, self.ledger, resting, points.held["ROUGH"])
        self._proofs = PathProofs(
            Paths(self.beams), self.field, self.ledger, points, self.sun_vector
        )
        self._watch = BeamWatch(self._proofs)
        self.locks = Locks(self.field, self.ledger, lambda: clock.utc().timestamp())
        self.locks.recall(points.held["LOCKED"], clock.monotonic())
        self.movements.recall(points.held["LENT"])
        self._agreement = self._compared(points)
        self._clusters = Clusters(members, links, clock, self.counters)
        self.worth = np.ones(len(self.field))
        self.join_rate, burst = self.settings.joins(design)
        self._joining = JoinQueue(self.join_rate, burst, self.settings.join_wait)
        self._identities = Identities(
            self.field,
            self.beams.armature.table,
            self.wanted.items,
            self._clusters.connection,
            self._tell,
            self._joining.drop,
        )
        self.witnesses = Witnesses(
            self.settings.witnesses, design.site, lambda: clock.utc().timestamp(), self._tell
        )
        self.drive_checks, self.doubtful = self._doubting()
        self.name = f"{clock.utc():%Y%m%dT%H%M%S}-{entropy(4).hex()}"
        self._second_plant = SecondPlant(self.name, self._tell)
        self._orders = self._ordering(stores.audit, stores.disk or AtOnce())
        self._taken = Taken(self.movements, self.locks, self.stepping, points, self._orders.owe)
        self._sync = self._syncing()
        self.sentinel = self._guarded(table, stores.record)
        self._given = Unacknowledged(self.field, points)
        self.guards = self._guarding()
        self.commands = self._directed()
        self._parts = self._listed()
        self._slow_at = -math.inf
        self._closing = asyncio.Event()
        self._last_safe: tuple[tuple[str, Act, tuple[str, ...]], Ticket] | None = None

    def _doubting(self) -> tuple[DriveChecks, DoubtfulPositions]:
        """Return the parts that judge drives and keep doubtful heliostats off the receiver."""
        sensed = (name for name, each in self.beams.machines.items() if each.tilt_sensor)
        checks = DriveChecks(
            self.field, self._clusters, sensed, self.design.site, self.clock, self._tell
        )
        return checks, DoubtfulPositions(
            self.field,
            self.design,
            self._tell,
            lambda: self.witnesses.refusal,
            checks.stalled,
        )

    def _ordering(self, audit: Audit, disk: Disk) -> PlantOrders:
        """Return the part that tracks accepted commands until they end."""
        return PlantOrders(
            self.clock,
            self.authority,
            audit,
            disk,
            self._clusters,
            self.name,
            self.settings,
            self._sent,
        )

    def _syncing(self) -> ParameterSync:
        """Return the part that compares and writes the local controllers' parameters."""
        return ParameterSync(
            self.field,
            self.wanted,
            self._orders,
            self._clusters,
            self._tell,
            self._proofs,
            self._unwritable,
            self._writing,
        )

    def _guarded(
        self, table: Iterable[Condition] | None, record: EmergencyRecord | None
    ) -> Sentinel:
        """Return the sentinel, with the plant's own readings of the safety table."""
        if table is None:
            table = limited(conditions(self.settings.autonomy), self.design.safety)
        readings = PlantReadings(
            self.field,
            self.authority,
            self._orders,
            self._watch,
            self._agreement,
            self.sun_vector,
        )
        return Sentinel(
            TableWatch(
                table,
                readings,
                self.field.clusters,
                self.settings.sensors | self.settings.given,
                self.now(),
                self._tell,
            ),
            self._orders,
            self._joining,
            self._watch,
            self.settings.repeat,
            self._identities,
            self.drive_checks,
            record,
        )

    def _guarding(self) -> Guards:
        """Return the guards that block heliostats."""
        return Guards(
            self.field,
            self.authority,
            self._orders,
            self.sentinel,
            self._second_plant,
            self.witnesses,
            self._identities,
            self._sync,
            self.doubtful,
            self.lockouts,
            self._given,
            self.aims,
        )

    def _listed(self) -> tuple[Part, ...]:
        """Return the parts in the order in which each hook is called."""
        return (
            # First at a beat, so that nothing begins that the safety table has just forbidden; and
            # first for a newly connected cluster, to which it repeats an emergency before anything
            # else.
            self.sentinel,
            self._dispatching(),
            self._orders,
            # After new orders, which may take over what a visit has left.
            self._returning(),
            self.ledger,
            self._agreement,
            self._given,
            ClusterSettings(self._tell, _expected(self.settings)),
            self._second_plant,
            ClusterAlarms(self._tell),
            # These evaluate a status before the sentinel uses it as proof (`on_rows`).
            self._identities,
            self.doubtful,
            self.drive_checks,
            RowNames(self.field, self._clusters),
            self.witnesses,
            Firmware(self.settings.firmware, self._clusters, self._tell),
            self._taken,
            # Last, because what it compares and writes depends on points accepted by the others.
            self._sync,
        )

    def _compared(self, points: Points) -> Agreement:
        """Return the part that compares reports with the plant's own knowledge."""
        return Agreement(
            self.field,
            self.ledger,
            points,
            self.beams,
            self.design.site,
            lambda: self.clock.utc().timestamp(),
            self._differing,
        )

    def _directed(self) -> Commands:
        """Return the part that issues operators' commands."""
        return Commands(
            self._orders,
            self._joining,
            self.guards,
            self._given,
            self._proofs,
            self.design,
            self.wanted,
            self._taken,
        )

    def _dispatching(self) -> JoinDispatcher:
        """Return the part that sends heliostats whose turn to join has come."""
        return JoinDispatcher(
            self._joining,
            self._orders,
            self._proofs,
            self.settings.join_life,
            lambda: bool(self.sentinel.refusal(("",))),
            self.guards,
            self.commands.examine,
        )

    def _returning(self) -> GivingBack:
        """Return the part that restores what visits have left behind."""
        return GivingBack(
            self.field,
            self.authority,
            self._orders,
            self.guards,
            self.commands,
            self._taken,
            lambda names: self.stow("plant", names),
        )

    # -- running ---------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until closed. If any part fails, everything stops, and the leases expire."""
        async with asyncio.TaskGroup() as group:
            parts: list[Coroutine[Any, Any, None]] = [self._beats()]
            for end in self._clusters.ends.values():
                parts += [self._clusters.hear(end, self._take)]
                parts += [end.keep(self._lease, self.settings.period, self._greet)]
                parts += [end.deliver(urgent=True), end.deliver(urgent=False)]
            tasks = [group.create_task(part) for part in parts]
            await self._closing.wait()
            for end in self._clusters.ends.values():
                await end.link.close()
            for task in tasks:
                task.cancel()
        if work := self._proofs.points.settling():
            self._orders.owe(work)
        await self._orders.end(self.now())

    async def close(self) -> None:
        """Stop the plant and its links; the clusters defocus when their leases expire."""
        self._closing.set()

    def _lease(self) -> Lease:
        self.counters.leases += 1
        settings = self.settings
        return Lease(self.authority.token, settings.lease, settings.autonomy, self.name)

    def _greet(self, end: ClusterEnd) -> None:
        now = self.now()
        for part in self._parts:
            part.on_connected(end.name, now)

    def _take(self, end: ClusterEnd, message: object, now: float) -> None:
        match message:
            case ClusterStatus():
                self._take_status(end, message, now)
            case Progress():
                found = self._orders.take(end.name, message)
                if found is not None:
                    for part in self._parts:
                        part.on_stage(*found, message.stage, now)
            case Alarm():
                for part in self._parts:
                    part.on_alarm(end.name, message)
            case Answer():
                self._clusters.take_answer(message)
            case _:
                raise ProtocolError(
                    f"{type(message).__name__.lower()}: clusters are not allowed to send this "
                    f"message type"
                )

    def _sent(
        self,
        name: str,
        values: tuple[float, ...],
        heliostats: tuple[str, ...],
        now: float,
        again: bool,
    ) -> None:
        for part in self._parts:
            part.on_sent(name, values, heliostats, now, again)

    def _take_status(self, end: ClusterEnd, status: ClusterStatus, now: float) -> None:
        self.counters.statuses += 1
        self.counters.problems.extend(self.field.take(end.name, status, now))
        for part in self._parts:
            part.on_status(end.name, status, now)
        for part in self._parts:
            part.on_rows(end.name, now)

    async def _beats(self) -> None:
        while True:
            due = self.now() + self.settings.beat
            self._beat(self.now())
            await sleep_until(self.clock, due)

    def _beat(self, now: float) -> None:
        for part in self._parts:
            part.on_beat(now)
        second = now - self._slow_at >= _SLOW_BEAT
        if self._orders.owing or second:
            self._orders.pay()
        if second:
            self._slow_at = now
            for part in self._parts:
                part.on_second(now)

    def _writing(self) -> int:
        """Return the token under which parameters may be written now; 0 if none may be written."""
        return 0 if self.sentinel.refusal(self.field.clusters) else self.authority.token

    def _tell(self, alarm: Alarm) -> None:
        self.alarms.append(alarm)
        if self._on_alarm is not None:
            self._on_alarm(alarm)

    # -- state -----------------------------------------------------------------------------

    def now(self) -> float:
        """Return the monotonic time, s."""
        return self.clock.monotonic()

    def sun_vector(self, ahead: float = 0.0) -> FloatArray:
        """Return the unit vector to the sun, ENU, (3,), now or some seconds from now."""
        return fast_vector(self.clock.utc().timestamp() + ahead, self.design.site)

    @property
    def standby_unknown(self) -> npt.NDArray[np.bool_]:
        """Mask of the heliostats whose standby point is unknown, (N,); see `Points.unknown`."""
        return self._proofs.points.unknown("STANDBY")

    @property
    def waiting(self) -> int:
        """Number of heliostats waiting to join the receiver."""
        return len(self._joining)

    @property
    def orders(self) -> tuple[Ticket, ...]:
        """Commands that have not yet ended."""
        return self._orders.open

    def put(self, name: str, value: float, subject: str = "", *, made: float | None = None) -> None:
        """Accept a sensor reading for the safety table or for the proof of an emergency.

        The reading was measured at ``made``, monotonic s; None: now.

        Raises
        ------
        UnknownNameError
            If the sensor is not in the settings.
        """
        self.sentinel.put(name, value, self.now() if made is None else made, subject)

    # -- open to anyone ---------------------------------------------------------------------

    def defocus(self, who: str, heliostats: Sequence[str] = ()) -> Ticket:
        """Move the beams of some or all heliostats off the receiver now; anyone may order this."""
        return self._safe(who, Act.DEFOCUS, heliostats)

    def stow(self, who: str, heliostats: Sequence[str] = ()) -> Ticket:
        """Send some or all heliostats to stow; anyone may order this.

        If there are many, they go one after the other (see `PlantSettings.stow_rate`); in an
        emergency all go at once.
        """
        return self._safe(who, Act.STOW, heliostats)

    def locked_for(self, heliostat: str) -> str:
        """Return a text that explains why a heliostat is LOCKED, since when and until when."""
        mandate = self.authority.visited().get(heliostat)
        visit = "" if mandate is None else f"the visit to {mandate.where} of {mandate.person.name}"
        held = self.guards.reasons(Asked("UNLOCK", (heliostat,)), NOT_NOW)
        return self.locks.reason(heliostat, visit, held.get(heliostat, ""))

    def last_order(self, heliostat: str) -> tuple[Record, Ticket] | None:
        """Return the last command to a heliostat since start-up, with its progress."""
        return self._orders.last.get(heliostat)

    def waits_to_stow(self, heliostat: str) -> bool:
        """Return whether a heliostat is waiting for its turn to stow."""
        return self._orders.to_stow(heliostat)

    def _safe(self, who: str, act: Act, heliostats: Sequence[str]) -> Ticket:
        for name in heliostats:
            self.field.place(name)
        # A client that repeats an order as soon as it is answered gets the ticket of the order
        # under way, because nothing else has been ordered since, and clusters repeat it by
        # themselves.
        same, last = (who, act, tuple(heliostats)), self._orders.latest
        under_way = last is not None and self._last_safe == (same, last) and not last.finished
        if last is not None and under_way and self.now() - last.accepted_at < _SAME:
            return last
        names = tuple(heliostats) or self.field.names
        self._joining.drop(f"{act.name} by {who}", frozenset(names))
        ticket = self.sentinel.send_safe((who, "anybody"), act, names, "", in_turn=True)
        self._last_safe = same, ticket
        return ticket

    def raise_emergency(self, who: str, act: Act = Act.DEFOCUS, reason: str = "") -> EmergencyOrder:
        """Order a field-wide DEFOCUS or STOW, whose execution is checked; anyone may order this.

        Each operator's order is in force until it is withdrawn, and the table rows that it trips
        stay tripped until they are acknowledged.

        Raises
        ------
        InputError
            If the act is neither DEFOCUS nor STOW.
        RefusedError
            If this person's order was withdrawn repeatedly; see `Callers`.
        """
        if act not in (Act.DEFOCUS, Act.STOW):
            raise InputError(f"emergency: {act.name} cannot be ordered; order DEFOCUS or STOW")
        at = self.clock.utc().timestamp()
        return self.sentinel.call(who, act, reason or f"emergency order of {who}", at)

    # -- the command authority -------------------------------------------------------------

    def take_authority(self, person: Person) -> Grant:
        """Take the command authority, if nobody holds it.

        Raises
        ------
        RefusedError
            See `Authority.take`.
        """
        before = self.authority.grant
        grant = self.authority.take(person)
        if before is None:
            self.note(person, "AUTHORITY", "taken")
        return grant

    def seize_authority(self, person: Person, reason: str) -> Grant:
        """Take the command authority away from another person.

        Raises
        ------
        RefusedError
            See `Authority.seize`.
        """
        before = self.authority.grant
        grant = self.authority.seize(person, reason)
        holder = "nobody" if before is None else before.holder.name
        self.note(person, "AUTHORITY", f"broken, from {holder}: {reason}")
        return grant

    def release_authority(self, person: Person, token: int) -> None:
        """Release the command authority; heliostats waiting to join the receiver are dropped.

        Raises
        ------
        RefusedError
            If another person holds the authority.
        """
        self.authority.release(person, token)
        self.note(person, "AUTHORITY", "released")

    def withdraw_emergency(self, person: Person, owner: str = "") -> str:
        """Withdraw the person's own emergency order; an engineer may withdraw an ``owner``'s order.

        The emergency continues while another person's order is active. The table rows that the
        order tripped wait for `acknowledge`.

        Returns
        -------
        What the operator should know: how often the order was repeated, and when the person's next
        order is accepted.

        Raises
        ------
        RefusedError
            If neither the person nor the owner has an active order, or the person's role is too
            low.
        """
        person.must_be(Role.OPERATOR, "withdraw")
        who, calls = owner or person.name, self.sentinel.calls
        if who != person.name:
            person.must_be(Role.ENGINEER, f"withdraw the emergency of {who}")
        if who not in {call.who for call in calls}:
            texts = "; ".join(call.text for call in calls)
            rows = "; ".join(self.sentinel.causes().values()) or "no emergency is active"
            stands = f"it was ordered by {texts}" if calls else rows
            raise refusals.NOT_CALLER.error(who=who, calls=stands)
        text = self.sentinel.withdraw(who, person.name)
        about = f"; {text}" if text else ""
        self.note(person, "WITHDRAW", f"emergency order of {who}{about}")
        return text

    def acknowledge(self, person: Person, condition: str, subject: str = "") -> None:
        """Acknowledge a row of the safety table that is waiting for acknowledgement.

        Parameters
        ----------
        person
            The person acknowledging; their role must be high enough for the row.
        condition, subject
            As named in the alarm. For a row that a cluster evaluates, the subject is the cluster;
            the cluster decides, and clears the alarm if it agrees. For `counts_doubtful`, the
            acknowledgement confirms that the person has seen the heliostat in its correct position;
            for `drive_stalled`, that its mirror follows its drives.

        Raises
        ------
        RefusedError
            If the role is too low, or the cause persists.
        """
        person.must_be(Role.OPERATOR, condition)
        role = person.role.acknowledges_as
        if condition == alarms.COUNTS_DOUBTFUL.name:
            self.doubtful.confirm(subject)
        elif condition == alarms.DRIVE_STALLED.name:
            self.drive_checks.confirm(subject)
        elif condition in self.sentinel.table.rows or subject not in self._clusters.ends:
            refusal = self.sentinel.acknowledge(condition, person.name, role, subject)
            if refusal:
                raise refusals.NOT_ACKNOWLEDGED.error(reason=refusal)
        else:
            identity = self._clusters.number("acknowledge")
            message = Acknowledge(identity, condition, person.name, role.name.lower())
            self._clusters.ends[subject].post(message, QUESTION_LIFE)
        self.note(person, "ACKNOWLEDGE", f"{condition} {subject}".strip())

    def note(self, person: Person, what: str, note: str) -> None:
        """Record an action that moves nothing in the audit."""
        self._orders.note(person.name, person.role.title, what, note)

    # -- commands --------------------------------------------------------------------------

    def command(
        self,
        person: Person,
        token: int,
        name: str,
        heliostats: Sequence[str] = (),
        values: Sequence[float] = (),
    ) -> Ticket:
        """Send a bus command to some or all heliostats.

        Parameters
        ----------
        person, token
            The person commanding, and the token of the command authority.
        name, values
            As in `lcu.messages`; for AIM and STANDBY use `aim` and `standby`.
        heliostats
            Names; () for all.

        Raises
        ------
        RefusedError
            If the command is not accepted; in that case nothing is sent.
        InputError
            If a name is unknown, or values do not fit.
        """
        if name in messages.SAFE:
            return self._safe(person.name, Act[name], heliostats)
        return self.commands.give(person, token, name, heliostats, values)

    def default_aims(
        self, heliostats: Sequence[str] = (), points: npt.ArrayLike | None = None
    ) -> dict[str, FloatArray]:
        """Return one aim per heliostat (() for all), for `aim`; see `aims.default_aims`."""
        names = tuple(heliostats) or self.field.names
        rows = np.array([self.field.place(name) for name in names], dtype=np.intp)
        vertices = self.beams.armature.origin_1[rows]
        return default_aims(self.design, names, vertices, points)

    def aim(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Aim heliostats at points where a surface stops their beams: on a receiver or target.

        Tracking heliostats move to their new aim at the rate at which they join the receiver.

        Parameters
        ----------
        person, token
            The person commanding, and the token of the command authority.
        points
            ENU, m, (3,), by name.

        Raises
        ------
        RefusedError
            If the command is not accepted, or one of the beams is not allowed at its point.
        """
        return self.commands.point(person, token, "AIM", points)

    def standby(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Set standby points, beyond which the beams continue; see `aim`."""
        return self.commands.point(person, token, "STANDBY", points)

    def parameters(
        self,
        person: Person,
        token: int,
        heliostat: str,
        items: Mapping[str, bytes],
        confirmed: str = "",
        record: HeliostatCalibration | None = None,
    ) -> Ticket:
        """Send journal items (see `board_items`) to one heliostat; from now on they are wanted.

        Items that change the pose are accepted only where the beam is safe: at stow, or at rest
        where the beam and its path to standby are clear with both the present and the new
        parameters.

        Parameters
        ----------
        person, token
            The person commanding, and the token of the command authority.
        heliostat, items
            Name of the heliostat, and bytes by item.
        confirmed
            Why a change above the limit of the settings is correct; recorded in the audit.
        record
            The calibration that the items come from, which the plant believes as soon as they are
            sent; None: it is adopted later.

        Raises
        ------
        RefusedError
            If the change is not accepted.
        InputError
            If a plant does not send such items.
        """
        row = self.field.place(heliostat)
        self.wanted.check(heliostat, items)
        if reason := self._unwritable(heliostat):
            raise BeamError("PARAMETERS", {heliostat: reason})
        before, after = self._proofs.tables(heliostat, items)
        self.authority.check(person, token, "PARAMETERS")
        self._sync.check(heliostat, items)
        if POSE_ITEMS.intersection(items):
            change, limit = change_of_beam(before, after, self._aimed(row)), self.settings
            if not confirmed.strip() and change > limit.largest_change:
                raise refusals.CHANGE_TOO_LARGE.error(
                    heliostat=heliostat, change=1e3 * change, limit=1e3 * limit.largest_change
                )
        note = ", ".join(items) + (f"; confirmed: {confirmed}" if confirmed else "")
        ticket = self.commands.accept(person, token, "PARAMETERS", (), (heliostat,), note)

        def use() -> None:
            self.wanted.set(heliostat, items)
            self._use(row, *self._proofs.tables(heliostat, items)[1])
            self._joining.drop("its parameters are being written", frozenset([heliostat]))
            if record is not None:
                self.beliefs.take(record)

        self._sync.push(ticket, heliostat, items, token, use)
        return ticket

    def _use(self, row: int, armature: FloatArray, drives: FloatArray) -> None:
        """Use an armature (18,) and drives (2, 19) in path checks and the pointing comparison."""
        self.beams.replace(row, armature, drives)
        self._agreement.believe(row, armature, drives)
        self._identities.learn(row, armature)

    @contextmanager
    def unverified(self, heliostat: str) -> Iterator[None]:
        """Check a heliostat's paths with both its new and its present parameters, until verified.

        Until the new parameters are verified, the heliostat may not join the receiver.
        """
        with self.doubtful.unverified(heliostat), self._proofs.unverified(heliostat):
            yield

    def misled(self, heliostat: str, point: FloatArray) -> str | None:
        """Return the reason why unverified parameters block a path to a point (3,), or None."""
        return self._proofs.misled(heliostat, point)

    def _unwritable(self, heliostat: str) -> str | None:
        """Return why nothing may be written to a heliostat; None if writing is allowed."""
        asked, kinds = Asked("PARAMETERS", (heliostat,)), (OUT_OF_SERVICE, BEAM_REFUSED)
        return self.guards.reasons(asked, *kinds).get(heliostat)

    def _differing(self, heliostat: str) -> str | None:
        return self._sync.differing(heliostat)

    def _aimed(self, row: int) -> FloatArray:
        """Return the points at which a heliostat may aim, ENU, m, (K, 3)."""
        own = np.stack([self.aims[row], self.standbys[row]])
        centers = [receiver.center for receiver in self.design.receivers]
        centers += [target.center for target in self.design.targets]
        return np.array([*own[np.isfinite(own).all(axis=-1)], *centers])

    def _believe(self, record: HeliostatCalibration) -> None:
        """Use a new calibration in the beam checks and in the wanted parameters."""
        self.want(record.heliostat, self.beliefs.present(record.heliostat)[0])

    def want(self, heliostat: str, mechanism: Mechanism) -> None:
        """Use a mechanism, batch shape (), in the beam checks and as the wanted parameters.

        The local controller's parameters are compared with this mechanism, and updated when the
        state of the heliostat allows.
        """
        row = self.field.place(heliostat)
        self._use(row, mechanism.armature.table, mechanism.drives.table)
        self.wanted.set(heliostat, items_of(mechanism))
        self._sync.compare(heliostat)

    async def ask_cluster(self, cluster: str, what: str, timeout: float) -> Answer | None:
        """Return a cluster's reply to a query; None if there is no reply.

        An unknown cluster is an error.
        """
        if cluster not in self._clusters.ends:
            raise UnknownNameError("cluster", cluster, self._clusters.ends)
        return await self._clusters.answer(cluster, what, timeout)

    def compared(self, heliostat: str) -> str:
        """Return the result of the last comparison of a heliostat's stored parameters, in words."""
        self.field.place(heliostat)
        return self._sync.compared(heliostat)

    async def stored(self, heliostat: str, timeout: float = 15.0) -> dict[str, int]:
        """Return the checksums of the items that a local controller stores, by item.

        Raises
        ------
        RefusedError
            If there is no reply.
        """
        self.field.place(heliostat)
        return await self._sync.stored(heliostat, timeout)


def _expected(settings: PlantSettings) -> str:
    """Return the checksum that clusters should report; empty if none is configured."""
    return "" if settings.common is None else settings_checksum(settings.common)


def _checked(design: Plant, links: Mapping[str, Link]) -> Mapping[str, Sequence[str]]:
    """Return the heliostats of each cluster; check that each cluster has a link."""
    members = clusters_of(design)
    odd = sorted(set(members) ^ set(links))
    if odd:
        raise InputError(
            f"plant: cluster {odd[0]} is in only one of the plant file and the links file; add it "
            f"to the other file or remove it"
        )
    return members
