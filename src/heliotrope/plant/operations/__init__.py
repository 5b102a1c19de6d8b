"""A running plant, as used by consoles, APIs and the command line.

Begin with `Operations`, the single object that all of them use. Behind it are automatic control
(`automatic`, with `raising` and `calibrating`), the calibration book, the logbook of alarms, events
and packets, and `views`, the plain values that are displayed.
"""

from heliotrope.plant.operations.automatic import AutomaticControl, AutomaticSettings
from heliotrope.plant.operations.calibrating import Scheduling
from heliotrope.plant.operations.logbook import Logbook
from heliotrope.plant.operations.operations import Operations, Photographer
from heliotrope.plant.operations.security import SecurityEvent, SecurityLog, SecurityNote
from heliotrope.plant.operations.zero import zero

__all__ = [
    "AutomaticControl",
    "AutomaticSettings",
    "Logbook",
    "Operations",
    "Photographer",
    "Scheduling",
    "SecurityEvent",
    "SecurityLog",
    "SecurityNote",
    "zero",
]
