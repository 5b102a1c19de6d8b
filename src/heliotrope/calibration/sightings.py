"""Sightings: light observed on its way from a source via a mirror to a destination.

Every measurement of where a mirror points is one record: heliostat, time, drive counts, source and
destination (each a direction at infinity or a point), and the uncertainty of the ray between them.
A photograph of the beam on a target, a reflection seen by a drone, a sun sensor and a camera in the
field all produce this record.
"""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError, kind_of
from heliotrope.field.formats.measurements import Measurements
from heliotrope.field.heliostats import Heliostats
from heliotrope.frames import ENU, Framed, Labelled, Variable, times
from heliotrope.geometry import FloatArray, as_float, as_numbers, azimuth_elevation, normalize
from heliotrope.sun import Times, unix_seconds
from heliotrope.values import Card, Value, amount, dots, span

#: Smallest and largest standard deviation of a ray, rad. No camera resolves less than the smallest,
#: and values mistakenly in milliradians or degrees are mostly larger than the largest.
SMALLEST_SIGMA, LARGEST_SIGMA = 1e-6, 0.2
#: Largest deviation from 1 of the length of a normalised vector, due to a few roundings.
_UNIT = 2e-15


@dataclass(frozen=True, eq=False, repr=False)
class Sightings(Value, Framed):
    """M sightings of N heliostats.

    Attributes
    ----------
    heliostat
        Index of the heliostat, 0 to N − 1, (M,).
    time
        Unix seconds (UTC), (M,).
    counts
        Drive counts, (M, D).
    source, destination
        Unit vector from the mirror if at infinity, otherwise a point in ENU metres, (M, 3).
    source_at_infinity, destination_at_infinity
        (M,).
    sigma
        Standard deviation of the ray's direction (source and destination together) in
        each of two directions across it, rad of beam, (M,).
    source_covariance, destination_covariance
        Additional covariance of each end, ENU, (M, 3, 3), in m² for a point and rad² for a
        direction. For a direction only the part across the direction counts.
    names
        Names of the heliostats by index, (N,); () if the indices refer to mechanisms passed
        alongside.
    """

    heliostat: npt.NDArray[np.intp]
    time: FloatArray
    counts: FloatArray
    source: FloatArray
    destination: FloatArray
    source_at_infinity: npt.NDArray[np.bool_]
    destination_at_infinity: npt.NDArray[np.bool_]
    sigma: FloatArray
    source_covariance: FloatArray
    destination_covariance: FloatArray
    names: tuple[str, ...] = ()

    def _card(self) -> Card:
        some = amount(len(np.unique(self.heliostat)), "heliostat")
        known = self.time[np.isfinite(self.time)]
        days = [f"{np.datetime64(int(t), 's').astype('datetime64[D]')}" for t in _ends(known)]
        when = " to ".join(dict.fromkeys(days)) or "times unknown"
        far = self.source[self.source_at_infinity]
        azimuth, elevation = azimuth_elevation(far)
        rows = [
            ("sun's azimuth", span(azimuth, np.degrees(1.0), "°")),
            ("sun's elevation", span(elevation, np.degrees(1.0), "°")),
            ("sigma of the beam", span(self.sigma, 1e3, "mrad")),
            ("sources at infinity", f"{len(far)} of {len(self)}"),
            ("destinations at infinity", f"{self.destination_at_infinity.sum()} of {len(self)}"),
            *(
                (f"counts of drive {d + 1}", span(self.counts[:, d]))
                for d in range(self.counts.shape[-1])
            ),
        ]
        # The sky is drawn with the zenith in the middle, north at the top and west to the left.
        sky = 0.5 * np.pi - elevation
        picture = dots(sky * np.sin(azimuth), sky * np.cos(azimuth), "suns from the zenith")
        return Card(f"{len(self)} of {some}, {when}", ("what", "range"), rows, picture)

    def _labelled(self) -> Labelled:
        row = ("sighting",)
        named = [self.names[i] for i in self.heliostat] if self.names else self.heliostat
        return Labelled(
            row,
            {
                "sighting": np.arange(len(self)),
                "drive": np.arange(1, self.counts.shape[-1] + 1),
                "axis": ENU,
                "axis_2": ENU,
            },
            {
                "heliostat": Variable(row, np.asarray(named)),
                "time": Variable(row, times(self.time)),
                "count": Variable((*row, "drive"), self.counts),
                "source": Variable((*row, "axis"), self.source),
                "source_at_infinity": Variable(row, self.source_at_infinity),
                "destination": Variable((*row, "axis"), self.destination),
                "destination_at_infinity": Variable(row, self.destination_at_infinity),
                "sigma": Variable(row, self.sigma, "rad"),
                "source_covariance": Variable((*row, "axis", "axis_2"), self.source_covariance),
                "destination_covariance": Variable(
                    (*row, "axis", "axis_2"), self.destination_covariance
                ),
            },
            frozenset({"source_covariance", "destination_covariance"}),
        )

    def __len__(self) -> int:
        return len(self.heliostat)

    def take(self, rows: npt.ArrayLike) -> "Sightings":
        """Return the sightings at indices ``rows`` (or a mask), in that order."""
        index = np.asarray(rows)
        # NumPy turns an empty list into an array of floats.
        index = index if index.size else index.astype(np.intp)
        return replace(self, **{name: getattr(self, name)[index] for name in _COLUMNS})

    def of(self, heliostat: int | str) -> "Sightings":
        """Return the sightings of one heliostat, given by index or name, with heliostat index 0.

        Raises
        ------
        UnknownNameError
            If there is no sighting of a heliostat with that name.
        """
        if isinstance(heliostat, str) and heliostat not in self.names:
            raise UnknownNameError("heliostat (of the sightings)", heliostat, self.names)
        row = self.names.index(heliostat) if isinstance(heliostat, str) else heliostat
        part = self.take(np.flatnonzero(self.heliostat == row))
        return replace(
            part,
            heliostat=np.zeros(len(part), dtype=np.intp),
            names=self.names[row : row + 1],
        )

    def renumbered(self, rows: npt.ArrayLike) -> "Sightings":
        """Return the sightings with other heliostat indices, (M,), and without names."""
        return replace(self, heliostat=np.asarray(rows, dtype=np.intp), names=())

    def __getitem__(self, heliostat: str) -> "Sightings":
        """Return the sightings of one heliostat, given by name; see `of`."""
        return self.of(heliostat)


_COLUMNS = tuple(f.name for f in fields(Sightings) if f.name != "names")


def _ends(values: FloatArray) -> tuple[float, ...]:
    return (float(values.min()), float(values.max())) if len(values) else ()


def sightings(
    heliostat: npt.ArrayLike,
    counts: npt.ArrayLike,
    source: npt.ArrayLike,
    destination: npt.ArrayLike,
    *,
    time: Times = 0.0,
    source_at_infinity: npt.ArrayLike = True,
    destination_at_infinity: npt.ArrayLike = False,
    sigma: npt.ArrayLike = 5e-4,
    source_covariance: npt.ArrayLike = 0.0,
    destination_covariance: npt.ArrayLike = 0.0,
) -> Sightings:
    """Return checked sightings; all arguments broadcast to the M rows of ``counts``.

    Counts with several batch axes, such as (T, N, D) for N heliostats at T times, produce one
    sighting per element, with the last batch axis varying fastest. All other arguments broadcast to
    (T, N), and a list of times runs along the first axis.

    Parameters
    ----------
    heliostat
        Name of the heliostat of each sighting, or its index among the mechanisms, () or (M,).
    counts
        Drive counts, (M, D).
    source, destination
        Directions (of any length) or points (m), ENU, (M, 3). A direction of length 1 is kept
        unchanged to the last bit.
    time
        See `heliotrope.sun.Times`, () or (M,); NaN if unknown.
    source_at_infinity, destination_at_infinity
        Whether each end is at infinity. The sun is at infinity; a centroid on a target is not.
    sigma
        Standard deviation of the ray's direction, rad of beam, (M,).
    source_covariance, destination_covariance
        Covariances of the ends, in addition to sigma, in m² for a point and rad² for a direction.
        Either a variance that is equal in every direction, () or (M,), or matrices, (3, 3) or (M,
        3, 3).

    Raises
    ------
    InputError
        If a value is not finite, a direction is zero, sigma is out of range, or a covariance is not
        symmetric and positive semidefinite; the message names the row.
    """
    table = np.atleast_2d(_numbers(counts, "counts"))
    if not table.shape[-1]:
        raise InputError(
            f"sightings: counts of shape {np.shape(counts)} have no drives; pass shape (M, 2), or "
            "(0, 2) for no sightings"
        )
    batch = table.shape[:-1]
    table = table.reshape(-1, table.shape[-1])
    rows = len(table)

    def spread(values: npt.ArrayLike, name: str, dtype: npt.DTypeLike = np.float64) -> np.ndarray:
        return np.array(_rows(_numbers(values, name), batch, name), dtype=dtype).ravel()

    far_source = spread(source_at_infinity, "source_at_infinity", np.bool_)
    far_destination = spread(destination_at_infinity, "destination_at_infinity", np.bool_)
    ends = []
    for name, end, far in (
        ("source", source, far_source),
        ("destination", destination, far_destination),
    ):
        points = np.array(_rows(_numbers(end, name), (*batch, 3), name)).reshape(rows, 3)
        _finite(points, name)
        with np.errstate(over="ignore"):
            loose = far & (np.abs(np.linalg.norm(points, axis=-1) - 1.0) > _UNIT)
        if loose.any():
            points[loose] = normalize(points[loose], name)
        ends.append(points)
    _finite(table, "counts")
    spreads = spread(sigma, "sigma")
    bad = ~((spreads <= LARGEST_SIGMA) & (spreads >= SMALLEST_SIGMA))
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"sighting {i}: sigma must be between {SMALLEST_SIGMA} and {LARGEST_SIGMA} rad, not "
            f"{spreads[i]} rad; multiply milliradians by 1e-3, and convert degrees with "
            "numpy.radians"
        )
    index, names = _named(heliostat)
    return Sightings(
        _heliostats(index, batch),
        spread(_along_first(unix_seconds(time, unknown=True), batch), "time"),
        table,
        ends[0],
        ends[1],
        far_source,
        far_destination,
        spreads,
        _covariances(source_covariance, rows, "source_covariance"),
        _covariances(destination_covariance, rows, "destination_covariance"),
        names,
    )


def _numbers(values: npt.ArrayLike, name: str) -> FloatArray:
    """Return an array of numbers; NaN is allowed here, and refused later with its index."""
    try:
        return as_float(values)
    except (TypeError, ValueError):
        # The error raised by `as_float` says what is wrong.
        return as_numbers(values, f"sightings: {name}")


def _rows(values: FloatArray, shape: tuple[int, ...], name: str) -> FloatArray:
    """Return the values of each sighting."""
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        shape_text = "3 numbers" if name in ("source", "destination") else "a number"
        raise InputError(
            f"sightings: {name} of shape {values.shape}; there are {shape[0]} rows of counts: "
            f"pass {shape_text} for all of them, or shape {shape}"
        ) from None


def _heliostats(heliostat: npt.ArrayLike, batch: tuple[int, ...]) -> npt.NDArray[np.intp]:
    values = _rows(_numbers(heliostat, "heliostat"), batch, "heliostat").ravel()
    bad = ~((values >= 0.0) & (values == np.floor(values)))
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"sighting {i}: heliostat {values[i]:g} is not a heliostat index; use integers from 0"
        )
    return np.array(values, dtype=np.intp)


def _named(heliostat: npt.ArrayLike) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return heliostat indices, and names in order of first appearance; () if passed as indices."""
    labels = np.asarray(heliostat)
    if labels.dtype.kind not in "UO":
        return labels, ()
    names = tuple(dict.fromkeys(str(name) for name in labels.ravel()))
    place = {name: i for i, name in enumerate(names)}
    rows = np.array([place[str(name)] for name in labels.ravel()], dtype=np.intp)
    return rows.reshape(labels.shape), names


def _along_first(times: FloatArray, batch: tuple[int, ...]) -> FloatArray:
    """Return a list of times as the first of several batch axes."""
    if times.ndim == 1 and len(batch) > 1 and len(times) == batch[0]:
        return times.reshape(-1, *(1,) * (len(batch) - 1))
    return times


def _covariances(covariance: npt.ArrayLike, rows: int, name: str) -> FloatArray:
    values = _numbers(covariance, name)
    if values.ndim < 2:
        values = np.where(np.eye(3) > 0.0, values[..., None, None], 0.0)
    try:
        matrices = np.array(np.broadcast_to(values, (rows, 3, 3)))
    except ValueError:
        raise InputError(
            f"sightings: {name} of shape {np.shape(covariance)}; pass one variance, {rows} "
            f"variances, or matrices (3, 3) or ({rows}, 3, 3)"
        ) from None
    bad = ~is_covariance(matrices)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"sighting {i}: {name} {matrices[i].tolist()} is not symmetric and positive "
            "semidefinite; use variances and covariances in m² for points and rad² for directions"
        )
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, -1, -2)))


def is_covariance(matrices: FloatArray) -> npt.NDArray[np.bool_]:
    """Return a mask of the matrices (M, 3, 3) that are finite, symmetric and positive semidefinite.

    The tolerance is 1e-9 of the largest entry. Entries above 1e100 count as infinite.
    """
    largest = np.abs(matrices).max(axis=(-1, -2))
    # Most matrices are zero and need no eigenvalues.
    good = largest == 0.0
    rows = np.flatnonzero(~good & (largest < 1e100))
    scaled = matrices[rows] / largest[rows, None, None]
    even = np.abs(scaled - np.swapaxes(scaled, -1, -2)).max(axis=(-1, -2)) <= 1e-9
    good[rows] = even & (np.linalg.eigvalsh(scaled)[:, 0] >= -1e-9)
    return np.asarray(good)


def _finite(values: FloatArray, name: str) -> None:
    bad = ~np.isfinite(values).all(axis=-1)
    if bad.any():
        i = int(np.flatnonzero(bad)[0])
        raise InputError(f"sighting {i}: {name} {values[i]} is not finite; omit this row")


def ray_directions(s: Sightings, vertex: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return unit vectors to source and destination, (..., 3), as seen from vertices (M, 3)."""
    m = as_float(vertex)
    ends = []
    for points, far in (
        (s.source, s.source_at_infinity),
        (s.destination, s.destination_at_infinity),
    ):
        directions = np.where(far[:, None], points, points - m)
        ends.append(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    return ends[0], ends[1]


def bisector_covariance(s: Sightings, vertex: npt.ArrayLike, axes: npt.ArrayLike) -> FloatArray:
    r"""Return the covariance of the bisectors of source and destination, rad², (M, 2, 2).

    With s and t the unit vectors to both ends and v their bisector, to first order

    $$ δv = (I - v v^T)(δs + δt) / |s + t| $$

    where a shift δp of a point at distance d turns its direction by
    $δs = (I - s s^T) δp / d$. The errors of the two ends are taken as independent.

    Parameters
    ----------
    s
        M sightings.
    vertex
        Vertices of their mirrors, ENU metres, (M, 3).
    axes
        Two unit axes across each bisector, (M, 2, 3).
    """
    m = as_float(vertex)
    rays = ray_directions(s, m)
    size = np.linalg.norm(rays[0] + rays[1], axis=-1)
    across = as_float(axes) / size[:, None, None]
    # A rotation ε of the ray t rotates the bisector by the part of ε across the normal, over |s +
    # t|. That part is all of ε across the plane of incidence, and ε cos i within the plane.
    turn = np.eye(3) - rays[1][:, :, None] * rays[1][:, None, :]
    covariance = across @ turn @ np.swapaxes(across, -1, -2) * s.sigma[:, None, None] ** 2
    for ray, points, far, end_covariance in (
        (rays[0], s.source, s.source_at_infinity, s.source_covariance),
        (rays[1], s.destination, s.destination_at_infinity, s.destination_covariance),
    ):
        rows = np.flatnonzero(end_covariance.any(axis=(-1, -2)))
        if rows.size:
            w = ray[rows]
            lever = np.where(far[rows], 1.0, np.linalg.norm(points[rows] - m[rows], axis=-1))
            turn = (np.eye(3) - w[:, :, None] * w[:, None, :]) / lever[:, None, None]
            part = across[rows] @ turn
            covariance[rows] += part @ end_covariance[rows] @ np.swapaxes(part, -1, -2)
    return as_float(covariance)


def of_measurements(
    measurements: Measurements, heliostats: Heliostats, sigma: float = 5e-4
) -> tuple[Sightings, list[str]]:
    """Return sightings from camera-target measurements, and a message for each name left out.

    Parameters
    ----------
    measurements
        Measurements as read from files.
    heliostats
        Heliostats that include all names in the measurements.
    sigma
        Standard deviation of a centroid as seen from the mirror, rad of beam.
    """
    known = {name: i for i, name in enumerate(heliostats.names)}
    rows = np.array([known.get(name, -1) for name in measurements.heliostat], dtype=np.intp)
    kept = rows >= 0
    strangers = sorted({n for n, ok in zip(measurements.heliostat, kept, strict=True) if not ok})
    left_out = [f"measurements of {name}: the plant has no such heliostat" for name in strangers]
    targeted = sightings(
        rows[kept],
        measurements.counts[kept],
        measurements.sun[kept],
        measurements.centroid[kept],
        time=measurements.time[kept],
        sigma=sigma,
    )
    return replace(targeted, names=heliostats.names), left_out


def camera_target(
    heliostat: npt.ArrayLike,
    counts: npt.ArrayLike,
    sun: npt.ArrayLike,
    centroid: npt.ArrayLike,
    *,
    time: Times = 0.0,
    sigma: npt.ArrayLike = 5e-4,
    sun_covariance: npt.ArrayLike = 0.0,
    centroid_covariance: npt.ArrayLike = 0.0,
) -> Sightings:
    """Return sightings from the sun to the centroid of its image on a target (Malan).

    Parameters
    ----------
    heliostat, counts, time, sigma
        As for `sightings`.
    sun
        Directions to the apparent sun, ENU, (M, 3).
    centroid
        Centroid of the image on the target, ENU metres, (M, 3).
    sun_covariance, centroid_covariance
        Covariances in Covariances in rad² and m², as for `sightings`.
    """
    return sightings(
        heliostat,
        counts,
        sun,
        centroid,
        time=time,
        sigma=sigma,
        source_covariance=sun_covariance,
        destination_covariance=centroid_covariance,
    )


def drone(
    heliostat: npt.ArrayLike,
    counts: npt.ArrayLike,
    led: npt.ArrayLike,
    camera: npt.ArrayLike,
    *,
    time: Times = 0.0,
    sigma: npt.ArrayLike = 5e-4,
    led_covariance: npt.ArrayLike = 0.0,
    camera_covariance: npt.ArrayLike = 0.0,
) -> Sightings:
    """Return sightings from a lamp to the drone camera that sees the reflection (HelioPoint).

    Parameters
    ----------
    heliostat, counts, time, sigma
        As for `sightings`.
    led, camera
        Position of the lamp, and centre of projection of the camera, ENU metres, (M, 3).
    led_covariance, camera_covariance
        Covariances in m², as for `sightings`. The two ends are taken as independent. If the lamp is
        mounted beside the camera, an error in the drone's position moves both: pass four times its
        variance for one end and 0 for the other.
    """
    return sightings(
        heliostat,
        counts,
        led,
        camera,
        time=time,
        sigma=sigma,
        source_at_infinity=False,
        source_covariance=led_covariance,
        destination_covariance=camera_covariance,
    )


def sun_sensor(
    heliostat: npt.ArrayLike,
    counts: npt.ArrayLike,
    sun: npt.ArrayLike,
    *,
    time: Times = 0.0,
    normal_sigma: npt.ArrayLike = 2.5e-4,
    normal_covariance: npt.ArrayLike = 0.0,
) -> Sightings:
    """Return sightings, from the sun to the sun, of a sensor that keeps the mirror facing the sun.

    Parameters
    ----------
    heliostat, counts, time
        As for `sightings`.
    sun
        Directions to the apparent sun while the sensor controlled the mirror, ENU, (M, 3).
    normal_sigma
        Standard deviation of the mirror normal, rad, (M,); the ray turns by twice that angle.
    normal_covariance
        Covariance of the normal, rad². Source and destination are one measurement, so four times
        this covariance is assigned to the destination.
    """
    return sightings(
        heliostat,
        counts,
        sun,
        sun,
        time=time,
        sigma=2.0 * _numbers(normal_sigma, "normal_sigma"),
        destination_at_infinity=True,
        destination_covariance=4.0 * _numbers(normal_covariance, "normal_covariance"),
    )


def field_camera(
    heliostat: npt.ArrayLike,
    counts: npt.ArrayLike,
    sun: npt.ArrayLike,
    camera: npt.ArrayLike,
    *,
    time: Times = 0.0,
    sigma: npt.ArrayLike = 5e-4,
    sun_covariance: npt.ArrayLike = 0.0,
    camera_covariance: npt.ArrayLike = 0.0,
) -> Sightings:
    """Return sightings from the sun to a field camera that sees the sun in the mirror (eSolar).

    Parameters
    ----------
    heliostat, counts, time, sigma
        As for `sightings`.
    sun
        Directions to the apparent sun, ENU, (M, 3).
    camera
        The camera's centre of projection, ENU metres, (M, 3).
    sun_covariance, camera_covariance
        rad² and m², as for `sightings`.
    """
    # For the law of reflection a camera is like a target, because sunlight reached this point.
    return camera_target(
        heliostat,
        counts,
        sun,
        camera,
        time=time,
        sigma=sigma,
        sun_covariance=sun_covariance,
        centroid_covariance=camera_covariance,
    )


def join(parts: Iterable[Sightings]) -> Sightings:
    """Join sightings of several kinds or campaigns, in the order of the arguments.

    Raises
    ------
    InputError
        If there are no sightings, or their mechanisms have different numbers of drives.
    """
    if isinstance(parts, Sightings):
        raise InputError("join: got a single Sightings; pass a list of Sightings")
    parts = list(parts)
    for k, part in enumerate(parts):
        if not isinstance(part, Sightings):
            raise InputError(f"join: part {k} is {kind_of(part)}; pass a list of Sightings")
    if not parts:
        raise InputError("join: the list is empty; pass at least one Sightings")
    drives = sorted({part.counts.shape[-1] for part in parts})
    if len(drives) != 1:
        raise InputError(
            f"join: sightings of mechanisms with {drives} drives; join those of one kind"
        )
    named = [part for part in parts if part.names]
    if named and len(named) != len(parts):
        raise InputError(
            "join: some sightings name their heliostats and others number them; name all, as in "
            "sightings(names, …)"
        )
    names = tuple(dict.fromkeys(name for part in named for name in part.names))
    if named:
        place = {name: i for i, name in enumerate(names)}
        parts = [
            replace(p, heliostat=np.array([place[n] for n in p.names], np.intp)[p.heliostat])
            for p in parts
        ]
    columns = {name: np.concatenate([getattr(p, name) for p in parts]) for name in _COLUMNS}
    return Sightings(**columns, names=names)
