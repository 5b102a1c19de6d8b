"""PAINT: the published data of the Jülich solar tower (DLR, KIT), as JSON files.

This module reads heliostat properties, tower measurements and calibration properties, in all
published variants. Positions are WGS84 and are converted exactly.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from heliotrope.errors import FormatError, InputError
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.marks import Mark
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.files import JsonNode, read_json, write_text
from heliotrope.geometry import FloatArray, enu_to_geodetic, geodetic_to_enu
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS, Drive, linear_paint
from heliotrope.sun import Site

TOWER_FILE = "tower-measurements.json"
Origin = tuple[float, float, float]

# θ₀ of the first joint is relative to the horizontal, that in the file to the vertical.
_AXIS_1_ZERO = -0.5 * np.pi
#: Numbers of a drive that PAINT's format cannot represent.
_LOST = ("scale", "worm_cos", "worm_sin", "sag")

#: Length and width of the strokes of Jülich's marks, measured in photographs, m.
MARK_SIZE, MARK_STROKE = 0.735, 0.15
# Marks at the measured points: kind and rotation.
_MARKS = {
    "upper_left": ("corner", 0.0),
    "upper_middle": ("tee", 0.0),
    "upper_right": ("corner", -0.5 * np.pi),
    "lower_right": ("corner", np.pi),
    "lower_middle": ("tee", np.pi),
    "lower_left": ("corner", 0.5 * np.pi),
}


@dataclass(frozen=True)
class Properties:
    """Properties of one heliostat as in the file.

    Attributes
    ----------
    name
        Taken from the file's name.
    geodetic
        Latitude and longitude in degrees, height in m.
    width, height
        m.
    drives
        The two actuators.
    translations
        First joint, second joint, concentrator, m, (3, 3).
    tilts
        Joint tilts in the file, by parameter name, rad.
    facets
        Centres and half edges of the facets in the mirror's frame, each (F, 3); empty if the file
        contains none.
    renovation
        Date of the last renovation; empty if unknown.
    """

    name: str
    geodetic: Origin
    width: float
    height: float
    drives: tuple[Drive, Drive]
    translations: FloatArray
    tilts: dict[str, float]
    facets: tuple[FloatArray, FloatArray, FloatArray]
    renovation: str = ""


def read_heliostat(path: str | Path, name: str | None = None) -> Properties:
    """Return the properties of one heliostat.

    Parameters
    ----------
    path
        JSON file.
    name
        Default: the part of the file's name before "-heliostat-properties" or the dot.

    Raises
    ------
    FormatError
        If a value is missing or invalid; the text names file, key and value.
    """
    root = read_json(path, "PAINT heliostat properties")
    chain = root.any_of("kinematics_properties", "kinematic_properties", "kinematic")
    actuators = chain["actuators"].elements()
    if len(actuators) != 2:
        raise chain["actuators"].fail(f"{len(actuators)} actuators; a heliostat has 2")
    translations = np.array(
        [
            [_number_or(chain, f"{part}_{axis}{end}", 0.0) for axis in "enu"]
            for part, end in (
                ("joint_translation", "_1"),
                ("joint_translation", "_2"),
                ("concentrator_translation", ""),
            )
        ]
    )
    # ARTIST's rotation about north is left-handed, ours right-handed.
    tilts = {
        "tilt_up": _number_or(chain, "joint_tilt_n_1", 0.0),
        "tilt_north": _number_or(chain, "joint_tilt_u_1", 0.0),
        "non_orthogonality": -_number_or(chain, "joint_tilt_n_2", 0.0),
        "elevation_bias": _number_or(chain, "joint_tilt_e_2", 0.0),
    }
    stem = Path(path).name.removesuffix(".json").removesuffix("-heliostat-properties")
    return Properties(
        name=stem if name is None else name,
        geodetic=root["heliostat_position"].geodetic(),
        width=root["width"].number(1e-3, 100.0),
        height=root["height"].number(1e-3, 100.0),
        drives=(_drive(actuators[0], _AXIS_1_ZERO), _drive(actuators[1], 0.0)),
        translations=translations,
        tilts={key: value for key, value in tilts.items() if value != 0.0},
        facets=_facets(root),
        renovation=root["renovation"].text() if root.has("renovation") else "",
    )


def _number_or(node: JsonNode, key: str, default: float) -> float:
    return node[key].number() if node.has(key) and node[key].value is not None else default


def _drive(node: JsonNode, zero: float) -> Drive:
    kind = node.any_of("type_axis", "type").text()
    # "ideal" tells ARTIST how to simulate the jack, whose constants are beside it.
    if kind not in ("linear", "ideal"):
        raise node.fail(f"actuator of type {kind!r}; known are 'linear' and 'ideal'")
    low, high = node["min_increment"].number(), node["max_increment"].number()
    speed = _number_or(node, "movement_speed", 0.0)
    try:
        return linear_paint(
            node["increment"].number(),
            node["initial_stroke_length"].number(),
            node["offset"].number() + _number_or(node, "offset_shift", 0.0),
            node["pivot_radius"].number() + _number_or(node, "radius_shift", 0.0),
            node["initial_angle"].number() + zero,
            clockwise=node["clockwise_axis_movement"].number(0, 1),
            min_count=low,
            max_count=high,
            speed=speed if speed > 0 else np.inf,
        )
    except FormatError:
        raise
    except InputError as error:
        raise node.fail(str(error)) from None


def _facets(root: JsonNode) -> tuple[FloatArray, FloatArray, FloatArray]:
    empty = np.empty((0, 3))
    if not root.has("facet_properties"):
        return empty, empty, empty
    listed = root["facet_properties"]["facets"].elements()
    return (
        np.array([f["translation_vector"].vector() for f in listed]).reshape(-1, 3),
        np.array([f.any_of("canting_e", "canting_vector_e").vector() for f in listed]).reshape(
            -1, 3
        ),
        np.array([f.any_of("canting_n", "canting_vector_n").vector() for f in listed]).reshape(
            -1, 3
        ),
    )


@dataclass(frozen=True)
class Tower:
    """The contents of the tower file: reference point, targets and receivers.

    Attributes
    ----------
    origin
        Latitude and longitude in degrees and height in m of the plant's reference.
    targets, receivers
        Targets and receivers in ENU about the origin.
    """

    origin: Origin
    targets: tuple[Target, ...]
    receivers: tuple[Receiver, ...]


def read_tower(path: str | Path) -> Tower:
    """Return the tower's reference point, targets and receivers.

    The planes are computed from the corners, because the normals in the file are rounded to compass
    directions, whereas the real planes are yawed by some milliradians.

    Raises
    ------
    FormatError
        If a value is missing or invalid.
    """
    root = read_json(path, "PAINT tower measurements")
    origin = root["power_plant_properties"]["coordinates"].geodetic()
    targets, receivers = [], []
    for name, node in root.items():
        if name == "power_plant_properties":
            continue
        kind = node["type"].text()
        points = {
            key: geodetic_to_enu(*value.geodetic(), origin)
            for key, value in node["coordinates"].items()
        }
        try:
            if kind == "planar":
                targets.append(_target(name, node, points))
            else:
                receivers.append(_receiver(name, kind, node, points))
        except FormatError:
            raise
        except InputError as error:
            raise node.fail(str(error)) from None
    return Tower(origin, with_marks(targets), tuple(receivers))


def _corners(node: JsonNode, points: dict[str, FloatArray], prefix: str = "") -> FloatArray:
    """Return the corners of a surface, starting at the upper left, as seen from the front."""
    order = ("upper_left", "upper_right", "lower_right", "lower_left")
    for corner in order:
        if prefix + corner not in points:
            raise node["coordinates"].fail(f"corner {prefix + corner!r} is missing")
    return np.stack([points[prefix + corner] for corner in order])


def _target(name: str, node: JsonNode, points: dict[str, FloatArray]) -> Target:
    if "center" not in points:
        raise node["coordinates"].fail("'center' is missing")
    corners = _corners(node, points)
    markers = {k: v for k, v in points.items() if k != "center"}
    return Target(name, corners, points["center"], markers)


def with_marks(targets: Sequence[Target]) -> tuple[Target, ...]:
    """Return targets with the marks at their measured points at Jülich.

    L-shaped marks are at free corners, T-shaped marks at edge midpoints and where two targets meet;
    the points are on the outer edges of the marks. The files do not contain the marks; these were
    measured in published photographs, their sizes to within a centimetre.
    """
    marked = []
    for target in targets:
        corners = [c for t in targets if t is not target for c in t.corners]
        marks = []
        for name, point in target.markers.items():
            if name not in _MARKS:
                continue
            kind, turn = _MARKS[name]
            if kind == "corner" and any(np.linalg.norm(point - c) < 0.05 for c in corners):
                side = -1.0 if name.endswith("right") else 1.0
                kind, turn = "tee", side * 0.5 * np.pi
            marks.append(Mark(name, kind, point, MARK_SIZE, MARK_STROKE, turn))
        marked.append(replace(target, marks=tuple(marks)))
    return tuple(marked)


def _receiver(name: str, kind: str, node: JsonNode, points: dict[str, FloatArray]) -> Receiver:
    corners = _corners(node, points, "receiver_outer_")
    return Receiver(
        name=name,
        kind=kind,
        center=points["center"] if "center" in points else corners.mean(axis=0),
        normal=np.array(node["normal_vector"].vector()),
        width=float(np.linalg.norm(corners[1] - corners[0])),
        height=float(np.linalg.norm(corners[0] - corners[3])),
        corners=corners,
        radius=_number_or(node, "radius", 0.0),
        opening_angle=float(np.radians(_number_or(node, "opening_angle", 0.0))),
    )


def find_properties(folder: str | Path) -> list[Path]:
    """Return the property files of a folder.

    The files are named ``properties/ID.json``, or as in PAINT (``ID/Properties/…``) or ARTIST
    (``ID/heliostat-properties.json``).
    """
    root = Path(folder)
    flat = sorted((root / "properties").glob("*.json"))
    nested = sorted(root.glob("*/Properties/*heliostat-properties*.json"))
    artist = sorted(root.glob("*/*heliostat-properties.json"))
    return flat or nested or artist or sorted(root.glob("*-heliostat-properties.json"))


def heliostat_of(file: Path) -> str:
    """Return the heliostat of a PAINT or ARTIST file, known from its folder; empty if unknown."""
    if file.parent.name in ("Properties", "Calibration"):
        return file.parent.parent.name
    own = (file.parent / "heliostat-properties.json").exists()
    return file.parent.name if own else ""


def find_tower(folder: str | Path) -> Path:
    """Return the tower file in a folder, under either of its two names.

    Raises
    ------
    FormatError
        If there is no tower file.
    """
    names = [Path(folder) / TOWER_FILE, *sorted(Path(folder).glob("**/*tower-measurements*.json"))]
    for name in names:
        if name.exists():
            return name
    raise FormatError(folder, f"{TOWER_FILE} is missing in this folder; fetch it too")


def read_plant(folder: str | Path) -> Plant:
    """Return the plant from a folder with the tower file and heliostat properties.

    Raises
    ------
    FormatError
        If the folder or a file cannot be used.
    """
    place = Path(folder)
    if not place.is_dir():
        raise FormatError(
            place, "this is not a folder; use a folder with heliostat properties and the tower file"
        )
    tower = read_tower(find_tower(place))
    files = find_properties(place)
    if not files:
        raise FormatError(
            place,
            "no heliostat properties (properties/ID.json or ID/heliostat-properties.json)",
        )
    listed = [read_heliostat(file, heliostat_of(file) or None) for file in files]
    heliostats = to_heliostats(listed, tower.origin)
    latitude, longitude, height = tower.origin
    return Plant(
        name="Jülich",
        site=Site(latitude, longitude, height),
        groups={"jacks": heliostats},
        targets=tower.targets,
        receivers=tower.receivers,
    )


def to_heliostats(properties: Iterable[Properties], origin: Origin) -> Heliostats:
    """Return heliostats as arrays, from their properties, with positions relative to ``origin``."""
    listed = list(properties)
    latitude, longitude, height = np.array([p.geodetic for p in listed]).T
    position = geodetic_to_enu(latitude, longitude, height, origin)
    drives = (
        Drive(np.stack([p.drives[0].table for p in listed])),
        Drive(np.stack([p.drives[1].table for p in listed])),
    )
    translations = np.stack([p.translations for p in listed])
    mechanism = kinds.two_jacks(
        position,
        drives,
        joint_translation_1=translations[:, 0],
        joint_translation_2=translations[:, 1],
        concentrator_translation=translations[:, 2],
    )
    tilted = sorted({name for p in listed for name in p.tilts})
    mechanism = mechanism.with_parameters(
        {name: np.array([p.tilts.get(name, 0.0) for p in listed]) for name in tilted}
    )
    numbers = {len(p.facets[0]) for p in listed}
    facets = None
    if len(numbers) == 1 and numbers != {0}:
        center, across, up = (np.stack([p.facets[k] for p in listed]) for k in range(3))
        facets = Facets(center, across, up)
    return Heliostats(
        names=tuple(p.name for p in listed),
        mechanism=mechanism,
        width=np.array([p.width for p in listed]),
        height=np.array([p.height for p in listed]),
        facets=facets,
    )


@dataclass(frozen=True)
class CalibrationProperties:
    """One calibration measurement as PAINT publishes it.

    Attributes
    ----------
    motors
        Counts of both axes.
    target
        Name of the target.
    sun_azimuth_deg, sun_elevation_deg
        Azimuth (0 is south, positive towards east) and elevation, including refraction; NaN if the
        file contains none.
    focal_spots
        Geodetic centroids, by the name of the extractor ("UTIS", "HeliOS").
    """

    motors: tuple[float, float]
    target: str
    sun_azimuth_deg: float
    sun_elevation_deg: float
    focal_spots: dict[str, Origin]


def read_calibration_properties(path: str | Path) -> CalibrationProperties:
    """Return one calibration measurement; both published styles of keys are supported."""
    root = read_json(path, "PAINT calibration properties")
    motors = root["motor_position"]
    spots = {name: node.geodetic() for name, node in root["focal_spot"].items() if node.value}
    return CalibrationProperties(
        motors=(
            motors.any_of("axis_1_motor_position", "Axis1MotorPosition").number(),
            motors.any_of("axis_2_motor_position", "Axis2MotorPosition").number(),
        ),
        target=root["target_name"].text(),
        sun_azimuth_deg=_number_or(root, "sun_azimuth", float("nan")),
        sun_elevation_deg=_number_or(root, "sun_elevation", float("nan")),
        focal_spots=spots,
    )


def write_heliostat(
    heliostats: Heliostats, name: str, origin: Origin, path: str | Path
) -> tuple[str, ...]:
    """Write the properties of one heliostat, including its calibrated parameters.

    The zero offset of the second jack is included in its initial angle. ARTIST reads this format,
    but sets joint tilts to 0; `artist.write_scenario` passes all of them to ARTIST.

    Returns
    -------
    The parameters that the format cannot represent, each with its value and unit; a plant file does
    contain these parameters.

    Raises
    ------
    InputError
        If the heliostat's mechanism is not of kind ``two_jacks``.
    """
    mechanism = written(heliostats, name)
    i = heliostats.index(name)
    latitude, longitude, height = (float(v) for v in enu_to_geodetic(mechanism.position, origin))
    document: dict[str, object] = {
        "heliostat_position": [latitude, longitude, height],
        "height": float(heliostats.height[i]),
        "width": float(heliostats.width[i]),
        "initial_orientation": [0.0, -1.0, 0.0],
        "kinematics_properties": kinematics_properties(mechanism),
    }
    if heliostats.facets is not None:
        f = heliostats.facets
        document["facet_properties"] = {
            "number_of_facets": int(f.center.shape[1]),
            "facets": [
                {"translation_vector": c.tolist(), "canting_e": e.tolist(), "canting_n": n.tolist()}
                for c, e, n in zip(f.center[i], f.half_width[i], f.half_height[i], strict=True)
            ],
        }
    write_text(path, json.dumps(document, indent=1) + "\n")
    return without_place(mechanism)


def written(heliostats: Heliostats, name: str) -> Mechanism:
    """Return the calibrated mechanism of a heliostat, of kind ``two_jacks``, without batch axis.

    Raises
    ------
    InputError
        If the mechanism is of a different kind.
    """
    if heliostats.mechanism.kind != "two_jacks":
        raise InputError(
            f"heliostat {name}: its kind is {heliostats.mechanism.kind}, but PAINT supports only "
            "two_jacks; use write_plant, which supports every kind"
        )
    return heliostats.calibrated[heliostats.index(name)]


def kinematics_properties(mechanism: Mechanism) -> dict[str, object]:
    """Return a mechanism in PAINT's format: translations, tilts, and two actuators."""
    joints = dict(zip(mechanism.joints, mechanism.angles, strict=True))
    chain: dict[str, object] = {
        "actuators": [_actuator(mechanism.drives.table[k], k) for k in (0, 1)]
    }
    for part, joint in (
        ("joint_translation_{}_1", 2),
        ("joint_translation_{}_2", 3),
        ("concentrator_translation_{}", 5),
    ):
        row = mechanism.origins[joint] + (mechanism.origins[0] if joint == 2 else 0.0)
        chain |= {part.format(axis): float(row[k]) for k, axis in enumerate("enu")}
    return chain | {
        "joint_tilt_n_1": float(joints["tilt_up"]),
        "joint_tilt_u_1": float(joints["tilt_north"]),
        "joint_tilt_n_2": float(-joints["non_orthogonality"]),
        "joint_tilt_e_2": float(mechanism.drives.table[0, 7]),
    }


def without_place(mechanism: Mechanism) -> tuple[str, ...]:
    """Return the parameters of a mechanism that PAINT cannot represent, with their values."""
    joints = dict(zip(mechanism.joints, mechanism.angles, strict=True))
    lost = {name: float(joints[name]) for name in ("canting", "canting_secondary")}
    for k, d in enumerate(mechanism.driven):
        drive = dict(
            zip(_LOST, mechanism.drives.table[k, [SLOTS[name] for name in _LOST]], strict=True)
        )
        lost |= {
            name if name == "sag" else f"{mechanism.joints[d]}_{name}": float(value)
            for name, value in drive.items()
        }
    return tuple(
        f"{name} {value:.4g} {mechanism.parameter(name).unit}"
        for name, value in lost.items()
        if value
    )


def _actuator(row: FloatArray, axis: int) -> dict[str, object]:
    def of(name: str) -> float:
        return float(row[SLOTS[name]])

    # SENSE precedes STROKE in the row; SLOTS contains only parameters that may be calibrated.
    sense = float(row[SLOTS["stroke_offset"] - 1])
    speed = of("speed")
    return {
        "type_axis": "linear",
        "min_increment": of("min_count"),
        "max_increment": of("max_count"),
        "increment": 1.0 / of("rate"),
        "offset_shift": 0.0,
        "initial_stroke_length": of("stroke_offset"),
        "offset": of("offset"),
        "pivot_radius": of("pivot_radius"),
        "radius_shift": 0.0,
        "clockwise_axis_movement": 1 if sense > 0 else 0,
        # The bias of the first axis has its own key, joint_tilt_e_2.
        "initial_angle": of("initial_angle") + (of("bias") if axis else -_AXIS_1_ZERO),
        "movement_speed": speed if np.isfinite(speed) else 0.0,
    }
