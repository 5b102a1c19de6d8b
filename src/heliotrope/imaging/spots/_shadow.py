"""The straight edge of a shadow across a face: found, and followed while a background is fitted.

Places are those of the grid that backgrounds are fitted on: columns and rows from its middle,
rows downwards.
"""

from dataclasses import dataclass, replace

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.rectify import Mask

#: Brightness is compared across a line over so many cells to either side.
_ARM = 2.0
#: Directions and shifts of lines that are tried: rad and cells apart.
_TURN, _SHIFT = np.radians(5.0), 1.0
#: A line must be seen over so many cells.
_LENGTH = 12
#: Brightness must change by this part of the face's, and so many times what other lines have.
_CHANGE, _ABOVE = 0.02, 5.0
#: At one end of a line it must change by as much as elsewhere, to this part.
_ALIKE = 0.25
#: What one step of the fit may turn, shift and widen an edge by: rad, cells, and relative.
_STEP = np.array([0.06, 1.5, 0.5])


@dataclass(frozen=True)
class Edge:
    """A border between two brightnesses.

    Attributes
    ----------
    angle
        Of its normal, clockwise from the right, rad.
    offset
        Of it along the normal, from the middle, cells.
    breadth
        Standard deviation of what softens it, cells.
    height
        By how much brightness rises across it, about.
    """

    angle: float
    offset: float
    breadth: float = 1.0
    height: float = 0.0

    def distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return how far beyond it places are, cells."""
        return np.asarray(x * np.cos(self.angle) + y * np.sin(self.angle) - self.offset)

    def step(self, x: FloatArray, y: FloatArray, breadth: float | None = None) -> FloatArray:
        """Return 0 on this side of it, 1 beyond, and what is between."""
        from scipy.special import ndtr

        soft = self.breadth if breadth is None else breadth
        return np.asarray(ndtr(self.distance(x, y) / soft))

    def columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the step, the step along x and y, and its derivatives, (..., 6).

        The derivatives are by angle, offset and the breadth's logarithm.
        """
        far = self.distance(x, y) / self.breadth
        bell = np.exp(-0.5 * far**2) / (np.sqrt(2.0 * np.pi) * self.breadth)
        across = y * np.cos(self.angle) - x * np.sin(self.angle)
        step = self.step(x, y)
        half = 0.5 * max(float(np.ptp(x)), 1.0)
        return np.stack(
            [
                step,
                step * x / half,
                step * y / half,
                bell * across,
                -bell,
                -bell * far * self.breadth,
            ],
            axis=-1,
        )

    def moved(self, numbers: FloatArray) -> "Edge":
        """Return where it is after a fit gave its six columns these numbers."""
        height = numbers[0]
        if abs(height) < 1e-9:
            return self
        turn, shift, wider = np.clip(numbers[3:] / height, -_STEP, _STEP)
        return replace(
            self,
            angle=self.angle + float(turn),
            offset=self.offset + float(shift),
            breadth=float(np.clip(self.breadth * np.exp(wider), 0.3, 8.0)),
        )

    def crosses(self, odd: Mask, paint: Mask, near: float = 6.0) -> bool:
        """Return whether something odd is near both of its ends, at the face's border."""
        x, y = places((odd.shape[0], odd.shape[1]))
        ends = border(paint) & (np.abs(self.distance(x, y)) < near + self.breadth)
        along = y * np.cos(self.angle) - x * np.sin(self.angle)
        if not ends.any():
            return False
        middle = 0.5 * (along[ends].min() + along[ends].max())
        return all(int(odd[ends & side].sum()) >= 2 for side in (along < middle, along >= middle))


def border(paint: Mask) -> Mask:
    """Return what of the paint is among its outermost three rows and columns."""
    rows, columns = np.flatnonzero(paint.any(axis=1)), np.flatnonzero(paint.any(axis=0))
    rim = paint.copy()
    rim[rows[0] + 3 : rows[-1] - 2, columns[0] + 3 : columns[-1] - 2] = False
    return rim


def prior(level: float) -> FloatArray:
    """Return the precision of the six numbers of an edge's columns on a face of brightness."""
    height = 0.5 * level
    deviation = np.array([height, 0.1 * level, 0.1 * level, 0.1 * height, height, height])
    return np.asarray(1.0 / np.maximum(deviation, 1e-4) ** 2)


def places(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return columns and rows of a grid from its middle, (H, W) each."""
    rows, columns = shape
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    return x - 0.5 * (columns - 1), y - 0.5 * (rows - 1)


def find_edges(soft: FloatArray, paint: Mask, most: int = 3) -> list[Edge]:
    """Return straight lines across which brightness changes all along, the likeliest first.

    Along the edge of a shadow brightness changes by as much everywhere: the lower and the
    upper quarter of the changes agree. A beam's flank is bent, and ends.

    Parameters
    ----------
    soft
        Brightness, (H, W).
    paint
        Where it is that of bare paint.
    most
        How many lines at most.
    """
    rows, columns = soft.shape
    reach = 0.5 * float(np.hypot(rows, columns))
    angles = np.arange(0.0, np.pi, _TURN)
    offsets = np.arange(-reach, reach + 0.5 * _SHIFT, _SHIFT)
    level = max(float(np.median(soft[paint])), 1e-6)
    size = np.abs(_changes(soft, paint, angles, offsets, 2.0))
    limit = max(_CHANGE * level, _ABOVE * float(np.median(size)))
    found: list[Edge] = []
    while len(found) < most and size.max() > limit:
        a, o = np.unravel_index(int(np.argmax(size)), size.shape)
        found.append(_nearer(soft, paint, float(angles[a]), float(offsets[o])))
        turn = np.abs((angles - angles[a] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)[:, None]
        # Turned past half a circle, a line's offset changes its sign.
        same = np.where(np.abs(angles - angles[a]) < 0.5 * np.pi, 1.0, -1.0)[:, None]
        shift = np.abs(same * offsets[None, :] - offsets[o])
        size = np.where((turn < 4.5 * _TURN) & (shift < 8.0), 0.0, size)
    return found


def _nearer(soft: FloatArray, paint: Mask, angle: float, offset: float) -> Edge:
    angles = angle + np.linspace(-_TURN, _TURN, 9)
    offsets = offset + np.linspace(-2.0, 2.0, 9)
    changes = _changes(soft, paint, angles, offsets, 1.0)
    a, o = np.unravel_index(int(np.argmax(np.abs(changes))), changes.shape)
    return Edge(float(angles[a]), float(offsets[o]), 1.0, float(changes[a, o]))


def _changes(
    soft: FloatArray, paint: Mask, angles: FloatArray, offsets: FloatArray, apart: float
) -> FloatArray:
    """By how much brightness changes across lines, (A, O); 0 where it changes unevenly.

    It is the middle of the shortest range that holds half of a line's changes, less that
    range, and less the shorter the line is.
    """
    difference = _differences(soft, paint, angles, offsets, apart)
    there = np.isfinite(difference)
    count, samples = there.sum(axis=1), difference.shape[1]
    each = np.arange(len(count))
    first, last = there.argmax(axis=1), samples - 1 - there[:, ::-1].argmax(axis=1)
    three = np.arange(3)
    ends = [
        np.median(difference[each[:, None], np.clip(at, 0, samples - 1)], axis=1)
        for at in (first[:, None] + three, last[:, None] - three)
    ]
    difference.sort(axis=1)  # the unknown ones last
    half = np.maximum(count // 2, 1)
    upper = np.minimum(np.arange(samples) + half[:, None], samples - 1)
    ranges = np.take_along_axis(difference, upper, axis=1) - difference
    ranges[np.arange(samples) + half[:, None] >= count[:, None]] = np.inf
    best = ranges.argmin(axis=1)
    width = ranges[each, best]
    middle = 0.5 * (difference[each, best] + difference[each, upper[each, best]])
    size = np.abs(middle)
    # A beam's flank ends before the face does; at one of a shadow's ends at least there is
    # no beam.
    even = np.zeros(len(count), dtype=bool)
    for end in ends:
        even |= np.abs(end - middle) < _ALIKE * size
    even &= (count * apart >= _LENGTH) & np.isfinite(width)
    length = np.minimum(count * apart / min(soft.shape), 1.0)
    score = np.sign(middle) * np.maximum(size - width, 0.0) * length
    found = np.where(even, score, 0.0)
    return np.asarray(found, dtype=np.float64).reshape(len(angles), len(offsets))


def _differences(
    soft: FloatArray, paint: Mask, angles: FloatArray, offsets: FloatArray, apart: float
) -> FloatArray:
    """Changes of brightness across lines along each, (A · O, T); NaN beyond the paint."""
    import cv2

    rows, columns = soft.shape
    known: Image = np.where(paint, soft, np.nan).astype(np.float32)
    reach = 0.5 * float(np.hypot(rows, columns))
    along = np.arange(-reach, reach + apart, apart)
    cos, sin = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    flat = (len(angles) * len(offsets), len(along))

    def at(shift: float) -> Image:
        far = offsets[None, :, None] + shift
        x = far * cos - along * sin + 0.5 * (columns - 1)
        y = far * sin + along * cos + 0.5 * (rows - 1)
        seen = cv2.remap(
            known,
            x.reshape(flat).astype(np.float32),
            y.reshape(flat).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float("nan"),
        )
        return np.asarray(seen)

    return np.asarray(at(_ARM) - at(-_ARM))
