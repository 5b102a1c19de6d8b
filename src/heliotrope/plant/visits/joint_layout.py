"""Where the beams of a joint visit stand on their target, and which codes they move by.

Each beam gets a place in a grid that leaves room to the border, and a movement of a few tenths of a
milliradian, or of two of the steps in which its drives move it if that is more. Beams that do not
overlap share a code, so that few photographs are needed. The light of all of them together stays
below what the target may take.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.field.joint_visits import MOST_MOVEMENT, JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, bisector, tangent_axes
from heliotrope.imaging.coded import (
    ExpectedBeam,
    coded_movements,
    shared_codes,
)
from heliotrope.optics.beam import beam_sigma
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.expected_errors import expected_errors
from heliotrope.plant.visits.resolution import LEAST_STEPS, beam_steps

#: Slope error of a mirror's surface that is assumed for the width of its beam, rad.
_SLOPE = 1e-3
#: Likely share of a mirror's size in its beam: between flat mirrors and well canted ones.
_CURVED = 0.5
#: Share of the light that a mirror is assumed to reflect.
_REFLECTED = 0.9
#: A beam keeps this many of its standard deviations from the border, and those of its place.
_BORDER, _PLACED = 2.0, 3.0
#: Numbers of codes, for 8 to 256 photographs with movements along both axes, for 8 to 128 along
#: one.
_CODES = (3, 7, 15, 31, 63, 127)
#: The verification's movements are up and down; those of first visits are to the right and left.
_UP = 1


def moments_on(
    target: Target,
    vertex: FloatArray,
    normal: FloatArray,
    width: npt.ArrayLike,
    height: npt.ArrayLike,
    flat: float = 1.0,
) -> FloatArray:
    """Return the second moments of beams on a target, m², (..., 2, 2).

    The image of the sun, widened by the mirror's slopes, and the mirror itself, seen along the
    beam.

    Parameters
    ----------
    target
        The target.
    vertex, normal
        Of the mirrors, ENU, m, and their unit normals, (..., 3).
    width, height
        Of the mirrors, m, (...).
    flat
        Share of its size that each beam has: 1 for a flat mirror, near 0 for one that is canted and
        curved for this distance.
    """
    path = np.asarray(target.center) - vertex
    slant = np.linalg.norm(path, axis=-1)
    ray = path / slant[..., None]
    size = flat * np.stack([np.asarray(width), np.asarray(height)], axis=-1) / np.sqrt(12.0)
    sides = size[..., None] * tangent_axes(normal)
    sun = beam_sigma(slant, slope=_SLOPE)[..., None, None]
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    spread = sun**2 * across + np.swapaxes(sides, -1, -2) @ sides
    # Along the beam onto the plane of the target.
    along = ray[..., :, None] * target.normal / (ray @ target.normal)[..., None, None]
    onto = target.axes @ (np.eye(3) - along)
    return np.asarray(onto @ spread @ np.swapaxes(onto, -1, -2))


@dataclass(frozen=True)
class Layout:
    """M beams on a target.

    Attributes
    ----------
    beams
        Each beam as it is expected.
    aims
        Aims without movement, ENU, m, (M, 3).
    moves
        Movements over K photographs, m right and up, (K, M, 2).
    codes
        Number of different codes.
    """

    target: Target
    beams: tuple[ExpectedBeam, ...]
    aims: FloatArray
    moves: FloatArray
    codes: int

    @property
    def names(self) -> tuple[str, ...]:
        """The heliostats."""
        return tuple(beam.heliostat for beam in self.beams)

    def points(self, photograph: int) -> dict[str, FloatArray]:
        """Return the aim of each heliostat in a photograph, ENU, m, by name."""
        move = self.moves[photograph % len(self.moves)]
        return dict(zip(self.names, self.aims + move @ self.target.axes, strict=True))

    def start(self) -> dict[str, FloatArray]:
        """Return the aims without movement, by name."""
        return dict(zip(self.names, self.aims, strict=True))


@dataclass(frozen=True)
class SentBeam:
    """What is known of a beam before it is sent.

    Attributes
    ----------
    slant
        Slant range, m.
    moments, likely
        Its widest and its likely second moments, m², (2, 2).
    variance
        Of its place along each axis, m².
    power
        Of its light, in suns m².
    step
        Steps in which it follows its aim, m right and up, (2,); see `beam_steps`.
    """

    slant: float
    moments: FloatArray
    likely: FloatArray
    variance: float
    power: float
    step: FloatArray


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
    known, wrong = beams_of(plant, target, sure)
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
    known, wrong = beams_of(
        plant, target, {name: float(np.hypot(error, again)) for name, error in errors.items()}
    )
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


def beams_of(
    plant: PlantController, target: Target, errors: Mapping[str, float]
) -> tuple[dict[str, SentBeam], dict[str, str]]:
    """Return what is known of beams, and why the others cannot be on a target, by heliostat.

    Parameters
    ----------
    plant, target
        Knows mirrors and the sun; and the target.
    errors
        Expected error of each beam, rad RMS (2-D); NaN where it does not reach the target.
    """
    field, center = plant.field, np.asarray(target.center)
    paths = {n: center - plant.beams.armature.origin_1[field.place(n)] for n in errors}
    blocked = {
        name: f"it does not see the front of {target.name}"
        for name, path in paths.items()
        if not float(path @ target.normal) < 0.0
    }
    lost = (name for name, error in errors.items() if not np.isfinite(error))
    blocked |= dict.fromkeys(lost, "out of its reach")
    names = [name for name in errors if name not in blocked]
    if not names:
        return {}, blocked
    rows = np.array([field.place(name) for name in names], dtype=np.intp)
    path, error = np.stack([paths[n] for n in names]), np.array([errors[n] for n in names])
    slant, sun = np.linalg.norm(path, axis=-1), plant.sun_vector()
    slanted = np.abs(path @ target.normal) / slant
    step = beam_steps(plant, rows, target, sun, np.broadcast_to(center, path.shape))
    normal = bisector(sun, path / slant[:, None])
    width, height = plant.beams.mirrors.width[rows], plant.beams.mirrors.height[rows]
    variance = 0.5 * (error * slant / slanted) ** 2
    power = _REFLECTED * width * height * (normal @ sun)
    wide, likely = (
        moments_on(target, center - path, normal, width, height, flat) for flat in (1.0, _CURVED)
    )
    sent: dict[str, SentBeam] = {}
    for k, coarse in enumerate(LEAST_STEPS * step.max(axis=-1) * slanted / slant):
        if coarse > MOST_MOVEMENT:
            blocked[names[k]] = (
                f"its drives move its beam in steps of {1e3 * coarse / LEAST_STEPS:.1f} mrad, the "
                f"limit is {1e3 * MOST_MOVEMENT / LEAST_STEPS:g} mrad; it is calibrated alone"
            )
        else:
            figures = float(variance[k]), float(power[k])
            sent[names[k]] = SentBeam(float(slant[k]), wide[k], likely[k], *figures, step[k])
    return sent, blocked


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


def coded(
    target: Target,
    known: Mapping[str, SentBeam],
    places: FloatArray,
    code: npt.NDArray[np.intp],
    movement: float,
    along: int | None = None,
) -> Layout:
    """Return the layout of beams at places (M, 2) that move by codes (M,).

    Parameters
    ----------
    target, known
        The target, and what is known of the M beams, by name.
    places, code
        m right of and above the centre; numbers of the codes.
    movement
        Either way, rad; more for a beam that follows its aim in coarse steps.
    along
        The only axis of the movements; None: both.
    """
    count = int(code.max(initial=0)) + 1
    axes = slice(None) if along is None else slice(along, along + 1)
    size = np.array(
        [
            max(movement * beam.slant, LEAST_STEPS * float(beam.step[axes].max()))
            for beam in known.values()
        ]
    )
    moves = coded_movements(count, along=along)[:, code] * size[:, None]
    beams = tuple(
        ExpectedBeam(name, place, beam.variance * np.eye(2), beam.likely)
        for (name, beam), place in zip(known.items(), places, strict=True)
    )
    return Layout(target, beams, target.center + places @ target.axes, moves, count)
