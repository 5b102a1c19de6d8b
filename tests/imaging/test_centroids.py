"""The simple ways to find a centroid do what they say, and no more."""

import numpy as np
import pytest
from benchmarks._centroids import malan_centroid, marker_threshold, moments_centroid

from heliotrope.field.target import Target
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import read_crop
from heliotrope.imaging.targets.rectify import Rectified, from_crop

TARGET = Target(
    "t", np.array([[-4.0, 0, 44], [4, 0, 44], [4, 0, 36], [-4, 0, 36]]), np.array([0.0, 0, 40])
)


def _picture(
    beams: list[tuple[float, float, float]], slope: float = 0.0, light: float = 80.0
) -> Rectified:
    """Gaussian beams (right, up, height) of 0.6 m on light that grows to the right."""
    y, x = np.mgrid[255:-1:-1, 0:256] * (8.0 / 256) - 4.0 + 4.0 / 256
    shine = light + slope * x
    for right, up, height in beams:
        shine = shine + height * np.exp(-((x - right) ** 2 + (y - up) ** 2) / (2 * 0.6**2))
    noise = np.random.default_rng(1).normal(0.0, 0.5, shine.shape)
    pixels = np.clip(np.round(shine + noise), 0, 255).astype(np.uint8)
    return from_crop(Frame(pixels), TARGET)


def _grey(values: list[list[int]]) -> Rectified:
    return from_crop(Frame(np.kron(np.array(values), np.ones((64, 64))).astype(np.uint8)), TARGET)


def test_malans_thresholds_are_as_printed() -> None:
    """(5.2): T1 = darkest + 0.2 · lightest; (5.3): T2 = (mean + lowest) / 2; (5.4)."""
    picture = _grey([[200, 40, 40, 40], [40, 40, 40, 40], [40, 40, 40, 40], [40, 40, 40, 140]])
    assert marker_threshold(picture.values) == pytest.approx((40 + 0.2 * 200) / 255)
    # The mean is 56.25, so T2 = 48.1: the two bright squares remain, at ∓3 and ±3 m.
    found = malan_centroid(picture)
    assert found == pytest.approx([3 * (140 - 200) / 340, 3 * (200 - 140) / 340], abs=0.02)


def test_both_find_a_lone_round_beam_on_a_dark_target() -> None:
    picture = _picture([(0.7, -0.4, 150.0)], light=0.0)
    assert malan_centroid(picture) == pytest.approx([0.7, -0.4], abs=0.02)
    assert moments_centroid(picture) == pytest.approx([0.7, -0.4], abs=0.02)


def test_lit_paint_draws_malans_centroid_to_the_middle() -> None:
    picture = _picture([(0.7, -0.4, 100.0)])
    found = malan_centroid(picture)
    assert found is not None
    assert np.linalg.norm(found - [0.7, -0.4]) > 0.2
    assert np.linalg.norm(found) < np.linalg.norm([0.7, -0.4])


def test_uneven_light_moves_the_moments_and_not_the_default() -> None:
    picture = _picture([(-1.5, 0.5, 40.0)], slope=8.0)
    moments = moments_centroid(picture)
    assert moments is not None
    assert np.linalg.norm(moments - [-1.5, 0.5]) > 0.2
    frame = Frame(np.round(picture.values * 255.0).astype(np.uint8))
    spot = read_crop(frame, TARGET).readings[0].spots[0]
    assert np.linalg.norm(spot.plane - [-1.5, 0.5]) < 0.03


def test_a_second_beam_moves_the_thresholds_and_not_the_default() -> None:
    picture = _picture([(-1.8, 0.0, 100.0), (2.0, 1.0, 60.0)])
    found = malan_centroid(picture)
    assert found is not None
    assert np.linalg.norm(found - [-1.8, 0.0]) > 0.5
    frame = Frame(np.round(picture.values * 255.0).astype(np.uint8))
    reading = read_crop(frame, TARGET).readings[0]
    assert np.linalg.norm(reading.spots[0].plane - [-1.8, 0.0]) < 0.03
    assert "several spots" in [r.name for r in reading.reasons]


def test_nothing_bright_is_nothing() -> None:
    black = from_crop(Frame(np.zeros((256, 256), dtype=np.uint8)), TARGET)
    assert moments_centroid(black) is None
    assert malan_centroid(black) is None
