"""Emergencies: the plant's safety-table rows, and the orders that they require and confirm.

`Sentinel` acts on the table, and repeats and confirms orders; its file contains everything that
starts or ends an emergency. `TableWatch` evaluates the rows. `EmergencyOrder` is one field-wide
order with the proof that it has been carried out.
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
