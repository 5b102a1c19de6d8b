"""Aerial photographs: camera, position and attitude.

The camera model and its conventions are those of `heliotrope.field.camera`: camera axes with x to
the right, y down and z forward, and rotations from camera axes to ENU.
"""

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.airborne._photo_metadata import RTK_FIXED, Metadata, read_metadata
from heliotrope.errors import FormatError, InputError
from heliotrope.field.camera import check_unfolded, checked_pinhole, checked_pose, local_pixels
from heliotrope.files.cells import read_rows
from heliotrope.files.documents import read_toml
from heliotrope.files.limits import check_entries
from heliotrope.files.text import write_text
from heliotrope.files.times import moment
from heliotrope.geometry import (
    FloatArray,
    as_float,
    as_vectors,
    geodetic_to_enu,
    rotation,
)

#: Suffixes of photographs.
SUFFIXES = (".jpg", ".jpeg")
#: Standard deviation of a fixed RTK solution for which none is stated, m.
RTK_SIGMA = 0.01
#: Points farther out than this multiple of the frame corners are not visible.
REACH = 1.3


@dataclass(frozen=True)
class LedCamera:
    """A camera with a lamp beside it, in the lens model of OpenCV (Brown and Conrady).

    Attributes
    ----------
    size
        Width and height of a photograph, pixels.
    matrix
        Focal lengths and principal point, pixels; the first pixel's centre is (0, 0), (3, 3).
    distortion
        k1, k2, p1, p2, k3, (5,).
    led_offset
        Vector from the projection centre to the lamp, m, in camera axes, (3,); HelioPoint's
        d_cam-led.
    """

    size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray = field(default_factory=lambda: np.zeros(5))
    led_offset: FloatArray = field(default_factory=lambda: np.array([0.0, -0.1, 0.0]))

    def __post_init__(self) -> None:
        size, matrix, distortion = checked_pinhole("camera", self, smallest=16)
        offset = as_vectors(self.led_offset, "camera: led_offset")
        if offset.shape != (3,) or np.linalg.norm(offset) > 5.0:
            raise InputError(f"camera: led_offset {offset} m; use right, down, forward within 5 m")
        object.__setattr__(self, "size", size)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "distortion", distortion)
        object.__setattr__(self, "led_offset", offset)

    @property
    def focal(self) -> float:
        """Mean focal length, pixels."""
        return float(0.5 * (self.matrix[0, 0] + self.matrix[1, 1]))


@dataclass(frozen=True)
class Photo:
    """One photograph as recorded by the drone.

    Attributes
    ----------
    name
        Name of the file.
    time
        Time of exposure, UTC; None if no time with a time zone is stated.
    position
        Position of the projection centre, ENU metres, (3,).
    rotation
        Rotation from camera axes to ENU, (3, 3).
    sigma_position
        Standard deviation of the position east, north, up, m, (3,).
    path
        The file; None if there is no image.
    by_hand
        Whether the rotation comes from mirrors that a user identified in the photograph.
    """

    name: str
    time: datetime | None
    position: FloatArray
    rotation: FloatArray
    sigma_position: FloatArray = field(default_factory=lambda: np.full(3, RTK_SIGMA))
    path: Path | None = None
    by_hand: bool = False

    def __post_init__(self) -> None:
        position, turned = checked_pose(f"photo {self.name}", self.position, self.rotation)
        sigma = np.array(np.broadcast_to(as_float(self.sigma_position), (3,)))
        if not (np.isfinite(sigma).all() and (sigma > 0.0).all()):
            raise InputError(f"photo {self.name}: sigma_position must be above 0, not {sigma} m")
        if self.time is not None and self.time.tzinfo is None:
            raise InputError(f"photo {self.name}: time {self.time} has no time zone; use UTC")
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", turned)
        object.__setattr__(self, "sigma_position", sigma)

    def led_position(self, camera: LedCamera) -> FloatArray:
        """Return the position of the lamp, ENU metres, (3,)."""
        return as_float(self.position + self.rotation @ camera.led_offset)

    def pixels(self, camera: LedCamera, points: npt.ArrayLike) -> FloatArray:
        """Return the pixels (..., 2) at which points, ENU metres (..., 3), appear.

        The result is NaN for points behind the camera or beyond `REACH`.
        """
        local = (as_vectors(points, "points") - self.position) @ self.rotation
        return local_pixels(camera, local, REACH)

    def moved(self, position: npt.ArrayLike, rotation: npt.ArrayLike) -> "Photo":
        """Return the photograph with a different exterior orientation."""
        return replace(self, position=as_float(position), rotation=as_float(rotation))


def rotation_of_gimbal(yaw: float, pitch: float, roll: float) -> FloatArray:
    """Return the rotation from camera axes to ENU, (3, 3), for gimbal angles in rad.

    The angles are defined as by DJI: rotations about the axes of a body with x forward, y to the
    right and z down, in the order yaw, pitch, roll, starting from north-east-down. Yaw is clockwise
    from north, pitch is 0 at the horizon and −π/2 straight down, roll lowers the right side.
    """
    ned = rotation([0.0, 0.0, 1.0], yaw) @ rotation([0.0, 1.0, 0.0], pitch)
    ned = ned @ rotation([1.0, 0.0, 0.0], roll)
    # Camera x (right), y (down), z (forward) are the body's y, z, x; ENU are the y, x, −z of NED.
    return as_float(ned[[1, 0, 2]][:, [1, 2, 0]] * np.array([[1.0], [1.0], [-1.0]]))


def gimbal_of_rotation(turned: npt.ArrayLike) -> tuple[float, float, float]:
    """Return yaw in [−π, π], pitch and roll, rad: the inverse of `rotation_of_gimbal`.

    If the camera looks straight down, yaw and roll are the same rotation, which is returned as yaw.
    """
    enu = as_float(turned)
    ned = (enu * np.array([[1.0], [1.0], [-1.0]]))[[1, 0, 2]][:, [2, 0, 1]]
    level = math.hypot(ned[0, 0], ned[1, 0])
    pitch = math.atan2(-ned[2, 0], level)
    if level < 1e-9:
        return math.atan2(-ned[0, 1], ned[1, 1]), pitch, 0.0
    return math.atan2(ned[1, 0], ned[0, 0]), pitch, math.atan2(ned[2, 1], ned[2, 2])


# -- camera file -----------------------------------------------------------------------


def read_camera(path: str | Path) -> LedCamera:
    """Return the camera from a TOML file written by `write_camera`.

    Raises
    ------
    FormatError
        If the file cannot be read, or a value is missing or wrong.
    """
    table = read_toml(path, "a camera file (TOML)")
    lengths = {
        "size_px": 2, "focal_px": 2, "principal_point_px": 2, "distortion": 5, "led_offset_m": 3,
    }  # fmt: skip
    values: dict[str, list[float]] = {}
    for key, length in lengths.items():
        value = table.get(key)
        numbers = isinstance(value, list) and all(
            isinstance(v, int | float) and not isinstance(v, bool) for v in value
        )
        if not numbers or value is None or len(value) != length:
            raise FormatError(path, f"needs {length} numbers, not {value!r}", key)
        values[key] = value
    (fx, fy), (cx, cy) = values["focal_px"], values["principal_point_px"]
    width, height = values["size_px"]
    try:
        camera = LedCamera(
            (int(width), int(height)),
            np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
            as_float(values["distortion"]),
            as_float(values["led_offset_m"]),
        )
        check_unfolded("camera", camera)
    except InputError as error:
        raise FormatError(path, str(error)) from None
    return camera


def write_camera(path: str | Path, camera: LedCamera) -> None:
    """Write a camera as TOML; the lamp offset is to the right of, below and ahead of the camera."""
    m = camera.matrix
    rows = {
        "size_px": list(camera.size),
        "focal_px": [m[0, 0], m[1, 1]],
        "principal_point_px": [m[0, 2], m[1, 2]],
        "distortion": camera.distortion.tolist(),
        "led_offset_m": camera.led_offset.tolist(),
    }
    lines = [f"{key} = [{', '.join(repr(v + 0) for v in row)}]" for key, row in rows.items()]
    write_text(path, "\n".join(lines).replace("np.float64(", "").replace(")", "") + "\n")


# -- photographs -----------------------------------------------------------------------


def read_photos(
    folder: str | Path, plant_origin: tuple[float, float, float]
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """Return the photographs in a folder, sorted by name, and a message for each problem.

    Position, gimbal angles and time come from ``photos.csv`` in the folder if it exists, otherwise
    from the EXIF and XMP metadata that DJI drones write.

    Parameters
    ----------
    folder
        Folder of JPEG files; see `SUFFIXES`.
    plant_origin
        Latitude and longitude (degrees) and height (m) of the ENU origin. This height and those of
        the photographs must be of the same kind (both above the ellipsoid, or both above the
        geoid).

    Returns
    -------
    Photographs, and a message for each photograph that cannot be used because its position or
    angles are missing, its RTK solution is not marked as fixed, or its size differs from that of
    most photographs (mixed cameras).

    Raises
    ------
    InputError
        If the folder does not exist, or contains no usable photograph.
    FormatError
        If ``photos.csv`` is not a table of photographs.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{place}: no such folder; specify a folder with photographs")
    files = sorted(f for f in check_entries(place, place.iterdir()) if f.suffix.lower() in SUFFIXES)
    table = place / "photos.csv"
    rows = _read_table(table) if table.exists() else {}
    if not files and not rows:
        raise InputError(f"{place}: no photographs ({', '.join(SUFFIXES)}) in it")
    photos: list[Photo] = []
    problems: list[str] = []
    sizes: dict[str, tuple[int, int]] = {}
    for file in files:
        try:
            metadata = read_metadata(file)
            sizes[file.name] = metadata.size
            if rows:
                if file.name not in rows:
                    raise FormatError(file, f"{table.name} has no row for this photograph; add one")
                photos.append(_of_row(rows[file.name], table, file, plant_origin))
            else:
                photos.append(_of_metadata(metadata, file, plant_origin))
        except InputError as error:
            problems.append(str(error))
    missing = sorted(set(rows) - {f.name for f in files})
    problems += [f"{place / name}: {table.name} lists it, but no such file" for name in missing]
    if not photos:
        raise InputError(
            f"{place}: none of the {len(problems)} photographs can be used: {problems[0]}"
        )
    return _of_one_camera(photos, problems, sizes, place)


def _of_one_camera(
    photos: list[Photo], problems: list[str], sizes: Mapping[str, tuple[int, int]], place: Path
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    counted = Counter(sizes[p.name] for p in photos)
    if len(counted) > 1:
        usual = counted.most_common(1)[0][0]
        for photo in [p for p in photos if sizes[p.name] != usual]:
            width, height = sizes[photo.name]
            problems.append(
                f"{place / photo.name}: {width} × {height} px, but most photographs have "
                f"{usual[0]} × {usual[1]} px; use a separate folder for each camera"
            )
        photos = [p for p in photos if sizes[p.name] == usual]
    return tuple(photos), tuple(problems)


def _of_metadata(metadata: Metadata, file: Path, origin: tuple[float, float, float]) -> Photo:
    missing = [
        name
        for name, value in (
            ("GpsLatitude", metadata.latitude_deg),
            ("GpsLongitude", metadata.longitude_deg),
            ("AbsoluteAltitude", metadata.altitude),
            ("GimbalYawDegree", metadata.yaw_deg),
            ("GimbalPitchDegree", metadata.pitch_deg),
            ("GimbalRollDegree", metadata.roll_deg),
        )
        if not math.isfinite(value)
    ]
    if missing:
        raise FormatError(
            file,
            f"its XMP lacks {', '.join(missing)}; copy the original file from the drone, or "
            "write the values into photos.csv",
        )
    if metadata.rtk_flag != RTK_FIXED:
        what = (
            "its XMP has no RtkFlag, so nothing states how well its position is known"
            if metadata.rtk_flag is None
            else f"RtkFlag {metadata.rtk_flag} is not a fixed solution ({RTK_FIXED}): its position "
            "is known to decimetres at best"
        )
        remedy = "leave it out, or write photos.csv with corrected positions and their sigma_m"
        raise FormatError(file, f"{what}; {remedy}")
    position = geodetic_to_enu(
        metadata.latitude_deg, metadata.longitude_deg, metadata.altitude, origin
    )
    known = np.isfinite(metadata.sigma) & (metadata.sigma > 0.0)
    return Photo(
        file.name,
        metadata.time,
        position,
        rotation_of_gimbal(*(math.radians(a) for a in metadata.angles_deg)),
        np.where(known, metadata.sigma, RTK_SIGMA),
        file,
    )


def _read_table(path: Path) -> dict[str, dict[str, str]]:
    rows = read_rows(path, "a table of photographs")
    columns = set(rows.columns)
    places = ({"east_m", "north_m", "up_m"}, {"latitude_deg", "longitude_deg", "altitude_m"})
    needed = {"name", "yaw_deg", "pitch_deg", "roll_deg", "sigma_m"}
    if needed - columns or not any(p <= columns for p in places):
        raise FormatError(
            path,
            "needs the columns name, yaw_deg, pitch_deg, roll_deg, sigma_m and east_m, north_m, "
            "up_m (or latitude_deg, longitude_deg, altitude_m); time is optional",
        )
    names = rows.names("name", "photograph")
    rows.refuse_bad()
    cells = {column: rows.texts(column) for column in columns}
    return {name: {c: texts[i] for c, texts in cells.items()} for i, name in enumerate(names)}


def _of_row(
    row: Mapping[str, str], table: Path, file: Path, origin: tuple[float, float, float]
) -> Photo:
    def number(key: str) -> float:
        try:
            value = float(row[key])
        except (TypeError, ValueError):
            value = math.nan
        if not math.isfinite(value):
            raise FormatError(
                table, f"{row[key]!r} is not a number", f"{row['name']}, column {key}"
            )
        return value

    yaw, pitch, roll = (math.radians(number(f"{k}_deg")) for k in ("yaw", "pitch", "roll"))
    if "east_m" in row:
        position = np.array([number(k) for k in ("east_m", "north_m", "up_m")])
    else:
        latitude, longitude, height = (
            number(k) for k in ("latitude_deg", "longitude_deg", "altitude_m")
        )
        position = geodetic_to_enu(latitude, longitude, height, origin)
    time, text = None, (row.get("time") or "").strip()
    if text:
        try:
            time = moment(text)
        except ValueError:
            raise FormatError(table, f"time {text!r} is not ISO 8601", row["name"]) from None
        if time.tzinfo is None:
            raise FormatError(table, f"time {text} has no time zone; append Z", row["name"])
        time = time.astimezone(UTC)
    turned = rotation_of_gimbal(yaw, pitch, roll)
    return Photo(file.name, time, position, turned, np.full(3, number("sigma_m")), file)
