"""The heliostat table beside a plant file: CSV or Parquet, column by column."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError
from heliotrope.files import Rows, read_parquet, read_rows, write_file
from heliotrope.geometry import FloatArray

TEXTS = ("name", "group", "cluster")
REQUIRED = ("name", "group", "east_m", "north_m", "up_m")

#: Plausible values by column; a value outside is most likely in another unit.
PLAUSIBLE = {
    "east_m": (-50e3, 50e3, "m from the site's reference"),
    "north_m": (-50e3, 50e3, "m from the site's reference"),
    "up_m": (-1000.0, 1000.0, "m above the site's reference"),
    "latitude_deg": (-90.0, 90.0, "°, north positive"),
    "longitude_deg": (-180.0, 180.0, "°, east positive"),
    "altitude_m": (-500.0, 9000.0, "m above the ellipsoid"),
    "mirror_width_m": (0.05, 50.0, "m"),
    "mirror_height_m": (0.05, 50.0, "m"),
    "pivot_height_m": (-1.0, 30.0, "m"),
    "pivot_offset_m": (-3.0, 3.0, "m"),
}
#: Maximum number of errors that are listed.
MOST_PROBLEMS = 50


@dataclass(frozen=True)
class HeliostatColumns:
    """Columns of the heliostat table.

    Attributes
    ----------
    path
        The file.
    name, group, cluster
        Text columns, (N,).
    numbers
        Columns of numbers, each (N,), by name.
    problems
        Errors found in the table.
    """

    path: Path
    name: tuple[str, ...]
    group: tuple[str, ...]
    cluster: tuple[str, ...]
    numbers: Mapping[str, FloatArray]
    problems: list[FormatError] = field(default_factory=list)

    def column(self, name: str, rows: npt.NDArray[np.intp]) -> FloatArray | None:
        """Return the numbers of a column at ``rows``; None if there is no such column."""
        return self.numbers[name][rows] if name in self.numbers else None


def read_table(path: Path) -> HeliostatColumns:
    """Return the heliostat table.

    Raises
    ------
    FormatError
        If the file is not a table at all; individual wrong values are added to ``problems``.
    """
    rows = read_columns(path)
    rows.need(REQUIRED)
    if not len(rows):
        raise FormatError(path, "the table has a header but no heliostats")
    names = rows.names("name", "heliostat")
    rows.heliostat = names
    numbers = {}
    for column in rows.columns:
        if column not in TEXTS:
            # A cell may be empty if the heliostat's group does not need the column.
            numbers[column] = plausible(
                rows, column, column, empty=None if column in REQUIRED else np.nan
            )
    group, cluster = (tuple(rows.texts(name)) for name in ("group", "cluster"))
    return HeliostatColumns(path, names, group, cluster, numbers, rows.problems[:MOST_PROBLEMS])


def read_columns(path: Path) -> Rows:
    """Return the columns of the heliostat table, unchanged.

    Raises
    ------
    FormatError
        If the file cannot be read.
    """
    if path.suffix == ".parquet":
        return read_parquet(path, "the table of heliostats")
    return read_rows(path, "the table of heliostats", (*TEXTS, *PLAUSIBLE))


def plausible(rows: Rows, column: str, meaning: str, *, empty: float | None = None) -> FloatArray:
    """Return a column of numbers; refuse numbers outside the range of their ``meaning``."""
    low, high, unit = PLAUSIBLE.get(meaning, (-np.inf, np.inf, "a number"))
    values = rows.numbers(column, unit, empty)
    rows.within(column, values, low, high, unit)
    return values


def write_table(parts: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write columns, one group after the other, as CSV (17 digits) or Parquet."""
    import pandas as pd

    frame = pd.concat([pd.DataFrame(dict(part)) for part in parts], ignore_index=True)
    if path.suffix == ".parquet":
        write_file(path, lambda stream: frame.to_parquet(stream, index=False))
    else:
        # The repr of a float is the shortest text from which the same float is read.
        write_file(path, lambda stream: frame.to_csv(stream, index=False, na_rep=""))
