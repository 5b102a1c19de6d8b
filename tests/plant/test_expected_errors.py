"""What is known of beams before they are sent: the same one by one and all at once."""

from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.uncertainty import expected_error, precision
from heliotrope.field.coded_visits import JointSettings
from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import bisector, direction
from heliotrope.plant.field.aims import BeamCheck
from heliotrope.plant.field.beliefs import Beliefs
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.visits import coded_layout, joint_layout
from heliotrope.plant.visits import expected_errors as module
from heliotrope.plant.visits.coded_layout import beams_of, moments_on
from heliotrope.plant.visits.expected_errors import expected_errors
from heliotrope.plant.visits.joint_layout import arranged, bells, newcomers
from heliotrope.plant.visits.resolution import beam_slopes, beam_steps

NOW = datetime(2026, 6, 21, 10, tzinfo=UTC)
SUN = direction(np.radians(30.0), np.radians(50.0))
BIASES = ("azimuth_bias", "elevation_bias")
MODEL = (*BIASES, "tilt_north", "tilt_east")


@pytest.fixture
def plant() -> Any:
    """Twelve heliostats; the first six are calibrated, some of them a year ago."""
    design = malan_plant(12)
    beliefs = Beliefs(design)
    for k, name in enumerate(design.names[:6]):
        spread, value = np.diag([(1e-4 * (k + 1)) ** 2] * 2), np.array([1e-3 * k, -2e-3])
        at = NOW.timestamp() - 86400.0 * 365.0 * (k % 2)
        beliefs.take(HeliostatCalibration(name, at, BIASES, value, spread, np.full(2, 5e-3)))
    return SimpleNamespace(
        design=design,
        beliefs=beliefs,
        field=FieldState({"C1": design.names[::-1]}),
        beams=BeamCheck(design, design.names[::-1]),
        clock=SimpleNamespace(utc=lambda: NOW),
        sun_vector=lambda: SUN,
    )


def test_errors_of_new_and_of_known_mirrors_are_those_of_each_alone(plant: Any) -> None:
    names, target = plant.design.names, plant.design.targets[0]
    aims = target.center + np.linspace(-1.0, 1.0, len(names))[:, None] * target.axes[0]
    model = dict.fromkeys(names[:9], MODEL)
    found = expected_errors(plant, names, aims, model)
    for name, aim, error in zip(names[:9], aims, found, strict=False):
        record, nominal = plant.beliefs.record(name), plant.beliefs.nominal(name)
        if record is None:
            known, covariance = MODEL, np.linalg.inv(precision(nominal, MODEL))[0]
        else:
            known, covariance = record.names, record.covariance_at(NOW.timestamp())
        one = expected_error(
            plant.beliefs.present(name),
            known,
            covariance,
            SUN,
            aim,
            current=plant.field.counts(np.array([plant.field.place(name)])),
        )
        assert error == pytest.approx(float(one.rms[0]), rel=1e-9), name
    assert np.isfinite(found[:9]).all()
    assert np.isnan(found[9:]).all(), "nothing is known of them"
    np.testing.assert_array_equal(expected_errors(plant, names[:6], aims[:6]), found[:6])
    assert expected_errors(plant, [], np.zeros((0, 3))).shape == (0,)


def test_beams_are_laid_out_together_as_each_alone(plant: Any) -> None:
    names, target = plant.design.names, plant.design.targets[0]
    errors = dict(zip(names, np.linspace(1e-3, 9e-3, len(names)).tolist(), strict=True))
    errors[names[3]] = np.nan
    sent, blocked = beams_of(plant, target, errors, JointSettings())
    assert tuple(sent) == (*names[:3], *names[4:])
    assert blocked == {names[3]: "out of its reach"}
    rows = np.array([plant.field.place(name) for name in sent])
    steps = beam_steps(plant, rows, target, SUN, np.tile(target.center, (len(rows), 1)))
    counts = np.linspace(-500.0, 500.0, 2 * len(rows)).reshape(-1, 2)
    slopes = beam_slopes(plant, rows, target, SUN, counts)
    for k, (name, beam) in enumerate(sent.items()):
        alone = beams_of(plant, target, {name: errors[name]}, JointSettings())[0][name]
        for one, other in zip(vars(beam).values(), vars(alone).values(), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9)
        np.testing.assert_array_equal(steps[k], beam.step)
        np.testing.assert_allclose(
            slopes[k], beam_slopes(plant, int(rows[k]), target, SUN, counts[k]), rtol=1e-9
        )
        vertex = plant.beams.armature.origin_1[rows[k]]
        normal = bisector(SUN, (target.center - vertex) / beam.slant)
        size = plant.beams.mirrors.width[rows[k]], plant.beams.mirrors.height[rows[k]]
        np.testing.assert_allclose(
            beam.moments, moments_on(target, vertex, normal, *size), rtol=1e-9
        )
    assert beams_of(plant, target, {}, JointSettings()) == ({}, {})


def test_the_light_of_a_beam_is_its_power() -> None:
    side = np.linspace(-6.0, 6.0, 121)
    points = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    places, moments = (
        np.array([(0.0, 0.0), (1.0, -1.0)]),
        np.array([np.eye(2), [[1, 0.3], [0.3, 2]]]),
    )
    light = bells(points, places, moments)
    np.testing.assert_allclose(0.01 * light.sum(axis=1), 1.0, atol=1e-3)
    mean = np.einsum("mn,nc->mc", 0.01 * light, points)
    np.testing.assert_allclose(mean, places, atol=5e-3)


def test_a_layout_computes_its_beams_at_once(plant: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop that renews leases waits for it: its time must not grow with the beams."""
    calls: list[str] = []

    def counted(place: Any, name: str) -> None:
        made = getattr(place, name)

        def count(*given: Any, **named: Any) -> Any:
            calls.append(name)
            return made(*given, **named)

        monkeypatch.setattr(place, name, count)

    counted(module, "expected_error")
    for place, name in (
        (coded_layout, "beam_steps"),
        (coded_layout, "moments_on"),
        (joint_layout, "bells"),
    ):
        counted(place, name)
    names, target = plant.design.names, plant.design.targets[0]
    settings = replace(JointSettings(), known=1.0)

    def of(few: int) -> list[str]:
        calls.clear()
        layout = arranged(plant, target, names[:few], settings)
        assert len(layout.names) == few
        layout = newcomers(plant, target, names[6 : 6 + few], settings, dict.fromkeys(names, MODEL))
        assert len(layout.names) == few
        return sorted(calls)

    assert of(6) == of(2)
    assert calls.count("expected_error") == 2
