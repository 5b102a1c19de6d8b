"""Waypoint files: Litchi CSV, DJI WPML in KMZ, QGroundControl plan.

The formats are those published: Litchi Hub's CSV in metres; DJI's Waypoint Markup Language 1.0.2
(Cloud API documentation: template.kml and waylines.wpml in a folder ``wpmz``); QGroundControl's
plan file (developer guide, mission items of MAVLink's common set). In all three, heights are
relative to the take-off place.
"""

import csv
import io
import json
import zipfile
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray

#: WPML codes of the drone, its variant and the payload, and the image types to store.
AIRCRAFT = {
    "M3E": (77, 0, 66, "visible"), "M3T": (77, 1, 67, "visible"), "M3M": (77, 2, 68, "visible"),
    "M30": (67, 0, 52, "wide"), "M30T": (67, 1, 53, "wide"),
    "M300-H20": (60, 0, 42, "wide"), "M300-H20T": (60, 0, 43, "wide"),
    "M350-H20": (89, 0, 42, "wide"), "M350-H20T": (89, 0, 43, "wide"),
}  # fmt: skip
#: Limits of Litchi: minimum distance between waypoints, m; longest stay, ms; number of actions at a
#: waypoint.
_LITCHI_APART, _LITCHI_STAY, _LITCHI_ACTIONS = 0.6, 32_000, 15
_WPMZ = "http://www.dji.com/wpmz/1.0.2"
_KML = "http://www.opengis.net/kml/2.2"
_LITCHI_HEADER = [
    "latitude", "longitude", "altitude(m)", "heading(deg)", "curvesize(m)", "rotationdir",
    "gimbalmode", "gimbalpitchangle",
    *(f"action{what}{k}" for k in range(1, _LITCHI_ACTIONS + 1) for what in ("type", "param")),
    "altitudemode", "speed(m/s)", "poi_latitude", "poi_longitude", "poi_altitude(m)",
    "poi_altitudemode", "photo_timeinterval", "photo_distinterval",
]  # fmt: skip


@dataclass(frozen=True)
class Mission:
    """One flight in the form of waypoint files; W waypoints.

    Attributes
    ----------
    name
        Name of the flight.
    latitude_deg, longitude_deg
        WGS84, (W,).
    height
        Height above the take-off place, m, (W,).
    yaw_deg
        Heading, clockwise from north in [0, 360), (W,).
    pitch_deg
        Pitch of the gimbal, where −90 is straight down, (W,).
    stay
        Hover time before a photograph, s, (W,); 0 if there is no photograph.
    photo
        Whether a photograph is taken, (W,).
    speed
        Speed, m/s.
    home
        Latitude and longitude in degrees and height above the ellipsoid in m.
    return_height
        Height to which the drone climbs before it returns home automatically, m above take-off.
    """

    name: str
    latitude_deg: FloatArray
    longitude_deg: FloatArray
    height: FloatArray
    yaw_deg: FloatArray
    pitch_deg: FloatArray
    stay: FloatArray
    photo: npt.NDArray[np.bool_]
    speed: float
    home: tuple[float, float, float]
    return_height: float

    def __post_init__(self) -> None:
        if not len(self.latitude_deg):
            raise InputError(f"flight {self.name}: no waypoints; add at least one")
        if (np.abs(self.height) > 500.0).any():
            worst = float(self.height[int(np.argmax(np.abs(self.height)))])
            raise InputError(
                f"flight {self.name}: a waypoint is {worst:.1f} m above take-off; drones accept at "
                "most 500 m"
            )

    def __len__(self) -> int:
        return len(self.latitude_deg)


@dataclass(frozen=True)
class Circle:
    """A circle to stay out of, for QGroundControl: degrees and metres."""

    latitude_deg: float
    longitude_deg: float
    radius: float


@dataclass(frozen=True)
class Fence:
    """The airspace for QGroundControl.

    Attributes
    ----------
    inside
        Polygons to stay in, latitude and longitude in degrees, (V, 2) each.
    outside
        Polygons to stay out of.
    circles
        Circles to stay out of.
    """

    inside: tuple[FloatArray, ...] = ()
    outside: tuple[FloatArray, ...] = ()
    circles: tuple[Circle, ...] = ()


# --- Litchi ---------------------------------------------------------------------------


def litchi(mission: Mission) -> str:
    """Return the CSV of Litchi Hub, in metres, with one row for each waypoint.

    Raises
    ------
    InputError
        If waypoints are closer together than Litchi allows.
    """
    _check_litchi(mission)
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_LITCHI_HEADER)
    for k in range(len(mission)):
        actions: list[tuple[int, int]] = []
        remaining = round(1e3 * float(mission.stay[k]))
        while remaining > 0 and len(actions) < _LITCHI_ACTIONS - 1:
            actions.append((0, min(remaining, _LITCHI_STAY)))
            remaining -= _LITCHI_STAY
        if mission.photo[k]:
            actions.append((1, 0))
        actions += [(-1, 0)] * (_LITCHI_ACTIONS - len(actions))
        writer.writerow(
            [
                f"{mission.latitude_deg[k]:.9f}",
                f"{mission.longitude_deg[k]:.9f}",
                f"{mission.height[k]:.3f}",
                f"{mission.yaw_deg[k]:.2f}",
                0,
                0,
                2,
                f"{mission.pitch_deg[k]:.2f}",
                *(v for pair in actions for v in pair),
                0,
                f"{mission.speed:g}",
                0,
                0,
                0,
                0,
                -1,
                -1,
            ]
        )
    return text.getvalue()


def _check_litchi(mission: Mission) -> None:
    lat, lon = np.radians(mission.latitude_deg), np.radians(mission.longitude_deg)
    # A sphere is accurate enough for the distance between neighbours.
    step = 6.37e6 * np.hypot(np.diff(lat), np.cos(lat[:-1]) * np.diff(lon))
    gap = np.hypot(step, np.diff(mission.height))
    if len(gap) and gap.min() < 0.99 * _LITCHI_APART:
        k = int(np.argmin(gap))
        raise InputError(
            f"flight {mission.name}: waypoints {k + 1} and {k + 2} are {gap[k]:.2f} m apart; "
            f"Litchi requires {_LITCHI_APART} m: raise the least spacing, or leave out this format"
        )


# --- DJI ------------------------------------------------------------------------------


def wpml(mission: Mission, aircraft: str = "M3E") -> bytes:
    """Return a KMZ of DJI's Waypoint Markup Language with template and executable wayline.

    Parameters
    ----------
    mission
        At most 65,536 waypoints.
    aircraft
        A key of `AIRCRAFT`.

    Raises
    ------
    UnknownNameError
        If the aircraft is unknown.
    """
    if aircraft not in AIRCRAFT:
        raise UnknownNameError("aircraft", aircraft, AIRCRAFT)
    if len(mission) > 65_536:
        raise InputError(
            f"flight {mission.name}: {len(mission)} waypoints; WPML allows at most 65,536"
        )
    template = _document(mission, aircraft, template=True)
    waylines = _document(mission, aircraft, template=False)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=3) as archive:
        for name, text in (("template.kml", template), ("waylines.wpml", waylines)):
            # The time is fixed, so that equal plans produce equal files.
            entry = zipfile.ZipInfo(f"wpmz/{name}", (2020, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, text)
    return stream.getvalue()


def _document(mission: Mission, aircraft: str, *, template: bool) -> str:
    drone, variant, payload, images = AIRCRAFT[aircraft]
    lat, lon, up = mission.home
    take_off = max(2.0, min(1500.0, float(mission.height[0])))
    marks = "".join(_placemark(mission, k, template) for k in range(len(mission)))
    own = (
        f"<wpml:takeOffRefPoint>{lat:.9f},{lon:.9f},{up:.3f}</wpml:takeOffRefPoint>"
        "<wpml:takeOffRefPointAGLHeight>0</wpml:takeOffRefPointAGLHeight>"
        if template
        else ""
    )
    home = (
        ""
        if template
        else f"<wpml:globalRTHHeight>{mission.return_height:.1f}</wpml:globalRTHHeight>"
    )
    if template:
        folder = (
            "<wpml:templateType>waypoint</wpml:templateType><wpml:templateId>0</wpml:templateId>"
            "<wpml:waylineCoordinateSysParam><wpml:coordinateMode>WGS84</wpml:coordinateMode>"
            "<wpml:heightMode>relativeToStartPoint</wpml:heightMode>"
            "</wpml:waylineCoordinateSysParam>"
            f"<wpml:autoFlightSpeed>{mission.speed:g}</wpml:autoFlightSpeed>"
            f"<wpml:globalHeight>{mission.height[0]:.3f}</wpml:globalHeight>"
            "<wpml:gimbalPitchMode>usePointSetting</wpml:gimbalPitchMode>"
            f"<wpml:globalWaypointHeadingParam>{_heading(0.0)}</wpml:globalWaypointHeadingParam>"
            "<wpml:globalWaypointTurnMode>toPointAndStopWithDiscontinuityCurvature"
            "</wpml:globalWaypointTurnMode>"
            "<wpml:payloadParam><wpml:payloadPositionIndex>0</wpml:payloadPositionIndex>"
            f"<wpml:imageFormat>{images}</wpml:imageFormat></wpml:payloadParam>"
        )
    else:
        folder = (
            "<wpml:templateId>0</wpml:templateId>"
            "<wpml:executeHeightMode>relativeToStartPoint</wpml:executeHeightMode>"
            "<wpml:waylineId>0</wpml:waylineId>"
            f"<wpml:autoFlightSpeed>{mission.speed:g}</wpml:autoFlightSpeed>"
        )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="{_KML}" xmlns:wpml="{_WPMZ}">'
        "<Document><wpml:missionConfig><wpml:flyToWaylineMode>safely</wpml:flyToWaylineMode>"
        "<wpml:finishAction>goHome</wpml:finishAction>"
        "<wpml:exitOnRCLost>executeLostAction</wpml:exitOnRCLost>"
        "<wpml:executeRCLostAction>goBack</wpml:executeRCLostAction>"
        f"<wpml:takeOffSecurityHeight>{take_off:.1f}</wpml:takeOffSecurityHeight>{own}"
        f"<wpml:globalTransitionalSpeed>{mission.speed:g}</wpml:globalTransitionalSpeed>{home}"
        f"<wpml:droneInfo><wpml:droneEnumValue>{drone}</wpml:droneEnumValue>"
        f"<wpml:droneSubEnumValue>{variant}</wpml:droneSubEnumValue></wpml:droneInfo>"
        f"<wpml:payloadInfo><wpml:payloadEnumValue>{payload}</wpml:payloadEnumValue>"
        "<wpml:payloadSubEnumValue>0</wpml:payloadSubEnumValue>"
        "<wpml:payloadPositionIndex>0</wpml:payloadPositionIndex></wpml:payloadInfo>"
        f"</wpml:missionConfig><Folder>{folder}{marks}</Folder></Document></kml>\n"
    )


def _heading(yaw_deg: float) -> str:
    # WPML accepts whole degrees from −180 to 180.
    angle = round((yaw_deg + 180.0) % 360.0 - 180.0)
    return (
        "<wpml:waypointHeadingMode>smoothTransition</wpml:waypointHeadingMode>"
        f"<wpml:waypointHeadingAngle>{angle}</wpml:waypointHeadingAngle>"
        "<wpml:waypointHeadingPathMode>followBadArc</wpml:waypointHeadingPathMode>"
    )


def _placemark(mission: Mission, k: int, template: bool) -> str:
    height = f"{mission.height[k]:.3f}"
    if template:
        above = mission.home[2] + mission.height[k]
        level = (
            f"<wpml:ellipsoidHeight>{above:.3f}</wpml:ellipsoidHeight>"
            f"<wpml:height>{height}</wpml:height><wpml:useGlobalHeight>0</wpml:useGlobalHeight>"
            "<wpml:useGlobalSpeed>1</wpml:useGlobalSpeed>"
            "<wpml:useGlobalHeadingParam>0</wpml:useGlobalHeadingParam>"
            "<wpml:useGlobalTurnParam>1</wpml:useGlobalTurnParam>"
            f"<wpml:gimbalPitchAngle>{mission.pitch_deg[k]:.2f}</wpml:gimbalPitchAngle>"
        )
        turn = ""
    else:
        level = (
            f"<wpml:executeHeight>{height}</wpml:executeHeight>"
            f"<wpml:waypointSpeed>{mission.speed:g}</wpml:waypointSpeed>"
        )
        turn = (
            "<wpml:waypointTurnParam><wpml:waypointTurnMode>"
            "toPointAndStopWithDiscontinuityCurvature</wpml:waypointTurnMode>"
            "<wpml:waypointTurnDampingDist>0</wpml:waypointTurnDampingDist>"
            "</wpml:waypointTurnParam>"
        )
    return (
        "<Placemark><Point><coordinates>"
        f"{mission.longitude_deg[k]:.9f},{mission.latitude_deg[k]:.9f}</coordinates></Point>"
        f"<wpml:index>{k}</wpml:index>{level}<wpml:waypointHeadingParam>"
        f"{_heading(float(mission.yaw_deg[k]))}</wpml:waypointHeadingParam>{turn}"
        f"{_actions(mission, k)}</Placemark>"
    )


def _actions(mission: Mission, k: int) -> str:
    """Return gimbal, hover and photograph actions; none at a waypoint that is only passed."""
    if not mission.photo[k]:
        return ""
    position = "<wpml:payloadPositionIndex>0</wpml:payloadPositionIndex>"
    pitch = (
        "<wpml:gimbalHeadingYawBase>north</wpml:gimbalHeadingYawBase>"
        "<wpml:gimbalRotateMode>absoluteAngle</wpml:gimbalRotateMode>"
        "<wpml:gimbalPitchRotateEnable>1</wpml:gimbalPitchRotateEnable>"
        f"<wpml:gimbalPitchRotateAngle>{mission.pitch_deg[k]:.2f}</wpml:gimbalPitchRotateAngle>"
        "<wpml:gimbalRollRotateEnable>0</wpml:gimbalRollRotateEnable>"
        "<wpml:gimbalRollRotateAngle>0</wpml:gimbalRollRotateAngle>"
        "<wpml:gimbalYawRotateEnable>0</wpml:gimbalYawRotateEnable>"
        "<wpml:gimbalYawRotateAngle>0</wpml:gimbalYawRotateAngle>"
        "<wpml:gimbalRotateTimeEnable>0</wpml:gimbalRotateTimeEnable>"
        f"<wpml:gimbalRotateTime>0</wpml:gimbalRotateTime>{position}"
    )
    photo = (
        f"{position}<wpml:fileSuffix>{k}</wpml:fileSuffix>"
        "<wpml:useGlobalPayloadLensIndex>1</wpml:useGlobalPayloadLensIndex>"
    )
    steps = [("gimbalRotate", pitch)]
    if mission.stay[k] > 0.0:
        steps.append(("hover", f"<wpml:hoverTime>{mission.stay[k]:.1f}</wpml:hoverTime>"))
    steps.append(("takePhoto", photo))
    actions = "".join(
        f"<wpml:action><wpml:actionId>{i}</wpml:actionId>"
        f"<wpml:actionActuatorFunc>{what}</wpml:actionActuatorFunc>"
        f"<wpml:actionActuatorFuncParam>{how}</wpml:actionActuatorFuncParam></wpml:action>"
        for i, (what, how) in enumerate(steps)
    )
    # The waypoint's number, which is unique in the file, identifies the group.
    return (
        f"<wpml:actionGroup><wpml:actionGroupId>{k}</wpml:actionGroupId>"
        f"<wpml:actionGroupStartIndex>{k}</wpml:actionGroupStartIndex>"
        f"<wpml:actionGroupEndIndex>{k}</wpml:actionGroupEndIndex>"
        "<wpml:actionGroupMode>sequence</wpml:actionGroupMode><wpml:actionTrigger>"
        "<wpml:actionTriggerType>reachPoint</wpml:actionTriggerType></wpml:actionTrigger>"
        f"{actions}</wpml:actionGroup>"
    )


# --- QGroundControl -------------------------------------------------------------------

_TAKE_OFF, _WAYPOINT, _RETURN = 22, 16, 20
_SPEED, _GIMBAL, _PHOTO = 178, 205, 2000
#: MAVLink frames: for heights relative to home, and for commands without a position.
_RELATIVE, _NO_PLACE = 3, 2


def qgc(mission: Mission, fence: Fence | None = None) -> str:
    """Return a plan file of QGroundControl.

    Parameters
    ----------
    mission
        The flight.
    fence
        Airspace uploaded to the autopilot with the plan.
    """
    items: list[dict[str, Any]] = []

    def add(command: int, params: list[float | None], height: float | None = None) -> None:
        item: dict[str, Any] = {
            "autoContinue": True,
            "command": command,
            "doJumpId": len(items) + 1,
            "frame": _NO_PLACE if height is None else _RELATIVE,
            "params": params,
            "type": "SimpleItem",
        }
        if height is not None:
            item |= {"AMSLAltAboveTerrain": None, "Altitude": height, "AltitudeMode": 1}
        items.append(item)

    lat, lon, up = mission.home
    first = round(float(mission.height[0]), 3)
    add(_TAKE_OFF, [0, 0, 0, None, round(lat, 9), round(lon, 9), first], first)
    add(_SPEED, [1, mission.speed, -1, 0, 0, 0, 0])
    tilt: float | None = None
    for k in range(len(mission)):
        height, pitch = round(float(mission.height[k]), 3), round(float(mission.pitch_deg[k]), 2)
        if mission.photo[k] and pitch != tilt:
            add(_GIMBAL, [pitch, 0, 0, 0, 0, 0, 2])
            tilt = pitch
        add(
            _WAYPOINT,
            [
                round(float(mission.stay[k]), 1),
                0,
                0,
                round(float(mission.yaw_deg[k]), 2),
                round(float(mission.latitude_deg[k]), 9),
                round(float(mission.longitude_deg[k]), 9),
                height,
            ],
            height,
        )
        if mission.photo[k]:
            add(_PHOTO, [0, 0, 1, 0, None, None, None])
    add(_RETURN, [0, 0, 0, 0, 0, 0, 0])
    return json.dumps(
        {
            "fileType": "Plan",
            "geoFence": _fence(fence or Fence()),
            "groundStation": "QGroundControl",
            "mission": {
                "cruiseSpeed": mission.speed,
                "firmwareType": 12,
                "globalPlanAltitudeMode": 1,
                "hoverSpeed": mission.speed,
                "items": items,
                "plannedHomePosition": [round(lat, 9), round(lon, 9), round(up, 3)],
                "vehicleType": 2,
                "version": 2,
            },
            "rallyPoints": {"points": [], "version": 2},
            "version": 1,
        }
    )


def _fence(fence: Fence) -> dict[str, Any]:
    polygons = []
    for including, shapes in ((True, fence.inside), (False, fence.outside)):
        for shape in shapes:
            # The format requires corners in clockwise order, with east to the right.
            anticlockwise = bool(shapely.is_ccw(shapely.linearrings(shape[:, ::-1])))
            corners = np.round(shape[::-1] if anticlockwise else shape, 9).tolist()
            polygons.append({"inclusion": including, "polygon": corners, "version": 1})
    circles = [
        {
            "circle": {"center": [c.latitude_deg, c.longitude_deg], "radius": c.radius},
            "inclusion": False,
            "version": 1,
        }
        for c in fence.circles
    ]
    return {"circles": circles, "polygons": polygons, "version": 2}
