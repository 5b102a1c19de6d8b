"""Sightings: light seen to go from a source by way of a mirror to a destination.

Every measurement of where a mirror points is one record: heliostat, time, drive
counts, source and destination (each a direction at infinity or a point), and how well
the ray between them is known. A photograph of the beam on a target, a reflection seen
by a drone, a sun sensor and a camera in the field differ in nothing else.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.formats.measurements import Measurements
from heliotrope.field.heliostats import Heliostats
from heliotrope.geometry import FloatArray, as_float, normalize


@dataclass(frozen=True)
class Sightings:
    """M sightings of N heliostats.

    Attributes
    ----------
    heliostat
        Row of the heliostat, 0 … N − 1, (M,).
    time
        Unix seconds (UTC), (M,).
    counts
        Drive counts, (M, D).
    source, destination
        Unit vector from the mirror if at infinity, else a point in ENU metres, (M, 3).
    source_at_infinity, destination_at_infinity
        (M,).
    sigma
        Standard deviation of the ray's direction (source and destination together) in
        each of two directions across it, rad of beam, (M,).
    """

    heliostat: npt.NDArray[np.intp]
    time: FloatArray
    counts: FloatArray
    source: FloatArray
    destination: FloatArray
    source_at_infinity: npt.NDArray[np.bool_]
    destination_at_infinity: npt.NDArray[np.bool_]
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.heliostat)

    def take(self, rows: npt.ArrayLike) -> "Sightings":
        """Return the sightings at ``rows`` (indices or a mask), in that order."""
        index = np.asarray(rows)
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def of(self, heliostat: int) -> "Sightings":
        """Return the sightings of one heliostat, renumbered to 0."""
        part = self.take(np.flatnonzero(self.heliostat == heliostat))
        return replace(part, heliostat=np.zeros(len(part), dtype=np.intp))


def sightings(
    heliostat: npt.ArrayLike,
    counts: npt.ArrayLike,
    source: npt.ArrayLike,
    destination: npt.ArrayLike,
    *,
    time: npt.ArrayLike = 0.0,
    source_at_infinity: npt.ArrayLike = True,
    destination_at_infinity: npt.ArrayLike = False,
    sigma: npt.ArrayLike = 5e-4,
) -> Sightings:
    """Return checked sightings; everything broadcasts to the M rows of ``counts``.

    Parameters
    ----------
    heliostat
        Row of the heliostat of each sighting, (M,).
    counts
        Drive counts, (M, D).
    source, destination
        Directions (any length) or points (m), ENU, (M, 3).
    time
        Unix seconds, (M,).
    source_at_infinity, destination_at_infinity
        The sun is at infinity, the centroid on a target is not.
    sigma
        Standard deviation of the ray's direction, rad of beam, (M,).

    Raises
    ------
    InputError
        If a value is not finite, a direction is zero, or sigma is not above 0; the text
        names the row.
    """
    table = np.atleast_2d(as_float(counts))
    rows = len(table)

    def spread(values: npt.ArrayLike, dtype: npt.DTypeLike) -> np.ndarray:
        return np.array(np.broadcast_to(np.asarray(values, dtype=dtype), (rows,)))

    far_source = spread(source_at_infinity, np.bool_)
    far_destination = spread(destination_at_infinity, np.bool_)
    ends = []
    for name, given, far in (
        ("source", source, far_source),
        ("destination", destination, far_destination),
    ):
        points = np.array(np.broadcast_to(as_float(given), (rows, 3)))
        _finite(points, name)
        if far.any():
            points[far] = normalize(points[far], name)
        ends.append(points)
    _finite(table, "counts")
    spreads = spread(sigma, np.float64)
    wrong = ~(np.isfinite(spreads) & (spreads > 0))
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise InputError(f"sighting {i}: sigma {spreads[i]} rad must be above 0")
    index = spread(heliostat, np.intp)
    if (index < 0).any():
        raise InputError("sightings: a heliostat's row is below 0")
    return Sightings(
        index, spread(time, np.float64), table, ends[0], ends[1], far_source, far_destination,
        spreads,
    )  # fmt: skip


def _finite(values: FloatArray, name: str) -> None:
    wrong = ~np.isfinite(values).all(axis=-1)
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise InputError(f"sighting {i}: {name} {values[i]} is not finite; leave the row out")


def ray_directions(s: Sightings, vertex: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors to source and destination, (..., 3), as seen from vertices (M, 3)."""
    m = as_float(vertex)
    ends = []
    for points, far in (
        (s.source, s.source_at_infinity),
        (s.destination, s.destination_at_infinity),
    ):
        way = np.where(far[:, None], points, points - m)
        ends.append(way / np.linalg.norm(way, axis=-1, keepdims=True))
    return ends[0], ends[1]


def of_measurements(
    measurements: Measurements, heliostats: Heliostats, sigma: float = 5e-4
) -> tuple[Sightings, list[str]]:
    """Return sightings of camera-target measurements, and what was left out and why.

    Parameters
    ----------
    measurements
        As read from files.
    heliostats
        Those that the names refer to.
    sigma
        Standard deviation of a centroid as seen from the mirror, rad of beam.
    """
    known = {name: i for i, name in enumerate(heliostats.names)}
    rows = np.array([known.get(name, -1) for name in measurements.heliostat], dtype=np.intp)
    kept = rows >= 0
    strangers = sorted({n for n, ok in zip(measurements.heliostat, kept, strict=True) if not ok})
    left_out = [f"measurements of {name}: the plant has no such heliostat" for name in strangers]
    seen = sightings(
        rows[kept],
        measurements.counts[kept],
        measurements.sun[kept],
        measurements.centroid[kept],
        time=measurements.time[kept],
        sigma=sigma,
    )
    return seen, left_out
