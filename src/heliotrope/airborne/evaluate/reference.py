"""Compare orientations with a reference, as in HelioPoint's tables 3 to 5.

A reference is the normal of a heliostat in the same pose, measured by another method
(deflectometry, QDec-H). The same reflections are evaluated with the ideal surface and, if a slope
map exists, with the measured surface; unknown slopes bias the first result.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.airborne.evaluate.flight import FlightResult
from heliotrope.airborne.evaluate.orientation import Orientation, Orientations, measure_field
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.errors import FormatError, InputError
from heliotrope.files.cells import read_rows
from heliotrope.files.limits import check_file
from heliotrope.geometry import FloatArray, as_float, azimuth_elevation, direction, wrap_signed

_COLUMNS = ("heliostat", "azimuth_deg", "elevation_deg")
#: Surfaces with which the reflections are evaluated.
SURFACES = ("ideal", "measured")


@dataclass(frozen=True)
class Reference:
    """Heliostat normals measured by another method.

    Attributes
    ----------
    normals
        Unit normals, ENU, keyed by flight ("" for every flight) and heliostat.
    """

    normals: dict[tuple[str, str], FloatArray]

    def of(self, flight: str, heliostat: str) -> FloatArray | None:
        """Return the normal of a heliostat in a flight, (3,); None if it is not known."""
        own = self.normals.get((flight, heliostat))
        return self.normals.get(("", heliostat)) if own is None else own


def read_reference(path: str | Path) -> Reference:
    """Return the reference from a CSV table.

    Parameters
    ----------
    path
        CSV file with the columns heliostat, azimuth_deg (clockwise from north) and elevation_deg of
        the normal, and the column flight if the campaign has several flights.

    Raises
    ------
    FormatError
        If the file cannot be read, a row cannot be used, or a heliostat is listed twice.
    """
    file = check_file(path, "a table of reference orientations (.csv)")
    rows = read_rows(file, "a table of reference orientations")
    rows.need(_COLUMNS)
    angles = [rows.numbers(name, "degrees") for name in _COLUMNS[1:]]
    rows.check("elevation_deg", np.abs(angles[1]) > 90.0, angles[1], "° is beyond ±90°")
    rows.refuse_bad()
    if not len(rows):
        raise FormatError(file, "no rows; write one row per heliostat")
    known: dict[tuple[str, str], FloatArray] = {}
    flights = rows.texts("flight") if "flight" in rows.columns else [""] * len(angles[0])
    normals = direction(*np.radians(angles))
    for flight, name, normal in zip(flights, rows.texts("heliostat"), normals, strict=True):
        if (flight, name) in known:
            raise FormatError(file, f"heliostat {name} is listed twice; write one row per pose")
        known[flight, name] = normal
    return Reference(known)


@dataclass(frozen=True)
class Compared:
    """One heliostat in one pose beside its reference.

    Attributes
    ----------
    label
        Name of the heliostat, preceded by the name of the flight if there are several.
    reference
        Unit normal, ENU, (3,).
    shape
        Surface of the heliostat, with the slope map if there is one.
    ideal, measured
        Orientations with the ideal and with the measured surface; None if there is no slope map or
        the evaluation failed.
    """

    label: str
    reference: FloatArray
    shape: MirrorShape
    ideal: Orientation | None
    measured: Orientation | None

    def offset(self, surface: str) -> FloatArray:
        """Return rotX and rotY from the reference to the result, rad, (2,); NaN if no result."""
        orientation: Orientation | None = getattr(self, surface)
        if orientation is None:
            return np.full(2, np.nan)
        return offset_from(self.reference, orientation)


def offset_from(reference: FloatArray, orientation: Orientation) -> FloatArray:
    """Return rotX and rotY that rotate the reference normal into the measured one, rad, (2,)."""
    axis = np.cross(reference, orientation.normal)
    sine = float(np.linalg.norm(axis))
    angle = np.arctan2(sine, float(reference @ orientation.normal))
    turn = axis * (angle / sine if sine > 0.0 else 1.0)
    return np.asarray(turn @ orientation.rotation[:, :2])


def compare(flights: Sequence[FlightResult], reference: Reference) -> tuple[Compared, ...]:
    """Return the heliostats that have a reference, in the order of the flights.

    Raises
    ------
    InputError
        If no heliostat has a reference.
    """
    compared = []
    for flight in flights:
        ideal, measured = (_evaluated(flight, slopes=slopes) for slopes in (False, True))
        for row, name in enumerate(flight.measured.found.names):
            normal = reference.of(flight.data.name, name)
            results = [orientations.of(name) for orientations in (ideal, measured)]
            if normal is None or results == [None, None]:
                continue
            shape = flight.measured.shape(row)
            measured_one = None if shape.slope is None else results[1]
            compared.append(Compared(flight.label(name), normal, shape, results[0], measured_one))
    if not compared:
        raise InputError(
            "reference: none of its heliostats was measured; use heliostat names from the plant "
            "and flight names from the campaign's folders"
        )
    return tuple(compared)


def _evaluated(flight: FlightResult, *, slopes: bool) -> Orientations:
    if slopes:
        return flight.measured.found
    return measure_field(
        flight.evaluation.reflections,
        flight.data.stand.names,
        flight.data.shape,
        flight.data.stand.rotation,
        flight.evaluation.stand.vertex,
        slopes=False,
        budget=flight.measured.budget,
        places=flight.measured.places,
        mean=next((o.mean for o in flight.measured.found.found), "area"),
    )


@dataclass(frozen=True)
class Offsets:
    """Offsets of M heliostats from the reference, evaluated with one kind of surface.

    Attributes
    ----------
    mean, spread
        Mean of rotX and rotY, and their standard deviation about the mean, rad, (2,).
    rms
        RMS of rotX and rotY about 0, rad, (2,).
    count
        M.
    within
        Fraction of components within 1.645 σ_tot, which is 0.9 if σ_tot is right.
    """

    mean: FloatArray
    spread: FloatArray
    rms: FloatArray
    count: int
    within: float


def offsets(compared: Sequence[Compared], surface: str) -> Offsets | None:
    """Return the offsets with the "ideal" or the "measured" surface; None if there are none."""
    kept = [c for c in compared if getattr(c, surface) is not None]
    if not kept:
        return None
    values = np.array([c.offset(surface) for c in kept])
    sigma = np.array([getattr(c, surface).sigma_total for c in kept])
    return Offsets(
        values.mean(axis=0),
        values.std(axis=0, ddof=1) if len(kept) > 1 else np.full(2, np.nan),
        as_float(np.sqrt(np.mean(values**2, axis=0))),
        len(kept),
        float(np.mean(np.abs(values) < 1.645 * sigma)),
    )


def reference_rows(compared: Sequence[Compared]) -> list[dict[str, Any]]:
    """Return one record per heliostat: offsets (table 3), azimuth and elevation (tables 4, 5)."""
    rows = []
    for pair in compared:
        row: dict[str, Any] = {"heliostat": pair.label}
        angles = azimuth_elevation(pair.reference)
        for word, value in zip(("azimuth", "elevation"), angles, strict=True):
            row[f"{word}_reference_deg"] = float(np.degrees(value))
        for surface in SURFACES:
            orientation: Orientation | None = getattr(pair, surface)
            offset = pair.offset(surface)
            normal = np.full(3, np.nan) if orientation is None else orientation.normal
            for axis, turn in zip("xy", offset, strict=True):
                row[f"rot_{axis}_{surface}_mrad"] = 1e3 * float(turn)
            for word, angle, at in zip(
                ("azimuth", "elevation"), azimuth_elevation(normal), angles, strict=True
            ):
                row[f"{word}_{surface}_deg"] = float(np.degrees(angle))
                # As in the paper, this is the difference of the angles, not of the directions.
                row[f"{word}_{surface}_off_mrad"] = 1e3 * float(wrap_signed(angle - at))
        rows.append(row)
    return rows


def reference_document(compared: Sequence[Compared]) -> dict[str, Any]:
    """Return the comparison as a JSON object; empty if there was no comparison."""
    if not compared:
        return {}
    document: dict[str, Any] = {"reference": reference_rows(compared), "reference_offsets": {}}
    for surface in SURFACES:
        summary = offsets(compared, surface)
        if summary is not None:
            document["reference_offsets"][surface] = {
                "mean_mrad": (1e3 * summary.mean).tolist(),
                "spread_mrad": (1e3 * summary.spread).tolist(),
                "rms_mrad": (1e3 * summary.rms).tolist(),
                "heliostats": summary.count,
                "within_90": summary.within,
            }
    return document
