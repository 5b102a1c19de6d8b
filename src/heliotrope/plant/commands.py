"""Commands of people: permitted, proven, recorded, and sent, at once or when their turn comes."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from heliotrope.errors import UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.files.disk import Work
from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages as wire
from heliotrope.lcu import states
from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant.assigned import NOTHING, Held, grouped, points_of
from heliotrope.plant.authority import Authority, Person
from heliotrope.plant.beam_watch import BeamError, BeamWatch
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.given import Given
from heliotrope.plant.joining import JoiningJob, JoinQueue, in_slices
from heliotrope.plant.locks import Locks
from heliotrope.plant.movements import Movements
from heliotrope.plant.ordered import JOINING
from heliotrope.plant.orders import PlantOrders, whole
from heliotrope.plant.permission import SETTINGS, Permission
from heliotrope.plant.stepping import Stepping
from heliotrope.plant.tickets import Ticket

#: Commands that assign points; `Commands.point` proves their beams.
POINTS = frozenset({"AIM", "STANDBY"})
#: States in which a beam is at its aim.
_ON_AIM = (states.TRACKING, states.SEARCHING)
#: A new point so near the last one, and both so far off all receivers, bring no light there, m.
_BESIDE = 3.0


class Commands:
    """Gives the commands of the wire that need the command authority.

    Parameters
    ----------
    now
        Returns the monotonic time, s.
    field, orders, joining
        The plant's.
    permission
        Who may command what.
    given
        Points that were given, and whether they were taken.
    ways
        Where beams may go.
    design
        Knows the targets and receivers.
    wanted
        Parameters that local controllers should store, their standby points among them.
    patience
        Time that a heliostat waits for its turn to join, s.
    movements, locks, stepping
        What visits have taken: aims, heliostats that are locked, and fine steps.
    authority
        The plant's.
    """

    def __init__(
        self,
        now: Callable[[], float],
        field: FieldState,
        orders: PlantOrders,
        joining: JoinQueue,
        permission: Permission,
        given: Given,
        ways: BeamWatch,
        design: Plant,
        wanted: Wanted,
        patience: float,
        movements: Movements,
        locks: Locks,
        stepping: Stepping,
        authority: Authority,
    ) -> None:
        self._now, self._field, self._orders, self._joining = now, field, orders, joining
        self._permission, self._given, self._ways = permission, given, ways
        self._design, self._wanted, self._patience = design, wanted, patience
        self._movements, self._locks = movements, locks
        self._stepping, self._authority = stepping, authority

    def give(
        self,
        person: Person,
        token: int,
        name: str,
        heliostats: Sequence[str],
        values: Sequence[float],
    ) -> Ticket:
        """Give a command without points; see `PlantController.command`."""
        row = wire.ROW_OF.get(wire.NUMBER_OF.get(name, -1))
        if row is None or row[2] != wire.AUTHORITY or name in POINTS:
            known = [r[1] for r in wire.MESSAGES if r[2] == wire.AUTHORITY and r[1] not in POINTS]
            raise UnknownNameError("command (points are given by aim and standby)", name, known)
        numbers = whole(values, row[3], name)
        self._authority.check(person, token, name)
        names = tuple(dict.fromkeys(heliostats)) or self._field.names
        out = self._permission.locked_out(name, names, self._destined(name, names))
        others = tuple(n for n in names if n not in out)
        clear, wrong = self.examine(name, numbers, others, token)
        blocked = {**wrong, **out}
        accept = self._permission.accept
        store = self._lock_record(clear, token) if name == "LOCK" else None
        ticket = accept(person, token, name, numbers, names, store=store, blocked=blocked)
        if name not in SETTINGS:
            # A heliostat that still waits to join must not undo a later command.
            self._joining.drop(f"superseded by {name}", frozenset(names))
        self._orders.when_recorded(ticket, partial(self._send, ticket, numbers, clear, token))
        return ticket

    def _send(
        self,
        ticket: Ticket,
        numbers: tuple[float, ...],
        heliostats: tuple[str, ...],
        token: int,
        again: bool,
    ) -> None:
        """Send a recorded command; one that waited for its record (``again``) is examined again.

        Raises
        ------
        RefusedError
            If it may no longer be sent.
        """
        name, left = ticket.name, ticket.waiting(heliostats)
        if again and left:
            out = self._permission.still_locked_out(name, left, self._destined(name, left))
            others = tuple(n for n in left if n not in out)
            left, wrong = self.examine(name, numbers, others, token)
            ticket.block({**wrong, **out})
            if name not in SETTINGS:
                # One that was given before it may have joined the queue after its acceptance.
                self._joining.drop(f"superseded by {name}", frozenset(left))
        if left and name == "LOCK":
            self._note_lock(left, token)
        if name == "ROUGH":
            self._stepping.ordered(left, bool(numbers[0]))
        if left:
            waits = name in JOINING or in_slices(name, left)
            send = self._join if waits else self._orders.command
            send(ticket, name, numbers, left, token)

    def _lock_record(self, heliostats: tuple[str, ...], token: int) -> tuple[Work, Work]:
        """Return work that stores whose lock it is, before it is taken; and its reverse."""
        visit = self._authority.mandate_of(token) is not None
        return self._ways.points.holding(self._locks.record(heliostats, visit=visit))

    def _note_lock(self, heliostats: tuple[str, ...], token: int) -> None:
        """Note whose lock it is: a visit's, which the plant opens in the end, or a person's."""
        if self._authority.mandate_of(token) is None:
            self._locks.forget(heliostats)
        else:
            self._locks.take(heliostats, token, self._now())

    def examine(
        self, name: str, numbers: tuple[float, ...], names: tuple[str, ...], token: int = 0
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that may be sent a command now, and why the others may not.

        Raises
        ------
        BeamError
            If none may.
        """
        able, wrong = self._permission.able(name, names, token)
        if in_slices(name, able):
            return able, wrong  # each slice is examined when its turn comes
        clear, blocked = self._ways.clear(name, numbers, able, self._now())
        return clear, wrong | blocked

    def zero(self, person: Person, token: int, heliostat: str, counts: Sequence[float]) -> Ticket:
        """Declare the step counts of one heliostat; see `PlantController.zero`."""
        numbers = whole(counts, wire.ROW_OF[wire.NUMBER_OF["ZERO"]][3], "ZERO")
        if wrong := self._permission.strange((heliostat,)):
            raise BeamError("ZERO", wrong)
        self._permission.locked_out("ZERO", (heliostat,))
        ticket = self._permission.accept(person, token, "ZERO", numbers, (heliostat,))

        def send(again: bool) -> None:
            if again:
                self._permission.locked_out("ZERO", (heliostat,))
            left = ticket.waiting((heliostat,))
            self._orders.command(ticket, "ZERO", numbers, left, token)

        self._orders.when_recorded(ticket, send)
        return ticket

    def point(
        self, person: Person, token: int, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> Ticket:
        """Give AIM or STANDBY with a point (3,) for each heliostat; see `PlantController.aim`."""
        names, rows, wanted, out = self._pointed(name, points)
        self.prove_points(name, names, wanted)
        visit = self._authority.mandate_of(token) is not None

        def assign() -> frozenset[str]:
            here = self._stays(rows, wanted)
            if name == "AIM" and visit:
                self._movements.lend(names, self._aims(rows), wanted, token)
            elif name == "AIM":
                self._movements.forget(names)
            else:
                for each, place in zip(names, wanted, strict=True):
                    self._wanted.rest(each, tuple(place))
            self.assign(name, names, wanted)
            return frozenset(names[i] for i in np.flatnonzero(here))

        groups = grouped(names, wanted)
        values = next(iter(groups)) if len(groups) == 1 else ()
        all_names, note = (*names, *out), f"{len(groups)} points"
        held: Held = NOTHING
        if name == "AIM" and visit:
            held = self._movements.record(names, self._aims(rows), wanted)
        elif name == "AIM":
            held = {"LENT": dict.fromkeys(names)}
        store = self._ways.points.storing(name, rows, wanted, held)
        ticket = self._permission.accept(person, token, name, values, all_names, note, store, out)
        self.when_recorded(ticket, names, wanted, token, assign)
        return ticket

    def move(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Move beams a little beside their aims; see `PlantController.move`."""
        names, rows, wanted, out = self._pointed("AIM", points)
        tracking, aims = self._field.among((states.TRACKING,), self._now())[rows], self._aims(rows)
        if wrong := self._movements.refused(names, rows, aims, wanted, tracking):
            raise BeamError("AIM", wrong)
        self.prove_points("AIM", names, wanted)

        def assign() -> frozenset[str]:
            aims, on = self._aims(rows), np.ones(len(rows), dtype=np.bool_)
            if wrong := self._movements.refused(names, rows, aims, wanted, on):
                raise BeamError("AIM", wrong)  # aimed elsewhere while the record was written
            self._movements.take(names, aims, token, self._now())
            self.assign("AIM", names, wanted)
            return frozenset(names)

        all_names, note = (*names, *out), f"{len(names)} coded movements"
        store = self._ways.points.holding(self._movements.record(names, aims, wanted))
        accept = self._permission.accept
        ticket = accept(person, token, "AIM", (), all_names, note, store, out)
        self.when_recorded(ticket, names, wanted, token, assign)
        return ticket

    def storing(self, name: str, names: Sequence[str], wanted: FloatArray) -> tuple[Work, Work]:
        """Return work that stores points (K, 3) before they are assigned, and its reverse."""
        return self._ways.points.storing(name, self._places(names), wanted)

    def holding(self, held: Held) -> tuple[Work, Work]:
        """Return work that stores what a visit takes, and its reverse; see `Points.holding`."""
        return self._ways.points.holding(held)

    def assign(self, name: str, names: Sequence[str], wanted: FloatArray) -> None:
        """Assign points (K, 3) to heliostats, before they are sent."""
        self._ways.points.assign(name, self._places(names), wanted)

    def _places(self, names: Sequence[str]) -> npt.NDArray[np.intp]:
        return np.array([self._field.place(name) for name in names], dtype=np.intp)

    def _destined(self, name: str, names: Sequence[str]) -> FloatArray | None:
        """Return the aims (K, 3) to which a command sends beams; None: it sends them to none."""
        return self._aims(self._places(names)) if name in JOINING else None

    def _aims(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        return np.asarray(self._ways.points.aims[rows])

    def _pointed(
        self, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> tuple[tuple[str, ...], npt.NDArray[np.intp], FloatArray, dict[str, str]]:
        """Return heliostats, rows (K,) and points (K, 3), and which are out of service, and why."""
        wanted = points_of(name, points) if name == "AIM" else None
        out = self._permission.locked_out(name, points, wanted)
        points = {n: point for n, point in points.items() if n not in out}
        rows = self._places(tuple(points))
        return tuple(points), rows, points_of(name, points), out

    def when_recorded(
        self,
        ticket: Ticket,
        names: tuple[str, ...],
        wanted: FloatArray,
        token: int,
        assign: Callable[[], frozenset[str]],
    ) -> None:
        """Assign and send points once they are recorded; ``assign`` returns who needs no turn."""

        def send(again: bool) -> None:
            if again:
                self._permission.refuse_now(ticket.name, names)
                self.prove_points(ticket.name, names, wanted)
            stays = assign()
            self._given.sent(ticket, names)
            self._send_points(ticket, ticket.name, grouped(names, wanted), token, stays)

        self._orders.when_recorded(ticket, send)

    def prove_points(self, name: str, names: tuple[str, ...], wanted: FloatArray) -> None:
        """Prove that heliostats (K,) may be given points (K, 3) now.

        Raises
        ------
        BeamError
            If one of them may not.
        """
        rows = self._places(names)
        tracking = self._field.among(_ON_AIM, self._now())[rows]
        moves = tracking if name == "AIM" else self._field.among((states.IDLE,), self._now())[rows]
        moved = [names[i] for i in np.flatnonzero(moves)]
        if wrong := self._permission.unready(name, moved, wanted[moves]):
            raise BeamError(name, wrong)
        self._ways.check_points(name, rows, wanted, tracking)

    def _send_points(
        self,
        ticket: Ticket,
        name: str,
        groups: Mapping[tuple[float, ...], Sequence[str]],
        token: int,
        stays: frozenset[str],
    ) -> None:
        """Send points that are stored; heliostats that track join their new aim.

        Those that bring no light to a receiver need no turn to join: see `_stays`.
        """
        names = [n for members in groups.values() for n in members]
        rows = self._places(names)
        tracking = self._field.among(_ON_AIM, self._now())[rows]
        self._joining.drop(f"superseded by another {name}", frozenset(names), name)
        joins = {names[i] for i in np.flatnonzero(tracking)} - stays
        moving = joins if name == "AIM" else set()
        for point, members in groups.items():
            still = [n for n in members if n not in moving]
            if still:
                self._orders.command(ticket, name, point, still, token)
            if len(still) < len(members):
                self._join(ticket, name, point, [n for n in members if n in moving], token)

    def _stays(self, rows: npt.NDArray[np.intp], wanted: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which heliostats bring no light to a receiver by new points (K, 3), (K,).

        Aim and new point lie on the same target, or near each other and off every receiver: so
        moves a beam that is sent beside a target, because it misses.
        """
        aims = self._ways.points.aims[rows]
        found = np.linalg.norm(wanted - aims, axis=-1) <= _BESIDE
        for receiver in self._design.receivers:
            clear = 0.5 * float(np.hypot(receiver.width, receiver.height)) + _BESIDE
            for points in (aims, wanted):
                found &= np.linalg.norm(points - receiver.center, axis=-1) > clear
        for target in self._design.targets:
            found |= target.holds(aims) & target.holds(wanted)
        return np.asarray(found)

    def _join(
        self,
        ticket: Ticket,
        name: str,
        values: tuple[float, ...],
        heliostats: Sequence[str],
        token: int,
    ) -> None:
        until = self._now() + self._patience
        self._joining.put(JoiningJob(ticket, name, values, token, deque(heliostats), until))
