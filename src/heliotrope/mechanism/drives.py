r"""Drives: conversion from motor counts to a joint angle, and back.

A drive converts counts into an ideal angle φ, and φ into the joint angle

$$θ = bias + (1 + scale)\,φ + worm_{cos} \cos u + worm_{sin} \sin u + sag \cos(φ + phase)$$

where u is the worm angle (a known ratio times φ, or times the stroke of a jack). For a rotary drive
φ is linear in the counts. For a linear drive (jack) the law of cosines holds in the triangle formed
by the joint, the fixed end and the moving end:

$$Φ(L) = \arccos\frac{c^2 + r^2 - L^2}{2 c r}, \qquad
φ = φ_0 + σ\,(Φ(k) - Φ(k + counts \cdot rate))$$

The literature describes a linear drive in three equivalent ways: PAINT (`linear_paint`), Grigoriev
et al. 2021 (`linear_grigoriev`) and Guo et al. 2013, (41)-(42) (`linear_guo`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, shown
from heliotrope.frames import Framed, Labelled, Variable, batch_rows
from heliotrope.geometry import (
    MOST_TURNS,
    TAU,
    FloatArray,
    as_angles,
    as_float,
    as_numbers,
    common_batch,
)
from heliotrope.jit import as_input
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.kernels.drives import angles_block, counts_block, slopes_block
from heliotrope.parallel import run_blocks
from heliotrope.values import Card, Value, span


@dataclass(frozen=True, eq=False, repr=False)
class Drive(Value, Framed):
    """One drive, or an array of drives, which may be of different kinds.

    Attributes
    ----------
    table
        Shape (..., 19), the numbers that the kernels read. Build them with `rotary`, `direct`,
        `linear_paint`, `linear_grigoriev` or `linear_guo`.
    """

    table: FloatArray

    def _card(self) -> Card:
        rows = [
            (name, span(self.table[..., place], *_SHOWN[name]))
            for name, place in SLOTS.items()
            if name != "initial_angle" and np.isfinite(self.table[..., place]).any()
        ]
        size = "" if not self.shape else f"{' × '.join(map(str, self.shape))} "
        return Card(f"{size}{self.kinds}, {self.describe()}", ("number", "value"), rows)

    def _labelled(self) -> Labelled:
        rows = batch_rows(self.shape)
        return Labelled(tuple(rows), rows, self.variables(tuple(rows)))

    def variables(self, axes: tuple[str, ...]) -> dict[str, Variable]:
        """Return the constants by name for a data frame; ``axes`` names the batch axes."""
        table = self.table if self.shape else self.table[None]
        rotary = table[..., slot.KIND] == slot.ROTARY
        variables = {"kind": Variable(axes, np.where(rotary, "rotary", "jack"))}
        for name, place in SLOTS.items():
            if name != "initial_angle":
                variables[name] = Variable(axes, table[..., place], _UNITS.get(name, ""))
        return variables

    @property
    def kinds(self) -> str:
        """The kinds of drives present: "rotary", "jack" or "rotary and jack"."""
        codes = self.table[..., slot.KIND]
        names = {"rotary": slot.ROTARY, "jack": slot.LINEAR}
        return " and ".join(name for name, kind in names.items() if (codes == kind).any())

    def describe(self) -> str:
        """Describe the step size and the stops in one line, for display."""
        rotary = self.table[..., slot.KIND] == slot.ROTARY
        rate = np.abs(self.table[..., slot.RATE])
        steps = [
            span(rate[chosen], 1e6, f"{unit} a count")
            for chosen, unit in ((rotary, "µrad"), (~rotary, "µm"))
            if chosen.any()
        ]
        stops = self.table[..., [slot.MIN_ANGLE, slot.MAX_ANGLE]]
        if np.isfinite(stops).any():
            steps.append(f"stops {span(stops, *_SHOWN['min_angle'])}")
        return ", ".join(steps)

    @property
    def shape(self) -> tuple[int, ...]:
        """The batch shape."""
        return self.table.shape[:-1]

    def __getitem__(self, index: int) -> "Drive":
        """Return the drive at ``index`` of the last batch axis."""
        return Drive(self.table[..., index, :])

    def angles(self, counts: npt.ArrayLike) -> FloatArray:
        """Return the joint angles in radians at given motor counts, both of shape (...)."""
        return self._run(angles_block, counts, "counts")

    def counts(self, angles: npt.ArrayLike) -> FloatArray:
        """Return the counts (real numbers) at joint angles in radians, both of shape (...).

        The result is exact to 1e-9 rad, with all periodic terms included. For an angle beyond the
        reach of a jack, the result is the counts at the end of its travel.
        """
        return self._run(counts_block, angles, "angles")

    def radians_per_count(self, counts: npt.ArrayLike) -> FloatArray:
        """Return the derivative dθ/dcounts, shape (...)."""
        return self._run(slopes_block, counts, "counts")

    def replace(self, **values: npt.ArrayLike) -> "Drive":
        """Return a drive with some of its constants replaced, by their names in ``SLOTS``.

        Raises
        ------
        InputError
            If a name is not in ``SLOTS``, or a value is out of range.
        """
        for name in values:
            if name not in SLOTS:
                raise InputError(f"drive: there is no {name!r}; known: {', '.join(SLOTS)}")
        numbers = {name: _number(value, name) for name, value in values.items()}
        shapes = {name: value.shape for name, value in numbers.items()}
        shape = common_batch({"drive": self.shape, **shapes})
        table = np.array(np.broadcast_to(self.table, (*shape, slot.DRIVE_SLOTS)))
        for name, value in numbers.items():
            table[..., SLOTS[name]] = value
        return _checked(Drive(table))

    def _run(self, block: Any, values: npt.ArrayLike, what: str) -> FloatArray:
        array = as_numbers(values, f"drive: {what}")
        shape = common_batch({"drive": self.shape, what: array.shape})
        rows = as_input(
            np.broadcast_to(np.arange(_size(self.shape)).reshape(self.shape), shape)
        ).reshape(-1)
        flat = as_input(np.broadcast_to(array, shape)).reshape(-1, 1)
        table = as_input(self.table).reshape(-1, 1, slot.DRIVE_SLOTS)
        out = np.empty(flat.shape)
        run_blocks(lambda a, b: block(table, flat, rows, out, a, b), len(rows))
        return out.reshape(shape)


#: Names of a drive's constants, for `Drive.replace` and the parameter table.
SLOTS = {
    "zero": slot.ZERO,
    "initial_angle": slot.ZERO,
    "rate": slot.RATE,
    "stroke_offset": slot.STROKE,
    "offset": slot.OFFSET,
    "pivot_radius": slot.RADIUS,
    "bias": slot.BIAS,
    "scale": slot.SCALE,
    "worm_cos": slot.WORM_COS,
    "worm_sin": slot.WORM_SIN,
    "worm_ratio": slot.WORM_RATIO,
    "sag": slot.SAG,
    "sag_phase": slot.SAG_PHASE,
    "min_angle": slot.MIN_ANGLE,
    "max_angle": slot.MAX_ANGLE,
    "min_count": slot.MIN_COUNT,
    "max_count": slot.MAX_COUNT,
    "speed": slot.SPEED,
}


_DEGREES, _MRAD, _METRES = (float(np.degrees(1.0)), "°"), (1e3, "mrad"), (1.0, "m")
#: Scale and unit in which each number is shown.
_SHOWN = {
    **dict.fromkeys(SLOTS, (1.0, "")),
    **dict.fromkeys(("zero", "sag_phase", "min_angle", "max_angle"), _DEGREES),
    **dict.fromkeys(("bias", "worm_cos", "worm_sin", "sag"), _MRAD),
    **dict.fromkeys(("stroke_offset", "offset", "pivot_radius"), _METRES),
    "rate": (1e6, "µrad or µm a count"),
    "speed": (1.0, "counts/s"),
}
#: Unit of each number in a frame; a jack's rate is in metres.
_UNITS = {
    **dict.fromkeys(("zero", "bias", "worm_cos", "worm_sin", "sag", "sag_phase"), "rad"),
    **dict.fromkeys(("min_angle", "max_angle"), "rad"),
    **dict.fromkeys(("stroke_offset", "offset", "pivot_radius"), "m"),
    "rate": "rad or m",
    "speed": "1/s",
}
#: Name of each number in error messages.
_NAMES = {index: name for name, index in SLOTS.items()} | {
    slot.KIND: "kind",
    slot.SENSE: "sense",
}


def _size(shape: tuple[int, ...]) -> int:
    return int(np.prod(shape, dtype=np.int64))


_ANGLES = ("zero", "initial_angle", "bias", "worm_cos", "worm_sin", "sag", "sag_phase")
_STOPS = ("min_angle", "max_angle")


def _number(value: npt.ArrayLike, name: str) -> FloatArray:
    """Return a checked drive constant.

    Angles must be in radians; stops may be infinite.
    """
    if name in _ANGLES:
        return as_angles(value, f"drive: {name}", MOST_TURNS)
    number = as_numbers(value, f"drive: {name}")
    if name in _STOPS:
        as_angles(np.where(np.isinf(number), 0.0, number), f"drive: {name}", MOST_TURNS)
    return number


def _build(kind: float, numbers: dict[int, npt.ArrayLike]) -> Drive:
    numbers = {
        slot.KIND: kind,
        slot.MIN_ANGLE: -np.inf,
        slot.MAX_ANGLE: np.inf,
        slot.MIN_COUNT: -np.inf,
        slot.MAX_COUNT: np.inf,
        slot.SPEED: np.inf,
        **numbers,
    }
    arrays = {index: _number(value, _NAMES[index]) for index, value in numbers.items()}
    shape = common_batch({_NAMES[index]: value.shape for index, value in arrays.items()})
    table = np.zeros((*shape, slot.DRIVE_SLOTS))
    for index, value in arrays.items():
        table[..., index] = value
    return _checked(Drive(table))


def _checked(drive: Drive) -> Drive:
    """Return the drive if its numbers describe a drive that can move.

    Raises
    ------
    InputError
        If stops are reversed, a rate is zero or a jack's triangle cannot close.
    """
    t = drive.table
    rate = t[..., slot.RATE]
    if (rate == 0.0).any() or not np.isfinite(rate).all():
        raise InputError(
            "drive: the angle (or stroke) per count is 0 or infinite; specify the counts"
        )
    for low, high, what in (
        (slot.MIN_ANGLE, slot.MAX_ANGLE, "angle"),
        (slot.MIN_COUNT, slot.MAX_COUNT, "count"),
    ):
        reversed_ = t[..., low] > t[..., high]
        if reversed_.any():
            i = tuple(np.argwhere(reversed_)[0])
            raise InputError(
                f"drive: lower {what} stop {t[i][low]:g} is above the upper stop {t[i][high]:g}; "
                "swap them"
            )
    if (t[..., slot.SPEED] <= 0.0).any():
        raise InputError("drive: speed must be above 0 counts per second")
    if (np.abs(1.0 + t[..., slot.SCALE]) < 1e-3).any():
        raise InputError("drive: scale −1 makes the drive stand still; use a scale near 0")
    _check_triangles(t[t[..., slot.KIND] == slot.LINEAR])
    _check_monotone(t)
    return drive


def _check_triangles(jacks: FloatArray) -> None:
    c, r, k = jacks[:, slot.OFFSET], jacks[:, slot.RADIUS], jacks[:, slot.STROKE]
    invalid = (c <= 0) | (r <= 0) | (k <= np.abs(c - r)) | (k >= c + r)
    if invalid.any():
        i = int(np.flatnonzero(invalid)[0])
        raise InputError(
            f"linear drive: offset {c[i]:g} m, pivot radius {r[i]:g} m and initial stroke "
            f"length {k[i]:g} m do not form a triangle; the stroke must lie between "
            f"{abs(c[i] - r[i]):g} m and {c[i] + r[i]:g} m"
        )


def _check_monotone(t: FloatArray) -> None:
    """Reject periodic terms so large that several counts produce the same angle."""
    rotary = t[..., slot.KIND] == slot.ROTARY
    worm = np.hypot(t[..., slot.WORM_COS], t[..., slot.WORM_SIN]) * np.abs(t[..., slot.WORM_RATIO])
    swing = (worm + np.abs(t[..., slot.SAG])) / np.abs(1.0 + t[..., slot.SCALE])
    if (rotary & (swing >= 1.0)).any():
        raise InputError(
            f"drive: worm amplitude times ratio is {swing.max():g}, so the drive would run "
            "backwards within a turn; it must stay below 1"
        )


def direct(**values: npt.ArrayLike) -> Drive:
    """Return a drive whose counts are the joint angle itself in radians."""
    return _build(slot.ROTARY, {slot.RATE: 1.0}).replace(**values)


def rotary(
    steps_per_turn: npt.ArrayLike,
    gear_ratio: npt.ArrayLike,
    *,
    microsteps: npt.ArrayLike = 1,
    zero: npt.ArrayLike = 0.0,
    sense: npt.ArrayLike = 1,
    **values: npt.ArrayLike,
) -> Drive:
    """Return a stepper or encoder drive with a gear.

    Parameters
    ----------
    steps_per_turn
        Full steps (or encoder counts) per motor revolution.
    gear_ratio
        Motor revolutions per revolution of the joint.
    microsteps
        Counts per full step.
    zero
        Angle at 0 counts, rad.
    sense
        +1 if the angle increases with the counts, −1 if it decreases.
    values
        Any further constants of ``SLOTS``: bias, scale, worm_cos, worm_sin, worm_ratio, sag, stops,
        speed.

    Raises
    ------
    InputError
        If a drive with these constants could not move.
    """
    steps, micro = (
        as_numbers(steps_per_turn, "steps_per_turn"),
        as_numbers(microsteps, "microsteps"),
    )
    per_turn = steps * micro * as_numbers(gear_ratio, "gear_ratio")
    if not (np.isfinite(per_turn) & (per_turn > 0)).all():
        raise InputError(
            "rotary drive: steps, microsteps and gear ratio must be above 0 and finite, not "
            f"{shown(steps_per_turn)} × {shown(microsteps)} × {shown(gear_ratio)}"
        )
    _check_sense(sense)
    rate = as_float(sense) * TAU / per_turn
    return _build(slot.ROTARY, {slot.RATE: rate, slot.ZERO: zero}).replace(**values)


def linear_paint(
    increment: npt.ArrayLike,
    initial_stroke_length: npt.ArrayLike,
    offset: npt.ArrayLike,
    pivot_radius: npt.ArrayLike,
    initial_angle: npt.ArrayLike,
    *,
    clockwise: npt.ArrayLike = 1,
    **values: npt.ArrayLike,
) -> Drive:
    """Return a linear drive (jack) from the constants in PAINT's heliostat properties.

    Parameters
    ----------
    increment
        Counts per metre of stroke.
    initial_stroke_length
        k, distance between the ends of the actuator at 0 counts, m.
    offset, pivot_radius
        c and r, the two fixed sides of the triangle, m.
    initial_angle
        θ₀, angle at 0 counts, rad.
    clockwise
        σ = +1 where ``clockwise_axis_movement`` is 1, else −1.
    values
        Any further constants of ``SLOTS``.
    """
    counts_per_metre = as_numbers(increment, "increment")
    if not (np.isfinite(counts_per_metre) & (counts_per_metre != 0)).all():
        raise InputError(
            f"linear drive: increment must not be 0, but is {shown(increment)} counts per metre"
        )
    sense = np.where(as_float(clockwise) == 1, 1.0, -1.0)
    return _build(
        slot.LINEAR,
        {
            slot.RATE: 1.0 / counts_per_metre,
            slot.STROKE: initial_stroke_length,
            slot.OFFSET: offset,
            slot.RADIUS: pivot_radius,
            slot.ZERO: initial_angle,
            slot.SENSE: sense,
        },
    ).replace(**values)


def linear_grigoriev(
    side_a: npt.ArrayLike,
    side_b: npt.ArrayLike,
    length_at_zero: npt.ArrayLike,
    metres_per_count: npt.ArrayLike,
    *,
    angle_zero: npt.ArrayLike = 0.0,
    sense: npt.ArrayLike = 1,
    **values: npt.ArrayLike,
) -> Drive:
    """Return a linear drive (jack) that follows θ = angle_zero + sense · Φ(L).

    Parameters
    ----------
    side_a, side_b
        Distances from the joint to the ends of the actuator, m.
    length_at_zero
        Length of the actuator at 0 counts, m.
    metres_per_count
        Change in actuator length per count, m.
    angle_zero
        Joint angle at which the two sides coincide, rad.
    sense
        +1 if the angle increases with the length.
    values
        Any further constants of ``SLOTS``.

    Notes
    -----
    Grigoriev et al. 2021 (HelioK) measure the angle from the folded triangle, whereas PAINT
    measures it from the position at 0 counts. The two angle origins differ by Φ(length_at_zero).
    """
    _check_sense(sense)
    a, b = as_numbers(side_a, "side_a"), as_numbers(side_b, "side_b")
    length = as_numbers(length_at_zero, "length_at_zero")
    jack = _build(
        slot.LINEAR,
        {
            slot.RATE: metres_per_count,
            slot.STROKE: length,
            slot.OFFSET: a,
            slot.RADIUS: b,
            slot.SENSE: -as_float(sense),
        },
    )
    folded = np.arccos((a**2 + b**2 - length**2) / (2.0 * a * b))
    return jack.replace(
        zero=as_angles(angle_zero, "angle_zero", MOST_TURNS) + as_float(sense) * folded
    ).replace(**values)


def linear_guo(
    side_a: npt.ArrayLike,
    side_b: npt.ArrayLike,
    slope: npt.ArrayLike,
    length_at_zero: npt.ArrayLike,
    metres_per_count: npt.ArrayLike,
    **values: npt.ArrayLike,
) -> Drive:
    """Return the screw drive of an elevation axis from the constants in Guo's figure 3.

    Parameters
    ----------
    side_a
        a, distance OA from the axis to the moving end of the screw, m.
    side_b
        b, distance OB from the axis to its fixed end, m.
    slope
        β₀, slope of OB from the horizontal, rad.
    length_at_zero
        x₀, length of the screw at 0 counts, m.
    metres_per_count
        Change in screw length per count, m; Guo's x is this value times the counts.
    values
        Any further constants of ``SLOTS``.

    Notes
    -----
    Guo et al. 2013, (41)-(42) as printed: x = √(a² + b² + 2ab cos(α + β₀)) − x₀. The angle AOB is
    180° − α − β₀, so the screw gets shorter as the mirror rises. For a screw that gets longer use
    `linear_grigoriev`.
    """
    zero = np.pi - as_angles(slope, "slope", np.pi)
    return linear_grigoriev(
        side_a, side_b, length_at_zero, metres_per_count, angle_zero=zero, sense=-1, **values
    )


def _check_sense(sense: npt.ArrayLike) -> None:
    if not np.isin(as_numbers(sense, "drive: sense"), (-1.0, 1.0)).all():
        raise InputError(f"drive: sense must be +1 or −1, not {shown(sense)}")
