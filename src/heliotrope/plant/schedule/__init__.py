"""The calibration schedule: which heliostat is photographed next, on which target.

Begin with `Scheduler`: it decides from time, sun vector and states alone, so that whole days can be
simulated in seconds. `PlantSchedule` runs it in a running plant. `knowledge` holds the expected
error of each heliostat, and `choice` finds the best visit at a given moment.
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
