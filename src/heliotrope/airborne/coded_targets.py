"""Coded targets on the ground, with which photogrammetry locates the drone (appendix A).

A target is a black square with a pattern that encodes its number (OpenCV's ArUco, dictionary 4×4,
250 numbers), on a white sheet whose margin is one cell wide. Its four outer corners are measured in
the photographs; the position of the target need not be known.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

#: Number of different targets, and cells across the black square.
NUMBERS, CELLS = 250, 6
#: Width of the white margin of the sheet, cells.
MARGIN = 1


@dataclass(frozen=True)
class CodedTarget:
    """A target and its position.

    Attributes
    ----------
    number
        Number of the target, 0 to 249.
    corners
        Corners of the black square, ENU metres: upper left, upper right, lower right, lower left
        of the pattern, (4, 3).
    """

    number: int
    corners: FloatArray

    def at(self, u: npt.ArrayLike, v: npt.ArrayLike) -> FloatArray:
        """Return points of the sheet, (..., 3), at cells right and down of its top left corner."""
        a, b = as_float(u)[..., None] / CELLS, as_float(v)[..., None] / CELLS
        start = self.corners[0]
        right, down = self.corners[1] - start, self.corners[3] - start
        return as_float(start + a * right + b * down)


@lru_cache(maxsize=NUMBERS)
def white_cells(number: int) -> npt.NDArray[np.bool_]:
    """Return a mask of the white cells of the black square, (CELLS, CELLS), rows from the top.

    Raises
    ------
    InputError
        If there is no target with that number.
    """
    import cv2

    if not 0 <= number < NUMBERS:
        raise InputError(f"target {number}: numbers run from 0 to {NUMBERS - 1}")
    codes = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    return np.asarray(cv2.aruco.generateImageMarker(codes, number, CELLS) > 127)


def square_target(
    number: int, center: npt.ArrayLike, side: float, right: npt.ArrayLike, down: npt.ArrayLike
) -> CodedTarget:
    """Return a target with sides of ``side`` m along unit vectors (3,), centred at ``center``."""
    half = 0.5 * side
    x, y = half * as_float(right), half * as_float(down)
    return CodedTarget(number, as_float(center) + np.stack([-x - y, x - y, x + y, y - x]))


def target_sheet(number: int, side_mm: float) -> str:
    """Return a printable sheet as SVG, in mm, whose black square has sides of ``side_mm``."""
    cell = side_mm / CELLS
    whole = side_mm + 2 * MARGIN * cell
    rows, columns = np.nonzero(white_cells(number))
    cells = "".join(
        f'<rect x="{(MARGIN + c) * cell:.3f}" y="{(MARGIN + r) * cell:.3f}" width="{cell:.3f}" '
        f'height="{cell:.3f}" fill="white"/>\n'
        for r, c in zip(rows.tolist(), columns.tolist(), strict=True)
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{whole:.3f}mm" height="{whole:.3f}mm" '
        f'viewBox="0 0 {whole:.3f} {whole:.3f}" shape-rendering="crispEdges">\n'
        f'<rect width="{whole:.3f}" height="{whole:.3f}" fill="white"/>\n'
        f'<rect x="{cell:.3f}" y="{cell:.3f}" width="{side_mm:.3f}" height="{side_mm:.3f}"/>\n'
        f"{cells}"
        f'<text x="{cell:.3f}" y="{whole - 0.3 * cell:.3f}" font-size="{0.5 * cell:.3f}">'
        f"{number}</text>\n</svg>\n"
    )
