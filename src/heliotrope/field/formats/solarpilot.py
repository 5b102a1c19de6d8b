"""Field layouts: text tables with one heliostat per line, with a header or in SolarPILOT's form.

A header, if present, is read: names or ids, and positions in metres (``id,x,y,z``) or in degrees
(``id,latitude,longitude,altitude``); a header without positions is rejected. SolarPILOT identifies
columns by position, so without a header the columns are::

    14 columns   template, enabled, in layout, x, y, z, focus x, focus y,
                 cant i, cant j, cant k, aim x, aim y, aim z
    12 columns   the same without the two flags (older versions)
     6 and 4     the columns up to z of either

x is east, y north, z up, in m; z = 0 is the height of the pivots on level ground, so a location is
the position of a pivot, and an aim point is relative to the same origin. The optional groups focus,
cant and aim are numbers, or NULL for "to be computed". The separator is a comma, a semicolon, a tab
or spaces; in text passed on by other programs, records may end with a semicolon instead of a line
end.

SolarPILOT's exports begin with two lines (names, units). With 14 columns the names list "In layout"
before "Enabled", but in the data "enabled" comes first, as SolarPILOT reads it; the flags are
therefore taken in that order whatever their names.

These facts come from the sources of SolarPILOT and of its underlying library (National Renewable
Energy Laboratory).
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats._plant_table import PLAUSIBLE, plausible
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.files import Rows, alike, read_cells, rows_under, write_text
from heliotrope.files.cells import SEPARATORS
from heliotrope.geometry import FloatArray, geodetic_to_enu
from heliotrope.mechanism.kinds import UP, azimuth_elevation
from heliotrope.sun import Site

#: Names and units of the columns, in order, as SolarPILOT's exports should have them.
COLUMNS = (
    ("Template", ""), ("Enabled", ""), ("In layout", ""),
    ("Loc. X", "[m]"), ("Loc. Y", "[m]"), ("Loc. Z", "[m]"),
    ("X focus", "[m]"), ("Y focus", "[m]"),
    ("Cant vect.", "<i>"), ("Cant vect.", "<j>"), ("Cant vect.", "<k>"),
    ("Aim pt. X", "[m]"), ("Aim pt. Y", "[m]"), ("Aim pt. Z", "[m]"),
)  # fmt: skip
#: Possible numbers of columns, and whether the two flags are among them.
WIDTHS = {14: True, 12: False, 6: True, 4: False}
#: Meanings of the columns, in order, and the three that occur in both kinds.
_MEANINGS = (
    "template", "enabled", "in layout", "x", "y", "z", "focus x", "focus y", "cant i", "cant j",
    "cant k", "aim x", "aim y", "aim z",
)  # fmt: skip
#: Header names accepted for each meaning, without units, blanks and punctuation; the preferred name
#: first.
_NAMES = {
    "name": "name heliostatname heliostat heliostatid helioid hid id label number no nr",
    "template": "template templateid heliostattemplate",
    "enabled": "enabled isenabled",
    "in layout": "inlayout isinlayout",
    "x": "x locx xloc locationx xlocation posx xpos positionx xposition east easting",
    "y": "y locy yloc locationy ylocation posy ypos positiony yposition north northing",
    "z": "z locz zloc locationz zlocation posz zpos positionz zposition up",
    "focus x": "xfocus focusx",
    "focus y": "yfocus focusy",
    "cant i": "canti",
    "cant j": "cantj",
    "cant k": "cantk",
    "aim x": "aimptx aimx",
    "aim y": "aimpty aimy",
    "aim z": "aimptz aimz",
    "latitude": "latitude lat",
    "longitude": "longitude long lon lng",
    "altitude": "altitude alt height elevation",
}
#: Meaning of each name, and the rank of the name for this meaning.
_KNOWN = {n: (meaning, k) for meaning, ns in _NAMES.items() for k, n in enumerate(ns.split())}
#: Names of three adjacent columns, and the axes that distinguish them.
_THREE = {"cantvect": "ijk", "cant": "ijk", "aim": "xyz", "aimpt": "xyz"}
_METRES, _DEGREES = ("x", "y", "z"), ("latitude", "longitude", "altitude")
_GROUPS = (("focus x", "focus y"), ("cant i", "cant j", "cant k"), ("aim x", "aim y", "aim z"))
_UNIT = re.compile(r"\s*(?:[\[(<]\s*(.*?)\s*[\])>]|[_/](mm|cm|km|m|ft|deg|rad))\s*", re.IGNORECASE)
#: Pattern of a cell that begins like a number.
_NUMBERED = re.compile(r"[-+]?\d")
_EXAMPLE = (
    "use id,x,y,z (m east, north, up), id,latitude,longitude,altitude (degrees, m), or the "
    "columns of SolarPILOT"
)
_NULL = "null"
_WHAT = "a table of heliostats (SolarPILOT or OpenCSP)"


@dataclass(frozen=True, eq=False)
class Layout:
    """The rows of a layout file.

    Attributes
    ----------
    template
        Number of the heliostat template, (N,).
    enabled, in_layout
        (N,).
    location
        Positions of the pivots, m east, north and above the base pivot, (N, 3).
    focus
        Focal lengths in x and y, m, (N, 2); NaN for NULL in the file.
    cant
        Canting vectors, (N, 3); NaN for NULL.
    aim
        Aim points, m, in the frame of the locations, (N, 3); NaN for NULL.
    names
        Unique names; H1, H2, … by row number if the file has none.
    unread
        Columns of the file that are not read.
    """

    template: npt.NDArray[np.int64]
    enabled: npt.NDArray[np.bool_]
    in_layout: npt.NDArray[np.bool_]
    location: FloatArray
    focus: FloatArray
    cant: FloatArray
    aim: FloatArray
    names: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.names:
            object.__setattr__(self, "names", tuple(f"H{i + 1}" for i in range(len(self))))

    def __len__(self) -> int:
        return len(self.template)


@dataclass(frozen=True)
class Template:
    """The dimensions of a heliostat, which a layout does not contain.

    Attributes
    ----------
    width, height
        Size of the mirror, m.
    pivot_height
        Height of the axes above the foot, m.
    pivot_offset
        Distance of the mirror's surface in front of the pivot, m.
    """

    width: float
    height: float
    pivot_height: float = 0.0
    pivot_offset: float = 0.0


def read_layout(path: str | Path, site: Site | None = None) -> Layout:
    """Read a layout file.

    Parameters
    ----------
    path
        A table with a header, or without a header and with 14, 12, 6 or 4 columns.
    site
        The plant's reference point; only positions in degrees need it.

    Raises
    ------
    FormatError
        If the file cannot be read, or has no rows, a header without positions, rows of differing
        length, or a cell that is invalid for its column; the text states line and column.
    """
    file = Path(path)
    places, table = read_cells(file, _WHAT, separators=f"{SEPARATORS} ", record_end=";")
    first = next((i for i, cells in enumerate(table) if any(map(_is_value, cells))), len(table))
    head, place = table[:first], places[0]
    if first == 0:
        header, columns = _by_position(file, place, table)
    else:
        header, columns = _by_header(file, place, head)
    rows = rows_under(file, (place, header), places[first:], table[first:])
    if not len(rows):
        raise FormatError(file, "there are no heliostats; write one line per heliostat")
    names = rows.names(columns["name"], "heliostat") if "name" in columns else ()
    rows.heliostat = names
    focus, cant, aim = (_group(rows, columns, group) for group in _GROUPS)
    layout = Layout(
        _templates(rows, columns.get("template")),
        _flags(rows, columns.get("enabled")),
        _flags(rows, columns.get("in layout")),
        _location(rows, columns, site),
        focus,
        cant,
        aim,
        names,
        tuple(name for name in rows.columns if name not in columns.values()),
    )
    rows.refuse_bad()
    if first == 0 and len(layout) > 1 and len(set(layout.template)) == len(layout):
        raise FormatError(
            file,
            "column 1 has a different number in each row, like ids, but without a header it is "
            "read as the template; begin the file with a line such as id,x,y,z",
            place,
        )
    return layout


def _by_position(
    file: Path, place: str, table: list[list[str]]
) -> tuple[list[str], dict[str, str]]:
    """Return the column names of a file without a header, and the same names by meaning."""
    width = max(k + 1 for k, cell in enumerate(table[0]) if cell)
    if width not in WIDTHS:
        raise FormatError(
            file,
            f"{width} columns; a layout has 14 (template, enabled, in layout, location, focus, "
            "cant, aim), 12 (without the flags), 6 or 4 (up to the location), or a header; "
            "write decimals with a point",
            place,
        )
    kept = [k for k in range(14) if WIDTHS[width] or k not in {1, 2}][:width]
    header = [f"{i + 1} ({_column_name(k)})" for i, k in enumerate(kept)]
    return header, {_MEANINGS[k]: name for k, name in zip(kept, header, strict=True)}


def _by_header(file: Path, place: str, head: list[list[str]]) -> tuple[list[str], dict[str, str]]:
    """Return the column names of a header, made unique, and the known names by meaning.

    ``head`` contains the rows without a number: names, and units if there are two rows.
    """
    width = max(k + 1 for cells in head for k, cell in enumerate(cells) if cell)
    names, units = ([*row, *[""] * width][:width] for row in (head[0], (*head[1:2], [])[0]))
    if len(head) > 2 or not all(_UNIT.fullmatch(unit) for unit in units if unit):
        cell = next((cell for cells in head[1:] for cell in cells if _NUMBERED.match(cell)), "")
        advice = f" ({cell!r:.30} is not a plain number: write metres without the unit)"
        text = f"no number below the header{advice if cell else ''}; {_EXAMPLE}"
        raise FormatError(file, text, place)
    header: list[str] = []
    by_meaning: dict[str, list[tuple[int, str]]] = {}
    for cell, below in zip(names, units, strict=True):
        unit = _UNIT.search(below or cell)
        form = _form(cell if below else _UNIT.sub("", cell))
        if form in _THREE:
            axis = _THREE[form][sum(name.startswith(f"{cell} <") for name in header) % 3]
            form = f"{form[: 4 if form[0] == 'c' else 3]}{axis}"
            header.append(f"{cell} <{axis}>")
        else:
            header.append(cell)
        meaning, rank = _KNOWN.get(form, ("", 0))
        expected = "deg" if meaning in _DEGREES[:2] else "m"
        stated = "" if unit is None else (unit[1] or unit[2] or "").lower()
        if meaning in (*_METRES, *_DEGREES) and stated not in ("", "°", "degrees", expected):
            raise FormatError(file, f"column {cell} is in {stated}; use {expected}", place)
        by_meaning.setdefault(meaning, []).append((rank, header[-1]))
    unknown = {_form(name) for _, name in by_meaning.pop("", ())}
    if {"group", "eastm"} <= {_form(name) for name in names} | unknown:
        text = "this is the table of a plant file; open the plant file (.toml) that names it"
        raise FormatError(file, text, place)
    if unknown & {"unit", "units"}:
        text = "unit columns are not read; use metres, or degrees and metres, and remove the column"
        raise FormatError(file, text, place)
    for meaning, all_ in by_meaning.items():
        all_.sort()
        if len(all_) > 1 and (meaning != "name" or all_[0][0] == all_[1][0]):
            raise FormatError(file, f"two columns hold {meaning}; keep one", place)
    columns = {meaning: entries[0][1] for meaning, entries in by_meaning.items()}
    if not any(all(axis in columns for axis in axes) for axes in (_METRES, _DEGREES)):
        shown = ", ".join(name[:30] for name in names[:8])
        raise FormatError(
            file, f"the header ({shown}) names no position columns; {_EXAMPLE}", place
        )
    if all(axis in columns for axis in _METRES):
        # Additional positions in degrees are not read.
        columns = {meaning: name for meaning, name in columns.items() if meaning not in _DEGREES}
    flags = [columns.get("enabled", ""), columns.get("in layout", "")]
    if "template" in columns and all(flags):
        columns["enabled"], columns["in layout"] = sorted(flags, key=header.index)
    return header, columns


def _form(name: str) -> str:
    return re.sub(r"[\W_]", "", alike(name))


def _templates(rows: Rows, column: str | None) -> npt.NDArray[np.int64]:
    numbers = np.zeros(len(rows), dtype=np.int64)
    for i, cell in enumerate(rows.texts(column) if column else ()):
        if cell.isascii() and cell.isdigit() and len(cell) < 10:
            numbers[i] = int(cell)
        else:
            rows.refuse(i, column or "", f"{cell!r:.60} is not a template's number (0, 1, …)")
    return numbers


def _flags(rows: Rows, column: str | None) -> npt.NDArray[np.bool_]:
    if column is None:
        return np.ones(len(rows), dtype=np.bool_)
    advice = (
        f"write 0 or 1; with {len(rows.columns)} columns a row begins with template, enabled, in "
        "layout"
    )
    return rows.flags(column, advice)


def _location(rows: Rows, columns: dict[str, str], site: Site | None) -> FloatArray:
    """Return positions, m east, north and up, (N, 3)."""
    if all(axis in columns for axis in _METRES):
        meanings = zip(_METRES, ("east_m", "north_m", "up_m"), strict=True)
        return np.stack([plausible(rows, columns[a], meaning) for a, meaning in meanings], axis=-1)
    if site is None:
        raise FormatError(rows.path, "positions are in degrees; specify the site", rows.header)
    latitude, longitude, altitude = (
        plausible(rows, columns[axis], meaning)
        for axis, meaning in zip(
            _DEGREES, ("latitude_deg", "longitude_deg", "altitude_m"), strict=True
        )
    )
    location, good = np.zeros((len(rows), 3)), rows.good
    location[good] = geodetic_to_enu(latitude[good], longitude[good], altitude[good], site.origin)
    for axis, values, metres in zip(
        _DEGREES, (latitude, longitude, altitude), location[:, [1, 0, 2]].T, strict=True
    ):
        low, high, unit = PLAUSIBLE["up_m" if axis == "altitude" else "east_m"]
        far = ~((metres >= low) & (metres <= high))
        reason = f" puts it outside {low:g} to {high:g} {unit}; correct it, or the site"
        rows.check(columns[axis], far, values, reason)
    return location


def _group(rows: Rows, columns: dict[str, str], group: tuple[str, ...]) -> FloatArray:
    """Return some columns, whose entries in a row are all numbers or all NULL.

    NULL and empty entries become NaN.
    """
    if not all(meaning in columns for meaning in group):
        return np.full((len(rows), len(group)), np.nan)
    names = [columns[meaning] for meaning in group]
    for name in names:
        rows.columns[name] = ["" if c.lower() == _NULL else c for c in rows.texts(name)]
    values = np.stack([rows.numbers(name, "a number or NULL", np.nan) for name in names], axis=-1)
    missing = np.isnan(values)
    for i in np.flatnonzero(missing.any(axis=1) & ~missing.all(axis=1)):
        what = f"all {len(group)} columns of {group[0].split()[0]} are numbers or NULL"
        rows.refuse(i, names[int(np.argmax(missing[i]))], f"NULL mixed with numbers; {what}")
    return values


def write_layout(path: str | Path, layout: Layout) -> None:
    """Write a layout in 14 columns, as SolarPILOT exports it, completely or not at all."""
    lines = [",".join(part) for part in zip(*COLUMNS, strict=True)]
    groups = (layout.location, layout.focus, layout.cant, layout.aim)
    for i in range(len(layout)):
        flags = [int(layout.template[i]), int(layout.enabled[i]), int(layout.in_layout[i])]
        numbers = [
            "NULL" if np.isnan(value) else repr(float(value))
            for group in groups
            for value in group[i]
        ]
        lines.append(",".join([*(str(flag) for flag in flags), *numbers]))
    write_text(path, "\n".join(lines) + "\n")


def _column_name(k: int) -> str:
    name, unit = COLUMNS[k]
    return f"{name} {unit}" if unit.startswith("<") else name


def _is_value(cell: str) -> bool:
    if cell.lower() == _NULL:
        return True
    try:
        # A number with a decimal comma counts as a number, which is refused later.
        float(cell.replace(",", ""))
    except ValueError:
        return False
    return True


def to_plant(layout: Layout, site: Site, templates: Mapping[int, Template]) -> Plant:
    """Return the plant of a layout: azimuth-elevation heliostats, one group per template.

    The origin of ENU is SolarPILOT's, so up = 0 is the height of the base pivot, and the
    heliostats' feet are ``pivot_height`` lower. Heliostats that are not enabled or not in the
    layout are left out and named in ``notes``, as are columns that were not read. Focus and cant
    are not part of a plant and stay in the layout.

    Parameters
    ----------
    layout
        From `read_layout`.
    site
        The plant's reference point.
    templates
        Dimensions of the heliostats, by template number.

    Raises
    ------
    InputError
        If a template is not specified, or no heliostat is in use.
    """
    used = layout.enabled & layout.in_layout
    if not used.any():
        raise InputError("layout: no heliostat is both enabled and in the layout")
    for i in np.flatnonzero(used):
        if int(layout.template[i]) not in templates:
            known = ", ".join(str(number) for number in sorted(templates)) or "none"
            which = f"heliostat {layout.names[i]}: template {layout.template[i]}"
            raise InputError(f"{which} is not among the specified templates ({known})")
    groups = {}
    for number in np.unique(layout.template[used]).tolist():
        rows = np.flatnonzero(used & (layout.template == number))
        template = templates[number]
        aim = layout.aim[rows]
        groups[f"template-{number}"] = Heliostats(
            names=tuple(layout.names[i] for i in rows),
            mechanism=azimuth_elevation(
                layout.location[rows] - template.pivot_height * UP,
                pivot_height=template.pivot_height,
                pivot_offset=template.pivot_offset,
            ),
            width=np.full(len(rows), template.width),
            height=np.full(len(rows), template.height),
            aim=None if np.isnan(aim).all() else aim,
        )
    left_out = [layout.names[i] for i in np.flatnonzero(~used)]
    lists = {"left out": left_out, "columns not read": layout.unread}
    notes = {subject: ", ".join(names) for subject, names in lists.items() if names}
    return Plant(site.name, site, groups, notes=notes)
