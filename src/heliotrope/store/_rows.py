"""Rows of the tables from records, and records from rows."""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
from sqlalchemy import Connection, Executable, RowMapping, Table
from sqlalchemy import Row as SqlRow
from sqlalchemy.dialects import postgresql, sqlite

from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.record import (
    CalibrationOutcome,
    HeliostatCalibration,
    Identities,
    Provenance,
)
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray
from heliotrope.store import tables
from heliotrope.store.records import (
    SEVERITIES,
    AlarmEntry,
    CampaignEntry,
    Event,
    KeptSightings,
    PlannedVisit,
    VisitEntry,
)

Row = dict[str, Any]
_ENDS = ("source", "destination")
_AXES = ("east", "north", "up")
_MISSES = ("before_right", "before_above", "after_right", "after_above")
_VISIT_REALS = (
    "gain", "sigma_before", "sigma_expected", "sigma_after", "error_before", "error_after",
)  # fmt: skip


def insert(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert rows; one whose key is there already is there already."""
    if rows:
        connection.execute(_insert(connection.dialect.name, table), list(rows))


@cache
def _insert(dialect: str, table: Table) -> Executable:
    """Return the statement, which is made once: events come in thousands."""
    kind = postgresql if dialect == "postgresql" else sqlite
    statement: Executable = kind.insert(table).on_conflict_do_nothing()
    return statement


def replace(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert rows, or put them in place of those with their keys."""
    if not rows:
        return
    kind = postgresql if connection.dialect.name == "postgresql" else sqlite
    statement = kind.insert(table)
    keys = [column.name for column in table.primary_key]
    rest = {name: statement.excluded[name] for name in rows[0] if name not in keys}
    connection.execute(statement.on_conflict_do_update(index_elements=keys, set_=rest), list(rows))


def real(value: float | None) -> float | None:
    """Return a number as it is written: what is none is NULL."""
    return float(value) if value is not None and math.isfinite(value) else None


def number(value: float | None) -> float:
    """Return a number as it is read: NULL is NaN."""
    return math.nan if value is None else value


def reals(values: Mapping[str, float]) -> dict[str, float | None]:
    """Return numbers by name as they are written."""
    return {str(name): real(value) for name, value in values.items()}


# -- sightings ---------------------------------------------------------------------------


def sighting_rows(
    numbers: Identities, names: Sequence[str], s: Sightings, kind: str, target: str, campaign: str
) -> list[Row]:
    """Return M rows of the table ``sighting``."""
    covariances = {end: getattr(s, f"{end}_covariance") for end in _ENDS}
    rows: list[Row] = []
    for i, row in enumerate(s.heliostat.tolist()):
        found: Row = {
            "number": int(numbers[i]), "heliostat": names[row], "kind": kind, "target": target,
            "campaign": campaign, "time": real(s.time[i]), "counts": s.counts[i].tolist(),
            "sigma": float(s.sigma[i]),
        }  # fmt: skip
        for end in _ENDS:
            found[f"{end}_at_infinity"] = bool(getattr(s, f"{end}_at_infinity")[i])
            point = getattr(s, end)[i].tolist()
            found.update({f"{end}_{axis}": x for axis, x in zip(_AXES, point, strict=True)})
            matrix = covariances[end][i]
            found[f"{end}_covariance"] = matrix.tolist() if matrix.any() else None
        rows.append(found)
    return rows


def kept_sightings(rows: Sequence[SqlRow[Any]]) -> KeptSightings:
    """Return sightings from M rows of the whole table, all with as many drives."""
    # By columns: of 100,000 rows a look-up of each cell takes longer than reading them.
    cells = zip(*rows, strict=True) if rows else ((),) * len(tables.sighting.columns)
    columns = dict(zip(tables.sighting.columns.keys(), cells, strict=True))
    names = tuple(dict.fromkeys(columns["heliostat"]))
    index = {name: i for i, name in enumerate(names)}

    def array(name: str, dtype: npt.DTypeLike = np.float64) -> Any:
        return np.array(columns[name], dtype=dtype)

    def points(end: str) -> FloatArray:
        return np.stack([array(f"{end}_{axis}") for axis in _AXES], axis=-1)

    def matrices(end: str) -> FloatArray:
        given = columns[f"{end}_covariance"]
        known = [i for i, cell in enumerate(given) if cell is not None]
        found = np.zeros((len(rows), 3, 3))
        found[known] = np.array([given[i] for i in known], np.float64).reshape(-1, 3, 3)
        return found

    drives = len(columns["counts"][0]) if rows else 2
    seen = Sightings(
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
    return KeptSightings(array("number", np.int64), names, seen, *texts)


# -- parameters --------------------------------------------------------------------------


def calibration_row(record: HeliostatCalibration) -> Row:
    """Return the row of the table ``parameter_version``."""
    return {
        "heliostat": record.heliostat,
        "version": record.version,
        "at": record.at,
        "model": record.model,
        "names": list(record.names),
        "value": record.values.tolist(),
        "covariance": record.covariance.tolist(),
        "prior": record.prior.tolist(),
        "error_before": real(record.before),
        "error_after": real(record.after),
        "scale": real(record.scale),
        "outcome": record.outcome.name.lower(),
        "provenance": record.provenance.value,
        "person": record.person,
        "campaign": record.campaign,
        "note": record.note,
        "pushed": list(record.pushed),
        "code": record.code,
    }


def used_rows(record: HeliostatCalibration) -> list[Row]:
    """Return the rows of the table ``parameter_sighting``: sightings used, then those left out."""
    nothing = np.full((len(record.left_out), 4), np.nan)
    misses = np.concatenate([record.residual_before, record.residual_after], axis=1)
    whole = np.concatenate([misses, nothing])
    numbers = (*record.sightings.tolist(), *record.left_out.tolist())
    return [
        {
            "heliostat": record.heliostat,
            "version": record.version,
            "place": place,
            "sighting": number,
            "used": place < len(record.sightings),
            **{name: real(x) for name, x in zip(_MISSES, whole[place], strict=True)},
        }
        for place, number in enumerate(numbers)
    ]


def calibration(row: RowMapping, behind: Sequence[RowMapping] = ()) -> HeliostatCalibration:
    """Return a calibration from its row, and the rows of the sightings behind it."""
    used = [u for u in behind if u["used"]]
    misses = np.array([[number(u[name]) for name in _MISSES] for u in used]).reshape(-1, 4)
    names = tuple(row["names"])
    return HeliostatCalibration(
        row["heliostat"],
        row["at"],
        names,
        np.array(row["value"], np.float64),
        np.array(row["covariance"], np.float64).reshape(len(names), len(names)),
        np.array(row["prior"], np.float64),
        number(row["error_before"]),
        number(row["error_after"]),
        number(row["scale"]),
        FitOutcome[row["outcome"].upper()],
        np.array([u["sighting"] for u in used], np.int64),
        np.array([u["sighting"] for u in behind if not u["used"]], np.int64),
        misses[:, :2],
        misses[:, 2:],
        row["model"],
        Provenance(row["provenance"]),
        row["person"],
        row["campaign"],
        row["note"],
        tuple(row["pushed"]),
        row["code"],
        row["version"],
    )


# -- the others --------------------------------------------------------------------------


def visit_row(entry: VisitEntry, number: int) -> Row:
    """Return the row of the table ``visit``."""
    row = {column.name: getattr(entry, column.name) for column in tables.visit.columns}
    reals = {name: real(row[name]) for name in _VISIT_REALS}
    return {**row, **reals, "number": number, "outcome": entry.outcome.value}


def visit(row: RowMapping) -> VisitEntry:
    """Return a visit from its row."""
    values = {name: value for name, value in row.items() if name != "good"}
    reals = {name: number(row[name]) for name in _VISIT_REALS}
    return VisitEntry(**{**values, **reals, "outcome": CalibrationOutcome(row["outcome"])})


def plan_rows(plan: Sequence[PlannedVisit]) -> list[Row]:
    """Return the rows of the table ``plan``, in the order of their time."""
    return [
        {
            "place": i,
            "heliostat": p.heliostat,
            "target": p.target,
            "due": p.due,
            "gain": real(p.gain),
            "note": p.note,
        }
        for i, p in enumerate(sorted(plan, key=lambda p: p.due))
    ]


def planned(row: RowMapping) -> PlannedVisit:
    """Return a planned visit from its row."""
    return PlannedVisit(
        row["heliostat"], row["target"], row["due"], number(row["gain"]), row["note"]
    )


def campaign_row(entry: CampaignEntry) -> Row:
    """Return the row of the table ``campaign``."""
    return {
        "name": entry.name,
        "begun": entry.begun,
        "finished": entry.finished,
        "model": entry.model,
        "note": entry.note,
        "expected": reals(entry.expected),
        "found": reals(entry.found),
    }


def campaign(row: RowMapping) -> CampaignEntry:
    """Return a campaign from its row."""
    figures = {
        key: {name: number(x) for name, x in row[key].items()} for key in ("expected", "found")
    }
    return CampaignEntry(**{**row, **figures})


def event_row(entry: Event, number: int) -> Row:
    """Return the row of the table ``event``."""
    return {
        "number": number,
        "at": entry.at,
        "source": entry.source,
        "severity": SEVERITIES.index(entry.severity),
        "heliostat": entry.heliostat,
        "text": entry.text,
        "values": reals(entry.values),
    }


def event(row: RowMapping) -> Event:
    """Return an event from its row."""
    values = {name: number(x) for name, x in row["values"].items()}
    return Event(
        row["at"],
        row["source"],
        row["text"],
        SEVERITIES[row["severity"]],
        row["heliostat"],
        values,
        row["number"],
    )


def alarm(row: RowMapping) -> AlarmEntry:
    """Return an alarm from its row."""
    return AlarmEntry(**row)
