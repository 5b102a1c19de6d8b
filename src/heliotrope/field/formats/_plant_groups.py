"""Converts groups between plant-file tables and mechanisms with drive settings, without loss."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.formats._plant_mirrors import mirror_document, read_facets, read_surface
from heliotrope.field.formats._plant_models import (
    ANGLE_UNITS,
    DRIVE_ANGLES,
    KINDS,
    AxisTable,
    GroupTable,
    MachineTable,
)
from heliotrope.field.formats._plant_table import HeliostatColumns
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.mirror_surface import Canting, FacetGrid
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import drives as drive_kinds
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS, Drive
from heliotrope.mechanism.kernels import slots as slot
from heliotrope.mechanism.machine import (
    LONGEST_DEFOCUS,
    AxisLimits,
    Machine,
    Stepping,
    spread_defocus,
)
from heliotrope.sun import Site

# Names that the writer uses for the numbers of a drive; names such as "rate" have no unit because
# the unit depends on the kind.
_RAW = {
    **{n: i for n, i in SLOTS.items() if n != "initial_angle"},
    "kind": slot.KIND,
    "sense": slot.SENSE,
}
_POSITION = ("east_m", "north_m", "up_m")


def build_group(
    path: Path,
    name: str,
    group: GroupTable,
    table: HeliostatColumns,
    rows: npt.NDArray[np.intp],
    site: Site,
) -> Heliostats:
    """Return the heliostats of one group.

    Raises
    ------
    FormatError, InputError
        If the group cannot be built.
    """
    reader = _Reader(path, name, group, table, rows)
    position = np.stack([table.numbers[c][rows] for c in _POSITION], axis=-1)
    mechanism = reader.chain(position) if group.chain else reader.built(position, site)
    width = reader.number("mirror_width_m", group.mirror_width_m)
    height = reader.number("mirror_height_m", group.mirror_height_m)
    if width is None or height is None:
        raise reader.fail("mirror_width_m and mirror_height_m are needed, here or in the table")
    aim = None
    if "aim_east_m" in table.numbers:
        columns = ("aim_east_m", "aim_north_m", "aim_up_m")
        aim = np.stack([table.numbers[c][rows] for c in columns], axis=-1)
    cluster = tuple(table.cluster[i] for i in rows)
    names = tuple(table.name[i] for i in rows)
    size = (np.broadcast_to(width, rows.shape), np.broadcast_to(height, rows.shape))
    facets = read_facets(reader, size, site)
    grid = FacetGrid(1, 1, 0.0, Canting("none"))
    center, half = grid.places(*size)
    parts = Facets.of(center, half, np.zeros_like(center)) if facets is None else facets
    heliostats = Heliostats(
        names=names,
        mechanism=mechanism,
        width=size[0],
        height=size[1],
        facets=facets,
        parameters=reader.parameters(mechanism),
        aim=aim,
        cluster=cluster if any(cluster) else (),
        machines=reader.machines(mechanism),
        surface=read_surface(reader, names, parts, whole=facets is None),
    )
    if group.mirror is not None:
        heliostats.check_facets()
    return heliostats


class _Reader:
    """Reads the numbers of one group: from a table column if there is one, else from the TOML."""

    def __init__(
        self,
        path: Path,
        name: str,
        group: GroupTable,
        table: HeliostatColumns,
        rows: npt.NDArray[np.intp],
    ) -> None:
        self.path, self.name, self.group, self.table, self.rows = path, name, group, table, rows

    def fail(self, problem: str, where: str = "") -> FormatError:
        place = f"groups.{self.name}" + (f".{where}" if where else "")
        return FormatError(self.path, problem, place)

    def column(self, key: str) -> FloatArray | None:
        """Return the table's column for this group; None if it is missing or entirely empty."""
        column = self.table.column(key, self.rows)
        if column is None or np.isnan(column).all():
            return None
        if np.isnan(column).any():
            i = int(self.rows[np.flatnonzero(np.isnan(column))[0]])
            raise FormatError(
                self.table.path,
                f"heliostat {self.table.name[i]}: the cell is empty, but other heliostats of "
                f"group {self.name} have a value; fill it",
                f"line {i + 2}, column {key}",
            )
        return column

    def columns(self, start: str) -> tuple[str, ...]:
        """Return the columns whose names begin with ``start`` and that this group fills."""
        names = (name for name in self.table.numbers if name.startswith(start))
        return tuple(name for name in names if self.column(name) is not None)

    def number(self, key: str, value: float | None) -> FloatArray | None:
        column = self.column(key)
        if column is not None:
            return column
        return None if value is None else np.asarray(value, dtype=np.float64)

    def array(self, key: str, value: Any) -> FloatArray:
        """Return an array of numbers, (N, …); columns ``key.i.j`` replace individual elements."""
        base = np.asarray(value, dtype=np.float64)
        full = np.array(np.broadcast_to(base, (len(self.rows), *base.shape)))
        for index in np.ndindex(base.shape):
            column = self.column(".".join([key, *map(str, index)]))
            if column is not None:
                full[(slice(None), *index)] = column
        return full

    def built(self, position: FloatArray, site: Site) -> Mechanism:
        group = self.group
        if group.kind not in KINDS:
            raise UnknownNameError("kind of mechanism", group.kind, KINDS)
        every = {key for keys in KINDS.values() for key in keys}
        for key in sorted(every - set(KINDS[group.kind])):
            if getattr(group, key) is not None:
                raise self.fail(f"{key} does not belong to kind {group.kind}; remove it", key)
        arguments: dict[str, Any] = {}
        for key in KINDS[group.kind]:
            setting = getattr(group, key)
            if isinstance(setting, list):
                arguments[key.removesuffix("_m")] = self.array(key, setting)
            elif (value := self.number(key, setting)) is not None:
                arguments[key.removesuffix("_m")] = value
        if group.kind == "polar":
            degrees = arguments.pop("latitude_deg", np.asarray(site.latitude_deg))
            arguments["latitude"] = np.radians(degrees)
        if group.kind == "pitch_roll" and "facing_deg" in arguments:
            arguments["azimuth"] = np.radians(arguments.pop("facing_deg"))
        builder = getattr(kinds, group.kind)
        needed = {
            "target_aligned": ("aim_m",),
            "two_axis": ("axis_1", "axis_2", "normal"),
            "single_axis": ("axis",),
        }
        names = _joint_names(group.kind)
        missing = [key for key in needed.get(group.kind, ()) if getattr(group, key) is None]
        if group.drives or group.kind == "two_jacks":
            missing += [f"drives.{joint}" for joint in names if joint not in group.drives]
        for joint in group.drives:
            if joint not in names:
                raise self.fail(f"{joint!r} is not a driven joint; use one of {names}", "drives")
        self.check_missing(missing, f"kind {group.kind} needs")
        if group.drives:
            arguments["drives"] = tuple(self.drive(joint) for joint in names)
        mechanism: Mechanism = builder(position, **arguments)
        return mechanism

    def check_missing(self, keys: Sequence[str], why: str, where: str = "") -> None:
        """Raise an error that names all missing keys, and why they are needed."""
        if keys:
            be, it = ("are", "them") if len(keys) > 1 else ("is", "it")
            raise self.fail(f"{', '.join(keys)} {be} missing; {why} {it}", where)

    def drive(self, joint: str) -> Drive:
        if joint not in self.group.drives:
            raise self.fail(f"the drive of joint {joint!r} is missing", "drives")
        model: Any = self.group.drives[joint]
        where = f"drives.{joint}"
        if model.kind == "raw":
            return self.raw_drive(joint, model.numbers)
        values: dict[str, Any] = {}
        for key in type(model).model_fields:
            if key in ("kind",):
                continue
            value = self.number(f"{where}.{key}", getattr(model, key))
            if value is not None:
                values[key] = value
        for angle in DRIVE_ANGLES:
            units = [u for u in ANGLE_UNITS if f"{angle}_{u}" in values]
            if len(units) > 1:
                raise self.fail(
                    f"{angle} is specified in {' and '.join(units)}; keep one of them", where
                )
            if units:
                values[angle] = values.pop(f"{angle}_{units[0]}") * ANGLE_UNITS[units[0]]
        for key in ("min_count", "max_count", "scale", "worm_ratio"):
            values[key] = values.get(key, {"min_count": -np.inf, "max_count": np.inf}.get(key, 0.0))
        values["speed"] = values.pop("speed_counts_per_s", np.inf)
        if model.kind == "direct":
            return drive_kinds.direct(**values)
        if model.kind == "rotary":
            return drive_kinds.rotary(
                values.pop("steps_per_turn"), values.pop("gear_ratio"), **values
            )
        needed = (
            "increment_per_m",
            "initial_stroke_length_m",
            "offset_m",
            "pivot_radius_m",
            "initial_angle",
        )
        missing = [key for key in needed if key not in values]
        self.check_missing(missing, f"specify here, or as columns {where}.KEY,", where)
        # Popped first, because an unpacked generator would run only after **values.
        constants = [values.pop(key) for key in needed]
        return drive_kinds.linear_paint(*constants, **values)

    def raw_drive(self, joint: str, numbers: Mapping[str, float]) -> Drive:
        row = np.zeros((len(self.rows), slot.DRIVE_SLOTS))
        for key, value in numbers.items():
            if key not in _RAW:
                raise UnknownNameError("number of a drive", key, _RAW)
            row[:, _RAW[key]] = value
        for key, index in _RAW.items():
            column = self.column(f"drives.{joint}.{key}")
            if column is not None:
                row[:, index] = column
        lacks = [k for k in _RAW if k not in numbers and self.column(f"drives.{joint}.{k}") is None]
        self.check_missing(lacks, "a drive of kind raw needs", f"drives.{joint}.numbers")
        return Drive(row).replace()

    def chain(self, position: FloatArray) -> Mechanism:
        chain = self.group.chain
        if chain is None:
            raise self.fail("chain is missing")
        joints = len(chain.joints)
        for key in ("axes", "origins_m", "angles_rad"):
            if len(getattr(chain, key)) != joints:
                raise self.fail(f"{key} has {len(getattr(chain, key))} rows for {joints} joints")
        if not chain.driven or any(not 0 <= d < joints for d in chain.driven):
            raise self.fail(f"driven {chain.driven}: use joint indices from 0 to {joints - 1}")
        driven = [self.drive(chain.joints[d]).table for d in chain.driven]
        return Mechanism(
            kind=self.group.kind,
            joints=tuple(chain.joints),
            driven=tuple(chain.driven),
            position=position,
            orientation=self.array("chain.orientation", chain.orientation),
            axes=self.array("chain.axes", chain.axes),
            origins=self.array("chain.origins_m", chain.origins_m),
            angles=self.array("chain.angles_rad", chain.angles_rad),
            drives=Drive(np.stack(driven, axis=-2)),
            vertex=self.array("chain.vertex_m", chain.vertex_m),
            normal=self.array("chain.normal", chain.normal),
        )

    def parameters(self, mechanism: Mechanism) -> dict[str, FloatArray]:
        parameters = {}
        for column in self.table.numbers:
            if not column.startswith("parameters."):
                continue
            key = column.removeprefix("parameters.")
            name = next((n for n in mechanism.parameters if _column(mechanism, n) == key), None)
            values = self.column(column)
            # A plant of several kinds has columns that are empty for the other groups.
            if values is None:
                continue
            if name is None:
                known = [_column(mechanism, n) for n in mechanism.parameters]
                raise UnknownNameError(f"parameter (column {column})", key, known)
            parameters[name] = values
        return parameters

    def machines(self, mechanism: Mechanism) -> tuple[Machine, ...]:
        """Return the machine of each heliostat; () if the group has no machine table."""
        table = self.group.machine
        if table is None:
            if any(column.startswith("machine.") for column in self.table.numbers):
                raise self.fail("the columns machine.… need this table; add it", "machine")
            return ()
        joints = [mechanism.joints[d] for d in mechanism.driven]
        if sorted(table.axes) != sorted(joints):
            listed = ", ".join(table.axes) or "none"
            raise self.fail(
                f"axes are specified for {listed}; specify those of {' and '.join(joints)}",
                "machine.axes",
            )
        first = table.leaves_stow_first or joints[0]
        if first not in joints:
            raise self.fail(f"{first!r} is not a driven joint; use one of {joints}", "machine")
        if len(joints) != 2:
            raise self.fail(
                "local controllers drive two joints, but this kind has one; remove the table",
                "machine",
            )
        drives = Drive(
            np.broadcast_to(mechanism.drives.table, (len(self.rows), 2, slot.DRIVE_SLOTS))
        )
        axes = [
            self.axis(drives[i], f"machine.axes.{j}", table.axes[j]) for i, j in enumerate(joints)
        ]
        stow, defocus = self.stow(drives, table), self.defocus(table)
        standby = (
            None if table.standby_m is None else self.array("machine.standby_m", table.standby_m)
        )
        points = tuple((x, y, z) for x, y, z in table.way_m)
        stepping = None
        if table.stepping is not None:
            primary, secondary = table.stepping.microsteps
            stepping = Stepping((primary, secondary), table.stepping.rests)
        made: dict[tuple[Any, ...], Machine] = {}
        machines = []
        for k in range(len(self.rows)):
            numbers = (
                tuple(axes[0][k].tolist()),
                tuple(axes[1][k].tolist()),
                tuple(stow[k].tolist()),
                tuple(defocus[k].tolist()),
                None if standby is None else tuple(standby[k].tolist()),
            )
            if numbers not in made:
                limits = (AxisLimits(*numbers[0]), AxisLimits(*numbers[1]))
                made[numbers] = Machine(
                    limits,
                    *numbers[2:],
                    joints.index(first),
                    points,
                    stepping,
                    table.stow_lights,
                    table.tilt_sensor,
                )
            machines.append(made[numbers])
        self.check_defocus(drives, axes, defocus, joints)
        return tuple(machines)

    def axis(self, drive: Drive, where: str, table: AxisTable) -> npt.NDArray[np.int64]:
        """Return the lower and upper limit, rate, acceleration and backlash of one axis, (N, 5)."""
        stops = (slot.MIN_ANGLE, slot.MAX_ANGLE)
        self.check_axis(drive, where, table)
        ends = [
            self.end(drive, f"{where}.{name}", getattr(table, f"{name}_steps"), deg, stop)
            for name, deg, stop in zip(
                ("min", "max"), (table.min_deg, table.max_deg), stops, strict=True
            )
        ]
        rate = self.number(f"{where}.rate_steps_per_s", table.rate_steps_per_s)
        if rate is None:
            rate = drive.table[:, slot.SPEED]
        rest = [
            self.array(f"{where}.{key}", getattr(table, key))
            for key in ("acceleration_steps_per_s2", "backlash_steps")
        ]
        # If counts decrease with the angle, the lower stop is at the higher count.
        low, high = np.minimum(*ends), np.maximum(*ends)
        columns = [np.broadcast_to(v, self.rows.shape) for v in (low, high, rate, *rest)]
        return np.round(np.stack(columns, axis=-1)).astype(np.int64)

    def check_axis(self, drive: Drive, where: str, table: AxisTable) -> None:
        """Check that the stops and the rate of an axis are specified, here or in its drive."""
        given = (
            ("min_deg", (table.min_steps, table.min_deg), slot.MIN_ANGLE),
            ("max_deg", (table.max_steps, table.max_deg), slot.MAX_ANGLE),
            ("rate_steps_per_s", (table.rate_steps_per_s,), slot.SPEED),
        )
        columns = ("min_steps", "max_steps", *(key for key, _, _ in given))
        known = {key for key in columns if self.column(f"{where}.{key}") is not None}
        missing = [
            key
            for key, values, place in given
            if all(value is None for value in values)
            and not known & {key, key.replace("_deg", "_steps")}
            and not np.isfinite(drive.table[:, place]).all()
        ]
        self.check_missing(missing, "its drive does not define", where)

    def end(
        self, drive: Drive, where: str, steps: int | None, deg: float | None, stop: int
    ) -> FloatArray:
        """Return one limit of an axis, steps, (N,): as specified, or else the stop of its drive."""
        counts = self.number(f"{where}_steps", steps)
        angle = self.number(f"{where}_deg", deg)
        if counts is not None and angle is not None:
            raise self.fail("set both in steps and in degrees; keep one", where)
        if counts is not None:
            return np.broadcast_to(counts, self.rows.shape)
        radians = drive.table[:, stop] if angle is None else np.radians(angle)
        return np.asarray(drive.counts(np.broadcast_to(radians, self.rows.shape)))

    def stow(self, drives: Drive, table: MachineTable) -> npt.NDArray[np.int64]:
        if (table.stow_steps is None) == (table.stow_deg is None):
            raise self.fail("set either stow_steps or stow_deg", "machine")
        if table.stow_steps is not None:
            steps = self.array("machine.stow_steps", table.stow_steps)
        else:
            steps = drives.counts(np.radians(self.array("machine.stow_deg", table.stow_deg)))
        return np.round(steps).astype(np.int64)

    def check_defocus(
        self,
        drives: Drive,
        axes: Sequence[npt.NDArray[np.int64]],
        defocus: FloatArray,
        joints: Sequence[str],
    ) -> None:
        """Check that the largest rotation of a DEFOCUS, including its spread, ends in time."""
        low, high, rate, ramp, _ = np.stack(axes, axis=1).transpose(2, 0, 1).astype(np.float64)
        steps = np.abs(defocus / drives.radians_per_count(0.5 * (low + high)))
        time = steps / rate + rate / ramp
        row, axis = divmod(int(time.argmax()), 2)
        if time[row, axis] > LONGEST_DEFOCUS:
            raise self.fail(
                f"the {joints[axis]} of heliostat {self.table.name[self.rows[row]]} needs "
                f"{time[row, axis]:.0f} s to turn away by {np.degrees(defocus[row, axis]):.1f}°, "
                f"but has only {LONGEST_DEFOCUS:.0f} s after the loss of its cluster is "
                "detected; lower defocus_spread or the angles, or raise the rate",
                "machine",
            )

    def defocus(self, table: MachineTable) -> FloatArray:
        units = [u for u in ANGLE_UNITS if getattr(table, f"defocus_{u}") is not None]
        if len(units) != 1:
            raise self.fail("set one of defocus_deg, defocus_mrad, defocus_rad", "machine")
        key = f"defocus_{units[0]}"
        angles = self.array(f"machine.{key}", getattr(table, key))
        names = [self.table.name[row] for row in self.rows]
        return spread_defocus(angles * ANGLE_UNITS[units[0]], names, table.defocus_spread)


def _joint_names(kind: str) -> tuple[str, ...]:
    return {
        "single_axis": ("rotation",),
        "azimuth_elevation": ("azimuth", "elevation"),
        "two_jacks": ("elevation", "azimuth"),
        "polar": ("hour_angle", "declination"),
        "two_axis": ("primary", "secondary"),
    }.get(kind, ("tilt", "roll"))


def _column(mechanism: Mechanism, name: str) -> str:
    unit = mechanism.parameter(name).unit
    return name if unit == "1" else f"{name}_{unit}"


def group_document(
    name: str, heliostats: Heliostats, place: Path
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the TOML of a group, and columns for the values that differ between its heliostats.

    Slope maps are written beside the plant file at ``place``.
    """
    m = heliostats.mechanism
    columns: dict[str, Any] = {"name": list(heliostats.names), "group": [name] * len(heliostats)}
    columns |= {c: m.position[:, k] for k, c in enumerate(_POSITION)}
    columns["mirror_width_m"] = np.array(heliostats.width)
    columns["mirror_height_m"] = np.array(heliostats.height)
    if heliostats.cluster:
        columns["cluster"] = list(heliostats.cluster)
    if heliostats.aim is not None:
        columns |= {f"aim_{c}": heliostats.aim[:, k] for k, c in enumerate(_POSITION)}

    def first(key: str, array: npt.NDArray[Any]) -> Any:
        """Return the numbers of the first heliostat; if other heliostats differ, add a column."""
        for index in np.ndindex(array.shape[1:]):
            values = array[(slice(None), *index)]
            if (values != values[0]).any():
                columns[".".join([key, *map(str, index)])] = values
        return array[0].tolist()

    chain = {
        "joints": list(m.joints),
        "driven": list(m.driven),
        "orientation": first("chain.orientation", m.orientation),
        "axes": first("chain.axes", m.axes),
        "origins_m": first("chain.origins_m", m.origins),
        "angles_rad": first("chain.angles_rad", m.angles),
        "vertex_m": first("chain.vertex_m", m.vertex),
        "normal": first("chain.normal", m.normal),
    }
    drives = {}
    for d, joint in enumerate(m.driven):
        table = m.drives.table[:, d]
        key = m.joints[joint]
        numbers = {n: float(table[0, i]) for n, i in _RAW.items()}
        for n, i in _RAW.items():
            if (table[:, i] != table[0, i]).any():
                columns[f"drives.{key}.{n}"] = table[:, i]
        drives[key] = {"kind": "raw", "numbers": numbers}
    document: dict[str, Any] = {"kind": m.kind, "chain": chain, "drives": drives}
    if heliostats.machines:
        document["machine"] = _machine_document(heliostats, first)
    document |= mirror_document(name, heliostats, first, place)
    own = [row.name for row in m.own if row.name in heliostats.parameters]
    if own:
        raise InputError(
            f"group {name}: parameter {own[0]} belongs to a user-defined joint, which a plant "
            "file cannot hold; write the plant without it"
        )
    for parameter, values in heliostats.parameters.items():
        columns[f"parameters.{_column(m, parameter)}"] = values
    return document, columns


def _machine_document(
    heliostats: Heliostats, first: Callable[[str, npt.NDArray[Any]], Any]
) -> dict[str, Any]:
    """Return the machine table; ``first`` puts numbers that differ into columns."""
    machines, m = heliostats.machines, heliostats.mechanism
    joints = [m.joints[d] for d in m.driven]
    axes = {}
    keys = {
        "min_steps": "low",
        "max_steps": "high",
        "rate_steps_per_s": "rate",
        "acceleration_steps_per_s2": "acceleration",
        "backlash_steps": "backlash",
    }
    for i, joint in enumerate(joints):
        where = f"machine.axes.{joint}"
        axes[joint] = {
            key: first(
                f"{where}.{key}", np.array([getattr(machine.axes[i], name) for machine in machines])
            )
            for key, name in keys.items()
        }
    document: dict[str, Any] = {
        "stow_steps": first("machine.stow_steps", np.array([machine.stow for machine in machines])),
        "defocus_rad": first(
            "machine.defocus_rad", np.array([machine.defocus for machine in machines])
        ),
        "defocus_spread": 0.0,  # the angles of each heliostat are written
        "leaves_stow_first": joints[machines[0].azimuth_axis],
    }
    if machines[0].standby is not None:
        standby = np.array([machine.standby for machine in machines])
        document["standby_m"] = first("machine.standby_m", standby)
    if machines[0].way:
        document["way_m"] = [list(point) for point in machines[0].way]
    if (stepping := machines[0].stepping) is not None:
        document["stepping"] = {
            "microsteps": list(stepping.microsteps),
            "rests": stepping.rests,
        }
    if machines[0].stow_lights:
        document["stow_lights"] = True
    if machines[0].tilt_sensor:
        document["tilt_sensor"] = True
    return {**document, "axes": axes}
