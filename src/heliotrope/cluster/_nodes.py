"""The cluster's records of its local controllers, and fast parsing of replies.

Each local controller is polled once or twice per second, so the query frames are created once, and
a reply of the expected size is parsed with one call of ``struct``. All other bytes go through
`wire.Reader`, which decides; the fast parser accepts nothing that `wire.Reader` would reject. A
reply carries the sequence number of its query, and consecutive queries to a node have different
numbers, so a reply that arrives late (by many seconds, from a network serial server) is not
mistaken for the reply to a later query.
"""

import math
import struct
from binascii import crc32
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.lcu import messages, states, wire
from heliotrope.links.messages import NEVER, NODE

_ROW = struct.Struct("<BBIIiiiiIHbHIIII")
assert _ROW.size == NODE.itemsize

#: Queries to a node cycle through this many sequence numbers, which takes four minutes.
SEQUENCES = 256

_NO_STATUS = (states.UNCONFIGURED, 0, 0, 0, NEVER, 0, 0, 0, 0)
_NO_STEPS = (0, 0, 0, 0)
_UNSTUFFED_MOST = 254


class OrderRefusedError(Exception):
    """A command was refused; the text says why."""


class Question:
    """A query without values, with a fast parser for its reply."""

    def __init__(self, name: str, answer: str) -> None:
        self.number = messages.NUMBER_OF[name]
        self.answer = messages.NUMBER_OF[answer]
        self._layout = struct.Struct(wire.HEADER + messages.codes_of(self.answer) + "I")
        self.size = self._layout.size + 2
        self._frames: dict[int, bytes] = {}

    def frame(self, address: int, sequence: int) -> bytes:
        """Return the frame of the query to an address."""
        # Shared by all clusters of a process, because they use the same addresses.
        key = address << 16 | sequence
        frame = self._frames.get(key)
        if frame is None:
            made = wire.Frame(address, wire.CLUSTER_ADDRESS, sequence, self.number, b"")
            frame = self._frames[key] = wire.encode(made)
        return frame

    def read(self, data: bytes, address: int, sequence: int) -> tuple[Any, ...] | None:
        """Return the values of the reply, or None unless the bytes are exactly that reply.

        COBS is decoded in place: as long as no block is full, each of its codes stands for one
        zero.
        """
        last = self.size - 1
        if len(data) != self.size or data.find(0) != last:
            return None
        raw = bytearray(data)
        place = raw[0]
        while place < last:
            step = raw[place]
            raw[place] = 0
            place += step
        if place != last:
            return None
        values = self._layout.unpack_from(raw, 1)
        if (
            values[-1] != crc32(raw[1 : last - wire.CRC_SIZE])
            or values[2] != address
            or values[3] != sequence
            or values[4] != self.answer
            or values[0] != wire.VERSION
            or values[1] != wire.CLUSTER_ADDRESS
        ):
            return None
        return values[5:-1]


STATUS = Question("QUERY_STATUS", "STATUS")
STEPS = Question("QUERY_STEPS", "STEPS")
assert STATUS.size < _UNSTUFFED_MOST
assert STEPS.size < _UNSTUFFED_MOST


@dataclass(slots=True)
class Counts:
    """Counts of one local controller since start-up.

    Attributes
    ----------
    asked, answered
        Number of queries; number of replies.
    late, corrupt, silent
        Queries without their own reply because the reply to another query arrived, because bytes
        were damaged, or because nothing arrived.
    retries
        Frames sent again.
    round_trip, longest
        Time from query to complete reply, s: the last and the longest.
    """

    asked: int = 0
    answered: int = 0
    late: int = 0
    corrupt: int = 0
    silent: int = 0
    retries: int = 0
    round_trip: float = 0.0
    longest: float = 0.0


class ClusterNode:
    """One local controller.

    Attributes
    ----------
    member, index
        Heliostat and index as configured.
    counts
        See `Counts`.
    status, steps
        Values of the last STATUS and STEPS.
    status_at, steps_at
        When they were requested, monotonic s; -inf if never. The reply may have been read later.
    heard_at
        When it last replied to any message, monotonic s; -inf if never.
    follow_until
        End of the time in which its step counts are requested each second, monotonic s.
    missed
        Consecutive queries without a reply.
    """

    def __init__(self, member: Member, index: int) -> None:
        self.member, self.index = member, index
        self.name, self.address = member.name, member.address
        self.counts = Counts()
        self.status: tuple[Any, ...] = _NO_STATUS
        self.steps: tuple[Any, ...] = _NO_STEPS
        self.status_at = self.steps_at = -math.inf
        self.heard_at = self.follow_until = -math.inf
        self.missed = 0
        self._sequence = 0

    def next_sequence(self) -> int:
        """Return the sequence number of the next query."""
        self._sequence = self._sequence % SEQUENCES + 1
        return self._sequence

    @property
    def known(self) -> bool:
        """Whether a state was received since start-up; otherwise ``state`` is meaningless."""
        return self.status_at > -math.inf

    @property
    def state(self) -> int:
        """Last reported state, of `lcu.states`."""
        return int(self.status[0])

    @property
    def flags(self) -> int:
        """Last reported flags, bits of `lcu.names.FLAGS`."""
        return int(self.status[1])

    @property
    def fault(self) -> int:
        """Last reported fault, of `lcu.names.FAULTS`."""
        return int(self.status[2])

    def take_status(self, status: tuple[Any, ...], asked_at: float) -> None:
        """Store the values of a new STATUS."""
        self.status, self.status_at = status, asked_at

    def take_steps(self, steps: tuple[Any, ...], asked_at: float) -> None:
        """Store the values of a new STEPS."""
        self.steps, self.steps_at = steps, asked_at

    def follow(self, until: float) -> None:
        """Request step counts each second until a monotonic time."""
        self.follow_until = max(self.follow_until, until)

    def asked(self, *, again: bool = False) -> None:
        """Count a query; ``again`` means that its frame was sent before."""
        self.counts.asked += 1
        self.counts.retries += again

    def retried(self) -> None:
        """Count a query that will be repeated."""
        self.counts.retries += 1

    def answered(self, now: float, took: float) -> None:
        """Count a reply."""
        counts = self.counts
        counts.answered += 1
        counts.round_trip = took
        counts.longest = max(counts.longest, took)
        self.heard_at = now
        self.missed = 0

    def spoilt(self, data: bytes) -> None:
        """Count bytes that arrived in place of a reply."""
        self.missed += 1
        if not data.strip(b"\0"):
            self.counts.silent += 1
        elif wire.Reader().feed(data):
            self.counts.late += 1
        else:
            self.counts.corrupt += 1

    def pack_into(self, block: bytearray, now: float) -> None:
        """Write the record of this node in `messages.NODE`."""
        state, flags, fault, _, sun_age, supply, temperature, crc, boots = self.status
        # An ACK shows that the node is there, not its state; the record is as old as its STATUS.
        _ROW.pack_into(
            block,
            self.index * _ROW.size,
            state,
            fault,
            flags,
            _age(now - self.status_at),
            *self.steps,
            sun_age,
            supply,
            temperature,
            boots,
            crc,
            self.counts.asked & NEVER,
            self.counts.answered & NEVER,
            _age(now - self.steps_at),
        )


def _age(seconds: float) -> int:
    age = 1e3 * seconds
    return int(age) if age < NEVER else NEVER


class Nodes:
    """The local controllers of a cluster, in the order of its configuration."""

    def __init__(self, config: ClusterConfig) -> None:
        self._cluster = config.name
        self._nodes = [ClusterNode(member, index) for index, member in enumerate(config.heliostats)]
        self._by_name = {node.name: node for node in self._nodes}

    def __iter__(self) -> Iterator[ClusterNode]:
        return iter(self._nodes)

    def __len__(self) -> int:
        return len(self._nodes)

    def __getitem__(self, index: int) -> ClusterNode:
        return self._nodes[index]

    def named(self, name: str) -> ClusterNode:
        """Return a heliostat by name.

        Raises
        ------
        OrderRefusedError
            If a name does not belong to this cluster.
        """
        node = self._by_name.get(name)
        if node is None:
            raise OrderRefusedError(f"cluster {self._cluster} has no heliostat {name!r}")
        return node

    def chosen(self, heliostats: Iterable[str]) -> tuple[list[ClusterNode], dict[str, str]]:
        """Return heliostats by name, or all if none is named, and the refusals of unknown names."""
        names = dict.fromkeys(heliostats)
        nodes, refused = list[ClusterNode](), dict[str, str]()
        for name in names:
            try:
                nodes.append(self.named(name))
            except OrderRefusedError as refusal:
                refused[name] = str(refusal)
        return (nodes if names else list(self._nodes)), refused

    def rows(self, now: float) -> bytes:
        """Return a record of `messages.NODE` for each node, at a monotonic time."""
        block = bytearray(_ROW.size * len(self._nodes))
        for node in self._nodes:
            node.pack_into(block, now)
        return bytes(block)


def answer_in(
    data: bytes, address: int, sequence: int, numbers: tuple[int, ...]
) -> wire.Frame | None:
    """Return the reply to a query from received bytes; None if they contain no such reply."""
    for frame in wire.Reader().feed(data):
        if (
            frame.to == wire.CLUSTER_ADDRESS
            and frame.sender == address
            and frame.sequence == sequence
            and frame.number in numbers
        ):
            return frame
    return None
