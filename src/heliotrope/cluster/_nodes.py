"""The local controllers of a cluster as the cluster knows them, and a quick way to read them.

Every second each is asked once or twice, so the frames of the questions are made once, and an
answer of the right size is read with one call of ``struct``. Whatever is not exactly the answer
that was asked for goes through `wire.Reader`, which decides; the quick way accepts nothing that
it would not. An answer carries the sequence of its question, and each question to a node has
another: one that comes late, from a serial server in the network by many seconds, is not taken for
that of a later question.
"""

import math
import struct
from binascii import crc32
from dataclasses import dataclass
from typing import Any

from heliotrope.cluster.config import Member
from heliotrope.lcu import messages, states, wire
from heliotrope.links.messages import NEVER, NODE

_ROW = struct.Struct("<BBIIiiiiIHbHIIII")
assert _ROW.size == NODE.itemsize

#: Questions to a node go out under as many sequences in turn: four minutes of them.
SEQUENCES = 256

_NO_STATUS = (states.UNCONFIGURED, 0, 0, 0, NEVER, 0, 0, 0, 0)
_NO_STEPS = (0, 0, 0, 0)
_UNSTUFFED_MOST = 254


class Question:
    """A question without values, and the quick reading of its answer."""

    def __init__(self, name: str, answer: str) -> None:
        self.number = messages.NUMBER_OF[name]
        self.answer = messages.NUMBER_OF[answer]
        self._layout = struct.Struct(wire.HEADER + messages.codes_of(self.answer) + "I")
        self.size = self._layout.size + 2
        self._frames: dict[int, bytes] = {}

    def frame(self, address: int, sequence: int) -> bytes:
        """Return the question to an address."""
        # Kept for all clusters of a process, whose addresses are the same.
        key = address << 16 | sequence
        frame = self._frames.get(key)
        if frame is None:
            made = wire.Frame(address, wire.CLUSTER_ADDRESS, sequence, self.number, b"")
            frame = self._frames[key] = wire.encode(made)
        return frame

    def read(self, data: bytes, address: int, sequence: int) -> tuple[Any, ...] | None:
        """Return the answer's values if the bytes are exactly that answer, else None.

        COBS is undone in place: where no block is full, each of its codes stands for one zero.
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
    """Counts of one local controller since the start.

    Attributes
    ----------
    asked, answered
        Frames that wanted an answer; of those, how many got it.
    late, corrupt, silent
        Instead of it came: one to another question; damage; nothing.
    retries
        Frames that were sent again.
    round_trip, longest
        From the question to the whole answer, in s: the last, and the longest.
    """

    asked: int = 0
    answered: int = 0
    late: int = 0
    corrupt: int = 0
    silent: int = 0
    retries: int = 0
    round_trip: float = 0.0
    longest: float = 0.0


class Node:
    """One local controller.

    Attributes
    ----------
    member, index
        As configured.
    counts
        See `Counts`.
    status, steps
        Values of the last STATUS and STEPS.
    status_at, steps_at
        When they came, monotonic s; -inf: never.
    heard_at
        When it last answered anything, monotonic s; -inf: never.
    follow_until
        Its step counts are asked for each second until then, monotonic s.
    missed
        How many questions in a row it has not answered.
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
        """Return the sequence of the next questions to it."""
        self._sequence = self._sequence % SEQUENCES + 1
        return self._sequence

    @property
    def known(self) -> bool:
        """Whether it has told its state since the start; if not, ``state`` means nothing."""
        return self.status_at > -math.inf

    @property
    def state(self) -> int:
        """Of `lcu.states`, as last heard."""
        return int(self.status[0])

    @property
    def flags(self) -> int:
        """Bits of `lcu.names.FLAGS`, as last heard."""
        return int(self.status[1])

    @property
    def fault(self) -> int:
        """Of `lcu.names.FAULTS`, as last heard."""
        return int(self.status[2])

    def answered(self, now: float, took: float) -> None:
        """Count an answer."""
        counts = self.counts
        counts.answered += 1
        counts.round_trip = took
        counts.longest = max(counts.longest, took)
        self.heard_at = now
        self.missed = 0

    def spoilt(self, data: bytes) -> None:
        """Count what came instead of an answer."""
        self.missed += 1
        if not data.strip(b"\0"):
            self.counts.silent += 1
        elif wire.Reader().feed(data):
            self.counts.late += 1
        else:
            self.counts.corrupt += 1

    def pack_into(self, block: bytearray, now: float) -> None:
        """Write its row of `protocol.NODE`."""
        state, flags, fault, _, sun_age, supply, temperature, crc, boots = self.status
        # An ACK shows that it is there, not what state it is in.
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


def rows(nodes: list[Node], now: float) -> bytes:
    """Return the rows of all nodes, as in `protocol.Status`."""
    block = bytearray(_ROW.size * len(nodes))
    for node in nodes:
        node.pack_into(block, now)
    return bytes(block)


def answer_in(
    data: bytes, address: int, sequence: int, numbers: tuple[int, ...]
) -> wire.Frame | None:
    """Return the answer to a question among what came, None if it is not there."""
    for frame in wire.Reader().feed(data):
        if (
            frame.to == wire.CLUSTER_ADDRESS
            and frame.sender == address
            and frame.sequence == sequence
            and frame.number in numbers
        ):
            return frame
    return None
