"""Metadata of photographs: heliostat, motor counts, target, time or sun vector."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.field.formats.paint import heliostat_of, read_calibration_properties
from heliotrope.files import read_rows
from heliotrope.geometry import FloatArray, direction

#: Columns of a log; a row needs a file name or id, a heliostat and two counts.
COLUMNS = (
    "file", "id", "heliostat", "timestamp", "target", "axis_1_motor_position",
    "axis_2_motor_position", "sun_azimuth_deg_south0_east", "sun_elevation_deg_apparent", "empty",
)  # fmt: skip
_MOTORS, _ANGLES = COLUMNS[5:7], COLUMNS[7:9]


@dataclass(frozen=True)
class Entry:
    """Metadata of one photograph.

    Attributes
    ----------
    heliostat
        Heliostat that sends the beam; empty if unknown.
    counts
        Drive counts, (D,); None if unknown.
    target
        Target to which the beam was sent; empty if unknown.
    time
        Time with its time zone; None if unknown.
    sun
        Unit vector to the apparent sun, ENU, (3,); None if unknown.
    empty
        Photograph by the same camera without the beam, from the same minute; None if there is none.
    """

    heliostat: str = ""
    counts: FloatArray | None = None
    target: str = ""
    time: datetime | None = None
    sun: FloatArray | None = None
    empty: Path | None = None


class Log:
    """Entries by file name or number.

    An entry belongs to a photograph if its ``file`` is the photograph's name, or its ``id`` is the
    part of that name before the first hyphen, underscore or dot.
    """

    def __init__(self, entries: Mapping[str, Entry]) -> None:
        self._entries = dict(entries)

    def __len__(self) -> int:
        return len(self._entries)

    def find(self, path: Path) -> Entry | None:
        """Return the entry of a photograph."""
        for key in (str(path), path.name, *_short(path)):
            if key in self._entries:
                return self._entries[key]
        return None


def _short(path: Path) -> tuple[str, str]:
    """Return the shortened names under which a log may list a photograph."""
    return path.stem, _number(path)


def _number(path: Path) -> str:
    name = path.name
    for mark in "-_.":
        name = name.split(mark, 1)[0]
    return name


def read_log(path: str | Path) -> Log:
    """Return the log from a CSV table.

    Parameters
    ----------
    path
        A table with the columns `COLUMNS`, such as Jülich's ``measurements.csv``. Paths in the
        column ``empty`` are relative to the folder of the log.

    Raises
    ------
    FormatError
        If the table cannot be read, lacks a required value, or has two entries for one photograph.
    """
    rows = read_rows(Path(path), "a log of photographs (CSV)", COLUMNS)
    rows.need(["heliostat", *_MOTORS])
    if not {"file", "id"} & set(rows.columns):
        rows.need(["file"])
    for name in COLUMNS:
        rows.columns.setdefault(name, [""] * len(rows))
    time = rows.times("timestamp", optional=True)
    numbers = [rows.numbers(name, "a number", np.nan) for name in (*_MOTORS, *_ANGLES)]
    files, ids, heliostats, targets, empties = (
        rows.texts(name) for name in ("file", "id", "heliostat", "target", "empty")
    )
    places: dict[str, int] = {}
    entries: dict[str, Entry] = {}
    for i, key in enumerate(file or number for file, number in zip(files, ids, strict=True)):
        first = places.setdefault(key, i)
        if not key:
            rows.refuse(i, "file", "neither file nor id is filled in; enter one")
        elif first != i:
            rows.refuse(
                i, "file", f"{key} also appears in {rows.places[first]}; keep the correct row"
            )
        counts = np.array([numbers[0][i], numbers[1][i]])
        entries[key] = Entry(
            heliostat=heliostats[i],
            counts=counts if np.isfinite(counts).all() else None,
            target=targets[i],
            time=None if np.isnan(time[i]) else datetime.fromtimestamp(float(time[i]), UTC),
            sun=_sun(numbers[2][i], numbers[3][i]),
            empty=(rows.path.parent / empties[i]).resolve() if empties[i] else None,
        )
    for key, i in places.items():
        for other in {*_short(Path(key))} - {key}:
            if other in places:
                text = (
                    f"{key} and {other} of {rows.places[places[other]]} refer to the same "
                    "photograph"
                )
                rows.refuse(i, "file", f"{text}; keep the correct row")
    rows.refuse_bad()
    return Log(entries)


def _sun(azimuth_deg: float, elevation_deg: float) -> FloatArray | None:
    """Return the direction for an azimuth as in PAINT, with 0 south and east positive."""
    if not (np.isfinite(azimuth_deg) and np.isfinite(elevation_deg)):
        return None
    return direction(np.pi - np.radians(azimuth_deg), np.radians(elevation_deg))


def beside(path: Path, heliostat: str = "") -> Entry | None:
    """Return the entry in PAINT's file beside a photograph; None if there is no such file.

    Parameters
    ----------
    path
        Photograph, such as ``ID/Calibration/137608-raw.png``; PAINT's file beside it is
        ``137608-calibration-properties.json``.
    heliostat
        Name of the heliostat, used if the folder does not state it.

    Raises
    ------
    FormatError
        If the file exists and cannot be read.
    """
    file = path.with_name(f"{_number(path)}-calibration-properties.json")
    if not file.exists():
        return None
    properties: Any = read_calibration_properties(file)
    return Entry(
        heliostat=heliostat or heliostat_of(path),
        counts=np.array(properties.motors),
        target=properties.target,
        sun=_sun(properties.sun_azimuth_deg, properties.sun_elevation_deg),
    )
