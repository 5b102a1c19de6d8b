"""Lenses and poses: what was put in comes out, as well as the covariance says."""

import re
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from heliotrope.errors import InputError
from heliotrope.field.camera import Camera, look_at, project, rays, undistort
from heliotrope.geometry import FloatArray
from heliotrope.imaging.lens import calibrate_chessboard, calibrate_corners, find_chessboard
from heliotrope.imaging.pose import (
    CENTER_SIGMA,
    INNER,
    POSE,
    CameraFit,
    calibrate_marks,
    resection,
)

PATTERN, SQUARE = (9, 6), 0.03
SIZE = (480, 360)
MATRIX = np.array([[520.0, 0.0, 251.0], [0.0, 523.0, 171.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.22, 0.11, 0.0, 0.0, 0.0])
#: Tilts about the picture's axes, degrees, and middle of the board, m, before the camera.
HELD = (
    ((25, 5, 3), (-0.06, 0.01, 0.46)), ((-30, 8, -8), (0.06, -0.03, 0.48)),
    ((4, 32, 12), (0.05, 0.04, 0.46)), ((-6, -28, 2), (-0.05, -0.04, 0.45)),
    ((22, -24, 40), (0.0, 0.02, 0.5)), ((-20, 26, -20), (0.02, -0.02, 0.42)),
)  # fmt: skip


# -- chessboards -----------------------------------------------------------------------


def held(tilt: Any, middle: Any) -> tuple[FloatArray, FloatArray]:
    """Rotation and translation of a board whose first inner corner is its origin."""
    turn = np.eye(3)
    for k, angle in enumerate(np.radians(tilt)):
        turn = turn @ cv2.Rodrigues(angle * np.eye(3)[k])[0]
    center = 0.5 * SQUARE * np.array([PATTERN[0] - 1, PATTERN[1] - 1, 0])
    return turn, np.array(middle) - turn @ center


def corners(turn: FloatArray, shift: FloatArray, distortion: FloatArray = DISTORTION) -> FloatArray:
    plane = np.indices(PATTERN[::-1])[::-1].reshape(2, -1).T * SQUARE
    points = np.pad(plane, ((0, 0), (0, 1)))
    seen, _ = cv2.projectPoints(points, cv2.Rodrigues(turn)[0], shift, MATRIX, distortion)
    return np.asarray(seen, dtype=np.float64).reshape(-1, 2)


def drawn(turn: FloatArray, shift: FloatArray, seed: int) -> npt.NDArray[np.uint8]:
    """The board as the camera sees it: every ray, three times three to a pixel, meets its plane."""
    width, height = SIZE
    lens = Camera("lens", SIZE, MATRIX, DISTORTION)
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    ahead = undistort(lens, np.stack([x, y], axis=-1)).astype(np.float32)
    fine = cv2.resize(ahead, (3 * width, 3 * height), interpolation=cv2.INTER_LINEAR)
    line = np.concatenate([fine, np.ones((*fine.shape[:2], 1), np.float32)], axis=-1)
    turn, shift = turn.astype(np.float32), shift.astype(np.float32)
    away = (shift @ turn[:, 2]) / (line @ turn[:, 2])
    place = ((line * away[..., None] - shift) @ turn[:, :2]) / SQUARE
    cell = np.floor(place).astype(int)
    dark = (cell.sum(axis=-1) % 2 == 0) & ((cell >= -1) & (cell < np.array(PATTERN))).all(axis=-1)
    light = cv2.resize(np.where(dark, 40.0, 190.0), SIZE, interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(light, (0, 0), 0.7)
    noise = np.random.default_rng(seed).normal(0.0, 2.0, soft.shape)
    return np.clip(np.round(soft + noise), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photographs() -> list[npt.NDArray[np.uint8]]:
    return [drawn(*held(*pose), seed) for seed, pose in enumerate(HELD)]


def test_corners_are_found_where_they_are(photographs: list[npt.NDArray[np.uint8]]) -> None:
    for pose, picture in zip(HELD, photographs, strict=True):
        found = find_chessboard(picture, PATTERN)
        assert found is not None
        true = corners(*held(*pose))
        # A board looks the same upside down.
        miss = min(
            float(np.sqrt(np.mean(np.sum((found - t) ** 2, axis=1)))) for t in (true, true[::-1])
        )
        assert miss < 0.15


def test_pictures_of_a_board_give_the_lens(photographs: list[npt.NDArray[np.uint8]]) -> None:
    empty = np.full(SIZE[::-1], 128, np.uint8)
    names = [f"{k}.png" for k in range(6)] + ["empty.png"]
    lens = calibrate_chessboard([*photographs, empty], PATTERN, SQUARE, names)
    assert [board.used for board in lens.boards] == [True] * 6 + [False]
    assert lens.boards[-1].name == "empty.png"
    assert lens.boards[-1].reason == "the pattern of 9 × 6 inner corners was not found"
    assert np.isnan(lens.boards[-1].deviation)
    assert lens.deviation < 0.15
    assert lens.matrix[0, 0] == pytest.approx(MATRIX[0, 0], rel=0.005)
    assert lens.matrix[1, 1] == pytest.approx(MATRIX[1, 1], rel=0.005)
    assert lens.matrix[:2, 2] == pytest.approx(MATRIX[:2, 2], abs=2.0)
    # What counts is where pixels look, over the part of the frame that boards were in.
    pixels = np.stack(np.meshgrid(np.linspace(80, 400, 7), np.linspace(60, 300, 5)), axis=-1)
    one = undistort(lens.camera("found"), pixels)
    two = undistort(Camera("true", SIZE, MATRIX, DISTORTION), pixels)
    assert MATRIX[0, 0] * np.abs(one - two - (one - two).mean(axis=(0, 1))).max() < 0.5
    assert 0.5 < lens.coverage < 1.0
    camera = lens.camera("roof")
    assert (camera.name, camera.size, camera.position) == ("roof", SIZE, None)
    assert camera.deviation == lens.deviation


def test_twelve_bits_in_sixteen_are_read(photographs: list[npt.NDArray[np.uint8]]) -> None:
    deep = photographs[0].astype(np.uint16) * 16
    found, shallow = find_chessboard(deep, PATTERN), find_chessboard(photographs[0], PATTERN)
    assert found is not None
    assert shallow is not None
    assert np.abs(found - shallow).max() < 0.05


def seen_corners(seed: int, noise: float, distortion: FloatArray = DISTORTION) -> list[FloatArray]:
    rng = np.random.default_rng(seed)
    return [
        c + rng.normal(0.0, noise, c.shape) for c in (corners(*held(*p), distortion) for p in HELD)
    ]


def names(count: int) -> list[str]:
    return [f"{k}.png" for k in range(count)]


@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ([0.0, 0.0, 0.0, 0.0, 0.0], "none"),
        ([-0.2, 0.0, 0.0, 0.0, 0.0], "k1"),
        ([-0.3, 0.25, 0.0, 0.0, 0.0], "k1 k2"),
        ([-0.3, 0.25, 0.01, -0.008, 0.0], "k1 k2 p1 p2"),
    ],
)
def test_as_many_terms_as_the_data_support(distortion: list[float], model: str) -> None:
    chosen = [
        calibrate_corners(
            SIZE, seen_corners(seed, 0.1, np.array(distortion)), PATTERN, SQUARE, names(6)
        ).model
        for seed in range(5)
    ]
    assert chosen.count(model) >= 4, chosen


def test_all_terms_without_noise() -> None:
    true = np.array([-0.3, 0.25, 0.01, -0.008, 0.6])
    lens = calibrate_corners(SIZE, seen_corners(0, 0.0, true), PATTERN, SQUARE, names(6))
    assert lens.model == "k1 k2 p1 p2 k3"
    # Corners are handed over in 32 bits: 3e-5 px of 480.
    assert lens.deviation < 1e-4
    assert lens.matrix == pytest.approx(MATRIX, abs=1e-2)
    assert lens.distortion == pytest.approx(true, abs=2e-3)


def test_the_lens_is_as_certain_as_it_says() -> None:
    true = np.concatenate([np.diag(MATRIX)[:2], MATRIX[:2, 2], [-0.2, 0, 0, 0, 0]])
    off = []
    for seed in range(24):
        views = seen_corners(seed, 0.2, true[4:])
        lens = calibrate_corners(SIZE, views, PATTERN, SQUARE, names(6))
        if lens.model == "k1":
            found = np.concatenate([np.diag(lens.matrix)[:2], lens.matrix[:2, 2], lens.distortion])
            off.append((found - true)[:5] / lens.sigma[:5])
            assert (lens.sigma[5:] == 0.0).all()
    assert len(off) >= 20
    # 5 × 20 squares of unit normals, correlated: their mean is 1 ± 0.3.
    assert 0.6 < np.mean(np.square(off)) < 1.5
    assert lens.deviation == pytest.approx(0.2 * np.sqrt(2.0), rel=0.1)


def test_a_board_that_bent_is_left_out_and_named() -> None:
    views: list[FloatArray | None] = [*seen_corners(1, 0.1)]
    bent = np.asarray(views[2])
    views[2] = bent + 3.0 * np.sin(bent / 40.0)
    lens = calibrate_corners(SIZE, views, PATTERN, SQUARE, names(6))
    assert [b.name for b in lens.boards if not b.used] == ["2.png"]
    reason = lens.boards[2].reason
    assert re.fullmatch(r"its residuals of \d\.\d\d px are far above the usual 0\.\d\d px", reason)
    assert lens.boards[2].deviation > 1.0
    # Only without it is the focal length right.
    assert lens.matrix[0, 0] == pytest.approx(520.0, abs=4.0 * lens.sigma[0])


def test_frontal_boards_do_not_tell_the_focal_length() -> None:
    rng = np.random.default_rng(2)
    views = [
        corners(*held((0, 0, roll), (x, 0.0, z))) + rng.normal(0.0, 0.2, (54, 2))
        for roll, x, z in ((0, 0.0, 0.5), (10, 0.03, 0.55), (-20, -0.03, 0.6), (5, 0.0, 0.7))
    ]
    with pytest.raises(InputError, match=r"(lens|focal length.*) is not determined: it cannot"):
        calibrate_corners(SIZE, views, PATTERN, SQUARE, names(4))


def test_three_boards_at_one_tilt_are_one() -> None:
    views = [corners(*held((30, 0, 0), (x, 0.0, 0.5))) for x in (-0.05, 0.0, 0.05)]
    rng = np.random.default_rng(3)
    views = [view + rng.normal(0.0, 0.02, view.shape) for view in views]
    with pytest.raises(InputError, match=r"is not determined.*three or more different tilts"):
        calibrate_corners(SIZE, views, PATTERN, SQUARE, names(3))


def test_a_lens_says_what_is_weak_about_it() -> None:
    rng = np.random.default_rng(4)
    views = [
        corners(*held(tilt, (0.0, 0.0, 1.2))) + rng.normal(0.0, 0.2, (54, 2))
        for tilt in ((14, 0, 0), (0, 15, 0), (-12, -10, 0), (2, 2, 0))
    ]
    lens = calibrate_corners(SIZE, views, PATTERN, SQUARE, names(4))
    text = " | ".join(lens.notes)
    assert re.search(r"focal length is known to \d\.\d %", text)
    assert re.search(r"boards cover \d+ % of the frame", text)
    assert "4 pictures were used" in text


GREY = np.full((60, 80), 128, np.uint8)


@pytest.mark.parametrize(
    ("pictures", "pattern", "square", "text"),
    [
        ([GREY] * 2, PATTERN, 0.03, r"^2 pictures of a chessboard; pass three or more$"),
        ([GREY] * 3, (2, 6), 0.03, r"2 × 6 inner corners; use 3 to 200 each"),
        ([GREY] * 3, PATTERN, 0.0, r"the side of a square must be above 0, not 0.0 m"),
        ([GREY] * 3, PATTERN, float("nan"), r"must be above 0, not nan m"),
        (
            [GREY, GREY, GREY[:, 1:]],
            PATTERN,
            0.03,
            r"^picture 3: 79 × 60 px, but picture 1 has 80 × 60 px; use pictures from one camera",
        ),
        (
            [GREY] * 3,
            PATTERN,
            0.03,
            r"^the pattern of 9 × 6 inner corners is found in none of 3 pictures; three or more",
        ),
        (
            [GREY / 2.0] * 3,
            PATTERN,
            0.03,
            r"of float64; pass a grey image \(H, W\), uint8 or uint16",
        ),
        ([np.dstack([GREY] * 3)] * 3, PATTERN, 0.03, r"picture \(60, 80, 3\) of uint8"),
    ],
)
def test_boards_that_cannot_be_used(
    pictures: list[FloatArray], pattern: tuple[int, int], square: float, text: str
) -> None:
    with pytest.raises(InputError, match=text):
        calibrate_chessboard(pictures, pattern, square)


# -- poses -----------------------------------------------------------------------------

WIDE = (1600, 1200)
_X = np.linspace(-3.5, 3.5, 3)
#: Nine marks of a target at 40 m, seen from the south, and of two more in other planes.
FACE = np.array([(x, 0.0, 40.0 + z) for x in _X for z in _X])
SPACE = np.concatenate([FACE, FACE + [9.0, 1.0, -4.0], FACE + [0.5, 6.0, 9.0]])
FRONT, SIDE = (0.5, -60.0, 40.0), (25.0, -30.0, 20.0)


def camera(
    position: Any, focal: float = 8000.0, k1: float = 0.0, center: Any = (0.0, 0.0)
) -> Camera:
    matrix = np.array([[focal, 0.0, 799.5 + center[0]], [0.0, focal, 599.5 + center[1]], [0, 0, 1]])
    distortion = np.array([k1, 0.0, 0.0, 0.0, 0.0])
    return Camera(
        "tower", WIDE, matrix, distortion, np.array(position), look_at(position, (0.0, 0.0, 40.0))
    )


def errors(true: Camera, fit: CameraFit) -> FloatArray:
    """What the covariance is of."""
    found = fit.camera
    turn = cv2.Rodrigues(np.asarray(found.R_enu_camera).T @ np.asarray(true.R_enu_camera))[0]
    parts = [turn.ravel(), np.asarray(found.position) - true.position]
    if len(fit.names) > 6:
        parts += [
            [np.log(found.matrix[0, 0] / true.matrix[0, 0])],
            found.matrix[:2, 2] - true.matrix[:2, 2],
            [found.distortion[0] - true.distortion[0]],
        ]
    return np.concatenate(parts)


@pytest.mark.parametrize("position", [FRONT, SIDE, (3.0, -8.0, 41.0)])
@pytest.mark.parametrize("points", [FACE, FACE[[0, 2, 6, 8]], SPACE, SPACE[[0, 4, 11, 17, 24]]])
def test_resection_is_exact_without_noise(position: Any, points: FloatArray) -> None:
    focal = 150.0 * np.linalg.norm(np.array(position) - (0.0, 0.0, 40.0))
    true = camera(position, float(focal), k1=0.1, center=(11.0, -7.0))
    fit = resection(true, points, project(true, points))
    assert fit.names == POSE
    assert np.abs(errors(true, fit)).max() < 1e-6
    assert np.abs(fit.residuals).max() < 1e-6
    assert fit.camera.matrix is true.matrix


@pytest.mark.parametrize("points", [FACE, SPACE])
def test_a_pose_is_as_certain_as_it_says(points: FloatArray) -> None:
    true = camera(SIDE, k1=-0.05)
    # Some marks are seen better than others.
    covariance = (
        np.array([[0.09, 0.05], [0.05, 0.04]]) * (1.0 + np.arange(len(points)) % 3)[:, None, None]
    )
    square = []
    for seed in range(80):
        rng = np.random.default_rng(seed)
        noise = [rng.multivariate_normal([0.0, 0.0], c) for c in covariance]
        fit = resection(true, points, project(true, points) + noise, covariance)
        error = errors(true, fit)
        square.append(float(error @ np.linalg.solve(fit.covariance, error)))
    # χ² of 6: mean 6, deviation of the mean of 80 of them √(12/80) = 0.39.
    assert 4.8 < np.mean(square) < 7.2
    assert np.mean(np.array(square) < 10.64) > 0.82  # its 90 % point


def on_plane(seen: Camera, pixels: FloatArray) -> FloatArray:
    """Where pixels meet the plane north = 0."""
    lines = rays(seen, pixels)
    start = np.asarray(seen.position)
    return np.asarray(start - lines * (start[1] / lines[..., 1])[..., None])


@pytest.mark.parametrize(
    ("position", "points"), [(SIDE, FACE), (FRONT, FACE), (FRONT, FACE[[0, 2, 6, 8]])]
)
def test_marks_alone_map_the_plane_as_well_as_they_say(position: Any, points: FloatArray) -> None:
    grid = (0.5 * (points + points[:, None])).reshape(-1, 3)
    ratio, marginal = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        focal = 4000.0 * np.exp(rng.normal(0.0, 0.3))
        true = camera(position, focal, rng.normal(0.0, 0.1), rng.normal(0.0, 32.0, 2))
        pixels = project(true, points) + rng.normal(0.0, 0.2, (len(points), 2))
        fit = calibrate_marks(WIDE, [points], [pixels], 0.2)
        assert fit.names == POSE + INNER
        miss = on_plane(fit.camera, project(true, grid)) - grid
        ratio.append(np.sqrt(0.5 * np.mean(np.sum(miss**2, axis=-1))) / fit.plane_sigma)
        marginal.append(errors(true, fit) / np.sqrt(np.diag(fit.covariance)))
    assert 0.7 < np.sqrt(np.mean(np.square(ratio))) < 1.2
    if position is SIDE:
        # Each number by itself; together they are so stiff (a turn against the principal
        # point) that only a nonlinear law could say how they go together.
        assert 0.7 < np.sqrt(np.mean(np.square(marginal))) < 1.3


def test_depth_tells_all_but_the_priors() -> None:
    true = camera(SIDE, 6000.0, 0.15, (20.0, -12.0))
    fit = calibrate_marks(WIDE, [SPACE], [project(true, SPACE)], 0.01)
    assert fit.camera.matrix[0, 0] == pytest.approx(6000.0, rel=2e-3)
    assert fit.camera.distortion[0] == pytest.approx(0.15, abs=0.02)
    assert np.linalg.norm(fit.camera.position - true.position) < 0.1
    assert fit.sigma("log_focal") < 2e-3
    assert not any("focal" in note for note in fit.notes)
    assert fit.camera.deviation == pytest.approx(np.sqrt(np.mean(np.sum(fit.residuals**2, axis=1))))


def test_several_frames_of_a_camera_that_stands_still_are_one() -> None:
    true = camera(SIDE, 6000.0)
    rng = np.random.default_rng(5)
    parts = [SPACE[:9], SPACE[9:18], SPACE[18:]]
    pixels = [project(true, p) + rng.normal(0.0, 0.2, (9, 2)) for p in parts]
    split = calibrate_marks(WIDE, parts, pixels, 0.2)
    whole = calibrate_marks(WIDE, [SPACE], [np.concatenate(pixels)], 0.2)
    assert split.camera.position == pytest.approx(whole.camera.position, abs=1e-6)
    weighted = calibrate_marks(WIDE, parts, pixels, [np.full(9, 0.2)] * 3)
    assert weighted.covariance == pytest.approx(whole.covariance, rel=1e-6)


def test_a_plane_from_the_front_tells_no_focal_length_and_says_so() -> None:
    true = camera(FRONT)
    rng = np.random.default_rng(6)
    pixels = project(true, FACE) + rng.normal(0.0, 0.2, (9, 2))
    fit = calibrate_marks(WIDE, [FACE], [pixels], 0.2)
    assert fit.sigma("log_focal") > 0.5
    text = "focal length and distance cannot be determined separately"
    said = next(note for note in fit.notes if text in note)
    match = re.search(
        r"px at [\d.]+ m, uncertain by a factor of [\d.]+; .* accurate to (\d+\.\d) mm$", said
    )
    assert match
    # 0.2 px of 133 px/m are 1.5 mm; nine marks do better.
    assert 0.3 < float(match[1]) < 1.5
    center = next(note for note in fit.notes if "principal point" in note)
    assert f"± {CENTER_SIGMA * 1600:.0f} px" in center


def test_a_second_pose_is_told() -> None:
    # A small target far away: perspective is below the noise, and its tilt may be either way.
    small = 0.1 * (FACE - (0.0, 0.0, 40.0)) + (0.0, 0.0, 40.0)
    true = camera((25.0, -55.0, 40.0))
    rng = np.random.default_rng(7)
    fit = resection(true, small, project(true, small) + rng.normal(0.0, 0.5, (9, 2)), 0.5)
    assert fit.other is not None
    assert any("a second pose explains the points equally well" in note for note in fit.notes)
    nearest = min(
        float(np.linalg.norm(np.asarray(c.position) - true.position))
        for c in (fit.camera, fit.other)
    )
    assert nearest < 10.0
    near = resection(true, FACE, project(true, FACE) + rng.normal(0.0, 0.2, (9, 2)), 0.2)
    assert near.other is None


def test_a_point_that_is_named_wrongly_is_told() -> None:
    true = camera(SIDE)
    pixels = project(true, FACE)
    pixels[3] += (9.0, -5.0)
    fit = resection(true, FACE, pixels, 0.2)
    assert any(re.search(r"px at point 4, are \d+\.\d times", note) for note in fit.notes)
    clean = resection(true, FACE, project(true, FACE), 0.2)
    assert fit.sigma("east") > 5.0 * clean.sigma("east")


SEEN = project(camera(SIDE), FACE)


@pytest.mark.parametrize(
    ("points", "pixels", "sigma", "text"),
    [
        (FACE[:3], SEEN[:3], 0.3, "^3 points; four or more are needed to locate a camera$"),
        (FACE[:3].repeat(2, axis=0), SEEN[:6], 0.3, "6 points lie on one line"),
        (FACE[[0, 0, 0, 0]], SEEN[:4], 0.3, "4 points lie on one line"),
        (FACE, SEEN[:8], 0.3, r"points \(9, 3\) and pixels \(8, 2\)"),
        (FACE[:, :2], SEEN, 0.3, "the last axis must have 3 numbers"),
        (FACE * np.nan, SEEN, 0.3, "is not a finite number"),
        (
            FACE,
            np.where(np.arange(9)[:, None] == 4, np.nan, SEEN),
            0.3,
            r"pixels\[4\]: .* is not finite",
        ),
        (FACE, SEEN, 0.0, "a variance is not finite and above 0"),
        (FACE, SEEN, -0.3, "a variance is not finite and above 0"),
        (FACE, SEEN, float("nan"), "a variance is not finite and above 0"),
        (FACE, SEEN, [0.3, 0.3], r"sigma \(2,\); pass one number"),
        (FACE, SEEN, np.zeros((9, 2, 2)), "a variance is not finite and above 0"),
    ],
)
def test_points_that_cannot_be_used(points: Any, pixels: Any, sigma: Any, text: str) -> None:
    with pytest.raises(InputError, match=text):
        resection(camera(SIDE), points, pixels, sigma)


def test_frames_without_partners_are_refused() -> None:
    with pytest.raises(InputError, match="got 2 point lists and 1 pixel lists"):
        calibrate_marks(WIDE, [FACE, FACE], [SEEN])
    with pytest.raises(InputError, match="got 0 point lists"):
        calibrate_marks(WIDE, [], [])
    with pytest.raises(InputError, match=r"^3 points; four or more"):
        calibrate_marks(WIDE, [FACE[:2], FACE[3:4]], [SEEN[:2], SEEN[3:4]])
