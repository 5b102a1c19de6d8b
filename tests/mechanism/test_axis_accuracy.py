"""Zeros and scatter of each axis, (43)-(47) of Guo."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.errors import InputError
from heliotrope.geometry import MRAD, TAU, wrap_signed
from heliotrope.mechanism.axis_accuracy import axis_accuracy
from heliotrope.mechanism.guo import GuoParameters, angles, forward

PI = np.pi

properties = settings(max_examples=30, deadline=None, derandomize=True, database=None)


def test_zeros_and_scatter_are_recovered():
    rng = np.random.default_rng(5)
    n = 20_000
    alpha_i, gamma_i = rng.uniform(0.2, 1.2, n), rng.uniform(0, TAU, n)
    alpha = alpha_i - 0.004 + rng.normal(0, 0.3 * MRAD, n)
    gamma = wrap_signed(gamma_i + 0.007 + rng.normal(0, 0.8 * MRAD, n))
    found = axis_accuracy(alpha, gamma, alpha_i, gamma_i)
    standard_error = MRAD / np.sqrt(n)
    # Measured minus computed, (44) and (46).
    assert found.alpha_0 == pytest.approx(-0.004, abs=5 * standard_error)
    assert found.gamma_0 == pytest.approx(0.007, abs=5 * standard_error)
    assert found.sigma_alpha == pytest.approx(0.3 * MRAD, rel=0.03)
    assert found.sigma_gamma == pytest.approx(0.8 * MRAD, rel=0.03)
    mean_square_cosine = np.mean(np.cos(alpha_i) ** 2)
    assert found.sigma_normal == pytest.approx(
        np.sqrt(0.3**2 + mean_square_cosine * 0.8**2) * MRAD, rel=0.03
    )


def test_the_zeros_are_those_of_the_parameters():
    truth = GuoParameters(tilt=0.01, tilt_azimuth=1.0, tau_1=0.004, mu=-0.003)
    biased = replace(truth, azimuth_zero=-0.02, elevation_zero=0.03)
    alpha, gamma = np.random.default_rng(2).uniform(0.2, 1.2, (2, 30))
    demanded = angles(forward(alpha, gamma, biased), truth)
    found = axis_accuracy(alpha, gamma, demanded.alpha[:, 0], demanded.gamma[:, 0])
    assert found.gamma_0 == pytest.approx(-0.02, abs=1e-13)
    assert found.alpha_0 == pytest.approx(0.03, abs=1e-13)
    assert found.sigma_normal < 1e-12


@properties
@given(st.integers(2, 30), st.floats(-PI, PI), st.integers(0, 1000))
def test_mean_and_deviation_do_not_depend_on_where_the_circle_is_cut(n, shift, seed):
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 0.1, (2, n))
    alpha_i = rng.uniform(0, 1, n)
    gamma_i = rng.uniform(0, TAU, n)
    found = axis_accuracy(
        alpha_i + noise[0], wrap_signed(gamma_i + shift + noise[1]), alpha_i, gamma_i
    )
    assert abs(wrap_signed(found.gamma_0 - shift - noise[1].mean())) < 1e-13
    assert found.sigma_gamma == pytest.approx(np.std(noise[1], ddof=1), abs=1e-13)
    assert found.sigma_alpha == pytest.approx(np.std(noise[0], ddof=1), abs=1e-13)


def test_weights_by_cosine_keep_the_keyhole_from_ruling_the_azimuth():
    rng = np.random.default_rng(8)
    alpha_i = np.pi / 2 - rng.uniform(0.01, 1.0, (400, 50))
    gamma_i = rng.uniform(0, TAU, alpha_i.shape)
    # Normals that scatter equally in all directions.
    noise = rng.normal(0, MRAD, (2, *alpha_i.shape))
    gamma = gamma_i + noise[0] / np.cos(alpha_i)
    equal = axis_accuracy(alpha_i + noise[1], gamma, alpha_i, gamma_i)
    weighted = axis_accuracy(
        alpha_i + noise[1], gamma, alpha_i, gamma_i, azimuth_weight=np.cos(alpha_i) ** 2
    )
    assert weighted.gamma_0.shape == (400,)
    assert np.std(weighted.gamma_0) < 0.5 * np.std(equal.gamma_0)
    spread = MRAD / np.sqrt(np.mean(np.cos(alpha_i) ** 2))
    assert np.median(weighted.sigma_gamma) == pytest.approx(spread, rel=0.05)
    assert np.median(weighted.sigma_normal) == pytest.approx(np.sqrt(2) * MRAD, rel=0.05)


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: axis_accuracy(0.0, 0.0, 0.0, 0.0), r"shape \(\); the last axis must hold 2"),
        (lambda: axis_accuracy([0], [0], [0], [0]), r"shape \(1,\); the last axis"),
        (
            lambda: axis_accuracy([0, 0], [0, 0, 0], 0, 0),
            r"broadcast together: measured_alpha \(2,\), measured_gamma \(3,\)",
        ),
        (lambda: axis_accuracy([0, 0], [0, np.nan], 0, 0), r"measured_gamma\[1\]: nan"),
        (lambda: axis_accuracy(0, 0, 0, [0, 0], azimuth_weight=[1, -1]), "must not be negative"),
        (lambda: axis_accuracy(0, 0, 0, [0, 0], azimuth_weight=0), "must not be .* all 0"),
        (
            lambda: axis_accuracy(0, 0, 0, [0.1, PI, 0.1]),
            r"computed gamma\[1\]: .* from the mean, limit ±90°; do not mix branches",
        ),
        (lambda: axis_accuracy(0, 0, [0.1, 0.1, PI], 0), r"alpha\[2\]: .* do not mix branches"),
    ],
)
def test_bad_input_gets_one_clear_line(call, text):
    with pytest.raises(InputError, match=text) as caught:
        call()
    assert "\n" not in str(caught.value)
