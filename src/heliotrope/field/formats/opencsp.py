"""OpenCSP heliostat fields: a table of heliostats and a table of facet centroids.

The heliostat table has one row per heliostat and these columns, found by name::

    Name, X, Y, Z, Num. Facets, Num. Rows, Num. Cols, Pivot Height, Pivot Offset,
    Facet Width, Facet Height

X is east, Y north, Z up, in m. The position is the position of the pivot (the torque tube), not of
the foot, and the pivot height is for information only. The mirror surface is in front of the pivot
by the pivot offset. Azimuth is clockwise from north, elevation from the horizon.

The centroid table (Facet id, X, Y, Z) applies to all heliostats of the field. Its frame belongs to
a mirror that lies face up and is rotated to face south: X to the right as seen from the front, Y
up, Z out of the mirror. Facets are listed from the upper left, row by row, and are neither canted
nor curved in these files.

These facts come from the sources and data of OpenCSP (Sandia National Laboratories).
"""

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.field.formats._plant_table import plausible
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.files import Rows, alike, read_cells, read_rows, write_text
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.kinds import UP, azimuth_elevation
from heliotrope.sun import Site

COLUMNS = (
    "Name", "X", "Y", "Z", "Num. Facets", "Num. Rows", "Num. Cols", "Pivot Height",
    "Pivot Offset", "Facet Width", "Facet Height",
)  # fmt: skip
FACET_COLUMNS = ("Facet id", "X", "Y", "Z")

_COUNTS = ("Num. Facets", "Num. Rows", "Num. Cols")
_SIZES = {
    "Pivot Height": "pivot_height_m",
    "Pivot Offset": "pivot_offset_m",
    "Facet Width": "mirror_width_m",
    "Facet Height": "mirror_height_m",
}
#: Columns that occur in no other format's heliostat table.
_OWN = ("Name", "Num. Facets", "Pivot Height")


@dataclass(frozen=True, eq=False)
class FieldTable:
    """The heliostat table.

    Attributes
    ----------
    names
        Unique.
    location
        Positions of the pivots, m east, north and up, (N, 3).
    facets, rows, columns
        Number of facets, and number of rows and columns of facets, (N,).
    pivot_height
        m, (N,).
    pivot_offset
        Distance of the mirror's face in front of the pivot, m, (N,).
    facet_width, facet_height
        m, (N,).
    extra
        Additional columns of the file, unchanged, each (N,).
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
    """Read the heliostat table.

    Raises
    ------
    FormatError
        If the file cannot be read, a column is missing, a row has the wrong number of cells, a cell
        is invalid for its column, or a name occurs twice; the text states line and column.
    """
    rows = _read(path, "an OpenCSP heliostat field", COLUMNS)
    names = rows.names("Name", "heliostat")
    rows.heliostat = names
    location = _location(rows)
    sizes = {column: plausible(rows, column, meaning) for column, meaning in _SIZES.items()}
    facets, in_rows, in_columns = (_count(rows, column) for column in _COUNTS)
    for i in np.flatnonzero(facets != in_rows * in_columns):
        grid = f"{in_rows[i]:g} rows × {in_columns[i]:g} columns"
        rows.refuse(i, "Num. Facets", f"{facets[i]:g} facets are not {grid}")
    rows.refuse_bad()
    return FieldTable(
        names=names,
        location=location,
        facets=facets.astype(np.int64),
        rows=in_rows.astype(np.int64),
        columns=in_columns.astype(np.int64),
        pivot_height=sizes["Pivot Height"],
        pivot_offset=sizes["Pivot Offset"],
        facet_width=sizes["Facet Width"],
        facet_height=sizes["Facet Height"],
        extra={name: tuple(rows.texts(name)) for name in rows.columns if name not in COLUMNS},
    )


def is_field(path: Path) -> bool:
    """Return whether the header of a table contains OpenCSP's columns."""
    _, table = read_cells(path, "a table of heliostats (SolarPILOT or OpenCSP)")
    return {alike(name) for name in _OWN} <= {alike(cell) for cell in table[0]}


def _read(path: str | Path, what: str, columns: tuple[str, ...]) -> Rows:
    rows = read_rows(Path(path), what, columns)
    rows.need(columns)
    if not len(rows):
        raise FormatError(path, f"there are no rows below the header; expected {what}")
    return rows


def _location(rows: Rows) -> FloatArray:
    meanings = zip("XYZ", ("east_m", "north_m", "up_m"), strict=True)
    return np.stack([plausible(rows, axis, meaning) for axis, meaning in meanings], axis=-1)


def _count(rows: Rows, column: str) -> FloatArray:
    values = rows.numbers(column, "a number of facets, rows or columns")
    invalid = ~((values >= 1) & (values == np.floor(values)) & (values <= 1e6))
    rows.check(
        column, invalid & np.isfinite(values), values, " is not a whole number from 1 to 1,000,000"
    )
    return values


def write_field(path: str | Path, table: FieldTable) -> None:
    """Write the heliostat table, with its additional columns, completely or not at all."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([*COLUMNS, *table.extra])
    for i, name in enumerate(table.names):
        counts = [int(values[i]) for values in (table.facets, table.rows, table.columns)]
        sizes = (table.pivot_height, table.pivot_offset, table.facet_width, table.facet_height)
        numbers = [float(values[i]) for values in sizes]
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
    rows = _read(path, "an OpenCSP table of facet centroids", FACET_COLUMNS)
    ids = rows.names("Facet id", "facet")
    center = np.stack([rows.numbers(axis, "metres") for axis in "XYZ"], axis=-1)
    for axis, values in zip("XYZ", center.T, strict=True):
        rows.within(axis, values, -50.0, 50.0, "m from the mirror's vertex")
    rows.refuse_bad()
    return Centroids(ids, center)


def to_plant(table: FieldTable, site: Site, centroids: Centroids | None = None) -> Plant:
    """Return the plant of a field: azimuth-elevation heliostats.

    Heliostats with the same number of facets share a group. The foot of each heliostat is below its
    pivot by the pivot height.

    Parameters
    ----------
    table
        From `read_field`.
    site
        The plant's reference point: the field's origin.
    centroids
        From `read_centroids`; they also determine the size of the mirror. Without them the facets
        are placed edge to edge.

    Raises
    ------
    InputError
        If a heliostat's number of facets differs from the number of centroids.
    """
    if centroids is not None and (table.facets != len(centroids)).any():
        i = int(np.flatnonzero(table.facets != len(centroids))[0])
        raise InputError(
            f"heliostat {table.names[i]}: {table.facets[i]} facets, but the centroid table has "
            f"{len(centroids)}"
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
    """Return the centres of facets without gaps, from the upper left, (N, rows·columns, 3)."""
    down, right = np.mgrid[:rows, :columns].reshape(2, -1)
    center = np.zeros((len(size), rows * columns, 3))
    center[..., 0] = (right - 0.5 * (columns - 1)) * size[:, :1]
    center[..., 1] = (0.5 * (rows - 1) - down) * size[:, 1:]
    return center
