"""The cluster's end of the plant link: receives messages, sends reports and the status."""

import contextlib
from collections.abc import Callable

from heliotrope.cluster._nodes import Nodes
from heliotrope.cluster._reports import Reports
from heliotrope.cluster._watch import Watch
from heliotrope.cluster._work import Work
from heliotrope.cluster.config import ClusterConfig
from heliotrope.cluster.timekeeping import Time
from heliotrope.links.clock import Clock
from heliotrope.links.common_settings import settings_checksum
from heliotrope.links.link import Link, LinkClosedError, SendOutcome, received
from heliotrope.links.messages import (
    Acknowledge,
    Answer,
    Ask,
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    ProtocolError,
    Stage,
    decode,
    encode,
)
from heliotrope.safety import AcknowledgeRole, Alarm, alarms

#: Lifetime of a message to the plant, s. The ages in a status count from the time at which it was
#: made. A status is not sent later than `_STATUS_WAITS`, because the program may have been
#: suspended in the meantime.
_NEWS_LIFE = 5.0
_STATUS_LIFE, _STATUS_WAITS = 1.0, 1.0
#: The names of the rows and the alarms are repeated after this many statuses, because a status may
#: have been lost.
_NAMES_EVERY = 10
#: Represents an unknown time error, s.
_UNBOUNDED = 1e9


class PlantLink:
    """Receives messages from the plant and reports to it.

    Parameters
    ----------
    config
        Name of the cluster, the site for its sun vector, and its common settings.
    link, clock, nodes, watch, work, reports
        Parts of the cluster.
    wake
        Function that is called when a message has arrived, since the message may be urgent.
    """

    def __init__(
        self,
        config: ClusterConfig,
        link: Link,
        clock: Clock,
        nodes: Nodes,
        watch: Watch,
        work: Work,
        reports: Reports,
        wake: Callable[[], None],
    ) -> None:
        self._cluster, self._link, self._clock, self._nodes = config.name, link, clock, nodes
        self._watch, self._work, self._reports, self._wake = watch, work, reports, wake
        self._site, self._settings = config.site.numbers, settings_checksum(config.common)
        self._names = tuple(node.name for node in nodes)
        self._opened = -1
        self._was_connected = False
        self._number = 0  # of the last status
        self._told_names = 0  # number of the last status with names
        self._names_lost = False
        self._made_at = clock.monotonic()  # when the last status was made

    @property
    def connected(self) -> bool:
        """Whether the plant is connected."""
        return self._link.connected

    # -- from the plant --------------------------------------------------------------------

    async def listen(self) -> None:
        """Receive messages until the link is closed."""
        async for data in received(self._link):
            try:
                message = decode(data)
            except ProtocolError as error:
                self._reports.event(alarms.PLANT_UNINTELLIGIBLE.raised(problem=error))
            else:
                self._take(message)
                self._wake()
            self._reports.publish()

    def _take(self, message: Message) -> None:
        if isinstance(message, Lease):
            now = self._clock.monotonic()
            if not self._watch.runs.admits(message.run, now):
                return
            refusal = self._watch.take(message, now)
            if refusal:
                self._reports.alarm(alarms.LEASE_REFUSED.raised(problem=refusal))
            else:
                self._reports.clear(alarms.LEASE_REFUSED.ended())
        elif isinstance(message, Emergency | Command | Parameters | Ask):
            self._work.take(message)
        elif isinstance(message, Acknowledge):
            self._take_acknowledgement(message)
        elif isinstance(message, ClusterStatus | Progress | Alarm | Answer):
            text = f"the plant sent a {message.kind} message, which only clusters may send"
            self._reports.event(alarms.PLANT_UNINTELLIGIBLE.raised(problem=text))

    def _take_acknowledgement(self, message: Acknowledge) -> None:
        try:
            role = AcknowledgeRole[message.role.upper()]
        except KeyError:
            known = " or ".join(role.name.lower() for role in AcknowledgeRole)
            refusal: str | None = f"role {message.role!r} is not known; specify {known}"
        else:
            refusal = self._watch.acknowledge(message.condition, message.who, role)
        stage = Stage.REFUSED if refusal else Stage.DONE
        self._reports.add(message.identity, stage, text=refusal or "")

    # -- to the plant ----------------------------------------------------------------------

    def report(self, present: Time, begin: float) -> None:
        """Report the status of the second that began at monotonic time ``begin``."""
        self._number += 1
        connected, opened = self._link.connected, self._link.statistics.opened
        if connected and (opened != self._opened or not self._was_connected):
            self._opened, self._told_names = opened, self._number
        self._was_connected = connected
        now = self._made_at = self._clock.monotonic()
        with_names = (self._number - self._told_names) % _NAMES_EVERY == 0
        if with_names:
            self._reports.repeat()
        # Alarms are not repeated at once, because on a slow line they may be what delayed the
        # status. A status made before the line is up may be the first that the plant receives of
        # this configuration.
        with_names, self._names_lost = with_names or self._names_lost or not connected, False
        self._reports.status(
            ClusterStatus(
                cluster=self._cluster,
                count=len(self._nodes),
                utc_s=present.utc_s,
                time_quality=present.quality,
                time_error_s=min(present.error, _UNBOUNDED),
                lease_left=self._watch.lease_left(now),
                cycle_s=now - begin,
                acts=self._watch.verdict.acts,
                names=self._names if with_names else (),
                site=self._site,
                settings=self._settings,
                block=self._nodes.rows(now),
                run=self._watch.runs.holder,
                barred=self._watch.runs.blocked,
            )
        )
        self._reports.publish()

    async def tell(self) -> None:
        """Send reports while the plant is connected, until the link is closed."""
        with contextlib.suppress(LinkClosedError):
            while True:
                if self._link.connected:
                    made_at = self._made_at
                    for message in self._reports.take():
                        await self._send(message, made_at)
                await self._reports.published()

    async def _send(self, message: Message, made_at: float) -> None:
        status, now = isinstance(message, ClusterStatus), self._clock.monotonic()
        expires = now + _NEWS_LIFE
        if status:
            expires = min(now, made_at + _STATUS_WAITS) + _STATUS_LIFE
        outcome = await self._link.send(encode(message), expires=expires)
        if status and outcome is not SendOutcome.SENT:
            self._names_lost = True
