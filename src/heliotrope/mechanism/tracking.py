"""Tracking: the drive positions at which the beam reaches its aim.

Global aiming sends light from a direction (the sun) to a point in the field; local aiming sends the
light to a point that is fixed to the mirror (dish, CPV, trough). Both work on the armature, and
therefore apply to every mechanism and every error model.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, kind_of, require, shown
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.geometry import FloatArray, as_numbers, as_vectors, normalize, reflect
from heliotrope.jit import as_input
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive, direct
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.kernels.block import track_block
from heliotrope.mechanism.kernels.track import (
    BEHIND,
    DEGENERATE,
    NOT_CONVERGED,
    OK,
    STOPPED,
    UNREACHABLE,
)
from heliotrope.parallel import run_blocks
from heliotrope.values import Card, Value, amount, span

Branch = Literal["both", 0, 1]


class Steered(Protocol):
    """Any object with axes and drives: mechanisms, one or several heliostats, a plant."""

    @property
    def armature(self) -> Armature:
        """Armature, batch shape (...)."""

    @property
    def drives(self) -> Drive:
        """Drives, batch shape (..., D)."""

    @property
    def attachment(self) -> FloatArray:
        """Transforms from heliostat frames to ENU for points fixed to the mirrors, (..., 4, 4)."""


class TrackingStatus(IntEnum):
    """Outcome of a solution."""

    OK = OK
    UNREACHABLE = UNREACHABLE
    STOPPED = STOPPED
    NOT_CONVERGED = NOT_CONVERGED
    DEGENERATE = DEGENERATE
    BEHIND = BEHIND

    @property
    def text(self) -> str:
        """Meaning of the status, in one clause."""
        return _TEXTS[self]


_TEXTS = {
    TrackingStatus.OK: "the beam reaches its aim",
    TrackingStatus.UNREACHABLE: "the axes cannot turn the mirror there; this is the nearest pose",
    TrackingStatus.STOPPED: "a stop is in the way; this is the nearest pose within the stops",
    TrackingStatus.NOT_CONVERGED: "the iteration did not converge; do not use this pose",
    TrackingStatus.DEGENERATE: (
        "no mirror can reflect the beam there: source and aim are opposite, or the aim is in "
        "the mirror"
    ),
    TrackingStatus.BEHIND: "the aim is fixed behind the mirror or in its plane, where no beam goes",
}


@dataclass(frozen=True, eq=False, repr=False)
class Tracking(Value, Framed):
    """Solutions on one or both branches; there are B branches and D drives.

    Attributes
    ----------
    angles
        Joint angles, rad, (..., B, D).
    counts
        Drive counts, real numbers, (..., B, D).
    normal, vertex
        Pose of the mirror, ENU, (..., B, 3).
    status
        `TrackingStatus` as integers, (..., B).
    residual
        Angle between the normal and the required normal, rad, (..., B).
    iterations
        (..., B).
    best
        The selected branch, (...): the branch that reaches the aim with the least motion from the
        current counts or, if none does, the branch with the smallest residual.
    """

    angles: FloatArray
    counts: FloatArray
    normal: FloatArray
    vertex: FloatArray
    status: npt.NDArray[np.int8]
    residual: FloatArray
    iterations: npt.NDArray[np.int32]
    best: npt.NDArray[np.int8]

    def _labelled(self) -> Labelled:
        batch = self.best.shape
        row = tuple(f"axis_{k}" for k in range(len(batch))) or ("row",)

        def of(values: npt.ArrayLike) -> np.ndarray:
            array = np.asarray(values)
            return array if batch else array[None]

        return Labelled(
            row,
            {
                **{name: np.arange(n) for name, n in zip(row, batch or (1,), strict=True)},
                "branch": np.arange(self.angles.shape[-2]),
                "joint": np.arange(1, self.angles.shape[-1] + 1),
                "axis": ENU,
            },
            {
                "angle": Variable((*row, "branch", "joint"), of(self.angles), "rad"),
                "count": Variable((*row, "branch", "joint"), of(self.counts)),
                "normal": Variable((*row, "branch", "axis"), of(self.normal)),
                "vertex": Variable((*row, "branch", "axis"), of(self.vertex), "m"),
                "residual": Variable((*row, "branch"), of(self.residual), "rad"),
                "served": Variable((*row, "branch"), of(self.served)),
                "best": Variable(row, of(self.best)),
            },
        )

    def _card(self) -> Card:
        best = self.chosen(self.status)
        counted = [(s.name.lower(), s.text, int((best == s).sum())) for s in TrackingStatus]
        present = [(name, text, str(count)) for name, text, count in counted if count]
        angles = np.degrees(self.chosen(self.angles))
        rows = [
            (f"drive {d + 1}", f"{span(angles[..., d])} °", span(self.chosen(self.counts)[..., d]))
            for d in range(angles.shape[-1])
        ]
        size = " × ".join(map(str, best.shape)) or "one"
        line = f"{size} of {amount(self.status.shape[-1], 'branch').replace('chs', 'ches')}: "
        line += ", ".join(f"{count} {name}" for name, _, count in present)
        return Card(line, ("best branch", "angle or meaning", "counts"), [*rows, *present])

    @property
    def served(self) -> npt.NDArray[np.bool_]:
        """Whether the beam reaches its aim on each branch, (..., B)."""
        return np.asarray(self.status == TrackingStatus.OK)

    @property
    def reachable(self) -> npt.NDArray[np.bool_]:
        """Whether the beam reaches its aim on the best branch, (...)."""
        return np.asarray(self.chosen(self.served))

    @property
    def best_counts(self) -> FloatArray:
        """Drive counts of the best branch, (..., D)."""
        return np.asarray(self.chosen(self.counts))

    @property
    def best_angles(self) -> FloatArray:
        """Joint angles of the best branch, rad, (..., D)."""
        return np.asarray(self.chosen(self.angles))

    def chosen(self, values: np.ndarray) -> np.ndarray:
        """Return the best branch's part of one of the above arrays, (..., rest)."""
        extra = values.ndim - self.best.ndim - 1
        index = self.best.reshape(*self.best.shape, 1, *(1,) * extra).astype(np.intp)
        return np.take_along_axis(values, index, axis=self.best.ndim).squeeze(self.best.ndim)


def track(
    mechanism: Steered | Armature,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike,
    *,
    drives: Drive | None = None,
    current: npt.ArrayLike | None = None,
    branch: Branch = "both",
    local: bool = False,
    tolerance: float = 1e-9,
    max_iterations: int = 50,
    newton: bool = True,
) -> Tracking:
    """Return the drive positions that send light from the sun to the aim.

    All batch shapes broadcast: several heliostats with one sun vector, one heliostat with the sun
    vectors of a day, or sun vectors of batch shape (times, 1) with mechanisms (heliostats,).

    Parameters
    ----------
    mechanism
        Mechanisms; one or several heliostats or a plant, as calibrated; or armatures.
    sun
        Unit vectors to the source, ENU, (..., 3).
    aim
        Points in ENU metres, (..., 3); with ``local``, points fixed to the mirror, specified at
        zero joint angles in the heliostat frame (see `Mechanism.attachment`), or in the armature
        frame.
    drives
        Drives, batch shape (..., D); by default the mechanism's drives, or radians for an armature.
    current
        Present counts, (..., D). The counts select between the branches and between angles that
        differ by a revolution; without them the middle of the stops is used.
    branch
        "both", or the only branch to solve (0: −, 1: + in Paden-Kahan), which takes half the time.
    local
        Whether the aim is a point fixed to the mirror (Grigoriev et al. 2021, "Local aiming").
    tolerance
        Largest allowed miss distance of the beam at the aim, m.
    max_iterations
        Maximum number of fixed-point steps.
    newton
        Whether to switch to Newton's method where the fixed-point iteration converges slowly.

    Returns
    -------
    For an aim that cannot be reached, the result is the nearest pose; ``status`` and ``residual``
    report this, and no exception is raised.

    Raises
    ------
    InputError
        If an input is not finite, a sun vector is not a unit vector, or shapes do not fit.

    Notes
    -----
    Grigoriev et al. 2021, (3)-(9). The fixed-point iteration on the vertex contracts by about
    offset / (2 · slant · sin ζ), where ζ is the angle from the primary axis. Where a step reduces
    the error by less than a factor of 3.3, Newton's method with the screw derivative takes over.
    """
    armature, table = _tables(mechanism, drives)
    s, p = as_vectors(sun, "sun"), as_vectors(aim, "aim")
    if (np.abs(np.sum(s * s, axis=-1) - 1.0) > 1e-6).any():
        raise InputError("sun: a vector's length differs from 1 by more than 5e-7; normalise it")
    if branch not in ("both", 0, 1):
        raise InputError(f"branch must be 'both', 0 or 1, not {shown(branch)}")
    _check_settings(tolerance, max_iterations)
    for name, value in (("local", local), ("newton", newton)):
        require(name, value, (bool, np.bool_), "True or False")
    axes = table.shape[-2]
    now = None if current is None else _current(current, axes)
    batches = [armature.shape, table.shape[:-2], s.shape[:-1], p.shape[:-1]]
    batches += [] if now is None else [now.shape[:-1]]
    try:
        shape = np.broadcast_shapes(*batches)
    except ValueError:
        raise InputError(
            f"shapes of mechanism {armature.shape}, sun {s.shape[:-1]}, aim {p.shape[:-1]} and "
            "current counts do not fit together"
        ) from None
    if local and not isinstance(mechanism, Armature):
        frame = mechanism.attachment
        p = np.einsum("...ij,...j->...i", frame[..., :3, :3], p) + frame[..., :3, 3]
        batches[3] = p.shape[:-1]
    rows = int(np.prod(shape, dtype=np.int64))
    index = np.full((rows, 5), -1, dtype=np.int64)
    for column, batch in enumerate(batches):
        place = np.arange(int(np.prod(batch, dtype=np.int64))).reshape(batch)
        index[:, column] = np.broadcast_to(place, shape).ravel()
    many = 2 if branch == "both" else 1
    result = Tracking(
        angles=np.empty((rows, many, axes)),
        counts=np.empty((rows, many, axes)),
        normal=np.empty((rows, many, 3)),
        vertex=np.empty((rows, many, 3)),
        status=np.empty((rows, many), dtype=np.int8),
        residual=np.empty((rows, many)),
        iterations=np.empty((rows, many), dtype=np.int32),
        best=np.empty(rows, dtype=np.int8),
    )
    arguments = (
        _flat(armature.table, slot.ARMATURE_SIZE), _flat(table, axes, slot.DRIVE_SLOTS),
        _flat(s, 3), _flat(p, 3), _flat(np.empty((0, axes)) if now is None else now, axes),
        index, local, 2 if branch == "both" else int(branch), float(tolerance),
        int(max_iterations), newton, result.angles, result.counts, result.normal, result.vertex,
        result.status, result.iterations, result.residual, result.best,
    )  # fmt: skip
    run_blocks(lambda a, b: track_block(*arguments, a, b), rows)
    return Tracking(
        **{name: array.reshape((*shape, *array.shape[1:])) for name, array in vars(result).items()}
    )


@dataclass(frozen=True)
class TraceStep:
    """A step of the fixed-point iteration (Grigoriev et al. 2021, "Global aiming").

    Attributes
    ----------
    iteration
        Number of the iteration, from 1.
    branch
        Branch, 0 or 1.
    angles
        Joint angles, rad, (D,).
    miss
        Lateral distance of the reflected ray from the aim point at these angles, m; for a single
        axis, measured in the plane perpendicular to it.
    """

    iteration: int
    branch: int
    angles: FloatArray
    miss: float


def trace(
    mechanism: Steered | Armature,
    sun: npt.ArrayLike,
    aim: npt.ArrayLike,
    *,
    drives: Drive | None = None,
    tolerance: float = 1e-9,
    most: int = 50,
) -> tuple[TraceStep, ...]:
    """Return the steps in which both branches converge on an aim, without Newton and stops.

    A branch ends when its miss is below the tolerance or no longer decreases.

    Parameters
    ----------
    mechanism, sun, aim, drives
        As for `track`, with batch shape ().
    tolerance
        Miss at which a branch ends, m.
    most
        Maximum number of iterations.

    Raises
    ------
    InputError
        As for `track`, or if there is more than one heliostat.
    """
    armature, table = _tables(mechanism, drives)
    if armature.shape or np.ndim(sun) != 1 or np.ndim(aim) != 1:
        raise InputError("trace: pass one heliostat, one sun and one aim")
    s, p = as_vectors(sun, "sun"), as_vectors(aim, "aim")
    free = direct().table
    free_drives = Drive(table).replace(
        min_angle=free[slot.MIN_ANGLE], max_angle=free[slot.MAX_ANGLE]
    )
    steps: list[TraceStep] = []
    single = table.shape[-2] == 1
    along = armature.axis_1 if single else np.zeros(3)
    flat = np.eye(3) - np.outer(along, along)
    light = normalize(flat @ s, "sun across the axis")
    for branch in range(1 if single else 2):  # the branches of a single axis are the same
        before = np.inf
        for k in range(1, most + 1):
            # A tolerance that no step reaches, so that each step is made.
            solution = track(
                armature, s, p, drives=free_drives, tolerance=1e-300, max_iterations=k, newton=False
            )
            normal, vertex = solution.normal[branch], solution.vertex[branch]
            ray = reflect(light, normalize(flat @ normal))
            miss = float(np.linalg.norm(np.cross(flat @ (p - vertex), ray)))
            steps.append(TraceStep(k, branch, solution.angles[branch], miss))
            if miss < tolerance or miss > 0.999 * before:
                break
            before = miss
    return tuple(steps)


def _tables(mechanism: Steered | Armature, drives: Drive | None) -> tuple[Armature, FloatArray]:
    steered = isinstance(getattr(mechanism, "drives", None), Drive)
    if not isinstance(mechanism, Armature) and not steered:
        raise InputError(
            f"mechanism: {kind_of(mechanism)} cannot be tracked; pass a Mechanism, plant[name], a "
            "group, a plant, or an Armature with drives"
        )
    if drives is not None and not isinstance(drives, Drive):
        raise InputError(
            f"drives: {kind_of(drives)} is not a Drive; pass one of batch shape (..., D)"
        )
    if isinstance(mechanism, Armature):
        armature = mechanism
        # A single-axis tracker has no second axis; an empty array shows nothing.
        single = armature.axis_2.size > 0 and not armature.axis_2.any()
        own = np.stack([direct().table] * (1 if single else 2))
    else:
        armature, own = mechanism.armature, mechanism.drives.table
    table = own if drives is None else drives.table
    axes = own.shape[-2]
    if table.ndim < 2 or table.shape[-2] != axes:
        raise InputError(
            f"drives: batch shape {table.shape[:-1]}; its last axis must be {axes}, the drives"
        )
    return armature, table


def _check_settings(tolerance: float, max_iterations: int) -> None:
    numbers = as_numbers([tolerance, max_iterations], "tolerance and max_iterations")
    if not (np.isfinite(numbers[0]) and numbers[0] > 0 and numbers[1] >= 1):
        raise InputError(
            f"tolerance and max_iterations must be above 0, not {tolerance} m and {max_iterations}"
        )


def _current(current: npt.ArrayLike, axes: int) -> FloatArray:
    counts = as_numbers(current, "current")
    if counts.ndim == 0 or counts.shape[-1] != axes or not np.isfinite(counts).all():
        raise InputError(
            f"current: shape {counts.shape}; pass finite counts of the {axes} drives, (..., {axes})"
        )
    return counts


def _flat(array: FloatArray, *tail: int) -> FloatArray:
    return as_input(array).reshape(-1, *tail)
