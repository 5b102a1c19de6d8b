"""Which heliostats in production take part in a receiver visit, and the codes they move by.

Each beam stays about its own aim. Every movement ends on the receiver, and all of them together
cost no more of the power than is allowed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import erf, sqrt

import numpy as np

from heliotrope.field.receiver_visits import MOST_MOVEMENT, ReceiverSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, bisector
from heliotrope.imaging.coded import ExpectedBeam, coded_movements
from heliotrope.lcu import states
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.expected_errors import expected_errors
from heliotrope.plant.visits.joint_layout import Layout, moments_on
from heliotrope.plant.visits.resolution import LEAST_STEPS, beam_steps

#: Likely share of a mirror's size in its beam: between flat mirrors and well canted ones.
_CURVED = 0.5
#: The four ends of a movement along both axes.
_ENDS = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)])


@dataclass(frozen=True)
class ReceiverLayout:
    """Beams of a receiver visit.

    Attributes
    ----------
    layout
        Beams, aims and movements on the receiver's face.
    powers
        Of each beam, in square metres of sunlight, (M,).
    cost
        Share of the power on the receiver that the movements cost, as expected.
    """

    layout: Layout
    powers: FloatArray
    cost: float


@dataclass(frozen=True)
class _Beam:
    """What is known of a beam: its place on the face, shape, variance, power and movement."""

    place: FloatArray
    moments: FloatArray
    variance: float
    power: float
    size: float
    cost: float


def arranged_on(
    plant: PlantController,
    face: Target,
    heliostats: tuple[str, ...],
    settings: ReceiverSettings,
) -> tuple[ReceiverLayout, dict[str, str]]:
    """Return the layout of a receiver visit, and why some of the heliostats take no part.

    Parameters
    ----------
    plant
        Knows mirrors, aims, calibrations and the sun.
    face, heliostats
        The face of the receiver, and names.
    settings
        See `ReceiverSettings`.
    """
    wrong: dict[str, str] = {}
    known: dict[str, _Beam] = {}
    tracking = plant.field.among((states.TRACKING,), plant.now())
    for name in heliostats:
        if not tracking[plant.field.place(name)]:
            wrong[name] = f"it does not track {face.name}"
        elif plant.beliefs.record(name) is None:
            wrong[name] = "it has no calibration yet; it is calibrated on a target first"
    able = [name for name in heliostats if name not in wrong]
    rows = np.array([plant.field.place(name) for name in able], dtype=np.intp)
    points = zip(able, plant.aims[rows], strict=True)
    aims = np.array([plant.movements.aim(name, aim) for name, aim in points]).reshape(-1, 3)
    steps = beam_steps(plant, rows, face, plant.sun_vector(), aims).max(axis=-1)
    errors = np.hypot(expected_errors(plant, able, aims), sqrt(2.0) * settings.visit)
    for name, *figures in zip(able, aims, steps.tolist(), errors.tolist(), strict=True):
        found = _known(plant, face, name, settings, *figures)
        if isinstance(found, str):
            wrong[name] = found
        else:
            known[name] = found
    for name in list(known)[settings.most :]:
        del known[name]
        wrong[name] = f"{settings.most} heliostats take part at once; it can come later"
    known, dear, cost = _affordable(known, production(plant, face), settings.power)
    return ReceiverLayout(
        _coded(face, known), np.array([beam.power for beam in known.values()]), cost
    ), wrong | dear


def production(plant: PlantController, face: Target) -> float:
    """Return the light that is sent to a receiver now, in square metres of sunlight."""
    field = plant.field
    rows = np.flatnonzero(field.among((states.TRACKING,), plant.now()) & face.holds(plant.aims))
    if not len(rows):
        return 0.0
    ways = plant.aims[rows] - plant.beams.armature.origin_1[rows]
    rays = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    cosines = np.sqrt(np.maximum(0.5 * (1.0 + rays @ plant.sun_vector()), 0.0))
    return float((plant.beams.mirrors.width[rows] * plant.beams.mirrors.height[rows]) @ cosines)


def _known(
    plant: PlantController,
    face: Target,
    name: str,
    settings: ReceiverSettings,
    aim: FloatArray,
    step: float,
    error: float,
) -> _Beam | str:
    row = plant.field.place(name)
    vertex = np.asarray(plant.beams.armature.origin_1[row], dtype=np.float64)
    way = aim - vertex
    slant = float(np.linalg.norm(way))
    if not float(way @ face.normal) < 0.0:
        return f"it does not see the front of {face.name}"
    sun = plant.sun_vector()
    slanted = abs(float(way @ face.normal)) / slant
    least = LEAST_STEPS * step
    if (coarse := least * slanted / slant) > MOST_MOVEMENT:
        return (
            f"its drives move its beam in steps of {1e3 * coarse / LEAST_STEPS:.1f} mrad, the "
            f"limit is {1e3 * MOST_MOVEMENT / LEAST_STEPS:g} mrad; it is calibrated on a target"
        )
    place, size = face.plane_coordinates(aim), max(settings.movement * slant, least)
    if not face.holds(aim + size * _ENDS @ face.axes).all():
        return f"its aim is less than {size:.2f} m inside the edge of {face.name}"
    normal = bisector(sun, way / slant)
    if not error <= settings.known:
        return (
            f"its beam is known to {1e3 * error:.1f} mrad only, the limit is "
            f"{1e3 * settings.known:g} mrad; it is calibrated on a target first"
        )
    group, number = plant.design.find(name)
    width, height = float(group.width[number]), float(group.height[number])
    moments = moments_on(face, vertex, normal, width, height, _CURVED)
    power = width * height * float(normal @ sun)
    there = caught(face, place, moments)
    moved = float(np.mean([caught(face, place + size * end, moments) for end in _ENDS]))
    return _Beam(
        place,
        moments,
        0.5 * (error * slant / slanted) ** 2,
        power,
        size,
        power * max(0.0, there - moved),
    )


def caught(face: Target, place: FloatArray, moments: FloatArray) -> float:
    """Return the share of a beam that a face catches."""
    corners = face.plane_coordinates(face.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    share = 1.0
    for k in range(2):
        wide = sqrt(2.0 * moments[k, k])
        share *= 0.5 * (erf((high[k] - place[k]) / wide) - erf((low[k] - place[k]) / wide))
    return share


def _affordable(
    known: Mapping[str, _Beam], power: float, limit: float
) -> tuple[dict[str, _Beam], dict[str, str], float]:
    """Return the beams whose movements cost no more than allowed, the others, and the cost."""
    taken, dear, total = set(), dict[str, str](), 0.0
    for name, beam in sorted(known.items(), key=lambda item: item[1].cost):
        if total + beam.cost <= limit * power:
            total += beam.cost
            taken.add(name)
        else:
            dear[name] = (
                f"with its movements the visit would cost more than {100.0 * limit:g} % of the "
                "power on the receiver"
            )
    kept = {name: beam for name, beam in known.items() if name in taken}
    return kept, dear, total / power if power > 0.0 else 0.0


def _coded(face: Target, known: Mapping[str, _Beam]) -> Layout:
    """Return beams that each have a code of their own: on a receiver they all overlap."""
    count = max(1, len(known))
    size = np.array([beam.size for beam in known.values()])
    moves = coded_movements(count)[:, : len(known)] * size[:, None]
    places = np.array([beam.place for beam in known.values()]).reshape(-1, 2)
    beams = tuple(
        ExpectedBeam(name, beam.place, beam.variance * np.eye(2), beam.moments)
        for name, beam in known.items()
    )
    return Layout(face, beams, face.center + places @ face.axes, moves, count)
