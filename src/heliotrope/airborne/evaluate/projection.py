"""Identify overlapping mirrors by registering a drawing of the known field to the photograph.

Seen from a low drone, mirrors merge into one bright shape without separate patches, so
`heliotrope.airborne.evaluate.identification` finds no patches that could vote. But that shape is
predictable. The mirrors are drawn as expected from the recorded position and gimbal angles, with
nearer mirrors in front. The drawing is then shifted and rotated over the photograph until the two
correlate best (OpenCV's ``matchTemplate``, then ``findTransformECC``: Evangelidis and Psarakis
2008, IEEE Transactions on Pattern Analysis and Machine Intelligence 30, 1858). If the drawing fits
nearly as well elsewhere, no position is trusted.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.detection import Picture, brightness
from heliotrope.airborne.evaluate.identification import (
    GIMBAL,
    USUAL_GIMBAL,
    Identified,
    expected_size,
    nearest_rotation,
    rotation_angle,
)
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.airborne.visibility import draw_labels
from heliotrope.field.camera import undistort
from heliotrope.geometry import FloatArray, as_float, rotation

Image = npt.NDArray[np.float32]

#: Side of a typical mirror in the reduced picture, px.
_SIDE = 10.0
#: Minimum correlation of drawing and photograph, and by how much the best position must exceed any
#: other.
LEAST, MARGIN = 0.7, 0.06
#: If the brightness correlates this well, the colour of a photograph is not tried.
_CERTAIN = 0.9
#: A position counts as a different one if it is this far away, in mirror sides.
_APART = 0.6
#: Correlation deducted for a typical gimbal error, so that the usual position wins if two fit
#: equally well.
_USUAL = 0.01
_TURNS, _CANDIDATES, _ROUNDS = 17, 4, 60


@dataclass(frozen=True)
class _Place:
    """A position where the drawing fits: correlation, attitude and mirror centres, px, (M, 2)."""

    fit: float
    rotation: FloatArray
    middle: FloatArray


def outlines(photo: Photo, camera: LedCamera, stand: MirrorPoses) -> tuple[FloatArray, FloatArray]:
    """Return the corners of all mirrors in a photograph, px, (N, 4, 2), and their distances, (N,).

    Mirrors seen from behind are included, because they hide other mirrors.
    """
    away = np.linalg.norm(stand.vertex - photo.position, axis=-1)
    return photo.pixels(camera, stand.corners), as_float(away)


def overlay(picture: Picture, camera: LedCamera, photo: Photo, stand: MirrorPoses) -> Identified:
    """Return the attitude in which the overlapping mirrors of a field match a photograph.

    The result names mirrors but no patches.
    """
    none = np.empty(0, dtype=np.intp)
    side, visible = expected_size(camera, photo, stand)
    rows = np.flatnonzero(visible)
    scale = float(np.clip(_SIDE / np.median(side[rows]), 0.05, 1.0))
    reach = int(np.ceil(np.tan(GIMBAL) * camera.focal * scale))
    best: list[_Place] = []
    for feature in brightness(picture, scale):
        places = _places(feature, camera, photo, stand, rows, scale, reach)
        if places and (not best or places[0].fit > best[0].fit):
            best = places
        if best and best[0].fit > _CERTAIN:
            break
    if not best or best[0].fit < LEAST:
        fit = f"{100 * best[0].fit:.0f} %" if best else "nothing"
        text = (
            f"wrong_field: the {len(rows)} mirrors that should be in view match the photograph "
            f"to {fit}; check the field and the commands"
        )
        return Identified(photo.rotation, none, none, text)
    first = best[0]
    for other in best[1:]:
        gap = float(np.nanmedian(np.linalg.norm(other.middle - first.middle, axis=-1)))
        if gap > _APART * float(np.median(side[rows])) and other.fit > first.fit - MARGIN:
            text = (
                f"ambiguous: the mirrors also fit {gap:.0f} px away ({100 * other.fit:.0f} % "
                f"there, {100 * first.fit:.0f} % here); record the gimbal more accurately or "
                "photograph the end of a row"
            )
            return Identified(photo.rotation, none, none, text)
    return Identified(first.rotation, rows, none)


def _drawing(
    photo: Photo, camera: LedCamera, stand: MirrorPoses, scale: float, border: int
) -> tuple[Image, FloatArray]:
    """Return the drawing of the mirrors with a border, and the mirror corners, picture px."""
    import cv2

    corners, away = outlines(photo, camera, stand)
    width, height = camera.size
    pad = border / scale
    labels = draw_labels(
        corners + pad, away, (int(width + 2 * pad), int(height + 2 * pad)), 2.0 * scale
    )
    drawn = (labels > 0).astype(np.float32)
    size = (round(width * scale) + 2 * border, round(height * scale) + 2 * border)
    return np.asarray(cv2.resize(drawn, size, interpolation=cv2.INTER_AREA), np.float32), corners


def _places(
    feature: Image,
    camera: LedCamera,
    photo: Photo,
    stand: MirrorPoses,
    rows: npt.NDArray[np.intp],
    scale: float,
    reach: int,
) -> list[_Place]:
    """Return the positions where the drawing fits, best first."""
    import cv2

    coarse: list[tuple[float, float, FloatArray]] = []
    wide = cv2.copyMakeBorder(feature, reach, reach, reach, reach, cv2.BORDER_REPLICATE)
    for turn in np.linspace(-GIMBAL, GIMBAL, _TURNS):
        turned = photo.rotation @ rotation([0.0, 0.0, 1.0], -turn)
        drawn, _ = _drawing(photo.moved(photo.position, turned), camera, stand, scale, 0)
        used = np.argwhere(drawn > 0.0)
        if not len(used):
            continue
        (top, left), (bottom, right) = (
            np.maximum(used.min(axis=0) - reach // 2, 0),
            np.minimum(used.max(axis=0) + reach // 2 + 1, drawn.shape),
        )
        part = wide[top : bottom + 2 * reach, left : right + 2 * reach]
        score = cv2.matchTemplate(part, drawn[top:bottom, left:right], cv2.TM_CCOEFF_NORMED)
        score = np.where(np.isfinite(score), score, -1.0)
        for _ in range(_CANDIDATES):
            i, j = np.unravel_index(int(np.argmax(score)), score.shape)
            shift = (np.array([j, i]) - reach) / scale
            move = _move(shift, camera.focal)
            coarse.append((float(score[i, j]), float(turn), turned @ move))
            near = int(np.ceil(_APART * _SIDE))
            score[max(i - near, 0) : i + near + 1, max(j - near, 0) : j + near + 1] = -1.0
    coarse.sort(key=lambda c: -c[0])
    kept: list[FloatArray] = []
    apart = _APART * _SIDE / (scale * camera.focal)
    for _, _, turned in coarse:
        ahead = turned[:, 2]
        if len(kept) < _CANDIDATES and all(np.linalg.norm(ahead - k[:, 2]) > apart for k in kept):
            kept.append(turned)
    refined = [_refined(feature, camera, photo, stand, rows, scale, k) for k in kept]
    return sorted((f for f in refined if f is not None), key=lambda f: -f.fit)


def _move(shift: FloatArray, focal: float) -> FloatArray:
    """Return the camera rotation that moves its picture by ``shift`` (right, down), px."""
    x, y = np.arctan(shift / focal).tolist()
    return (rotation([0.0, 1.0, 0.0], x) @ rotation([1.0, 0.0, 0.0], -y)).T


def _refined(
    feature: Image,
    camera: LedCamera,
    photo: Photo,
    stand: MirrorPoses,
    rows: npt.NDArray[np.intp],
    scale: float,
    turned: FloatArray,
) -> _Place | None:
    """Return the position to which an attitude's drawing converges; None if it diverges."""
    import cv2

    fit, middle = -1.0, np.empty((0, 2))
    for _ in range(2):
        drawn, corners = _drawing(photo.moved(photo.position, turned), camera, stand, scale, 0)
        start = np.eye(2, 3, dtype=np.float32)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _ROUNDS, 1e-5)
        mask = cv2.dilate((drawn > 0.0).astype(np.uint8), np.ones((2 * int(_SIDE) + 1,) * 2))
        try:
            fit, warp = cv2.findTransformECC(
                drawn, feature, start, cv2.MOTION_EUCLIDEAN, stop, mask, 3
            )
        except cv2.error:
            return None
        middles = corners[rows].mean(axis=1)
        good = np.isfinite(middles).all(axis=-1)
        small = (middles[good] + 0.5) * scale - 0.5
        middle = ((small @ warp[:, :2].T + warp[:, 2]) + 0.5) / scale - 0.5
        plane = undistort(camera, middle)
        rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        directions = stand.corners[rows[good]].mean(axis=1) - photo.position
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        turned = nearest_rotation(directions, rays)
    angle = rotation_angle(turned, photo.rotation)
    if angle > 2.0 * GIMBAL:
        return None
    full = np.full((len(rows), 2), np.nan)
    full[good] = middle
    return _Place(float(fit) - _USUAL * (angle / USUAL_GIMBAL) ** 2, turned, full)
