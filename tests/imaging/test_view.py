"""Views: a plane in a frame, recovered with a covariance that is true."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.field.camera import Camera, project
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.synthetic.scenes import example_camera, example_target
from heliotrope.imaging.targets.view import (
    FaceView,
    faces,
    fit_view,
    homography,
    unknown_lens,
)

TARGET = example_target()
FACE = faces((TARGET,))[0]
CAMERA = example_camera(TARGET, size=(1600, 1200), distortion=0.004)
MARKS = np.array([m.point for m in TARGET.marks])
GRID = TARGET.point(np.stack(np.meshgrid(*[np.linspace(-4.0, 4.0, 9)] * 2), -1).reshape(-1, 2))
#: A view's accuracy over the whole target, m.
MAPPED = 5e-3


def seen(noise: float = 0.0, seed: int = 0, camera: Camera = CAMERA) -> FloatArray:
    rng = np.random.default_rng(seed)
    return project(camera, MARKS) + noise * rng.standard_normal((len(MARKS), 2))


def fitted(
    pixels: FloatArray, deviation: float, lens: Camera | None = None, marks: FloatArray = MARKS
) -> FaceView:
    covariance = np.broadcast_to(deviation**2 * np.eye(2), (len(pixels), 2, 2))
    unknown = unknown_lens(CAMERA.size)
    return fit_view(FACE, FACE.plane(marks), pixels, covariance, lens or unknown, lens is not None)


def off(view: FaceView, camera: Camera = CAMERA) -> FloatArray:
    """Errors over the target, m, (81,)."""
    found = view.to_plane(project(camera, GRID))
    return np.asarray(np.linalg.norm(found - FACE.plane(GRID), axis=-1))


def test_a_known_lens_gives_the_plane_exactly() -> None:
    view = fitted(seen(), 0.1, CAMERA)
    assert off(view).max() < 1e-6
    assert view.residual < 1e-6
    np.testing.assert_allclose(view.lens.distortion, CAMERA.distortion, atol=1e-9)


@pytest.mark.parametrize("distortion", [0.0, 0.004, 0.012, -0.008])
def test_an_unknown_lens_is_learnt_well_enough(distortion: float) -> None:
    """At 200 m; tangential terms and k2 are in the frames but not in the model."""
    camera = example_camera(TARGET, size=(1600, 1200), distortion=distortion)
    view = fitted(seen(camera=camera), 0.1)
    assert off(view, camera).max() < MAPPED
    # Without the lens it is worse than that.
    if abs(distortion) > 0.01:
        plane = homography(FACE.plane(MARKS), seen(camera=camera))
        places = np.column_stack([FACE.plane(GRID), np.ones(len(GRID))]) @ plane.T
        bent = places[:, :2] / places[:, 2:] - project(camera, GRID)
        assert np.linalg.norm(bent, axis=1).max() / 103.0 > MAPPED


def test_there_and_back() -> None:
    view = fitted(seen(0.3), 0.3)
    plane = FACE.plane(GRID)
    np.testing.assert_allclose(view.to_plane(view.to_pixels(plane)), plane, rtol=0, atol=1e-7)
    step = 1e-4 * np.eye(2)
    slopes = [(view.to_pixels(plane + e) - view.to_pixels(plane - e)) / 2e-4 for e in step]
    np.testing.assert_allclose(view.scale(plane), np.stack(slopes, axis=-1), rtol=1e-5, atol=1e-4)
    assert view.scale(plane).shape == (81, 2, 2)


@pytest.mark.parametrize("known", [True, False], ids=["lens known", "lens unknown"])
@pytest.mark.parametrize("place", [(0.0, 0.0), (3.5, -2.5)])
def test_covariances_are_those_of_the_noise(known: bool, place: tuple[float, float]) -> None:
    plane, errors = np.array(place), []
    true = project(CAMERA, FACE.point(plane))
    for seed in range(120):
        view = fitted(seen(0.5, seed), 0.5, CAMERA if known else None)
        miss = view.to_plane(true) - plane
        errors.append(miss @ np.linalg.solve(view.covariance_at(plane), miss))
    # Two for two coordinates; less, for residuals may raise a covariance but not lower it.
    assert 1.2 < np.mean(errors) < 2.6


def test_residuals_that_are_too_large_raise_the_covariance() -> None:
    honest, hopeful = (fitted(seen(2.0, 5), d).covariance_at((0.0, 0.0)) for d in (2.0, 0.2))
    alone = fitted(seen(0.0), 0.2).covariance_at((0.0, 0.0))
    assert np.trace(hopeful) > 10.0 * np.trace(alone)
    assert np.trace(hopeful) > 0.1 * np.trace(honest)


def test_covariances_between_points_count() -> None:
    """Errors that all points share move the view, and are told; those alone average out."""
    pixels, n = seen(), len(MARKS)
    shared = np.kron(np.ones((n, n)), np.eye(2)) + 1e-2 * np.eye(2 * n)
    each = np.broadcast_to(1.01 * np.eye(2), (n, 2, 2))
    lens = (CAMERA, True)
    both = [fit_view(FACE, FACE.plane(MARKS), pixels, c, *lens) for c in (shared, each)]
    np.testing.assert_allclose(both[0].H_norm_plane, both[1].H_norm_plane, atol=1e-9)
    traces = [np.trace(v.covariance_at((0.0, 0.0))) for v in both]
    per_metre = np.abs(np.linalg.det(both[0].scale(np.zeros(2)))) ** 0.5
    assert traces[0] > 3.0 * traces[1]
    assert np.sqrt(0.5 * traces[0]) * per_metre == pytest.approx(1.0, rel=0.1)
    blocks = np.zeros((2 * n, 2 * n))
    for k in range(n):
        blocks[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = each[k]
    whole = fit_view(FACE, FACE.plane(MARKS), pixels, blocks, *lens)
    np.testing.assert_allclose(whole.covariance, both[1].covariance, rtol=1e-6, atol=1e-12)


def test_four_points_are_enough_and_leave_more_open() -> None:
    four = fitted(seen()[:4], 0.3, None, MARKS[:4])
    eight = fitted(seen(), 0.3)
    far = np.array([0.0, -3.9])
    assert off(four).max() < 0.03
    assert np.trace(four.covariance_at(far)) > 1.5 * np.trace(eight.covariance_at(far))


def test_an_unknown_lens_has_the_frames_size_and_no_distortion() -> None:
    lens = unknown_lens((640, 480))
    np.testing.assert_allclose(lens.matrix[:2, 2], [319.5, 239.5])
    assert lens.size == (640, 480)
    assert not lens.distortion.any()


# -- faces -----------------------------------------------------------------------------


def moved(target: Target, shift: tuple[float, float, float], name: str) -> Target:
    return replace(target, name=name, corners=target.corners + shift, center=target.center + shift)


def test_targets_that_meet_in_a_plane_are_one_face() -> None:
    lower = moved(TARGET, (0.0, 0.02, -8.1), "lower")
    found = faces((TARGET, lower))
    assert [tuple(t.name for t in f.targets) for f in found] == [("target", "lower")]
    np.testing.assert_allclose(found[0].span, [[-4.0, -8.05], [4.0, 8.05]], atol=1e-9)
    points = TARGET.point(np.array([[1.0, 2.0], [-3.0, 0.5]]))
    np.testing.assert_allclose(found[0].point(found[0].plane(points)), points, atol=0.02)


@pytest.mark.parametrize(
    "shift", [(0.0, 0.4, -8.1), (-11.0, 0.0, 0.0)], ids=["behind", "another tower"]
)
def test_targets_apart_are_faces_of_their_own(shift: tuple[float, float, float]) -> None:
    assert len(faces((TARGET, moved(TARGET, shift, "other")))) == 2
