"""Frames: white, where pixels clip, is the frame's own where it lies below the full scale."""

from typing import Any

import numpy as np
import pytest

from heliotrope.field.camera import project
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import PhotographSettings, read_photograph
from heliotrope.imaging.synthetic.rendering import Scene, Sensor, Thrown, exposed, render
from heliotrope.imaging.synthetic.scenes import example_camera, example_target
from heliotrope.optics.mirror_image import gaussian_beam


def bell(peak: float, kind: Any, noise: float = 0.004) -> Any:
    """Return a bright spot over a dim ground, (240, 320), with noise as a share of its peak."""
    y, x = np.indices((240, 320))
    light = 0.25 + 0.75 * np.exp(-((x - 150) ** 2 + (y - 120) ** 2) / (2.0 * 35.0**2))
    light = light + noise * np.random.default_rng(3).standard_normal(light.shape)
    return np.asarray(np.round(np.clip(peak * light, 0, np.iinfo(kind).max)), dtype=kind)


@pytest.mark.parametrize(
    ("kind", "peak", "white"),
    [
        (np.uint8, 330.0, 255),
        (np.uint8, 330.0, 235),
        (np.uint8, 200.0, 150),
        (np.uint16, 5500.0, 4095),
        (np.uint16, 1500.0, 1023),
        (np.uint16, 80_000.0, 65_520),
    ],
)
def test_a_plateau_is_clipping_wherever_it_lies(kind: Any, peak: float, white: int) -> None:
    frame = Frame(np.minimum(bell(peak, kind), kind(white)))
    at_white = frame.pixels == white
    assert at_white.sum() > 1000
    assert (frame.clipped[at_white] == 255).all()
    assert not frame.clipped[frame.pixels < 0.98 * white].any()


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.004, 0.02])
@pytest.mark.parametrize(("kind", "peak"), [(np.uint8, 180.0), (np.uint16, 4000.0)])
def test_a_smooth_top_is_no_plateau(kind: Any, peak: float, noise: float) -> None:
    assert not Frame(bell(peak, kind, noise)).clipped.any()


def test_hot_pixels_hide_no_plateau() -> None:
    pixels = np.minimum(bell(330.0, np.uint8), np.uint8(235))
    pixels[5, 10:20] = 250
    assert (Frame(pixels).clipped[pixels == 235] == 255).all()


def test_dark_and_flat_frames_have_no_plateau() -> None:
    for value in (0, 3, 200):
        assert not Frame(np.full((60, 80), value, dtype=np.uint8)).clipped.any()


def test_each_channel_has_its_own_white() -> None:
    pixels = np.stack([bell(120.0, np.uint8), bell(160.0, np.uint8), bell(330.0, np.uint8)], -1)
    pixels[..., 2] = np.minimum(pixels[..., 2], 235)
    frame = Frame(pixels)
    assert frame.grey.max() < 200
    # Red has 0.299 of the brightness.
    at_white = pixels[..., 2] == 235
    np.testing.assert_allclose(frame.clipped[at_white] / 255.0, 0.299**2, atol=0.003)
    assert not frame.clipped[pixels[..., 2] < 230].any()
    pixels[..., :2] = pixels[..., 2:]
    assert (Frame(pixels).clipped[at_white] == 255).all()


@pytest.mark.parametrize("bits", [8, 12])
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_a_beam_that_clips_below_the_full_scale_is_named(bits: int, gamma: float) -> None:
    target = example_target(8.0)
    camera = example_camera(target, 200.0, (1000, 750))
    thrown = Thrown("target", gaussian_beam((0.9, -0.6), 0.7, 0.5), 200.0)
    sensor = Sensor(bits=bits, colour=False)
    frame = render(exposed(Scene(camera, (target,), (thrown,), sensor=sensor), 0.8), 5).frame
    settings = PhotographSettings(gamma=gamma)

    def reasons(pixels: Any) -> set[str]:
        (reading,) = read_photograph(Frame(pixels), [target], camera, settings=settings).readings
        return {reason.name for reason in reading.reasons}

    assert "saturated" not in reasons(frame.pixels)
    # Half of the way from paint to the beam's top.
    places = project(camera, target.point(np.array([[0.9, -0.6], [-2.5, 2.5]])))
    top, paint = (float(frame.pixels[round(y), round(x)]) for x, y in places)
    white = int(paint + 0.5 * (top - paint))
    assert "saturated" in reasons(np.minimum(frame.pixels, white).astype(frame.pixels.dtype))
