"""The cluster controller: master of one bus, with up to 32 heliostats on it.

Every second it broadcasts session, time and sun, asks each local controller for its state in the
order of addresses, does what the plant has ordered meanwhile, and tells the plant. DEFOCUS and STOW
go before everything. One task alone uses the bus, so frames go out in the order in which they were
numbered; a second listens to the plant, a third talks to it and may wait for it.

What keeps the field safe without anybody: the sun is sent only while the plant's lease (and the
autonomy that it grants) lasts, the time is sound, and no row of the safety table says otherwise.
Without the sun every local controller defocuses by itself. At a start nothing moves: it takes a
lease, and then a command.

::

    cluster = Cluster(config, bus, link, clock, time)
    async with running(bus, link, time):
        async with running(cluster):       # closing it defocuses first
            ...
"""

import asyncio
import contextlib
from collections.abc import Callable, Sequence
from typing import Any

from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._goals import BEAM_OUT, Goals
from heliotrope.cluster._nodes import STATUS, STEPS, Node, rows
from heliotrope.cluster._orders import Orders, Refusal
from heliotrope.cluster._questions import Asked
from heliotrope.cluster._reports import Reports
from heliotrope.cluster._urgent import NAMES, Urgent
from heliotrope.cluster._watch import Watch
from heliotrope.cluster.config import ClusterConfig
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import Time, TimeKeeper
from heliotrope.lcu import names, states, wire
from heliotrope.links.clock import WEEK, Clock
from heliotrope.links.link import Bus, Link, LinkClosedError, LinkError, Outcome
from heliotrope.links.link import messages as received
from heliotrope.links.messages import (
    Acknowledge,
    Answer,
    Ask,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    ProtocolError,
    Stage,
    Status,
    decode,
    encode,
)
from heliotrope.safety import Act, Alarm, Role, alarms
from heliotrope.sun import broadcast_values

#: Of TIME on the wire.
_QUALITIES = ("none", "gps", "holdover", "system")
#: A node that missed so many questions in a row is asked only in every so many seconds.
_ABSENT, _PROBE = 3, 5
#: Polling ends so long after the beginning of the second, s.
_ROUND = 0.95
#: The beginning of the second is shifted by at most so much at a time, s.
_STEER = 0.1
#: Commands answered "duplicate" in a row, for no known reason, that begin a new epoch.
_OUT_OF_STEP = 3
#: A message to the plant is worth so long, s.
_NEWS_LIFE = 5.0
_STATUS_LIFE = 1.0
#: The names of the rows are repeated after so many status: the message of before may be lost.
_NAMES_EVERY = 10
_UNBOUNDED = 1e9


class Cluster:
    """A cluster controller; see the head of this module.

    Parameters
    ----------
    config
        What it is.
    bus, link
        To the heliostats, and to the plant; run by the owner.
    clock
        Its monotonic time decides all that has a limit.
    time
        Where GPS and UTC come from; run by the owner.
    kept
        Epoch and editions; None: nothing outlasts this object.
    line
        Returns whether current flows in the hard-wired emergency line; None: there is none.

    Attributes
    ----------
    nodes
        Its local controllers, in the order of the configuration.
    cycle
        Duration of the last round of polling, s.
    overruns
        Rounds that did not end within their second.
    """

    def __init__(
        self,
        config: ClusterConfig,
        bus: Bus,
        link: Link,
        clock: Clock,
        time: TimeKeeper,
        kept: Kept | None = None,
        line: Callable[[], bool] | None = None,
    ) -> None:
        self.config = config
        self._link, self._clock, self._time = link, clock, time
        self._kept = kept or Kept(None)
        self.nodes = [Node(member, index) for index, member in enumerate(config.heliostats)]
        self._names = tuple(node.name for node in self.nodes)
        self._by_address = sorted(self.nodes, key=lambda node: node.address)
        now, present = clock.monotonic(), time.time()
        # Without a file the time alone makes sure that the epoch is above that of any run before.
        self._epoch_of_time = _known(present)
        epoch = self._kept.start(int(present.gps_s) if self._epoch_of_time else 0)
        self._exchange = Exchange(bus, clock, epoch, config.answer)
        self._reports = Reports()
        self._goals = Goals(self._reports)
        self._watch = Watch(config.name, config.longest_autonomy, self._reports, now, line)
        self._urgent = Urgent(
            self.nodes, self._exchange, self._goals, self._reports, clock.monotonic
        )
        self._orders = Orders(
            config,
            self.nodes,
            self._exchange,
            self._goals,
            self._reports,
            self._kept,
            clock.monotonic,
            self._bus_time,
            self._look,
        )
        self._asked = Asked(config, self.nodes, self._exchange, self._reports, clock.monotonic)
        # The first call loads the libraries, which takes longer than a second may.
        broadcast_values(0, present.utc_s if self._epoch_of_time else 0.0, config.site)
        self._started = now
        self._number = 0  # of the second
        self._next = 0  # whom the last round did not reach
        self._offset: float | None = None  # GPS minus monotonic, as the nodes were told
        self._wake, self._news = asyncio.Event(), asyncio.Event()
        self._closing, self._ended = False, asyncio.Event()
        self._running = False
        self._opened = -1
        self._was_connected = False
        self._told_names = 0  # in which second
        self._silent: set[int] = set()
        self._strange: set[int] = set()
        self.cycle = 0.0
        self.overruns = 0

    # -- life ------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run until closed; then defocus, and end.

        Raises
        ------
        LinkError
            If it runs already.
        """
        if self._running:
            raise LinkError(f"cluster {self.config.name}: it runs already")
        self._running = True
        try:
            async with asyncio.TaskGroup() as group:
                others = [group.create_task(self._listen()), group.create_task(self._tell())]
                with contextlib.suppress(LinkClosedError):  # the bus was closed before us
                    await self._master()
                for other in others:
                    other.cancel()
        finally:
            self._running = False
            self._ended.set()

    async def close(self) -> None:
        """Defocus, and end ``run``; returns when that is done."""
        self._closing = True
        self._wake.set()
        if self._running:
            await self._ended.wait()

    async def _master(self) -> None:
        """Do one second after the other: the only task that uses the bus."""
        due = self._clock.monotonic()
        present = self._time.time()
        if _known(present):
            due += 1.0 - (present.gps_s - self.config.phase) % 1.0
        while not self._closing:
            await self._serve_until(due)
            if not self._closing:
                due = await self._second()
        if self._exchange.connected:
            for _ in range(3):
                await self._exchange.broadcast("DEFOCUS", urgent=True)

    async def _serve_until(self, due: float) -> None:
        """Until the next second begins, do what is ordered; an emergency wakes it at once."""
        while not self._closing and (left := due - self._clock.monotonic()) > 0.0:
            if self._busy():
                await self._serve()
                continue
            self._wake.clear()
            alarm = asyncio.get_running_loop().call_later(max(left, 1e-6), self._wake.set)
            try:
                await self._wake.wait()
            finally:
                alarm.cancel()

    def _busy(self, *, patient: bool = True) -> bool:
        """Whether something is to be done; questions wait until polling is over."""
        return self._exchange.connected and (
            self._urgent.pressing or self._orders.ready or (patient and self._asked.ready)
        )

    async def _serve(self) -> None:
        """Do one thing that is ordered, the urgent first."""
        if self._urgent.pressing:
            await self._urgent.serve()
        elif self._orders.ready:
            self._orders.token = self._authority()
            await self._orders.serve()
        else:
            await self._asked.serve()
        if self._reports.waiting:
            self._news.set()

    def _authority(self) -> int:
        """Return the token of who commands, 0 once lease and autonomy are over."""
        return 0 if self._watch.alone(self._clock.monotonic()) else self._watch.token

    # -- a second --------------------------------------------------------------------------

    async def _second(self) -> float:
        """Do what is due once a second, and return when the next one begins."""
        begin = self._clock.monotonic()
        present = self._time.time()
        self._number += 1
        verdict = self._watch.second(present, self._exchange.second(), begin)
        if verdict.new is not None:
            self._act(Act.STOW if verdict.new is Act.STOW else Act.DEFOCUS)
        self._orders.token = self._authority()
        self._asked.second()
        if self._orders.out_of_step >= _OUT_OF_STEP:
            self._new_epoch(0)
        self._urgent.second()
        if self._urgent.pressing and self._exchange.connected:
            await self._urgent.serve()
        if self._exchange.connected:
            # An emergency on a bus that is silent takes seconds: what counts is the time now.
            await self._broadcast(self._time.time(), self._clock.monotonic())
            self._orders.second()
            await self._round(begin + _ROUND)
        self._goals.second(self.nodes, begin)
        self._look_for_silence(begin)
        self.cycle = self._clock.monotonic() - begin
        self._report(begin)
        return self._next_due(begin, present)

    def _next_due(self, begin: float, present: Time) -> float:
        ahead = 0.0
        if _known(present):
            # Where this second should have begun, as the time says, within half a second.
            ahead = (present.gps_s - self.config.phase + 0.5) % 1.0 - 0.5
        return begin + 1.0 - max(-_STEER, min(_STEER, ahead))

    async def _broadcast(self, present: Time, now: float) -> None:
        """Session, time and sun: who has just started takes nothing before a session."""
        exchange = self._exchange
        sound = _known(present) and not present.jumped
        if sound and not self._epoch_of_time:
            self._new_epoch(int(present.gps_s))
        await exchange.transmit(exchange.sender.session(exchange.token(self._watch.token)))
        if sound:
            gps = present.gps_s + self._clock.monotonic() - now
            week, seconds = divmod(gps, WEEK)
            quality = _QUALITIES.index(present.quality)
            if await exchange.broadcast("TIME", int(week), int(1000.0 * seconds), quality):
                self._offset = present.gps_s - now
        if sound and not self._watch.verdict.dark and not self._watch.alone(now):
            second = round(present.gps_s - self.config.phase)
            utc_s = present.utc_s - (present.gps_s - second)
            values = broadcast_values(second, utc_s, self.config.site)
            if values is not None:
                await exchange.broadcast("SUN", *values)

    def _new_epoch(self, at_least: int) -> None:
        sender = self._exchange.sender
        try:
            sender.epoch, sender.count = self._kept.start(at_least), 0
            self._reports.clear(alarms.STATE_UNWRITABLE.ended())
        except OSError as error:
            self._reports.alarm(alarms.STATE_UNWRITABLE.raised(problem=error))
        self._epoch_of_time = self._epoch_of_time or at_least > 0
        self._orders.out_of_step = 0

    def _bus_time(self) -> float | None:
        """Return the GPS time as the nodes know it."""
        return None if self._offset is None else self._clock.monotonic() + self._offset

    async def _round(self, until: float) -> None:
        """Ask every node once, in the order of addresses; orders are done in between."""
        nodes, count = self._by_address, len(self.nodes)
        first, self._next = self._next, 0
        now = self._clock.monotonic()
        for place in range(first, first + count):
            if now >= until or self._closing:
                self._next = place % count
                self.overruns += 1
                return
            node = nodes[place % count]
            if node.missed < _ABSENT or (self._number + node.index) % _PROBE == 0:
                now = await self._poll(node, now)
            if self._busy(patient=False):
                await self._serve()
                now = self._clock.monotonic()

    async def _look(self, node: Node) -> None:
        """Ask a node for its state, between two rounds."""
        await self._poll(node, self._clock.monotonic())

    async def _poll(self, node: Node, now: float) -> float:
        """Ask a node for state and step counts; ``now`` at the beginning, returned at the end."""
        exchange, sequence = self._exchange, node.next_sequence()
        status = await exchange.poll(node, STATUS, sequence, now)
        if status is None or not self._believes(node, status):
            return exchange.now
        waits = self._goals.waits(node)
        due = (self._number + node.index) % self.config.steps_every == 0
        if waits or due or now < node.follow_until:
            steps = await exchange.poll(node, STEPS, sequence, exchange.now)
            if steps is not None:
                node.steps, node.steps_at = steps, node.heard_at
        if waits:
            self._goals.heard(node, now)
        return exchange.now

    def _believes(self, node: Node, status: tuple[Any, ...]) -> bool:
        """Take a STATUS; False if its firmware has states that this side doesn't know."""
        if status[0] >= len(states.STATES):
            self._reports.alarm(alarms.NODE_UNINTELLIGIBLE.raised(node.name, state=status[0]))
            self._strange.add(node.index)
            return False
        if node.index in self._strange:
            self._strange.remove(node.index)
            self._reports.clear(alarms.NODE_UNINTELLIGIBLE.ended(node.name))
        before, node.status, node.status_at = node.status, status, node.heard_at
        if before[2] != status[2]:
            self._fault(node)
        if self._watch.verdict.dark and status[0] in BEAM_OUT and not self._urgent.waits(node):
            # It has missed the call, or came back from somewhere.
            self._urgent.begin("", "DEFOCUS", [node])
        return True

    # -- what is found ---------------------------------------------------------------------

    def _act(self, act: Act) -> None:
        """Obey the safety table: everybody, and what was ordered before is void."""
        why = "; ".join(self._watch.verdict.acts)
        self._orders.cancel(self.nodes, f"overruled: {why}")
        self._urgent.begin("", act.name, list(self.nodes))

    def _fault(self, node: Node) -> None:
        if node.fault:
            known = node.fault < len(names.FAULTS)
            text = names.FAULTS[node.fault] if known else f"fault {node.fault}"
            self._reports.alarm(alarms.NODE_FAULT.raised(node.name, fault=text))
        else:
            self._reports.clear(alarms.NODE_FAULT.ended(node.name))

    def _look_for_silence(self, now: float) -> None:
        limit = self.config.silence
        for node in self.nodes:
            silent = now - max(node.heard_at, self._started) > limit
            if silent and node.index not in self._silent:
                self._silent.add(node.index)
                self._tell_silence(node, limit)
            elif not silent and node.index in self._silent:
                self._silent.remove(node.index)
                self._reports.clear(alarms.NODE_SILENT.ended(node.name))

    def _tell_silence(self, node: Node, limit: float) -> None:
        out = node.known and node.state in BEAM_OUT
        if not node.known:
            last = "never heard" if node.heard_at < self._started else "its state was never heard"
        else:
            last = f"its last state was {states.STATES[node.state]}"
            last += "; where its beam is, is not known" if out else ""
        self._reports.alarm(
            alarms.NODE_SILENT.raised(node.name, worse=out, silence=limit, last=last)
        )

    # -- the plant -------------------------------------------------------------------------

    async def _listen(self) -> None:
        async for data in received(self._link):
            try:
                message = decode(data)
            except ProtocolError as error:
                self._reports.event(alarms.PLANT_UNINTELLIGIBLE.raised(problem=error))
            else:
                self._take(message)
            if self._reports.waiting:
                self._news.set()

    def _take(self, message: Message) -> None:
        """Take a message of the plant."""
        if isinstance(message, Lease):
            refusal = self._watch.take(message, self._clock.monotonic())
            if refusal:
                self._reports.alarm(alarms.LEASE_REFUSED.raised(problem=refusal))
            else:
                self._reports.clear(alarms.LEASE_REFUSED.ended())
                self._orders.token = self._authority()
        elif isinstance(message, Emergency):
            self._take_emergency(message.identity, message.name, message.heliostats)
        elif isinstance(message, Command):
            if message.name in NAMES:
                self._take_emergency(message.identity, message.name, message.heliostats)
            else:
                self._orders.token = self._authority()
                self._orders.accept(message, self._watch.verdict.forbidden)
        elif isinstance(message, Parameters):
            self._orders.token = self._authority()
            self._orders.accept_parameters(message)
        elif isinstance(message, Ask):
            self._asked.take(message)
        elif isinstance(message, Acknowledge):
            self._take_acknowledgement(message)
        elif isinstance(message, Status | Progress | Alarm | Answer):
            text = f"a {message.kind} came from the plant; only clusters send it"
            self._reports.event(alarms.PLANT_UNINTELLIGIBLE.raised(problem=text))
        self._wake.set()

    def _take_emergency(self, identity: str, name: str, heliostats: Sequence[str]) -> None:
        try:
            if name not in NAMES:
                raise Refusal(f"{name!r} is no emergency; give DEFOCUS or STOW")
            nodes = self._orders.chosen(heliostats)
        except Refusal as refusal:
            self._reports.add(identity, Stage.REFUSED, text=str(refusal))
            return
        self._orders.cancel(nodes, f"{name} came before it")
        self._urgent.begin(identity, name, nodes)
        self._exchange.interrupt()

    def _take_acknowledgement(self, message: Acknowledge) -> None:
        try:
            role = Role[message.role.upper()]
        except KeyError:
            known = " or ".join(each.name.lower() for each in Role)
            refusal = f"role {message.role!r} is not known; give {known}"
        else:
            refusal = self._watch.acknowledge(message.condition, message.who, role)
        stage = Stage.REFUSED if refusal else Stage.DONE
        self._reports.add(message.identity, stage, text=refusal)

    def _report(self, begin: float) -> None:
        """Make the status of this second."""
        link = self._link
        connected, opened = link.connected, link.statistics.opened
        greet = connected and (opened != self._opened or not self._was_connected)
        self._was_connected = connected
        if greet:
            self._opened, self._told_names = opened, self._number
            self._reports.greet()
        present, now = self._time.time(), self._clock.monotonic()
        self._reports.status(
            Status(
                cluster=self.config.name,
                count=len(self.nodes),
                utc_s=present.utc_s,
                time_quality=present.quality,
                time_error_s=min(present.error, _UNBOUNDED),
                lease_left=self._watch.lease_left(now),
                cycle_s=now - begin,
                acts=self._watch.verdict.acts,
                names=self._names if (self._number - self._told_names) % _NAMES_EVERY == 0 else (),
                block=rows(self.nodes, now),
            )
        )
        self._news.set()

    async def _tell(self) -> None:
        """Send what is to be told, while the plant is there to hear it."""
        with contextlib.suppress(LinkClosedError):
            while True:
                self._news.clear()
                if self._link.connected:
                    for message in self._reports.take():
                        life = _STATUS_LIFE if isinstance(message, Status) else _NEWS_LIFE
                        expires = self._clock.monotonic() + life
                        outcome = await self._link.send(encode(message), expires=expires)
                        if outcome is not Outcome.SENT and isinstance(message, Status):
                            self._opened = -1  # the names may not have arrived
                await self._news.wait()

    def line(self) -> str:
        """Return the state in one line, for a log."""
        counts = [0] * len(states.STATES)
        for node in self.nodes:
            if node.known:
                counts[node.state] += 1
        shown = [f"{states.STATES[i]} {n}" for i, n in enumerate(counts) if n]
        if unknown := len(self.nodes) - sum(counts):
            shown.append(f"not heard {unknown}")
        present, now = self._time.time(), self._clock.monotonic()
        lease = self._watch.lease_left(now)
        return (
            f"{self.config.name}: {' '.join(shown)}; silent {len(self._silent)}; "
            f"cycle {self.cycle:.2f} s; "
            f"time {present.quality} ±{min(present.error, 999.0):.2g} s; "
            f"plant {'here' if self._link.connected else 'away'}, "
            f"lease {'over' if lease <= 0.0 else f'{lease:.1f} s'}"
            + ("".join(f"; {act}" for act in self._watch.verdict.acts))
        )


def _known(time: Time) -> bool:
    """Whether a time can be sent: the limit of its error is the safety table's."""
    return time.quality != "none" and time.error < 1.0


assert wire.CLUSTER_ADDRESS == 0
