"""Our own format: one TOML file for the plant, with a table of its heliostats beside it.

The TOML file contains what all heliostats share (site, tower, kinds of mechanism, drives); the
table contains what differs: name, group, position, and any number of the group that differs between
heliostats, in a column with its dotted name. Files are written at full precision, so that a plant
reads back exactly as it was.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.canting import cant
from heliotrope.field.formats._plant_aims import aims_document, build_aims
from heliotrope.field.formats._plant_cameras import (
    build_camera,
    build_mark,
    camera_document,
    mark_document,
)
from heliotrope.field.formats._plant_coded import build_joint, build_receiver_visits, coded_document
from heliotrope.field.formats._plant_groups import build_group, group_document
from heliotrope.field.formats._plant_models import (
    ApprovalTable,
    PlantDocument,
    TargetTable,
    TimetableTable,
    TowerTable,
)
from heliotrope.field.formats._plant_receivers import build_receiver, receiver_document
from heliotrope.field.formats._plant_table import HeliostatColumns, read_table, write_table
from heliotrope.field.formats._plant_volumes import build_volume, volume_document
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.field.timetable import TimetableEntry
from heliotrope.field.tower import Tower
from heliotrope.files import write_text
from heliotrope.files.documents import read_document
from heliotrope.geometry import FloatArray, direction
from heliotrope.safety import CONDITIONS, limited
from heliotrope.sun import Site

Table = TypeVar("Table")
Made = TypeVar("Made")


@dataclass(frozen=True)
class Finding:
    """An error or a warning about a plant file, and the place in its TOML file ("": unknown)."""

    severity: Literal["error", "warning"]
    text: str
    where: str = ""


def read_plant(path: str | Path) -> Plant:
    """Return the plant from a TOML file and the table that the file names.

    Raises
    ------
    FormatError
        If a value cannot be used; the message names file, place, value and limit, and how many more
        problems there are.
    """
    document = read_document(path, "plant", PlantDocument, _MODELS)
    table = read_table(Path(path).parent / document.heliostats)
    problems = list(table.problems)
    plant = None
    if not problems:
        plant = _assemble(Path(path), document, table, problems)
    if problems or plant is None:
        more = len(problems) - 1
        hint = f" (and {more} more: heliotrope field check shows all)" if more else ""
        first = problems[0]
        raise FormatError(first.path, first.problem + hint, first.where)
    return plant


def _models() -> list[Any]:
    from heliotrope.field.formats import _plant_models as models

    return [
        models.PlantDocument,
        models.PlantNameTable,
        models.PlantSiteTable,
        models.TargetTable,
        models.MarkTable,
        models.ReceiverTable,
        models.TowerTable,
        models.CameraTable,
        models.GroupTable,
        models.ChainTable,
        models.MirrorTable,
        models.FacetTable,
        models.MachineTable,
        models.AxisTable,
        models.RotaryDrive,
        models.LinearDrive,
        models.BoxTable,
        models.SphereTable,
        models.CylinderTable,
        models.PrismTable,
        models.JointVisitsTable,
        models.TimetableTable,
        models.ApprovalTable,
        models.AimsTable,
    ]


_MODELS = _models()


def _assemble(
    path: Path, document: PlantDocument, table: HeliostatColumns, problems: list[FormatError]
) -> Plant | None:
    """Build the plant; errors are added to ``problems``."""
    site = Site(
        document.site.latitude_deg,
        document.site.longitude_deg,
        document.site.height_m,
        pressure=document.site.pressure_pa,
        temperature_c=document.site.temperature_c,
        name=document.site.name,
        delta_t=document.site.delta_t_s,
    )
    groups = _groups(path, document, table, site, problems)
    targets = _all_built(path, "targets", document.targets, _target, problems)
    receivers = _all_built(
        path, "receivers", document.receivers, lambda t: build_receiver(t, path.parent), problems
    )
    towers = _all_built(path, "towers", document.towers, _tower, problems)
    cameras = _all_built(path, "cameras", document.cameras, build_camera, problems)
    keep_outs = _all_built(path, "keep_out", document.keep_out, build_volume, problems)
    eyes = {name: np.array(point) for name, point in document.eyes_m.items()}
    joint = _built(path, "joint_visits", document.joint_visits, build_joint, problems)
    settings = document.receiver_visits
    receiver = _built(path, "receiver_visits", settings, build_receiver_visits, problems)
    timetable = _all_built(path, "timetable", document.timetable, _timetable_entry, problems)
    approval = _built(path, "approval", document.approval, _approval, problems)
    aims = _built(path, "aims", document.aims, lambda t: build_aims(t, path.parent), problems)
    _built(
        path,
        "safety",
        document.safety,
        lambda settings: limited(CONDITIONS, settings or {}),
        problems,
    )
    if problems or approval is None or aims is None:
        return None
    try:
        plant = Plant(
            document.plant.name,
            site,
            groups,
            targets,
            receivers,
            cameras=cameras,
            keep_outs=keep_outs,
            eyes=eyes,
            joint_visits=joint,
            receiver_visits=receiver,
            timetable=timetable,
            safety=document.safety,
            approval=approval,
            aims=aims,
            towers=towers,
        )
        return cant(plant)
    except InputError as error:
        problems.append(FormatError(path, str(error)))
        return None


def _groups(
    path: Path,
    document: PlantDocument,
    table: HeliostatColumns,
    site: Site,
    problems: list[FormatError],
) -> dict[str, Heliostats]:
    """Build the groups of heliostats; errors are added to ``problems``."""
    groups = {}
    for group in sorted(set(table.group) - set(document.groups)):
        known = ", ".join(document.groups)
        problems.append(
            FormatError(table.path, f"group {group!r} is not in {path.name}; known: {known}")
        )
    for name, group_table in document.groups.items():
        try:
            rows = np.flatnonzero(np.array(table.group) == name)
            if len(rows):
                groups[name] = build_group(path, name, group_table, table, rows, site)
        except FormatError as error:
            problems.append(error)
        except InputError as error:
            problems.append(FormatError(path, str(error), f"groups.{name}"))
    return groups


def _built(
    path: Path,
    key: str,
    table: Table | None,
    build: Callable[[Table | None], Made | None],
    problems: list[FormatError],
) -> Made | None:
    """Build an object from a table that may be missing; an error is added to ``problems``."""
    try:
        return build(table)
    except InputError as error:
        problems.append(FormatError(path, str(error), key))
        return None


def _all_built(
    path: Path,
    key: str,
    tables: Sequence[Table],
    build: Callable[[Table], Made],
    problems: list[FormatError],
) -> tuple[Made, ...]:
    """Build one object from each table of an array; errors are added to ``problems``."""
    made = []
    for k, table in enumerate(tables):
        try:
            made.append(build(table))
        except InputError as error:
            problems.append(FormatError(path, str(error), f"{key}[{k}]"))
    return tuple(made)


def _timetable_entry(table: TimetableTable) -> TimetableEntry:
    return TimetableEntry.of(table.model_dump())


def _approval(table: ApprovalTable | None) -> ApprovalSettings:
    if table is None:
        return ApprovalSettings()
    return ApprovalSettings(table.parameters, table.within_s)


def _tower(table: TowerTable) -> Tower:
    return Tower(table.east_m, table.north_m, table.radius_m, table.bottom_m, table.top_m)


def _tower_document(tower: Tower) -> dict[str, float]:
    return {f"{key}_m": value for key, value in vars(tower).items()}


def _target(table: TargetTable) -> Target:
    markers = {name: np.array(point) for name, point in table.markers_m.items()}
    marks = tuple(build_mark(mark) for mark in table.marks)
    if table.corners_m is not None:
        corners = np.array(table.corners_m)
        center = corners.mean(axis=0) if table.center_m is None else np.array(table.center_m)
        return Target(table.name, corners, center, markers, marks)
    size = (table.center_m, table.width_m, table.height_m, table.facing_deg)
    if any(value is None for value in size):
        raise InputError(
            f"target {table.name}: specify corners_m, or center_m, width_m, height_m and facing_deg"
        )
    center = np.array(table.center_m)
    corners = rectangle(center, size[1] or 0.0, size[2] or 0.0, np.radians(size[3] or 0.0))
    return Target(table.name, corners, center, markers, marks)


def rectangle(center: FloatArray, width: float, height: float, facing: float) -> FloatArray:
    """Return the corners (4, 3) of an upright rectangle whose front faces azimuth ``facing``.

    Corners are in order from the upper left, as seen from the front; metres and radians.
    """
    # Seen from the front, right is a quarter turn anticlockwise from the facing direction.
    right = 0.5 * width * direction(facing - 0.5 * np.pi, 0.0)
    up = np.array([0.0, 0.0, 0.5 * height])
    return np.stack(
        [center - right + up, center + right + up, center + right - up, center - right - up]
    )


def write_plant(plant: Plant, path: str | Path, table: Literal["csv", "parquet"] = "csv") -> None:
    """Write the TOML file and, beside it, the table of the heliostats.

    Both files are written under temporary names and then renamed, the table first, so that a reader
    never sees an incomplete file.

    Parameters
    ----------
    plant
        Any plant; calibrated parameters are included.
    path
        TOML file; the table has the same name with another suffix.
    table
        Format of the table, "csv" or "parquet".

    Raises
    ------
    InputError
        If the folder cannot be written to.
    """
    import tomli_w

    place = Path(path)
    other = place.with_suffix(f".{table}")
    columns: list[Mapping[str, Any]] = []
    groups = {}
    for name, heliostats in plant.groups.items():
        groups[name], varying = group_document(name, heliostats, place)
        columns.append(varying)
    write_table(columns, other)
    document = {
        "format": "heliotrope-plant",
        "version": 1,
        "heliostats": other.name,
        "plant": {"name": plant.name},
        "site": {
            "latitude_deg": plant.site.latitude_deg,
            "longitude_deg": plant.site.longitude_deg,
            "height_m": plant.site.height,
            **({} if plant.site.pressure is None else {"pressure_pa": plant.site.pressure}),
            "temperature_c": plant.site.temperature_c,
            **({} if plant.site.delta_t is None else {"delta_t_s": plant.site.delta_t}),
            **({"name": plant.site.name} if plant.site.name else {}),
        },
        "targets": [
            {
                "name": t.name,
                "center_m": t.center.tolist(),
                "corners_m": t.corners.tolist(),
                "markers_m": {k: np.asarray(v).tolist() for k, v in t.markers.items()},
                "marks": [mark_document(mark) for mark in t.marks],
            }
            for t in plant.targets
        ],
        "receivers": [receiver_document(r, k, place) for k, r in enumerate(plant.receivers)],
        **({"towers": [_tower_document(t) for t in plant.towers]} if plant.towers else {}),
        "cameras": [camera_document(camera) for camera in plant.cameras],
        "keep_out": [volume_document(volume) for volume in plant.keep_outs],
        "eyes_m": {name: np.asarray(point).tolist() for name, point in plant.eyes.items()},
        **coded_document(plant.joint_visits, plant.receiver_visits),
        **({"timetable": [e.document for e in plant.timetable]} if plant.timetable else {}),
        **({"approval": approval} if (approval := plant.approval.document) else {}),
        **aims_document(plant.aims, place),
        **({"safety": {k: dict(v) for k, v in plant.safety.items()}} if plant.safety else {}),
        "groups": groups,
    }
    write_text(place, tomli_w.dumps(document))


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of the TOML file."""
    return {"title": "Heliotrope plant file", **PlantDocument.model_json_schema()}


def check_plant(path: str | Path) -> list[Finding]:
    """Return all errors and warnings about a plant file."""
    return examine_plant(path)[0]


def examine_plant(path: str | Path) -> tuple[list[Finding], Plant | None]:
    """Return all errors and warnings about a plant file, and the plant if there are no errors."""
    place = Path(path)
    try:
        document = read_document(place, "plant", PlantDocument, _MODELS)
        table = read_table(place.parent / document.heliostats)
    except FormatError as error:
        return [_error(place, error)], None
    problems = list(table.problems)
    plant = None if problems else _assemble(place, document, table, problems)
    findings = [_error(place, problem) for problem in problems]
    if plant is None:
        return findings, None
    return findings + [Finding("warning", text) for text in _warnings(plant)], plant


def _error(place: Path, problem: FormatError) -> Finding:
    return Finding("error", str(problem), problem.where if problem.path == str(place) else "")


def _warnings(plant: Plant) -> list[str]:
    texts = []
    if not plant.targets:
        texts.append("there is no target: calibration with a camera is not possible")
    if not plant.receivers:
        texts.append("there is no receiver")
    if plant.aims.limit is not None and plant.aims.limit.unit_hint:
        texts.append(f"aims: {plant.aims.map}: {plant.aims.limit.unit_hint}")
    if len(plant) == 0:
        return [*texts, "there are no heliostats"]
    texts += _crowding(plant)
    surfaces: tuple[Target | Receiver, ...] = (*plant.targets, *plant.receivers)
    for surface in surfaces:
        texts += _placing(plant, surface)
    return texts + _coinciding(surfaces)


def _placing(plant: Plant, surface: Target | Receiver) -> list[str]:
    """Return warnings about unusual features of a surface's position and orientation."""
    what = f"{'target' if isinstance(surface, Target) else 'receiver'} {surface.name}"
    texts, lines = [], plant.position - surface.center
    behind = lines @ surface.normal <= 0.0
    if behind.any() and getattr(surface, "kind", "planar") == "planar":
        example = plant.names[int(np.flatnonzero(behind)[0])]
        texts.append(
            f"{what}: {int(behind.sum())} of {len(plant)} heliostats are behind its plane and "
            f"cannot illuminate it (for example {example})"
        )
    nearest = int(np.argmin(np.linalg.norm(lines, axis=1)))
    size = np.concatenate([np.hypot(g.width, g.height) for g in plant.groups.values()])
    reach = 0.5 * (size[nearest] + np.hypot(surface.width, surface.height))
    if np.linalg.norm(lines[nearest]) < reach:
        texts.append(
            f"{what}: its centre is {np.linalg.norm(lines[nearest]):.2f} m from heliostat "
            f"{plant.names[nearest]}, so the two touch; correct its center_m"
        )
    if surface.center[2] < plant.position[:, 2].min():
        texts.append(
            f"{what}: its centre, {surface.center[2]:.2f} m up, is below every heliostat; "
            "correct its center_m (metres above the site's height)"
        )
    if isinstance(surface, Target) and surface.upside_down:
        texts.append(
            f"{what}: its upper corners lie below its lower ones, so photographs would be read "
            "upside down; list upper left, upper right, lower right, lower left as seen from the "
            "front"
        )
    return texts


def _coinciding(surfaces: Sequence[Target | Receiver]) -> list[str]:
    """Return a warning about the surfaces that share a centre."""
    return [
        f"{one.name} and {other.name} have the same centre; correct one or remove it"
        for one, other in itertools.combinations(surfaces, 2)
        if np.linalg.norm(one.center - other.center) < 0.01
    ]


def _crowding(plant: Plant) -> list[str]:
    from scipy.spatial import cKDTree

    size = np.concatenate([np.hypot(g.width, g.height) for g in plant.groups.values()])
    flat = plant.position[:, :2]
    pairs = cKDTree(flat).query_pairs(float(size.max()), output_type="ndarray")
    if not len(pairs):
        return []
    apart = np.linalg.norm(flat[pairs[:, 0]] - flat[pairs[:, 1]], axis=1)
    close = apart < 0.5 * (size[pairs[:, 0]] + size[pairs[:, 1]])
    if not close.any():
        return []
    i, j = pairs[close][int(np.argmin(apart[close]))]
    text = (
        f"{int(close.sum())} pairs of mirrors can touch: the nearest, {plant.names[i]} and "
        f"{plant.names[j]}, are {apart[close].min():.2f} m apart, with diagonals of "
        f"{size[i]:.2f} m"
    )
    return [text]
