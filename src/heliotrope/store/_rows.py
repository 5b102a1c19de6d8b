"""Converts records to table rows, and back.

Fields and columns are matched by name, and the column types convert the values (see `tables`). Two
kinds of record have their own functions because one record spans many rows: sightings, and the
sightings behind a calibration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt
from sqlalchemy import Connection, Executable, RowMapping, Select, Table
from sqlalchemy import Row as SqlRow
from sqlalchemy.dialects import postgresql, sqlite

from heliotrope.calibration.record import HeliostatCalibration, Identities
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray
from heliotrope.store import tables
from heliotrope.store.records import KeptSightings

Row = dict[str, Any]
_ENDS = ("source", "destination")
_AXES = ("east", "north", "up")
_MISSES = ("before_right", "before_above", "after_right", "after_above")
Record = TypeVar("Record")


def insert(connection: Connection, table: Table, rows: Sequence[Row]) -> int:
    """Insert rows, except rows whose key exists already; return the number of inserted rows."""
    if not rows:
        return 0
    return connection.execute(_insert(connection.dialect.name, table), list(rows)).rowcount


@cache
def _insert(dialect: str, table: Table) -> Executable:
    """Return the insert statement, which is cached because events arrive in thousands."""
    kind = postgresql if dialect == "postgresql" else sqlite
    statement: Executable = kind.insert(table).on_conflict_do_nothing()
    return statement


def replace(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert rows; each row replaces an existing row with the same key."""
    if not rows:
        return
    kind = postgresql if connection.dialect.name == "postgresql" else sqlite
    statement = kind.insert(table)
    rest = {c.name: statement.excluded[c.key] for c in table.columns if not c.primary_key}
    change = statement.on_conflict_do_update(index_elements=list(table.primary_key), set_=rest)
    connection.execute(change, list(rows))


def row_of(table: Table, record: object, **others: Any) -> Row:
    """Return the row of a record.

    Each column is taken from the attribute of the same name, or from ``others``.
    """
    own = (key for key in table.columns.keys() if key not in others)  # noqa: SIM118
    return {**{key: getattr(record, key) for key in own}, **others}


def record_of(kind: type[Record], row: RowMapping, **others: Any) -> Record:
    """Return the record in a row.

    Each field is taken from the column of the same name, or from ``others``.
    """
    names = {field.name for field in fields(cast("Any", kind))} - others.keys()
    return kind(**{name: row[name] for name in names if name in row}, **others)


def records(connection: Connection, kind: type[Record], query: Select[Any]) -> list[Record]:
    """Return the records found by a query."""
    return [record_of(kind, row) for row in connection.execute(query).mappings()]


# -- sightings ---------------------------------------------------------------------------


def sighting_rows(
    numbers: Identities, names: Sequence[str], s: Sightings, kind: str, target: str, campaign: str
) -> list[Row]:
    """Return M rows of the table ``sighting``."""
    covariances = {end: getattr(s, f"{end}_covariance") for end in _ENDS}
    rows: list[Row] = []
    for i, row in enumerate(s.heliostat.tolist()):
        cells: Row = {
            "number": int(numbers[i]), "heliostat": names[row], "kind": kind, "target": target,
            "campaign": campaign, "time": s.time[i], "counts": s.counts[i].tolist(),
            "sigma": float(s.sigma[i]),
        }  # fmt: skip
        for end in _ENDS:
            cells[f"{end}_at_infinity"] = bool(getattr(s, f"{end}_at_infinity")[i])
            point = getattr(s, end)[i].tolist()
            cells.update({f"{end}_{axis}": x for axis, x in zip(_AXES, point, strict=True)})
            matrix = covariances[end][i]
            cells[f"{end}_covariance"] = matrix.tolist() if matrix.any() else None
        rows.append(cells)
    return rows


def kept_sightings(rows: Sequence[SqlRow[Any]]) -> KeptSightings:
    """Return sightings from M complete rows of the table, all with the same number of drives."""
    # Column by column, because looking up each cell of 100,000 rows takes longer than reading them.
    cells = zip(*rows, strict=True) if rows else ((),) * len(tables.sighting.columns)
    columns = dict(zip(tables.sighting.columns.keys(), cells, strict=True))
    names = tuple(dict.fromkeys(columns["heliostat"]))
    index = {name: i for i, name in enumerate(names)}

    def array(name: str, dtype: npt.DTypeLike = np.float64) -> Any:
        return np.array(columns[name], dtype=dtype)

    def points(end: str) -> FloatArray:
        return np.stack([array(f"{end}_{axis}") for axis in _AXES], axis=-1)

    def matrices(end: str) -> FloatArray:
        cells = columns[f"{end}_covariance"]
        known = [i for i, cell in enumerate(cells) if cell is not None]
        filled = np.zeros((len(rows), 3, 3))
        filled[known] = np.array([cells[i] for i in known], np.float64).reshape(-1, 3, 3)
        return filled

    drives = len(columns["counts"][0]) if rows else 2
    sightings = Sightings(
        np.array([index[name] for name in columns["heliostat"]], np.intp),
        array("time"),
        array("counts").reshape(len(rows), drives),
        points("source"),
        points("destination"),
        array("source_at_infinity", np.bool_),
        array("destination_at_infinity", np.bool_),
        array("sigma"),
        matrices("source"),
        matrices("destination"),
    )
    texts = [tuple(columns[name]) for name in ("kind", "target", "campaign")]
    return KeptSightings(array("number", np.int64), names, sightings, *texts)


# -- calibrations ------------------------------------------------------------------------


def behind_rows(
    record: HeliostatCalibration, standing: Mapping[int, bool]
) -> tuple[list[Row], list[int]]:
    """Return the changes that a version makes to the table ``parameter_sighting``.

    Parameters
    ----------
    record
        The new version.
    standing
        Whether each sighting behind the previous version was used, by number.

    Returns
    -------
        The new rows, and the numbers of the sightings whose rows end with this version.
    """
    nothing = np.full((len(record.left_out), 4), np.nan)
    misses = np.concatenate([record.residual_before, record.residual_after], axis=1)
    whole = np.concatenate([misses, nothing])
    numbers = (*record.sightings.tolist(), *record.left_out.tolist())
    use_of = {number: place < len(misses) for place, number in enumerate(numbers)}
    made = [
        {
            "heliostat": record.heliostat,
            "sighting": number,
            "version": record.version,
            "used": use_of[number],
            **dict(zip(_MISSES, whole[place].tolist(), strict=True)),
        }
        for place, number in enumerate(numbers)
        if standing.get(number) is not use_of[number]
    ]
    return made, [number for number, used in standing.items() if use_of.get(number) is not used]


class Behind:
    """The sightings behind the versions of one heliostat.

    Parameters
    ----------
    found
        The heliostat's rows of the table ``parameter_sighting``, in the order of the numbers.
    """

    def __init__(self, rows: Sequence[RowMapping]) -> None:
        def column(name: str, dtype: npt.DTypeLike) -> Any:
            return np.array([row[name] for row in rows], dtype=dtype)

        self._number, self._used = column("sighting", np.int64), column("used", np.bool_)
        self._from = column("version", np.int64)
        last = np.iinfo(np.int64).max
        ends = [last if row["until"] is None else row["until"] for row in rows]
        self._until = np.array(ends, np.int64)
        self._misses = np.array([[row[name] for name in _MISSES] for row in rows]).reshape(-1, 4)

    def of(self, version: int) -> dict[str, Any]:
        """Return the fields of a version.

        Residuals are NaN except for sightings that are new in this version.
        """
        stands = (self._from <= version) & (version < self._until)
        used = np.flatnonzero(stands & self._used)
        new = (self._from[used] == version)[:, None]
        misses = np.where(new, self._misses[used], np.nan)
        return {
            "sightings": self._number[used],
            "left_out": self._number[stands & ~self._used],
            "residual_before": misses[:, :2],
            "residual_after": misses[:, 2:],
        }


def calibration(row: RowMapping, behind: Behind) -> HeliostatCalibration:
    """Return a calibration from its row and the sightings behind it."""
    return record_of(HeliostatCalibration, row, **behind.of(row["version"]))
