"""The controller of one heliostat, without input or output: messages and time in, actions out.

Safety rests on three things here: the state table, the sun-vector lease, and the rule that DEFOCUS
and STOW pass every check. ``wire.Gate`` decides who may command and which frames are new.

Every call returns the same list of actions, valid until the next call:

SEGMENT       axis, direction, count, interval_us: for the step timer
ANSWER        number, values: send it to the cluster controller
STORE         items by name: for ``Journal.store``
RECALL        item number: answer STORED from the journal
BEFORE_STEPS  counts now (2) and after (2): ``Journal.before_steps``, before the segments are played
AT_REST       counts (2): ``Journal.at_rest``
NOTE          state with marks, aim as bytes or None, goals or (): ``Journal.note``
ZEROED        counts (2), doubts: ``Journal.zero``
FEED          the watchdog may be fed
DRIVERS       on: switch the motors' drivers on, before segments, or off
"""

import struct

from . import messages, states, ticks
from .config import Config, is_place
from .journal import ITEMS, MOST, STATE, TURNING, items_of
from .lease import Clock, SunLease
from .motion import (
    APPROACH,
    DEFOCUS,
    DIAGNOSE,
    HOLD,
    MOVE,
    RETURN,
    ROUGH_STEPS,
    SEARCH,
    STANDBY,
    STOW,
    TRACK,
    Motion,
)

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such modules
    from collections.abc import Callable
    from typing import Any

    from .wire import Frame, Gate

(SEGMENT, ANSWER, STORE, RECALL, BEFORE_STEPS, AT_REST, NOTE, ZEROED, FEED, DRIVERS) = range(10)

#: Fault codes; their texts, and the names of the flag bits, are in ``names``.
(
    NO_FAULT,
    STUCK_PRIMARY,
    STUCK_SECONDARY,
    LIMIT_SWITCH,
    SUPPLY,
    TEMPERATURE,
    SENSOR,
    COUNTS,
    BOOTS,
    JOURNAL,
    LATCHED,
) = range(11)
#: A cause that locks but is no fault: the drives are switched off at the heliostat.
SWITCH = 11

#: States in which settings may change: settings that move nothing, pose settings, and machine
#: settings. The last two change only at rest.
HARMLESS = (
    states.UNCONFIGURED,
    states.STOWED,
    states.LOCKED,
    states.FAULT,
    states.IDLE,
    states.DEFOCUSED,
)
POSE = (states.UNCONFIGURED, states.STOWED, states.LOCKED, states.FAULT)
MACHINE = (states.UNCONFIGURED, states.LOCKED, states.FAULT)
#: Messages of class KEY that change neither the pose nor the machine, and messages that change the
#: pose.
HARMLESS_SETS = ("SET_POSITION", "SET_DEFOCUS", "SET_ADDRESS")
POSE_SETS = ("SET_ARMATURE", "SET_BIAS")

#: States that hold a position for as long as messages from the cluster arrive.
HELD = (states.LOCKED, states.UNCONFIGURED)

#: Motions that need the sun. If a board is in one of them, or in a state that needs the sun, for
#: longer than this (ms) beyond the lease, its program no longer works as it should and the watchdog
#: resets it.
FOLLOWS, LATE_MS = (STANDBY, TRACK, SEARCH, APPROACH, RETURN), 1000
#: Marks of the journal beside the state: locked at stow; turned away; on the way to stow.
PARKED, TURNED, STOWS = 0x10, 0x20, 0x80
#: A clock that changes by more than this (ms) has jumped.
CLOCK_JUMP_MS = 2000
MOST_STEPS = 1 << 29


class Controller:
    """The controller of one heliostat.

    Parameters
    ----------
    config
        Settings, loaded from the journal.
    now_ms
        The present tick; see ``ticks``.
    gate
        Gate that decides which frames may act; None if `on_message` is called directly.
    sensor
        Function that returns the tilt of the mirror; see ``Motion``.

    Attributes
    ----------
    state, fault
        Indices in ``states.STATES`` and ``names.FAULTS``.
    supply_mv, temperature_degc
        Values for STATUS, set by the caller.
    """

    def __init__(
        self,
        config: Config,
        now_ms: int,
        gate: "Gate | None" = None,
        sensor: "Callable[[], tuple[float, float] | None]" = lambda: None,
    ) -> None:
        self.config, self.gate = config, gate
        self.clock, self.sun = Clock(), SunLease(config.lease_ms)
        self.motion = Motion(config, self.sun, sensor)
        self.state, self.fault = states.UNCONFIGURED, NO_FAULT
        self.supply_mv, self.temperature_degc, self.boots = 0, 0, 0
        self.out: list[tuple[Any, ...]] = []
        self._seen = now_ms
        self._owed_ms = 0  # time charged by messages but not yet passed to the motion
        self._uptime_s = self._uptime_ms = 0
        self._dark, self._heard = ticks.Deadline(), ticks.Deadline()
        self._dark.start(now_ms, config.stow_wait_ms)
        self._heard.start(now_ms, config.silence_ms)
        self._sunless_ms = 0  # since the last sun vector; counted apart from the lease, to check it
        self._present = 0
        self._doubtful = self._aim_locked = False
        self._clock_jumped = self._ticks_jumped = False
        self._moving = False
        self._powered = True
        self._marked = -1  # state and marks in the journal

    # Start.

    def boot(
        self,
        primary: int,
        secondary: int,
        doubt: int,
        state: int,
        aim: "bytes | None",
        boots: int,
        looping: bool,
        goals: "tuple[int, ...]" = (),
    ) -> "list[tuple[Any, ...]]":
        """Start from the values that ``Journal`` has loaded.

        The arguments are the journal's values of the same names. The journal's items are already in
        the configuration.
        """
        self.out.clear()
        motion = self.motion
        motion.declare(primary, secondary, doubt >= 0)
        motion.parked = state & PARKED != 0
        if goals or state & TURNED:
            motion.aside = goals
        stows, state = state & STOWS, state & STATE
        self._doubtful = doubt != 0
        self.boots = boots
        if aim is not None:
            point = struct.unpack("<fff", aim)
            if is_place(point):
                motion.aim = point
        if not self.config.complete():
            if motion.known:
                motion.defocus()  # as far as the settings allow
            return self.out
        if looping or not motion.known:
            self.fault = BOOTS if looping else COUNTS
        elif state == states.FAULT:
            self.fault = LATCHED
        rested = state in (states.STOWED, states.FAULT)
        if looping or rested:
            motion.blind = 0  # the beam was not on the receiver, or has turned away before
        if state == states.LOCKED:
            self._event("BOOT_LOCKED")
        elif self.fault != NO_FAULT:
            self._event("BOOT_FAULT")
        else:
            self._event("BOOT_STOWED" if motion.at_stow() else "BOOT_AWAY")
        if stows and motion.known and self.state != states.LOCKED:
            self._event("SILENT")
        if rested and not looping:
            motion.blind = 1
        return self.out

    # Time.

    def _time(self, now_ms: int) -> None:
        """Charge the time since the last call to everything that has a time limit."""
        elapsed = ticks.diff(now_ms, self._seen)
        self._seen = now_ms
        if elapsed < 0:
            # After that no clock is trusted, and no lease survives.
            self._ticks_jumped = True
            self.clock.lose()
            self.sun.end()
            elapsed = 0
        self._owed_ms = min(self._owed_ms + elapsed, 1_000_000)
        self.clock.elapse(elapsed)
        self._uptime_ms += elapsed
        self._uptime_s = (self._uptime_s + self._uptime_ms // 1000) & 0xFFFFFFFF
        self._uptime_ms %= 1000
        fresh = self.sun.look(now_ms, elapsed)
        if self._present >> SWITCH:  # when they are switched on again, nothing moves at once
            self._heard.start(now_ms, self.config.silence_ms)
        silent = self._heard.over(now_ms)
        goes_on = self.motion.following() and self.state != states.FAULT
        held = self.state in HELD and self.motion.kind == HOLD and not silent
        if held or (fresh and (goes_on or self.state in states.NEED_SUN)):
            self._dark.start(now_ms, self.config.stow_wait_ms)
        dark = self._dark.over(now_ms)
        self._lapses(fresh, silent, dark)

    def _lapses(self, fresh: bool, silent: bool, dark: bool) -> None:
        """Pass expired time limits to the state table as events."""
        state, kind = self.state, self.motion.kind
        idle = state == states.IDLE
        follows = kind == RETURN or (idle and kind == STANDBY)
        if (idle and silent) or (not fresh and (follows or state in states.NEED_SUN)):
            self._event("LAPSED")
        elif state == states.DEFOCUSED:
            if dark:
                self._event("SILENT")
        elif state == states.FAULT or state in HELD:
            self._latched_lapses(silent, dark)

    def _latched_lapses(self, silent: bool, dark: bool) -> None:
        """Handle lost contact with the cluster in LOCKED or FAULT: the heliostat leaves anyway.

        The state itself stays. While the cause of a fault is present, nothing moves until the stow
        delay has passed, because the supply may be failing.
        """
        motion = self.motion
        if motion.parked or motion.at_stow() or motion.leaving():
            return
        if dark and motion.known and self.config.fits():
            self._event("SILENT")
        elif (
            silent
            and motion.kind in (HOLD, MOVE)
            and not self._present
            and (motion.known or self.state != states.UNCONFIGURED)
        ):
            self._event("LAPSED")

    def on_tick(self, now_ms: int) -> "list[tuple[Any, ...]]":
        """Advance in time; during a motion, call this more often than every ``ahead_ms``."""
        self.out.clear()
        self._time(now_ms)
        elapsed, self._owed_ms = self._owed_ms, 0
        motion = self.motion
        before = motion.kind
        event = motion.tick(elapsed)
        if event:
            self._event(event)
        if before == DIAGNOSE and motion.kind == MOVE:
            self._judge()
        stepper = motion.stepper
        if stepper is not None:
            primary, secondary, place = motion.place(0), motion.place(1), len(self.out)
            stepper.advance(elapsed, self.out, SEGMENT)
            if len(self.out) > place:
                steps = (BEFORE_STEPS, primary, secondary, motion.place(0), motion.place(1))
                self.out.insert(place, steps)
                self._moving = True
            elif self._moving and motion.still() and not motion.following():
                # A heliostat that tracks the sun stops several times a second. Recording each stop
                # would wear out the flash within a year.
                self._moving = False
                self.out.append((AT_REST, primary, secondary))
            if motion.may_rest(elapsed) == self._powered:
                self._powered = not self._powered
                self.out.insert(place, (DRIVERS, self._powered))
        self._mark()
        self._sunless_ms = min(self._sunless_ms + elapsed, 1_000_000)
        needs_sun = self.state in states.NEED_SUN or motion.kind in FOLLOWS
        if not needs_sun or self._sunless_ms <= self.config.lease_ms + LATE_MS:
            self.out.append((FEED,))
        return self.out

    # Events.

    def _event(self, name: str) -> bool:
        """Pass an event to the state table; return False if it was refused and changed nothing."""
        change = states.transition(self.state, name)
        if change is None:
            return False
        before, self.state = self.state, change[0]
        if change[1]:
            getattr(self.motion, change[1])()
        if self.state in (states.DEFOCUSED, states.FAULT) and before != self.state:
            self._dark.start(self._seen, self.config.stow_wait_ms)
        self._mark()
        return True

    def _mark(self) -> None:
        """Write changes that must survive a reset to the journal."""
        motion = self.motion
        if motion.kind not in (HOLD, DEFOCUS):
            motion.aside = None
        motion.parked = self.state == states.LOCKED and (motion.parked or motion.at_stow())
        marks = self.state
        if motion.parked:
            marks |= PARKED
        elif motion.kind == STOW:
            marks |= STOWS
        elif motion.aside is not None:
            marks |= TURNING if motion.aside else TURNED
        if marks != self._marked:
            self._marked = marks
            self._note()

    def _note(self) -> None:
        aim = self.motion.aim
        data = None if aim is None else struct.pack("<fff", aim[0], aim[1], aim[2])
        self.out.append((NOTE, self._marked, data, self.motion.aside or ()))

    def on_fault(self, number: int, now_ms: int, halt: bool) -> "list[tuple[Any, ...]]":
        """Latch a fault that the caller has detected; ``halt`` stops the motors at once.

        The cause SWITCH locks the heliostat instead. While SWITCH is present no step is made; the
        lock remains after SWITCH has gone.
        """
        self.out.clear()
        self._time(now_ms)
        if number == SWITCH:
            self._event("LOCK")
        else:
            self._latch(number)
        self._present |= 1 << number
        if halt:
            self.motion.hold()
        return self.out

    def _latch(self, number: int) -> None:
        if self.fault == NO_FAULT:
            self.fault = number
        self._event("FAULTED")

    def fault_gone(self, number: int) -> None:
        """Record that the cause of a fault has gone; the fault itself remains until CLEAR_FAULT."""
        self._present &= ~(1 << number)

    def halted(self, primary: int, secondary: int) -> "list[tuple[Any, ...]]":
        """Subtract signed steps that were emitted but not made, after a fault with ``halt``."""
        self.out.clear()
        self.motion.halted(primary, secondary)
        self._moving = False
        self.out.append((AT_REST, self.motion.place(0), self.motion.place(1)))
        return self.out

    def _judge(self) -> None:
        """Latch a fault if the diagnosis found a stuck drive."""
        result = self.motion.diagnosis[0]
        for i in (0, 1):
            if result & (4 << i):
                self._present &= ~(1 << (STUCK_PRIMARY + i))
                self._latch(STUCK_PRIMARY + i)

    # Messages.

    def on_frame(self, frame: "Frame", now_ms: int) -> "list[tuple[Any, ...]]":
        """Handle a complete frame."""
        self.out.clear()
        if not frame.for_address(self.config.address):
            return self.out
        self._time(now_ms)
        assert self.gate is not None
        verdict = self.gate.judge(frame, now_ms, self.clock.second)
        values = frame.values()
        reply = frame.to == self.config.address
        self._message(frame.number, frame.sequence, values, frame.payload, verdict, now_ms, reply)
        return self.out

    def on_message(
        self,
        number: int,
        sequence: int,
        values: "tuple[Any, ...]",
        payload: bytes,
        verdict: int,
        now_ms: int,
        reply: bool,
    ) -> "list[tuple[Any, ...]]":
        """Handle a message.

        Parameters
        ----------
        number, sequence
            Number and sequence number of the message.
        values, payload
            The message's numbers, and the bytes from which they were read; both include the head.
        verdict
            Verdict of the gate: ``messages.DONE`` if the message may act.
        now_ms
            The present tick.
        reply
            Whether the message was sent to this address alone, so that a reply is expected.
        """
        self.out.clear()
        self._time(now_ms)
        self._message(number, sequence, values, payload, verdict, now_ms, reply)
        return self.out

    def _message(
        self,
        number: int,
        sequence: int,
        values: "tuple[Any, ...] | None",
        payload: bytes,
        verdict: int,
        now_ms: int,
        reply: bool,
    ) -> None:
        who, name = messages.who_of(number), messages.name_of(number)
        if who == messages.ANYONE:
            # These are never refused, whatever the verdict, except by drives without power.
            result = messages.DONE
            if not self._present >> SWITCH:
                self._event(name)
            elif not self.motion.at_stow():
                result = messages.REFUSED_SWITCH
        elif who < 0 or who == messages.NODE:
            return
        elif verdict != messages.DONE:
            result = verdict
        elif values is None:
            result = messages.BAD_VALUE
        else:
            if who != messages.ASK or self.gate is None or not self.gate.keyed():
                # Anyone can send a query, so where frames are signed, a query keeps no heliostat in
                # place.
                self._heard.start(now_ms, self.config.silence_ms)
                if self.motion.kind == HOLD and self.state != states.FAULT:
                    self.motion.aside = None  # it may be held for long, while the sun moves on
            if who == messages.ASK:
                if reply or name == "DISCOVER":  # if all replied at once, no reply could be read
                    self._answer(name, values)
                return
            if who == messages.CLUSTER:
                self._hear(name, values, now_ms)
                return
            if who == messages.KEY:
                result = self._set(name, values[3:], payload)
            else:
                result = self._command(name, values[2:], payload)
        if reply and who in (messages.ANYONE, messages.AUTHORITY, messages.KEY):
            self.out.append((ANSWER, 0x0D, (sequence, number, result)))

    def _hear(self, name: str, values: "tuple[Any, ...]", now_ms: int) -> None:
        """Handle TIME or SUN."""
        if name == "TIME":
            if abs(self.clock.set(values[0], values[1])) > CLOCK_JUMP_MS:
                self._clock_jumped = True
        elif name == "SUN" and self.sun.take(values, self.clock, now_ms):
            self._sunless_ms = 0

    def _answer(self, name: str, values: "tuple[Any, ...]") -> None:
        motion = self.motion
        answer: tuple[Any, ...] = ()
        if name == "QUERY_STEPS":
            answer = 0x02, (motion.place(0), motion.place(1), motion.goal(0), motion.goal(1))
        elif name == "QUERY_STATUS":
            answer = 0x04, self.status()
        elif name == "QUERY_POSITION" and self.config.location is not None:
            answer = 0x06, self.config.location
        elif name == "QUERY_DIAGNOSIS":
            answer = 0x08, motion.diagnosis
        elif name == "DISCOVER" and values[0] <= self.config.serial <= values[1]:
            answer = 0x0C, (self.config.serial, self.config.firmware, self.config.address)
        elif name == "QUERY_STORED" and 1 <= values[0] <= len(ITEMS):
            if ITEMS[values[0] - 1][0] not in ("key_id", "bus_keys"):
                self.out.append((RECALL, values[0]))
            return
        if answer:
            self.out.append((ANSWER, answer[0], answer[1]))

    def status(self) -> "tuple[Any, ...]":
        """Return the numbers of STATUS."""
        return (
            self.state,
            self.flags(),
            self.fault,
            self._uptime_s,
            self.sun.age_ms(),
            self.supply_mv,
            self.temperature_degc,
            self.config.armature_crc,
            self.boots,
        )

    def flags(self) -> int:
        """Return the bits of ``names.FLAGS``."""
        motion = self.motion
        bits = 0
        for i, value in enumerate(
            (
                not motion.still(),
                self.sun.fresh(),
                self.clock.second is not None,
                self.config.complete(),
                motion.ready,
                motion.at_stow(),
                self._aim_locked,
                motion.rough,
                self._doubtful,
                not motion.known,
                motion.unreachable,
                motion.cut,
                self._clock_jumped,
                self._ticks_jumped,
                self._present % (1 << SWITCH),
                motion.kind == DIAGNOSE,
                self.sun.leaps,
                self._present >> SWITCH,
                self.gate is not None and self.gate.keyed(),
                self.gate is not None and self.gate.waits(),
            )
        ):
            bits |= bool(value) << i
        return bits

    # Commands.

    def _command(self, name: str, values: "tuple[Any, ...]", payload: bytes) -> int:
        """Carry out a fresh command of the authority; return the result for ACK."""
        if name in ("AIM", "LOCK_AIM", "ROUGH", "STANDBY"):
            return self._adjust(name, values, payload)
        if self._present >> SWITCH and name != "LOCK":
            return messages.REFUSED_SWITCH
        motion = self.motion
        if name in ("UNLOCK", "CLEAR_FAULT"):
            return messages.BUSY if motion.leaving() else self._release(name)
        if states.transition(self.state, name) is None:
            return messages.REFUSED_STATE
        if motion.kind == DIAGNOSE and name not in ("LOCK", "IDLE"):
            return messages.BUSY
        result = messages.DONE
        if name in ("APPROACH", "TRACK", "REFOCUS", "SEARCH"):
            result = self._may_go(name == "APPROACH")
            if name == "SEARCH" and not motion.prepare_search(values[0], values[1]):
                return messages.BAD_VALUE
        elif name in ("JOG", "GOTO", "DIAGNOSE"):
            result = self._may_move(name, values)
        elif (
            name == "IDLE"
            and self.state == states.DEFOCUSED
            and not (motion.ready and self.sun.fresh())
        ):
            # The heliostat would hold its position, wherever its beam is by then.
            return messages.REFUSED_STATE
        if result == messages.DONE:
            self._event(name)
        return result

    def _release(self, name: str) -> int:
        """Leave LOCKED or FAULT."""
        if name == "UNLOCK":
            if self.fault != NO_FAULT:
                name = "UNLOCK_FAULT"
            elif self.motion.at_stow():
                name = "UNLOCK_STOWED"
        else:
            if self._present or (self.fault == COUNTS and not self.motion.known):
                return messages.REFUSED_STATE
            if self.motion.at_stow():
                name = "CLEAR_FAULT_STOWED"
        if not self._event(name):
            return messages.REFUSED_STATE
        if name.startswith("CLEAR"):
            self.fault = NO_FAULT
        return messages.DONE

    def _may_go(self, up: bool) -> int:
        """Return whether the heliostat may leave stow (``up``) or go straight to its aim.

        The result is ``messages.DONE``, or the reason for a refusal.
        """
        motion = self.motion
        if not (
            (up or motion.ready) and motion.known and self.sun.fresh() and self.fault == NO_FAULT
        ):
            return messages.REFUSED_STATE
        end = self.config.standby if up else motion.aim
        if end is None or not motion.reaches(motion.way() if up else [end]):
            return messages.BAD_VALUE
        return messages.DONE

    def _may_move(self, name: str, values: "tuple[Any, ...]") -> int:
        motion = self.motion
        if not motion.known:
            return messages.REFUSED_STATE
        if name == "JOG":
            if values[0] > 1 or abs(values[1]) > MOST_STEPS:
                return messages.BAD_VALUE
            steps = [motion.goal(0), motion.goal(1)]
            steps[values[0]] += values[1]
            values = tuple(steps)
        if name != "DIAGNOSE" and not motion.prepare_move(values[0], values[1]):
            return messages.BAD_VALUE
        return messages.DONE

    def _adjust(self, name: str, values: "tuple[Any, ...]", payload: bytes) -> int:
        """Set the aim, the standby point or the stepping, without a change of state."""
        motion, config = self.motion, self.config
        if name in ("LOCK_AIM", "ROUGH"):
            if values[0] > 1:
                return messages.BAD_VALUE
            if name == "LOCK_AIM":
                self._aim_locked = values[0] == 1
            else:
                motion.set_rough(ROUGH_STEPS if values[0] else 0)
            return messages.DONE
        if name == "AIM" and self._aim_locked:
            return messages.REFUSED_STATE
        if self.state == states.SEARCHING or motion.kind in (APPROACH, RETURN):
            return messages.BUSY
        follows = self.state == states.TRACKING if name == "AIM" else motion.kind == STANDBY
        if not is_place(values) or (follows and not motion.reaches([values])):
            return messages.BAD_VALUE
        if name == "AIM":
            motion.aim = values[0], values[1], values[2]
            self._note()
        else:
            config.standby = values[0], values[1], values[2]
            self.out.append((STORE, {"standby": payload[8:]}))
        motion.renew()
        return messages.DONE

    # Stored settings.

    def _set(self, name: str, values: "tuple[Any, ...]", payload: bytes) -> int:
        """Accept a setting in a safe state and at rest; return the result for ACK."""
        allowed: tuple[int, ...] = MACHINE
        if name in HARMLESS_SETS:
            allowed = HARMLESS
        elif name in POSE_SETS:
            allowed = POSE
        if self.state not in allowed:
            return messages.REFUSED_STATE
        motion, config = self.motion, self.config
        moves = motion.following() or motion.leaving() or not motion.still()
        if allowed is not HARMLESS and moves:
            return messages.REFUSED_STATE
        if name == "ZERO":
            if max(abs(values[0]), abs(values[1])) > MOST_STEPS:
                return messages.BAD_VALUE
            motion.hold()
            motion.declare(values[0], values[1], True)
            self._doubtful, motion.ready = False, False
            self.out.append((ZEROED, values[0], values[1], 0))
            self.out.append((STORE, items_of(name, payload)))
            return messages.DONE
        if name == "SET_ADDRESS" and values[0] != config.serial:
            return messages.BAD_VALUE
        try:
            items = items_of(name, payload)
        except ValueError:
            return messages.BAD_VALUE
        known = motion.known
        for item in items:
            if item != "edition" and not config.take(item, items[item]):
                return messages.BAD_VALUE
        if allowed is not HARMLESS:
            motion.hold()  # in another pose, a defocused heliostat must not continue with the sun
        if name != "SET_ADDRESS":
            motion.rebuild()
        if known and not motion.known:
            self._doubtful = True
            self.out.append((ZEROED, motion.place(0), motion.place(1), MOST))
            self._latch(COUNTS)
        self.out.append((STORE, items))
        if self.state == states.UNCONFIGURED and config.complete():
            self._event("CONFIGURED")
        return messages.DONE
