"""Tables of a flight: one record per heliostat, facet, reflection and flight."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.orientation import Orientation, Orientations
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.errors import InputError
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, as_float

_AXES = ("x", "y")


@dataclass(frozen=True)
class MeasuredFlight:
    """Orientations from one flight (one pose of the mirrors), and the data used to measure them.

    Attributes
    ----------
    name
        Name of the flight; empty if it is the only flight.
    found
        Orientations of the N heliostats.
    shape
        Function that returns the mirror, given its index.
    position
        Positions of the heliostats, ENU metres, (N, 3).
    budget
        Error budget by which the systematic part is split by cause; None for no split.
    places
        Covariances of the mirrors' positions relative to the drone, m², (N, 3, 3), or None.
    """

    name: str
    found: Orientations
    shape: Callable[[int], MirrorShape]
    position: FloatArray
    budget: Budget | None = None
    places: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.position.shape != (len(self.found.names), 3):
            raise InputError(
                f"flight report: positions of shape {self.position.shape} for "
                f"{len(self.found.names)} heliostats"
            )

    def rows(self, flight: str = "") -> list[dict[str, Any]]:
        """Return one record per heliostat, with the name of the flight if it has one."""
        return orientation_rows(self.found, self.budget, flight, self.places)

    def label(self, o: Orientation) -> str:
        """Return the heliostat name of an orientation, with the flight's name if it has one."""
        name = self.found.names[o.heliostat]
        return f"{self.name}/{name}" if self.name else name


def orientation_rows(
    orientations: Orientations,
    budget: Budget | None = None,
    flight: str = "",
    places: npt.ArrayLike | None = None,
) -> list[dict[str, Any]]:
    """Return one record per heliostat for tables and JSON, with angles in mrad and degrees.

    Parameters
    ----------
    orientations
        Orientations of one flight.
    budget
        Error budget by which the systematic part is also split by cause; None for no split.
    flight
        Name of the flight, for the column ``flight``; if empty, there is no such column.
    places
        See `heliotrope.airborne.evaluate.orientation.measure_field`, (N, 3, 3).
    """
    known = None if places is None else as_float(places)
    return [
        {**_of(flight), **_row(orientations.names[o.heliostat], o, budget, known)}
        for o in orientations.found
    ]


def facet_rows(orientations: Orientations, flight: str = "") -> list[dict[str, Any]]:
    """Return one record per facet; its mean difference is its canting error, mrad."""
    return [
        {
            **_of(flight),
            "heliostat": orientations.names[o.heliostat],
            "facet": f.facet,
            "points": f.count,
            **_pair("rot", f.mean),
            **_pair("sigma", f.sigma),
        }
        for o in orientations.found
        for f in o.facets
    ]


def difference_rows(orientations: Orientations, flight: str = "") -> list[dict[str, Any]]:
    """Return one record for each reflection: its position on the mirror, and its difference."""
    return [
        {
            **_of(flight),
            "heliostat": orientations.names[o.heliostat],
            "photo": int(o.reflections.photo[i]),
            "facet": int(o.reflections.facet[i]),
            "x_m": float(o.reflections.x[i]),
            "y_m": float(o.reflections.y[i]),
            **_pair("rot", o.difference[i]),
            "outlier": bool(o.outlier[i]),
        }
        for o in orientations.found
        for i in range(len(o.reflections))
    ]


def flight_row(orientations: Orientations, flight: str = "") -> dict[str, Any]:
    """Return the record of a flight: counts, and means over its heliostats, mrad.

    ``rot_mean`` is the mean deviation, which is common to all heliostats, and ``rot_rms`` is the
    RMS deviation. The standard deviations are also averaged as root mean squares.
    """
    every = orientations.found
    row: dict[str, Any] = {
        **_of(flight),
        "heliostats": len(every),
        "not_measured": len(orientations.left_out),
        "photographs_with_reflections": len({int(k) for o in every for k in o.reflections.photo}),
        "points": sum(o.count for o in every),
        "outliers": sum(int(o.outlier.sum()) for o in every),
        "distance_m": float(np.mean([o.distance for o in every])) if every else np.nan,
    }
    row |= _pair("rot_mean", _over([o.correction for o in every], mean=True))
    for name, what in (
        ("rot_rms", "correction"),
        ("sigma", "sigma"),
        ("sigma_plain", "sigma_plain"),
        ("sigma_mean", "sigma_mean"),
        ("systematic", "systematic"),
        ("sigma_tot", "sigma_total"),
    ):
        row |= _pair(name, _over([getattr(o, what) for o in every]))
    return row


def systematic_parts(
    o: Orientation, budget: Budget, place: npt.ArrayLike | None = None
) -> dict[str, FloatArray]:
    """Return the contribution of each cause to an orientation's systematic error, rad, (2,).

    Parameters
    ----------
    o
        Orientation measured with this budget. The squares of the contributions add up to the square
        of its systematic part.
    budget
        Error budget, whose entries are the causes.
    place
        Covariance of the mirror's position relative to the drone, m², (3, 3), if a bundle
        adjustment estimated it. The single cause "place" then replaces position, kinematics and
        RTK.
    """
    kept = o.reflections.take(~o.outlier)
    # A rotation about x moves the normal towards −y, and a rotation about y towards x.
    axes = np.stack([-o.rotation[:, 1], o.rotation[:, 0]])
    nothing = {f.name: 0.0 for f in fields(Budget)}
    geometry, used = (o.point[~o.outlier], kept.camera, kept.led, axes), list(nothing)
    parts = {}
    if place is not None:
        used = ["lamp"]
        parts["place"] = _spread(Budget(**nothing).covariance(*geometry, place))
    for name in used:
        alone = Budget(**{**nothing, name: getattr(budget, name)})
        parts[name] = _spread(alone.covariance(*geometry))
    return parts


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write records as ``.csv`` or ``.parquet``, as the suffix says, completely or not at all."""
    import pandas as pd

    table = pd.DataFrame(rows)
    if path.suffix.casefold() == ".csv":
        write_text(path, table.to_csv(index=False))
    else:
        write_file(path, lambda stream: table.to_parquet(stream, index=False))


def _spread(covariance: FloatArray) -> FloatArray:
    return as_float(np.sqrt(np.diag(covariance)))


def _of(flight: str) -> dict[str, Any]:
    return {"flight": flight} if flight else {}


def _pair(name: str, values: FloatArray) -> dict[str, float]:
    return {f"{name}_{a}_mrad": 1e3 * float(v) for a, v in zip(_AXES, values, strict=True)}


def _over(values: Sequence[FloatArray], mean: bool = False) -> FloatArray:
    """Return the mean or root mean square of the finite pairs, (2,); NaN if there are none."""
    table = as_float(values).reshape(-1, 2)
    table = table[np.isfinite(table).all(axis=-1)]
    if not len(table):
        return np.full(2, np.nan)
    return as_float(table.mean(axis=0) if mean else np.sqrt(np.mean(table**2, axis=0)))


def _row(
    name: str, o: Orientation, budget: Budget | None, places: FloatArray | None
) -> dict[str, Any]:
    row: dict[str, Any] = {
        "heliostat": name,
        "points": o.count,
        "outliers": int(o.outlier.sum()),
        "distance_m": o.distance,
        "azimuth_deg": float(np.degrees(o.azimuth)),
        "elevation_deg": float(np.degrees(o.elevation)),
    }
    for what, values in (
        ("rot", o.correction),
        ("sigma", o.sigma),
        ("sigma_plain", o.sigma_plain),
        ("sigma_mean", o.sigma_mean),
        ("systematic", o.systematic),
        ("sigma_tot", o.sigma_total),
    ):
        row |= _pair(what, values)
    if budget is not None:
        place = None if places is None else places[o.heliostat]
        for cause, part in systematic_parts(o, budget, place).items():
            row |= _pair(f"systematic_{cause}", part)
    for a, value in zip(_AXES, o.normality, strict=True):
        row[f"shapiro_wilk_p_{a}"] = float(value)
    return {**row, "mean": o.mean, "warnings": "; ".join(o.warnings)}
