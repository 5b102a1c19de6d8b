"""How cameras see targets: distance, resolution, obliquity, and fraction in the frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.camera import Camera, project
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray


@dataclass(frozen=True)
class TargetView:
    """A camera's view of a target.

    Attributes
    ----------
    target
        Name of the target.
    distance
        Distance from the camera to the target's centre, m.
    metres_per_pixel
        Resolution at the centre, as the square root of the area of a pixel, m.
    obliquity
        Angle between the line of sight and the target normal, rad.
    share
        Fraction of the target in the frame.
    marks
        Number of the target's marks in the frame.
    """

    target: str
    distance: float
    metres_per_pixel: float
    obliquity: float
    share: float
    marks: int


def sights(camera: Camera, targets: Sequence[Target]) -> list[TargetView]:
    """Return the views of the targets that face a camera and are in its frame."""
    if camera.position is None:
        return []
    views = []
    for target in targets:
        ray = camera.position - target.center
        distance = float(np.linalg.norm(ray))
        facing = float(ray @ target.normal) / distance
        if (camera.targets and target.name not in camera.targets) or facing <= 0.0:
            continue
        half = 0.5 * np.array([target.width, target.height])
        steps = np.linspace(-1.0, 1.0, 21)
        middle = target.plane_coordinates(target.corners).mean(axis=0)
        grid = middle + half * np.stack(np.meshgrid(steps, steps), axis=-1)
        share = _held(camera, project(camera, target.point(grid))).mean()
        marks = np.array([mark.point for mark in target.marks]).reshape(-1, 3)
        around = project(camera, target.point([[-0.01, 0], [0.01, 0], [0, -0.01], [0, 0.01]]))
        if share == 0.0 or not np.isfinite(around).all():
            continue
        area = abs(float(np.linalg.det([around[1] - around[0], around[3] - around[2]]))) / 4e-4
        if area > 0.0:
            oblique = float(np.arccos(min(facing, 1.0)))
            count = int(_held(camera, project(camera, marks)).sum())
            views.append(
                TargetView(target.name, distance, area**-0.5, oblique, float(share), count)
            )
    return views


def _held(camera: Camera, pixels: FloatArray) -> npt.NDArray[np.bool_]:
    """Return whether pixels (..., 2) are in the frame; NaN (behind the camera) is not."""
    with np.errstate(invalid="ignore"):
        held = (pixels > -0.5) & (pixels < np.array(camera.size) - 0.5)
    return np.asarray(held.all(axis=-1))
