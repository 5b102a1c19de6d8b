"""Sighting tables: all kinds of sighting in one CSV or Parquet file, and Malan's own CSV.

Each row is one sighting. A row that cannot be used is left out and reported in one line (file,
line, heliostat, column, value, remedy). A file that cannot be used raises an error.
"""

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt

from heliotrope.calibration import plausibility
from heliotrope.calibration.sightings import (
    LARGEST_SIGMA,
    SMALLEST_SIGMA,
    Sightings,
    camera_target,
    is_covariance,
    sightings,
)
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.field.target import Target
from heliotrope.files.cells import (
    Rows,
    find_heliostats,
    read_parquet,
    read_rows,
    rows_of,
)
from heliotrope.files.limits import SIZE_LIMIT
from heliotrope.files.text import write_file
from heliotrope.files.times import format_time
from heliotrope.geometry import FloatArray, direction
from heliotrope.sun.ephemeris import END_OF_TIMES

#: Kinds of sightings, and whether their source and destination are at infinity.
KINDS = {
    "camera_target": (True, False),
    "drone": (False, False),
    "sun_sensor": (True, True),
    "field_camera": (True, False),
}
_ENDS = ("source", "destination")
_AXES = ("east", "north", "up")
#: Upper triangle of a symmetric matrix, by the initials of the axes.
_PAIRS = {"ee": (0, 0), "en": (0, 1), "eu": (0, 2), "nn": (1, 1), "nu": (1, 2), "uu": (2, 2)}
#: Largest plausible distance of a lamp, camera or target from the plant's reference, m.
_FARTHEST = 50e3
_MALAN = (
    "timestamp", "sun_azimuth_deg", "sun_elevation_deg", "horizontal_offset_m",
    "vertical_offset_m", "azimuth_counts", "elevation_counts",
)  # fmt: skip
#: Largest plausible distance of a centroid from the aim point, m.
_FARTHEST_OFFSET = 50.0


def read_sightings(
    path: str | Path,
    names: Sequence[str],
    judge: Callable[[Sightings, Sequence[str]], Mapping[int, str]] | None = None,
) -> tuple[Sightings, tuple[str, ...], list[str]]:
    """Return the sightings of a table, their kinds, and a message for each row left out.

    Parameters
    ----------
    path
        A ``.csv`` file (comma, semicolon or tab; with or without a byte-order mark) or a
        ``.parquet`` file, with the columns of `write_sightings`. Columns ``time``, ``kind`` and the
        covariances are optional; ``sigma_mrad`` may replace ``sigma_rad``. A missing time is NaN.
        Other columns are ignored.
    names
        Names of the heliostats in the order of their indices, (N,).
    judge
        Function that is called with all sightings and their kinds, and returns the impossible
        sightings by index, with the reason. See `heliotrope.calibration.plausibility`.

    Returns
    -------
    M sightings in the order of the file, their kinds (empty if not specified), and one message for
    each row that could not be used.

    Raises
    ------
    FormatError
        If the file cannot be read, or a column is missing or misspelt.
    InputError
        If a name occurs twice.
    """
    file = Path(path)
    if _is_parquet(file):
        rows = read_parquet(file, "a table of sightings")
    else:
        rows = read_rows(file, "a table of sightings in CSV (large ones are .parquet)")
    drives = _check_columns(rows)
    heliostat = find_heliostats(rows, "heliostat", names)
    kinds = rows.texts("kind")
    time = _times(rows, "time", optional=True) if "time" in rows.columns else None
    counts = np.stack([rows.numbers(name, "drive counts") for name in drives], axis=-1)
    far = {end: rows.flags(f"{end}_at_infinity") for end in _ENDS}
    ends = {end: _points(rows, end, far[end]) for end in _ENDS}
    _check_kinds(rows, kinds, far)
    sigma = _sigma(rows)
    spread = {end: _covariance(rows, end) for end in _ENDS}
    good = rows.good
    unnamed = sightings(
        heliostat[good],
        counts[good],
        ends["source"][good],
        ends["destination"][good],
        time=np.nan if time is None else time[good],
        source_at_infinity=far["source"][good],
        destination_at_infinity=far["destination"][good],
        sigma=sigma[good],
        source_covariance=spread["source"][good],
        destination_covariance=spread["destination"][good],
    )
    named = replace(unnamed, names=tuple(names))
    if judge is not None:
        named = _without(rows, named, judge(named, [kinds[i] for i in good]))
    return named, tuple(kinds[i] for i in rows.good), rows.left_out


def _times(rows: Rows, column: str, *, optional: bool) -> FloatArray:
    """Return Unix seconds; a row with a time that sightings cannot hold is left out."""
    seconds = rows.times(column, optional=optional)
    for i in np.flatnonzero(seconds >= END_OF_TIMES):
        rows.refuse(i, column, plausibility.YEAR)
    return seconds


def _without(rows: Rows, sightings: Sightings, reasons: Mapping[int, str]) -> Sightings:
    """Reject the rows of sightings that have a reason, and return the other sightings."""
    good = rows.good
    rows.reasons |= {int(good[k]): ("", reason) for k, reason in reasons.items()}
    return sightings.take(np.isin(good, rows.good))


def write_sightings(
    path: str | Path,
    sightings: Sightings,
    names: Sequence[str],
    kinds: Sequence[str] | None = None,
) -> None:
    """Write sightings so that `read_sightings` returns exactly the same numbers.

    Parameters
    ----------
    path
        A ``.csv`` or ``.parquet`` file, written completely or not at all.
    sightings
        M sightings.
    names
        Names of the heliostats, (N,).
    kinds
        Kind of each sighting, (M,): "camera_target", "drone", "sun_sensor", "field_camera"
        or "".

    Raises
    ------
    InputError
        If a name, kind or time cannot be written, the suffix is unknown, a CSV would exceed
        the 64 MiB that `read_sightings` accepts, or the folder cannot be written to.
    """
    file = Path(path)
    columns = _columns(sightings, names, kinds)
    if _is_parquet(file):
        write_file(file, lambda stream: _write_parquet(columns, stream))
    else:
        write_file(file, lambda stream: _write_csv(file, columns, stream))


def read_malan(
    path: str | Path,
    heliostat: str,
    names: Sequence[str],
    target: Target,
    *,
    aim: tuple[float, float] = (0.0, 0.0),
    sigma: float = 5e-4,
) -> tuple[Sightings, list[str]]:
    """Return the camera-target sightings of one heliostat from a file in Malan's format.

    Parameters
    ----------
    path
        CSV (comma, semicolon or tab; with or without a byte-order mark) with the columns
        ``timestamp`` (ISO 8601 with a zone), ``sun_azimuth_deg`` (clockwise from north),
        ``sun_elevation_deg`` (apparent), ``horizontal_offset_m`` and
        ``vertical_offset_m`` (of the centroid from the aim point, to the right as seen from
        the heliostats, and up), ``azimuth_counts`` and ``elevation_counts``.
    heliostat
        Name of the measured heliostat.
    names
        Names of all heliostats, (N,).
    target
        Target on which the beam was measured.
    aim
        Aim point, m to the right of and above the target's centre.
    sigma
        Standard deviation of a centroid as seen from the mirror, rad of beam.

    Returns
    -------
    The sightings in the order of the file, and one message for each row left out.

    Raises
    ------
    FormatError
        If the file cannot be read or lacks a column.
    UnknownNameError
        If the heliostat does not exist.
    """
    index = rows_of(names)
    if heliostat not in index:
        raise UnknownNameError("heliostat", heliostat, names)
    rows = read_rows(Path(path), "a table of Malan's measurements in CSV")
    rows.need(_MALAN)
    rows.heliostat = [heliostat] * len(rows)
    time = _times(rows, "timestamp", optional=False)
    azimuth = rows.numbers("sun_azimuth_deg", "degrees clockwise from north")
    elevation = rows.numbers("sun_elevation_deg", "degrees above the horizon")
    offsets = [
        rows.numbers(name, "metres from the aim point")
        for name in ("horizontal_offset_m", "vertical_offset_m")
    ]
    counts = [rows.numbers(name, "drive counts") for name in _MALAN[-2:]]
    rows.check(
        "sun_azimuth_deg",
        (azimuth < -180.0) | (azimuth > 360.0),
        azimuth,
        "° is outside −180° to 360°; use degrees clockwise from north",
    )
    rows.check(
        "sun_elevation_deg",
        (elevation <= -5.0) | (elevation > 90.0),
        elevation,
        "° is outside −5° to 90°; use the sun's elevation in degrees",
    )
    for name, values in zip(_MALAN[3:5], offsets, strict=True):
        rows.check(
            name,
            np.abs(values) > _FARTHEST_OFFSET,
            values,
            f" m is more than {_FARTHEST_OFFSET:g} m; check the unit",
        )
    good = rows.good
    targeted = camera_target(
        index[heliostat],
        np.stack(counts, axis=-1)[good],
        direction(np.radians(azimuth[good]), np.radians(elevation[good])),
        target.point((np.stack(offsets, axis=-1) + aim)[good]),
        time=time[good],
        sigma=sigma,
    )
    targeted = _without(rows, targeted, plausibility.judge(targeted).reasons)
    return replace(targeted, names=tuple(names)), rows.left_out


def _is_parquet(path: Path) -> bool:
    suffix = path.suffix.casefold()
    if suffix not in (".csv", ".parquet"):
        raise FormatError(path, f"the name ends in {suffix!r}; sightings are .csv or .parquet")
    return suffix == ".parquet"


def _check_columns(rows: Rows) -> list[str]:
    """Return the names of the count columns; raise an error for missing or misspelt columns."""
    ends = [f"{end}_{axis}" for end in _ENDS for axis in (*_AXES, "at_infinity")]
    rows.need(["heliostat", "count_1", *ends])
    columns = list(rows.columns)
    drives = ["count_1"]
    while f"count_{len(drives) + 1}" in rows.columns:
        drives.append(f"count_{len(drives) + 1}")
    covariances = [f"{end}_cov_{pair}" for end in _ENDS for pair in _PAIRS]
    for end in _ENDS:
        six = [name for name in covariances if name.startswith(end)]
        if any(name in rows.columns for name in six):
            rows.need(six)
    sigmas = ("sigma_rad", "sigma_mrad")
    if all(name in rows.columns for name in sigmas):
        raise FormatError(
            rows.path, ("sigma is specified both in rad and in mrad; keep one column"), rows.header
        )
    if "sigma_mrad" not in rows.columns:
        rows.need(["sigma_rad"])
    known = ["heliostat", "time", "kind", *drives, *ends, *sigmas, *covariances]
    likely = [n for n in (*known, f"count_{len(drives) + 1}") if n not in columns]
    for name in columns:
        if name not in known and name.startswith(("source_", "destination_", "count_", "sigma")):
            close = get_close_matches(name, likely, n=1)
            hint = f"did you mean {close[0]}?" if close else "rename or remove it"
            raise FormatError(rows.path, f"column {name} is not known; {hint}", rows.header)
    return drives


def _points(rows: Rows, end: str, far: npt.NDArray[np.bool_]) -> FloatArray:
    names = [f"{end}_{axis}" for axis in _AXES]
    what = "metres in ENU, or a part of the direction"
    points = np.stack([rows.numbers(name, what) for name in names], axis=-1)
    for name, values in zip(names, points.T, strict=True):
        rows.check(
            name,
            ~far & (np.abs(values) > _FARTHEST),
            values,
            f" m is more than {_FARTHEST / 1e3:g} km from the plant; use ENU metres relative to "
            "the plant",
        )
    for i in np.flatnonzero(far & ~points.any(axis=-1)):
        rows.refuse(i, names[0], "0, 0, 0 is not a direction; enter the direction from the mirror")
    return points


def _check_kinds(rows: Rows, kinds: Sequence[str], far: dict[str, npt.NDArray[np.bool_]]) -> None:
    for i, kind in enumerate(kinds):
        if kind and kind not in KINDS:
            rows.refuse(i, "kind", str(UnknownNameError("kind of sighting", kind, KINDS)))
        for end, infinite in zip(_ENDS, KINDS.get(kind, ()), strict=False):
            if far[end][i] != infinite:
                rows.refuse(
                    i,
                    f"{end}_at_infinity",
                    f"{str(bool(far[end][i])).lower()}, but for kind {kind} it is "
                    f"{str(infinite).lower()}; correct one of them",
                )


def _sigma(rows: Rows) -> FloatArray:
    name = "sigma_rad" if "sigma_rad" in rows.columns else "sigma_mrad"
    unit = name.removeprefix("sigma_")
    values = rows.numbers(name, f"the ray's standard deviation in {unit}")
    # Dividing by 1000 rounds once; multiplying by 1e-3, which is not exact in binary, rounds twice.
    scale = 1.0 if unit == "rad" else 1e3
    sigma = values / scale
    rows.check(
        name,
        (sigma < SMALLEST_SIGMA) | (sigma > LARGEST_SIGMA),
        values,
        f" {unit} is outside {scale * SMALLEST_SIGMA:g} to {scale * LARGEST_SIGMA:g} {unit}; "
        "check the unit",
    )
    return sigma


def _covariance(rows: Rows, end: str) -> FloatArray:
    matrices = np.zeros((len(rows), 3, 3))
    if f"{end}_cov_ee" not in rows.columns:
        return matrices
    names = {pair: f"{end}_cov_{pair}" for pair in _PAIRS}
    # If all six cells are empty, there is no covariance; if only some are, it is a mistake.
    filled = np.array([rows.filled(name) for name in names.values()])
    some = filled.any(axis=0)
    what = "m² of a point or rad² of a direction, or leave all six empty"
    for k, (pair, (a, b)) in enumerate(_PAIRS.items()):
        values = rows.numbers(names[pair], what, empty=0.0)
        matrices[:, a, b] = matrices[:, b, a] = values
        for i in np.flatnonzero(some & ~filled[k]):
            rows.refuse(i, names[pair], f"the cell is empty; enter {what}")
    for i in np.flatnonzero(~is_covariance(matrices)):
        rows.refuse(
            i,
            f"{end}_cov_ee to {end}_cov_uu",
            f"{[float(matrices[i, a, b]) for a, b in _PAIRS.values()]} is not a covariance (not "
            "positive semidefinite); correct it or leave all six cells empty",
        )
    return matrices


def _columns(
    s: Sightings, names: Sequence[str], kinds: Sequence[str] | None
) -> dict[str, list[Any]]:
    rows_of(names)
    if len(s) and int(s.heliostat.max()) >= len(names):
        raise InputError(
            f"sightings: heliostat row {int(s.heliostat.max())}, but there are only {len(names)} "
            "names; pass the names of all heliostats"
        )
    all_kinds = [""] * len(s) if kinds is None else list(kinds)
    if len(all_kinds) != len(s):
        raise InputError(
            f"sightings: got {len(all_kinds)} kinds for {len(s)} sightings; pass one kind per "
            "sighting"
        )
    for kind in all_kinds:
        if kind and kind not in KINDS:
            raise UnknownNameError("kind of sighting", kind, KINDS)
    columns: dict[str, list[Any]] = {
        "heliostat": [str(names[i]) for i in s.heliostat],
        "time": [format_time(t) for t in s.time.tolist()],
        "kind": all_kinds,
    }
    for d in range(s.counts.shape[-1]):
        columns[f"count_{d + 1}"] = s.counts[:, d].tolist()
    for end in _ENDS:
        for axis, values in zip(_AXES, getattr(s, end).T, strict=True):
            columns[f"{end}_{axis}"] = values.tolist()
        columns[f"{end}_at_infinity"] = getattr(s, f"{end}_at_infinity").tolist()
    columns["sigma_rad"] = s.sigma.tolist()
    for end in _ENDS:
        matrices = getattr(s, f"{end}_covariance")
        if matrices.any():
            for pair, (a, b) in _PAIRS.items():
                columns[f"{end}_cov_{pair}"] = matrices[:, a, b].tolist()
    return columns


def _write_csv(path: Path, columns: dict[str, list[Any]], stream: BinaryIO) -> None:
    text = io.TextIOWrapper(stream, encoding="utf-8", newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    # `repr` produces the shortest text that reads back as the same number.
    cells: Iterable[list[Any]] = (
        ["true" if c else "false" for c in column] if name.endswith("_at_infinity") else column
        for name, column in columns.items()
    )
    writer.writerows(zip(*cells, strict=True))
    text.flush()
    text.detach()
    if stream.tell() > SIZE_LIMIT:
        raise InputError(
            f"{path}: {stream.tell() / 2**20:.0f} MiB of CSV exceed the "
            f"{SIZE_LIMIT / 2**20:.0f} MiB that can be read; write .parquet"
        )


def _write_parquet(columns: dict[str, list[Any]], stream: BinaryIO) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    def kind(name: str) -> Any:
        if name in ("heliostat", "time", "kind"):
            return pa.string()
        return pa.bool_() if name.endswith("_at_infinity") else pa.float64()

    table = pa.table({name: pa.array(cells, kind(name)) for name, cells in columns.items()})
    pq.write_table(table, stream)
