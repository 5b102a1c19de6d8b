"""Glare: the effect of heliostat beams on the eye; for information only.

The method has the form of Ho, Ghanbari and Diver, "Methodology to assess potential glint and glare
hazards from concentrating solar power plants", J. Sol. Energy Eng. 133 (2011) 031021. We have not
read the paper itself: formulae and constants come from later descriptions and carry no equation
numbers, and the tests check only one reference case, a look at the bare sun. No decision of the
plant rests on this module: where people may look into beams, the plant requires less than one sun
(`heliotrope.plant.field.aims.MOST_SUNS`). Do not approve a place for people on the basis of these
figures. Internally, irradiances are in W/m² (in the paper: W/cm², 1 W/cm² = 10⁴ W/m²).

Limits. The thresholds apply to a short look (0.15 s, the blink reflex) with the naked eye in
daylight; they do not apply to binoculars, telescopes or cameras, nor to a forced stare. The sun is
modelled as a uniform disk; its centre is in fact about a fifth brighter than its mean. Mirrors are
disks with an ideal focus and no slope error, which errs on the safe side. Atmospheric attenuation
is ignored.
"""

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize, tangent_axes
from heliotrope.optics.beam import NOMINAL_DNI, SUN_RADIUS, Beams, crossing

#: Retinal irradiance times subtended angle that causes a burn, W/m² · rad (0.118 W/cm² · rad), and
#: the angle above which the irradiance alone counts, rad (1 W/cm² there).
BURN, WIDE = 1180.0, 0.118
#: Retinal irradiance that leaves an after-image at 1 rad, W/m² (3.59e-5 W/cm²), and the power
#: of the angle by which the threshold falls.
FLASH, FLASH_POWER = 0.359, 1.77
#: Smaller sources are treated as this large, rad, which is far below the blur of any eye.
SMALLEST = 1e-6


@dataclass(frozen=True)
class Eye:
    """An eye: daylight-adapted pupil (m), focal length (m), transmittance of the ocular media."""

    pupil: float = 2e-3
    focal_length: float = 17e-3
    transmission: float = 0.5

    def __post_init__(self) -> None:
        for name in ("pupil", "focal_length"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"eye: {name} must be above 0 and finite, not {value} m")
        if not 0.0 < self.transmission <= 1.0:
            raise InputError(
                f"eye: transmission must be above 0 and at most 1, not {self.transmission}"
            )


#: The eye assumed in the paper.
DAYLIGHT = Eye()


class Hazard(IntEnum):
    """Effect of a short look into a beam."""

    LOW = 0
    AFTER_IMAGE = 1
    DAMAGE = 2

    @property
    def text(self) -> str:
        """The effect in words."""
        return _HAZARD_TEXTS[self]


_HAZARD_TEXTS = {
    Hazard.LOW: "low potential for a temporary after-image",
    Hazard.AFTER_IMAGE: "potential for a temporary after-image",
    Hazard.DAMAGE: "potential for permanent eye damage (burn of the retina)",
}


def retinal_irradiance(
    corneal: npt.ArrayLike, subtended: npt.ArrayLike, eye: Eye = DAYLIGHT
) -> FloatArray:
    """Return the irradiance of the image on the retina, W/m², E_r = E_c d² τ / (f ω)².

    Parameters
    ----------
    corneal
        E_c, irradiance at the eye, W/m².
    subtended
        ω, full angle of the source as seen from the eye, rad, above 0.
    eye
        The eye, with its pupil d, focal length f and transmission τ.
    """
    e, w = _checked(corneal, subtended)
    return as_float(e * eye.pupil**2 * eye.transmission / (eye.focal_length * w) ** 2)


def burn_threshold(subtended: npt.ArrayLike) -> FloatArray:
    """Return the retinal irradiance from which permanent damage is possible, W/m².

    It is 0.118 W/cm² / ω below ω = 0.118 rad, and 1 W/cm² above.
    """
    _, w = _checked(0.0, subtended)
    return as_float(BURN / np.minimum(w, WIDE))


def flash_threshold(subtended: npt.ArrayLike) -> FloatArray:
    """Return the retinal irradiance from which an after-image is possible, W/m².

    It is 3.59e-5 W/cm² / ω^1.77, with ω in rad.
    """
    _, w = _checked(0.0, subtended)
    return as_float(FLASH / w**FLASH_POWER)


@dataclass(frozen=True)
class Glare:
    """The exposure of an eye at each location (...).

    Attributes
    ----------
    burn, flash
        Retinal irradiance divided by the thresholds of damage and of an after-image; 1 is at the
        threshold.
    corneal
        Irradiance of all sources together at the eye, W/m².
    subtended
        Full angle of a disk with the solid angle of all sources together, rad; 0 without sources.
    """

    burn: FloatArray
    flash: FloatArray
    corneal: FloatArray
    subtended: FloatArray

    @property
    def hazard(self) -> npt.NDArray[np.int8]:
        """`Hazard` as integers; a value at a threshold counts as above it."""
        worse = np.where(self.flash >= 1.0, Hazard.AFTER_IMAGE, Hazard.LOW)
        return np.asarray(np.where(self.burn >= 1.0, Hazard.DAMAGE, worse), dtype=np.int8)


def glare_of_one(corneal: npt.ArrayLike, subtended: npt.ArrayLike, eye: Eye = DAYLIGHT) -> Glare:
    """Return the hazard of one source: corneal irradiance (W/m²) and subtended angle (rad)."""
    retinal = retinal_irradiance(corneal, subtended, eye)
    w = np.broadcast_to(as_float(subtended), retinal.shape)
    e = np.broadcast_to(as_float(corneal), retinal.shape)
    return Glare(retinal / burn_threshold(w), retinal / flash_threshold(w), e, w)


def glare_of_many(corneal: npt.ArrayLike, subtended: npt.ArrayLike, eye: Eye = DAYLIGHT) -> Glare:
    """Return an upper bound of the hazard of several sources seen at once.

    Images of sources that lie side by side may touch on the retina and heat it as one. The
    arrangement of the sources is not considered. Instead, the worst selection of sources is treated
    as one disk with the sum of their solid angles. An additional source can only increase the
    bound.

    Parameters
    ----------
    corneal, subtended
        Irradiance and subtended angle of each source, W/m² and rad, (..., N); sources of 0 W/m² or
        0 rad are dark.

    Notes
    -----
    Of all selections with solid angle W (in units of ω²), none has more irradiance than g(W), which
    selects the brightest sources first, with a fraction of the last source. g is concave and
    piecewise linear. Both thresholds depend on g and W as g / W^a with a constant a from 0 to 1,
    which has no maximum in the interior of a linear piece; a changes only at ω = 0.118 rad. The
    maximum is therefore at one of the corners or at that point, and is found in N log N.
    """
    e, w = np.broadcast_arrays(as_float(corneal), as_float(subtended))
    if e.ndim == 0 or not (np.isfinite(e).all() and np.isfinite(w).all()):
        raise InputError("glare of many: irradiances and angles must be finite, (..., N)")
    if (e < 0.0).any() or (w < 0.0).any():
        raise InputError("glare of many: irradiances and angles must be 0 or more")
    bright = (e > 0.0) & (w > 0.0)
    e, size = np.where(bright, e, 0.0), np.where(bright, np.maximum(w, SMALLEST) ** 2, 0.0)
    radiance = np.divide(e, size, out=np.zeros_like(e), where=bright)
    order = np.argsort(-radiance, axis=-1)
    light = np.cumsum(np.take_along_axis(e, order, axis=-1), axis=-1)
    room = np.cumsum(np.take_along_axis(size, order, axis=-1), axis=-1)
    corner_light, corner_room = _corner(light, room)
    every_light = np.concatenate([light, corner_light[..., None]], axis=-1)
    # No source is wider than the half-space; a smaller angle errs on the safe side.
    angle = np.minimum(np.sqrt(np.concatenate([room, corner_room[..., None]], axis=-1)), math.pi)
    dark = angle == 0.0
    combined = glare_of_one(every_light, np.where(dark, 1.0, angle), eye)
    total = np.sqrt(room[..., -1]) if e.shape[-1] else np.zeros(e.shape[:-1])
    return Glare(
        np.max(np.where(dark, 0.0, combined.burn), axis=-1),
        np.max(np.where(dark, 0.0, combined.flash), axis=-1),
        np.sum(e, axis=-1),
        as_float(total),
    )


def _corner(light: FloatArray, room: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return g and W where ω passes 0.118 rad; 0 and 0 if it does not."""
    wide = WIDE * WIDE
    before = np.concatenate([np.zeros((*room.shape[:-1], 1)), room[..., :-1]], axis=-1)
    below = np.concatenate([np.zeros((*light.shape[:-1], 1)), light[..., :-1]], axis=-1)
    passes = (before < wide) & (room >= wide)
    if not room.shape[-1]:
        return np.zeros(room.shape[:-1]), np.zeros(room.shape[:-1])
    share = np.divide(wide - before, room - before, out=np.zeros_like(room), where=passes)
    at = np.sum(np.where(passes, below + share * (light - below), 0.0), axis=-1)
    return as_float(at), as_float(np.where(passes.any(axis=-1), wide, 0.0))


def glare_at(
    given: Beams, points: npt.ArrayLike, *, dni: float = NOMINAL_DNI, eye: Eye = DAYLIGHT
) -> Glare:
    """Return the hazard to an eye that looks into the beams from points (P, 3).

    Each beam is a source as wide as the part of its mirror in which the sun is visible. A mirror
    with concentration C subtends ω = 2 β √C, because it shows the sun at the sun's radiance.
    """
    _irradiance(dni)
    concentration = crossing(given, points, dni=dni).concentration
    corneal = dni * given.mirrors.reflectivity * concentration
    return glare_of_many(corneal, 2.0 * SUN_RADIUS * np.sqrt(concentration), eye)


def safe_range(
    area: float,
    focus: float = math.inf,
    *,
    dni: float = NOMINAL_DNI,
    reflectivity: float = 1.0,
    eye: Eye = DAYLIGHT,
) -> tuple[float, float]:
    """Return the range of distances along one beam at which a look into it may cause a burn, m.

    The range is (0, 0) if the beam causes burns nowhere along it. On the axis the ratio to the
    threshold is K ω with K = ρ DNI d² τ / (4 β² f² · 0.118 W/cm²) while ω < 0.118 rad, and ω = 2
    min(R / x, β / |1 − x/b|); the threshold is reached where ω = 1 / K.

    Parameters
    ----------
    area, focus
        Area and focal length of the mirror, m² and m.
    dni, reflectivity
        Irradiance, W/m², and reflectivity, 0 to 1.
    eye
        The observer's eye.
    """
    _irradiance(dni)
    if not (area > 0.0 and math.isfinite(area) and focus > 0.0 and 0.0 < reflectivity <= 1.0):
        raise InputError(
            f"mirror of {area} m², focus {focus} m, reflectivity {reflectivity}: area and focus "
            "must be above 0, reflectivity above 0 and at most 1"
        )
    image = reflectivity * dni * eye.pupil**2 * eye.transmission
    gain = image / (4.0 * SUN_RADIUS**2 * eye.focal_length**2 * BURN)
    if gain * WIDE < 1.0:
        return 0.0, 0.0
    wide = 1.0 / gain
    # |1 − x/b| ≤ 2 β / ω bounds the distance from both sides, R / x ≥ ω / 2 from above.
    slack = 2.0 * SUN_RADIUS / wide
    near = 0.0 if slack >= 1.0 else focus * (1.0 - slack)
    far = min(focus * (1.0 + slack), 2.0 * math.sqrt(area / math.pi) / wide)
    return (near, far) if far > near else (0.0, 0.0)


@dataclass(frozen=True)
class GlareMap:
    """Hazards on a plane grid through a standby point.

    Attributes
    ----------
    right, up
        Offsets from the point, to the right and upwards as seen from the side that the normal
        points to (east and north in a horizontal plane), m, (W,) and (H,).
    points
        ENU, m, (H, W, 3).
    glare
        Hazards, as arrays of shape (H, W).
    """

    right: FloatArray
    up: FloatArray
    points: FloatArray
    glare: Glare

    @property
    def radius(self) -> float:
        """Largest distance from the point at which a look may cause a burn, m; 0 if none may."""
        bad = self.glare.hazard == Hazard.DAMAGE
        away = np.hypot(*np.meshgrid(self.right, self.up))
        return float(np.max(np.where(bad, away, 0.0)))


def glare_map(
    given: Beams,
    center: npt.ArrayLike,
    size: float,
    cells: int,
    *,
    normal: npt.ArrayLike = (0.0, 0.0, 1.0),
    dni: float = NOMINAL_DNI,
    eye: Eye = DAYLIGHT,
) -> GlareMap:
    """Return the hazards on a square around a standby point.

    Parameters
    ----------
    given
        Beams at standby there, and any other beams.
    center
        ENU, m, (3,).
    size
        Side of the square, m.
    cells
        Number of grid points per side, at least 2.
    normal
        Normal of the plane of the square, (3,).
    dni
        W/m².
    eye
        The observer's eye.
    """
    middle = as_vectors(center, "center")
    if not (math.isfinite(size) and size > 0.0 and cells >= 2):
        raise InputError(
            f"map of {size} m and {cells} cells: the size must be above 0, with 2 cells or more"
        )
    # Seen against the normal: from above, east is to the right and north is up.
    axes = tangent_axes(-normalize(normal, "normal"))
    line = np.linspace(-0.5 * size, 0.5 * size, cells)
    points = middle + line[:, None, None] * axes[1] + line[None, :, None] * axes[0]
    rows = [glare_at(given, row, dni=dni, eye=eye) for row in points]
    together = Glare(
        *(
            np.stack([getattr(r, n) for r in rows])
            for n in ("burn", "flash", "corneal", "subtended")
        )
    )
    return GlareMap(line, line, points, together)


def safe_distance(
    given: Beams,
    center: npt.ArrayLike,
    *,
    limit: Hazard = Hazard.DAMAGE,
    reach: float = 200.0,
    step: float = 0.5,
    dni: float = NOMINAL_DNI,
    eye: Eye = DAYLIGHT,
) -> float:
    """Return the radius around a standby point beyond which no beam axis reaches ``limit``.

    The axes of all beams are sampled on both sides of the point, where a beam is strongest. Points
    between the axes are not sampled; `glare_map` covers them.

    Parameters
    ----------
    given
        Beams at standby there.
    center
        ENU, m, (3,).
    limit
        Hazard that must not occur outside the radius.
    reach, step
        Largest distance from the point, and spacing of the samples, m.
    dni
        W/m².
    eye
        The observer's eye.

    Returns
    -------
    A multiple of ``step``; infinite if the limit is still reached at ``reach``.
    """
    middle = as_vectors(center, "center")
    if not (0.0 < step < reach and math.isfinite(reach)):
        raise InputError(f"step {step} m and reach {reach} m: must satisfy 0 < step < reach")
    to = np.einsum("nk,nk->n", middle - given.origin, given.direction)
    distances = np.append(np.arange(step, reach, step), reach)
    for away in distances[::-1]:
        points = given.point(np.stack([to - away, to + away], axis=-1)).reshape(-1, 3)
        glare = glare_at(given, points, dni=dni, eye=eye)
        if (glare.hazard >= limit).any():
            return math.inf if away == distances[-1] else float(away + step)
    return 0.0 if not (glare_at(given, middle, dni=dni, eye=eye).hazard >= limit).any() else step


def _checked(corneal: npt.ArrayLike, subtended: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    e, w = as_float(corneal), as_float(subtended)
    if not ((e >= 0.0) & np.isfinite(e)).all():
        raise InputError("corneal irradiance must be 0 W/m² or more and finite")
    if not ((w > 0.0) & (w <= math.pi)).all():
        raise InputError("subtended angle must be above 0 and at most π rad")
    return e, w


def _irradiance(dni: float) -> None:
    if not (math.isfinite(dni) and dni >= 0.0):
        raise InputError(f"direct normal irradiance must be 0 or more and finite, not {dni} W/m²")
