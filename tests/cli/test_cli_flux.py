"""``heliotrope flux``: what it prints, what it writes, and what it refuses."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import heliotrope as ht
from heliotrope.cli import main
from heliotrope.field.tower import Tower
from heliotrope.optics import FieldOptics

SUN = "--sun=0.1,0.6,0.8"


def run(
    arguments: tuple[str, ...], capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["heliotrope", "flux", *arguments])
    with pytest.raises(SystemExit) as leaving:
        main()
    said = capsys.readouterr()
    return int(leaving.value.code or 0), said.out, said.err


@pytest.fixture
def flux(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run the command on the example plant in its folder."""
    monkeypatch.chdir(tmp_path)
    ht.write_plant(ht.example_plant(), "plant.toml")
    return lambda *words: run(("plant.toml", *words), capsys, monkeypatch)


def test_json_is_what_the_library_computes(flux: Any) -> None:
    code, out, err = flux(
        SUN, "--json", "--dni=800", "--sun-shape=buie:0.1", "--air=20", "--slope-mrad=2",
        "--error-mrad=3", "--reflectivity=0.8", "--clean=0.9", "--focus=flat", "--cells=10x12",
        "--tower=0,-10,1,15",
    )  # fmt: skip
    assert code == 0, err
    got = json.loads(out)
    known = ht.flux(
        ht.example_plant(), sun=[0.1, 0.6, 0.8], dni=800.0, shape="buie:0.1", air=20.0, slope=2e-3,
        error=3e-3, reflectivity=0.8, clean=0.9, focus="flat", cells=(10, 12),
        towers=(Tower(0.0, -10.0, 1.0, -1e4, 15.0),),
    )  # fmt: skip
    assert got["power_w"] == pytest.approx(known.power)
    assert got["efficiencies"] == pytest.approx(known.summary)
    assert np.shape(got["receivers"][0]["flux_w_m2"]) == (10, 12)
    assert [one["name"] for one in got["heliostats"]] == list(known.names)
    assert got["heliostats"][3]["lit"] == pytest.approx(known.efficiencies.lit[3])


def test_facets_are_canted_at_a_time(flux: Any) -> None:
    words = ("--facets=3x2", "--canting=2026-09-02T10:00Z", "--json")
    code, out, err = flux("--time=2026-09-02T15:00Z", *words)
    assert code == 0, err
    plant = ht.example_plant()
    noon = ht.sun.vector("2026-09-02T10:00Z", plant.site)
    known = ht.flux(plant, "2026-09-02T15:00Z", facets=(3, 2), canting=noon)
    assert json.loads(out)["peak_w_m2"] == pytest.approx(known.peak)


def test_without_sunlight_only_what_it_needs_is_unknown(flux: Any) -> None:
    code, out, err = flux(SUN, "--dni=0")
    assert code == 0, err
    assert "cannot reach" not in out
    assert "nan" not in out
    (line,) = [line for line in out.splitlines() if line.strip().startswith("total")]
    assert line.split() == ["total"]
    code, out, _ = flux(SUN, "--dni=0", "--json")
    assert code == 0
    shares = json.loads(out)["efficiencies"]
    assert shares["cosine"] > 0.7
    assert shares["intercept"] is shares["total"] is None


def test_a_receiver_beside_the_beams_gets_no_light(flux: Any) -> None:
    file = Path("plant.toml")
    text, first = file.read_text(), ht.open("plant.toml").receivers[0]

    def with_another(normal: np.ndarray) -> tuple[int, str, str]:
        center = (first.center + [9.0, 0.0, 0.0]).tolist()
        file.write_text(
            f'{text}\n[[receivers]]\nname = "beside"\nkind = "planar"\ncenter_m = {center}\n'
            f"normal = {normal.tolist()}\nwidth_m = 3\nheight_m = 3\n"
        )
        return flux(SUN)  # type: ignore[no-any-return]

    code, out, err = with_another(first.normal)
    assert code == 0, err
    assert "beside: 0 MW, peak 0 kW/m², 0.00 % of the reflected light" in out
    code, _, err = with_another(-first.normal)
    assert code == 2
    assert "receiver beside: no mirror sends light to it; turn the receiver" in err


def test_off_axis_facets_face_the_receiver_that_they_are_for() -> None:
    plant = ht.example_plant()
    first = plant.receivers[0]
    name, away = "other", first.center + [15.0, 0.0, 0.0]
    other = replace(first, name=name, center=away, corners=None)
    plant = replace(plant, receivers=(first, other))
    light = FieldOptics(facets=(3, 2), canting=(0.1, 0.6, 0.8))
    sun = np.array([0.1, 0.6, 0.8]) / np.linalg.norm([0.1, 0.6, 0.8])
    given = light.scene(plant, sun, None, (name,)).mirrors
    alone = light.scene(replace(plant, receivers=(other,)), sun, None, ()).mirrors
    assert given.facets is not None
    assert alone.facets is not None
    np.testing.assert_allclose(given.facets.tilt, alone.facets.tilt, atol=1e-12)


def test_files_are_written_and_named(flux: Any, tmp_path: Path) -> None:
    code, out, err = flux(
        SUN, "--csv=h.csv", "--map=m.csv", "--netcdf=f.nc", "--picture=p.png", "--by=cosine"
    )
    assert code == 0, err
    for name in ("h.csv", "m.csv", "f.nc", "p.png"):
        assert (tmp_path / name).stat().st_size > 500
        assert name in out
    assert "neither shaded nor blocked" in out
    assert "peak" in out


def test_rays_stand_beside(flux: Any) -> None:
    pytest.importorskip("embreex")
    code, out, err = flux(SUN, "--rays=2e4", "--json")
    assert code == 0, err
    got = json.loads(out)
    assert got["rays"]["count"] == 20_000
    assert got["rays"]["power_w"] == pytest.approx(got["power_w"], rel=0.01)
    assert "by 20,000 rays" in flux(SUN, "--rays=2e4")[1]


def test_a_day_and_a_year_are_tables(flux: Any, tmp_path: Path) -> None:
    code, out, err = flux("--time=2026-09-02T10:00Z", "--every=4h", "--csv=d.csv")
    assert code == 0, err
    with (tmp_path / "d.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["time"].startswith("2026-09-02T")
    assert "mean optical efficiency" in out
    monkey = flux("--year", "--sam=s.csv", "--solartherm=s.motab", "--json")
    assert monkey[0] == 0, monkey[2]
    got = json.loads(monkey[1])
    assert len(got["suns"]) == len((tmp_path / "s.csv").read_text().splitlines()) > 80
    assert 0.6 < got["mean_efficiency"] < 0.9
    assert (tmp_path / "s.motab").read_text().startswith("#1\n")


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ((SUN, "--time=now"), "use --time or --sun, not both"),
        (("--time=2026-09-02T22:00Z",), "below the horizon; choose a time in daylight"),
        ((SUN, "--dni=-1"), "--dni"),
        ((SUN, "--air=fog"), "unknown air model 'fog'; known"),
        ((SUN, "--sun-shape=disk"), "sun shape 'disk'; known"),
        ((SUN, "--focus=near"), "--focus must be plant, slant, flat, or a focal"),
        ((SUN, "--facets=5"), "--facets '5': write COLUMNSxROWS, such as 5x7"),
        (
            (SUN, "--facets=100x7"),
            "--facets '100x7': write COLUMNSxROWS, such as 5x7, each number from 1",
        ),
        ((SUN, "--facets=5x7", "--canting=noon"), "time 'noon' is not ISO 8601"),
        ((SUN, "--facets=5x7", "--canting=-4"), "--canting '-4': use slant, a focal length from"),
        ((SUN, "--facets=5x7", "--canting=2026-03-20T00:00Z"), "below the horizon at that time"),
        ((SUN, "--canting=60"), "--canting applies only with --facets; add --facets"),
        (("--sun=0,0,0",), "--sun '0,0,0': write the sun vector as east,north,up"),
        (("--sun=1,2",), "--sun '1,2': write the sun vector as east,north,up"),
        ((SUN, "--csv=a.csv", "--map=a.csv"), "a.csv: two outputs have this name"),
        ((SUN, "--cells=0x4"), "--cells '0x4': write ROWSxCOLUMNS, such as 20x56"),
        ((SUN, "--tower=1,2,3"), "--tower '1,2,3': write four numbers in m"),
        ((SUN, "--tower=0,-24,30,9"), "of a tower of radius 30 m, inside it; correct one of them"),
        ((SUN, "--receiver=none"), "receiver 'none'"),
        ((SUN, "--rays=10"), "rays must be between 1,000 and 1,000,000,000, not 10"),
        ((SUN, "--sam=s.csv"), "--sam: this file is written only for --year"),
        ((SUN, "--picture=p.gif"), "use one of"),
        ((SUN, "--csv=none/h.csv"), "the folder none does not exist"),
        ((SUN, "--csv=plant.toml"), "this file is an input"),
        (("--year", "--time=now"), "--time cannot be used with a year"),
        (("--year", "--rays=1e4"), "--rays: a year cannot be ray-traced"),
        (("--every=1h", "--netcdf=f.nc"), "--netcdf: this file is written only for one time"),
    ],
)
def test_bad_input_ends_in_one_line(flux: Any, words: tuple[str, ...], line: str) -> None:
    code, out, err = flux(*words)
    assert (code, out) == (2, "")
    assert line in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("more", "words", "text"),
    [
        ("[groups.azel.mirror]\nfacets = [2, 0]\n", (), "groups.azel.mirror.facets"),
        ("[groups.azel.mirror]\nslope_maps = 'maps'\n", (), "no such folder"),
        ("[groups.azel.mirror]\ncanting = 'slant'\n", (), "add facets = [columns, rows]"),
        ("[[towers]]\neast_m = 0\nnorth_m = 0\nradius_m = 900\ntop_m = 9\n", (), "of a tower of"),
        ("", ("--tower=0,0,900,9",), "of a tower of radius 900 m, inside it"),
        ("", ("--dni=-1",), "--dni"),
    ],
)
def test_a_plant_that_cannot_be_is_one_line(
    more: str, words: tuple[str, ...], text: str, flux: Any
) -> None:
    file = Path("plant.toml")
    (group,) = ht.open("plant.toml").groups
    file.write_text(file.read_text() + more.replace("azel", group))
    code, _, err = flux(SUN, *words)
    assert code == 2
    assert text.replace("azel", group) in " ".join(err.split())
    assert "Traceback" not in err
