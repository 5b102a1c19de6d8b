"""Tables cell by cell: a row that cannot be used is left out and named in one line."""

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from fractions import Fraction
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.files.limits import (
    COLUMNS,
    PARQUET_CELLS,
    PARQUET_EXPANDED,
    PARQUET_SIZE,
    check_count,
    check_file,
    check_table,
)
from heliotrope.files.text import read_text
from heliotrope.geometry import FloatArray

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

#: A column as it was read: texts, or what Parquet holds.
Cells: TypeAlias = list[Any] | FloatArray

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_TIME = re.compile(
    r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d(?::\d\d(?:[.,](\d+))?)?) ?(Z|[+-]\d\d(?::?\d\d)?)?", re.ASCII
)
#: Unknown names of a table for which close ones are suggested.
_SUGGESTIONS = 20
_TRUE, _FALSE = ("true", "1"), ("false", "0")


@dataclass
class Rows:
    """The M rows of a table.

    Attributes
    ----------
    path
        The file.
    places
        Place of each row in the file ("line 12"), (M,).
    columns
        Cells by column, (M,) each.
    header
        Place of the column names in the file, "" if not known.
    heliostat
        Name of the heliostat in each row, for messages, (M,).
    reasons
        Why a row cannot be used, by its index.
    """

    path: Path
    places: list[str]
    columns: dict[str, Cells]
    header: str = ""
    heliostat: Sequence[str] = ()
    reasons: dict[int, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.places)

    @property
    def good(self) -> npt.NDArray[np.intp]:
        """Indices of the rows without a fault."""
        return np.array([i for i in range(len(self)) if i not in self.reasons], dtype=np.intp)

    @property
    def left_out(self) -> list[str]:
        """One line for each row that cannot be used, in the order of the rows."""
        lines = []
        for i, reason in sorted(self.reasons.items()):
            name = self.heliostat[i] if len(self.heliostat) else ""
            of = f", heliostat {name}" if name else ""
            # A quoted cell may hold line breaks; a message is one line.
            lines.append(" ".join(f"{self.path.name}: {self.places[i]}{of}, {reason}".split()))
        return lines

    def need(self, names: Sequence[str]) -> None:
        """Raise FormatError if one of the columns is not there."""
        for name in names:
            if name not in self.columns:
                there = ", ".join(list(self.columns)[:12]) or "none"
                raise FormatError(
                    self.path, f"there is no column {name}; add it. There are {there}", self.header
                )

    def refuse(self, i: "int | np.integer[Any]", column: str, reason: str) -> None:
        """Leave a row out; only the first reason is kept."""
        self.reasons.setdefault(int(i), f"column {column}: {reason}")

    def texts(self, column: str) -> list[str]:
        """Return the cells as texts, "" where empty or where there is no such column."""
        if column not in self.columns:
            return [""] * len(self)
        return ["" if _empty(cell) else str(cell) for cell in self.columns[column]]

    def filled(self, column: str) -> npt.NDArray[np.bool_]:
        """Return which cells are not empty, (M,)."""
        return np.array([not _empty(cell) for cell in self.columns[column]], dtype=np.bool_)

    def numbers(self, column: str, what: str, empty: float | None = None) -> FloatArray:
        """Return the finite numbers of a column; other cells leave their rows out.

        Parameters
        ----------
        column
            Name of an existing column.
        what
            Value to give instead, with its unit, for the message.
        empty
            Value of an empty cell; None refuses it.
        """
        cells = self.columns[column]
        values = cells if isinstance(cells, np.ndarray) else np.array([_number(c) for c in cells])
        values = np.asarray(values, dtype=np.float64).copy()
        for i in np.flatnonzero(~np.isfinite(values)):
            if not _empty(cells[i]):
                self.refuse(i, column, f"{_shown(cells[i])} is not a finite number; give {what}")
            elif empty is None:
                self.refuse(i, column, f"the cell is empty; give {what}")
            else:
                values[i] = empty
        return values

    def check(self, column: str, wrong: npt.ArrayLike, values: FloatArray, reason: str) -> None:
        """Leave out the rows where ``wrong`` holds; ``reason`` follows the value in the message."""
        for i in np.flatnonzero(wrong):
            self.refuse(i, column, f"{values[i]:.10g}{reason}")

    def flags(self, column: str) -> npt.NDArray[np.bool_]:
        """Return booleans; cells that are neither true nor false leave their rows out."""
        flags = np.zeros(len(self), dtype=np.bool_)
        for i, cell in enumerate(self.columns[column]):
            text = str(int(cell) if isinstance(cell, float) and cell in (0.0, 1.0) else cell)
            known = text.strip().casefold()
            if known in _TRUE:
                flags[i] = True
            elif known not in _FALSE:
                self.refuse(i, column, f"{_shown(cell)} is neither true nor false; give one")
        return flags

    def times(self, column: str, optional: bool) -> FloatArray:
        """Return unix seconds; NaN where the cell is empty and ``optional`` holds."""
        seconds = np.full(len(self), np.nan)
        for i, cell in enumerate(self.columns[column]):
            if _empty(cell):
                if not optional:
                    self.refuse(i, column, "the cell is empty; give a time in ISO 8601 with Z")
                continue
            try:
                text = cell.isoformat() if isinstance(cell, datetime) else str(cell)
                seconds[i] = parse_time(text)
            except InputError as error:
                self.refuse(i, column, str(error))
        return seconds


def read_rows(path: Path, what: str) -> Rows:
    """Return the rows of a CSV file with a header, separated by comma, semicolon or tab.

    Empty lines are skipped; lines with more or fewer cells than the header are bad rows.

    Raises
    ------
    FormatError
        If it cannot be read, or its header is unusable.
    """
    text = read_text(check_table(path, what), what)
    header = text.lstrip("\r\n").split("\n", maxsplit=1)[0]
    separator = max(",;\t", key=header.count)
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=separator, strict=True)
    table: list[list[str]] = []
    places: list[str] = []
    before = 0
    try:
        for cells in reader:
            # A quoted cell may span several lines; the row is named by its first.
            if any(cell.strip() for cell in cells):
                table.append(cells)
                places.append(f"line {before + 1}")
            before = reader.line_num
    except csv.Error as error:
        raise FormatError(path, f"not a CSV table ({error})", f"line {reader.line_num}") from None
    if not table:
        raise FormatError(path, f"the file has no rows; it should be {what}")
    names = [_tidy(cell) for cell in table.pop(0)]
    place = places.pop(0)
    while names and not names[-1]:
        names.pop()
    seen: set[str] = set()
    for k, name in enumerate(names):
        if not name or name in seen:
            wrong = f"column {name} occurs twice" if name else f"column {k + 1} has no name"
            raise FormatError(path, f"{wrong}; name each column once", place)
        seen.add(name)
    rows = Rows(path, places, {}, place)
    for i, cells in enumerate(table):
        while len(cells) > len(names) and not cells[-1].strip():
            cells.pop()
        if len(cells) != len(names):
            rows.reasons[i] = f"{len(cells)} cells under {len(names)} columns; correct the line"
        cells.extend(repeat("", len(names) - len(cells)))
    rows.columns.update({name: [cells[k] for cells in table] for k, name in enumerate(names)})
    return rows


def read_parquet(path: Path, what: str) -> Rows:
    """Return the rows of a Parquet file.

    Raises
    ------
    FormatError
        If it cannot be read, has nested columns, or is beyond the limits of
        `heliotrope.files.limits`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_file(path, what, binary=True, limit=PARQUET_SIZE)
    try:
        with pq.ParquetFile(path) as file:
            _check_parquet(path, file.metadata)
            texts = [field.name for field in file.schema_arrow if pa.types.is_string(field.type)]
        # As a dictionary a text that recurs is in memory once.
        with pq.ParquetFile(path, read_dictionary=texts) as file:
            table = file.read()
        names = [_tidy(name) for name in table.column_names]
        cells = [_cells_of(column) for column in table.columns]
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = str(error).split("\n", maxsplit=1)[0]
        raise FormatError(path, f"not a Parquet table ({reason}); it should be {what}") from None
    if len(set(names)) != len(names):
        raise FormatError(path, "two columns have the same name; name each column once")
    columns = dict(zip(names, cells, strict=True))
    return Rows(path, [f"row {i + 1}" for i in range(table.num_rows)], columns)


def _check_parquet(path: Path, about: "pq.FileMetaData") -> None:
    """Refuse a file whose stated columns, cells or expanded size are beyond the limits."""
    check_count(path, about.num_columns, COLUMNS, "columns", "remove those that are not needed")
    check_count(path, about.num_rows * about.num_columns, PARQUET_CELLS, "cells", "divide it")
    size = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    check_count(path, size, PARQUET_EXPANDED, "expanded bytes", "divide the table")
    for i in range(about.num_columns):
        if about.schema.column(i).max_repetition_level:
            raise FormatError(
                path, "a column of lists; give single values", about.schema.column(i).path
            )


def _cells_of(column: "pa.ChunkedArray[Any]") -> Cells:
    import pyarrow as pa

    if pa.types.is_float64(column.type):
        return np.asarray(column.to_numpy(), dtype=np.float64)
    if not pa.types.is_dictionary(column.type):
        return list(column.to_pylist())
    cells: list[Any] = []
    for chunk in column.chunks:
        texts = chunk.dictionary.to_pylist()
        cells += [None if i is None else texts[i] for i in chunk.indices.to_pylist()]
    return cells


def rows_of(names: Sequence[str]) -> dict[str, int]:
    """Return the row of each heliostat by name.

    Raises
    ------
    InputError
        If a name occurs twice.
    """
    index = {name: i for i, name in enumerate(names)}
    if len(index) != len(names):
        twice = next(name for i, name in enumerate(names) if index[name] != i)
        raise InputError(f"heliostat {twice}: the name occurs twice; names are unique")
    return index


def find_heliostats(rows: Rows, column: str, names: Sequence[str]) -> npt.NDArray[np.intp]:
    """Return the row of each heliostat named in the table; unknown names are left out."""
    index = rows_of(names)
    rows.heliostat = rows.texts(column)
    found = np.array([index.get(n, index.get(n.strip(), -1)) for n in rows.heliostat], np.intp)
    reasons = {"": "the cell is empty; name a heliostat"}
    for i in np.flatnonzero(found < 0):
        name = rows.heliostat[i]
        if name not in reasons:
            # Close names are looked for among all names: seconds in a table of another field.
            reasons[name] = (
                str(UnknownNameError("heliostat", name, names))
                if len(reasons) <= _SUGGESTIONS
                else f"there is no heliostat {_shown(name)}"
            )
        rows.refuse(i, column, reasons[name])
    return found


def parse_time(text: str) -> float:
    """Return unix seconds of an ISO 8601 text, the nearest double to all its digits.

    Raises
    ------
    InputError
        If it is not a time, or has no time zone.
    """
    found = _TIME.fullmatch(text.strip())
    if found is None:
        raise InputError(
            f"{_shown(text)} is not an ISO 8601 time; write it like 2026-06-21T12:00:00Z"
        )
    day, clock, digits, zone = found.groups()
    if zone is None:
        raise InputError(
            f"{text.strip()} has no time zone; append Z if it is UTC, or an offset such as +02:00"
        )
    try:
        moment = datetime.fromisoformat(f"{day}T{clock[:8]}{zone}")
        whole = (moment - _EPOCH) // timedelta(seconds=1)
        return float(whole + (Fraction(int(digits), 10 ** len(digits)) if digits else 0))
    except (ValueError, OverflowError) as error:
        raise InputError(f"{_shown(text)} is not a valid time ({error}); correct it") from None


def format_time(seconds: float) -> str:
    """Return unix seconds as ISO 8601 in UTC, with the digits that give the same double again.

    Raises
    ------
    InputError
        If they are infinite or lie outside the years 1 to 9999.
    """
    if math.isnan(seconds):
        return ""
    try:
        whole = math.floor(seconds)
        moment = (_EPOCH + timedelta(seconds=whole)).replace(tzinfo=None).isoformat()
    except OverflowError:
        raise InputError(f"time {seconds} s since 1970 lies outside the years 1 to 9999") from None
    # repr is the shortest text that gives the same double; its decimals are kept exactly.
    decimals = f"{Decimal(repr(float(seconds))):f}".partition(".")[2].rstrip("0")
    if decimals and seconds < 0.0:
        # Below the epoch the time of day still counts upwards.
        decimals = f"{10 ** len(decimals) - int(decimals):0{len(decimals)}d}"
    return f"{moment}.{decimals}Z" if decimals else f"{moment}Z"


def _tidy(name: str) -> str:
    """Return the name of a column in one line that a message can show."""
    return " ".join(name.split())[:60]


def _empty(cell: Any) -> bool:
    # NaN and NaT, which Parquet may hold, are the values that differ from themselves.
    return cell is None or cell != cell or (isinstance(cell, str) and not cell.strip())  # noqa: PLR0124


def _number(cell: Any) -> float:
    if isinstance(cell, bool) or (isinstance(cell, str) and "_" in cell):
        return math.nan
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _shown(cell: Any) -> str:
    text = repr(cell if isinstance(cell, str) else str(cell))
    return text if len(text) <= 60 else f"{text[:57]}…'"
