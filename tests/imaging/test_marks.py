"""Marks: what they look like, and where they are in a frame to hundredths of a pixel."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets import refinement
from heliotrope.imaging.targets.marks import polygons, tag_cells, tag_dictionary
from heliotrope.imaging.targets.refinement import Refined, locate, refine
from heliotrope.optics.coverage import coverage

ORIGIN = np.zeros(3)
MARKS = {
    "corner": Mark("m", "corner", ORIGIN, 0.6, 0.12),
    "tee": Mark("m", "tee", ORIGIN, 0.6, 0.12, turn=0.5),
    "square": Mark("m", "square", ORIGIN, 0.4, turn=0.2),
    "disc": Mark("m", "disc", ORIGIN, 0.4),
    "tag": Mark("m", "tag", ORIGIN, 0.6, code="4X4_50:7"),
    "apriltag": Mark("m", "tag", ORIGIN, 0.8, code="APRILTAG_36h11:3", turn=-0.3),
}
#: Pixels per metre of a plane seen from the side by a tilted camera.
SCALE = np.array([[62.0, -14.0], [-9.0, -51.0]])


def area(polygon: FloatArray) -> float:
    x, y = polygon.T
    return 0.5 * abs(float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


def drawn(
    mark: Mark,
    pixel: FloatArray,
    scale: FloatArray = SCALE,
    *,
    blur: float = 0.7,
    paint: float = 180.0,
    print_: float = 25.0,
    noise: float = 0.0,
    size: int = 144,
) -> FloatArray:
    """A mark on paint, by counting 16 × 16 places in each pixel, (144, 144)."""
    fine = 16
    raster = np.zeros((size * fine, size * fine), dtype=np.uint8)
    for shape in polygons(mark):
        places = (pixel + shape @ scale.T + 0.5) * fine - 0.5
        # Of a polygon's border OpenCV draws half a place too much, the same on all sides.
        cv2.fillPoly(raster, [np.round(places * 256).astype(np.int32)], 1, shift=8)
    share = raster.reshape(size, fine, size, fine).mean(axis=(1, 3))
    share = cv2.GaussianBlur(share, (0, 0), blur)
    rng = np.random.default_rng(4)
    return np.asarray(paint + (print_ - paint) * share + noise * rng.standard_normal(share.shape))


def eight(image: FloatArray) -> Image:
    return np.asarray(np.clip(np.round(image), 0, 255), dtype=np.uint8)


def found(grey: Image, mark: Mark, about: FloatArray, search: float = 0.3) -> Refined:
    refined = refine(grey, mark, about, SCALE, search)
    assert refined is not None
    return refined


# -- drawings --------------------------------------------------------------------------


def test_drawings_cover_what_their_sizes_say() -> None:
    arms = 0.6 * 0.12 + (0.6 - 0.12) * 0.12
    assert area(polygons(MARKS["corner"])[0]) == pytest.approx(arms)
    assert area(polygons(MARKS["tee"])[0]) == pytest.approx(arms)
    assert area(polygons(MARKS["square"])[0]) == pytest.approx(0.16)
    assert area(polygons(MARKS["disc"])[0]) == pytest.approx(np.pi * 0.04, rel=2e-3)
    cells = tag_cells(MARKS["tag"])
    total = sum(area(p) for p in polygons(MARKS["tag"]))
    assert total == pytest.approx(cells.mean() * 0.36)


def test_a_turn_is_counterclockwise_as_seen_from_the_front() -> None:
    turned = polygons(replace(MARKS["corner"], turn=0.5 * np.pi))[0]
    # Arms to the right and down become arms up and to the right.
    np.testing.assert_allclose(turned.min(axis=0), [0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(turned.max(axis=0), [0.6, 0.6], atol=1e-12)


def test_tags_are_those_of_opencv() -> None:
    for code, number in (("4X4_50:7", cv2.aruco.DICT_4X4_50), ("DICT_5X5_100:99", 5)):
        mark = replace(MARKS["tag"], code=code)
        assert tag_dictionary(mark)[0] == number
        side = 8 * len(tag_cells(mark))
        dictionary = cv2.aruco.getPredefinedDictionary(number)
        wanted = cv2.aruco.generateImageMarker(dictionary, tag_dictionary(mark)[1], side)
        cells = [(p * [1, -1] + 0.5 * mark.size) * (side / mark.size) - 0.5 for p in polygons(mark)]
        np.testing.assert_allclose(1.0 - coverage(cells, (side, side)), wanted / 255.0, atol=1e-9)


def test_codes_that_name_no_tag_are_refused() -> None:
    with pytest.raises(InputError, match=r"code '4X4:7' is not a tag; write for example 4X4_50:7"):
        tag_dictionary(replace(MARKS["tag"], code="4X4:7"))
    with pytest.raises(InputError, match=r"the dictionary holds 0 to 49"):
        tag_cells(replace(MARKS["tag"], code="4X4_50:50"))
    with pytest.raises(InputError, match="a picture has no polygons"):
        polygons(Mark("m", "picture", ORIGIN, 0.5, code="a.png"))


def test_covered_areas_are_exact() -> None:
    rng, fine = np.random.default_rng(2), 24
    y, x = (np.mgrid[0 : 16 * fine, 0 : 16 * fine] + 0.5) / fine
    for _ in range(5):
        triangle = rng.uniform(1.0, 15.0, (3, 2))
        share = coverage([triangle - 0.5], (16, 16))
        assert share.sum() == pytest.approx(area(triangle), abs=1e-9)
        sides = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) > 0.0
            for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True)
        ]
        inside = np.all(sides, axis=0) | ~np.any(sides, axis=0)
        counted = inside.reshape(16, fine, 16, fine).mean(axis=(1, 3))
        np.testing.assert_allclose(share, counted, atol=0.03)
    box = np.array([(1.5, 2.25), (6.75, 2.25), (6.75, 16.0), (1.5, 16.0)])
    share = coverage([box - 0.5], (16, 16))
    np.testing.assert_allclose(share[[2, 2, 15], [1, 3, 3]], [0.375, 0.75, 1.0])


# -- places ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", list(MARKS))
def test_marks_are_found_without_bias(kind: str) -> None:
    mark, rng = MARKS[kind], np.random.default_rng(1)
    off = []
    for _ in range(12):
        true = 68.0 + rng.uniform(-8.0, 8.0, 2)
        refined = found(eight(drawn(mark, true, noise=2.0)), mark, true + rng.uniform(-5, 5, 2))
        off.append(refined.pixel - true)
        assert refined.explained > (0.9 if mark.kind != "tag" else 0.8)
        assert refined.contrast < 0.3
        assert np.abs(refined.shape).max() < 0.05
    assert np.abs(np.mean(off, axis=0)).max() < 0.03
    assert np.sqrt(np.mean(np.square(off))) < 0.06


@pytest.mark.parametrize("kind", ["corner", "square", "tag"])
def test_a_mark_of_another_size_is_told(kind: str) -> None:
    true = np.array([68.0, 67.0])
    mark = MARKS[kind]
    taller = np.diag([1.0, 1.05])
    grey = eight(drawn(replace(mark, turn=0.0), true, SCALE @ taller))
    refined = found(grey, replace(mark, turn=0.0), true)
    # Robust weights take the ends of a longer arm for something else, in part.
    assert 0.02 < refined.shape[1, 1] < 0.06
    assert np.abs(refined.shape - np.diag([0.0, refined.shape[1, 1]])).max() < 0.012


def test_blur_veil_and_uneven_light_move_nothing() -> None:
    true, mark = np.array([66.3, 69.1]), MARKS["corner"]
    y, x = np.mgrid[0:144, 0:144]
    for image in (
        drawn(mark, true, blur=2.5),
        drawn(mark, true, paint=220.0, print_=150.0),
        drawn(mark, true) * (0.4 + 0.006 * x + 0.003 * y),
        drawn(mark, true, paint=9.0, print_=2.0),
    ):
        refined = found(eight(image), mark, true + [3.0, -2.0])
        np.testing.assert_allclose(refined.pixel, true, rtol=0, atol=0.06)


@pytest.mark.parametrize("cut", [-9.0, -3.0, 4.0, 12.0])
def test_an_edge_of_shade_across_a_mark_moves_it_little(cut: float) -> None:
    true, mark = np.array([64.0, 66.0]), MARKS["corner"]
    y, x = np.mgrid[0:144, 0:144]
    shade = 1.0 / (1.0 + np.exp(-((x - true[0]) + 0.4 * (y - true[1]) - cut)))
    refined = found(eight(drawn(mark, true) * (0.35 + 0.65 * shade)), mark, true + [2.0, 2.0])
    np.testing.assert_allclose(refined.pixel, true, rtol=0, atol=0.35)
    assert refined.explained > 0.6


def test_frames_of_sixteen_bits_are_read_as_they_are() -> None:
    true, mark = np.array([68.4, 66.8]), MARKS["tee"]
    # As little light as eight bits would show in three counts.
    grey = np.round(4.0 * drawn(mark, true, noise=2.0)).astype(np.uint16)
    np.testing.assert_allclose(found(grey, mark, true).pixel, true, rtol=0, atol=0.05)


def test_covariances_are_those_of_the_noise() -> None:
    true, mark, rng = np.array([68.0, 67.5]), MARKS["corner"], np.random.default_rng(3)
    clean = drawn(mark, true, paint=60.0, print_=20.0)
    off, expected = [], []
    for _ in range(30):
        grey = eight(clean + 12.0 * rng.standard_normal(clean.shape))
        refined = found(grey, mark, true, search=0.0)
        off.append(refined.pixel - true)
        expected.append(refined.covariance)
    errors = np.mean([e @ np.linalg.solve(c, e) for e, c in zip(off, expected, strict=True)])
    # Two for two coordinates. What no fit sees is in the covariance, but not in these frames.
    assert 0.5 < errors < 3.0


def test_what_is_not_there_is_not_explained() -> None:
    rng = np.random.default_rng(6)
    place = np.array([68.0, 68.0])
    for _ in range(15):
        blobs = cv2.GaussianBlur(rng.standard_normal((144, 144)), (0, 0), rng.uniform(0.5, 12.0))
        grey = eight(120.0 + 30.0 * blobs / blobs.std())
        # Blobs are discs, and many are squares.
        for kind in ("corner", "tee", "tag", "apriltag"):
            refined = refine(grey, MARKS[kind], place, SCALE, 0.4)
            assert (
                refined is None
                or refined.explained < 0.7
                or refined.contrast > 0.93
                or np.abs(refined.shape).max() > 0.2
            )


def test_marks_beyond_the_frame_or_too_small_are_none() -> None:
    grey = eight(drawn(MARKS["disc"], np.array([68.0, 68.0])))
    assert refine(grey, MARKS["disc"], np.array([250.0, 68.0]), SCALE) is None
    assert refine(grey, MARKS["disc"], np.array([142.0, 68.0]), SCALE, 0.0) is None
    assert refine(grey, MARKS["disc"], np.array([68.0, 68.0]), 0.3 * SCALE) is None
    assert refine(grey, MARKS["disc"], np.array([np.nan, 68.0]), SCALE, 0.0) is None
    assert locate(grey, MARKS["disc"], np.array([68.0, 68.0]), np.nan * SCALE, 0.5) is None


def test_a_taught_picture_is_found_in_other_light() -> None:
    rng = np.random.default_rng(8)
    count, size = 41, 0.5
    picture = cv2.GaussianBlur(rng.uniform(0.0, 255.0, (count, count)), (0, 0), 2.0)
    mark, true = Mark("m", "picture", ORIGIN, size, code="a.png"), np.array([67.3, 69.2])
    # Plane to the picture's pixels, and from those to the frame's.
    step = size / count
    linear = SCALE @ np.diag([step, -step])
    affine = np.column_stack([linear, true - linear @ np.full(2, 0.5 * (count - 1))])
    image = cv2.warpAffine(picture, affine, (144, 144), borderMode=cv2.BORDER_REFLECT)
    refined = refine(eight(40.0 + 0.3 * image), mark, true + [4.0, -3.0], SCALE, 0.4, picture)
    assert refined is not None
    np.testing.assert_allclose(refined.pixel, true, rtol=0, atol=0.1)
    assert refined.explained > 0.8


def test_drawings_are_made_once() -> None:
    refinement._drawn.cache_clear()
    mark, place = MARKS["corner"], np.array([68.0, 68.0])
    for move in (0.0, 0.3, 0.7):
        refine(eight(drawn(mark, place + move)), mark, place, SCALE * (1.0 + 0.001 * move))
    assert refinement._drawn.cache_info().misses <= 2
