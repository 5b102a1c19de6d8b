"""Lens calibration from pictures of a chessboard.

A deviation in pixels is two-dimensional: the root mean square length of the residuals. A ``sigma``
is the standard deviation of one coordinate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.coverage import coverage

#: Distortion models, with the Brown-Conrady terms that each contains.
MODELS: dict[str, tuple[int, ...]] = {
    "none": (), "k1": (0,), "k1 k2": (0, 1), "k1 k2 p1 p2": (0, 1, 2, 3),
    "k1 k2 p1 p2 k3": (0, 1, 2, 3, 4),
}  # fmt: skip
#: Boards whose normals differ by less than this count as one tilt, rad.
SAME_TILT = np.radians(3.0)
#: Maximum relative uncertainty of a focal length.
FOCAL_LIMIT = 0.1


@dataclass(frozen=True)
class Chessboard:
    """A picture of a chessboard.

    Attributes
    ----------
    name, corners
        Name of the picture, and its inner corners, row by row, px, (N, 2); None if they were not
        found.
    reason
        Why the picture was not used for the lens; an empty string if it was used.
    deviation, tilt
        RMS of the residuals, px, and angle between the board's normal and the optical axis, rad;
        NaN if unknown.
    """

    name: str
    corners: FloatArray | None
    reason: str = ""
    deviation: float = float("nan")
    tilt: float = float("nan")

    @property
    def used(self) -> bool:
        """Whether the picture was used for the lens."""
        return not self.reason


@dataclass(frozen=True)
class Lens:
    """A calibrated lens.

    Attributes
    ----------
    size, matrix, distortion, deviation
        See `Camera`.
    sigma, model
        Standard deviations of both focal lengths, the principal point (px) and the five distortion
        coefficients, (9,); 0 for terms outside the model (`MODELS`).
    boards, coverage
        All pictures, in order, and the fraction of the frame that the boards cover.
    notes
        Notes, as sentences.
    """

    size: tuple[int, int]
    matrix: FloatArray
    distortion: FloatArray
    deviation: float
    sigma: FloatArray
    model: str
    boards: tuple[Chessboard, ...]
    coverage: float = float("nan")
    notes: tuple[str, ...] = ()

    def camera(self, name: str) -> Camera:
        """Return a camera with this lens and without a pose."""
        return Camera(name, self.size, self.matrix, self.distortion, deviation=self.deviation)


def find_chessboard(grey: npt.ArrayLike, pattern: tuple[int, int]) -> FloatArray | None:
    """Return the inner corners in a picture (H, W), px, (columns * rows, 2); None if not found."""
    import cv2

    picture: Any = _eight_bit(grey)
    # On synthetic boards the errors are 0.04 to 0.1 px with SB without flags, 0.2 to 0.4 px with
    # EXHAUSTIVE, and 0.03 to 0.06 px after cornerSubPix, whatever the start.
    complete, corners = cv2.findChessboardCornersSB(picture, pattern)
    if not complete:
        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        complete, corners = cv2.findChessboardCornersSB(picture, pattern, flags=flags)
    if not complete:
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        complete, corners = cv2.findChessboardCorners(picture, pattern, flags=flags)
    if not complete:
        return None
    grid = as_float(corners).reshape(pattern[1], pattern[0], 2)
    apart = min(np.linalg.norm(np.diff(grid, axis=k), axis=-1).min() for k in (0, 1))
    half = int(np.clip(0.25 * apart, 2, 15))
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-4)
    corners = cv2.cornerSubPix(picture, corners, (half, half), (-1, -1), end)
    return as_float(corners).reshape(-1, 2)


def _eight_bit(grey: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    picture = np.asarray(grey)
    if picture.ndim != 2 or picture.dtype not in (np.uint8, np.uint16):
        what = f"picture {picture.shape} of {picture.dtype}"
        raise InputError(f"{what}; pass a grey image (H, W), uint8 or uint16")
    if picture.dtype == np.uint8:
        return np.ascontiguousarray(picture)
    # Sensors with 10 or 12 bits leave the upper bits empty.
    top = max(float(picture.max()), 1.0)
    return np.asarray(np.round(picture * (255.0 / top)), dtype=np.uint8)


def calibrate_chessboard(
    images: Sequence[npt.ArrayLike],
    pattern: tuple[int, int],
    square: float,
    names: Sequence[str] = (),
) -> Lens:
    """Calibrate a lens from pictures of a flat chessboard.

    Parameters
    ----------
    images
        Grey pictures (H, W), uint8 or uint16, all of the same size. The board should be tilted by
        20° to 45° in different directions and appear in all parts of the frame.
    pattern
        Columns and rows of inner corners.
    square
        Side of a square, m.
    names
        Names of the pictures; default: "picture 1" and so on.

    Raises
    ------
    InputError
        If the pattern is found in fewer than three pictures, or the pictures do not determine the
        focal length.
    """
    columns, rows = (int(n) for n in pattern)
    if min(columns, rows) < 3 or max(columns, rows) > 200:
        what = f"chessboard of {columns} × {rows} inner corners"
        raise InputError(f"{what}; use 3 to 200 each, counting only corners inside the board")
    pictures = [_eight_bit(image) for image in images]
    called = list(names) or [f"picture {k + 1}" for k in range(len(pictures))]
    if len(pictures) < 3:
        raise InputError(f"{len(pictures)} pictures of a chessboard; pass three or more")
    height, width = pictures[0].shape
    for name, picture in zip(called, pictures, strict=True):
        if picture.shape != (height, width):
            raise InputError(
                f"{name}: {picture.shape[1]} × {picture.shape[0]} px, but {called[0]} has {width} "
                f"× {height} px; use pictures from one camera with one setting"
            )
    corners = [find_chessboard(picture, (columns, rows)) for picture in pictures]
    return calibrate_corners((width, height), corners, (columns, rows), square, called)


def calibrate_corners(
    size: tuple[int, int],
    corners: Sequence[FloatArray | None],
    pattern: tuple[int, int],
    square: float,
    names: Sequence[str],
) -> Lens:
    """Calibrate a lens from given corners, in the same way as `calibrate_chessboard`.

    ``corners`` has one entry per picture, px, (columns * rows, 2), which may be None. The
    distortion model is the one with the smallest Bayesian information criterion.
    """
    if not (np.isfinite(square) and square > 0.0):
        raise InputError(f"the side of a square must be above 0, not {square} m")
    columns, rows = pattern
    plane = np.indices((rows, columns))[::-1].reshape(2, -1).T * square
    points = np.pad(plane, ((0, 0), (0, 1)))
    what = f"the pattern of {columns} × {rows} inner corners"
    boards = [
        Chessboard(name, own, f"{what} was not found" if own is None else "")
        for name, own in zip(names, corners, strict=True)
    ]
    if sum(board.used for board in boards) < 3:
        have = ", ".join(board.name for board in boards if board.used) or "none"
        raise InputError(
            f"{what} is found in {have} of {len(boards)} pictures; three or more are needed: "
            "check the corner counts, and that the whole board is in the frame, sharp and not "
            "overexposed"
        )
    boards = _without_outliers(size, points, boards)
    solved = [_solve(size, points, boards, model) for model in MODELS]
    lens, _, normals = min(solved, key=lambda triple: triple[1])
    _check_lens(lens, normals)
    outer = [0, columns - 1, rows * columns - 1, (rows - 1) * columns]
    outlines = [b.corners[outer] for b in boards if b.used and b.corners is not None]
    lens = replace(lens, coverage=_coverage(size, outlines))
    return replace(lens, notes=_lens_notes(lens))


def _solve(
    size: tuple[int, int], points: FloatArray, boards: Sequence[Chessboard], model: str
) -> tuple[Lens, float, FloatArray]:
    """Return the lens fitted with a model, its information criterion, and the board normals."""
    import cv2

    kept = (
        (cv2.CALIB_FIX_K1, 0),
        (cv2.CALIB_FIX_K2, 1),
        (cv2.CALIB_ZERO_TANGENT_DIST, 2),
        (cv2.CALIB_FIX_K3, 4),
    )
    flags = sum(flag for flag, term in kept if term not in MODELS[model])
    pixels = [np.float32(b.corners).reshape(-1, 1, 2) for b in boards if b.used]
    where = [np.float32(points).reshape(-1, 1, 3)] * len(pixels)
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    try:
        deviation, matrix, distortion, turns, _, sigma, _, apart = cv2.calibrateCameraExtended(
            where, pixels, size, np.eye(3), np.zeros(5), flags=flags, criteria=end
        )
    except cv2.error:
        raise InputError(_FRONTAL.format("the focal length")) from None
    if not (np.isfinite(matrix).all() and np.isfinite(sigma).all() and np.isfinite(deviation)):
        raise InputError(_FRONTAL.format("the focal length"))
    normals = np.stack([cv2.Rodrigues(as_float(turn))[0][:, 2] for turn in turns])
    n = 2 * len(pixels) * len(points)
    # The noise is unknown; its lower bound is the rounding of the 32-bit corners.
    floor = (np.finfo(np.float32).eps * max(size)) ** 2
    criterion = n * np.log(0.5 * deviation**2 + floor) + len(MODELS[model]) * np.log(n)
    tilts = np.arccos(np.clip(np.abs(normals[:, 2]), 0.0, 1.0))
    numbered = zip(boards, np.cumsum([b.used for b in boards]) - 1, strict=True)
    after = [
        replace(b, deviation=float(np.ravel(apart)[k]), tilt=float(tilts[k])) if b.used else b
        for b, k in numbered
    ]
    lens = Lens(
        size,
        as_float(matrix),
        as_float(distortion).ravel()[:5],
        float(deviation),
        as_float(sigma).ravel()[:9],
        model,
        tuple(after),
    )
    return lens, float(criterion), as_float(normals)


_FRONTAL = (
    "{} is not determined: it cannot be separated from the distance; hold the board at three "
    "or more different tilts of 20° to 45°"
)


def _without_outliers(
    size: tuple[int, int], points: FloatArray, boards: Sequence[Chessboard]
) -> list[Chessboard]:
    """Leave out boards with far larger residuals than the other boards, the worst first."""
    kept = list(boards)
    while sum(board.used for board in kept) > 3:
        # The model has all terms, so that no board is rejected because of distortion.
        solved = _solve(size, points, kept, "k1 k2 p1 p2 k3")[0].boards
        apart = np.array([board.deviation if board.used else np.nan for board in solved])
        usual, worst = float(np.nanmedian(apart)), int(np.nanargmax(apart))
        if apart[worst] <= max(3.0 * usual, usual + 0.1):
            break
        reason = f"its residuals of {apart[worst]:.2f} px are far above the usual {usual:.2f} px"
        kept[worst] = replace(kept[worst], reason=reason, deviation=float(apart[worst]))
    return kept


def _check_lens(lens: Lens, normals: FloatArray) -> None:
    """Raise an error if the boards do not determine the lens."""
    f, sigma = lens.matrix[0, 0], lens.sigma[0]
    if sigma > FOCAL_LIMIT * f or sigma == 0.0:
        raise InputError(_FRONTAL.format(f"the focal length of {f:.0f} px ± {sigma:.0f} px"))
    different: list[FloatArray] = []
    for normal in normals:
        if all(np.linalg.norm(np.cross(normal, other)) > np.sin(SAME_TILT) for other in different):
            different.append(normal)
    if len(different) < 3:
        tilts = ", ".join(f"{np.degrees(b.tilt):.0f}°" for b in lens.boards if b.used)
        have = f"{len(different)} differ by more than {np.degrees(SAME_TILT):.0f}°"
        raise InputError(_FRONTAL.format("the lens") + f" (now {have}; from the axis: {tilts})")


def _coverage(size: tuple[int, int], outlines: Sequence[FloatArray]) -> float:
    """Return the fraction of the frame covered by quadrilaterals (4, 2)."""
    scale = 256.0 / max(size)
    rows, columns = (int(np.ceil(n * scale)) for n in reversed(size))
    return float(coverage([outline * scale for outline in outlines], (rows, columns)).mean())


def _lens_notes(lens: Lens) -> tuple[str, ...]:
    relative, share = 100.0 * lens.sigma[0] / lens.matrix[0, 0], 100.0 * lens.coverage
    used = sum(board.used for board in lens.boards)
    notes = (
        (
            relative > 1.0,
            f"the focal length is known to {relative:.1f} %; tilt more",
        ),
        (
            share < 50.0,
            f"boards cover {share:.0f} % of the frame; outside them, distortion is extrapolated",
        ),
        (used < 6, f"{used} pictures were used; use ten or more for a reliable lens"),
    )
    return tuple(text for said, text in notes if said)
