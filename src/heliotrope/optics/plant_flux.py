"""The flux and the efficiencies of a plant: at one sun, over a day, and over a year.

The field's efficiencies stand in the order of the light, each as a share of what the one before
left, so that their product is the total: cosine, shading and blocking together (`lit`), mirror
(reflectivity and soiling), air, intercept.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.frames import times as frame_times
from heliotrope.geometry import FloatArray, as_float, as_vectors, azimuth_elevation, normalize
from heliotrope.optics.attenuation import air_loss
from heliotrope.optics.canting import Canting, canted
from heliotrope.optics.flux import FluxView
from heliotrope.optics.rays import trace
from heliotrope.optics.receiver_flux import Efficiencies, FieldFlux
from heliotrope.optics.scene import Scene, Tower, scene_of
from heliotrope.optics.sun_shape import SunShape
from heliotrope.optics.surfaces import Cylinder, Plate, Surface
from heliotrope.sun import Times, unix_seconds, vector
from heliotrope.values import Card, Value, amount, span

Progress = Callable[[int, int], None]
#: Efficiencies of a mirror and of a field, in the order of the light; shading and blocking are
#: parts of "lit".
EFFICIENCIES = ("cosine", "shading", "blocking", "lit", "mirror", "air", "intercept", "total")
#: The sun's greatest declination, rad.
_OBLIQUITY = np.radians(23.45)
#: Apparent elevation below which a table over the year has no sun, rad.
LOWEST = np.radians(2.0)


@dataclass(frozen=True)
class FieldOptics:
    """What the light of a field depends on, beside plant and sun.

    Attributes
    ----------
    dni
        Direct normal irradiance, W/m².
    shape
        Shape of the sun, or its name: `heliotrope.optics.SunShape`.
    air
        Model of the air, or the visibility, km: `heliotrope.optics.air_loss`.
    slope
        Standard deviation of the surface's normal per axis, rad.
    error
        Two-dimensional standard deviation of the mirrors' normals that is expected of their
        calibration, rad, () or (N,).
    reflectivity, clean
        Of the clean mirror, and the share that soiling leaves, 0 to 1, () or (N,).
    focus
        "slant": each mirror is focused on its aim; "flat"; or the focal length, m. Of mirrors with
        facets it is that of each facet.
    facets
        Columns and rows of equal facets; None: as the plant file has them.
    canting
        Of these facets: "slant", a focal length or the sun at which they are canted off axis; see
        `heliotrope.optics.canting.canted`.
    cells
        Rows and columns of each receiver; None: as the engine chooses.
    towers
        What else shades and blocks.
    gaussians
        Number of Gaussians of the sun's image, 1 to 4.
    """

    dni: float = 900.0
    shape: str | SunShape = "limb"
    air: str | float = "clear"
    slope: float = 1e-3
    error: npt.ArrayLike = 1e-3
    reflectivity: npt.ArrayLike = 0.9
    clean: npt.ArrayLike = 1.0
    focus: Literal["slant", "flat"] | float = "slant"
    facets: tuple[int, int] | None = None
    canting: Canting = "slant"
    cells: tuple[int, int] | None = None
    towers: tuple[Tower, ...] = ()
    gaussians: int = 3

    def changed(self, changes: dict[str, Any]) -> "FieldOptics":
        """Return it with other values.

        Raises
        ------
        UnknownNameError
            If it has no such attribute.
        """
        known = [each.name for each in fields(self)]
        for name in changes:
            if name not in known:
                raise UnknownNameError("option of the light", name, known)
        return replace(self, **changes)

    def scene(
        self, plant: Plant, sun: FloatArray, aim: npt.ArrayLike | None, receivers: tuple[str, ...]
    ) -> Scene:
        """Return the scene of a plant under this light."""
        error = as_float(self.error)
        if not (np.isfinite(error) & (error >= 0.0) & (error < 0.2)).all():
            raise InputError(f"flux: an error of {error.max():g} rad must be from 0 to 0.2 rad")
        # Two axes of the normal share its variance, and the beam turns by twice the angle.
        spread = np.broadcast_to(2.0 * error**2, (len(plant),))[:, None, None] * np.eye(2)
        scene = scene_of(
            plant,
            sun,
            aim,
            receivers=receivers,
            dni=self.dni,
            focus=np.inf if self.focus == "flat" else self.focus,
            towers=self.towers,
            cells=self.cells,
            slope=self.slope,
            reflectivity=self.reflectivity,
            clean=self.clean,
            pointing=spread,
        )
        if self.facets is None:
            return scene
        mirrors = canted(scene.mirrors, self.facets, self.canting, plant=plant, aim=aim)
        return replace(scene, mirrors=mirrors)


@dataclass(frozen=True, eq=False, repr=False)
class PlantFlux(Value, Framed):
    """Flux and efficiencies of N heliostats at one sun.

    Attributes
    ----------
    plant
        Name.
    names, position, aim
        Of the heliostats; positions and aims, ENU m, (N, 3).
    sun
        Unit vector, (3,).
    dni
        W/m².
    area
        Of the mirrors, m², (N,).
    clean, reflectivity
        Of each mirror, (N,).
    efficiencies
        Shares of each mirror, (N,); NaN for one that cannot reach its aim.
    maps
        Flux on each receiver. A cylinder's is unrolled: metres clockwise from the north, or from
        the middle of its opening; a mesh is one row of cells.
    surfaces
        The receivers with their cells.
    rays
        Number of rays, if it was traced; 0: by the engine.
    errors, power_error
        Standard errors of the maps, W/m², and of the power, W, if traced.
    """

    plant: str
    names: tuple[str, ...]
    position: FloatArray
    aim: FloatArray
    sun: FloatArray
    dni: float
    area: FloatArray
    clean: FloatArray
    reflectivity: FloatArray
    efficiencies: Efficiencies
    maps: tuple[FluxView, ...]
    surfaces: tuple[Surface, ...]
    rays: int = 0
    errors: tuple[FloatArray, ...] = ()
    power_error: float = 0.0

    def _card(self) -> Card:
        s = self.summary
        line = f"{self.plant}, {amount(len(self.names), 'heliostat')}, {1e-3 * self.power:.5g} kW, "
        line += f"optical efficiency {100 * s['total']:.4g} %, peak {1e-3 * self.peak:.4g} kW/m²"
        rows = [(name, f"{100 * value:.2f} %") for name, value in s.items()]
        return Card(line, ("efficiency", "of the field"), rows)

    def _labelled(self) -> Labelled:
        row = ("heliostat",)
        variables = {
            "position": Variable((*row, "axis"), self.position, "m"),
            "aim": Variable((*row, "axis"), self.aim, "m"),
            "area": Variable(row, self.area, "m²"),
            **{name: Variable(row, getattr(self.efficiencies, name)) for name in EFFICIENCIES},
            "reflectivity": Variable(row, self.reflectivity),
            "clean": Variable(row, self.clean),
            "power": Variable(row, self.heliostat_power, "W"),
        }
        azimuth, elevation = np.degrees(azimuth_elevation(self.sun))
        notes = {"plant": self.plant, "dni": f"{self.dni:g} W/m²"}
        notes["sun"] = f"azimuth {azimuth:.3f}°, elevation {elevation:.3f}°"
        return Labelled(row, {"heliostat": self.names, "axis": ENU}, variables, notes=notes)

    @property
    def heliostat_power(self) -> FloatArray:
        """Power of each heliostat on the receivers, W, (N,)."""
        return as_float(np.nan_to_num(self.efficiencies.total) * self.area * self.dni)

    @property
    def power(self) -> float:
        """Power on all receivers, W."""
        return sum(view.power for view in self.maps)

    @property
    def peak(self) -> float:
        """Greatest flux in a cell, W/m²."""
        return max(float(view.flux.max()) for view in self.maps)

    @property
    def intercept(self) -> float:
        """Share of the field's light that reaches a receiver; NaN without light."""
        return self.summary["intercept"]

    @property
    def heliostats(self) -> int:
        """Number of heliostats whose beams count."""
        return self.maps[0].heliostats

    @property
    def flux(self) -> FloatArray:
        """Flux on the first receiver, W/m², lowest row first."""
        return self.maps[0].flux

    @property
    def right(self) -> FloatArray:
        """Centres of the columns of the first receiver's map, m."""
        return self.maps[0].right

    @property
    def up(self) -> FloatArray:
        """Centres of the rows of the first receiver's map, m."""
        return self.maps[0].up

    @cached_property
    def summary(self) -> dict[str, float]:
        """Efficiencies of the field, by name; see the module."""
        return field_efficiencies(self.efficiencies, self.area)


def field_efficiencies(shares: Efficiencies, area: FloatArray) -> dict[str, float]:
    """Return the efficiencies of a field, each as a share of what the one before left.

    Parameters
    ----------
    shares
        Of the mirrors, (N,); a mirror with NaN counts as dark, and its area counts.
    area
        m², (N,).
    """
    light = [area, np.nan_to_num(area * shares.cosine)]
    for stage in ("lit", "mirror", "air"):
        light.append(light[-1] * np.nan_to_num(getattr(shares, stage)))
    light.append(np.nan_to_num(area * shares.total))
    sums = [float(each.sum()) for each in light]

    def share(part: float, whole: float) -> float:
        return part / whole if whole > 0.0 else float("nan")

    cosine = sums[1]
    alone = {
        name: share(float(light[1] @ np.nan_to_num(getattr(shares, name))), cosine)
        for name in ("shading", "blocking")
    }
    steps = [share(b, a) for a, b in pairwise(sums)]
    named = dict(zip(("cosine", "lit", "mirror", "air", "intercept"), steps, strict=True))
    values = {**named, **alone, "total": share(sums[-1], sums[0])}
    return {name: values[name] for name in EFFICIENCIES}


def field_flux(
    plant: Plant,
    time: Times | None = None,
    receiver: str | tuple[str, ...] = "",
    *,
    sun: npt.ArrayLike | None = None,
    aim: npt.ArrayLike | None = None,
    rays: float = 0,
    seed: int = 0,
    progress: Progress | None = None,
    light: FieldOptics | None = None,
    **changes: Any,
) -> PlantFlux:
    """Return what each heliostat of a plant puts on the receivers, and what is lost where.

    Parameters
    ----------
    plant
        As calibrated.
    time
        One time; see `heliotrope.sun.Times`. Or give the sun.
    receiver
        Name or names; "": all receivers of the plant. A beam counts where it lands first.
    sun
        Unit vector, (3,), instead of a time.
    aim
        Aim points, ENU m, (3,) or (N, 3); None: each heliostat's own, else the middle of the
        first receiver.
    rays
        Number of random rays that are traced instead, 1e3 to 1e9; 0: none. This needs the extra
        ``rays``, and is a second opinion.
    seed
        Of the rays.
    progress
        Called with the rays done and the rays of all.
    light
        Everything else; None: as `FieldOptics` has it.
    **changes
        Any attribute of `FieldOptics` by name, such as ``dni=850.0`` or ``shape="buie:0.05"``.

    Raises
    ------
    InputError
        If there is no receiver, the sun is below the horizon, more than one time is given, no
        heliostat reaches its aim, or a number is out of range.
    UnknownNameError
        If there is no receiver or option of that name.
    """
    optics = (light or FieldOptics()).changed(changes)
    direction = one_sun(plant, time, sun)
    scene = optics.scene(plant, direction, aim, _names(receiver))
    if scene.dark is not None and scene.dark.all():
        raise InputError(f"flux: none of the {len(plant)} heliostats can reach its aim at this sun")
    if rays:
        return _traced(plant, scene, optics, rays, seed, progress)
    engine = FieldFlux(scene, sun=optics.shape, air=optics.air, gaussians=optics.gaussians)
    return result_of(plant, scene, engine)


def result_of(plant: Plant, scene: Scene, engine: FieldFlux) -> PlantFlux:
    """Return what an engine computed of a plant's scene."""
    intercepts = [power / max(float(engine.leaving.sum()), 1e-300) for power in engine.powers]
    lit = int((engine.leaving > 0.0).sum())
    maps = [
        _view(*each, lit)
        for each in zip(scene.surfaces, engine.maps, engine.powers, intercepts, strict=True)
    ]
    return _result(plant, scene, engine.efficiencies, maps)


def _names(receiver: str | tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in ([receiver] if isinstance(receiver, str) else receiver) if name)


def one_sun(plant: Plant, time: Times | None, sun: npt.ArrayLike | None) -> FloatArray:
    """Return the unit vector to the sun, (3,), from one time or the sun itself.

    Raises
    ------
    InputError
        If there is not one of them, or the sun is below the horizon.
    """
    if sun is not None and time is None:
        light = normalize(as_vectors(sun, "sun"))
    elif time is not None and sun is None:
        light = vector(time, plant.site)
    else:
        raise InputError("flux: give either a time or the sun")
    if light.shape != (3,):
        raise InputError(f"flux: times of shape {light.shape[:-1]}; give one time")
    if light[2] <= 0.0:
        elevation = np.degrees(np.arcsin(np.clip(light[2], -1.0, 1.0)))
        raise InputError(
            f"flux: the sun stands {elevation:.1f}° above the horizon; choose a time by day"
        )
    return light


def _traced(
    plant: Plant,
    scene: Scene,
    light: FieldOptics,
    rays: float,
    seed: int,
    progress: Progress | None,
) -> PlantFlux:
    traced = trace(scene, rays, sun=light.shape, air=light.air, seed=seed, progress=progress)
    m = scene.mirrors
    air = 1.0 - air_loss(m.slant, light.air)
    mirror = as_float(m.reflectivity * m.clean)
    caught = np.nan_to_num(traced.lit * traced.intercept)
    total = as_float(traced.cosine * mirror * air * caught)
    shares = Efficiencies(
        traced.cosine, traced.shading, traced.blocking, traced.lit, mirror, air, traced.intercept,
        total,
    )  # fmt: skip
    left = float((m.area * traced.cosine * mirror * air * np.nan_to_num(traced.lit)).sum())
    views = [
        _view(s, f, float(p), float(p) / max(left * scene.dni, 1e-300), int((traced.lit > 0).sum()))
        for s, f, p in zip(scene.surfaces, traced.flux, traced.power, strict=True)
    ]
    found = _result(plant, scene, shares, views)
    spread = float(np.sqrt(np.sum(traced.power_error**2)))
    return replace(found, rays=int(rays), errors=traced.error, power_error=spread)


def _result(plant: Plant, scene: Scene, shares: Efficiencies, maps: list[FluxView]) -> PlantFlux:
    m = scene.mirrors
    if scene.dark is not None and scene.dark.any():
        unknown = {
            name: np.where(scene.dark, np.nan, getattr(shares, name)) for name in EFFICIENCIES
        }
        shares = Efficiencies(**unknown)
    return PlantFlux(
        plant.name, plant.names, plant.position, m.aim, scene.sun, scene.dni, m.area, m.clean,
        m.reflectivity, shares, tuple(maps), scene.surfaces,
    )  # fmt: skip


def _view(surface: Surface, flux: FloatArray, power: float, intercept: float, lit: int) -> FluxView:
    if isinstance(surface, Plate):
        rows, columns = surface.shape
        right = ((np.arange(columns) + 0.5) / columns - 0.5) * surface.width
    elif isinstance(surface, Cylinder):
        rows = surface.shape[0]
        edges = surface.edges
        right = 0.5 * (edges[1:] + edges[:-1]) * surface.radius
    else:
        right, row = np.arange(float(flux.size)), flux.reshape(1, -1)
        return FluxView(surface.name, right, np.zeros(1), row, power, intercept, lit)
    up = ((np.arange(rows) + 0.5) / rows - 0.5) * surface.height
    return FluxView(surface.name, right, up, flux, power, intercept, lit)


@dataclass(frozen=True, eq=False, repr=False)
class FluxTable(Value, Framed):
    """Efficiencies of a field at M suns.

    Attributes
    ----------
    plant
        Name.
    sun
        Unit vectors, (M, 3).
    time
        Unix seconds, (M,); NaN where the table is over positions of the sun.
    declination, hour
        Of the sun, rad, (M,); NaN in a table over times.
    weight
        Share of the sum that each sun has, (M,): of the day's or of the year's light.
    dni
        W/m², (M,).
    shares
        Efficiencies of the field, (M,), by name.
    power, peak
        On all receivers, W, and in the hottest cell, W/m², (M,).
    names, position
        Of the N heliostats.
    heliostat
        Mean total efficiency of each, weighted by the light, (N,).
    """

    plant: str
    sun: FloatArray
    time: FloatArray
    declination: FloatArray
    hour: FloatArray
    weight: FloatArray
    dni: FloatArray
    shares: dict[str, FloatArray]
    power: FloatArray
    peak: FloatArray
    names: tuple[str, ...]
    position: FloatArray
    heliostat: FloatArray

    def _card(self) -> Card:
        kind = "times" if np.isfinite(self.time).all() else "suns"
        line = (
            f"{self.plant}, {len(self.sun)} {kind}, mean optical efficiency {100 * self.mean:.4g}"
        )
        line += f" %, {span(self.power, 1e-6, 'MW')}"
        return Card(line)

    def _labelled(self) -> Labelled:
        row = ("sun",)
        variables = {
            "azimuth": Variable(row, self.azimuth, "rad"),
            "elevation": Variable(row, self.elevation, "rad"),
            "declination": Variable(row, self.declination, "rad"),
            "hour_angle": Variable(row, self.hour, "rad"),
            "dni": Variable(row, self.dni, "W/m²"),
            **{name: Variable(row, self.shares[name]) for name in EFFICIENCIES},
            "power": Variable(row, self.power, "W"),
            "peak": Variable(row, self.peak, "W/m²"),
        }
        known = bool(np.isfinite(self.time).all())
        labels = {"sun": frame_times(self.time) if known else np.arange(len(self.sun))}
        return Labelled(row, labels, variables, notes={"plant": self.plant})

    @property
    def azimuth(self) -> FloatArray:
        """Clockwise from north, rad, (M,)."""
        return azimuth_elevation(self.sun)[0]

    @property
    def elevation(self) -> FloatArray:
        """Rad, (M,)."""
        return azimuth_elevation(self.sun)[1]

    @property
    def mean(self) -> float:
        """Mean optical efficiency, weighted by the light."""
        light = self.weight * self.dni
        return float(light @ self.shares["total"] / light.sum())


def flux_day(
    plant: Plant,
    times: Times,
    receiver: str | tuple[str, ...] = "",
    *,
    aim: npt.ArrayLike | None = None,
    progress: Progress | None = None,
    light: FieldOptics | None = None,
    **changes: Any,
) -> FluxTable:
    """Return the efficiencies of a field at times with sunlight, such as a day's.

    Parameters
    ----------
    times
        M times, such as `heliotrope.sun.daylight` gives; those with the sun below 2° are left out.
    plant, receiver, aim, light, **changes
        As for `field_flux`.
    progress
        Called with the suns done and the suns of all.

    Raises
    ------
    InputError
        As `field_flux`, or if the sun is up at none of the times.
    """
    optics = (light or FieldOptics()).changed(changes)
    suns = np.atleast_2d(vector(times, plant.site))
    up = suns[:, 2] > np.sin(LOWEST)
    if not up.any():
        raise InputError("flux: the sun is above 2° at none of the times; choose others")
    seconds = np.atleast_1d(unix_seconds(times))[up]
    unknown = np.full(len(seconds), np.nan)
    weight = np.full(len(seconds), 1.0 / len(seconds))
    dni = np.full(len(seconds), optics.dni)
    return _table(
        plant, suns[up], (seconds, unknown, unknown, weight, dni), _names(receiver), aim, optics,
        progress,
    )  # fmt: skip


def flux_year(
    plant: Plant,
    receiver: str | tuple[str, ...] = "",
    *,
    declinations: int = 9,
    hours: float = 1.0,
    aim: npt.ArrayLike | None = None,
    progress: Progress | None = None,
    light: FieldOptics | None = None,
    **changes: Any,
) -> FluxTable:
    """Return the efficiencies of a field over the sun's positions in a year.

    Parameters
    ----------
    plant, receiver, aim, light, **changes
        As for `field_flux`; ``dni`` scales the irradiance of a clear day.
    declinations
        Number of declinations from −23.45° to 23.45°, 2 or more; the sun spends equal times
        between two of them.
    hours
        Step of the hour angle, 0.1 to 4 h.
    progress
        Called with the suns done and the suns of all.

    Raises
    ------
    InputError
        As `field_flux`, or if the numbers are out of range.

    Notes
    -----
    Suns below 2° are left out. The means are weighted by the irradiance of a clear day after
    Meinel, 0.7^(AM^0.678), AM = 1 / sin(elevation) being the air mass.
    """
    if not (2 <= declinations <= 100 and 0.1 <= hours <= 4.0):
        raise InputError(
            f"flux: {declinations} declinations and steps of {hours} h; give 2 to 100, and 0.1 to "
            "4 h"
        )
    optics = (light or FieldOptics()).changed(changes)
    longitude = np.linspace(-0.5 * np.pi, 0.5 * np.pi, declinations)
    steps = int(12.0 / hours)
    grid = np.meshgrid(
        np.arcsin(np.sin(_OBLIQUITY) * np.sin(longitude)),
        np.radians(15.0 * hours) * np.arange(-steps, steps + 1),
        indexing="ij",
    )
    weight = np.ones_like(grid[0])
    weight[[0, -1]] = 0.5
    declination, hour, weight = (each.ravel() for each in (*grid, weight))
    suns = sun_at(declination, hour, np.radians(plant.site.latitude_deg))
    up = suns[:, 2] > np.sin(LOWEST)
    clear = optics.dni * 0.7 ** (1.0 / suns[up, 2]) ** 0.678
    share = weight[up] / weight[up].sum()
    unknown = np.full(int(up.sum()), np.nan)
    columns = (unknown, declination[up], hour[up], share, clear)
    return _table(plant, suns[up], columns, _names(receiver), aim, optics, progress)


def sun_at(declination: npt.ArrayLike, hour: npt.ArrayLike, latitude: float) -> FloatArray:
    """Return unit vectors to the sun, ENU, (..., 3), from declination and hour angle, rad."""
    d, h = as_float(declination), as_float(hour)
    east = -np.cos(d) * np.sin(h)
    north = np.sin(d) * np.cos(latitude) - np.cos(d) * np.cos(h) * np.sin(latitude)
    up = np.sin(d) * np.sin(latitude) + np.cos(d) * np.cos(h) * np.cos(latitude)
    return np.stack(np.broadcast_arrays(east, north, up), axis=-1)


def _table(
    plant: Plant,
    suns: FloatArray,
    columns: tuple[FloatArray, ...],
    receivers: tuple[str, ...],
    aim: npt.ArrayLike | None,
    light: FieldOptics,
    progress: Progress | None,
) -> FluxTable:
    time, declination, hour, weight, dni = columns
    rows: list[dict[str, float]] = []
    power, peak = np.zeros(len(suns)), np.zeros(len(suns))
    heliostat = np.zeros(len(plant))
    for k, sun in enumerate(suns):
        scene = replace(light, dni=float(dni[k])).scene(plant, sun, aim, receivers)
        engine = FieldFlux(scene, sun=light.shape, air=light.air, gaussians=light.gaussians)
        efficiencies = engine.efficiencies
        rows.append(field_efficiencies(efficiencies, scene.mirrors.area))
        power[k] = sum(engine.powers)
        peak[k] = max(float(flux.max()) for flux in engine.maps)
        heliostat += weight[k] * dni[k] * np.nan_to_num(efficiencies.total)
        if progress is not None:
            progress(k + 1, len(suns))
    shares = {name: np.array([row[name] for row in rows]) for name in EFFICIENCIES}
    return FluxTable(
        plant.name, suns, time, declination, hour, weight, dni, shares, power, peak, plant.names,
        plant.position, as_float(heliostat / max(float(weight @ dni), 1e-300)),
    )  # fmt: skip
