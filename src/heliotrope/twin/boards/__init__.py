"""Simulated local controllers, their clocks, flash and motors, and the bus they share.

`Board` runs the firmware's own code (`heliotrope.lcu`) on simulated hardware; `TwinBus` carries
frames to its stations and can damage them (`BusFaults`); `SimulatedTime`, `DriftingClock`: the
clocks of a cluster with faults. Begin with `Board`.
"""

from heliotrope.twin.boards.board import Board, Witness
from heliotrope.twin.boards.bus import BusFaults, Station, Tap, TwinBus
from heliotrope.twin.boards.clocks import DriftingClock, SimulatedTime, TickCounter
from heliotrope.twin.boards.flash import NorFlash, PowerCutError
from heliotrope.twin.boards.motors import MotorAxis
from heliotrope.twin.boards.outfit import MACHINE, Outfit, mechanisms, outfits, own_items

__all__ = [
    "MACHINE",
    "Board",
    "BusFaults",
    "DriftingClock",
    "MotorAxis",
    "NorFlash",
    "Outfit",
    "PowerCutError",
    "SimulatedTime",
    "Station",
    "Tap",
    "TickCounter",
    "TwinBus",
    "Witness",
    "mechanisms",
    "outfits",
    "own_items",
]
