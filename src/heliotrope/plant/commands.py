"""Commands of people: permitted, proven, recorded, and sent, at once or when their turn comes."""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import numpy.typing as npt

from heliotrope.errors import UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages as wire
from heliotrope.lcu import states
from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant.assigned import grouped, points_of
from heliotrope.plant.audit import AuditError
from heliotrope.plant.authority import Person, RefusedError
from heliotrope.plant.beam_watch import BeamError, BeamWatch
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.given import Given
from heliotrope.plant.joining import JoiningJob, JoinQueue, in_slices
from heliotrope.plant.movements import Movements
from heliotrope.plant.ordered import JOINING
from heliotrope.plant.orders import PlantOrders, whole
from heliotrope.plant.permission import Permission
from heliotrope.plant.stepping import Stepping
from heliotrope.plant.tickets import Ticket

#: Commands that move nothing.
SETTINGS = frozenset({"LOCK_AIM", "ROUGH"})
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
    movements
        Beams that are a little beside their aims.
    stepping
        How local controllers must step.
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
        stepping: Stepping,
    ) -> None:
        self._now, self._field, self._orders, self._joining = now, field, orders, joining
        self._permission, self._given, self._ways = permission, given, ways
        self._design, self._wanted, self._patience = design, wanted, patience
        self._movements, self._stepping = movements, stepping

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
        names = tuple(dict.fromkeys(heliostats)) or self._field.names
        out = self._permission.locked_out(name, names)
        clear, wrong = self.examine(name, numbers, tuple(n for n in names if n not in out))
        ticket = self._permission.accept(person, token, name, numbers, names)
        ticket.block({**wrong, **out})
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
            self._permission.refuse_now(name, left)
            out = self._permission.still_locked_out(name, left)
            left, wrong = self.examine(name, numbers, tuple(n for n in left if n not in out))
            ticket.block({**wrong, **out})
            if name not in SETTINGS:
                # One that was given before it may have joined the queue after its acceptance.
                self._joining.drop(f"superseded by {name}", frozenset(left))
        if name == "ROUGH":
            self._stepping.ordered(left, bool(numbers[0]))
        if left:
            waits = name in JOINING or in_slices(name, left)
            send = self._join if waits else self._orders.command
            send(ticket, name, numbers, left, token)

    def examine(
        self, name: str, numbers: tuple[float, ...], names: tuple[str, ...]
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that may be sent a command now, and why the others may not.

        Raises
        ------
        BeamError
            If none may.
        """
        able, wrong = self._permission.able(name, names)
        if in_slices(name, able):
            return able, wrong  # each slice is examined when its turn comes
        clear, blocked = self._ways.clear(name, numbers, able, self._now())
        return clear, wrong | blocked

    def zero(self, person: Person, token: int, heliostat: str, counts: Sequence[float]) -> Ticket:
        """Declare the step counts of one heliostat; see `PlantController.zero`."""
        numbers = whole(counts, wire.ROW_OF[wire.NUMBER_OF["ZERO"]][3], "ZERO")
        if wrong := self._permission.strange((heliostat,)):
            raise BeamError("ZERO", wrong)
        ticket = self._permission.accept(person, token, "ZERO", numbers, (heliostat,))
        self._orders.when_recorded(
            ticket,
            lambda _: self._orders.command(
                ticket, "ZERO", numbers, ticket.waiting((heliostat,)), token
            ),
        )
        return ticket

    def point(
        self, person: Person, token: int, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> Ticket:
        """Give AIM or STANDBY with a point (3,) for each heliostat; see `PlantController.aim`."""
        names, rows, wanted, out = self._pointed(name, points)
        self._prove_points(name, names, rows, wanted)
        keep = self._ways.points

        def assign() -> frozenset[str]:
            here = self._stays(rows, wanted)
            keep.assign(name, rows, wanted)
            if name == "AIM":
                self._movements.forget(names)
            else:
                for each, place in zip(names, wanted, strict=True):
                    self._wanted.rest(each, tuple(place))
            return frozenset(names[i] for i in np.flatnonzero(here))

        groups = grouped(names, wanted)
        values = next(iter(groups)) if len(groups) == 1 else ()
        all_names, note = (*names, *out), f"{len(groups)} points"
        store = keep.storing(name, rows, wanted)
        ticket = self._permission.accept(person, token, name, values, all_names, note, store)
        ticket.block(out)
        self._when_recorded(ticket, names, wanted, token, assign)
        return ticket

    def move(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Move beams a little beside their aims; see `PlantController.move`."""
        names, rows, wanted, out = self._pointed("AIM", points)
        tracking, aims = self._field.among((states.TRACKING,), self._now())[rows], self._aims(rows)
        if wrong := self._movements.refused(names, rows, aims, wanted, tracking):
            raise BeamError("AIM", wrong)
        self._prove_points("AIM", names, rows, wanted)

        def assign() -> frozenset[str]:
            aims, on = self._aims(rows), np.ones(len(rows), dtype=np.bool_)
            if wrong := self._movements.refused(names, rows, aims, wanted, on):
                raise BeamError("AIM", wrong)  # aimed elsewhere while the record was written
            self._movements.take(names, aims, token, self._now())
            self._ways.points.assign("AIM", rows, wanted)
            return frozenset(names)

        all_names, note = (*names, *out), f"{len(names)} coded movements"
        ticket = self._permission.accept(person, token, "AIM", (), all_names, note)
        ticket.block(out)
        self._when_recorded(ticket, names, wanted, token, assign)
        return ticket

    def bring_back(self, token: int) -> None:
        """Send moved beams back to their aims that are due, as far as motions are accepted now.

        ``token`` is that of the present command authority, whoever has it.
        """
        due = self._movements.due(self._now(), token)
        if not due:
            return
        self._movements.wait(due, token, self._now())
        names = self._free_to_return(due)
        if not names:
            return
        rows = np.array([self._field.place(n) for n in names], dtype=np.intp)
        wanted = np.stack([due[n] for n in names])

        def assign() -> frozenset[str]:
            aimed = [name for name in names if name not in self._movements.names]
            if aimed:  # while the record was written
                raise BeamError("AIM", dict.fromkeys(aimed, "it has another aim now"))
            self._ways.points.assign("AIM", rows, wanted)
            return frozenset(names)

        note = f"{len(names)} beams go back to their aims"
        try:
            ticket = self._orders.accept(("plant", "anybody", "AIM"), (), names, note)
        except AuditError:
            return
        self._movements.sent(ticket, token, self._now())
        self._when_recorded(ticket, names, wanted, token, assign)

    def step(self, token: int) -> None:
        """Order heliostats to step finely or roughly, as far as motions are accepted now.

        ``token`` is that of the present command authority, whoever has it.
        """
        for rough, due in self._stepping.due(self._now(), token).items():
            self._stepping.sent(due, self._now())
            blocked = self._permission.strange(due)
            names = tuple(name for name in due if name not in blocked)
            if not names:
                continue
            note = f"{len(names)} step {'roughly again' if rough else 'finely for a visit'}"
            values = (float(rough),)
            try:
                self._permission.refuse_now("ROUGH", names)
                ticket = self._orders.accept(("plant", "anybody", "ROUGH"), values, names, note)
            except (RefusedError, AuditError):
                continue
            self._orders.when_recorded(ticket, partial(self._send_step, ticket, values, token))

    def _send_step(
        self, ticket: Ticket, values: tuple[float, ...], token: int, again: bool
    ) -> None:
        left = ticket.waiting(ticket.heliostats)
        if again:
            self._permission.refuse_now(ticket.name, left)
        self._orders.command(ticket, ticket.name, values, left, token)

    def _free_to_return(self, due: Mapping[str, FloatArray]) -> tuple[str, ...]:
        """Return which moved beams may go back now."""
        names = tuple(due)
        while names:
            rows = np.array([self._field.place(n) for n in names], dtype=np.intp)
            try:
                self._permission.refuse_now("AIM", names)
                self._prove_points("AIM", names, rows, np.stack([due[n] for n in names]))
                break
            except BeamError as error:
                names = tuple(n for n in names if n not in error.refusals)
            except RefusedError:
                return ()
        return names

    def _aims(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        return np.asarray(self._ways.points.aims[rows])

    def _pointed(
        self, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> tuple[tuple[str, ...], npt.NDArray[np.intp], FloatArray, dict[str, str]]:
        """Return heliostats, rows (K,) and points (K, 3), and which are out of service, and why."""
        out = self._permission.locked_out(name, points)
        points = {n: point for n, point in points.items() if n not in out}
        rows = np.array([self._field.place(n) for n in points], dtype=np.intp)
        return tuple(points), rows, points_of(name, points), out

    def _when_recorded(
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
                rows = np.array([self._field.place(n) for n in names], dtype=np.intp)
                self._permission.refuse_now(ticket.name, names)
                self._prove_points(ticket.name, names, rows, wanted)
            stays = assign()
            self._given.sent(ticket, names)
            self._send_points(ticket, ticket.name, grouped(names, wanted), token, stays)

        self._orders.when_recorded(ticket, send)

    def _prove_points(
        self, name: str, names: tuple[str, ...], rows: npt.NDArray[np.intp], wanted: FloatArray
    ) -> None:
        """Prove that heliostats (K,) may be given points (K, 3) now.

        Raises
        ------
        BeamError
            If one of them may not.
        """
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
        rows = np.array([self._field.place(n) for n in names], dtype=np.intp)
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
