"""The share of a beam that an aperture takes."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.optics import beam_sigma, intercept_circle, intercept_disks, intercept_rectangle

DRAWS = 200_000


def _beam(sigma: float, sigma_up: float, right: float, up: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    return rng.normal((right, up), (sigma, sigma_up), (DRAWS, 2))


@pytest.mark.parametrize(
    ("sigma", "sigma_up", "right", "up"),
    [(0.5, 0.5, 0.0, 0.0), (0.5, 0.5, 0.8, -0.3), (0.4, 0.9, 0.2, 0.5), (0.05, 0.05, 0.98, 0.0)],
)
def test_against_monte_carlo(sigma: float, sigma_up: float, right: float, up: float) -> None:
    x, y = _beam(sigma, sigma_up, right, up).T
    for share, inside in (
        (intercept_circle(1.0, sigma, sigma_up=sigma_up, right=right, up=up), x**2 + y**2 <= 1.0),
        (
            intercept_rectangle(2.0, 1.0, sigma, sigma_up=sigma_up, right=right, up=up),
            (np.abs(x) <= 1.0) & (np.abs(y) <= 0.5),
        ),
    ):
        spread = np.sqrt(share * (1.0 - share) / DRAWS)
        assert abs(share - inside.mean()) < 4 * spread + 1e-5


def test_centred_circle_is_rayleigh() -> None:
    sigma = np.array([0.1, 0.5, 2.0])
    np.testing.assert_allclose(
        intercept_circle(1.2, sigma), 1.0 - np.exp(-(1.2**2) / (2 * sigma**2)), atol=1e-12
    )


def test_malans_disks_give_his_printed_values() -> None:
    """Malan §3.2.2: 92.2 % at 0.75 mrad, "around ten per cent" lost at 1 mrad."""
    found = intercept_disks([0.0, 0.75e-3, 1e-3], slope=1.5e-3, sun_angle=9.3e-3)
    assert found[0] == 1.0
    assert found[1] == pytest.approx(0.922, abs=5e-4)
    assert found[2] == pytest.approx(0.90, abs=5e-3)
    # Beyond two radii nothing is common.
    assert intercept_disks(13e-3, slope=1.5e-3, sun_angle=9.3e-3) == 0.0


def test_malans_disks_are_the_overlap_of_two_disks() -> None:
    rng = np.random.default_rng(33)
    x, y = rng.uniform(-1.0, 1.0, (2, DRAWS))
    inside = x**2 + y**2 <= 1.0
    slope, sun_angle, tracking = 1e-3, 9.3e-3, 4e-3
    apart = tracking / (0.5 * sun_angle + slope)
    common = ((x - apart) ** 2 + y**2 <= 1.0)[inside].mean()
    found = intercept_disks(tracking, slope=slope, sun_angle=sun_angle)
    assert found == pytest.approx(common, abs=4 * 0.5 / np.sqrt(inside.sum()))


def test_limits_and_quadrature() -> None:
    assert intercept_circle(1.0, 1e-6) == pytest.approx(1.0)
    assert intercept_circle(1.0, 1e6) == pytest.approx(0.0, abs=1e-9)
    assert intercept_rectangle(1e6, 1e6, 1.0) == pytest.approx(1.0)
    sigma = beam_sigma(100.0, tracking=1e-3, slope=0.5e-3, sun_shape=2e-3)
    assert sigma == pytest.approx(100.0 * np.sqrt(4e-6 + 4e-6 + 1e-6))


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: beam_sigma(0.0), "slant must be above 0 and finite, not 0 m"),
        (
            lambda: beam_sigma(10.0, tracking=-1e-3),
            "tracking must be 0 or more and finite, not -0.001 rad",
        ),
        (lambda: intercept_circle(-1.0, 1.0), "radius"),
        (lambda: intercept_disks(-1e-3), "tracking must be 0 or more and finite, not -0.001 rad"),
        (lambda: intercept_disks(1e-3, sun_angle=0.0), "must be above 0 and finite, not 0 rad"),
        (lambda: intercept_circle(1.0, 1.0, right=np.inf), "infinite"),
        (lambda: intercept_rectangle(np.ones(2), np.ones(3), 1.0), "do not broadcast"),
    ],
)
def test_guards(make, text: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=text):
        make()
