"""The candidate aims of each mirror, and its image at each aim."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.aims import _choice_kernels as kernels
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.beam import SUN_SIGMA
from heliotrope.optics.receiver_flux import FieldFlux, Images
from heliotrope.optics.scene import Mirrors, Scene
from heliotrope.optics.shading import IntArray
from heliotrope.optics.surfaces import Cylinder, Plate
from heliotrope.parallel import run_blocks

#: Number of heights of a mirror's candidates, and of positions across a cylinder.
HEIGHTS, AROUND = 9, 3
#: Positions across a plate: their spacing in standard deviations of the median beam, and their
#: least and greatest number. On a plate about as large as its beams, more of them add no power.
SPACING, FEWEST, MOST = 1.5, 3, 7
#: Displacement of a plate's candidates across and up from one mirror to the next, in spacings; the
#: fractional parts of the multiples of these numbers fill a square evenly. If all mirrors had their
#: candidates at the same places, the flux would have ridges there, and a tight limit would cost
#: power. On a cylinder, which mirrors face from many sides, the same gains almost nothing.
STAGGER = (0.7548776662466927, 0.5698402909980532)
#: The outermost aim lies this many standard deviations of the beam within the edge.
WITHIN = 0.5
#: Offset of the outermost aim on a cylinder, across the beam, as a fraction of the radius.
ASIDE = 0.4


@dataclass(frozen=True, eq=False)
class Candidates:
    """Candidate aims of H mirrors: K positions across the receiver at S heights each.

    Attributes
    ----------
    images
        Images at the K positions, at half height.
    loads
        Load that each value of the images puts on its cell, W/m²: the flux, plus the part of the
        allowance for errors that the mirror's own error takes up.
    weight
        Ratio of each mirror's light to the light in its images, (H,).
    shifts
        Displacements of the images in rows, (H, S).
    aims
        ENU m, (H, K · S, 3).
    power
        W, (H, K · S).
    width
        Standard deviation of each beam at the receiver, m, (H,).
    """

    images: Images
    loads: npt.NDArray[np.float32]
    weight: FloatArray
    shifts: IntArray
    aims: FloatArray
    power: FloatArray
    width: FloatArray

    @property
    def table(self) -> tuple[Any, ...]:
        """The loads in the form that the kernels expect."""
        i = self.images
        return self.loads, i.begin, i.box, i.looks, self.weight

    @cached_property
    def peak(self) -> float:
        """Median of the greatest load that each mirror puts on a cell, W/m²."""
        peaks = np.zeros(len(self.weight))
        kernels.peaks(self.table, peaks)
        return float(np.median(peaks[peaks > 0.0])) if peaks.any() else 0.0

    @property
    def middle_power(self) -> float:
        """Power with every mirror aimed at half height in the middle, W."""
        middle = self.shifts.shape[1] * (self.images.looks // 2) + self.shifts.shape[1] // 2
        return float(self.power[:, middle].sum())

    def worth(self, price: FloatArray) -> FloatArray:
        """Return the sum over cells of price times load, for each candidate, (H, K · S).

        The prices are (columns, rows).
        """
        out = np.zeros(self.aims.shape[:2])
        price32, spans = price.astype(np.float32), spans_of(price)

        def block(first: int, last: int) -> None:
            kernels.worths(first, last, self.table, self.shifts, price32, spans, out)

        run_blocks(block, len(self.weight))
        return out

    def load(self, choice: IntArray, mirrors: IntArray | None = None) -> FloatArray:
        """Return the load of chosen candidates (−1: none), W/m², (columns, rows)."""
        chosen = np.arange(len(choice)) if mirrors is None else mirrors
        load = np.zeros(self.images.shape[::-1])
        kernels.sum_of(chosen, choice, self.table, self.shifts, load)
        return load

    def flux(self, choice: IntArray) -> FloatArray:
        """Return the flux of chosen candidates (−1: none), W/m², (columns, rows)."""
        return replace(self, loads=self.images.values).load(choice)

    def charged(self, scene: Scene, rate: float) -> "Candidates":
        r"""Return the candidates with loads that include the variance of the mirrors' own errors.

        The load is $f + r s^2 |\nabla f|^2$ with the flux f, the rate r and the standard deviation
        s of the beam's displacement on the receiver.

        Parameters
        ----------
        scene
            Has one receiver; its mirrors' ``pointing`` is the covariance of their own errors.
        rate
            Load per variance of the flux, 1/(W/m²).
        """
        surface, mirrors = surface_in(scene), scene.mirrors
        moved = np.sqrt(0.5 * np.trace(mirrors.pointing, axis1=1, axis2=2)) * mirrors.slant
        # A beam that rises moves further up the receiver than across its own direction.
        rise = (surface.center - mirrors.center) @ axis_of(surface) / mirrors.slant
        step, loads = surface.height / surface.shape[0], self.images.values.copy()
        across = 0.5 * moved * step / self.images.area
        up = 0.5 * moved / (step * np.sqrt(np.maximum(1.0 - rise**2, 0.01)))
        kernels.charge(self.images.values, *self.table[1:], rate, across, up, loads)
        return replace(self, loads=loads)

    def relit(self, weight: FloatArray) -> "Candidates":
        """Return the candidates for a different amount of light on each mirror, (H,)."""
        ratio = weight / np.where(self.weight > 0.0, self.weight, 1.0)
        return replace(self, weight=weight, power=as_float(self.power * ratio[:, None]))


def spans_of(price: FloatArray) -> IntArray:
    """Return the first and the end row of the nonzero prices in each column, (columns, 2)."""
    some = (price > 0.0).astype(np.int64)
    first = some.argmax(axis=1)
    end = price.shape[1] - np.flip(some, axis=1).argmax(axis=1)
    return np.asarray(np.stack([first, end], axis=-1) * some.max(axis=1, keepdims=True))


def surface_in(scene: Scene) -> Plate | Cylinder:
    """Return the only receiver of a scene.

    Raises
    ------
    InputError
        If there is more than one receiver, or the receiver has no rows and columns.
    """
    if len(scene.surfaces) != 1:
        names = ", ".join(surface.name for surface in scene.surfaces)
        raise InputError(f"aims: {len(scene.surfaces)} receivers, {names}; choose one")
    surface = scene.surfaces[0]
    if not isinstance(surface, Plate | Cylinder):
        raise InputError(
            f"receiver {surface.name}: aims can be chosen only on flat and cylindrical receivers; "
            "use one of these"
        )
    return surface


def turns(count: int) -> FloatArray:
    """Return numbers from 0 to 1 that are evenly spread and differ between neighbours, (count,)."""
    # The fractional parts of the multiples of the golden ratio.
    return as_float((np.arange(count) * 0.6180339887498949) % 1.0)


def middles(scene: Scene) -> FloatArray:
    """Return the points at half height that face each mirror, ENU m, (H, 3)."""
    return _across(scene, np.zeros((len(scene.mirrors), 1)))[:, 0]


def _across(scene: Scene, offset: FloatArray) -> FloatArray:
    """Return points on the receiver, (H, K, 3), at offsets (H, K) to the right, m.

    Right is as seen from each mirror.
    """
    surface = surface_in(scene)
    if isinstance(surface, Plate):
        return as_float(surface.center + offset[..., None] * surface.right)
    away = scene.mirrors.center - surface.center
    angle = np.arctan2(away @ surface.side, away @ surface.front)[:, None]
    angle = angle + np.arcsin(np.clip(offset / surface.radius, -1.0, 1.0))
    low, high = surface.span
    if high - low < 2.0 * np.pi - 1e-6:
        angle = np.clip(angle, 0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high)
    return as_float(surface.center + surface.radius * surface.outward(angle))


def widths(mirrors: Mirrors) -> FloatArray:
    """Return the beams' standard deviations at the receiver, m, (H,)."""
    angle = SUN_SIGMA**2 + 4.0 * mirrors.slope**2
    angle = angle + 0.5 * np.trace(mirrors.pointing, axis1=1, axis2=2)
    return as_float(mirrors.slant * np.sqrt(angle))


def regions(scene: Scene) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the beams' standard deviations at the receiver, and how far aims may be displaced.

    The displacements are to either side and up or down from `middles`; all three are in m, (H,).
    """
    surface, width = surface_in(scene), widths(scene.mirrors)
    room = np.maximum(0.5 * surface.height - WITHIN * width, 0.0)
    if isinstance(surface, Plate):
        return width, np.maximum(0.5 * surface.width - WITHIN * width, 0.0), room
    return width, np.full(len(width), ASIDE * surface.radius), room


def axis_of(surface: Plate | Cylinder) -> FloatArray:
    """Return the direction in which a receiver's height is measured, (3,)."""
    return surface.up if isinstance(surface, Plate) else surface.axis


def on_receiver(scene: Scene, place: FloatArray) -> FloatArray:
    """Return points displaced from `middles` to the right and up by ``place`` (H, 2), m, (H, 3)."""
    across = _across(scene, place[:, :1])[:, 0]
    return as_float(across + place[:, 1:] * axis_of(surface_in(scene)))


def _places(far: FloatArray, count: int, stagger: float) -> FloatArray:
    """Return positions from −far to far (H,), staggered from mirror to mirror, (H, count).

    The middle position is 0 for all mirrors.
    """
    even = np.linspace(-1.0, 1.0, count)
    aside = (stagger * np.arange(len(far)) + 0.5) % 1.0 - 0.5
    moved = np.clip(even + 2.0 / (count - 1) * aside[:, None], -1.0, 1.0)
    moved[:, count // 2] = 0.0
    return as_float(moved * far[:, None])


def _across_and_up(
    surface: Plate | Cylinder, width: FloatArray, far: FloatArray, room: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the displacements of the candidates from `middles`, m, (H, K) and (H, S)."""
    if isinstance(surface, Cylinder):
        return _places(far, AROUND, 0.0), _places(room, HEIGHTS, 0.0)
    side = np.ceil(np.median(far) / (SPACING * np.median(width)))
    count = int(np.clip(2 * side + 1, FEWEST, MOST))
    return _places(far, count, STAGGER[0]), _places(room, HEIGHTS, STAGGER[1])


def candidates(engine: FieldFlux) -> Candidates:
    """Return the candidates of the mirrors of a scene with one receiver.

    Parameters
    ----------
    engine
        Flux engine of the scene, with aims on the receiver; see `FieldFlux.images` for what stays
        constant.

    Raises
    ------
    InputError
        If there is more than one receiver, or no mirror reaches any cell.
    """
    scene = engine.scene
    surface, mirrors = surface_in(scene), scene.mirrors
    width, far, room = regions(scene)
    rows, step = surface.shape[0], surface.height / surface.shape[0]
    across, up = _across_and_up(surface, width, far, room)
    shifts, looks = np.round(up / step).astype(np.int64), _across(scene, across)
    images = engine.images(looks, np.abs(shifts).max(axis=1))
    aims = looks[:, :, None, :] + (step * shifts)[:, None, :, None] * axis_of(surface)
    aims = as_float(aims.reshape(len(mirrors), -1, 3))
    empty = np.zeros(aims.shape[:2])
    built = Candidates(images, images.values, np.ones(len(mirrors)), shifts, aims, empty, width)
    power = built.worth(np.full((surface.shape[1], rows), images.area))
    if not power.any():
        advice = "turn the receiver towards the field, or choose another sun position"
        if scene.dni <= 0.0:
            advice = f"the direct normal irradiance is {scene.dni:g} W/m²; use one above 0"
        raise InputError(
            f"receiver {surface.name}: none of the {len(mirrors)} mirrors sends light to any of "
            f"its cells; {advice}"
        )
    return replace(built, power=power)
