"""Camera-target measurements: positions of heliostat beams on a target.

The measurements are read from ``measurements.csv`` or from PAINT's calibration properties. A record
that cannot be used is left out and reported.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from heliotrope.errors import FormatError
from heliotrope.field.formats.paint import (
    find_tower,
    heliostat_of,
    read_calibration_properties,
    read_tower,
)
from heliotrope.files import read_rows
from heliotrope.geometry import FloatArray, direction, geodetic_to_enu
from heliotrope.sun.ephemeris import END_OF_TIMES

if TYPE_CHECKING:
    import pandas as pd

Centroid = Literal["utis", "helios"]

_COLUMNS = (
    "heliostat", "id", "timestamp", "target", "sun_azimuth_deg_south0_east",
    "sun_elevation_deg_apparent", "axis_1_motor_position", "axis_2_motor_position",
)  # fmt: skip


@dataclass(frozen=True)
class Measurements:
    """M measurements.

    Attributes
    ----------
    heliostat, ids, target
        Names, (M,).
    time
        POSIX seconds (UTC), (M,); NaN where only the sun's angles are known.
    counts
        Motor counts, (M, 2).
    sun
        Apparent sun, unit vectors in ENU, (M, 3).
    centroid
        Centroid of the beam on the target, ENU, m, relative to the plant's reference point, (M, 3).
    left_out
        One line for each record that could not be used.
    """

    heliostat: tuple[str, ...]
    ids: tuple[str, ...]
    target: tuple[str, ...]
    time: FloatArray
    counts: FloatArray
    sun: FloatArray
    centroid: FloatArray
    left_out: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.heliostat)


def read_measurements(folder: str | Path, centroid: Centroid = "utis") -> Measurements:
    """Return the measurements of a folder with the tower's file.

    Parameters
    ----------
    folder
        Folder with ``measurements.csv``, or ``ID/Calibration/*-calibration-properties.json``
        (ARTIST omits ``Calibration/``).
    centroid
        Name of the published extractor whose centroids are used.

    Raises
    ------
    FormatError
        If there are no measurements, or the table lacks a column.
    """
    place = Path(folder)
    origin = read_tower(find_tower(place)).origin
    table = place / "measurements.csv"
    left_out: list[str] = []
    if table.exists():
        frame, left_out = _read_table(table, centroid)
    else:
        frame = _read_files(place, centroid)
    columns = ("lat", "lon", "alt")
    spots = frame[[f"{centroid}_{c}" for c in columns]].to_numpy(dtype=np.float64)
    enu = np.full((len(frame), 3), np.nan)
    known = np.isfinite(spots).all(axis=1)
    enu[known] = geodetic_to_enu(spots[known, 0], spots[known, 1], spots[known, 2], origin)
    return _keep_good(frame, enu, centroid, left_out)


def _read_table(path: Path, centroid: Centroid) -> "tuple[pd.DataFrame, list[str]]":
    """Return the rows of a table, and a message for each row that is not as long as the header."""
    import pandas as pd

    needed = [*_COLUMNS, *(f"{centroid}_{c}" for c in ("lat", "lon", "alt"))]
    rows = read_rows(path, "a table of measurements", needed)
    rows.need(needed)
    kept = rows.take(rows.good)
    frame = pd.DataFrame({name: kept.columns[name] for name in needed})
    for column in needed:
        if column not in ("heliostat", "id", "timestamp", "target"):
            frame[column] = pd.to_numeric(frame[column], errors="coerce")
    return frame, rows.left_out


def _read_files(place: Path, centroid: Centroid) -> "pd.DataFrame":
    import pandas as pd

    name = "*-calibration-properties.json"
    files = sorted(place.glob(f"*/Calibration/{name}")) or sorted(place.glob(f"*/{name}"))
    if not files:
        raise FormatError(
            place,
            ("found neither measurements.csv nor ID/Calibration/*.json; fetch measurements first"),
        )
    rows = []
    for file in files:
        record = read_calibration_properties(file)
        key = {"utis": "UTIS", "helios": "HeliOS"}[centroid]
        spot = record.focal_spots.get(key, (np.nan, np.nan, np.nan))
        name = heliostat_of(file) or file.parent.name
        numbers = (record.sun_azimuth_deg, record.sun_elevation_deg, *record.motors)
        rows.append((name, file.name.split("-")[0], "", record.target, *numbers, *spot))
    spots = [f"{centroid}_{c}" for c in ("lat", "lon", "alt")]
    return pd.DataFrame(rows, columns=[*_COLUMNS, *spots])


def _seconds(texts: "pd.Series[str]") -> FloatArray:
    import pandas as pd

    # A time without a zone is refused; PAINT writes Z.
    zoned = texts.where(texts.str.contains(r"(?:Z|[+-]\d\d:?\d\d)$", regex=True), "")
    times = pd.to_datetime(zoned, utc=True, errors="coerce", format="ISO8601")
    # Times in nanoseconds end in the year 2262.
    seconds = (times - pd.Timestamp(0, tz="UTC").as_unit("us")) / pd.Timedelta(seconds=1)
    return np.asarray(seconds, dtype=np.float64)


def _keep_good(
    frame: "pd.DataFrame", enu: FloatArray, centroid: Centroid, left_out: list[str]
) -> Measurements:
    azimuth = frame["sun_azimuth_deg_south0_east"].to_numpy(dtype=np.float64)
    elevation = frame["sun_elevation_deg_apparent"].to_numpy(dtype=np.float64)
    counts = frame[["axis_1_motor_position", "axis_2_motor_position"]].to_numpy(dtype=np.float64)
    time = _seconds(frame["timestamp"].astype(str))
    reasons: list[tuple[Any, str]] = [
        (frame["heliostat"].astype(str).to_numpy() == "", "no heliostat is named"),
        (~np.isfinite(counts).all(axis=1), "a motor position is missing or not a number"),
        (~np.isfinite(azimuth) | ~np.isfinite(elevation), "the sun's angles are missing"),
        (~((elevation > -5.0) & (elevation <= 90.0)), "the sun's elevation is not above −5°"),
        (time >= END_OF_TIMES, "the year is out of range; correct the time"),
        (~np.isfinite(enu).all(axis=1), f"there is no {centroid.upper()} centroid"),
        (np.linalg.norm(enu, axis=1) > 5e3, "the centroid lies more than 5 km from the plant"),
    ]
    good = np.ones(len(frame), dtype=np.bool_)
    left_out = list(left_out)
    for invalid, reason in reasons:
        left_out += [
            f"{frame['heliostat'][i]} {frame['id'][i]}: {reason}"
            for i in np.flatnonzero(invalid & good)
        ]
        good &= ~invalid
    rows = np.flatnonzero(good)
    # 0 is south and east is positive, so the clockwise angle from north is 180° minus the azimuth.
    suns = direction(np.pi - np.radians(azimuth[rows]), np.radians(elevation[rows]))

    def texts(column: str) -> tuple[str, ...]:
        return tuple(str(frame[column][i]) for i in rows)

    return Measurements(
        heliostat=texts("heliostat"),
        ids=texts("id"),
        target=texts("target"),
        time=time[rows],
        counts=counts[rows],
        sun=suns,
        centroid=enu[rows],
        left_out=tuple(left_out),
    )
