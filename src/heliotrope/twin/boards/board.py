"""A simulated heliostat board that runs the real firmware.

The firmware is an `lcu.node.Node` on simulated hardware. The board has flash, a millisecond
counter, two motors with step timers, and a supply that may fail at any instant, even during a flash
write. `Board` is a `Station` on a bus; `step` advances its time. A `Witness` sees all its actions
without affecting them.
"""

import contextlib
import math
import random
import struct
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.lcu.controller import SWITCH, Controller
from heliotrope.lcu.journal import CODES_OF, Journal
from heliotrope.lcu.node import Node
from heliotrope.twin.boards.clocks import TickCounter
from heliotrope.twin.boards.flash import NorFlash, PowerCutError
from heliotrope.twin.boards.motors import MotorAxis
from heliotrope.twin.boards.outfit import Outfit, sha256
from heliotrope.twin.wind import Wind

#: Longest intervals between two passes of the main loop: while making steps, while following the
#: sun, and at rest. A real board loops far more often. The first interval is the longest that the
#: core allows; the other two save computing time.
MOVING, FOLLOWING, RESTING = 0.05, 0.1, 0.5


class Witness(Protocol):
    """An observer of a board's actions."""

    def acted(self, board: "Board", what: str, now: float) -> None:
        """Record what a board has done: "bytes", "tick", "boot" or "cut" (power lost)."""
        ...

    def stepped(
        self, board: "Board", axis: int, direction: int, count: int, interval_us: int
    ) -> None:
        """Record a segment that a board has sent to its step timer."""
        ...


class _Timer:
    """The step timer as the node sees it."""

    def __init__(self, board: "Board") -> None:
        self._board = board

    def play(self, axis: int, direction: int, count: int, interval_us: int) -> None:
        board = self._board
        if board.witness is not None:
            board.witness.stepped(board, axis, direction, count, interval_us)
        board.axes[axis].take(direction, count, interval_us, board.now)

    def stop(self) -> tuple[int, int]:
        for axis in self._board.axes:
            axis.play_to(self._board.now)
        return self._board.axes[0].stop(), self._board.axes[1].stop()


class Board:
    """One local controller with its heliostat.

    Parameters
    ----------
    outfit
        The heliostat: name, addresses, mechanism, journal. The board may belong to another
        heliostat; see `exchange`.
    seed
        Seed of the flash, the motors and the random choices.
    ticks
        The board's millisecond counter.
    play, miss
        Backlash and missed steps of the motors; see `MotorAxis`.
    wind
        Wind that deflects the mirror; None for no wind.

    Attributes
    ----------
    node
        None while the supply is off.
    axes
        Motors.
    slip
        Position of the motors relative to the node's counts, steps; set at each boot and by ZERO.
    now
        True time of the last event, in s.
    tilt
        Accelerometer reading; None if there is no accelerometer.
    switched_off
        Whether the drives are switched off at the mirror.
    powered
        Whether the motor drivers are on.
    """

    def __init__(
        self,
        outfit: Outfit,
        *,
        seed: int = 0,
        ticks: TickCounter | None = None,
        play: float = 0.0,
        miss: float = 0.0,
        wind: Wind | None = None,
    ) -> None:
        chance = random.Random(seed)
        self.outfit, self.wind = outfit, wind
        self.ticks = ticks or TickCounter()
        self.flash = NorFlash(chance.getrandbits(32))
        self._serial = outfit.serial
        self.axes = [
            MotorAxis(count, play, miss, random.Random(chance.random())) for count in outfit.stow
        ]
        self.node: Node | None = None
        self.witness: Witness | None = None
        self.slip = [0, 0]
        self.now = 0.0
        self.tilt: tuple[float, float] | None = None
        self.switched_off, self.powered = False, True
        self._out = bytearray()
        self._last_pass = -math.inf
        self._restless = False
        self._posed: tuple[float, float] | None = None
        self._pose: tuple[FloatArray, FloatArray] = np.zeros(3), np.zeros(3)
        journal = Journal(self.flash)
        journal.load()
        journal.store(outfit.items)
        journal.zero(*outfit.stow)

    # -- the supply --------------------------------------------------------------------

    def power_on(self, now: float) -> None:
        """Boot the board unless it is already running; the flash may fail during the boot."""
        if self.node is not None:
            return
        self.now = now
        # If the journal's counts differ from those of the motors, the difference becomes slip.
        journal = Journal(self.flash)
        journal.load()
        self._counts_from((journal.primary, journal.secondary))
        self._last_pass = -math.inf
        try:
            self.node = Node(
                self.flash,
                _Timer(self),
                self._out.extend,
                self.ticks.at(now),
                serial=self._serial,
                sha256=sha256,
                key=self.outfit.key,
                sensor=lambda: self.tilt,
                drivers=self._drive,
            )
            self._switch()
        except PowerCutError:
            self._die()
            return
        self._tell("boot")

    def zeroed(self) -> None:
        """Record that step counts were declared, and the motors' offset from these counts."""
        if self.node is not None:
            self._counts_from([self.node.controller.motion.place(axis) for axis in (0, 1)])

    def _counts_from(self, counts: Sequence[int]) -> None:
        """Restart the count of emitted steps at the motors' positions.

        Steps missed earlier are contained in ``slip``.
        """
        self.slip = [axis.turned - count for axis, count in zip(self.axes, counts, strict=True)]
        for axis in self.axes:
            axis.emitted = axis.turned

    def power_off(self, now: float, *, warned: bool = False) -> None:
        """Cut the supply.

        If ``warned``, the brown-out detector notices the failure in time.
        """
        self._to(now)
        if self.node is None:
            return
        if warned:
            with contextlib.suppress(PowerCutError):
                self.node.on_supply_failing(self.ticks.at(now))
        self._die()

    def exchange(self, serial: int, items: Mapping[str, bytes] | NorFlash) -> NorFlash:
        """Install another board at the heliostat while its power is off; return the old flash.

        Parameters
        ----------
        serial
            Serial number of the other board.
        items
            Items that the new board stores, with its counts set to stow; or the flash of a board
            that was installed here before.
        """
        assert self.node is None
        before, self._serial = self.flash, serial
        if isinstance(items, NorFlash):
            self.flash = items
            return before
        self.flash = NorFlash(serial)
        journal = Journal(self.flash)
        journal.load()
        journal.store(dict(items))
        journal.zero(*struct.unpack(CODES_OF["stow"], items["stow"]))
        return before

    def switch(self, now: float, *, off: bool) -> None:
        """Switch the drives off or on with the switch at the heliostat."""
        self._to(now)
        self.switched_off = off
        try:
            self._switch()
        except PowerCutError:
            self._die()

    def _switch(self) -> None:
        if self.node is not None and self.switched_off:
            self.node.on_fault(SWITCH, self.ticks.at(self.now), True)
        elif self.node is not None:
            self.node.fault_gone(SWITCH)

    def _drive(self, on: bool) -> None:
        node = self.node
        self.powered = on
        if not on and node is not None:
            for axis, full in zip(self.axes, node.controller.config.microsteps, strict=True):
                axis.release(full)

    def _die(self) -> None:
        for axis in self.axes:
            axis.play_to(self.now)
            axis.stop()
        self.flash.budget = None
        self._out.clear()
        self.node = None
        self._tell("cut")

    def _to(self, now: float) -> None:
        self.now = now
        for axis in self.axes:
            if not axis.idle:
                axis.play_to(now)

    def _tell(self, what: str) -> None:
        if self.witness is not None:
            self.witness.acted(self, what, self.now)

    # -- events ------------------------------------------------------------------------

    def hear(self, data: bytes, now: float) -> bytes:
        """Receive bytes from the bus and return the immediate reply."""
        self._to(now)
        if self.node is None:
            return b""
        self._restless = True
        try:
            self.node.on_bytes(data, self.ticks.at(now))
        except PowerCutError:
            self._die()
            return b""
        self._tell("bytes")
        return self._spoken()

    def step(self, now: float) -> bytes:
        """Run one pass of the main loop and return the bytes that the board sends unrequested."""
        self._to(now)
        if self.node is None:
            return b""
        self._last_pass = now
        self._restless = False
        try:
            self.node.on_tick(self.ticks.at(now))
        except PowerCutError:
            self._die()
            return b""
        self._tell("tick")
        return self._spoken()

    def _spoken(self) -> bytes:
        out = bytes(self._out)
        self._out.clear()
        return out

    def due(self, now: float) -> float:
        """Return the latest time at which the main loop should run next, in s.

        Running earlier is always allowed.
        """
        node = self.node
        if node is None:
            return math.inf
        if self._restless or not node.controller.motion.still():
            return self._last_pass + MOVING
        own = node.controller
        busy = own.state in (states.APPROACHING, states.SEARCHING, states.STOWING)
        pause = RESTING
        if busy or own.motion.following():
            pause = MOVING if busy else FOLLOWING
        if own.sun.fresh():
            # At the end of the lease the loop runs at once, as on a real board.
            remaining = (own.config.lease_ms - own.sun.age_ms() + 1) / 1000.0
            pause = min(pause, max(0.0, now - self._last_pass) + remaining)
        return self._last_pass + pause

    # -- truth -------------------------------------------------------------------------

    @property
    def controller(self) -> Controller | None:
        """The controller; None while the supply is off."""
        return None if self.node is None else self.node.controller

    @property
    def state(self) -> int:
        """State, one of `lcu.states`; -1 while the supply is off."""
        return -1 if self.node is None else self.node.controller.state

    def mirror(self, *, believed: bool = False) -> tuple[FloatArray, FloatArray]:
        """Return the mirror's vertex and unit normal at the time of the last event.

        Parameters
        ----------
        believed
            Whether to ignore slip and wind, which yields the position that the node believes.
        """
        counts = [axis.joint for axis in self.axes]
        if believed:
            counts = [axis.turned - slip for axis, slip in zip(self.axes, self.slip, strict=True)]
        key = (counts[0], counts[1])
        if key != self._posed:  # observers query one position several times
            pose = self.outfit.mechanism.pose(counts)
            self._posed, self._pose = key, (pose.vertex, pose.normal)
        vertex, normal = self._pose
        if self.wind is None or believed:
            return vertex, normal
        return vertex, self.wind.turned(normal, self.outfit.mechanism.position, self.now)

    def beam(self, sun: FloatArray, *, believed: bool = False) -> tuple[FloatArray, FloatArray]:
        """Return the vertex of the mirror, (3,), m, and the direction of the reflected ray, (3,).

        Parameters
        ----------
        sun
            Direction to the sun, (3,).
        believed
            As for `mirror`.
        """
        vertex, normal = self.mirror(believed=believed)
        return vertex, 2.0 * (normal @ sun) * normal - sun

    def miss(
        self, sun: FloatArray, point: "tuple[float, float, float]", *, believed: bool = False
    ) -> float:
        """Return the distance of the reflected ray from a point, m; infinite if it leads away."""
        # Computed with scalars, because numpy takes several times as long for three numbers.
        vertex, normal = (vector.tolist() for vector in self.mirror(believed=believed))
        (a, b, c), (i, j, k), (s, t, u) = vertex, normal, sun.tolist()
        twice = 2.0 * (i * s + j * t + k * u)
        x, y, z = point[0] - a, point[1] - b, point[2] - c
        along = x * (twice * i - s) + y * (twice * j - t) + z * (twice * k - u)
        if along <= 0.0:
            return math.inf
        return math.sqrt(max(0.0, x * x + y * y + z * z - along * along))
