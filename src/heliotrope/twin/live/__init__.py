"""Simulated surroundings for a running plant, in paced or virtual time.

Begin with `World`: its `ports` are passed to `plant.assembly.PlantAssembly`. `PacedLoop` runs the
plant and its surroundings at a chosen multiple of real time.
"""

from heliotrope.twin.live.boards import BoardField
from heliotrope.twin.live.live import CYCLE, World, WorldOptions, true_mechanisms
from heliotrope.twin.live.loop import PacedLoop
from heliotrope.twin.live.near_link import NearLink, near_pair

__all__ = [
    "CYCLE",
    "BoardField",
    "NearLink",
    "PacedLoop",
    "World",
    "WorldOptions",
    "near_pair",
    "true_mechanisms",
]
