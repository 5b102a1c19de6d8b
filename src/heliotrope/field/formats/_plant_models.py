"""Tables of the plant file as pydantic models, used only at the file boundary."""

from collections.abc import Callable
from dataclasses import fields
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, WithJsonSchema, create_model

from heliotrope.field.aim_settings import AimSettings
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.coded_visits import CodedSettings, JointSettings, ReceiverSettings
from heliotrope.safety import CONDITIONS
from heliotrope.safety.limits import schema

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]

#: Kinds of mechanisms, each with the geometry keys of its group.
KINDS: dict[str, tuple[str, ...]] = {
    "azimuth_elevation": ("pivot_height_m", "pivot_offset_m"),
    "tilt_roll": ("axis", "pivot_height_m", "spacing_m", "pivot_offset_m"),
    "target_aligned": ("aim_m", "pivot_height_m", "pivot_offset_m"),
    "pitch_roll": ("facing_deg", "pivot_height_m", "spacing_m", "pivot_offset_m"),
    "polar": ("latitude_deg", "pivot_height_m", "pivot_offset_m"),
    "two_axis": ("axis_1", "axis_2", "normal", "origin_1_m", "origin_2_m", "arm_m", "vertex_m"),
    "single_axis": ("axis", "normal", "pivot_height_m", "vertex_m"),
    "two_jacks": (
        "joint_translation_1_m", "joint_translation_2_m", "concentrator_translation_m",
    ),
}  # fmt: skip

#: Angles of a drive; each may be specified in ``_deg``, ``_mrad`` or ``_rad``.
DRIVE_ANGLES = (
    "zero",
    "initial_angle",
    "bias",
    "worm_cos",
    "worm_sin",
    "sag",
    "sag_phase",
    "min_angle",
    "max_angle",
)
ANGLE_UNITS = {"deg": 0.017453292519943295, "mrad": 1e-3, "rad": 1.0}


class StrictTable(BaseModel):
    """A table that refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", strict=False)


Made = TypeVar("Made", bound=StrictTable)


class PlantNameTable(StrictTable):
    """``[plant]``: the name of the plant."""

    name: str = Field(min_length=1)


class PlantSiteTable(StrictTable):
    """``[site]``: the origin of ENU, and the atmosphere there."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180, allow_inf_nan=False)]
    height_m: Annotated[float, Field(ge=-500, le=9000, allow_inf_nan=False)] = 0.0
    pressure_pa: Annotated[float, Field(ge=30e3, le=120e3, allow_inf_nan=False)] | None = None
    temperature_c: Annotated[float, Field(ge=-80, le=60, allow_inf_nan=False)] = 12.0
    name: str = ""
    delta_t_s: Number | None = Field(None, description="TT - UT1; default from the date.")


class MarkTable(StrictTable):
    """A mark on a target: L, T, square, disc, tag or reference picture."""

    name: str = Field(min_length=1)
    kind: Literal["corner", "tee", "square", "disc", "tag", "picture"]
    at_m: Vector = Field(description="ENU of vertex, middle of the bar, or centre.")
    size_m: Positive
    stroke_m: Positive | None = Field(None, description="For corner or tee; default: size / 5.")
    turn_deg: Number = Field(0.0, description="Counterclockwise, as seen from the front.")
    code: str = Field("", description="Tag: 4X4_50:7 or APRILTAG_36h11:7; picture: its file.")


class TargetTable(StrictTable):
    """``[[targets]]``: a target, specified by a size or by four corners from the upper left."""

    name: str = Field(min_length=1)
    corners_m: Annotated[list[Vector], Field(min_length=4, max_length=4)] | None = None
    center_m: Vector | None = None
    width_m: Positive | None = None
    height_m: Positive | None = None
    facing_deg: Number | None = Field(None, description="Azimuth that the front faces.")
    markers_m: dict[str, Vector] = Field(default_factory=dict)
    marks: list[MarkTable] = Field(default_factory=list)


class ReceiverTable(StrictTable):
    """``[[receivers]]``: a receiver."""

    name: str = Field(min_length=1)
    kind: Literal["planar", "convex_cylinder", "external_cylinder", "cavity", "mesh"] = "planar"
    center_m: Vector = Field(description="Of a cavity: the middle of its aperture.")
    normal: Vector
    width_m: Positive | None = Field(
        None,
        description="Of the aperture, or the diameter; may be omitted only for a mesh, whose "
        "extent is then used.",
    )
    height_m: Positive | None = None
    corners_m: Annotated[list[Vector], Field(min_length=4, max_length=4)] | None = None
    radius_m: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    opening_angle_rad: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    inner_height_m: Positive | None = Field(
        None, description="Of a cavity's cylindrical wall; default: height_m."
    )
    mesh: str = Field(
        "",
        description="File beside this one (.obj, or binary .stl) with the surface of a mesh, or "
        "the inner surface of a cavity: coordinates in m relative to center_m: right and up as "
        "seen from the front, and outwards.",
    )
    nominal_power_mw: Positive | None = Field(
        None, description="Power on the receiver that its flux readings take as nominal."
    )


class TowerTable(StrictTable):
    """``[[towers]]``: an upright cylinder that shades and blocks, such as the receiver's tower."""

    east_m: Number
    north_m: Number
    radius_m: Positive
    bottom_m: Number = Field(-1e4, description="Height of its base; default: far below the ground.")
    top_m: Number


class CameraTable(StrictTable):
    """``[[cameras]]``: a pinhole camera with distortion, in OpenCV's convention."""

    name: str = Field(min_length=1)
    size_px: Annotated[list[Annotated[int, Field(ge=1)]], Field(min_length=2, max_length=2)]
    focal_px: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    center_px: Annotated[list[Number], Field(min_length=2, max_length=2)]
    skew_px: Number = 0.0
    distortion: Annotated[list[Number], Field(min_length=5, max_length=5)] = Field(
        default_factory=lambda: [0.0] * 5, description="k1, k2, p1, p2, k3."
    )
    position_m: Vector | None = None
    rotation: Annotated[list[Vector], Field(min_length=3, max_length=3)] | None = Field(
        None, description="Rows: the camera's right, down and forward in ENU."
    )
    targets: list[str] = Field(default_factory=list)
    source: str = ""
    deviation_px: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0


class BoxTable(StrictTable):
    """``[[keep_out]]`` of kind box: an upright box, such as a building."""

    name: str = Field(min_length=1)
    kind: Literal["box"]
    center_m: Vector
    size_m: Annotated[list[Positive], Field(min_length=3, max_length=3)] = Field(
        description="To the right of the camera, forward, and up."
    )
    azimuth_deg: Number = Field(0.0, description="Azimuth of the forward direction.")
    azimuth_rad: Number | None = Field(
        None, description="Alternative form, which the program writes."
    )


class SphereTable(StrictTable):
    """``[[keep_out]]`` of kind sphere."""

    name: str = Field(min_length=1)
    kind: Literal["sphere"]
    center_m: Vector
    radius_m: Positive


class CylinderTable(StrictTable):
    """``[[keep_out]]`` of kind cylinder, such as a mast or an approach corridor."""

    name: str = Field(min_length=1)
    kind: Literal["cylinder"]
    start_m: Vector = Field(description="Centre of one end.")
    end_m: Vector = Field(description="Centre of the other.")
    radius_m: Positive


class PrismTable(StrictTable):
    """``[[keep_out]]`` of kind prism: a polygon extruded upwards, such as a walkway."""

    name: str = Field(min_length=1)
    kind: Literal["prism"]
    corners_m: Annotated[
        list[Annotated[list[Number], Field(min_length=2, max_length=2)]], Field(min_length=3)
    ] = Field(description="East and north of each, in order.")
    bottom_m: Number
    top_m: Number


AnyVolume = Annotated[
    BoxTable | SphereTable | CylinderTable | PrismTable, Field(discriminator="kind")
]


class ChainTable(StrictTable):
    """``chain``: the individual numbers of a mechanism, as the program writes them."""

    joints: list[str]
    driven: list[int]
    orientation: list[list[Number]]
    axes: list[Vector]
    origins_m: list[Vector]
    angles_rad: list[Number]
    vertex_m: Vector
    normal: Vector


class RawDrive(StrictTable):
    """The individual numbers of a drive, as the program writes them."""

    kind: Literal["raw"]
    numbers: dict[str, float]


def _drive(name: str, kind: str, **own: Any) -> type[BaseModel]:
    angles: dict[str, Any] = {
        f"{angle}_{unit}": (Number | None, None) for angle in DRIVE_ANGLES for unit in ANGLE_UNITS
    }
    common: dict[str, Any] = {
        "scale": (Number, 0.0),
        "worm_ratio": (Number, 0.0),
        "min_count": (Number | None, None),
        "max_count": (Number | None, None),
        "speed_counts_per_s": (Positive | None, None),
    }
    fields: dict[str, Any] = {"kind": (Literal[kind], ...), **own, **angles, **common}
    return create_model(name, __base__=StrictTable, **fields)


RotaryDrive = _drive(
    "RotaryDrive",
    "rotary",
    steps_per_turn=(Positive, ...),
    gear_ratio=(Positive, ...),
    microsteps=(Positive, 1.0),
    sense=(Literal[1, -1], 1),
)
DirectDrive = _drive("DirectDrive", "direct")
# The constants of a jack often differ between heliostats, so they may be in the table instead.
LinearDrive = _drive(
    "LinearDrive",
    "linear",
    increment_per_m=(Positive | None, None),
    initial_stroke_length_m=(Positive | None, None),
    offset_m=(Positive | None, None),
    pivot_radius_m=(Positive | None, None),
    clockwise=(Literal[0, 1], 1),
)
AnyDrive = Annotated[
    RotaryDrive | DirectDrive | LinearDrive | RawDrive,  # type: ignore[valid-type]
    Field(discriminator="kind"),
]


Steps = Annotated[int, Field(ge=-(1 << 29), le=1 << 29)]
Pair = Annotated[list[Number], Field(min_length=2, max_length=2)]


class AxisTable(StrictTable):
    """``[groups.NAME.machine.axes.JOINT]``: the motor of one driven joint."""

    rate_steps_per_s: Annotated[int, Field(gt=0, le=1 << 29)] | None = Field(
        None, description="Default: the drive's speed_counts_per_s."
    )
    acceleration_steps_per_s2: Annotated[int, Field(gt=0, le=1 << 29)]
    backlash_steps: Annotated[int, Field(ge=0, le=65535)] = Field(
        description="Length of the final approach from below; 0: none."
    )
    min_steps: Steps | None = Field(None, description="Or min_deg; default: the drive's stop.")
    max_steps: Steps | None = Field(None, description="Or max_deg; default: the drive's stop.")
    min_deg: Number | None = None
    max_deg: Number | None = None


class SteppingTable(StrictTable):
    """``[groups.NAME.machine.stepping]``: the drivers of the stepper motors."""

    microsteps: Annotated[
        list[Annotated[int, Field(ge=1, le=256)]], Field(min_length=2, max_length=2)
    ] = Field(description="Of a full step, for both driven joints in order.")
    rests: bool = Field(
        False,
        description="Whether the drivers switch off between motions, which then end on full steps.",
    )


class MachineTable(StrictTable):
    """``[groups.NAME.machine]``: settings that local controllers store beside the calibration."""

    axes: dict[str, AxisTable] = Field(description="For each driven joint.")
    stow_steps: Annotated[list[Steps], Field(min_length=2, max_length=2)] | None = Field(
        None, description="For both driven joints in order; or stow_deg."
    )
    stow_deg: Pair | None = None
    defocus_deg: Pair | None = Field(
        None, description="Angles by which both joints turn away; or defocus_mrad, defocus_rad."
    )
    defocus_mrad: Pair | None = None
    defocus_rad: Pair | None = None
    defocus_spread: Annotated[float, Field(ge=0.0, le=4.0, allow_inf_nan=False)] = Field(
        1.0,
        description=(
            "Each heliostat turns further, by up to this multiple of the angles, so that the "
            "beams spread; 0: all by the same angles."
        ),
    )
    stow_lights: bool = Field(
        False,
        description="Whether beams may pass a receiver or a target at some hours of the year while "
        "the mirrors are at stow.",
    )
    tilt_sensor: bool = Field(
        False,
        description=(
            "Whether each mirror carries a tilt sensor: automatic control then diagnoses every "
            "heliostat at stow each day before raising it."
        ),
    )
    standby_m: Vector | None = Field(
        None, description="ENU; if omitted, the local controller keeps its current point."
    )
    leaves_stow_first: str | None = Field(
        None, description="Joint that moves first when leaving stow; default: the first driven."
    )
    way_m: Annotated[list[Vector], Field(max_length=4)] = Field(
        default_factory=list,
        description="Points that the beam passes from the ground to the standby point; default: "
        "the local controller finds its own.",
    )
    stepping: SteppingTable | None = Field(
        None, description="If omitted, the local controller keeps its current values."
    )


Length = Annotated[float, Field(gt=0)]
SlopeError = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]


class FacetTable(StrictTable):
    """``[[groups.NAME.mirror.facet]]``: one facet, in the plane of the mirror."""

    center_m: Pair = Field(description="Right of and above the mirror's middle, from its front.")
    size_m: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    tilt_mrad: Pair = Field(
        default_factory=lambda: [0.0, 0.0],
        description="Canting: by how much its normal leans to the right, and up.",
    )
    focal_m: Length | None = Field(None, description="Default: focal_m of the mirror.")
    slope_error_mrad: SlopeError | None = Field(
        None, description="Default: slope_error_mrad of the mirror."
    )


class MirrorTable(StrictTable):
    """``[groups.NAME.mirror]``: the surface of the mirrors.

    For a group without this table, see `heliotrope flux`.
    """

    facets: (
        Annotated[list[Annotated[int, Field(ge=1, le=50)]], Field(min_length=2, max_length=2)]
        | None
    ) = Field(None, description="Columns and rows of equal facets.")
    gap_m: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(
        0.0, description="Between neighbouring facets."
    )
    canting: Literal["none", "slant", "focal", "off_axis"] | None = Field(
        None,
        description="Of equal facets. slant (default): on-axis, for each mirror's distance to its "
        "aim point. focal: on-axis, for canting_focal_m. off_axis: for canting_time.",
    )
    canting_focal_m: Length | None = Field(None, description="Focal length of on-axis canting.")
    canting_time: str | None = Field(
        None, description="Time of off-axis canting, ISO 8601 with a time zone."
    )
    canting_sun: Vector | None = Field(
        None, description="Instead of the time: vector to the sun, ENU."
    )
    facet: list[FacetTable] = Field(
        default_factory=list, description="Individual facets, instead of equal ones."
    )
    focal_m: Length | None = Field(
        None,
        description="Focal length of each facet's own curvature, or of a mirror without facets; "
        "1e9 or more: flat. Default: the distance to the aim.",
    )
    slope_error_mrad: SlopeError | None = Field(
        None, description="Standard deviation of the surface normal per axis."
    )
    reflectivity: Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)] | None = Field(
        None, description="Of the clean mirror."
    )
    slope_maps: str = Field(
        "",
        description="Folder beside this file with a measured slope map of each heliostat: "
        "NAME.npz, NAME.csv, or NAME.h5 as PAINT publishes it.",
    )
    slope_error_rad: Number | None = Field(None, description="Instead, as the program writes it.")
    facet_focal_m: list[Length] | None = Field(
        None, description="Of each facet, as the program writes it."
    )
    facet_slope_error_rad: list[Number] | None = Field(
        None, description="Of each facet, as the program writes it."
    )


class GroupTable(StrictTable):
    """``[groups.NAME]``: heliostats of one kind."""

    kind: str
    mirror_width_m: Positive | None = None
    mirror_height_m: Positive | None = None
    pivot_height_m: Number | None = None
    pivot_offset_m: Number | None = None
    spacing_m: Number | None = None
    facing_deg: Number | None = None
    latitude_deg: Number | None = None
    aim_m: Vector | None = None
    axis: Vector | None = None
    axis_1: Vector | None = None
    axis_2: Vector | None = None
    normal: Vector | None = None
    origin_1_m: Vector | None = None
    origin_2_m: Vector | None = None
    arm_m: Vector | None = None
    vertex_m: Vector | None = None
    joint_translation_1_m: Vector | None = None
    joint_translation_2_m: Vector | None = None
    concentrator_translation_m: Vector | None = None
    chain: ChainTable | None = None
    drives: dict[str, AnyDrive] = Field(default_factory=dict)
    machine: MachineTable | None = Field(
        None, description="Motor limits and rest positions; needed to run and to configure."
    )
    mirror: MirrorTable | None = Field(
        None, description="Facets, curvature and errors of the mirrors."
    )
    facets: list[list[Vector]] | None = Field(
        None, description="Centre, half width and half height of each, in the mirror's frame, m."
    )


def _with_numbers(settings: type[CodedSettings]) -> Callable[[type[Made]], type[Made]]:
    """Add keys to a table for each number of some settings.

    There is one key in the number's unit, and one as the program writes it.
    """

    def made(table: type[Made]) -> type[Made]:
        keys: dict[str, Any] = {}
        for one in fields(settings):
            if (setting := one.metadata.get("setting")) is None:
                continue
            kind = int | None if one.type is int else Number | None
            text = f"{setting.text[0].upper()}{setting.text[1:]}"
            usual = f"{text}; default: {one.default / setting.scale:g}."
            keys[setting.key(one.name)] = kind, Field(None, description=usual)
            if setting.unit == "mrad":
                written = Field(None, description="Alternative form, which the program writes.")
                keys[f"{one.name}_rad"] = kind, written
        return create_model(table.__name__, __base__=table, __doc__=table.__doc__, **keys)

    return made


@_with_numbers(JointSettings)
class JointVisitsTable(StrictTable):
    """``[joint_visits]``: several heliostats on one target, distinguished by their movements."""

    allowed: bool = Field(True, description="False: each heliostat is calibrated on its own.")


@_with_numbers(ReceiverSettings)
class ReceiverVisitsTable(StrictTable):
    """``[receiver_visits]``: heliostats measured while their beams are on a receiver."""

    camera: str = Field(
        min_length=1, description="A camera of known position that sees the receiver."
    )
    receiver: str = Field(min_length=1, description="A planar receiver.")


class TimetableTable(StrictTable):
    """``[[timetable]]``: heliostats that are calibrated at times of day or at intervals."""

    name: str = Field(min_length=1)
    heliostats: list[str] = Field(min_length=1, description="In the order of calibration.")
    target: str = Field("", description="Default: any target that is free.")
    at: list[str] = Field(
        default_factory=list, description="Times of day with their zone: 08:30Z, 10:30+02:00."
    )
    every_s: Number | None = Field(None, description="Interval, from midnight UTC; 60 to 86400.")
    rule: Literal["", "first", "never"] = Field(
        "", description="Instead of times: calibrated before others, or only by operators."
    )


class ApprovalTable(StrictTable):
    """``[approval]``: manual changes that need the approval of a second engineer."""

    parameters: bool = Field(
        False,
        description=(
            "True: when a user changes or rolls back a heliostat's parameters, the change waits "
            "until another engineer approves it."
        ),
    )
    within_s: Number = Field(
        ApprovalSettings.within,
        description="Time after which an unapproved change expires; 60 to 604800.",
    )


class AimsTable(StrictTable):
    """``[aims]``: how the heliostats' aims on the receiver are chosen."""

    strategy: Literal["spread", "limit"] = Field(
        "spread",
        description="spread: aim_m of the heliostats, or the receiver's middle. limit: most power "
        "under a flux limit.",
    )
    limit_kw_m2: Positive | None = Field(None, description="Allowable flux of all cells.")
    limit_map: str = Field(
        "",
        description="Allowable flux of each cell, W/m²: a file of numbers (CSV) beside this one, "
        "highest row first.",
    )
    limit_table: str = Field(
        "",
        description="Allowable flux over temperature and velocity of the fluid: a table (CSV) "
        "beside this one; needs limit_panels.",
    )
    limit_panels: str = Field(
        "", description="Panels with the state of the fluid: a table (CSV) beside this one."
    )
    margin: Number = Field(
        0.05, description="Fraction of the limit reserved for model error; 0 to 0.5."
    )
    probability: Number = Field(
        AimSettings.probability,
        description="Probability that the limit holds everywhere; 0.5 to 0.9999.",
    )
    drift_mrad: Number = Field(0.0, description="Error common to all mirror normals; 0 to 50.")
    clock_s: Number = Field(0.0, description="Error of the field clock; 0 to 600.")
    cluster_mrad: Number = Field(
        0.0, description="Error common to the mirror normals of a cluster; 0 to 50."
    )
    dni_w_m2: Number = Field(
        AimSettings.dni, description="The limit holds at least up to this irradiance; 1 to 1500."
    )
    ramp_kw_m2_min: Number = Field(
        0.0,
        description="Fastest increase of the flux in a cell while the receiver is heated after "
        "standby or a cloud, kW/m² per minute; 0: no ramp.",
    )
    moves_per_minute: Number = Field(
        AimSettings.moves,
        description="Maximum number of tracking heliostats given a new aim per minute; 1 to 6000.",
    )
    together: int = Field(
        AimSettings.together,
        description="Maximum number of heliostats moving to a new aim at the same time; 1 to 1000.",
    )
    every_s: Number = Field(
        AimSettings.every, description="Time between two computations; 5 to 600."
    )
    deadline_s: Number = Field(
        AimSettings.deadline,
        description="Time within which aims must be computed; when the last good aims are five "
        "times as old, the field goes to the safe spread. From twice every_s to 3600.",
    )


class PlantDocument(StrictTable):
    """The whole file."""

    format: Literal["heliotrope-plant"]
    version: Literal[1]
    plant: PlantNameTable
    site: PlantSiteTable
    heliostats: str = Field(
        description="Table of the heliostats (CSV or Parquet), beside this file."
    )
    groups: dict[str, GroupTable] = Field(min_length=1)
    targets: list[TargetTable] = Field(default_factory=list)
    receivers: list[ReceiverTable] = Field(default_factory=list)
    towers: list[TowerTable] = Field(
        default_factory=list, description="Obstacles that shade and block heliostats."
    )
    cameras: list[CameraTable] = Field(default_factory=list)
    keep_out: list[AnyVolume] = Field(
        default_factory=list, description="Volumes that no beam may enter."
    )
    eyes_m: dict[str, Vector] = Field(
        default_factory=dict,
        description="Places from which people may look into beams of heliostats at rest.",
    )
    joint_visits: JointVisitsTable | None = Field(
        None, description="If omitted, joint visits with the default settings."
    )
    receiver_visits: ReceiverVisitsTable | None = Field(
        None, description="If omitted, no heliostat is measured on a receiver."
    )
    timetable: list[TimetableTable] = Field(
        default_factory=list, description="Calibrations at times of day and at intervals."
    )
    safety: Annotated[
        dict[str, dict[str, Number]],
        WithJsonSchema(
            {
                **schema(CONDITIONS),
                "description": "Values of the safety table that this plant sets, by condition.",
            }
        ),
    ] = Field(default_factory=dict)
    approval: ApprovalTable | None = Field(
        None, description="If omitted, no change needs a second engineer."
    )
    aims: AimsTable | None = Field(None, description="If omitted, strategy spread.")
