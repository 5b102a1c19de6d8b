"""The plant: the central controller of a field of clusters.

It knows the state of every heliostat with its age, holds the one command authority, takes
commands of persons, sends them to clusters and follows them to their end, tells every cluster
each second that it is there, watches the safety table, and proves an emergency.

Commands are accepted or refused at once (`RefusedError`, with the reason); what is accepted has
its record in the audit before it is sent, and a `Ticket` to await. DEFOCUS and STOW are taken
from anybody, and wait for nothing. Nothing moves by itself: neither at the start nor after an
emergency.
"""

import asyncio
import math
import secrets
from collections import deque
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.field.volumes import Volume
from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages as wire
from heliotrope.lcu import states
from heliotrope.links.clock import Clock, sleep_until
from heliotrope.links.link import Link, messages
from heliotrope.links.messages import (
    Acknowledge,
    Answer,
    Ask,
    Lease,
    Progress,
    ProtocolError,
    Stage,
    Status,
    decode,
)
from heliotrope.mechanism.board_items import Wanted, checksums, items_of
from heliotrope.plant._beam_watch import Lookout, Ways
from heliotrope.plant._cluster_end import ClusterEnd
from heliotrope.plant._joining import Job, Joiner, JoinQueue
from heliotrope.plant._pushing import Pusher, stored_items
from heliotrope.plant._sentinel import Sentinel
from heliotrope.plant._watch import PlantWatch
from heliotrope.plant.aims import BeamCheck, default_aims
from heliotrope.plant.assigned import Assigned, Points, grouped, points_of
from heliotrope.plant.audit import Audit, AuditError
from heliotrope.plant.authority import Authority, Grant, Person, RefusedError, Role
from heliotrope.plant.beliefs import Beliefs
from heliotrope.plant.emergency import EmergencyOrder
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.orders import PlantOrders, whole
from heliotrope.plant.settings import Counters, PlantSettings, clusters_of
from heliotrope.plant.tickets import Ticket
from heliotrope.safety import Act, Alarm, Condition, alarms, conditions
from heliotrope.sun import fast_vector

#: Commands that bring beams to the receiver or move them across it.
JOINING = frozenset({"TRACK", "REFOCUS", "SEARCH"})
#: Commands that move nothing.
SETTINGS = frozenset({"LOCK_AIM", "ROUGH"})
#: Commands that points are given with; `PlantController.aim` and `standby` check their beams.
POINTS = frozenset({"AIM", "STANDBY"})
#: In these states a beam is at its aim, or at its standby point.
_ON_AIM = (states.TRACKING, states.SEARCHING)


class PlantController:
    """The central controller.

    Parameters
    ----------
    design
        Site, heliostats, receivers, targets.
    links
        To each cluster, by its name; run by the owner, as by a `TcpServer`.
    clock
        Its monotonic time decides everything.
    audit
        Of accepted commands.
    clusters
        Names of the heliostats of each cluster; None: as the design says.
    settings
        Times and limits.
    volumes, eyes
        Where no beam may be; eyes, ENU, m, (P, 3), that look into beams; None: the design's.
    wanted
        What local controllers should hold.
    assigned
        Where aims and standby points are kept over a restart; None: nowhere.
    table
        Safety rows; None: the defaults at the autonomy of the settings.
    entropy
        Random bytes, for tokens and identities.
    on_alarm
        Called with each alarm.

    Attributes
    ----------
    design, field, authority, wanted, counters, beliefs
        See their classes.
    alarms
        The last ones, oldest first.
    aims, standbys
        What was assigned, ENU, m, (N, 3); NaN before.

    Raises
    ------
    InputError
        Clusters without a link, or links without a cluster.
    UnknownNameError
        A cluster has a heliostat that the design does not know.
    """

    def __init__(
        self,
        design: Plant,
        links: Mapping[str, Link],
        clock: Clock,
        audit: Audit,
        *,
        clusters: Mapping[str, Sequence[str]] | None = None,
        settings: PlantSettings | None = None,
        volumes: Sequence[Volume] | None = None,
        eyes: npt.ArrayLike | None = None,
        wanted: Wanted | None = None,
        assigned: Assigned | None = None,
        table: Iterable[Condition] | None = None,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
        on_alarm: Callable[[Alarm], None] | None = None,
    ) -> None:
        held = clusters_of(design) if clusters is None else clusters
        if set(held) != set(links):
            odd = sorted(set(held) ^ set(links))
            raise InputError(f"plant: cluster {odd[0]} has heliostats or a link, not both")
        for name in (name for names in held.values() for name in names):
            design.find(name)
        self.design, self.settings = design, settings or PlantSettings()
        self.field = FieldState(held, self.settings.stale)
        self.authority = Authority(clock, self.settings.authority, entropy)
        self.wanted = wanted or Wanted()
        self.counters = Counters()
        self.alarms: deque[Alarm] = deque(maxlen=1000)
        self._clock, self._audit, self._on_alarm = clock, audit, on_alarm
        self._ends = {
            name: ClusterEnd(name, tuple(held[name]), links[name], clock) for name in held
        }
        prefix = f"{clock.utc():%Y%m%dT%H%M%S}-{entropy(4).hex()}"
        self._orders = PlantOrders(
            clock, audit, self._ends, prefix, self.settings.lifetime, self.settings.patience
        )
        rows = conditions(self.settings.autonomy) if table is None else table
        self._joining = JoinQueue(self.settings.join_rate, self.settings.join_burst)
        self.beams = BeamCheck(design, self.field.names, volumes, eyes)
        self.beliefs = Beliefs(design)
        self.beliefs.subscribe(self._believe)
        looks = bool(self.beams.volumes)
        self._watch = PlantWatch(
            rows, tuple(held), self.settings.sensors, clock.monotonic(), looks=looks
        )
        self._points = Points(self.field.names, assigned)
        self.aims, self.standbys = self._points.aims, self._points.standbys
        self._joiner = Joiner(
            self._joining,
            self._orders,
            self.beams,
            self.field,
            self.aims,
            self.sun_vector,
            self.settings.join_life,
        )
        self._ways = Ways(self.beams, self.field, self.aims, self.standbys, self.sun_vector)
        self._sentinel = Sentinel(
            clock,
            design.site,
            self.field,
            self._ends,
            self._orders,
            self._joining,
            self.authority,
            self._watch,
            self.beams.drives,
            Lookout(self.beams, self.field, self.sun_vector),
            self.settings.repeat,
        )
        self._pusher = Pusher(self.field, self.wanted, self._orders, self._ask_stored)
        self._paid_at = -math.inf
        self._answers: dict[str, asyncio.Future[Answer]] = {}
        self._asked = 0
        self._closing = asyncio.Event()

    # Running.

    async def run(self) -> None:
        """Run until closed. If any part of it fails all of it ends, and with it the leases."""
        async with asyncio.TaskGroup() as group:
            parts: list[Coroutine[Any, Any, None]] = [self._beats()]
            for end in self._ends.values():
                parts += [self._hear(end), self._keep(end)]
                parts += [end.deliver(urgent=True), end.deliver(urgent=False)]
            tasks = [group.create_task(part) for part in parts]
            await self._closing.wait()
            for end in self._ends.values():
                await end.link.close()
            for task in tasks:
                task.cancel()
        self._orders.end(self._clock.monotonic())

    async def close(self) -> None:
        """End it, and the links; the clusters then defocus when their leases are over."""
        self._closing.set()

    async def _keep(self, end: ClusterEnd) -> None:
        """Tell one cluster each second that the plant is there."""
        while True:
            due = self._clock.monotonic() + self.settings.period
            opened = end.link.statistics.opened
            if end.link.connected:
                if end.greeted != opened:
                    end.greeted = opened
                    self._greet(end)
                lease = Lease(self.authority.token, self.settings.lease, self.settings.autonomy)
                # A lease counts from its arrival: an old one must not arrive at all.
                end.post(lease, self.settings.period, urgent=True)
                self.counters.leases += 1
            await sleep_until(self._clock, due)

    def _greet(self, end: ClusterEnd) -> None:
        """Begin with a cluster that has connected."""
        # What was ordered while it was away holds for it too.
        end.act = -1
        self._sentinel.repeat([end])
        for name in end.members:
            self._pusher.compare(name)

    def _ask(self, end: ClusterEnd, what: str, heliostat: str = "") -> str:
        self._asked += 1
        identity = f"{what}-{self._asked}"
        end.post(Ask(identity, what, heliostat), 5.0)
        return identity

    def _ask_stored(self, heliostat: str) -> str:
        return self._ask(self._end_of(heliostat), "stored", heliostat)

    def _end_of(self, heliostat: str) -> ClusterEnd:
        return self._ends[self.field.clusters[self.field.cluster[self.field.place(heliostat)]]]

    async def _hear(self, end: ClusterEnd) -> None:
        async for data in messages(end.link):
            now = self._clock.monotonic()
            try:
                self._take(end, decode(data), now)
            except ProtocolError as error:
                self.counters.refused += 1
                self.counters.problems.append(f"cluster {end.name}: {error}")

    def _take(self, end: ClusterEnd, message: object, now: float) -> None:
        match message:
            case Status():
                self._take_status(end, message, now)
            case Progress():
                found = self._orders.take(end.name, message)
                if found is not None:
                    self._sentinel.take_progress(*found, message)
            case Alarm():
                self._tell(
                    Alarm(
                        message.condition,
                        message.subject or end.name,
                        message.severity,
                        message.text,
                        message.active,
                    )
                )
            case Answer():
                self._take_answer(end, message)
            case _:
                raise ProtocolError(f"{type(message).__name__.lower()}: a cluster sends no such")

    def _take_status(self, end: ClusterEnd, status: Status, now: float) -> None:
        self.counters.statuses += 1
        self.counters.problems.extend(self.field.take(end.name, status, now))
        if not self.field.knows_order(end.name) and now - end.asked_at >= 5.0:
            # The message that told the names was lost; the statistics come in the rows' order.
            end.asked_at = now
            self._ask(end, "statistics")
        self._sentinel.take_rows(end, now)

    def _take_answer(self, end: ClusterEnd, answer: Answer) -> None:
        waiting = self._answers.pop(answer.identity, None)
        if waiting is not None and not waiting.done():
            waiting.set_result(answer)
        elif answer.identity.startswith("statistics-") and "error" not in answer.data:
            self.field.learn_order(end.name, tuple(answer.data))
        elif (found := self._pusher.take(answer)) is not None and found[1]:
            differs = alarms.PARAMETERS_DIFFER
            self._tell(differs.raised(found[0], items=", ".join(found[1])))

    # Time.

    async def _beats(self) -> None:
        while True:
            due = self._clock.monotonic() + self.settings.beat
            self._beat(self._clock.monotonic())
            await sleep_until(self._clock, due)

    def _beat(self, now: float) -> None:
        for alarm in self._sentinel.beat(now):
            self._tell(alarm)
        token = self.authority.token
        self._joiner.beat(now, token)
        self._orders.beat(now)
        if self._orders.owing or now - self._paid_at >= 1.0:
            self._orders.pay()
        if now - self._paid_at >= 1.0:
            self._paid_at = now
            allowed = not self._sentinel.refusal(self.field.clusters)
            self._pusher.beat(now, token, allowed)

    def _tell(self, alarm: Alarm) -> None:
        self.alarms.append(alarm)
        if self._on_alarm is not None:
            self._on_alarm(alarm)

    # Anybody.

    def defocus(self, who: str, heliostats: Sequence[str] = ()) -> Ticket:
        """Take beams off the receiver now: of some heliostats, or of all; anybody may."""
        return self._safe(who, Act.DEFOCUS, heliostats)

    def stow(self, who: str, heliostats: Sequence[str] = ()) -> Ticket:
        """Send heliostats to stow, or all; anybody may."""
        return self._safe(who, Act.STOW, heliostats)

    def _safe(self, who: str, act: Act, heliostats: Sequence[str]) -> Ticket:
        for name in heliostats:
            self.field.place(name)
        whom = tuple(heliostats) or self.field.names
        self._joining.drop(f"{act.name} by {who}", frozenset(whom))
        return self._sentinel.send_safe((who, "anybody"), act, whom, "")

    def raise_emergency(self, who: str, act: Act = Act.DEFOCUS, reason: str = "") -> EmergencyOrder:
        """Order DEFOCUS or STOW of the whole field with proof; anybody may.

        It holds until it is withdrawn and the rows that it trips are acknowledged.

        Raises
        ------
        InputError
            Another act.
        """
        if act not in (Act.DEFOCUS, Act.STOW):
            raise InputError(f"emergency: {act.name} is none; give DEFOCUS or STOW")
        return self._sentinel.call(who, act, reason or f"emergency order of {who}")

    def put(self, name: str, value: float, subject: str = "") -> None:
        """Take a reading of the safety table from a sensor, taken now.

        Raises
        ------
        UnknownNameError
            If it is not one of the settings' sensors.
        """
        if name not in self._watch.sensors:
            raise UnknownNameError("sensor of the plant", name, self._watch.sensors)
        self._watch.put(name, value, self._clock.monotonic(), subject)

    def put_flux(self, share: float) -> None:
        """Take the flux on the receiver as a share of the nominal, measured now, as proof."""
        order = self._sentinel.order
        if order is not None:
            order.take_flux(share, self._clock.monotonic())

    @property
    def emergency(self) -> EmergencyOrder | None:
        """The last order to the whole field, None before the first."""
        return self._sentinel.order

    @property
    def unwatched(self) -> tuple[str, ...]:
        """Rows of the safety table that nobody gives readings for."""
        return self._watch.unwatched

    @property
    def emergency_on(self) -> bool:
        """Whether an emergency of the whole field holds."""
        return self._sentinel.on

    @property
    def waiting(self) -> int:
        """How many mirrors wait to join the receiver."""
        return len(self._joining)

    @property
    def orders(self) -> tuple[Ticket, ...]:
        """Commands that have not come to their end."""
        return self._orders.open

    def sun_vector(self) -> FloatArray:
        """Return the unit vector to the sun now, ENU, (3,)."""
        return fast_vector(self._clock.utc().timestamp(), self.design.site)

    @property
    def clock(self) -> Clock:
        """What tells the time here."""
        return self._clock

    def now(self) -> float:
        """Return the monotonic time, s."""
        return self._clock.monotonic()

    # The authority.

    def take_authority(self, person: Person) -> Grant:
        """Take the command authority, if nobody has it.

        Raises
        ------
        RefusedError
            See `Authority.take`.
        """
        before = self.authority.token
        grant = self.authority.take(person)
        if grant.token != before:
            self._orders.note(person.name, person.role.name.lower(), "AUTHORITY", "taken")
        return grant

    def seize_authority(self, person: Person, reason: str) -> Grant:
        """Break another's command authority and take it.

        Raises
        ------
        RefusedError
            See `Authority.seize`.
        """
        before = self.authority.grant
        grant = self.authority.seize(person, reason)
        whom = "nobody" if before is None else before.holder.name
        note = f"broken, from {whom}: {reason}"
        self._orders.note(person.name, person.role.name.lower(), "AUTHORITY", note)
        return grant

    def release_authority(self, person: Person, token: int) -> None:
        """Give the command authority back; what waits to join is dropped.

        Raises
        ------
        RefusedError
            If it is not theirs.
        """
        self.authority.release(person, token)
        self._orders.note(person.name, person.role.name.lower(), "AUTHORITY", "released")

    def withdraw_emergency(self, person: Person) -> None:
        """Take an emergency order back; rows that it tripped wait for `acknowledge`.

        Raises
        ------
        RefusedError
            To a viewer.
        """
        if person.role < Role.OPERATOR:
            raise RefusedError(f"emergency: {person.name} is viewer; it needs operator")
        self._sentinel.called = False
        self._orders.note(person.name, person.role.name.lower(), "WITHDRAW", "emergency order")

    def acknowledge(self, person: Person, condition: str, subject: str = "") -> None:
        """Acknowledge a row of the safety table that waits for it.

        Parameters
        ----------
        person
            Whose role is high enough for the row.
        condition, subject
            As the alarm tells them. A row that a cluster watches has the cluster as subject; the
            cluster judges, and tells with an alarm that it is over.

        Raises
        ------
        RefusedError
            If the role is too low, or its cause has not gone.
        """
        role, title = person.role.acknowledges_as, person.role.name.lower()
        if role is None:
            raise RefusedError(f"{condition}: {person.name} is viewer; it needs operator")
        if condition in self._watch.rows or subject not in self._ends:
            refusal = self._watch.acknowledge(condition, person.name, role, subject)
            if refusal:
                raise RefusedError(refusal)
        else:
            self._asked += 1
            identity = f"acknowledge-{self._asked}"
            message = Acknowledge(identity, condition, person.name, role.name.lower())
            self._ends[subject].post(message, 5.0)
        note = f"{condition} {subject}".strip()
        self._orders.note(person.name, title, "ACKNOWLEDGE", note)

    # Commands.

    def command(
        self,
        person: Person,
        token: int,
        name: str,
        heliostats: Sequence[str] = (),
        values: Sequence[float] = (),
    ) -> Ticket:
        """Give a command of the wire to some heliostats, or to all.

        Parameters
        ----------
        person, token
            Who, with the token of the authority.
        name, values
            As in `lcu.messages`; for AIM and STANDBY see `aim` and `standby`.
        heliostats
            Names; () for all.

        Raises
        ------
        RefusedError
            If it is not accepted; nothing is sent then.
        InputError
            An unknown name, or values that do not fit.
        """
        if name in ("DEFOCUS", "STOW"):
            return self._safe(person.name, Act[name], heliostats)
        row = wire.ROW_OF.get(wire.NUMBER_OF.get(name, -1))
        if row is None or row[2] != wire.AUTHORITY or name in POINTS:
            known = [r[1] for r in wire.MESSAGES if r[2] == wire.AUTHORITY and r[1] not in POINTS]
            raise UnknownNameError("command (points are given by aim and standby)", name, known)
        numbers = whole(values, row[3], name)
        whom = tuple(dict.fromkeys(heliostats)) or self.field.names
        clear, blocked = self._ways.clear(name, numbers, whom, self.now())
        ticket = self._accept(person, token, name, numbers, whom)
        ticket.block(blocked)
        if name not in SETTINGS:
            # What still waits to join must not undo what is commanded after it.
            self._joining.drop(f"{name} came after it", frozenset(whom))
        if name in JOINING:
            self._join(ticket, name, numbers, clear, token)
        else:
            self._orders.command(ticket, name, numbers, clear, token)
        return ticket

    def default_aims(
        self, heliostats: Sequence[str] = (), points: npt.ArrayLike | None = None
    ) -> dict[str, FloatArray]:
        """Return an aim for each heliostat (() for all), for `aim`; see `aims.default_aims`."""
        names = tuple(heliostats) or self.field.names
        rows = np.array([self.field.place(name) for name in names], dtype=np.intp)
        vertices = self.beams.armature.origin_1[rows]
        return default_aims(self.design, names, vertices, points)

    def aim(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Aim heliostats at points that stop their beams: on the receiver or on a target.

        Mirrors that track join their new aim as slowly as the receiver.

        Parameters
        ----------
        person, token
            Who, with the token of the authority.
        points
            ENU, m, (3,), by name.

        Raises
        ------
        RefusedError
            If it is not accepted, or one of the beams may not go there.
        """
        return self._point(person, token, "AIM", points)

    def standby(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Set standby points, beyond which beams go on; see `aim`."""
        return self._point(person, token, "STANDBY", points)

    def parameters(
        self, person: Person, token: int, heliostat: str, items: Mapping[str, bytes]
    ) -> Ticket:
        """Push items of the journal to one heliostat (see `control.parameters`), and want them.

        Raises
        ------
        RefusedError
            If it is not accepted.
        InputError
            Items that no plant pushes.
        """
        self.field.place(heliostat)
        self.wanted.check(heliostat, items)
        note = ", ".join(items)
        ticket = self._accept(person, token, "PARAMETERS", (), (heliostat,), note)
        self.wanted.set(heliostat, items)
        self._orders.parameters(ticket, heliostat, items, token)
        self._pusher.follow(heliostat, ticket)
        return ticket

    def _believe(self, record: HeliostatCalibration) -> None:
        """Check beams by a new calibration, and want it of the local controller."""
        mechanism = self.beliefs.present(record.heliostat)[0]
        row = self.field.place(record.heliostat)
        self.beams.replace(row, mechanism.armature.table, mechanism.drives.table)
        self.wanted.set(record.heliostat, items_of(mechanism))

    async def stored(self, heliostat: str, timeout: float = 15.0) -> dict[str, int]:
        """Return the checksums of what a local controller has stored, by item.

        Raises
        ------
        RefusedError
            If no answer comes.
        """
        identity = self._ask_stored(heliostat)
        future = self._answers[identity] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(timeout):
                answer = await future
        except TimeoutError:
            raise RefusedError(
                f"{heliostat}: what it has stored was not told within {timeout:g} s; is it there?"
            ) from None
        finally:
            self._answers.pop(identity, None)
        items = stored_items(answer)
        if not items:
            raise RefusedError(f"{heliostat}: {answer.data.get('error', 'nothing is stored')}")
        return checksums(items)

    def _point(
        self, person: Person, token: int, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> Ticket:
        whom = tuple(points)
        rows = np.array([self.field.place(n) for n in whom], dtype=np.intp)
        wanted = points_of(name, points)
        tracking = self.field.among(_ON_AIM, self.now())[rows]
        self._ways.check_points(name, rows, wanted, tracking)
        groups = grouped(whom, wanted)
        values = next(iter(groups)) if len(groups) == 1 else ()
        ticket = self._accept(person, token, name, values, whom, f"{len(groups)} points")
        if problem := self._points.assign(name, rows, wanted):
            ticket.advance(whom, Stage.FAILED, f"not sent, since it is not kept: {problem}")
            return ticket
        self._joining.drop(f"another {name} came after it", frozenset(whom), name)
        moving = {whom[i] for i in np.flatnonzero(tracking)} if name == "AIM" else set()
        for point, members in groups.items():
            still = [n for n in members if n not in moving]
            if still:
                self._orders.command(ticket, name, point, still, token)
            if len(still) < len(members):
                self._join(ticket, name, point, [n for n in members if n in moving], token)
        return ticket

    def _join(
        self,
        ticket: Ticket,
        name: str,
        values: tuple[float, ...],
        heliostats: Sequence[str],
        token: int,
    ) -> None:
        until = self.now() + self.settings.join_wait
        self._joining.put(Job(ticket, name, values, token, deque(heliostats), until))

    def _accept(
        self,
        person: Person,
        token: int,
        name: str,
        values: tuple[float, ...],
        heliostats: Sequence[str],
        note: str = "",
    ) -> Ticket:
        rows = [self.field.place(n) for n in heliostats]
        self.authority.check(person, token, name)
        clusters = {self.field.clusters[self.field.cluster[row]] for row in rows}
        reason = "" if name == "LOCK" else self._sentinel.refusal(clusters)
        if reason:
            raise RefusedError(f"{name}: not accepted now: {reason}")
        try:
            return self._orders.accept(
                (person.name, person.role.name.lower(), name), values, heliostats, note
            )
        except AuditError as error:
            raise RefusedError(
                f"{name}: not accepted, since it cannot be recorded: {error}"
            ) from None
