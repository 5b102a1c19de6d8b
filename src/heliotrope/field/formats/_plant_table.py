"""The table of heliostats beside a plant file: CSV or Parquet, column by column."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError
from heliotrope.files import check_table, read_parquet, write_file
from heliotrope.geometry import FloatArray

TEXTS = ("name", "group", "cluster")
REQUIRED = ("name", "group", "east_m", "north_m", "up_m")

#: Plausible values by column: a value outside is most likely in another unit.
PLAUSIBLE = {
    "east_m": (-50e3, 50e3, "m from the site's reference"),
    "north_m": (-50e3, 50e3, "m from the site's reference"),
    "up_m": (-1000.0, 1000.0, "m above the site's reference"),
    "mirror_width_m": (0.05, 50.0, "m"),
    "mirror_height_m": (0.05, 50.0, "m"),
    "pivot_height_m": (-1.0, 30.0, "m"),
    "pivot_offset_m": (-3.0, 3.0, "m"),
}
#: Most errors of one kind that are listed.
MOST_PROBLEMS = 50


@dataclass(frozen=True)
class HeliostatColumns:
    """Columns of the table of heliostats.

    Attributes
    ----------
    path
        The file.
    name, group, cluster
        Texts, (N,).
    numbers
        Columns of numbers, each (N,), by name.
    problems
        Errors found in it.
    """

    path: Path
    name: tuple[str, ...]
    group: tuple[str, ...]
    cluster: tuple[str, ...]
    numbers: Mapping[str, FloatArray]
    problems: list[FormatError] = field(default_factory=list)

    def column(self, name: str, rows: npt.NDArray[np.intp]) -> FloatArray | None:
        """Return the numbers of a column at ``rows``, None if there is no such column."""
        return self.numbers[name][rows] if name in self.numbers else None


def read_table(path: Path) -> HeliostatColumns:
    """Return the table of heliostats.

    Raises
    ------
    FormatError
        Not a table at all; single wrong values go to ``problems``.
    """
    import pandas as pd

    if path.suffix == ".parquet":
        frame = pd.DataFrame(read_parquet(path, "the table of heliostats").columns)
    else:
        check_table(path, "the table of heliostats")
        texts = dict.fromkeys(TEXTS, str)
        try:
            # pandas reads numbers to the last digit since 3.1.
            frame = pd.read_csv(path, dtype=texts, keep_default_na=False, na_values=[""])
        except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
            raise FormatError(path, f"not a CSV table: {str(error).strip()}") from None
    missing = [name for name in REQUIRED if name not in frame.columns]
    if missing:
        there = ", ".join(map(str, frame.columns[:10]))
        raise FormatError(path, f"column {missing[0]} is missing; there are {there}", "line 1")
    if not len(frame):
        raise FormatError(path, "the table has a header but no heliostats")
    problems: list[FormatError] = []
    texts_read = {
        name: tuple("" if pd.isna(v) else str(v) for v in frame[name])
        if name in frame.columns
        else ("",) * len(frame)
        for name in TEXTS
    }
    _check_names(path, texts_read["name"], problems)
    numbers = {
        str(column): _numbers(path, str(column), frame[column], texts_read["name"], problems)
        for column in frame.columns
        if column not in TEXTS
    }
    return HeliostatColumns(
        path, texts_read["name"], texts_read["group"], texts_read["cluster"], numbers, problems
    )


def _check_names(path: Path, names: Sequence[str], problems: list[FormatError]) -> None:
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        if not name:
            problems.append(FormatError(path, "a heliostat without a name", f"line {i + 2}"))
        elif name in first:
            problems.append(
                FormatError(
                    path,
                    f"heliostat {name} stands in line {first[name] + 2} already; names are unique",
                    f"line {i + 2}",
                )
            )
        else:
            first[name] = i
        if len(problems) >= MOST_PROBLEMS:
            return


def _numbers(
    path: Path, column: str, values: Any, names: Sequence[str], problems: list[FormatError]
) -> FloatArray:
    import pandas as pd

    read = pd.to_numeric(values, errors="coerce").to_numpy(dtype=np.float64)
    low, high, unit = PLAUSIBLE.get(column, (-np.inf, np.inf, ""))
    # A cell may be empty if the heliostat's group does not need the column.
    empty = values.isna().to_numpy()
    wrong = np.isnan(read) & (~empty if column not in REQUIRED else True)
    for i in np.flatnonzero(wrong)[:MOST_PROBLEMS]:
        shown = "nothing" if empty[i] else repr(values.iloc[i])
        text = f"heliostat {names[i]}: {shown} is no number"
        problems.append(FormatError(path, text, f"line {i + 2}, column {column}"))
    outside = ~np.isnan(read) & ~((read >= low) & (read <= high))
    for i in np.flatnonzero(outside)[:MOST_PROBLEMS]:
        text = (
            f"heliostat {names[i]}: {read[i]:g} is outside {low:g} to {high:g} {unit}; "
            "is it in another unit?"
        )
        problems.append(FormatError(path, text, f"line {i + 2}, column {column}"))
    return np.asarray(read, dtype=np.float64)


def write_table(parts: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write columns, group below group, as CSV (17 digits) or Parquet."""
    import pandas as pd

    frame = pd.concat([pd.DataFrame(dict(part)) for part in parts], ignore_index=True)
    if path.suffix == ".parquet":
        write_file(path, lambda stream: frame.to_parquet(stream, index=False))
    else:
        # repr of a float is the shortest text that reads back the same.
        write_file(path, lambda stream: frame.to_csv(stream, index=False, na_rep=""))
