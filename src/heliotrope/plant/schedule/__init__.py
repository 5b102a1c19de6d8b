"""The schedule of calibration: which heliostat is photographed next, on which target.

Begin with `Scheduler`: it decides from time, sun and states alone, so days are tried out in
seconds. `PlantSchedule` runs it in a plant at work. `knowledge` holds the expected error of each
heliostat, and `choice` finds the best visit of a moment.
"""

from heliotrope.plant.schedule.choice import Assignment
from heliotrope.plant.schedule.plant_schedule import PlantSchedule, settings_for
from heliotrope.plant.schedule.scheduler import (
    Comparison,
    Finished,
    Scheduler,
    States,
    Visited,
    compare,
)
from heliotrope.plant.schedule.settings import Settings, Weather

__all__ = [
    "Assignment",
    "Comparison",
    "Finished",
    "PlantSchedule",
    "Scheduler",
    "Settings",
    "States",
    "Visited",
    "Weather",
    "compare",
    "settings_for",
]
