"""Find straight shadow edges across a face, and refine them in a background fit.

Positions are columns and rows from the middle of the grid on which backgrounds are fitted; rows run
downwards.
"""

from dataclasses import dataclass, replace

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.rectify import Mask

#: Distance to either side of a line at which brightness is compared, cells.
_ARM = 2.0
#: Steps between the directions (rad) and between the offsets (cells) of trial lines.
_TURN, _SHIFT = np.radians(5.0), 1.0
#: Minimum visible length of a line, cells.
_LENGTH = 12
#: Minimum change of brightness: relative to the face, and to the median of all lines.
_CHANGE, _ABOVE = 0.02, 5.0
#: At one end of a line at least, the change must agree with the rest of the line to this fraction.
_ALIKE = 0.25
#: Maximum rotation (rad), shift (cells) and relative widening of an edge in one step of the fit.
_STEP = np.array([0.06, 1.5, 0.5])


@dataclass(frozen=True)
class Edge:
    """An edge between two levels of brightness.

    Attributes
    ----------
    angle
        Angle of the edge's normal, clockwise from the right, rad.
    offset
        Distance along the normal from the middle of the grid, cells.
    breadth
        Standard deviation of the edge's blur, cells.
    height
        Approximate rise of brightness across the edge.
    """

    angle: float
    offset: float
    breadth: float = 1.0
    height: float = 0.0

    def distance(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the signed distances of positions from the edge, positive beyond it, cells."""
        return np.asarray(x * np.cos(self.angle) + y * np.sin(self.angle) - self.offset)

    def step(self, x: FloatArray, y: FloatArray, breadth: float | None = None) -> FloatArray:
        """Return a smooth step: 0 before the edge, 1 beyond it."""
        from scipy.special import ndtr

        soft = self.breadth if breadth is None else breadth
        return np.asarray(ndtr(self.distance(x, y) / soft))

    def columns(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return the step, the step times x and times y, and the step's derivatives, (..., 6).

        The derivatives are with respect to angle, offset and the logarithm of the breadth.
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
        """Return the edge moved by the six coefficients fitted to its `columns`."""
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
        """Return whether unexplained pixels lie at the face's border near both ends of the edge."""
        x, y = places((odd.shape[0], odd.shape[1]))
        ends = border(paint) & (np.abs(self.distance(x, y)) < near + self.breadth)
        along = y * np.cos(self.angle) - x * np.sin(self.angle)
        if not ends.any():
            return False
        middle = 0.5 * (along[ends].min() + along[ends].max())
        return all(int(odd[ends & side].sum()) >= 2 for side in (along < middle, along >= middle))


def border(paint: Mask) -> Mask:
    """Return a mask of the outermost three rows and columns of the paint."""
    rows, columns = np.flatnonzero(paint.any(axis=1)), np.flatnonzero(paint.any(axis=0))
    rim = paint.copy()
    rim[rows[0] + 3 : rows[-1] - 2, columns[0] + 3 : columns[-1] - 2] = False
    return rim


def prior(level: float) -> FloatArray:
    """Return the prior precision of an edge's six parameters, by the brightness of the face."""
    height = 0.5 * level
    deviation = np.array([height, 0.1 * level, 0.1 * level, 0.1 * height, height, height])
    return np.asarray(1.0 / np.maximum(deviation, 1e-4) ** 2)


def places(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return the columns and rows of a grid, counted from its middle, (H, W) each."""
    rows, columns = shape
    y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
    return x - 0.5 * (columns - 1), y - 0.5 * (rows - 1)


def find_edges(soft: FloatArray, paint: Mask, most: int = 3) -> list[Edge]:
    """Return straight lines with a uniform change of brightness across them, the best first.

    Along a shadow's edge the change is uniform, so its quartiles agree. The flank of a beam, in
    contrast, is curved and ends within the face.

    Parameters
    ----------
    soft
        Brightness, (H, W).
    paint
        Mask of bare paint.
    most
        Maximum number of lines.
    """
    rows, columns = soft.shape
    reach = 0.5 * float(np.hypot(rows, columns))
    angles = np.arange(0.0, np.pi, _TURN)
    offsets = np.arange(-reach, reach + 0.5 * _SHIFT, _SHIFT)
    level = max(float(np.median(soft[paint])), 1e-6)
    size = np.abs(_changes(soft, paint, angles, offsets, 2.0))
    limit = max(_CHANGE * level, _ABOVE * float(np.median(size)))
    edges: list[Edge] = []
    while len(edges) < most and size.max() > limit:
        a, o = np.unravel_index(int(np.argmax(size)), size.shape)
        edges.append(_nearer(soft, paint, float(angles[a]), float(offsets[o])))
        turn = np.abs((angles - angles[a] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)[:, None]
        # Beyond half a turn, the offset of a line changes sign.
        same = np.where(np.abs(angles - angles[a]) < 0.5 * np.pi, 1.0, -1.0)[:, None]
        shift = np.abs(same * offsets[None, :] - offsets[o])
        size = np.where((turn < 4.5 * _TURN) & (shift < 8.0), 0.0, size)
    return edges


def _nearer(soft: FloatArray, paint: Mask, angle: float, offset: float) -> Edge:
    angles = angle + np.linspace(-_TURN, _TURN, 9)
    offsets = offset + np.linspace(-2.0, 2.0, 9)
    changes = _changes(soft, paint, angles, offsets, 1.0)
    a, o = np.unravel_index(int(np.argmax(np.abs(changes))), changes.shape)
    return Edge(float(angles[a]), float(offsets[o]), 1.0, float(changes[a, o]))


def _changes(
    soft: FloatArray, paint: Mask, angles: FloatArray, offsets: FloatArray, apart: float
) -> FloatArray:
    """Return the changes of brightness across lines, (A, O); 0 where they are not uniform.

    The score is the midpoint of the shortest range containing half of a line's changes, minus the
    width of that range, and is reduced for short lines.
    """
    difference = _differences(soft, paint, angles, offsets, apart)
    known = np.isfinite(difference)
    count, samples = known.sum(axis=1), difference.shape[1]
    rows = np.arange(len(count))
    first, last = known.argmax(axis=1), samples - 1 - known[:, ::-1].argmax(axis=1)
    three = np.arange(3)
    ends = [
        np.median(difference[rows[:, None], np.clip(at, 0, samples - 1)], axis=1)
        for at in (first[:, None] + three, last[:, None] - three)
    ]
    difference.sort(axis=1)  # NaN last
    half = np.maximum(count // 2, 1)
    upper = np.minimum(np.arange(samples) + half[:, None], samples - 1)
    ranges = np.take_along_axis(difference, upper, axis=1) - difference
    ranges[np.arange(samples) + half[:, None] >= count[:, None]] = np.inf
    best = ranges.argmin(axis=1)
    width = ranges[rows, best]
    middle = 0.5 * (difference[rows, best] + difference[rows, upper[rows, best]])
    size = np.abs(middle)
    # A beam's flank ends within the face, whereas at least one end of a shadow is free of beams.
    even = np.zeros(len(count), dtype=bool)
    for end in ends:
        even |= np.abs(end - middle) < _ALIKE * size
    even &= (count * apart >= _LENGTH) & np.isfinite(width)
    length = np.minimum(count * apart / min(soft.shape), 1.0)
    score = np.sign(middle) * np.maximum(size - width, 0.0) * length
    changes = np.where(even, score, 0.0)
    return np.asarray(changes, dtype=np.float64).reshape(len(angles), len(offsets))


def _differences(
    soft: FloatArray, paint: Mask, angles: FloatArray, offsets: FloatArray, apart: float
) -> FloatArray:
    """Return changes of brightness along each line, (A · O, T); NaN outside the paint."""
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
        sampled = cv2.remap(
            known,
            x.reshape(flat).astype(np.float32),
            y.reshape(flat).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=float("nan"),
        )
        return np.asarray(sampled)

    return np.asarray(at(_ARM) - at(-_ARM))
