"""Aim points that keep the flux on a receiver under a limit despite pointing errors.

- `FluxLimit`: the allowable flux on a receiver, a number or a map (`heliotrope.field.flux_limit`);
  `FluxTable` derives such a limit from the fluid's temperature and velocity
  (`heliotrope.field.flux_table`).
- `candidates` and `optimiser`: images of each mirror at a few aims, and the choice that maximises
  power.
- `errors`: the uncertainty of the flux due to each mirror's own error and to shared errors.
- `ramp`: when each mirror joins along a ramp; `heating`: how far a receiver may be heated now.
- `scene_aims`: aims for a scene; `plan`: aims for a plant; `strategies` and `gradient`: other
  strategies for comparison.

Begin with `plan_aims`, which is `heliotrope.aim`.
"""

from heliotrope.aims.errors import Risk, SharedErrors
from heliotrope.aims.files import write_aim_map, write_aims
from heliotrope.aims.plan import AimPlan, compare_aims, plan_aims
from heliotrope.aims.ramp import ramp_up
from heliotrope.aims.scene_aims import Demand, SceneAims, aim_scene
from heliotrope.aims.strategies import STRATEGIES
from heliotrope.field.flux_limit import FluxLimit, read_limit
from heliotrope.field.flux_table import (
    FluxTable,
    Panel,
    limit_of,
    read_flux_table,
    read_panels,
    read_table_limit,
)

__all__ = [
    "STRATEGIES",
    "AimPlan",
    "Demand",
    "FluxLimit",
    "FluxTable",
    "Panel",
    "Risk",
    "SceneAims",
    "SharedErrors",
    "aim_scene",
    "compare_aims",
    "limit_of",
    "plan_aims",
    "ramp_up",
    "read_flux_table",
    "read_limit",
    "read_panels",
    "read_table_limit",
    "write_aim_map",
    "write_aims",
]
