"""Identify mirrors by projecting the field into a photograph and matching it with the patches.

The position of a photograph is known to centimetres and its attitude to about a degree, so only a
small rotation is unknown. It is found by voting: each pair of a patch and an expected mirror votes
for the shift between the two, at several rotations about the line of sight. The best few shifts are
refined by solving Wahba's problem on the pairs that are then close together. The best solution has
the most close matches and the fewest unmatched mirrors and patches. If another solution that
identifies the mirrors differently is nearly as good, neither of the two is trusted.

On a moonless night only the lamp is visible. A mirror in its commanded pose shows the lamp at the
foot of the perpendicular from the drone, so these points are matched with the spots instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.detection import Picture, Spots, find_spots
from heliotrope.airborne.photo import LedCamera, Photo, gimbal_of_rotation, rotation_of_gimbal
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.field.camera import undistort
from heliotrope.geometry import FloatArray, as_float, rotation

Rows = npt.NDArray[np.intp]

#: Largest gimbal error that is searched, rad.
GIMBAL = float(np.radians(4.0))
#: Largest gimbal error that is searched if the mirrors fit badly, rad. The rows of a field are
#: nearly periodic, so a field shifted by one row may seem to fit although the gimbal error is
#: larger.
FAR_GIMBAL = float(np.radians(12.0))
#: A solution fits badly if the RMS distance of patches from mirrors exceeds the first value, in
#: mirror sides, or if a smaller fraction of mirrors and patches matches than the next. It is not
#: trusted beyond the second distance, nor if this fraction of both mirrors and patches is left
#: over, as with a shifted field. Rendered photographs have distances of 0.01 to 0.05, shifted
#: fields 0.03 to 0.17 with 60 to 85 % matched.
_BAD_FIT, _WORST_FIT, _GOOD_SHARE, _LEFT = 0.06, 0.08, 0.92, 0.1
#: Minimum number of mirrors that must match, and their minimum fraction of the mirrors expected in
#: the frame.
FEWEST, LEAST_SHARE = 4, 0.4
#: The best solution must explain this many more mirrors and patches than any other.
MARGIN = 4.0
#: Typical gimbal error, rad; one such standard deviation counts as much as half a mirror.
USUAL_GIMBAL = float(np.radians(1.5))
#: A photograph is dark if its median reading is below this.
DARK_READING = 25
#: More lights than this in a dark photograph are not reflections of the lamp.
_MOST_LIGHTS = 5000
#: Distance from its mirror at which a light may appear before the camera attitude is known, m.
BESIDE = 0.5
_TURNS, _CANDIDATES, _ROUNDS = 17, 10, 6


@dataclass(frozen=True)
class Identified:
    """The mirrors in a photograph.

    Attributes
    ----------
    rotation
        Camera axes to ENU, (3, 3).
    mirror, patch
        Index pairs of a mirror and a patch, (K,).
    reason
        Why no solution is trusted; an empty string if one is.
    shifted
        Whether the apparent fit is that of a shifted field. A drawing laid over the photograph
        would then seem to fit in the same wrong position.
    """

    rotation: FloatArray
    mirror: Rows
    patch: Rows
    reason: str = ""
    shifted: bool = False


def expected_size(
    camera: LedCamera, photo: Photo, stand: MirrorPoses, gimbal: float = GIMBAL
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return the apparent sides of mirrors, px, and a mask of those that may be in the frame, (M,).

    The side is the square root of the area. A mirror may be in the frame if a gimbal error can
    bring it there.
    """
    local = (stand.corners - photo.position) @ photo.rotation
    depth = local[..., 2]
    safe = np.where(depth > 0.1, depth, np.nan)
    plane = local[..., :2] / safe[..., None]
    area = quad_area(plane)
    front = np.sum((photo.position - stand.vertex) * stand.rotation[:, :, 2], axis=-1) > 0.0
    width, height = camera.size
    limit = np.array([width, height]) / (2.0 * camera.focal) * 1.1 + np.tan(gimbal)
    middle = plane.mean(axis=1)
    visible = front & np.isfinite(area) & (np.abs(middle) < limit).all(axis=-1)
    return np.sqrt(np.nan_to_num(area)) * camera.focal, visible


def quad_area(corners: FloatArray) -> FloatArray:
    """Return the areas, (M,), of quadrilaterals (M, 4, 2); NaN where a corner is NaN."""
    ahead = np.roll(corners, -1, axis=1)
    cross = corners[..., 0] * ahead[..., 1] - corners[..., 1] * ahead[..., 0]
    return as_float(0.5 * np.abs(cross.sum(axis=1)))


def nearest_rotation(directions: FloatArray, rays: FloatArray) -> FloatArray:
    """Return the rotation that best turns unit ``rays`` (K, 3) into ``directions`` (K, 3).

    This is Wahba's problem, solved by a singular value decomposition.
    """
    u, _, vt = np.linalg.svd(directions.T @ rays)
    return as_float(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def identify(
    camera: LedCamera,
    photo: Photo,
    stand: MirrorPoses,
    patches: FloatArray,
    *,
    far: bool = True,
) -> Identified:
    """Return the mirrors that the patches show, and the attitude of the camera.

    Parameters
    ----------
    camera
        Lens.
    photo
        The photograph as recorded by the drone.
    stand
        All mirrors in their expected poses.
    patches
        Centres of patches, px, (K, 2).
    far
        Whether to search attitudes up to `FAR_GIMBAL` away if the mirrors fit badly; a clearly
        better fit is accepted.
    """
    none = np.empty(0, dtype=np.intp)
    _, visible = expected_size(camera, photo, stand)
    rows = np.flatnonzero(visible)
    if len(rows) < FEWEST:
        text = (
            f"wrong_field: {len(rows)} mirrors of the field can be in view; check that this is "
            "the right field"
        )
        return Identified(photo.rotation, none, none, text)
    if len(patches) < FEWEST:
        text = f"nothing: only {len(patches)} patches look like mirrors; {FEWEST} are needed"
        return Identified(photo.rotation, none, none, text)
    tried = _search(camera, photo, stand, rows, patches, (photo.rotation,))
    near, fit = _choose(tried, photo, camera, stand, rows, len(patches))
    if not far or (fit is not None and fit.good) or near.reason.startswith("ambiguous"):
        return near
    return _farther(camera, photo, stand, patches, near, fit)


def _search(
    camera: LedCamera,
    photo: Photo,
    stand: MirrorPoses,
    rows: Rows,
    patches: FloatArray,
    about: Sequence[FloatArray],
) -> "list[_Tried]":
    """Return solutions within `GIMBAL` of some attitudes, with mirrors as indices into ``rows``."""
    side, _ = expected_size(camera, photo, stand)
    directions = stand.corners[rows].mean(axis=1) - photo.position
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    plane = undistort(camera, patches)
    rays = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    size = float(np.median(side[rows])) / camera.focal
    return [
        _refine(start, directions, rays, side[rows] / camera.focal)
        for turned in about
        for start in _starts(turned, directions, plane, size)
    ]


def _farther(
    camera: LedCamera,
    photo: Photo,
    stand: MirrorPoses,
    patches: FloatArray,
    near: Identified,
    fit: "_Fit | None",
) -> Identified:
    """Return an attitude far from the gimbal's if it fits clearly better than one near it."""
    none = np.empty(0, dtype=np.intp)
    _, visible = expected_size(camera, photo, stand, FAR_GIMBAL)
    rows = np.flatnonzero(visible)
    yaw, pitch, roll = gimbal_of_rotation(photo.rotation)
    step = 2.0 * GIMBAL
    about = [
        rotation_of_gimbal(yaw + i * step, pitch + j * step, roll)
        for i in (-1, 0, 1)
        for j in (-1, 0, 1)
        if i or j
    ]
    tried = _search(camera, photo, stand, rows, patches, about)
    ranked = _ranked(tried, photo, camera, stand, rows, len(patches), FAR_GIMBAL)
    best = max(ranked, key=lambda r: r.evidence, default=None)
    others = [r.evidence for r in ranked if best is not None and best.differs(r)]
    competing = [0.0 if fit is None else fit.evidence, *others]
    if best is not None and best.good and best.evidence > max(competing) + MARGIN:
        solution = best.solution
        return Identified(as_float(solution.rotation), rows[solution.mirror], solution.patch)
    if fit is None:
        return near
    better = best is not None and best.evidence > fit.evidence + MARGIN
    if better or fit.apart > _WORST_FIT or fit.unmatched > _LEFT:
        text = (
            f"ambiguous: {len(fit.solution.mirror)} mirrors match badly, {100 * fit.apart:.0f} % "
            f"of a side apart and {100 * fit.matched:.0f} % of all; the gimbal may be more than "
            f"{np.degrees(GIMBAL):.0f}° off; check the gimbal angles"
        )
        return Identified(photo.rotation, none, none, text, shifted=True)
    return near


@dataclass(frozen=True)
class _Tried:
    """A solution: an attitude, pairs of a mirror and a patch, and how well they fit.

    ``apart`` is the RMS distance of the patches from their mirrors, in mirror sides.
    """

    score: float
    apart: float
    rotation: FloatArray
    mirror: Rows
    patch: Rows


def _starts(
    turned: FloatArray, directions: FloatArray, plane: FloatArray, size: float
) -> list[FloatArray]:
    """Return the rotations with the most votes."""
    from scipy.ndimage import uniform_filter

    local = directions @ turned
    reach = np.tan(GIMBAL) * 1.2
    cells = int(np.clip(2.0 * reach / (0.35 * size), 16, 400))
    ranked: list[tuple[float, FloatArray]] = []
    for turn in np.linspace(-GIMBAL, GIMBAL, _TURNS):
        spun = local @ rotation([0.0, 0.0, 1.0], turn)
        projected = spun[:, :2] / spun[:, 2:]
        shift = (plane[:, None] - projected[None]).reshape(-1, 2)
        votes, *_ = np.histogram2d(
            shift[:, 0], shift[:, 1], bins=cells, range=[[-reach, reach]] * 2
        )
        votes = uniform_filter(votes, 3, mode="constant")
        for _ in range(3):
            i, j = np.unravel_index(int(np.argmax(votes)), votes.shape)
            x, y = ((np.array([i, j]) + 0.5) / cells * 2.0 - 1.0) * reach
            # To shift the image by (x, y), the camera rotates about its down and right axes.
            move = rotation([0.0, 1.0, 0.0], x) @ rotation([1.0, 0.0, 0.0], -y)
            total = turned @ rotation([0.0, 0.0, 1.0], turn) @ move.T
            ranked.append((float(votes[i, j]), total))
            votes[max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3] = 0.0
    ranked.sort(key=lambda f: -f[0])
    # Neighbouring rotations vote for the same solution, so keep only distinct ones.
    apart = max(0.7 * size, 2.2 * GIMBAL / (_TURNS - 1))
    kept: list[FloatArray] = []
    for _, start in ranked:
        if len(kept) < _CANDIDATES and all(rotation_angle(start, k) > apart for k in kept):
            kept.append(start)
    return kept


def _refine(
    turned: FloatArray, directions: FloatArray, rays: FloatArray, size: FloatArray
) -> _Tried:
    """Return the solution that a start converges to."""
    from scipy.spatial import cKDTree

    tree = cKDTree(rays)
    score, apart = 0.0, np.inf
    mirror, patch = np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    for k in range(_ROUNDS):
        reach = size * max(0.25, 0.9 * 0.6**k)
        neighbours = tree.query(directions @ turned)
        distance, nearest = as_float(neighbours[0]), np.asarray(neighbours[1], dtype=np.intp)
        close = np.flatnonzero(distance < reach)
        # A patch belongs to the mirror nearest to it.
        order = close[np.argsort(distance[close])]
        _, first = np.unique(nearest[order], return_index=True)
        mirror = order[first]
        patch = nearest[mirror]
        away = distance[mirror] / size[mirror]
        score = float(np.sum(np.exp(-0.5 * (away / 0.12) ** 2)))
        if len(mirror) < 3:
            break
        apart = float(np.sqrt(np.mean(away**2)))
        turned = nearest_rotation(directions[mirror], rays[patch])
    return _Tried(score, apart, turned, mirror, patch)


@dataclass(frozen=True)
class _Fit:
    """A solution and its quality of fit.

    Attributes
    ----------
    one
        The solution.
    merit, evidence
        Number of closely matching mirrors minus unmatched mirrors and patches, with and without the
        penalty for an unusual gimbal angle.
    inside
        Mirrors that should be in the frame.
    matched
        Fraction of these mirrors, or of the patches, that match, whichever is smaller.
    left
        Unmatched mirrors or unmatched patches, whichever are fewer, divided by the number of pairs.
    apart
        RMS distance of patches from their mirrors, in mirror sides.
    """

    solution: _Tried
    merit: float
    evidence: float
    inside: int
    matched: float
    unmatched: float
    apart: float

    @property
    def good(self) -> bool:
        """Whether the fit is good enough that no other attitude need be searched."""
        return self.apart < _BAD_FIT and self.matched > _GOOD_SHARE

    def differs(self, other: "_Fit") -> bool:
        """Return whether another solution assigns different names to most mirrors."""
        pairs = [
            set(zip(f.solution.patch.tolist(), f.solution.mirror.tolist(), strict=True))
            for f in (self, other)
        ]
        return len(pairs[0] & pairs[1]) < 0.5 * len(other.solution.mirror)


def _ranked(
    tried: "list[_Tried]",
    photo: Photo,
    camera: LedCamera,
    stand: MirrorPoses,
    rows: Rows,
    patches: int,
    most: float,
) -> list[_Fit]:
    """Return the solutions within the angle ``most`` of the gimbal attitude, the best first."""
    fits = []
    for solution in tried:
        angle = rotation_angle(solution.rotation, photo.rotation)
        matched = len(solution.mirror)
        if angle > most or matched < FEWEST:
            continue
        pixels = photo.moved(photo.position, solution.rotation).pixels(camera, stand.vertex[rows])
        inside = int(((pixels > 0) & (pixels < np.array(camera.size) - 1)).all(axis=-1).sum())
        # Count mirrors without a patch, and patches without a mirror.
        absent, surplus = max(inside - matched, 0), patches - matched
        usual = 0.5 * (angle / USUAL_GIMBAL) ** 2
        evidence = solution.score - 0.5 * (absent + surplus)
        share = matched / max(inside, patches, 1)
        unmatched = min(absent, surplus) / matched
        fits.append(
            _Fit(solution, evidence - usual, evidence, inside, share, unmatched, solution.apart)
        )
    return sorted(fits, key=lambda f: -f.merit)


def _choose(
    tried: list[_Tried],
    photo: Photo,
    camera: LedCamera,
    stand: MirrorPoses,
    rows: Rows,
    patches: int,
) -> tuple[Identified, _Fit | None]:
    """Return the best solution and its fit, or the reason why it is not trusted."""
    none = np.empty(0, dtype=np.intp)
    ranked = _ranked(tried, photo, camera, stand, rows, patches, 2.0 * GIMBAL)
    if not ranked:
        text = "nothing: no mirrors of the field match its patches"
        return Identified(photo.rotation, none, none, text), None
    best = ranked[0].solution
    if best.score < LEAST_SHARE * ranked[0].inside:
        text = (
            f"wrong_field: {len(best.mirror)} patches match the {ranked[0].inside} mirrors of the "
            "field that should be in it; check the field, the commands, and the gimbal angles "
            f"(errors of up to {np.degrees(GIMBAL):.0f}° are corrected)"
        )
        return Identified(photo.rotation, none, none, text), None
    for other in ranked[1:]:
        close = other.merit > ranked[0].merit - max(MARGIN, 0.03 * best.score)
        if ranked[0].differs(other) and close:
            text = (
                f"ambiguous: {len(other.solution.mirror)} mirrors match if the camera pointed "
                f"elsewhere, {len(best.mirror)} with the recorded angles; record the gimbal "
                "more accurately or photograph more of the field"
            )
            return Identified(photo.rotation, none, none, text), None
    return Identified(as_float(best.rotation), rows[best.mirror], best.patch), ranked[0]


def rotation_angle(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotations (3, 3), rad."""
    return float(np.arccos(np.clip(0.5 * (np.trace(a @ b.T) - 1.0), -1.0, 1.0)))


# -- in the dark -----------------------------------------------------------------------


def is_dark(picture: Picture) -> bool:
    """Return whether only lights are visible in a picture."""
    return bool(np.median(picture[::8, ::8]) < DARK_READING)


def expected_feet(photo: Photo, camera: LedCamera, stand: MirrorPoses) -> tuple[FloatArray, Rows]:
    """Return where mirrors in expected poses show the lamp, (K, 3), and mirror indices, (K,)."""
    between = photo.position + 0.5 * (photo.led_position(camera) - photo.position)
    local = np.einsum("nji,nj->ni", stand.rotation, between - stand.vertex)
    half = 0.5 * np.ptp(stand.outline[..., :2], axis=1)
    on = (np.abs(local[:, :2]) < half + BESIDE).all(axis=1) & (local[:, 2] > 0.0)
    rows = np.flatnonzero(on)
    flat = np.pad(local[rows, :2], ((0, 0), (0, 1)))
    return stand.vertex[rows] + np.einsum("nij,nj->ni", stand.rotation[rows], flat), rows


def find_lights(
    picture: Picture, photo: Photo, camera: LedCamera, stand: MirrorPoses
) -> tuple[Identified, Spots]:
    """Return the camera attitude, and the spots with their mirrors as indices into ``stand``.

    Spots that lie on no mirror are left out.
    """
    width, height = camera.size
    frame = np.array([(3, 3), (width - 4, 3), (width - 4, height - 4), (3, height - 4)], np.float64)
    spots, _ = find_spots(picture, frame[None], most=_MOST_LIGHTS)
    feet, rows = expected_feet(photo, camera, stand)
    none = np.empty(0, dtype=np.intp)
    identified = Identified(photo.rotation, none, none)
    if len(spots) < FEWEST:
        text = (
            f"nothing: the photograph is dark and shows only {len(spots)} lights; {FEWEST} are "
            "needed"
        )
        return replace(identified, reason=text), spots
    if not photo.by_hand:
        identified = identify(
            camera, photo, replace(stand.take(rows), vertex=feet), spots.pixel, far=False
        )
    if identified.reason:
        text = (
            f"ambiguous: the photograph is dark, and its {len(spots)} lights cannot be assigned "
            "to mirrors; check the field and the commands"
        )
        return replace(identified, reason=text), spots
    mirror = _mirrors_of(undistort(camera, spots.pixel), photo, identified.rotation, stand)
    kept = mirror >= 0
    named = Spots(
        mirror[kept], spots.pixel[kept], spots.sigma[kept], spots.flux[kept], spots.clipped[kept]
    )
    return replace(identified, mirror=rows[identified.mirror]), named


def _mirrors_of(plane: FloatArray, photo: Photo, turn: FloatArray, stand: MirrorPoses) -> Rows:
    """Return the index of the mirror on which each light lies; -1 if it lies on none."""
    directions = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1) @ turn.T
    start = np.einsum("nji,nj->ni", stand.rotation, photo.position - stand.vertex)
    local = np.einsum("nji,sj->sni", stand.rotation, directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        length = -start[:, 2] / local[..., 2]
        at = start[:, :2] + length[..., None] * local[..., :2]
    half = 0.5 * np.ptp(stand.outline[..., :2], axis=1)
    off = np.where(length > 0.0, np.max(np.abs(at) - half, axis=-1), np.inf)
    nearest = np.argmin(np.where(np.isfinite(off), off, np.inf), axis=1)
    # The attitude is known only to a few milliradians, so lights this far beside the mirror are
    # allowed.
    inside = off[np.arange(len(plane)), nearest] < BESIDE
    return np.where(inside, nearest, -1).astype(np.intp)
