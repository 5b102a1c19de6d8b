"""Tables of points for heliostats, such as standby points."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from heliotrope.errors import InputError
from heliotrope.files import write_text
from heliotrope.files.cells import find_heliostats, read_rows
from heliotrope.geometry import FloatArray

#: Columns of a table of points.
POINT_COLUMNS = ("heliostat", "east_m", "north_m", "up_m")


def write_points(path: str | Path, names: Sequence[str], points: FloatArray) -> None:
    """Write a CSV table of points (N, 3), ENU, m, one line for each heliostat."""
    text = io.StringIO(newline="")
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(POINT_COLUMNS)
    for name, point in zip(names, points, strict=True):
        rows.writerow((name, *(f"{x:.3f}" for x in point)))
    write_text(path, text.getvalue())


def read_points(path: str | Path, names: Sequence[str] = ()) -> dict[str, FloatArray]:
    """Return the points of a table, ENU, m, (3,), by heliostat; other columns are ignored.

    Parameters
    ----------
    path
        CSV file with the columns `POINT_COLUMNS`.
    names
        Heliostats of the plant; (): any name is accepted.

    Raises
    ------
    FormatError
        If the file cannot be read, a column is missing, a cell is not a number, a heliostat is
        unknown.
    InputError
        If the table is empty, or names a heliostat twice.
    """
    rows = read_rows(Path(path), "a table of points (CSV)", POINT_COLUMNS)
    rows.need(POINT_COLUMNS)
    if names:
        find_heliostats(rows, "heliostat", names)
    else:
        rows.heliostat = rows.texts("heliostat")
    values = np.stack(
        [rows.numbers(column, "a number in m") for column in POINT_COLUMNS[1:]], axis=-1
    )
    rows.refuse_bad()
    points = dict(zip(rows.heliostat, values, strict=True))
    if not points or len(points) < len(values):
        problem = "names a heliostat twice" if points else "has no rows"
        raise InputError(f"{path}: the table {problem}; give each heliostat one row")
    return points
