"""Where the beams of a joint visit stand on their target, and which codes they move by.

Each beam gets a place in a grid that leaves room to the border, and a movement of a few tenths of a
milliradian, or of two of the steps in which its drives move it if that is more. Beams that do not
overlap share a code, so that few photographs are needed. The light of all of them together stays
below what the target may take.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.uncertainty import expected_error
from heliotrope.field.joint_visits import MOST_MOVEMENT, JointSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, bisector
from heliotrope.imaging.coded import (
    ExpectedBeam,
    coded_movements,
    shared_codes,
)
from heliotrope.optics.beam import beam_sigma
from heliotrope.plant.controller import PlantController
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
    width: float,
    height: float,
    flat: float = 1.0,
) -> FloatArray:
    """Return the second moments of a beam on a target, m², (2, 2).

    The image of the sun, widened by the mirror's slopes, and the mirror itself, seen along the
    beam.

    Parameters
    ----------
    target
        The target.
    vertex, normal
        Of the mirror, ENU, m, and its unit normal, (3,).
    width, height
        Of the mirror, m.
    flat
        Share of its size that the beam has: 1 for a flat mirror, near 0 for one that is canted and
        curved for this distance.
    """
    way = np.asarray(target.center) - vertex
    slant = float(np.linalg.norm(way))
    ray = way / slant
    right = np.cross((0.0, 0.0, 1.0), normal)
    size = float(np.linalg.norm(right))
    right = right / size if size > 1e-9 else np.array([1.0, 0.0, 0.0])
    sides = flat * np.stack([width * right, height * np.cross(normal, right)]) / np.sqrt(12.0)
    sun = float(beam_sigma(slant, slope=_SLOPE))
    spread = sun**2 * (np.eye(3) - np.outer(ray, ray)) + sides.T @ sides
    # Along the beam onto the plane of the target.
    onto = target.axes @ (np.eye(3) - np.outer(ray, target.normal) / float(ray @ target.normal))
    return np.asarray(onto @ spread @ onto.T)


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
    wrong: dict[str, str] = {}
    known: dict[str, SentBeam] = {}
    for name in heliostats:
        found = _known(plant, target, name, settings)
        if isinstance(found, str):
            wrong[name] = found
        else:
            known[name] = found
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
    wrong: dict[str, str] = {}
    known: dict[str, SentBeam] = {}
    for name, error in errors.items():
        found = beam_of(plant, target, name, float(np.hypot(error, np.sqrt(2.0) * settings.visit)))
        if isinstance(found, str):
            wrong[name] = found
        else:
            known[name] = found
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


def _known(
    plant: PlantController, target: Target, name: str, settings: JointSettings
) -> SentBeam | str:
    error = error_on(plant, target, name, settings)
    if error is None:
        return "it has no calibration yet; it is calibrated alone first"
    if not error <= settings.known:
        return (
            f"its beam is known to {1e3 * error:.1f} mrad only, the limit is "
            f"{1e3 * settings.known:g} mrad; it is calibrated alone first"
        )
    return beam_of(plant, target, name, error)


def error_on(
    plant: PlantController, target: Target, name: str, settings: JointSettings
) -> float | None:
    """Return the expected error of a beam on a target, rad RMS (2-D); None if never calibrated."""
    record = plant.beliefs.record(name)
    if record is None:
        return None
    covariance = record.covariance_at(plant.clock.utc().timestamp())
    expected = expected_error(
        plant.beliefs.present(name),
        record.names,
        covariance,
        plant.sun_vector(),
        target.center,
        current=plant.field.counts(np.array([plant.field.place(name)])),
    )
    return float(np.hypot(expected.rms[0], np.sqrt(2.0) * settings.visit))


def beam_of(plant: PlantController, target: Target, name: str, error: float) -> SentBeam | str:
    """Return what is known of a beam with an expected error (rad RMS, 2-D), or why it cannot be."""
    row, (group, place) = plant.field.place(name), plant.design.find(name)
    vertex = np.asarray(plant.beams.armature.origin_1[row], dtype=np.float64)
    way = target.center - vertex
    slant = float(np.linalg.norm(way))
    sun = plant.sun_vector()
    if not float(way @ target.normal) < 0.0:
        return f"it does not see the front of {target.name}"
    slanted = abs(float(way @ target.normal)) / slant
    step = beam_steps(plant, row, target, sun, np.asarray(target.center))
    if (coarse := LEAST_STEPS * float(step.max()) * slanted / slant) > MOST_MOVEMENT:
        return (
            f"its drives move its beam in steps of {1e3 * coarse / LEAST_STEPS:.1f} mrad, the "
            f"limit is {1e3 * MOST_MOVEMENT / LEAST_STEPS:g} mrad; it is calibrated alone"
        )
    normal = bisector(sun, way / slant)
    width, height = float(group.width[place]), float(group.height[place])
    variance = 0.5 * (error * slant / slanted) ** 2
    power = _REFLECTED * width * height * float(normal @ sun)
    wide, likely = (
        moments_on(target, vertex, normal, width, height, flat) for flat in (1.0, _CURVED)
    )
    return SentBeam(slant, wide, likely, variance, power, step)


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
    light = np.zeros(len(places))
    for beam, place in zip(known.values(), places, strict=True):
        away = places - place
        form = np.einsum("mi,ij,mj->m", away, np.linalg.inv(beam.likely), away)
        peak = beam.power / (2.0 * np.pi * float(np.sqrt(np.linalg.det(beam.likely))))
        light += peak * np.exp(-0.5 * form)
    return list(known)[int(np.argmax(light))] if light.max() > limit else ""


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
