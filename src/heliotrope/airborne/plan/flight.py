"""Plan flights: the order of the stations, take-off positions and duration.

A station is one cluster in one pose, measured with one hover pattern. While a drone flies the
stations of some clusters, the heliostats of the other clusters move to their next pose. Clusters
are therefore flown in groups. The whole group is flown in one pose, then in the next pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.plan.airspace import Airspace
from heliotrope.airborne.plan.hover import Pattern
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, azimuth_elevation
from heliotrope.sun import Site, position

#: Largest group of clusters tried.
_GROUPS = 8
#: Minimum distance between drones in the air, m.
APART = 15.0
#: Longest time for which a take-off waits for other drones, s.
_LATEST = 7200.0
#: Time that heliostats need to settle before the first photograph, s.
REST = 5.0


@dataclass(frozen=True)
class Craft:
    """Performance of the drones.

    Attributes
    ----------
    count
        Number of drones flying at the same time.
    speed
        Speed between stations, m/s, up to 15.
    acceleration
        Acceleration, m/s².
    photo
        Time to come to rest at a hover point and take a photograph, s.
    endurance
        Time from take-off to landing on one battery, excluding its reserve, s.
    change
        Time from landing to the next take-off, s.
    """

    count: int = 1
    speed: float = 8.0
    acceleration: float = 2.0
    photo: float = 2.5
    endurance: float = 1500.0
    change: float = 300.0

    def __post_init__(self) -> None:
        if not 1 <= self.count <= 50:
            raise InputError(f"the number of drones must be between 1 and 50, not {self.count}")
        if not 0.0 < self.speed <= 15.0:
            raise InputError(f"speed must be above 0 and at most 15 m/s, not {self.speed:g} m/s")
        for name in ("acceleration", "photo", "endurance"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name} must be above 0, not {value:g}")
        if not (np.isfinite(self.change) and self.change >= 0.0):
            raise InputError(f"battery change must be 0 or more, not {self.change:g} s")

    def time(self, length: float) -> float:
        """Return the duration of a leg from rest to rest, s."""
        if length >= self.speed**2 / self.acceleration:
            return length / self.speed + self.speed / self.acceleration
        return 2.0 * float(np.sqrt(length / self.acceleration))

    def way(self, points: FloatArray) -> float:
        """Return the duration of a route through points (M, 3) with a stop at each point, s."""
        return sum(self.time(float(d)) for d in np.linalg.norm(np.diff(points, axis=0), axis=-1))


@dataclass(frozen=True)
class HoverStation:
    """One cluster in one pose.

    Attributes
    ----------
    cluster, point
        Indices of the cluster and of its calibration point.
    pattern
        The hover points.
    travel
        Time that the heliostats need to move from the previous pose, s; 0 for the first pose.
    """

    cluster: int
    point: int
    pattern: Pattern
    travel: float

    @property
    def yaw(self) -> float:
        """Heading of the drone, rad clockwise from north in [0, 2π)."""
        return float(azimuth_elevation(-self.pattern.direction)[0])

    @property
    def pitch(self) -> float:
        """Pitch of the gimbal, rad; −π/2 is straight down."""
        return float(azimuth_elevation(-self.pattern.direction)[1])


@dataclass(frozen=True)
class StationVisit:
    """Hover points of a station flown in one go.

    Attributes
    ----------
    station
        Index of the station.
    first, last
        Indices of the first hover point and of the point after the last.
    approach
        Points between the previous position and the first hover point, ENU metres, (M, 3).
    begin, end
        Start and end of photography, s since the start of the campaign.
    wait
        Hover time before the first photograph while heliostats are still moving, s.
    """

    station: int
    first: int
    last: int
    approach: FloatArray
    begin: float
    end: float
    wait: float


@dataclass(frozen=True)
class Sortie:
    """One flight on one battery.

    Attributes
    ----------
    drone, number
        Indices from 0; ``number`` counts the sorties of the drone.
    start, end
        Take-off and landing, s since the start of the campaign.
    home
        Take-off and landing position, ENU metres, (3,).
    visits
        Stations in the order flown.
    back
        Points between the last hover point and the landing, ENU metres, (M, 3).
    """

    drone: int
    number: int
    start: float
    end: float
    home: FloatArray
    visits: tuple[StationVisit, ...]
    back: FloatArray

    @property
    def photos(self) -> int:
        """Number of photographs."""
        return sum(v.last - v.first for v in self.visits)


@dataclass(frozen=True)
class _Routes:
    """Routes between stations and homes, each computed only once."""

    airspace: Airspace
    stations: Sequence[HoverStation]
    labels: Sequence[str]
    known: dict[tuple[int, int, int], FloatArray]
    #: Durations of the route home, by drone and station.
    backs: dict[tuple[int, int], float]

    def between(
        self, a: FloatArray, b: FloatArray, whence: int, whither: int, home: FloatArray, drone: int
    ) -> FloatArray:
        """Return the route between positions of two stations; index -1 means the home position."""
        legs = self.airspace.free_legs
        if legs(a[None], b[None])[0]:
            return np.empty((0, 3))
        key = (drone, whence, whither)
        if key not in self.known:
            ends = [home if r < 0 else self.stations[r].pattern.center for r in (whence, whither)]
            self.known[key] = self._searched(ends[0], ends[1], max(whence, whither))
        # The route between the station centres is good enough if it can be joined and left at these
        # points.
        route = self.known[key]
        if len(route) and legs(np.stack([a, route[-1]]), np.stack([route[0], b])).all():
            return route
        return self._searched(a, b, max(whence, whither))

    def _searched(self, a: FloatArray, b: FloatArray, row: int) -> FloatArray:
        route = self.airspace.route(a, b)
        if route is None:
            station = self.stations[row]
            raise InputError(
                f"{self.labels[station.cluster]}, calibration point {station.point + 1}: no free "
                "route there and back; widen the fence, raise the upper height limit or move the "
                "home point"
            )
        return route


def fly(
    stations: Sequence[HoverStation],
    order: Sequence[int],
    airspace: Airspace,
    home: FloatArray,
    craft: Craft,
    labels: Sequence[str],
) -> list[Sortie]:
    """Return the sorties of the drones.

    Parameters
    ----------
    stations
        Stations of all clusters. The stations of a cluster are in the order of its calibration
        points.
    order
        Clusters in the order of a short tour.
    airspace, craft
        Limits and performance.
    home
        Take-off positions, ENU metres, (count, 3).
    labels
        Names of the clusters, for error messages.

    Notes
    -----
    Each drone receives a connected part of the tour with an equal share of the photographs. Its
    group size, 1 to 8 clusters, is the one with which the drone finishes earliest.

    Raises
    ------
    InputError
        If a station cannot be reached at all, or not on one battery.
    """
    place: dict[int, list[int]] = {int(c): [] for c in order}
    for row, station in enumerate(stations):
        place[station.cluster].append(row)
    load = np.array([sum(len(stations[r].pattern) for r in place[int(c)]) for c in order], float)
    share = (np.cumsum(load) - 0.5 * load) / load.sum() * craft.count
    routes = _Routes(airspace, stations, labels, {}, {})
    flown: list[Sortie] = []
    for drone in range(craft.count):
        mine = [int(c) for c, s in zip(order, share, strict=True) if int(s) == drone]
        if not mine:
            continue
        best, rest = list[Sortie](), list[int]()
        for size in range(1, min(_GROUPS, len(mine)) + 1):
            rows = grouped(mine, place, size)
            tried = _sorties_of(drone, rows, stations, home[drone], craft, routes)
            if best and tried[-1].end > 0.995 * best[-1].end:
                # Moving heliostats no longer cause a wait, so larger groups would only lengthen the
                # flight.
                break
            best, rest = tried, rows
        if flown:
            others = [timeline(flown, stations, craft, d) for d in range(drone)]
            best = _sorties_of(drone, rest, stations, home[drone], craft, routes, others)
        flown += best
    return flown


def grouped(clusters: Sequence[int], place: dict[int, list[int]], size: int) -> list[int]:
    """Return station indices: all clusters of a group in one pose before the next pose."""
    rows: list[int] = []
    groups = max(1, len(clusters) // size)
    for group in np.array_split(np.array(clusters), groups):
        members = [int(c) for c in group]
        for k in range(max(len(place[c]) for c in members)):
            # Alternate the direction, so that the route to the next pose is short.
            order = members if k % 2 == 0 else members[::-1]
            rows.extend(place[c][k] for c in order if k < len(place[c]))
    return rows


def _sorties_of(
    drone: int,
    rows: Sequence[int],
    stations: Sequence[HoverStation],
    home: FloatArray,
    craft: Craft,
    routes: _Routes,
    others: "Sequence[Timeline]" = (),
) -> list[Sortie]:
    """Return the sorties of a drone that flies ``rows`` in order and avoids other drones."""
    work = _Work(drone, stations, home, craft, routes, others, {}, [], [])
    for row in rows:
        work.station(row)
    work.land()
    return work.sorties


@dataclass
class _Work:
    """State of one drone's work."""

    drone: int
    stations: Sequence[HoverStation]
    home: FloatArray
    craft: Craft
    routes: _Routes
    others: "Sequence[Timeline]"
    #: When each cluster's last photograph was taken.
    photographed: dict[int, float]
    sorties: list[Sortie]
    visits: list[StationVisit]
    now: float = 0.0
    start: float = 0.0
    place: FloatArray | None = None
    row: int = -1

    def station(self, row: int) -> None:
        """Fly one station, landing in between whenever the battery requires it."""
        station = self.stations[row]
        camera = station.pattern.camera
        step = self.craft.photo + self.craft.time(station.pattern.spacing)
        ready = self.photographed.get(station.cluster, -np.inf) + station.travel + REST
        first = 0
        while first < len(camera):
            at_home = self.place is None
            origin = self.home if self.place is None else self.place
            approach = self._route(origin, camera[first], -1 if at_home else self.row, row)
            travel = self.craft.way(np.vstack([origin, approach, camera[first]]))
            if at_home:
                # Wait on the ground rather than in the air.
                self.start = self.now = max(self.now, ready - travel)
            begin = max(self.now + travel, ready)
            remaining = self.start + self.craft.endurance - begin - self.back(row)
            count = min(len(camera) - first, int(remaining // step))
            if count < 1:
                if at_home:
                    raise InputError(
                        f"{self.routes.labels[station.cluster]}: {travel:.0f} s to fly there and "
                        f"{self.back(row):.0f} s back leave no time for a photograph within "
                        f"{self.craft.endurance:.0f} s; take off closer to it"
                    )
                self.land()
                continue
            end = begin + count * step
            wait = begin - self.now - travel
            self.visits.append(StationVisit(row, first, first + count, approach, begin, end, wait))
            first += count
            self.now, self.place, self.row = end, camera[first - 1], row
        self.photographed[station.cluster] = self.now

    def _route(self, a: FloatArray, b: FloatArray, whence: int, whither: int) -> FloatArray:
        return self.routes.between(a, b, whence, whither, self.home, self.drone)

    def back(self, row: int) -> float:
        """Return the longest flight time home from a station, s."""
        known = self.routes.backs
        if (self.drone, row) not in known:
            known[self.drone, row] = self._back(row)
        return known[self.drone, row]

    def _back(self, row: int) -> float:
        pattern = self.stations[row].pattern
        route = self._route(pattern.center, self.home, row, -1)
        half = 0.5 * pattern.spacing * float(np.hypot(pattern.columns, pattern.rows))
        return (
            self.craft.way(np.vstack([pattern.center, route, self.home])) + half / self.craft.speed
        )

    def land(self) -> None:
        """Fly home and change the battery."""
        if self.place is None:
            return
        route = self._route(self.place, self.home, self.row, -1)
        end = self.now + self.craft.way(np.vstack([self.place, route, self.home]))
        sortie = Sortie(
            self.drone, len(self.sorties), self.start, end, self.home, tuple(self.visits), route
        )
        late = _delay(sortie, self.stations, self.craft, self.others) if self.others else 0.0
        if late:
            visits = [replace(v, begin=v.begin + late, end=v.end + late) for v in sortie.visits]
            sortie = replace(
                sortie, start=sortie.start + late, end=end + late, visits=tuple(visits)
            )
            for visit in visits:
                self.photographed[self.stations[visit.station].cluster] = visit.end
        self.sorties.append(sortie)
        self.visits, self.place = [], None
        self.now = sortie.end + self.craft.change


@dataclass(frozen=True)
class Timeline:
    """Position of a drone over time.

    Attributes
    ----------
    time
        Time since the start of the campaign, s, ascending, (W,).
    place
        ENU metres, (W, 3).
    """

    time: FloatArray
    place: FloatArray

    def at(self, clock: FloatArray) -> FloatArray:
        """Return the drone's positions at times (M,), ENU metres, (M, 3)."""
        return np.stack([np.interp(clock, self.time, self.place[:, k]) for k in range(3)], -1)


def _delay(
    sortie: Sortie, stations: Sequence[HoverStation], craft: Craft, others: Sequence[Timeline]
) -> float:
    """Return the delay that keeps a sortie clear of other drones, s."""
    line = timeline([sortie], stations, craft, sortie.drone)
    clock = np.arange(sortie.start, sortie.end, 1.0)
    mine = line.at(clock)
    for late in np.arange(0.0, _LATEST, 10.0):
        if all(
            np.linalg.norm(mine - other.at(clock + late), axis=-1).min() >= APART
            for other in others
        ):
            return float(late)
    raise InputError(
        f"drones: drone {sortie.drone + 1} comes within {APART:g} m of another whenever it takes "
        "off; fly with fewer drones"
    )


def timeline(
    sorties: Sequence[Sortie], stations: Sequence[HoverStation], craft: Craft, drone: int
) -> Timeline:
    """Return the path of one drone through all its sorties."""
    time, place = [0.0], []
    mine = [s for s in sorties if s.drone == drone]
    place.append(mine[0].home)

    def add(moment: float, point: FloatArray) -> None:
        time.append(max(moment, time[-1]))
        place.append(point)

    for sortie in mine:
        add(sortie.start, sortie.home)
        for visit in sortie.visits:
            station = stations[visit.station]
            camera = station.pattern.camera[visit.first : visit.last]
            moment, previous = time[-1], place[-1]
            for point in (*visit.approach, camera[0]):
                moment, previous = (
                    moment + craft.time(float(np.linalg.norm(point - previous))),
                    point,
                )
                add(moment, point)
            step = (visit.end - visit.begin) / len(camera)
            for k, point in enumerate(camera):
                add(visit.begin + k * step, point)
            add(visit.end, camera[-1])
        for point in sortie.back:
            add(time[-1] + craft.time(float(np.linalg.norm(point - place[-1]))), point)
        add(sortie.end, sortie.home)
    return Timeline(np.array(time), np.array(place))


def separation(sorties: Sequence[Sortie], stations: Sequence[HoverStation], craft: Craft) -> float:
    """Return the smallest distance between drones, m, checked every second; inf for one drone."""
    drones = sorted({s.drone for s in sorties})
    if len(drones) < 2:
        return float(np.inf)
    clock = np.arange(0.0, max(s.end for s in sorties), 1.0)
    lines = [timeline(sorties, stations, craft, d) for d in drones]
    at = [line.at(clock) for line in lines]
    near = np.inf
    for i in range(len(at)):
        for j in range(i):
            near = min(near, float(np.linalg.norm(at[i] - at[j], axis=-1).min()))
    return near


@dataclass(frozen=True)
class CameraTarget:
    """Duration of the same measurements if they are made with a camera and a target.

    Attributes
    ----------
    hours
        Total hours of sun, h.
    days, months
        Calendar time.
    sunny
        Usable hours per day, h.
    """

    hours: float
    days: float
    months: float
    sunny: float


def camera_target(
    site: Site,
    photographs: int,
    *,
    minutes: float = 2.0,
    targets: int = 1,
    clear: float = 0.7,
    year: int = 2026,
    min_elevation: float = float(np.radians(10.0)),
) -> CameraTarget:
    """Return how long the same number of poses takes with a camera and a target.

    Parameters
    ----------
    site
        Location and atmosphere.
    photographs
        Number of heliostats times calibration points.
    minutes
        Time from one photograph to the next on a target, min.
    targets
        Number of targets, each with a camera.
    clear
        Fraction of the sunny hours that are clear enough.
    year, min_elevation
        Year, and lowest usable elevation of the sun, rad.

    Raises
    ------
    InputError
        If a number is not above 0, or the sun never reaches this elevation.
    """
    for name, value in (("minutes", minutes), ("targets", targets), ("clear share", clear)):
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be above 0, not {value:g}")
    begin = np.datetime64(f"{year}-01-01").astype("datetime64[s]").astype(np.float64)
    # One sample every 29 minutes of a year covers all hours of the day equally.
    moments = begin + np.arange(0.0, 365.0 * 86400.0, 29.0 * 60.0)
    up = position(moments, site).elevation >= min_elevation
    sunny = 24.0 * float(up.mean()) * min(clear, 1.0)
    if sunny <= 0.0:
        raise InputError(
            f"{site.label}: the sun never reaches an elevation of {np.degrees(min_elevation):g}°"
        )
    hours = photographs * minutes / 60.0 / targets
    return CameraTarget(hours, hours / sunny, hours / sunny / 30.44, sunny)


def mirror_travel(counts: FloatArray, speed: npt.ArrayLike) -> FloatArray:
    """Return how long the heliostats take to move to each pose, s, (K,); 0 for the first.

    Parameters
    ----------
    counts
        Counts of n heliostats in K poses, (K, n, D).
    speed
        Speed of the drives, counts/s, (n, D).
    """
    seconds = (np.abs(np.diff(counts, axis=0)) / np.asarray(speed, dtype=np.float64)).max(axis=-1)
    return np.concatenate([[0.0], seconds.max(axis=-1)])


def homes(home: FloatArray, count: int, apart: float = 20.0) -> FloatArray:
    """Return the take-off positions of the drones, in a row from west to east, (count, 3)."""
    shift = apart * (np.arange(count) - 0.5 * (count - 1))
    return np.asarray(home + shift[:, None] * np.array([1.0, 0.0, 0.0]))
