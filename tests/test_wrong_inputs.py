"""More than a hundred wrong inputs to public names: one clear line each, with what, the value and the limit."""

# A table reads by its rows.
# ruff: noqa: E501

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pytest
from pvlib.location import Location

import heliotrope as ht
from heliotrope import geometry
from heliotrope.calibration import join, predict, sun_sensor
from heliotrope.calibration.fit import DriveTerm
from heliotrope.errors import FormatError, InputError, TimeError, UnknownNameError
from heliotrope.field import Box, Cylinder, Sphere
from heliotrope.mechanism import (
    AxisLimits,
    direct,
    kinds,
    linear_grigoriev,
    linear_guo,
    linear_paint,
    rotary,
)

ORIGIN = (0.0, 0.0, 0.0)
UP, NORTH, EAST = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
AIM = (0.0, 0.0, 13.0)
NOON = "2026-09-02T10:00Z"
SITE = ht.Site(-33.93, 18.87, 120.0)
NAN = float("nan")
SINE = DriveTerm("k_sin", "azimuth", lambda angles: np.sin(angles[..., 0]), prior=5e-3)


@cache
def plant() -> ht.Plant:
    return ht.example_plant()


@cache
def field() -> ht.Heliostats:
    return plant().groups["azel"]


@cache
def mechs() -> ht.Mechanism:
    return field().mechanism


@cache
def seen() -> ht.Sightings:
    """Twelve sightings of the first heliostat, half an hour apart."""
    times = 1788336000.0 + 1800.0 * np.arange(12)
    suns = ht.sun.vector(times, SITE)
    found = ht.track(mechs()[0], suns, AIM)
    return ht.sightings(0, found.best_counts, suns, AIM, time=times)


@cache
def learned() -> ht.Learned:
    return ht.learn(mechs()[:1], seen(), "guo6", rounds=2)


def azel(**given: Any) -> Any:
    return kinds.azimuth_elevation(ORIGIN, **given)


def two(**given: Any) -> Any:
    return kinds.two_axis(ORIGIN, UP, EAST, NORTH, **given)


def row(**given: Any) -> Any:
    """Sightings of three rows, with something wrong."""
    right: dict[str, Any] = {
        "heliostat": 0,
        "counts": np.zeros((3, 2)),
        "source": UP,
        "destination": AIM,
    }
    return ht.sightings(**{**right, **given})


def flux(**given: Any) -> Any:
    return ht.flux(plant(), **{"sun": UP, **given})


class Wrong(NamedTuple):
    """A call that must be refused, and what its error must say."""

    call: Callable[[], object]
    argument: str
    value: str
    limit: str
    error: type[InputError] = InputError


SUN = [
    Wrong(lambda: ht.sun.vector("2026-09-02T10:00", SITE), "times", "10:00:00", "time zone", TimeError),
    Wrong(lambda: ht.sun.vector("noon", SITE), "times", "'noon'", "ISO 8601", TimeError),
    Wrong(lambda: ht.sun.vector(datetime(2026, 9, 2), SITE), "times", "2026", "time zone", TimeError),  # noqa: DTZ001
    Wrong(lambda: ht.sun.vector(pd.NaT, SITE), "times", "NaT", "aware", TimeError),
    Wrong(lambda: ht.sun.vector([0.0, NAN], SITE), "times[1]", "nan", "unix seconds", TimeError),
    Wrong(lambda: ht.sun.vector(np.datetime64("2026-09-02"), SITE), "times", "datetime64", "time zone", TimeError),
    Wrong(lambda: ht.sun.vector(1e13, SITE), "times", "year", "6000", TimeError),
    Wrong(lambda: row(time=1.788e12), "times", "1788000000000 s", "unix seconds", TimeError),
    Wrong(lambda: ht.sun.vector(NOON, Location(-33.9, 18.9)), "site", "pvlib Location", "Site.from_pvlib("),
    Wrong(lambda: ht.sun.vector(NOON, (-33.9, 18.9, 120.0)), "site", "tuple", "Site(latitude_deg"),
    Wrong(lambda: ht.sun.position(NOON, SITE, algorithm="spa2"), "algorithm", "'spa2'", "spa", UnknownNameError),
    Wrong(lambda: ht.sun.position(NOON, SITE, algorithm="grena2008"), "algorithm", "2026", "2003 to 2022"),
    Wrong(lambda: ht.sun.events("today", SITE), "day", "'today'", "ISO 8601 date", TimeError),
    Wrong(lambda: ht.sun.events("2026-09-02", SITE, elevation=5.0), "elevation", "5.0", "−π/2 to π/2"),
    Wrong(lambda: ht.sun.events("2026-09-02", SITE, elevation=-0.1, apparent=True), "elevation", "-0.1", "at least 0"),
    Wrong(lambda: ht.sun.events("2026-09-02", Location(-33.9, 18.9)), "site", "pvlib Location", "Site(latitude_deg"),
    Wrong(lambda: ht.sun.daylight("2026-09-02", SITE, every=timedelta(0)), "every", "0:00:00", "between 0.1 s and 1 day"),
    Wrong(lambda: ht.Site(95.0, 18.87, 120.0), "latitude_deg", "95.0", "-90 to 90"),
    Wrong(lambda: ht.Site(-33.93, 18.87, 120.0, pressure=1013.0), "pressure", "1013.0 Pa", "30000 to 120000"),
    Wrong(lambda: ht.Site(-33.93, 18.87, 120.0, temperature_c=288.0), "temperature_c", "288.0", "-90 to 60"),
]  # fmt: skip

GEOMETRY = [
    Wrong(lambda: geometry.direction(180.0, 0.5), "azimuth", "180 rad", "25.1327"),
    Wrong(lambda: geometry.direction(0.5, [0.1, 45.0]), "elevation[1]", "45 rad", "1.5708"),
    Wrong(lambda: geometry.direction("north", 0.5), "azimuth", "'north'", "array of numbers"),
    Wrong(lambda: geometry.direction([0.1, 0.2], [0.1, 0.2, 0.3]), "elevation", "(3,)", "azimuth (2,)"),
    Wrong(lambda: geometry.normalize(ORIGIN, "axis"), "axis", "length 0", "pass a nonzero vector"),
    Wrong(lambda: geometry.bisector(UP, (0.0, 0.0, -1.0)), "source and destination", "opposite", "no normal"),
    Wrong(lambda: geometry.geodetic_to_enu(-33.9, 18.8, 100.0, 5.0), "origin", "5.0", "latitude, longitude and height"),
    Wrong(lambda: geometry.enu_to_geodetic(AIM, (95.0, 18.8, 0.0)), "origin", "95", "-90 to 90"),
]  # fmt: skip

DRIVES = [
    Wrong(lambda: direct(max_angle=95.0), "max_angle", "95 rad", "25.1327"),
    Wrong(lambda: rotary(200, 2400, min_angle=-200.0), "min_angle", "-200 rad", "-25.1327"),
    Wrong(lambda: rotary(200, 2400, bias=30.0), "bias", "30 rad", "numpy.radians"),
    Wrong(lambda: rotary(200, 2400, bias="small"), "bias", "'small'", "array of numbers"),
    Wrong(lambda: rotary(200, 2400, sag=NAN), "sag", "nan", "pass a number"),
    Wrong(lambda: rotary(200, 0), "gear ratio", "0", "above 0"),
    Wrong(lambda: rotary(200, 2400, sense=2), "sense", "2", "+1 or −1"),
    Wrong(lambda: rotary(200, 2400, speed=0.0), "speed", "0", "above 0"),
    Wrong(lambda: rotary(200, 2400, backlash=3), "backlash", "'backlash'", "known: zero"),
    Wrong(lambda: direct(min_angle=1.0, max_angle=0.5), "angle stop", "1", "0.5"),
    Wrong(lambda: direct(scale=-1.0), "scale", "−1", "near 0"),
    Wrong(lambda: direct(bias=[0.1, 0.2], scale=[0.0, 0.0, 0.0]), "scale", "(3,)", "bias (2,)"),
    Wrong(lambda: direct().angles(NAN), "counts", "nan", "pass a number"),
    Wrong(lambda: linear_paint(0.0, 0.3, 0.3, 0.3, 0.0), "increment", "0.0", "must not be 0"),
    Wrong(lambda: linear_paint(1e5, 0.3, 0.3, 0.3, 45.0), "initial_angle", "45 rad", "numpy.radians"),
    Wrong(lambda: linear_paint(1e5, 0.9, 0.3, 0.3, 0.0), "initial stroke", "0.9 m", "0 m and 0.6 m"),
    Wrong(lambda: linear_guo(0.3, 0.3, 20.0, 0.3, 1e-6), "slope", "20 rad", "3.14159"),
    Wrong(lambda: linear_grigoriev(0.3, 0.3, "long", 1e-6), "length_at_zero", "'long'", "array of numbers"),
]  # fmt: skip

MECHANISMS = [
    Wrong(lambda: kinds.polar(ORIGIN, 50.9), "latitude", "50.9 rad", "1.5708"),
    Wrong(lambda: kinds.pitch_roll(ORIGIN, 180.0), "azimuth", "180 rad", "25.1327"),
    Wrong(lambda: kinds.tilt_roll(ORIGIN, UP), "axis", "vertical", "must not"),
    Wrong(lambda: kinds.target_aligned((1.0, 2.0), AIM), "position", "(2,)", "3 numbers"),
    Wrong(lambda: kinds.single_axis(ORIGIN, NORTH, NORTH), "normal", "parallel to the axis", "not change"),
    Wrong(lambda: two(origin_1=0.5), "origin_1", "()", "3 numbers"),
    Wrong(lambda: two(origin_2=(0.5, 0.1)), "origin_2", "(2,)", "3 numbers"),
    Wrong(lambda: two(vertex="front"), "vertex", "'front'", "array of numbers"),
    Wrong(lambda: two(names=("tilt", "tilt")), "names", "'tilt'", "unique"),
    Wrong(lambda: two(names=("azimuth", "canting")), "names", "'canting'", "unique"),
    Wrong(lambda: two(leans=("west", "north")), "lean", "'west'", "east", UnknownNameError),
    Wrong(lambda: two(orientation=2.0 * np.eye(3)), "orientation", "deviates by 3", "1e-9"),
    Wrong(lambda: two(orientation=30.0), "orientation", "()", "(..., 3, 3)"),
    Wrong(lambda: two(drives=(direct(),)), "drives", "got 1, but", "has 2"),
    Wrong(lambda: two(drives=(direct(), 40.0)), "drives", "float", "2 drives"),
    Wrong(lambda: kinds.two_axis(ORIGIN, UP, UP, NORTH), "axes", "0 mrad", "parallel"),
    Wrong(lambda: kinds.two_axis(ORIGIN, UP, NORTH, NORTH), "normal", "parallel to the secondary axis", "not change"),
    Wrong(lambda: kinds.azimuth_elevation((NAN, 0.0, 0.0)), "position", "nan", "finite"),
    Wrong(lambda: azel(pivot_height=1200.0), "pivot_height", "1200 m", "1000 m"),
    Wrong(lambda: kinds.azimuth_elevation(np.zeros((2, 3)), pivot_height=[1.0, 1.0, 1.0]), "origin", "(3,)", "position (2,)"),
    Wrong(lambda: azel().with_parameters({"tilt_north": 5.0}), "tilt_north", "5 rad", "1.5708"),
    Wrong(lambda: azel().with_parameters({"azimuth_bias": -90.0}), "azimuth_bias", "-90 rad", "-6.28319"),
    Wrong(lambda: azel().with_parameters({"position_up": 1500.0}), "position_up", "1500 m", "1000 m"),
    Wrong(lambda: azel().with_parameters({"tilt_nort": 0.01}), "parameter", "'tilt_nort'", "tilt_north", UnknownNameError),
    Wrong(lambda: azel().with_parameters({"canting": [0.1, 0.2]}), "canting", "(2,)", "shape ()"),
    Wrong(lambda: azel().with_parameters({"canting": "small"}), "canting", "'small'", "array of numbers"),
    Wrong(lambda: azel().pose((1.0, 2.0, 3.0)), "counts", "(3,)", "2 drives"),
    Wrong(lambda: azel().pose((NAN, 0.0)), "counts[0]", "nan", "pass a number"),
    Wrong(lambda: azel().jacobian((0.0, 0.0), ("tilt",)), "parameter", "'tilt'", "tilt_north", UnknownNameError),
    Wrong(lambda: AxisLimits(5, 1, 100.0, 100.0, 0), "axis", "5", "low end"),
]  # fmt: skip

TRACKING = [
    Wrong(lambda: ht.track("P6A", UP, AIM), "mechanism", "a str", "plant[name]"),
    Wrong(lambda: ht.track(azel(), (0.0, 0.0, 2.0), AIM), "sun", "length", "5e-7"),
    Wrong(lambda: ht.track(azel(), (180.0, 45.0), AIM), "sun", "(2,)", "3 numbers"),
    Wrong(lambda: ht.track(azel(), UP, (0.0, 13.0)), "aim", "(2,)", "3 numbers"),
    Wrong(lambda: ht.track(azel(), UP, (0.0, NAN, 13.0)), "aim[1]", "nan", "finite"),
    Wrong(lambda: ht.track(mechs(), np.tile(UP, (3, 1)), AIM), "sun", "(3,)", "(18,)"),
    Wrong(lambda: ht.track(azel(), UP, AIM, branch="left"), "branch", "'left'", "'both', 0 or 1"),
    Wrong(lambda: ht.track(azel(), UP, AIM, tolerance=0.0), "tolerance", "0.0 m", "above 0"),
    Wrong(lambda: ht.track(azel(), UP, AIM, max_iterations=0), "max_iterations", "0", "above 0"),
    Wrong(lambda: ht.track(azel(), UP, AIM, current=(0.0,)), "current", "(1,)", "(..., 2)"),
    Wrong(lambda: ht.track(azel(), UP, AIM, drives=direct()), "drives", "()", "must be 2"),
    Wrong(lambda: ht.image_offsets(mechs(), kinds.pitch_roll(ORIGIN), UP, AIM), "actual", "pitch_roll", "azimuth_elevation"),
]  # fmt: skip

SIGHTINGS = [
    Wrong(lambda: row(heliostat=-1), "heliostat", "-1", "use integers from 0"),
    Wrong(lambda: row(heliostat=0.5), "heliostat", "0.5", "integers"),
    Wrong(lambda: row(heliostat=[0, 0]), "heliostat", "(2,)", "(3,)"),
    Wrong(lambda: row(counts=np.zeros((2, 3, 2)), source=np.ones((4, 3))), "source", "(4, 3)", "(2, 3, 3)"),
    Wrong(lambda: row(counts=[(0.0, NAN)]), "counts", "nan", "omit this row"),
    Wrong(lambda: row(heliostat=[], counts=[]), "counts", "(0,)", "(0, 2)"),
    Wrong(lambda: row(source=np.ones((3, 2))), "source", "(3, 2)", "(3, 3)"),
    Wrong(lambda: row(destination=np.ones((3, 2))), "destination", "(3, 2)", "(3, 3)"),
    Wrong(lambda: row(source=ORIGIN), "source", "length 0", "pass a nonzero vector"),
    Wrong(lambda: row(sigma=0.0), "sigma", "0.0 rad", "1e-06 and 0.2 rad"),
    Wrong(lambda: row(sigma=0.5), "sigma", "0.5 rad", "0.2 rad"),
    Wrong(lambda: row(time="2026-09-02T10:00"), "times", "10:00:00", "time zone", TimeError),
    Wrong(lambda: row(time=[0.0, 1.0]), "time", "(2,)", "(3,)"),
    Wrong(lambda: row(source_covariance=-1.0), "source_covariance", "-1.0", "positive semidefinite"),
    Wrong(lambda: row(destination_covariance=np.eye(2)), "destination_covariance", "(2, 2)", "(3, 3)"),
    Wrong(lambda: row(source_at_infinity=[True, False]), "source_at_infinity", "(2,)", "(3,)"),
    Wrong(lambda: sun_sensor(0, np.zeros((1, 2)), UP, normal_sigma=0.25), "sigma", "0.5 rad", "0.2 rad"),
    Wrong(lambda: join([]), "join", "the list is empty", "at least one"),
    Wrong(lambda: join([seen(), 5]), "part 1", "int", "list of Sightings"),  # type: ignore[list-item]
    Wrong(lambda: join([seen(), row(counts=np.zeros((3, 1)))]), "join", "[1, 2] drives", "one kind"),
    Wrong(lambda: ht.split(seen(), "random", 1.5), "fraction", "1.5", "between 0 and 1"),
    Wrong(lambda: ht.split(seen(), "odd"), "split", "'odd'", "random"),  # type: ignore[arg-type]
]  # fmt: skip

CALIBRATION = [
    Wrong(lambda: ht.fit(mechs(), seen(), "guo6", loss="l2"), "loss", "'l2'", "square", UnknownNameError),  # type: ignore[arg-type]
    Wrong(lambda: ht.fit(mechs(), seen(), "malan9"), "model", "'malan9'", "malan8", UnknownNameError),
    Wrong(lambda: ht.fit(mechs(), seen(), ("tilt",)), "parameter", "'tilt'", "tilt_north", UnknownNameError),
    Wrong(lambda: ht.fit(mechs(), seen(), 8), "model", "an int", "name of a model"),  # type: ignore[arg-type]
    Wrong(lambda: ht.fit("P6A", seen(), "guo6"), "mechanism", "a str", "plant[name]"),  # type: ignore[arg-type]
    Wrong(lambda: ht.fit(mechs(), np.zeros((3, 2)), "guo6"), "sightings", "numpy ndarray", "heliotrope.sightings"),  # type: ignore[arg-type]
    Wrong(lambda: ht.fit(mechs()[:1], row(heliostat=4), "guo6"), "sightings", "index 4", "1 heliostats"),
    Wrong(lambda: ht.fit(mechs(), row(counts=np.zeros((3, 1))), "guo6"), "counts", "1 drives", "have 2"),
    Wrong(lambda: ht.fit(mechs(), seen(), "guo6", priors={"canting": 0.0}), "prior of canting", "0.0", "above 0"),
    Wrong(lambda: ht.fit(mechs(), seen(), "guo6", priors={"cant": 0.1}), "parameter", "'cant'", "canting", UnknownNameError),
    Wrong(lambda: ht.fit(mechs(), seen(), "guo6", keep=[True]), "keep", "(1,)", "(12,)"),
    Wrong(lambda: ht.fit(mechs(), seen(), "guo6", max_iterations=0), "max_iterations", "0", "at least 1"),
    Wrong(lambda: ht.fit(mechs(), seen(), "azimuth_worm_ratio"), "fit", "azimuth_worm_ratio", "found by a search, not by a fit"),
    Wrong(lambda: ht.learn(mechs(), seen(), ("tilt_north", SINE)), "model", "a heliotrope DriveTerm", "fit_terms"),  # type: ignore[arg-type]
    Wrong(lambda: ht.learn(mechs(), seen(), "guo6", used=np.ones(3, bool)), "used", "(3,)", "(12,)"),
    Wrong(lambda: learned().parameters_at([1], 0.0), "heliostat", "row 1", "0 to 0"),
    Wrong(lambda: learned().parameters_at([0], "noon"), "times", "'noon'", "ISO 8601", TimeError),
    Wrong(lambda: predict(learned(), row(heliostat=7)), "heliostat", "index 7", "1 heliostats"),
    Wrong(lambda: ht.beam_errors(mechs()[:2], row(heliostat=7)), "sightings", "index 7", "2 heliostats"),
    Wrong(lambda: ht.evaluate(field().names, mechs(), seen(), "guo6", fraction=0.0), "fraction", "0.0", "between 0 and 1"),
]  # fmt: skip

FIELD = [
    Wrong(lambda: replace(field(), names=("A",)), "heliostats", "1 names", "(18,)"),
    Wrong(lambda: replace(field(), names=("A",) * 18), "heliostat A", "twice", "unique"),
    Wrong(lambda: replace(field(), width=np.zeros(18)), "width", "0.0 m", "above 0"),
    Wrong(lambda: replace(field(), aim=np.zeros((18, 2))), "aim", "(18, 2)", "(18, 3)"),
    Wrong(lambda: field().with_parameters({"cant": 0.1}), "parameter", "'cant'", "canting", UnknownNameError),
    Wrong(lambda: field().take([18]), "rows", "18", "0 to 17"),
    Wrong(lambda: plant().find("P6Z"), "heliostat", "'P6Z'", "P6A", UnknownNameError),
    Wrong(lambda: plant().target("tower"), "target", "'tower'", "known: target", UnknownNameError),
    Wrong(lambda: plant().machine("P6A"), "azel", "no table", "[groups.azel.machine]"),
    Wrong(lambda: replace(plant(), site=Location(-33.9, 18.9)), "site", "pvlib Location", "Site(latitude_deg"),
    Wrong(lambda: replace(plant(), targets=plant().targets * 2), "target", "target", "twice"),
    Wrong(lambda: replace(plant().targets[0], corners=np.zeros((3, 3))), "corners", "(3, 3)", "(4, 3)"),
    Wrong(lambda: replace(plant().targets[0], corners=np.zeros((4, 3))), "corners", "no area", "rectangle"),
    Wrong(lambda: replace(plant().receivers[0], kind="flat"), "kind", "'flat'", "planar"),
    Wrong(lambda: replace(plant().receivers[0], width=-1.5), "width", "-1.5 m", "above 0"),
    Wrong(lambda: ht.open(Path("nowhere.toml")), "nowhere.toml", "no such file", "", FormatError),
    Wrong(lambda: Sphere("tower", ORIGIN, 0.0), "radius", "0.0 m", "above 0"),
    Wrong(lambda: Box("hall", ORIGIN, (1.0, 1.0)), "size", "(2,)", "3 numbers"),
    Wrong(lambda: Cylinder("mast", ORIGIN, ORIGIN, 1.0), "mast", "coincide", "two different points"),
    Wrong(lambda: flux(aim=[AIM, AIM]), "aim", "(2, 3)", "expected (3,) or"),
    Wrong(lambda: flux(reflectivity=1.2), "reflectivity", "1.2", "between 0 and 1"),
    Wrong(lambda: flux(sun=(1.0, 0.0)), "sun", "(2,)", "3 numbers"),
    Wrong(lambda: flux(cells=(0, 24)), "cells", "0", "at least 1"),
]  # fmt: skip

TABLE = SUN + GEOMETRY + DRIVES + MECHANISMS + TRACKING + SIGHTINGS + CALIBRATION + FIELD


def test_the_table_has_a_hundred_rows() -> None:
    assert len(TABLE) >= 100


@pytest.mark.parametrize("wrong", TABLE, ids=[f"{w.argument}-{w.value}" for w in TABLE])
def test_a_wrong_input_gets_one_clear_line(wrong: Wrong) -> None:
    with pytest.raises(InputError) as caught:
        wrong.call()
    text = str(caught.value)
    assert type(caught.value) is wrong.error
    assert "\n" not in text
    assert len(text) < 300
    for part in (wrong.argument, wrong.value, wrong.limit):
        assert part in text, text


def test_values_compare_by_content() -> None:
    """``==`` of records of arrays says yes or no; it does not fail."""
    mechanism = mechs()
    assert mechanism == replace(mechanism, position=mechanism.position.copy())
    assert mechanism != mechanism.with_parameters({"tilt_north": 1e-6})
    assert mechanism != mechanism[:3]
    assert mechanism != "mechanism"
    assert ht.example_plant() == plant()
    assert replace(plant(), name="another") != plant()
    assert seen() == seen().take(np.arange(12))
    assert seen() != seen().take(np.arange(11))
    unknown = replace(seen(), time=np.full(12, NAN))
    assert unknown == replace(unknown, time=np.full(12, NAN))
    assert learned() == replace(learned(), model=tuple(learned().model))
    with pytest.raises(TypeError, match="unhashable"):
        hash(mechanism)
