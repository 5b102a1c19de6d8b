"""Plan a campaign: clusters, poses, hover patterns, flights and their duration."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.plan import flight
from heliotrope.airborne.plan.airspace import Airspace
from heliotrope.airborne.plan.calibration_points import (
    CalibrationPoints,
    PointSelection,
    calibration_points,
)
from heliotrope.airborne.plan.clusters import HeliostatClusters, clusters, tour
from heliotrope.airborne.plan.flight import CameraTarget, Craft, HoverStation, Sortie
from heliotrope.airborne.plan.hover import HoverMirrors, Sampling, mirrors, pattern
from heliotrope.airborne.visibility import FEWEST
from heliotrope.calibration.uncertainty import suns_of_year
from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS
from heliotrope.mechanism.parameters import MODELS
from heliotrope.mechanism.parameters import model as model_names

#: Distance of the default home point from the southern edge of the field, m.
_OUTSIDE = 20.0
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class PlanSettings:
    """Settings of a campaign.

    Attributes
    ----------
    size
        Diameter of a cluster, m.
    spread
        Largest angle between an optical axis and the mean axis of its cluster, rad; it limits the
        cluster radius to distance · tan(spread).
    view
        Angle of view of the camera across its shorter side, rad. A cluster must fit into a
        photograph.
    model
        Error model whose unknowns are to be estimated; "auto" selects the model jacks or malan8.
    sampling, selection, craft, airspace
        Patterns, calibration points, drones, and where drones may fly.
    home
        Take-off position, ENU metres, (3,); None for a point south of the field.
    hours_a_day
        Flying hours per day, h.
    photo_minutes, clear
        Parameters of the same campaign with a camera and a target, for comparison: time between
        photographs, min, and the fraction of the sunny hours that are clear.
    """

    size: float = 100.0
    spread: float = float(np.radians(25.0))
    view: float = float(np.radians(56.0))
    model: str = "auto"
    sampling: Sampling = field(default_factory=Sampling)
    selection: PointSelection = field(default_factory=PointSelection)
    craft: Craft = field(default_factory=Craft)
    airspace: Airspace = field(default_factory=Airspace)
    home: FloatArray | None = None
    hours_a_day: float = 8.0
    photo_minutes: float = 2.0
    clear: float = 0.7

    def __post_init__(self) -> None:
        if not 0.0 < self.spread <= np.radians(45.0):
            raise InputError(
                f"spread must be above 0° and at most 45°, not {np.degrees(self.spread):g}°"
            )
        if not 0.0 < self.view < np.pi:
            raise InputError(
                f"view must be above 0° and below 180°, not {np.degrees(self.view):g}°"
            )
        if not 0.0 < self.hours_a_day <= 24.0:
            raise InputError(
                f"the hours a day must be above 0 and at most 24, not {self.hours_a_day:g}"
            )


@dataclass(frozen=True)
class FlightPlan:
    """A planned campaign.

    Attributes
    ----------
    plant, settings, mirrors
        The field and the settings.
    clusters
        The K clusters.
    labels
        Names of the clusters, (K,).
    points
        Calibration points of each cluster, (K,).
    stations
        The poses of all clusters, cluster by cluster.
    sorties
        Sorties of all drones.
    homes
        Take-off position of each drone, ENU metres, (drones, 3).
    separation
        Minimum distance between two airborne drones, m.
    camera_target
        Duration of the same number of poses with a camera and a target.
    """

    plant: Plant
    settings: PlanSettings
    mirrors: HoverMirrors
    clusters: HeliostatClusters
    labels: tuple[str, ...]
    points: tuple[CalibrationPoints, ...]
    stations: tuple[HoverStation, ...]
    sorties: tuple[Sortie, ...]
    homes: FloatArray
    separation: float
    camera_target: CameraTarget

    @property
    def photos(self) -> int:
        """Number of photographs."""
        return sum(s.photos for s in self.sorties)

    @property
    def seconds(self) -> float:
        """Time from the first take-off to the last landing, s."""
        return max(s.end for s in self.sorties)

    @property
    def airborne(self) -> float:
        """Total flying time of all drones, s."""
        return sum(s.end - s.start for s in self.sorties)

    @property
    def poses(self) -> int:
        """Number of orientations to measure: the reachable calibration points of all heliostats."""
        return sum(int(k.facing.able.sum()) for k in self.points)

    def summary(self) -> dict[str, Any]:
        """Return the key figures of the campaign, for tables and JSON."""
        radius, able = self.clusters.radius, np.ones(len(self.mirrors), dtype=np.int64)
        for k, look in enumerate(self.points):
            able[self.clusters.rows(k)] = look.facing.able.sum(axis=0)
        patterns = [s.pattern for s in self.stations]
        hours = self.seconds / 3600.0
        flown = [look.plan for look in self.points]
        reflections = np.concatenate([k.prospect.reflections[k.facing.able] for k in self.points])
        return {
            "heliostats": len(self.mirrors),
            "clusters": len(self.clusters),
            "cluster_area_m2": float(self.clusters.area.mean()),
            "cluster_radius_m": [float(np.median(radius)), float(radius.max())],
            "calibration_points": self.settings.selection.points,
            "fewest_points_of_a_heliostat": int(able.min()),
            "orientations": self.poses,
            "hover_points_of_a_pattern": [min(map(len, patterns)), max(map(len, patterns))],
            "spacing_m": [min(p.spacing for p in patterns), max(p.spacing for p in patterns)],
            "samples_of_a_facet": min(p.samples for p in patterns),
            "reflections_of_a_mirror": np.quantile(reflections, (0.1, 0.5)).tolist(),
            "orientations_with_few_reflections": int(np.sum(reflections < FEWEST)),
            "photographs": self.photos,
            "drones": len(self.homes),
            "sorties": len(self.sorties),
            "hours": hours,
            "hours_in_the_air": self.airborne / 3600.0,
            "hours_waiting_in_the_air": sum(v.wait for s in self.sorties for v in s.visits)
            / 3600.0,
            "working_days": hours / self.settings.hours_a_day,
            "separation_m": self.separation,
            "beam_error_before_mrad": 1e3 * float(np.median([p.before for p in flown])),
            "beam_error_after_mrad": 1e3 * float(np.median([p.error[-1] for p in flown])),
            "camera_target": {
                "photographs": self.poses,
                "hours": self.camera_target.hours,
                "sunny_hours_a_day": self.camera_target.sunny,
                "days": self.camera_target.days,
                "months": self.camera_target.months,
            },
        }


def plan_flight(
    plant: Plant, settings: PlanSettings, progress: Progress | None = None
) -> FlightPlan:
    """Return the plan of a campaign over all heliostats of a plant.

    Parameters
    ----------
    plant
        The plant; calibrated mechanisms are used if it has any.
    settings
        Settings; if the airspace has no ground points, those of the plant are used.
    progress
        Called with the numbers of clusters (done, total).

    Raises
    ------
    InputError
        If the model has at least as many unknowns as there are points, or heights, keep-outs, stops
        or the battery allow no flight.
    """
    all_mirrors = mirrors(plant)
    airspace = settings.airspace
    if not len(airspace.ground):
        airspace = replace(airspace, ground=plant.position)
    settings = replace(settings, airspace=airspace)
    limit = settings.sampling.distance * float(np.tan(min(settings.spread, 0.5 * settings.view)))
    cells = clusters(plant.position, size=settings.size, max_radius=limit)
    digits = len(str(len(cells)))
    labels = tuple(f"C{k + 1:0{digits}d}" for k in range(len(cells)))
    suns = suns_of_year(plant.site, 2026)
    look, stations = [], list[HoverStation]()
    for k in range(len(cells)):
        if progress is not None:
            progress(k, len(cells))
        rows = cells.rows(k)
        cluster = _look(plant, all_mirrors, cells.center[k], rows, suns, settings, labels[k])
        look.append(cluster)
        stations += _stations(all_mirrors, rows, cluster, k, settings)
    _check_patterns(stations, labels, airspace)
    start = _home(plant, settings)
    homes = flight.homes(start, settings.craft.count)
    order = tour(cells.center[:, :2], start[:2])
    sorties = flight.fly(stations, order.tolist(), airspace, homes, settings.craft, labels)
    poses = sum(int(cluster.facing.able.sum()) for cluster in look)
    return FlightPlan(
        plant,
        settings,
        all_mirrors,
        cells,
        labels,
        tuple(look),
        tuple(stations),
        tuple(sorties),
        homes,
        flight.separation(sorties, stations, settings.craft),
        flight.camera_target(
            plant.site,
            poses,
            minutes=settings.photo_minutes,
            targets=max(1, len(plant.targets)),
            clear=settings.clear,
        ),
    )


def _look(
    plant: Plant,
    all_mirrors: HoverMirrors,
    center: FloatArray,
    rows: npt.NDArray[np.intp],
    suns: FloatArray,
    settings: PlanSettings,
    label: str,
) -> CalibrationPoints:
    """Return the calibration points of one cluster, chosen for its central heliostat."""
    away = np.linalg.norm(plant.position[rows] - center, axis=-1)
    group, row = plant.find(all_mirrors.names[int(rows[np.argmin(away)])])
    middle = group.calibrated[np.array([row])]
    kind = _model(middle) if settings.model == "auto" else settings.model
    names = model_names(kind, middle.parameters)
    settings.selection.check(names, kind)
    if group.aim is not None and np.isfinite(group.aim[row]).all():
        aim = group.aim[row]
    else:
        surfaces = [r.center for r in plant.receivers] + [t.center for t in plant.targets]
        if not surfaces:
            raise InputError(
                "the plant has no receiver and no target to aim at; add one to the plant file"
            )
        aim = surfaces[0]
    return calibration_points(
        all_mirrors,
        rows,
        middle,
        aim,
        names,
        suns,
        settings.airspace,
        settings.sampling,
        settings.selection,
        label,
    )


def _model(mechanism: Mechanism) -> str:
    for name in ("jacks", "malan8"):
        if all(p in mechanism.parameters for p in MODELS[name]):
            return name
    return "full"


def _stations(
    all_mirrors: HoverMirrors,
    rows: npt.NDArray[np.intp],
    look: CalibrationPoints,
    cluster: int,
    settings: PlanSettings,
) -> list[HoverStation]:
    speed = all_mirrors.drives.table[rows][..., SLOTS["speed"]]
    travel = flight.mirror_travel(look.facing.counts, speed)
    return [
        HoverStation(
            cluster,
            k,
            pattern(
                look.facing.vertex[k],
                all_mirrors.corners[rows],
                all_mirrors.slopes[rows],
                all_mirrors.facet_area[rows],
                look.point[k],
                look.direction[k],
                settings.sampling,
            ),
            float(travel[k]),
        )
        for k in range(len(look))
    ]


def _check_patterns(
    stations: list[HoverStation], labels: tuple[str, ...], airspace: Airspace
) -> None:
    """Reject patterns that leave the permitted airspace."""
    sizes = np.array([len(s.pattern) for s in stations])
    free = airspace.free(np.concatenate([s.pattern.camera for s in stations]))
    owner = np.repeat(np.arange(len(stations)), sizes)
    if not free.all():
        station = stations[int(owner[np.argmin(free)])]
        raise InputError(
            f"{labels[station.cluster]}, calibration point {station.point + 1}: its pattern of "
            f"{station.pattern.columns} by {station.pattern.rows} points, "
            f"{station.pattern.spacing:g} m apart, leaves the height limits or the fence, or comes "
            "too near to a keep-out; lower the pointing error or the elevations, or widen the "
            "airspace"
        )


def _home(plant: Plant, settings: PlanSettings) -> FloatArray:
    """Return the take-off position: as specified, or south of the middle of the field."""
    if settings.home is not None:
        start = np.asarray(settings.home, dtype=np.float64)
    else:
        place = plant.position
        start = np.array([place[:, 0].mean(), place[:, 1].min() - _OUTSIDE, 0.0])
        start[2] = settings.airspace.ground_below(start[None])[0]
    up = start + np.array([0.0, 0.0, settings.airspace.min_height])
    if not settings.airspace.free_legs(start[None], up[None])[0]:
        raise InputError(
            f"home at {start[0]:.1f} m east, {start[1]:.1f} m north: it is in a keep-out or "
            "outside the fence; choose another with --home"
        )
    return start
