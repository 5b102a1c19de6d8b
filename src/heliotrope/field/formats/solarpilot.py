"""SolarPILOT's field layouts: text tables with one heliostat a line.

SolarPILOT reads a layout by position, not by the names of a header::

    14 columns   template, enabled, in layout, x, y, z, focus x, focus y,
                 cant i, cant j, cant k, aim x, aim y, aim z
    12 columns   the same without the two flags (older versions)
     6 and 4     the columns up to z of either

x is east, y north, z up, in m; z = 0 is the height of the pivots on level ground, so a
location is that of the pivot and an aim point counts from there. The optional groups
focus, cant and aim are numbers, or NULL for "to be computed". The separator is a comma, a
semicolon, a tab or spaces; in the text that other programs hand over, records may end
with a semicolon instead of a line end.

Its exports begin with two lines (names, units). Of the 14 columns they name "In layout"
before "Enabled", but what follows is enabled before in layout, as it is read. Header
lines are therefore skipped unread.

Facts from the sources of SolarPILOT and of the library behind it (National Renewable
Energy Laboratory).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.files import check_table, read_text, write_text
from heliotrope.files.limits import ROWS, check_count
from heliotrope.geometry import FloatArray
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
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}

_FLAGS = {"1": True, "true": True, "t": True, "0": False, "false": False, "f": False}
_NULL = "null"
_WHAT = "a SolarPILOT layout"


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
        Focal lengths in x and y, m, (N, 2); NaN where the file says NULL.
    cant
        Canting vectors, (N, 3); NaN where NULL.
    aim
        Aim points, m, in the frame of the locations, (N, 3); NaN where NULL.
    """

    template: npt.NDArray[np.int64]
    enabled: npt.NDArray[np.bool_]
    in_layout: npt.NDArray[np.bool_]
    location: FloatArray
    focus: FloatArray
    cant: FloatArray
    aim: FloatArray

    def __len__(self) -> int:
        return len(self.template)


@dataclass(frozen=True)
class Template:
    """The dimensions of a heliostat, which a layout does not give.

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


def read_layout(path: str | Path) -> Layout:
    """Read a layout file.

    Parameters
    ----------
    path
        A text file with 14, 12, 6 or 4 columns.

    Raises
    ------
    FormatError
        If the file cannot be read, has no rows, has rows of a wrong or of differing length,
        or a cell that does not fit its column; with line and column.
    """
    file = Path(path)
    rows = _rows(file, read_text(check_table(file, _WHAT), _WHAT))
    width = len(rows[0][1])
    if width not in WIDTHS:
        raise FormatError(
            file,
            f"{width} columns; a layout has 14 (template, enabled, in layout, location, "
            "focus, cant, aim), 12 (without the flags), 6 or 4 (up to the location)",
            f"line {rows[0][0]}",
        )
    flags = WIDTHS[width]
    names = [_column_name(k) for k in range(14) if flags or k not in {1, 2}][:width]
    template = np.empty(len(rows), dtype=np.int64)
    switches = np.ones((len(rows), 2), dtype=np.bool_)
    numbers = np.full((len(rows), 11), np.nan)
    for i, (line, cells) in enumerate(rows):
        if len(cells) != width:
            raise FormatError(
                file, f"{len(cells)} columns, but the first row has {width}", f"line {line}"
            )
        reader = _Row(file, line, names, cells)
        template[i] = reader.whole(0)
        if flags:
            switches[i] = reader.flag(1), reader.flag(2)
        start = 3 if flags else 1
        numbers[i, : width - start] = reader.numbers(start)
    return Layout(
        template,
        switches[:, 0],
        switches[:, 1],
        numbers[:, :3],
        numbers[:, 3:5],
        numbers[:, 5:8],
        numbers[:, 8:],
    )


def write_layout(path: str | Path, layout: Layout) -> None:
    """Write a layout in 14 columns, as SolarPILOT exports it; it is there whole or not at all."""
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


def _rows(file: Path, text: str) -> list[tuple[int, list[str]]]:
    """Return line number and cells of each row behind the header."""
    # A piece with the commas of a whole row between two semicolons is a row.
    if ";" in text and any(piece.count(",") >= min(WIDTHS) - 1 for piece in text.split(";")):
        text = text.replace(";\r\n", "\n").replace(";\n", "\n").replace(";", "\n")
    lines = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip(" ,;\t")]
    check_count(file, len(lines), ROWS, "rows", "divide the layout")
    if not lines:
        raise FormatError(file, "there is no heliostat in it; one line each is needed")
    separator = _separator(lines[-1][1])
    rows = [(n, _cells(line, separator)) for n, line in lines]
    for first, (_, cells) in enumerate(rows):
        if any(_is_value(cell) for cell in cells):
            return rows[first:]
    raise FormatError(
        file, "no line holds a number, so there is no heliostat in it; one line each is needed"
    )


def _separator(line: str) -> str:
    """Return what cuts the line into the most cells, as SolarPILOT chooses."""
    return max(SEPARATORS.values(), key=lambda s: len(_cells(line, s)))


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    cells = [cell.strip().strip('"').strip() for cell in line.split(separator)]
    # SolarPILOT ends the lines of its header with a separator.
    return cells[:-1] if not cells[-1] else cells


def _is_value(cell: str) -> bool:
    if cell.lower() == _NULL:
        return True
    try:
        float(cell)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class _Row:
    """Reads the cells of one row."""

    file: Path
    line: int
    names: Sequence[str]
    cells: Sequence[str]

    def error(self, k: int, problem: str) -> FormatError:
        return FormatError(
            self.file, problem, f"line {self.line}, column {k + 1} ({self.names[k]})"
        )

    def whole(self, k: int) -> int:
        """Return the template's number, from 0."""
        if not self.cells[k].isascii() or not self.cells[k].isdigit() or len(self.cells[k]) > 9:
            raise self.error(k, f"{self.cells[k]!r} is not a template's number (0, 1, …)")
        return int(self.cells[k])

    def flag(self, k: int) -> bool:
        """Return a flag."""
        value = _FLAGS.get(self.cells[k].lower())
        if value is None:
            raise self.error(
                k,
                f"{self.cells[k]!r} is not 0 or 1; {len(self.cells)} columns begin with "
                "template, enabled, in layout",
            )
        return value

    def numbers(self, start: int) -> list[float]:
        """Return the numbers from column ``start`` on; groups behind the location may be NULL."""
        values = [self.number(k) for k in range(start, len(self.cells))]
        for first, count, what in (
            (0, 3, "location"),
            (3, 2, "focus"),
            (5, 3, "cant"),
            (8, 3, "aim"),
        ):
            group = values[first : first + count]
            missing = [math.isnan(value) for value in group]
            if any(missing) and what == "location":
                raise self.error(start + missing.index(True), "NULL; a location needs numbers")
            if any(missing) and not all(missing):
                raise self.error(
                    start + first + missing.index(True),
                    f"NULL beside numbers; all {count} columns of {what} are numbers or NULL",
                )
        return values

    def number(self, k: int) -> float:
        """Return a number, NaN for NULL."""
        cell = self.cells[k]
        if cell.lower() == _NULL:
            return math.nan
        try:
            value = float(cell.replace("_", "?"))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            hint = "write a point, not a comma" if "," in cell else "write a number or NULL"
            raise self.error(k, f"{cell!r} is not a finite number; {hint}")
        return value


def to_plant(layout: Layout, site: Site, templates: Mapping[int, Template]) -> Plant:
    """Return the plant of a layout: azimuth-elevation heliostats, one group a template.

    The origin of ENU is SolarPILOT's, so up = 0 is the height of the base pivot and the
    feet stand ``pivot_height`` lower. Heliostats are named H1, H2, … by their row. Those
    not enabled or not in the layout are left out and named in ``notes``; focus and cant
    have no place in a plant and stay in the layout.

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
        If a template is not among those given, or none of the heliostats is in use.
    """
    used = layout.enabled & layout.in_layout
    if not used.any():
        raise InputError("layout: none of its heliostats is enabled and in the layout")
    for i in np.flatnonzero(used):
        if int(layout.template[i]) not in templates:
            known = ", ".join(str(number) for number in sorted(templates)) or "none"
            raise InputError(
                f"row {i + 1}: template {layout.template[i]} is not among those given ({known})"
            )
    groups = {}
    for number in np.unique(layout.template[used]).tolist():
        rows = np.flatnonzero(used & (layout.template == number))
        template = templates[number]
        aim = layout.aim[rows]
        groups[f"template-{number}"] = Heliostats(
            names=tuple(f"H{i + 1}" for i in rows),
            mechanism=azimuth_elevation(
                layout.location[rows] - template.pivot_height * UP,
                pivot_height=template.pivot_height,
                pivot_offset=template.pivot_offset,
            ),
            width=np.full(len(rows), template.width),
            height=np.full(len(rows), template.height),
            aim=None if np.isnan(aim).all() else aim,
        )
    left_out = [f"H{i + 1}" for i in np.flatnonzero(~used)]
    notes = {"left out": ", ".join(left_out)} if left_out else {}
    return Plant(site.name, site, groups, notes=notes)
