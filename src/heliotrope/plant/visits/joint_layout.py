"""Where the beams of a joint visit stand on their target, and which codes they share.

Each beam gets a place in a grid that leaves room to the border. Beams that do not overlap share a
code, so that few photographs are needed. The light of all of them together stays below what the
target may take.
"""

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded import shared_codes
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.coded_layout import Layout, SentBeam, beams_of, coded
from heliotrope.plant.visits.expected_errors import expected_errors

#: A beam keeps this many of its standard deviations from the border, and those of its place.
_BORDER, _PLACED = 2.0, 3.0
#: Numbers of codes, for 8 to 256 photographs with movements along both axes, for 8 to 128 along
#: one.
_CODES = (3, 7, 15, 31, 63, 127)
#: The verification's movements are up and down; those of first visits are to the right and left.
_UP = 1


def arranged(
    plant: PlantController,
    target: Target,
    heliostats: tuple[str, ...],
    settings: JointSettings,
) -> tuple[Layout, dict[str, str]]:
    """Return the layout of a joint visit, and why some of the heliostats have no place in it.

    Parameters
    ----------
    plant
        Knows mirrors, calibrations and the sun.
    target, heliostats
        The target, and names.
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
        wrong[name] = f"{settings.most} heliostats are on {target.name} already"
        del known[name]
    places, dazzling = _darkened(target, known, settings)
    too_bright = f"the light on {target.name} would exceed {settings.brightest:g} suns"
    wrong |= dict.fromkeys(dazzling, too_bright)
    code = _shared(known, places, along=None)
    return coded(target, known, places, code, settings.movement), wrong


def verifying(
    plant: PlantController,
    target: Target,
    errors: Mapping[str, float],
    settings: JointSettings,
    *,
    own: bool = False,
) -> tuple[Layout, dict[str, str], tuple[str, ...]]:
    """Return the layout of a joint verification.

    With it, why some heliostats have no place on the target, and those that would make it too
    bright: they can be verified by another stack.

    Parameters
    ----------
    plant, target, settings
        As for `arranged`.
    errors
        Expected beam error of each heliostat with its new parameters, rad RMS (2-D).
    own
        Whether each has a code of its own.
    """
    again = np.sqrt(2.0) * settings.visit
    all_errors = {name: float(np.hypot(error, again)) for name, error in errors.items()}
    known, wrong = beams_of(plant, target, all_errors, settings)
    places, dazzling = _darkened(target, known, settings)
    code = np.arange(len(known)) if own else _shared(known, places, along=_UP)
    return coded(target, known, places, code, settings.movement, along=_UP), wrong, dazzling


def _darkened(
    target: Target, known: dict[str, SentBeam], settings: JointSettings
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return places, and the beams that make the target too bright; these are known no more."""
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
    """Return why a beam with an expected error on its target is not known well enough, if so."""
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

    NaN for one that cannot reach it, or was never calibrated and has no ``model``; see
    `expected_errors`.
    """
    aims = np.broadcast_to(target.center, (len(heliostats), 3))
    found = expected_errors(plant, heliostats, aims, model)
    # The priors of a heliostat that was never calibrated hold what is drawn anew at each visit.
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
    # As many columns and rows as make the steps alike, in beams.
    ratio = float(np.clip((size[0] / sigma[0] + 1e-9) / (size[1] / sigma[1] + 1e-9), 0.02, 50.0))
    columns = int(np.clip(round(float(np.sqrt(len(known) * ratio))), 1, len(known)))
    rows = -(-len(known) // columns)
    x, y = (
        np.linspace(low[k], high[k], n) if n > 1 else np.array([0.5 * (low[k] + high[k])])
        for k, n in enumerate((columns, rows))
    )
    return np.array([(a, b) for b in y for a in x])[: len(known)]


def _too_bright(known: Mapping[str, SentBeam], places: FloatArray, limit: float) -> str:
    """Return the beam at the brightest place if that is above a limit, in suns; else "".

    One that is alone may be as bright as in a visit of its own.
    """
    if len(known) < 2:
        return ""
    power = np.array([beam.power for beam in known.values()])
    light = power @ bells(places, places, np.array([beam.likely for beam in known.values()]))
    return list(known)[int(np.argmax(light))] if light.max() > limit else ""


def bells(points: FloatArray, places: FloatArray, moments: FloatArray) -> FloatArray:
    """Return the light of M beams of power 1 at n points of their target, 1/m², (M, n).

    Parameters
    ----------
    points, places
        m right of and above the centre, (n, 2) and (M, 2).
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
    """Return the code of each beam: as few codes as keep beams of one code apart, (M,)."""
    spread = np.array([b.moments + b.variance * np.eye(2) for b in known.values()])
    for few in _CODES if len(known) else ():
        # A stack of movements along one axis has twice as many codes.
        code = shared_codes(places, spread, few if along is None else 2 * few + 1)
        if code is not None:
            return code
    return np.arange(len(known), dtype=np.intp)
