"""Aims that keep the flux on a receiver under a limit, although mirrors err.

- `FluxLimit`: what a receiver may get: a number or a map (`heliotrope.field.flux_limit`).
- `candidates` and `optimiser`: images of each mirror at a few aims, and the choice of most power.
- `errors`: how far the flux may be off, by each mirror's own error and by shared ones.
- `scene_aims`: all of this for a scene; `plan`: for a plant; `strategies`: what to compare with.

Begin with `plan_aims`, which is `heliotrope.aim`.
"""

from heliotrope.aims.errors import Risk, SharedErrors
from heliotrope.aims.files import write_aims
from heliotrope.aims.plan import AimPlan, compare_aims, plan_aims
from heliotrope.aims.scene_aims import Demand, SceneAims, aim_scene
from heliotrope.aims.strategies import STRATEGIES
from heliotrope.field.flux_limit import FluxLimit, read_limit

__all__ = [
    "STRATEGIES",
    "AimPlan",
    "Demand",
    "FluxLimit",
    "Risk",
    "SceneAims",
    "SharedErrors",
    "aim_scene",
    "compare_aims",
    "plan_aims",
    "read_limit",
    "write_aims",
]
