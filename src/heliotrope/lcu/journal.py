"""The journal: the memory of a local controller that survives a power failure.

NOR flash holds two kinds of records, each with a counter and a CRC-32, each written once into
erased flash and not touched again until its block is erased:

*Stored items* are kept in two slots of one block each. A new record goes to the slot that does not
hold the present one, so that one slot is valid at every instant. Armature, drives and similar items
are stored as the bytes received, so that single precision cannot change them, and their checksum
equals the sender's.

*Counts* (step counts, aim, state, boots) change often and are kept in a ring of the other blocks. A
record is appended where flash is blank. After a full block, writing continues in the next block,
which was erased in advance; wear is therefore even, and there is always space for a last record
when the supply fails. The block with the newest record is never erased.

A power failure at any byte of a write or an erasure leaves the old or the new record: a damaged
record fails its checksum and is skipped (except with probability 2^-32).

**Step counts.** Before the first step away from rest, and whenever the next steps would lead
farther than ``STRIDE`` from the counts in flash, a record "moving" is written; at rest, a record
"rest". If the newest record says "moving" after a reset, the true counts are within ``STRIDE`` of
its counts. ``doubt`` reports this uncertainty until ``zero``; it accumulates over further power
failures. A brown-out detector that calls ``brown_out`` prevents it.

**Marks.** The state byte also contains marks of the controller. While the mark ``TURNING`` is set,
a record ``GOALS`` contains the goals of the motion in place of the counts.

The storage is injected::

    block_size, blocks      bytes of a block, number of blocks: two, and two or more for the ring
    read(offset, size)      -> bytes
    write(offset, data)     clears bits, sets none; here each byte once after an erasure
    erase(block)            to 0xFF
"""

import struct
from binascii import crc32

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such modules
    from typing import Any, Protocol

    class Storage(Protocol):
        """NOR flash; see the docstring of this module."""

        block_size: int
        blocks: int

        def read(self, offset: int, size: int) -> bytes:
            """Return ``size`` bytes from ``offset``."""

        def write(self, offset: int, data: bytes) -> None:
            """Write ``data``: clear the bits that are 0 in it."""

        def erase(self, block: int) -> None:
            """Set all bits of a block."""


#: Stored items: name and ``struct`` codes, little-endian. The position in this table, from 1, is
#: the item's number in QUERY_STORED; the order is part of the layout in flash.
ITEMS = (
    ("address", "H"),
    ("key_id", "I"),
    ("edition", "I"),
    ("location", "ddd"),
    ("armature", "18d"),
    ("drive_primary", "B10d"),
    ("drive_secondary", "B10d"),
    ("limits_primary", "iiIIH"),
    ("limits_secondary", "iiIIH"),
    ("biases", "ff"),
    ("stow", "ii"),
    ("defocus", "ff"),
    ("standby", "fff"),
    ("way", "BB12f"),
    ("stepping", "HHB"),
    ("bus_keys", "8I"),
)
SIZE_OF = {row[0]: struct.calcsize("<" + row[1]) for row in ITEMS}
CODES_OF = {row[0]: "<" + row[1] for row in ITEMS}

#: The item that a message of class KEY sets; if there are two, the one for its axis.
TARGETS = {
    "SET_ARMATURE": ("armature",),
    "SET_DRIVES": ("drive_primary", "drive_secondary"),
    "SET_BIAS": ("biases",),
    "SET_POSITION": ("location",),
    "SET_ADDRESS": ("address",),
    "SET_STOW": ("stow",),
    "SET_LIMITS": ("limits_primary", "limits_secondary"),
    "SET_DEFOCUS": ("defocus",),
    "SET_WAY": ("way",),
    "SET_STEPPING": ("stepping",),
    "ZERO": (),
}

MAGIC, LAYOUT = 0x48, 2
SLOT_HEAD = "<BBHI"  # magic, layout, bits of the items present, counter
SLOT_HEAD_SIZE = 8
SLOT_SIZE = SLOT_HEAD_SIZE + sum(SIZE_OF.values()) + 4
#: Record sizes of firmware without the last item, or the last two, which can also be read.
FORMER_SIZES = (SLOT_SIZE - 32, SLOT_SIZE - 37)

#: counter, primary, secondary, aim, state, flags, boots; then the CRC.
RING_RECORD = "<Iii12sBBH"
RING_SIZE = 32
FIRST_RING_BLOCK = 2
BLANK = b"\xff" * RING_SIZE
#: Parts of the state byte: the state itself; a motion to goals is in progress; a record of goals.
STATE, TURNING, GOALS = 0x0F, 0x40, 0x0F
REST, AIM = 0x80, 0x40  # flags; the lower bits: three of doubts, three of boots

#: Maximum distance of the true step counts from the counts in flash, steps.
STRIDE = 1000
#: After this many consecutive unhealthy boots, the controller stays in FAULT.
BOOT_LIMIT = 5
#: A boot is healthy after this time, ms; then the caller reports it.
HEALTHY_MS = 60000
MOST = 7


def items_of(name: str, payload: bytes) -> "dict[str, bytes]":
    """Return the items that a message of class KEY sets, and the message's edition.

    Parameters
    ----------
    name
        Name of the message.
    payload
        Payload of the message with head; ``wire`` ensures that its length fits.

    Raises
    ------
    ValueError
        If the message stores nothing, or the axis is not 0 or 1.
    """
    if name not in TARGETS:
        raise ValueError(f"{name}: stores nothing")
    items = {"edition": payload[8:12]}
    targets = TARGETS[name]
    rest = payload[12:]
    if len(targets) == 2:
        axis = rest[0]
        if axis > 1:
            raise ValueError(f"{name}: axis {axis}: must be 0 (primary) or 1 (secondary)")
        items[targets[axis]] = rest[1:]
    elif name == "SET_ADDRESS":
        items["address"] = rest[4:]
    elif targets:
        items[targets[0]] = rest
    return items


def _whole(data: bytes) -> bool:
    return bool(struct.unpack("<I", data[-4:])[0] == crc32(data[:-4]))


def _newer(counter: int, than: int) -> bool:
    return 0 < ((counter - than) & 0xFFFFFFFF) < 0x80000000


class Journal:
    """The journal of one local controller; call ``load`` first, then ``boot``.

    Parameters
    ----------
    storage
        NOR flash; see the docstring of this module.
    stride
        Maximum distance of the true step counts from the counts in flash, steps.

    Attributes
    ----------
    items
        Stored items, as bytes, by name; items that were never stored are missing.
    damaged
        Whether flash contained data but no complete record of stored items.
    primary, secondary
        Step counts of the newest record.
    rest
        Whether the newest record written since ``load`` says that the heliostat is at rest.
    doubts
        How often the counts may have been falsified by up to ``stride``; 7 means 7 times or more,
        or that there was no record of counts at all.
    state
        State of the newest record, with the controller's marks.
    goals
        Goals of the motion in progress, as step counts; () if there is none.
    aim
        Aim of the newest record as bytes (three ``f``); None if there is none.
    boots
        Total number of boots, modulo 65536.
    unhealthy
        Number of consecutive boots without a healthy minute; 7 means 7 or more.
    """

    def __init__(self, storage: "Storage", stride: int = STRIDE) -> None:
        if storage.blocks < FIRST_RING_BLOCK + 2 or storage.block_size < SLOT_SIZE:
            raise ValueError(
                f"journal: {storage.blocks} blocks of {storage.block_size} bytes: needs at least "
                f"{FIRST_RING_BLOCK + 2} of {SLOT_SIZE}"
            )
        self.stride = stride
        self._storage = storage
        self._places = storage.block_size // RING_SIZE
        self._clear()

    def _clear(self) -> None:
        self.items: dict[str, bytes] = {}
        self.damaged = False
        self.primary = self.secondary = 0
        self.rest = True
        self.doubts = MOST
        self.state = 0
        self.goals: tuple[int, ...] = ()
        self.aim: bytes | None = None
        self.boots = 0
        self.unhealthy = 0
        self._slot = 1  # so that the first record goes to slot 0
        self._slot_counter = 0
        self._counter = 0
        self._newest = FIRST_RING_BLOCK  # block of the newest record
        self._block = FIRST_RING_BLOCK
        self._place = self._places  # of the next record; beyond the last: none left
        self._next_ready = False

    # Stored items.

    def load(self) -> "dict[str, bytes]":
        """Read the newest complete records and return ``items``; nothing is written."""
        self._clear()
        intact = False
        for slot in (0, 1):
            data = self._storage.read(slot * self._storage.block_size, SLOT_SIZE)
            magic, layout, mask, counter = struct.unpack(SLOT_HEAD, data[:SLOT_HEAD_SIZE])
            whole = _whole(data)
            for size in FORMER_SIZES:
                whole = whole or _whole(data[:size])
            if not whole or magic != MAGIC or layout != LAYOUT:
                self.damaged = self.damaged or data != b"\xff" * SLOT_SIZE
            elif not intact or _newer(counter, self._slot_counter):
                intact = True
                self._slot, self._slot_counter = slot, counter
                self.items = self._split(mask, data)
        self.damaged = self.damaged and not intact
        self._load_ring()
        return self.items

    def _split(self, mask: int, data: bytes) -> "dict[str, bytes]":
        items = {}
        start = SLOT_HEAD_SIZE
        for place, (name, _) in enumerate(ITEMS):
            if mask >> place & 1:
                items[name] = bytes(data[start : start + SIZE_OF[name]])
            start += SIZE_OF[name]
        return items

    def store(self, changes: "dict[str, bytes]") -> None:
        """Store items: all of them or, if interrupted, none of them; other items stay unchanged.

        Raises
        ------
        ValueError
            If a name is unknown, or a length is wrong.
        OSError
            If flash does not contain the written record. The old record is then still complete.
        """
        for name in changes:
            if name not in SIZE_OF or len(changes[name]) != SIZE_OF[name]:
                raise ValueError(f"journal: {len(changes[name])} bytes for item {name!r}")
        items = dict(self.items)
        items.update(changes)
        if items == self.items:
            return
        slot = 1 - self._slot
        counter = (self._slot_counter + 1) & 0xFFFFFFFF
        mask = 0
        body = b""
        for place, (name, _) in enumerate(ITEMS):
            mask |= (name in items) << place
            body += items.get(name, bytes(SIZE_OF[name]))
        data = struct.pack(SLOT_HEAD, MAGIC, LAYOUT, mask, counter) + body
        data += struct.pack("<I", crc32(data))
        offset = slot * self._storage.block_size
        self._storage.erase(slot)
        self._storage.write(offset, data)
        if self._storage.read(offset, len(data)) != data:
            raise OSError(
                f"journal: block {slot} does not hold what was written; replace the board"
            )
        self.items = items
        self.damaged = False
        self._slot, self._slot_counter = slot, counter

    def numbers(self, name: str) -> "tuple[Any, ...] | None":
        """Return an item's numbers; None if the item was never stored."""
        data = self.items.get(name)
        return None if data is None else struct.unpack(CODES_OF[name], data)

    def checksum(self, name: str) -> int:
        """Return the CRC-32 of an item's bytes; 0 if the item was never stored."""
        data = self.items.get(name)
        return 0 if data is None else crc32(data)

    # Counts.

    @property
    def doubt(self) -> int:
        """Return the largest possible error of the counts, steps; -1 if the counts are unknown."""
        return self.doubts * self.stride if self.doubts < MOST else -1

    @property
    def looping(self) -> bool:
        """Return whether the controller keeps rebooting without a healthy minute."""
        return self.unhealthy >= BOOT_LIMIT

    def boot(self) -> None:
        """Count a boot; from then on there always is room for a last record."""
        self.boots = (self.boots + 1) & 0xFFFF
        self.unhealthy = min(self.unhealthy + 1, MOST)
        self._append(self.primary, self.secondary, True)

    def healthy(self) -> None:
        """Record that the controller has run well for ``HEALTHY_MS``."""
        if self.unhealthy:
            self.unhealthy = 0
            self._append(self.primary, self.secondary, self.rest)

    def before_steps(
        self, primary: int, secondary: int, next_primary: int, next_secondary: int
    ) -> None:
        """Write a record if the next steps would make flash wrong by more than ``stride``.

        Call this before steps are emitted.

        Parameters
        ----------
        primary, secondary
            Present counts.
        next_primary, next_secondary
            Counts after the steps that may now be emitted.

        Raises
        ------
        ValueError
            If more than ``stride`` steps are requested at once.
        """
        if self._far(next_primary, primary) or self._far(next_secondary, secondary):
            raise ValueError(
                f"journal: from {primary}, {secondary} to {next_primary}, {next_secondary}: "
                f"at most {self.stride} steps at once"
            )
        far = self._far(next_primary, self.primary) or self._far(next_secondary, self.secondary)
        if self.rest or far:
            self._append(primary, secondary, False)

    def _far(self, one: int, other: int) -> bool:
        return abs(one - other) > self.stride

    def at_rest(self, primary: int, secondary: int) -> None:
        """Record that the axes are at rest at these counts, and erase the next block in time."""
        if not (self.rest and (primary, secondary) == (self.primary, self.secondary)):
            self._append(primary, secondary, True)
        if not self._next_ready and self._place > self._places // 2:
            self._erase_next()

    def brown_out(self, primary: int, secondary: int) -> bool:
        """Write the last record while the supply fails, with one write of 32 bytes and no erasure.

        Returns whether the record was written; after ``boot`` there always is room.
        """
        if self._place >= self._places and not self._next_ready:
            return False
        self._advance()
        return self._write(primary, secondary, True)

    def zero(self, primary: int, secondary: int, doubts: int = 0) -> None:
        """Declare the present counts, with no doubt left; ``MOST`` doubts mean unknown counts."""
        self.doubts = doubts
        self._append(primary, secondary, True)

    def note(self, state: int, aim: "bytes | None", goals: "tuple[int, ...]" = ()) -> None:
        """Record state, aim and goals: a new state at once, a new aim with the next record."""
        if aim is not None and len(aim) != 12:
            raise ValueError(f"journal: {len(aim)} bytes for an aim, 12 needed")
        changed = state != self.state
        self.state, self.aim, self.goals = state, aim, goals
        if changed:
            self._append(self.primary, self.secondary, self.rest)

    # The ring.

    def _offset(self, block: int, place: int) -> int:
        return block * self._storage.block_size + place * RING_SIZE

    def _following(self, block: int) -> int:
        return block + 1 if block + 1 < self._storage.blocks else FIRST_RING_BLOCK

    def _load_ring(self) -> None:
        held: list[bytes | None] = [None, None]  # the newest records, of counts and of goals
        counters = [0, 0]
        for block in range(FIRST_RING_BLOCK, self._storage.blocks):
            for place in range(self._places):
                data = self._storage.read(self._offset(block, place), RING_SIZE)
                if data == BLANK or struct.unpack("<I", data[28:])[0] != crc32(data[:28]):
                    continue
                counter = struct.unpack("<I", data[:4])[0]
                kind = int(data[24] == GOALS)
                if held[kind] is None or _newer(counter, counters[kind]):
                    held[kind], counters[kind] = data, counter
                    if held[1 - kind] is None or _newer(counter, counters[1 - kind]):
                        self._counter, self._block = counter, block
        newest, goals = held
        if newest is None:
            return
        _, self.primary, self.secondary, aim, self.state, flags, self.boots = struct.unpack(
            RING_RECORD, newest[:28]
        )
        if goals is not None and self.state & TURNING:
            self.goals = struct.unpack("<ii", goals[4:12])
        self._newest = self._block
        self.aim = aim if flags & AIM else None
        self.doubts, self.unhealthy = flags >> 3 & MOST, flags & MOST
        if not flags & REST:
            self.doubts = min(self.doubts + 1, MOST)
        while self._place > 0 and self._blank(self._block, self._place - 1):
            self._place -= 1

    def _blank(self, block: int, place: int) -> bool:
        return self._storage.read(self._offset(block, place), RING_SIZE) == BLANK

    def _erase_next(self) -> None:
        following = self._following(self._block)
        if following == self._newest and following != self._block:
            raise OSError("journal: the ring does not hold what was written; replace the board")
        self._storage.erase(following)
        self._next_ready = True

    def _advance(self) -> None:
        if self._place >= self._places:
            self._block = self._following(self._block)
            self._place = 0
            self._next_ready = False

    def _append(self, primary: int, secondary: int, rest: bool) -> None:
        if self.goals:
            # Close to every record, so that no erasure removes one without the other.
            goals, state, self.goals, self.state = self.goals, self.state, (), GOALS
            self._append(goals[0], goals[1], rest)
            self.goals, self.state = goals, state
        for _ in range(self._places):
            if self._place >= self._places and not self._next_ready:
                self._erase_next()
            self._advance()
            if self._write(primary, secondary, rest):
                # There must be room for the next record before it is needed in a hurry.
                if self._place >= self._places and not self._next_ready:
                    self._erase_next()
                return
        raise OSError("journal: the ring does not hold what was written; replace the board")

    def _write(self, primary: int, secondary: int, rest: bool) -> bool:
        """Write one record and return whether flash contains it."""
        self._counter = (self._counter + 1) & 0xFFFFFFFF
        flags = (REST if rest else 0) | (AIM if self.aim is not None else 0)
        flags |= self.doubts << 3 | self.unhealthy
        data = struct.pack(
            RING_RECORD,
            self._counter,
            primary,
            secondary,
            self.aim or bytes(12),
            self.state,
            flags,
            self.boots,
        )
        data += struct.pack("<I", crc32(data))
        offset = self._offset(self._block, self._place)
        self._place += 1
        self._storage.write(offset, data)
        if self._storage.read(offset, RING_SIZE) != data:
            return False
        self.primary, self.secondary, self.rest = primary, secondary, rest
        self._newest = self._block
        return True


def item_name(number: int) -> str:
    """Return the name of an item by its number in QUERY_STORED; empty if there is none."""
    return ITEMS[number - 1][0] if 1 <= number <= len(ITEMS) else ""
