"""What a plant's TOML file may hold: pydantic models, at the boundary only."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]

#: Names of mechanisms, each with the geometry that its group may give.
KINDS: dict[str, tuple[str, ...]] = {
    "azimuth_elevation": ("pivot_height_m", "pivot_offset_m"),
    "tilt_roll": ("axis", "pivot_height_m", "spacing_m", "pivot_offset_m"),
    "target_aligned": ("aim_m", "pivot_height_m", "pivot_offset_m"),
    "pitch_roll": ("facing_deg", "pivot_height_m", "spacing_m", "pivot_offset_m"),
    "polar": ("latitude_deg", "pivot_height_m", "pivot_offset_m"),
    "two_axis": ("axis_1", "axis_2", "normal", "origin_1_m", "origin_2_m", "arm_m", "vertex_m"),
    "two_jacks": (
        "joint_translation_1_m", "joint_translation_2_m", "concentrator_translation_m",
    ),
}  # fmt: skip

#: Angles of a drive; each may be given with ``_deg``, ``_mrad`` or ``_rad``.
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


class Strict(BaseModel):
    """Refuses what it does not know."""

    model_config = ConfigDict(extra="forbid", strict=False)


class PlantTable(Strict):
    """``[plant]``."""

    name: str = Field(min_length=1)


class SiteTable(Strict):
    """``[site]``: the reference point and its air."""

    latitude_deg: Annotated[float, Field(ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(ge=-180, le=180)]
    height_m: Annotated[float, Field(ge=-500, le=9000)] = 0.0
    pressure_pa: Annotated[float, Field(ge=30e3, le=120e3)] | None = None
    temperature_c: Annotated[float, Field(ge=-80, le=60)] = 12.0
    name: str = ""
    delta_t_s: Number | None = Field(None, description="TT - UT1; default from the date.")


class MarkTable(Strict):
    """A mark on a target: L, T, square, disc, tag or taught picture."""

    name: str = Field(min_length=1)
    kind: Literal["corner", "tee", "square", "disc", "tag", "picture"]
    at_m: Vector = Field(description="ENU of its vertex, middle of bar, or centre.")
    size_m: Positive
    stroke_m: Positive | None = Field(None, description="Of a corner or tee; default a fifth.")
    turn_deg: Number = Field(0.0, description="Counterclockwise, as seen from the front.")
    code: str = Field("", description="Of a tag 4X4_50:7 or APRILTAG_36h11:7; of a picture a file.")


class TargetTable(Strict):
    """``[[targets]]``: four corners from the upper left as seen from the front, or a size."""

    name: str = Field(min_length=1)
    corners_m: Annotated[list[Vector], Field(min_length=4, max_length=4)] | None = None
    center_m: Vector | None = None
    width_m: Positive | None = None
    height_m: Positive | None = None
    facing_deg: Number | None = Field(None, description="Azimuth that the front looks to.")
    markers_m: dict[str, Vector] = Field(default_factory=dict)
    marks: list[MarkTable] = Field(default_factory=list)


class ReceiverTable(Strict):
    """``[[receivers]]``."""

    name: str = Field(min_length=1)
    kind: Literal["planar", "convex_cylinder", "external_cylinder"] = "planar"
    center_m: Vector
    normal: Vector
    width_m: Positive
    height_m: Positive
    corners_m: Annotated[list[Vector], Field(min_length=4, max_length=4)] | None = None
    radius_m: Annotated[float, Field(ge=0)] = 0.0
    opening_angle_rad: Annotated[float, Field(ge=0)] = 0.0


class CameraTable(Strict):
    """``[[cameras]]``: a pinhole with distortion, in the convention of OpenCV."""

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
    deviation_px: Annotated[float, Field(ge=0)] = 0.0


class BoxTable(Strict):
    """``[[keep_out]]`` of kind box: an upright box, such as a building."""

    name: str = Field(min_length=1)
    kind: Literal["box"]
    center_m: Vector
    size_m: Annotated[list[Positive], Field(min_length=3, max_length=3)] = Field(
        description="To its right, forwards and up."
    )
    azimuth_deg: Number = Field(0.0, description="Of its forward direction.")
    azimuth_rad: Number | None = Field(None, description="Instead, as the writer leaves it.")


class SphereTable(Strict):
    """``[[keep_out]]`` of kind sphere."""

    name: str = Field(min_length=1)
    kind: Literal["sphere"]
    center_m: Vector
    radius_m: Positive


class CylinderTable(Strict):
    """``[[keep_out]]`` of kind cylinder, such as a mast or an approach corridor."""

    name: str = Field(min_length=1)
    kind: Literal["cylinder"]
    start_m: Vector = Field(description="Centre of one end.")
    end_m: Vector = Field(description="Centre of the other.")
    radius_m: Positive


class PrismTable(Strict):
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


class ChainTable(Strict):
    """``chain``: a mechanism number by number, as the writer leaves it."""

    joints: list[str]
    driven: list[int]
    orientation: list[list[Number]]
    axes: list[Vector]
    origins_m: list[Vector]
    angles_rad: list[Number]
    vertex_m: Vector
    normal: Vector


class RawDrive(Strict):
    """A drive number by number, as the writer leaves it."""

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
    return create_model(name, __base__=Strict, **fields)


RotaryDrive = _drive(
    "RotaryDrive",
    "rotary",
    steps_per_turn=(Positive, ...),
    gear_ratio=(Positive, ...),
    microsteps=(Positive, 1.0),
    sense=(Literal[1, -1], 1),
)
DirectDrive = _drive("DirectDrive", "direct")
# The constants of a jack often differ from heliostat to heliostat, so that they may
# stand in the table instead.
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


class GroupTable(Strict):
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
    facets: list[list[Vector]] | None = Field(
        None, description="Center, half width and half height of each, in the mirror's frame, m."
    )


class PlantDocument(Strict):
    """The whole file."""

    format: Literal["heliotrope-plant"]
    version: Literal[1]
    plant: PlantTable
    site: SiteTable
    heliostats: str = Field(description="Table of the heliostats (CSV or Parquet), beside.")
    groups: dict[str, GroupTable] = Field(min_length=1)
    targets: list[TargetTable] = Field(default_factory=list)
    receivers: list[ReceiverTable] = Field(default_factory=list)
    cameras: list[CameraTable] = Field(default_factory=list)
    keep_out: list[AnyVolume] = Field(
        default_factory=list, description="Volumes where no beam may be."
    )
    eyes_m: dict[str, Vector] = Field(
        default_factory=dict, description="From where people may look into beams at rest."
    )
