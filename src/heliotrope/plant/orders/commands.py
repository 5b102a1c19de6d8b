"""Operator commands: authorised, checked, recorded, and sent, at once or in turn."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from heliotrope.errors import UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.files.disk import Work
from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages as wire
from heliotrope.lcu import states
from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant import refusals
from heliotrope.plant.field.assigned import NOTHING, Held, grouped, points_of
from heliotrope.plant.motion.proofs import BeamError, PathProofs
from heliotrope.plant.orders.audit import AuditError
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.guards import TO_AIMS, Asked, Guards
from heliotrope.plant.orders.joining import Assign, Clear, JoiningJob, JoinQueue, in_slices
from heliotrope.plant.orders.queue import PlantOrders, whole
from heliotrope.plant.orders.taken import Taken
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.orders.unacknowledged import Unacknowledged
from heliotrope.plant.refusals import BEAM_REFUSED, NOT_NOW, OUT_OF_SERVICE
from heliotrope.values import amount

#: Disk work, and the disk work that reverts it.
Storing = tuple[Work, Callable[..., object]]
#: If two points are at least this far from all receivers, m, and at most this far from each other,
#: a beam that moves between them brings no light to a receiver.
_BESIDE = 3.0


@dataclass(frozen=True)
class NewPoints:
    """New points for heliostats; each point is assigned when it is sent.

    Attributes
    ----------
    name
        AIM or STANDBY.
    names, wanted
        Heliostats (K,), and their points, ENU, m, (K, 3).
    token
        Token of the authority holder or of a mandate.
    store
        Called with some heliostats and their points. It returns disk work that must be done before
        the points are sent, and disk work that reverts it.
    note
        Called with the heliostats whose points are being assigned, and the points.
    check
        Called with the heliostats whose turn has come; raises `RefusedError` if their points may no
        longer be assigned.
    free
        Returns the heliostats that need not wait for a turn; None: heliostats that bring no light
        to a receiver need not wait.
    """

    name: str
    names: tuple[str, ...]
    points: FloatArray
    token: int
    store: Callable[[tuple[str, ...], FloatArray], Storing]
    note: Callable[[tuple[str, ...], FloatArray], None] = lambda *_: None
    check: Callable[[tuple[str, ...]], None] = lambda _: None
    free: Callable[[], frozenset[str]] | None = None

    def of(self, names: Sequence[str]) -> FloatArray:
        """Return the points of some heliostats, (M, 3)."""
        row = {name: i for i, name in enumerate(self.names)}
        return self.points[np.array([row[name] for name in names], dtype=np.intp)]

    def grouped(self, names: Iterable[str]) -> dict[tuple[float, ...], list[str]]:
        """Group the heliostats by point; heliostats with the same point share one command."""
        some = tuple(names)
        return grouped(some, self.of(some))


class Commands:
    """Issues the wire commands that need the command authority.

    Parameters
    ----------
    orders, joining
        Parts of the plant.
    guards
        What blocks heliostats; see `GUARDS`.
    unacknowledged
        Assigned points, and whether they were acknowledged.
    proofs
        Checks where beams may go.
    design
        The plant, with its targets and receivers.
    required
        Parameters that local controllers should store, including their standby points.
    taken
        What visits have taken.
    """

    def __init__(
        self,
        orders: PlantOrders,
        joining: JoinQueue,
        guards: Guards,
        unacknowledged: Unacknowledged,
        proofs: PathProofs,
        design: Plant,
        required: Wanted,
        taken: Taken,
    ) -> None:
        self._orders, self._joining, self._guards = orders, joining, guards
        self._now, self._authority = orders.clock.monotonic, orders.authority
        self._unacknowledged, self._proofs, self._field = unacknowledged, proofs, proofs.field
        self._design, self._required = design, required
        self._movements, self._locks, self._stepping = taken.movements, taken.locks, taken.stepping

    def give(
        self,
        person: Person,
        token: int,
        name: str,
        heliostats: Sequence[str],
        values: Sequence[float],
    ) -> Ticket:
        """Issue a command without points; see `PlantController.command`."""
        row = wire.ROW_OF.get(wire.NUMBER_OF.get(name, -1))
        if row is None or row[2] != wire.AUTHORITY or name in wire.POINTS:
            known = [r[1] for r in wire.MESSAGES if r[2] == wire.AUTHORITY]
            known = [row_name for row_name in known if row_name not in wire.POINTS]
            raise UnknownNameError("command (points are given by aim and standby)", name, known)
        numbers = whole(values, row[3], name)
        self._authority.check(person, token, name)
        names = tuple(dict.fromkeys(heliostats)) or self._field.names
        others, out = self._guards.passed(Asked(name, names, token=token), OUT_OF_SERVICE)
        clear, refused = self.examine(name, numbers, others, token)
        blocked = {**refused, **out}
        store = self._lock_record(clear, token) if name == "LOCK" else None
        ticket = self.accept(person, token, name, numbers, names, store=store, blocked=blocked)
        if name not in wire.SETTINGS:
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
        """Send a recorded command.

        A command that waited for its record (``again``) is examined again.

        Raises
        ------
        RefusedError
            If the command may no longer be sent.
        """
        name, waiting = ticket.name, ticket.waiting(heliostats)
        if again and waiting:
            out = self._guards.reasons(Asked(name, waiting), OUT_OF_SERVICE)
            others = tuple(n for n in waiting if n not in out)
            waiting, refused = self.examine(name, numbers, others, token)
            ticket.block({**refused, **out})
            if name not in wire.SETTINGS:
                # A heliostat commanded earlier may have joined the queue after this command was
                # accepted.
                self._joining.drop(f"superseded by {name}", frozenset(waiting))
        if waiting and name == "LOCK":
            self._note_lock(waiting, token)
        if name == "ROUGH":
            self._stepping.ordered(waiting, bool(numbers[0]))
        if waiting:
            waits = name in wire.JOINING or in_slices(name, waiting)
            send = self._join if waits else self._orders.command
            send(ticket, name, numbers, waiting, token)

    def accept(
        self,
        person: Person,
        token: int,
        name: str,
        values: tuple[float, ...],
        heliostats: Sequence[str],
        note: str = "",
        store: tuple[Work, Work] | None = None,
        blocked: Mapping[str, str] = MappingProxyType({}),
    ) -> Ticket:
        """Return the ticket of a command that may be issued; its record goes to the disk.

        The ticket ends at once for ``blocked`` heliostats. An operator's command removes all other
        heliostats of the ticket from their visits. While a visit verifies new parameters, no
        operator may send the beam to an aim, because only the visit can tell whether the beam
        arrives there.

        Raises
        ------
        RefusedError
            If the command may not be issued.
        """
        for heliostat in heliostats:
            self._field.place(heliostat)
        self._authority.check(person, token, name)
        self._guards.refuse_now(
            name, [heliostat for heliostat in heliostats if heliostat not in blocked]
        )
        mandate = self._authority.mandate_of(token)
        if mandate is not None:
            reasons = mandate.refused(heliostats)
        else:
            verifying = self._guards.doubtful.verifying(heliostats) if name in TO_AIMS else ()
            reasons = dict.fromkeys(verifying, refusals.NOT_VERIFIED.text)
            if name in wire.JOINING and len(reasons) < len(heliostats):
                blocked, reasons = {**blocked, **reasons}, {}
        if reasons:
            raise BeamError(name, reasons)
        try:
            ticket = self._orders.accept(
                (person.name, person.role.title, name), values, heliostats, note, store=store
            )
        except AuditError as error:
            raise refusals.NOT_RECORDED.error(what=name, problem=error) from None
        ticket.block(blocked)
        if mandate is None and name not in wire.SETTINGS:
            self._authority.prevail(ticket.waiting(heliostats), f"{person.name} ordered {name}")
        return ticket

    def _lock_record(self, heliostats: tuple[str, ...], token: int) -> tuple[Work, Work]:
        """Return disk work that records who owns a lock before locking, and its reversal."""
        visit = self._authority.mandate_of(token) is not None
        return self._proofs.points.holding(self._locks.record(heliostats, visit=visit))

    def _note_lock(self, heliostats: tuple[str, ...], token: int) -> None:
        """Record who owns a lock: an operator or a visit; the plant removes a visit's lock."""
        if self._authority.mandate_of(token) is None:
            self._locks.forget(heliostats)
        else:
            self._locks.take(heliostats, token, self._now())

    def examine(
        self, name: str, numbers: tuple[float, ...], names: tuple[str, ...], token: int = 0
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that may be sent a command now, and why the rest may not.

        Raises
        ------
        BeamError
            If no heliostat may be sent the command.
        """
        asked = Asked(name, names, token=token)
        able, refused = self._guards.passed(asked, NOT_NOW, BEAM_REFUSED)
        if in_slices(name, able):
            return able, refused  # each slice is examined when its turn comes
        clear, blocked = self._proofs.clear(name, numbers, able, self._now())
        return clear, refused | blocked

    def zero(self, person: Person, token: int, heliostat: str, counts: Sequence[float]) -> Ticket:
        """Declare the step counts of the axes of one heliostat that is locked or has a fault.

        Nothing moves; its local controller stores the counts. This requires an engineer, and the
        heliostat's key stored in its cluster.

        Parameters
        ----------
        person, token
            The person commanding, and the token of the command authority.
        heliostat
            Name.
        counts
            Step counts of the primary and the secondary axis.

        Raises
        ------
        RefusedError
            If the command is not accepted; in that case nothing is sent.
        InputError
            If counts are invalid.
        UnknownNameError
            If there is no such heliostat.
        """
        numbers = whole(counts, wire.ROW_OF[wire.NUMBER_OF["ZERO"]][3], "ZERO")
        asked = Asked("ZERO", (heliostat,), token=token)
        self._guards.passed(asked, BEAM_REFUSED)
        self._guards.passed(asked, OUT_OF_SERVICE)
        ticket = self.accept(person, token, "ZERO", numbers, (heliostat,))

        def send(again: bool) -> None:
            if again:
                self._guards.passed(asked, OUT_OF_SERVICE)
            waiting = ticket.waiting((heliostat,))
            self._orders.command(ticket, "ZERO", numbers, waiting, token)

        self._orders.when_recorded(ticket, send)
        return ticket

    def point(
        self, person: Person, token: int, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> Ticket:
        """Send AIM or STANDBY with a point (3,) for each heliostat; see `PlantController.aim`."""
        names, _, targets, out = self._pointed(name, points)
        self.prove_points(name, names, targets)
        visit = self._authority.mandate_of(token) is not None

        def store(some: tuple[str, ...], places: FloatArray) -> Storing:
            held: Held = NOTHING
            if name == "AIM":
                held = self._lent(some, places) if visit else {"LENT": dict.fromkeys(some)}
            return self.storing(name, some, places, held)

        def note(some: tuple[str, ...], places: FloatArray) -> None:
            if name == "AIM" and visit:
                self._movements.lend(some, self._aims(self._places(some)), places, token)
            elif name == "AIM":
                self._movements.forget(some)
            else:
                for each, place in zip(some, places, strict=True):
                    self._required.rest(each, tuple(place))

        groups = grouped(names, targets)
        values = next(iter(groups)) if len(groups) == 1 else ()
        all_names, text = (*names, *out), amount(len(groups), "point")

        def accept(store: tuple[Work, Work] | None) -> Ticket:
            order = person, token, name, values, all_names, text, store, out
            return self.accept(*order)

        return self.give_points(NewPoints(name, names, targets, token, store, note), accept)

    def move(self, person: Person, token: int, points: Mapping[str, npt.ArrayLike]) -> Ticket:
        """Move beams slightly on their receiver for a measurement; their aims stay assigned.

        The plant returns the beams to their aims by itself; see `movements`. The heliostats need
        not wait for a turn, because they bring no additional light to the receiver.

        Parameters
        ----------
        person, token
            The person commanding, and the token of the command authority.
        points
            ENU, m, (3,), by name.

        Raises
        ------
        RefusedError
            If the command is not accepted, or one of the beams may not go there.
        """
        names, rows, targets, out = self._pointed("AIM", points)
        tracking, aims = self._field.among((states.TRACKING,), self._now())[rows], self._aims(rows)
        self._movements.check(names, rows, aims, targets, tracking)
        self.prove_points("AIM", names, targets)

        def store(some: tuple[str, ...], places: FloatArray) -> Storing:
            return self.holding(self._lent(some, places))

        def check(some: tuple[str, ...]) -> None:
            rows, on = self._places(some), np.ones(len(some), dtype=np.bool_)
            # A heliostat may have been aimed elsewhere while the record was written.
            self._movements.check(some, rows, self._aims(rows), new.of(some), on)

        def note(some: tuple[str, ...], places: FloatArray) -> None:
            del places
            self._movements.take(some, self._aims(self._places(some)), token, self._now())

        def accept(store: tuple[Work, Work] | None) -> Ticket:
            order = person, token, "AIM", (), (*names, *out), f"{len(names)} coded movements"
            return self.accept(*order, store, out)

        every = frozenset(names)
        new = NewPoints("AIM", names, targets, token, store, note, check, lambda: every)
        return self.give_points(new, accept)

    @property
    def aimed(self) -> frozenset[str]:
        """The heliostats whose new aim is waiting for the disk or for its turn."""
        return self._joining.waiting("AIM") | self._orders.unstored("AIM")

    def holding(self, held: Held) -> tuple[Work, Work]:
        """Return disk work that stores what a visit takes, and the reversal: `Points.holding`."""
        return self._proofs.points.holding(held)

    def _places(self, names: Sequence[str]) -> npt.NDArray[np.intp]:
        return np.array([self._field.place(name) for name in names], dtype=np.intp)

    def _aims(self, rows: npt.NDArray[np.intp]) -> FloatArray:
        return np.asarray(self._proofs.points.aims[rows])

    def _pointed(
        self, name: str, points: Mapping[str, npt.ArrayLike]
    ) -> tuple[tuple[str, ...], npt.NDArray[np.intp], FloatArray, dict[str, str]]:
        """Return the heliostats that may get points, their indices (K,), and their points (K, 3).

        Also return why the remaining heliostats are out of service.
        """
        goals = points_of(name, points) if name == "AIM" else None
        able, out = self._guards.passed(Asked(name, tuple(points), goals), OUT_OF_SERVICE)
        points = {n: points[n] for n in able}
        rows = self._places(able)
        return tuple(points), rows, points_of(name, points), out

    def storing(
        self, name: str, names: tuple[str, ...], places: FloatArray, held: Held = NOTHING
    ) -> Storing:
        """Return disk work that stores points (K, 3) and what visits hold, and its reversal."""
        return self._proofs.points.storing(name, self._places(names), places, held)

    def _lent(self, names: tuple[str, ...], places: FloatArray) -> Held:
        """Return the record to store before a visit sends beams to points (K, 3)."""
        return self._movements.record(names, self._aims(self._places(names)), places)

    def give_points(
        self, new: NewPoints, accept: Callable[[tuple[Work, Work] | None], Ticket]
    ) -> Ticket:
        """Issue points that have been checked; each is stored, then assigned when it is sent.

        Parameters
        ----------
        new
            The points.
        accept
            Returns the ticket of the points. Its argument is the disk work that stores, together
            with the ticket's record, the points that need not wait for a turn.
        """
        waiting = self._joins(new)
        early = tuple(n for n in new.names if n not in waiting)
        store = new.store(early, new.of(early)) if early else None
        ticket = accept(store)

        def send(again: bool) -> None:
            if again:
                self._guards.refuse_now(new.name, new.names)
                self.prove_points(new.name, new.names, new.points)
            new.check(new.names)
            self._joining.drop(f"superseded by another {new.name}", frozenset(new.names), new.name)
            joins = waiting | self._joins(new)
            if store is not None and (late := joins - waiting):
                self._orders.owe(partial(store[1], late))
            still = tuple(n for n in new.names if n not in joins)
            self._assign(new, ticket, still)
            for point, members in new.grouped(still).items():
                self._orders.command(ticket, new.name, point, members, new.token)
            for point, members in new.grouped(n for n in new.names if n in joins).items():
                part = replace(new, names=tuple(members), points=new.of(members))
                assign = partial(self._assign_in_turn, part, ticket)
                self._join(ticket, new.name, point, members, new.token, assign)

        self._orders.when_recorded(ticket, send)
        return ticket

    def _assign_in_turn(
        self,
        new: NewPoints,
        ticket: Ticket,
        names: tuple[str, ...],
        clear: Clear,
        send: Callable[[tuple[str, ...]], None],
    ) -> None:
        """Store and assign the points of heliostats whose turn has come, then send them."""
        store = new.store(names, new.of(names))

        def stored(again: bool) -> None:
            new.check(names)
            cleared = names
            if again:
                self._guards.refuse_now(new.name, names)
                cleared = clear(names)
            if dropped := set(names).difference(cleared):
                self._orders.owe(partial(store[1], dropped))
            self._assign(new, ticket, cleared)
            send(cleared)

        self._orders.when_stored(ticket, names, store, stored)

    def _assign(self, new: NewPoints, ticket: Ticket, names: tuple[str, ...]) -> None:
        """Assign the points of some heliostats, which are being sent now."""
        places = new.of(names)
        new.note(names, places)
        self._proofs.points.assign(new.name, self._places(names), places)
        self._unacknowledged.sent(ticket, names)

    def _joins(self, new: NewPoints) -> frozenset[str]:
        """Return the tracking heliostats that must wait for a turn to join their new aims.

        Heliostats that bring no light to a receiver need not wait: see `_stays`.
        """
        if new.name != "AIM":
            return frozenset()
        rows = self._places(new.names)
        moves = self._field.among(states.ON_AIM, self._now())[rows]
        if new.free is not None:
            return frozenset(new.names[i] for i in np.flatnonzero(moves)) - new.free()
        return frozenset(
            new.names[i] for i in np.flatnonzero(moves & ~self._stays(rows, new.points))
        )

    def prove_points(self, name: str, names: tuple[str, ...], places: FloatArray) -> None:
        """Check that heliostats (K,) may be assigned points (K, 3) now.

        Raises
        ------
        BeamError
            If a heliostat may not be assigned its point.
        """
        rows = self._places(names)
        tracking = self._field.among(states.ON_AIM, self._now())[rows]
        moves = tracking if name == "AIM" else self._field.among((states.IDLE,), self._now())[rows]
        moved = tuple(names[i] for i in np.flatnonzero(moves))
        if reasons := self._guards.reasons(Asked(name, moved, places[moves]), BEAM_REFUSED):
            raise BeamError(name, reasons)
        self._proofs.check_points(name, rows, places, tracking)

    def _stays(self, rows: npt.NDArray[np.intp], places: FloatArray) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that new points (K, 3) keep off receivers, (K,).

        Light stays off the receivers if the present aim and the new point lie on the same target,
        or near each other and off every receiver. The second case occurs if a beam misses its
        target and is therefore sent to a point beside the target.
        """
        aims = self._proofs.points.aims[rows]
        stays = np.linalg.norm(places - aims, axis=-1) <= _BESIDE
        for receiver in self._design.receivers:
            clear = 0.5 * float(np.hypot(receiver.width, receiver.height)) + _BESIDE
            for points in (aims, places):
                stays &= np.linalg.norm(points - receiver.center, axis=-1) > clear
        for target in self._design.targets:
            stays |= target.holds(aims) & target.holds(places)
        return np.asarray(stays)

    def _join(
        self,
        ticket: Ticket,
        name: str,
        values: tuple[float, ...],
        heliostats: Sequence[str],
        token: int,
        assign: Assign | None = None,
    ) -> None:
        until, waiting = self._now() + self._joining.patience, deque(heliostats)
        self._joining.put(JoiningJob(ticket, name, values, token, waiting, until, assign))
