"""Synthetic frames with exact ground truth, for tests, figures and simulated cameras.

`scenes` describes target, light, paint, lens and sensor; `rendering` renders a frame from a scene.
No code that evaluates real photographs imports this package. Begin with `example_target`,
`example_camera`, `Scene` and `render`.
"""

from heliotrope.imaging.synthetic.rendering import BeamTruth, MarkTruth, Rendered, render
from heliotrope.imaging.synthetic.scenes import (
    LensEffects,
    Paint,
    Scene,
    Sensor,
    Shadow,
    Surroundings,
    Thrown,
    example_camera,
    example_target,
    exposed,
)

__all__ = [
    "BeamTruth",
    "LensEffects",
    "MarkTruth",
    "Paint",
    "Rendered",
    "Scene",
    "Sensor",
    "Shadow",
    "Surroundings",
    "Thrown",
    "example_camera",
    "example_target",
    "exposed",
    "render",
]
