"""The allowable flux on a receiver: a number, or a map on any grid of cells."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.errors import FormatError, InputError, shown
from heliotrope.files import write_text
from heliotrope.files.text import read_text
from heliotrope.geometry import FloatArray, as_float

#: Largest flux that a limit may state, W/m²; the sun's own surface emits 6.3e7.
MOST = 6.4e7
#: A map that is lower than this in every cell is probably in kW/m²; ten suns, W/m².
UNUSUAL = 1e4


@dataclass(frozen=True, eq=False)
class FluxLimit:
    """The allowable flux on a receiver.

    Attributes
    ----------
    flux
        W/m²: a number, or a map over the receiver, (rows, columns), with the lowest row first and
        columns ordered like the columns of its cells; there may be any number of rows and columns.
    margin
        Fraction of the flux that is reserved for the model's own error, 0 to 0.5.
    """

    flux: float | FloatArray
    margin: float = 0.0

    def __post_init__(self) -> None:
        flux = as_float(self.flux)
        if flux.ndim not in (0, 2) or flux.size == 0:
            raise InputError(
                f"flux limit: a map of shape {flux.shape}; pass one number, or an array with rows "
                "and columns"
            )
        wrong = ~((flux > 0.0) & (flux <= MOST))
        if wrong.any():
            place = "" if flux.ndim == 0 else " in row {}, column {}".format(*np.argwhere(wrong)[0])
            raise InputError(
                f"flux limit{place} must be above 0 and at most {MOST:g} W/m², not "
                f"{flux[wrong].flat[0]:g} W/m²"
            )
        if not 0.0 <= self.margin <= 0.5:
            raise InputError(
                f"flux limit: the margin must be between 0 and 0.5, not {self.margin:g}"
            )

    @property
    def unit_hint(self) -> str:
        """What to do about a map whose values are probably in kW/m²; "" for other limits."""
        most = float(as_float(self.flux).max())
        if np.ndim(self.flux) == 0 or most >= UNUSUAL:
            return ""
        return (
            f"no cell's limit is above {most:,.0f} W/m², which is very low; if the numbers were "
            "meant as kW/m², multiply them by 1,000"
        )

    @classmethod
    def of(cls, limit: "FluxLimit | npt.ArrayLike") -> "FluxLimit":
        """Return a limit from a number or a map, W/m²."""
        if isinstance(limit, FluxLimit):
            return limit
        try:
            flux = as_float(limit)
        except (TypeError, ValueError):
            raise InputError(
                "flux limit: pass a number in W/m², or an array with rows and columns"
            ) from None
        return cls(flux)

    def on(self, rows: int, columns: int) -> FloatArray:
        """Return the allowable flux of each cell minus the margin, W/m², (rows, columns).

        A cell gets the smallest value of the map cells that it overlaps, so that a finer grid never
        allows more.
        """
        flux = as_float(self.flux)
        if flux.ndim == 0:
            return np.full((rows, columns), (1.0 - self.margin) * float(flux))
        for axis, count in enumerate((rows, columns)):
            flux = _least(flux, axis, count)
        return as_float((1.0 - self.margin) * flux)


def _least(flux: FloatArray, axis: int, count: int) -> FloatArray:
    """Return the minimum over the cells that each of ``count`` equal parts of an axis overlaps."""
    given = flux.shape[axis]
    parts = np.arange(count)
    first = parts * given // count
    last = -(-(parts + 1) * given // count)
    lines = [
        flux.take(range(a, b), axis=axis).min(axis=axis) for a, b in zip(first, last, strict=True)
    ]
    return np.stack(lines, axis=axis)


def read_limit(path: str | Path, margin: float = 0.0) -> FluxLimit:
    """Return the limit in a CSV file of numbers, W/m², one line per row of cells.

    Parameters
    ----------
    path
        File without a header, with the highest row of cells first, as seen in front of the
        receiver. The columns are ordered like the columns of the receiver: to the right, or
        clockwise around a cylinder from the north.
    margin
        As for `FluxLimit`.

    Raises
    ------
    FormatError
        If the file is not a table of numbers, a number is out of range, or its lines differ in
        length.
    """
    rows: list[list[float]] = []
    for number, line in enumerate(read_text(path, "a flux map").splitlines(), start=1):
        # Spreadsheets append commas to short lines.
        cells = [cell.strip() for cell in line.strip().rstrip(",").split(",")]
        if cells == [""]:
            continue
        rows.append([_flux(path, cell, number, k) for k, cell in enumerate(cells, start=1)])
        if len(rows[-1]) != len(rows[0]):
            raise FormatError(
                path, (
                    f"this row has {len(cells)} numbers, but earlier rows have {len(rows[0])}; "
                    "make all rows equally long"
                ),
                where=f"line {number}",
            )  # fmt: skip
    if not rows:
        raise FormatError(path, "the file contains no numbers; enter W/m², one line per row")
    return FluxLimit(np.array(rows[::-1]), margin)


def _flux(path: str | Path, cell: str, line: int, column: int) -> float:
    """Return the allowable flux in one cell of a file."""
    where = f"line {line}, column {column}"
    if not cell:
        raise FormatError(path, "the cell is empty; enter W/m²", where=where)
    try:
        flux = float(cell)
    except ValueError:
        raise FormatError(
            path, (
                f"{shown(cell)} is not a number; separate numbers in W/m² by commas, write decimal "
                "points, and omit headers"
            ),
            where=f"line {line}",
        ) from None  # fmt: skip
    if not 0.0 < flux <= MOST:
        what = f"the flux must be above 0 and at most {MOST:g} W/m², not {flux:g} W/m²"
        raise FormatError(path, what, where=where)
    return flux


def write_limit(path: str | Path, limit: FluxLimit) -> None:
    """Write a limit's map in the format of `read_limit`; the margin is not written."""
    flux = np.atleast_2d(as_float(limit.flux))[::-1]
    write_text(path, "".join(",".join(repr(float(x)) for x in row) + "\n" for row in flux))
