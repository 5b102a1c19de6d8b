"""Proves, before a command is sent, that it brings no beam into a keep-out volume.

`BeamWatch` monitors afterwards where the beams are.
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
from heliotrope.mechanism.tracking import TrackingStatus
from heliotrope.plant.field.assigned import BEFORE, KINDS, Points
from heliotrope.plant.field.ledger import MOVING, Kind, Ledger
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.motion.paths import Paths
from heliotrope.plant.refusals import (
    BEAM_REFUSED,
    PLACE_UNKNOWN,
    SOON,
    STILL_MOVING,
    NoFreePath,
    RefusedError,
)

Rows = npt.NDArray[np.intp]

#: A heliostat moves if its counts and goals differ by more steps than this.
_MOVES = 200
#: Commands whose whole motion is proven clear before they are sent.
_PROVEN = messages.TO_STANDBY | messages.BY_COUNTS
#: States from which IDLE moves a heliostat straight to its standby point. From the last two it does
#: so once the heliostat has been unlocked, or its fault cleared, which a report may not show yet.
_TO_STANDBY = (
    states.TRACKING,
    states.SEARCHING,
    states.DEFOCUSED,
    states.IDLE,
    states.LOCKED,
    states.FAULT,
)


class BeamError(RefusedError):
    """A command is refused because it would send beams where they are not allowed.

    Attributes
    ----------
    refusals
        Reasons, by heliostat name.
    """

    def __init__(self, command: str, refusals: dict[str, str]) -> None:
        self.refusals = refusals
        first, text = next(iter(refusals.items()))
        more = f" (and {len(refusals) - 1} more)" if len(refusals) > 1 else ""
        super().__init__(
            BEAM_REFUSED.text.format(what=command, heliostat=first, more=more, reason=text)
        )


class PathProofs:
    """Proves that commands bring no beam into a keep-out volume.

    Parameters
    ----------
    paths
        Paths of the heliostats past the keep-out volumes.
    field, ledger
        State of the field, with the positions of the axes; the orders sent.
    points
        Assigned aims and standby points.
    sun
        Function that returns the unit vector to the sun, (3,), some seconds from now.

    Attributes
    ----------
    paths, field, ledger, points, sun
        As given.
    """

    def __init__(
        self,
        paths: Paths,
        field: FieldState,
        ledger: Ledger,
        points: Points,
        sun: Callable[[float], FloatArray],
    ) -> None:
        self.paths, self._check = paths, paths.check
        self.field, self.ledger, self.points, self.sun = field, ledger, points, sun
        #: Tables that have been replaced by unverified ones, by index of the heliostat.
        self._earlier: dict[int, Tables] = {}

    def check_points(
        self, name: str, rows: Rows, points: FloatArray, tracking: npt.NDArray[np.bool_]
    ) -> None:
        """Prove that heliostats (K,) may be sent to points (K, 3) by AIM or STANDBY.

        Raises
        ------
        BeamError
            If one of the beams may not go there.
        """
        stopped, light = name == "AIM", self.sun(0.0)
        blocked = self._early(name, rows)
        for start, among in self._starts(rows, tracking):
            of = rows[among], points[among], light
            blocked |= self._check.problems(*of, start=start, stopped=stopped)
        if not stopped:
            every = self.points.possible("STANDBY", np.arange(len(self.field)))
            blocked |= self._check.glare(rows, points, every, light)
        if blocked:
            raise BeamError(name, _refusals(blocked))

    def _early(self, name: str, rows: Rows) -> dict[str, str]:
        """Return the heliostats that may not get a new point before their next report, and why.

        The path to the new point was checked from the previous point. A heliostat must wait if it
        is still moving to the previous point, or may be moving because of an order that no report
        shows yet, because it would then start from elsewhere.
        """
        if not self._check.volumes:
            return {}
        if name == "AIM":  # tracking heliostats join the aim, and are checked then
            return self._unplaced(rows, messages.JOINING)
        state = self.field.rows["state"][rows]
        blocked = self._unplaced(rows[np.isin(state, _TO_STANDBY)])
        return blocked | self._unsettled(rows[state == states.IDLE])

    def _starts(
        self, rows: Rows, tracking: npt.NDArray[np.bool_]
    ) -> list[tuple[FloatArray, npt.NDArray[np.intp]]]:
        """Return points (M, 3) where beams may be, and the heliostat of each point, (M,).

        The first K points belong to all K heliostats, with NaN if no point is known.
        """
        points = self.points
        start = np.where(tracking[:, None], points.aims[rows], points.standbys[rows])
        starts = [(start, np.arange(len(rows)))]
        for k in range(BEFORE):
            aims, standbys = (points.earlier[kind][k, rows] for kind in KINDS)
            before = np.where(tracking[:, None], aims, standbys)
            among = np.flatnonzero(np.isfinite(before).all(axis=-1))
            if among.size:
                starts.append((before[among], among))
        return starts

    def clear(
        self, name: str, values: Sequence[float], heliostats: tuple[str, ...], now: float
    ) -> tuple[tuple[str, ...], dict[str, str]]:
        """Return the heliostats that may be sent a command, and why the rest may not.

        Raises
        ------
        BeamError
            If no heliostat may be sent the command.
        """
        solids = self._check.solids if name == "APPROACH" else ()
        if name not in _PROVEN or not (self._check.volumes or solids):
            return heliostats, {}
        rows = np.array([self.field.place(n) for n in heliostats], dtype=np.intp)
        # A heliostat with unknown counts is left to its local controller.
        rows = rows[np.isfinite(self.field.counted_at[rows])]
        if name == "APPROACH":
            blocked = self._from_stow(rows)
        elif name == "IDLE":
            mine = np.isin(self.field.rows["state"][rows], _TO_STANDBY)
            blocked = self._back_to_standby(rows[mine], now)
        else:
            path = self._by_counts(name, values, rows)
            blocked = self._check.moving(rows, path, self.sun(0.0)) | self._unplaced(rows)
        blocked = _refusals(blocked)
        if blocked and len(blocked) == len(heliostats):
            raise BeamError(name, blocked)
        return tuple(n for n in heliostats if n not in blocked), blocked

    def _from_stow(self, rows: Rows) -> dict[str, str]:
        """Return the heliostats whose path from stow to standby is blocked, and the reasons."""
        early = self._unplaced(rows, messages.SAFE)
        rows, blocked = self._resting(rows)
        if not self._check.volumes:
            blocked = {}  # a path to an unknown point cannot be proven clear
        stow, counts = self.paths.stow[rows], self.field.counts(rows)
        begin = dict(zip(rows.tolist(), np.where(np.isfinite(stow), stow, counts), strict=True))
        for some, standbys in self.points.possible("STANDBY", rows):
            starts = np.array([begin[row] for row in some.tolist()])
            blocked |= self.paths.approach(some, starts, standbys, self.sun)
        return blocked | early

    def _back_to_standby(self, rows: Rows, now: float) -> dict[str, str]:
        """Return the heliostats whose straight path to standby is blocked, and the reasons.

        A path is checked only from the pose of a heliostat at rest. A moving heliostat is refused,
        because it leaves that pose and does not turn back at once.
        """
        early = self._unsettled(rows) | self._unplaced(rows, now=now)
        rows, blocked = self._resting(rows)
        light = self.sun(0.0)
        for some, standbys in self.points.possible("STANDBY", rows):
            blocked |= self._by_earlier(some, standbys)
            good, path = self._to_standby(some, standbys, light)
            blocked |= self._check.moving(good, path, light)
        return blocked | early

    def _unsettled(self, rows: Rows) -> dict[str, str]:
        """Return the heliostats that move, or were ordered to move since their last report."""
        blocked = {self.field.names[row]: STILL_MOVING.text for row in rows[self.moving(rows)]}
        return blocked | self._unplaced(rows)

    def _unplaced(
        self, rows: Rows, kind: Kind = MOVING, now: float | None = None
    ) -> dict[str, str]:
        """Return the heliostats (K,) without a report since an order of a kind.

        With ``now`` (monotonic s), heliostats that are not live are included.
        """
        placed = self.ledger.reported(kind)
        if now is not None:
            placed &= self.field.live(now)
        late = rows[~placed[rows]]
        return {self.field.names[row]: PLACE_UNKNOWN.text for row in late}

    def _resting(self, rows: Rows) -> tuple[Rows, dict[str, str]]:
        """Return the heliostats with known standby points, and why the rest may not go."""
        known = np.isfinite(self.points.standbys[rows]).all(axis=-1)
        return rows[known], {
            self.field.names[row]: "the plant does not know its standby point; set one (STANDBY) "
            "first, or stow the heliostat"
            for row in rows[~known]
        }

    def tables(self, heliostat: str, items: Mapping[str, bytes]) -> tuple[Tables, Tables]:
        """Return the tables of a heliostat's mechanism before and after items are stored."""
        before = self._tables(self.field.place(heliostat))
        return before, tables_with(items, *before) if POSE_ITEMS.intersection(items) else before

    def resting(self, heliostat: str, items: Mapping[str, bytes]) -> str | None:
        """Return the reason why a heliostat may not rest at the stow position in ``items``."""
        if "stow" not in items:
            return None
        counts = np.array([struct.unpack(CODES_OF["stow"], items["stow"])], dtype=np.float64)
        armature, drives = self.tables(heliostat, items)[1]
        rows = np.array([self.field.place(heliostat)])
        blocked = self._check.standing(rows, counts, (armature[None], drives[None]))
        return blocked.get(heliostat)

    def rewriting(self, heliostat: str, armature: FloatArray, drives: FloatArray) -> str | None:
        """Return the reason why new parameters may not be written in this pose; None if they may.

        Under both the present and the new parameters, the beam must be clear in the present pose
        and on the path from there to the standby point. Under the present parameters it must also
        be clear on the path that the new parameters produce, because the new parameters may be
        wrong.

        Parameters
        ----------
        heliostat
            Name of the heliostat, which is at rest.
        armature, drives
            The new tables, (18,) and (2, 19).
        """
        row = self.field.place(heliostat)
        if not self._check.volumes or not np.isfinite(self.field.posed_at[row]):
            return None
        rows, new, present = np.array([row]), (armature, drives), self._tables(row)
        for tables in (present, new):
            with self._believing(row, tables):
                if blocked := self._from_here(rows):
                    return blocked[heliostat].partition(";")[0]
        standbys = self.points.standbys[rows]
        with self._believing(row, new):
            blocked = self._misled(rows, standbys, present)
        return blocked[heliostat].partition(";")[0] if blocked else None

    @contextmanager
    def unverified(self, heliostat: str) -> Iterator[None]:
        """Check paths with the present parameters too, while new parameters are being verified.

        The heliostat goes to a target and returns under the new parameters. If these are wrong, its
        beam is where the present parameters predict.
        """
        row = self.field.place(heliostat)
        self._earlier[row] = self._tables(row)
        try:
            yield
        finally:
            self._earlier.pop(row, None)

    def misled(self, heliostat: str, point: FloatArray) -> str | None:
        """Return why unverified parameters block a path to a point (3,); None if they do not."""
        rows = np.array([self.field.place(heliostat)])
        blocked = self._by_earlier(rows, point[None])
        return blocked[heliostat].partition(";")[0] if blocked else None

    def _tables(self, row: int) -> Tables:
        return self._check.armature.table[row].copy(), self._check.drives.table[row].copy()

    @contextmanager
    def _believing(self, row: int, tables: Tables) -> Iterator[None]:
        """Use different mechanism tables for a heliostat within the block."""
        present = self._tables(row)
        self._check.replace(row, *tables)
        try:
            yield
        finally:
            self._check.replace(row, *present)

    def _misled(self, rows: Rows, point: FloatArray, tables: Tables) -> dict[str, str]:
        """Return why the path of one heliostat to a point (1, 3) is blocked; None if it is clear.

        The heliostat is moved by the parameters of the check, and its beam is computed from
        ``tables``.
        """
        if not np.isfinite(point).all():
            return {}
        counts, light = self.field.counts(rows), self.sun(0.0)
        ends = self._check.poses(rows, point, light, counts).best_counts
        with self._believing(int(rows[0]), tables):
            return self._check.moving(rows, self.paths.motion(rows, counts, ends), light)

    def _by_earlier(self, rows: Rows, points: FloatArray) -> dict[str, str]:
        """Return the paths to points (K, 3) that are blocked according to replaced parameters."""
        reasons: dict[str, str] = {}
        for i, row in enumerate(rows.tolist()):
            if row in self._earlier:
                reasons |= self._misled(rows[i : i + 1], points[i : i + 1], self._earlier[row])
        return reasons

    def _from_here(self, rows: Rows) -> dict[str, str]:
        """Return the heliostats that may not go from their present pose to standby, and why."""
        light = self.sun(0.0)
        present = self.paths.angles(rows, self.field.posed[rows])
        blocked = self._check.moving(rows, np.repeat(present[:, None], 2, axis=1), light)
        known = rows[np.isfinite(self.points.standbys[rows]).all(axis=-1)]
        good, path = self._to_standby(known, self.points.standbys[known], light)
        blocked |= {
            self.field.names[row]: "its standby point cannot be reached"
            for row in np.setdiff1d(known, good)
        }
        return blocked | self._check.moving(good, path, light)

    def joining(
        self, name: str, values: Sequence[float], heliostats: tuple[str, ...], now: float
    ) -> dict[str, str]:
        """Return the heliostats that may not join their aims now, and the reasons.

        AIM contains a new aim in its values; every other command uses the aim that the heliostats
        may already have.
        """
        if not self._check.volumes:
            return {}
        rows = np.array([self.field.index[n] for n in heliostats], dtype=np.intp)
        new = name == "AIM"
        aims = np.tile(values, (len(rows), 1)) if new else self.points.aims[rows]
        unknown = ~np.isfinite(aims).all(axis=-1)
        reasons = {
            heliostats[i]: f"{name}: the plant does not know its aim; set one (AIM) first"
            for i in np.flatnonzero(unknown)
        }
        if not unknown.all():
            light = self.sun(0.0)
            reasons |= self._unplaced(rows, messages.SAFE, now)
            possible = self.points.possible("AIM", rows[~unknown])
            for known, places in [(rows, aims)] if new else possible:
                reasons |= self._by_earlier(known, places)
                for some, begin in self._begins(known):
                    to = known[some], begin, places[some], light, self.paths.motion
                    reasons |= self._check.on_the_way(*to)
                if name == "SEARCH":
                    reasons |= self._check.around(known, places, values[1], light)
        return _refusals(reasons)

    def _begins(self, rows: Rows) -> list[tuple[npt.NDArray[np.bool_], FloatArray]]:
        """Return where motions may begin: pairs of a heliostat mask, (K,), and step counts, (M, 2).

        A moving heliostat may be anywhere between its counts and its goals.
        """
        counts, goals = self.field.counts(rows), self.field.goals(rows)
        moving = self.moving(rows)
        starts = [(np.ones(len(rows), dtype=np.bool_), counts)]
        if moving.any():
            starts += [
                (moving, counts[moving] + share * (goals - counts)[moving]) for share in (0.5, 1.0)
            ]
        return starts

    def _to_standby(
        self, rows: Rows, standbys: FloatArray, light: FloatArray
    ) -> tuple[Rows, FloatArray]:
        """Return the heliostats that can reach their standby points (K, 3), and the paths there."""
        counts = self.field.counts(rows)
        solved = self._check.poses(rows, standbys, light, counts)
        good = solved.chosen(solved.status) == TrackingStatus.OK
        rows, ends = rows[good], solved.best_counts[good]
        return rows, self.paths.motion(rows, counts[good], ends)

    def _by_counts(self, name: str, values: Sequence[float], rows: Rows) -> FloatArray:
        """Return the angles through which a command moves the axes from here, (K, W, 2)."""
        counts = self.field.counts(rows)
        if name == "DIAGNOSE":
            begin = self.paths.angles(rows, counts)
            nudges = NUDGE * np.array([(1, 0), (-1, 0), (0, 0), (0, 1), (0, -1)])
            return np.stack([begin, *(begin + nudge for nudge in nudges)], axis=-2)
        ends = np.broadcast_to(np.asarray(values, dtype=np.float64), (len(rows), 2))
        if name == "JOG":
            axis, steps = int(values[0]), values[1]
            ends = self.field.goals(rows)
            if axis < 2:  # the local controller refuses any other axis
                ends[:, axis] += steps
        return self.paths.motion(rows, counts, ends)

    def moving(self, rows: Rows) -> npt.NDArray[np.bool_]:
        """Return a mask of the heliostats that move to their goals, (K,)."""
        remaining = np.abs(self.field.goals(rows) - self.field.posed[rows])
        return np.asarray((remaining > _MOVES).any(axis=-1))


def _refusals(reasons: Mapping[str, str]) -> dict[str, str]:
    """Mark the reasons of heliostats whose paths are blocked, as opposed to awaiting a report."""
    return {n: text if text in SOON else NoFreePath(text) for n, text in reasons.items()}
