"""Beams stay out of keep-out volumes: commands are proven before they are sent, beams watched.

The watch over beams that light a receiver unsent is `unsent`.
"""

import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.lcu import messages, states
from heliotrope.lcu.diagnosis import NUDGE
from heliotrope.lcu.journal import CODES_OF
from heliotrope.mechanism.board_items import POSE_ITEMS, Tables, tables_with
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.machine import Machine
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.assigned import BEFORE, KINDS, Points
from heliotrope.plant.field.ordered import Ordered
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.defocusing import way_out
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.motion.stray_beams import TURNS, StrayBeams
from heliotrope.plant.refusals import BEAM_REFUSED, SOON, STILL_MOVING, NoFreePath, RefusedError
from heliotrope.safety import Act, Reading

Rows = npt.NDArray[np.intp]

#: Pause between two looks at the beams, s.
LOOK_PERIOD = 1.0
#: A heliostat moves if its counts and goals differ by more steps than this.
_MOVES = 200
#: Where stow is not known: an approach turns by more than this (rad) only when it leaves stow.
_FROM_STOW = 0.15
#: Commands whose whole motion is proven before they are sent.
_PROVEN = messages.TO_STANDBY | messages.BY_COUNTS
#: States from which IDLE moves a heliostat straight to its standby point; from the last two it
#: does so once the heliostat has been unlocked, or its fault cleared, which no report may show yet.
_TO_STANDBY = (
    states.TRACKING,
    states.SEARCHING,
    states.DEFOCUSED,
    states.IDLE,
    states.LOCKED,
    states.FAULT,
)


class BeamError(RefusedError):
    """The refusal of a command that would bring beams where none may be.

    Attributes
    ----------
    refusals
        Reasons, by name of the heliostat.
    """

    def __init__(self, command: str, refusals: dict[str, str]) -> None:
        self.refusals = refusals
        first, text = next(iter(refusals.items()))
        more = f" (and {len(refusals) - 1} more)" if len(refusals) > 1 else ""
        super().__init__(
            BEAM_REFUSED.text.format(what=command, heliostat=first, more=more, reason=text)
        )


class BeamWatch:
    """Proof that a command brings no beam into a keep-out volume, and watch over the beams.

    The watch sees errors that a proof cannot: false counts, changed parameters, a local controller
    that disobeys, the sun that carries the beam of a standing mirror on. Every heliostat is looked
    at, whatever its state, as long as its step counts have been known: where they are unknown or it
    is silent, it is taken to stand where it was last seen. Those that move are looked at each
    second, the others in turn.

    Parameters
    ----------
    check
        Mirrors and keep-out volumes.
    field
        State of the field, with the positions of the axes.
    points
        Assigned aims and standby points.
    sun
        Returns the unit vector to the sun, (3,), some seconds from now.
    machines
        Limits and resting places of heliostats, by name, as far as they are known.

    Attributes
    ----------
    check, field, points
        As given.
    unsent
        Watch over beams on a receiver that were not sent there.
    ordered
        The last orders that moved heliostats, to be noted by others.
    """

    def __init__(
        self,
        check: BeamCheck,
        field: FieldState,
        points: Points,
        sun: Callable[[float], FloatArray],
        machines: Mapping[str, Machine],
    ) -> None:
        self.check, self.field, self.points, self._sun = check, field, points, sun
        self.ordered = Ordered(field)
        self._machines = machines
        self._ways = Paths(check, machines)
        self.stray = StrayBeams(check, field, points, sun, machines)
        #: Tables that unverified ones have replaced, by row.
        self._earlier: dict[int, Tables] = {}
        self._seen: frozenset[str] = frozenset()
        self._turn = 0
        self._at = -np.inf

    # -- proofs ----------------------------------------------------------------------------

    def check_points(
        self, name: str, rows: Rows, wanted: FloatArray, tracking: npt.NDArray[np.bool_]
    ) -> None:
        """Prove that heliostats (K,) may be given points (K, 3) by AIM or STANDBY.

        Raises
        ------
        BeamError
            If one of the beams may not go there.
        """
        stopped, light = name == "AIM", self._sun(0.0)
        wrong = self._early(name, rows)
        for start, among in self._starts(rows, tracking):
            of = rows[among], wanted[among], light
            wrong |= self.check.problems(*of, start=start, stopped=stopped)
        if not stopped:
            every = self.points.possible("STANDBY", np.arange(len(self.field)))
            wrong |= self.check.glare(rows, wanted, every, light)
        if wrong:
            raise BeamError(name, _paths(wrong))

    def _early(self, name: str, rows: Rows) -> dict[str, str]:
        """Return which heliostats may not have a new point before they are heard again, and why.

        The way to it is proven from the point before. One that is on its way there, or may be by
        an order that no report shows yet, would go to the new point from elsewhere.
        """
        if not self.check.volumes:
            return {}
        if name == "AIM":  # those that track join it, and are examined then
            return self.ordered.unshown(rows, messages.JOINING)
        state = self.field.rows["state"][rows]
        found = self.ordered.unshown(rows[np.isin(state, _TO_STANDBY)])
        return found | self._unsettled(rows[state == states.IDLE])

    def _starts(
        self, rows: Rows, tracking: npt.NDArray[np.bool_]
    ) -> list[tuple[FloatArray, npt.NDArray[np.intp]]]:
        """Return points (M, 3) where the beams of some of K heliostats may be, and which, (M,).

        All are among the first, NaN where no point is known.
        """
        points = self.points
        start = np.where(tracking[:, None], points.aims[rows], points.standbys[rows])
        found = [(start, np.arange(len(rows)))]
        for k in range(BEFORE):
            aims, standbys = (points.earlier[kind][k, rows] for kind in KINDS)
            before = np.where(tracking[:, None], aims, standbys)
            among = np.flatnonzero(np.isfinite(before).all(axis=-1))
            if among.size:
                found.append((before[among], among))
        return found

    def clear(
        self, name: str, values: Sequence[float], heliostats: tuple[str, ...], now: float
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that may be sent a command, and why the others may not.

        Raises
        ------
        BeamError
            If none may.
        """
        solids = self.check.solids if name == "APPROACH" else ()
        if name not in _PROVEN or not (self.check.volumes or solids):
            return heliostats, {}
        rows = np.array([self.field.place(n) for n in heliostats], dtype=np.intp)
        # A heliostat without known counts is left to its local controller.
        rows = rows[np.isfinite(self.field.counted_at[rows])]
        if name == "APPROACH":
            wrong = self._from_stow(rows)
        elif name == "IDLE":
            mine = np.isin(self.field.rows["state"][rows], _TO_STANDBY)
            wrong = self._back_to_standby(rows[mine], now)
        else:
            path = self._by_counts(name, values, rows)
            wrong = self.check.moving(rows, path, self._sun(0.0)) | self.ordered.unshown(rows)
        wrong = _paths(wrong)
        if wrong and len(wrong) == len(heliostats):
            raise BeamError(name, wrong)
        return tuple(n for n in heliostats if n not in wrong), wrong

    def _from_stow(self, rows: Rows) -> dict[str, str]:
        """Return which heliostats have no free way from stow to standby, and why."""
        early = self.ordered.unshown(rows, messages.SAFE)
        rows, wrong = self._resting(rows)
        if not self.check.volumes:
            wrong = {}  # a way to a point that is not known here is not proven
        stow, counts = self._ways.stow[rows], self.field.counts(rows)
        begin = dict(zip(rows.tolist(), np.where(np.isfinite(stow), stow, counts), strict=True))
        for some, standbys in self.points.possible("STANDBY", rows):
            here = np.array([begin[row] for row in some.tolist()])
            wrong |= self._ways.approach(some, here, standbys, self._sun)
        return wrong | early

    def _back_to_standby(self, rows: Rows, now: float) -> dict[str, str]:
        """Return which heliostats may not go straight to their standby points, and why.

        A way is proven from where a heliostat stands. One that moves is no longer there, and does
        not turn at once.
        """
        early = self._unsettled(rows) | self.ordered.silent(rows, now)
        rows, wrong = self._resting(rows)
        light = self._sun(0.0)
        for some, standbys in self.points.possible("STANDBY", rows):
            wrong |= self._by_earlier(some, standbys)
            good, path = self._to_standby(some, standbys, light)
            wrong |= self.check.moving(good, path, light)
        return wrong | early

    def _unsettled(self, rows: Rows) -> dict[str, str]:
        """Return which heliostats move, or have told nothing since they were ordered to."""
        found = {self.field.names[row]: STILL_MOVING.text for row in rows[self._moving(rows)]}
        return found | self.ordered.unshown(rows)

    def _resting(self, rows: Rows) -> tuple[Rows, dict[str, str]]:
        """Return the heliostats whose standby points are known, and why the others do not go."""
        known = np.isfinite(self.points.standbys[rows]).all(axis=-1)
        return rows[known], {
            self.field.names[row]: "its standby point is not known here; give it one "
            "(STANDBY) first, or stow it"
            for row in rows[~known]
        }

    def tables(self, heliostat: str, items: Mapping[str, bytes]) -> tuple[Tables, Tables]:
        """Return the tables of a heliostat's mechanism now, and once items are stored."""
        row = self.field.place(heliostat)
        before = self.check.armature.table[row].copy(), self.check.drives.table[row].copy()
        return before, tables_with(items, *before) if POSE_ITEMS.intersection(items) else before

    def resting(self, heliostat: str, items: Mapping[str, bytes]) -> str:
        """Return why a heliostat may not rest at the stow position in items, "" if it may."""
        if "stow" not in items:
            return ""
        counts = np.array([struct.unpack(CODES_OF["stow"], items["stow"])], dtype=np.float64)
        armature, drives = self.tables(heliostat, items)[1]
        rows = np.array([self.field.place(heliostat)])
        found = self.check.standing(rows, counts, (armature[None], drives[None]))
        return found.get(heliostat, "")

    def rewriting(self, heliostat: str, armature: FloatArray, drives: FloatArray) -> str:
        """Return why new parameters may not be written where a heliostat stands, "" if they may.

        With the present parameters and with the new ones, its beam must be free where it stands
        and on the way from there to its standby point; and with the present ones on the way that
        the new ones will lead it, since the new ones may be the wrong ones.

        Parameters
        ----------
        heliostat
            Name of the heliostat, which is at rest.
        armature, drives
            The new tables, (18,) and (2, 19).
        """
        row = self.field.place(heliostat)
        if not self.check.volumes or not np.isfinite(self.field.posed_at[row]):
            return ""
        rows, new, present = np.array([row]), (armature, drives), self._tables(row)
        for tables in (present, new):
            with self._believing(row, tables):
                if wrong := self._from_here(rows):
                    return wrong[heliostat].partition(";")[0]
        standbys = self.points.standbys[rows]
        with self._believing(row, new):
            wrong = self._misled(rows, standbys, present)
        return wrong[heliostat].partition(";")[0] if wrong else ""

    @contextmanager
    def unverified(self, heliostat: str) -> Iterator[None]:
        """Prove ways with the present parameters too, while others that replace them are verified.

        By those, the heliostat goes to a target and comes back; if they are wrong, its beam is
        where the present ones say.
        """
        row = self.field.place(heliostat)
        self._earlier[row] = self._tables(row)
        try:
            yield
        finally:
            self._earlier.pop(row, None)

    def misled(self, heliostat: str, point: FloatArray) -> str:
        """Return why unverified parameters may not lead a beam to a point (3,), "" if they may."""
        rows = np.array([self.field.place(heliostat)])
        wrong = self._by_earlier(rows, point[None])
        return wrong[heliostat].partition(";")[0] if wrong else ""

    def _tables(self, row: int) -> Tables:
        return self.check.armature.table[row].copy(), self.check.drives.table[row].copy()

    @contextmanager
    def _believing(self, row: int, tables: Tables) -> Iterator[None]:
        """Prove with other tables of a heliostat."""
        present = self._tables(row)
        self.check.replace(row, *tables)
        try:
            yield
        finally:
            self.check.replace(row, *present)

    def _misled(self, rows: Rows, point: FloatArray, tables: Tables) -> dict[str, str]:
        """Return why the way on which one heliostat is led to a point (1, 3) is not free.

        The parameters of the check lead it, and the beam goes by ``tables``.
        """
        if not np.isfinite(point).all():
            return {}
        counts, light = self.field.counts(rows), self._sun(0.0)
        ends = self.check.poses(rows, point, light, counts).best_counts
        with self._believing(int(rows[0]), tables):
            return self.check.moving(rows, self._ways.motion(rows, counts, ends), light)

    def _by_earlier(self, rows: Rows, points: FloatArray) -> dict[str, str]:
        """Return which ways to points (K, 3) are not free by parameters that were replaced."""
        found: dict[str, str] = {}
        for i, row in enumerate(rows.tolist()):
            if row in self._earlier:
                found |= self._misled(rows[i : i + 1], points[i : i + 1], self._earlier[row])
        return found

    def _from_here(self, rows: Rows) -> dict[str, str]:
        """Return which heliostats may not go from where they stand to standby, and why."""
        light = self._sun(0.0)
        here = self._angles(rows, self.field.posed[rows])
        wrong = self.check.moving(rows, np.repeat(here[:, None], 2, axis=1), light)
        known = rows[np.isfinite(self.points.standbys[rows]).all(axis=-1)]
        good, path = self._to_standby(known, self.points.standbys[known], light)
        wrong |= {
            self.field.names[row]: "its standby point cannot be reached"
            for row in np.setdiff1d(known, good)
        }
        return wrong | self.check.moving(good, path, light)

    def joining(
        self, name: str, values: Sequence[float], heliostats: tuple[str, ...], now: float
    ) -> dict[str, str]:
        """Return which heliostats may not join their aims now, and why.

        AIM brings a new aim, its values; every other command leads to those that they may have.
        """
        if not self.check.volumes:
            return {}
        rows = np.array([self.field.index[n] for n in heliostats], dtype=np.intp)
        new = name == "AIM"
        aims = np.tile(values, (len(rows), 1)) if new else self.points.aims[rows]
        unknown = ~np.isfinite(aims).all(axis=-1)
        found = {
            heliostats[i]: f"{name}: its aim is not known here; give it one (AIM) first"
            for i in np.flatnonzero(unknown)
        }
        if not unknown.all():
            light = self._sun(0.0)
            found |= self.ordered.unshown(rows, messages.SAFE) | self.ordered.silent(rows, now)
            possible = self.points.possible("AIM", rows[~unknown])
            for known, places in [(rows, aims)] if new else possible:
                found |= self._by_earlier(known, places)
                for some, begin in self._begins(known):
                    to = known[some], begin, places[some], light, self._ways.motion
                    found |= self.check.on_the_way(*to)
                if name == "SEARCH":
                    found |= self.check.around(known, places, values[1], light)
        return _paths(found)

    def _begins(self, rows: Rows) -> list[tuple[npt.NDArray[np.bool_], FloatArray]]:
        """Return where motions of heliostats (K,) may begin: which, (K,), and their counts (M, 2).

        One that moves may be anywhere between its counts and its goals.
        """
        counts, goals = self.field.counts(rows), self.field.goals(rows)
        moving = self._moving(rows)
        found = [(np.ones(len(rows), dtype=np.bool_), counts)]
        if moving.any():
            found += [
                (moving, counts[moving] + share * (goals - counts)[moving]) for share in (0.5, 1.0)
            ]
        return found

    def _to_standby(
        self, rows: Rows, standbys: FloatArray, light: FloatArray
    ) -> tuple[Rows, FloatArray]:
        """Return the heliostats that reach their standby points (K, 3), and their ways there."""
        counts = self.field.counts(rows)
        found = self.check.poses(rows, standbys, light, counts)
        good = found.chosen(found.status) == TrackingStatus.OK
        rows, ends = rows[good], found.best_counts[good]
        return rows, self._ways.motion(rows, counts[good], ends)

    def _by_counts(self, name: str, values: Sequence[float], rows: Rows) -> FloatArray:
        """Return the angles that a command passes, from where the axes stand, (K, W, 2)."""
        counts = self.field.counts(rows)
        if name == "DIAGNOSE":
            begin = self._angles(rows, counts)
            nudges = NUDGE * np.array([(1, 0), (-1, 0), (0, 0), (0, 1), (0, -1)])
            return np.stack([begin, *(begin + nudge for nudge in nudges)], axis=-2)
        ends = np.broadcast_to(np.asarray(values, dtype=np.float64), (len(rows), 2))
        if name == "JOG":
            axis, steps = int(values[0]), values[1]
            ends = self.field.goals(rows)
            if axis < 2:  # the local controller refuses any other axis
                ends[:, axis] += steps
        return self._ways.motion(rows, counts, ends)

    def _angles(self, rows: Rows, counts: FloatArray) -> FloatArray:
        angles: FloatArray = Drive(self.check.drives.table[rows]).angles(counts)
        return angles

    # -- the watch -------------------------------------------------------------------------

    @property
    def watched(self) -> frozenset[str]:
        """Names of the readings: of keep-out volumes and of receivers, where there are any."""
        found = {"keep_out_predicted": self.check.volumes, "beam_unsent": self.check.solids}
        return frozenset(name for name, places in found.items() if places)

    def readings(self, now: float) -> dict[tuple[str, str], Reading]:
        """Return 1 for each heliostat whose beam is where it may not be, 0 for others.

        That is in a volume or heading for one, or on a receiver unsent. The beams are looked at
        once a second; between two looks the last one counts.
        """
        if now - self._at >= LOOK_PERIOD:
            self._at = now
            if self.check.volumes:
                self._look(now)
            if self.stray.watches:
                self.stray.look(now)
        seen = {"keep_out_predicted": self._seen, "beam_unsent": self.stray.seen}
        found = {(what, ""): Reading(0.0, now) for what in self.watched}
        return found | {
            (what, name): Reading(1.0, now) for what in self.watched for name in seen[what]
        }

    def way_out(self, name: str, *, again: bool) -> Act:
        """Return the order, DEFOCUS or STOW, that takes a beam out of a volume or off a receiver.

        Parameters
        ----------
        name
            Name of the heliostat.
        again
            Whether it has been ordered off already, and its beam is still there.
        """
        row = self.field.place(name)
        if name not in self._seen:
            lit = name in self.stray.seen
            return self.stray.way_out(name, again=again) if lit else Act.DEFOCUS
        state = int(self.field.rows["state"][row])
        if state == states.STOWING or (again and self._stands(row)) or self.turned(name):
            return Act.STOW
        machine = self._machines.get(name)
        points, counts, sun = self.points, self.field.posed[row], self._sun(0.0)
        aim, standby = points.aims[row], points.standbys[row]
        return way_out(self.check, machine, row, counts, sun, state, aim, standby)

    def turned(self, name: str) -> bool:
        """Return whether a beam stands where it may not be, and DEFOCUS turns it no further."""
        if name not in self._seen and name not in self.stray.seen:
            return False
        row = self.field.place(name)
        off = self.field.rows["state"][row] == states.DEFOCUSED or self.field.turned[row]
        return bool(off and self._stands(row))

    def _stands(self, row: int) -> bool:
        return not self._moving(np.array([row])).any()

    def _moving(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return which heliostats are on their way to their goals, (K,)."""
        left = np.abs(self.field.goals(rows) - self.field.posed[rows])
        return np.asarray((left > _MOVES).any(axis=-1))

    def _look(self, now: float) -> None:
        field = self.field
        self._turn = (self._turn + 1) % TURNS
        every = np.flatnonzero(np.isfinite(field.posed_at))
        state, begin = field.rows["state"][every], field.posed[every]
        goes = field.sure(now)[every] & np.not_equal(state, states.STOWING)
        end = np.where(goes[:, None], field.goals(every), begin)
        moves = np.asarray((np.abs(end - begin) > _MOVES).any(axis=-1))
        chosen = moves | (every % TURNS == self._turn)
        rows, moves, state = every[chosen], moves[chosen], state[chosen]
        begin, end = begin[chosen], end[chosen]
        light = self._sun(0.0)
        # A commanded motion is looked at on its whole way; of every other, the present pose and the
        # end are, as a way to safety is never held up.
        follows = moves & np.isin(state, states.BEAM_OUT)
        turns = follows & self._leaves_stow(rows, state, begin, end)
        both, ends = follows & ~turns, moves & ~follows
        stand = np.concatenate([rows[~follows], rows[ends]])
        at = self._angles(stand, np.concatenate([begin[~follows], end[ends]]))
        wrong = self.check.moving(stand, np.repeat(at[:, None], 2, axis=1), light)
        path = self._ways.turns(rows[turns], begin[turns], end[turns])
        wrong |= self.check.moving(rows[turns], path, light)
        path = self._ways.motion(rows[both], begin[both], end[both], ramps=False)
        wrong |= self.check.moving(rows[both], path, light)
        looked = {field.names[row] for row in rows}
        self._seen = frozenset(wrong) | (self._seen - looked)

    def _leaves_stow(
        self, rows: Rows, state: npt.NDArray[np.integer], begin: FloatArray, end: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """Return which approaches (K,) leave stow: the other axis has not moved yet."""
        each, other = np.arange(len(rows)), 1 - self._ways.azimuth[rows]
        stow = self._ways.stow[rows][each, other]
        turned = np.abs(self._angles(rows, end) - self._angles(rows, begin)).max(axis=-1)
        far = np.where(np.isfinite(stow), begin[each, other] == stow, turned > _FROM_STOW)
        return np.asarray(np.equal(state, states.APPROACHING) & far)


def _paths(reasons: Mapping[str, str]) -> dict[str, str]:
    """Mark the reasons of heliostats whose paths are not free; the others only wait for reports."""
    return {n: text if text in SOON else NoFreePath(text) for n, text in reasons.items()}
