"""Beam positions of a joint visit on its target, and which codes the beams share.

Each beam gets a place in a grid with a margin to the border. Beams that do not overlap share a
code, so that only a few photographs are needed. The total light stays below the target's limit.

The beam of a heliostat that was never calibrated misses by metres, so separate places cannot be
guaranteed. Each such heliostat has its own code, and moves widely to the right and left, which
needs half as many photographs as movements along both axes. Heliostats with a larger expected miss
aim nearer to the middle; a heliostat whose beam was not found before aims beside the target, so
that its beam comes onto the target. The target must not become too bright, wherever the beams
actually are, so the limit applies to the expected light plus twice its standard deviation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan.on_target import LOOKS, search_places
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import shared_codes
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.coded_layout import Layout, SentBeam, beams_of, coded
from heliotrope.plant.visits.expected_errors import expected_errors

#: Smallest distance of a beam's centre from the edge of the target, in standard deviations of
#: the beam's width and of its position.
_BORDER, _PLACED = 2.0, 3.0
#: Possible numbers of codes: for 8 to 256 photographs with movements along both axes, or for 8 to
#: 128 with movements along one axis.
_CODES = (3, 7, 15, 31, 63, 127)
#: Movements of a verification are up and down; those of first visits are to the right and left.
_UP = 1
#: The same for a first visit.
_FIRST_BORDER, _FIRST_PLACED = 1.5, 1.5
#: Number of standard deviations by which the light is assumed to exceed its expected value.
_ABOVE = 2.0
#: Number of points across the target at which its light is computed.
_ACROSS = 15
#: First visits move to the right and left.
_RIGHT = 0


def arranged(
    plant: PlantController,
    target: Target,
    heliostats: tuple[str, ...],
    settings: JointSettings,
) -> Layout:
    """Return the layout of a joint visit.

    Parameters
    ----------
    plant
        Plant with its heliostats, their calibrations and the sun.
    target, heliostats
        The target, and names of heliostats.
    settings
        See `JointSettings`.
    """
    errors = errors_on(plant, target, heliostats, settings)
    blocked = {
        name: why
        for name, error in errors.items()
        if (why := _unknown(plant, name, error, settings))
    }
    sure = {name: error for name, error in errors.items() if name not in blocked}
    known, wrong = beams_of(plant, target, sure, settings)
    wrong |= blocked
    for name in list(known)[settings.most :]:
        wrong[name] = f"{settings.most} heliostats are already on {target.name}"
        del known[name]
    places, dazzling = _darkened(target, known, settings)
    too_bright = f"the light on {target.name} would exceed {settings.brightest:g} suns"
    wrong |= dict.fromkeys(dazzling, too_bright)
    code = _shared(known, places, along=None)
    return replace(coded(target, known, places, code, settings.movement), left_out=wrong)


def verifying(
    plant: PlantController,
    target: Target,
    errors: Mapping[str, float],
    settings: JointSettings,
    *,
    own: bool = False,
) -> tuple[Layout, tuple[str, ...]]:
    """Return the layout of a joint verification, and the heliostats to be verified later.

    The heliostats to be verified later would make the target too bright now.

    Parameters
    ----------
    plant, target, settings
        As in `arranged`.
    errors
        Expected beam error of each heliostat with its new parameters, rad RMS (2-D).
    own
        Whether each heliostat has its own code.
    """
    again = np.sqrt(2.0) * settings.visit
    all_errors = {name: float(np.hypot(error, again)) for name, error in errors.items()}
    known, wrong = beams_of(plant, target, all_errors, settings)
    places, dazzling = _darkened(target, known, settings)
    code = np.arange(len(known)) if own else _shared(known, places, along=_UP)
    layout = coded(target, known, places, code, settings.movement, along=_UP)
    return replace(layout, left_out=wrong), dazzling


def _darkened(
    target: Target, known: dict[str, SentBeam], settings: JointSettings
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return places for the beams, and the beams that are too bright.

    Beams that are too bright are removed from ``known``.
    """
    dazzling: list[str] = []
    while known:
        places = _places(target, known)
        if not (over := _too_bright(known, places, settings.brightest)):
            return places, tuple(dazzling)
        dazzling.append(over)
        del known[over]
    return np.zeros((0, 2)), tuple(dazzling)


def _unknown(
    plant: PlantController, name: str, error: float, settings: JointSettings
) -> str | None:
    """Return the reason why the expected error of a beam is too large; None if it is not."""
    if plant.beliefs.record(name) is None:
        return "it has no calibration yet; it is calibrated alone first"
    if error > settings.known:
        return (
            f"its beam is known to {1e3 * error:.1f} mrad only, the limit is "
            f"{1e3 * settings.known:g} mrad; it is calibrated alone first"
        )
    return None


def errors_on(
    plant: PlantController,
    target: Target,
    heliostats: Sequence[str],
    settings: JointSettings,
    model: Mapping[str, tuple[str, ...]] | None = None,
) -> dict[str, float]:
    """Return the expected errors of beams on a target, rad RMS (2-D), by heliostat.

    The error is NaN for a heliostat that cannot reach the target, or was never calibrated and has
    no ``model``; see `expected_errors`.
    """
    aims = np.broadcast_to(target.center, (len(heliostats), 3))
    found = expected_errors(plant, heliostats, aims, model)
    # The priors of an uncalibrated heliostat include errors that differ from visit to visit.
    known = np.array([plant.beliefs.record(name) is not None for name in heliostats])
    found = np.hypot(found, known * np.sqrt(2.0) * settings.visit)
    return dict(zip(heliostats, found.tolist(), strict=True))


def _places(target: Target, known: Mapping[str, SentBeam]) -> FloatArray:
    """Return places in a grid, right of and above the centre, m, (M, 2)."""
    sigma = np.sqrt(np.max([np.diag(beam.moments) for beam in known.values()], axis=0))
    placed = np.sqrt(max(beam.variance for beam in known.values()))
    corners = target.plane_coordinates(target.corners)
    low = np.minimum(corners.min(axis=0) + _BORDER * sigma + _PLACED * placed, 0.0)
    high = np.maximum(corners.max(axis=0) - _BORDER * sigma - _PLACED * placed, 0.0)
    size = high - low
    # The numbers of columns and rows that make the spacings equal, in units of the beam size.
    ratio = float(np.clip((size[0] / sigma[0] + 1e-9) / (size[1] / sigma[1] + 1e-9), 0.02, 50.0))
    columns = int(np.clip(round(float(np.sqrt(len(known) * ratio))), 1, len(known)))
    rows = -(-len(known) // columns)
    x, y = (
        np.linspace(low[k], high[k], n) if n > 1 else np.array([0.5 * (low[k] + high[k])])
        for k, n in enumerate((columns, rows))
    )
    return np.array([(a, b) for b in y for a in x])[: len(known)]


def _too_bright(known: Mapping[str, SentBeam], places: FloatArray, limit: float) -> str:
    """Return the beam at the brightest place if this exceeds a limit, in suns; otherwise "".

    A single beam may be as bright as in a visit of its own.
    """
    if len(known) < 2:
        return ""
    power = np.array([beam.power for beam in known.values()])
    light = power @ bells(places, places, np.array([beam.likely for beam in known.values()]))
    return list(known)[int(np.argmax(light))] if light.max() > limit else ""


def bells(points: FloatArray, places: FloatArray, moments: FloatArray) -> FloatArray:
    """Return the light of M beams of unit power at n points on their target, 1/m², (M, n).

    Parameters
    ----------
    points, places
        Positions in m right of and above the centre, (n, 2) and (M, 2).
    moments
        Second moments of the beams, m², (M, 2, 2).
    """
    away = points - places[:, None]
    form = np.einsum("mni,mij,mnj->mn", away, np.linalg.inv(moments), away)
    size = 2.0 * np.pi * np.sqrt(np.linalg.det(moments))
    return np.asarray(np.exp(-0.5 * form) / size[:, None])


def _shared(
    known: Mapping[str, SentBeam], places: FloatArray, along: int | None
) -> npt.NDArray[np.intp]:
    """Return the code of each beam, (M,), using the fewest codes.

    Beams with the same code must not overlap.
    """
    spread = np.array([b.moments + b.variance * np.eye(2) for b in known.values()])
    for few in _CODES if len(known) else ():
        # A series of movements along one axis has twice as many codes.
        code = shared_codes(places, spread, few if along is None else 2 * few + 1)
        if code is not None:
            return code
    return np.arange(len(known), dtype=np.intp)


def newcomers(
    plant: PlantController,
    target: Target,
    heliostats: Sequence[str],
    settings: JointSettings,
    model: Mapping[str, tuple[str, ...]],
    missed: Mapping[str, int] | None = None,
) -> Layout:
    """Return the layout of a joint first visit.

    Parameters
    ----------
    plant
        Plant with its heliostats and the sun.
    target, heliostats
        The target, and names of heliostats that are poorly known or were never calibrated.
    settings
        See `JointSettings`.
    model
        Names of the parameters whose priors determine how far each beam may miss, by heliostat.
    missed
        Number of joint first visits in which a beam was not found, by heliostat.
    """
    sent, wrong = beams_of(
        plant, target, errors_on(plant, target, heliostats, settings, model), settings
    )
    for name in list(sent)[settings.first :]:
        wrong[name] = f"{settings.first} heliostats are already on {target.name}"
        del sent[name]
    suns, too_bright = settings.brightest, f"the light on {target.name} might exceed"
    while len(sent) > 1 and _brightest(target, sent, _first_places(target, sent)) > suns:
        wrong[sent.popitem()[0]] = f"{too_bright} {suns:g} suns"
    code = np.arange(len(sent), dtype=np.intp)
    looks = search_places(target, LOOKS)
    count = [min((missed or {}).get(name, 0), LOOKS - 1) for name in sent]
    places = _first_places(target, sent) + looks[count]
    layout = coded(target, sent, places, code, settings.first_movement, along=_RIGHT)
    return replace(layout, first=True, left_out=wrong)


def _first_places(target: Target, sent: Mapping[str, SentBeam]) -> FloatArray:
    """Return places, right of and above the centre, m, (M, 2); well-known beams go far out."""
    if not sent:
        return np.zeros((0, 2))
    half = np.abs(target.plane_coordinates(target.corners)).min(axis=0)
    size = np.sqrt([np.diag(beam.moments) for beam in sent.values()])
    placed = np.sqrt([beam.variance for beam in sent.values()])[:, None]
    room = np.maximum(half - _FIRST_BORDER * size - _FIRST_PLACED * placed, 0.0)
    across = int(np.ceil(np.sqrt(len(sent))))
    line = np.linspace(-1.0, 1.0, across) if across > 1 else np.zeros(1)
    grid = np.array([(a, b) for b in line for a in line])
    out = np.argsort(np.abs(grid).max(axis=1), kind="stable")[: len(sent)]
    near: npt.NDArray[np.intp] = np.argsort(room.min(axis=1), kind="stable")
    places = np.empty((len(sent), 2))
    places[near] = grid[out] * room.max(axis=0)
    return np.asarray(np.clip(places, -room, room))


def _brightest(target: Target, sent: Mapping[str, SentBeam], places: FloatArray) -> float:
    """Return the highest light level expected anywhere on the target, in suns."""
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
