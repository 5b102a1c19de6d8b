"""Ledgers of the observer: the frames on the bus and the orders of the plant."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from heliotrope.lcu import messages, wire

#: Who may send a message, by the first and the last number of a range: the ledger's own table.
_WHO = (
    (0x10, 0x12, messages.CLUSTER), (0x20, 0x21, messages.ANYONE),
    (0x30, 0x47, messages.AUTHORITY), (0x50, 0x59, messages.KEY),
)  # fmt: skip


def who_of(number: int) -> int:
    """Return who may send a message: a constant of `lcu.messages`."""
    for first, last, who in _WHO:
        if first <= number <= last:
            return who
    return messages.ASK if number % 2 and number < 0x0D else messages.NODE


@dataclass(frozen=True)
class Sent:
    """A frame that the cluster sent.

    Attributes
    ----------
    index
        Index among all frames of the bus.
    at
        Time, s.
    name, who
        See `lcu.messages`.
    to
        Address.
    values, payload
        As in the frame.
    """

    index: int
    at: float
    name: str
    who: int
    to: int
    values: tuple[float, ...]
    payload: bytes

    def addresses(self, address: int) -> bool:
        """Whether the frame is meant for an address."""
        return self.to in (address, wire.BROADCAST)


@dataclass
class PlantCommand:
    """A command of the plant.

    Attributes
    ----------
    identity, name
        Identity and command name; a set of parameters is not a command and has its own name.
    addresses
        Addresses of the heliostats that the command is for.
    at, until
        When the command was given and when it expires, s.
    authorised
        Whether the command carried the token of the command authority.
    token
        The token.
    accepted
        How often it was reported as accepted, by heliostat.
    """

    identity: str
    name: str
    addresses: frozenset[int]
    at: float
    until: float
    authorised: bool
    token: int = 0
    accepted: Counter[str] = field(default_factory=Counter)


class FrameLedger:
    """All frames that the cluster has sent.

    Attributes
    ----------
    last
        The last frame of each name.
    commands
        Indices of the frames that need authority.
    safe
        When DEFOCUS or STOW was last sent to each address, s.
    """

    def __init__(self) -> None:
        self._frames: dict[bytes, Sent] = {}
        self._order: list[bytes] = []
        self.last: dict[str, Sent] = {}
        self.commands: list[int] = []
        self.safe: dict[int, float] = {}

    def __len__(self) -> int:
        return len(self._order)

    def note(self, data: bytes, now: float) -> Sent | None:
        """Record a frame; return None if the bytes contain no frame."""
        known = self._frames.get(data)
        if known is not None:
            if known.who == messages.ANYONE:
                self.safe[known.to] = now
            return known
        frames = wire.Reader().feed(data)
        if not frames:
            return None
        frame = frames[-1]
        sent = Sent(
            len(self._order),
            now,
            frame.name,
            who_of(frame.number),
            frame.to,
            frame.values() or (),
            frame.payload,
        )
        self._frames[data] = self.last[frame.name] = sent
        self._order.append(data)
        if sent.who in (messages.AUTHORITY, messages.KEY):
            self.commands.append(sent.index)
        elif sent.who == messages.ANYONE:
            self.safe[sent.to] = now
        return sent

    def of(self, data: bytes) -> Sent | None:
        """Return the recorded frame for some bytes; None if the cluster never sent them."""
        return self._frames.get(data)

    def data(self, index: int) -> bytes:
        """Return the bytes of the frame with an index."""
        return self._order[index]


#: Orders are forgotten this long after they expire, s.
_KEPT = 60.0


class OrderLedger:
    """The recent orders of the plant."""

    def __init__(self) -> None:
        self.by_identity: dict[str, PlantCommand] = {}

    def note(self, order: PlantCommand) -> None:
        """Record an order; a second order with the same identity is a repetition and is ignored."""
        self.by_identity.setdefault(order.identity, order)

    def void(self, token: int, until: float) -> None:
        """End the orders that carry a token, because its authority has ended."""
        for order in self.by_identity.values():
            if order.token == token:
                order.until = min(order.until, until)

    def drop(self, now: float) -> None:
        """Forget orders that expired long ago."""
        old = [i for i, order in self.by_identity.items() if order.until + _KEPT < now]
        for identity in old:
            del self.by_identity[identity]

    def covering(self, name: str, addresses: Iterable[int], now: float) -> list[PlantCommand]:
        """Return the orders with a name that were given before now and cover these addresses."""
        required = frozenset(addresses)
        return [
            order
            for order in self.by_identity.values()
            if order.name == name and required <= order.addresses and order.at <= now
        ]
