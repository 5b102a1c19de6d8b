"""Reflections of the drone's lamp found in the images: the reflection table of a flight.

One record is one reflection in one photograph. The mirror orientations are computed from this table
alone, without the images.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError
from heliotrope.files.cells import Rows, find_heliostats, read_parquet, read_rows
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, as_float

_VECTORS = ("camera", "led")
_AXES = ("east", "north", "up")
_ENDS = tuple(f"{end}_{axis}_m" for end in _VECTORS for axis in _AXES)
_COLUMNS = ("photo", "heliostat", "facet", "x_m", "y_m", *_ENDS, "sigma_m")


@dataclass(frozen=True)
class Reflections:
    """N reflections.

    Attributes
    ----------
    photo
        Index of the photograph, (N,).
    heliostat
        Index of the heliostat in a separate list of names, (N,).
    facet
        Facet index, (N,).
    x, y
        Position on the mirror, m in concentrator coordinates, (N,).
    camera, led
        Projection centre and lamp at exposure, ENU metres, (N, 3).
    sigma
        Standard deviation of x and of y, m on the mirror, (N,).
    """

    photo: npt.NDArray[np.intp]
    heliostat: npt.NDArray[np.intp]
    facet: npt.NDArray[np.intp]
    x: FloatArray
    y: FloatArray
    camera: FloatArray
    led: FloatArray
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.photo)

    @property
    def xy(self) -> FloatArray:
        """Position on the mirror, m in concentrator coordinates, (N, 2)."""
        return np.stack([self.x, self.y], axis=-1)

    def take(self, rows: npt.ArrayLike) -> "Reflections":
        """Return the reflections at indices ``rows`` (or a mask), in that order."""
        index = np.asarray(rows)
        # NumPy turns an empty list into an array of floats.
        index = index if index.size else index.astype(np.intp)
        return replace(self, **{f.name: getattr(self, f.name)[index] for f in fields(self)})

    def of(self, heliostat: int) -> "Reflections":
        """Return the reflections of one heliostat, with its index unchanged."""
        return self.take(np.flatnonzero(self.heliostat == heliostat))


def reflections(
    photo: npt.ArrayLike,
    heliostat: npt.ArrayLike,
    facet: npt.ArrayLike,
    xy: npt.ArrayLike,
    camera: npt.ArrayLike,
    led: npt.ArrayLike,
    sigma: npt.ArrayLike,
) -> Reflections:
    """Return checked reflections; all arguments broadcast to the N rows of ``xy`` (N, 2).

    Raises
    ------
    InputError
        If a number is not finite, an index is below 0, or sigma is not above 0.
    """
    place = as_float(xy).reshape(-1, 2)
    rows = len(place)

    def index(numbers: npt.ArrayLike, name: str) -> npt.NDArray[np.intp]:
        values = np.array(np.broadcast_to(np.asarray(numbers, dtype=np.intp), (rows,)))
        if (values < 0).any():
            i = int(np.flatnonzero(values < 0)[0])
            raise InputError(f"reflection {i}: {name} {values[i]} is below 0")
        return values

    spread = np.array(np.broadcast_to(as_float(sigma), (rows,)))
    ends = [np.array(np.broadcast_to(as_float(end), (rows, 3))) for end in (camera, led)]
    for name, values in (("xy", place), ("camera", ends[0]), ("led", ends[1])):
        invalid = ~np.isfinite(values).all(axis=-1)
        if invalid.any():
            i = int(np.flatnonzero(invalid)[0])
            raise InputError(
                f"reflection {i}: {name} {values[i]} is not finite; omit this reflection"
            )
    invalid = ~(np.isfinite(spread) & (spread > 0.0))
    if invalid.any():
        i = int(np.flatnonzero(invalid)[0])
        raise InputError(f"reflection {i}: sigma must be above 0, not {spread[i]} m")
    return Reflections(
        index(photo, "photo"),
        index(heliostat, "heliostat"),
        index(facet, "facet"),
        place[:, 0].copy(),
        place[:, 1].copy(),
        ends[0],
        ends[1],
        spread,
    )


def join(parts: Sequence[Reflections]) -> Reflections:
    """Join several tables in order; without any tables the result is empty."""
    if not parts:
        return reflections([], [], [], np.empty((0, 2)), np.empty((0, 3)), np.empty((0, 3)), [])
    return Reflections(
        **{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Reflections)}
    )


def write_reflections(path: str | Path, found: Reflections, names: Sequence[str]) -> None:
    """Write reflections as ``.csv`` or ``.parquet``, completely or not at all.

    The columns are photo, heliostat (name), facet, x_m, y_m, camera_east_m …, led_up_m, sigma_m.

    Raises
    ------
    InputError
        If the suffix is neither ``.csv`` nor ``.parquet``, or an index has no name in ``names``.
    """
    import pandas as pd

    file = _checked(path)
    if len(found) and int(found.heliostat.max()) >= len(names):
        raise InputError(
            f"reflections: heliostat row {int(found.heliostat.max())}, but there are only "
            f"{len(names)} names; pass the names of all heliostats"
        )
    columns: dict[str, object] = {
        "photo": found.photo,
        "heliostat": [str(names[i]) for i in found.heliostat],
        "facet": found.facet,
        "x_m": found.x,
        "y_m": found.y,
    }
    for end in _VECTORS:
        for k, axis in enumerate(_AXES):
            columns[f"{end}_{axis}_m"] = getattr(found, end)[:, k]
    table = pd.DataFrame({**columns, "sigma_m": found.sigma})
    if file.suffix.casefold() == ".csv":
        write_text(file, table.to_csv(index=False))
    else:
        write_file(file, lambda stream: table.to_parquet(stream, index=False))


def read_reflections(path: str | Path, names: Sequence[str]) -> tuple[Reflections, list[str]]:
    """Return the reflections in a file, and a message for each row that was left out.

    Raises
    ------
    FormatError
        If the file cannot be read or lacks a column.
    """
    file = _checked(path)
    reader = read_rows if file.suffix.casefold() == ".csv" else read_parquet
    rows: Rows = reader(file, "a table of reflections")
    rows.need(_COLUMNS)
    heliostat = find_heliostats(rows, "heliostat", names)
    numbers = {name: rows.numbers(name, "a number") for name in _COLUMNS if name != "heliostat"}
    for name in ("photo", "facet"):
        column = numbers[name]
        rows.check(
            name,
            ~((column >= 0) & (column == np.floor(column))) & np.isfinite(column),
            column,
            " is not a whole number from 0",
        )
    sigma = numbers["sigma_m"]
    rows.check("sigma_m", ~(sigma > 0.0) & np.isfinite(sigma), sigma, " m is not above 0")
    good = rows.good
    ends = [
        np.stack([numbers[f"{end}_{axis}_m"][good] for axis in _AXES], axis=-1) for end in _VECTORS
    ]
    return reflections(
        numbers["photo"][good].astype(np.intp),
        heliostat[good],
        numbers["facet"][good].astype(np.intp),
        np.stack([numbers["x_m"][good], numbers["y_m"][good]], axis=-1),
        ends[0],
        ends[1],
        sigma[good],
    ), rows.left_out


def _checked(path: str | Path) -> Path:
    file = Path(path)
    if file.suffix.casefold() not in (".csv", ".parquet"):
        raise FormatError(
            file, f"the name ends in {file.suffix!r}; reflections are .csv or .parquet"
        )
    return file
