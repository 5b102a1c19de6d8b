"""Detect coded targets in photographs; OpenCV reads the numbers, edge fits locate the corners."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.coded_targets import NUMBERS
from heliotrope.airborne.evaluate.detection import Picture, decode, find_outlines
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.errors import HeliotropeError
from heliotrope.geometry import FloatArray, as_float

#: Shortest side of a target, px; the profile of an edge must fit across its black border.
SMALLEST = 24.0
#: Largest distance of an edge from where OpenCV located it, px, in the first and in the second fit.
_REACHES = (2.0, 1.0)
#: Corner error in addition to that of the edges, px.
_FLOOR = 0.03


@dataclass(frozen=True)
class SeenTargets:
    """Targets in one photograph.

    Attributes
    ----------
    number
        (T,).
    corners
        Pixels, in the order of `heliotrope.airborne.coded_targets.CodedTarget`, (T, 4, 2).
    sigma
        Standard deviation of a corner in each direction, px, (T,).
    problem
        Why there are no targets; an empty string if there are some.
    """

    number: npt.NDArray[np.intp]
    corners: FloatArray
    sigma: FloatArray
    problem: str = ""


def find_targets(picture: Picture) -> SeenTargets:
    """Return the targets in a picture with the channels blue, green, red."""
    import cv2

    finder = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250), cv2.aruco.DetectorParameters()
    )
    squares, numbers, _ = finder.detectMarkers(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
    if not len(squares):
        return _none("there is no coded target in it")
    corners = as_float(np.stack(squares)).reshape(-1, 4, 2)
    number = np.asarray(numbers, dtype=np.intp).reshape(-1)
    # If a number is read twice, one of the two targets is false, and it is unknown which.
    once = np.bincount(number, minlength=NUMBERS)[number] == 1
    large = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).min(axis=1) >= SMALLEST
    number, corners = number[once & large], corners[once & large]
    sigma = np.ones(len(number))
    for reach in _REACHES:
        lines = find_outlines(picture, corners, reach, printed=True)
        good = lines.found
        number, corners, sigma = number[good], lines.corners[good], lines.sigma[good]
    if not len(number):
        return _none(
            f"its coded targets are smaller than {SMALLEST:.0f} px or have no straight edges; fly "
            "closer, or print them larger"
        )
    return SeenTargets(number, corners, np.hypot(sigma, _FLOOR))


def read_targets(photos: Sequence[Photo], camera: LedCamera) -> tuple[SeenTargets, ...]:
    """Return the targets in the files of photographs, in the order of the photographs."""
    return tuple(_read(photo, camera) for photo in photos)


def _read(photo: Photo, camera: LedCamera) -> SeenTargets:
    if photo.path is None:
        return _none("no such file")
    try:
        picture = decode(photo.path)
    except HeliotropeError as error:
        return _none(str(error))
    height, width = picture.shape[:2]
    if (width, height) != camera.size:
        return _none(
            f"{width} × {height} px, but the camera file says {camera.size[0]} × {camera.size[1]} "
            "px; use the file of this camera"
        )
    return find_targets(picture)


def _none(problem: str) -> SeenTargets:
    return SeenTargets(np.empty(0, np.intp), np.empty((0, 4, 2)), np.empty(0), problem)
