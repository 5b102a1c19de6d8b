"""Draw marks as dark polygons in the plane of their target, metres."""

import re

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray


def polygons(mark: Mark) -> list[FloatArray]:
    """Return the dark polygons of a mark, (K, 2) each, m right of and above the mark's point.

    Raises
    ------
    InputError
        If the dictionary of a tag is unknown, or the mark is a picture, which has no polygons.
    """
    shapes = _upright(mark)
    cos, sin = np.cos(mark.turn), np.sin(mark.turn)
    turn = np.array([[cos, sin], [-sin, cos]])  # rows times this: counterclockwise
    return [shape @ turn for shape in shapes]


def _upright(mark: Mark) -> list[FloatArray]:
    s, w = mark.size, mark.stroke
    if mark.kind == "corner":
        return [np.array([(0, 0), (s, 0), (s, -w), (w, -w), (w, -s), (0, -s)], dtype=np.float64)]
    if mark.kind == "tee":
        half, stem = 0.5 * s, 0.5 * w
        return [
            np.array(
                [
                    (-half, 0),
                    (half, 0),
                    (half, -w),
                    (stem, -w),
                    (stem, -s),
                    (-stem, -s),
                    (-stem, -w),
                    (-half, -w),
                ]
            )
        ]
    if mark.kind == "square":
        return [_box(-0.5 * s, -0.5 * s, 0.5 * s, 0.5 * s)]
    if mark.kind == "disc":
        angle = np.arange(64) * (2.0 * np.pi / 64)
        return [0.5 * s * np.stack([np.cos(angle), np.sin(angle)], axis=-1)]
    if mark.kind == "tag":
        return _tag(mark)
    raise InputError(f"mark {mark.name}: a {mark.kind} has no polygons")


def _box(left: float, low: float, right: float, high: float) -> FloatArray:
    return np.array([(left, high), (right, high), (right, low), (left, low)])


def _tag(mark: Mark) -> list[FloatArray]:
    """Return a tag's dark cells, joined along each row."""
    cells = tag_cells(mark)
    n = len(cells)
    side = mark.size / n
    shapes = []
    for row in range(n):
        # Runs of dark cells of a row.
        edges = np.flatnonzero(np.diff(np.concatenate([[False], cells[row], [False]])))
        high = 0.5 * mark.size - row * side
        for start, end in zip(edges[::2], edges[1::2], strict=True):
            left = -0.5 * mark.size + start * side
            right = -0.5 * mark.size + end * side
            shapes.append(_box(left, high - side, right, high))
    return shapes


def tag_dictionary(mark: Mark) -> tuple[int, int]:
    """Return OpenCV's number of a tag's dictionary, and the tag's number in that dictionary.

    Raises
    ------
    InputError
        If the code does not name a tag.
    """
    import cv2

    match = re.fullmatch(r"(?:DICT_)?(\w+):(\d+)", mark.code)
    known = sorted(n[5:] for n in dir(cv2.aruco) if n.startswith("DICT_"))
    if not match or match[1] not in known:
        raise InputError(
            f"mark {mark.name}: code {mark.code!r} is not a tag; write for example 4X4_50:7, with "
            f"a dictionary from {', '.join(known)}"
        )
    return int(getattr(cv2.aruco, f"DICT_{match[1]}")), int(match[2])


def tag_cells(mark: Mark) -> FloatArray:
    """Return a mask of the dark cells of a tag, including its border, (N, N)."""
    import cv2

    number, identity = tag_dictionary(mark)
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    if identity >= len(dictionary.bytesList):
        raise InputError(
            f"mark {mark.name}: code {mark.code!r}: the dictionary holds 0 to "
            f"{len(dictionary.bytesList) - 1}"
        )
    n = dictionary.markerSize + 2
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, identity, n) < 128)
