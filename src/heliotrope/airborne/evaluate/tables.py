"""The tables of a flight's report: one record a heliostat, a facet, a reflection, a flight."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.orientation import Orientation, Orientations
from heliotrope.geometry import FloatArray, as_float

_AXES = ("x", "y")


def orientation_rows(
    found: Orientations,
    budget: Budget | None = None,
    flight: str = "",
    places: npt.ArrayLike | None = None,
) -> list[dict[str, Any]]:
    """Return one record a heliostat, for tables and JSON; angles in mrad and degrees.

    Parameters
    ----------
    found
        Of one flight.
    budget
        If given, the systematic part is also told by its causes.
    flight
        Its name, for a column of that name; none if "".
    places
        As :func:`heliotrope.airborne.evaluate.orientation.measure_field` had them, (N, 3, 3).
    """
    known = None if places is None else as_float(places)
    return [
        {**_of(flight), **_row(found.names[o.heliostat], o, budget, known)} for o in found.found
    ]


def facet_rows(found: Orientations, flight: str = "") -> list[dict[str, Any]]:
    """Return one record a facet: its mean difference, which is its canting error, mrad."""
    return [
        {
            **_of(flight),
            "heliostat": found.names[o.heliostat],
            "facet": f.facet,
            "points": f.count,
            **_pair("rot", f.mean),
            **_pair("sigma", f.sigma),
        }
        for o in found.found
        for f in o.facets
    ]


def difference_rows(found: Orientations, flight: str = "") -> list[dict[str, Any]]:
    """Return one record a reflection: where it stands on the mirror, and its difference."""
    return [
        {
            **_of(flight),
            "heliostat": found.names[o.heliostat],
            "photo": int(o.reflections.photo[i]),
            "facet": int(o.reflections.facet[i]),
            "x_m": float(o.reflections.x[i]),
            "y_m": float(o.reflections.y[i]),
            **_pair("rot", o.difference[i]),
            "outlier": bool(o.outlier[i]),
        }
        for o in found.found
        for i in range(len(o.reflections))
    ]


def flight_row(found: Orientations, flight: str = "") -> dict[str, Any]:
    """Return the record of a flight: counts, and means over its heliostats, mrad.

    ``rot_mean`` is the mean deviation, which all share; ``rot_rms`` the size of all; the
    standard deviations are root mean squares.
    """
    every = found.found
    row: dict[str, Any] = {
        **_of(flight),
        "heliostats": len(every),
        "not_measured": len(found.left_out),
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
    """Return what each cause of a budget turns an orientation by, rotX and rotY, rad, (2,).

    Parameters
    ----------
    o
        Measured with this budget: the squares sum to the square of its systematic part.
    budget
        Its lengths are the causes.
    place
        Covariance of the mirror's place as seen from the drone, m², (3, 3), if a bundle
        adjustment found it: it is one cause, "place", instead of position, kinematics and RTK.
    """
    kept = o.reflections.take(~o.outlier)
    # A turn about x moves the normal towards −y, one about y towards x.
    axes = np.stack([-o.rotation[:, 1], o.rotation[:, 0]])
    nothing = {f.name: 0.0 for f in fields(Budget)}
    seen, used = (o.point[~o.outlier], kept.camera, kept.led, axes), list(nothing)
    parts = {}
    if place is not None:
        used = ["lamp"]
        parts["place"] = _spread(Budget(**nothing).covariance(*seen, place))
    for name in used:
        alone = Budget(**{**nothing, name: getattr(budget, name)})
        parts[name] = _spread(alone.covariance(*seen))
    return parts


def _spread(covariance: FloatArray) -> FloatArray:
    return as_float(np.sqrt(np.diag(covariance)))


def _of(flight: str) -> dict[str, Any]:
    return {"flight": flight} if flight else {}


def _pair(name: str, values: FloatArray) -> dict[str, float]:
    return {f"{name}_{a}_mrad": 1e3 * float(v) for a, v in zip(_AXES, values, strict=True)}


def _over(values: Sequence[FloatArray], mean: bool = False) -> FloatArray:
    """Return mean or root mean square of pairs that are finite, (2,); NaN without any."""
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
