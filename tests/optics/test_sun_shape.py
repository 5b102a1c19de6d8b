"""The sun's profile: published values, moments, random rays and the short sums of Gaussians."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.optics import SUN_RADIUS, SUN_SHAPES, SunShape
from heliotrope.optics.sun_shape import AUREOLE_RADIUS, sun_profile

MRAD = 1e-3
SHAPES = ("pillbox", "limb", "quartic", "gaussian", "buie:0.02", "buie:0.05", "buie:0.2")


def test_variances_of_the_disks_are_the_integrals_done_by_hand() -> None:
    assert SunShape("pillbox").variance == pytest.approx(SUN_RADIUS**2 / 4, rel=1e-9)
    a = 0.5138  # of ∫θ³(1 − aθ⁴) / 2∫θ(1 − aθ⁴) over the unit disk
    by_hand = 0.5 * (1 / 4 - a / 8) / (1 / 2 - a / 6) * SUN_RADIUS**2
    assert SunShape("quartic").variance == pytest.approx(by_hand, rel=1e-9)
    assert SunShape("gaussian", sigma=2e-3).variance == pytest.approx(4e-6, rel=1e-6)


def test_the_disk_of_buie_holds_the_light_that_tonatiuh_states() -> None:
    # TonatiuhPP, source/plugins/sun/SunBuie/SunBuie.cpp: m_integralA = ∫ φ sin θ over the disk.
    theta = (np.arange(20_000) + 0.5) * SUN_RADIUS / 20_000
    light = (sun_profile(theta, "buie", 0.05) * np.sin(theta)).sum() * SUN_RADIUS / 20_000
    assert light == pytest.approx(9.224724736098827e-6, rel=1e-6)


# χ by the polynomials of the same file, which its authors fitted to Buie's integrals.
@pytest.mark.parametrize(
    ("csr", "chi"), [(0.02, 0.03232), (0.05, 0.05519), (0.2, 0.21569), (0.4, 0.42635)]
)
def test_the_circumsolar_ratio_is_kept_and_chi_is_as_published(csr: float, chi: float) -> None:
    shape = SunShape("buie", csr=csr)
    assert shape.chi == pytest.approx(chi, rel=0.011)
    assert 1.0 - shape.within(SUN_RADIUS) == pytest.approx(csr, abs=2e-6)
    assert shape.within(AUREOLE_RADIUS) == pytest.approx(1.0)


@pytest.mark.parametrize("name", SHAPES)
def test_random_rays_follow_the_profile(name: str) -> None:
    shape, count = SunShape.of(name), 200_000
    rays = shape.sample(count, np.random.default_rng(5))
    assert np.abs(rays.mean(axis=0)).max() < 4.5 * np.sqrt(shape.variance / count)
    angle = np.hypot(*rays.T)
    assert angle.max() <= shape.radius
    for at in (1.5 * MRAD, 3.0 * MRAD, 4.6 * MRAD, 10.0 * MRAD):
        share = float(shape.within(at))
        noise = np.sqrt(max(share * (1.0 - share), 1e-9) / count)
        assert (angle < at).mean() == pytest.approx(share, abs=4.5 * noise + 1e-6)


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_a_sum_of_gaussians_has_the_light_and_the_variance_of_the_sun(
    name: str, count: int
) -> None:
    shape = SunShape.of(name)
    parts = shape.gaussians(count)
    assert parts.weight.sum() == pytest.approx(1.0, abs=1e-9)
    assert parts.weight @ parts.variance == pytest.approx(shape.variance, rel=1e-7)
    assert parts.variance.min() > 0.0


# Greatest error over the peak behind slope errors of 0.75, 1 and 1.5 mrad; the same table
# stands in docs/explanation/optics.md.
@pytest.mark.parametrize(
    ("name", "count", "errors"),
    [
        ("pillbox", 1, (0.43, 0.24, 0.08)),
        ("pillbox", 2, (0.055, 0.017, 0.004)),
        ("pillbox", 3, (0.042, 0.012, 0.003)),
        ("limb", 2, (0.036, 0.011, 0.003)),
        ("limb", 3, (0.027, 0.008, 0.002)),
        ("quartic", 2, (0.036, 0.011, 0.003)),
        ("buie:0.05", 1, (0.35, 0.36, 0.31)),
        ("buie:0.05", 3, (0.032, 0.013, 0.002)),
    ],
)
def test_the_error_of_a_sum_is_small_where_slope_blurs_the_image(
    name: str, count: int, errors: tuple[float, ...]
) -> None:
    shape = SunShape.of(name)
    for blur, most in zip((1.5, 2.0, 3.0), errors, strict=True):
        assert 0.2 * most < shape.gaussian_error(count, blur * MRAD) < most


def test_the_error_is_the_one_that_random_rays_show() -> None:
    shape, rng, blur = SunShape("pillbox"), np.random.default_rng(3), 1.5 * MRAD
    rays = shape.sample(1_000_000, rng) + rng.normal(scale=blur, size=(1_000_000, 2))
    inner = (np.hypot(*rays.T) < 0.5 * MRAD).mean()
    for count in (1, 3):
        weight, variance = shape.gaussians(count)
        share = weight @ -np.expm1(-0.5 * (0.5 * MRAD) ** 2 / (variance + blur**2))
        error = shape.gaussian_error(count, blur)
        # The peak is where a single Gaussian is worst.
        assert abs(share / inner - 1.0) <= error + 0.02
        if count == 1:
            assert share / inner - 1.0 > 0.5 * error


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("square", "sun shape 'square'; known: pillbox, limb, quartic, buie, gaussian"),
        ("limb:3", "sun shape 'limb:3': limb takes no number; write just limb"),
        ("buie:x", "sun shape 'buie:x': write a number after the colon"),
        ("buie:0.9", "circumsolar ratio must be between 0.01 and 0.7, not 0.9"),
        ("buie:nan", "circumsolar ratio must be .* not nan"),
        ("gaussian:0", "σ must be above 0"),
    ],
)
def test_a_wrong_shape_is_refused_in_one_line(text: str, line: str) -> None:
    with pytest.raises(InputError, match=line.replace("(", r"\(")):
        SunShape.of(text)


def test_a_shape_is_made_of_its_name_and_number() -> None:
    assert SunShape.of("buie:0.1") == SunShape("buie", csr=0.1)
    assert SunShape.of("gaussian:0.003").sigma == 0.003
    assert SunShape.of(SunShape("limb")) == SunShape("limb")
    assert {SunShape.of(name).name for name in SUN_SHAPES} == set(SUN_SHAPES)
    with pytest.raises(InputError, match="must be between 1 and 4, not 5"):
        SunShape().gaussians(5)
