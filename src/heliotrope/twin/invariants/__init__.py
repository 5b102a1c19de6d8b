"""The observers that check the safety invariants.

`Observer` monitors one cluster with its boards, `PlantObserver` the plant, `BeamObserver` the true
beams, `VisitObserver` what the plant has learnt from photographs, `ResultObserver` the results of
visits, `ProgressObserver` the progress of automatic control, `ShownObserver` what the plant
displays, and `DayObserver` whether the field is at stow while the sun is low; `TITLES` names the
invariants.
"""

from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.day import DayObserver
from heliotrope.twin.invariants.invariants import TITLES, InvariantError, Observer, Violation
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.progress import ProgressObserver
from heliotrope.twin.invariants.results import ResultObserver
from heliotrope.twin.invariants.shown import ShownObserver
from heliotrope.twin.invariants.visits import VisitObserver

__all__ = [
    "TITLES",
    "BeamObserver",
    "DayObserver",
    "InvariantError",
    "Observer",
    "PlantObserver",
    "ProgressObserver",
    "ResultObserver",
    "ShownObserver",
    "Violation",
    "VisitObserver",
]
