"""Exports every calibration step as CSV: sightings, their beam errors, and learnt parameters.

There is one folder per heliostat, like the records that Malan used for troubleshooting. It contains
``sightings.csv`` (which `calibration.sighting_table` reads), ``residuals.csv`` (for the new
sightings of each version, before and after the fit), ``versions.csv``, ``parameters.csv`` and
``covariance.csv``. The file ``heliostats.csv`` lies beside the folders.
"""

import csv
import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from sqlalchemy import Connection, select

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sighting_table import KINDS, write_sightings
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.files.text import write_text
from heliotrope.files.times import format_time
from heliotrope.store import _rows as rows
from heliotrope.store import tables
from heliotrope.store.database import Database
from heliotrope.store.keeper import calibration_history
from heliotrope.store.records import KeptSightings


def export(
    database: Database,
    folder: str | Path,
    heliostats: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[str]:
    """Write the steps of all calibrations; return the names of the heliostats written.

    Parameters
    ----------
    database
        Database to export; it may be written to in the meantime, because the export reads one
        consistent state.
    folder
        Destination, created if missing; existing files are replaced.
    heliostats
        Names; None: every heliostat in the store.
    progress
        Called with (done, total) after each heliostat.

    Raises
    ------
    StoreError
        If the store cannot be read.
    UnknownNameError
        If a heliostat is not in the store.
    InputError
        If the folder cannot be written.
    """
    place = Path(folder)
    database.require()
    index = []
    with database.reading() as connection:
        known = _known(connection)
        for name in heliostats or ():
            if name not in known:
                raise UnknownNameError("heliostat in the store", name, known)
        selected = known if heliostats is None else list(dict.fromkeys(heliostats))
        for done, name in enumerate(selected, 1):
            kept = _sightings(connection, name)
            history = calibration_history(connection, name)
            _write_heliostat(place / folder_name(name), name, kept, history)
            index.append(_index_row(name, kept, history))
            if progress is not None:
                progress(done, len(selected))
    _write(place / "heliostats.csv", _INDEX, index)
    return selected


def folder_name(heliostat: str) -> str:
    """Return the name of a heliostat's folder; characters that file systems refuse are encoded."""
    name = quote(heliostat, safe=" +-_.,()=@")
    return name.replace(".", "%2E") if set(name) <= {"."} else name


def _known(connection: Connection) -> list[str]:
    names: set[str] = set()
    for table in (tables.sighting, tables.parameter_version):
        names.update(connection.scalars(select(table.c.heliostat).distinct()))
    return sorted(names)


def _sightings(connection: Connection, name: str) -> KeptSightings:
    table = tables.sighting
    query = select(table).where(table.c.heliostat == name).order_by(table.c.time, table.c.number)
    return rows.kept_sightings(connection.execute(query).all())


def _write_heliostat(
    place: Path, name: str, kept: KeptSightings, history: Sequence[HeliostatCalibration]
) -> None:
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{place}: {error.strerror}; choose a folder to write to") from None
    kinds = [kind if kind in KINDS else "" for kind in kept.kinds]
    write_sightings(place / "sightings.csv", kept.sightings, kept.names or (name,), kinds)
    _write(place / "residuals.csv", _RESIDUALS, _residuals(kept, history))
    _write(place / "versions.csv", _VERSIONS, map(_version, history))
    _write(place / "parameters.csv", _PARAMETERS, _parameters(history))
    _write(place / "covariance.csv", _COVARIANCE, _covariance(history))


def _write(path: Path, header: Sequence[str], lines: Iterable[Sequence[Any]]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([_cell(value) for value in line] for line in lines)
    write_text(path, text.getvalue())


def _cell(value: Any) -> str:
    """Return the text of a CSV cell: "" for NaN; a float reads back as the same float."""
    if isinstance(value, float):
        return "" if np.isnan(value) else repr(float(value))
    return str(value)


_INDEX = (
    "heliostat", "folder", "sightings", "versions", "last_version_at", "beam_error_before_rad",
    "beam_error_after_rad",
)  # fmt: skip


def _index_row(
    name: str, kept: KeptSightings, history: Sequence[HeliostatCalibration]
) -> Sequence[Any]:
    last = history[-1] if history else None
    tail = ("", "", "") if last is None else (format_time(last.at), last.before, last.after)
    return (name, folder_name(name), len(kept), len(history), *tail)


#: ``row`` counts the rows of sightings.csv from 1, without the header.
_RESIDUALS = (
    "version", "row", "sighting", "time", "before_right_rad", "before_above_rad", "before_beam_rad",
    "after_right_rad", "after_above_rad", "after_beam_rad",
)  # fmt: skip


def _residuals(
    kept: KeptSightings, history: Sequence[HeliostatCalibration]
) -> Iterable[Sequence[Any]]:
    row_of = {int(number): row for row, number in enumerate(kept.identities)}
    for version in history:
        before, after = version.residual_before, version.residual_after
        # The residual of a sighting is stored for the version that first uses it.
        known = np.isfinite(before).any(axis=1) | np.isfinite(after).any(axis=1)
        for i in np.flatnonzero(known):
            sighting = version.sightings[i]
            row = row_of.get(int(sighting))
            place = ("", "") if row is None else (row + 1, kept.sightings.time[row])
            yield (
                version.version,
                place[0],
                sighting,
                place[1] and format_time(float(place[1])),
                float(before[i, 0]),
                float(before[i, 1]),
                float(np.hypot(*before[i])),
                float(after[i, 0]),
                float(after[i, 1]),
                float(np.hypot(*after[i])),
            )


_VERSIONS = (
    "version", "at", "model", "outcome", "sightings", "beam_error_before_rad",
    "beam_error_after_rad", "scale", "person", "campaign", "pushed", "program", "note",
)  # fmt: skip


def _version(v: HeliostatCalibration) -> Sequence[Any]:
    return (
        v.version,
        format_time(v.at),
        v.model,
        v.outcome.text,
        len(v.sightings),
        v.before,
        v.after,
        v.scale,
        v.person,
        v.campaign,
        " ".join(v.pushed),
        v.code,
        v.note,
    )


#: Values are deviations from the nominal mechanism in rad, m or 1; see the parameter reference.
_PARAMETERS = ("version", "at", "parameter", "value", "sigma", "prior_sigma")


def _parameters(history: Sequence[HeliostatCalibration]) -> Iterable[Sequence[Any]]:
    for v in history:
        for p, name in enumerate(v.names):
            yield (
                v.version,
                format_time(v.at),
                name,
                float(v.values[p]),
                float(v.sigma[p]),
                float(v.prior[p]),
            )


_COVARIANCE = ("version", "parameter_1", "parameter_2", "covariance", "correlation")


def _covariance(history: Sequence[HeliostatCalibration]) -> Iterable[Sequence[Any]]:
    for v in history:
        sigma = v.sigma
        for a, first in enumerate(v.names):
            for b in range(a, len(v.names)):
                size = sigma[a] * sigma[b]
                correlation = float(v.covariance[a, b] / size) if size > 0.0 else float("nan")
                yield v.version, first, v.names[b], float(v.covariance[a, b]), correlation
