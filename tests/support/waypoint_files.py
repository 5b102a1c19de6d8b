"""Readers of waypoint files, to check by other code what the plan of a drone wrote."""

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.airborne.plan import waypoints
from heliotrope.airborne.plan.waypoints import Mission
from heliotrope.errors import FormatError
from heliotrope.files.archives import read_members
from heliotrope.files.json import read_json
from heliotrope.files.limits import MIB
from heliotrope.files.text import read_text

_WPMZ, _KML, _LITCHI_HEADER = waypoints._WPMZ, waypoints._KML, waypoints._LITCHI_HEADER
#: MAVLink's commands, as QGroundControl's plan holds them.
_WAYPOINT, _SPEED, _GIMBAL, _PHOTO = 16, 178, 205, 2000


def read_litchi(path: str | Path) -> Mission:
    """Return the flight of a Litchi CSV; values that the file does not hold are 0.

    Raises
    ------
    FormatError
        If it is not such a file.
    """
    text = read_text(path, "a Litchi CSV")
    rows = list(csv.reader(io.StringIO(text, newline="")))
    if rows[0] != _LITCHI_HEADER:
        raise FormatError(path, "the header is not Litchi's in metres with 15 actions", "line 1")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(_LITCHI_HEADER):
            raise FormatError(
                path, f"{len(row)} cells instead of {len(_LITCHI_HEADER)}", f"line {number}"
            )
    try:
        table = np.array([[float(cell) for cell in row] for row in rows[1:]])
    except ValueError as error:
        raise FormatError(path, f"a cell is not a number ({error})") from None
    table = table.reshape(-1, len(_LITCHI_HEADER))
    kind, value = table[:, 8:38:2], table[:, 9:38:2]
    if not len(table) or (np.abs(table[:, 0]) > 90.0).any() or (np.abs(table[:, 1]) > 180.0).any():
        raise FormatError(path, "no waypoint, or a latitude or longitude out of its range")
    return Mission(
        Path(path).stem,
        table[:, 0],
        table[:, 1],
        table[:, 2],
        table[:, 3],
        table[:, 7],
        1e-3 * np.where(kind == 0, value, 0.0).sum(axis=1),
        (kind == 1).any(axis=1),
        float(table[0, 39]),
        (0.0, 0.0, 0.0),
        0.0,
    )


def read_wpml(path: str | Path) -> Mission:
    """Return the flight of the executable wayline in a KMZ.

    Raises
    ------
    FormatError
        If it is not such a file.
    """
    from lxml import etree

    file, names = Path(path), ("wpmz/template.kml", "wpmz/waylines.wpml")
    members = read_members(file, f"a KMZ with {' and '.join(names)}", names, most=4 * MIB)
    text = {name.removeprefix("wpmz/"): body for name, body in members.items()}
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    try:
        roots = {name: etree.fromstring(body, parser) for name, body in text.items()}
    except etree.XMLSyntaxError as error:
        raise FormatError(file, f"not XML ({error})") from None
    spaces = {"k": _KML, "w": _WPMZ}
    marks = roots["waylines.wpml"].findall(".//k:Placemark", spaces)
    config = roots["template.kml"].find(".//w:missionConfig", spaces)

    def value(node: Any, name: str) -> str:
        found = None if node is None else node.findtext(f".//{name}", None, spaces)
        if found is None:
            raise FormatError(file, f"element {name.replace('w:', 'wpml:')} is missing")
        return str(found).strip()

    try:
        place = np.array([[float(v) for v in value(m, "k:coordinates").split(",")] for m in marks])
        pitch = [m.findtext(".//w:gimbalPitchRotateAngle", "0", spaces) for m in marks]
        stay = [m.findtext(".//w:hoverTime", "0", spaces) for m in marks]
        kinds = [[a.text for a in m.findall(".//w:actionActuatorFunc", spaces)] for m in marks]
        return Mission(
            Path(path).stem,
            place[:, 1],
            place[:, 0],
            np.array([float(value(m, "w:executeHeight")) for m in marks]),
            np.array([float(value(m, "w:waypointHeadingAngle")) for m in marks]) % 360.0,
            np.array(pitch, dtype=np.float64),
            np.array(stay, dtype=np.float64),
            np.array(["takePhoto" in kind for kind in kinds]),
            float(value(roots["waylines.wpml"], "w:autoFlightSpeed")),
            _triple(value(config, "w:takeOffRefPoint")),
            float(value(roots["waylines.wpml"], "w:globalRTHHeight")),
        )
    except (ValueError, IndexError) as error:
        raise FormatError(file, f"a number cannot be read ({error})") from None


def _triple(text: str) -> tuple[float, float, float]:
    a, b, c = (float(v) for v in re.split(r"\s*,\s*", text))
    return a, b, c


def read_qgc(path: str | Path) -> Mission:
    """Return the flight of a QGroundControl plan.

    Raises
    ------
    FormatError
        If it is not such a plan, or has items that are not simple.
    """
    root = read_json(path, "a QGroundControl plan")
    if root["fileType"].text() != "Plan" or root["version"].number() != 1:
        raise root.fail('fileType must be "Plan" and version 1')
    mission = root["mission"]
    rows: list[list[float]] = []
    tilt = speed = 0.0
    for item in mission["items"].elements():
        if item["type"].text() != "SimpleItem":
            raise item.fail("a complex item; only simple ones can be read")
        command, params = int(item["command"].number()), item["params"].elements()
        if command == _SPEED:
            speed = params[1].number()
        elif command == _GIMBAL:
            tilt = params[0].number()
        elif command == _WAYPOINT:
            lat, lon = params[4].number(-90.0, 90.0), params[5].number(-180.0, 180.0)
            rows.append(
                [lat, lon, params[6].number(), params[3].number(), 0.0, params[0].number(), 0.0]
            )
        elif command == _PHOTO and rows:
            rows[-1][4], rows[-1][6] = tilt, 1.0
    table = np.array(rows).reshape(-1, 7)
    return Mission(
        Path(path).stem,
        table[:, 0],
        table[:, 1],
        table[:, 2],
        table[:, 3],
        table[:, 4],
        table[:, 5],
        table[:, 6] > 0.0,
        speed,
        mission["plannedHomePosition"].vector(),
        0.0,
    )
