"""The observers that check the safety invariants.

`Observer` watches one cluster with its boards, `PlantObserver` the plant, `BeamObserver` the true
beams, `VisitObserver` what photographs have taught the plant; `TITLES` names the invariants.
"""

from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.invariants import TITLES, InvariantError, Observer, Violation
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.visits import VisitObserver

__all__ = [
    "TITLES",
    "BeamObserver",
    "InvariantError",
    "Observer",
    "PlantObserver",
    "Violation",
    "VisitObserver",
]
