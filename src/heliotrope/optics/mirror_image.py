"""The flux of a heliostat beam on the target plane, with its exact centroid."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets
from heliotrope.field.target import Target
from heliotrope.geometry import (
    FloatArray,
    as_float,
    as_vectors,
    bisector,
    normalize,
    reflect,
    tangent_axes,
)
from heliotrope.optics.beam import SUN_RADIUS
from heliotrope.optics.coverage import coverage
from heliotrope.optics.mirror_surface import equal_facets, grid_of, mirror_axes, surface_at
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.shading import Shading
from heliotrope.optics.sun_shape import SunShape

#: A Gaussian is drawn to this many σ; 4e-6 of a two-dimensional Gaussian lies beyond.
_REACH = 5.0
#: Maximum number of samples along a side of a grid.
_LARGEST = 4096
#: Samples of several beams must coincide on one grid to within this share of a step.
_ALIGNED = 1e-6
#: Share of a mirror below which nothing counts as hidden: rounding of the clipped areas.
_SPECK = 1e-9


@dataclass(frozen=True)
class Beam:
    """Flux on a grid in the target plane, bilinear between samples and 0 beyond them.

    The bilinear surface has exactly the power and the centroid of the samples.

    Attributes
    ----------
    flux
        W/m², rows upwards and columns to the right as seen from the front of the target, (H, W).
    step
        Spacing of the samples, m.
    origin
        Position of sample [0, 0], metres to the right of and above the target centre, (2,).
    """

    flux: FloatArray
    step: float
    origin: FloatArray

    def __post_init__(self) -> None:
        flux, origin = as_float(self.flux), as_float(self.origin)
        if flux.ndim != 2 or flux.size == 0:
            raise InputError(f"beam: flux of shape {flux.shape}; expected (rows, columns)")
        if not (np.isfinite(flux).all() and flux.min() >= 0.0):
            raise InputError("beam: flux must be finite and nowhere below 0 W/m²")
        if flux.max() <= 0.0:
            raise InputError("beam: flux is 0 W/m² everywhere; pass a beam with light")
        _above_zero("beam: step", self.step, "m")
        if origin.shape != (2,) or not np.isfinite(origin).all():
            raise InputError(f"beam: origin {origin} must be two finite numbers, m")
        object.__setattr__(self, "flux", flux)
        object.__setattr__(self, "origin", origin)

    @classmethod
    def from_image(
        cls,
        image: npt.ArrayLike,
        metres_per_pixel: float,
        centre: npt.ArrayLike = (0.0, 0.0),
        power: float | None = None,
    ) -> "Beam":
        """Return the beam from a picture of the target taken head-on.

        Parameters
        ----------
        image
            Flux, top row first, (H, W).
        metres_per_pixel
            Size of a pixel on the target.
        centre
            Middle of the picture, metres to the right of and above the target centre.
        power
            Power in W to which the picture is scaled; None: the picture is in W/m².
        """
        flux = as_float(image)
        if flux.ndim != 2:
            raise InputError(f"beam: picture of shape {flux.shape}; expected (rows, columns)")
        middle = 0.5 * metres_per_pixel * (np.array(flux.shape[::-1]) - 1.0)
        beam = cls(flux[::-1].copy(), metres_per_pixel, as_float(centre) - middle)
        return beam if power is None else beam.of_power(power)

    @classmethod
    def together(cls, beams: Sequence["Beam"]) -> "Beam":
        """Return the sum of one or more beams as one beam, on a grid that contains all of them.

        Raises
        ------
        InputError
            If their samples do not lie on a common grid. The beams that `reflected_beam` returns
            for the same step do.
        """
        step = beams[0].step
        places = np.array([beam.origin for beam in beams]) / step
        first = places.min(axis=0)
        columns, rows = np.round(places - first).astype(int).T
        off = np.abs(places - first - np.stack([columns, rows], axis=-1)).max()
        if any(beam.step != step for beam in beams) or off > _ALIGNED:
            raise InputError("beams: the samples are not on a common grid; use one step for all")
        height = max(y + beam.flux.shape[0] for y, beam in zip(rows, beams, strict=True))
        width = max(x + beam.flux.shape[1] for x, beam in zip(columns, beams, strict=True))
        flux = np.zeros((height, width))
        for x, y, beam in zip(columns, rows, beams, strict=True):
            flux[y : y + beam.flux.shape[0], x : x + beam.flux.shape[1]] += beam.flux
        return cls(flux, step, step * first)

    @cached_property
    def power(self) -> float:
        """Power of the beam, W."""
        return float(self.flux.sum() * self.step**2)

    @cached_property
    def peak(self) -> float:
        """Maximum flux, W/m²."""
        return float(self.flux.max())

    @cached_property
    def centroid(self) -> FloatArray:
        """Centre of the energy on the plane, including light beyond the target, m, (2,)."""
        return _centroid(self.flux, self.origin, self.step)

    @cached_property
    def second_moments(self) -> FloatArray:
        """Second moments of the bilinear surface about its centroid, m², (2, 2)."""
        y, x = (np.arange(n) * self.step for n in self.flux.shape)
        rows, columns = self.flux.sum(axis=1), self.flux.sum(axis=0)
        total = rows.sum()
        x, y = x - columns @ x / total, y - rows @ y / total
        cross = float(y @ self.flux @ x) / total
        inside = np.array([[columns @ x**2 / total, cross], [cross, rows @ y**2 / total]])
        # A triangle of half-width step has the variance step²/6.
        return inside + np.eye(2) * self.step**2 / 6.0

    @property
    def corners(self) -> FloatArray:
        """Corners of the beam's extent, the grid plus a margin of one step, m, (4, 2)."""
        rows, columns = self.flux.shape
        ends = np.array([(-1, rows), (columns, rows), (columns, -1), (-1, -1)], dtype=np.float64)
        return self.origin + ends * self.step

    def at(self, plane: npt.ArrayLike) -> FloatArray:
        """Return the flux at points (..., 2) in the plane, W/m², (...)."""
        from scipy.ndimage import map_coordinates

        place = (as_float(plane) - self.origin) / self.step
        return as_float(
            map_coordinates(
                self.flux, [place[..., 1], place[..., 0]], order=1, mode="grid-constant", cval=0.0
            )
        )

    def shifted(self, by: npt.ArrayLike) -> "Beam":
        """Return the beam moved by metres right and up (2,)."""
        return replace(self, origin=self.origin + as_float(by))

    def coarser(self, factor: int) -> "Beam":
        """Return the beam with blocks of ``factor`` samples merged, at equal power and centroid."""
        if factor < 2:
            return self
        rows, columns = (-(-n // factor) for n in self.flux.shape)
        full = np.zeros((rows * factor, columns * factor))
        full[: self.flux.shape[0], : self.flux.shape[1]] = self.flux
        flux = full.reshape(rows, factor, columns, factor).mean(axis=(1, 3))
        return Beam(flux, self.step * factor, self.origin + 0.5 * (factor - 1) * self.step)

    def of_power(self, power: float) -> "Beam":
        """Return the beam scaled to ``power`` W."""
        _above_zero("beam: power", power, "W")
        return replace(self, flux=self.flux * (power / self.power))

    def swept(self, motion: npt.ArrayLike) -> "Beam":
        """Return the mean over an exposure in which the beam moves by metres right and up (2,).

        The beam moves uniformly about its position in the middle of the exposure, so the centroid
        stays unchanged.
        """
        from scipy.signal import fftconvolve

        move = as_float(motion)
        if move.shape != (2,) or not np.isfinite(move).all():
            raise InputError(f"beam: motion {move} must be two finite numbers, m")
        reach = np.ceil(0.5 * np.abs(move) / self.step).astype(int)
        if not reach.any():
            return self
        count = 4 * int(reach.max()) + 2
        places = ((np.arange(count) + 0.5) / count - 0.5)[:, None] * move / self.step + reach
        trail = deposit(places, np.full(count, 1.0 / count), (2 * reach[1] + 1, 2 * reach[0] + 1))
        flux = np.maximum(fftconvolve(self.flux, trail), 0.0)
        return Beam(flux, self.step, self.origin - reach * self.step)

    def on_target(self, target: Target) -> tuple[float, FloatArray]:
        """Return the fraction of the energy that falls on a target, and its centroid, m, (2,).

        The centroid is NaN if that fraction is zero. Samples at the border are counted in part.
        """
        inside = coverage(
            [(target.plane_coordinates(target.corners) - self.origin) / self.step],
            self.flux.shape,
        )
        landed = self.flux * inside
        share = float(landed.sum() / self.flux.sum())
        if share <= 0.0:
            return 0.0, np.full(2, np.nan)
        return share, _centroid(landed, self.origin, self.step)


def gaussian_beam(
    centre: npt.ArrayLike,
    sigma_major: float,
    sigma_minor: float | None = None,
    angle: float = 0.0,
    power: float = 1.0,
    step: float | None = None,
) -> Beam:
    """Return an elliptical Gaussian beam, drawn to 5 σ; its centroid is exactly ``centre``.

    Parameters
    ----------
    centre
        Metres to the right of and above the target centre, (2,).
    sigma_major, sigma_minor
        Standard deviations along its axes, m; a circle if only one is specified.
    angle
        Angle of the major axis from the right, counterclockwise as seen from the front, rad.
    power
        W.
    step
        Grid step, m; default a twelfth of the smaller σ.
    """
    minor = sigma_major if sigma_minor is None else sigma_minor
    _above_zero("gaussian beam: sigma_major", sigma_major, "m")
    _above_zero("gaussian beam: sigma_minor", minor, "m")
    step = min(sigma_major, minor) / 12.0 if step is None else step
    _above_zero("gaussian beam: step", step, "m")
    middle = as_float(centre)
    cos, sin = np.cos(angle), np.sin(angle)
    reach = _REACH * np.hypot([sigma_major * cos, sigma_major * sin], [minor * sin, minor * cos])
    x, y = _axes(reach, step)
    along, across = x * cos + y[:, None] * sin, y[:, None] * cos - x * sin
    square = (along / sigma_major) ** 2 + (across / minor) ** 2
    flux = np.where(square <= _REACH**2, np.exp(-0.5 * square), 0.0)
    return Beam(flux, step, middle + [x[0], y[0]]).of_power(power)


def flat_top_beam(
    centre: npt.ArrayLike,
    width: float,
    height: float | None = None,
    angle: float = 0.0,
    power: float = 1.0,
    step: float | None = None,
    *,
    round_: bool = False,
) -> Beam:
    """Return a uniform beam with a sharp border; its centroid is exactly ``centre``.

    Parameters
    ----------
    centre
        Metres to the right of and above the target centre, (2,).
    width, height
        Sides, or diameters, m; a square or a circle if only one is specified.
    angle
        Rotation, counterclockwise as seen from the front, rad.
    power
        W.
    step
        Grid step, m; default a sixtieth of the smaller side. The border is one step wide.
    round_
        Whether the beam is an ellipse instead of a rectangle.
    """
    tall = width if height is None else height
    _above_zero("flat-top beam: width", width, "m")
    _above_zero("flat-top beam: height", tall, "m")
    step = min(width, tall) / 60.0 if step is None else step
    _above_zero("flat-top beam: step", step, "m")
    middle = as_float(centre)
    if round_:
        around = np.arange(256) * (2.0 * np.pi / 256)
        shape = np.stack([np.cos(around), np.sin(around)], axis=-1)
    else:
        shape = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)], dtype=np.float64)
    shape = 0.5 * shape * [width, tall]
    cos, sin = np.cos(angle), np.sin(angle)
    shape = shape @ np.array([[cos, sin], [-sin, cos]])
    x, y = _axes(np.abs(shape).max(axis=0) + step, step)
    flux = coverage([(shape - [x[0], y[0]]) / step], (len(y), len(x)))
    return Beam(flux, step, middle + [x[0], y[0]]).of_power(power)


def reflected_beam(
    target: Target,
    mirror_center: npt.ArrayLike,
    sun: npt.ArrayLike,
    width: float,
    height: float,
    *,
    aim: npt.ArrayLike | None = None,
    normal: npt.ArrayLike | None = None,
    R_enu_mirror: npt.ArrayLike | None = None,
    facets: Facets | tuple[int, int] = (2, 2),
    focal: float | None = None,
    facet_focal: float | None = None,
    slope_error: float = 1e-3,
    sun_shape: str | SunShape = "limb",
    reflectivity: float = 0.9,
    dni: float = 900.0,
    neighbours: Mirrors | None = None,
    step: float = 0.02,
    elements: int = 24,
) -> Beam:
    """Return the beam of one heliostat on a target, by cone optics.

    Parameters
    ----------
    target
        The target; the beam falls on its plane, and light beyond the border is kept.
    mirror_center
        ENU metres, (3,).
    sun
        Unit vector to the sun, ENU, (3,).
    width, height
        Size of the mirror, m; ignored if facets are specified.
    aim
        ENU metres, (3,); default: the target centre. Determines the normal as the bisector.
    normal
        The mirror's unit normal, ENU, (3,), instead of an aim.
    R_enu_mirror
        Instead of aim and normal: columns x (right), y (up) and z (normal) of the mirror, (3, 3).
        By default, x is horizontal.
    facets
        Columns and rows of equal facets without gaps, or the facets of one heliostat with their own
        tilts.
    focal
        Distance of the focus towards which the facets are canted, m; None: the slant range;
        infinity: no canting.
    facet_focal
        Focal length of each facet's own curvature, m; None: as ``focal``, infinity: flat.
    slope_error
        Standard deviation of the surface normal per axis, rad.
    sun_shape
        Shape of the sun, or its name; see `SunShape`.
    reflectivity, dni
        Reflectivity (0 to 1) and irradiance (W/m²). Their product with the area and the cosine of
        incidence is the power; atmospheric attenuation is not included.
    neighbours
        Mirrors that shade and block parts of this mirror; None: no shading or blocking.
    step
        Grid step, m.
    elements
        Each facet is divided into the square of this number of elements.

    Raises
    ------
    InputError
        If a value is invalid, the sun or the target is behind the mirror, the mirror is behind the
        target, its neighbours hide all of it, or the grid would have more than 4096 samples per
        side.

    Notes
    -----
    The central ray of each element is exact. The spread around it is the same for the whole beam
    and linear in the angles. At an angle φ between the beam and the target normal, this neglects a
    shift of about d tan φ / cos φ · σ² (0.4 mm at d = 200 m, φ = 30°, σ = 1.7 mrad).
    """
    light = SunShape.of(sun_shape)
    _reflection_guards(slope_error, reflectivity, dni, step, elements)
    center = _vector(mirror_center, "mirror_center")
    to_sun = normalize(_vector(sun, "sun"), "sun")
    aimed = target.center if aim is None else _vector(aim, "aim")
    R = _mirror_axes(center, to_sun, aimed, normal, R_enu_mirror)
    slant = float(np.linalg.norm(aimed - center))
    cant = slant if focal is None else focal
    curve = cant if facet_focal is None else facet_focal
    for name, value in (("focal", cant), ("facet_focal", curve)):
        if not value > 0.0:
            raise InputError(f"reflected beam: {name} {value} m must be above 0; flat is inf")
    if isinstance(facets, Facets):
        if len(facets.center) != 1:
            raise InputError(
                f"reflected beam: facets of {len(facets.center)} heliostats; pass the facets of one"
            )
        shape = facets
    else:
        shape = equal_facets(width, height, facets, cant)
    points, normals, areas = _lit_elements(
        target, center, R, to_sun, shape, curve, neighbours, elements
    )
    if not areas.any():
        raise InputError("reflected beam: neighbours hide the whole mirror")
    incidence = normals @ to_sun
    rays = reflect(to_sun, normals)
    hits = target.intersect(points, rays)
    if incidence.min() <= 0.0 or not np.isfinite(hits).all():
        raise InputError(
            f"reflected beam: misses target {target.name}; sun and target must be in front of the "
            "mirror, and the mirror in front of the target"
        )
    power = reflectivity * dni * areas * incidence
    ray = normalize(power @ rays)
    distance = float(power @ np.linalg.norm(hits - points, axis=-1) / power.sum())
    plane = target.plane_coordinates(hits)
    spread = ray_spread(target, to_sun, R[:, 2], ray, distance)
    return _gather(plane, power, spread, slope_error, light, step)


@dataclass(frozen=True)
class CentroidShift:
    """The effect of neighbours on one beam.

    Attributes
    ----------
    shift
        Centroid with neighbours minus centroid without, right and up on the target plane, m, (2,);
        NaN if they hide the whole mirror.
    hidden
        Fraction of the mirror's area that is shaded, blocked on the way to the target, or both.
    """

    shift: FloatArray
    hidden: float


def centroid_shift(
    target: Target,
    center: FloatArray,
    sun: FloatArray,
    normal: FloatArray,
    facets: Facets,
    neighbours: Mirrors,
    *,
    facet_focal: float = np.inf,
    elements: int = 4,
) -> CentroidShift:
    """Return how far neighbours shift the centroid of a beam.

    The unobstructed part of the mirror has a different centre. The beam of a flat mirror shifts by
    the same amount. The beam of a mirror focused on the target hardly shifts while light arrives
    along the axis; at oblique incidence, where the mirror is astigmatic, the beam shifts by a
    fraction of that amount.

    Parameters
    ----------
    target
        The target; the beam falls on its plane.
    center, normal
        Centre of the mirror, ENU metres, and its unit normal, (3,).
    sun
        Unit vector to the sun, (3,).
    facets
        Facets of one heliostat, with their actual tilts.
    neighbours
        Mirrors that may shade or block this mirror.
    facet_focal
        Focal length of each facet's own curvature, m.
    elements
        Each facet is divided into the square of this number of elements.

    Notes
    -----
    The lit part of each element is exact (`Shading`). The shift is that of the central rays,
    because sun shape and slope errors widen the beam without shifting it. The centroid includes all
    light, on the target or beside it.
    """
    R, centroids, areas = mirror_axes(normal), [], []
    for beside in (None, neighbours):
        points, normals, area = _lit_elements(
            target, center, R, sun, facets, facet_focal, beside, elements
        )
        power = area * np.maximum(normals @ sun, 0.0)
        plane = target.plane_coordinates(target.intersect(points, reflect(sun, normals)))
        areas.append(float(area.sum()))
        centroids.append(power @ plane / power.sum() if power.any() else np.full(2, np.nan))
    hidden = 1.0 - areas[1] / areas[0]
    if hidden < _SPECK:
        return CentroidShift(np.zeros(2), 0.0)
    return CentroidShift(as_float(centroids[1] - centroids[0]), hidden)


def _lit_elements(
    target: Target,
    center: FloatArray,
    R: FloatArray,
    sun: FloatArray,
    facets: Facets,
    focal: float,
    neighbours: Mirrors | None,
    n: int,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the elements of a mirror that are at least partly lit.

    Returns
    -------
    tuple
        Centroids of their lit parts, ENU m, and normals, (E, 3), and lit areas, m², (E,).
    """
    half, middle = facets.half_size[0], facets.center[0, :, :2]
    places = np.broadcast_to(grid_of(n), (n * n, len(half), 2))
    areas = np.broadcast_to(4.0 * half.prod(axis=-1) / n**2, places.shape[:2])
    if neighbours is not None and len(neighbours):
        aim = center + np.linalg.norm(target.center - center) * reflect(sun, R[:, 2])
        parts = middle + places * half
        lit = _moments(parts, half / n, Mirrors.of(
            center, R[:, 2], tuple(2.0 * (np.abs(middle) + half).max(axis=0)), aim,
            right=R[:, 0], focal=focal,
        ), neighbours, sun)  # fmt: skip
        areas = lit[..., 0]
        places = np.where(areas[..., None] > 0.0, (lit[..., 1:3] - middle) / half, places)
    points, normals = surface_at(facets, focal, places)
    some = areas > 0.0
    return center + points[some] @ R.T, normals[some] @ R.T, as_float(areas[some])


def _moments(
    middle: FloatArray, half: FloatArray, mirror: Mirrors, neighbours: Mirrors, sun: FloatArray
) -> FloatArray:
    """Return the moments (E, F, 6; see `Lit`) of parts (E, F, 2) of a mirror beside others."""
    names = ("center", "normal", "width", "height", "aim", "right", "focal")
    c, n, width, height, aim, right, focal = (
        np.concatenate([getattr(mirror, name), getattr(neighbours, name)]) for name in names
    )
    # The first kind has the parts; the neighbours are of a kind without any.
    center, sizes = (
        np.broadcast_to(value, middle.shape).reshape(1, -1, 2) for value in (middle, half)
    )
    center, sizes = (np.concatenate([value, np.zeros_like(value)]) for value in (center, sizes))
    table = FacetTable(center, np.zeros_like(center), sizes, np.full(center.shape[:2], np.inf))
    kind = np.minimum(np.arange(len(c)), 1)
    every = Mirrors.of(c, n, (width, height), aim, right=right, focal=focal)
    shading = Shading(Scene(sun, 0.0, every.with_facets(table, kind), ()))
    return shading.lit.moments[: center.shape[1]].reshape(*middle.shape[:2], 6)


def _mirror_axes(
    center: FloatArray,
    sun: FloatArray,
    aim: FloatArray,
    normal: npt.ArrayLike | None,
    R_enu_mirror: npt.ArrayLike | None,
) -> FloatArray:
    if R_enu_mirror is not None:
        R = as_float(R_enu_mirror)
        if R.shape != (3, 3) or not np.allclose(R.T @ R, np.eye(3), atol=1e-6):
            raise InputError("reflected beam: R_enu_mirror must be a rotation, (3, 3)")
        return R
    if normal is None:
        n = bisector(sun, normalize(aim - center, "aim − mirror_center"))
    else:
        n = normalize(_vector(normal, "normal"), "normal")
    return mirror_axes(n)


def ray_spread(
    target: Target, sun: FloatArray, normal: FloatArray, ray: FloatArray, distance: float
) -> tuple[FloatArray, float]:
    """Return the displacement on the plane per angle off the ray, m/rad, (2, 2).

    Also return the cosine of incidence.

    The columns are for deviations in the plane of incidence and across it. A deviation e of
    the ray moves its end by d (e − r (e·N) / (r·N)), N being the target's normal.
    """
    across = np.cross(sun, normal)
    if np.linalg.norm(across) < 1e-9:
        across = tangent_axes(normal)[0]
    across = normalize(across - (across @ ray) * ray)
    deviations = np.stack([np.cross(across, ray), across])
    front = target.normal
    moved = distance * (deviations - np.outer(deviations @ front / (ray @ front), ray))
    return (moved @ target.axes.T).T, float(sun @ normal)


def _gather(
    plane: FloatArray,
    power: FloatArray,
    spread: tuple[FloatArray, float],
    slope_error: float,
    light: SunShape,
    step: float,
) -> Beam:
    """Return the beam of rays that meet the plane at (E, 2), each spread by sun and slope."""
    from scipy.fft import irfft2, next_fast_len, rfft2

    per_rad, cosine = spread
    # A slope error rotates the ray by twice its size in the plane of incidence. Across that plane
    # it is multiplied by the cosine of incidence as well, because r = 2 (n·s) n − s.
    sigma = per_rad * (2.0 * slope_error * np.array([1.0, cosine]))
    covariance = sigma @ sigma.T
    sun_reach = light.radius * np.linalg.norm(per_rad, axis=1)
    margin = sun_reach + _REACH * np.sqrt(np.diag(covariance)) + 2.0 * step
    # Samples lie at multiples of the step, so that beams can be added.
    low, high = plane.min(axis=0) - margin, plane.max(axis=0) + margin
    low = step * np.floor(low / step)
    needed = np.ceil((high - low) / step).astype(int) + 1
    if needed.max() > _LARGEST:
        raise InputError(
            f"reflected beam: {needed[0]} × {needed[1]} samples of {step} m; at most {_LARGEST} "
            "each way are allowed, use a larger step"
        )
    columns, rows = (next_fast_len(int(n), real=True) for n in needed)
    cloud = deposit((plane - low) / step, power, (rows, columns))
    blur = np.exp(slope_error**2 * slope_exponent(spread, (rows, columns), step))
    spectrum = rfft2(cloud) * blur_response(spread, light, (rows, columns), step) * blur
    flux = np.maximum(irfft2(spectrum, s=(rows, columns)), 0.0)
    flux[flux < 1e-9 * flux.max()] = 0.0  # rounding residue
    return Beam(flux, step, low).of_power(float(power.sum()))


def blur_response(
    spread: tuple[FloatArray, float], light: SunShape, shape: tuple[int, int], step: float
) -> npt.NDArray[np.complex128]:
    """Return the spectrum of the sun's image from one ray on a grid, as of ``rfft2``."""
    from scipy.fft import rfft2

    reach = light.radius * np.linalg.norm(spread[0], axis=1)
    disk = _sun_kernel(spread[0], reach, light, step)
    kernel = np.zeros(shape)
    kernel[: disk.shape[0], : disk.shape[1]] = disk
    half = (-(disk.shape[0] // 2), -(disk.shape[1] // 2))
    return np.asarray(rfft2(np.roll(kernel, half, axis=(0, 1))))


def slope_exponent(
    spread: tuple[FloatArray, float], shape: tuple[int, int], step: float
) -> FloatArray:
    """Return the logarithm of the spectrum of slope errors of 1 rad on a grid, as of ``rfft2``."""
    per_rad, cosine = spread
    # A slope error rotates the ray by twice its size in the plane of incidence. Across that plane
    # it is multiplied by the cosine of incidence as well, because r = 2 (n·s) n − s.
    sigma = per_rad * (2.0 * np.array([1.0, cosine]))
    covariance = sigma @ sigma.T
    fy, fx = np.fft.fftfreq(shape[0], step)[:, None], np.fft.rfftfreq(shape[1], step)
    exponent = (
        covariance[0, 0] * fx**2 + 2.0 * covariance[0, 1] * fx * fy + covariance[1, 1] * fy**2
    )
    return as_float(-2.0 * np.pi**2 * exponent)


def _sun_kernel(per_rad: FloatArray, reach: FloatArray, light: SunShape, step: float) -> FloatArray:
    """Return the sun's image from one ray, centred and with sum 1."""
    columns, rows = (np.ceil(reach / step).astype(int) + 1).tolist()
    value = _sun_cells(per_rad, (columns, rows), 1, light, step)
    # The limb is sharp, unlike the aureole: cells around the disk are means of 4 × 4 points.
    disk = reach * min(SUN_RADIUS / light.radius, 1.0)
    j, i = (np.ceil(disk / step).astype(int) + 1).tolist()
    inner = _sun_cells(per_rad, (j, i), 4, light, step)
    value[rows - i : rows + i + 1, columns - j : columns + j + 1] = inner
    return as_float(value / value.sum())


def _sun_cells(
    per_rad: FloatArray, half: tuple[int, int], fine: int, light: SunShape, step: float
) -> FloatArray:
    """Return means of the profile over cells, ``half`` columns and rows to each side of 0."""
    shift = (np.arange(fine) + 0.5) / fine - 0.5
    x, y = ((np.arange(-n, n + 1)[:, None] + shift).ravel() * step for n in half)
    back = np.linalg.inv(per_rad)
    theta = np.hypot(
        back[0, 0] * x + back[0, 1] * y[:, None], back[1, 0] * x + back[1, 1] * y[:, None]
    )
    value = light.radiance(theta)
    return as_float(value.reshape(2 * half[1] + 1, fine, 2 * half[0] + 1, fine).mean(axis=(1, 3)))


def deposit(places: FloatArray, weights: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return a grid of weights (E,) at columns and rows (E, 2), each split over four cells."""
    whole = np.floor(places).astype(np.intp)
    a, b = (places - whole).T
    total = np.zeros(shape[0] * shape[1])
    for right in (0, 1):
        for up in (0, 1):
            part = weights * (a if right else 1.0 - a) * (b if up else 1.0 - b)
            # The last column has no neighbour, but the share for that neighbour is 0.
            column = np.minimum(whole[:, 0] + right, shape[1] - 1)
            row = np.minimum(whole[:, 1] + up, shape[0] - 1)
            total += np.bincount(row * shape[1] + column, part, minlength=total.size)
    return total.reshape(shape)


def _centroid(flux: FloatArray, origin: FloatArray, step: float) -> FloatArray:
    rows, columns = flux.sum(axis=1), flux.sum(axis=0)
    total = rows.sum()
    place = np.array([columns @ np.arange(columns.size), rows @ np.arange(rows.size)]) / total
    return as_float(origin + step * place)


def _axes(reach: FloatArray, step: float) -> tuple[FloatArray, FloatArray]:
    """Return columns and rows of a grid with its central sample at 0, m."""
    count = np.ceil(reach / step).astype(int)
    if count.max() > _LARGEST // 2:
        raise InputError(
            f"beam: {2 * count.max() + 1} samples of {step} m; at most {_LARGEST} each way are "
            "allowed, use a larger step"
        )
    x, y = (np.arange(-n, n + 1) * step for n in count)
    return x, y


def _vector(value: npt.ArrayLike, name: str) -> FloatArray:
    vector = as_vectors(value, name)
    if vector.shape != (3,):
        raise InputError(f"reflected beam: {name} {vector.shape} must have the shape (3,)")
    return vector


def _above_zero(what: str, value: float, unit: str) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise InputError(f"{what} {value} {unit} must be above 0 and finite")


def _reflection_guards(
    slope_error: float, reflectivity: float, dni: float, step: float, elements: int
) -> None:
    name = "reflected beam"
    if not 0.0 <= slope_error < 0.1:
        raise InputError(f"{name}: slope_error {slope_error} rad must be 0 or more, below 0.1")
    if not 0.0 < reflectivity <= 1.0:
        raise InputError(f"{name}: reflectivity {reflectivity} must be above 0 and at most 1")
    _above_zero(f"{name}: dni", dni, "W/m²")
    _above_zero(f"{name}: step", step, "m")
    if elements < 1:
        raise InputError(f"{name}: {elements} elements; must be 1 or more")
