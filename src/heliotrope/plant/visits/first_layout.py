"""Where beams of mirrors that were never calibrated are sent together.

Such a beam misses by metres, so that places cannot be kept apart: each mirror has a code of its
own, and moves widely to the right and left, which needs half as many photographs as movements along
both axes. Mirrors that may miss by more aim nearer to the middle; one that was missed before aims
beside the target, so that its beam comes onto it. The target must not become too
bright wherever the beams truly are: the expected light and twice its standard deviation count.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan.on_target import LOOKS, search_places
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.coded_layout import Layout, SentBeam, beams_of, coded
from heliotrope.plant.visits.joint_layout import bells, errors_on

#: A beam keeps this many of its standard deviations from the border, and those of its place.
_BORDER, _PLACED = 1.5, 1.5
#: Standard deviations by which the light may exceed its expectation.
_ABOVE = 2.0
#: Points across the target where its light is computed.
_ACROSS = 15
#: First visits move to the right and left.
_RIGHT = 0


def newcomers(
    plant: PlantController,
    target: Target,
    heliostats: Sequence[str],
    settings: JointSettings,
    model: Mapping[str, tuple[str, ...]],
    missed: Mapping[str, int] | None = None,
) -> tuple[Layout, dict[str, str]]:
    """Return the layout of a joint first visit, and why some heliostats have no place in it.

    Parameters
    ----------
    plant
        Knows mirrors and the sun.
    target, heliostats
        The target, and names of heliostats that are known badly, or were never calibrated.
    settings
        See `JointSettings`.
    model
        Names of the parameters whose priors say how far each beam may miss, by heliostat.
    missed
        Joint first visits in which a beam was not found, by heliostat.
    """
    sent, wrong = beams_of(
        plant, target, errors_on(plant, target, heliostats, settings, model), settings
    )
    for name in list(sent)[settings.first :]:
        wrong[name] = f"{settings.first} heliostats are on {target.name} already"
        del sent[name]
    while len(sent) > 1 and _brightest(target, sent, _places(target, sent)) > settings.brightest:
        wrong[sent.popitem()[0]] = (
            f"the light on {target.name} might exceed {settings.brightest:g} suns"
        )
    code = np.arange(len(sent), dtype=np.intp)
    looks = search_places(target, LOOKS)
    count = [min((missed or {}).get(name, 0), LOOKS - 1) for name in sent]
    places = _places(target, sent) + looks[count]
    layout = coded(target, sent, places, code, settings.first_movement, along=_RIGHT)
    return replace(layout, first=True), wrong


def _places(target: Target, sent: Mapping[str, SentBeam]) -> FloatArray:
    """Return places, right of and above the centre, m, (M, 2); the surest go far out."""
    if not sent:
        return np.zeros((0, 2))
    half = np.abs(target.plane_coordinates(target.corners)).min(axis=0)
    size = np.sqrt([np.diag(beam.moments) for beam in sent.values()])
    placed = np.sqrt([beam.variance for beam in sent.values()])[:, None]
    room = np.maximum(half - _BORDER * size - _PLACED * placed, 0.0)
    across = int(np.ceil(np.sqrt(len(sent))))
    line = np.linspace(-1.0, 1.0, across) if across > 1 else np.zeros(1)
    grid = np.array([(a, b) for b in line for a in line])
    out = np.argsort(np.abs(grid).max(axis=1), kind="stable")[: len(sent)]
    near: npt.NDArray[np.intp] = np.argsort(room.min(axis=1), kind="stable")
    places = np.empty((len(sent), 2))
    places[near] = grid[out] * room.max(axis=0)
    return np.asarray(np.clip(places, -room, room))


def _brightest(target: Target, sent: Mapping[str, SentBeam], places: FloatArray) -> float:
    """Return the most light at a place of the target that is to be reckoned with, in suns."""
    corners = target.plane_coordinates(target.corners)
    x, y = (np.linspace(low, high, _ACROSS) for low, high in zip(*_ends(corners), strict=True))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    beams = tuple(sent.values())
    power = np.array([beam.power for beam in beams])
    likely = np.array([beam.likely for beam in beams])
    spread = np.array([beam.variance for beam in beams])[:, None, None] * np.eye(2)
    own = power**2 / (4.0 * np.pi * np.sqrt(np.linalg.det(likely)))
    mean = power @ bells(points, places, likely + spread)
    variance = own @ bells(points, places, 0.5 * likely + spread)
    return float((mean + _ABOVE * np.sqrt(variance)).max())


def _ends(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    return corners.min(axis=0), corners.max(axis=0)
