"""Mirrors identified by a user in photographs that the program cannot match by itself.

HelioPoint improves the camera attitude "using automatic or manual feature matching". A table lists
where in a photograph some mirrors, or their corners, are visible. Solving Wahba's problem for these
positions yields the attitude, which replaces that of the gimbal. The photograph is then evaluated
like all others, except that its attitude need not be searched for.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.identification import expected_feet, nearest_rotation, quad_area
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import FormatError
from heliotrope.field.camera import undistort
from heliotrope.files.cells import Rows, find_heliostats, read_rows
from heliotrope.geometry import FloatArray, as_float

#: What a row of the table may name: the corners in the order of an outline, the middle of the
#: mirror, or the lamp's reflection on it.
CORNERS = ("upper left", "upper right", "lower right", "lower left")
MIDDLE, LIGHT = "middle", "light"
#: Columns of the table.
COLUMNS = ("photo", "heliostat", "corner", "x_px", "y_px")
#: Minimum number of positions that determine an attitude; with three, a wrong name can be detected.
FEWEST = 2
#: A position has a wrong name if it is this many mirror sides from where the other positions
#: predict it.
_OFF = 0.4


@dataclass(frozen=True)
class Matches:
    """K positions in photographs named by a user.

    Attributes
    ----------
    path
        The table.
    photo
        Name of each photograph, or FLIGHT/NAME, (K,).
    heliostat
        Name of the heliostat, (K,).
    corner
        What is visible there: one of `CORNERS`, `MIDDLE` or `LIGHT`, (K,).
    pixel
        Position, px; the centre of the first pixel is (0, 0), (K, 2).
    """

    path: Path
    photo: tuple[str, ...]
    heliostat: tuple[str, ...]
    corner: tuple[str, ...]
    pixel: FloatArray

    def __len__(self) -> int:
        return len(self.photo)

    def of(self, photo: str, flight: str) -> npt.NDArray[np.intp]:
        """Return the indices of the positions in a photograph."""
        names = (photo, f"{flight}/{photo}")
        return np.array([k for k, name in enumerate(self.photo) if name in names], dtype=np.intp)


def read_matches(path: str | Path, names: Sequence[str]) -> tuple[Matches, list[str]]:
    """Return the positions in a table, and a message for each row that was left out.

    Rows without a heliostat are skipped, because they are outlines that the user has not named. An
    empty ``corner`` means the middle of the mirror.

    Parameters
    ----------
    path
        CSV with `COLUMNS`; other columns are ignored.
    names
        Names of the plant's heliostats.

    Raises
    ------
    FormatError
        If the table cannot be read, lacks a column, or names no mirror.
    """
    rows = read_rows(Path(path), "a table of mirrors named in photographs")
    rows.need([name for name in COLUMNS if name != "corner"])
    blank = {k for k, name in enumerate(rows.texts("heliostat")) if not name.strip()}
    heliostat = find_heliostats(rows, "heliostat", names)
    corner = _corners(rows)
    places = np.stack([rows.numbers(c, "pixels") for c in ("x_px", "y_px")], axis=-1)
    good = [int(k) for k in rows.good if int(k) not in blank]
    for k in blank:
        rows.reasons.pop(k, None)
    if not good:
        hint = f"; {rows.left_out[0]}" if rows.left_out else ""
        raise FormatError(rows.path, f"no row names a heliostat; fill in the column{hint}")
    photo = rows.texts("photo")
    return Matches(
        rows.path,
        tuple(photo[k].strip() for k in good),
        tuple(names[heliostat[k]] for k in good),
        tuple(corner[k] for k in good),
        as_float(places[good]),
    ), rows.left_out


def _corners(rows: Rows) -> list[str]:
    known = (*CORNERS, MIDDLE, LIGHT)
    names = []
    for k, text in enumerate(rows.texts("corner")):
        name = " ".join(text.replace("_", " ").split()).casefold() or MIDDLE
        if name not in known:
            rows.refuse(k, "corner", f"{text!r} is not one of {', '.join(known)}")
        names.append(name)
    return names


def turn_by_hand(
    photos: Sequence[Photo],
    camera: LedCamera,
    stand: MirrorPoses,
    matches: Matches,
    flight: str = "",
) -> tuple[tuple[Photo, ...], tuple[str, ...]]:
    """Return photographs with attitudes from positions identified by a user, and the problems.

    Parameters
    ----------
    photos
        Photographs as recorded by the drone.
    camera
        Lens.
    stand
        All mirrors in their expected poses.
    matches
        Named positions.
    flight
        Name of the flight; empty if it is the only flight.

    Returns
    -------
    The photographs, marked `by_hand` if they have named positions, and a message for each
    photograph whose positions were not used.
    """
    turned, problems = [], []
    for photo in photos:
        rows = matches.of(photo.name, flight)
        result = _turned(photo, camera, stand, matches, rows) if len(rows) else photo
        if isinstance(result, str):
            problems.append(f"{matches.path.name}: {photo.name}: {result}")
            result = photo
        turned.append(result)
    return tuple(turned), tuple(problems)


def _turned(
    photo: Photo,
    camera: LedCamera,
    stand: MirrorPoses,
    matches: Matches,
    rows: npt.NDArray[np.intp],
) -> Photo | str:
    """Return a photograph with the attitude from its named positions, or why that failed."""
    unknown = [matches.heliostat[k] for k in rows if matches.heliostat[k] not in stand.names]
    if unknown:
        return f"heliostat {unknown[0]} was not commanded in this flight; correct the name"
    if len(rows) < FEWEST:
        return (
            f"{len(rows)} place is named; {FEWEST} are needed, and 3 to detect a wrong name; name "
            "more"
        )
    plane = undistort(camera, matches.pixel[rows])
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    mirrors = np.array([stand.names.index(matches.heliostat[k]) for k in rows])
    current = photo
    # Where the lamp is seen on a mirror depends on the lamp's position, and hence on the attitude.
    for _ in range(2):
        points = np.stack(
            [
                _point(current, camera, stand, int(row), matches.corner[k])
                for row, k in zip(mirrors, rows, strict=True)
            ]
        )
        directions = points - photo.position
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        if float(np.linalg.svd(directions - directions.mean(axis=0))[1][0]) < 1e-3:
            return "all its places coincide; name mirrors that are farther apart"
        current = photo.moved(photo.position, nearest_rotation(directions, rays))
    gap = np.linalg.norm(current.pixels(camera, points) - matches.pixel[rows], axis=-1)
    side = np.sqrt(quad_area(current.pixels(camera, stand.corners[mirrors])))
    off = gap / np.where(np.isfinite(side), side, 1.0)
    worst = int(np.argmax(np.where(np.isfinite(off), off, np.inf)))
    if not off[worst] < _OFF:
        name, corner = matches.heliostat[rows[worst]], matches.corner[rows[worst]]
        return (
            f"{name}, {corner}, is {gap[worst]:.0f} px from the position that the other mirrors "
            "imply; correct its name or its position"
        )
    return replace(current, by_hand=True)


def _point(
    photo: Photo, camera: LedCamera, stand: MirrorPoses, row: int, corner: str
) -> FloatArray:
    """Return the point that a named position shows, ENU metres, (3,)."""
    if corner in CORNERS:
        return as_float(stand.corners[row, CORNERS.index(corner)])
    if corner == LIGHT:
        feet, visible = expected_feet(photo, camera, stand.take([row]))
        if len(visible):
            return as_float(feet[0])
    return as_float(stand.corners[row].mean(axis=0))
