r"""The error budget of an orientation: its systematic part, and the part that averages out.

An error in the lines of sight from a point to the lamp and the camera rotates the measured normal
of that point. Let s and t be the unit vectors from the mirror to the lamp and to the camera, v
their bisector, and δ the displacement of the mirror relative to the drone. Then

$$ δv = -\frac{I - v v^T}{|s + t|}
\left(\frac{I - s s^T}{d_s} + \frac{I - t t^T}{d_t}\right) δ $$

With the lamp beside the camera, this is the component of δ across the line of sight, divided by the
distance. An error common to all points of a mirror rotates the measured orientation by that amount,
however many points there are. Such errors are

- the surveyed position of the heliostat,
- its kinematics, that is, the vertex in this pose compared with the model,
- the absolute position of the RTK base, unless it was estimated from the heliostats themselves,
- the offset of the lamp from the camera, which affects only one of the two lines of sight.

Errors that differ from point to point average out, and appear in the scatter of the differences.
They are errors in the detected position of the reflection on the mirror, the RTK error of each
photograph, and the slope deviations if there is no slope map.
"""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors


@dataclass(frozen=True)
class Budget:
    """Standard deviations per axis of the errors common to a flight, m.

    Attributes
    ----------
    position
        Surveyed position of the heliostat.
    kinematics
        Position of the vertex in one pose, compared with the surveyed position and the nominal
        mechanism.
    rtk
        Common offset of all drone positions, or what remains of it if the offset was estimated from
        the heliostats.
    lamp
        Offset of the lamp from the camera.
    """

    position: float = 0.010
    kinematics: float = 0.030
    rtk: float = 0.005
    lamp: float = 0.002

    def __post_init__(self) -> None:
        for f in fields(self):
            value = float(getattr(self, f.name))
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"budget: {f.name} must be 0 or more, not {value} m")

    def parts(self, distance: npt.ArrayLike) -> dict[str, FloatArray]:
        """Return the rotation that each error causes at distances (...), rad per axis, (...)."""
        d = as_float(distance)
        return {
            "position": self.position / d,
            "kinematics": self.kinematics / d,
            "rtk": self.rtk / d,
            # The lamp is at only one of the two ends.
            "lamp": 0.5 * self.lamp / d,
        }

    def systematic(self, distance: npt.ArrayLike) -> FloatArray:
        """Return the root sum square of the parts, rad per axis, (...)."""
        return as_float(np.sqrt(sum(p**2 for p in self.parts(distance).values())))

    def covariance(
        self,
        point: npt.ArrayLike,
        camera: npt.ArrayLike,
        led: npt.ArrayLike,
        axes: npt.ArrayLike,
        place: npt.ArrayLike | None = None,
    ) -> FloatArray:
        """Return the covariance, along two axes, of the error common to N points, rad², (2, 2).

        Parameters
        ----------
        point, camera, led
            ENU metres, (N, 3).
        axes
            Two unit axes perpendicular to the mirror normal, (2, 3).
        place
            Covariance of the mirror's position relative to the drone, m², (3, 3), if a bundle
            adjustment estimated it. It replaces ``position``, ``kinematics`` and ``rtk``.
        """
        both, lamp = lever(point, camera, led, axes)
        known = (self.position**2 + self.kinematics**2 + self.rtk**2) * np.eye(3)
        common = known if place is None else as_float(place)
        mean, half = both.mean(axis=0), lamp.mean(axis=0)
        return as_float(mean @ common @ mean.T + self.lamp**2 * half @ half.T)


def lever(
    point: npt.ArrayLike, camera: npt.ArrayLike, led: npt.ArrayLike, axes: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return how normals rotate when lamp and camera move together, and when only the lamp moves.

    Parameters
    ----------
    point, camera, led
        ENU metres, (N, 3).
    axes
        Two unit axes across the normals, (2, 3) or (N, 2, 3).

    Returns
    -------
    Derivatives of the normals along the axes with respect to the displacement in ENU metres, (N, 2,
    3) each. Moving the mirror is equivalent to moving both the lamp and the camera the opposite
    way.
    """
    m, across = as_vectors(point, "point"), as_float(axes)
    parts, total = [], np.zeros_like(m)
    for end in (as_vectors(led, "led"), as_vectors(camera, "camera")):
        path = end - m
        distance = np.linalg.norm(path, axis=-1, keepdims=True)
        unit = path / distance
        total = total + unit
        parts.append((np.eye(3) - unit[..., :, None] * unit[..., None, :]) / distance[..., None])
    size = np.linalg.norm(total, axis=-1)[..., None, None]
    normal = total / size[..., 0]
    flat = (np.eye(3) - normal[..., :, None] * normal[..., None, :]) / size
    lamp = across @ (flat @ parts[0])
    return as_float(lamp + across @ (flat @ parts[1])), as_float(lamp)
