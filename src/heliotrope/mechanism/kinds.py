"""Builders for the kinds of mechanism used in heliostats.

Every two-axis kind is the same chain with different axes::

    position, orientation
      two tilts of the primary axis            (fixed)
      primary axis                             (driven)
      non-orthogonality                        (fixed)
      secondary axis                           (driven)
      canting, canting_secondary               (fixed)
    vertex, normal
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError, kind_of
from heliotrope.geometry import (
    MOST_TURNS,
    FloatArray,
    as_angles,
    as_float,
    as_numbers,
    as_vectors,
    common_batch,
    normalize,
)
from heliotrope.mechanism.armature import Armature, check_axes
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import Drive, direct
from heliotrope.mechanism.parameters import Parameter

EAST, NORTH, UP = np.eye(3)
_LEANS = {"east": EAST, "north": NORTH, "up": UP}
#: Longest distance within a heliostat, m; a number in millimetres is mostly larger.
_LONGEST = 1000.0


def two_axis(
    position: npt.ArrayLike,
    axis_1: npt.ArrayLike,
    axis_2: npt.ArrayLike,
    normal: npt.ArrayLike,
    *,
    kind: str = "two_axis",
    names: tuple[str, str] = ("primary", "secondary"),
    leans: tuple[str, str] | None = None,
    pole: npt.ArrayLike | None = None,
    origin_1: npt.ArrayLike = (0.0, 0.0, 0.0),
    origin_2: npt.ArrayLike = (0.0, 0.0, 0.0),
    arm: npt.ArrayLike = (0.0, 0.0, 0.0),
    vertex: npt.ArrayLike = (0.0, 0.0, 0.0),
    orientation: npt.ArrayLike | None = None,
    drives: tuple[Drive, Drive] | None = None,
) -> Mechanism:
    """Return mechanisms with two arbitrary axes (Grigoriev et al. 2021).

    Parameters
    ----------
    position
        Foot of the chain, ENU metres, (..., 3).
    axis_1, axis_2, normal
        Primary axis, secondary axis and mirror normal at zero angles, in the heliostat frame, (...,
        3), any length.
    kind, names
        Name of the kind, and names of the two driven joints.
    leans
        The two directions ("east", "north", "up") in which the primary axis can tilt; by default
        the two that are closest to perpendicular to the primary axis of the first mechanism.
    pole
        The end of the primary axis that the tilt names refer to; default ``axis_1``.
    origin_1
        Point on the primary axis, relative to the position, m.
    origin_2
        Point on the secondary axis, relative to ``origin_1``, m.
    arm
        Vector from ``origin_2`` to the point about which canting rotates the mirror, m.
    vertex
        Vector from that point to the mirror vertex, m; it rotates with the canting.
    orientation
        Rotation from the heliostat frame to ENU, (..., 3, 3); default identity.
    drives
        Primary and secondary drive; by default counts are radians.

    Raises
    ------
    InputError
        If a direction is zero, the axes are parallel, the normal is parallel to the secondary axis,
        the orientation is not a rotation, two joints have the same name, or a point is not a
        vector.
    UnknownNameError
        If ``leans`` contains an unknown direction.
    """
    p = as_vectors(position, "position")
    a1, a2 = normalize(axis_1, "axis_1"), normalize(axis_2, "axis_2")
    n = normalize(normal, "normal")
    check_axes(a1, a2)
    if (np.linalg.norm(np.cross(n, a2), axis=-1) < 1e-6).any():
        raise InputError(
            "normal: it is parallel to the secondary axis, so rotation about this axis would not "
            "change it"
        )
    end = a1 if pole is None else normalize(pole, "pole")
    lean_names = _lean_names(end) if leans is None else leans
    for name in lean_names:
        if name not in _LEANS:
            raise UnknownNameError("lean of the primary axis", str(name), _LEANS)
    lean_axes = [normalize(np.cross(end, _LEANS[name]), "tilt axis") for name in lean_names]
    steps: list[tuple[str, FloatArray, npt.ArrayLike]] = [
        (f"tilt_{lean_names[0]}", lean_axes[0], as_vectors(origin_1, "origin_1")),
        (f"tilt_{lean_names[1]}", lean_axes[1], 0.0),
        (names[0], a1, 0.0),
        (
            "non_orthogonality",
            normalize(np.cross(a2, a1), "axis"),
            as_vectors(origin_2, "origin_2"),
        ),
        (names[1], a2, 0.0),
        ("canting", normalize(np.cross(n, a2), "axis"), as_vectors(arm, "arm")),
        ("canting_secondary", a2, 0.0),
    ]
    return _assemble(kind, steps, (2, 4), p, orientation, drives, vertex, n)


def with_joint(
    mechanism: Mechanism,
    name: str,
    axis: npt.ArrayLike,
    *,
    prior: float,
    after: str | None = None,
    origin: npt.ArrayLike = (0.0, 0.0, 0.0),
    cause: str = "own joint",
) -> Mechanism:
    """Return mechanisms with an additional fixed joint and a parameter of the same name.

    No drive moves the joint. Its angle is 0 until `Mechanism.with_parameters` or a fit changes it,
    so that nothing else changes. Derivatives follow from the screw formula, as for every joint. A
    plant file keeps the joint, but not its entry in the parameter table.

    Parameters
    ----------
    mechanism
        Mechanisms, shape (...).
    name
        Name of the joint, unique among joints and parameters.
    axis
        Axis of the joint in the frame that the joint ``after`` rotates, (..., 3), any length;
        angles are right-handed about it.
    prior
        Standard deviation of the angle before any measurement, rad.
    after
        Joint that the new joint follows on the way from ground to mirror; None if the new joint is
        the first.
    origin
        Point on the axis, from the origin of ``after`` or from the position, m, (..., 3).
    cause
        Physical cause, for the parameter table.

    Raises
    ------
    UnknownNameError
        If there is no joint ``after``.
    InputError
        If the name is taken, the axis is zero, the prior is not an angle above 0, or a shape does
        not fit.
    """
    if after is not None and after not in mechanism.joints:
        raise UnknownNameError(f"joint of a {mechanism.kind} mechanism", after, mechanism.joints)
    if not name.isidentifier() or name in (*mechanism.joints, *mechanism.parameters):
        raise InputError(
            f"own joint {name!r}: choose a new name of letters, digits and underscores; the joints "
            f"are {', '.join(mechanism.joints)}"
        )
    sigma = as_numbers(prior, f"prior of {name}", 0.0, 0.5 * np.pi, "rad", "give radians")
    if sigma.shape or not sigma > 0.0:
        raise InputError(f"prior of {name} must be one number above 0, not {prior} rad")
    direction, point = normalize(axis, f"axis of {name}"), as_vectors(origin, f"origin of {name}")
    shapes = {
        "mechanism": mechanism.shape,
        "axis": direction.shape[:-1],
        "origin": point.shape[:-1],
    }
    if common_batch(shapes) != mechanism.shape:
        raise InputError(
            f"own joint {name}: axis {direction.shape} and origin {point.shape} do not fit "
            f"mechanisms of shape {mechanism.shape}; pass one vector, or one per mechanism"
        )
    place = 0 if after is None else mechanism.joints.index(after) + 1
    origins = np.insert(mechanism.origins, place, point, axis=-2)
    vertex = mechanism.vertex.copy()
    # The following joints stay where they are.
    if place == len(mechanism.joints):
        vertex -= point
    else:
        origins[..., place + 1, :] -= point
    return replace(
        mechanism,
        joints=(*mechanism.joints[:place], name, *mechanism.joints[place:]),
        driven=tuple(d + (d >= place) for d in mechanism.driven),
        axes=np.insert(mechanism.axes, place, direction, axis=-2),
        origins=origins,
        angles=np.insert(mechanism.angles, place, 0.0, axis=-1),
        vertex=vertex,
        own=(
            *mechanism.own,
            Parameter(name, "rad", cause, "right-handed about its axis", float(sigma)),
        ),
    )


def _lean_names(end: FloatArray) -> tuple[str, str]:
    first = end.reshape(-1, 3)[0]
    kept = np.argsort(np.abs(first), kind="stable")[:2]
    order = [("north", 1), ("east", 0), ("up", 2)]
    names = [name for name, i in order if i in kept]
    return names[0], names[1]


def _assemble(
    kind: str,
    steps: list[tuple[str, FloatArray, npt.ArrayLike]],
    driven: tuple[int, ...],
    position: FloatArray,
    orientation: npt.ArrayLike | None,
    drives: tuple[Drive, ...] | None,
    vertex: npt.ArrayLike,
    normal: FloatArray,
) -> Mechanism:
    joints = [step[0] for step in steps]
    for name in joints:
        if joints.count(name) > 1:
            raise InputError(
                f"names: two joints are called {name!r}; a joint's name is unique, because its "
                f"parameters are named after it; the joints are {', '.join(joints)}"
            )
    turned = np.eye(3) if orientation is None else as_numbers(orientation, "orientation")
    _check_rotation(turned)
    tables = _tables(drives, driven)
    v = as_vectors(vertex, "vertex")
    offsets = [as_float(step[2]) for step in steps]
    batches = {
        "position": position.shape[:-1],
        "orientation": turned.shape[:-2],
        "vertex": v.shape[:-1],
        "normal": normal.shape[:-1],
        **{f"axis of {step[0]}": step[1].shape[:-1] for step in steps},
        **{f"origin of {step[0]}": o.shape[:-1] for step, o in zip(steps, offsets, strict=True)},
        **{f"drive {k + 1}": t.shape[:-1] for k, t in enumerate(tables)},
    }
    shape = common_batch(batches)

    def spread(array: FloatArray, *tail: int) -> FloatArray:
        return np.array(np.broadcast_to(array, (*shape, *tail)))

    return Mechanism(
        kind=kind,
        joints=tuple(joints),
        driven=driven,
        position=spread(position, 3),
        orientation=spread(turned, 3, 3),
        axes=np.stack([spread(step[1], 3) for step in steps], axis=-2),
        origins=np.stack([spread(o, 3) for o in offsets], axis=-2),
        angles=np.zeros((*shape, len(steps))),
        drives=Drive(np.stack([spread(t, t.shape[-1]) for t in tables], axis=-2)),
        vertex=spread(v, 3),
        normal=spread(normal, 3),
    )


def _tables(drives: object, driven: tuple[int, ...]) -> list[FloatArray]:
    """Return the tables of the drives, one table per driven joint."""
    if drives is None:
        return [direct().table for _ in driven]
    drive_list = tuple(drives) if isinstance(drives, tuple | list) else (drives,)
    if len(drive_list) != len(driven):
        raise InputError(f"drives: got {len(drive_list)}, but this kind has {len(driven)}")
    tables = []
    for drive in drive_list:
        if not isinstance(drive, Drive):
            raise InputError(
                f"drives: {kind_of(drive)} is not a Drive; pass {len(driven)} drives made by "
                "rotary, direct or linear_paint"
            )
        tables.append(drive.table)
    return tables


def _lengths(value: npt.ArrayLike, name: str) -> FloatArray:
    return as_numbers(value, name, -_LONGEST, _LONGEST, "m", "give metres")


def _check_rotation(matrix: FloatArray) -> None:
    if matrix.shape[-2:] != (3, 3) or not np.isfinite(matrix).all():
        raise InputError(
            f"orientation: shape {matrix.shape}; pass finite rotation matrices, (..., 3, 3)"
        )
    deviation = np.abs(matrix @ np.swapaxes(matrix, -1, -2) - np.eye(3)).max()
    if deviation > 1e-9 or (np.linalg.det(matrix) < 0).any():
        raise InputError(
            f"orientation: not a rotation (deviates by {deviation:.2g}, limit 1e-9); "
            "its columns must be unit, perpendicular and right-handed"
        )


def azimuth_elevation(
    position: npt.ArrayLike,
    *,
    pivot_height: npt.ArrayLike = 0.0,
    pivot_offset: npt.ArrayLike = 0.0,
    orientation: npt.ArrayLike | None = None,
    drives: tuple[Drive, Drive] | None = None,
) -> Mechanism:
    """Return azimuth-elevation mechanisms.

    At zero angles the mirror faces north; azimuth increases clockwise from north and elevation
    increases upwards, so without imperfections the joint angles are the azimuth and elevation of
    the normal.

    Parameters
    ----------
    position
        Foot of the pedestal, ENU metres, (..., 3).
    pivot_height
        Height of the intersection of the axes above the foot, m, (...).
    pivot_offset
        Distance of the mirror surface in front of the pivot, m, (...).
    orientation, drives
        As for `two_axis`.
    """
    height, front = _lengths(pivot_height, "pivot_height"), _lengths(pivot_offset, "pivot_offset")
    return two_axis(
        position,
        -UP,
        EAST,
        NORTH,
        kind="azimuth_elevation",
        names=("azimuth", "elevation"),
        leans=("north", "east"),
        pole=UP,
        origin_1=height[..., None] * UP,
        vertex=front[..., None] * NORTH,
        orientation=orientation,
        drives=drives,
    )


def tilt_roll(
    position: npt.ArrayLike,
    axis: npt.ArrayLike = (1.0, 0.0, 0.0),
    *,
    kind: str = "tilt_roll",
    pivot_height: npt.ArrayLike = 0.0,
    spacing: npt.ArrayLike = 0.0,
    pivot_offset: npt.ArrayLike = 0.0,
    drives: tuple[Drive, Drive] | None = None,
) -> Mechanism:
    """Return tilt-roll mechanisms; the first axis (tilt) is parallel to ``axis``.

    At zero angles the mirror faces as far up as the first axis allows; the second axis (roll) lies
    in the mirror plane, perpendicular to the first.

    Parameters
    ----------
    position
        Foot of the heliostat, ENU metres, (..., 3).
    axis
        Direction of the first axis in ENU, (..., 3); it must not be vertical.
    kind
        Name of the kind.
    pivot_height, spacing, pivot_offset
        Height of the first axis above ground, of the second axis above the first, and of the mirror
        surface above the second, m.
    drives
        Tilt and roll drive.

    Raises
    ------
    InputError
        If the first axis is vertical.
    """
    a1 = normalize(axis, "axis")
    flat = np.linalg.norm(a1[..., :2], axis=-1)
    if (flat < 1e-6).any():
        raise InputError("axis: the first axis of a tilt-roll mechanism must not be vertical")
    n = normalize(UP - a1[..., 2:] * a1, "normal")
    height, front = _lengths(pivot_height, "pivot_height"), _lengths(pivot_offset, "pivot_offset")
    gap = _lengths(spacing, "spacing")
    return two_axis(
        position,
        a1,
        np.cross(n, a1),
        n,
        kind=kind,
        names=("tilt", "roll"),
        origin_1=height[..., None] * UP,
        origin_2=gap[..., None] * n,
        vertex=front[..., None] * n,
        drives=drives,
    )


def target_aligned(
    position: npt.ArrayLike,
    aim: npt.ArrayLike,
    *,
    pivot_height: npt.ArrayLike = 0.0,
    pivot_offset: npt.ArrayLike = 0.0,
    drives: tuple[Drive, Drive] | None = None,
) -> Mechanism:
    """Return target-aligned (spinning-elevation) mechanisms; the first axis points at ``aim``.

    Parameters
    ----------
    position, aim
        ENU metres, (..., 3).
    pivot_height, pivot_offset, drives
        As for `tilt_roll`.
    """
    p, a = as_vectors(position, "position"), as_vectors(aim, "aim")
    common_batch({"position": p.shape[:-1], "aim": a.shape[:-1]})
    towards = a - (p + _lengths(pivot_height, "pivot_height")[..., None] * UP)
    return tilt_roll(
        p,
        towards,
        kind="target_aligned",
        pivot_height=pivot_height,
        pivot_offset=pivot_offset,
        drives=drives,
    )


def pitch_roll(
    position: npt.ArrayLike,
    azimuth: npt.ArrayLike = 0.0,
    *,
    pivot_height: npt.ArrayLike = 0.0,
    spacing: npt.ArrayLike = 0.0,
    pivot_offset: npt.ArrayLike = 0.0,
    drives: tuple[Drive, Drive] | None = None,
) -> Mechanism:
    """Return pitch-roll mechanisms; the first axis is horizontal and perpendicular to ``azimuth``.

    At zero angles the mirror faces up. A positive pitch tilts the mirror away from the azimuth
    (rad) that the heliostat faces; the roll axis lies in the mirror.

    Raises
    ------
    InputError
        If the azimuth is not within four revolutions.
    """
    facing = as_angles(azimuth, "azimuth", MOST_TURNS)
    axis = np.stack([np.cos(facing), -np.sin(facing), np.zeros_like(facing)], axis=-1)
    return tilt_roll(
        position,
        axis,
        kind="pitch_roll",
        pivot_height=pivot_height,
        spacing=spacing,
        pivot_offset=pivot_offset,
        drives=drives,
    )


def of_armature(
    armature: Armature, drives: Drive, position: npt.ArrayLike, *, kind: str = "two_axis"
) -> Mechanism:
    """Return two-axis mechanisms with given armatures, which may come from any kind.

    Parameters
    ----------
    armature
        Armatures, shape (...).
    drives
        Both drives, (..., 2).
    position
        ENU metres, (..., 3).
    kind
        Name of the kind.
    """
    foot = as_vectors(position, "position")
    steps: list[tuple[str, FloatArray, npt.ArrayLike]] = [
        ("primary", armature.axis_1, armature.origin_1 - foot),
        ("secondary", armature.axis_2, armature.origin_2 - armature.origin_1),
    ]
    both = (drives[0], drives[1])
    mirror = armature.vertex - armature.origin_2
    return _assemble(kind, steps, (0, 1), foot, None, both, mirror, armature.normal)


def polar(
    position: npt.ArrayLike,
    latitude: npt.ArrayLike,
    *,
    pivot_height: npt.ArrayLike = 0.0,
    pivot_offset: npt.ArrayLike = 0.0,
    drives: tuple[Drive, Drive] | None = None,
) -> Mechanism:
    """Return polar mechanisms; the first axis is parallel to the Earth's axis.

    At zero angles the mirror faces the intersection of the meridian and the celestial equator; a
    positive declination turns it towards the north pole, and the hour angle increases westwards
    with the sun.

    Parameters
    ----------
    position
        ENU metres, (..., 3).
    latitude
        Latitude, rad, positive north, (...).
    pivot_height, pivot_offset, drives
        As for `tilt_roll`.

    Raises
    ------
    InputError
        If the latitude is not within −π/2 to π/2.
    """
    phi = as_angles(latitude, "latitude", 0.5 * np.pi)
    zero = np.zeros_like(phi)
    north_pole = np.stack([zero, np.cos(phi), np.sin(phi)], axis=-1)
    equator = np.stack([zero, -np.sin(phi), np.cos(phi)], axis=-1)
    height, front = _lengths(pivot_height, "pivot_height"), _lengths(pivot_offset, "pivot_offset")
    return two_axis(
        position,
        -north_pole,
        -EAST,
        equator,
        kind="polar",
        names=("hour_angle", "declination"),
        leans=_lean_names(north_pole),
        pole=north_pole,
        origin_1=height[..., None] * UP,
        vertex=front[..., None] * equator,
        drives=drives,
    )


def two_jacks(
    position: npt.ArrayLike,
    drives: tuple[Drive, Drive],
    *,
    joint_translation_1: npt.ArrayLike = (0.0, 0.0, 0.0),
    joint_translation_2: npt.ArrayLike = (0.0, 0.0, 0.0),
    concentrator_translation: npt.ArrayLike = (0.0, 0.0, 0.0),
) -> Mechanism:
    """Return the mechanism of the heliostats at Jülich, which two linear actuators move.

    The first joint rotates about east (elevation), the second about an axis that points up in the
    frame of the first joint (azimuth); the mirror faces south at zero angles.

    Parameters
    ----------
    position
        ENU metres, (..., 3).
    drives
        Two drives made by `linear_paint`.
    joint_translation_1, joint_translation_2, concentrator_translation
        As in PAINT's heliostat properties, m, (..., 3).
    """
    return two_axis(
        position,
        EAST,
        UP,
        -NORTH,
        kind="two_jacks",
        names=("elevation", "azimuth"),
        leans=("up", "north"),
        origin_1=joint_translation_1,
        origin_2=joint_translation_2,
        arm=concentrator_translation,
        drives=drives,
    )


def single_axis(
    position: npt.ArrayLike,
    axis: npt.ArrayLike,
    normal: npt.ArrayLike = (0.0, 0.0, 1.0),
    *,
    leans: tuple[str, str] | None = None,
    pivot_height: npt.ArrayLike = 0.0,
    origin: npt.ArrayLike = (0.0, 0.0, 0.0),
    vertex: npt.ArrayLike = (0.0, 0.0, 0.0),
    orientation: npt.ArrayLike | None = None,
    drives: tuple[Drive] | None = None,
) -> Mechanism:
    """Return single-axis trackers (parabolic trough, linear Fresnel).

    Only the plane perpendicular to the axis can be reached, so source and destination are projected
    onto it (Grigoriev et al. 2021, (9)).

    Parameters
    ----------
    position
        ENU metres, (..., 3).
    axis, normal
        Axis, and normal at zero angle, in the tracker frame, (..., 3).
    leans
        As for `two_axis`.
    pivot_height
        Height of the axis above the position, m.
    origin
        Point on the axis, relative to the position and ``pivot_height``, m, (..., 3).
    vertex
        Mirror vertex relative to that point at zero angle, m.
    orientation
        Rotation from the tracker frame to ENU, (..., 3, 3); default identity.
    drives
        One drive; by default counts are radians.

    Raises
    ------
    InputError
        If the normal is parallel to the axis, or the orientation is not a rotation.
    """
    p, a, n = as_vectors(position, "position"), normalize(axis, "axis"), normalize(normal, "normal")
    if (np.linalg.norm(np.cross(a, n), axis=-1) < 1e-6).any():
        raise InputError(
            "normal: it is parallel to the axis, so rotation about this axis would not change it"
        )
    height = _lengths(pivot_height, "pivot_height")
    lean_names = _lean_names(a) if leans is None else leans
    steps: list[tuple[str, FloatArray, npt.ArrayLike]] = [
        (
            f"tilt_{lean_names[0]}",
            normalize(np.cross(a, _LEANS[lean_names[0]])),
            as_vectors(origin, "origin") + height[..., None] * UP,
        ),
        (f"tilt_{lean_names[1]}", normalize(np.cross(a, _LEANS[lean_names[1]])), 0.0),
        ("rotation", a, 0.0),
    ]
    return _assemble("single_axis", steps, (2,), p, orientation, drives, vertex, n)
