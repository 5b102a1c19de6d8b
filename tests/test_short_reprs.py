"""What values say of themselves: one line for a prompt, a small table for a notebook."""

# A table reads by its rows.
# ruff: noqa: E501

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from lxml import etree

import heliotrope as ht
from heliotrope.calibration.fit import DriveTerm, fit_terms
from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.mechanism import kinds, linear_paint, rotary
from heliotrope.values import MOST_ROWS

AIM = (0.0, 0.0, 13.0)
LONGEST_LINE, LONGEST_TABLE = 230, 9000


@cache
def plant() -> ht.Plant:
    return ht.example_plant()


@cache
def mechs() -> ht.Mechanism:
    return plant().groups["azel"].mechanism


@cache
def seen() -> ht.Sightings:
    times = 1788336000.0 + 1800.0 * np.arange(12)
    suns = ht.sun.vector(times, plant().site)
    found = ht.track(mechs()[0], suns, AIM)
    return ht.sightings(0, found.chosen(found.counts), suns, AIM, time=times)


@cache
def fitted() -> Any:
    return ht.fit(mechs()[:1], seen(), "guo6")


@cache
def terms() -> Any:
    own = DriveTerm("eccentric", "azimuth", lambda angles: np.sin(angles[..., 0]), 5e-3)
    return fit_terms(mechs()[:1], seen(), "guo6", [own])


@cache
def learned() -> ht.Learned:
    return ht.learn(mechs()[:1], seen(), "guo6", rounds=2)


@cache
def calibration() -> HeliostatCalibration:
    return HeliostatCalibration.from_fit(
        "P1A", 1788336000.0, fitted(), mechs()[:1], seen(), np.arange(12), model="guo6"
    )


@cache
def large() -> ht.Plant:
    """Ten thousand heliostats."""
    count = 10_000
    rng = np.random.default_rng(4)
    places = np.append(rng.uniform(-900.0, 900.0, (count, 2)), np.zeros((count, 1)), axis=1)
    group = ht.Heliostats(
        tuple(f"H{k}" for k in range(count)),
        kinds.azimuth_elevation(places),
        np.full(count, 4.0),
        np.full(count, 3.0),
    )
    return replace(plant(), groups={"wide": group})


SUN = (0.0, -0.6, 0.8)
#: A value, and what its line and its table must say.
VALUES: list[tuple[Callable[[], Any], str, str]] = [
    (plant, "Plant: example, 18 heliostats; 1 target, 1 receiver; site Stellenbosch -33.93", "azel"),
    (large, "Plant: example, 10000 heliostats", "azimuth_elevation"),
    (lambda: large().groups["wide"], "Heliostats: 10000 azimuth_elevation", "and 9976 more"),
    (lambda: plant().groups["azel"], "18 azimuth_elevation heliostats, 1.83 × 1.22 m, nom", "P6A"),
    (lambda: plant().targets[0], "Target: target, 3 × 3 m, centre 0 m east", "upper left"),
    (lambda: plant().receivers[0], "Receiver: receiver, planar, 1.5 × 1.5 m", ""),
    (mechs, "Mechanism: 18 azimuth_elevation: azimuth (rotary), elevation (rotary)", "east"),
    (lambda: mechs()[0], "Mechanism: one azimuth_elevation", "0.8181 µrad a count, stops -5 … 95 °"),
    (lambda: rotary(200, 2400, bias=1e-3), "Drive: rotary, 13.09 µrad a count", "1 mrad"),
    (lambda: linear_paint(1e5, 0.4, 0.3, 0.3, 0.0), "Drive: jack, 10 µm a count", "0.4 m"),
    (lambda: mechs().armature, "Armature: table (18, 18)", "18"),
    (lambda: mechs().pose((0.0, 0.0)), "Pose: normal (18, 3), vertex (18, 3)", "normal"),
    (lambda: mechs().jacobian((0.0, 0.0), ("tilt_north",)), "Jacobian: normal (18, 1, 3)", "vertex"),
    (lambda: ht.track(mechs(), SUN, AIM), "Tracking: 18 of 2 branches: 18 ok", "the beam reaches"),
    (seen, "Sightings: 12 of 1 heliostat, 2026-09-02", "0.5 mrad"),
    (fitted, "FieldFit: 6 parameters of 1 heliostat from 12 sightings: 1 converged", "mrad"),
    (terms, "TermFit: 1 term of 1 heliostat: eccentric", "mrad"),
    (learned, "Learned: 1 heliostat from 12 sightings, 0 outliers", "tilt_north"),
    (lambda: ht.predict(learned(), seen()), "Prediction: 12 beams, 0 unusable", ""),
    (lambda: ht.beam_errors(mechs()[:1], seen()), "BeamErrors: 12 sightings, beam", "upwards"),
    (calibration, "HeliostatCalibration: P1A, version 0, guo6, 12 sightings", "canting"),
    (lambda: ht.image_offsets(mechs(), mechs(), SUN, AIM), "ImageOffsets: 18, beam error", "slant"),
    (lambda: ht.sun.position(0.0, plant().site), "SunPosition: one, azimuth", "elevation"),
]  # fmt: skip


@pytest.mark.parametrize(("make", "line", "table"), VALUES, ids=[row[1][:24] for row in VALUES])
def test_a_value_says_what_it_is_in_one_line(
    make: Callable[[], Any], line: str, table: str
) -> None:
    value = make()
    text = repr(value)
    assert line in text
    assert "\n" not in text
    assert len(text) <= LONGEST_LINE
    page = value._repr_html_()
    assert len(page) <= LONGEST_TABLE
    assert etree.fromstring(page).tag == "div"
    assert table in page
    assert page.count("<tr>") <= MOST_ROWS + 2


def test_names_of_files_are_no_markup() -> None:
    page = replace(plant(), name="<script>alert(1)</script>")._repr_html_()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page


def test_nothing_is_a_value_too() -> None:
    none = seen().take([])
    assert repr(none) == "<Sightings: 0 of 0 heliostats, times unknown>"
    assert etree.fromstring(none._repr_html_()).tag == "div"
    assert "no usable beam" in repr(ht.predict(learned(), none))
    assert "nan" in repr(ht.beam_errors(mechs()[:1], none))
    assert ht.track(mechs(), np.empty((0, 1, 3)), AIM)._repr_html_().startswith("<div>")
