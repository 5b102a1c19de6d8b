"""One photograph read: which mirrors it shows, their corners, the lamp's spots on them.

What is found stands as places without distortion, X/Z and Y/Z in camera axes, so that nothing
later needs the image. What is wrong with a photograph is said, not raised.
"""

from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate._dark import find_lights, is_dark
from heliotrope.airborne.evaluate.detection import (
    Picture,
    decode,
    find_outlines,
    find_patches,
    find_spots,
)
from heliotrope.airborne.evaluate.identification import Identified, expected_size, identify
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import Standing
from heliotrope.errors import HeliotropeError
from heliotrope.field.camera import undistort
from heliotrope.geometry import FloatArray, as_float

#: Mirrors of a smaller side are not measured, px.
SMALLEST = 12.0
#: A corner's deviation beyond that of its edges: texture beside the mirror, px.
CORNER_FLOOR = 0.07
#: Corners that stand so far from where a rectangle's would are of another edge: px, and share
#: of the mirror's side.
_SKEW, _SKEW_SHARE = 1.5, 0.03


def _none(*shape: int) -> FloatArray:
    return np.empty((0, *shape))


def _no_rows() -> npt.NDArray[np.intp]:
    return np.empty(0, dtype=np.intp)


@dataclass(frozen=True)
class Seen:
    """What one photograph shows.

    Attributes
    ----------
    name
        Of the photograph.
    problem
        Why it shows nothing that is believed; "" if it does. Begins with a name of the
        reason: nothing, wrong_field, ambiguous, overexposed, small, unreadable.
    rotation
        Camera axes to ENU, from its mirrors alone, (3, 3).
    mirror
        Rows of the mirrors that are in it, (M,).
    corners
        Their corners' places in the order of the outline, NaN where not found, (M, 4, 2).
    corner_sigma
        Standard deviation of a corner in each direction, (M,).
    spot_mirror
        Row of the mirror of each spot, (S,).
    spot, spot_sigma
        Place of each and its standard deviation in each direction, (S, 2) and (S,).
    flux
        Of each, full scales times pixels, (S,).
    clipped
        Clipped pixels of each, (S,).
    notes
        Reasons of mirrors that give no spot or no outline, "" for none, M of them.
    """

    name: str
    problem: str = ""
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    mirror: npt.NDArray[np.intp] = field(default_factory=_no_rows)
    corners: FloatArray = field(default_factory=lambda: _none(4, 2))
    corner_sigma: FloatArray = field(default_factory=_none)
    spot_mirror: npt.NDArray[np.intp] = field(default_factory=_no_rows)
    spot: FloatArray = field(default_factory=lambda: _none(2))
    spot_sigma: FloatArray = field(default_factory=_none)
    flux: FloatArray = field(default_factory=_none)
    clipped: npt.NDArray[np.intp] = field(default_factory=_no_rows)
    notes: tuple[str, ...] = ()

    def save(self, path: Path) -> None:
        """Write it as ``.npz``, whole or not at all."""
        from heliotrope.files.text import write_file

        values = {f.name: np.asarray(getattr(self, f.name)) for f in fields(self)}
        write_file(path, lambda stream: np.savez_compressed(stream, allow_pickle=False, **values))

    @classmethod
    def load(cls, path: Path) -> "Seen":
        """Return what :meth:`save` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            values = {f.name: stored[f.name] for f in fields(cls)}
        return cls(
            **{
                **values,
                "name": str(values["name"]),
                "problem": str(values["problem"]),
                "notes": tuple(str(n) for n in values["notes"]),
            }
        )


def read_photo(photo: Photo, camera: LedCamera, stand: Standing) -> Seen:
    """Return what the file of a photograph shows.

    Parameters
    ----------
    photo
        As the drone tells it, with its path.
    camera
        Lens.
    stand
        All mirrors as they are believed to stand.
    """
    if photo.path is None:
        return Seen(photo.name, "unreadable: there is no file")
    try:
        picture = decode(photo.path)
    except HeliotropeError as error:
        return Seen(photo.name, f"unreadable: {error}")
    height, width = picture.shape[:2]
    if (width, height) != camera.size:
        return Seen(
            photo.name,
            f"unreadable: {width} × {height} px, but the camera's photographs have "
            f"{camera.size[0]} × {camera.size[1]} px; give that camera's file",
        )
    return look(picture, photo, camera, stand)


def look(picture: Picture, photo: Photo, camera: LedCamera, stand: Standing) -> Seen:
    """Return what a picture shows, see :func:`read_photo`."""
    side, near = expected_size(camera, photo, stand)
    if not near.any():
        return Seen(photo.name, "wrong_field: no mirror of the field can be in it")
    usual = float(np.median(side[near]))
    if usual < SMALLEST:
        return Seen(
            photo.name,
            f"small: mirrors are {usual:.0f} px across, less than {SMALLEST:.0f}; "
            "fly nearer or with a longer lens",
        )
    clipped = float((picture[::8, ::8] >= 254).all(axis=2).mean())
    if clipped > 0.5:
        return Seen(
            photo.name, f"overexposed: {100 * clipped:.0f} % of it are clipped; expose shorter"
        )
    found = Identified(photo.rotation, _no_rows(), _no_rows(), "nothing: no patches")
    for patches in find_patches(picture, usual**2):
        one = identify(camera, photo, stand, patches.center)
        # The reason of the attempt that came farthest is told: any but "nothing" says more.
        if not one.reason or found.reason.startswith("nothing"):
            found = one
        if not found.reason:
            break
    if found.reason:
        if is_dark(picture):
            return _lights(picture, photo, camera, stand)
        return Seen(photo.name, found.reason)
    return _measure(picture, photo, camera, stand, found)


def _measure(
    picture: Picture, photo: Photo, camera: LedCamera, stand: Standing, found: Identified
) -> Seen:
    rows, expected = _in_frame(photo.moved(photo.position, found.rotation), camera, stand)
    if not len(rows):
        return Seen(photo.name, "nothing: no mirror is wholly in the frame")
    size = np.sqrt(_area(expected))
    reach = float(np.clip(0.12 * np.median(size), 2.0, 6.0))
    first = find_outlines(picture, expected, reach, profiles=16)
    better = np.where(first.found[:, None, None], first.corners, expected)
    lines = find_outlines(picture, better, 2.0)
    # Corners of a mirror move together if the camera is turned, not one by one.
    shift = lines.corners - expected
    skew = np.linalg.norm(shift - np.median(shift, axis=1, keepdims=True), axis=-1).max(axis=1)
    good = lines.found & (skew < np.maximum(_SKEW, _SKEW_SHARE * size))
    outline = np.where(good[:, None, None], lines.corners, expected)
    spots, reasons = find_spots(picture, outline)
    if all(r.startswith("overexposed") for r in reasons):
        return Seen(photo.name, f"overexposed: all {len(rows)} mirrors are clipped; expose shorter")
    notes = [
        reason or ("" if whole else "outline: hidden, or no straight edges")
        for reason, whole in zip(reasons, good, strict=True)
    ]
    corners = np.full(lines.corners.shape, np.nan)
    corners[good] = undistort(camera, lines.corners[good])
    return Seen(
        name=photo.name,
        rotation=_attitude(found.rotation, photo, stand, rows, corners),
        mirror=rows,
        corners=corners,
        corner_sigma=np.hypot(np.where(good, lines.sigma, 1.0), CORNER_FLOOR) / camera.focal,
        spot_mirror=rows[spots.mirror],
        spot=undistort(camera, spots.pixel),
        spot_sigma=spots.sigma / camera.focal,
        flux=spots.flux,
        clipped=spots.clipped,
        notes=tuple(notes),
    )


def _lights(picture: Picture, photo: Photo, camera: LedCamera, stand: Standing) -> Seen:
    """Return what a photograph shows in which the mirrors cannot be seen, but the lamp can."""
    found, spots = find_lights(picture, photo, camera, stand)
    if found.reason:
        return Seen(photo.name, found.reason)
    rows = np.unique(spots.mirror)
    return Seen(
        name=photo.name,
        rotation=found.rotation,
        mirror=rows,
        corners=np.full((len(rows), 4, 2), np.nan),
        corner_sigma=np.ones(len(rows)),
        spot_mirror=spots.mirror,
        spot=undistort(camera, spots.pixel),
        spot_sigma=spots.sigma / camera.focal,
        flux=spots.flux,
        clipped=spots.clipped,
        notes=("dark: its edges cannot be seen",) * len(rows),
    )


def _in_frame(
    photo: Photo, camera: LedCamera, stand: Standing
) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the mirrors whose corners are all in the frame, and those corners, px."""
    pixels = photo.pixels(camera, stand.corners)
    width, height = camera.size
    with np.errstate(invalid="ignore"):
        inside = (pixels > 3.0) & (pixels < np.array([width, height]) - 4.0)
    front = np.sum((photo.position - stand.vertex) * stand.rotation[:, :, 2], axis=-1) > 0.0
    whole = inside.all(axis=(1, 2)) & front
    whole[whole] &= _area(pixels[whole]) > SMALLEST**2 / 2.0
    rows = np.flatnonzero(whole)
    return rows, pixels[rows]


def _area(corners: FloatArray) -> FloatArray:
    ahead = np.roll(corners, -1, axis=1)
    cross = corners[..., 0] * ahead[..., 1] - corners[..., 1] * ahead[..., 0]
    return as_float(0.5 * np.abs(cross.sum(axis=1)))


def _attitude(
    start: FloatArray,
    photo: Photo,
    stand: Standing,
    rows: npt.NDArray[np.intp],
    corners: FloatArray,
) -> FloatArray:
    """Return the rotation that brings all found corners closest (Wahba)."""
    seen = np.isfinite(corners).all(axis=-1)
    if int(seen.sum()) < 4:
        return start
    ways = (stand.corners[rows] - photo.position)[seen]
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    rays = np.concatenate([corners[seen], np.ones((int(seen.sum()), 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    u, _, vt = np.linalg.svd(ways.T @ rays)
    return as_float(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
