"""Map a plane with targets to one frame (a view), with the covariance of the mapping."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera, distort, project, undistort
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray

#: Standard deviation of k1 for an unknown lens whose focal length equals the frame's longer side.
#: Photographic lenses have less distortion.
LENS_DEVIATION = 0.1
#: Minimum error of a located camera as a whole, and of single points due to its lens, px.
_TURNED, _FITTED = 0.33, 0.1


@dataclass(frozen=True)
class Face:
    """A plane with one or more targets on it.

    Attributes
    ----------
    targets
        Targets, each within some centimetres of the plane.
    origin
        ENU metres, (3,).
    axes
        Unit axes to the right as seen from the front, and up, (2, 3).
    """

    targets: tuple[Target, ...]
    origin: FloatArray
    axes: FloatArray

    def plane(self, points: npt.ArrayLike) -> FloatArray:
        """Return positions right of and above the origin, m, (..., 2), of ENU points (..., 3)."""
        return np.asarray((np.asarray(points, dtype=np.float64) - self.origin) @ self.axes.T)

    def point(self, plane: npt.ArrayLike) -> FloatArray:
        """Return ENU points (..., 3) of positions in the plane (..., 2)."""
        return self.origin + np.asarray(plane, dtype=np.float64) @ self.axes

    @property
    def span(self) -> FloatArray:
        """Smallest and largest plane coordinates of the target corners, m, (2, 2)."""
        corners = self.plane(np.concatenate([t.corners for t in self.targets]))
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def faces(targets: tuple[Target, ...], apart: float = 0.25) -> list[Face]:
    """Return targets grouped by plane.

    Parameters
    ----------
    targets
        Targets of a plant.
    apart
        Largest distance of a corner from its plane, m.
    """
    groups: list[list[Target]] = []
    for target in targets:
        for group in groups:
            first = group[0]
            depth = np.abs((target.corners - first.center) @ first.normal)
            # Targets of two towers may lie in one plane by chance.
            near = any(_meet(target, other) for other in group)
            if depth.max() < apart and near and float(target.normal @ first.normal) > 0.98:
                group.append(target)
                break
        else:
            groups.append([target])
    result = []
    for group in groups:
        origin = np.mean([t.center for t in group], axis=0)
        result.append(Face(tuple(group), origin, group[0].axes))
    return result


def _meet(a: Target, b: Target) -> bool:
    """Return whether two targets of a plane are closer than a quarter of their size."""
    corners, others = a.plane_coordinates(a.corners), a.plane_coordinates(b.corners)
    gap = np.maximum(
        others.min(axis=0) - corners.max(axis=0), corners.min(axis=0) - others.max(axis=0)
    )
    size = max(a.width, a.height, b.width, b.height)
    return float(np.linalg.norm(np.maximum(gap, 0.0))) < 0.25 * size


@dataclass(frozen=True)
class FaceView:
    """How a face lies in a frame.

    Attributes
    ----------
    face
        The plane.
    lens
        Focal length and distortion, known or estimated together with the view.
    H_norm_plane
        Homography from plane metres to undistorted x/z, y/z, (3, 3).
    covariance
        Covariance of the eight free parameters of the homography and of k1, (9, 9), in the scaled
        coordinates of `fit_view`.
    residual
        RMS of the point residuals, pixels.
    """

    face: Face
    lens: Camera
    H_norm_plane: FloatArray
    covariance: FloatArray
    residual: float

    def to_pixels(self, plane: npt.ArrayLike) -> FloatArray:
        """Return pixels (..., 2) for positions in the plane (..., 2), m."""
        place = np.asarray(plane, dtype=np.float64)
        return distort(self.lens, _apply(self.H_norm_plane, place))

    def to_plane(self, pixels: npt.ArrayLike) -> FloatArray:
        """Return positions in the plane (..., 2), m, for pixels (..., 2)."""
        inverse = np.asarray(np.linalg.inv(self.H_norm_plane), dtype=np.float64)
        return _apply(inverse, undistort(self.lens, pixels))

    def scale(self, plane: npt.ArrayLike) -> FloatArray:
        """Return d(pixel)/d(plane), pixels per metre, (..., 2, 2)."""
        place = np.asarray(plane, dtype=np.float64)
        step = 1e-3
        sides = [
            (self.to_pixels(place + step * e) - self.to_pixels(place - step * e)) / (2.0 * step)
            for e in np.eye(2)
        ]
        return np.stack(sides, axis=-1)

    def covariance_at(self, plane: npt.ArrayLike) -> FloatArray:
        """Return the covariance, m², (2, 2), of the position seen at a given pixel.

        The covariance includes only the errors of the view, that is, of the marks, their survey and
        the lens.
        """
        place = np.asarray(plane, dtype=np.float64)
        numbers = _numbers(self.face, self.H_norm_plane, self.lens)
        J = _slopes(lambda p: _predict(self.face, self.lens, p, place[None])[..., 0, :], numbers)
        moved = np.linalg.solve(self.scale(place), J)
        return np.asarray(moved @ self.covariance @ moved.T)


def unknown_lens(size: tuple[int, int]) -> Camera:
    """Return a camera of which only the frame size is known, without distortion."""
    focal = float(max(size))
    matrix = np.array(
        [[focal, 0.0, 0.5 * (size[0] - 1)], [0.0, focal, 0.5 * (size[1] - 1)], [0.0, 0.0, 1.0]]
    )
    return Camera("unknown", size, matrix)


def homography(plane: FloatArray, norm: FloatArray) -> FloatArray:
    """Return the direct linear transform (3, 3) of four or more pairs (N, 2)."""
    middle, scale = plane.mean(axis=0), np.ptp(plane, axis=0).max()
    x, y = ((plane - middle) / scale).T
    u, v = norm.T
    zeros, ones = np.zeros_like(x), np.ones_like(x)
    rows = np.concatenate(
        [
            np.stack([x, y, ones, zeros, zeros, zeros, -u * x, -u * y, -u], axis=-1),
            np.stack([zeros, zeros, zeros, x, y, ones, -v * x, -v * y, -v], axis=-1),
        ]
    )
    H = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    shift = np.array([[1.0, 0.0, -middle[0]], [0.0, 1.0, -middle[1]], [0.0, 0.0, scale]])
    H = H @ shift
    return np.asarray(H / H[2, 2]) if abs(H[2, 2]) > 1e-12 else np.asarray(H)


def fit_view(
    face: Face,
    plane: FloatArray,
    pixels: FloatArray,
    covariance: FloatArray,
    lens: Camera,
    lens_known: bool,
) -> FaceView:
    """Return the view with the highest posterior probability.

    Parameters
    ----------
    face
        The plane.
    plane, pixels
        Points in the plane, m, and their pixels, (N, 2), N ≥ 4.
    covariance
        Covariance of the pixels, including survey errors, either of each pixel, (N, 2, 2), or of
        all pixels jointly, (2N, 2N).
    lens
        Initial lens; unless ``lens_known``, its k1 is estimated with the prior `LENS_DEVIATION`.

    Notes
    -----
    The covariance is scaled by the residuals with the factor (ν + χ²)/(ν + dof), but at least 1.
    Here ν = 4, and dof is the number of observations minus that of the unknowns.
    """
    white = np.linalg.inv(np.linalg.cholesky(covariance))
    # A tiny standard deviation of the prior fixes a known lens without a second code path.
    deviation = LENS_DEVIATION * (1e-4 if lens_known else 1.0)
    prior = lens.distortion[0]

    def residuals(numbers: FloatArray) -> FloatArray:
        miss = _predict(face, lens, numbers, plane) - pixels
        if white.ndim == 2:
            whitened = miss.reshape(*miss.shape[:-2], -1) @ white.T
        else:
            whitened = (white @ miss[..., None]).reshape(*miss.shape[:-2], -1)
        held = (numbers[..., 8:] - prior) / deviation
        return np.concatenate([whitened, held], axis=-1)

    numbers = _numbers(face, homography(plane, undistort(lens, pixels)), lens)
    J, cost = np.empty((0, 9)), np.inf
    for _ in range(20):
        miss, J = residuals(numbers), _slopes(residuals, numbers)
        step = np.linalg.lstsq(J, -miss, rcond=None)[0]
        numbers = numbers + step
        # The start is within a pixel or two, close enough for Gauss-Newton to converge.
        before, cost = cost, float(miss @ miss)
        if before - cost <= 1e-6 * cost:
            break
    end = residuals(numbers)
    chi2 = float(end @ end)
    dof = max(2 * len(plane) - 8 - (0 if lens_known else 1), 0)
    factor = max((4.0 + chi2) / (4.0 + dof), 1.0)
    information = J.T @ J
    H, k1 = _unpack(face, numbers)
    distortion = lens.distortion.copy()
    distortion[0] = float(k1)
    fitted = replace(lens, distortion=distortion)
    miss = distort(fitted, _apply(H, plane)) - pixels
    return FaceView(
        face=face,
        lens=fitted,
        H_norm_plane=H,
        covariance=np.asarray(factor * np.linalg.pinv(information, hermitian=True), np.float64),
        residual=float(np.sqrt(np.mean(np.sum(miss**2, axis=-1)))),
    )


def posed_view(camera: Camera, target: Target) -> FaceView:
    """Return the view of a surface without marks, from the camera pose alone.

    The covariance is that of a rotation of the whole camera by the camera's ``deviation``, but at
    least a third of a pixel.

    Raises
    ------
    InputError
        If the camera has not been located, or the surface is behind it.
    """
    face = faces((target,))[0]
    low, high = face.span
    plane = np.array([(x, y) for y in (0.0, 0.5, 1.0) for x in (0.0, 0.5, 1.0)])
    plane = low + plane * (high - low)
    pixels = project(camera, face.point(plane))
    if not np.isfinite(pixels).all():
        raise InputError(
            f"camera {camera.name}: {target.name} is not in front of it; turn the camera"
        )
    turned = max(camera.deviation, _TURNED) ** 2 * np.tile(np.eye(2), (len(plane), len(plane)))
    return fit_view(
        face, plane, pixels, turned + _FITTED**2 * np.eye(2 * len(plane)), camera, lens_known=True
    )


def _slopes(function: Callable[[FloatArray], FloatArray], numbers: FloatArray) -> FloatArray:
    """Return the derivatives (M, 9) of a function of nine unknowns, by central differences."""
    steps = 1e-6 * np.eye(len(numbers))
    ahead, back = function(numbers + steps), function(numbers - steps)
    return np.asarray(((ahead - back) / 2e-6).T)


def _apply(H: FloatArray, points: FloatArray) -> FloatArray:
    x, y = points[..., 0], points[..., 1]
    w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    return np.stack(
        [
            (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w,
            (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w,
        ],
        axis=-1,
    )


def _scales(face: Face) -> FloatArray:
    """Return divisors that scale plane coordinates to order one."""
    return np.array([1.0, 1.0, 0.0]) * 0.5 * float(np.ptp(face.span, axis=0).max()) + [0, 0, 1]


def _numbers(face: Face, H: FloatArray, lens: Camera) -> FloatArray:
    """Return nine unknowns: H of scaled coordinates, with last element 1, and then k1."""
    scaled = (H / H[2, 2]) * _scales(face)
    return np.append(scaled.ravel()[:8], lens.distortion[0])


def _unpack(face: Face, numbers: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return homographies (..., 3, 3) and k1 (...) of the unknowns (..., 9)."""
    ones = np.ones((*numbers.shape[:-1], 1))
    H = np.concatenate([numbers[..., :8], ones], axis=-1).reshape(*numbers.shape[:-1], 3, 3)
    return np.asarray(H / _scales(face)), np.asarray(numbers[..., 8])


def _predict(face: Face, lens: Camera, numbers: FloatArray, plane: FloatArray) -> FloatArray:
    """Return pixels (..., N, 2) of positions (N, 2) for unknowns (..., 9)."""
    H, k1 = _unpack(face, numbers)
    homogeneous = np.column_stack([plane, np.ones(len(plane))])
    image = homogeneous @ np.swapaxes(H, -1, -2)
    norm = image[..., :2] / image[..., 2:]
    return distort(lens, norm, (k1[..., None], *lens.distortion[1:]))
