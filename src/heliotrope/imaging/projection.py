"""Pinhole and lens: points to pixels and back, by OpenCV."""

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.geometry import FloatArray, as_vectors, normalize


def project(camera: Camera, points: npt.ArrayLike) -> FloatArray:
    """Return where points are seen, pixels (..., 2); NaN behind the camera.

    Parameters
    ----------
    camera
        With its position and rotation.
    points
        ENU metres, (..., 3).

    Raises
    ------
    InputError
        If nobody knows where the camera stands.
    """
    import cv2

    position, rotation = _pose(camera)
    given = as_vectors(points, "points")
    local = (given.reshape(-1, 3) - position) @ rotation.T
    front = local[:, 2] > 1e-9
    safe = np.where(front[:, None], local, [0.0, 0.0, 1.0])
    zero = np.zeros(3)
    if len(safe) == 0:
        return np.empty((*given.shape[:-1], 2))
    pixels, _ = cv2.projectPoints(safe, zero, zero, camera.matrix, camera.distortion)
    seen = np.where(front[:, None], pixels.reshape(-1, 2), np.nan)
    return np.asarray(seen.reshape(*given.shape[:-1], 2))


def undistort(camera: Camera, pixels: npt.ArrayLike) -> FloatArray:
    """Return normalised places x/z, y/z (..., 2) of pixels (..., 2), without distortion."""
    import cv2

    given = np.asarray(pixels, dtype=np.float64)
    flat = given.reshape(-1, 1, 2)
    if len(flat) == 0:
        return np.empty(given.shape)
    # Brown's series has no closed inverse; the iteration ends below a thousandth of a pixel.
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
    found = cv2.undistortPoints(flat, camera.matrix, camera.distortion, criteria=end)
    return np.asarray(found, dtype=np.float64).reshape(given.shape)


def rays(camera: Camera, pixels: npt.ArrayLike) -> FloatArray:
    """Return unit directions, ENU (..., 3), that pixels (..., 2) look along.

    Raises
    ------
    InputError
        If nobody knows how the camera stands.
    """
    _, rotation = _pose(camera)
    plane = undistort(camera, pixels)
    ahead = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
    return normalize(ahead @ rotation)


def _pose(camera: Camera) -> tuple[FloatArray, FloatArray]:
    if camera.position is None or camera.R_camera_enu is None:
        raise InputError(
            f"camera {camera.name}: where it stands is not known; find its targets in a frame "
            "first (heliotrope camera calibrate)"
        )
    return camera.position, camera.R_camera_enu


def look_at(position: npt.ArrayLike, point: npt.ArrayLike) -> FloatArray:
    """Return R_camera_enu (3, 3) of an upright camera at ``position`` that looks at ``point``."""
    forward = normalize(np.asarray(point, dtype=np.float64) - np.asarray(position))
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    right = normalize(right)
    return np.stack([right, np.cross(forward, right), forward])
