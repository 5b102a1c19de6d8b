"""Queries and commands on the bus, one at a time, counted for each local controller."""

import asyncio
import hashlib
import struct
from binascii import crc32
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from heliotrope.cluster._nodes import ClusterNode, Question, answer_in
from heliotrope.lcu import messages, wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import Clock
from heliotrope.links.link import Bus, SendOutcome

#: The share of bad frames is computed over this many seconds.
_WINDOW = 10
#: Function that returns the tag of some bytes under a bus key.
Sign = Callable[[bytes], bytes]


def sha256(data: bytes) -> bytes:
    """Return the hash that the wire's MACs use."""
    return hashlib.sha256(data).digest()


class NodeAnswer(NamedTuple):
    """A reply: its name, its values, and the number of preceding attempts without a reply."""

    name: str
    values: tuple[Any, ...]
    attempt: int


class Exchange:
    """The bus as the cluster uses it.

    Parameters
    ----------
    bus
        The port, run by its owner.
    clock
        Clock for the expiries of frames.
    answer, stored_answer
        Time limit for a complete reply, s; time limit if flash is written before the reply, s.

    Attributes
    ----------
    sender
        Creates and numbers the frames.
    clock
        Clock for the expiries of frames.
    now
        When the last poll ended, monotonic s.
    """

    def __init__(self, bus: Bus, clock: Clock, answer: float, stored_answer: float) -> None:
        self.sender = Sender(wire.CLUSTER_ADDRESS, 0, sha256)
        self._bus, self.clock = bus, clock
        self._sign: Sign | None = None
        self._answer, self._stored_answer = answer, stored_answer
        self._hurry = False
        self.now = clock.monotonic()
        self._gathering: asyncio.Timeout | None = None
        self._asked = self._bad = self._answered = 0
        self._seconds: deque[tuple[int, int, int]] = deque(maxlen=_WINDOW)

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._bus.connected

    def begin_epoch(self, epoch: int) -> None:
        """Restart the numbering of frames, in an epoch above all earlier ones (see `lcu.wire`)."""
        self.sender = Sender(wire.CLUSTER_ADDRESS, epoch, sha256)
        self.sender.sign = self._sign

    def sign(self, sign: Sign | None) -> None:
        """Sign frames from now on (see `lcu.signing`); with None, sign no frame."""
        self._sign = self.sender.sign = sign

    def token(self, token: int) -> int:
        """Return the bus token for a token of the command authority.

        The bus token changes with the epoch, so that commands from before a restart, which may
        arrive late, are void although the same authority still commands.
        """
        if token == 0:
            return 0
        return crc32(struct.pack("<II", token, self.sender.epoch)) or 1

    async def broadcast(
        self, name: str, *values: Any, life: float = 0.5, urgent: bool = False
    ) -> bool:
        """Broadcast a message within ``life`` s, and return whether it was sent."""
        return await self.transmit(
            self.sender.frame(wire.BROADCAST, name, *values), life=life, urgent=urgent
        )

    async def broadcast_session(self, token: int) -> None:
        """Broadcast the token of the command authority."""
        await self.transmit(self.sender.session(self.token(token)))

    async def send_session(self, address: int, token: int, number: bytes, sign: Sign) -> None:
        """Begin a signed session with a local controller, over the random number that it drew."""
        await self.transmit(self.sender.session_to(address, self.token(token), number, sign))

    async def transmit(self, frame: bytes, *, life: float = 0.5, urgent: bool = False) -> bool:
        """Send a frame within ``life`` s, expecting no reply; return whether it was sent."""
        expires = self.clock.monotonic() + life
        outcome = await self._bus.transmit(frame, expires=expires, urgent=urgent)
        return outcome is SendOutcome.SENT

    async def poll(
        self, node: ClusterNode, question: Question, sequence: int, begin: float
    ) -> tuple[Any, ...] | None:
        """Query a node at time ``begin``.

        Return the values of the reply, or None if there was none, and set ``now``.
        """
        node.asked()
        self._asked += 1
        data = await self._bus.transact(question.frame(node.address, sequence), self._answer)
        values = question.read(data, node.address, sequence)
        if values is None:
            frame = answer_in(data, node.address, sequence, (question.answer,)) if data else None
            if frame is None or (values := frame.values()) is None:
                self.now = self.clock.monotonic()
                self._spoilt(node, data, begin)
                return None
        self.now = now = self.clock.monotonic()
        self._answered += 1
        node.answered(now, now - begin)
        return values

    async def ask(
        self,
        node: ClusterNode,
        name: str,
        *values: Any,
        key: bytes = b"",
        expires: float,
        numbers: tuple[str, ...] = ("ACK",),
        stored: bool = False,
        tries: int = 1,
        urgent: bool = False,
    ) -> NodeAnswer | None:
        """Send a message to a node, repeating the frame while no reply comes; return the reply.

        ``stored`` means that flash is written before the reply.

        A frame that is repeated before any other frame is created takes effect once. If the node
        has already accepted it, the node replies "duplicate".
        """
        frame = self.sender.frame(node.address, name, *values, key=key)
        sequence = self.sender.count & 0xFFFF
        expected = tuple(messages.NUMBER_OF[number] for number in numbers)
        for attempt in range(tries):
            begin = self.clock.monotonic()
            if begin >= expires or (attempt and self._hurry):
                break
            node.asked(again=attempt > 0)
            self._asked += 1
            data: bytes | None
            if stored:
                data = await self._patiently(frame, self._stored_answer, expires, None)
            else:
                data = await self._bus.transact(frame, self._answer, expires=expires, urgent=urgent)
            if data is None:
                break
            answer = answer_in(data, node.address, sequence, expected) if data else None
            fields = None if answer is None else answer.values()
            if answer is not None and fields is not None:
                now = self.clock.monotonic()
                self._answered += 1
                node.answered(now, now - begin)
                return NodeAnswer(answer.name, fields, attempt)
            self._spoilt(node, data, begin)
        return None

    async def gather(
        self,
        name: str,
        *values: Any,
        span: float,
        key: bytes = b"",
        stored: bool = False,
        complete: Callable[[bytes], bool] = lambda _: False,
    ) -> tuple[bytes | None, int]:
        """Query all nodes; return the bytes received within ``span`` s, and the sequence number.

        The bytes are None if `interrupt` was called in the meantime. ``stored`` means that flash is
        written before the reply.
        """
        span += self._stored_answer if stored else 0.0
        frame = self.sender.frame(wire.BROADCAST, name, *values, key=key)
        sequence = self.sender.count & 0xFFFF
        return await self._patiently(frame, span, None, complete), sequence

    async def _patiently(
        self,
        frame: bytes,
        timeout: float,
        expires: float | None,
        complete: Callable[[bytes], bool] | None,
    ) -> bytes | None:
        """Run a transaction that may take long; return None if `interrupt` was called meanwhile."""
        try:
            async with asyncio.timeout(None) as self._gathering:
                return await self._bus.transact(frame, timeout, expires=expires, complete=complete)
        except TimeoutError:
            return None
        finally:
            self._gathering = None

    def interrupt(self) -> None:
        """Abort long transactions and repeat no frame until `resume`: an emergency is waiting."""
        self._hurry = True
        if self._gathering is not None:
            self._gathering.reschedule(asyncio.get_running_loop().time())

    def resume(self) -> None:
        """End the effect of `interrupt`."""
        self._hurry = False

    def _spoilt(self, node: ClusterNode, data: bytes, now: float) -> None:
        node.spoilt(data)
        # The silence of a node that is switched off says nothing about the bus; damaged bytes
        # always do.
        if data or now - node.heard_at <= _WINDOW:
            self._bad += 1

    def second(self) -> float:
        """End a second and return the fraction of bad frames in the last ten seconds."""
        if not self.connected:
            self._seconds.clear()
            self._asked = self._bad = self._answered = 0
            return 1.0
        if self._asked:
            self._seconds.append((self._asked, self._bad, self._answered))
        self._asked = self._bad = self._answered = 0
        asked = sum(row[0] for row in self._seconds)
        bad = sum(row[1] for row in self._seconds)
        answered = sum(row[2] for row in self._seconds)
        if asked and not answered:
            return 1.0
        return bad / (bad + answered) if bad else 0.0
