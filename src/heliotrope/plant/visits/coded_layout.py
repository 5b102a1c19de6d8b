"""Beams of a coded visit: their positions on a surface, and the codes by which they move.

A beam moves by a few tenths of a milliradian to a few milliradians, or by two drive steps if these
are larger.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from heliotrope.field.coded_visits import CodedSettings
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, bisector, tangent_axes
from heliotrope.imaging.coded import ExpectedBeam, coded_movements
from heliotrope.optics.beam import beam_sigma
from heliotrope.plant.controller import PlantController
from heliotrope.plant.visits.resolution import LEAST_STEPS, beam_steps

#: Slope error of a mirror's surface that is assumed when computing the width of its beam, rad.
_SLOPE = 1e-3
#: Fraction of the light that a mirror is assumed to reflect.
REFLECTED = 0.9
#: Likely fraction of a mirror's size in its beam, between flat mirrors and well canted ones.
_CURVED = 0.5


def moments_on(
    target: Target,
    vertex: FloatArray,
    normal: FloatArray,
    width: npt.ArrayLike,
    height: npt.ArrayLike,
    flat: float = 1.0,
) -> FloatArray:
    """Return the second moments of beams on a target, m², (..., 2, 2).

    A beam combines the image of the sun, widened by the mirror's slope errors, and the outline of
    the mirror as seen along the beam.

    Parameters
    ----------
    target
        The target.
    vertex, normal
        Vertices of the mirrors, ENU, m, and their unit normals, (..., 3).
    width, height
        Size of the mirrors, m, (...).
    flat
        Fraction of the mirror's size that appears in each beam: 1 for a flat mirror, near 0 for a
        mirror that is canted and curved for this distance.
    """
    path = np.asarray(target.center) - vertex
    slant = np.linalg.norm(path, axis=-1)
    ray = path / slant[..., None]
    size = flat * np.stack([np.asarray(width), np.asarray(height)], axis=-1) / np.sqrt(12.0)
    sides = size[..., None] * tangent_axes(normal)
    sun = beam_sigma(slant, slope=_SLOPE)[..., None, None]
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    spread = sun**2 * across + np.swapaxes(sides, -1, -2) @ sides
    # Project along the beam onto the plane of the target.
    along = ray[..., :, None] * target.normal / (ray @ target.normal)[..., None, None]
    onto = target.axes @ (np.eye(3) - along)
    return np.asarray(onto @ spread @ np.swapaxes(onto, -1, -2))


@dataclass(frozen=True)
class Layout:
    """M beams on a target.

    Attributes
    ----------
    beams
        Expected beams.
    aims
        Aims without movement, ENU, m, (M, 3).
    moves
        Movements over K photographs, m right and up, (K, M, 2).
    codes
        Number of different codes.
    powers
        Expected power of each beam, in any common unit, (M,); a beam with a different power is
        mixed with other light. None: the powers are not compared.
    first
        Whether new parameters are verified by a further series of photographs.
    left_out
        Why the remaining heliostats do not take part, by name.
    """

    target: Target
    beams: tuple[ExpectedBeam, ...]
    aims: FloatArray
    moves: FloatArray
    codes: int
    powers: FloatArray | None = None
    first: bool = False
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the heliostats."""
        return tuple(beam.heliostat for beam in self.beams)

    def points(self, photograph: int) -> dict[str, FloatArray]:
        """Return the aim of each heliostat in a photograph, ENU, m, by name."""
        move = self.moves[photograph % len(self.moves)]
        return dict(zip(self.names, self.aims + move @ self.target.axes, strict=True))

    def start(self) -> dict[str, FloatArray]:
        """Return the aims before any movement, by name."""
        return dict(zip(self.names, self.aims, strict=True))


@dataclass(frozen=True)
class SentBeam:
    """What is known about a beam before it is sent.

    Attributes
    ----------
    slant
        Slant range, m.
    moments, likely
        Largest and likely second moments of the beam, m², (2, 2).
    variance
        Variance of its position along each axis, m².
    power
        Power of its light, suns · m².
    step
        Size of the steps in which it follows its aim, m right and up, (2,); see `beam_steps`.
    """

    slant: float
    moments: FloatArray
    likely: FloatArray
    variance: float
    power: float
    step: FloatArray

    def movement(self, angle: float, axes: slice = slice(None)) -> float:
        """Return the size of a movement along some axes, m; it is larger for coarse steps."""
        return max(angle * self.slant, LEAST_STEPS * float(self.step[axes].max()))


def beams_of(
    plant: PlantController,
    target: Target,
    errors: Mapping[str, float],
    settings: CodedSettings,
    aims: Mapping[str, FloatArray] | None = None,
) -> tuple[dict[str, SentBeam], dict[str, str]]:
    """Return the known beams, and why other beams cannot be on a surface, by heliostat.

    Parameters
    ----------
    plant, target
        Plant with its heliostats and the sun; and the target, or the face of a receiver.
    errors
        Expected error of each beam, rad RMS (2-D); NaN if it does not reach the target.
    settings
        Settings of the visit, which limit the size of the movements.
    aims
        Aims of the heliostats, ENU, m, each (3,); None: the centre.
    """
    field, at = plant.field, aims or dict.fromkeys(errors, np.asarray(target.center))
    paths = {n: at[n] - plant.beams.armature.origin_1[field.place(n)] for n in errors}
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
    aim = np.stack([at[n] for n in names])
    step = beam_steps(plant, rows, target, sun, aim)
    normal = bisector(sun, path / slant[:, None])
    width, height = plant.beams.mirrors.width[rows], plant.beams.mirrors.height[rows]
    variance = 0.5 * (error * slant / slanted) ** 2
    power = REFLECTED * width * height * (normal @ sun)
    wide, likely = (
        moments_on(target, aim - path, normal, width, height, flat) for flat in (1.0, _CURVED)
    )
    sent: dict[str, SentBeam] = {}
    most = settings.most_movement
    for k, coarse in enumerate(LEAST_STEPS * step.max(axis=-1) * slanted / slant):
        if coarse > most:
            blocked[names[k]] = (
                f"its drives move its beam in steps of {1e3 * coarse / LEAST_STEPS:.1f} mrad, the "
                f"limit is {1e3 * most / LEAST_STEPS:g} mrad; it is calibrated alone"
            )
        else:
            figures = float(variance[k]), float(power[k])
            sent[names[k]] = SentBeam(float(slant[k]), wide[k], likely[k], *figures, step[k])
    return sent, blocked


def coded(
    target: Target,
    known: Mapping[str, SentBeam],
    places: FloatArray,
    code: npt.NDArray[np.intp],
    movement: float,
    along: int | None = None,
) -> Layout:
    """Return the layout of M beams at given places, (M, 2), which move by given codes, (M,).

    Parameters
    ----------
    target, known
        The target, and what is known about the M beams, by name.
    places, code
        Places, m right of and above the centre, and code numbers.
    movement
        Amplitude in both directions, rad; larger for a beam that follows its aim in coarse steps.
    along
        The only axis of the movements; None: the beams move along both axes.
    """
    count = int(code.max(initial=0)) + 1
    axes = slice(None) if along is None else slice(along, along + 1)
    size = np.array([beam.movement(movement, axes) for beam in known.values()])
    moves = coded_movements(count, along=along)[:, code] * size[:, None]
    beams = tuple(
        ExpectedBeam(name, place, beam.variance * np.eye(2), beam.likely)
        for (name, beam), place in zip(known.items(), places, strict=True)
    )
    return Layout(target, beams, target.center + places @ target.axes, moves, count)
