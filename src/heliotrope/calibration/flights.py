"""Drone flights as a plant imports them: sightings together with their shared errors.

`drone evaluate` writes the file ``flight.json``, and a plant reads it. Each record is the
orientation of one mirror in one pose; see ``docs/reference/formats.md``. A record contains what
belongs to one measurement, and the file header describes the errors that all records share. For
example, an error in the RTK base position displaces the drone equally in all records, and an error
in the focal length displaces each mirror away from the middle of the flight.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from heliotrope.calibration.sightings import Sightings, drone, is_covariance
from heliotrope.errors import FormatError, InputError
from heliotrope.files.text import read_text, write_text
from heliotrope.geometry import FloatArray

#: Maximum number of records in a flight, and of errors that they share.
MOST_ROWS, MOST_SHARED = 20_000, 24
#: Largest file, bytes.
LARGEST = 8 << 20
#: Largest coordinate, m; largest standard deviation, rad; largest variance, m².
_FAR, _WIDE, _VARIANCE = 1e5, 0.1, 1e4

_Number = Annotated[float, Field(allow_inf_nan=False)]
_Coordinate = Annotated[float, Field(ge=-_FAR, le=_FAR, allow_inf_nan=False)]
_Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]+$")]
_Shares = Annotated[list[_Coordinate], Field(max_length=MOST_SHARED)]
_Variances = Annotated[
    list[Annotated[float, Field(ge=-_VARIANCE, le=_VARIANCE, allow_inf_nan=False)]],
    Field(max_length=MOST_SHARED),
]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class FlightRow(_Strict):
    """One orientation: the drone's measurement of one mirror in one pose.

    Attributes
    ----------
    heliostat, time
        Name of the heliostat, and POSIX time, s.
    counts
        Counts of its drives.
    place_m
        Point on the mirror's normal at the distance of the drone, ENU, as if the lamp and the
        camera were in one place.
    sigma_rad
        Standard deviation of the normal about each axis, excluding the errors below.
    turn_rad
        Standard deviation of the rotation common to all poses of this mirror, due to unknown slopes
        and the survey of its position.
    covariance_m2
        Covariance of the mirror's position relative to the drone, ENU, excluding the shared errors.
    shift
        Displacement of the drone relative to the mirror per unit of each shared error, recorded
        minus true, ENU, m: three lists, east, north and up.
    """

    heliostat: _Name
    time: Annotated[float, Field(ge=0.0, le=1e11, allow_inf_nan=False)]
    counts: Annotated[list[_Number], Field(min_length=1, max_length=4)]
    place_m: Annotated[list[_Coordinate], Field(min_length=3, max_length=3)]
    sigma_rad: Annotated[float, Field(gt=0.0, le=_WIDE)]
    turn_rad: Annotated[float, Field(ge=0.0, le=_WIDE)]
    covariance_m2: Annotated[list[_Variances], Field(min_length=3, max_length=3)]
    shift: Annotated[list[_Shares], Field(min_length=3, max_length=3)]


class FlightDocument(_Strict):
    """A flight as stored in its file.

    Attributes
    ----------
    format, version
        Format and version of the file.
    name
        Name of the flight, unique in a plant.
    shared
        Names of the K errors shared by all records.
    covariance
        Their covariance, (K, K).
    rows
        The orientations.
    """

    format: Literal["heliotrope-flight"]
    version: Literal[1]
    name: _Name
    shared: Annotated[list[_Name], Field(max_length=MOST_SHARED)]
    covariance: Annotated[list[_Variances], Field(max_length=MOST_SHARED)]
    rows: Annotated[list[FlightRow], Field(min_length=1, max_length=MOST_ROWS, fail_fast=True)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        """Check shapes and covariances.

        Raises
        ------
        ValueError
            If shapes do not match, or a matrix is not a covariance.
        """
        count = len(self.shared)
        if len(self.covariance) != count or any(len(r) != count for r in self.covariance):
            raise ValueError(
                f"covariance: write {count} by {count} values, a row and a column for each of "
                "shared"
            )
        if count and not _positive(np.array(self.covariance)):
            raise ValueError("covariance: it is not symmetric and positive definite")
        for k, row in enumerate(self.rows):
            if any(len(line) != count for line in row.shift):
                raise ValueError(f"rows.{k}.shift: write 3 lists of {count} values")
            if any(len(line) != 3 for line in row.covariance_m2):
                raise ValueError(f"rows.{k}.covariance_m2: write 3 lists of 3 values")
        good = is_covariance(np.array([row.covariance_m2 for row in self.rows]))
        if not good.all():
            k = int(np.flatnonzero(~good)[0])
            raise ValueError(f"rows.{k}.covariance_m2: it is not a covariance")
        if len({len(row.counts) for row in self.rows}) > 1:
            raise ValueError("rows: all rows must have counts for the same number of drives")
        return self


def _positive(matrix: FloatArray) -> bool:
    scale = np.sqrt(np.maximum(np.diagonal(matrix), 0.0))
    if not (scale > 0.0).all() or np.abs(matrix - matrix.T).max() > 1e-9 * scale.max() ** 2:
        return False
    return bool(np.linalg.eigvalsh(matrix / np.outer(scale, scale))[0] > 1e-9)


@dataclass(frozen=True)
class Flight:
    """M orientations of N heliostats measured from the air, with their K shared errors.

    Attributes
    ----------
    name
        Name, unique in a plant.
    heliostats
        Names of the N heliostats.
    sightings
        M sightings, with indices into ``heliostats``; their covariances exclude the shared errors.
    turn_sigma
        Standard deviation of the rotation common to all poses of a mirror, rad, (N,).
    shared, covariance
        Names of the shared errors, and their covariance, (K, K).
    shift
        Displacement of the drone relative to each sighting's mirror per unit of each shared error,
        recorded minus true, ENU, m, (M, 3, K).
    """

    name: str
    heliostats: tuple[str, ...]
    sightings: Sightings
    turn_sigma: FloatArray
    shared: tuple[str, ...]
    covariance: FloatArray
    shift: FloatArray

    @classmethod
    def of(cls, document: FlightDocument) -> "Flight":
        """Convert a document into a flight."""
        rows = document.rows
        names = tuple(dict.fromkeys(row.heliostat for row in rows))
        index = {name: i for i, name in enumerate(names)}
        places = np.array([row.place_m for row in rows])
        heliostat = np.array([index[row.heliostat] for row in rows])
        turn = np.zeros(len(names))
        np.maximum.at(turn, heliostat, np.array([row.turn_rad for row in rows]))
        made = drone(
            heliostat,
            np.array([row.counts for row in rows]),
            places,
            places,
            time=np.array([row.time for row in rows]),
            # The ray rotates by twice the error of the normal, and the lamp and camera move
            # together.
            sigma=2.0 * np.array([row.sigma_rad for row in rows]),
            camera_covariance=4.0 * np.array([row.covariance_m2 for row in rows]),
        )
        count = len(document.shared)
        return cls(
            document.name,
            names,
            made,
            turn,
            tuple(document.shared),
            np.array(document.covariance).reshape(count, count),
            np.array([row.shift for row in rows]).reshape(len(rows), 3, count),
        )

    def rows_by_heliostat(self) -> dict[str, npt.NDArray[np.intp]]:
        """Return the sighting indices of each heliostat."""
        order = np.argsort(self.sightings.heliostat, kind="stable")
        count = np.bincount(self.sightings.heliostat, minlength=len(self.heliostats))
        parts = np.split(order, np.cumsum(count)[:-1])
        return dict(zip(self.heliostats, parts, strict=True))


def parse_flight(data: bytes | str) -> FlightDocument:
    """Parse and check the text of a flight file.

    Raises
    ------
    InputError
        If the text cannot be used; the message names the location.
    """
    try:
        return FlightDocument.model_validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        raise InputError(f"flight: {f'{place}: ' if place else ''}{first['msg']}") from None


def read_flight(path: str | Path) -> FlightDocument:
    """Read the document from a flight file.

    Raises
    ------
    FormatError
        If the file cannot be read or used.
    """
    text = read_text(path, "the flight.json of `heliotrope drone evaluate`", LARGEST)
    try:
        return parse_flight(text)
    except InputError as error:
        raise FormatError(path, str(error).removeprefix("flight: ")) from None


def write_flight(path: str | Path, document: FlightDocument) -> None:
    """Write a flight file, with one record per line."""
    content = document.model_dump()
    rows = ",\n  ".join(_text(row) for row in content.pop("rows"))
    head = ",\n ".join(f"{json.dumps(key)}: {_text(value)}" for key, value in content.items())
    write_text(path, f'{{{head},\n "rows": [\n  {rows}]}}\n')


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


def flight_name(parts: Sequence[str], at: float) -> str:
    """Return a name for a flight, composed of the parts and the time ``at`` (POSIX s)."""
    day = np.datetime_as_string(np.datetime64(round(at), "s"))
    return f"{day}Z {' '.join(part for part in parts if part)}".strip()[:64]
