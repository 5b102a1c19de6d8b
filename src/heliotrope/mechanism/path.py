"""A day's tracking as a path: successive drive positions without needless slews.

`track` solves each sun position independently, so two successive solutions may lie on different
branches, or a revolution apart. A path is the sequence of solutions with the least cost, found by
dynamic programming over branches and revolutions. The cost minimises, in this order: poses that
miss the aim, poses over the top, slews, and motion.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.geometry import TAU, FloatArray, angle_between, as_float, as_vectors, wrap_signed
from heliotrope.mechanism.drives import Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.tracking import Steered, Tracking, TrackingStatus, track
from heliotrope.values import Card, Value, amount, span

#: Costs in rad of motion: a pose that misses the aim, a pose over the top, a slew. Each cost
#: outweighs all lower costs over a day of 10,000 poses.
_MISS, _TOP, _SLEW = 1e14, 1e8, 1e3
#: The keyhole must be this far from the home position for one branch to be over the top, rad.
_SIDE = 0.1
#: A normal that moves this much more than the sun did not follow it.
_FOLLOWS, _SLACK = 2.0, 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Slew(Value):
    """A step of the path that the sun's motion does not explain.

    Attributes
    ----------
    step
        Index of the pose at which the slew ends.
    row
        Heliostat index, counted over all batch axes after the time axis.
    turn
        Change of the joint angles, rad, (D,).
    reason
        Reason, in one clause, for display.
    """

    step: int
    row: int
    turn: FloatArray
    reason: str

    def _card(self) -> Card:
        turns = ", ".join(f"{np.degrees(angle):.1f}°" for angle in self.turn)
        return Card(f"before pose {self.step} of heliostat {self.row}: {self.reason} ({turns})")


@dataclass(frozen=True, eq=False, repr=False)
class TrackedPath(Value, Framed):
    """Poses at T successive times; (...) are the batch axes of the heliostats.

    Attributes
    ----------
    angles
        Joint angles, rad, (T, ..., D), without jumps of a full revolution except in slews.
    counts
        Drive counts, real numbers, (T, ..., D).
    normal, vertex
        Pose of the mirror, ENU, (T, ..., 3).
    status
        `TrackingStatus` as integers, (T, ...).
    residual
        Angle between the normal and the required normal, rad, (T, ...).
    branch
        (T, ...).
    over_the_top
        Whether the mirror is beyond the keyhole, seen from its home position, (T, ...).
    slews
        The steps that the sun's motion does not explain, in order of time.
    """

    angles: FloatArray
    counts: FloatArray
    normal: FloatArray
    vertex: FloatArray
    status: npt.NDArray[np.int8]
    residual: FloatArray
    branch: npt.NDArray[np.int8]
    over_the_top: npt.NDArray[np.bool_]
    slews: tuple[Slew, ...]

    def _card(self) -> Card:
        shape = " × ".join(map(str, self.status.shape))
        line = f"{shape} poses, {int(self.reachable.sum())} reach the aim, "
        line += amount(len(self.slews), "slew")
        rows = [
            (f"joint {k + 1}", span(np.degrees(self.angles[..., k]), unit="°"))
            for k in range(self.angles.shape[-1])
        ]
        rows += [(f"slew before pose {s.step}", s.reason) for s in self.slews]
        return Card(line, ("part", "range"), rows)

    def _labelled(self) -> Labelled:
        shape, axes = self.status.shape, self.angles.shape[-1]
        row = ("step", *(f"axis_{k}" for k in range(1, len(shape))))
        labels: dict[str, npt.ArrayLike] = {"joint": np.arange(1, axes + 1), "axis": ENU}
        labels |= {name: np.arange(n) for name, n in zip(row, shape, strict=True)}
        return Labelled(row, labels, self.variables(row))

    def variables(self, row: tuple[str, ...]) -> dict[str, Variable]:
        """Return the arrays by name for a data frame; ``row`` names the axes (T, ...)."""
        return {
            "angle": Variable((*row, "joint"), self.angles, "rad"),
            "count": Variable((*row, "joint"), self.counts),
            "normal": Variable((*row, "axis"), self.normal),
            "vertex": Variable((*row, "axis"), self.vertex, "m"),
            "residual": Variable(row, self.residual, "rad"),
            "reachable": Variable(row, self.reachable),
            "branch": Variable(row, self.branch),
            "over_the_top": Variable(row, self.over_the_top),
        }

    @property
    def reachable(self) -> npt.NDArray[np.bool_]:
        """Whether the beam reaches its aim, (T, ...)."""
        return np.asarray(self.status == TrackingStatus.OK)


def track_path(
    mechanism: Steered,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike,
    *,
    current: npt.ArrayLike | None = None,
    over_the_top: bool = False,
    local: bool = False,
) -> TrackedPath:
    """Return the poses that follow the sun through T times.

    Parameters
    ----------
    mechanism
        Mechanisms, one or several heliostats, or a plant, batch shape (...).
    sun
        Unit vectors to the sun, ENU, (T, 3), or (T, ..., 3) if they broadcast to the batch.
    aim, local
        Points in ENU metres, and whether they are fixed to the mirror, as for `track`.
    current
        Counts before the first pose, (..., D).
    over_the_top
        Whether the over-the-top branch may be used wherever that saves slews or motion. By default
        it is used only when the other branch cannot reach the aim.

    Raises
    ------
    InputError
        As for `track`, or if the sun array has no time axis.

    Notes
    -----
    Both joints rotate about fixed axes, so the two branches are mirror images of each other about
    the keyhole, that is, the angle of the second joint at which the normal comes closest to the
    primary axis. The usual branch is on the side of the home position (the middle of the stops, or
    0).
    """
    light = as_vectors(sun, "sun")
    batch = mechanism.armature.shape
    if light.ndim < 2:
        raise InputError(f"sun: shape {light.shape}; a path needs the suns of its times, (T, 3)")
    if not len(light):
        raise InputError("sun: no times; a path needs at least one")
    if light.ndim == 2 and batch:
        light = light.reshape(len(light), *(1,) * len(batch), 3)
    tracking = track(mechanism, light, aim, local=local)
    flat = _flat(tracking)
    steps, rows, _, axes = flat.angles.shape
    shape = tracking.best.shape[1:]
    table = np.broadcast_to(mechanism.drives.table, (*shape, axes, slot.DRIVE_SLOTS))
    axles = np.broadcast_to(mechanism.armature.table, (*shape, slot.ARMATURE_SIZE))
    choices = _Choices.of(
        flat,
        table.reshape(rows, axes, slot.DRIVE_SLOTS),
        axles.reshape(rows, slot.ARMATURE_SIZE),
    )
    start = None
    if current is not None:
        counts = np.broadcast_to(as_float(current), (*shape, axes)).reshape(rows, axes)
        start = Drive(choices.table).angles(counts)
    states = _cheapest(choices, start, 0.0 if over_the_top else _TOP)
    angles, branch = choices.taken(states)
    pick = branch[..., None].astype(np.intp)

    def of(values: np.ndarray) -> np.ndarray:
        extra = pick.reshape(*pick.shape, *(1,) * (values.ndim - 3))
        return np.take_along_axis(values, extra, axis=2)[:, :, 0]

    status, normal = of(flat.status), of(flat.normal)
    full = np.broadcast_to(light, (steps, *shape, 3)).reshape(steps, rows, 3)
    slews = _slews(choices, angles, branch, normal, full)

    def shaped(values: np.ndarray) -> np.ndarray:
        return values.reshape(steps, *shape, *values.shape[2:])

    return TrackedPath(
        shaped(angles),
        shaped(Drive(choices.table).counts(angles)),
        shaped(normal),
        shaped(of(flat.vertex)),
        shaped(status),
        shaped(of(flat.residual)),
        shaped(branch),
        shaped(np.take_along_axis(choices.top, pick, axis=2)[..., 0]),
        slews,
    )


def _flat(tracking: Tracking) -> Tracking:
    """Return solutions with one heliostat axis after the time axis, (T, N, …)."""
    batch = tracking.best.ndim
    steps = tracking.best.shape[0]
    return Tracking(
        **{k: v.reshape(steps, -1, *v.shape[batch:]) for k, v in vars(tracking).items()}
    )


@dataclass(frozen=True)
class _Choices:
    """The poses among which a path chooses, for T times and N heliostats.

    A state is a branch with a number of turns of each joint. There are S states in total.

    Attributes
    ----------
    table
        Drives, (N, D, slots).
    angles
        Joint angles, rad, (T, N, 2, D), each in the lowest turn that the joint's stops allow.
    able
        Whether the branch reaches the aim, (T, N, 2).
    top
        Whether the branch is over the top, (T, N, 2).
    free
        Whether a joint may turn without limit, (N, D).
    high
        Upper stop, rad, (N, D).
    turns
        Branch (0 or 1) and number of turns of each joint for the S states, (S, 1 + D).
    """

    table: FloatArray
    angles: FloatArray
    able: npt.NDArray[np.bool_]
    top: npt.NDArray[np.bool_]
    free: npt.NDArray[np.bool_]
    high: FloatArray
    turns: npt.NDArray[np.intp]

    @classmethod
    def of(cls, tracking: Tracking, table: FloatArray, armature: FloatArray) -> "_Choices":
        low, high = _stops(table)
        jack = table[..., slot.KIND] == slot.LINEAR
        free = ~jack & ~(np.isfinite(low) & np.isfinite(high))
        able = tracking.status == TrackingStatus.OK
        turning = ~jack & ~free
        # A pose at a stop, or out of reach, stays in the turn where it was found.
        lowest = tracking.angles - TAU * np.floor(
            (tracking.angles - np.where(turning, low, 0.0)[:, None] + 1e-9) / TAU
        )
        angles = np.where(turning[:, None] & able[..., None], lowest, tracking.angles)
        span = np.where(turning, high - low, 0.0)
        most = [int(n) for n in (1 + np.floor((span.max(axis=0) + 2e-9) / TAU))]
        grid = np.meshgrid(*(np.arange(n) for n in (2, *most)), indexing="ij")
        turns = np.stack([g.ravel() for g in grid], axis=-1).astype(np.intp)
        top = _over_the_top(armature, tracking.angles, low, high)
        return cls(table, angles, able, top, free, np.where(turning, high, np.inf), turns)

    def at(self, step: int) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return the angles of the states at a time, (N, S, D), and whether each exists, (N, S)."""
        branch, turns = self.turns[:, 0], self.turns[:, 1:]
        angles = self.angles[step][:, branch] + TAU * turns
        limited = np.isfinite(self.high)[:, None]
        fits = np.where(limited, angles <= self.high[:, None] + 1e-9, turns == 0)
        alone = self.able[step][:, branch] | (turns == 0).all(axis=-1)
        # A pose out of reach has one place only, wherever the stops are.
        known = np.where(self.able[step][:, branch], fits.all(axis=-1), alone)
        return angles, known

    def steps(self, before: FloatArray, after: FloatArray) -> FloatArray:
        """Return the changes of the joint angles between poses, (N, …, D)."""
        gap = after - before
        free = self.free.reshape(len(self.free), *(1,) * (gap.ndim - 2), -1)
        return np.where(free, wrap_signed(gap), gap)

    def taken(self, states: npt.NDArray[np.intp]) -> tuple[FloatArray, npt.NDArray[np.int8]]:
        """Return the angles (T, N, D) and branches (T, N) of the chosen states (T, N)."""
        chosen = self.turns[states]
        branch = chosen[..., 0]
        angles = np.take_along_axis(self.angles, branch[..., None, None], axis=2)[:, :, 0]
        angles = angles + TAU * chosen[..., 1:]
        unwound = np.unwrap(angles, axis=0)
        return np.where(self.free, unwound, angles), branch.astype(np.int8)


def _stops(table: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and highest joint angles that all stops allow, each (N, D)."""
    ends = table[..., [slot.MIN_COUNT, slot.MAX_COUNT]]
    drive = Drive(table[..., None, :])
    at = drive.angles(np.where(np.isfinite(ends), ends, 0.0))
    rising = drive.radians_per_count(np.where(np.isfinite(ends), ends, 0.0))[..., :1] > 0.0
    at = np.where(rising, at, at[..., ::-1])
    known = np.where(rising, np.isfinite(ends), np.isfinite(ends)[..., ::-1])
    low = np.maximum(table[..., slot.MIN_ANGLE], np.where(known[..., 0], at[..., 0], -np.inf))
    high = np.minimum(table[..., slot.MAX_ANGLE], np.where(known[..., 1], at[..., 1], np.inf))
    # Two turns from a single stop are more than any day needs.
    one_sided = np.isfinite(low) != np.isfinite(high)
    return (
        np.where(one_sided & np.isinf(low), high - 2.0 * TAU, low),
        np.where(one_sided & np.isinf(high), low + 2.0 * TAU, high),
    )


def _over_the_top(
    armature: FloatArray, angles: FloatArray, low: FloatArray, high: FloatArray
) -> npt.NDArray[np.bool_]:
    """Return whether each branch is beyond the keyhole as seen from the home, (T, N, 2).

    With a₁, a₂ the axes and n the normal, a₁·R(a₂, θ)n = p + q cos θ + r sin θ is largest at the
    keyhole.
    """
    if angles.shape[-1] < 2:
        return np.zeros(angles.shape[:-1], dtype=np.bool_)
    primary, secondary, normal = armature[:, :3], armature[:, 6:9], armature[:, 15:18]

    def dot(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.asarray(np.sum(a * b, axis=-1))

    q = dot(primary, normal) - dot(primary, secondary) * dot(normal, secondary)
    keyhole = np.arctan2(dot(primary, np.cross(secondary, normal)), q)
    limited = np.isfinite(low[:, 1]) & np.isfinite(high[:, 1])
    ends = np.where(limited, low[:, 1], 0.0), np.where(limited, high[:, 1], 0.0)
    from_home = np.sin(0.5 * (ends[0] + ends[1]) - keyhole)
    side = np.sin(angles[..., 1] - keyhole[:, None]) * from_home[:, None]
    return np.asarray((side < 0.0) & (np.abs(from_home) > _SIDE)[:, None])


def _cheapest(choices: _Choices, start: FloatArray | None, top_cost: float) -> npt.NDArray[np.intp]:
    """Return the states of the path with the least cost, (T, N)."""
    steps, rows = choices.angles.shape[:2]
    branch = choices.turns[:, 0]
    other = branch[:, None] != branch
    back = np.zeros((steps, rows, len(branch)), dtype=np.int16)
    cost, before = np.zeros((rows, len(branch))), None
    for t in range(steps):
        angles, exists = choices.at(t)
        price = np.where(exists, 0.0, np.inf)
        price = price + _MISS * ~choices.able[t][:, branch] + top_cost * choices.top[t][:, branch]
        # Only avoidable costs count, because rounding in large sums would hide the motion.
        price = price - price.min(axis=-1, keepdims=True)
        if before is None:
            if start is not None:
                moved = np.abs(choices.steps(start[:, None], angles)).max(axis=-1)
                cost = np.nan_to_num(moved)
            cost = cost + price
        else:
            turn = np.abs(choices.steps(before[:, :, None], angles[:, None])).max(axis=-1)
            turn = np.nan_to_num(turn)
            total = cost[:, :, None] + turn + _SLEW * (other | (turn > np.pi + 1e-9))
            back[t] = np.argmin(total, axis=1)
            cost = np.take_along_axis(total, back[t][:, None].astype(np.intp), axis=1)[:, 0] + price
        before = angles
    states = np.empty((steps, rows), dtype=np.intp)
    if steps:
        states[-1] = np.argmin(cost, axis=-1)
    for t in range(steps - 1, 0, -1):
        states[t - 1] = np.take_along_axis(back[t], states[t][:, None], axis=1)[:, 0]
    return states


def _slews(
    choices: _Choices,
    angles: FloatArray,
    branch: npt.NDArray[np.int8],
    normal: FloatArray,
    sun: FloatArray,
) -> tuple[Slew, ...]:
    """Return the steps that change the branch, go back by a turn, or do not follow the sun."""
    turn = np.diff(angles, axis=0)
    changed = np.asarray(np.diff(branch, axis=0) != 0)
    whole = np.asarray((np.abs(turn) > np.pi + 1e-9).any(axis=-1))
    shift = angle_between(normal[1:], normal[:-1])
    strays = shift > _FOLLOWS * angle_between(sun[1:], sun[:-1]) + _SLACK
    slews = []
    for step, row in np.argwhere(changed | whole | strays):
        before = choices.top[step, row, branch[step, row]]
        after = choices.top[step + 1, row, branch[step + 1, row]]
        if changed[step, row]:
            reason = "to the other branch"
            if before != after:
                reason = "over the top" if after else "back from over the top"
        elif whole[step, row]:
            joint = int(np.argmax(np.abs(turn[step, row])))
            reason = f"joint {joint + 1} turns back by a whole turn at its stop"
        else:
            reason = "between a pose at a stop and one that follows the sun"
        slews.append(Slew(int(step) + 1, int(row), turn[step, row], reason))
    return tuple(slews)
