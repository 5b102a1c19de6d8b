"""The choice of heliostats that take part in a receiver visit.

Each beam stays near its own aim. Every movement ends on the receiver, and all movements together
cost no more power than is allowed.
"""

from dataclasses import replace
from math import erf, sqrt

import numpy as np

from heliotrope.field.coded_visits import ReceiverSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.coded_layout import REFLECTED, Layout, SentBeam, beams_of, coded
from heliotrope.plant.visits.expected_errors import expected_errors

#: The four ends of a movement along both axes.
_ENDS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


def arranged_on(
    plant: PlantController,
    face: Target,
    heliostats: tuple[str, ...],
    settings: ReceiverSettings,
) -> Layout:
    """Return the layout of a receiver visit.

    Parameters
    ----------
    plant
        Plant with its heliostats, their aims and calibrations, and the sun.
    face, heliostats
        The face of the receiver, and names of heliostats.
    settings
        See `ReceiverSettings`.
    """
    blocked: dict[str, str] = {}
    aims: dict[str, FloatArray] = {}
    tracking = plant.field.among((states.TRACKING,), plant.now())
    for name in heliostats:
        row = plant.field.place(name)
        if not tracking[row]:
            blocked[name] = f"it does not track {face.name}"
        elif plant.beliefs.record(name) is None:
            blocked[name] = "it has no calibration yet; it is calibrated on a target first"
        else:
            aims[name] = plant.movements.aim(name, plant.aims[row])
    points = np.array(list(aims.values())).reshape(-1, 3)
    found = np.hypot(expected_errors(plant, list(aims), points), sqrt(2.0) * settings.visit)
    errors = dict(zip(aims, found.tolist(), strict=True))
    known, others = beams_of(plant, face, errors, settings, aims)
    blocked |= others
    for name in list(known):
        size = known[name].movement(settings.movement)
        if not face.holds(aims[name] + size * _ENDS @ face.axes).all():
            blocked[name] = f"its aim is less than {size:.2f} m inside the edge of {face.name}"
        elif not errors[name] <= settings.known:
            blocked[name] = (
                f"its beam is known to {1e3 * errors[name]:.1f} mrad only, the limit is "
                f"{1e3 * settings.known:g} mrad; it is calibrated on a target first"
            )
        if name in blocked:
            del known[name]
    for name in list(known)[settings.most :]:
        del known[name]
        blocked[name] = f"{settings.most} heliostats already take part; it can join a later visit"
    places = {name: face.plane_coordinates(aims[name]) for name in known}
    limit = settings.power * REFLECTED * sunlight_on(plant, face)
    costs = {name: _cost(face, places[name], known[name], settings) for name in known}
    total = 0.0
    for name in sorted(known, key=costs.__getitem__):
        if total + costs[name] <= limit:
            total += costs[name]
        else:
            del known[name]
            blocked[name] = (
                f"with its movements the visit would cost more than {100.0 * settings.power:g} % "
                "of the power on the receiver"
            )
    # On a receiver all beams overlap, so each has its own code.
    own = np.arange(len(known), dtype=np.intp)
    where = np.array([places[name] for name in known]).reshape(-1, 2)
    powers = np.array([beam.power for beam in known.values()])
    layout = coded(face, known, where, own, settings.movement)
    return replace(layout, powers=powers, left_out=blocked)


def sunlight_on(plant: PlantController, face: Target) -> float:
    """Return the light that is now sent to a receiver, in square metres of sunlight."""
    field = plant.field
    rows = np.flatnonzero(field.among((states.TRACKING,), plant.now()) & face.holds(plant.aims))
    if not len(rows):
        return 0.0
    paths = plant.aims[rows] - plant.beams.armature.origin_1[rows]
    rays = paths / np.linalg.norm(paths, axis=-1, keepdims=True)
    cosines = np.sqrt(np.maximum(0.5 * (1.0 + rays @ plant.sun_vector()), 0.0))
    return float((plant.beams.mirrors.width[rows] * plant.beams.mirrors.height[rows]) @ cosines)


def caught(face: Target, place: FloatArray, moments: FloatArray) -> float:
    """Return the fraction of a beam that a face catches."""
    corners = face.plane_coordinates(face.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    share = 1.0
    for k in range(2):
        wide = sqrt(2.0 * moments[k, k])
        share *= 0.5 * (erf((high[k] - place[k]) / wide) - erf((low[k] - place[k]) / wide))
    return share


def _cost(face: Target, place: FloatArray, beam: SentBeam, settings: ReceiverSettings) -> float:
    """Return the light that a beam's movements cost, in suns · m²."""
    ends = place + beam.movement(settings.movement) * _ENDS
    moved = float(np.mean([caught(face, end, beam.likely) for end in ends]))
    return beam.power * max(0.0, caught(face, place, beam.likely) - moved)
