"""Pinhole and lens of a camera that flies: points to pixels and back, by OpenCV."""

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.photo import LedCamera
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize

#: Directions farther out than this multiple of the frame's corners are not in view: there
#: Brown's series may fold back into the frame.
FARTHEST = 1.3


def project(
    camera: LedCamera, position: npt.ArrayLike, rotation: npt.ArrayLike, points: npt.ArrayLike
) -> FloatArray:
    """Return where points are seen, pixels (..., 2); NaN behind the camera or far outside.

    Parameters
    ----------
    camera
        Lens.
    position, rotation
        Of the camera: ENU metres (3,), camera axes to ENU (3, 3).
    points
        ENU metres, (..., 3).
    """
    given = as_vectors(points, "points")
    local = (given - as_float(position)) @ as_float(rotation)
    return local_pixels(camera, local)


def local_pixels(camera: LedCamera, local: npt.ArrayLike) -> FloatArray:
    """Return pixels (..., 2) of points in camera axes (..., 3); NaN as :func:`project`."""
    points = as_float(local)
    pixels, _ = _by_opencv(camera, points.reshape(-1, 3))
    return as_float(pixels.reshape(*points.shape[:-1], 2))


def pixels_and_derivative(camera: LedCamera, local: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return pixels (N, 2) of points in camera axes (N, 3), and their derivatives (N, 2, 3)."""
    return _by_opencv(camera, as_float(local))


def _by_opencv(camera: LedCamera, local: FloatArray) -> tuple[FloatArray, FloatArray]:
    import cv2

    count = len(local)
    if count == 0:
        return np.empty((0, 2)), np.empty((0, 2, 3))
    depth = local[:, 2]
    ahead = depth > 1e-6
    seen = np.zeros(count, np.bool_)
    limit = FARTHEST * _corner_radius(camera)
    seen[ahead] = np.hypot(*(local[ahead, :2] / depth[ahead, None]).T) <= limit
    safe = np.where(seen[:, None], local, [0.0, 0.0, 1.0])
    zero = np.zeros(3)
    pixels, jacobian = cv2.projectPoints(safe, zero, zero, camera.matrix, camera.distortion)
    # Columns 3 to 5 are by the translation, which moves points in camera axes.
    slope = jacobian[:, 3:6].reshape(count, 2, 3)
    flat = np.where(seen[:, None], pixels.reshape(count, 2), np.nan)
    return as_float(flat), as_float(slope)


def _corner_radius(camera: LedCamera) -> float:
    """Return the tangent of the angle of the frame's farthest corner without distortion."""
    width, height = camera.size
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) - camera.matrix[:2, 2]
    plain = corners / np.array([camera.matrix[0, 0], camera.matrix[1, 1]])
    return float(np.hypot(*plain.T).max())


def undistort(camera: LedCamera, pixels: npt.ArrayLike) -> FloatArray:
    """Return normalised places x/z, y/z (..., 2) of pixels (..., 2), without distortion."""
    import cv2

    given = as_float(pixels)
    flat = np.ascontiguousarray(given).reshape(-1, 1, 2)
    if len(flat) == 0:
        return np.empty(given.shape)
    # Brown's series has no closed inverse; the iteration ends below a thousandth of a pixel.
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
    found = cv2.undistortPoints(flat, camera.matrix, camera.distortion, criteria=end)
    return as_float(found).reshape(given.shape)


def rays(camera: LedCamera, rotation: npt.ArrayLike, pixels: npt.ArrayLike) -> FloatArray:
    """Return unit directions in ENU, (..., 3), that pixels (..., 2) look along."""
    plane = undistort(camera, pixels)
    ahead = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1)
    return normalize(ahead @ as_float(rotation).T)
