r"""How well an orientation is known: what the many points average, and what they share.

A point m whose ways to lamp and camera are off turns its measured normal. With s and t the unit
vectors from the mirror to the two, v their bisector, and δ the displacement of the mirror
relative to the drone,

.. math:: δv = -\frac{I - v v^T}{|s + t|}
          \left(\frac{I - s s^T}{d_s} + \frac{I - t t^T}{d_t}\right) δ

which with the lamp beside the camera is δ across the line of sight over the distance. What is
off alike for all points of a mirror turns its orientation by as much, however many there are:

- the surveyed position of the heliostat,
- its kinematics: where the vertex stands in this pose, as against where the model has it,
- the absolute position of the RTK base, unless the heliostats themselves gave it,
- the lamp's place beside the camera, which moves one of the two ways only.

What differs from point to point goes down with their number: where the reflection was seen on
the mirror, each photograph's own RTK error, and the slope deviations if no map is known.
"""

from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors


@dataclass(frozen=True)
class Budget:
    """Standard deviations per axis of what a flight does not average, m.

    Attributes
    ----------
    position
        Of the heliostat's surveyed position.
    kinematics
        Of the vertex in a pose, about where the position and the nominal mechanism put it.
    rtk
        Of the common offset of all positions of the drone; what is left of it if the offset
        was estimated from the heliostats.
    lamp
        Of the lamp's place beside the camera.
    """

    position: float = 0.010
    kinematics: float = 0.030
    rtk: float = 0.005
    lamp: float = 0.002

    def __post_init__(self) -> None:
        for f in fields(self):
            value = float(getattr(self, f.name))
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"budget: {f.name} {value} m must be 0 or more")

    def parts(self, distance: npt.ArrayLike) -> dict[str, FloatArray]:
        """Return what each turns an orientation by at distances (...), rad per axis, (...)."""
        d = as_float(distance)
        return {
            "position": self.position / d,
            "kinematics": self.kinematics / d,
            "rtk": self.rtk / d,
            # Half of the light's way is the lamp's.
            "lamp": 0.5 * self.lamp / d,
        }

    def systematic(self, distance: npt.ArrayLike) -> FloatArray:
        """Return their sum in squares, rad per axis, (...)."""
        return as_float(np.sqrt(sum(p**2 for p in self.parts(distance).values())))

    def covariance(
        self,
        point: npt.ArrayLike,
        camera: npt.ArrayLike,
        led: npt.ArrayLike,
        axes: npt.ArrayLike,
        place: npt.ArrayLike | None = None,
    ) -> FloatArray:
        """Return the covariance along two axes of what N points of a mirror share, (2, 2), rad².

        Parameters
        ----------
        point, camera, led
            ENU metres, (N, 3).
        axes
            Two unit axes across the mirror's normal, (2, 3).
        place
            Covariance of the mirror's place as seen from the drone, m², (3, 3), if a bundle
            adjustment found it: it stands for ``position``, ``kinematics`` and ``rtk``.
        """
        both, lamp = lever(point, camera, led, axes)
        known = (self.position**2 + self.kinematics**2 + self.rtk**2) * np.eye(3)
        common = known if place is None else as_float(place)
        mean, half = both.mean(axis=0), lamp.mean(axis=0)
        return as_float(mean @ common @ mean.T + self.lamp**2 * half @ half.T)


@dataclass(frozen=True)
class Noise:
    """Standard deviations per axis of what differs from point to point.

    Attributes
    ----------
    rtk
        Of one photograph's position, m.
    slope
        Of the slope deviations that no map tells, rad.
    """

    rtk: float = 0.008
    slope: float = 0.8e-3

    def __post_init__(self) -> None:
        for f in fields(self):
            value = float(getattr(self, f.name))
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"noise: {f.name} {value} must be 0 or more")

    def of_a_point(
        self, sigma: npt.ArrayLike, distance: npt.ArrayLike, focal: npt.ArrayLike = np.inf
    ) -> FloatArray:
        """Return the standard deviation of one difference, rad per axis, (...).

        Parameters
        ----------
        sigma
            Of the reflection's place on the mirror, m, (...). A place that is off by δ turns
            the measured normal by δ over the distance and the expected one by δ / 2f: on a
            focusing mirror they cancel in part.
        distance, focal
            From mirror to drone, and of the facets, m, (...).
        """
        d = as_float(distance)
        seen = as_float(sigma) * np.abs(1.0 / d - 0.5 / as_float(focal))
        return as_float(np.sqrt(seen**2 + (self.rtk / d) ** 2 + self.slope**2))


def lever(
    point: npt.ArrayLike, camera: npt.ArrayLike, led: npt.ArrayLike, axes: npt.ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return how measured normals turn by moving lamp and camera together, and the lamp alone.

    Parameters
    ----------
    point, camera, led
        ENU metres, (N, 3).
    axes
        Two unit axes across the normals, (2, 3) or (N, 2, 3).

    Returns
    -------
    Derivatives along the axes by ENU metres, each (N, 2, 3). Moving the mirror is moving both
    the other way.
    """
    m, across = as_vectors(point, "point"), as_float(axes)
    parts, total = [], np.zeros_like(m)
    for end in (as_vectors(led, "led"), as_vectors(camera, "camera")):
        way = end - m
        distance = np.linalg.norm(way, axis=-1, keepdims=True)
        unit = way / distance
        total = total + unit
        parts.append((np.eye(3) - unit[..., :, None] * unit[..., None, :]) / distance[..., None])
    size = np.linalg.norm(total, axis=-1)[..., None, None]
    normal = total / size[..., 0]
    flat = (np.eye(3) - normal[..., :, None] * normal[..., None, :]) / size
    lamp = across @ (flat @ parts[0])
    return as_float(lamp + across @ (flat @ parts[1])), as_float(lamp)
