"""Deterministic simulation: a real plant, clusters and boards in virtual time, with seeded faults.

Begin with `run` and a `RunPlan`; `run_many` runs many seeds, and `shrink` reduces a failed run to
the faults that matter. `KINDS` lists everything that can go wrong.
"""

from heliotrope.twin.world.design import design_of
from heliotrope.twin.world.faults import KINDS, Fault
from heliotrope.twin.world.simulation import RunPlan, RunResult, Simulation, run, shrink
from heliotrope.twin.world.soak import SoakResult, run_many

__all__ = [
    "KINDS",
    "Fault",
    "RunPlan",
    "RunResult",
    "Simulation",
    "SoakResult",
    "design_of",
    "run",
    "run_many",
    "shrink",
]
