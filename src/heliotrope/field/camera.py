"""Cameras that look at targets: what is known of them."""

from dataclasses import dataclass, field

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_vectors


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a lens that distorts, in the convention of OpenCV.

    A point at ``x = R_camera_enu @ (point - position)``, x right, y down, z forward, is seen
    at the normalised place ``x/z, y/z``, moved by the distortion, then at the pixel that
    ``matrix`` gives. The centre of the first pixel is (0, 0).

    Attributes
    ----------
    name
        Unique in the plant.
    size
        Width and height of a frame, pixels.
    matrix
        Focal lengths and principal point, pixels, (3, 3).
    distortion
        k1, k2, p1, p2, k3 of Brown and Conrady, (5,).
    position
        ENU metres, (3,); None if it is not known where the camera stands.
    R_camera_enu
        Rows are the camera's axes (right, down, forward), (3, 3); None with ``position``.
    targets
        Names of the targets that it sees; none named means any.
    source
        Where frames come from: a folder, a video, an address, a device.
    deviation
        RMS of the calibration's residuals, pixels; 0 if it was never calibrated.
    """

    name: str
    size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray = field(default_factory=lambda: np.zeros(5))
    position: FloatArray | None = None
    R_camera_enu: FloatArray | None = None
    targets: tuple[str, ...] = ()
    source: str = ""
    deviation: float = 0.0

    def __post_init__(self) -> None:
        who = f"camera {self.name}"
        width, height = self.size
        if not (1 <= width <= 100_000 and 1 <= height <= 100_000):
            raise InputError(f"{who}: frames of {width} × {height} px; give 1 to 100000 each")
        matrix = np.asarray(self.matrix, dtype=np.float64)
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise InputError(f"{who}: matrix {matrix.shape} must be (3, 3) and finite")
        if min(matrix[0, 0], matrix[1, 1]) <= 0.0:
            raise InputError(f"{who}: focal lengths {matrix[0, 0]}, {matrix[1, 1]} must be above 0")
        distortion = np.asarray(self.distortion, dtype=np.float64)
        if distortion.shape != (5,) or not np.isfinite(distortion).all():
            raise InputError(f"{who}: distortion needs k1, k2, p1, p2, k3, each finite")
        if (self.position is None) != (self.R_camera_enu is None):
            raise InputError(f"{who}: give position and rotation together, or neither")
        object.__setattr__(self, "size", (int(width), int(height)))
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        if self.position is not None:
            position = as_vectors(self.position, f"{who}: position")
            rotation = np.asarray(self.R_camera_enu, dtype=np.float64)
            if position.shape != (3,) or rotation.shape != (3, 3):
                raise InputError(f"{who}: position (3,) and rotation (3, 3) are needed")
            square = rotation @ rotation.T
            if not np.allclose(square, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0.0:
                raise InputError(f"{who}: rotation is not a right-handed rotation")
            object.__setattr__(self, "position", position)
            object.__setattr__(self, "R_camera_enu", rotation)
