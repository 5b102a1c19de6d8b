"""Glare: the paper's anchors, limits, monotony, and maps of standby points."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.errors import InputError
from heliotrope.geometry import normalize
from heliotrope.optics import SUN_RADIUS, MirrorOptics, beams, concentration, mean_concentration
from heliotrope.optics import glare as eye
from heliotrope.optics.glare import Eye, Hazard

#: One watt per square centimetre.
CM2 = 1e4
SUN_ANGLE = 9.3e-3


def test_a_look_into_the_bare_sun() -> None:
    """Ho et al.: 0.1 W/cm² under 9.3 mrad: about 8 W/cm² on the retina; an after-image, no burn."""
    assert eye.retinal_irradiance(0.1 * CM2, SUN_ANGLE) == pytest.approx(8.0 * CM2, rel=1e-3)
    assert eye.burn_threshold(SUN_ANGLE) == pytest.approx(12.69 * CM2, rel=1e-3)
    seen = eye.glare_of_one(0.1 * CM2, SUN_ANGLE)
    assert int(seen.hazard) == Hazard.AFTER_IMAGE
    assert "temporary after-image" in Hazard.AFTER_IMAGE.text
    assert seen.burn == pytest.approx(8.0 / 12.69, rel=2e-3)


def test_thresholds_by_hand() -> None:
    # Powers of ten, so that a slide rule does: 10^(3 · 1.77) = 10^5.31 = 2.042e5.
    assert eye.flash_threshold(1e-3) == pytest.approx(3.59e-5 * 2.042e5 * CM2, rel=1e-3)
    assert eye.flash_threshold(1.0) == pytest.approx(3.59e-5 * CM2)
    assert eye.burn_threshold(0.0118) == pytest.approx(10.0 * CM2)
    # 1 W/cm² from 0.118 rad on; the two branches meet there.
    for angle in (0.118, 0.5, 3.0):
        assert eye.burn_threshold(angle) == pytest.approx(1.0 * CM2)
    assert eye.burn_threshold(0.1179) == pytest.approx(1.0 * CM2, rel=1e-3)
    # A candle-like 1 mW/m² under 1 mrad does nothing.
    assert int(eye.glare_of_one(1e-3, 1e-3).hazard) == Hazard.LOW


def test_the_retina_sees_a_radiance() -> None:
    """A source of one radiance is as bright on the retina at any distance."""
    angle = np.array([1e-3, 1e-2, 1e-1])
    radiance = 1e6 * angle**2
    retinal = eye.retinal_irradiance(radiance, angle)
    assert np.ptp(retinal) < 1e-9 * retinal[0]
    wide = eye.retinal_irradiance(1.0, 0.01, Eye(pupil=4e-3))
    assert wide == pytest.approx(4.0 * float(eye.retinal_irradiance(1.0, 0.01)))


@given(st.floats(0.0, 1e5), st.floats(1e-4, 3.0), st.floats(1.0, 10.0))
def test_more_light_is_never_milder(corneal: float, angle: float, factor: float) -> None:
    one, more = eye.glare_of_one(corneal, angle), eye.glare_of_one(factor * corneal, angle)
    assert more.hazard >= one.hazard
    # At one radiance a larger source is never milder either.
    larger = eye.glare_of_one(corneal * factor**2, min(angle * factor, math.pi))
    assert larger.hazard >= one.hazard or angle * factor > math.pi


#: Irradiance and angle; some are dark.
SOURCE = st.tuples(st.floats(0.0, 5e3), st.one_of(st.just(0.0), st.floats(1e-5, 0.2)))
SOURCES = st.lists(SOURCE, min_size=1, max_size=7)


@given(SOURCES)
def test_many_sources_are_bounded_by_their_worst_selection(
    sources: list[tuple[float, float]],
) -> None:
    corneal, angle = np.array(sources).T
    found = eye.glare_of_many(corneal, angle)
    worst = [0.0, 0.0]
    for size in range(1, len(sources) + 1):
        for pick in itertools.combinations(range(len(sources)), size):
            lit = [k for k in pick if corneal[k] > 0.0 and angle[k] > 0.0]
            if not lit or (together := math.sqrt(sum(angle[k] ** 2 for k in lit))) == 0.0:
                continue
            one = eye.glare_of_one(sum(corneal[k] for k in lit), together)
            worst = [max(worst[0], float(one.burn)), max(worst[1], float(one.flash))]
    assert found.burn >= worst[0] * (1.0 - 1e-9)
    assert found.flash >= worst[1] * (1.0 - 1e-9)


def test_the_worst_selection_may_leave_out_a_brighter_one() -> None:
    """A and C together are worse than A, than A and B, and than all: they just fill 0.118 rad."""
    angle = np.array([0.1, math.sqrt(0.02), math.sqrt(0.118**2 - 0.01)])
    corneal = 1e4 * np.array([1.0, 0.5, 0.49]) * angle**2
    found = float(eye.glare_of_many(corneal, angle).burn)
    pair = float(eye.glare_of_one(corneal[0] + corneal[2], 0.118).burn)
    for others in ([0], [0, 1], [0, 1, 2]):
        together = math.sqrt(float((angle[others] ** 2).sum()))
        assert float(eye.glare_of_one(corneal[others].sum(), together).burn) < pair
    assert pair <= found < 1.01 * pair


@given(SOURCES, SOURCE)
def test_a_further_source_is_never_milder(
    sources: list[tuple[float, float]], further: tuple[float, float]
) -> None:
    before = eye.glare_of_many(*np.array(sources).T)
    after = eye.glare_of_many(*np.array([*sources, further]).T)
    assert after.burn >= before.burn * (1.0 - 1e-9)
    assert after.flash >= before.flash * (1.0 - 1e-9)
    assert after.hazard >= before.hazard or before.burn == pytest.approx(1.0)


def test_equal_sources_add_their_solid_angles() -> None:
    """Four suns side by side: the same retinal irradiance under twice the angle."""
    four = eye.glare_of_many(np.full(4, 1000.0), np.full(4, SUN_ANGLE))
    one = eye.glare_of_one(4000.0, 2.0 * SUN_ANGLE)
    assert four.burn == pytest.approx(float(one.burn))
    assert four.burn == pytest.approx(2.0 * float(eye.glare_of_one(1000.0, SUN_ANGLE).burn))
    assert int(four.hazard) == Hazard.DAMAGE
    assert four.corneal == 4000.0
    assert four.subtended == pytest.approx(2.0 * SUN_ANGLE)


def test_a_point_of_light_has_a_finite_image() -> None:
    assert np.isfinite(eye.glare_of_many([1.0], [1e-300]).burn)
    vast = eye.glare_of_many(np.full(4000, 1e3), np.full(4000, 0.1))
    assert vast.subtended > math.pi
    assert np.isfinite(vast.burn)


def test_no_source_no_glare() -> None:
    for none in (np.zeros(3), np.zeros(0)):
        dark = eye.glare_of_many(none, none)
        assert (dark.burn, dark.flash, dark.corneal, dark.subtended) == (0.0, 0.0, 0.0, 0.0)
        assert int(dark.hazard) == Hazard.LOW


@pytest.mark.parametrize("focus", [math.inf, 500.0, 60.0])
def test_on_the_axis_the_mirror_shows_the_sun(focus: float) -> None:
    """Irradiance over solid angle is the sun's radiance, times the reflectivity."""
    given_ = beams((0, 0, 0), (0, 1, 0), MirrorOptics.of(5.0, 5.0, focus=focus, reflectivity=0.9))
    for distance in (10.0, 100.0, 400.0, 1500.0):
        seen = eye.glare_at(given_, (0.0, distance, 0.0), dni=950.0)
        c = float(concentration(distance, 25.0, focus))
        assert seen.corneal[0] == pytest.approx(950.0 * 0.9 * c, rel=1e-4)
        radiance = seen.corneal[0] / seen.subtended[0] ** 2
        assert radiance == pytest.approx(950.0 * 0.9 / (2.0 * SUN_RADIUS) ** 2, rel=1e-6)


def test_the_mean_of_the_paper_is_below_the_axis() -> None:
    x = np.linspace(1.0, 3000.0, 5000)
    for focus in (math.inf, 700.0, 100.0):
        mean, axis = mean_concentration(x, 40.0, focus), concentration(x, 40.0, focus)
        assert (mean <= axis * (1.0 + 1e-12)).all()
    # In the focus both are mirror over image area.
    assert mean_concentration(700.0, 40.0, 700.0) == pytest.approx(
        float(concentration(700.0, 40.0, 700.0))
    )


@pytest.mark.parametrize(
    ("area", "focus", "dni"),
    [
        (100.0, 500.0, 1000.0),
        (2.2, 40.0, 1000.0),
        (40.0, math.inf, 1000.0),
        (140.0, 60.0, 1100.0),
        (20.0, 2000.0, 1000.0),
    ],
)
def test_the_range_of_a_beam_agrees_with_a_scan_of_it(
    area: float, focus: float, dni: float
) -> None:
    near, far = eye.safe_range(area, focus, dni=dni)
    x = np.linspace(1.0, 3000.0, 60_000)
    c = concentration(x, area, focus)
    burns = eye.glare_of_one(dni * c, 2.0 * SUN_RADIUS * np.sqrt(c)).hazard == Hazard.DAMAGE
    if not burns.any():
        assert far - near < 0.1
        return
    assert near == pytest.approx(x[burns][0], abs=0.1)
    assert far == pytest.approx(x[burns][-1], abs=0.1)
    assert burns[(x > near + 0.1) & (x < far - 0.1)].all()


def test_flat_mirrors_and_weak_suns_never_burn() -> None:
    assert eye.safe_range(140.0) == (0.0, 0.0), "a flat mirror is at most the sun"
    assert eye.safe_range(140.0, 300.0, dni=10.0) == (0.0, 0.0)
    assert eye.safe_range(0.01, 300.0) == (0.0, 0.0)


def _standby(count: int) -> tuple[eye.Beams, np.ndarray]:
    """Mirrors on an arc that stand by at a point 60 m up."""
    center = np.array([10.0, 0.0, 60.0])
    angle = np.linspace(-0.8, 0.8, count)
    origin = np.stack([150 * np.sin(angle), -150 * np.cos(angle), np.full(count, 3.0)], axis=-1)
    return beams(origin, center, MirrorOptics.of(3.0, 3.0, focus=160.0)), center


def test_beyond_the_safe_distance_no_look_burns() -> None:
    given_, center = _standby(25)
    assert int(eye.glare_at(given_, center).hazard[0]) == Hazard.DAMAGE
    radius = eye.safe_distance(given_, center)
    assert 5.0 < radius < 150.0
    rng = np.random.default_rng(2)
    shell = normalize(rng.normal(size=(4000, 3))) * rng.uniform(radius, 2.0 * radius, (4000, 1))
    # Most of the beams' neighbourhood, too.
    along = given_.point(rng.uniform(0, 400, (25, 200))).reshape(-1, 3)
    along += rng.normal(0.0, 1.0, along.shape)
    away = np.linalg.norm(along - center, axis=1)
    points = np.concatenate([center + shell, along[(away > radius) & (away < 200.0)]])
    assert (eye.glare_at(given_, points).hazard < Hazard.DAMAGE).all()
    # And it is not larger than need be.
    inside = along[(away < radius)]
    assert (eye.glare_at(given_, inside).hazard == Hazard.DAMAGE).any()


def test_fewer_beams_are_safe_nearer() -> None:
    radii = []
    for count in (1, 5, 25):
        given_, center = _standby(count)
        radii.append(eye.safe_distance(given_, center, step=2.0))
    assert radii == sorted(radii)
    given_, center = _standby(25)
    assert eye.safe_distance(given_, center, dni=1.0, step=2.0) == 0.0
    assert eye.safe_distance(given_, center, limit=Hazard.AFTER_IMAGE) == math.inf


def test_a_map_shows_where_the_standby_point_burns() -> None:
    given_, center = _standby(25)
    shown = eye.glare_map(given_, center, 120.0, 61)
    assert shown.points.shape == (61, 61, 3)
    assert shown.points[30, 30] == pytest.approx(center)
    assert shown.points[..., 2] == pytest.approx(60.0)
    assert (shown.right[-1], shown.up[0]) == (60.0, -60.0)
    # East is to the right, north is up.
    assert shown.points[30, 60] == pytest.approx(center + (60.0, 0.0, 0.0))
    assert shown.points[60, 30] == pytest.approx(center + (0.0, 60.0, 0.0))
    alone = eye.glare_at(given_, shown.points[20, 34])
    assert shown.glare.burn[20, 34] == alone.burn[0]
    assert shown.glare.hazard[30, 30] == Hazard.DAMAGE
    assert shown.glare.hazard[30, 60] == Hazard.LOW
    assert 0.0 < shown.radius < eye.safe_distance(given_, center)
    upright = eye.glare_map(given_, center, 10.0, 3, normal=(0.0, -1.0, 0.0))
    assert np.ptp(upright.points[..., 1]) < 1e-12
    assert eye.glare_map(given_, center, 10.0, 3, dni=0.0).radius == 0.0


def test_what_cannot_be_is_refused() -> None:
    given_, center = _standby(2)
    refusals = (
        (lambda: eye.glare_of_one(-1.0, 0.01), "corneal irradiance must be 0 W/m² or more"),
        (lambda: eye.glare_of_one(math.nan, 0.01), "corneal irradiance must be 0"),
        (lambda: eye.glare_of_one(1.0, 0.0), "subtended angle must be above 0 and at most π"),
        (lambda: eye.burn_threshold(4.0), "subtended angle must be above 0 and at most π"),
        (lambda: eye.glare_of_many(1.0, 0.01), "irradiances and angles must be finite"),
        (lambda: eye.glare_of_many([math.inf], [0.01]), "irradiances and angles must be finite"),
        (lambda: eye.glare_of_many([-1.0], [0.01]), "irradiances and angles must be 0 or more"),
        (lambda: Eye(pupil=0.0), "eye: pupil must be above 0"),
        (lambda: Eye(transmission=1.5), "eye: transmission must be above 0 and at most 1, not 1.5"),
        (lambda: eye.glare_at(given_, center, dni=-5.0), "normal irradiance must be 0 or more"),
        (lambda: eye.safe_range(-1.0), "mirror of -1.0 m², focus inf m"),
        (lambda: eye.glare_map(given_, center, 10.0, 1), "map of 10.0 m and 1 cells"),
        (lambda: eye.safe_distance(given_, center, step=0.0), "step 0.0 m and reach 200.0 m"),
    )
    for call, text in refusals:
        with pytest.raises(InputError, match=text):
            call()
