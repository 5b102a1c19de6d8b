"""Motion of the two axes, according to the actions of the state table.

One motion runs at a time; starting another replaces it. When the heliostat leaves stow, the azimuth
moves first and the elevation last; the beam then travels along the ground to the foot of the tower
and up to standby. It returns by the same path.
"""

import math

from .config import Config
from .lease import RECENT_MS, SunLease
from .pointing import OK, Pose
from .search import Spiral, displaced
from .stepper import BOTH, PRIMARY_FIRST, SECONDARY_FIRST, Stepper
from .vectors import cross, minus, norm

TYPE_CHECKING = False
if TYPE_CHECKING:  # for the type checker only; a microcontroller has no such modules
    from collections.abc import Callable
    from typing import Any

    from .diagnosis import Diagnosis

#: Codes of the motions.
HOLD, MOVE, DEFOCUS, APPROACH, RETURN, STOW, STANDBY, TRACK, SEARCH, DIAGNOSE = range(10)

#: Interval at which goals are renewed, ms; and interval at which poses are computed, ms. Between
#: the poses, goals are interpolated as long as the angles change by at most this (rad; the chord is
#: then off by at most 1e-6 rad).
RENEW_MS, KNOT_MS, KNOT_LIMIT = 200, 4000, 1e-3
#: A path is followed through poses that divide each straight line evenly. On average their beams
#: are at most this far apart, rad; where the line passes nearest, they are further apart.
PIECE = 0.1
#: A path back is abandoned if an axis would have to turn by more than this (rad) to the next point:
#: such a turn, in the keyhole or the long way around a stop, carries the beam far off the line.
FAR = 1.6
#: An armature that is farther than this (m) from the previous one belongs to another heliostat.
ELSEWHERE = 0.5
#: Time for which the spiral stays at a point, ms.
DWELL_MS = 2000
#: If the size of a full step is unknown, rough stepping moves by this many steps at a time.
ROUGH_STEPS = 16
#: Drivers that may be switched off at rest are switched off after the motors have been at rest for
#: this long, ms.
RELEASE_MS = 200
#: Time that an axis is at rest before a diagnosis reads the sensor, ms.
SETTLE_MS = 500


class Motion:
    """The two axes of a heliostat.

    Parameters
    ----------
    config
        Settings; call `rebuild` after they change.
    sun
        The sun-vector lease.
    sensor
        Function that returns the mirror's tilt measured by an accelerometer, (x, y), rad, or None
        if there is no reading.

    Attributes
    ----------
    kind
        The present motion.
    aim
        Aim point, ENU, m; None before the first aim.
    ready
        Whether the standby point was reached by the safe path since leaving stow.
    known
        Whether the step counts are known.
    parked
        Whether the heliostat was locked at stow: neither DEFOCUS nor STOW moves it, even if the
        stow position has changed since.
    aside
        Goals of the defocus that has begun, as step counts; () once the defocus has ended, and the
        beam rests beside its aim or moves with the sun; None if another motion has begun since.
    blind
        Direction (1, -1) in which a heliostat with unknown counts may turn away; 0 once it has
        turned away.
    cut, unreachable
        Whether the last goals were beyond the limits; whether no pose reaches the last aim.
    diagnosis
        Result of the last diagnosis, steps moved by the two axes, and change of tilt x, y.
    """

    def __init__(
        self,
        config: Config,
        sun: SunLease,
        sensor: "Callable[[], tuple[float, float] | None]",
    ) -> None:
        self.config, self.sun, self.sensor = config, sun, sensor
        self.counts = [0, 0]
        self.stepper: Stepper | None = None
        self.kind = HOLD
        self.aim: tuple[float, float, float] | None = None
        self.ready = self.known = self.cut = self.unreachable = self.parked = False
        self.aside: tuple[int, ...] | None = None
        self.rough = 0
        self.blind, self._turns = 1, 0
        self.diagnosis: tuple[Any, ...] = (0, 0, 0, 0.0, 0.0)
        self._stops = [[0.0, 0.0], [0.0, 0.0]]
        self._near = [0.0, 0.0]
        self._start, self._slope = [0.0, 0.0], [0.0, 0.0]
        self._knot_ms = self._renew_ms = self._since_ms = 0
        self._base = HOLD  # the motion that a defocus turns away from
        self._offset = config.defocus  # by how much; new angles apply from the next defocus on
        self._path: list[tuple[float, float, float]] = []
        self._place = 0
        self._spiral: Spiral | None = None
        self._target: tuple[float, float, float] | None = None
        self._wait_ms = 0
        self._diagnosis: Diagnosis | None = None
        self._home = [0, 0]
        self._rests, self._resting_ms = False, 0
        self._origin: tuple[float, float, float] | None = None
        self.rebuild()

    # The axes.

    def rebuild(self) -> None:
        """Apply the settings; limits may change only at rest.

        If the board has been moved to another heliostat, the step counts become unknown, because
        they do not apply there.
        """
        config = self.config
        if config.pointing is not None:
            origin, self._origin = self._origin, config.pointing.origin
            if origin is None or norm(minus(origin, self._origin)) > ELSEWHERE:
                self.known = self.ready = False
        if config.rests != self._rests:
            self._rests = config.rests
            self.set_rough(ROUGH_STEPS if config.rests else 0)
        first, second = config.axes
        if first is None or second is None:
            return
        if self.stepper is None or self.stepper.axes != [first, second]:
            self.counts = [self.place(0), self.place(1)]
            self.stepper = Stepper([first, second], config.slot_ms, config.ahead_ms)
            self.stepper.rough = self.rough
            self.declare(self.counts[0], self.counts[1], self.known)
        self.stepper.full = config.microsteps
        for i in (0, 1):
            drive, axis = config.drives[i], self.stepper.axes[i]
            if drive is not None:
                low, high = drive.angle(axis.low), drive.angle(axis.high)
                self._stops[i][0], self._stops[i][1] = min(low, high), max(low, high)
        self._knot_ms = 0

    def declare(self, primary: int, secondary: int, known: bool) -> None:
        """Declare the present step counts, which is allowed only at rest."""
        self.counts[0], self.counts[1] = primary, secondary
        self.known, self.blind, self.aside = known, 1, None
        if self.stepper is not None:
            for axis, count in zip(self.stepper.axes, self.counts):  # noqa: B905
                axis.count = axis.goal = axis.leg = count

    def place(self, i: int) -> int:
        """Return the step count of an axis."""
        return self.counts[i] if self.stepper is None else self.stepper.axes[i].count

    def goal(self, i: int) -> int:
        """Return the goal of an axis."""
        return self.counts[i] if self.stepper is None else self.stepper.axes[i].goal

    def still(self) -> bool:
        """Return whether both axes are at rest."""
        return self.stepper is None or self.stepper.still()

    def following(self) -> bool:
        """Return whether the heliostat tracks the sun, so that its beam stays in place."""
        kind = self._base if self.kind == DEFOCUS else self.kind
        return kind in (STANDBY, TRACK, SEARCH) and self.sun.fresh()

    def at_stow(self) -> bool:
        """Return whether the heliostat is at stow."""
        stow = self.config.stow
        return (
            self.known
            and self.still()
            and stow is not None
            and self.place(0) == stow[0]
            and self.place(1) == stow[1]
        )

    def leaving(self) -> bool:
        """Return whether a motion is in progress that takes the beam off: a defocus or a stow."""
        return self.kind in (STOW, RETURN) or (self.kind == DEFOCUS and bool(self.aside))

    def may_rest(self, elapsed_ms: int) -> bool:
        """Return whether the drivers may be off, because the motors rest on full steps.

        Full steps hold without current. Between full steps, a motor without current turns to the
        nearest full step, and the counts do not register this.
        """
        full = self.config.microsteps
        at_rest = self.still() and (self.rough > 0 or not self.following())
        on_full = self.place(0) % full[0] == 0 and self.place(1) % full[1] == 0
        if not (self.config.rests and at_rest and on_full):
            self._resting_ms = 0
            return False
        self._resting_ms = min(self._resting_ms + elapsed_ms, RELEASE_MS)
        return self._resting_ms >= RELEASE_MS

    def halted(self, primary: int, secondary: int) -> None:
        """Subtract signed steps that were emitted but not made, after an emergency stop."""
        self.kind = HOLD
        if self._turns == 1 and not self.still():
            self.blind = -1  # a limit switch ended the blind turn; only the other direction is left
        self._turns = 0
        if self.stepper is not None:
            self.stepper.undone(primary, secondary)

    # Poses.

    def pose(self, aim: tuple[float, float, float], ahead_ms: int) -> "Pose | None":
        """Return the pose for an aim some time from now; None if no pose lies within the stops."""
        pointing = self.config.pointing
        if pointing is None or self.stepper is None:
            return None
        for i in (0, 1):
            drive = self.config.drives[i]
            if drive is None:
                return None
            self._near[i] = drive.angle(self.place(i))
        pose = pointing.solve(self.sun.vector(ahead_ms), aim, self._stops, self._near)
        self.unreachable = pose.status != OK
        return pose if pose.status == OK else None

    def reaches(self, points: "list[tuple[float, float, float]]") -> bool:
        """Return whether the beam can be sent to all these points now."""
        for point in points:  # noqa: SIM110 - a generator would allocate
            if self.pose(point, 0) is None:
                return False
        return True

    def _go_angles(self, angles: "list[float]", order: int) -> None:
        """Go to joint angles; if ``order`` is −1, use ``follow``."""
        stepper, steps = self.stepper, [0, 0]
        if stepper is None:
            return
        for i in (0, 1):
            drive = self.config.drives[i]
            if drive is None:
                return
            steps[i] = drive.nearest(angles[i])
        inside = (
            stepper.follow(steps[0], steps[1])
            if order < 0
            else stepper.go(steps[0], steps[1], order)
        )
        self.cut = not inside

    def _follow(self, aim: tuple[float, float, float]) -> bool:
        """Keep the beam on an aim as time passes; return False if no pose reaches it."""
        if self._knot_ms <= 0:
            # Goals hold until the next renewal, so they are exact at the middle of the interval.
            pose = self.pose(aim, RENEW_MS // 2)
            if pose is None:
                return False
            self._start[:] = pose.angles
            self._slope[0] = self._slope[1] = 0.0
            self._knot_ms = RENEW_MS
            later = self.pose(aim, RENEW_MS // 2 + KNOT_MS)
            if later is not None:
                primary, secondary = [later.angles[i] - self._start[i] for i in (0, 1)]
                if max(abs(primary), abs(secondary)) <= KNOT_LIMIT:
                    self._slope[0], self._slope[1] = primary / KNOT_MS, secondary / KNOT_MS
                    self._knot_ms = KNOT_MS
            self._since_ms = 0
        angles = [self._start[i] + self._slope[i] * self._since_ms for i in (0, 1)]
        if self.kind == DEFOCUS:
            for i in (0, 1):
                angles[i] = self._away(i, angles[i])
        self._go_angles(angles, -1)
        return True

    def _away(self, i: int, angle: float) -> float:
        """Return an angle turned away by the defocus.

        If a stop is near, the angle turns in the other direction.
        """
        offset = self._offset[i]
        low, high = self._stops[i]
        for away in (angle + offset, angle - offset):
            if low <= away <= high:
                return away
        return low if angle - low > high - angle else high

    def _turn(self) -> "list[float] | None":
        """Choose the angles of a defocus; return the final joint angles of a defocus from standby.

        From standby, even if held there, the beam goes down the safe path; a beam on its way up
        goes back along its path. It stops when an axis has turned by its angle or the beam reaches
        the ground. No other position is known to be off the receiver, because the aim may be on a
        target. From an aim, the axes turn away from standby, which is beside the receiver. A
        heliostat that an operator has left elsewhere turns away from its aim. Without a recent sun
        vector, both axes turn by the configured angles.
        """
        primary, secondary = self._offset = self.config.defocus
        if not self.known or self.sun.since_ms > RECENT_MS:
            return None
        near, unreachable, kind, chosen = self._near, self.unreachable, self.kind, None
        points = self._path[: max(0, self._place)] if kind == APPROACH else []
        at_standby = self.ready and self._target is self.config.standby
        if kind == STANDBY or (kind == HOLD and at_standby):
            points = self.way()[:-1]
        for point in points[::-1]:
            pose = self.pose(point, 0)
            if pose is None:
                break
            first, second = abs(near[0] - pose.angles[0]), abs(near[1] - pose.angles[1])
            if max(first, second) > FAR:
                break
            # The next pose overwrites this one, even if the beam cannot follow.
            chosen, self._target, self._offset = list(pose.angles), point, (0.0, 0.0)
            if first >= primary or second >= secondary or point[2] <= points[0][2]:
                break
        other = self.config.standby if kind in (TRACK, SEARCH) else self.aim
        pose = None if other is None or chosen is not None else self.pose(other, 0)
        self.unreachable = unreachable
        if pose is not None:
            first, second = near[0] - pose.angles[0], near[1] - pose.angles[1]
            self._offset = math.copysign(primary, first), math.copysign(secondary, second)
        return chosen

    # Actions of the state table.

    def hold(self) -> None:
        """Slow down and stop both axes."""
        self.kind = HOLD
        if self.stepper is not None:
            self.stepper.stop()

    def lock(self) -> None:
        """Stand still; a motion that takes the beam off, however, continues to its end."""
        if self.leaving():
            self._base = HOLD
        else:
            self.hold()

    def defocus(self) -> None:
        """Turn away from the present position; with unknown counts, only once.

        With unknown counts the axes turn by the same amount. A turn that was interrupted by an
        emergency stop or a reset continues to the same goals.
        """
        if self.kind in (DEFOCUS, STOW):
            return
        if self.kind == RETURN:  # locked on its way to stow
            self.kind = HOLD
            self.stow_directly()
            return
        # At stow, an approach may have begun without having made its first step.
        still = self.parked or self.at_stow()
        if still or self.stepper is None or None in self.config.drives:
            self.hold()
            return
        if self.known and self.aside is not None:
            self._base, self.kind = HOLD, DEFOCUS
            if self.aside:
                self.stepper.go(self.aside[0], self.aside[1], BOTH)
            return
        sense = 1
        if not self.known:
            sense = self.blind
            if sense == 0 or not self.still():
                self.hold()
                return
            # The middle of the range represents the unknown counts; the step size is then correct
            # for a rotary drive, and about right for a jack.
            first, second = self.stepper.axes
            self.declare((first.low + first.high) // 2, (second.low + second.high) // 2, False)
            self.blind, self._turns = 0, sense
            self.kind = HOLD
        down = self._turn()
        self._base, self.kind = self.kind, DEFOCUS
        self._knot_ms = self._renew_ms = 0
        angles = [0.0, 0.0]
        for i in (0, 1):
            drive = self.config.drives[i]
            assert drive is not None
            angle = drive.angle(self.place(i))
            away = self._away(i, angle)
            # In the other direction it is twice as far, beyond the position where the first turn
            # began.
            angles[i] = away if sense > 0 else 3.0 * angle - 2.0 * away
        self._go_angles(angles if down is None else down, BOTH)
        self.aside = (self.goal(0), self.goal(1)) if self.known else None

    def stow(self) -> None:
        """Return along the approach path, as far as the sun allows, and go to stow."""
        if not (self.sun.fresh() and self.config.complete()):
            self.stow_directly()
            return
        if self.kind == APPROACH:
            self._path = self._path[: max(0, self._place)][::-1]
        elif self.ready and self.config.standby is not None:
            points = self.way()[::-1]
            if self.kind in (TRACK, SEARCH) and self.aim is not None:
                points = self._pieces([self.aim] + points)[1:]
            elif self.kind == DEFOCUS:
                # From beside the receiver, go down, not across it.
                top = self.config.standby[2]
                if self._target is not None:
                    top = min(top, self._target[2])
                points = [point for point in points if point[2] < top]
            self._path = points
        else:
            self._path = []
        self.kind, self.ready = RETURN, False
        self._place = -1
        self._wait_ms = 0
        if self.stepper is not None:
            self.stepper.stop()

    def stow_directly(self) -> None:
        """Go to stow at once; the azimuth moves last."""
        self.ready = False
        if self.parked:
            return
        stow = self.config.stow
        if not self.known or self.stepper is None or stow is None or not self.config.fits():
            self.defocus()  # the stow position cannot be found, but the beam can leave
            return
        self.kind = STOW
        order = SECONDARY_FIRST if self.config.azimuth_axis == 0 else PRIMARY_FIRST
        self.stepper.go(stow[0], stow[1], order)

    def approach(self) -> None:
        """Leave stow for standby."""
        self.kind, self.ready = APPROACH, False
        self._path, self._place = self.way(), -1

    def standby(self) -> None:
        """Keep the beam on the standby point; hold if that point has not been reached."""
        if self.kind == APPROACH:
            self.ready = True
        if self.ready and self.config.standby is not None and self.sun.fresh():
            self._begin(STANDBY, self.config.standby)
        else:
            self.hold()

    def track(self) -> None:
        """Keep the beam on the aim."""
        if self.aim is not None:
            self._begin(TRACK, self.aim)

    def search(self) -> None:
        """Keep the beam on a spiral about the aim, set by `prepare_search`."""
        if self.aim is not None:
            self._begin(SEARCH, self.aim)
            self._wait_ms = 0

    def prepare_search(self, pitch: float, radius: float) -> bool:
        """Prepare the spiral; return False if that is impossible."""
        try:
            self._spiral = Spiral(pitch, radius)
        except ValueError:
            return False
        return True

    def prepare_move(self, primary: int, secondary: int) -> bool:
        """Prepare a motion to step counts; return False if the counts are beyond the limits."""
        self._home[0], self._home[1] = primary, secondary
        if self.stepper is None:
            return False
        first, second = self.stepper.axes
        return first.low <= primary <= first.high and second.low <= secondary <= second.high

    def move(self) -> None:
        """Go to the prepared step counts."""
        self.kind, self._target = MOVE, None  # a heliostat held at step counts is not at standby
        if self.stepper is not None:
            self.stepper.go(self._home[0], self._home[1], BOTH)

    def diagnose(self) -> None:
        """Move each axis a little and back, and check with the sensor whether it moved."""
        self.hold()
        if self.stepper is not None and self.config.complete():
            self.kind, self._wait_ms = DIAGNOSE, SETTLE_MS
            self._diagnosis = None

    def renew(self) -> None:
        """Apply a change of the aim, the armature or the standby point."""
        self._knot_ms = self._renew_ms = 0
        if self.kind == TRACK:
            self._target = self.aim
        elif self.kind == STANDBY:
            self._target = self.config.standby

    def set_rough(self, steps: int) -> None:
        """Set the number of steps to accumulate before following; 0 means fine stepping."""
        self.rough = steps
        if self.stepper is not None:
            self.stepper.rough = steps

    def _begin(self, kind: int, target: tuple[float, float, float]) -> None:
        self.kind, self._target = kind, target
        self._knot_ms = self._renew_ms = 0

    # The safe path.

    def way(self) -> "list[tuple[float, float, float]]":
        """Return points of the safe path from the ground to standby, close to each other."""
        config = self.config
        standby = config.standby
        if standby is None or config.pointing is None:
            return []
        points = list(config.path)
        if not points:
            # Beside the tower on the ground, half-way to its foot, then the foot.
            base = config.location if config.location is not None else config.pointing.origin
            east, north = 0.5 * (standby[0] - base[0]), 0.5 * (standby[1] - base[1])
            sine, cosine = 0.5, 0.866
            aside = (
                base[0] + cosine * east - sine * north,
                base[1] + sine * east + cosine * north,
                base[2],
            )
            points = [aside, (standby[0], standby[1], base[2])]
        return self._pieces(points + [standby])

    def _pieces(
        self, points: "list[tuple[float, float, float]]"
    ) -> "list[tuple[float, float, float]]":
        """Return the points of a path with intermediate points; see ``PIECE``."""
        pointing = self.config.pointing
        assert pointing is not None
        path = [points[0]]
        for i in range(1, len(points)):
            a, b = points[i - 1], points[i]
            u, v = minus(a, pointing.origin), minus(b, pointing.origin)
            cosine = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
            turn = math.atan2(norm(cross(u, v)), cosine)
            parts = 1 + int(turn / PIECE)
            for k in range(1, parts):
                step = minus(b, a)
                path.append(
                    (
                        a[0] + step[0] * k / parts,
                        a[1] + step[1] * k / parts,
                        a[2] + step[2] * k / parts,
                    )
                )
            path.append(b)
        return path

    def _on_path(self) -> str:
        """Advance along the path; return an event at its end, or if no pose reaches it."""
        if not self.still():
            return ""
        self._place += 1
        if self._place < len(self._path):
            pose = self.pose(self._path[self._place], 0)
            if pose is None:
                return "UNREACHABLE"
            # `pose` keeps the turn of each axis from the last call.
            if self.kind == RETURN:
                for i in (0, 1):
                    if abs(pose.angles[i] - self._near[i]) > FAR:
                        return "UNREACHABLE"
            order = BOTH
            if self.kind == APPROACH and self._place == 0:
                order = PRIMARY_FIRST if self.config.azimuth_axis == 0 else SECONDARY_FIRST
            self._go_angles(pose.angles, order)
            return ""
        if self.kind == APPROACH:
            return "ARRIVED"
        self.stow_directly()
        return ""

    # Time.

    def tick(self, elapsed_ms: int) -> str:
        """Advance the motion; return an event of the state table, or empty if there is none."""
        self._knot_ms = max(0, self._knot_ms - elapsed_ms)
        self._renew_ms = max(0, self._renew_ms - elapsed_ms)
        self._since_ms = min(self._since_ms + elapsed_ms, KNOT_MS)
        kind = self.kind
        if kind == STOW:
            if not self.at_stow():
                return ""
            self.kind = HOLD
            return "ARRIVED"
        if kind in (APPROACH, RETURN):
            return self._on_path()
        if kind == DEFOCUS and self.aside and self.still():
            self.aside = ()
        if kind == DIAGNOSE:
            self._diagnose(elapsed_ms)
        if kind == SEARCH:
            event = self._spin(elapsed_ms)
            if event:
                return event
        if self._renew_ms <= 0:
            self._renew_ms = RENEW_MS
            if kind in (STANDBY, TRACK, SEARCH) and self._target is not None:
                return "" if self._follow(self._target) else "UNREACHABLE"
            if (
                kind == DEFOCUS
                and self._target is not None
                and self.following()
                and not self._follow(self._target)
            ):
                # The heliostat stands still now, and the beam of a heliostat at rest moves with the
                # sun.
                self._base = HOLD
        return ""

    def _spin(self, elapsed_ms: int) -> str:
        """Advance the search from one point to the next."""
        self._wait_ms -= elapsed_ms
        if self._wait_ms > 0 or self._spiral is None or self.aim is None:
            return ""
        self._wait_ms = DWELL_MS
        if not self._spiral.advance():
            return "SEARCHED"
        pointing = self.config.pointing
        assert pointing is not None
        right, up = self._spiral.offset
        self._target = displaced(self.aim, pointing.origin, right, up)
        self._knot_ms = self._renew_ms = 0
        return ""

    def _diagnose(self, elapsed_ms: int) -> None:
        """Advance the diagnosis: a motion, a rest, then the next motion."""
        stepper = self.stepper
        if stepper is None:
            return
        self._wait_ms = self._wait_ms - elapsed_ms if self.still() else SETTLE_MS
        if self._wait_ms > 0:
            return
        self._wait_ms = SETTLE_MS
        diagnosis = self._diagnosis
        if diagnosis is None:
            from .diagnosis import Diagnosis  # rare, so it need not always occupy a board's memory

            diagnosis = self._diagnosis = Diagnosis(self.config, [self.place(0), self.place(1)])
        steps = diagnosis.advance(self.sensor())
        stepper.go(steps[0], steps[1], BOTH)
        if diagnosis.over:
            self.kind, self._diagnosis = MOVE, None
            self.diagnosis = diagnosis.result
