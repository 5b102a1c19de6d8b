"""Beams on a target's plane: exact centroids, and the optics of a heliostat's cone."""

from functools import cache

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.geometry import MRAD, FloatArray, bisector, direction, normalize, reflect
from heliotrope.imaging.synthetic.scenes import example_target
from heliotrope.optics.mirror_image import (
    SUN_RADIUS,
    Beam,
    equal_facets,
    flat_top_beam,
    gaussian_beam,
    reflected_beam,
)
from heliotrope.optics.sun_shape import AUREOLE_RADIUS, sun_profile

MM = 1e-3
TARGET = example_target()
SUN = direction(np.radians(150.0), np.radians(50.0))
MIRROR = np.array([60.0, 180.0, 2.0])


def numeric_moments(beam: Beam) -> tuple[FloatArray, FloatArray]:
    """Centroid and covariance of the bilinear surface by a fine sum over it."""
    fine = 4
    rows, columns = beam.flux.shape
    x, y = ((np.arange((n + 1) * fine) + 0.5) / fine - 1.0 for n in (columns, rows))
    places = beam.origin + beam.step * np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    weight = beam.at(places)
    centroid = weight @ places / weight.sum()
    off = places - centroid
    return centroid, (off * weight[:, None]).T @ off / weight.sum()


@cache
def field_beam(sun_shape: str = "limb", focal: float | None = None, slope: float = 1e-3) -> Beam:
    return reflected_beam(
        TARGET, MIRROR, SUN, 3.2, 3.2, sun_shape=sun_shape, focal=focal, slope_error=slope
    )


# -- beams -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "beam",
    [
        gaussian_beam((1.0, -0.5), 0.6, 0.3, 0.5, 2e3),
        flat_top_beam((-0.7, 0.2), 0.8, 0.5, 0.3, 2e3),
        flat_top_beam((-0.7, 0.2), 0.5, power=2e3, round_=True),
        Beam.from_image(np.arange(12.0).reshape(3, 4), 0.1, (0.3, 0.4), power=2e3),
        field_beam(),
    ],
    ids=["gaussian", "box", "disc", "picture", "reflected"],
)
def test_centroid_and_moments_are_those_of_the_surface(beam: Beam) -> None:
    centroid, covariance = numeric_moments(beam)
    np.testing.assert_allclose(beam.centroid, centroid, rtol=0, atol=1e-6)
    np.testing.assert_allclose(beam.second_moments, covariance, rtol=0, atol=2e-4)
    assert beam.power == pytest.approx(beam.flux.sum() * beam.step**2)


def test_simple_shapes_are_what_they_say() -> None:
    bell = gaussian_beam((1.0, -0.5), 0.6, 0.3, 0.5, 2e3)
    np.testing.assert_allclose(bell.centroid, (1.0, -0.5), rtol=0, atol=1e-12)
    values, vectors = np.linalg.eigh(bell.second_moments)
    np.testing.assert_allclose(np.sqrt(values), (0.3, 0.6), rtol=2e-3)
    assert abs(vectors[:, 1] @ [np.cos(0.5), np.sin(0.5)]) == pytest.approx(1.0, abs=1e-5)
    assert bell.peak == pytest.approx(2e3 / (2.0 * np.pi * 0.6 * 0.3), rel=1e-4)
    box = flat_top_beam((-0.7, 0.2), 0.8, 0.5, 0.3, 2e3)
    np.testing.assert_allclose(box.centroid, (-0.7, 0.2), rtol=0, atol=1e-12)
    assert box.peak == pytest.approx(2e3 / 0.4, rel=1e-9)


def test_a_picture_is_seen_from_the_front() -> None:
    image = np.zeros((5, 7))
    image[1, 6] = 1.0  # above the middle row, right of the middle column
    beam = Beam.from_image(image, 0.1, (2.0, 1.0))
    np.testing.assert_allclose(beam.centroid, (2.3, 1.1), atol=1e-12)


def test_moved_turned_coarser_and_swept_beams() -> None:
    beam = gaussian_beam((0.2, 0.1), 0.3, 0.2, 0.7, 500.0)
    np.testing.assert_allclose(beam.shifted((0.5, -1.0)).centroid, (0.7, -0.9), atol=1e-12)
    coarse = beam.coarser(3)
    np.testing.assert_allclose(coarse.centroid, (0.2, 0.1), atol=1e-12)
    assert coarse.power == pytest.approx(500.0)
    swept = beam.swept((0.6, -0.3))
    np.testing.assert_allclose(swept.centroid, (0.2, 0.1), atol=1e-9)
    assert swept.power == pytest.approx(500.0)
    grown = swept.second_moments - beam.second_moments
    # An even movement by m has the variance m²/12.
    wanted = np.array([[0.36, -0.18], [-0.18, 0.09]]) / 12.0
    np.testing.assert_allclose(grown, wanted, rtol=0, atol=2e-4)
    assert beam.swept((0.0, 0.0)) is beam


def test_several_beams_as_one_have_their_light_at_its_places() -> None:
    def sent(right: float, up: float, step: float = 0.04) -> Beam:
        aim = TARGET.point(np.array([right, up]))
        return reflected_beam(TARGET, MIRROR, SUN, 3.0, 2.0, aim=aim, step=step)

    one, other = sent(0.3, -0.2), sent(-1.9, 0.7)
    both = Beam.together([one, other])
    assert both.power == pytest.approx(one.power + other.power, rel=1e-12)
    middle = (one.power * one.centroid + other.power * other.centroid) / both.power
    np.testing.assert_allclose(both.centroid, middle, atol=1e-9)
    row, column = np.round((one.origin - both.origin)[::-1] / 0.04).astype(int)
    rows, columns = np.round((other.origin - both.origin)[::-1] / 0.04).astype(int)
    left = both.flux.copy()
    left[row : row + one.flux.shape[0], column : column + one.flux.shape[1]] -= one.flux
    left[rows : rows + other.flux.shape[0], columns : columns + other.flux.shape[1]] -= other.flux
    assert np.abs(left).max() < 1e-9 * both.peak
    # A grid of 4 cm shows the same beam as one of 2 cm.
    fine = sent(0.3, -0.2, 0.02)
    np.testing.assert_allclose(fine.centroid, one.centroid, atol=0.1 * MM)
    np.testing.assert_allclose(fine.second_moments, one.second_moments, rtol=0.01)
    alone = Beam.together([one])
    assert np.array_equal(alone.flux, one.flux)
    for bad in (fine, one.shifted((0.01, 0.0))):
        with pytest.raises(InputError, match="on a common grid"):
            Beam.together([one, bad])


def test_what_falls_on_the_target() -> None:
    """Half a symmetric beam at the border: half its energy, and the half bell's centroid."""
    sigma = 0.4
    share, centroid = gaussian_beam((4.0, 0.5), sigma, power=1.0, step=0.01).on_target(TARGET)
    assert share == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(centroid, (4.0 - sigma * np.sqrt(2 / np.pi), 0.5), atol=2 * MM)
    share, centroid = gaussian_beam((9.0, 0.0), sigma).on_target(TARGET)
    assert share == 0.0
    assert np.isnan(centroid).all()


# -- cone optics -----------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["pillbox", "limb", "buie"])
def test_energy_is_what_the_mirror_catches(shape: str) -> None:
    normal = bisector(SUN, normalize(TARGET.center - MIRROR))
    caught = 0.9 * 900.0 * 3.2**2 * float(normal @ SUN)
    assert field_beam(shape).power == pytest.approx(caught, rel=2e-4)  # facets are tilted
    assert field_beam(shape).flux.min() >= 0.0


@pytest.mark.parametrize("aim", [(0.0, 0.0), (2.5, -1.5)])
def test_the_centre_of_a_flat_mirrors_beam_is_the_reflected_ray(aim: tuple[float, float]) -> None:
    normal = bisector(SUN, normalize(TARGET.point(aim) - MIRROR))
    beam = reflected_beam(
        TARGET, MIRROR, SUN, 3.2, 2.4, normal=normal, focal=np.inf, elements=9, step=0.04
    )
    hit = TARGET.plane_coordinates(TARGET.intersect(MIRROR, reflect(SUN, normal)))
    np.testing.assert_allclose(hit, aim, atol=1e-9)
    np.testing.assert_allclose(beam.centroid, hit, rtol=0, atol=0.1 * MM)


def test_a_turn_of_the_mirror_is_doubled_in_the_beam() -> None:
    right = TARGET.axes[0]
    to_target = normalize(TARGET.center - MIRROR)
    distance = np.linalg.norm(TARGET.center - MIRROR)
    normal = bisector(SUN, to_target)
    turned = normalize(normal + 1.0 * MRAD * np.cross(np.cross(SUN, normal), normal))
    size = np.linalg.norm(np.cross(normal, turned))
    a, b = (
        reflected_beam(TARGET, MIRROR, SUN, 2.0, 2.0, normal=n, elements=4)
        for n in (normal, turned)
    )
    moved = TARGET.point(b.centroid) - TARGET.point(a.centroid)
    across = moved - (moved @ to_target) * to_target
    assert np.linalg.norm(across) / distance == pytest.approx(2.0 * size, rel=5e-3)
    assert abs(right @ moved) > 0.05


def test_the_suns_image_has_the_size_of_the_sun() -> None:
    """A small flat mirror square to the target: a disc of 9.3 mrad times the distance."""
    distance = 150.0
    mirror = TARGET.center + distance * TARGET.normal
    sun = normalize(TARGET.normal + [0.0, 0.0, 0.3])
    beam = reflected_beam(
        TARGET,
        mirror,
        sun,
        0.05,
        0.05,
        facets=(1, 1),
        focal=np.inf,
        slope_error=0.0,
        sun_shape="pillbox",
    )
    lit = beam.flux > 0.5 * beam.peak
    width, height = np.ptp(np.nonzero(lit)[1]) + 1, np.ptp(np.nonzero(lit)[0]) + 1
    assert width * beam.step == pytest.approx(0.0093 * distance, abs=0.06)
    assert height * beam.step == pytest.approx(0.0093 * distance, abs=0.06)
    area = lit.sum() * beam.step**2
    assert area == pytest.approx(np.pi / 4.0 * (0.0093 * distance) ** 2, rel=0.02)


def test_variances_of_sun_and_slopes_add() -> None:
    """The slopes count twice in the plane of incidence, and with its cosine across it."""
    distance, slope, tilt = 150.0, 1.5e-3, 0.4
    mirror = TARGET.center + distance * TARGET.normal
    sun = normalize(np.cos(2 * tilt) * -TARGET.normal + [0.0, 0.0, np.sin(2 * tilt)])
    sun = -np.array([sun[0], sun[1], -sun[2]])
    smooth, rough = (
        reflected_beam(
            TARGET,
            mirror,
            sun,
            0.05,
            0.05,
            facets=(1, 1),
            focal=np.inf,
            slope_error=s,
            sun_shape="pillbox",
        )
        for s in (0.0, slope)
    )
    normal = bisector(sun, -TARGET.normal)
    sigma_sun = distance * SUN_RADIUS / 2.0
    np.testing.assert_allclose(
        np.sqrt(np.diag(smooth.second_moments)), sigma_sun, rtol=0, atol=5 * MM
    )
    grown = np.diag(rough.second_moments - smooth.second_moments)
    twice = 2.0 * distance * slope
    np.testing.assert_allclose(np.sqrt(grown), (twice * (normal @ sun), twice), rtol=2e-3)


def test_oblique_light_is_stretched_by_the_targets_cosine() -> None:
    distance, phi = 150.0, np.radians(50.0)
    side = np.cos(phi) * TARGET.normal + np.sin(phi) * TARGET.axes[0]
    mirror = TARGET.center + distance * side
    beam = reflected_beam(
        TARGET, mirror, normalize(side + [0.0, 0.0, 0.2]), 0.05, 0.05, focal=np.inf, slope_error=0.0
    )
    across, upright = np.sqrt(np.diag(beam.second_moments))
    assert across / upright == pytest.approx(1.0 / np.cos(phi), rel=0.01)


def test_canting_gathers_the_beam() -> None:
    flat, focused = field_beam(focal=np.inf), field_beam()
    assert focused.peak > 2.0 * flat.peak
    # Of flat facets the mirror's own size adds: 3.2²/12 m² at near-normal incidence.
    added = np.trace(flat.second_moments) - np.trace(field_beam(focal=1e9).second_moments)
    assert abs(added) < 1e-3
    gained = np.trace(flat.second_moments) - np.trace(focused.second_moments)
    assert 0.5 * 2 * 3.2**2 / 12 < gained < 2 * 3.2**2 / 12
    same = reflected_beam(
        TARGET,
        MIRROR,
        SUN,
        1.0,
        1.0,
        facets=equal_facets(3.2, 3.2, (2, 2), np.inf),
        focal=np.inf,
    )
    np.testing.assert_allclose(same.flux, flat.flux, rtol=0, atol=1e-6 * flat.peak)


def test_profiles_of_the_sun() -> None:
    edge = np.array([0.0, 0.999, 1.001]) * SUN_RADIUS
    np.testing.assert_allclose(sun_profile(edge, "pillbox"), (1.0, 1.0, 0.0))
    limb = sun_profile(edge, "limb")
    assert limb[0] == pytest.approx(1.0)
    assert 0.3 < limb[1] < 0.36
    theta = np.linspace(0.0, 1.2 * AUREOLE_RADIUS, 40_001)
    for chi, tolerance in ((0.05, 0.01), (0.1, 0.005), (0.2, 0.02), (0.4, 0.03)):
        ring = sun_profile(theta, "buie", chi) * theta
        outside = ring[theta > SUN_RADIUS].sum() / ring.sum()
        assert outside == pytest.approx(chi, abs=tolerance)
    assert field_beam("buie").on_target(TARGET)[0] < field_beam("limb").on_target(TARGET)[0]


# -- bad input -------------------------------------------------------------------------


def _reflected(**changes: object) -> Beam:
    return reflected_beam(TARGET, MIRROR, SUN, 3.2, 3.2, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Beam(np.zeros(3), 0.1, np.zeros(2)), r"flux of shape \(3,\)"),
        (lambda: Beam(-np.ones((2, 2)), 0.1, np.zeros(2)), "nowhere below 0"),
        (lambda: Beam(np.zeros((2, 2)), 0.1, np.zeros(2)), "pass a beam with light"),
        (lambda: Beam(np.ones((2, 2)), 0.0, np.zeros(2)), "step 0.0 m must be above 0"),
        (lambda: Beam(np.ones((2, 2)), 0.1, np.zeros(3)), "origin"),
        (lambda: Beam.from_image(np.ones(3), 0.1), "picture of shape"),
        (lambda: gaussian_beam((0, 0), -1.0), "sigma_major -1.0 m"),
        (lambda: gaussian_beam((0, 0), 1.0, step=1e-4), "larger step"),
        (lambda: flat_top_beam((0, 0), 0.0), "width 0.0 m"),
        (lambda: gaussian_beam((0, 0), 1.0).swept((np.nan, 0.0)), "motion"),
        (lambda: _reflected(sun_shape="square"), "sun shape 'square'; known: pillbox"),
        (lambda: sun_profile(0.0, "square"), "sun shape 'square'"),
        (lambda: _reflected(slope_error=-1e-3), "slope_error -0.001 rad"),
        (lambda: _reflected(sun_shape="buie:0"), "circumsolar ratio must be .* not 0.0"),
        (lambda: _reflected(reflectivity=1.2), "reflectivity 1.2"),
        (lambda: _reflected(dni=0.0), "dni 0.0 W/m²"),
        (lambda: _reflected(focal=-5.0), "focal -5.0 m"),
        (lambda: _reflected(elements=0), "0 elements"),
        (lambda: _reflected(facets=(0, 2)), "1 or more facets in each direction, not 0 × 2"),
        (lambda: _reflected(step=1e-4), "use a larger step"),
        (lambda: _reflected(normal=-SUN), "misses target"),
        (lambda: _reflected(R_enu_mirror=np.ones((3, 3))), "must be a rotation"),
        (lambda: _reflected(aim=np.zeros((2, 3))), r"aim \(2, 3\)"),
    ],
)
def test_guards(make: object, text: str) -> None:
    with pytest.raises(InputError, match=text):
        make()  # type: ignore[operator]
