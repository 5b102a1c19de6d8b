"""Guo's formula against an independent implementation in 50 digits.

The cases are in Guo's left-handed frame (north, east, height); the angles are the same
in ours. Where sin α is 1 within rounding (a *boundary case*) only the normal, the
elevation and the residual are determined, and those to half of the digits.
"""

from typing import Any

import numpy as np
import pytest

from heliotrope.geometry import MRAD, FloatArray, angle_between, direction, wrap_signed
from heliotrope.mechanism.guo import (
    GuoParameters,
    forward,
    from_malan,
    mirror_normal,
    regularise,
    to_malan,
    track,
)
from reference.cases import load, params

ANGLE = 1e-11
BOUNDARY = 1e-7


def neh_to_enu(vector: Any) -> FloatArray:
    """Exchange north and east, which turns Guo's left-handed frame into ours and back."""
    return np.asarray(vector, dtype=np.float64)[..., [1, 0, 2]]


def inputs(case: dict[str, Any]) -> tuple[FloatArray, FloatArray, GuoParameters]:
    given = case["inputs"]
    sun = direction(
        np.radians(given["sun_azimuth_deg_NtoE"]), np.radians(given["sun_altitude_deg"])
    )
    parameters = GuoParameters(
        tilt=np.radians(given["psi_t_deg"]),
        tilt_azimuth=np.radians(given["psi_a_deg"]),
        tau_1=np.radians(given["tau1_deg"]),
        mu=np.radians(given["mu_deg"]),
        offset=given["Hz_m"],
    )
    return neh_to_enu(given["OT_m_NEH"]), sun, parameters


@pytest.mark.parametrize("case", params("guo"))
def test_the_normal_of_26(case):
    target, sun, parameters = inputs(case)
    expected = case["outputs"]
    found = mirror_normal(target, sun, parameters.offset)
    assert found.theta == pytest.approx(expected["theta_rad"], abs=ANGLE)
    assert found.tau == pytest.approx(expected["tau_rad"], abs=ANGLE)
    assert angle_between(found.normal, neh_to_enu(expected["n_eq26"])) < ANGLE


@pytest.mark.parametrize("case", params("guo"))
def test_the_exact_offset_and_the_error_of_5(case):
    target, sun, parameters = inputs(case)
    expected = case["outputs"]
    exact = mirror_normal(target, sun, parameters.offset, exact=True).normal
    assert angle_between(exact, neh_to_enu(expected["n_exact_offset"])) < ANGLE
    by_5 = mirror_normal(target, sun, parameters.offset).normal
    error = expected["eq5_approx_error_mrad"] * MRAD
    assert angle_between(exact, by_5) == pytest.approx(error, rel=1e-3, abs=1e-15)


@pytest.mark.parametrize("case", params("guo"))
def test_both_branches(case):
    target, sun, parameters = inputs(case)
    expected = case["outputs"]
    limit = BOUNDARY if case["boundary_case"] else ANGLE
    found = track(target, sun, parameters)
    alpha = [expected["alpha_rad"], expected["alpha2_rad"]]
    gamma = [expected["gamma_rad"], expected["gamma2_rad"]]
    np.testing.assert_allclose(found.alpha, alpha, rtol=0.0, atol=limit)
    if not case["boundary_case"]:
        np.testing.assert_allclose(wrap_signed(found.gamma - gamma), 0.0, rtol=0.0, atol=limit)
        assert found.status == expected["status"]
    assert found.residual == pytest.approx(expected["pointing_residual_mrad"] * MRAD, abs=limit)
    assert found.residual == pytest.approx(
        expected["pointing_residual_branch2_mrad"] * MRAD, abs=limit
    )


@pytest.mark.parametrize("case", params("guo"))
def test_the_forward_normal_of_29(case):
    target, sun, parameters = inputs(case)
    found = track(target, sun, parameters)
    normals = forward(found.alpha, found.gamma, parameters)
    expected = neh_to_enu(case["outputs"]["n_forward_eq29"])
    limit = BOUNDARY if case["boundary_case"] else ANGLE
    assert (angle_between(normals, expected) < limit).all()
    assert np.linalg.norm(normals, axis=-1) == pytest.approx(1.0, abs=1e-14)


def test_37_makes_one_machine_of_two_cases():
    cases = dict(load("guo"))
    _, _, plain = inputs(cases["large_errors"])
    _, _, flipped = inputs(cases["large_errors_eq37_equivalent"])
    a, b = regularise(plain), regularise(flipped)
    for name in vars(a):
        assert getattr(a, name) == pytest.approx(getattr(b, name), abs=1e-15), name


@pytest.mark.parametrize(
    "case",
    [
        case
        for case in params("malan")
        if case.values[0]["convention"] == "phys"
        and "Aw" not in case.values[0]["inputs"]["params_rad_m"]
    ],
)
def test_malans_model_in_guos_parameters(case):
    shared = ("eptN", "eptE", "gb", "ab", "eNO")
    values = {k: v for k, v in case["inputs"]["params_rad_m"].items() if k in shared}
    ideal = np.asarray(case["outputs"]["h_ideal_ZEN"])[:, [1, 2, 0]]
    actual = np.asarray(case["outputs"]["h_adj_ZEN"])[:, [1, 2, 0]]
    parameters = from_malan(values)
    commanded_azimuth = np.arctan2(ideal[:, 0], ideal[:, 1])
    commanded_elevation = np.arctan2(ideal[:, 2], np.hypot(ideal[:, 0], ideal[:, 1]))
    normals = forward(commanded_elevation, commanded_azimuth, parameters)
    assert (angle_between(normals, actual) < 1e-14).all()
    back = to_malan(parameters)
    for name in shared:
        assert back[name] == pytest.approx(values.get(name, 0.0), abs=1e-15), name
