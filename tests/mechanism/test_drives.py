"""Drives: counts to angle and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.errors import InputError
from heliotrope.mechanism import drives

_LIMIT = 1e-9  # rad


@given(
    zero=st.floats(-3, 3),
    sense=st.sampled_from([-1, 1]),
    scale=st.floats(-0.05, 0.05),
    bias=st.floats(-0.5, 0.5),
    worm=st.floats(-0.012, 0.012),
    sine=st.floats(-0.012, 0.012),
    sag=st.floats(-0.01, 0.01),
    seed=st.integers(0, 99),
)
def test_rotary_inverse(zero, sense, scale, bias, worm, sine, sag, seed) -> None:  # type: ignore[no-untyped-def]
    drive = drives.rotary(
        200,
        2400,
        microsteps=16,
        zero=zero,
        sense=sense,
        scale=scale,
        bias=bias,
        worm_cos=worm,
        worm_sin=sine,
        worm_ratio=40.0,
        sag=sag,
        sag_phase=0.3,
    )
    counts = np.random.default_rng(seed).uniform(-4e6, 4e6, 50)
    angles = drive.angles(counts)
    np.testing.assert_allclose(drive.angles(drive.counts(angles)), angles, rtol=0, atol=_LIMIT)
    back = (drive.counts(angles) - counts) * drive.radians_per_count(counts)
    assert np.abs(back).max() < _LIMIT


@given(
    stroke=st.floats(0.061, 0.12),
    offset=st.floats(0.30, 0.36),
    radius=st.floats(0.30, 0.36),
    clockwise=st.sampled_from([0, 1]),
    worm=st.floats(-5e-4, 5e-4),
    sag=st.floats(-0.01, 0.01),
)
def test_jack_inverse(stroke, offset, radius, clockwise, worm, sag) -> None:  # type: ignore[no-untyped-def]
    drive = drives.linear_paint(
        154166.6667,
        stroke,
        offset,
        radius,
        0.04,
        clockwise=clockwise,
        worm_cos=worm,
        worm_sin=worm / 3,
        worm_ratio=500.0,
        sag=sag,
        bias=0.01,
        scale=0.002,
    )
    counts = np.linspace(0.0, 70000.0, 41)
    angles = drive.angles(counts)
    np.testing.assert_allclose(drive.angles(drive.counts(angles)), angles, rtol=0, atol=_LIMIT)


@pytest.mark.parametrize("sense", [1, -1])
def test_the_three_forms_of_a_jack_are_one(sense: int) -> None:
    a, b, length, rate, angle = 0.34, 0.33, 0.09, 1 / 154166.0, 0.25
    grigoriev = drives.linear_grigoriev(a, b, length, rate, angle_zero=angle, sense=sense)
    included = np.arccos((a * a + b * b - length * length) / (2 * a * b))
    at_zero = angle + sense * included
    guo = drives.linear_guo(a, b, np.pi - angle, length, rate)
    paint = drives.linear_paint(1 / rate, length, a, b, at_zero, clockwise=int(sense < 0))
    counts = np.linspace(0, 60000, 13)
    # The law of cosines itself.
    stroke = length + rate * counts
    wanted = angle + sense * np.arccos((a * a + b * b - stroke**2) / (2 * a * b))
    # Guo's angle falls as the jack lengthens: his triangle is on the other side.
    for drive in (grigoriev, paint, *([guo] if sense < 0 else [])):
        np.testing.assert_allclose(drive.angles(counts), wanted, rtol=0, atol=1e-12)


def test_gears() -> None:
    drive = drives.rotary(200, 90, microsteps=16)
    assert drive.angles(200 * 16 * 90) == pytest.approx(2 * np.pi, abs=1e-12)
    assert drives.rotary(200, 90, sense=-1).angles(200 * 90 / 4) == pytest.approx(-np.pi / 2)
    assert drives.direct().angles(0.3) == 0.3
    assert drives.direct(min_angle=np.zeros(3)).shape == (3,)
    assert drives.direct().angles(np.empty(0)).shape == (0,)


@pytest.mark.parametrize("kind", ["rotary", "linear"])
def test_slope_is_the_derivative(kind: str) -> None:
    if kind == "rotary":
        drive = drives.rotary(200, 2400, worm_cos=1e-3, worm_sin=-2e-3, worm_ratio=40, sag=0.01)
    else:
        drive = drives.linear_paint(
            154166.0, 0.08, 0.34, 0.32, 0.1, worm_cos=2e-4, worm_ratio=500, sag=0.01
        )
    counts = np.linspace(1000.0, 60000.0, 31)
    step = 1.0
    central = (drive.angles(counts + step) - drive.angles(counts - step)) / (2 * step)
    np.testing.assert_allclose(drive.radians_per_count(counts), central, rtol=1e-6, atol=1e-13)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: drives.rotary(200, 0), "must be above 0"),
        (lambda: drives.rotary(200, 10, sense=2), r"sense must be \+1 or −1, not 2"),
        (lambda: drives.rotary(200, 10, min_angle=1, max_angle=0), "angle stop 1 is above"),
        (lambda: drives.rotary(200, 10, min_count=5, max_count=2), "count stop 5 is above"),
        (lambda: drives.rotary(200, 10, speed=0), "speed must be above 0"),
        (lambda: drives.rotary(200, 10, scale=-1), "stand still"),
        (lambda: drives.rotary(200, 10, worm_cos=0.1, worm_ratio=40), "backwards"),
        (lambda: drives.rotary(200, 10, bias=np.nan), "bias: nan is not a number"),
        (lambda: drives.rotary(200, 10, colour=3), "there is no 'colour'"),
        (lambda: drives.linear_paint(0, 0.08, 0.34, 0.32, 0), "must not be 0"),
        (lambda: drives.linear_paint(1e5, 0.9, 0.34, 0.32, 0), "do not form a triangle"),
        (lambda: drives.linear_paint(1e5, 0.01, 0.34, 0.32, 0), "do not form a triangle"),
        (lambda: drives.linear_guo(0.3, 0.3, 0.5, 0.7, 1e-5), r"do not form a triangle"),
        (lambda: drives.direct(rate=0.0), "is 0 or infinite"),
        (lambda: drives.direct().angles(np.nan), "counts: nan is not a number"),
    ],
)
def test_guards(make, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=text):
        make()
