"""Guo's parameters under his names and units, and those of a mechanism."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import angle_between, direction, wrap_signed
from heliotrope.mechanism import direct, guo, kinds
from heliotrope.mechanism.guo_names import NAMES, from_his_names, in_his_names, of_mechanism
from heliotrope.mechanism.tracking import track

#: The heliostat model of his section 5, with its zeros.
PUBLISHED = {
    "psi_a": 236.06, "psi_t": 1.854, "gamma_0": -237.43,
    "tau_1": 5.0, "alpha_0": 22.832, "mu": -0.92,
}  # fmt: skip


def test_his_published_set_goes_there_and_back() -> None:
    found = in_his_names(from_his_names(PUBLISHED))
    assert list(found) == list(NAMES)
    for name, value in PUBLISHED.items():
        # In our range of γ₀ his −237.43° is 122.57°.
        wanted = value + 360.0 if name == "gamma_0" else value
        assert float(found[name]) == pytest.approx(wanted, abs=1e-10), name


def test_his_parameters_of_a_mechanism_track_as_its_armature() -> None:
    real = kinds.azimuth_elevation(
        [[10.0, 60.0, 1.0], [-30.0, 45.0, 1.0]], pivot_height=2.0, pivot_offset=0.25,
        drives=(direct(), direct(min_angle=-0.1, max_angle=1.7)),
    ).with_parameters(
        {"tilt_north": 0.01, "tilt_east": [-0.02, 0.005], "non_orthogonality": 3e-3}
        | {"canting": -0.004, "azimuth_bias": -8e-3, "elevation_bias": 6e-3}
    )  # fmt: skip
    sun, aim = direction(np.radians(170.0), np.radians(40.0)), np.array([0.0, 0.0, 30.0])
    his, pivot = of_mechanism(real)
    found = guo.track(aim - pivot, sun, his, exact=True)
    ours = track(real, sun, aim)
    joints = ours.best_angles
    assert np.abs(wrap_signed(found.gamma[:, 0] - joints[:, 0])).max() < 1e-9
    assert np.abs(found.alpha[:, 0] - joints[:, 1]).max() < 1e-9
    # With the zeros the same machine takes what the drives show.
    shown = ours.best_counts
    with_zeros, _ = of_mechanism(real, zeros=True)
    normals = guo.forward(shown[:, 1], shown[:, 0], with_zeros)
    assert angle_between(normals, ours.chosen(ours.normal)).max() < 1e-12
    assert np.degrees(8e-3) == pytest.approx(in_his_names(with_zeros)["gamma_0"], abs=0.02)


@pytest.mark.parametrize(
    ("mechanism", "text"),
    [
        (kinds.tilt_roll((0.0, 0.0, 0.0)), "this one is tilt_roll"),
        (
            kinds.azimuth_elevation((0.0, 0.0, 0.0)).with_parameters({"canting_secondary": 0.01}),
            "normals differ by 10 mrad",
        ),
        (
            replace(kinds.azimuth_elevation((0.0, 0.0, 0.0)), vertex=np.array([0.05, 0.2, 0.0])),
            "mirror turns wanders by 84.1 mm",
        ),
    ],
)
def test_a_mechanism_that_the_formula_does_not_know_is_refused(mechanism, text) -> None:
    with pytest.raises(InputError, match=text):
        of_mechanism(mechanism)


def test_an_unknown_name_gets_a_suggestion() -> None:
    with pytest.raises(UnknownNameError, match="psi_t"):
        from_his_names({"psi": 1.0})
