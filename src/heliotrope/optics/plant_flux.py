"""The flux and the efficiencies of a plant: at one sun position, over a day, and over a year.

The efficiencies of the field are listed in the order of the light path, each as a fraction of the
light that the previous step left, so that their product is the total: cosine, shading and blocking
together (`lit`), mirror (reflectivity and soiling), atmosphere, intercept.
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
from heliotrope.field.tower import Tower
from heliotrope.frames import ENU, Framed, Labelled, Variable
from heliotrope.frames import times as frame_times
from heliotrope.geometry import FloatArray, as_float, as_vectors, azimuth_elevation, normalize
from heliotrope.optics.attenuation import air_loss
from heliotrope.optics.canting import Canting, canted
from heliotrope.optics.flux import FluxView
from heliotrope.optics.plant_scene import scene_of
from heliotrope.optics.rays import trace
from heliotrope.optics.receiver_flux import Efficiencies, FieldFlux
from heliotrope.optics.scene import Scene
from heliotrope.optics.sun_shape import SunShape
from heliotrope.optics.surfaces import Cylinder, Plate, Surface
from heliotrope.sun import Times, unix_seconds, vector
from heliotrope.values import Card, Value, amount, span

Progress = Callable[[int, int], None]
#: Efficiencies of a heliostat and of a field, in the order of the light path; "lit" combines
#: shading and blocking.
EFFICIENCIES = ("cosine", "shading", "blocking", "lit", "mirror", "air", "intercept", "total")
#: The sun's greatest declination, rad.
_OBLIQUITY = np.radians(23.45)
#: Apparent elevation below which a yearly table has no sun positions, rad.
LOWEST = np.radians(2.0)


@dataclass(frozen=True)
class FieldOptics:
    """Everything that determines the light of a field, apart from the plant and the sun position.

    Attributes
    ----------
    dni
        Direct normal irradiance, W/m².
    shape
        Sun shape, or its name: `heliotrope.optics.SunShape`.
    air
        Atmospheric model, or the visibility, km: `heliotrope.optics.air_loss`.
    slope
        Standard deviation of the surface normal per axis, rad; None: the value in the plant file,
        or else 1 mrad.
    error
        Two-dimensional standard deviation of the mirror normals expected from their calibration,
        rad, () or (N,).
    reflectivity, clean
        Reflectivity of the clean mirror, and the fraction that soiling leaves, 0 to 1, () or (N,).
        A reflectivity of None: the value in the plant file, or else 0.9.
    focus
        "plant": as the plant file specifies, or else "slant"; "slant": each mirror is focused on
        its aim; "flat"; or the focal length, m. For mirrors with facets it applies to each facet.
    facets
        Columns and rows of equal facets; None: as in the plant file.
    canting
        Canting of these facets: "slant", a focal length or the sun vector for which they are canted
        off-axis; see `heliotrope.optics.canting.canted`.
    cells
        Rows and columns of each receiver; None: chosen by the engine.
    towers
        Other objects that shade and block.
    gaussians
        Number of Gaussians for the sun image, 1 to 4.
    """

    dni: float = 900.0
    shape: str | SunShape = "limb"
    air: str | float = "clear"
    slope: npt.ArrayLike | None = None
    error: npt.ArrayLike = 1e-3
    reflectivity: npt.ArrayLike | None = None
    clean: npt.ArrayLike = 1.0
    focus: Literal["plant", "slant", "flat"] | float = "plant"
    facets: tuple[int, int] | None = None
    canting: Canting = "slant"
    cells: tuple[int, int] | None = None
    towers: tuple[Tower, ...] = ()
    gaussians: int = 3

    def changed(self, changes: dict[str, Any]) -> "FieldOptics":
        """Return the settings with some values changed.

        Raises
        ------
        UnknownNameError
            If there is no such attribute.
        """
        known = [item.name for item in fields(self)]
        for name in changes:
            if name not in known:
                raise UnknownNameError("option of the light", name, known)
        return replace(self, **changes)

    def scene(
        self, plant: Plant, sun: FloatArray, aim: npt.ArrayLike | None, receivers: tuple[str, ...]
    ) -> Scene:
        """Return the scene of a plant under these conditions."""
        error = as_float(self.error)
        if not (np.isfinite(error) & (error >= 0.0) & (error < 0.2)).all():
            raise InputError(
                f"flux: the error must be between 0 and 0.2 rad, not {error.max():g} rad"
            )
        # The variance of the normal is split between two axes, and the beam turns by twice the
        # angle.
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
        ends = scene.mirrors.aim
        mirrors = canted(scene.mirrors, self.facets, self.canting, plant=plant, aim=ends)
        return replace(scene, mirrors=mirrors)

    def engine(self, scene: Scene) -> FieldFlux:
        """Return the flux engine for a scene under these conditions."""
        return FieldFlux(scene, sun=self.shape, air=self.air, gaussians=self.gaussians)


@dataclass(frozen=True, eq=False, repr=False)
class PlantFlux(Value, Framed):
    """Flux and efficiencies of N heliostats at one sun position.

    Attributes
    ----------
    plant
        Name.
    names, position, aim
        Names, positions and aims of the heliostats; positions and aims in ENU m, (N, 3).
    sun
        Unit vector, (3,).
    dni
        W/m².
    area
        Area of the mirrors, m², (N,).
    clean, reflectivity
        Cleanliness and reflectivity of each mirror, (N,).
    efficiencies
        Efficiencies of each mirror, (N,); NaN for a mirror that cannot reach its aim.
    maps
        Flux on each receiver. A cylinder is unrolled: metres clockwise from north, or from the
        middle of its opening; a mesh is one row of cells.
    surfaces
        The receivers with their cells.
    rays
        Number of rays, if ray-traced; 0: computed by the engine.
    errors, power_error
        Standard errors of the maps, W/m², and of the power, W, if ray-traced.
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
        """Power that each heliostat sends to the receivers, W, (N,)."""
        return as_float(np.nan_to_num(self.efficiencies.total) * self.area * self.dni)

    @property
    def power(self) -> float:
        """Power on all receivers, W."""
        return sum(view.power for view in self.maps)

    @property
    def peak(self) -> float:
        """Maximum flux in a cell, W/m²."""
        return max(float(view.flux.max()) for view in self.maps)

    @property
    def intercept(self) -> float:
        """Fraction of the field's light that reaches a receiver; NaN without light."""
        return self.summary["intercept"]

    @property
    def heliostats(self) -> int:
        """Number of heliostats whose beams are counted."""
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
        """Efficiencies of the field, by name; see the module docstring."""
        return field_efficiencies(self.efficiencies, self.area)


def field_efficiencies(shares: Efficiencies, area: FloatArray) -> dict[str, float]:
    """Return the efficiencies of a field, each as a fraction of what the previous step left.

    Parameters
    ----------
    shares
        Efficiencies of the mirrors, (N,); a mirror with NaN counts as dark, but its area is
        included.
    area
        m², (N,).
    """
    light = [area, np.nan_to_num(area * shares.cosine)]
    for stage in ("lit", "mirror", "air"):
        light.append(light[-1] * np.nan_to_num(getattr(shares, stage)))
    light.append(np.nan_to_num(area * shares.total))
    sums = [float(item.sum()) for item in light]
    if np.isnan(shares.total).all():
        # Without sunlight nothing is known of what comes after the air.
        sums[-1] = np.nan

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
    """Return the flux of a field on its receivers, and the losses along the light path.

    Parameters
    ----------
    plant
        The plant, with its calibrated mechanisms.
    time
        One time; see `heliotrope.sun.Times`. Alternatively pass ``sun``.
    receiver
        Name or names; "": all receivers of the plant. A beam counts on the first receiver that it
        meets.
    sun
        Unit vector, (3,), instead of a time.
    aim
        Aim points, ENU m, (3,) or (N, 3); None: each heliostat's own aim, or the middle of the
        first receiver.
    rays
        Number of random rays to trace instead of using the engine, 1e3 to 1e9; 0: no ray tracing.
        Ray tracing needs the extra ``rays`` and serves as an independent check.
    seed
        Seed of the rays.
    progress
        Called with the numbers of rays (done, total).
    light
        All other settings; None: the defaults of `FieldOptics`.
    **changes
        Any attribute of `FieldOptics` by name, such as ``dni=850.0`` or ``shape="buie:0.05"``.

    Raises
    ------
    InputError
        If there is no receiver, the sun is below the horizon, more than one time is passed, no
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
    engine = optics.engine(scene)
    engine.check_met()
    return result_of(plant, scene, engine)


def result_of(plant: Plant, scene: Scene, engine: FieldFlux) -> PlantFlux:
    """Return the results of an engine for a plant's scene."""
    return _result(plant, scene, engine.efficiencies, flux_views(engine))


def flux_views(engine: FieldFlux) -> list[FluxView]:
    """Return the flux on the surfaces of a scene; the maps are zero if no mirror sends light.

    Parameters
    ----------
    engine
        The flux of the scene.
    """
    leaving, surfaces = float(engine.leaving.sum()), engine.scene.surfaces
    lit = int((engine.leaving > 0.0).sum())
    return [
        _view(surface, flux, power, power / leaving if leaving > 0.0 else np.nan, lit)
        for surface, flux, power in zip(surfaces, engine.maps, engine.powers, strict=True)
    ]


def _names(receiver: str | tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in ([receiver] if isinstance(receiver, str) else receiver) if name)


def one_sun(plant: Plant, time: Times | None, sun: npt.ArrayLike | None) -> FloatArray:
    """Return the unit vector to the sun, (3,), from a single time or from the vector itself.

    Raises
    ------
    InputError
        If neither or both are passed, if there are several times, or if the sun is below the
        horizon.
    """
    if sun is not None and time is None:
        light = normalize(as_vectors(sun, "sun"))
    elif time is not None and sun is None:
        light = vector(time, plant.site)
    else:
        raise InputError("flux: pass either a time or a sun vector")
    if light.shape != (3,):
        raise InputError(f"flux: times of shape {light.shape[:-1]}; pass one time")
    if light[2] <= 0.0:
        elevation = np.degrees(np.arcsin(np.clip(light[2], -1.0, 1.0)))
        raise InputError(
            f"flux: the sun is {-elevation:.1f}° below the horizon; choose a time in daylight"
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
    rest = float((m.area * traced.cosine * mirror * air * np.nan_to_num(traced.lit)).sum())
    views = [
        _view(s, f, float(p), float(p) / max(rest * scene.dni, 1e-300), int((traced.lit > 0).sum()))
        for s, f, p in zip(scene.surfaces, traced.flux, traced.power, strict=True)
    ]
    result = _result(plant, scene, shares, views)
    spread = float(np.sqrt(np.sum(traced.power_error**2)))
    return replace(result, rays=int(rays), errors=traced.error, power_error=spread)


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
    """Efficiencies of a field at M sun positions.

    Attributes
    ----------
    plant
        Name.
    sun
        Unit vectors, (M, 3).
    time
        POSIX seconds, (M,); NaN in a table over sun positions.
    declination, hour
        Declination and hour angle of the sun, rad, (M,); NaN in a table over times.
    weight
        Weight of each sun position, (M,): its fraction of the light of the day or the year.
    dni
        W/m², (M,).
    shares
        Efficiencies of the field, (M,), by name.
    power, peak
        Power on all receivers, W, and flux in the cell with the highest flux, W/m², (M,).
    names, position
        Names of the N heliostats.
    heliostat
        Mean total efficiency of each heliostat, weighted by the light, (N,).
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
        """Azimuth of the sun, clockwise from north, rad, (M,)."""
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
    """Return the efficiencies of a field at times with sunlight, such as the times of a day.

    Parameters
    ----------
    times
        M times, such as the times from `heliotrope.sun.daylight`; times with the sun below 2° are
        left out.
    plant, receiver, aim, light, **changes
        As for `field_flux`.
    progress
        Called with the numbers of sun positions (done, total).

    Raises
    ------
    InputError
        As for `field_flux`, or if the sun is up at none of the times.
    """
    optics = (light or FieldOptics()).changed(changes)
    suns = np.atleast_2d(vector(times, plant.site))
    up = suns[:, 2] > np.sin(LOWEST)
    if not up.any():
        raise InputError(
            "flux: the sun is at or below 2° elevation at all of these times; choose other times"
        )
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
    """Return the efficiencies of a field over the sun positions of a year.

    Parameters
    ----------
    plant, receiver, aim, light, **changes
        As for `field_flux`; ``dni`` scales the irradiance of a clear day.
    declinations
        Number of declinations from −23.45° to 23.45°, 2 or more; the sun spends equal times between
        neighbouring declinations.
    hours
        Step of the hour angle, 0.1 to 4 h.
    progress
        Called with the numbers of sun positions (done, total).

    Raises
    ------
    InputError
        As for `field_flux`, or if the numbers are out of range.

    Notes
    -----
    Sun positions below 2° are left out. The means are weighted by clear-day irradiance according to
    Meinel, 0.7^(AM^0.678), where AM = 1 / sin(elevation) is the air mass.
    """
    if not (2 <= declinations <= 100 and 0.1 <= hours <= 4.0):
        raise InputError(
            f"flux: use 2 to 100 declinations and steps of 0.1 to 4 h, not {declinations} and "
            f"{hours} h"
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
    declination, hour, weight = (item.ravel() for item in (*grid, weight))
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
        engine = light.engine(scene)
        engine.check_met()
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
