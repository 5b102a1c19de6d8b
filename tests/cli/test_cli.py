"""The command line: what each command prints, on the screen and as JSON."""

import json
import subprocess
import sys
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from heliotrope import __version__, sun
from heliotrope.calibration.report import page as report
from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.calibration.sightings import join, sightings
from heliotrope.cli import main
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.geometry import azimuth_elevation, reflect
from heliotrope.mechanism.tracking import track
from support.data import juelich
from support.paint_server import PLANT, serve


def _call(arguments: list[str], capsys: Any, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "argv", ["heliotrope", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    captured = capsys.readouterr()
    assert leaving.value.code in (0, None), captured.err
    return str(captured.out)


@pytest.fixture(autouse=True)
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a report's heliostats only the worst two are drawn."""
    monkeypatch.setattr(report, "MOST_SECTIONS", 2)


@pytest.fixture
def call(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command and return what it prints."""
    return lambda *arguments: _call(list(arguments), capsys, monkeypatch)


@pytest.fixture
def plant_file(tmp_path: Path) -> Path:
    """The example plant as a file."""
    write_plant(example_plant(), tmp_path / "plant.toml")
    return tmp_path / "plant.toml"


def test_help_and_version(call: Any) -> None:
    text = call("--help")
    for command in ("sun", "track", "field", "calibrate", "evaluate", "plan", "fetch", "demo"):
        assert command in text
    assert call("--version").strip() == f"heliotrope {__version__}"


def test_sun(call: Any) -> None:
    arguments = ("sun", "--latitude", "39.742476", "--longitude", "-105.1786", "--height",
                 "1830.14", "--pressure", "820", "--temperature", "11",
                 "--time", "2003-10-17T12:30:30-07:00", "--json")  # fmt: skip
    found = json.loads(call(*arguments))
    # Reda & Andreas 2004, table A5.1: azimuth 194.34024°, zenith 50.11162°.
    assert found["azimuth_deg"] == pytest.approx(194.34024, abs=2e-4)
    assert found["elevation_deg"] == pytest.approx(90 - 50.11162, abs=2e-4)
    assert found["sunrise"] < found["culmination"] < found["sunset"]
    table = call("sun", "--time", "2026-09-02T10:00Z", "--every", "1h")
    assert table.count("2026-09-02T") >= 11
    assert "sunset" in table


def test_track_gives_both_branches(call: Any, plant_file: Path) -> None:
    found = json.loads(
        call(
            "track",
            plant_file,
            "--heliostat",
            "P6A",
            "--aim",
            "0,0,13",
            "--time",
            "2026-09-02T10:00:00Z",
            "--json",
        )
    )
    assert len(found["branches"]) == 2
    plant = example_plant()
    mechanism = plant["P6A"].calibrated
    vector = sun.vector("2026-09-02T10:00:00Z", plant.site)
    keys = {
        "azimuth_deg",
        "elevation_deg",
        "angles_rad",
        "counts",
        "reachable",
        "residual_mrad",
        "iterations",
    }
    for branch in found["branches"]:
        assert keys <= set(branch)
        pose = mechanism.pose(branch["counts"])
        azimuth, elevation = azimuth_elevation(pose.normal)
        assert branch["azimuth_deg"] == pytest.approx(np.degrees(azimuth), abs=1e-9)
        assert branch["elevation_deg"] == pytest.approx(np.degrees(elevation), abs=1e-9)
        if branch["reachable"]:
            ray = reflect(vector, pose.normal)
            way = np.array([0.0, 0.0, 13.0]) - pose.vertex
            assert np.linalg.norm(np.cross(way, ray)) < 1e-8
            assert branch["residual_mrad"] < 1e-6
        else:
            assert branch["residual_mrad"] > 1.0
    assert found["branches"][found["best"]]["reachable"]


def test_track_by_guo_agrees_with_the_armature(call: Any, plant_file: Path) -> None:
    question = ("track", plant_file, "--heliostat", "P1A", "--time", "2026-12-21T10:00+02:00")
    his = json.loads(call(*question, "--law", "guo", "--json"))
    ours = json.loads(call(*question, "--json"))
    best = ours["branches"][ours["best"]]
    nearest = min(his["branches"], key=lambda b: abs(b["counts"][1] - best["counts"][1]))
    np.testing.assert_allclose(nearest["angles_rad"], best["angles_rad"], rtol=0, atol=1e-7)
    assert nearest["from_armature_mrad"] < 1e-4
    assert set(his["guo"]) == {"psi_a", "psi_t", "gamma_0", "tau_1", "alpha_0", "mu", "H_z"}
    assert "τ₁" in call(*question, "--law", "guo")


def test_parameters_converts_malans_table_6_1(call: Any) -> None:
    values = ("eptN=-13.27", "eptE=-4.56", "eNO=-1.92", "gb=-3.79", "ab=1.12")
    found = json.loads(call("parameters", "--from", "malan", *values, "--json"))
    # The pedestal leans to the south-south-west, as he says of his roof.
    assert found["guo"]["psi_a_deg"] == pytest.approx(198.97, abs=0.01)
    assert found["guo"]["psi_t_deg"] == pytest.approx(
        np.degrees(np.hypot(13.27, 4.56) / 1e3), rel=1e-3
    )
    assert found["guo"]["alpha_0_deg"] == pytest.approx(-np.degrees(1.12e-3))
    assert found["malan"]["eptN_mrad"] == pytest.approx(-13.27)
    shown = call("parameters", "psi_t=1.854", "psi_a=236.06", "mu=-0.92")
    assert "cannot be expressed in Malan's parameters: canting" in shown


def test_track_a_day(call: Any, plant_file: Path) -> None:
    arguments = (
        "track",
        plant_file,
        "--heliostat",
        "P1A",
        "--time",
        "2026-09-02T10:00Z",
        "--every",
        "30min",
    )
    found = json.loads(call(*arguments, "--json"))
    assert 20 < len(found["day"]) < 25
    assert sum(row["reachable"] for row in found["day"]) > 18
    assert "P1A" in call(*arguments)
    shown = call("track", plant_file, "--heliostat", "P1A", "--sun", "0.2,0.5,0.8")
    assert "recommended pose" in shown


def test_field_check(call: Any, plant_file: Path) -> None:
    found = json.loads(call("field", "check", plant_file, "--json"))
    assert found["ok"]
    assert found["findings"] == []
    assert "no problems found" in call("field", "check", plant_file)


def test_field_safety_shows_the_numbers_in_force(call: Any, plant_file: Path) -> None:
    limits = "\n[safety.wind_gust_stow]\ntrips_m_s = 18\n"
    plant_file.write_text(plant_file.read_text(encoding="utf-8") + limits, encoding="utf-8")
    text = call("field", "safety", plant_file)
    assert "wind_gust_stow.trips_m_s*" in text
    assert "wind_gust_stow.releases_m_s " in text
    found = json.loads(call("field", "safety", plant_file, "--json"))
    rows = {f"{one['condition']}.{one['key']}": one for one in found}
    assert rows["wind_gust_stow.trips_m_s"] == {
        "condition": "wind_gust_stow",
        "key": "trips_m_s",
        "value": 18.0,
        "default": 20.0,
        "low": 5.0,
        "high": 30.0,
        "changed": True,
    }
    assert not rows["sun_below_horizon.trips_deg"]["changed"]
    assert "cluster_silent.trips_s" not in rows


def test_track_reads_heliok(call: Any) -> None:
    scene = Path(__file__).parents[1] / "files" / "heliok-scene.xml"
    found = json.loads(
        call(
            "track",
            scene,
            "--heliostat",
            "HeliostatA",
            "--aim",
            "0,0,20",
            "--sun",
            "0.6123724,-0.3535534,0.7071068",
            "--json",
        )
    )
    angles = np.degrees(found["branches"][0]["angles_rad"])
    np.testing.assert_allclose(angles, [-36.8761, 40.6415], rtol=0, atol=2e-3)


HELIOK = Path(__file__).parents[1] / "files" / "heliok-scene.xml"


def test_track_takes_aim_and_sun_of_a_heliok_file(call: Any) -> None:
    found = json.loads(call("track", HELIOK, "--heliostat", "HeliostatA", "--json"))
    assert found["sun_from"] == "file"
    assert found["aim"] == [0.0, 0.0, 20.0]
    angles = np.degrees(found["branches"][0]["angles_rad"])
    np.testing.assert_allclose(angles, [-36.8761, 40.6415], rtol=0, atol=2e-3)
    timed = call(
        "track", HELIOK, "--heliostat", "HeliostatA", "--time", "2026-06-21T10:00Z", "--json"
    )
    assert json.loads(timed)["sun_from"] == "time"


def test_track_traces_the_iteration_of_both_branches(call: Any) -> None:
    words = ("track", HELIOK, "--heliostat", "HeliostatA", "--trace")
    steps = json.loads(call(*words, "--json"))["steps"]
    assert {step["branch"] for step in steps} == {0, 1}
    for branch in (0, 1):
        misses = [step["miss_m"] for step in steps if step["branch"] == branch]
        # "A sub-millimeter accuracy" after two iterations, a thousandth of the miss each.
        assert misses[0] > 0.01
        assert misses[1] < 1e-3
        assert all(b < 0.01 * a for a, b in pairwise(misses))
    assert "Grigoriev's iteration" in call(*words)
    with pytest.raises(AssertionError, match="--trace prints a single time"):
        call(*words, "--local")


def test_track_aims_at_a_point_fixed_to_the_mirror(call: Any) -> None:
    # A point on the mirror's own normal, in the heliostat's frame: the mirror looks at the sun.
    words = ("track", HELIOK, "--heliostat", "HeliostatB", "--local")
    found = json.loads(call(*words, "--aim", "0,5.1,1.5", "--json"))
    best = found["branches"][found["best"]]
    assert best["reachable"]
    assert (best["azimuth_deg"], best["elevation_deg"]) == pytest.approx((120.0, 45.0), abs=1e-8)
    with pytest.raises(AssertionError, match="the aim is fixed behind the mirror"):
        call(*words, "--aim", "0,-5.1,1.5")
    with pytest.raises(
        AssertionError, match="--local needs an aim point that moves with the mirror"
    ):
        call(*words, "--target", "Receiver")


def test_track_follows_the_sun_with_a_single_axis(call: Any, tmp_path: Path) -> None:
    text = HELIOK.read_text(encoding="utf-8")
    line = next(row for row in text.splitlines() if "<Secondary" in row)
    path = tmp_path / "trough.xml"
    path.write_text(text.replace(line, "").replace('"0, 0, -1"', '"1, 0, 0"'), encoding="utf-8")
    words = ("track", path, "--heliostat", "HeliostatA")
    (branch,) = json.loads(call(*words, "--json"))["branches"]
    assert branch["reachable"]
    assert len(branch["angles_rad"]) == 1
    assert "single axis: sun and aim are projected onto the plane" in call(*words)
    assert "Grigoriev's iteration" in call(*words, "--trace")
    day = json.loads(call(*words, "--time", "2026-06-21T10:00Z", "--every", "3h", "--json"))
    assert day["joints"] == ["rotation"]
    assert any(row["reachable"] for row in day["day"])
    with pytest.raises(AssertionError, match="pass one heliostat with two drives"):
        call("view", path, tmp_path / "day.glb", "--heliostat", "HeliostatA")


def test_view_writes_a_page_and_a_model(call: Any, tmp_path: Path) -> None:
    words = ("--heliostat", "HeliostatA", "--time", "2026-06-21T12:00Z", "--every", "1h")
    said = call("view", HELIOK, tmp_path / "day.html", *words)
    assert "poses reach the aim" in said
    page = (tmp_path / "day.html").read_text(encoding="utf-8")
    assert "armature and mirror through a day" in page
    assert "<script src=" not in page, "the page stands by itself"
    call("view", HELIOK, tmp_path / "day.glb", *words)
    assert (tmp_path / "day.glb").read_bytes().startswith(b"glTF")
    with pytest.raises(AssertionError, match=r"must end in \.html or \.glb"):
        call("view", HELIOK, tmp_path / "day.obj", *words)


def test_track_reads_paint(call: Any) -> None:
    arguments = ("--target", "multi_focus_tower", "--time", "2022-06-01T10:00Z", "--json")
    found = json.loads(call("track", juelich(), "--heliostat", "AA39", *arguments))
    assert found["branches"][found["best"]]["reachable"]


def test_fetch(call: Any, tmp_path: Path) -> None:
    with httpx.Client(timeout=5.0) as client, serve(client) as database:
        href = f"{database.base}/{PLANT}-tower-measurements.json"
        database.put(
            f"{PLANT}-tower-measurements-item-stac.json",
            {"assets": {"tower-measurements": {"href": href}}},
        )
        database.put(f"{PLANT}-tower-measurements.json", {"tower": 1})
        arguments = (
            "fetch",
            "juelich",
            "AA39",
            "--into",
            tmp_path / "j",
            "--base-url",
            database.base,
        )
        found = json.loads(call(*arguments, "--json"))
        assert len(found["files"]) == found["new"] == 4
        assert all(Path(file).is_file() for file in found["files"])
        assert "4 files in" in call(*arguments)
        assert json.loads(call(*arguments, "--json"))["new"] == 0


def test_calibrate(call: Any, tmp_path: Path) -> None:
    found = json.loads(
        call("calibrate", juelich(), "--model", "jacks", "--report", tmp_path / "out", "--json")
    )
    assert found["held_out_median_of_medians_mrad"] <= 0.65
    assert 0.85 <= found["held_out_coverage_90"] <= 0.95
    assert found["heliostats"]["BF57"]["n"] == 145
    assert found["heliostats"]["BF57"]["sigma"]["tilt_north"] > 0
    assert len(found["left_out"]) == 549
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "BF41" in page
    table = (tmp_path / "out" / "parameters.csv").read_text(encoding="utf-8").splitlines()
    assert table[0].startswith("name,sightings,outcome,noise_scale,tilt_north_rad")
    assert len(table) == 27
    # The plant of the report is read like any other, with its parameters.
    plant = read_plant(tmp_path / "out" / "plant.toml")
    (group,) = plant.groups.values()
    sent = found["heliostats"]["BF57"]["parameters"]["tilt_north"]
    assert group.parameters["tilt_north"][group.index("BF57")] == sent


def test_calibrate_chooses_a_model(call: Any, tmp_path: Path) -> None:
    source, some = juelich(), ("BG23", "BH21", "BG15")
    for name in ("properties", "tower-measurements.json"):
        (tmp_path / name).symlink_to(source / name)
    head, *rows = (source / "measurements.csv").read_text(encoding="utf-8").splitlines()
    kept = [head, *(row for row in rows if row.split(",")[0] in some)]
    (tmp_path / "measurements.csv").write_text("\n".join(kept) + "\n", encoding="utf-8")
    found = json.loads(call("calibrate", tmp_path, "--report", tmp_path / "out", "--json"))
    assert "canting" in found["model"]
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert "simplest that explains" in page


def test_evaluate(call: Any) -> None:
    arguments = ("evaluate", juelich(), "--model", "jacks", "--split", "chronological")
    found = json.loads(call(*arguments, "--fraction", "0.7", "--seed", "0", "--json"))
    for key in ("n", "median_beam_mrad", "rms_beam_mrad", "p95_beam_mrad", "coverage_90"):
        assert found["heliostats"]["BF57"][key] > 0
    assert found["median_of_medians_mrad"] <= 1.05
    assert found["mean_of_means_mrad"] > 0
    assert 0.85 <= found["coverage_90"] <= 0.95
    for key in ("gamma_0_mrad", "sigma_gamma_mrad", "alpha_0_mrad", "sigma_alpha_mrad"):
        assert np.isfinite(found["heliostats"]["BF57"][key])
    text = call("evaluate", juelich(), "--model", "tilt_north,tilt_up,canting", "--fraction", "0.5")
    assert "median of medians" in text
    assert "90 % ellipse" in text


def test_calibrate_a_plant_with_a_table(call: Any, plant_file: Path, tmp_path: Path) -> None:
    """What a researcher brings: a plant file, and sightings of any kind in a table."""
    plant = read_plant(plant_file)
    (group,) = plant.groups.values()
    truth = group.mechanism.with_parameters({"tilt_north": 5e-3, "azimuth_bias": -3e-3})
    seen = []
    for hour in range(8, 17):
        s = sun.vector(datetime(2026, 9, 2, hour, tzinfo=UTC), plant.site)
        wanted = track(group.mechanism, s, plant.targets[0].center)
        counts = wanted.best_counts
        pose = truth.pose(counts)
        spot = plant.targets[0].intersect(pose.vertex, reflect(s, pose.normal))
        good = np.flatnonzero(np.isfinite(spot).all(axis=-1))
        moment = datetime(2026, 9, 2, hour, tzinfo=UTC).timestamp()
        seen.append(sightings(good, counts[good], s, spot[good], time=moment, sigma=1e-4))
    table = tmp_path / "seen.csv"
    write_sightings(table, join(seen), group.names)
    found = json.loads(
        call(
            "calibrate",
            plant_file,
            "--sightings",
            table,
            "--report",
            tmp_path / "out",
            "--model",
            "guo6",
            "--prior",
            "tilt_north=0.01",
            "--json",
        )
    )
    his = next(iter(found["guo"].values()))
    # A tilt to the north of 5 mrad, and a bias of −3 mrad: a zero of +3 mrad in his sense.
    assert his["psi_t_deg"] == pytest.approx(np.degrees(5e-3), rel=0.1)
    assert his["gamma_0_deg"] == pytest.approx(np.degrees(3e-3), rel=0.1)
    page = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2 + report.MOST_SECTIONS
    values = [h["parameters"]["tilt_north"] for h in found["heliostats"].values()]
    np.testing.assert_allclose(np.median(values), 5e-3, atol=2e-4)
    # The field takes it back: as a plant, and as a calibration beside the old one.
    question = ("--heliostat", "P6A", "--time", "2026-09-02T10:00Z", "--json")
    plain = json.loads(call("track", plant_file, *question))
    whole = json.loads(call("track", tmp_path / "out" / "plant.toml", *question))
    beside = json.loads(
        call("track", plant_file, "--calibration", tmp_path / "out" / "calibration.json", *question)
    )
    assert beside["branches"] == whole["branches"]
    assert beside["branches"] != plain["branches"]


def test_demo(call: Any, tmp_path: Path) -> None:
    found = json.loads(call("demo", "--into", tmp_path / "d", "--seed", "3", "--json"))
    assert found["day_before_mrad"] > 5.0
    assert found["day_after_mrad"] < 0.3
    plant = read_plant(tmp_path / "d" / "plant.toml")
    assert np.abs(plant.groups["azel"].parameters["tilt_north"]).max() > 1e-3


def test_light_import() -> None:
    """Help must not wait for the heavy libraries."""
    code = (
        "import sys; import heliotrope.cli; "
        "print([m for m in ('numpy','numba','scipy','pandas','pvlib','matplotlib','pydantic') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_closed_pipe_is_no_error(plant_file: Path) -> None:
    command = Path(sys.executable).with_name("heliotrope")
    line = f"{command} track {plant_file} --heliostat P1A --every 30s | head -1"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=True)
    assert "Traceback" not in done.stderr
    assert "P1A" in done.stdout
