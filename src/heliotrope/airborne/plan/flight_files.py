"""Write the files of a flight plan: waypoints of each sortie, heliostat commands, and JSON."""

import csv
import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.airborne.plan import waypoints
from heliotrope.airborne.plan.airspace import Airspace, KeepOut
from heliotrope.airborne.plan.flight import Sortie
from heliotrope.airborne.plan.flight_plan import FlightPlan
from heliotrope.airborne.plan.waypoints import Circle, Fence, Mission
from heliotrope.errors import InputError
from heliotrope.files.json import JsonNode, read_json
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, as_float, azimuth_elevation, enu_to_geodetic
from heliotrope.sun import Site

#: Formats of waypoint files; each has a folder of the same name.
FORMATS = ("dji", "qgc", "litchi")
_SUFFIX = {"dji": ".kmz", "qgc": ".plan", "litchi": ".csv"}
Progress = Callable[[int, int], None]


def sortie_name(sortie: Sortie) -> str:
    """Return the name of a sortie's files, which consists of drone and number."""
    return f"drone{sortie.drone + 1}-{sortie.number + 1:03d}"


def mission(plan: FlightPlan, sortie: Sortie, name: str) -> Mission:
    """Return a sortie in the form of waypoint files.

    Notes
    -----
    The drone looks along the axis of its station from every point. It rests for
    ``craft.photo`` before each photograph, and waits for mirrors that are still moving.
    """
    place, yaw, pitch, stay, photo = (list[Any]() for _ in range(5))

    def add(points: FloatArray, heading: float, tilt: float, rests: FloatArray | None) -> None:
        place.extend(points)
        yaw.extend([heading] * len(points))
        pitch.extend([tilt] * len(points))
        stay.extend(np.zeros(len(points)) if rests is None else rests)
        photo.extend([rests is not None] * len(points))

    rest = plan.settings.craft.photo
    for visit in sortie.visits:
        station = plan.stations[visit.station]
        camera = station.pattern.camera[visit.first : visit.last]
        heading, tilt = np.degrees([station.yaw, station.pitch])
        add(visit.approach, heading, tilt, None)
        rests = np.full(len(camera), rest)
        rests[0] += visit.wait
        add(camera, heading, tilt, rests)
    add(sortie.back, yaw[-1], pitch[-1], None)
    points = np.array(place)
    lat, lon, _ = enu_to_geodetic(points, _origin(plan.plant.site))
    home = tuple(float(v) for v in enu_to_geodetic(sortie.home, _origin(plan.plant.site)))
    return Mission(
        name,
        lat,
        lon,
        points[:, 2] - sortie.home[2],
        np.array(yaw) % 360.0,
        np.array(pitch),
        np.array(stay),
        np.array(photo, dtype=np.bool_),
        plan.settings.craft.speed,
        (home[0], home[1], home[2]),
        _return_height(plan.settings.airspace, sortie),
    )


def _origin(site: Site) -> tuple[float, float, float]:
    return site.latitude_deg, site.longitude_deg, site.height


def _return_height(airspace: Airspace, sortie: Sortie) -> float:
    """Return a height above all keep-outs, or the maximum allowed, m above take-off."""
    tops = [k.top + airspace.margin for k in airspace.keep_outs if np.isfinite(k.top)]
    return float(min(airspace.max_height, max([airspace.min_height, *tops]) - sortie.home[2]))


def fence(plan: FlightPlan) -> Fence:
    """Return the airspace for QGroundControl, with its margins."""
    airspace, origin = plan.settings.airspace, _origin(plan.plant.site)

    def geodetic(corners: FloatArray) -> FloatArray:
        lat, lon, _ = enu_to_geodetic(np.column_stack([corners, np.zeros(len(corners))]), origin)
        return np.stack([lat, lon], axis=-1)

    circles, polygons = [], []
    for keep_out in airspace.keep_outs:
        corners = geodetic(keep_out.corners)
        if len(corners) == 1:
            radius = keep_out.radius + airspace.margin
            circles.append(Circle(float(corners[0, 0]), float(corners[0, 1]), radius))
        else:
            polygons.append(corners)
    whole = () if airspace.fence is None else (geodetic(airspace.fence),)
    return Fence(whole, tuple(polygons), tuple(circles))


def write_plan(
    plan: FlightPlan,
    folder: str | Path,
    *,
    formats: Sequence[str] = FORMATS,
    aircraft: str = "M3E",
    progress: Progress | None = None,
) -> list[Path]:
    """Write plan.json, commands.csv and the waypoint files of all sorties to a folder.

    Parameters
    ----------
    plan
        The plan.
    folder
        Folder, created if it does not exist.
    formats
        Names from `FORMATS`.
    aircraft
        Aircraft for DJI's files; see `AIRCRAFT`.
    progress
        Called with the numbers of sorties (done, total).

    Raises
    ------
    InputError
        If a format or the aircraft is unknown, or the folder cannot be written to.
    """
    into = Path(folder)
    written = write_missions(
        into,
        [mission(plan, sortie, sortie_name(sortie)) for sortie in plan.sorties],
        formats=formats,
        aircraft=aircraft,
        around=fence(plan),
        progress=progress,
    )
    write_text(into / "commands.csv", commands(plan))
    write_text(into / "plan.json", json.dumps(document(plan), separators=(",", ":")) + "\n")
    return [into / "plan.json", into / "commands.csv", *written]


def write_missions(
    into: Path,
    missions: Sequence[Mission],
    *,
    formats: Sequence[str] = FORMATS,
    aircraft: str = "M3E",
    around: Fence | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Write the waypoint files of missions into a folder for each format; see `write_plan`."""
    for name in formats:
        if name not in FORMATS:
            raise InputError(f"format {name!r}: choose from {', '.join(FORMATS)}")
    try:
        for name in ("", *formats):
            (into / name).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{into}: cannot be created ({error.strerror}); choose another folder"
        ) from None
    written = []
    for done, flown in enumerate(missions):
        if progress is not None:
            progress(done, len(missions))
        for name in formats:
            path = into / name / (flown.name + _SUFFIX[name])
            if name == "dji":
                body = waypoints.wpml(flown, aircraft)
                write_file(path, lambda stream, data=body: stream.write(data))  # type: ignore[misc]
            else:
                write_text(
                    path, waypoints.qgc(flown, around) if name == "qgc" else waypoints.litchi(flown)
                )
            written.append(path)
    return written


def commands(plan: FlightPlan) -> str:
    """Return a table of drive positions with one row for each heliostat and calibration point."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        [
            "cluster",
            "point",
            "heliostat",
            "look_east_m",
            "look_north_m",
            "look_up_m",
            "count_1",
            "count_2",
            "reachable",
        ]
    )
    for k, look in enumerate(plan.points):
        names = [plan.mirrors.names[i] for i in plan.clusters.rows(k)]
        for point in range(len(look)):
            where = [f"{v:.4f}" for v in look.point[point]]
            able = look.facing.able[point].tolist()
            for i, (first, second) in enumerate(look.facing.counts[point].tolist()):
                writer.writerow(
                    [
                        plan.labels[k],
                        point + 1,
                        names[i],
                        *where,
                        f"{first:.3f}",
                        f"{second:.3f}",
                        str(able[i]).lower(),
                    ]
                )
    return text.getvalue()


def document(plan: FlightPlan) -> dict[str, Any]:
    """Return the plan as stored in plan.json, with units in the names."""
    settings, air = plan.settings, plan.settings.airspace
    timing = {v.station: [np.inf, 0.0] for s in plan.sorties for v in s.visits}
    for sortie in plan.sorties:
        for visit in sortie.visits:
            both = timing[visit.station]
            both[0], both[1] = min(both[0], visit.begin), max(both[1], visit.end)
    return {
        "format": "heliotrope flight plan 1",
        "plant": plan.plant.name,
        "origin": {
            "latitude_deg": plan.plant.site.latitude_deg,
            "longitude_deg": plan.plant.site.longitude_deg,
            "height_m": plan.plant.site.height,
        },
        "summary": _finite(plan.summary()),
        "sampling": {
            "distance_m": settings.sampling.distance,
            "pointing_mrad": 1e3 * settings.sampling.pointing,
            "samples": settings.sampling.samples,
            "facet_focal_m": _finite(settings.sampling.focal),
            "led_offset_m": list(settings.sampling.led_offset),
        },
        "airspace": {
            "min_height_m": air.min_height,
            "max_height_m": air.max_height,
            "margin_m": air.margin,
            "fence": None if air.fence is None else air.fence.tolist(),
            "keep_out": [
                {
                    "name": k.name,
                    "polygon": k.corners.tolist(),
                    "radius_m": k.radius,
                    "bottom_m": _finite(k.bottom),
                    "top_m": _finite(k.top),
                }
                for k in air.keep_outs
            ],
        },
        "clusters": [
            {
                "name": plan.labels[k],
                "center_m": np.round(plan.clusters.center[k], 3).tolist(),
                "heliostats": [plan.mirrors.names[i] for i in plan.clusters.rows(k)],
            }
            for k in range(len(plan.clusters))
        ],
        "stations": [_station(plan, row, timing[row]) for row in range(len(plan.stations))],
        "sorties": [_sortie(plan, sortie) for sortie in plan.sorties],
    }


def _station(plan: FlightPlan, row: int, timing: list[float]) -> dict[str, Any]:
    station = plan.stations[row]
    look = plan.points[station.cluster]
    azimuth, elevation = np.degrees(azimuth_elevation(station.pattern.direction))
    return {
        "cluster": plan.labels[station.cluster],
        "point": station.point + 1,
        "look_at_m": np.round(look.point[station.point], 4).tolist(),
        "drone_azimuth_deg": round(float(azimuth), 4),
        "drone_elevation_deg": round(float(elevation), 4),
        "yaw_deg": round(float(np.degrees(station.yaw)), 4),
        "pitch_deg": round(float(np.degrees(station.pitch)), 4),
        "columns": station.pattern.columns,
        "rows": station.pattern.rows,
        "spacing_m": station.pattern.spacing,
        "mirrors_travel_s": round(station.travel, 1),
        "mirrors_at_rest_by_s": round(timing[0], 1),
        "mirrors_move_from_s": round(timing[1], 1),
        "counts": np.round(look.facing.counts[station.point], 3).tolist(),
        "unreachable": np.flatnonzero(~look.facing.able[station.point]).tolist(),
    }


def _sortie(plan: FlightPlan, sortie: Sortie) -> dict[str, Any]:
    return {
        "name": sortie_name(sortie),
        "drone": sortie.drone + 1,
        "start_s": round(sortie.start, 1),
        "end_s": round(sortie.end, 1),
        "home_m": np.round(sortie.home, 3).tolist(),
        "visits": [
            {
                "station": v.station,
                "first": v.first,
                "approach_m": np.round(v.approach, 3).tolist(),
                "photographs_m": np.round(
                    plan.stations[v.station].pattern.camera[v.first : v.last], 3
                ).tolist(),
                "begin_s": round(v.begin, 1),
                "end_s": round(v.end, 1),
                "wait_s": round(v.wait, 1),
            }
            for v in sortie.visits
        ],
        "back_m": np.round(sortie.back, 3).tolist(),
    }


def _finite(value: Any) -> Any:
    """Return a value that JSON can hold: None instead of infinity."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def read_airspace(path: str | Path, base: Airspace) -> tuple[Airspace, FloatArray | None]:
    """Return an airspace from a JSON file, and the home point if the file contains one.

    Parameters
    ----------
    path
        JSON file with an object that may have ``min_height_m``, ``max_height_m``, ``margin_m``,
        ``home`` ([east, north, up]), ``fence`` ([[east, north], …]) and ``keep_out``: a list of
        objects with ``name`` and either ``polygon`` ([[east, north], …]) or ``centre`` ([east,
        north]) and ``radius_m``, and optionally ``bottom_m`` and ``top_m``.
    base
        Airspace whose keep-out volumes are kept, and whose limits apply if the file does not set
        them.

    Raises
    ------
    FormatError, InputError
        If the file cannot be used.
    """
    root = read_json(path, "an airspace in JSON")
    known = {"min_height_m", "max_height_m", "margin_m", "home", "fence", "keep_out"}
    for key, node in root.items():
        if key not in known:
            raise node.fail(f"unknown key; known keys are {', '.join(sorted(known))}")
    volumes = list(base.keep_outs)
    if root.has("keep_out"):
        volumes += [_keep_out(node) for node in root["keep_out"].elements()]

    def number(key: str, default: float) -> float:
        return root[key].number(0.0, 10_000.0) if root.has(key) else default

    return Airspace(
        tuple(volumes),
        _polygon(root["fence"]) if root.has("fence") else base.fence,
        number("min_height_m", base.min_height),
        number("max_height_m", base.max_height),
        number("margin_m", base.margin),
        base.ground,
    ), as_float(root["home"].vector()) if root.has("home") else None


def _keep_out(node: JsonNode) -> KeepOut:
    bottom = node["bottom_m"].number() if node.has("bottom_m") else -np.inf
    top = node["top_m"].number() if node.has("top_m") else np.inf
    name = node["name"].text()
    if node.has("polygon"):
        return KeepOut(name, _polygon(node["polygon"]), 0.0, bottom, top)
    centre = _polygon_corner(node["centre"])
    return KeepOut(name, as_float([centre]), node["radius_m"].number(1e-3), bottom, top)


def _polygon(node: JsonNode) -> FloatArray:
    return as_float([_polygon_corner(corner) for corner in node.elements()]).reshape(-1, 2)


def _polygon_corner(node: JsonNode) -> tuple[float, float]:
    parts = node.elements()
    if len(parts) != 2:
        raise node.fail(f"expected [east, north], found {len(parts)} numbers")
    return parts[0].number(), parts[1].number()
