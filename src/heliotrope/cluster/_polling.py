"""Polling: each heliostat reports its state once per second, in the order of addresses.

Commands are sent between polls. Replies are checked, faults and silence are reported, and the goals
of commands are evaluated.
"""

import asyncio
from typing import Any

from heliotrope.cluster._emergencies import Emergencies
from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._goals import Goals
from heliotrope.cluster._nodes import STATUS, STEPS, ClusterNode, Nodes
from heliotrope.cluster._reports import Reports
from heliotrope.cluster._watch import Watch
from heliotrope.cluster._work import Work
from heliotrope.cluster.config import ClusterConfig
from heliotrope.lcu import names, states
from heliotrope.links.clock import Clock
from heliotrope.safety import alarms

#: A node that missed this many consecutive queries is queried only every fifth second.
_ABSENT, _PROBE = 3, 5
#: A node reports a jump of the sun until it is restarted; the alarm ends after this time, s.
_JUMP_SHOWS = 60.0


class Polling:
    """Polls the local controllers."""

    def __init__(
        self,
        config: ClusterConfig,
        nodes: Nodes,
        exchange: Exchange,
        goals: Goals,
        reports: Reports,
        watch: Watch,
        emergencies: Emergencies,
        clock: Clock,
    ) -> None:
        self._config, self._nodes, self._exchange = config, nodes, exchange
        self._goals, self._reports, self._watch = goals, reports, watch
        self._emergencies, self._clock = emergencies, clock
        self._by_address = sorted(nodes, key=lambda node: node.address)
        self._started = clock.monotonic()
        self._number = 0  # of the second
        self._next = 0  # index at which the last round was cut off
        self._silent: set[int] = set()
        self._unreadable: set[int] = set()
        self._jumped: dict[str, float] = {}

    @property
    def silent(self) -> int:
        """Number of heliostats that do not reply."""
        return len(self._silent)

    def begin_second(self) -> None:
        """Count a second."""
        self._number += 1

    async def round(self, until: float, work: Work, closing: asyncio.Event) -> None:
        """Poll every node once, and carry out orders between polls."""
        nodes, count = self._by_address, len(self._nodes)
        first, self._next = self._next, 0
        now = self._clock.monotonic()
        for place in range(first, first + count):
            if now >= until or closing.is_set():
                self._next = place % count
                return
            node = nodes[place % count]
            if node.missed < _ABSENT or (self._number + node.index) % _PROBE == 0:
                now = await self._poll(node, now)
            if work.ready(patient=False):
                await work.serve()
                now = self._clock.monotonic()

    async def look(self, node: ClusterNode) -> None:
        """Poll the state of a node between two rounds."""
        await self._poll(node, self._clock.monotonic())

    async def _poll(self, node: ClusterNode, now: float) -> float:
        """Poll a node for its state and step counts at ``now``; return the time afterwards."""
        exchange, sequence = self._exchange, node.next_sequence()
        status = await exchange.poll(node, STATUS, sequence, now)
        if status is None or not self._believes(node, status, now):
            return exchange.now
        waits = self._goals.waits(node)
        due = (self._number + node.index) % self._config.steps_every == 0
        if waits or due or now < node.follow_until:
            begin = exchange.now
            steps = await exchange.poll(node, STEPS, sequence, begin)
            if steps is not None:
                node.take_steps(steps, begin)
        if waits:
            self._goals.heard(node, now)
        return exchange.now

    def _believes(self, node: ClusterNode, status: tuple[Any, ...], asked_at: float) -> bool:
        """Accept a STATUS; return False if it contains a state that is unknown here."""
        if status[0] >= len(states.STATES):
            self._reports.alarm(alarms.NODE_UNINTELLIGIBLE.raised(node.name, state=status[0]))
            self._unreadable.add(node.index)
            return False
        if node.index in self._unreadable:
            self._unreadable.remove(node.index)
            self._reports.clear(alarms.NODE_UNINTELLIGIBLE.ended(node.name))
        before = node.fault
        node.take_status(status, asked_at)
        if node.fault != before:
            self._report_fault(node)
        if bool(node.flags & names.SUN_JUMPED) != (node.name in self._jumped):
            self._report_sun(node)
        if (
            self._watch.verdict.dark
            and node.state in states.BEAM_OUT
            and not self._emergencies.waits(node)
        ):
            # The heliostat missed the broadcast, or has just come back.
            self._emergencies.begin("", "DEFOCUS", [node])
        return True

    def _report_fault(self, node: ClusterNode) -> None:
        if node.fault:
            known = node.fault < len(names.FAULTS)
            text = names.FAULTS[node.fault] if known else f"fault {node.fault}"
            self._reports.alarm(alarms.NODE_FAULT.raised(node.name, fault=text))
        else:
            self._reports.clear(alarms.NODE_FAULT.ended(node.name))

    def _report_sun(self, node: ClusterNode) -> None:
        """Report the first jump of the sun vector since a local controller started."""
        if node.flags & names.SUN_JUMPED:
            self._jumped[node.name] = node.heard_at
            self._reports.alarm(alarms.SUN_JUMPED.raised(node.name))
        else:
            del self._jumped[node.name]
            self._reports.clear(alarms.SUN_JUMPED.ended(node.name))

    def end_second(self, now: float) -> None:
        """Abandon goals that take too long, and report silent heliostats."""
        for name, at in self._jumped.items():
            if now - at > _JUMP_SHOWS:
                self._reports.clear(alarms.SUN_JUMPED.ended(name))
        self._goals.second(self._nodes, now)
        limit = self._config.silence
        for node in self._nodes:
            silent = now - max(node.heard_at, self._started) > limit
            # A heliostat that replies but does not report its step counts: its beam may be
            # anywhere.
            unsure = now - max(node.steps_at, self._started) > limit + self._config.steps_every
            silent |= unsure and node.index not in self._unreadable
            if silent and node.index not in self._silent:
                self._silent.add(node.index)
                self._report_silence(node, limit)
            elif not silent and node.index in self._silent:
                self._silent.remove(node.index)
                self._reports.clear(alarms.NODE_SILENT.ended(node.name))

    def _report_silence(self, node: ClusterNode, limit: float) -> None:
        out = node.known and node.state in states.BEAM_OUT
        if not node.known:
            last = (
                "never heard"
                if node.heard_at < self._started
                else ("it has never reported its state")
            )
        elif self._clock.monotonic() - node.heard_at <= limit:
            last = f"it is {states.STATES[node.state]} and does not report its step counts"
            last += "; the position of its beam is unknown" if out else ""
        else:
            last = f"its last state was {states.STATES[node.state]}"
            last += "; the position of its beam is unknown" if out else ""
        self._reports.alarm(
            alarms.NODE_SILENT.raised(node.name, worse=out, silence=limit, last=last)
        )
