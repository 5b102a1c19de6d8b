"""Where an imperfect heliostat throws its beam."""

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.example import example_plant, roughly_installed
from heliotrope.geometry import MRAD, direction
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import direct
from heliotrope.optics import image_offsets, target_offsets

AIM = np.array([0.0, 0.0, 13.0])
UPRIGHT = (direct(), direct(min_angle=-0.1, max_angle=1.65))
NOMINAL = kinds.azimuth_elevation((0.0, -50.0, 1.0), pivot_offset=0.1, drives=UPRIGHT)
SUNS = direction(np.radians([30.0, 0.0, -40.0]), np.radians([40.0, 55.0, 30.0]))


def test_no_error_no_offset() -> None:
    found = image_offsets(NOMINAL, NOMINAL, SUNS, AIM)
    assert found.distance.max() < 2e-9
    assert found.rms() < 1e-9 * MRAD * 1e3


def test_a_survey_error_moves_the_image_with_the_mirror() -> None:
    """The mirror looks the same way from beside, so the beam is shifted as a whole."""
    moved = NOMINAL.with_parameters({"position_east": 0.05})
    found = image_offsets(NOMINAL, moved, SUNS, AIM)
    np.testing.assert_allclose(found.right, 0.05, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.up, 0.0, rtol=0, atol=1e-3)


def test_a_small_turn_of_the_normal_is_doubled_in_the_beam() -> None:
    """In the plane of incidence: sun and target straight in front, elevation off by 1 mrad."""
    found = image_offsets(
        NOMINAL, NOMINAL.with_parameters({"elevation_bias": 1e-3}), direction(0.0, 0.9), AIM
    )
    assert found.beam_error[..., 1] == pytest.approx(2e-3, abs=0.01e-3)
    assert abs(found.right) < 1e-6


def test_on_the_real_target_the_camera_sees_the_mirror_image() -> None:
    """The target's front looks back at the heliostat, so its right is the mirror's left."""
    plant = example_plant()
    target = plant.targets[0]
    moved = NOMINAL.with_parameters({"azimuth_bias": 1e-3})
    from_mirror = image_offsets(NOMINAL, moved, SUNS, target.center)
    seen = target_offsets(NOMINAL, moved, SUNS, target)
    # The target faces south and stands upright; its plane is nearly across the line of sight.
    np.testing.assert_allclose(seen[:, 0], from_mirror.right, rtol=0.1)
    assert (np.sign(seen[:, 1]) == np.sign(from_mirror.up)).all()


def test_a_whole_field_for_a_day() -> None:
    plant = example_plant()
    nominal = plant.groups["azel"].mechanism
    found = image_offsets(nominal, roughly_installed(nominal), SUNS[:, None], AIM)
    assert found.right.shape == (3, 18)
    assert found.rms(axis=0).shape == (18,)
    assert 5 * MRAD < found.rms() < 60 * MRAD


def test_out_of_reach_is_nan() -> None:
    stopped = kinds.azimuth_elevation(
        (0.0, -50.0, 1.0),
        drives=(direct(min_angle=2.0, max_angle=3.0), direct(min_angle=0, max_angle=1.6)),
    )
    found = image_offsets(stopped, stopped, SUNS, AIM)
    assert np.isnan(found.right).all()
    assert np.isnan(found.rms())


def test_guards() -> None:
    with pytest.raises(InputError, match="a tilt_roll mechanism, but the nominal one"):
        image_offsets(NOMINAL, kinds.tilt_roll((0, 0, 0)), SUNS, AIM)
    with pytest.raises(InputError, match="do not fit nominal ones"):
        image_offsets(NOMINAL, kinds.azimuth_elevation(np.zeros((2, 3))), SUNS, AIM)
