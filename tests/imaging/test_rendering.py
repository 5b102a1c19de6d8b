"""Synthetic frames: the truth is where it is said to be, and light behaves as light."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.camera import project
from heliotrope.field.marks import Mark
from heliotrope.geometry import FloatArray, direction
from heliotrope.imaging.synthetic import _painting
from heliotrope.imaging.synthetic.rendering import (
    LensEffects,
    Paint,
    Rendered,
    Scene,
    Sensor,
    Shadow,
    Surroundings,
    Thrown,
    example_camera,
    example_target,
    exposed,
    point_spread,
    render,
)
from heliotrope.optics.coverage import coverage
from heliotrope.optics.mirror_image import (
    Beam,
    flat_top_beam,
    gaussian_beam,
    reflected_beam,
)

TARGET = example_target()
#: Small frames, and a lens five times as bent as the example's.
CAMERA = example_camera(TARGET, size=(640, 480), distortion=0.02)
PLAIN = Paint(wear=0.0, stains=0, panels=(1, 1))
BARE = replace(TARGET, marks=())
ALONE = Surroundings(wall=(0.0, 0.0, 0.0, 0.0), sky=0.0, texture=0.0, clutter=0)
SHARP = LensEffects(defocus=0.0, veil=0.0)


def scene(*beams: Thrown, **changes: object) -> Scene:
    """A plain white target alone in the dark, through a sharp but bent lens."""
    given = {
        "camera": CAMERA, "targets": (BARE,), "beams": beams, "ambient": 0.0, "paint": PLAIN,
        "surroundings": ALONE, "lens": SHARP, "sensor": Sensor(offset=0.0), **changes,
    }  # fmt: skip
    return Scene(**given)  # type: ignore[arg-type]


def light_of(rendered: Rendered) -> FloatArray:
    assert rendered.level is not None
    return rendered.level.astype(np.float64)


def centre_of(image: FloatArray) -> FloatArray:
    y, x = np.indices(image.shape)
    return np.array([np.sum(x * image), np.sum(y * image)]) / image.sum()


@cache
def field_beam() -> Beam:
    return reflected_beam(TARGET, (60.0, 180.0, 2.0), direction(2.6, 0.9), 3.2, 3.2)


# -- geometry --------------------------------------------------------------------------


def test_covered_areas_are_exact() -> None:
    rng = np.random.default_rng(3)
    shape = rng.uniform(-4.0, 24.0, (5, 2))
    fine = 64
    x = (np.arange(20 * fine) + 0.5) / fine - 0.5
    y = (np.arange(16 * fine) + 0.5) / fine - 0.5
    triangle = shape[:3]
    inside = np.ones((y.size, x.size), dtype=bool)
    side = np.sign(np.linalg.det(triangle[1:] - triangle[0]))
    for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
        cross = (b[0] - a[0]) * (y[:, None] - a[1]) - (b[1] - a[1]) * (x - a[0])
        inside &= side * cross > 0.0
    counted = inside.reshape(16, fine, 20, fine).mean(axis=(1, 3))
    for polygon in (triangle, triangle[::-1]):
        np.testing.assert_allclose(coverage([polygon], (16, 20)), counted, atol=0.02)
    box = np.array([(1.5, 2.25), (6.75, 2.25), (6.75, 8.5), (1.5, 8.5)])
    assert coverage([box], (16, 20)).sum() == pytest.approx(5.25 * 6.25, abs=1e-12)
    across = np.array([0, 0, 1, 1, 1, 1, 1, 0.25])
    down = np.array([0, 0, 0.25, 1, 1, 1, 1, 1, 1, 0])
    np.testing.assert_allclose(coverage([box], (10, 8)), np.outer(down, across), atol=1e-12)


@pytest.mark.parametrize("phase", [0.0, 0.13, 0.31, 0.5])
def test_paint_is_blurred_before_pixels_sample_it(phase: float) -> None:
    """An edge through a Gaussian lens, averaged over pixels: a difference of closed integrals."""
    sigma, edge = 0.6, 10.0 + phase
    half = np.array([(edge, -90.0), (90.0, -90.0), (90.0, 90.0), (edge, 90.0)])

    def integral(x: FloatArray) -> FloatArray:
        z = (x - edge) / sigma
        return sigma * (z * norm.cdf(z) + norm.pdf(z))

    x = np.arange(20.0)
    wanted = integral(x + 0.5) - integral(x - 0.5)
    found = _painting.soft_coverage([half], (80, 20), sigma)
    np.testing.assert_allclose(found, np.broadcast_to(wanted, found.shape), atol=3e-3)


@pytest.mark.parametrize("sigma", [0.1, 0.03, 0.015], ids=["4px", "1.3px", "0.6px"])
def test_tiny_beams_are_seen_where_their_points_project(sigma: float) -> None:
    """Gaussians, because pixels cannot sample a sharp border without moving its centroid."""
    rng = np.random.default_rng(1)
    for place in rng.uniform(-3.8, 3.8, (12, 2)) * (1.0 - 0.6 * (sigma > 0.05)):
        beam = gaussian_beam(place, sigma, power=10.0)
        rendered = render(scene(Thrown("target", beam)), 0, level=True)
        truth = rendered.beams[0]
        np.testing.assert_allclose(truth.pixel, project(CAMERA, TARGET.point(place)), atol=1e-9)
        np.testing.assert_allclose(truth.point, TARGET.point(place), atol=1e-9)
        found = centre_of(light_of(rendered))
        np.testing.assert_allclose(found, truth.pixel, rtol=0, atol=0.005)


def test_a_wide_beam_is_bent_by_lens_and_perspective_as_it_must_be() -> None:
    """The image's centroid is that of flux times the pixels that an area of the plane takes."""
    beam = gaussian_beam((1.0, -0.8), 0.7, 0.4, 0.3, 5e3, step=0.05)
    rows, columns = beam.flux.shape
    x, y = (np.arange(n) * beam.step for n in (columns, rows))
    places = beam.origin + np.stack(np.meshgrid(x, y), axis=-1)
    seen = project(CAMERA, TARGET.point(places))
    along, across = (np.gradient(seen, axis=axis) for axis in (1, 0))
    area = np.abs(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])
    weight = beam.flux * area
    wanted = (seen * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
    rendered = render(scene(Thrown("target", beam)), 0, level=True)
    np.testing.assert_allclose(centre_of(light_of(rendered)), wanted, rtol=0, atol=0.01)
    # It is not the projected centroid: this is what a finder must undo.
    assert np.linalg.norm(wanted - rendered.beams[0].pixel) > 0.01
    total = light_of(rendered).sum() / Sensor().scale
    power = PLAIN.reflectance * weight.sum()
    assert total == pytest.approx(power, rel=1e-3)


@pytest.mark.parametrize("kind", ["disc", "square"])
def test_marks_are_seen_where_their_points_project(kind: str) -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(-3.5, 3.5, (6, 2))
    lens = LensEffects(defocus=0.6, veil=0.0)
    for k, place in enumerate(places):
        mark = Mark("m", kind, TARGET.point(place), 0.25, turn=0.3 * k)
        bright, dark = (
            light_of(render(scene(targets=(t,), ambient=100.0, lens=lens), 0, level=True))
            for t in (BARE, replace(BARE, marks=(mark,)))
        )
        missing = bright - dark
        np.testing.assert_allclose(
            centre_of(missing), project(CAMERA, mark.point), rtol=0, atol=0.005
        )


def test_the_border_covers_pixels_by_their_exact_areas() -> None:
    level = light_of(render(scene(ambient=100.0), 0, level=True))
    full = 100.0 * PLAIN.reflectance * Sensor().scale
    border = np.concatenate(
        [
            np.linspace(a, b, 200, endpoint=False)
            for a, b in zip(TARGET.corners, np.roll(TARGET.corners, -1, axis=0), strict=True)
        ]
    )
    x, y = project(CAMERA, border).T
    area = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert level.sum() / full == pytest.approx(area, rel=2e-6)
    assert level.max() == pytest.approx(full, rel=1e-5)


def test_pixels_see_the_plane_where_its_points_project() -> None:
    plane = _painting.painted_scene(scene()).planes[0]
    rows, columns = np.mgrid[3:480:61, 5:640:71]
    seen = np.stack([plane.u[rows, columns], plane.v[rows, columns]], axis=-1)
    pixels = project(CAMERA, TARGET.point(seen))
    np.testing.assert_allclose(pixels, np.stack([columns, rows], axis=-1), rtol=0, atol=1e-3)


def test_blur_and_shake_leave_places_alone() -> None:
    for lens in (
        LensEffects(2.5),
        LensEffects(2.5, disc=True),
        LensEffects(1.2, shake=(7.0, -4.0)),
    ):
        spread = point_spread(lens)
        assert spread.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(spread, spread[::-1, ::-1], atol=1e-15)
        beam = flat_top_beam((0.5, 0.7), 0.1, power=10.0, round_=True)
        rendered = render(
            scene(Thrown("target", beam), lens=replace(lens, veil=0.0)), 0, level=True
        )
        found = centre_of(light_of(rendered))
        np.testing.assert_allclose(found, rendered.beams[0].pixel, rtol=0, atol=0.01)
    disc = point_spread(LensEffects(3.0, disc=True))
    x = np.indices(disc.shape)[1] - disc.shape[1] // 2
    assert np.sum(disc * x**2) == pytest.approx(3.0**2 / 4.0, rel=0.05)
    trail = point_spread(LensEffects(0.0, shake=(12.0, 0.0)))
    x = np.arange(trail.shape[1]) - trail.shape[1] // 2
    assert trail.sum(axis=0) @ x**2 == pytest.approx(12.0**2 / 12.0, rel=0.05)


def test_a_moving_beam_is_where_it_is_in_the_middle() -> None:
    beam = gaussian_beam((0.3, 0.4), 0.2, power=100.0)
    still, moving = (
        render(scene(Thrown("target", beam, motion=m)), 0, level=True)
        for m in ((0.0, 0.0), (1.0, 0.2))
    )
    np.testing.assert_allclose(moving.beams[0].centroid, (0.3, 0.4), atol=1e-9)
    assert light_of(moving).max() < 0.6 * light_of(still).max()
    assert light_of(moving).sum() == pytest.approx(light_of(still).sum(), rel=1e-3)


# -- light -----------------------------------------------------------------------------


def test_light_adds_and_clouds_dim_the_beams_only() -> None:
    beam = Thrown("target", gaussian_beam((0.0, 0.0), 0.6, power=1500.0))
    both, ambient, dimmed = (
        light_of(render(s, 0, level=True))
        for s in (scene(beam, ambient=80.0), scene(ambient=80.0), scene(beam, cloud=0.25))
    )
    alone = light_of(render(scene(beam), 0, level=True))
    np.testing.assert_allclose(both, ambient + alone, rtol=0, atol=1e-6)
    np.testing.assert_allclose(dimmed, 0.25 * alone, rtol=0, atol=1e-6)
    peak = PLAIN.reflectance * beam.beam.peak * Sensor().scale
    assert alone.max() == pytest.approx(peak, rel=2e-3)
    assert render(scene(beam), 0).beams[0].peak == pytest.approx(alone.max(), rel=1e-6)


def test_shadow_and_gradient() -> None:
    shadow = Shadow(point=(0.5, 0.0), angle=0.0, softness=0.5, left=0.3)
    s = scene(ambient=100.0, shadow=shadow, gradient=(0.0, 0.05))
    level = light_of(render(s, 0, level=True))
    full = 100.0 * PLAIN.reflectance * Sensor().scale

    def at(x: float, y: float) -> float:
        column, row = np.rint(project(CAMERA, TARGET.point((x, y)))).astype(int)
        return float(level[row, column] / full)

    assert at(-2.0, 0.0) == pytest.approx(1.0, abs=0.005)
    assert at(2.0, 0.0) == pytest.approx(0.3, abs=0.005)
    assert at(0.5, 0.0) == pytest.approx(0.65, abs=0.03)  # a pixel is a tenth of the edge
    assert at(-2.0, 2.0) == pytest.approx(1.1, abs=0.005)
    assert at(2.0, -2.0) == pytest.approx(0.27, abs=0.005)


def test_light_beyond_the_border_falls_on_the_wall() -> None:
    beam = Thrown("target", gaussian_beam((4.0, 0.0), 0.3, power=300.0))
    walled = replace(ALONE, wall=(2.0, 2.0, 2.0, 2.0), reflectance=0.425)
    dark, grey = (
        light_of(render(scene(beam, surroundings=s), 0, level=True)).sum() for s in (ALONE, walled)
    )
    assert grey / dark == pytest.approx(1.5, abs=0.01)  # half the light on half as white a wall
    truth = render(scene(beam), 0).beams[0]
    assert truth.share_on_target == pytest.approx(0.5, abs=0.002)
    assert truth.centroid_on_target[0] < 4.0 < truth.centroid[0] + 1e-9
    assert np.isfinite(truth.pixel_on_target).all()


def test_two_targets_on_one_wall() -> None:
    lower = example_target(4.0, (0.0, 0.0, 32.0), "lower")
    camera = example_camera(TARGET, size=(640, 480), fill=0.4)
    s = Scene(
        camera,
        (TARGET, lower),
        (Thrown("lower", gaussian_beam((0.2, 0.1), 0.2, power=500.0)),),
        lens=SHARP,
        paint=PLAIN,
    )
    with_beam, without = (light_of(render(x, 0, level=True)) for x in (s, replace(s, beams=())))
    found = centre_of(with_beam - without)
    np.testing.assert_allclose(found, project(camera, lower.point((0.2, 0.1))), atol=0.02)
    planes = _painting.painted_scene(s)
    total = sum(p.share for p in planes.planes)
    assert np.max(total) <= 1.0 + 1e-5
    assert len(render(s, 0).marks) == 16


def test_flare() -> None:
    beam = Thrown("target", gaussian_beam((0.0, 0.0), 0.6, power=1500.0))
    plain = light_of(render(scene(beam), 0, level=True))
    lens = replace(SHARP, veil=0.2, ghost=0.3, ghost_at=(50.0, 400.0), ghost_radius=10.0)
    veiled = light_of(render(scene(beam, lens=lens), 0, level=True)) - plain
    assert veiled[100, 600] == pytest.approx(0.2 * plain.mean(), rel=1e-3)
    assert veiled[400, 50] - veiled[100, 600] == pytest.approx(0.3, rel=1e-3)


# -- sensor ----------------------------------------------------------------------------


@pytest.mark.parametrize("gain", [1.0, 2.5])
def test_photon_transfer(gain: float) -> None:
    """Variance grows with the mean by one reading an electron, from the noise of reading."""
    sensor = Sensor(electrons=8000.0, read_noise=9.0, offset=0.02, gain=gain, bits=12)
    means, variances = [], []
    for ambient in (0.0, 60.0, 150.0, 300.0):
        pixels = render(scene(ambient=ambient, sensor=sensor), 5).frame.pixels
        x, y = np.rint(project(CAMERA, TARGET.center)).astype(int)
        part = (pixels[y - 90 : y + 90, x - 90 : x + 90] >> 4).astype(np.float64)
        means.append(part.mean() - 0.02 * 4095)
        variances.append(part.var())
    step = gain * 4095 / 8000.0
    slope, floor = np.polyfit(means, variances, 1)
    assert slope == pytest.approx(step, rel=0.03)
    assert floor == pytest.approx((9.0 * step) ** 2 + 1.0 / 12.0, rel=0.1)
    light = 300.0 * PLAIN.reflectance * sensor.scale * 4095
    assert means[-1] == pytest.approx(light, rel=2e-3)


def test_clipping_is_counted() -> None:
    beam = gaussian_beam((0.0, 0.0), 0.6, power=1.0)
    sensor = Sensor(offset=0.0, read_noise=0.0)
    # Twice the full scale at the peak.
    strength = 2.0 / (PLAIN.reflectance * beam.peak * sensor.scale)
    rendered = render(scene(Thrown("target", beam, strength), sensor=sensor), 0, level=True)
    truth = rendered.beams[0]
    assert truth.peak == pytest.approx(2.0, rel=2e-3)
    # A two-dimensional bell is above half its peak within r² = 2 σ² ln 2: half of its energy.
    assert truth.share_clipped == pytest.approx(0.5, abs=0.02)
    pixels = rendered.frame.pixels
    assert pixels.max() == 255
    assert (light_of(rendered) > 1.0).mean() == pytest.approx(rendered.clipped, rel=0.1)
    twelve = render(scene(Thrown("target", beam, strength), sensor=Sensor(bits=12)), 0).frame
    assert twelve.pixels.dtype == np.uint16
    assert twelve.pixels.max() == 65535
    assert np.unique(twelve.pixels >> 4).size <= 4096
    assert render(scene(ambient=1.0), 0).clipped == 0.0


def test_srgb_brightens_the_dark() -> None:
    linear, curved = (
        render(scene(ambient=300.0, sensor=Sensor(bits=12, srgb=s)), 3).frame.pixels.astype(float)
        for s in (False, True)
    )
    share = linear / 65535.0
    bright = share > 0.1
    wanted = 1.055 * share[bright] ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(curved[bright] / 65535.0, wanted, atol=1e-3)


def test_colour_has_warm_beams_and_a_cool_sky() -> None:
    beam = gaussian_beam((0.0, 0.0), 0.6, power=2500.0)
    s = Scene(CAMERA, (TARGET,), (Thrown("target", beam),), sensor=Sensor(colour=True))
    rendered = render(s, 0)
    pixels = rendered.frame.pixels.astype(float)
    assert pixels.shape == (480, 640, 3)
    x, y = np.rint(rendered.beams[0].pixel).astype(int)
    assert (
        pixels[y - 5 : y + 5, x - 5 : x + 5, 2].mean()
        > pixels[y - 5 : y + 5, x - 5 : x + 5, 0].mean()
    )
    assert pixels[:20, :20, 0].mean() > pixels[:20, :20, 2].mean()


def test_exposed_for_the_beam() -> None:
    beam = Thrown("target", field_beam())
    s = exposed(scene(beam, ambient=150.0, sensor=Sensor()), 0.7)
    assert render(s, 0).beams[0].peak == pytest.approx(0.7, abs=0.01)
    dark = exposed(scene(ambient=150.0, sensor=Sensor()), 0.4)
    assert light_of(render(dark, 0, level=True)).max() == pytest.approx(0.4, abs=1e-3)


def test_marks_lit_and_covered() -> None:
    corner = TARGET.plane_coordinates(TARGET.marks[0].point)
    strong = Thrown("target", gaussian_beam(corner + [0.3, -0.3], 0.5, power=1e6))
    weak = Thrown("target", gaussian_beam(-corner + [-0.3, 0.3], 0.5, power=300.0))
    s = scene(strong, weak, targets=(TARGET,), ambient=150.0)
    marks = {mark.name: mark for mark in render(s, 0).marks}
    assert marks["upper_left"].covered
    assert marks["upper_left"].lit
    assert marks["lower_right"].lit
    assert not marks["lower_right"].covered
    assert not marks["lower_left"].lit
    assert marks["lower_left"].contrast == pytest.approx(
        (PLAIN.reflectance - PLAIN.mark) * 150.0 * Sensor().scale, rel=1e-3
    )
    assert all(mark.in_frame for mark in marks.values())
    dark = render(scene(targets=(TARGET,), ambient=0.01), 0).marks
    assert all(mark.covered for mark in dark)


def test_seeds_repeat_bit_for_bit() -> None:
    s = Scene(CAMERA, (TARGET,), (("target", field_beam(), 0.3),))  # type: ignore[arg-type]
    assert isinstance(s.beams[0], Thrown)
    first = render(s, 7, name="a")
    _painting._painted.cache_clear()
    _painting._areas.cache_clear()
    again, other = render(s, 7, name="a"), render(s, 8)
    np.testing.assert_array_equal(first.frame.pixels, again.frame.pixels)
    assert first.beams[0].pixel.tolist() == again.beams[0].pixel.tolist()
    assert (first.frame.pixels != other.frame.pixels).mean() > 0.3
    worn = render(replace(s, paint=Paint(seed=1, patch=0.6)), 7, level=True)
    moved = render(replace(s, surroundings=Surroundings(seed=1)), 7, level=True)
    plain = render(s, 7, level=True)
    assert not np.allclose(light_of(worn), light_of(plain))
    assert not np.allclose(light_of(moved), light_of(plain))
    assert first.frame.exposure == s.sensor.exposure


def test_the_example_camera_frames_the_target() -> None:
    camera = example_camera(TARGET)
    pixels = project(camera, TARGET.corners)
    assert camera.size == (1600, 1200)
    assert (pixels > 50).all()
    assert (pixels < np.array(camera.size) - 50).all()
    assert camera.position is not None
    assert camera.position[2] < TARGET.center[2]
    straight = project(replace(camera, distortion=np.zeros(5)), TARGET.corners)
    bent = np.linalg.norm(pixels - straight, axis=-1)
    assert 0.3 < bent.max() < 5.0
    # Marks lie inside the border, arms inwards.
    for mark in TARGET.marks:
        for shape in _painting.mark_shapes(TARGET, mark):
            assert np.abs(shape).max() < 3.8


# -- bad input -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Scene(CAMERA, ()), "no target"),
        (lambda: Scene(CAMERA, (TARGET, TARGET)), "a name occurs twice"),
        (lambda: Scene(CAMERA, (TARGET,), ambient=-1.0), "ambient must be .* not -1.0 W/m²"),
        (lambda: Scene(CAMERA, (TARGET,), cloud=1.5), "cloud must be between 0 and 1, not 1.5"),
        (lambda: Scene(CAMERA, (TARGET,), gradient=(np.nan, 0.0)), "gradient"),
        (
            lambda: Thrown("target", gaussian_beam((0, 0), 1.0), -1.0),
            "strength must be .* not -1.0",
        ),
        (lambda: Paint(reflectance=1.5), "reflectance must be .* not 1.5"),
        (lambda: Paint(panels=(0, 1)), "panels"),
        (lambda: Paint(wear=0.9), "wear must be .* not 0.9"),
        (lambda: Surroundings(wall=(-1.0, 0.0, 0.0, 0.0)), "wall"),
        (lambda: Surroundings(sky=-1.0), "sky"),
        (lambda: Surroundings(texture=0.9), "texture must be .* not 0.9"),
        (lambda: Shadow(left=2.0), "left must be .* not 2.0"),
        (lambda: Shadow(softness=-1.0), "softness"),
        (lambda: LensEffects(defocus=-1.0), "defocus must be .* not -1.0 px"),
        (lambda: LensEffects(veil=2.0), "veil must be .* not 2.0"),
        (lambda: LensEffects(ghost_radius=0.0), "ghost"),
        (lambda: Sensor(gain=0.0), "gain must be .* not 0.0"),
        (lambda: Sensor(read_noise=-1.0), "read_noise must be .* not -1.0"),
        (lambda: Sensor(offset=1.0), "offset must be .* not 1.0"),
        (lambda: Sensor(bits=10), "bits must be 8 or 12, not 10"),
        (lambda: exposed(scene()), "nothing to expose for"),
        (lambda: exposed(scene(ambient=1.0), -0.1), r"peak \(-0.1\)"),
        (lambda: render(scene(), -1), "seed must be .* not -1"),
        (lambda: example_camera(TARGET, 0.0), "distance .* not 0.0 m"),
    ],
)
def test_guards(make: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        make()  # type: ignore[operator]


def test_cameras_that_cannot_see_the_target() -> None:
    assert CAMERA.position is not None
    assert CAMERA.R_enu_camera is not None
    lost = replace(CAMERA, position=None, R_enu_camera=None)
    with pytest.raises(InputError, match="its position is unknown"):
        render(scene(camera=lost), 0)
    behind = replace(CAMERA, position=CAMERA.position * [1.0, -1.0, 1.0])
    with pytest.raises(InputError, match="cannot see the front of target target"):
        render(scene(camera=behind), 0)
    near = example_camera(TARGET, 9.0, side=1.3, size=(640, 480))
    wide = replace(ALONE, wall=(0.0, 60.0, 0.0, 0.0))
    with pytest.raises(InputError, match="make the surroundings' wall smaller"):
        render(scene(camera=near, surroundings=wide), 0)
    with pytest.raises(UnknownNameError, match="there is no target 'tower'"):
        scene(Thrown("tower", gaussian_beam((0, 0), 1.0)))
    picture = replace(BARE, marks=(Mark("logo", "picture", TARGET.center, 1.0, code="x.png"),))
    with pytest.raises(InputError, match="a picture has no polygons"):
        render(scene(targets=(picture,)), 0)
