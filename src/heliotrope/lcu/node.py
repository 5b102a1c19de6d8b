"""A complete local controller except for its pins, as run by boards and by the simulator.

``Node`` joins the reader of frames, the gate, the controller, the journal and the step timer. A
node has no loop, clock or port of its own: bytes and time come in through calls, bytes go out
through ``write``, steps go to the timer, and records go to flash. A node boots when it is created;
to reset it, create another node on the same flash.

::

    node = Node(flash, timer, uart.write, now_ms(), serial=4711, sha256=sha256, key=key)
    while True:
        node.on_bytes(uart.read(), now_ms())     # when bytes have arrived
        node.on_tick(now_ms())                   # always, every 50 ms or more often

``now_ms`` is a counter of milliseconds modulo 2^30, like ``time.ticks_ms``; see ``ticks``.

**Replies** carry the sequence number of the frame that requested them, and are sent within the call
that delivered that frame. The exception is HERE, which waits for a randomly chosen slot,
``HERE_SLOTS`` of ``HERE_SLOT_MS`` each. HERE is the only reply to a broadcast query.

**Order.** Flash is written before the steps that it records are executed, and before an ACK reports
that something was stored. An emergency stop takes precedence over everything else.

**A journal that fails** latches the fault JOURNAL, which holds until the next reset; from then on
nothing is written and nothing is stored. The heliostat still moves its beam off the receiver and
goes to stow, because that is more important than correct step counts; a boot on such flash treats
the counts as unknown.
"""

import struct

from . import controller, messages, ticks, wire
from .config import Config
from .controller import Controller
from .journal import HEALTHY_MS, Journal, item_name

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such modules
    from collections.abc import Callable
    from typing import Any, Protocol

    from .journal import Storage
    from .signing import BusKeys

    class StepTimer(Protocol):
        """Hardware that makes the steps of the two axes."""

        def play(self, axis: int, direction: int, count: int, interval_us: int) -> None:
            """Queue ``count`` steps of ``axis`` (0, 1), with ``direction`` 1 or -1.

            The steps are made after the steps already queued for the axis, ``interval_us`` apart.
            The two axes run independently. The call never blocks.
            """

        def stop(self) -> "tuple[int, int]":
            """Stop both axes at once; return the signed steps queued but not made, one per axis."""


#: Slots in which HERE replies to DISCOVER: their number, and the length of each (ms).
HERE_SLOTS, HERE_SLOT_MS = 32, 20
ACK, HERE, STORED = 0x0D, 0x0C, 0x0A
QUERY_BUS, BUS, SET_BUS_KEY = 0x0E, 0x0F, 0x5B
#: An action of the node itself, in addition to those of the controller.
HEALTHY = -1


def no_sensor() -> "tuple[float, float] | None":
    """Return no tilt, because no accelerometer is fitted."""
    return None


def no_watchdog() -> None:
    """Do nothing, because there is no watchdog."""


def no_enable(on: bool) -> None:
    """Do nothing, because the motors' drivers are always on."""


class Node:
    """One complete local controller.

    Parameters
    ----------
    storage
        NOR flash: ``block_size``, ``blocks``, ``read``, ``write``, ``erase``; see ``journal``.
    timer
        Step timer: ``play(axis, direction, count, interval_us)``, and ``stop()``, which returns
        the signed steps that were queued but not made.
    write
        Function that sends bytes to the cluster controller.
    now_ms
        The present tick.
    serial, firmware
        Values reported in HERE.
    sha256
        The hash function, ``sha256(data) -> 32 bytes``; if None, nothing can be stored.
    key
        Key of this controller; with b"", nothing can be stored.
    sensor
        Function that returns the mirror's tilt (x, y), rad, or None if there is no reading; see
        ``Motion``.
    feed
        Function that feeds the hardware watchdog.
    drivers
        Function that switches the motors' drivers on (True) or off; they are on at start-up.

    Attributes
    ----------
    controller, gate, journal, reader, timer
        The parts of the node.
    trouble
        The error of flash that has failed; empty if there is none.
    """

    def __init__(
        self,
        storage: "Storage",
        timer: "StepTimer",
        write: "Callable[[bytes], Any]",
        now_ms: int,
        serial: int,
        firmware: int = 0,
        sha256: "Callable[[bytes], bytes] | None" = None,
        key: bytes = b"",
        sensor: "Callable[[], tuple[float, float] | None]" = no_sensor,
        feed: "Callable[[], Any]" = no_watchdog,
        drivers: "Callable[[bool], Any]" = no_enable,
    ) -> None:
        self.timer, self.reader, self.trouble = timer, wire.Reader(), ""
        self._write, self._feed, self._drivers = write, feed, drivers
        self.journal = journal = Journal(storage)
        config = Config()
        config.serial, config.firmware = serial, firmware
        good = config.load(journal.load()) and not journal.damaged
        edition = journal.numbers("edition")
        self.gate = wire.Gate(sha256, key, edition[0] if edition else 0)
        self.controller = Controller(config, now_ms, self.gate, sensor)
        self._address = self._sequence = 0  # of the replies to the current frame
        self._here: tuple[Any, ...] = ()  # a HERE that waits for its slot
        self._slot, self._well = ticks.Deadline(), ticks.Deadline()
        self._well.start(now_ms, HEALTHY_MS)
        self._healthy = False
        doubt = journal.doubt
        try:
            journal.boot()
        except OSError as error:
            self.trouble, doubt = str(error), -1
        self._sha256, self._key = sha256, key
        stored = journal.items.get("bus_keys")
        self._bus: BusKeys | None = None
        if stored is not None and sha256 is not None:
            self._begin_bus(sha256).take(stored)
        self._chance = (serial * 0x9E3779B1 + journal.boots) & 0xFFFFFFFF or 1
        actions = self.controller.boot(
            journal.primary,
            journal.secondary,
            doubt,
            journal.state,
            journal.aim,
            journal.boots,
            journal.looping,
            journal.goals,
        )
        self._obey(actions, now_ms)
        if self.trouble or not good:
            self.on_fault(controller.JOURNAL, now_ms, False)
            if not self.trouble:  # lost settings can be stored again
                self.controller.fault_gone(controller.JOURNAL)

    def on_bytes(self, data: bytes, now_ms: int) -> None:
        """Accept received bytes, in pieces of any size."""
        for frame in self.reader.feed(data):
            self.on_frame(frame, now_ms)

    def on_frame(self, frame: "wire.Frame", now_ms: int) -> None:
        """Handle a complete frame; a simulated bus may parse it once for many nodes."""
        own = self.controller
        # A new address takes effect after the reply.
        self._address, self._sequence = own.config.address, frame.sequence
        if frame.number in (QUERY_BUS, SET_BUS_KEY):
            if frame.to == self._address:
                self._on_bus_key(frame, now_ms)
            return
        self._obey(own.on_frame(frame, now_ms), now_ms)

    def on_tick(self, now_ms: int) -> None:
        """Advance in time; call this every 50 ms or more often."""
        self._obey(self.controller.on_tick(now_ms), now_ms)
        if self._here and self._slot.over(now_ms):
            values, self._here = self._here, ()
            self._send(values[0], values[1], HERE, values[2])
        if not self._healthy and self._well.over(now_ms):
            self._healthy = True
            self._obey([(HEALTHY,)], now_ms)

    def on_fault(self, number: int, now_ms: int, halt: bool) -> None:
        """Latch a fault of ``controller`` that the board has detected; ``halt`` stops the motors.

        The cause counts as present until ``fault_gone``. ``controller.SWITCH``, always with
        ``halt``, is not a fault: it means that the drives have been switched off at the heliostat,
        which is then locked.
        """
        undone = self.timer.stop() if halt else (0, 0)
        self._obey(self.controller.on_fault(number, now_ms, halt), now_ms)
        if halt:
            self._obey(self.controller.halted(undone[0], undone[1]), now_ms)

    def fault_gone(self, number: int) -> None:
        """Record that the cause of a fault has gone; the fault remains until CLEAR_FAULT."""
        self.controller.fault_gone(number)

    def on_supply_failing(self, now_ms: int) -> bool:
        """Stop and store the step counts, because the supply will fail within milliseconds.

        Returns whether flash contains the counts. The fault SUPPLY is latched; if the supply comes
        back without a reset, call ``fault_gone``.
        """
        undone = self.timer.stop()
        motion = self.controller.motion
        kept = False
        if not self.trouble:
            try:
                kept = self.journal.brown_out(
                    motion.place(0) - undone[0], motion.place(1) - undone[1]
                )
            except OSError as error:
                self.trouble = str(error)
        self._obey(self.controller.on_fault(controller.SUPPLY, now_ms, True), now_ms)
        self._obey(self.controller.halted(undone[0], undone[1]), now_ms)
        return kept

    def measured(self, supply_mv: int, temperature_degc: int) -> None:
        """Set the supply voltage and temperature reported in STATUS."""
        self.controller.supply_mv = min(max(supply_mv, 0), 0xFFFF)
        self.controller.temperature_degc = min(max(temperature_degc, -128), 127)

    # The bus key.

    def _begin_bus(self, sha256: "Callable[[bytes], bytes]") -> "BusKeys":
        """Return the bus keys; their module is loaded when it is first needed."""
        from .signing import BusKeys

        if self._bus is None:
            serial = self.controller.config.serial
            self._bus = self.gate.bus = BusKeys(sha256, self._key, serial, self.journal.boots)
        return self._bus

    def _on_bus_key(self, frame: "wire.Frame", now_ms: int) -> None:
        own = self.controller
        values = frame.values()
        if values is None or not self._key or self._sha256 is None:
            return
        bus = self._begin_bus(self._sha256)
        if frame.number == QUERY_BUS:
            self._send(self._address, self._sequence, BUS, bus.told())
            return
        result = self.gate.judge_key(frame, values[2])
        if result == messages.DONE and own.state not in controller.HARMLESS:
            result = messages.REFUSED_STATE
        if result == messages.DONE:
            keyed, stored = bus.keyed, bus.with_key(frame.payload)
            items = {"bus_keys": stored, "edition": frame.payload[8:12]}
            if self._keep(controller.STORE, (controller.STORE, items)):
                self.gate.edition = values[2]
                bus.take(stored)
                if not keyed:
                    self.gate.replay.epoch = -1  # anyone may have set it
            else:
                result = messages.NOT_STORED
        self._answer(ACK, (self._sequence, frame.number, result), True, now_ms)

    # The controller's actions.

    def _obey(self, actions: "list[tuple[Any, ...]]", now_ms: int) -> None:
        before = self.trouble
        kept = True
        for action in actions:
            kind = action[0]
            if kind == controller.SEGMENT:
                self.timer.play(action[1], action[2], action[3], action[4])
            elif kind == controller.FEED:
                self._feed()
            elif kind == controller.DRIVERS:
                self._drivers(action[1])
            elif kind == controller.ANSWER:
                self._answer(action[1], action[2], kept, now_ms)
            elif kind == controller.RECALL:
                data = self.journal.items.get(item_name(action[1]), b"")
                self._send(self._address, self._sequence, STORED, (action[1], data))
            else:
                kept = self._keep(kind, action) and kept
        if self.trouble and not before:
            self.on_fault(controller.JOURNAL, now_ms, False)

    def _keep(self, kind: int, action: "tuple[Any, ...]") -> bool:
        """Carry out actions on the journal; return False if flash fails or has failed before."""
        journal = self.journal
        if self.trouble:
            return False
        try:
            if kind == controller.BEFORE_STEPS:
                journal.before_steps(action[1], action[2], action[3], action[4])
            elif kind == controller.AT_REST:
                journal.at_rest(action[1], action[2])
            elif kind == controller.NOTE:
                journal.note(action[1], action[2], action[3])
            elif kind == controller.STORE:
                journal.store(action[1])
            elif kind == controller.ZEROED:
                journal.zero(action[1], action[2], action[3])
            elif kind == HEALTHY:
                journal.healthy()
        except OSError as error:
            self.trouble = str(error) or "journal: flash failed"
            return False
        return True

    # Replies.

    def _answer(self, number: int, values: "tuple[Any, ...]", kept: bool, now_ms: int) -> None:
        if number == ACK and values[2] == messages.DONE and not kept:
            values = values[0], values[1], messages.NOT_STORED
        if number != HERE:
            self._send(self._address, self._sequence, number, values)
            return
        self._here = self._address, self._sequence, values
        self._slot.start(now_ms, self._draw(now_ms) * HERE_SLOT_MS)

    def _draw(self, now_ms: int) -> int:
        """Draw a slot at random, with Marsaglia's xorshift.

        The slots differ between controllers and between calls.
        """
        chance = self._chance ^ now_ms or 1
        chance ^= (chance << 13) & 0xFFFFFFFF
        chance ^= chance >> 17
        chance ^= (chance << 5) & 0xFFFFFFFF
        self._chance = chance
        return chance % HERE_SLOTS

    def _send(self, address: int, sequence: int, number: int, values: "tuple[Any, ...]") -> None:
        if number == STORED:
            payload = bytes([values[0]]) + values[1]
        else:
            payload = struct.pack("<" + messages.codes_of(number), *values)
        frame = wire.Frame(wire.CLUSTER_ADDRESS, address, sequence, number, payload)
        self._write(wire.sealed(frame))
