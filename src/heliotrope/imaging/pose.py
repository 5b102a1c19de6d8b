"""Locate a camera from known points, with a known or unknown lens.

A deviation in pixels is two-dimensional: the root mean square length of the residuals. A ``sigma``
is the standard deviation of one coordinate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.geometry import FloatArray, as_float, as_vectors, cross_matrix
from heliotrope.imaging.lens import Lens

#: Priors for a calibration from marks alone: log of focal length over width and its standard
#: deviation; standard deviations of principal point over width, and of k1.
LOG_FOCAL, LOG_FOCAL_SIGMA, CENTER_SIGMA, K1_SIGMA = np.log(3.0), 1.5, 0.02, 0.1
#: Names of the rows of a `CameraFit` covariance.
POSE = ("turn_right", "turn_down", "turn_forward", "east", "north", "up")
INNER = ("log_focal", "center_x", "center_y", "k1")


@dataclass(frozen=True)
class CameraFit:
    """A camera fitted to points.

    Attributes
    ----------
    camera, residuals
        The camera with its pose, and observed minus predicted pixels, (N, 2).
    names, covariance
        Parameter names and their covariance, (6, 6) or (10, 10). The parameters are `POSE`,
        followed by `INNER` if these were also solved for. Rotations are about the camera's own
        axes, rad; the position is in ENU metres.
    plane_sigma
        Predicted standard deviation per coordinate, m, of a pixel's position on the plane of the
        points, between the points, due to the camera error alone.
    other
        A second pose that explains the points equally well; None if there is none.
    notes
        Sentences about parameters that the points do not determine, and about contradictions.
    """

    camera: Camera
    names: tuple[str, ...]
    covariance: FloatArray
    residuals: FloatArray
    plane_sigma: float
    other: Camera | None = None
    notes: tuple[str, ...] = ()

    def sigma(self, name: str) -> float:
        """Return the standard deviation of a parameter."""
        k = self.names.index(name)
        return float(np.sqrt(self.covariance[k, k]))


def resection(
    lens: Lens | Camera,
    points: npt.ArrayLike,
    pixels: npt.ArrayLike,
    sigma: npt.ArrayLike = 0.3,
    name: str = "camera",
) -> CameraFit:
    """Return the pose of a camera with a known lens.

    The two poses from a plane (Collins and Bartoli 2014, IPPE) and the pose from the general
    problem (SQPnP) are refined by least squares. The covariance includes the noise of the points;
    the lens is treated as exact.

    Parameters
    ----------
    lens
        Lens or camera; the pose of a camera is not used.
    points
        ENU metres, (N, 3), four or more, not collinear.
    pixels
        Pixels of the points, (N, 2).
    sigma
        Standard deviation of a pixel coordinate, a scalar or (N,); or covariances (N, 2, 2), px².
    name
        Name of the camera, if a lens is passed.

    Raises
    ------
    InputError
        If there are too few points or they are collinear, or no pose explains them.
    """
    base = lens.camera(name) if isinstance(lens, Lens) else lens
    problem = _problem(*_observed(points, pixels, sigma), base, free=False)
    return _finish(problem, [np.concatenate(start) for start in _starts(problem, base)])


def calibrate_marks(
    size: tuple[int, int],
    points: Sequence[npt.ArrayLike],
    pixels: Sequence[npt.ArrayLike],
    sigma: float | Sequence[npt.ArrayLike] = 0.3,
    name: str = "camera",
) -> CameraFit:
    """Calibrate a camera from points alone.

    The function solves for pose, focal length (square pixels), principal point and k1. The last
    three have priors: 3 frame widths within a factor of 4.5, the frame centre ± 2 % of the width,
    and 0 ± 0.1. Parameters that the points do not determine keep their priors.

    Parameters
    ----------
    size
        Width and height of the frames, px.
    points, pixels
        Points and pixels as for `resection`, for each frame of a camera that does not move between
        frames; four or more points in total. Errors are those of `resection`.
    sigma
        As for `resection`, or a list with one entry for each frame.
    name
        Name of the camera.
    """
    if not points or len(points) != len(pixels):
        raise InputError(
            f"got {len(points)} point lists and {len(pixels)} pixel lists; pass one of each per "
            "frame"
        )
    noise = [sigma] * len(points) if isinstance(sigma, int | float) else sigma
    frames = [_observed(*frame) for frame in zip(points, pixels, noise, strict=True)]
    where, observed, white = (np.concatenate(part) for part in zip(*frames, strict=True))
    problem = _problem(where, observed, white, _pinhole(size, 3.0, name), free=True)
    tried = []
    for wide in 0.5 * 2.0 ** np.arange(8):
        guess = _pinhole(size, wide, name)
        f = guess.matrix[0, 0]
        for turn, shift in _starts(problem, guess):
            x = np.concatenate([turn, shift / f, [np.log(f)], guess.matrix[:2, 2], [0.0]])
            tried.append((float(np.sum(problem.residuals(x) ** 2)), x))
    tried.sort(key=lambda pair: pair[0])
    return _finish(problem, [x for _, x in tried[:6]])


def _pinhole(size: tuple[int, int], wide: float, name: str) -> Camera:
    """Return a camera without distortion, with a focal length of ``wide`` frame widths."""
    f, (cx, cy) = wide * size[0], (0.5 * (size[0] - 1), 0.5 * (size[1] - 1))
    return Camera(name, size, np.array([[f, 0.0, cx], [0.0, f, cy], [0.0, 0.0, 1.0]]))


@dataclass(frozen=True)
class _Problem:
    """Least squares of a pose and, if ``free``, of focal length, principal point and k1.

    The unknowns are the rotation vector and the translation from points relative to ``origin``
    to the camera, then log focal length, principal point and k1. If ``free``, the translation
    is in units of the focal length, because a frontal plane determines only their ratio.
    """

    origin: FloatArray
    local: FloatArray
    pixels: FloatArray
    whitener: FloatArray
    base: Camera
    free: bool

    def camera(self, x: FloatArray) -> Camera:
        """Return the camera for a vector of unknowns."""
        matrix, distortion = self.lens(x)
        position = self.origin - self.turn(x).T @ self.shift(x)
        return replace(
            self.base,
            matrix=matrix,
            distortion=distortion,
            position=position,
            R_enu_camera=self.turn(x).T,
        )

    def turn(self, x: FloatArray) -> FloatArray:
        """Return the rotation from ENU to camera axes, (3, 3), for a vector of unknowns."""
        import cv2

        return as_float(cv2.Rodrigues(x[:3])[0])

    def lens(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the lens matrix and distortion for a vector of unknowns."""
        if not self.free:
            return self.base.matrix, self.base.distortion
        f = float(np.exp(np.clip(x[6], -20.0, 20.0)))
        matrix = np.array([[f, 0.0, x[7]], [0.0, f, x[8]], [0.0, 0.0, 1.0]])
        return matrix, np.array([x[9], 0.0, 0.0, 0.0, 0.0])

    def predict(self, x: FloatArray, local: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return pixels (N, 2) and their derivatives (N, 2, P)."""
        import cv2

        matrix, distortion = self.lens(x)
        shift = self.shift(x)
        projected, derivatives = cv2.projectPoints(local, x[:3], shift, matrix, distortion)
        slope = as_float(derivatives).reshape(len(local), 2, -1)
        f = matrix[0, 0]
        focal = (slope[..., 6] + slope[..., 7]) * f + slope[..., 3:6] @ shift
        inner = [f * slope[..., 3:6], focal[..., None], slope[..., 8:11]]
        parts = [slope[..., :3], *inner] if self.free else [slope[..., :6]]
        return as_float(projected).reshape(-1, 2), np.concatenate(parts, axis=-1)

    def shift(self, x: FloatArray) -> FloatArray:
        """Return the translation, m, for a vector of unknowns."""
        return x[3:6] * self.lens(x)[0][0, 0] if self.free else x[3:6]

    @property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Prior mean and standard deviation of log focal length, principal point and k1."""
        width, height = self.base.size
        mean = [LOG_FOCAL + np.log(width), 0.5 * (width - 1), 0.5 * (height - 1), 0.0]
        sigma = [LOG_FOCAL_SIGMA, CENTER_SIGMA * width, CENTER_SIGMA * width, K1_SIGMA]
        return np.array(mean), np.array(sigma)

    def residuals(self, x: FloatArray) -> FloatArray:
        """Return whitened residuals, with the residuals of the priors last."""
        apart = self.predict(x, self.local)[0] - self.pixels
        white = np.einsum("nij,nj->ni", self.whitener, apart).ravel()
        mean, sigma = self.prior
        return np.concatenate([white, (x[6:] - mean) / sigma]) if self.free else white

    def slopes(self, x: FloatArray) -> FloatArray:
        """Return the derivatives of `residuals` with respect to the unknowns."""
        white = np.einsum("nij,njp->nip", self.whitener, self.predict(x, self.local)[1])
        prior = np.eye(10)[6:] / self.prior[1][:, None]
        return np.concatenate([white.reshape(-1, len(x))] + [prior] * self.free)


def _observed(
    points: npt.ArrayLike, pixels: npt.ArrayLike, sigma: npt.ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points, pixels and W (N, 2, 2), where ``W.T @ W`` is the inverse covariance."""
    where, observed, noise = as_vectors(points, "points"), as_float(pixels), as_float(sigma)
    if where.ndim != 2 or observed.shape != (len(where), 2):
        raise InputError(
            f"points {where.shape} and pixels {observed.shape}; expected (N, 3) and (N, 2)"
        )
    if not np.isfinite(observed).all():
        row = int(np.argwhere(~np.isfinite(observed))[0, 0])
        raise InputError(f"pixels[{row}]: {observed[row]} is not finite; omit such points")
    if noise.shape in ((), (len(where),)):
        noise = np.eye(2) * np.broadcast_to(np.sign(noise) * noise**2, len(where))[:, None, None]
    if noise.shape != (len(where), 2, 2):
        raise InputError(f"sigma {noise.shape}; pass one number, (N,) or (N, 2, 2)")
    if not (np.isfinite(noise).all() and (np.linalg.eigvalsh(noise) > 0.0).all()):
        raise InputError("sigma of the pixels: a variance is not finite and above 0")
    return where, observed, np.linalg.inv(np.linalg.cholesky(noise))


def _problem(
    where: FloatArray, observed: FloatArray, white: FloatArray, base: Camera, free: bool
) -> _Problem:
    if len(where) < 4:
        raise InputError(f"{len(where)} points; four or more are needed to locate a camera")
    origin = where.mean(axis=0)
    spread = np.linalg.svd(where - origin, compute_uv=False)
    if spread[1] <= 1e-3 * spread[0]:
        raise InputError(f"the {len(where)} points lie on one line; use points that span an area")
    return _Problem(origin, where - origin, observed, white, base, free)


def _starts(problem: _Problem, lens: Camera) -> list[tuple[FloatArray, FloatArray]]:
    """Return initial rotation vectors and translations."""
    import cv2

    local = problem.local
    _, spread, axes = np.linalg.svd(local)
    axes = axes * np.linalg.det(axes)
    methods = [(local, np.eye(3), cv2.SOLVEPNP_SQPNP)]
    if spread[2] < 0.05 * spread[1]:
        methods.insert(0, (local @ axes.T * [1.0, 1.0, 0.0], axes, cv2.SOLVEPNP_IPPE))
    starts = []
    for shape, turned, method in methods:
        try:
            _, turns, shifts, _ = cv2.solvePnPGeneric(
                np.ascontiguousarray(shape),
                problem.pixels,
                lens.matrix,
                lens.distortion,
                flags=method,
            )
        except cv2.error:
            continue
        for turn, shift in zip(turns, shifts, strict=True):
            whole = as_float(cv2.Rodrigues(cv2.Rodrigues(turn)[0] @ turned)[0])
            starts.append((whole.ravel(), as_float(shift).ravel()))
    return [start for start in starts if np.isfinite(start).all()]


def _finish(problem: _Problem, starts: Sequence[FloatArray]) -> CameraFit:
    """Refine all starts; return the best result, and the second if it is hardly worse."""
    from scipy.optimize import least_squares
    from scipy.special import chdtri

    solved = []
    for start in starts:
        solution = least_squares(
            problem.residuals,
            start,
            problem.slopes,
            method="lm",
            x_scale="jac",
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
        )
        if (problem.local @ problem.turn(solution.x)[2] + problem.shift(solution.x)[2] > 0.0).all():
            solved.append((2.0 * float(solution.cost), solution.x))
    name = f"camera {problem.base.name}"
    if not solved:
        raise InputError(f"{name}: no pose explains the points; check their names")
    solved.sort(key=lambda pair: pair[0])
    chi2, x = solved[0]
    camera = problem.camera(x)
    slopes = problem.slopes(x)
    freedom = len(slopes) - len(x)
    # Scale only if the probability of the residuals by chance is below 1 %; otherwise scaling would
    # add noise.
    scale = chi2 / freedom if freedom and chi2 > chdtri(freedom, 0.01) else 1.0
    slopes[: 2 * len(problem.local)] /= np.sqrt(scale)
    close = [y for cost, y in solved[1:] if cost - chi2 < 9.0 * scale]
    # Ignore the same pose if it was reached from another start.
    differ = [y for y in close if np.ptp(problem.turn(y) - problem.turn(x)) > 0.01]
    other = problem.camera(differ[0]) if differ else None
    size = np.linalg.norm(slopes, axis=0)
    if not (size.min() > 0.0 and np.linalg.cond(slopes / size) < 1e8):
        raise InputError(f"{name}: the points do not determine its position; use more points")
    raw = np.linalg.inv((slopes / size).T @ (slopes / size)) / size / size[:, None]
    residuals = problem.pixels - problem.predict(x, problem.local)[0]
    if problem.free:
        camera = replace(camera, deviation=float(np.sqrt(2.0 * np.mean(residuals**2))))
    change = _to_pose(problem, x)
    fit = CameraFit(
        camera,
        POSE + INNER * problem.free,
        change @ raw @ change.T,
        residuals,
        _plane_sigma(problem, x, raw),
        other,
    )
    return replace(fit, notes=tuple(_notes(problem, fit, scale)))


def _to_pose(problem: _Problem, x: FloatArray) -> FloatArray:
    """Return the derivative of the camera's rotation and position with respect to the unknowns."""
    k, shift = cross_matrix(x[:3]), problem.shift(x)
    angle = max(float(np.linalg.norm(x[:3])), 1e-4)
    # Left Jacobian of SO(3).
    a, b = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    left = np.eye(3) + a * k + b * (k @ k)
    back = problem.turn(x).T
    change = np.eye(len(x))
    change[:3, :3] = left
    change[3:6, :3] = -back @ cross_matrix(shift) @ left
    change[3:6, 3:6] = -back
    if problem.free:
        change[3:6, 3:6] *= problem.lens(x)[0][0, 0]
        change[3:6, 6] = -back @ shift
    return change


def _plane_sigma(problem: _Problem, x: FloatArray, raw: FloatArray) -> float:
    """Return the standard deviation of pixel positions on the plane, at and between points."""
    axes = np.linalg.svd(problem.local)[2][:2]
    few = problem.local[:: len(problem.local) // 40 + 1]
    points = (0.5 * (few + few[:, None])).reshape(-1, 3)
    step = 1e-4 * float(np.ptp(few, axis=0).max())
    across = np.stack(
        [
            problem.predict(x, points + step * a)[0] - problem.predict(x, points - step * a)[0]
            for a in axes
        ],
        axis=-1,
    ) / (2.0 * step)
    # For a fixed pixel, the position on the plane moves opposite to the prediction.
    moved = np.linalg.solve(across, problem.predict(x, points)[1])
    return float(np.sqrt(0.5 * np.einsum("nip,pq,niq->n", moved, raw, moved).mean()))


def _notes(problem: _Problem, fit: CameraFit, scale: float) -> list[str]:
    notes = []
    good = f"pixels on the plane of the points remain accurate to {1e3 * fit.plane_sigma:.1f} mm"
    if problem.free and fit.sigma("log_focal") > 0.05:
        away = np.linalg.norm(np.asarray(fit.camera.position) - problem.origin)
        have = f"{fit.camera.matrix[0, 0]:.0f} px at {away:.1f} m"
        unsure = f"uncertain by a factor of {np.exp(fit.sigma('log_focal')):.2f}"
        notes.append(
            f"focal length and distance cannot be determined separately: {have}, {unsure}; {good}"
        )
    if problem.free:
        sigma = problem.prior[1]
        what = (
            ("the principal point", 1, f"the frame's centre ± {sigma[1]:.0f} px"),
            ("k1", 3, f"0 ± {K1_SIGMA}"),
        )
        notes += [
            f"the points do not determine {quantity}; it keeps its prior, {prior}"
            for quantity, k, prior in what
            if fit.sigma(INNER[k]) > 0.7 * sigma[k]
        ]
    if fit.other is not None and fit.other.position is not None:
        place = ", ".join(f"{v:.1f}" for v in fit.other.position)
        notes.append(f"a second pose explains the points equally well, at ({place}) m; {good}")
    if scale > 1.0:
        size = np.linalg.norm(fit.residuals, axis=1)
        notes.append(
            f"the residuals, up to {size.max():.1f} px at point {int(np.argmax(size)) + 1}, are "
            f"{np.sqrt(scale):.1f} times the given sigma; the covariance is scaled to them"
        )
    return notes
