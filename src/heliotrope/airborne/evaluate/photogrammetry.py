r"""Locate photographs of coded targets from the images alone.

This is a bundle adjustment with free points. Its unknowns are the rotation φ and the position p of
each photograph, each corner X of each target, and the errors of the camera file (focal lengths,
principal point, distortion). A corner is seen at OpenCV's projection of $(R e^{[φ]})^T (X - p)$.
Images do not determine the position, rotation and scale of the whole scene, so RTK positions
constrain these loosely. `compared` then fits the result to the RTK positions by a similarity
transform, as in HelioPoint's appendix A; the residuals are the errors of RTK and of the
photogrammetry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.coded import SeenTargets
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.errors import InputError
from heliotrope.field.camera import undistort
from heliotrope.geometry import FloatArray, as_float, cross_matrix, rotation

if TYPE_CHECKING:
    from scipy.sparse import csc_array

#: Minimum numbers of photographs and of targets in an adjustment, and of targets in a photograph.
FEWEST_PHOTOS, FEWEST_TARGETS, FEWEST_OF_PHOTO = 8, 4, 3
#: Standard deviations before the adjustment: RTK positions, m (the size and position of the whole
#: scene are known to this value divided by the square root of the number of photographs); relative
#: focal lengths; principal point, px; k1, k2, p1, p2, k3.
_LOOSE, _FOCAL, _CENTER = 1.0, 0.01, 20.0
_DISTORTION = np.array([0.05, 0.1, 0.005, 0.005, 0.1])
_LENS = 9
#: Residuals beyond this many standard deviations receive less weight.
_HUBER = 2.5
_MOST_ROUNDS, _STILL = 40, 1e-7


@dataclass(frozen=True)
class Sights:
    """K corners of targets seen in photographs.

    Attributes
    ----------
    photo, point
        Indices, (K,).
    pixel
        (K, 2).
    sigma
        Standard deviation of each coordinate, px, (K,).
    """

    photo: npt.NDArray[np.intp]
    point: npt.NDArray[np.intp]
    pixel: FloatArray
    sigma: FloatArray

    def __len__(self) -> int:
        return len(self.photo)


@dataclass(frozen=True)
class Photogrammetry:
    """The result of an adjustment of P photographs and Q corners.

    Attributes
    ----------
    position, rotation
        Positions and attitudes of the photographs, ENU metres, (P, 3), and (P, 3, 3).
    points
        Corners of the targets, ENU metres, (Q, 3).
    camera
        The camera with the lens that the images show.
    covariance
        Covariance of the positions relative to each other, after the best similarity transform, m²,
        (3P, 3P).
    deviation
        RMS of the residuals in units of their standard deviations; 1 if the standard deviations are
        right.
    sights
        Corners used.
    """

    position: FloatArray
    rotation: FloatArray
    points: FloatArray
    camera: LedCamera
    covariance: FloatArray
    deviation: float
    sights: Sights

    @property
    def position_sigma(self) -> FloatArray:
        """Standard deviations of the positions relative to each other, m, (P, 3)."""
        return as_float(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).reshape(-1, 3))


def usable(targets: Sequence[SeenTargets]) -> tuple[list[int], dict[int, str]]:
    """Return the usable photographs by index, and why the other photographs cannot be used.

    Targets visible in fewer than two photographs do not count.
    """
    number = np.concatenate([s.number for s in targets]) if targets else np.empty(0, np.intp)
    shared = np.flatnonzero(np.bincount(number, minlength=1) >= 2)
    good, unusable = [], {}
    for k, shown in enumerate(targets):
        count = int(np.isin(shown.number, shared).sum())
        if count >= FEWEST_OF_PHOTO:
            good.append(k)
        else:
            unusable[k] = shown.problem or (
                f"it shows only {count} targets that other photographs also show; "
                f"{FEWEST_OF_PHOTO} are needed"
            )
    return good, unusable


def locate(
    photos: Sequence[Photo], targets: Sequence[SeenTargets], camera: LedCamera
) -> Photogrammetry:
    """Locate photographs from the targets that they show.

    Parameters
    ----------
    photos, targets
        Photographs as recorded, and the targets in each photograph; all must be usable.
    camera
        Lens as stated in the camera file.

    Raises
    ------
    InputError
        If there are too few photographs or targets, or the adjustment does not converge.
    """
    if len(photos) < FEWEST_PHOTOS:
        raise InputError(
            f"{len(photos)} photographs show coded targets; {FEWEST_PHOTOS} are needed: fly a "
            "dome over them (heliotrope drone dome)"
        )
    sights, numbers = _sights(targets)
    if len(numbers) < FEWEST_TARGETS:
        raise InputError(
            f"{len(numbers)} coded targets are seen in two photographs or more; {FEWEST_TARGETS} "
            "are needed: lay out more"
        )
    state = _start(photos, sights, camera, 4 * len(numbers))
    return _result(*_adjusted(state, photos, camera, sights))


def _sights(targets: Sequence[SeenTargets]) -> tuple[Sights, npt.NDArray[np.intp]]:
    number = np.concatenate([s.number for s in targets])
    numbers = np.flatnonzero(np.bincount(number) >= 2)
    parts = []
    for k, shown in enumerate(targets):
        rows = np.flatnonzero(np.isin(shown.number, numbers))
        first = 4 * np.searchsorted(numbers, shown.number[rows])
        parts.append(
            (
                np.full(4 * len(rows), k),
                (first[:, None] + np.arange(4)).reshape(-1),
                shown.corners[rows].reshape(-1, 2),
                np.repeat(shown.sigma[rows], 4),
            )
        )
    photo, point, pixel, sigma = (np.concatenate(p) for p in zip(*parts, strict=True))
    return Sights(photo, point, as_float(pixel), as_float(sigma)), numbers


@dataclass(frozen=True)
class _State:
    position: FloatArray
    rotation: FloatArray
    points: FloatArray
    lens: FloatArray


def _start(photos: Sequence[Photo], sights: Sights, camera: LedCamera, points: int) -> _State:
    """Return the recorded poses, and the points nearest to the rays from these poses."""
    position = as_float([p.position for p in photos])
    turned = as_float([p.rotation for p in photos])
    plane = undistort(camera, sights.pixel)
    ray = np.concatenate([plane, np.ones((len(plane), 1))], axis=-1)
    ray = np.einsum("kij,kj->ki", turned[sights.photo], ray)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
    left, right = np.zeros((points, 3, 3)), np.zeros((points, 3))
    np.add.at(left, sights.point, across)
    np.add.at(right, sights.point, np.einsum("kij,kj->ki", across, position[sights.photo]))
    nearest = np.linalg.solve(left, right[..., None])[..., 0]
    m = camera.matrix
    lens = np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *camera.distortion])
    return _State(position, turned, as_float(nearest), lens)


def _projected(state: _State, sights: Sights) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return pixels (K, 2) and their derivatives with respect to φ, p and X, and to the lens."""
    import cv2

    local = np.einsum(
        "kji,kj->ki",
        state.rotation[sights.photo],
        state.points[sights.point] - state.position[sights.photo],
    )
    fx, fy, cx, cy = state.lens[:4]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    zero = np.zeros(3)
    pixel, slope = cv2.projectPoints(local[:, None], zero, zero, matrix, state.lens[4:])
    slope = slope.reshape(len(local), 2, -1)
    by_local, by_lens = slope[..., 3:6], slope[..., 6:15]
    moved = by_local @ np.swapaxes(state.rotation[sights.photo], -1, -2)
    by_pose = np.concatenate([by_local @ cross_matrix(local), -moved, moved], axis=-1)
    return as_float(pixel.reshape(-1, 2)), as_float(by_pose), as_float(by_lens)


def _adjusted(
    state: _State, photos: Sequence[Photo], camera: LedCamera, sights: Sights
) -> tuple[_State, Photogrammetry, FloatArray]:
    """Return the adjusted unknowns, the result without covariance, and the normal matrix."""
    from scipy.linalg import cho_factor, cho_solve

    known, size = state, 6 * len(photos) + len(state.points) * 3 + _LENS
    sigma_lens = np.concatenate([_FOCAL * known.lens[:2], np.full(2, _CENTER), _DISTORTION])
    lens = slice(size - _LENS, size)
    for _ in range(_MOST_ROUNDS):
        pixel, by_pose, by_lens = _projected(state, sights)
        gap = sights.pixel - pixel
        scaled = np.linalg.norm(gap, axis=-1) / sights.sigma
        # The start is accurate only to decimetres, so reject no outliers in the first step.
        limit = max(_HUBER, 3.0 * float(np.median(scaled)))
        weight = np.minimum(1.0, limit / np.maximum(scaled, 1e-9)) / sights.sigma**2
        jacobian = _jacobian(by_pose, by_lens, sights, len(photos), size)
        rows = np.repeat(weight, 2)
        normal = as_float((jacobian.T @ jacobian.multiply(rows[:, None])).toarray())
        right = jacobian.T @ (rows * gap.reshape(-1))
        position = np.arange(3 * len(photos)).reshape(-1, 3)
        own = (6 * (position // 3) + 3 + position % 3).reshape(-1)
        normal[own, own] += 1.0 / _LOOSE**2
        right[own] += (known.position - state.position).reshape(-1) / _LOOSE**2
        normal[lens, lens] += np.diag(1.0 / sigma_lens**2)
        right[lens] += (known.lens - state.lens) / sigma_lens**2
        step = cho_solve(cho_factor(normal), right)
        state = _moved(state, step)
        if np.abs(step[: lens.start]).max() < _STILL:
            break
    else:
        raise InputError(
            f"the photogrammetry of {len(photos)} photographs does not converge; check that "
            "camera.toml is the file of this camera, and that no target number occurs twice"
        )
    kept = scaled < 4.0
    freedom = max(2 * int(kept.sum()) - size + 7, 1)
    deviation = float(np.sqrt(np.sum((gap[kept] / sights.sigma[kept, None]) ** 2) / freedom))
    fx, fy, cx, cy = state.lens[:4]
    lens_found = replace(
        camera,
        matrix=np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        distortion=state.lens[4:],
    )
    made = Photogrammetry(
        state.position, state.rotation, state.points, lens_found, np.empty((0, 0)), deviation,
        sights,
    )  # fmt: skip
    return state, made, normal


def _jacobian(
    by_pose: FloatArray, by_lens: FloatArray, sights: Sights, photos: int, size: int
) -> "csc_array":
    from scipy.sparse import csc_array

    count = len(sights)
    columns = np.concatenate(
        [
            6 * sights.photo[:, None] + np.arange(6),
            6 * photos + 3 * sights.point[:, None] + np.arange(3),
            np.broadcast_to(size - _LENS + np.arange(_LENS), (count, _LENS)),
        ],
        axis=-1,
    )
    values = np.concatenate([by_pose, by_lens], axis=-1)
    rows = np.arange(2 * count).reshape(count, 2, 1)
    row, column = (np.broadcast_to(at, values.shape).ravel() for at in (rows, columns[:, None]))
    return csc_array((values.ravel(), (row, column)), shape=(2 * count, size))


def _moved(state: _State, step: FloatArray) -> _State:
    photos = len(state.position)
    own = step[: 6 * photos].reshape(-1, 6)
    turn = own[:, :3]
    return _State(
        state.position + own[:, 3:],
        state.rotation @ rotation(turn, np.linalg.norm(turn, axis=-1)),
        state.points + step[6 * photos : -_LENS].reshape(-1, 3),
        state.lens + step[-_LENS:],
    )


def _result(state: _State, made: Photogrammetry, normal: FloatArray) -> Photogrammetry:
    """Return the result with the covariance of its positions relative to each other."""
    from scipy.linalg import cho_factor, cho_solve

    photos = len(state.position)
    place = (6 * np.arange(photos)[:, None] + 3 + np.arange(3)).reshape(-1)
    unit = np.zeros((len(normal), 3 * photos))
    unit[place, np.arange(3 * photos)] = 1.0
    whole = cho_solve(cho_factor(normal), unit)[place]
    free = relative(state.position)
    covariance = free @ whole @ free.T * max(made.deviation, 0.1) ** 2
    return replace(made, covariance=as_float(covariance))


def relative(position: FloatArray) -> FloatArray:
    """Return the matrix (3P, 3P) that removes the best similarity transform of displacements.

    What remains of P displacements is the part that no common shift (3), rotation (3) or scale (1)
    explains.
    """
    away = position - position.mean(axis=0)
    modes = np.concatenate(
        [np.tile(np.eye(3), (len(away), 1)), cross_matrix(away).reshape(-1, 3),
         away.reshape(-1, 1)], axis=1,
    )  # fmt: skip
    base, _ = np.linalg.qr(modes)
    return as_float(np.eye(3 * len(away)) - base @ base.T)


def compared(recorded: FloatArray, adjusted: FloatArray) -> tuple[FloatArray, float]:
    """Return recorded minus adjusted positions after a similarity fit, (P, 3), and its scale.

    The adjusted positions (P, 3) are fitted to the recorded positions (Umeyama 1991).
    """
    a, b = adjusted - adjusted.mean(axis=0), recorded - recorded.mean(axis=0)
    u, size, vt = np.linalg.svd(b.T @ a)
    mirror = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    turned = u @ np.diag(mirror) @ vt
    scale = float(np.sum(size * mirror) / np.sum(a**2))
    return as_float(b - scale * a @ turned.T), scale
