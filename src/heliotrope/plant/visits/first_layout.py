"""Where beams of mirrors that were never calibrated are sent together.

Such a beam misses by metres, so that places cannot be kept apart: each mirror has a code of its
own, and moves widely to the right and left, which needs half as many photographs as movements along
both axes. Mirrors that may miss by more aim nearer to the middle; one that was missed before aims
beside the target, so that its beam comes onto it. The target must not become too
bright wherever the beams truly are: the expected light and twice its standard deviation count.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan.on_target import LOOKS, search_places
from heliotrope.calibration.uncertainty import expected_error, precision
from heliotrope.field.joint_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.joint_layout import Layout, SentBeam, beam_of, coded, error_on

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
    wrong: dict[str, str] = {}
    sent: dict[str, SentBeam] = {}
    sun = plant.sun_vector()
    for name in heliostats:
        error = error_on(plant, target, name, settings)
        if error is None:
            present, names = plant.beliefs.present(name), model[name]
            prior = np.linalg.inv(precision(plant.beliefs.nominal(name), names))[0]
            here = plant.field.counts(np.array([plant.field.place(name)]))
            expected = expected_error(present, names, prior, sun, target.center, current=here)
            error = float(expected.rms[0])
        found = beam_of(plant, target, name, error) if np.isfinite(error) else "out of its reach"
        if isinstance(found, str):
            wrong[name] = found
        elif len(sent) == settings.first:
            wrong[name] = f"{settings.first} heliostats are on {target.name} already"
        else:
            sent[name] = found
    while len(sent) > 1 and _brightest(target, sent, _places(target, sent)) > settings.brightest:
        wrong[sent.popitem()[0]] = (
            f"the light on {target.name} might exceed {settings.brightest:g} suns"
        )
    code = np.arange(len(sent), dtype=np.intp)
    looks = search_places(target, LOOKS)
    count = [min((missed or {}).get(name, 0), LOOKS - 1) for name in sent]
    places = _places(target, sent) + looks[count]
    return coded(target, sent, places, code, settings.first_movement, along=_RIGHT), wrong


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
    mean, variance = np.zeros((2, len(points)))
    for beam, place in zip(sent.values(), places, strict=True):
        spread = beam.variance * np.eye(2)
        own = beam.power**2 / (4.0 * np.pi * float(np.sqrt(np.linalg.det(beam.likely))))
        mean += beam.power * _bell(points - place, beam.likely + spread)
        variance += own * _bell(points - place, 0.5 * beam.likely + spread)
    return float((mean + _ABOVE * np.sqrt(variance)).max())


def _ends(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    return corners.min(axis=0), corners.max(axis=0)


def _bell(away: FloatArray, moments: FloatArray) -> FloatArray:
    form = np.einsum("ni,ij,nj->n", away, np.linalg.inv(moments), away)
    return np.asarray(np.exp(-0.5 * form) / (2.0 * np.pi * np.sqrt(np.linalg.det(moments))))
