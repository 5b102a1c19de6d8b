"""The surface of a mirror, learnt from its beams: synthetic truth recovered, and real beams."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets
from heliotrope.geometry import MRAD, FloatArray, bisector, direction, normalize
from heliotrope.imaging.synthetic.scenes import example_target
from heliotrope.optics import (
    Beam,
    BeamPhotograph,
    LearntSurface,
    beam_accuracy,
    equal_facets,
    flat_top_beam,
    gaussian_beam,
    learn_surface,
    reflected_beam,
)
from heliotrope.optics.learnt_surface import _View, spread_over_suns
from heliotrope.optics.mirror_surface import mirror_axes
from heliotrope.optics.sun_shape import SunShape

TARGET = example_target()
MIRROR = np.array([10.0, 60.0, 2.0])
FACETS = equal_facets(3.2, 2.6, (2, 2), np.inf)
SUNS = [(100.0, 25.0), (150.0, 50.0), (180.0, 60.0), (210.0, 35.0), (250.0, 20.0), (170.0, 20.0)]


def view(azimuth: float, elevation: float, facets: Facets, focal: float) -> BeamPhotograph:
    """The true beam of a mirror, as `reflected_beam` computes it with its own elements."""
    sun = direction(np.radians(azimuth), np.radians(elevation))
    R = mirror_axes(bisector(sun, normalize(TARGET.center - MIRROR)))
    beam = reflected_beam(
        TARGET, MIRROR, sun, 3.2, 2.6, R_enu_mirror=R, facets=facets, focal=np.inf,
        facet_focal=focal, slope_error=0.7e-3, step=0.08,
    )  # fmt: skip
    return BeamPhotograph(TARGET, beam, MIRROR, R, sun)


@pytest.fixture(scope="module")
def truth() -> tuple[FloatArray, list[BeamPhotograph]]:
    """Canting errors of four facets with a focal length of 150 m, and their beams."""
    tilt = MRAD * np.array([[3.0, -2.0], [-2.5, -1.0], [1.0, 3.0], [-2.0, 2.0]])[None]
    leaning = Facets.of(FACETS.center[..., :2], FACETS.half_size, tilt)
    return tilt[0], [view(*sun, leaning, 150.0) for sun in SUNS]


def test_canting_and_curvature_are_recovered_and_predict_other_suns(
    truth: tuple[FloatArray, list[BeamPhotograph]],
) -> None:
    tilt, seen = truth
    learnt = learn_surface(seen[:4], FACETS, degree=3)
    slopes = learnt.slopes(16)
    # A normal that leans to the right falls to the right. The mean tilt of the whole mirror cannot
    # be told from a pointing error.
    found = -slopes.mean(axis=(1, 2))
    np.testing.assert_allclose(
        found - found.mean(axis=0), tilt - tilt.mean(axis=0), rtol=0, atol=0.25 * MRAD
    )
    # From edge to edge of a facet the slope of a curved mirror rises by its width / 2f.
    rise = (slopes[:, :, -1, 0] - slopes[:, :, 0, 0]).mean(axis=1)
    np.testing.assert_allclose(rise, 15 / 16 * 1.6 / 300.0, rtol=0.2)
    assert learnt.slope_error == pytest.approx(0.7e-3, abs=0.25e-3)
    nominal = LearntSurface(FACETS, np.inf, np.zeros((4, 9)), 0.7e-3, np.zeros(0))
    for photograph in seen[4:]:
        predicted = learnt.predict(photograph)
        np.testing.assert_allclose(predicted.centroid, photograph.beam.centroid, atol=1e-6)
        assert beam_accuracy(photograph.beam, predicted) > 0.96
        assert beam_accuracy(photograph.beam, nominal.predict(photograph)) < 0.9


def test_the_gradient_is_that_of_the_misfit(
    truth: tuple[FloatArray, list[BeamPhotograph]],
) -> None:
    rng = np.random.default_rng(2)
    own, by = (1e-3 * rng.standard_normal((4, 9)) for _ in range(2))
    shift, variance = np.array([0.03, -0.02]), 0.5e-6
    single = _View(truth[1][0], FACETS, np.inf, SunShape.of("limb"), 3)

    def at(step: float, part: int) -> float:
        moved: list[Any] = [own, variance, shift]
        moved[part] = moved[part] + step * (by, 1e-6, np.array([0.3, 0.4]))[part]
        return single.misfit(*moved)[0]

    _, by_own, by_variance, by_shift = single.misfit(own, variance, shift)
    wanted = (float((by_own * by).sum()), 1e-6 * by_variance, float(by_shift @ [0.3, 0.4]))
    for part in range(3):
        slope = (at(1e-4, part) - at(-1e-4, part)) / 2e-4
        assert slope == pytest.approx(wanted[part], rel=0.02)


def test_accuracy_is_the_share_of_power_in_the_right_place() -> None:
    box = flat_top_beam((0.0, 0.0), 1.0, 1.0, step=0.01)
    assert beam_accuracy(box, replace(box, flux=3.0 * box.flux)) == pytest.approx(1.0)
    moved = Beam(np.pad(box.flux, 60), 0.01, box.origin - 0.6)
    assert beam_accuracy(moved, box.shifted((0.25, 0.0))) == pytest.approx(0.75, abs=0.01)


def test_photographs_to_learn_from_have_different_suns(
    truth: tuple[FloatArray, list[BeamPhotograph]],
) -> None:
    seen = truth[1]
    chosen = spread_over_suns([*seen, seen[0], seen[0]], 3)
    suns = np.array([seen[k].sun for k in chosen])
    assert len(chosen) == 3
    assert np.degrees(np.arccos((suns @ suns.T)[np.triu_indices(3, 1)])).min() > 25.0
    assert spread_over_suns(seen[:2], 8) == [0, 1]


def test_guards(truth: tuple[FloatArray, list[BeamPhotograph]]) -> None:
    seen = truth[1][0]
    with pytest.raises(InputError, match="no photograph of the mirror's beam"):
        learn_surface([], FACETS)
    with pytest.raises(InputError, match="degree 13 must be from 1 to 12"):
        learn_surface([seen], FACETS, degree=13)
    with pytest.raises(InputError, match="facets of 2 heliostats"):
        learn_surface([seen], FACETS.take(np.array([0, 0])))
    away = replace(seen, sun=-seen.sun, beam=gaussian_beam((0.0, 0.0), 0.5))
    with pytest.raises(InputError, match="does not send the sun to target"):
        learn_surface([away], FACETS)
