"""Tracking against Grigoriev's method in an independent implementation, and his notebook."""

import numpy as np
import pytest

from heliotrope.geometry import reflect, wrap_signed
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.tracking import TrackingStatus, track
from reference.cases import params

_LIMIT = 1e-10  # rad


def _mechanism(inputs: dict) -> Mechanism:
    return kinds.two_axis(
        inputs.get("position", (0.0, 0.0, 0.0)),
        inputs["axis1_unit"],
        inputs["axis2_unit"],
        inputs["n0"],
        origin_1=inputs["t1"],
        origin_2=inputs["t2"],
        vertex=inputs["r0"],
        orientation=np.array(inputs.get("R_heliostat_rowmajor", np.eye(3))).reshape(3, 3),
    )


def _difference(angles: np.ndarray, wanted: list[float]) -> float:
    return float(np.abs(wrap_signed(angles - np.array(wanted))).max())


def _check_two_axis(case: dict) -> None:
    inputs = case["inputs"]
    mechanism = _mechanism(inputs)
    sun, aim = inputs["sun_vector_ENZ"], inputs["aim_ENZ"]
    found = track(mechanism, sun, aim, tolerance=1e-13)
    rotation = mechanism.orientation
    for branch, wanted in enumerate(case["branches"]):
        assert wanted["branch"] == branch
        if wanted["status"] == "unreachable":
            assert found.status[branch] == TrackingStatus.UNREACHABLE
            assert found.residual[branch] > 1e-3
            continue
        assert found.status[branch] == TrackingStatus.OK
        angles = [wanted["alpha_rad"], wanted["beta_rad"]]
        assert _difference(found.angles[branch], angles) < _LIMIT
        vertex = mechanism.position + rotation @ np.array(wanted["mirror_point_local"])
        np.testing.assert_allclose(found.vertex[branch], vertex, rtol=0, atol=1e-10)
        normal = rotation @ np.array(wanted["normal_local"])
        np.testing.assert_allclose(found.normal[branch], normal, rtol=0, atol=1e-10)
        ray = reflect(np.array(sun), found.normal[branch])
        assert np.linalg.norm(np.cross(np.array(aim) - found.vertex[branch], ray)) < 1e-9
        _check_iterations(mechanism, sun, aim, branch, wanted)
    for branch, published in enumerate(case.get("published_iterations_deg_deg_m", [])):
        for k, (alpha, beta, _) in enumerate(published, start=1):
            step = track(mechanism, sun, aim, newton=False, max_iterations=k)
            shown = np.degrees(step.angles[branch])
            np.testing.assert_allclose(shown, [alpha, beta], rtol=0, atol=0.51e-4)


def _check_iterations(mechanism, sun, aim, branch, wanted) -> None:  # type: ignore[no-untyped-def]
    """The plain fixed point goes through the stored steps."""
    for step in wanted["iterations"][:4]:
        found = track(
            mechanism, sun, aim, newton=False, max_iterations=step["iteration"], tolerance=1e-15
        )
        angles = [step["alpha_rad"], step["beta_rad"]]
        assert _difference(found.angles[branch], angles) < _LIMIT


def _check_single_axis(case: dict) -> None:
    inputs = case["inputs"]
    mechanism = kinds.single_axis(
        (0.0, 0.0, 0.0),
        inputs["axis1_unit"],
        inputs["n0"],
        vertex=inputs["r0"],
    )
    local = "aim_in_mirror_frame" in inputs
    aim = np.array(inputs["aim_in_mirror_frame"] if local else inputs["aim_ENZ"])
    if not local:
        # t1 lifts axis and mirror alike; lower the aim instead.
        aim = aim - np.array(inputs["t1"])
    found = track(mechanism, inputs["sun_vector_ENZ"], aim, local=local, tolerance=1e-13)
    assert found.status[0] == TrackingStatus.OK
    assert _difference(found.angles[0], [case["alpha_rad"]]) < _LIMIT


def _check_local(case: dict) -> None:
    inputs = case["inputs"]
    mechanism = _mechanism(inputs)
    aim = np.array(inputs["t1"]) + inputs["t2"] + inputs["aim_in_secondary_frame"]
    found = track(mechanism, inputs["sun_vector_ENZ"], aim, local=True)
    for branch, wanted in enumerate(case["branches"]):
        angles = [wanted["alpha_rad"], wanted["beta_rad"]]
        assert _difference(found.angles[branch], angles) < _LIMIT


@pytest.mark.parametrize("case", params("heliok"))
def test_heliok_case(case: dict) -> None:
    inputs = case["inputs"]
    if "axis2_unit" not in inputs:
        _check_single_axis(case)
    elif "aim_in_secondary_frame" in inputs:
        _check_local(case)
    else:
        _check_two_axis(case)
