"""The errors of a real flight, each as large as asked for."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.airborne.evaluate.detection import decode
from heliotrope.airborne.simulate import rendering
from heliotrope.airborne.simulate.simulation import Errors, Flight, fly, hover_grid, look_counts
from heliotrope.errors import InputError
from heliotrope.geometry import direction
from support.drone_case import HOVER, camera, field

MRAD = 1e-3
NONE = Errors(slope=0.4e-3)


def flown(errors: Errors, columns: int = 3) -> Flight:
    mirrors = field()
    middle = mirrors.position.mean(axis=0)
    pattern = hover_grid(HOVER, middle, columns, 3, 0.7)
    return fly(mirrors, camera(), look_counts(mirrors, HOVER), pattern, middle, errors=errors)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def test_vertices_are_not_where_the_mechanism_puts_them() -> None:
    plain, real = flown(NONE), flown(replace(NONE, kinematics=0.030))
    assert rms(real.truth.vertex - plain.truth.vertex) == pytest.approx(0.030, rel=0.25)
    np.testing.assert_array_equal(real.truth.rotation, plain.truth.rotation)


def test_facets_are_canted_about_the_axis_of_the_mirror() -> None:
    real = flown(replace(NONE, canting=0.5e-3))
    tilt = np.array([s.slope.mean(axis=(1, 2)) for s in real.shapes])
    # The mean of four leaves three quarters of the variance.
    assert rms(tilt) == pytest.approx(0.5e-3 * np.sqrt(0.75), rel=0.2)
    np.testing.assert_allclose(tilt.mean(axis=1), 0.0, atol=1e-9)
    assert rms(np.array([s.slope.mean(axis=(1, 2)) for s in flown(NONE).shapes])) < 1e-9


def test_maps_differ_from_mirrors() -> None:
    real = flown(replace(NONE, map_error=0.1e-3))
    off = np.array([m - s.slope for m, s in zip(real.maps, real.shapes, strict=True)])
    assert rms(off) == pytest.approx(0.1e-3, rel=0.05)
    plain = flown(NONE)
    assert all(m is s.slope for m, s in zip(plain.maps, plain.shapes, strict=True))


def test_camera_file_is_off_at_the_corners() -> None:
    real = flown(replace(NONE, lens=0.8))
    known, true = real.known_camera, real.camera
    photo = real.taken[0]
    x, y = (0.5 * (n - 1) / true.focal for n in true.size)
    way = np.array([[x, y, 1.0], [0.0, 0.0, 1.0]]) * 50.0
    points = photo.position + way @ photo.rotation.T
    gap = np.linalg.norm(photo.pixels(known, points) - photo.pixels(true, points), axis=-1)
    assert gap[0] == pytest.approx(0.8, rel=0.05)
    assert gap[1] < 1e-6


def test_drone_leaves_its_pattern_and_knows() -> None:
    plain, real = flown(NONE, 6), flown(replace(NONE, hover=0.1), 6)
    places = [np.array([p.position for p in f.recorded]) for f in (plain, real)]
    assert rms(places[1] - places[0]) == pytest.approx(0.1, rel=0.3)
    off = [p.position - q.position for p, q in zip(real.recorded, real.taken, strict=True)]
    assert rms(np.array(off)) == pytest.approx(0.008, rel=0.3)


def test_errors_below_zero_are_refused() -> None:
    with pytest.raises(InputError, match=r"errors: hover must be 0 or more, not -0\.1"):
        Errors(hover=-0.1)
    with pytest.raises(InputError, match=r"conditions: speed must be 0 or more, not -1\.0"):
        rendering.Conditions(speed=-1.0)


def test_clouds_are_seen_in_mirrors() -> None:
    azimuth = np.linspace(0.0, 2.0 * np.pi, 400)
    way = direction(azimuth, np.full(400, np.radians(40.0)))
    clear, cloudy = (rendering.sky_light(way, rendering.Conditions(clouds=c)) for c in (0.0, 0.15))
    assert clear.std() < 1e-9
    assert cloudy.std() / clear.mean() == pytest.approx(0.15, rel=0.35)
    assert cloudy.mean() == pytest.approx(clear.mean(), rel=0.1)


def test_photographs_of_a_moving_drone_are_blurred(tmp_path) -> None:
    every = flown(NONE)
    still = replace(every, taken=every.taken[:1], recorded=every.recorded[:1])
    pictures = []
    for speed in (0.0, 8.0):
        light = rendering.Conditions(speed=speed, exposure=0.01)
        folder = tmp_path / str(speed)
        rendering.render_flight(still, folder, (37.0, -2.0, 500.0), conditions=light)
        pictures.append(decode(folder / still.recorded[0].name).astype(float))
    across, along = (
        [float(np.abs(np.diff(p, axis=axis)).mean()) for p in pictures] for axis in (1, 0)
    )
    # 8 cm at 58 m are 1.6 px, across only.
    assert across[1] < 0.9 * across[0]
    assert along[1] / along[0] > across[1] / across[0]
