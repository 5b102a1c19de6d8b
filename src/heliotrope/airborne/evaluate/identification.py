"""Which mirror is which: the field is projected into a photograph and laid over its patches.

The place of a photograph is known to centimetres, its attitude to a degree or so. What is
unknown is therefore a small rotation. It is found by votes: each pair of a patch and an
expected mirror votes for the shift between both, for a number of turns about the line of
sight. The best few shifts are made exact by Wahba's problem on the pairs that then lie close.
The one wins by which most mirrors lie most closely and fewest mirrors and patches are left
over. If another one, with other names for the mirrors, is nearly as good, nothing is believed.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import Standing
from heliotrope.field.camera import undistort
from heliotrope.geometry import FloatArray, as_float, rotation

#: Largest error of the gimbal that is looked for, rad.
GIMBAL = float(np.radians(4.0))
#: Fewest mirrors that must lie on patches, and the share of those expected in the frame.
FEWEST, LEAST_SHARE = 4, 0.4
#: The best solution must explain so many more mirrors and patches than another one does.
MARGIN = 4.0
#: Standard deviation of a gimbal, rad: what is worth a mirror's half.
USUAL_GIMBAL = float(np.radians(1.5))
_TURNS, _CANDIDATES, _ROUNDS = 17, 10, 6


@dataclass(frozen=True)
class Identified:
    """Which mirrors a photograph shows.

    Attributes
    ----------
    rotation
        Camera axes to ENU, (3, 3).
    mirror, patch
        Pairs of a mirror's row and a patch, (K,).
    reason
        Why nothing is believed; "" if it is.
    """

    rotation: FloatArray
    mirror: npt.NDArray[np.intp]
    patch: npt.NDArray[np.intp]
    reason: str = ""


def expected_size(
    camera: LedCamera, photo: Photo, stand: Standing
) -> tuple[FloatArray, FloatArray]:
    """Return sides (M,), px, of mirrors as seen by a photograph, and whether they may be in it.

    The side is the root of the area; a mirror may be in the frame if a turn of the gimbal by
    :data:`GIMBAL` can bring it there.
    """
    local = (stand.corners - photo.position) @ photo.rotation
    depth = local[..., 2]
    safe = np.where(depth > 0.1, depth, np.nan)
    plane = local[..., :2] / safe[..., None]
    ahead = np.roll(plane, -1, axis=1)
    area = 0.5 * np.abs(
        np.sum(plane[..., 0] * ahead[..., 1] - plane[..., 1] * ahead[..., 0], axis=1)
    )
    front = np.sum((photo.position - stand.vertex) * stand.rotation[:, :, 2], axis=-1) > 0.0
    width, height = camera.size
    limit = np.array([width, height]) / (2.0 * camera.focal) * 1.1 + np.tan(GIMBAL)
    middle = plane.mean(axis=1)
    seen = front & np.isfinite(area) & (np.abs(middle) < limit).all(axis=-1)
    return np.sqrt(np.nan_to_num(area)) * camera.focal, seen


def identify(camera: LedCamera, photo: Photo, stand: Standing, patches: FloatArray) -> Identified:
    """Return which mirrors patches show, and how the camera was turned.

    Parameters
    ----------
    camera
        Lens.
    photo
        As the drone tells it.
    stand
        All mirrors as they are believed to stand.
    patches
        Centres of patches, px, (K, 2).
    """
    none = np.empty(0, dtype=np.intp)
    side, seen = expected_size(camera, photo, stand)
    rows = np.flatnonzero(seen)
    if len(rows) < FEWEST:
        text = f"wrong_field: {len(rows)} mirrors of the field can be in it; is it this field's?"
        return Identified(photo.rotation, none, none, text)
    if len(patches) < FEWEST:
        text = f"nothing: {len(patches)} patches look like mirrors, {FEWEST} are needed"
        return Identified(photo.rotation, none, none, text)
    ways = stand.corners[rows].mean(axis=1) - photo.position
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    plane = undistort(camera, patches)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    size = float(np.median(side[rows])) / camera.focal
    tried = [
        _refine(start, ways, rays, side[rows] / camera.focal)
        for start in _starts(photo.rotation, ways, plane, size)
    ]
    return _believe(tried, photo, camera, stand, rows, len(patches))


Tried = tuple[float, FloatArray, npt.NDArray[np.intp], npt.NDArray[np.intp]]


def _starts(
    turned: FloatArray, ways: FloatArray, plane: FloatArray, size: float
) -> list[FloatArray]:
    """Return the rotations that most votes are for."""
    from scipy.ndimage import uniform_filter

    local = ways @ turned
    reach = np.tan(GIMBAL) * 1.2
    cells = int(np.clip(2.0 * reach / (0.35 * size), 16, 400))
    found: list[tuple[float, FloatArray]] = []
    for turn in np.linspace(-GIMBAL, GIMBAL, _TURNS):
        spun = local @ rotation([0.0, 0.0, 1.0], turn)
        there = spun[:, :2] / spun[:, 2:]
        shift = (plane[:, None] - there[None]).reshape(-1, 2)
        votes, *_ = np.histogram2d(
            shift[:, 0], shift[:, 1], bins=cells, range=[[-reach, reach]] * 2
        )
        votes = uniform_filter(votes, 3, mode="constant")
        for _ in range(3):
            i, j = np.unravel_index(int(np.argmax(votes)), votes.shape)
            x, y = ((np.array([i, j]) + 0.5) / cells * 2.0 - 1.0) * reach
            # To move what is seen by (x, y) the camera turns about its down and right axes.
            move = rotation([0.0, 1.0, 0.0], x) @ rotation([1.0, 0.0, 0.0], -y)
            total = turned @ rotation([0.0, 0.0, 1.0], turn) @ move.T
            found.append((float(votes[i, j]), total))
            votes[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3] = 0.0
    found.sort(key=lambda f: -f[0])
    # Neighbouring turns vote for the same: others are of interest.
    apart = max(0.7 * size, 2.2 * GIMBAL / (_TURNS - 1))
    kept: list[FloatArray] = []
    for _, start in found:
        if len(kept) < _CANDIDATES and all(rotation_angle(start, k) > apart for k in kept):
            kept.append(start)
    return kept


def _refine(turned: FloatArray, ways: FloatArray, rays: FloatArray, size: FloatArray) -> Tried:
    """Return score, rotation and pairs (mirror, patch) that a start leads to."""
    from scipy.spatial import cKDTree

    tree = cKDTree(rays)
    score, mirror, patch = 0.0, np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    for k in range(_ROUNDS):
        reach = size * max(0.25, 0.9 * 0.6**k)
        found = tree.query(ways @ turned)
        distance, nearest = as_float(found[0]), np.asarray(found[1], dtype=np.intp)
        close = np.flatnonzero(distance < reach)
        # A patch belongs to the mirror that is nearest to it.
        order = close[np.argsort(distance[close])]
        _, first = np.unique(nearest[order], return_index=True)
        mirror = order[first]
        patch = nearest[mirror]
        score = float(np.sum(np.exp(-0.5 * (distance[mirror] / (0.12 * size[mirror])) ** 2)))
        if len(mirror) < 3:
            break
        u, _, vt = np.linalg.svd(ways[mirror].T @ rays[patch])
        turned = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return score, turned, mirror, patch


def _believe(
    tried: list[Tried],
    photo: Photo,
    camera: LedCamera,
    stand: Standing,
    rows: npt.NDArray[np.intp],
    patches: int,
) -> Identified:
    none = np.empty(0, dtype=np.intp)
    ranked: list[tuple[float, int, Tried]] = []
    for one in tried:
        angle = rotation_angle(one[1], photo.rotation)
        if angle > 2.0 * GIMBAL or len(one[2]) < FEWEST:
            continue
        pixels = photo.moved(photo.position, one[1]).pixels(camera, stand.vertex[rows])
        inside = int(((pixels > 0) & (pixels < np.array(camera.size) - 1)).all(axis=-1).sum())
        # What should be there and is not, and what is there and should not be.
        absent, strange = max(inside - len(one[2]), 0), patches - len(one[2])
        usual = 0.5 * (angle / USUAL_GIMBAL) ** 2
        ranked.append((one[0] - 0.5 * (absent + strange) - usual, inside, one))
    if not ranked:
        text = "nothing: no mirrors of the field lie on its patches"
        return Identified(photo.rotation, none, none, text)
    ranked.sort(key=lambda r: -r[0])
    merit, inside, (score, turned, mirror, patch) = ranked[0]
    if score < LEAST_SHARE * inside:
        text = (
            f"wrong_field: {len(mirror)} patches lie on the {inside} mirrors of the field that "
            "should be in it; is it another field, or were other commands given?"
        )
        return Identified(photo.rotation, none, none, text)
    named = set(zip(patch.tolist(), mirror.tolist(), strict=True))
    for other_merit, _, other in ranked[1:]:
        same = named & set(zip(other[3].tolist(), other[2].tolist(), strict=True))
        if len(same) < 0.5 * len(other[2]) and other_merit > merit - max(MARGIN, 0.03 * score):
            text = (
                f"ambiguous: {len(other[2])} mirrors fit if the camera looked elsewhere, "
                f"{len(mirror)} as it is; the gimbal must be known better, or more of the field "
                "be seen"
            )
            return Identified(photo.rotation, none, none, text)
    return Identified(as_float(turned), rows[mirror], patch)


def rotation_angle(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotations (3, 3), rad."""
    return float(np.arccos(np.clip(0.5 * (np.trace(a @ b.T) - 1.0), -1.0, 1.0)))
