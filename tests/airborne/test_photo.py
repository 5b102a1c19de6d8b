"""Photographs: gimbal angles, what DJI writes, tables beside, camera files, refusals."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.airborne.photo import (
    LedCamera,
    Photo,
    gimbal_of_rotation,
    read_camera,
    read_photos,
    rotation_of_gimbal,
    write_camera,
)
from heliotrope.airborne.simulate.rendering import write_photo
from heliotrope.errors import FormatError, InputError
from heliotrope.field.camera import local_rays, look_at
from support.drone_case import ORIGIN, camera

TIME = datetime(2026, 6, 21, 10, 0, 0, 250_000, tzinfo=UTC)
PICTURE = np.full((60, 80, 3), 90, np.uint8)


def photo(name: str = "DJI_0001.JPG") -> Photo:
    turned = rotation_of_gimbal(0.3, -0.9, 0.01)
    return Photo(name, TIME, np.array([12.0, -30.0, 80.0]), turned, np.array([0.008, 0.009, 0.02]))


def test_gimbal_axes() -> None:
    # Level and north: right is east, down is down, ahead is north.
    np.testing.assert_allclose(
        rotation_of_gimbal(0.0, 0.0, 0.0).T, [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-12
    )
    # Straight down with the top of the picture to the north.
    down = rotation_of_gimbal(0.0, -np.pi / 2, 0.0)
    np.testing.assert_allclose(down.T, [[1, 0, 0], [0, -1, 0], [0, 0, -1]], atol=1e-12)
    # Yaw is clockwise: a quarter turn looks east.
    np.testing.assert_allclose(rotation_of_gimbal(np.pi / 2, 0, 0)[:, 2], [1, 0, 0], atol=1e-12)
    # Roll lowers the right side.
    assert rotation_of_gimbal(0.0, 0.0, 0.2)[2, 0] < -0.1


angles = st.tuples(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-0.7, 0.7))


@given(angles)
def test_gimbal_back_and_forth(given_angles: tuple[float, float, float]) -> None:
    turned = rotation_of_gimbal(*given_angles)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(gimbal_of_rotation(turned), given_angles, atol=1e-9)


def test_gimbal_straight_down() -> None:
    turned = rotation_of_gimbal(0.7, -np.pi / 2, 0.0)
    back = rotation_of_gimbal(*gimbal_of_rotation(turned))
    np.testing.assert_allclose(back, turned, atol=1e-9)


def test_look_at_puts_the_point_in_the_middle() -> None:
    lens, place, point = camera(), np.array([3.0, -8.0, 60.0]), np.array([10.0, 40.0, 1.0])
    seen = Photo("a", None, place, look_at(place, point)).pixels(lens, point)
    np.testing.assert_allclose(seen, lens.matrix[:2, 2], atol=1e-6)


def test_lamp_is_above_the_camera_in_the_picture() -> None:
    lens = replace(camera(), led_offset=np.array([0.0, -0.1, 0.0]))
    level = Photo("a", None, np.zeros(3), rotation_of_gimbal(0.0, 0.0, 0.0))
    np.testing.assert_allclose(level.led_position(lens), [0.0, 0.0, 0.1], atol=1e-12)


@given(st.floats(0.02, 0.98), st.floats(0.02, 0.98))
def test_pixels_to_rays_and_back(x: float, y: float) -> None:
    lens, turned = camera(), rotation_of_gimbal(0.4, -0.8, 0.03)
    pixel = np.array([x * lens.size[0], y * lens.size[1]])
    taken = Photo("a", None, np.array([1.0, 2.0, 3.0]), turned)
    again = taken.pixels(lens, taken.position + 70.0 * turned @ local_rays(lens, pixel))
    np.testing.assert_allclose(again, pixel, atol=2e-3)


def test_what_is_behind_or_far_outside_is_not_seen() -> None:
    lens, taken = camera(), Photo("a", None, np.zeros(3), np.eye(3))
    points = np.array([[0.0, 0.0, -5.0], [50.0, 0.0, 1.0], [0.0, 0.0, 5.0]])
    seen = taken.pixels(lens, points)
    assert np.isfinite(seen).all(axis=1).tolist() == [False, False, True]


def test_dji_metadata_comes_back(tmp_path) -> None:
    told = photo()
    write_photo(tmp_path / told.name, PICTURE, told, ORIGIN)
    (again,), problems = read_photos(tmp_path, ORIGIN)
    assert problems == ()
    np.testing.assert_allclose(again.position, told.position, atol=2e-4)
    # DJI writes angles to a tenth of a degree, we to a thousandth.
    np.testing.assert_allclose(again.rotation, told.rotation, atol=2e-5)
    np.testing.assert_allclose(again.sigma_position, told.sigma_position, atol=1e-5)
    assert again.time == TIME


def test_table_beside_goes_first(tmp_path) -> None:
    write_photo(tmp_path / "a.jpg", PICTURE, photo("a.jpg"), ORIGIN)
    (tmp_path / "photos.csv").write_text(
        "name,time,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg,sigma_m\n"
        "a.jpg,2026-06-21T12:00:00+02:00,1,2,50,90,-90,0,0.02\nb.jpg,,1,2,3,0,0,0,\n"
    )
    (again,), problems = read_photos(tmp_path, ORIGIN)
    np.testing.assert_allclose(again.position, [1, 2, 50])
    assert again.time == datetime(2026, 6, 21, 10, 0, tzinfo=UTC)
    assert again.sigma_position.tolist() == [0.02] * 3
    assert len(problems) == 1
    assert "b.jpg: photos.csv lists it, but no such file" in problems[0]


def test_bad_photographs_get_one_line_each(tmp_path) -> None:
    import cv2

    good = [photo(f"g{k}.jpg") for k in range(2)]
    for one in good:
        write_photo(tmp_path / one.name, PICTURE, one, ORIGIN)
    cv2.imwrite(str(tmp_path / "plain.jpg"), PICTURE)
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8\xff no picture")
    write_photo(
        tmp_path / "other.jpg", np.full((40, 40, 3), 9, np.uint8), photo("other.jpg"), ORIGIN
    )
    data = (tmp_path / "g0.jpg").read_bytes()
    (tmp_path / "float.jpg").write_bytes(data.replace(b'RtkFlag="50"', b'RtkFlag="34"'))
    (tmp_path / "flagless.jpg").write_bytes(data.replace(b'RtkFlag="50"', b'GpsState="3"'))
    (tmp_path / "xml.jpg").write_bytes(data.replace(b"<rdf:RDF", b"<rdf;RDF"))
    found, problems = read_photos(tmp_path, ORIGIN)
    assert [p.name for p in found] == ["g0.jpg", "g1.jpg"]
    text = "\n".join(problems)
    assert "plain.jpg: its XMP lacks GpsLatitude, GpsLongitude" in text
    assert "broken.jpg: not a readable image" in text
    assert "float.jpg: RtkFlag 34 is not a fixed solution" in text
    assert "flagless.jpg: its XMP has no RtkFlag, so nothing states how well its" in text
    assert "xml.jpg: its XMP is damaged" in text
    assert "other.jpg: 40 × 40 px, but most photographs have 80 × 60 px" in text
    assert len(problems) == 6
    assert all("\n" not in line for line in problems)


def test_folder_without_photographs(tmp_path) -> None:
    with pytest.raises(InputError, match="no photograph"):
        read_photos(tmp_path, ORIGIN)
    with pytest.raises(InputError, match="no such folder"):
        read_photos(tmp_path / "none", ORIGIN)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("name,yaw_deg\na,1\n", "needs the columns"),
        (
            "name,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg\na.jpg,1,2,3,0,0,0\n",
            "needs the columns .* sigma_m and",
        ),
        (
            "name,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg,sigma_m\na.jpg,1,x,3,0,0,0,1\n",
            "column north_m: 'x' is not a number",
        ),
        (
            "name,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg,sigma_m\na.jpg,1,2,3,0,0,0,\n",
            "a.jpg, column sigma_m: '' is not a number",
        ),
    ],
)
def test_bad_table(tmp_path, text: str, match: str) -> None:
    write_photo(tmp_path / "a.jpg", PICTURE, photo("a.jpg"), ORIGIN)
    (tmp_path / "photos.csv").write_text(text)
    with pytest.raises(InputError, match=match):
        read_photos(tmp_path, ORIGIN)


def test_camera_file(tmp_path) -> None:
    lens = camera()
    write_camera(tmp_path / "camera.toml", lens)
    again = read_camera(tmp_path / "camera.toml")
    assert again.size == lens.size
    for name in ("matrix", "distortion", "led_offset"):
        np.testing.assert_array_equal(getattr(again, name), getattr(lens, name))
    text = (tmp_path / "camera.toml").read_text()
    (tmp_path / "camera.toml").write_text(text.replace("focal_px", "focal"))
    with pytest.raises(FormatError, match="focal_px: needs 2 numbers, not None"):
        read_camera(tmp_path / "camera.toml")


def test_impossible_cameras_are_refused() -> None:
    with pytest.raises(InputError, match="focal lengths"):
        LedCamera((100, 100), np.diag([0.0, 1.0, 1.0]))
    with pytest.raises(InputError, match="led_offset"):
        LedCamera((100, 100), np.eye(3), np.zeros(5), np.array([0.0, 9.0, 0.0]))
    with pytest.raises(InputError, match="not a right-handed rotation"):
        Photo("x", None, np.zeros(3), np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match="has no time zone"):
        Photo("x", datetime(2026, 1, 1), np.zeros(3), np.eye(3))  # noqa: DTZ001
