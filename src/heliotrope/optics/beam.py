r"""Beams: the sun's angular radius, the width of a beam, and its irradiance along the axis.

All other modules take these quantities from this module. There are two beam models:

- `beam_sigma` returns the standard deviation of a Gaussian beam, to compute what falls on a
  receiver. The angular variances of the solar disk, of the mirror slope and of the tracking add up;
  reflection doubles the latter two errors: $σ_{beam}^2 = σ_{sun}^2 + (2 σ_{slope})^2 + (2
  σ_{tracking})^2$.
- `MirrorOptics` and `Beams` describe a solid that is guaranteed to contain the beam, for what must
  stay dark: keep-out volumes and eyes.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, as_vectors, common_shape, normalize

#: Angular radius of the solar disk, rad.
SUN_RADIUS = 4.65e-3
#: Standard deviation per axis of a uniform solar disk, rad: half of its radius.
SUN_SIGMA = 0.5 * SUN_RADIUS
#: Default distance up to which a beam is followed, m.
REACH = 3000.0
#: Default direct normal irradiance, W/m².
NOMINAL_DNI = 1000.0
#: Squared normalised distance that contains 90 % of a two-dimensional Gaussian: χ² with two degrees
#: of freedom.
CHI_SQUARE_90 = 2.0 * float(np.log(10.0))


def beam_sigma(
    slant: npt.ArrayLike,
    *,
    tracking: npt.ArrayLike = 0.0,
    slope: npt.ArrayLike = 0.0,
    sun_shape: npt.ArrayLike = SUN_SIGMA,
) -> FloatArray:
    """Return the standard deviation per axis of a beam on a plane perpendicular to it, m, (...).

    Parameters
    ----------
    slant
        Distance from mirror to aperture, m, (...).
    tracking, slope
        Standard deviations per axis of the *normal*, for the whole mirror (tracking) and over its
        surface (slope), rad, (...). Each is doubled in the beam.
    sun_shape
        Standard deviation per axis of the solar disk, rad, (...).

    Raises
    ------
    InputError
        If a value is negative or not finite, the slant range is 0, or shapes do not broadcast.

    Notes
    -----
    The mirror is assumed to be focused on the aperture, so its size does not widen the beam, and
    astigmatism at oblique incidence is neglected. For Malan's beam model see `intercept_disks`.
    """
    d = checked("slant", slant, "m", positive=True)
    t = checked("tracking", tracking, "rad")
    s = checked("slope", slope, "rad")
    sun = checked("sun_shape", sun_shape, "rad")
    common_shape(slant=d, tracking=t, slope=s, sun_shape=sun)
    return as_float(d * np.sqrt(sun**2 + (2.0 * s) ** 2 + (2.0 * t) ** 2))


def checked(name: str, value: npt.ArrayLike, unit: str, *, positive: bool = False) -> FloatArray:
    """Return ``value`` as an array if it is finite and not negative.

    Raises
    ------
    InputError
        If a number is not finite or is negative, or is 0 although ``positive`` is set.
    """
    array = as_float(value)
    invalid = ~(np.isfinite(array) & ((array > 0.0) if positive else (array >= 0.0)))
    if invalid.any():
        limit = "above 0" if positive else "0 or more"
        raise InputError(
            f"{name} must be {limit} and finite, not {array[invalid].flat[0]:g} {unit}"
        )
    return array


@dataclass(frozen=True)
class MirrorOptics:
    """The properties of N mirrors that determine the shape of their beams.

    Attributes
    ----------
    width, height
        Size of each mirror, m, (N,).
    focus
        Focal distance from canting and curvature together, m, (N,); infinite if flat.
    error
        Bound on everything that deflects or widens the beam beyond the sun's radius (slope,
        tracking, the sun's motion between updates), half angle, rad, (N,).
    reflectivity
        (N,).
    """

    width: FloatArray
    height: FloatArray
    focus: FloatArray
    error: FloatArray
    reflectivity: FloatArray

    @classmethod
    def of(
        cls,
        width: npt.ArrayLike,
        height: npt.ArrayLike,
        *,
        focus: npt.ArrayLike = np.inf,
        error: npt.ArrayLike = 5e-3,
        reflectivity: npt.ArrayLike = 1.0,
    ) -> "MirrorOptics":
        """Return mirrors from numbers or arrays that broadcast to (N,).

        Raises
        ------
        InputError
            If a number is out of range.
        """
        arguments = {
            "width": width,
            "height": height,
            "focus": focus,
            "error": error,
            "reflectivity": reflectivity,
        }
        arrays = np.broadcast_arrays(*(np.atleast_1d(as_float(v)) for v in arguments.values()))
        values = dict(zip(arguments, (np.ascontiguousarray(a) for a in arrays), strict=True))
        if values["width"].ndim != 1:
            raise InputError(f"mirrors: shape {values['width'].shape}; expected numbers or (N,)")
        limits = {
            "width": (0.0, np.inf, " m"),
            "height": (0.0, np.inf, " m"),
            "reflectivity": (0.0, 1.0 + 1e-12, ""),
        }
        for name, (low, high, unit) in limits.items():
            invalid = ~((values[name] > low) & (values[name] < high))
            if invalid.any():
                value = values[name][invalid][0]
                limit = "at most 1" if name == "reflectivity" else "finite"
                raise InputError(f"mirrors: {name} must be above 0 and {limit}, not {value}{unit}")
        if not (values["focus"] > 0.0).all():
            raise InputError("mirrors: a focus must be above 0 m; use inf for a flat mirror")
        if not ((values["error"] >= 0.0) & (values["error"] < 0.5)).all():
            raise InputError("mirrors: an error must be between 0 and 0.5 rad (500 mrad)")
        return cls(**values)

    def __len__(self) -> int:
        return len(self.width)

    @property
    def area(self) -> FloatArray:
        """Mirror area, m², (N,)."""
        return self.width * self.height

    @property
    def half_diagonal(self) -> FloatArray:
        """Half the diagonal of each mirror, m, (N,)."""
        return as_float(0.5 * np.hypot(self.width, self.height))

    @property
    def spread(self) -> FloatArray:
        """Half angle of the solid that contains the beam, rad, (N,)."""
        return SUN_RADIUS + self.error

    def broadcast(self, count: int) -> "MirrorOptics":
        """Return ``count`` mirrors, by repeating a single mirror."""
        if len(self) not in (1, count):
            raise InputError(
                f"mirrors: got {len(self)} for {count} beams; pass one, or one per beam"
            )
        return MirrorOptics(
            **{k: np.ascontiguousarray(np.broadcast_to(v, (count,))) for k, v in vars(self).items()}
        )

    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return radius (m), inverse focal distance (1/m) and spread (rad), for the kernels."""
        return self.half_diagonal, 1.0 / self.focus, self.spread


@dataclass(frozen=True)
class Beams:
    """N beams.

    Attributes
    ----------
    origin
        ENU, m, (N, 3).
    direction
        Unit vectors, ENU, (N, 3).
    mirrors
        N mirrors.
    reach
        Distance up to which each beam is followed, m, (N,).
    """

    origin: FloatArray
    direction: FloatArray
    mirrors: MirrorOptics
    reach: FloatArray

    def __len__(self) -> int:
        return len(self.origin)

    def point(self, distance: npt.ArrayLike) -> FloatArray:
        """Return points (N, ..., 3) on the axes at distances (N, ...), m."""
        t = as_float(distance)[..., None]
        extra = (slice(None), *(None,) * (t.ndim - 2), slice(None))
        return self.origin[extra] + t * self.direction[extra]


def beams(
    vertex: npt.ArrayLike,
    aim: npt.ArrayLike,
    mirrors: MirrorOptics,
    *,
    reach: npt.ArrayLike = REACH,
) -> Beams:
    """Return beams from vertices (N, 3) to aims (N, 3) or (3,), ENU metres.

    Raises
    ------
    InputError
        If shapes do not fit, or an aim coincides with its vertex.
    """
    origin = np.atleast_2d(as_vectors(vertex, "vertex"))
    to_aim = np.atleast_2d(as_vectors(aim, "aim")) - origin
    origin = np.ascontiguousarray(np.broadcast_to(origin, to_aim.shape))
    if origin.ndim != 2:
        raise InputError(f"beams: vertices and aims have shape {to_aim.shape}; expected (N, 3)")
    return Beams(
        origin,
        normalize(to_aim, "aim - vertex"),
        mirrors.broadcast(len(origin)),
        reaches(reach, len(origin)),
    )


def concentration(
    distance: npt.ArrayLike,
    area: npt.ArrayLike,
    focus: npt.ArrayLike,
    half_angle: npt.ArrayLike = SUN_RADIUS,
) -> FloatArray:
    """Return the ratio of the on-axis irradiance to that on the mirror times its reflectivity.

    The mirror is assumed to be a disk of ``area`` with an ideal focus at normal incidence, and the
    sun a uniform disk. From a point at distance x, the part of the mirror within √(area/π) and
    within x β / |1 − x/b| of its centre shows the sun at the sun's radiance, so C is the square of
    min(√(area/π) / (x β), 1 / |1 − x/b|). Ho et al. give the mean over the beam's cross-section,
    which is smaller everywhere (`mean_concentration`). At oblique incidence a mirror may be
    stronger near its line foci, up to the limit set by the sun's radiance, which is the first of
    the two terms.

    Parameters
    ----------
    distance
        m, above 0.
    area
        m².
    focus
        b, m; infinite if flat.
    half_angle
        β, rad.
    """
    x, b = as_float(distance), as_float(focus)
    radius = np.sqrt(as_float(area) / np.pi)
    gap = np.maximum(np.abs(1.0 - x / b), 1e-12)
    return as_float(np.minimum(radius / (x * as_float(half_angle)), 1.0 / gap) ** 2)


def mean_concentration(
    distance: npt.ArrayLike,
    area: npt.ArrayLike,
    focus: npt.ArrayLike,
    half_angle: npt.ArrayLike = SUN_RADIUS,
) -> FloatArray:
    """Return the ratio of the beam's mean irradiance to the irradiance on the mirror.

    The mean is taken over the cross-section of the beam.

    This is the estimate of Ho, Ghanbari and Diver (2011) for specular reflection by a focused
    mirror: mirror area over beam area, C = (|1 − x/b| + x β / R)⁻², where R is the radius of a disk
    with the mirror's area. Eye hazards are judged by the irradiance on the axis, which is larger.

    Parameters
    ----------
    distance, area, focus, half_angle
        As for `concentration`.
    """
    x = as_float(distance)
    radius = np.sqrt(as_float(area) / np.pi)
    return as_float((np.abs(1.0 - x / as_float(focus)) + x * as_float(half_angle) / radius) ** -2)


@dataclass(frozen=True)
class Crossing:
    """The irradiance from N beams at P points.

    Attributes
    ----------
    concentration
        Concentration of each beam, (P, N).
    irradiance
        Sum over the beams, W/m², on a surface normal to each beam, (P,).
    count
        Number of beams that reach the point, (P,).
    """

    concentration: FloatArray
    irradiance: FloatArray
    count: npt.NDArray[np.int64]


def crossing(given: Beams, points: npt.ArrayLike, *, dni: float = NOMINAL_DNI) -> Crossing:
    """Return the irradiance at points (P, 3), such as standby points, from all beams.

    Each mirror is assumed to be a disk with an ideal focus. From a point at distance d from the
    axis, the sun is visible in the part of the disk that lies within x β / |1 − x/b| of the
    distance d / |1 − x/b| from its centre. The area common to these two disks is known in closed
    form. On the axis the result is equal to the result of `concentration`.
    """
    p = np.atleast_2d(as_vectors(points, "points"))
    to = p[:, None, :] - given.origin
    along = np.einsum("pnk,nk->pn", to, given.direction)
    off = np.sqrt(np.maximum(np.einsum("pnk,pnk->pn", to, to) - along**2, 0.0))
    mirrors = given.mirrors
    within = (along > 0.0) & (along <= given.reach)
    x = np.where(within, along, 1.0)
    # Closer to the focus the visible disk covers the mirror anyway.
    gap = np.maximum(np.abs(1.0 - x / mirrors.focus), 1e-4)
    radius = np.broadcast_to(np.sqrt(mirrors.area / np.pi), x.shape)
    overlap = _common_area(radius, x * SUN_RADIUS / gap, off / gap)
    concentrations = np.where(within, overlap / (np.pi * (x * SUN_RADIUS) ** 2), 0.0)
    total = dni * (concentrations @ mirrors.reflectivity)
    return Crossing(concentrations, total, np.count_nonzero(concentrations > 0.0, axis=1))


@dataclass(frozen=True)
class ExpectedError:
    """Expected error of M beams, each for one sun position and one aim.

    Computed by `heliotrope.calibration.uncertainty.expected_error`.

    Attributes
    ----------
    covariance
        Covariance to the right of and above the aim as seen from the mirror, rad², (M, 2, 2); NaN
        where the pose is out of reach.
    reachable
        Whether the mechanism reaches the pose, (M,).
    """

    covariance: FloatArray
    reachable: npt.NDArray[np.bool_]

    @property
    def rms(self) -> FloatArray:
        """Two-dimensional root mean square of the error, rad, (M,)."""
        return np.asarray(np.sqrt(np.trace(self.covariance, axis1=-2, axis2=-1)))

    @property
    def ellipse(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The 90 % ellipse: semi-axes, rad, longer first, and angle of the longer axis, each (M,).

        The angle is counterclockwise from the right, rad.
        """
        known = np.asarray(np.isfinite(self.covariance).all(axis=(-1, -2)))
        values, vectors = np.linalg.eigh(np.where(known[:, None, None], self.covariance, 0.0))
        values = np.where(known[:, None], values, np.nan)
        axes = np.sqrt(CHI_SQUARE_90 * np.maximum(values, 0.0))
        angle = np.where(known, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]), np.nan)
        return axes[:, 1], axes[:, 0], np.asarray(np.mod(angle, np.pi))


def _common_area(r: FloatArray, s: FloatArray, d: FloatArray) -> FloatArray:
    """Return the common area of two disks with radii r and s and centres d apart."""
    small = np.minimum(r, s)
    # Concentric disks are handled by the case of one disk inside the other.
    safe = np.maximum(d, 1e-9)
    a = np.clip((d * d + r * r - s * s) / (2.0 * safe * r), -1.0, 1.0)
    b = np.clip((d * d + s * s - r * r) / (2.0 * safe * s), -1.0, 1.0)
    kite = np.maximum((r + s - d) * (d + r - s) * (d - r + s) * (d + r + s), 0.0)
    lens = r * r * np.arccos(a) + s * s * np.arccos(b) - 0.5 * np.sqrt(kite)
    inside = np.where(d <= np.abs(r - s), np.pi * small * small, lens)
    return as_float(np.where(d >= r + s, 0.0, np.clip(inside, 0.0, np.pi * small * small)))


def reaches(reach: npt.ArrayLike, count: int) -> FloatArray:
    """Return the reach of each beam, m, (count,), from a single number or one number per beam."""
    lengths = as_float(reach)
    if not (np.isfinite(lengths) & (lengths > 0.0)).all() or lengths.shape not in (
        (),
        (1,),
        (count,),
    ):
        raise InputError(f"reach {reach!r} m: pass one number above 0, or one per beam")
    return np.ascontiguousarray(np.broadcast_to(lengths, (count,)))
