"""The camera model: a pinhole camera with lens distortion and a pose in ENU.

One convention serves target cameras and drones. Camera axes are x right, y down, z forward.
``R_enu_camera`` rotates them into ENU, so its columns are the camera axes and

    point = position + R_enu_camera @ local

A point ``local`` appears at the normalised coordinates ``(x/z, y/z)``, which the lens distorts
(Brown and Conrady: k1, k2, p1, p2, k3) and ``matrix`` maps to pixels. The centre of the first pixel
is (0, 0). OpenCV inverts the distortion; it is imported on first use.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize

#: Smallest depth in front of a camera at which a point counts as seen, m.
_NEAREST = 1e-6
#: Number of points along each side of the frame's border and of steps along a ray at which a lens
#: is checked for folding; and the reach of the steps, in tangents of the angle to the farthest
#: corner without distortion.
_PER_SIDE, _STEPS, _FARTHEST = 4, 2000, 20.0


class Pinhole(Protocol):
    """Any object with a frame size (px), a camera matrix (3, 3) and a distortion (5,)."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of a frame, px."""

    @property
    def matrix(self) -> FloatArray:
        """Focal lengths and principal point, px, (3, 3)."""

    @property
    def distortion(self) -> FloatArray:
        """Distortion coefficients k1, k2, p1, p2, k3, (5,)."""


@dataclass(frozen=True)
class Camera:
    """A camera that observes targets.

    Attributes
    ----------
    name
        Unique in the plant.
    size
        Width and height of a frame, px.
    matrix
        Focal lengths and principal point, px, (3, 3).
    distortion
        Distortion coefficients k1, k2, p1, p2, k3, (5,).
    position
        Position, ENU, m, (3,); None until the camera has been located.
    R_enu_camera
        Camera axes to ENU, (3, 3): columns right, down, forward; None with ``position``.
    targets
        Names of the targets in view; () means any target.
    source
        Source of frames: a folder, a video, a network address or a device.
    deviation
        RMS residual of the calibration, px; 0 if it was never calibrated.
    """

    name: str
    size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray = field(default_factory=lambda: np.zeros(5))
    position: FloatArray | None = None
    R_enu_camera: FloatArray | None = None
    targets: tuple[str, ...] = ()
    source: str = ""
    deviation: float = 0.0

    def __post_init__(self) -> None:
        name = f"camera {self.name}"
        size, matrix, distortion = checked_pinhole(name, self)
        if (self.position is None) != (self.R_enu_camera is None):
            raise InputError(f"{name}: specify position and rotation together, or neither")
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        if self.position is not None and self.R_enu_camera is not None:
            position, turned = checked_pose(name, self.position, self.R_enu_camera)
            object.__setattr__(self, "position", position)
            object.__setattr__(self, "R_enu_camera", turned)

    @property
    def pose(self) -> tuple[FloatArray, FloatArray]:
        """Position (3,), ENU metres, and ``R_enu_camera`` (3, 3).

        Raises
        ------
        InputError
            If the camera has not been located.
        """
        if self.position is None or self.R_enu_camera is None:
            raise InputError(
                f"camera {self.name}: its position is unknown; locate its targets in a frame "
                "first (heliotrope camera calibrate)"
            )
        return self.position, self.R_enu_camera


def checked_pinhole(
    name: str, camera: Pinhole, smallest: int = 1
) -> tuple[tuple[int, int], FloatArray, FloatArray]:
    """Return the checked size, matrix and distortion of a camera.

    Raises
    ------
    InputError
        If a side of the frame is not between ``smallest`` and 100,000 px, the matrix is not (3, 3),
        finite and with positive focal lengths, or the distortion is not five finite numbers.
    """
    width, height = (int(n) for n in camera.size)
    if not (smallest <= width <= 100_000 and smallest <= height <= 100_000):
        raise InputError(
            f"{name}: frames must measure {smallest} to 100000 px in each direction, not {width} "
            f"× {height} px"
        )
    matrix = as_float(camera.matrix)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise InputError(
            f"{name}: matrix must be finite and of shape (3, 3); its shape is {matrix.shape}"
        )
    fx, fy = matrix[0, 0], matrix[1, 1]
    if min(fx, fy) <= 0.0:
        raise InputError(f"{name}: focal lengths must be above 0 px, not {fx} and {fy} px")
    distortion = as_float(camera.distortion)
    if distortion.shape != (5,) or not np.isfinite(distortion).all():
        raise InputError(f"{name}: distortion needs k1, k2, p1, p2, k3, each finite")
    return (width, height), matrix, distortion


def checked_pose(
    name: str, position: npt.ArrayLike, R_enu_camera: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return the checked position (3,) and rotation (3, 3) of a camera.

    Raises
    ------
    InputError
        If a shape is wrong, or the matrix is not a right-handed rotation.
    """
    place, turned = as_vectors(position, f"{name}: position"), as_float(R_enu_camera)
    if place.shape != (3,) or turned.shape != (3, 3):
        raise InputError(f"{name}: needs a position (3,) and a rotation (3, 3)")
    square = turned @ turned.T
    if not np.allclose(square, np.eye(3), atol=1e-6) or np.linalg.det(turned) < 0.0:
        raise InputError(f"{name}: its rotation is not a right-handed rotation")
    return place, turned


def check_unfolded(name: str, camera: Pinhole) -> None:
    """Reject a lens whose polynomial folds inside the frame.

    In a fold, a pixel has two rays or none.

    From the principal point outwards, along rays to the frame's border, the lens must map
    neighbours to neighbours (the determinant of its Jacobian stays above 0) until it has left the
    frame.

    Raises
    ------
    InputError
        If the lens folds inside the frame; the message states the smallest radius at which it
        folds, px.
    """
    if not camera.distortion.any():
        return
    size, center = as_float(camera.size), camera.matrix[:2, 2]
    share = np.arange(_PER_SIDE) / _PER_SIDE
    side = np.stack([share, np.zeros(_PER_SIDE)], axis=-1)
    border = np.concatenate([side, side[:, ::-1] + [1, 0], 1 - side, 1 - side[:, ::-1] - [1, 0]])
    towards = border * (size - 1.0) - center
    towards = towards[np.hypot(*towards.T) > 1.0] / np.diag(camera.matrix)[:2]
    rays = towards / np.hypot(*towards.T)[:, None]
    reach = _FARTHEST * _corner_tangent(camera) / _STEPS * np.arange(1, _STEPS + 1)
    plane = reach[:, None] * rays[:, None]
    pixels = distort(camera, plane)
    folded = _stretch(camera.distortion, plane) <= 0.0
    folded[:, -1] = True
    last = np.argmax(folded, axis=1)
    ends = pixels[np.arange(len(rays)), last]
    inside = ((ends > -0.5) & (ends < size - 0.5)).all(axis=1)
    if inside.any():
        radius = float(np.hypot(*(ends[inside] - center).T).min())
        corners = np.hypot(*(border * (size - 1.0) - center).T)
        raise InputError(
            f"{name}: its lens polynomial folds {radius:.0f} px from the principal point, inside "
            f"the frame (farthest corner: {corners.max():.0f} px): pixels beyond have no "
            "direction; calibrate the lens again with pictures that fill the corners (heliotrope "
            "camera calibrate)"
        )


def _stretch(distortion: FloatArray, plane: FloatArray) -> FloatArray:
    """Return the determinant of the distortion's Jacobian at normalised coordinates (..., 2)."""
    x, y = plane[..., 0], plane[..., 1]
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial, slope = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3)
    xx = radial + 2.0 * (x * x * slope + p1 * y + 3.0 * p2 * x)
    yy = radial + 2.0 * (y * y * slope + 3.0 * p1 * y + p2 * x)
    xy = 2.0 * (x * y * slope + p1 * x + p2 * y)
    return as_float(xx * yy - xy * xy)


# -- points to pixels and back ---------------------------------------------------------


def local_pixels(camera: Pinhole, local: npt.ArrayLike, reach: float = np.inf) -> FloatArray:
    """Return the pixels (..., 2) at which points in camera axes (..., 3) appear.

    Parameters
    ----------
    camera
        Frame size, matrix and distortion.
    local
        Points in camera axes, m.
    reach
        Multiple of the undistorted angle to the frame's farthest corner beyond which points
        are not seen. Far outside the frame the distortion's polynomial may fold back into it;
        1.3 keeps such points out.

    Returns
    -------
    NaN for points behind the camera or beyond ``reach``.
    """
    points = as_float(local)
    depth = points[..., 2:]
    ahead = depth > _NEAREST
    plane = np.where(ahead, points[..., :2], np.nan) / np.where(ahead, depth, 1.0)
    if np.isfinite(reach):
        far = np.hypot(plane[..., :1], plane[..., 1:])
        plane = np.where(far <= reach * _corner_tangent(camera), plane, np.nan)
    return distort(camera, plane)


def _corner_tangent(camera: Pinhole) -> float:
    """Return the tangent of the angle to the frame's farthest corner, without distortion."""
    width, height = camera.size
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) - camera.matrix[:2, 2]
    plain = corners / np.diag(camera.matrix)[:2]
    return float(np.hypot(*plain.T).max())


def distort(
    camera: Pinhole, plane: npt.ArrayLike, distortion: Sequence[Any] | None = None
) -> FloatArray:
    """Return the pixels (..., 2) of normalised coordinates x/z, y/z (..., 2) (Brown and Conrady).

    Parameters
    ----------
    camera
        Matrix and distortion.
    plane
        Coordinates without distortion.
    distortion
        Coefficients k1, k2, p1, p2, k3 that replace the camera's, each broadcast with the
        coordinates.
    """
    place, matrix = as_float(plane), camera.matrix
    x, y = place[..., 0], place[..., 1]
    k1, k2, p1, p2, k3 = camera.distortion if distortion is None else distortion
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([matrix[0, 0] * u + matrix[0, 2], matrix[1, 1] * v + matrix[1, 2]], axis=-1)


def project(camera: Camera, points: npt.ArrayLike) -> FloatArray:
    """Return the pixels (..., 2) of points in ENU, m, (..., 3); NaN for points behind the camera.

    Raises
    ------
    InputError
        If the camera has not been located.
    """
    position, R_enu_camera = camera.pose
    return local_pixels(camera, (as_vectors(points, "points") - position) @ R_enu_camera)


def undistort(camera: Pinhole, pixels: npt.ArrayLike) -> FloatArray:
    """Return the undistorted normalised coordinates x/z, y/z of pixels (..., 2), (..., 2)."""
    import cv2

    array = as_float(pixels)
    flat = np.ascontiguousarray(array).reshape(-1, 1, 2)
    if len(flat) == 0:
        return np.empty(array.shape)
    # Brown's series has no closed inverse; the iteration ends below a thousandth of a pixel.
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-10)
    places = cv2.undistortPoints(flat, camera.matrix, camera.distortion, criteria=end)
    return as_float(places).reshape(array.shape)


def local_rays(camera: Pinhole, pixels: npt.ArrayLike) -> FloatArray:
    """Return the unit viewing directions of pixels (..., 2) in camera axes, (..., 3)."""
    plane = undistort(camera, pixels)
    return normalize(np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1))


def rays(camera: Camera, pixels: npt.ArrayLike) -> FloatArray:
    """Return the unit viewing directions of pixels (..., 2) in ENU, (..., 3).

    Raises
    ------
    InputError
        If the camera has not been located.
    """
    _, R_enu_camera = camera.pose
    return local_rays(camera, pixels) @ R_enu_camera.T


def look_at(position: npt.ArrayLike, point: npt.ArrayLike) -> FloatArray:
    """Return R_enu_camera, (3, 3), for a level camera at ``position`` that looks at ``point``.

    If the camera looks straight down or up, its right is east.
    """
    forward = normalize(as_float(point) - as_float(position), "line of sight")
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-9:
        right = np.array([1.0, 0.0, 0.0])
    right = normalize(right)
    return np.stack([right, np.cross(forward, right), forward], axis=-1)
