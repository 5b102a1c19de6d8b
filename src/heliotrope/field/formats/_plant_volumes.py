"""Reads and writes the keep-out volumes in the plant file."""

import math
from typing import Any

import numpy as np

from heliotrope.field.formats._plant_models import (
    AnyVolume,
    BoxTable,
    CylinderTable,
    PrismTable,
    SphereTable,
)
from heliotrope.field.volumes import Box, Cylinder, Prism, Sphere, Volume


def build_volume(table: AnyVolume) -> Volume:
    """Return the volume of a table.

    Raises
    ------
    InputError
        If its numbers do not define a volume.
    """
    match table:
        case BoxTable():
            turn = table.azimuth_rad
            if turn is None:
                turn = math.radians(table.azimuth_deg)
            return Box(table.name, np.array(table.center_m), np.array(table.size_m), turn)
        case SphereTable():
            return Sphere(table.name, np.array(table.center_m), table.radius_m)
        case CylinderTable():
            ends = np.array(table.start_m), np.array(table.end_m)
            return Cylinder(table.name, *ends, table.radius_m)
        case PrismTable():
            return Prism(table.name, np.array(table.corners_m), table.bottom_m, table.top_m)


def volume_document(volume: Volume) -> dict[str, Any]:
    """Return the table of a volume."""
    match volume:
        case Box():
            own = {
                "kind": "box",
                "center_m": _numbers(volume.center),
                "size_m": _numbers(volume.size),
                "azimuth_rad": volume.azimuth,
            }
        case Sphere():
            own = {
                "kind": "sphere",
                "center_m": _numbers(volume.center),
                "radius_m": volume.radius,
            }
        case Cylinder():
            own = {
                "kind": "cylinder",
                "start_m": _numbers(volume.start),
                "end_m": _numbers(volume.end),
                "radius_m": volume.radius,
            }
        case Prism():
            own = {
                "kind": "prism",
                "corners_m": _numbers(volume.corners),
                "bottom_m": volume.bottom,
                "top_m": volume.top,
            }
    return {"name": volume.name, **own}


def _numbers(value: Any) -> Any:
    return np.asarray(value, dtype=np.float64).tolist()
