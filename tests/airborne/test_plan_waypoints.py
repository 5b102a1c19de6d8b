"""Waypoint files: what is written can be read back, and is as the formats are published."""

import csv
import io
import json
import re
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import etree

from heliotrope.airborne.plan.airspace import Airspace, KeepOut, tower
from heliotrope.airborne.plan.calibration_points import PointSelection
from heliotrope.airborne.plan.flight import Craft, Sortie
from heliotrope.airborne.plan.flight_files import commands, document, fence, mission, write_plan
from heliotrope.airborne.plan.flight_plan import FlightPlan, PlanSettings, plan_flight
from heliotrope.airborne.plan.waypoints import (
    Mission,
    litchi,
    qgc,
    wpml,
)
from heliotrope.errors import FormatError, InputError, UnknownNameError
from heliotrope.geometry import FloatArray, angle_between, as_float, geodetic_to_enu
from support.flight_case import staggered
from support.waypoint_files import read_litchi, read_qgc, read_wpml

SPACES = {"k": "http://www.opengis.net/kml/2.2", "w": "http://www.dji.com/wpmz/1.0.2"}
FENCE = as_float([[-400.0, -400.0], [400.0, -400.0], [400.0, 400.0], [-400.0, 400.0]])


@pytest.fixture(scope="module")
def plan() -> FlightPlan:
    plant = staggered(120)
    mast = KeepOut("mast", as_float([[150.0, 150.0], [160.0, 150.0], [160.0, 160.0]]), top=40.0)
    air = Airspace((*tower(plant), mast), FENCE)
    return plan_flight(
        plant,
        PlanSettings(
            selection=PointSelection(points=9), airspace=air, craft=Craft(endurance=1000.0)
        ),
    )


@pytest.fixture(scope="module")
def flown(plan: FlightPlan) -> Mission:
    return mission(plan, plan.sorties[0], "one")


Read = Callable[[Path], Mission]


@pytest.mark.parametrize(
    ("suffix", "write", "read", "yaw"),
    [
        (".csv", lambda m: litchi(m).encode(), read_litchi, 0.006),
        (".kmz", wpml, read_wpml, 0.51),
        (".plan", lambda m: qgc(m).encode(), read_qgc, 0.006),
    ],
)
def test_read_back(
    flown: Mission,
    tmp_path: Path,
    suffix: str,
    write: Callable[[Mission], bytes],
    read: Read,
    yaw: float,
) -> None:
    path = tmp_path / f"one{suffix}"
    path.write_bytes(write(flown))
    found = read(path)
    assert found.name == "one"
    assert (found.photo == flown.photo).all()
    assert found.speed == flown.speed
    # A hundred-millionth of a degree is a millimetre.
    np.testing.assert_allclose(found.latitude_deg, flown.latitude_deg, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.longitude_deg, flown.longitude_deg, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.height, flown.height, rtol=0, atol=1e-3)
    np.testing.assert_allclose(found.stay[flown.photo], flown.stay[flown.photo], atol=0.06)
    gap = (found.yaw_deg - flown.yaw_deg + 180.0) % 360.0 - 180.0
    assert np.abs(gap).max() <= yaw
    shown = flown.photo if suffix != ".csv" else np.ones(len(flown), dtype=np.bool_)
    np.testing.assert_allclose(found.pitch_deg[shown], flown.pitch_deg[shown], atol=0.006)


def test_places_and_view_are_those_of_the_plan(plan: FlightPlan, flown: Mission) -> None:
    """From degrees back to metres, and from yaw and pitch to where the camera looks."""
    sortie: Sortie = plan.sorties[0]
    site = plan.plant.site
    origin = (site.latitude_deg, site.longitude_deg, site.height)
    up = flown.home[2] + flown.height
    place = geodetic_to_enu(flown.latitude_deg, flown.longitude_deg, up, origin)
    camera = np.concatenate(
        [plan.stations[v.station].pattern.camera[v.first : v.last] for v in sortie.visits]
    )
    # The drone's height is above the home point, not along the plumb line at each place.
    np.testing.assert_allclose(place[flown.photo], camera, rtol=0, atol=0.03)
    yaw, pitch = np.radians(flown.yaw_deg), np.radians(flown.pitch_deg)
    view = np.stack([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)], -1)
    axes = np.concatenate(
        [
            np.tile(-plan.stations[v.station].pattern.direction, (v.last - v.first, 1))
            for v in sortie.visits
        ]
    )
    assert angle_between(view[flown.photo], axes).max() < 1e-9
    # And there is the cluster: the line of sight meets it.
    k = plan.stations[sortie.visits[0].station].cluster
    to_cluster = plan.clusters.center[k] - camera[0]
    to_cluster /= np.linalg.norm(to_cluster)
    assert np.degrees(angle_between(to_cluster, axes[0])) < 3.0


def test_litchi_as_published(flown: Mission) -> None:
    rows = list(csv.reader(io.StringIO(litchi(flown))))
    header = rows[0]
    assert len(header) == 46
    assert header[:8] == [
        "latitude",
        "longitude",
        "altitude(m)",
        "heading(deg)",
        "curvesize(m)",
        "rotationdir",
        "gimbalmode",
        "gimbalpitchangle",
    ]
    assert header[8:12] == ["actiontype1", "actionparam1", "actiontype2", "actionparam2"]
    assert header[36:40] == ["actiontype15", "actionparam15", "altitudemode", "speed(m/s)"]
    assert header[-2:] == ["photo_timeinterval", "photo_distinterval"]
    for k, row in enumerate(rows[1:]):
        assert len(row) == 46
        assert 0.0 <= float(row[3]) < 360.0
        assert row[6] == "2"
        kinds = [int(v) for v in row[8:38:2]]
        assert kinds[:2] == ([0, 1] if flown.photo[k] else [-1, -1])
        assert all(0 <= int(v) <= 32_767 for v in row[9:38:2])


def test_long_waits_are_cut_for_litchi(flown: Mission) -> None:
    stay = flown.stay.copy()
    first = int(np.argmax(flown.photo))
    stay[first] = 70.0
    row = list(csv.reader(io.StringIO(litchi(replace(flown, stay=stay)))))[1 + first]
    assert [int(v) for v in row[8:18]] == [0, 32000, 0, 32000, 0, 6000, 1, 0, -1, 0]


def _trees(body: bytes) -> tuple[Any, Any]:
    with zipfile.ZipFile(io.BytesIO(body)) as archive:
        assert archive.namelist() == ["wpmz/template.kml", "wpmz/waylines.wpml"]
        return tuple(etree.fromstring(archive.read(n)) for n in archive.namelist())  # type: ignore[return-value]


#: What DJI's documentation calls required in each place, for the drones offered.
CONFIG = ["flyToWaylineMode", "finishAction", "exitOnRCLost", "executeRCLostAction",
          "takeOffSecurityHeight", "globalTransitionalSpeed", "droneInfo",
          "payloadInfo"]  # fmt: skip
TEMPLATE = ["templateType", "templateId", "waylineCoordinateSysParam", "autoFlightSpeed",
            "globalWaypointTurnMode", "gimbalPitchMode", "globalHeight",
            "globalWaypointHeadingParam", "payloadParam"]  # fmt: skip
TEMPLATE_MARK = ["index", "useGlobalHeight", "ellipsoidHeight", "height", "useGlobalSpeed",
                 "useGlobalHeadingParam", "waypointHeadingParam", "useGlobalTurnParam",
                 "gimbalPitchAngle"]  # fmt: skip
WAYLINE = ["templateId", "waylineId", "autoFlightSpeed", "executeHeightMode"]
WAYLINE_MARK = [
    "index",
    "executeHeight",
    "waypointSpeed",
    "waypointHeadingParam",
    "waypointTurnParam",
]
HEADING = ["waypointHeadingMode", "waypointHeadingAngle", "waypointHeadingPathMode"]
ACTIONS = {
    "gimbalRotate": [
        "payloadPositionIndex",
        "gimbalHeadingYawBase",
        "gimbalRotateMode",
        "gimbalPitchRotateEnable",
        "gimbalPitchRotateAngle",
        "gimbalRollRotateEnable",
        "gimbalRollRotateAngle",
        "gimbalYawRotateEnable",
        "gimbalYawRotateAngle",
        "gimbalRotateTimeEnable",
        "gimbalRotateTime",
    ],
    "hover": ["hoverTime"],
    "takePhoto": ["payloadPositionIndex", "fileSuffix", "useGlobalPayloadLensIndex"],
}


def _has(node: Any, names: list[str]) -> None:
    there = [child.tag.split("}")[1] for child in node]
    for name in names:
        assert there.count(name) == 1, name


def test_wpml_as_published(flown: Mission) -> None:
    template, waylines = _trees(wpml(flown, "M30T"))
    for root in (template, waylines):
        config = root.find("k:Document/w:missionConfig", SPACES)
        _has(config, CONFIG)
        assert config.findtext("w:droneInfo/w:droneEnumValue", None, SPACES) == "67"
        assert config.findtext("w:droneInfo/w:droneSubEnumValue", None, SPACES) == "1"
        assert config.findtext("w:payloadInfo/w:payloadEnumValue", None, SPACES) == "53"
        for node in root.iterfind(".//w:waypointHeadingParam", SPACES):
            _has(node, HEADING)
            assert -180 <= int(node.findtext("w:waypointHeadingAngle", None, SPACES)) <= 180
    _has(waylines.find("k:Document/w:missionConfig", SPACES), ["globalRTHHeight"])
    folders = [root.find("k:Document/k:Folder", SPACES) for root in (template, waylines)]
    _has(folders[0], TEMPLATE)
    _has(folders[1], WAYLINE)
    for folder, names in zip(folders, (TEMPLATE_MARK, WAYLINE_MARK), strict=True):
        marks = folder.findall("k:Placemark", SPACES)
        assert len(marks) == len(flown)
        groups = []
        for k, mark in enumerate(marks):
            _has(mark, names)
            assert mark.findtext("w:index", None, SPACES) == str(k)
            # Longitude comes first in KML.
            lon, lat = mark.findtext("k:Point/k:coordinates", None, SPACES).split(",")
            assert float(lat) == pytest.approx(flown.latitude_deg[k], abs=1e-9)
            assert float(lon) == pytest.approx(flown.longitude_deg[k], abs=1e-9)
            group = mark.find("w:actionGroup", SPACES)
            assert (group is not None) == flown.photo[k]
            if group is None:
                continue
            groups.append(int(group.findtext("w:actionGroupId", None, SPACES)))
            assert group.findtext("w:actionGroupStartIndex", None, SPACES) == str(k)
            assert group.findtext("w:actionGroupEndIndex", None, SPACES) == str(k)
            steps = group.findall("w:action", SPACES)
            kinds = [s.findtext("w:actionActuatorFunc", None, SPACES) for s in steps]
            assert kinds == ["gimbalRotate", "hover", "takePhoto"]
            for step, kind in zip(steps, kinds, strict=True):
                _has(step.find("w:actionActuatorFuncParam", SPACES), ACTIONS[kind])
        assert len(set(groups)) == len(groups)


def test_qgc_as_published(plan: FlightPlan, flown: Mission) -> None:
    root = json.loads(qgc(flown, fence(plan)))
    assert set(root) == {
        "fileType",
        "geoFence",
        "groundStation",
        "mission",
        "rallyPoints",
        "version",
    }
    assert set(root["mission"]) == {
        "cruiseSpeed",
        "firmwareType",
        "globalPlanAltitudeMode",
        "hoverSpeed",
        "items",
        "plannedHomePosition",
        "vehicleType",
        "version",
    }
    assert (root["version"], root["mission"]["version"], root["geoFence"]["version"]) == (1, 2, 2)
    items = root["mission"]["items"]
    assert [i["doJumpId"] for i in items] == list(range(1, len(items) + 1))
    assert all(i["type"] == "SimpleItem" and len(i["params"]) == 7 for i in items)
    numbers = [i["command"] for i in items]
    # Take-off, speed, … and home.
    assert (numbers[0], numbers[1], numbers[-1]) == (22, 178, 20)
    assert numbers.count(2000) == flown.photo.sum()
    assert numbers.count(16) == len(flown)
    for item in items:
        assert ("Altitude" in item) == (item["command"] in (16, 22))
        assert item["frame"] == (3 if item["command"] in (16, 22) else 2)
    circles, polygons = root["geoFence"]["circles"], root["geoFence"]["polygons"]
    assert [c["inclusion"] for c in circles] == [False]
    assert [p["inclusion"] for p in polygons] == [True, False]
    for polygon in polygons:
        corners = np.array(polygon["polygon"])
        lat, lon = corners.T
        # Clockwise, seen from above.
        assert np.sum(lon * np.roll(lat, -1) - np.roll(lon, -1) * lat) < 0.0


def test_folder(plan: FlightPlan, tmp_path: Path) -> None:
    written = write_plan(plan, tmp_path / "plan", formats=("dji", "litchi"))
    assert all(path.is_file() for path in written)
    assert not (tmp_path / "plan" / "qgc").exists()
    assert len(list((tmp_path / "plan" / "dji").iterdir())) == len(plan.sorties)
    total = sum(int(read_wpml(p).photo.sum()) for p in (tmp_path / "plan" / "dji").iterdir())
    assert total == plan.photos
    held = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert held["summary"]["photographs"] == plan.photos
    assert sum(len(c["heliostats"]) for c in held["clusters"]) == 120
    assert len(held["stations"]) == len(plan.stations)
    flown = [len(v["photographs_m"]) for s in held["sorties"] for v in s["visits"]]
    assert sum(flown) == plan.photos
    # The same plan gives the same files.
    again = write_plan(plan, tmp_path / "again", formats=("dji", "litchi"))
    for one, two in zip(written, again, strict=True):
        assert one.read_bytes() == two.read_bytes()


def test_commands_turn_the_mirrors_to_the_drone(plan: FlightPlan) -> None:
    rows = list(csv.DictReader(io.StringIO(commands(plan))))
    assert len(rows) == 120 * 9
    group = plan.plant.groups["azel"]
    index = np.array([group.index(row["heliostat"]) for row in rows])
    counts = np.array([[float(row["count_1"]), float(row["count_2"])] for row in rows])
    look = np.array([[float(row[f"look_{d}_m"]) for d in ("east", "north", "up")] for row in rows])
    pose = group.calibrated[index].pose(counts)
    away = look - pose.vertex
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    # A thousandth of a count, and a tenth of a millimetre at 150 m.
    assert angle_between(pose.normal, away).max() < 2e-6
    assert {row["reachable"] for row in rows} == {"true"}


def test_document_says_when_mirrors_move(plan: FlightPlan) -> None:
    held = document(plan)
    last: dict[str, float] = {}
    for station in held["stations"]:
        if station["cluster"] in last:
            left = last[station["cluster"]]
            assert station["mirrors_at_rest_by_s"] >= left + station["mirrors_travel_s"] - 0.2
        last[station["cluster"]] = station["mirrors_move_from_s"]


@pytest.mark.parametrize(
    ("name", "read", "text"),
    [
        ("a.csv", read_litchi, "the header is not Litchi's"),
        ("a.kmz", read_wpml, "not a readable archive; expected a KMZ with wpmz/template.kml"),
        ("a.plan", read_qgc, "not valid JSON"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, name: str, read: Read, text: str) -> None:
    (tmp_path / name).write_text("something else\n")
    with pytest.raises(FormatError, match=text):
        read(tmp_path / name)
    with pytest.raises(FormatError, match="no such file"):
        read(tmp_path / f"b{name}")


def test_broken_files(flown: Mission, tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lines = litchi(flown).splitlines()
    path.write_text("\n".join([lines[0], lines[1] + ",3"]))
    with pytest.raises(FormatError, match="line 2: 47 cells instead of 46"):
        read_litchi(path)
    path.write_text("\n".join([lines[0], re.sub(r"^[^,]*", "north", lines[1])]))
    with pytest.raises(FormatError, match="a cell is not a number"):
        read_litchi(path)
    kmz = tmp_path / "a.kmz"
    with zipfile.ZipFile(kmz, "w") as archive:
        archive.writestr("wpmz/template.kml", "<kml>")
        archive.writestr("wpmz/waylines.wpml", "<kml>")
    with pytest.raises(FormatError, match="not XML"):
        read_wpml(kmz)
    plan = tmp_path / "a.plan"
    root = json.loads(qgc(flown))
    root["mission"]["items"][3]["type"] = "ComplexItem"
    plan.write_text(json.dumps(root))
    with pytest.raises(FormatError, match=r"mission.items\[3\]: a complex item"):
        read_qgc(plan)


def _moved(flown: Mission, height: FloatArray) -> Mission:
    return replace(flown, height=height)


def test_refusals(plan: FlightPlan, flown: Mission, tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="there is no aircraft 'M3'"):
        wpml(flown, "M3")
    with pytest.raises(InputError, match=r"drones accept at most 500 m"):
        _moved(flown, flown.height + 450.0)
    near = replace(
        flown,
        latitude_deg=flown.latitude_deg[:1].repeat(len(flown)),
        longitude_deg=flown.longitude_deg[:1].repeat(len(flown)),
    )
    with pytest.raises(InputError, match=r"Litchi requires 0.6 m"):
        litchi(near)
    with pytest.raises(InputError, match="format 'kml': choose from dji, qgc, litchi"):
        write_plan(plan, tmp_path, formats=("kml",))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be created"):
        write_plan(plan, tmp_path / "file" / "inside")
