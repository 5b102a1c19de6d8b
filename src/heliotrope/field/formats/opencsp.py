"""OpenCSP's heliostat fields: one table of heliostats and one of facet centroids.

The table of heliostats has a row each and these columns, found by name::

    Name, X, Y, Z, Num. Facets, Num. Rows, Num. Cols, Pivot Height, Pivot Offset,
    Facet Width, Facet Height

X is east, Y north, Z up, in m. They are those of the pivot (the torque tube), not of the
foot, and the pivot height is information only. The mirror's face stands the pivot offset
in front of the pivot. Azimuth is clockwise from north, elevation from the horizon.

The table of centroids (Facet id, X, Y, Z) holds for all heliostats of the field, in the
frame of a mirror that lies face up and is turned to look south: X to the right as seen
from the front, Y up, Z out of the mirror. Facets are listed from the upper left, row by
row, and are neither canted nor curved in these files.

Facts from the sources and data of OpenCSP (Sandia National Laboratories).
"""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.files import check_table, read_text, write_text
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.kinds import UP, azimuth_elevation
from heliotrope.sun import Site

COLUMNS = (
    "Name", "X", "Y", "Z", "Num. Facets", "Num. Rows", "Num. Cols", "Pivot Height",
    "Pivot Offset", "Facet Width", "Facet Height",
)  # fmt: skip
FACET_COLUMNS = ("Facet id", "X", "Y", "Z")

_COUNTS = ("Num. Facets", "Num. Rows", "Num. Cols")


@dataclass(frozen=True, eq=False)
class FieldTable:
    """The table of heliostats.

    Attributes
    ----------
    names
        Unique.
    location
        Positions of the pivots, m east, north and up, (N, 3).
    facets, rows, columns
        Number of facets, and of rows and columns of them, (N,).
    pivot_height
        m, (N,).
    pivot_offset
        Distance of the mirror's face in front of the pivot, m, (N,).
    facet_width, facet_height
        m, (N,).
    extra
        Further columns of the file, word for word, each (N,).
    """

    names: tuple[str, ...]
    location: FloatArray
    facets: npt.NDArray[np.int64]
    rows: npt.NDArray[np.int64]
    columns: npt.NDArray[np.int64]
    pivot_height: FloatArray
    pivot_offset: FloatArray
    facet_width: FloatArray
    facet_height: FloatArray
    extra: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Centroids:
    """The table of facet centroids.

    Attributes
    ----------
    ids
        Unique.
    center
        m to the right, up and out of the mirror, from its vertex, (F, 3).
    """

    ids: tuple[str, ...]
    center: FloatArray

    def __len__(self) -> int:
        return len(self.ids)


def read_field(path: str | Path) -> FieldTable:
    """Read the table of heliostats.

    Raises
    ------
    FormatError
        If the file cannot be read, a column is missing, a row has another number of
        cells, a cell is not what its column needs, or a name occurs twice; with line and
        column.
    """
    table = _Table.read(path, "an OpenCSP heliostat field", COLUMNS)
    names = table.names("Name", "heliostat")
    counts = {name: table.counts(name) for name in _COUNTS}
    facets, rows, columns = counts.values()
    wrong = np.flatnonzero(facets != rows * columns)
    if len(wrong):
        i = int(wrong[0])
        raise table.error(
            i,
            "Num. Facets",
            f"heliostat {names[i]}: {facets[i]} facets are not {rows[i]} rows × {columns[i]} "
            "columns",
        )
    return FieldTable(
        names=names,
        location=np.stack([table.numbers(axis) for axis in "XYZ"], axis=-1),
        facets=facets,
        rows=rows,
        columns=columns,
        pivot_height=table.numbers("Pivot Height"),
        pivot_offset=table.numbers("Pivot Offset"),
        facet_width=table.numbers("Facet Width", above_zero=True),
        facet_height=table.numbers("Facet Height", above_zero=True),
        extra={name: table.column(name) for name in table.header if name not in COLUMNS},
    )


def write_field(path: str | Path, table: FieldTable) -> None:
    """Write the table of heliostats, with its further columns; it is there whole or not at all."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *table.extra])
    for i, name in enumerate(table.names):
        counts = [int(each[i]) for each in (table.facets, table.rows, table.columns)]
        sizes = (table.pivot_height, table.pivot_offset, table.facet_width, table.facet_height)
        numbers = [float(each[i]) for each in sizes]
        more = [column[i] for column in table.extra.values()]
        writer.writerow([name, *table.location[i].tolist(), *counts, *numbers, *more])
    write_text(path, text.getvalue())


def read_centroids(path: str | Path) -> Centroids:
    """Read the table of facet centroids.

    Raises
    ------
    FormatError
        As for `read_field`.
    """
    table = _Table.read(path, "an OpenCSP table of facet centroids", FACET_COLUMNS)
    center = np.stack([table.numbers(axis) for axis in "XYZ"], axis=-1)
    return Centroids(table.names("Facet id", "facet"), center)


@dataclass(frozen=True, eq=False)
class _Table:
    """A comma-separated table with a header, as text."""

    path: Path
    header: tuple[str, ...]
    lines: tuple[int, ...]
    rows: tuple[tuple[str, ...], ...]

    @classmethod
    def read(cls, path: str | Path, what: str, needed: tuple[str, ...]) -> "_Table":
        """Read a table that has at least the columns ``needed``."""
        file = Path(path)
        reader = csv.reader(io.StringIO(read_text(check_table(file, what), what)), strict=True)
        found = list(cls._cells(file, reader))
        header = found[0][1] if found else ()
        for name, number in Counter(header).items():
            if number > 1:
                raise FormatError(file, f"column {name!r} occurs twice", "header")
        missing = [name for name in needed if name not in header]
        if missing:
            raise FormatError(
                file,
                f"no column {', '.join(map(repr, missing))}; {what} has {', '.join(needed)}",
                "header",
            )
        if len(found) == 1:
            raise FormatError(file, f"there is no row below the header; {what} has some")
        for line, row in found[1:]:
            if len(row) != len(header):
                raise FormatError(
                    file, f"{len(row)} cells, but the header has {len(header)}", f"line {line}"
                )
        lines, rows = zip(*found[1:], strict=True)
        return cls(file, header, lines, rows)

    @staticmethod
    def _cells(file: Path, reader: Any) -> Iterator[tuple[int, tuple[str, ...]]]:
        line = 0
        try:
            for row in reader:
                line = reader.line_num
                cells = tuple(cell.strip() for cell in row)
                if any(cells):
                    yield line, cells
        except csv.Error as error:
            raise FormatError(file, f"not a table ({error})", f"line {line + 1}") from None

    def column(self, name: str) -> tuple[str, ...]:
        """Return the cells of a column."""
        k = self.header.index(name)
        return tuple(row[k] for row in self.rows)

    def error(self, i: int, column: str, problem: str) -> FormatError:
        """Return the error that names line and column."""
        return FormatError(self.path, problem, f"line {self.lines[i]}, column {column}")

    def names(self, column: str, what: str) -> tuple[str, ...]:
        """Return a column of names that are unique and not empty."""
        names = self.column(column)
        seen: dict[str, int] = {}
        for i, name in enumerate(names):
            if not name:
                raise self.error(i, column, f"a {what} without a name; give it one")
            if name in seen:
                raise self.error(
                    i,
                    column,
                    f"{what} {name}: the name is that of line {self.lines[seen[name]]} "
                    "too; names are unique",
                )
            seen[name] = i
        return names

    def numbers(self, column: str, *, above_zero: bool = False) -> FloatArray:
        """Return a column of finite numbers."""
        values = np.empty(len(self.rows))
        for i, cell in enumerate(self.column(column)):
            try:
                value = float(cell.replace("_", "?"))
            except ValueError:
                value = math.nan
            if not math.isfinite(value):
                raise self.error(
                    i, column, f"{self.rows[i][0]}: {cell!r} is not a finite number; give metres"
                )
            if above_zero and value <= 0.0:
                raise self.error(i, column, f"{self.rows[i][0]}: {value:g} m must be above 0")
            values[i] = value
        return values

    def counts(self, column: str) -> npt.NDArray[np.int64]:
        """Return a column of whole numbers from 1."""
        values = self.numbers(column)
        wrong = np.flatnonzero((values < 1) | (values != np.floor(values)) | (values > 1e6))
        if len(wrong):
            i = int(wrong[0])
            cell = self.column(column)[i]
            raise self.error(i, column, f"{self.rows[i][0]}: {cell!r} is not a number of pieces")
        return values.astype(np.int64)


def to_plant(table: FieldTable, site: Site, centroids: Centroids | None = None) -> Plant:
    """Return the plant of a field: azimuth-elevation heliostats.

    Heliostats with the same number of facets share a group. Each one's foot stands the pivot height
    below the location of its pivot.

    Parameters
    ----------
    table
        From `read_field`.
    site
        The plant's reference point: the field's origin.
    centroids
        From `read_centroids`; they also give the size of the mirror. Without them
        the facets stand edge to edge.

    Raises
    ------
    InputError
        If the number of facets of a heliostat differs from that of the centroids.
    """
    if centroids is not None and (table.facets != len(centroids)).any():
        i = int(np.flatnonzero(table.facets != len(centroids))[0])
        raise InputError(
            f"heliostat {table.names[i]}: {table.facets[i]} facets, but there are "
            f"{len(centroids)} centroids"
        )
    kinds = sorted(set(zip(table.rows.tolist(), table.columns.tolist(), strict=True)))
    groups = {}
    for rows, columns in kinds:
        members = np.flatnonzero((table.rows == rows) & (table.columns == columns))
        name = "heliostats" if len(kinds) == 1 else f"heliostats-{rows}x{columns}"
        groups[name] = _group(table, members, centroids)
    return Plant(site.name, site, groups)


def _group(
    table: FieldTable, members: npt.NDArray[np.intp], centroids: Centroids | None
) -> Heliostats:
    size = np.stack([table.facet_width[members], table.facet_height[members]], axis=-1)
    if centroids is None:
        center = _edge_to_edge(int(table.rows[members[0]]), int(table.columns[members[0]]), size)
    else:
        center = np.broadcast_to(centroids.center, (len(members), *centroids.center.shape))
    half = np.zeros((2, *center.shape))
    half[0, ..., 0], half[1, ..., 1] = 0.5 * size[:, :1], 0.5 * size[:, 1:]
    mirror = np.ptp(center[..., :2], axis=1) + size
    height = table.pivot_height[members]
    return Heliostats(
        names=tuple(table.names[i] for i in members),
        mechanism=azimuth_elevation(
            table.location[members] - height[:, None] * UP,
            pivot_height=height,
            pivot_offset=table.pivot_offset[members],
        ),
        width=mirror[:, 0],
        height=mirror[:, 1],
        facets=Facets(center, half[0], half[1]),
    )


def _edge_to_edge(rows: int, columns: int, size: FloatArray) -> FloatArray:
    """Return centres of facets without gaps, from the upper left, (N, rows·columns, 3)."""
    down, right = np.mgrid[:rows, :columns].reshape(2, -1)
    center = np.zeros((len(size), rows * columns, 3))
    center[..., 0] = (right - 0.5 * (columns - 1)) * size[:, :1]
    center[..., 1] = (0.5 * (rows - 1) - down) * size[:, 1:]
    return center
