"""A whole field of local controllers as arrays: the states and steps of `lcu`, without frames.

All heliostats of a field do simultaneously what a board does from stow to standby, tracking,
defocused and back, in the same integer arithmetic: poses come from the vectorised tracking in
`mechanism`, steps from the kernels in this package. Step counts equal those of a board with the
real firmware wherever both exist.

The field models STOWED, APPROACHING, IDLE at standby, TRACKING, DEFOCUSED, STOWING, LOCKED and
FAULT, the lease, and the autonomous path to defocus and stow. Power may fail and return; gears have
backlash, motors lose steps, and the wind deflects mirrors. Settings, searching and jogging need a
board (`twin.boards.board`).
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, bisector, normalize
from heliotrope.lcu import states
from heliotrope.lcu.controller import LATCHED, NO_FAULT, SUPPLY
from heliotrope.lcu.lease import RATE_FACTOR, RECENT_MS, UNIT
from heliotrope.lcu.motion import (
    APPROACH,
    DEFOCUS,
    FAR,
    HOLD,
    KNOT_LIMIT,
    KNOT_MS,
    RENEW_MS,
    RETURN,
    STANDBY,
    STOW,
    TRACK,
)
from heliotrope.mechanism.board_motion import (
    end_down_the_path,
    offsets,
    pieces,
    safe_paths,
    turned,
)
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.twin.field import _kernels as kernels
from heliotrope.twin.field._among import among
from heliotrope.twin.field._drives import Drives
from heliotrope.twin.field.journals import Journals
from heliotrope.twin.sensors import light_share
from heliotrope.twin.wind import Wind

Rows = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

AXIS = np.dtype(
    [
        (name, "<i8")
        for name in (
            "count",
            "goal",
            "leg",
            "speed",
            "phase",
            "direction",
            "led",
            "braking",
            "low",
            "high",
            "top",
            "change",
            "backlash",
        )
    ]
)
#: As `lcu.config.Config`.
LEASE_MS, STOW_WAIT_MS, SLOT_MS, AHEAD_MS = 6000, 30_000, 50, 100
#: Stages of a defocus: none since another motion; moving to its goals; ended
#: (`lcu.motion.Motion.aside`).
NO_TURN, TURNING, TURNED = range(3)
#: Time step of a field, ms: no longer than a pass of a board's main loop.
TICK_MS = 50


class Field:
    """Heliostats with their local controllers.

    Parameters
    ----------
    mechanism
        True mechanisms, batch shape (N,), each with two drives.
    machine
        Limits and rest positions, with a standby point: one for all, or one per heliostat.
    believed
        Mechanisms that the controllers store; None if they store the true mechanisms.
    play, miss, seed
        See `Drives`.
    wind
        Wind that deflects the mirrors; None for no wind.

    Attributes
    ----------
    state, kind
        State, see `lcu.states` (-1 without power), and kind of motion, see `lcu.motion`, (N,).
    fault
        Fault number, see `lcu.controller`; 0 if there is no fault, (N,).
    axes
        Counts of the controllers, dtype `AXIS`, (N, 2).
    drives
        True positions of motors and joints.
    now_ms
        Time since the start, ms.
    edition
        Increases with every change; a value read at the same edition is still valid.
    journals
        Journals of the controllers.
    aim
        Aim points, (N, 3), m.

    Raises
    ------
    InputError
        If ``mechanism`` is not an array of mechanisms with two drives each.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        machine: Machine | Sequence[Machine],
        *,
        believed: Mechanism | None = None,
        play: npt.ArrayLike = 0.0,
        miss: float = 0.0,
        wind: Wind | None = None,
        seed: int = 0,
    ) -> None:
        if len(mechanism.shape) != 1 or len(mechanism.driven) != 2:
            raise InputError(
                f"field: mechanisms of shape {mechanism.shape} with {len(mechanism.driven)} "
                "drives; pass a one-dimensional array, with two drives each"
            )
        count = mechanism.shape[0]
        self.mechanism = mechanism
        self.journals = Journals(mechanism if believed is None else believed, machine)
        self._stow = np.zeros((count, 2), dtype=np.int64)
        self._defocus = np.zeros((count, 2))
        self._offset = np.zeros((count, 2))
        self.axes = np.zeros((count, 2), dtype=AXIS)
        for table, rows in self.journals.machines():
            self._stow[rows], self._defocus[rows] = table.stow, table.defocus
            for i, axis in enumerate(table.axes):
                _limit(self.axes, rows, i, axis)
        for name in ("count", "goal", "leg"):
            self.axes[name] = self._stow
        ends = np.stack([self._angles_at(self.axes[name]) for name in ("low", "high")])
        self._low, self._high = ends.min(axis=0), ends.max(axis=0)
        self.drives = Drives(self.axes["count"], play, miss, seed)
        self.wind, self.now_ms, self.edition = wind, 0, 0
        self._order = np.zeros(count, dtype=np.int64)
        self._queued = np.zeros(count, dtype=np.int64)
        self.state = np.full(count, states.STOWED, dtype=np.int8)
        self.fault = np.full(count, NO_FAULT, dtype=np.int8)
        self._present = np.zeros(count, dtype=np.bool_)
        self._kept = self.state.copy()
        self.kind = np.full(count, HOLD, dtype=np.int8)
        self._kept_kind = self.kind.copy()
        self._base = np.full(count, HOLD, dtype=np.int8)
        self._aside = np.full(count, NO_TURN, dtype=np.int8)
        self._turn_goals = np.zeros((count, 2), dtype=np.int64)
        self.aim = np.full((count, 3), np.nan)
        self._target = np.full((count, 3), np.nan)
        self._ready = np.zeros(count, dtype=np.bool_)
        self._lease = np.zeros(count, dtype=np.int64)
        self._heard = np.full(count, LEASE_MS, dtype=np.int64)
        self._dark = np.zeros(count, dtype=np.int64)
        self._knot, self._renew, self._since = np.zeros((3, count), dtype=np.int64)
        self._start, self._slope = np.zeros((2, count, 2))
        books = self.journals
        self._safe_path, self._safe_path_length = safe_paths(
            books.corners, books.position, books.origin, books.standby
        )
        self._path = np.zeros_like(self._safe_path)
        self._length = np.zeros(count, dtype=np.int64)
        self._place = np.zeros(count, dtype=np.int64)
        self._sun = np.zeros((2, 3), dtype=np.int64)
        self._sun_ms = 0
        self._sunned = np.full(count, -RECENT_MS)  # when each last took the sun vector, ms

    def __len__(self) -> int:
        return len(self.state)

    # -- poses -----------------------------------------------------------------------------

    def _angles_at(self, counts: npt.ArrayLike, rows: Rows | None = None) -> FloatArray:
        chosen = np.arange(len(self.axes)) if rows is None else rows
        return np.asarray(self.journals.drives(chosen).angles(np.asarray(counts, dtype=np.float64)))

    def _pose(self, rows: Rows, aims: FloatArray, ahead_ms: int) -> tuple[FloatArray, Bools]:
        """Return the joint angles for aims, (M, 2), and whether each aim can be reached, (M,).

        ``aims`` has shape (M, 3).
        """
        sun = (self._sun[0] + self._sun[1] * (self._sun_ms + ahead_ms) // 1000) / UNIT
        counts = self.axes["count"][rows].astype(np.float64)
        return self.journals.pose(rows, sun / np.linalg.norm(sun), aims, counts)

    def _go(self, rows: Rows, angles: FloatArray, how: npt.NDArray[np.int64]) -> None:
        steps = np.floor(self.journals.drives(rows).counts(angles) + 0.5).astype(np.int64)
        kernels.go_rows(self.axes, self._order, rows, steps, how)

    def _away(self, rows: Rows, angles: FloatArray) -> FloatArray:
        """Return joint angles turned away by the heliostats' defocus offsets."""
        return turned(angles, self._offset[rows], self._low[rows], self._high[rows])

    def still(self, rows: Rows | None = None) -> Bools:
        """Return whether heliostats are at rest: all (N,), or those in ``rows`` (M,)."""
        axes, queued = self.axes, self._queued
        if rows is not None:
            axes, queued = axes[rows], queued[rows]
        out = np.empty(len(axes), dtype=np.bool_)
        kernels.still_rows(axes, queued, out)
        return out

    def ready(self, rows: Rows) -> Bools:
        """Return whether heliostats have reached standby along the safe path, (M,)."""
        arrived: Bools = self._ready[rows]
        return arrived

    def at_stow(self, rows: Rows | None = None) -> Bools:
        """Return whether heliostats are at rest at stow: all (N,), or those in ``rows`` (M,)."""
        count, stow = self.axes["count"], self._stow
        if rows is not None:
            count, stow = count[rows], stow[rows]
        at_counts: Bools = (count == stow).all(axis=1)
        return self.still(rows) & at_counts

    # -- motions ---------------------------------------------------------------------------

    def _hold(self, rows: Rows) -> None:
        self.kind[rows] = HOLD
        kernels.brake_rows(self.axes, rows)

    def _begin(self, rows: Rows, kind: int, targets: FloatArray) -> None:
        self.kind[rows] = kind
        self._target[rows] = targets
        self._knot[rows] = self._renew[rows] = 0

    def _turn_away(self, rows: Rows) -> None:
        if not len(rows):
            return
        rows = rows[~among(self.kind[rows], DEFOCUS, STOW)]
        comes = self.kind[rows] == RETURN  # locked on its way to stow
        self._stow_directly(rows[comes])
        rows = rows[~comes]
        home = self.at_stow(rows)
        self._hold(rows[home])
        rows = rows[~home]
        begun = self._aside[rows] != NO_TURN
        self._go_on_turning(rows[begun])
        rows = rows[~begun]
        points, down = self._down(rows)
        lower = np.isfinite(down[:, 0])
        self._choose_offsets(rows[~lower])
        self._offset[rows[lower]] = 0.0
        self._target[rows[lower]] = points[lower]
        self._base[rows] = self.kind[rows]
        self.kind[rows] = DEFOCUS
        self._knot[rows] = self._renew[rows] = 0
        angles = self._away(rows, self._angles_at(self.axes["count"][rows], rows))
        angles[lower] = down[lower]
        self._go(rows, angles, np.full(len(rows), kernels.BOTH))
        self._aside[rows], self._turn_goals[rows] = TURNING, self.axes["goal"][rows]

    def _go_on_turning(self, rows: Rows) -> None:
        """Resume turns away from the aim that a reset or an emergency stop has interrupted."""
        self.kind[rows], self._base[rows] = DEFOCUS, HOLD
        rows = rows[self._aside[rows] == TURNING]
        both = np.full(len(rows), kernels.BOTH)
        kernels.go_rows(self.axes, self._order, rows, self._turn_goals[rows], both)

    def _leaving(self, rows: Rows) -> Bools:
        """Return a mask of heliostats whose motion takes the beam off, as in `Motion.leaving`."""
        turns = (self.kind[rows] == DEFOCUS) & (self._aside[rows] == TURNING)
        return np.asarray(among(self.kind[rows], STOW, RETURN) | turns)

    def _note_motions(self) -> None:
        """Forget turns away that a later motion has replaced, as `Controller._mark` does."""
        self._aside[~among(self.kind, HOLD, DEFOCUS)] = NO_TURN

    def _lock_now(self, rows: Rows) -> None:
        """Stand still, but first finish any motion that takes the beam off, as in `Motion.lock`."""
        leaving = self._leaving(rows)
        self._base[rows[leaving]] = HOLD
        self._hold(rows[~leaving])

    def _down(self, rows: Rows) -> tuple[FloatArray, FloatArray]:
        """Return the points (M, 3) and joint angles (M, 2) at which turns down the safe path end.

        They are NaN where a heliostat cannot turn down the path; see `Motion._turn`.
        """
        at_standby = (self._target[rows] == self.journals.standby[rows]).all(axis=1)
        held = self._ready[rows] & (self.kind[rows] == HOLD) & at_standby
        stands = held | (self.kind[rows] == STANDBY)
        goes = self._recent(rows) & (stands | (self.kind[rows] == APPROACH))
        place = np.where(stands, self._safe_path_length[rows] - 1, self._place[rows])
        # The path of an approach is no longer than the safe path.
        begun = self._path[rows, : self._safe_path.shape[1]]
        return end_down_the_path(
            lambda some, points: self._pose(rows[some], points, 0),
            np.where(stands[:, None, None], self._safe_path[rows], begun),
            np.where(goes, place, 0),
            self._angles_at(self.axes["count"][rows], rows),
            self._defocus[rows],
        )

    def _choose_offsets(self, rows: Rows) -> None:
        """Choose the angles by which heliostats turn away, as `Motion._turn` does."""
        tracks = self.kind[rows] == TRACK
        points = np.where(tracks[:, None], self.journals.standby[rows], self.aim[rows])
        points[~self._recent(rows)] = np.nan
        self._offset[rows] = offsets(
            lambda some, aims: self._pose(rows[some], aims, 0),
            points,
            self._angles_at(self.axes["count"][rows], rows),
            self._defocus[rows],
        )

    def _recent(self, rows: Rows) -> Bools:
        """Return whether heliostats recently received the sun vector, (M,)."""
        return np.asarray(self.now_ms - self._sunned[rows] < RECENT_MS)

    def _stow_directly(self, rows: Rows) -> None:
        if not len(rows):
            return
        self._ready[rows] = False
        self.kind[rows] = STOW
        kernels.go_rows(
            self.axes,
            self._order,
            rows,
            np.ascontiguousarray(self._stow[rows]),
            np.full(len(rows), kernels.SECONDARY_FIRST),
        )

    def _return(self, rows: Rows) -> None:
        """Return along the approach path to stow."""
        for i in rows:
            self._set_path(i, self._way_back(i))
        self.kind[rows] = RETURN
        self._ready[rows] = False
        self._place[rows] = -1
        kernels.brake_rows(self.axes, rows)

    def _way_back(self, i: np.intp) -> FloatArray:
        if self.kind[i] == APPROACH:
            return self._path[i, : max(0, self._place[i])][::-1].copy()
        if not self._ready[i]:
            return np.zeros((0, 3))
        path = self._safe_path[i, : self._safe_path_length[i]][::-1]
        if self.kind[i] == TRACK:
            corners = np.concatenate([self.aim[i][None], path])[None]
            long, length = pieces(corners, self.journals.origin[i][None])
            return np.asarray(long[0, 1 : length[0]])
        if self.kind[i] == DEFOCUS:
            top = min(self.journals.standby[i, 2], self._target[i, 2])
            return np.asarray(path[path[:, 2] < top])
        return np.asarray(path)

    def _set_path(self, i: np.intp, points: FloatArray) -> None:
        if len(points) > self._path.shape[1]:
            wider = np.zeros((len(self), len(points), 3))
            wider[:, : self._path.shape[1]] = self._path
            self._path = wider
        self._path[i, : len(points)] = points
        self._length[i] = len(points)

    def _enter(self, rows: Rows, state: int) -> None:
        if state in (states.DEFOCUSED, states.FAULT):
            self._dark[rows[self.state[rows] != state]] = STOW_WAIT_MS
        self.state[rows] = state

    # -- messages --------------------------------------------------------------------------

    def take_sun(
        self, values: tuple[int, ...], rows: Rows | None = None, delay_ms: int = 0
    ) -> None:
        """Receive a SUN message, which is sent every second and renews the lease.

        Parameters
        ----------
        values
            Contents of the message: second, direction, rate.
        rows
            Heliostats that receive the message; None for all heliostats.
        delay_ms
            Time in transit.
        """
        self.edition += 1
        self._sun[0], self._sun[1] = values[1:4], np.multiply(values[4:7], RATE_FACTOR)
        self._sun_ms = delay_ms
        heard = np.arange(len(self)) if rows is None else rows
        takes = heard[self.state[heard] >= 0]
        self._lease[takes], self._sunned[takes] = LEASE_MS - max(0, delay_ms), self.now_ms
        self.hear(heard)

    def put_up(self, values: tuple[int, ...], aims: npt.ArrayLike) -> Bools:
        """Set stowed heliostats to tracking at once; return a mask of these heliostats, (N,).

        Heliostats that cannot bring their beams to their aims stay at stow.

        Parameters
        ----------
        values
            SUN message; see `take_sun`.
        aims
            Aim points, (N, 3), m.
        """
        self.take_sun(values)
        rows = np.flatnonzero(self.state == states.STOWED)
        self.aim[rows] = np.asarray(aims)[rows]
        angles, good = self._pose(rows, self.aim[rows], 0)
        rows, angles = rows[good], angles[good]
        counts = np.floor(self.journals.drives(rows).counts(angles) + 0.5).astype(np.int64)
        for name in ("count", "goal", "leg"):
            self.axes[name][rows] = counts
        self.drives.turned[rows], self.drives.joint[rows] = counts, counts
        self._ready[rows] = True
        self._begin(rows, TRACK, self.aim[rows])
        self._enter(rows, states.TRACKING)
        return np.isin(np.arange(len(self)), rows)

    def hear(self, rows: Rows) -> None:
        """Record that heliostats hear from their cluster.

        A heliostat that does not hear from its cluster leaves any position that it holds.
        """
        self._heard[rows] = LEASE_MS
        held = (self.kind[rows] == HOLD) & (self.state[rows] != states.FAULT)
        self._aside[rows[held & (self.state[rows] >= 0)]] = NO_TURN

    def order(self, name: str, rows: Rows | None = None, aim: npt.ArrayLike | None = None) -> Bools:
        """Send a command to heliostats; return which of them accept it, (N,).

        Parameters
        ----------
        name
            DEFOCUS, STOW, APPROACH, IDLE, TRACK, REFOCUS, AIM, LOCK, UNLOCK or CLEAR_FAULT.
        rows
            Heliostats; None for all heliostats.
        aim
            Aim point of AIM, (3,) or (M, 3), m.

        Raises
        ------
        InputError
            If the command is any other, or AIM has no aim.
        """
        chosen = np.arange(len(self)) if rows is None else np.asarray(rows)
        chosen = chosen[self.state[chosen] >= 0]
        self.edition += 1
        state, taken = self.state[chosen], np.zeros(len(self), dtype=np.bool_)
        if name not in ("DEFOCUS", "STOW"):
            self.hear(chosen)
        if name == "DEFOCUS":
            self._defocus_now(chosen)
        elif name == "STOW":
            self._stow_now(chosen)
        elif name in ("LOCK", "UNLOCK", "CLEAR_FAULT"):
            chosen = self._lock(chosen, name)
        elif name == "APPROACH":
            chosen = chosen[(state == states.STOWED) & (self._lease[chosen] > 0)]
            for i in chosen:
                self._set_path(i, self._safe_path[i, : self._safe_path_length[i]])
            self.kind[chosen], self._place[chosen] = APPROACH, -1
            self._ready[chosen] = False
            self._enter(chosen, states.APPROACHING)
        elif name in ("TRACK", "REFOCUS", "IDLE"):
            chosen = self._sun_bound(chosen, name)
        elif name == "AIM" and aim is not None:
            chosen = chosen[~among(self.kind[chosen], APPROACH, RETURN)]
            self.aim[chosen] = aim
            self._knot[chosen] = self._renew[chosen] = 0
            tracks = chosen[self.kind[chosen] == TRACK]
            self._target[tracks] = self.aim[tracks]
        else:
            raise InputError(f"field: {name!r} with aim {aim!r}; see Field.order for the commands")
        self._note_motions()
        taken[chosen] = True
        return taken

    def _stow_now(self, rows: Rows) -> None:
        """Carry out STOW, according to the state table."""
        state = self.state[rows]
        kept = among(state, states.LOCKED, states.FAULT)
        self._stow_directly(rows[kept])
        goes = rows[~kept & ~among(state, states.STOWED, states.STOWING)]
        fresh = self._lease[goes] > 0
        self._enter(goes, states.STOWING)
        self._return(goes[fresh])
        self._stow_directly(goes[~fresh])

    def _lock(self, rows: Rows, name: str) -> Rows:
        """Carry out LOCK, UNLOCK or CLEAR_FAULT; return which heliostats accept it."""
        state = self.state[rows]
        if name == "LOCK":
            self._enter(rows, states.LOCKED)
            self._lock_now(rows)
            return rows
        free = ~self._leaving(rows)
        if name == "UNLOCK":
            rows = rows[free & (state == states.LOCKED)]
        else:
            rows = rows[free & (state == states.FAULT) & ~self._present[rows]]
            self.fault[rows] = NO_FAULT
        home = np.where(self.at_stow(rows), states.STOWED, states.IDLE)
        after = np.where(self.fault[rows] == NO_FAULT, home, states.FAULT)
        for to in (states.STOWED, states.IDLE, states.FAULT):
            self._enter(rows[after == to], to)
        self._hold(rows)
        return rows

    def _sun_bound(self, rows: Rows, name: str) -> Rows:
        """Carry out TRACK, REFOCUS or IDLE; return which heliostats accept it."""
        state, fresh = self.state[rows], self._lease[rows] > 0
        if name == "IDLE":
            back = (state == states.DEFOCUSED) & self._ready[rows] & fresh
            rows = rows[among(state, states.IDLE, states.TRACKING) | back]
            self._stand_by(rows)
            self.state[rows] = states.IDLE
            return rows
        begins = (states.DEFOCUSED,) if name == "REFOCUS" else (states.IDLE, states.DEFOCUSED)
        able = fresh & self._ready[rows] & ~np.isnan(self.aim[rows, 0]) & among(state, *begins)
        rows = rows[able]
        if len(rows):
            rows = rows[self._pose(rows, self.aim[rows], 0)[1]]
        self._begin(rows, TRACK, self.aim[rows])
        self.state[rows] = states.TRACKING
        return rows

    def _stand_by(self, rows: Rows) -> None:
        able = self._ready[rows] & (self._lease[rows] > 0)
        self._begin(rows[able], STANDBY, self.journals.standby[rows[able]])
        self._hold(rows[~able])

    def _defocus_now(self, rows: Rows) -> None:
        """Carry out DEFOCUS, LAPSED or UNREACHABLE, according to the state table."""
        state = self.state[rows]
        goes = rows[among(state, states.APPROACHING, states.IDLE, states.TRACKING)]
        if len(goes):
            self._turn_away(goes)
            self._enter(goes, states.DEFOCUSED)
        self._turn_away(rows[among(state, states.LOCKED, states.FAULT)])
        self._stow_directly(rows[state == states.STOWING])

    def lease_left(self, row: int) -> int:
        """Return the remaining lease of one heliostat, ms."""
        return int(self._lease[row])

    def leases(self, rows: Rows) -> npt.NDArray[np.int64]:
        """Return the remaining leases of the heliostats in ``rows``, ms, (M,)."""
        return self._lease[rows]

    # -- faults and power ------------------------------------------------------------------

    def fail(self, rows: Rows, number: int) -> None:
        """Set a fault of `lcu.controller`, which lasts until `mend`.

        Raises
        ------
        InputError
            If the fault number is unknown.
        """
        if not NO_FAULT < number <= LATCHED:
            raise InputError(
                f"field: a fault must be 1 to {LATCHED}, as in lcu.names, not {number}"
            )
        rows = rows[self.state[rows] >= 0]
        self.edition += 1
        self._present[rows] = True
        self.fault[rows] = np.where(self.fault[rows] == NO_FAULT, number, self.fault[rows])
        state = self.state[rows]
        self._hold(rows[state == states.STOWED])
        self._lock_now(rows[state == states.LOCKED])
        self._stow_directly(rows[state == states.STOWING])
        away = (states.APPROACHING, states.IDLE, states.TRACKING, states.DEFOCUSED)
        self._turn_away(rows[among(state, *away)])
        self._enter(rows[state != states.LOCKED], states.FAULT)
        self._note_motions()

    def mend(self, rows: Rows) -> None:
        """Remove the causes of faults; the faults themselves remain until CLEAR_FAULT."""
        self._present[rows] = False

    def cut(self, rows: Rows, *, warned: bool = False) -> None:
        """Cut the power: motors stop and messages are lost, but emitted steps are still made.

        If ``warned``, the brown-out detectors notice the failure in time and leave a fault.
        """
        rows = rows[self.state[rows] >= 0]
        self.edition += 1
        if warned:
            self.fail(rows, SUPPLY)
        self._kept_kind[rows] = self.kind[rows]
        self._kept[rows], self.state[rows] = self.state[rows], -1
        self.kind[rows] = self._base[rows] = HOLD
        self._lease[rows] = self._queued[rows] = self._order[rows] = 0
        self._sunned[rows] = -RECENT_MS
        self._ready[rows] = self._present[rows] = False
        for name in ("speed", "phase", "led", "braking"):
            self.axes[name][rows] = 0
        self.axes["direction"][rows] = 1
        for name in ("goal", "leg"):
            self.axes[name][rows] = self.axes["count"][rows]

    def restore(self, rows: Rows) -> None:
        """Restore the power; heliostats turn away unless they were locked or in FAULT.

        A turn that had begun is resumed, and so is a motion directly to stow.
        """
        rows = rows[self.state[rows] < 0]
        self.edition += 1
        before = self._kept[rows]
        locked, faulty = before == states.LOCKED, before == states.FAULT
        self.fault[rows] = np.where(faulty, LATCHED, NO_FAULT)
        self._heard[rows], self._dark[rows] = LEASE_MS, STOW_WAIT_MS
        home = self.at_stow(rows) & ~locked & ~faulty
        self._enter(rows[locked], states.LOCKED)
        self._enter(rows[home], states.STOWED)
        comes = (self._kept_kind[rows] == STOW) & ~home & ~locked
        self._turn_away(rows[~home & ~locked & ~comes])
        self._enter(rows[faulty], states.FAULT)
        self._enter(rows[~home & ~locked & ~faulty], states.DEFOCUSED)
        self._stow_directly(rows[comes])
        self.state[rows[comes & ~faulty]] = states.STOWING
        self._note_motions()

    # -- time ------------------------------------------------------------------------------

    def advance(self, milliseconds: int) -> None:
        """Advance time, in ticks of `TICK_MS`.

        Raises
        ------
        InputError
            If the time is not a multiple of `TICK_MS`.
        """
        if milliseconds % TICK_MS or milliseconds < 0:
            raise InputError(f"field: {milliseconds} ms is not a multiple of {TICK_MS} ms")
        for _ in range(milliseconds // TICK_MS):
            self._tick()

    def _tick(self) -> None:
        self.edition += 1
        self.now_ms += TICK_MS
        self._sun_ms += TICK_MS
        for timer in (self._lease, self._heard):
            np.maximum(timer - TICK_MS, 0, out=timer)
        fresh, silent = self._lease > 0, self._heard == 0
        follows = among(self.kind, STANDBY, TRACK) | (
            (self.kind == DEFOCUS) & among(self._base, STANDBY, TRACK)
        )
        needs = among(self.state, states.APPROACHING, states.TRACKING)
        renewed = fresh & ((follows & (self.state != states.FAULT)) | needs)
        renewed |= (self.state == states.LOCKED) & (self.kind == HOLD) & ~silent
        self._dark = np.where(renewed, STOW_WAIT_MS, np.maximum(self._dark - TICK_MS, 0))
        self._lapses(fresh, silent, needs)
        self._move()
        self._note_motions()
        kernels.advance_rows(
            self.axes, self._order, self._queued, self.drives.next(), TICK_MS, SLOT_MS, AHEAD_MS
        )

    def _lapses(self, fresh: Bools, silent: Bools, needs: Bools) -> None:
        """Apply lapsed leases, as `Controller._lapses` does.

        ``needs`` marks heliostats in a state that needs the sun vector.
        """
        dark, latched = self._dark == 0, among(self.state, states.LOCKED, states.FAULT)
        idle = self.state == states.IDLE
        comes = self.kind == RETURN
        held = latched & (self.kind == HOLD) & ~self._present & ~dark
        lapsed = ~fresh & (needs | comes | (idle & (self.kind == STANDBY)))
        if silent.any():
            lapsed |= silent & (idle | (held & ~self.at_stow()))
        if lapsed.any():
            self._defocus_now(np.flatnonzero(lapsed))
        alone = np.flatnonzero((self.state == states.DEFOCUSED) & dark)
        if len(alone):
            self._stow_directly(alone)
            self.state[alone] = states.STOWING
        dark_rows = np.flatnonzero(latched & dark & (self.kind != STOW))
        if len(dark_rows):
            self._stow_directly(dark_rows[~self._leaving(dark_rows) & ~self.at_stow(dark_rows)])

    def _move(self) -> None:
        """Advance all motions by a tick, as `Motion.tick` does."""
        for timer in (self._knot, self._renew):
            np.maximum(timer - TICK_MS, 0, out=timer)
        np.minimum(self._since + TICK_MS, KNOT_MS, out=self._since)
        kind = self.kind.copy()
        arrived = np.flatnonzero((kind == STOW) & self.at_stow())
        self.kind[arrived] = HOLD
        self.state[arrived[self.state[arrived] == states.STOWING]] = states.STOWED
        still = self.still()
        self._aside[(kind == DEFOCUS) & (self._aside == TURNING) & still] = TURNED
        on_path = np.flatnonzero(among(kind, APPROACH, RETURN) & still)
        if len(on_path):
            self._on_path(on_path)
        due = ~among(kind, STOW, APPROACH, RETURN) & (self._renew <= 0)
        self._renew[due] = RENEW_MS
        away = (kind == DEFOCUS) & among(self._base, STANDBY, TRACK) & (self._lease > 0)
        rows = np.flatnonzero(due & (among(kind, STANDBY, TRACK) | away))
        if len(rows):
            lost = self._follow(rows)
            self._base[lost[kind[lost] == DEFOCUS]] = HOLD
            lost = lost[kind[lost] != DEFOCUS]
            if len(lost):
                self._defocus_now(lost)

    def _on_path(self, rows: Rows) -> None:
        """Continue along the path, as `Motion._on_path` does."""
        self._place[rows] += 1
        goes = rows[self._place[rows] < self._length[rows]]
        ends = rows[self._place[rows] >= self._length[rows]]
        if len(goes):
            angles, good = self._pose(goes, self._path[goes, self._place[goes]], 0)
            turns = angles - self._angles_at(self.axes["count"][goes], goes)
            good &= (np.abs(turns).max(axis=1) <= FAR) | (self.kind[goes] != RETURN)
            first = (self.kind[goes] == APPROACH) & (self._place[goes] == 0)
            how = np.where(first, kernels.PRIMARY_FIRST, kernels.BOTH)
            self._go(goes[good], angles[good], how[good])
            self._defocus_now(goes[~good])
        came = ends[self.kind[ends] == APPROACH]
        self._ready[came] = True
        self.state[came] = states.IDLE
        self._stand_by(came)
        self._stow_directly(ends[self.kind[ends] == RETURN])

    def _follow(self, rows: Rows) -> Rows:
        """Keep beams on their aims, as `Motion._follow` does.

        Return the heliostats whose aims no pose reaches.
        """
        new = rows[self._knot[rows] <= 0]
        lost = new[:0]
        if len(new):
            start, good = self._pose(new, self._target[new], RENEW_MS // 2)
            end, reached = self._pose(new, self._target[new], RENEW_MS // 2 + KNOT_MS)
            change = end - start
            smooth = reached & (np.abs(change).max(axis=1) <= KNOT_LIMIT)
            lost = new[~good]
            self._start[new] = start
            self._slope[new] = np.where(smooth[:, None], change / KNOT_MS, 0.0)
            self._knot[new] = np.where(smooth, KNOT_MS, RENEW_MS)
            self._knot[lost] = self._since[lost]
            self._since[new] = 0
            rows = rows[~np.isin(rows, lost)]
        angles = self._start[rows] + self._slope[rows] * self._since[rows, None]
        away = self.kind[rows] == DEFOCUS
        angles[away] = self._away(rows[away], angles[away])
        self._go(rows, angles, np.full(len(rows), -1))
        return lost

    # -- truth -----------------------------------------------------------------------------

    def normals(self) -> FloatArray:
        """Return the present true normals of the mirrors, (N, 3)."""
        return self.stand()[0]

    def stand(self) -> tuple[FloatArray, FloatArray]:
        """Return the true normals and vertices, each (N, 3)."""
        pose = self.mechanism.pose(self.drives.joint)
        if self.wind is None:
            return pose.normal, pose.vertex
        place = np.broadcast_to(self.mechanism.position, pose.normal.shape)
        return self.wind.turned(pose.normal, place, 1e-3 * self.now_ms), pose.vertex

    def store(self, row: int, items: dict[str, bytes]) -> None:
        """Store items in a controller's journal; a new armature takes effect at once."""
        self.journals.store(row, items)
        self.edition += 1

    def errors(self, sun: FloatArray, aims: FloatArray) -> FloatArray:
        """Return the error that each normal would have if it tracked ``aims``, rad, (N,).

        ``aims`` has shape (N, 3), m.
        """
        rows = np.arange(len(self))
        counts = self.axes["count"].astype(np.float64)
        angles, good = self.journals.pose(rows, sun, aims, counts)
        pose = self.mechanism.pose(np.floor(self.journals.drives(rows).counts(angles) + 0.5))
        required = bisector(sun, normalize(aims - pose.vertex))
        off = np.linalg.norm(np.cross(pose.normal, required), axis=-1)
        return np.where(good, np.arcsin(np.clip(off, 0.0, 1.0)), np.nan)

    def flux(self, sun: npt.ArrayLike, receiver: npt.ArrayLike, radius: float) -> float:
        """Return the fraction of the field's light that reaches a receiver; see `light_share`."""
        return light_share(*self.stand(), sun, receiver, radius)


def _limit(axes: npt.NDArray[np.void], rows: Rows, index: int, axis: AxisLimits) -> None:
    """Set the limits of an axis for some heliostats, as `lcu.stepper.Axis` does.

    ``axes`` has dtype `AXIS`.
    """
    # Intervals are whole microseconds.
    room = 1000 * SLOT_MS * kernels.SCALE // -(-1_000_000 // axis.rate)
    values = {
        "low": axis.low,
        "high": axis.high,
        "top": max(1, min(axis.rate * SLOT_MS * kernels.SCALE // 1000, room)),
        "change": max(1, axis.acceleration * SLOT_MS * SLOT_MS * kernels.SCALE // 1_000_000),
        "backlash": axis.backlash,
        "direction": 1,
    }
    for name, value in values.items():
        axes[name][rows, index] = value
