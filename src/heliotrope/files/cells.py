"""Read tables cell by cell; a row that cannot be used is left out and reported in one line."""

import csv
import io
import math
import re
import unicodedata
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.files.kinds import instead
from heliotrope.files.limits import (
    CELLS,
    COLUMNS,
    PARQUET_CELLS,
    PARQUET_EXPANDED,
    PARQUET_SIZE,
    ROWS,
    check_count,
    check_file,
)
from heliotrope.files.text import read_text
from heliotrope.files.times import parse_time
from heliotrope.geometry import FloatArray

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

#: A column as it was read: texts, or the values from Parquet.
Cells: TypeAlias = list[Any] | FloatArray

#: Cell separators, the likelier one first.
SEPARATORS = "\t;,|"
_SEP_LINE = re.compile(r'"?sep=(.)"?[ ;,\t]*\n', re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:[,.' \u00a0\u202f]\d{3})+(?:[,.]\d*)?", re.ASCII)
#: Similar names are suggested for at most this many unknown names in a table.
_SUGGESTIONS = 20
_TRUE, _FALSE = ("true", "t", "1", "1.0"), ("false", "f", "0", "0.0")


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
        Place of the column names in the file; empty if unknown.
    heliostat
        Name of the heliostat in each row, for messages, (M,).
    reasons
        For each unusable row, keyed by its index: the column ("" for the whole row) and the reason.
    """

    path: Path
    places: list[str]
    columns: dict[str, Cells]
    header: str = ""
    heliostat: Sequence[str] = ()
    reasons: dict[int, tuple[str, str]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.places)

    @property
    def good(self) -> npt.NDArray[np.intp]:
        """Indices of the rows without an error."""
        return np.array([i for i in range(len(self)) if i not in self.reasons], dtype=np.intp)

    @property
    def left_out(self) -> list[str]:
        """One message for each row that cannot be used, in the order of the rows."""
        lines = []
        for i, (column, reason) in sorted(self.reasons.items()):
            parts = [f"{self.path.name}: {self.places[i]}", self._heliostat(i)]
            parts.append(f"column {column}: {reason}" if column else reason)
            # A quoted cell may contain line breaks, but a message is one line.
            lines.append(" ".join(", ".join(filter(None, parts)).split()))
        return lines

    @property
    def problems(self) -> list[FormatError]:
        """The errors of the unusable rows, for tables that are used completely or not at all."""
        errors = []
        for i, (column, reason) in sorted(self.reasons.items()):
            name = self._heliostat(i)
            where = f"{self.places[i]}, column {column}" if column else self.places[i]
            text = " ".join(f"{name}: {reason}".split()) if name else " ".join(reason.split())
            errors.append(FormatError(self.path, text, where))
        return errors

    def refuse_bad(self) -> None:
        """Raise the first of the `problems`, if any."""
        for problem in self.problems:
            raise problem

    def _heliostat(self, i: int) -> str:
        name = self.heliostat[i] if len(self.heliostat) else ""
        return f"heliostat {name}" if name else ""

    def take(self, index: Iterable[int]) -> "Rows":
        """Return the rows at ``index``, in that order."""
        taken = list(index)
        columns: dict[str, Cells] = {}
        for name, cells in self.columns.items():
            columns[name] = [cells[i] for i in taken]
        reasons = {k: self.reasons[i] for k, i in enumerate(taken) if i in self.reasons}
        names = [self.heliostat[i] for i in taken] if len(self.heliostat) else ()
        places = [self.places[i] for i in taken]
        return Rows(self.path, places, columns, self.header, names, reasons)

    def rename(self, known: Iterable[str]) -> None:
        """Rename columns that differ from a known name only in case or blanks."""
        by_form = {alike(name): name for name in known}
        names = [by_form.get(alike(name), name) for name in self.columns]
        if len(set(names)) == len(names):
            self.columns = dict(zip(names, self.columns.values(), strict=True))

    def need(self, names: Sequence[str]) -> None:
        """Raise FormatError if one of the columns is missing."""
        for name in names:
            if name not in self.columns:
                present = ", ".join(list(self.columns)[:12]) or "none"
                raise FormatError(
                    self.path,
                    f"there is no column {name}; add it. There are {present}",
                    self.header,
                )

    def refuse(self, i: "int | np.integer[Any]", column: str, reason: str) -> None:
        """Leave out a row; only the first reason for the row is kept."""
        self.reasons.setdefault(int(i), (column, reason))

    def texts(self, column: str) -> list[str]:
        """Return the cells as texts; empty if a cell is empty or there is no such column."""
        if column not in self.columns:
            return [""] * len(self)
        return ["" if _empty(cell) else str(cell) for cell in self.columns[column]]

    def filled(self, column: str) -> npt.NDArray[np.bool_]:
        """Return a mask of the cells that are not empty, (M,)."""
        return np.array([not _empty(cell) for cell in self.columns[column]], dtype=np.bool_)

    def numbers(self, column: str, what: str, empty: float | None = None) -> FloatArray:
        """Return the finite numbers in a column; rows with other cells are left out.

        Parameters
        ----------
        column
            Name of an existing column.
        what
            What to enter instead of an unusable cell, with its unit, for the message.
        empty
            Value for an empty cell; None rejects it.
        """
        cells = self.columns[column]
        values = _numbers(cells)
        for i in np.flatnonzero(~np.isfinite(values)):
            if not _empty(cells[i]):
                hint = _hint(str(cells[i])) or f"enter {what}"
                self.refuse(i, column, f"{_shown(cells[i])} is not a finite number; {hint}")
            elif empty is None:
                self.refuse(i, column, f"the cell is empty; enter {what}")
            else:
                values[i] = empty
        return values

    def within(self, column: str, values: FloatArray, low: float, high: float, unit: str) -> None:
        """Leave out the rows whose value is outside ``low`` to ``high``, in ``unit``."""
        outside = ~((values >= low) & (values <= high)) & np.isfinite(values)
        limits = f" is outside {low:g} to {high:g} {unit}; check the unit"
        self.check(column, outside, values, limits)

    def names(self, column: str, what: str) -> tuple[str, ...]:
        """Return the names in a column; empty and duplicate names are rejected.

        Names that differ only in case, blanks or Unicode form count as the same; see `alike`.
        """
        names = self.texts(column)
        first: dict[str, int] = {}
        for i, name in enumerate(names):
            other = first.setdefault(alike(name), i)
            if not name.strip():
                self.refuse(i, column, f"the {what} has no name; enter one")
            elif other != i:
                close = (
                    "" if names[other] == name else f" apart from case or blanks ({names[other]})"
                )
                place = self.places[other]
                text = f"{name} is already the name of {place}{close}; each name must be unique"
                self.refuse(i, column, text)
        return tuple(names)

    def check(self, column: str, wrong: npt.ArrayLike, values: FloatArray, reason: str) -> None:
        """Leave out the rows where ``wrong`` holds; ``reason`` follows the value in the message."""
        for i in np.flatnonzero(wrong):
            self.refuse(i, column, f"{values[i]:.10g}{reason}")

    def flags(self, column: str, advice: str = "enter one of them") -> npt.NDArray[np.bool_]:
        """Return booleans; rows with cells that are neither true nor false are left out."""
        flags = np.zeros(len(self), dtype=np.bool_)
        for i, cell in enumerate(self.columns[column]):
            known = str(cell).strip().casefold()
            if known in _TRUE:
                flags[i] = True
            elif known not in _FALSE:
                self.refuse(i, column, f"{_shown(cell)} is neither true nor false; {advice}")
        return flags

    def times(self, column: str, optional: bool) -> FloatArray:
        """Return Unix seconds; NaN if the cell is empty and ``optional`` is true."""
        seconds = np.full(len(self), np.nan)
        for i, cell in enumerate(self.columns[column]):
            if _empty(cell):
                if not optional:
                    self.refuse(i, column, "the cell is empty; enter a time in ISO 8601 with Z")
                continue
            try:
                text = cell.isoformat() if isinstance(cell, datetime) else str(cell)
                seconds[i] = parse_time(text)
            except InputError as error:
                self.refuse(i, column, str(error))
        return seconds


def read_cells(
    path: Path, what: str, *, separators: str = SEPARATORS, record_end: str = ""
) -> tuple[list[str], list[list[str]]]:
    """Return the place ("line 12") and the cells of each row of a text table.

    All text tables are read by this function. The text is UTF-8, UTF-16 with a byte-order mark, or
    Windows-1252, as written by spreadsheets. Blanks around cells, and empty rows, are ignored.

    Parameters
    ----------
    path
        The file.
    what
        Kind of table, as named in errors.
    separators
        Characters that may separate cells. A line ``sep=;`` before the table, as written by Excel,
        specifies another separator; otherwise the first row decides.
    record_end
        A character that may end a row instead of a line end, if cells are separated by a different
        character.

    Raises
    ------
    FormatError
        If the file cannot be read, or exceeds the limits of `heliotrope.files.limits`.
    """
    text = unicodedata.normalize("NFC", read_text(path, what, spreadsheet=True))
    if other := instead(text[:4096].encode(), what, "table"):
        raise FormatError(path, other)
    named = _SEP_LINE.match(text)
    if named is not None:
        text = "\n" + text[named.end() :]
    start = next((line for line in text.split("\n") if line.strip(" \t,;|")), "")
    if record_end and any(piece.count(",") > 1 for piece in start.split(record_end)):
        text = text.replace(f"{record_end}\n", "\n").replace(record_end, "\n")
        separators = separators.replace(record_end, "")
    separator = named[1] if named is not None else _separator(start, separators)
    lines = text.count("\n") + (not text.endswith("\n"))
    check_count(path, lines - 1, ROWS, "rows", "divide the table")
    check_count(path, lines + text.count(separator), CELLS, "cells", "divide the table")
    reader = csv.reader(
        io.StringIO(text, newline=""), delimiter=separator, skipinitialspace=True, strict=True
    )
    places: list[str] = []
    table: list[list[str]] = []
    before = 0
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            # A quoted cell may span several lines; the first line identifies the row.
            if any(cells):
                if not table:
                    advice = "remove those that are not needed"
                    check_count(path, len(cells), COLUMNS, "columns", advice, f"line {before + 1}")
                    # A short row is padded to the number of header columns.
                    check_count(path, lines * len(cells), CELLS, "cells", "divide the table")
                table.append(cells)
                places.append(f"line {before + 1}")
            before = reader.line_num
    except csv.Error as error:
        raise FormatError(path, f"not a CSV table ({error})", f"line {reader.line_num}") from None
    if not table:
        raise FormatError(path, f"the file has no rows; expected {what}")
    return places, table


def _separator(line: str, separators: str) -> str:
    """Return the separator of a row, which may be a semicolon with decimal commas in between."""
    bare = re.sub(r'"[^"]*"', "", line)
    counts = {separator: bare.count(separator) for separator in separators}
    if counts.get(";") and all(piece.count(",") < 2 for piece in bare.split(";")):
        return ";"
    # Blanks are separators only if the row contains no other separator.
    blanks = counts.pop(" ", 0)
    best = max(counts, key=lambda separator: counts[separator])
    return best if counts[best] else " " if blanks else ","


def read_rows(path: Path, what: str, known: Iterable[str] = ()) -> Rows:
    """Return the rows of a table with a header; lines with a different length are unusable.

    Parameters
    ----------
    path, what
        As for `read_cells`, with its errors.
    known
        Names of columns that are matched ignoring case and blanks.

    Raises
    ------
    FormatError
        If the file cannot be read, or its header is unusable.
    """
    places, table = read_cells(path, what)
    return rows_under(path, (places.pop(0), table.pop(0)), places, table, known)


def rows_under(
    path: Path,
    header: tuple[str, list[str]],
    places: list[str],
    table: list[list[str]],
    known: Iterable[str] = (),
) -> Rows:
    """Return rows from a header and from the places and cells of the rows below the header.

    Raises
    ------
    FormatError
        If a column has no name, or the name of another column.
    """
    place, names = header[0], [_tidy(cell) for cell in header[1]]
    while names and not names[-1]:
        names.pop()
    taken: set[str] = set()
    for k, name in enumerate(names):
        if not name or name in taken:
            problem = f"column {name} occurs twice" if name else f"column {k + 1} has no name"
            raise FormatError(path, f"{problem}; name each column once", place)
        taken.add(name)
    rows = Rows(path, places, {}, place)
    # Empty columns at the end are allowed; an extra cell in a row means that its cells are shifted.
    widths = {len(cells) for cells in table}
    allowed = {len(names), len(header[1]), *(widths if len(widths) == 1 else ())}
    for i, cells in enumerate(table):
        if len(cells) not in allowed or len(cells) < len(names) or any(cells[len(names) :]):
            rows.reasons[i] = "", f"{len(cells)} cells under {len(names)} columns; correct the line"
        cells.extend(repeat("", len(names) - len(cells)))
    rows.columns.update({name: [cells[k] for cells in table] for k, name in enumerate(names)})
    rows.rename(known)
    return rows


def read_parquet(path: Path, what: str) -> Rows:
    """Return the rows of a Parquet file.

    Raises
    ------
    FormatError
        If the file cannot be read, has nested columns, or exceeds the limits of
        `heliotrope.files.limits`.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_file(path, what, binary=True, limit=PARQUET_SIZE)
    try:
        with pq.ParquetFile(path) as file:
            _check_parquet(path, file.metadata)
            texts = [field.name for field in file.schema_arrow if pa.types.is_string(field.type)]
        # With dictionary encoding, a recurring text is in memory only once.
        with pq.ParquetFile(path, read_dictionary=texts) as file:
            table = file.read()
        names = [_tidy(name) for name in table.column_names]
        cells = [_cells_of(column) for column in table.columns]
    except (pa.ArrowException, OSError, UnicodeDecodeError) as error:
        reason = str(error).split("\n", maxsplit=1)[0]
        raise FormatError(path, f"not a Parquet table ({reason}); expected {what}") from None
    if len(set(names)) != len(names):
        raise FormatError(path, "two columns have the same name; name each column once")
    columns = dict(zip(names, cells, strict=True))
    return Rows(path, [f"row {i + 1}" for i in range(table.num_rows)], columns)


def _check_parquet(path: Path, about: "pq.FileMetaData") -> None:
    """Reject a file whose stated columns, cells or expanded size exceed the limits."""
    check_count(path, about.num_columns, COLUMNS, "columns", "remove those that are not needed")
    check_count(path, about.num_rows * about.num_columns, PARQUET_CELLS, "cells", "divide it")
    size = sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups))
    check_count(path, size, PARQUET_EXPANDED, "expanded bytes", "divide the table")
    for i in range(about.num_columns):
        if about.schema.column(i).max_repetition_level:
            raise FormatError(
                path,
                ("this column contains lists; each cell must contain a single value"),
                about.schema.column(i).path,
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
    """Return the index of each heliostat by name.

    Raises
    ------
    InputError
        If a name occurs twice.
    """
    index = {name: i for i, name in enumerate(names)}
    if len(index) != len(names):
        twice = next(name for i, name in enumerate(names) if index[name] != i)
        raise InputError(f"heliostat {twice}: the name occurs twice; each name must be unique")
    return index


def find_heliostats(rows: Rows, column: str, names: Sequence[str]) -> npt.NDArray[np.intp]:
    """Return the index of each heliostat named in the table; unknown names are left out."""
    index = rows_of(names)
    rows.heliostat = rows.texts(column)
    indices = np.array([index.get(n, index.get(n.strip(), -1)) for n in rows.heliostat], np.intp)
    reasons = {"": "the cell is empty; name a heliostat"}
    for i in np.flatnonzero(indices < 0):
        name = rows.heliostat[i]
        if name not in reasons:
            # Similar names are searched for among all names, which takes seconds for a table of
            # another field.
            reasons[name] = (
                str(UnknownNameError("heliostat", name, names))
                if len(reasons) <= _SUGGESTIONS
                else f"there is no heliostat {_shown(name)}"
            )
        rows.refuse(i, column, reasons[name])
    return indices


def alike(name: str) -> str:
    """Return a name normalised in case, blanks and Unicode form."""
    return "".join(unicodedata.normalize("NFKC", name).casefold().split())


def _tidy(name: str) -> str:
    """Return the name of a column as one line for a message."""
    return " ".join(name.split())[:60]


def _empty(cell: Any) -> bool:
    # NaN and NaT, which Parquet may contain, differ from themselves.
    return cell is None or cell != cell or (isinstance(cell, str) and not cell.strip())  # noqa: PLR0124


def check_names(what: str, names: Iterable[str]) -> None:
    """Reject empty names, and names that count as equal.

    Parameters
    ----------
    what
        Kind of object that has the names, for the message.
    names
        Names of the objects.

    Raises
    ------
    InputError
        For the first such name.
    """
    listed = list(names)
    # All names are checked at once, because a field of 100,000 heliostats is checked each time it
    # is copied.
    text = unicodedata.normalize("NFKC", "\n".join(listed)).casefold()
    forms = re.sub(r"[^\S\n]+", "", text).split("\n") if listed else []
    if len(forms) == len(listed) == len(set(forms)) and all(forms):
        return
    taken: dict[str, str] = {}
    for name in listed:
        if not name.strip():
            raise InputError(f"{what}: a name is empty; each {what} needs a name")
        if other := taken.get(alike(name), ""):
            twice = "the name occurs twice; each name must be unique"
            close = f"there is also {other}; names must differ by more than case and blanks"
            raise InputError(f"{what} {name}: {twice if other == name else close}")
        taken[alike(name)] = name


def _numbers(cells: Cells) -> FloatArray:
    """Return numbers; NaN where a cell is not a number."""
    if isinstance(cells, np.ndarray):
        return cells.copy()
    try:
        text = "".join(cells)
        if text.isascii() and "_" not in text:
            return np.fromiter(map(float, cells), np.float64, len(cells))
    except (TypeError, ValueError):
        pass
    return np.array([_number(cell) for cell in cells], dtype=np.float64)


def _number(cell: Any) -> float:
    if isinstance(cell, bool) or (isinstance(cell, str) and ("_" in cell or not cell.isascii())):
        return math.nan
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _hint(text: str) -> str:
    """Return the remedy for a number in another country's notation; "" for any other text."""
    if _DECIMAL_COMMA.fullmatch(text):
        return "write a point, not a comma"
    if _THOUSANDS.fullmatch(text):
        return "omit the thousands separators, and use a decimal point"
    if text.startswith("\u2212"):
        return "write the minus sign as -"
    return ""


def _shown(cell: Any) -> str:
    text = repr(cell if isinstance(cell, str) else str(cell))
    return text if len(text) <= 60 else f"{text[:57]}…'"
