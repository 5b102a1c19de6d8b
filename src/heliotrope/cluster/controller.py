"""The cluster controller: master of one bus with up to 32 heliostats.

Every second the controller broadcasts session, time and sun vector (`_broadcast`), polls each local
controller in the order of addresses (`_polling`), carries out the plant's orders between polls
(`_work`: `_emergencies`, then `_orders`, then `_questions`), and reports to the plant
(`_plant_link`). Only one task uses the bus, so frames are sent in the order of their numbers; a
second task receives from the plant; a third sends to the plant and may wait for it.

The field is safe when left alone: the sun vector is sent only while the plant's lease (and the
autonomy that it grants) is valid, the time is reliable, and no row of the safety table requires
otherwise (`_watch`). Without the sun vector every local controller defocuses by itself. At start-up
the cluster broadcasts DEFOCUS, because it does not know which heliostats are tracking; then it
waits for a lease, and for a command.

::

    cluster = Cluster(config, bus, link, clock, time)
    async with running(bus, link, time):
        async with running(cluster):       # closing it defocuses first
            ...
"""

import asyncio
import contextlib
from collections.abc import Callable

from heliotrope.cluster._broadcast import Broadcast
from heliotrope.cluster._bus_keys import BusKeys
from heliotrope.cluster._bus_log import RecordedBus
from heliotrope.cluster._emergencies import Emergencies
from heliotrope.cluster._epoch import Epoch
from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._goals import Goals
from heliotrope.cluster._nodes import Nodes
from heliotrope.cluster._orders import Orders
from heliotrope.cluster._plant_link import PlantLink
from heliotrope.cluster._polling import Polling
from heliotrope.cluster._questions import Questions
from heliotrope.cluster._reports import Reports
from heliotrope.cluster._watch import Watch
from heliotrope.cluster._work import Work
from heliotrope.cluster.config import ClusterConfig
from heliotrope.cluster.memory import Kept
from heliotrope.cluster.timekeeping import Time, TimeKeeper
from heliotrope.lcu import states
from heliotrope.links.clock import Clock
from heliotrope.links.keys import KeyRing
from heliotrope.links.link import Bus, Link, LinkClosedError, LinkError
from heliotrope.safety import Alarm
from heliotrope.sun import broadcast_values

#: Polling ends this long after the beginning of the second, s.
_ROUND = 0.95
#: The beginning of the second is shifted by at most this amount at a time, s.
_STEER = 0.1


class Cluster:
    """A cluster controller; see the docstring of this module.

    Parameters
    ----------
    config
        Site, heliostats and limits.
    bus, link
        Bus to the heliostats, and link to the plant; the owner runs both.
    clock
        Clock whose monotonic time measures all limits.
    time
        Source of GPS time and UTC; the owner runs it.
    kept
        Epoch and editions; if None, nothing survives this object.
    line
        Function that returns whether current flows in the hard-wired emergency line; None if there
        is no line.
    bus_keys
        Keys that sign the frames on the bus; None if frames are not signed.

    Attributes
    ----------
    nodes
        The local controllers, in the order of the configuration.
    cycle
        Duration of the last second's work, s.
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
        bus_keys: KeyRing | None = None,
    ) -> None:
        self.config, self._clock, self._time = config, clock, time
        kept = kept or Kept(None)
        self.nodes = Nodes(config)
        now, present = clock.monotonic(), time.time()
        reports = self._reports = Reports()
        goals = Goals(reports)
        recorded = RecordedBus(bus, clock)
        self._exchange = Exchange(recorded, clock, config.answer, config.stored_answer)
        self._watch = Watch(
            config.name, config.longest_autonomy, reports, now, present, config.limits, line
        )
        epoch = Epoch(kept, self._exchange, reports, present)
        emergencies = Emergencies(self.nodes, self._exchange, goals, reports, clock.monotonic)
        self._bus_keys = BusKeys(
            config.name, bus_keys, self.nodes, self._exchange, reports, kept, clock.monotonic
        )
        self._broadcast = Broadcast(
            config, self._exchange, self._watch, epoch, self._bus_keys, clock
        )
        self._polling = Polling(
            config, self.nodes, self._exchange, goals, reports, self._watch, emergencies, clock
        )
        orders = Orders(
            self.nodes,
            self._exchange,
            goals,
            reports,
            self._watch,
            epoch,
            self._broadcast.bus_time,
            self._polling.look,
        )
        questions = Questions(self.nodes, self._exchange, recorded, reports, clock.monotonic)
        self._work = Work(
            self.nodes, self._exchange, emergencies, orders, questions, reports, epoch
        )
        self._wake = asyncio.Event()
        self._plant = PlantLink(
            config,
            link,
            clock,
            self.nodes,
            self._watch,
            self._work,
            reports,
            self._wake.set,
        )
        # The first call loads libraries, which takes longer than a second may.
        broadcast_values(0, present.utc_s if present.usable else 0.0, config.site)
        self._closing, self._ended = asyncio.Event(), asyncio.Event()
        self._running = False
        self.cycle = 0.0

    @property
    def connected(self) -> bool:
        """Whether the link to the plant is connected."""
        return self._plant.connected

    @property
    def lease_left(self) -> float:
        """Remaining time of the plant's lease, s; below 0 if no plant controls the cluster."""
        return self._watch.lease_left(self._clock.monotonic())

    async def run(self) -> None:
        """Run until closed; then defocus, and return.

        Raises
        ------
        LinkError
            If the controller is already running.
        """
        if self._running:
            raise LinkError(f"cluster {self.config.name}: it is already running")
        self._running = True
        try:
            async with asyncio.TaskGroup() as group:
                others = [
                    group.create_task(self._plant.listen()),
                    group.create_task(self._plant.tell()),
                ]
                with contextlib.suppress(LinkClosedError):  # the bus was closed before us
                    await self._master()
                for other in others:
                    other.cancel()
        finally:
            self._running = False
            self._ended.set()

    async def close(self) -> None:
        """Defocus and stop ``run``; return when that is done."""
        self._closing.set()
        self._wake.set()
        if self._running:
            await self._ended.wait()

    async def _master(self) -> None:
        """Run one second after another; this is the only task that uses the bus."""
        due = self._clock.monotonic()
        present = self._time.time()
        if present.usable:
            due += 1.0 - (present.gps_s - self.config.phase) % 1.0
        while not self._closing.is_set():
            await self._serve_until(due)
            if not self._closing.is_set():
                due = await self._second()
        if self._exchange.connected:
            for _ in range(3):
                await self._exchange.broadcast("DEFOCUS", urgent=True)

    async def _serve_until(self, due: float) -> None:
        """Carry out orders until the next second begins; an emergency wakes this task at once."""
        while not self._closing.is_set() and (remaining := due - self._clock.monotonic()) > 0.0:
            if self._work.ready():
                await self._work.serve()
                continue
            self._wake.clear()
            alarm = asyncio.get_running_loop().call_later(max(remaining, 1e-6), self._wake.set)
            try:
                await self._wake.wait()
            finally:
                alarm.cancel()

    async def _second(self) -> float:
        """Carry out the tasks of one second and return when the next second begins."""
        begin = self._clock.monotonic()
        present = self._time.time()
        self._polling.begin_second()
        verdict = self._watch.second(present, self._exchange.second(), begin)
        if verdict.new is not None:
            self._work.obey(verdict.new.name, "; ".join(verdict.acts))
        await self._work.begin_second()
        if self._exchange.connected:
            # An emergency on a silent bus takes seconds, and the broadcast needs the present time.
            await self._broadcast.second(self._time.time())
            self._work.resume()
            await self._polling.round(begin + _ROUND, self._work, self._closing)
            await self._bus_keys.supply()
        self._polling.end_second(begin)
        self.cycle = self._clock.monotonic() - begin
        self._plant.report(self._time.time(), begin)
        return self._next_due(begin, present)

    def _next_due(self, begin: float, present: Time) -> float:
        ahead = 0.0
        if present.usable:
            # When this second should have begun according to the time source, within half a second.
            ahead = (present.gps_s - self.config.phase + 0.5) % 1.0 - 0.5
        return begin + 1.0 - max(-_STEER, min(_STEER, ahead))

    def take_alarm(self, alarm: Alarm) -> None:
        """Report an alarm that the enclosing program has raised or cleared."""
        (self._reports.alarm if alarm.active else self._reports.clear)(alarm)

    def line(self) -> str:
        """Return the controller's state in one line, for a log."""
        counts = [0] * len(states.STATES)
        for node in self.nodes:
            if node.known:
                counts[node.state] += 1
        shown = [f"{states.STATES[i]} {n}" for i, n in enumerate(counts) if n]
        if unknown := len(self.nodes) - sum(counts):
            shown.append(f"not heard {unknown}")
        present = self._time.time()
        lease = self._watch.lease_left(self._clock.monotonic())
        return (
            f"{self.config.name}: {' '.join(shown)}; silent {self._polling.silent}; "
            f"cycle {self.cycle:.2f} s; "
            f"time {present.quality} ±{min(present.error, 999.0):.2g} s; "
            f"plant {'here' if self._plant.connected else 'away'}, "
            f"lease {'over' if lease <= 0.0 else f'{lease:.1f} s'}"
            + "".join(f"; {act}" for act in self._watch.verdict.acts)
            + (f"; {present.note}" if present.note else "")
        )
