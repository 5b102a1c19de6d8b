"""Emergencies: the plant's rows of the safety table, the order that they demand, and its proof.

`Sentinel` obeys the table and repeats and proves orders; its file holds all that begins or ends
an emergency. `TableWatch` evaluates the rows, and `EmergencyOrder` is one order to the whole
field with its proof.
"""

from heliotrope.plant.emergency.order import EmergencyOrder, at_stow, carried_out
from heliotrope.plant.emergency.sentinel import UNPROVEN, Sentinel
from heliotrope.plant.emergency.standing import Call, EmergencyRecord, Standing, read_standing
from heliotrope.plant.emergency.table import (
    DNI_READING,
    ORDERED,
    OWN_READINGS,
    PlantReadings,
    TableWatch,
)

__all__ = [
    "DNI_READING",
    "ORDERED",
    "OWN_READINGS",
    "UNPROVEN",
    "Call",
    "EmergencyOrder",
    "EmergencyRecord",
    "PlantReadings",
    "Sentinel",
    "Standing",
    "TableWatch",
    "at_stow",
    "carried_out",
    "read_standing",
]
