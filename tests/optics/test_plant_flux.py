"""The flux and the efficiencies of a plant: they add up, and files hold what they should."""

import csv
from dataclasses import replace
from datetime import timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.io import netcdf_file

import heliotrope as ht
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.field.tower import Tower
from heliotrope.geometry import direction
from heliotrope.optics import EFFICIENCIES, FieldOptics, FluxTable, PlantFlux
from heliotrope.optics import flux_files as files
from heliotrope.optics.plant_flux import sun_at

SUN = direction(np.radians(10.0), np.radians(50.0))  # in the north, for a southern plant
LIGHT = FieldOptics(dni=850.0, clean=0.95, slope=1.5e-3)


@cache
def plant() -> Plant:
    """Return the example's 18."""
    return ht.example_plant()


@cache
def found() -> PlantFlux:
    return ht.flux(plant(), sun=SUN, light=LIGHT)


@cache
def year() -> FluxTable:
    return ht.flux_year(plant(), declinations=3, hours=2.0, light=LIGHT)


def test_efficiencies_multiply_to_the_power() -> None:
    got, e = found(), found().efficiencies
    product = e.cosine * e.lit * e.mirror * e.air * e.intercept
    np.testing.assert_allclose(product, e.total, rtol=1e-4)
    s = got.summary
    whole = s["cosine"] * s["lit"] * s["mirror"] * s["air"] * s["intercept"]
    assert whole == pytest.approx(s["total"], rel=1e-12)
    assert got.power == pytest.approx(s["total"] * got.area.sum() * 850.0, rel=1e-9)
    assert got.power == pytest.approx(got.heliostat_power.sum(), rel=1e-9)
    assert e.mirror == pytest.approx(0.9 * 0.95)
    view = got.maps[0]
    cell = (view.right[1] - view.right[0]) * (view.up[1] - view.up[0])
    assert view.flux.sum() * cell == pytest.approx(got.power, rel=2e-3)


def test_rays_say_the_same() -> None:
    pytest.importorskip("embreex")
    traced = ht.flux(plant(), sun=SUN, light=LIGHT, rays=2e5, seed=1)
    assert traced.rays == 200_000
    assert traced.power == pytest.approx(
        found().power, abs=4 * traced.power_error + 1e-4 * found().power
    )
    for name in EFFICIENCIES:
        assert traced.summary[name] == pytest.approx(found().summary[name], abs=2e-3)
    apart = traced.flux - found().flux
    noise = np.sqrt(np.mean(traced.errors[0] ** 2))
    assert np.sqrt(np.mean(apart**2)) < 1.5 * noise


def test_a_mirror_that_cannot_reach_its_aim_is_dark_and_named_unknown() -> None:
    # The elevation drive ends at the horizon: none looks down to an aim below the ground.
    aims = np.repeat([[0.0, 0.0, 16.5]], 18, axis=0)
    aims[3] = [-19.0, -24.0, -400.0]
    got = ht.flux(plant(), sun=SUN, aim=aims)
    assert np.isnan(got.efficiencies.total[3])
    assert np.isnan(got.efficiencies.cosine[3])
    assert got.heliostat_power[3] == 0.0
    assert got.heliostats == 17


def test_a_wide_belief_and_a_soiled_mirror_lower_what_they_should() -> None:
    wide = ht.flux(plant(), sun=SUN, light=LIGHT, error=20e-3)
    assert wide.summary["intercept"] < 0.8 < found().summary["intercept"]
    assert wide.summary["cosine"] == found().summary["cosine"]
    soiled = ht.flux(plant(), sun=SUN, light=LIGHT, clean=np.linspace(0.5, 1.0, 18))
    assert soiled.efficiencies.mirror[0] == pytest.approx(0.45)
    assert soiled.power < found().power


def test_a_day_is_the_moments_it_is_made_of() -> None:
    times = ht.sun.daylight("2026-09-02", plant().site, every=timedelta(hours=4))
    day = ht.flux_day(plant(), times, light=LIGHT)
    assert 2 <= len(day.sun) <= 3
    moment = ht.flux(plant(), sun=day.sun[1], light=LIGHT)
    assert day.power[1] == pytest.approx(moment.power, rel=1e-9)
    assert day.shares["lit"][1] == pytest.approx(moment.summary["lit"], rel=1e-9)
    assert day.mean == pytest.approx(day.shares["total"].mean())
    assert day.heliostat.shape == (18,)
    area = found().area
    assert day.heliostat @ area / area.sum() == pytest.approx(day.mean, rel=1e-9)


def test_the_suns_of_a_year_are_those_of_the_ephemeris() -> None:
    site = replace(plant().site, longitude_deg=0.0)
    position = ht.sun.position(["2026-06-21T12:00Z", "2026-12-21T09:00Z"], site)
    # Between mean and apparent time lie up to 16 minutes; at these days 2.
    ours = sun_at(np.radians([23.45, -23.45]), np.radians([0.0, -45.0]), np.radians(-33.93))
    apart = np.arccos(np.clip(np.sum(ours * position.true_vector, axis=-1), -1.0, 1.0))
    assert np.degrees(apart).max() < 1.0


def test_a_year_has_the_suns_above_the_horizon() -> None:
    table = year()
    assert table.elevation.min() > np.radians(2.0)
    # Longer days in the southern summer: declination −23.45°.
    count = [(table.declination.round(3) == d).sum() for d in np.unique(table.declination.round(3))]
    assert count[0] > count[-1]
    assert table.weight.sum() == pytest.approx(1.0)
    area = found().area
    assert table.heliostat @ area / area.sum() == pytest.approx(table.mean, rel=1e-9)


def test_a_table_of_heliostats_has_the_names_of_solarpilot(tmp_path: Path) -> None:
    files.write_heliostats(tmp_path / "h.csv", found(), year())
    with (tmp_path / "h.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["Heliostat ID"] for row in rows] == list(plant().names)
    for k, row in enumerate(rows):
        assert float(row["Total eff"]) == pytest.approx(found().efficiencies.total[k], abs=6e-6)
        assert float(row["Attenuation"]) == pytest.approx(found().efficiencies.air[k], abs=6e-6)
        assert float(row["Annual efficiency"]) == pytest.approx(year().heliostat[k], abs=6e-6)
        assert float(row["Soiling"]) == 0.95


def test_a_map_has_the_power(tmp_path: Path) -> None:
    files.write_map(tmp_path / "m.csv", found())
    with (tmp_path / "m.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    total = sum(float(row["area_m2"]) * float(row["flux_kw_m2"]) for row in rows)
    assert total == pytest.approx(1e-3 * found().power, rel=2e-3)
    assert {row["receiver"] for row in rows} == {"receiver"}


def test_netcdf_is_read_by_scipy(tmp_path: Path) -> None:
    files.write_netcdf(tmp_path / "f.nc", found())
    with netcdf_file(tmp_path / "f.nc", mmap=False) as file:
        flux, total = file.variables["flux_0"], file.variables["total"]
        np.testing.assert_array_equal(flux[:], found().flux)
        np.testing.assert_array_equal(total[:], found().efficiencies.total)
        assert flux.units == b"W m-2"
        assert flux.receiver == b"receiver"
        names = [b"".join(row).decode().strip() for row in file.variables["heliostat_name"][:]]
    assert names == list(plant().names)


def test_sam_gets_azimuth_zenith_and_efficiency(tmp_path: Path) -> None:
    files.write_sam(tmp_path / "s.csv", year())
    table = np.loadtxt(tmp_path / "s.csv", delimiter=",")
    suns = direction(np.radians(table[:, 0]), np.radians(90.0 - table[:, 1]))
    np.testing.assert_allclose(suns, year().sun, atol=2e-6)
    np.testing.assert_allclose(table[:, 2], year().shares["total"], atol=1e-6)


def test_solartherm_gets_declination_by_hour_angle(tmp_path: Path) -> None:
    files.write_solartherm(tmp_path / "s.motab", year())
    lines = (tmp_path / "s.motab").read_text(encoding="utf-8").splitlines()
    assert lines[0] == "#1"
    assert lines[2] == "double optics(4, 14)"  # as Modelica's tables begin, with the heads
    table = np.array([[float(x) for x in line.split()] for line in lines[3:]])
    assert table.shape == (4, 14)
    np.testing.assert_allclose(table[0, 1:], np.arange(-180.0, 181.0, 30.0))
    np.testing.assert_allclose(table[1:, 0], [-23.45, 0.0, 23.45])
    k = int(np.flatnonzero((np.abs(year().hour) < 1e-9) & (year().declination > 0.1))[0])
    assert table[3, 7] == pytest.approx(year().shares["total"][k], abs=1e-6)
    assert (table[1:, [1, -1]] == 0.0).all()  # midnight
    times = ht.sun.daylight("2026-09-02", plant().site, every=timedelta(hours=6))
    with pytest.raises(InputError, match="SolarTherm needs a table over a year"):
        files.write_solartherm(tmp_path / "d.motab", ht.flux_day(plant(), times))


def no_receiver() -> Plant:
    return replace(plant(), receivers=())


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: ht.flux(plant()), "pass either a time or a sun vector"),
        (
            lambda: ht.flux(plant(), "2026-09-02T10:00Z", sun=SUN),
            "pass either a time or a sun vector",
        ),
        (lambda: ht.flux(plant(), "2026-09-02T22:00Z"), r"the sun is \d+\.\d° below the hor"),
        (lambda: ht.flux(plant(), ["2026-09-02T10:00Z"]), "pass one time"),
        (lambda: ht.flux(no_receiver(), sun=SUN), "has no receiver; write a plant file"),
        (
            lambda: ht.flux(plant(), sun=SUN, dni=-1.0),
            r"DNI must be 0 or more and finite, not -1.0 W/m²",
        ),
        (
            lambda: ht.flux(plant(), sun=SUN, error=np.nan),
            "the error must be between 0 and 0.2 rad, not nan",
        ),
        (lambda: ht.flux(plant(), sun=SUN, shape="disk"), "sun shape 'disk'; known: pillbox"),
        (lambda: ht.flux(plant(), sun=SUN, air="fog"), "unknown air model 'fog'; known"),
        (
            lambda: ht.flux(plant(), sun=SUN, towers=(Tower(0.0, -24.0, 30.0, -9.0, 9.0),)),
            "of a tower of radius 30 m, inside it; correct one of them",
        ),
        (
            lambda: ht.flux(
                replace(
                    plant(), receivers=(replace(plant().receivers[0], normal=[0.0, 1.0, 0.0]),)
                ),
                sun=SUN,
            ),
            "receiver receiver: no mirror sends light to it; turn the receiver towards the field",
        ),
        (lambda: ht.flux_year(plant(), declinations=1), "2 to 100 declinations .* not 1 and 1.0 h"),
        (
            lambda: ht.flux_day(plant(), ["2026-09-02T22:00Z"]),
            "at or below 2° elevation at all of these times",
        ),
    ],
)
def test_bad_input_is_refused_in_one_line(call, line: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(InputError, match=line) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_an_unknown_option_or_receiver_is_named() -> None:
    with pytest.raises(UnknownNameError, match="option of the light 'slop'"):
        ht.flux(plant(), sun=SUN, slop=1e-3)
    with pytest.raises(UnknownNameError, match="receiver"):
        ht.flux(plant(), sun=SUN, receiver="recever")
