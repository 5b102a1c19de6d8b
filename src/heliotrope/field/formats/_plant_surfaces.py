"""Moves and rotates targets and receivers in the text of a plant file, as rigid bodies.

A surface moves together with everything attached to it: its corners, its additional known points
and its marks. The tables are tomlkit tables, so that comments and the layout of the file are
preserved.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray, normalize

#: The only value that is a name.
RENAMED = "name"
#: Decimals of a metre that are written (nanometres).
_DIGITS = 9
_SIZES = ("width_m", "height_m", "radius_m")


def surface_values(table: Any) -> dict[str, str]:
    """Return the settable values of a target or a receiver, by name."""
    facing, tilt = _angles(table)
    values = {
        RENAMED: str(table["name"]),
        "center_m": _text(_center(table)),
        "facing_deg": f"{facing:.6g}",
        "tilt_deg": f"{tilt:.6g}",
    }
    values |= {key: f"{float(table[key]):.9g}" for key in _SIZES if key in table}
    return values | {name: _text(point) for name, point in _points(table)}


def set_surface(table: Any, changes: Mapping[str, str]) -> tuple[str, ...]:
    """Set some values of a target or a receiver; return warnings.

    Raises
    ------
    InputError
        If a value is invalid.
    UnknownNameError
        If a name is not one of its values.
    """
    known = surface_values(table)
    for name in changes:
        if name not in known:
            raise UnknownNameError(f"value of {table['name']}", name, known)
    # Single points first, because the surface then moves and rotates with them.
    for name, text in changes.items():
        if name == RENAMED:
            table["name"] = text.strip()
        elif name in _SIZES:
            table[name] = _numbers(table, name, text, 1)[0]
        elif name not in ("center_m", "facing_deg", "tilt_deg"):
            point = _place(table, name)
            _put(point, np.array(_numbers(table, name, text, 3)))
    if "facing_deg" in changes or "tilt_deg" in changes:
        _turn(table, changes)
    if "center_m" in changes:
        shift = np.array(_numbers(table, "center_m", changes["center_m"], 3)) - _center(table)
        _move(table, lambda point: point + shift)
    if RENAMED in changes or set(changes) <= set(_SIZES) - {"width_m", "height_m"}:
        return ()
    kept = "earlier sightings on it keep the positions measured at that time"
    return (f"{table['name']}: {kept}; if it was moved, rename it too (name=…)",)


def _turn(table: Any, changes: Mapping[str, str]) -> None:
    facing, tilt = _angles(table)
    new = _numbers(table, "facing_deg", changes.get("facing_deg", f"{facing!r}"), 1)[0]
    lean = _numbers(table, "tilt_deg", changes.get("tilt_deg", f"{tilt!r}"), 1)[0]
    if abs(lean) >= 90.0:
        raise InputError(f"{table['name']}: tilt_deg must be between -90° and 90°, not {lean:g}°")
    R_enu_new, R_enu_old = _axes(new, lean), _axes(facing, tilt)
    middle, R = _center(table), R_enu_new @ R_enu_old.T
    if "corners_m" not in table and "normal" not in table and abs(lean) > 1e-9:
        _corners(table)
    _move(table, lambda point: middle + R @ (point - middle))
    if "normal" in table:
        _put(table["normal"], R @ np.array([float(x) for x in table["normal"]]))
    if "facing_deg" in table:
        table["facing_deg"] = round(new, _DIGITS)


def _corners(table: Any) -> None:
    """Add corners to an upright target specified by its size, so that it can be tilted."""
    facing, _ = _angles(table)
    across, up = _axes(facing, 0.0)[:, 0], np.array([0.0, 0.0, 1.0])
    w, h = 0.5 * float(table.pop("width_m")), 0.5 * float(table.pop("height_m"))
    table.pop("facing_deg")
    corners = [(-w, h), (w, h), (w, -h), (-w, -h)]
    table["corners_m"] = [
        np.round(_center(table) + x * across + y * up, _DIGITS).tolist() for x, y in corners
    ]


def _axes(facing: float, tilt: float) -> FloatArray:
    """Return the matrix with columns right (as seen from the front), up and normal, in ENU."""
    azimuth, elevation = np.radians(facing), np.radians(tilt)
    normal = np.array(
        [
            np.sin(azimuth) * np.cos(elevation),
            np.cos(azimuth) * np.cos(elevation),
            np.sin(elevation),
        ]
    )
    right = np.array([-np.cos(azimuth), np.sin(azimuth), 0.0])
    return np.stack([right, np.cross(normal, right), normal], axis=-1)


def _angles(table: Any) -> tuple[float, float]:
    """Return the azimuth and the elevation of the normal, degrees."""
    if "normal" in table:
        normal = normalize(np.array([float(x) for x in table["normal"]]))
    elif "corners_m" in table:
        c = np.array([[float(x) for x in corner] for corner in table["corners_m"]])
        normal = normalize(np.cross(c[1] + c[2] - c[0] - c[3], c[0] + c[1] - c[2] - c[3]))
    else:
        return float(table["facing_deg"]), 0.0
    return (
        float(np.degrees(np.arctan2(normal[0], normal[1])) % 360.0),
        float(np.degrees(np.arcsin(np.clip(normal[2], -1.0, 1.0)))),
    )


def _center(table: Any) -> FloatArray:
    if "center_m" in table:
        return np.array([float(x) for x in table["center_m"]])
    corners = np.array([[float(x) for x in corner] for corner in table["corners_m"]])
    return np.asarray(corners.mean(axis=0))


def _points(table: Any) -> Iterator[tuple[str, FloatArray]]:
    """Yield the individual points of a surface, apart from its centre, by name."""
    for k, corner in enumerate(table.get("corners_m", ())):
        yield f"corners_m.{k}", np.array([float(x) for x in corner])
    for name, point in table.get("markers_m", {}).items():
        yield f"markers_m.{name}", np.array([float(x) for x in point])
    for mark in table.get("marks", ()):
        yield f"marks.{mark['name']}", np.array([float(x) for x in mark["at_m"]])


def _place(table: Any, name: str) -> Any:
    """Return the TOML array of a point from `_points`."""
    kind, _, which = name.partition(".")
    if kind == "corners_m":
        return table[kind][int(which)]
    if kind == "markers_m":
        return table[kind][which]
    return next(mark["at_m"] for mark in table["marks"] if mark["name"] == which)


def _move(table: Any, motion: Any) -> None:
    """Move all points of a surface."""
    for name, point in list(_points(table)):
        _put(_place(table, name), motion(point))
    if "center_m" in table:
        _put(table["center_m"], motion(_center(table)))


def _put(array: Any, values: FloatArray) -> None:
    """Set the numbers of an array in place, so that its layout and comments are preserved."""
    for k, value in enumerate(values):
        new = round(float(value), _DIGITS)
        if float(array[k]) != new:
            array[k] = new


def _text(point: FloatArray) -> str:
    return ",".join(f"{x:.9g}" for x in point)


def _numbers(table: Any, name: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count or not np.isfinite(numbers).all():
        expected = "a number" if count == 1 else "three numbers in metres, east,north,up"
        raise InputError(f"{table['name']}: {name}={text}: write {expected}")
    return numbers
