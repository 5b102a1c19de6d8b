"""Facts about a photograph besides its pixels: heliostat, motors, target, time or sun."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.errors import FormatError
from heliotrope.field.formats.paint import read_calibration_properties
from heliotrope.files import check_table
from heliotrope.geometry import FloatArray, direction

#: Columns of a log; a row needs a file name or id, a heliostat and two counts.
COLUMNS = (
    "file", "id", "heliostat", "timestamp", "target", "axis_1_motor_position",
    "axis_2_motor_position", "sun_azimuth_deg_south0_east", "sun_elevation_deg_apparent", "empty",
)  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """Facts about one photograph.

    Attributes
    ----------
    heliostat
        Heliostat of the beam; "" if unknown.
    counts
        Motor counts, (D,); None if unknown.
    target
        Target that the beam was sent to; "" if unknown.
    time
        Time with its zone; None if unknown.
    sun
        Unit vector to the apparent sun, ENU, (3,); None if unknown.
    empty
        Photograph of the camera without the beam, of the same minute, or None.
    """

    heliostat: str = ""
    counts: FloatArray | None = None
    target: str = ""
    time: datetime | None = None
    sun: FloatArray | None = None
    empty: Path | None = None


class Log:
    """Entries by file name or number.

    A row belongs to a photograph if its ``file`` is the photograph's name, or its ``id`` is the
    beginning of that name up to the first hyphen, underscore or dot.
    """

    def __init__(self, entries: Mapping[str, Entry]) -> None:
        self._entries = dict(entries)

    def __len__(self) -> int:
        return len(self._entries)

    def find(self, path: Path) -> Entry | None:
        """Return the entry of a photograph."""
        for key in (str(path), path.name, path.stem, _number(path)):
            if key in self._entries:
                return self._entries[key]
        return None


def _number(path: Path) -> str:
    name = path.name
    for mark in "-_.":
        name = name.split(mark, 1)[0]
    return name


def read_log(path: str | Path) -> Log:
    """Return the log of a CSV table.

    Parameters
    ----------
    path
        A table with the columns `COLUMNS`, such as Jülich's ``measurements.csv``. ``empty`` is
        relative to the log's folder.

    Raises
    ------
    FormatError
        If it cannot be read, or lacks a required value.
    """
    import pandas as pd

    file = check_table(path, "a log of photographs (CSV)")
    try:
        table = pd.read_csv(file, dtype=str, keep_default_na=False)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise FormatError(file, f"not a CSV table ({str(error).strip()})") from None
    needed = ("heliostat", "axis_1_motor_position", "axis_2_motor_position")
    missing = [c for c in needed if c not in table.columns]
    if not {"file", "id"} & set(table.columns):
        missing.insert(0, "file (or id)")
    if missing:
        there = ", ".join(map(str, table.columns[:12]))
        raise FormatError(file, f"column {missing[0]} is missing; present are {there}", "line 1")
    entries: dict[str, Entry] = {}
    for number, row in enumerate(table.to_dict("records"), start=2):
        key = str(row.get("file") or row.get("id") or "").strip()
        if not key:
            raise FormatError(file, "neither file nor id is given", f"line {number}")
        entries[key] = _entry(file, number, {str(k): str(v) for k, v in row.items()})
    return Log(entries)


def _entry(file: Path, line: int, row: Mapping[str, str]) -> Entry:
    def number(column: str) -> float:
        text = row.get(column, "").strip()
        try:
            return float(text) if text else float("nan")
        except ValueError:
            raise FormatError(
                file, f"{text!r} is not a number", f"line {line}, column {column}"
            ) from None

    counts = np.array([number("axis_1_motor_position"), number("axis_2_motor_position")])
    angles = number("sun_azimuth_deg_south0_east"), number("sun_elevation_deg_apparent")
    time = None
    text = row.get("timestamp", "").strip()
    if text:
        try:
            time = datetime.fromisoformat(text)
        except ValueError:
            time = None
        if time is None or time.tzinfo is None:
            raise FormatError(
                file,
                f"{text!r} is not a time with a zone; write 2026-06-21T12:00:00Z",
                f"line {line}, column timestamp",
            )
    empty = row.get("empty", "").strip()
    return Entry(
        heliostat=row.get("heliostat", "").strip(),
        counts=counts if np.isfinite(counts).all() else None,
        target=row.get("target", "").strip(),
        time=time,
        sun=_sun(*angles),
        empty=(file.parent / empty).resolve() if empty else None,
    )


def _sun(azimuth_deg: float, elevation_deg: float) -> FloatArray | None:
    """Return the direction for PAINT's azimuth: 0 is south, east is positive."""
    if not (np.isfinite(azimuth_deg) and np.isfinite(elevation_deg)):
        return None
    return direction(np.pi - np.radians(azimuth_deg), np.radians(elevation_deg))


def beside(path: Path, heliostat: str = "") -> Entry | None:
    """Return the entry in PAINT's file beside a photograph; None if there is no such file.

    Parameters
    ----------
    path
        ``ID/Calibration/137608-raw.png`` with ``137608-calibration-properties.json``.
    heliostat
        Used if the folder does not name it.

    Raises
    ------
    FormatError
        If the file exists and cannot be read.
    """
    file = path.with_name(f"{_number(path)}-calibration-properties.json")
    if not file.exists():
        return None
    found: Any = read_calibration_properties(file)
    folder = path.parent.parent.name if path.parent.name == "Calibration" else ""
    return Entry(
        heliostat=heliostat or folder,
        counts=np.array(found.motors),
        target=found.target,
        sun=_sun(found.sun_azimuth_deg, found.sun_elevation_deg),
    )
