"""Lenses that cannot be inverted inside their frame are refused where cameras are read."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from heliotrope.airborne.photo import LedCamera, read_camera, write_camera
from heliotrope.errors import FormatError, InputError
from heliotrope.field.camera import Camera, check_unfolded, distort, undistort
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import check_plant, read_plant, write_plant

F = 900.0


def camera(*distortion: float, size: tuple[int, int] = (1600, 1200)) -> Camera:
    matrix = np.array([[F, 0, 0.5 * (size[0] - 1)], [0, F, 0.5 * (size[1] - 1)], [0, 0, 1.0]])
    return Camera("south", size, matrix, np.pad(distortion, (0, 5 - len(distortion))))


@pytest.mark.parametrize("k1", [-0.15, -0.3, -0.6])
def test_barrel_that_folds_is_refused_at_its_radius(k1: float) -> None:
    # r (1 + k1 r²) turns at r² = -1/(3 k1), where it is 2/3 r.
    radius = 2.0 / 3.0 * F / np.sqrt(-3.0 * k1)
    with pytest.raises(InputError, match=r"camera south: its lens polynomial folds") as refused:
        check_unfolded("camera south", camera(k1))
    number = float(str(refused.value).split("folds ")[1].split(" px")[0])
    assert number == pytest.approx(radius, abs=1.0)
    assert "farthest corner: 999 px" in str(refused.value)


@pytest.mark.parametrize(
    "distortion",
    [
        (0.0, 0.5),  # pincushion
        (-0.1,),
        (-0.3, 0.1),
        (-0.08, 0.06, 3e-4, -2e-4, -0.01),
    ],
)
def test_lens_that_is_taken_can_be_inverted_to_its_corners(distortion: tuple[float, ...]) -> None:
    lens = camera(*distortion)
    check_unfolded("camera south", lens)
    pixels = np.stack(np.meshgrid([0.0, 800.0, 1599.0], [0.0, 600.0, 1199.0]), axis=-1)
    np.testing.assert_allclose(distort(lens, undistort(lens, pixels)), pixels, atol=0.01)


@pytest.mark.parametrize("distortion", [(0.3, -0.4), (0.0, 0.0, 0.3), (-0.1, 0.0, 0.0, 0.0, -0.1)])
def test_other_terms_fold_too(distortion: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="folds"):
        check_unfolded("camera south", camera(*distortion))


def test_the_frame_decides_whether_a_fold_matters() -> None:
    check_unfolded("camera south", camera(-0.45, size=(640, 480)))


def test_plant_and_drone_camera_with_a_fold_are_refused(tmp_path: Path) -> None:
    good = camera(-0.1)
    plant = replace(example_plant(), cameras=(good,))
    with pytest.raises(InputError, match="camera south: its lens polynomial folds"):
        replace(plant, cameras=(camera(-0.45),))
    write_plant(plant, tmp_path / "plant.toml")
    text = (tmp_path / "plant.toml").read_text(encoding="utf-8").replace("-0.1,", "-0.45,")
    (tmp_path / "plant.toml").write_text(text, encoding="utf-8")
    (finding,) = check_plant(tmp_path / "plant.toml")
    assert finding.severity == "error"
    assert "folds 516 px from the principal point" in finding.text
    with pytest.raises(InputError, match="folds 516 px"):
        read_plant(tmp_path / "plant.toml")
    drone = LedCamera(good.size, good.matrix, camera(-0.45).distortion)
    write_camera(tmp_path / "camera.toml", drone)
    with pytest.raises(FormatError, match="folds 516 px"):
        read_camera(tmp_path / "camera.toml")
