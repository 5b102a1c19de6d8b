"""The flux on a receiver by its camera: true shares, changing daylight, and all that hides light.

The true share comes from the mirrors (`twin.sensors.light_share`), the frames from the renderer.
"""

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.receiver_file import read_reference, write_reference
from heliotrope.imaging.receiver_light import (
    ReceiverReference,
    ReceiverSight,
    receiver_light,
    take_reference,
)
from heliotrope.imaging.synthetic.scenes import LensEffects, Sensor, Shadow
from support.receiver_scene import (
    CAMERA,
    SENSOR,
    capped,
    frame,
    mirrors,
    reference,
    sight,
    true_share,
)

#: Stated accuracy: a share of the nominal flux, and a share of the reading.
OFF, RELATIVE = 0.005, 0.02


@pytest.fixture(scope="module")
def known() -> ReceiverReference:
    return reference()


def near(share: float) -> object:
    return pytest.approx(share, abs=OFF, rel=RELATIVE)


@pytest.mark.parametrize("ambient", [40.0, 150.0, 500.0])
@pytest.mark.parametrize("on", [0, 1, 2, 10, 20])
def test_the_share_is_the_mirrors(known: ReceiverReference, on: int, ambient: float) -> None:
    light = receiver_light(frame(on, ambient=ambient, seed=on), known)
    assert light.doubt == ""
    assert light.share == near(true_share(mirrors(on)))


def test_beams_elsewhere_on_the_receiver_count_the_same(known: ReceiverReference) -> None:
    light = receiver_light(frame(6, seed=3, aside=(0.6, -0.4)), known)
    assert (light.doubt, light.share) == ("", near(true_share(mirrors(6))))


def test_beams_beside_the_receiver_hide_none_on_it(known: ReceiverReference) -> None:
    """They light the surroundings on one side, which must not pass for daylight."""
    both = replace(frame(3, seed=4), name="both")
    beside = frame(14, seed=5, aside=(5.5, 0.0)).pixels.astype(np.float64)
    dark = frame(0, seed=6).pixels.astype(np.float64)
    pixels = np.clip(both.pixels + beside - dark, 0.0, 65535.0).astype(np.uint16)
    light = receiver_light(replace(both, pixels=pixels), known)
    # What spills onto the receiver itself is light too.
    assert light.share >= true_share(mirrors(3)) - OFF


def test_a_shadow_on_one_side_hides_no_light(known: ReceiverReference) -> None:
    shadow = Shadow((-4.0, 0.0), np.pi, 0.2, 0.3)
    light = receiver_light(frame(2, seed=7, shadow=shadow), known)
    true = true_share(mirrors(2))
    # The daylight that is left out counts as flux: to the safe side.
    assert true - OFF <= light.share <= true + known.daylight


@pytest.mark.parametrize("colour", [False, True])
def test_a_camera_of_eight_bits_with_a_tone_curve(colour: bool) -> None:
    sensor = Sensor(exposure=3e-4, bits=8, srgb=True, colour=colour)
    known = reference(sensor, 2.2)
    for on in (0, 2, 12):
        for ambient in (100.0, 250.0):
            light = receiver_light(frame(on, seed=on, sensor=sensor, ambient=ambient), known)
            assert light.doubt == ""
            # A power of 2.2 meets the curve of sRGB only roughly where it is dark.
            assert light.share == pytest.approx(true_share(mirrors(on)), abs=0.04, rel=0.08)


@pytest.mark.parametrize("factor", [0.8, 0.4, 0.15])
def test_an_exposure_that_is_cut_unsaid_hides_no_light(
    known: ReceiverReference, factor: float
) -> None:
    sensor = replace(SENSOR, exposure=factor * SENSOR.exposure)
    shown = replace(frame(4, seed=6, sensor=sensor), exposure=np.nan)
    light = receiver_light(shown, known)
    assert light.share == pytest.approx(true_share(mirrors(4)), abs=0.02)
    # Without beams, dim daylight reads as darkness all the same.
    dim = replace(frame(0, seed=7, ambient=factor * 150.0), exposure=np.nan)
    assert receiver_light(dim, known).share < 0.03


# -- what may hide light -------------------------------------------------------------------


def moved(given: Frame, right: int) -> Frame:
    return replace(given, pixels=np.roll(given.pixels, right, axis=1))


def covered(given: Frame) -> Frame:
    """A bright cloth before the lens."""
    blurred = cv2.GaussianBlur(given.pixels, (0, 0), 25.0)
    noise = np.random.default_rng(1).normal(0.0, 60.0, given.pixels.shape)
    return replace(given, pixels=np.clip(blurred + noise, 0, 65535).astype(np.uint16))


LONG = replace(SENSOR, exposure=1000 * SENSOR.exposure)


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (lambda: capped(5), "show 0% of the reference's daylight"),
        (lambda: replace(capped(), pixels=np.zeros_like(capped().pixels)), "covers the lens"),
        (lambda: frame(ambient=5.0), "night, or something covers the lens"),
        (lambda: frame(ambient=800.0), "times as bright as in the reference; the limit is 4"),
        (lambda: replace(frame(sensor=LONG), exposure=np.nan), "surroundings .* overexposed"),
        (lambda: frame(sensor=LONG), "exposure times gain is 0.3 s, that of the reference 0.0003"),
        (lambda: moved(frame(), 6), "the picture has moved by 6 px"),
        (lambda: moved(frame(), 25), "do not match the reference; the camera was moved"),
        (lambda: covered(frame()), "something is in front of it"),
        (lambda: replace(frame(), pixels=np.flipud(frame().pixels)), "do not match the reference"),
    ],
)  # fmt: skip
def test_darkness_that_is_not_proven(known: ReceiverReference, shown: object, text: str) -> None:
    light = receiver_light(shown(), known)  # type: ignore[operator]
    assert light.share < 0.1 or "exposure" in text or "overexposed" in text
    assert re.search(text, light.doubt), light.doubt


@pytest.mark.parametrize(
    "pixels", [np.zeros((120, 160), np.uint16), np.zeros((240, 320), np.uint8)]
)
def test_another_kind_of_frame_is_not_measured(known: ReceiverReference, pixels: object) -> None:
    light = receiver_light(Frame(pixels), known)  # type: ignore[arg-type]
    assert not light.share >= 0.0
    assert "but the reference has 320 × 240 px of 16 bit" in light.doubt


def test_overexposed_pixels_leave_a_lower_bound(known: ReceiverReference) -> None:
    sensor = replace(SENSOR, exposure=4 * SENSOR.exposure)
    long = reference(sensor, 1.0, 1)
    assert receiver_light(frame(1, seed=9, sensor=sensor), long).share == near(
        true_share(mirrors(1))
    )
    light = receiver_light(frame(20, seed=8, sensor=sensor), long)
    assert "of the receiver is overexposed; shorten the exposure" in light.doubt
    assert 0.1 < light.share < 0.9
    # A small spot of unknown strength, little in the mean.
    spot = frame(0, seed=8)
    spot.pixels[115:120, 155:160] = 65535
    light = receiver_light(spot, known)
    assert "of the receiver is overexposed" in light.doubt
    assert 0.0 < light.share < 0.1


def test_a_receiver_with_a_cloth_before_it(known: ReceiverReference) -> None:
    """Black cloth on the receiver alone: the surroundings are as ever."""
    shown = frame(seed=10)
    rows, columns = known.sight.box
    pixels = shown.pixels.copy()
    pixels[rows, columns][known.sight.face] = int(65535 * known.black)
    light = receiver_light(replace(shown, pixels=pixels), known)
    assert "darker than in daylight without beams" in light.doubt


# -- the reference -------------------------------------------------------------------------


def test_a_reference_comes_back_from_its_file(known: ReceiverReference, tmp_path: Path) -> None:
    write_reference(known, tmp_path / "receiver.toml")
    again = read_reference(tmp_path / "receiver.toml")
    shown = frame(5, seed=11)
    assert receiver_light(shown, again) == receiver_light(shown, known)
    assert again.exposure == known.exposure
    text = (tmp_path / "receiver.toml").read_text()
    (tmp_path / "receiver.toml").write_text(text.replace("rise = ", "rise = -"))
    with pytest.raises(FormatError, match=r"receiver\.toml: camera eye: receiver receiver: a ref"):
        read_reference(tmp_path / "receiver.toml")
    (tmp_path / "receiver.toml").write_text(text)
    cv2.imwrite(str(tmp_path / "receiver.png"), np.zeros((20, 20), np.uint16))
    with pytest.raises(FormatError, match="picture of its surroundings has"):
        read_reference(tmp_path / "receiver.toml")


def auto(on: int) -> Frame:
    """A camera that darkens its picture, and does not say so."""
    found = frame(on, seed=12, sensor=replace(SENSOR, exposure=0.5 * SENSOR.exposure))
    return replace(found, exposure=np.nan)


@pytest.mark.parametrize(
    ("dark", "lit", "text"),
    [
        (lambda: capped(1), lambda: [(frame(4), 0.2)], "shows 0 sides .* brighter than a capped"),
        (frame, list, "no photograph with beams; pass one with its fraction"),
        (frame, lambda: [(frame(4), 0.0)], "must be above 0 and at most 2"),
        (frame, lambda: [(auto(4), 0.2)], "with one fixed exposure, within a minute"),
        (frame, lambda: [(frame(4, sensor=LONG), 0.2)], "of the receiver is overexposed; use few"),
        (frame, lambda: [(frame(4), 0.2), (frame(8), 0.7)], "check the fractions and the line"),
        (frame, lambda: [(frame(0), 0.2), (frame(4), 0.2)], "check the fractions"),
        (frame, lambda: [(moved(frame(4), 30), 0.2)], "4 mirrors: the surroundings of the"),
        (frame, lambda: [(Frame(np.zeros((9, 9), np.uint16), "b.png"), 0.2)], "b.png has 9 × 9 px"),
    ],
)  # fmt: skip
def test_photographs_that_make_no_reference(dark: object, lit: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        take_reference(sight(), capped(), dark(), lit())  # type: ignore[operator]


def test_an_outline_that_cannot_be_measured() -> None:
    corners = sight().outline
    for outline, text in (
        (corners + [200.0, 0.0], "its outline leaves the frame of 320 × 240 px"),
        (corners.mean(axis=0) + 0.05 * (corners - corners.mean(axis=0)), "px in the frame, below"),
        (corners[:2], "specify 3 corners or more"),
        ([[0, 0], [319, 0], [319, 239], [0, 239]], "0 of its four sides have a margin"),
    ):
        with pytest.raises(InputError, match=text):
            ReceiverSight("eye", "receiver", CAMERA.size, np.array(outline, dtype=float))


def test_a_veil_of_stray_light_is_no_movement(known: ReceiverReference) -> None:
    light = receiver_light(frame(20, seed=13, lens=LensEffects(veil=0.05)), known)
    assert light.doubt == ""
    assert light.share == pytest.approx(1.0, abs=0.06)
