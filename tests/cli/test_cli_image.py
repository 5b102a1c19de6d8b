"""``heliotrope image``: photographs in, positions, pictures and sightings out."""

import json
import sys
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from heliotrope.calibration.sighting_table import read_sightings
from heliotrope.cli import main
from heliotrope.field.example import azimuth_elevation
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.geometry import enu_to_geodetic
from heliotrope.imaging.files import read_image, write_image
from heliotrope.imaging.synthetic.rendering import (
    Rendered,
    Scene,
    example_camera,
    example_target,
    exposed,
    render,
)
from heliotrope.optics.mirror_image import gaussian_beam
from heliotrope.sun import Site, vector
from support.data import juelich

SITE = Site(37.0, -2.0, 500.0)
ORIGIN = (37.0, -2.0, 500.0)
TARGET = example_target(8.0)
CAMERA = example_camera(TARGET, size=(800, 600))


def _photograph(at: tuple[float, float], seed: int, beams: int = 1) -> Rendered:
    thrown = tuple(
        ("target", gaussian_beam((at[0], at[1] - 3.0 * k), 0.7, 0.5, 0.4), 700.0)
        for k in range(beams)
    )
    scene = Scene(CAMERA, (TARGET,), thrown)
    return render(exposed(scene) if beams else scene, seed)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three photographs with their log and a plant, and what is true of them."""
    truth = []
    photographs = tmp_path / "photographs"
    photographs.mkdir()
    lines = ["file,heliostat,timestamp,target,axis_1_motor_position,axis_2_motor_position"]
    for k, at in enumerate([(0.5, 0.3), (-1.2, 0.8), (0.1, -1.4)]):
        rendered = _photograph(at, k)
        write_image(rendered.frame, photographs / f"p{k}.png")
        truth.append(rendered.beams[0].point.tolist())
        lines.append(f"p{k}.png,H{k % 2},2026-06-21T1{k}:00:00Z,target,{100 + k},{200 + k}")
    (tmp_path / "truth.json").write_text(json.dumps(truth))
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    names = ("H0", "H1")
    mechanism = azimuth_elevation(np.array([[0.0, -100.0, 0.0], [20.0, -120.0, 0.0]]))
    mirrors = Heliostats(names, mechanism, np.full(2, 2.0), np.full(2, 1.5))
    plant = Plant("test", SITE, {"azel": mirrors}, (TARGET,), cameras=(CAMERA,))
    write_plant(plant, tmp_path / "plant.toml")
    return tmp_path


@pytest.fixture
def call(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command; return exit code, output and errors."""

    def run(*arguments: Any) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["heliotrope", "image", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capsys.readouterr()
        return int(leaving.value.code or 0), str(captured.out), str(captured.err)

    return run


def test_json_gives_position_covariance_and_quality(folder: Path, call: Any) -> None:
    code, out, err = call(
        folder / "photographs" / "p0.png",
        "--plant",
        folder / "plant.toml",
        "--json",
        "--annotated",
        folder / "seen",
    )
    assert code == 0, err
    (image,) = json.loads(out)["images"]
    (reading,) = image["targets"]
    (spot,) = reading["spots"]
    truth = np.array(json.loads((folder / "truth.json").read_text())[0])
    place = np.array([spot[f"{axis}_m"] for axis in ("east", "north", "up")])
    covariance = np.array(spot["covariance_enu_m2"])
    assert reading["good"], reading["reasons"]
    assert np.linalg.norm(place - truth) < 0.03
    assert np.linalg.norm(place - truth) < 4.0 * np.sqrt(np.trace(covariance))
    latitude, longitude, altitude = enu_to_geodetic(place, ORIGIN)
    assert spot["latitude_deg"] == pytest.approx(float(latitude), abs=1e-12)
    assert spot["longitude_deg"] == pytest.approx(float(longitude), abs=1e-12)
    assert spot["altitude_m"] == pytest.approx(float(altitude), abs=1e-9)
    assert spot["sigma_major_m"] == pytest.approx(0.7, abs=0.05)
    drawn = read_image(image["annotated"])
    assert drawn.pixels.shape[2] == 3


def test_screen_names_spots_and_reasons(folder: Path, call: Any) -> None:
    write_image(_photograph((0.0, 1.5), 7, beams=2).frame, folder / "two.png")
    write_image(_photograph((0.0, 0.0), 8, beams=0).frame, folder / "none.png")
    code, out, _ = call(
        folder / "two.png", folder / "none.png", "--plant", folder / "plant.toml", "--no-pictures"
    )
    assert code == 0
    assert "several spots: a second spot has" in out
    assert "spot 2  E" in out
    assert "no spot: no spot stands out from the background" in out
    assert "annotated" not in out


def test_sightings_of_a_folder(folder: Path, call: Any) -> None:
    table = folder / "sightings.csv"
    code, out, err = call(
        folder / "photographs",
        "--plant",
        folder / "plant.toml",
        "--to-sightings",
        table,
        "--log",
        folder / "log.csv",
        "--no-pictures",
    )
    assert code == 0, err
    assert "3 sightings of 3 photographs" in out
    seen, kinds, left = read_sightings(table, ("H0", "H1"))
    assert not left
    assert set(kinds) == {"camera_target"}
    assert seen.heliostat.tolist() == [0, 1, 0]
    assert seen.counts[1].tolist() == [101.0, 201.0]
    truth = np.array(json.loads((folder / "truth.json").read_text()))
    assert np.linalg.norm(seen.destination - truth, axis=1).max() < 0.03
    sun = vector(datetime(2026, 6, 21, 11, tzinfo=UTC), SITE)
    assert seen.source[1] == pytest.approx(sun, abs=1e-12)
    spread = np.sqrt(np.trace(seen.destination_covariance, axis1=1, axis2=2))
    assert (spread > 0.001).all()
    assert (spread < 0.05).all()


def test_sightings_name_what_is_left_out(folder: Path, call: Any) -> None:
    photographs = folder / "photographs"
    write_image(_photograph((0.0, 0.0), 8, beams=0).frame, photographs / "p3.png")
    write_image(_photograph((0.0, 0.0), 9).frame, photographs / "p4.png")
    write_image(_photograph((0.0, 0.0), 10).frame, photographs / "p5.png")
    (photographs / "p6.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    with (folder / "log.csv").open("a") as log:
        log.write("p3.png,H0,2026-06-21T13:00:00Z,target,1,2\n")
        log.write("p4.png,H9,2026-06-21T13:00:00Z,target,1,2\n")
        log.write("p6.png,H0,2026-06-21T13:00:00Z,target,1,2\n")
    code, out, err = call(
        photographs,
        "--plant",
        folder / "plant.toml",
        "--to-sightings",
        folder / "s.parquet",
        "--log",
        folder / "log.csv",
        "--no-pictures",
        "--json",
        "--processes",
        1,
    )
    found = json.loads(out)
    assert code == 2, "a file could not be read"
    assert err.count("\n") == 1
    assert "p6.png" in err
    assert found["sightings"]["count"] == 3
    assert len(read_sightings(folder / "s.parquet", ("H0", "H1"))[0]) == 3
    left = {line.split(": ", 1)[0]: line.split(": ", 1)[1] for line in found["left_out"]}
    assert left["p3.png"].startswith("no spot")
    assert left["p4.png"] == "the plant has no heliostat H9"
    assert left["p5.png"].startswith("no metadata")
    assert "p6.png" in left


def _without_pose(folder: Path) -> None:
    camera = replace(CAMERA, position=None, R_enu_camera=None)
    plant = read_plant(folder / "plant.toml")
    write_plant(replace(plant, cameras=(camera,)), folder / "plant.toml")


def test_the_orientation_is_taken_on_trust_without_a_pose(folder: Path, call: Any) -> None:
    words = (folder / "photographs", "--plant", folder / "plant.toml", "--no-pictures")
    says = "the orientation of the frames cannot be checked"
    assert says not in call(*words)[1]
    assert json.loads(call(*words, "--json")[1])["notes"] == []
    _without_pose(folder)
    code, out, err = call(*words)
    assert code == 0, err
    assert out.count(says) == 1
    (note,) = json.loads(call(*words, "--json")[1])["notes"]
    assert note.startswith(f"{says}: the marks of target look the same turned or mirrored, and no")
    code, _, err = call(*words, "--live", "--limit", 2)
    assert code == 0
    assert err.count(says) == 1


def test_photographs_without_any_target_are_refused(folder: Path, call: Any) -> None:
    dark = replace(_photograph((0.5, 0.3), 1).frame, pixels=np.zeros((600, 800), np.uint8))
    write_image(dark, folder / "photographs" / "dark.png")
    words = ("--plant", folder / "plant.toml", "--no-pictures")
    code, _, err = call(folder / "photographs" / "dark.png", *words)
    assert code == 2
    assert err == "heliotrope: no target was found in 1 photograph: none could be read\n"
    assert call(folder / "photographs", *words)[0] == 0


def test_pictures_of_another_kind_in_a_folder_are_named(folder: Path, call: Any) -> None:
    frames = [Image.new("L", (800, 600), value) for value in (10, 200)]
    file = folder / "photographs" / "anim.gif"
    frames[0].save(file, save_all=True, append_images=frames[1:])
    words = ("--plant", folder / "plant.toml", "--no-pictures")
    code, out, err = call(folder / "photographs", *words)
    assert code == 0, err
    assert f"left out: {file}: this is a GIF file; convert it to a PNG" in out
    code, out, _ = call(folder / "photographs", *words, "--json")
    found = json.loads(out)
    assert len(found["images"]) == 3
    assert found["unreadable"] == []
    assert found["left_out"][0].startswith(f"{file}: this is a GIF")
    # Given by name, it is an error.
    assert call(file, *words)[0] == 2


def test_processes_change_nothing(folder: Path, call: Any) -> None:
    files = [folder / "photographs" / f"p{k % 3}.png" for k in range(8)]
    plant = ("--plant", folder / "plant.toml", "--no-pictures", "--json")
    documents = [json.loads(call(*files, *plant, "--processes", n)[1]) for n in (1, 2)]
    assert documents[0] == documents[1]
    assert len(documents[0]["images"]) == 8


def test_dask_changes_nothing(folder: Path, call: Any) -> None:
    pytest.importorskip("distributed")
    files = sorted((folder / "photographs").glob("*.png"))
    plant = ("--plant", folder / "plant.toml", "--no-pictures", "--json")
    here = json.loads(call(*files, *plant)[1])
    there = json.loads(call(*files, *plant, "--scheduler", "local:1")[1])
    for a, b in zip(here["images"], there["images"], strict=True):
        assert {**a, "file": ""} == {**b, "file": ""}


def test_an_empty_frame_serves_as_background(folder: Path, call: Any) -> None:
    write_image(_photograph((0.0, 0.0), 8, beams=0).frame, folder / "empty.png")
    code, out, err = call(
        folder / "photographs" / "p0.png",
        "--plant",
        folder / "plant.toml",
        "--json",
        "--empty",
        folder / "empty.png",
        "--no-pictures",
    )
    assert code == 0, err
    spot = json.loads(out)["images"][0]["targets"][0]["spots"][0]
    truth = np.array(json.loads((folder / "truth.json").read_text())[0])
    place = np.array([spot[f"{axis}_m"] for axis in ("east", "north", "up")])
    assert np.linalg.norm(place - truth) < 0.03


def test_a_log_names_the_empty_frame_of_each_photograph(folder: Path, call: Any) -> None:
    write_image(_photograph((0.0, 0.0), 8, beams=0).frame, folder / "empty.png")
    log = folder / "log.csv"
    lines = log.read_text().splitlines()
    log.write_text("\n".join([lines[0] + ",empty", *(f"{each},empty.png" for each in lines[1:])]))
    both = []
    for given in (["--log", log], ["--empty", folder / "empty.png"]):
        code, out, err = call(
            folder / "photographs" / "p0.png",
            "--plant",
            folder / "plant.toml",
            "--json",
            "--no-pictures",
            *given,
        )
        assert code == 0, err
        both.append(json.loads(out)["images"][0]["targets"][0]["spots"][0])
    assert both[0] == both[1]
    log.write_text(log.read_text().replace("empty.png", "missing.png"))
    code, _, err = call(
        folder / "photographs" / "p0.png",
        "--plant",
        folder / "plant.toml",
        "--log",
        log,
    )
    assert code == 2
    assert "missing.png: no such file" in err


def test_empty_targets_are_learnt_and_used(folder: Path, call: Any) -> None:
    for k in range(4):
        write_image(_photograph((0.0, 0.0), 80 + k, beams=0).frame, folder / f"e{k}.png")
    (folder / "before").mkdir()
    for k in range(4):
        (folder / f"e{k}.png").rename(folder / "before" / f"e{k}.png")
    plant, memory = folder / "plant.toml", folder / "memory"
    photograph = folder / "photographs" / "p0.png"
    code, _, err = call(photograph, "--plant", plant, "--memory", memory)
    assert code == 2
    assert "no model of an empty target" in err
    code, _, err = call(
        folder / "before", "--plant", plant, "--live", "--limit", 4, "--memory", memory
    )
    assert code == 0, err
    assert len(list(memory.glob("*.npz"))) == 1
    code, out, err = call(
        photograph, "--plant", plant, "--memory", memory, "--json", "--no-pictures"
    )
    assert code == 0, err
    (reading,) = json.loads(out)["images"][0]["targets"]
    assert reading["good"], reading["reasons"]
    alone = json.loads(call(photograph, "--plant", plant, "--json", "--no-pictures")[1])
    assert alone["images"][0]["targets"][0]["spots"] != reading["spots"]


def test_a_tower_file_is_plant_enough(folder: Path, call: Any) -> None:
    tower = juelich() / "tower-measurements.json"
    image = juelich() / "images" / "target-camera" / "213508-raw.png"
    code, out, err = call(
        image,
        "--plant",
        tower,
        "--json",
        "--no-pictures",
        "--heliostat",
        "AB12",
        "--to-sightings",
        folder / "s.csv",
    )
    assert code == 0, err
    assert json.loads(out)["sightings"]["count"] == 1
    seen, _, _ = read_sightings(folder / "s.csv", ("AB12",))
    # The file beside the photograph gives motors and sun.
    assert seen.counts.tolist() == [[22170.0, 11616.0]]
    azimuth, elevation = np.radians([36.9225463959062, 57.351935820685455])
    sun = [
        np.cos(elevation) * np.sin(azimuth),
        -np.cos(elevation) * np.cos(azimuth),
        np.sin(elevation),
    ]
    assert seen.source[0] == pytest.approx(sun, abs=1e-12)


def test_crops_need_their_target(folder: Path, call: Any) -> None:
    rendered = _photograph((0.5, 0.3), 1).frame.pixels
    write_image(np.ascontiguousarray(rendered[100:500, 200:600]), folder / "crop.png")
    common = (folder / "crop.png", "--plant", folder / "plant.toml", "--no-pictures", "--crop")
    code, _, err = call(*common)
    assert code == 2
    assert "a crop shows one target; name it by --target (one of target)" in err
    assert call(*common, "--target", "target")[0] == 0


@pytest.mark.parametrize("record", ["log", "json"])
def test_two_targets_for_one_photograph_are_refused(record: str, folder: Path, call: Any) -> None:
    plant = read_plant(folder / "plant.toml")
    other = replace(
        TARGET,
        name="other",
        corners=TARGET.corners + [0.0, 0.0, 30.0],
        center=TARGET.center + [0.0, 0.0, 30.0],
    )
    write_plant(replace(plant, targets=(TARGET, other)), folder / "plant.toml")
    photograph = folder / "photographs" / "7-raw.png"
    (folder / "photographs" / "p0.png").rename(photograph)
    words = [photograph, "--plant", folder / "plant.toml", "--no-pictures", "--target", TARGET.name]
    if record == "log":
        text = (folder / "log.csv").read_text(encoding="utf-8")
        text = text.replace("p0.png", "7-raw.png").replace("Z,target,100", "Z,other,100")
        (folder / "two.csv").write_text(text, encoding="utf-8")
        words += ["--log", folder / "two.csv"]
    else:
        facts = {
            "motor_position": {"axis_1_motor_position": 1, "axis_2_motor_position": 2},
            "target_name": "other",
            "sun_elevation": 30.0,
            "sun_azimuth": 10.0,
            "focal_spot": {"UTIS": [50.9, 6.39, 130.0]},
        }
        file = folder / "photographs" / "7-calibration-properties.json"
        file.write_text(json.dumps(facts), encoding="utf-8")
    code, _, err = call(*words, "--heliostat", "H0", "--to-sightings", folder / "s.csv")
    assert code == 2
    assert "its record names target other, and --target target; specify only the correct one" in err
    assert not (folder / "s.csv").exists()


BAD: list[tuple[str, list[str], str]] = [
    ("absent.png", [], "no such file"),
    ("photographs/p0.png", ["--target", "tower"], "there is no target 'tower'"),
    ("photographs/p0.png", ["--camera", "left"], "there is no camera 'left'"),
    ("photographs/p0.png", ["--log", "absent.csv"], "no such file"),
    ("photographs/p0.png", ["--log", "bad.csv"], "there is no column heliostat; add it"),
    ("photographs/p0.png", ["--log", "naive.csv"], "line 2, column timestamp"),
    ("photographs/p0.png", ["--log", "text.csv"], "'x' is not a finite number"),
    ("nothing", [], "no image in this folder"),
]


@pytest.mark.parametrize(("file", "options", "text"), BAD)
def test_bad_input_is_one_line(
    folder: Path,
    call: Any,
    monkeypatch: pytest.MonkeyPatch,
    file: str,
    options: list[str],
    text: str,
) -> None:
    monkeypatch.chdir(folder)
    (folder / "nothing").mkdir()
    (folder / "bad.csv").write_text("file,axis_1_motor_position\np0.png,1\n")
    head = "file,heliostat,timestamp,axis_1_motor_position,axis_2_motor_position\n"
    (folder / "naive.csv").write_text(head + "p0.png,H0,2026-06-21T12:00:00,1,2\n")
    (folder / "text.csv").write_text(head + "p0.png,H0,2026-06-21T12:00:00Z,x,2\n")
    code, _, err = call(file, "--plant", "plant.toml", "--no-pictures", *options)
    assert code == 2
    assert text in err
    assert err.count("\n") == 1, err
    assert "Traceback" not in err


def test_plant_without_targets_is_refused(tmp_path: Path, call: Any) -> None:
    tower = {"power_plant_properties": {"coordinates": list(ORIGIN)}}
    (tmp_path / "tower-measurements.json").write_text(json.dumps(tower), encoding="utf-8")
    write_image(_photograph((0.5, 0.3), 1).frame, tmp_path / "a.png")
    code, _, err = call(tmp_path / "a.png", "--plant", tmp_path / "tower-measurements.json")
    assert code == 2
    assert "the plant has no targets" in err


def test_live_folder_is_read_and_kept(folder: Path, call: Any) -> None:
    code, out, err = call(
        folder / "photographs",
        "--plant",
        folder / "plant.toml",
        "--live",
        "--limit",
        3,
        "--keep",
        folder / "kept",
        "--json",
    )
    assert code == 0, err
    lines = [json.loads(line) for line in out.splitlines()]
    truth = json.loads((folder / "truth.json").read_text())
    assert len(lines) == 3
    for line, place in zip(lines, truth, strict=True):
        (reading,) = line["targets"]
        spot = reading["spots"][0]
        assert spot["east_m"] == pytest.approx(place[0], abs=0.03)
        # The frame is kept, with its result beside it.
        assert read_image(line["kept"]).size == (800, 600)
        beside = json.loads(Path(line["kept"]).with_suffix(".json").read_text())
        assert beside["result"]["targets"][0]["spots"][0]["east_m"] == spot["east_m"]


def test_a_burst_is_averaged(folder: Path, call: Any) -> None:
    for k in range(4):
        write_image(_photograph((0.5, 0.3), 40 + k).frame, folder / f"burst-{k}.png")
    (folder / "burst").mkdir()
    for k in range(4):
        (folder / f"burst-{k}.png").rename(folder / "burst" / f"{k}.png")
    code, out, err = call(
        folder / "burst",
        "--plant",
        folder / "plant.toml",
        "--live",
        "--limit",
        1,
        "--burst",
        4,
        "--json",
    )
    assert code == 0, err
    (line,) = [json.loads(text) for text in out.splitlines()]
    assert line["targets"][0]["good"]


@pytest.mark.parametrize(
    ("source", "text"),
    [
        (["nowhere"], "source nowhere: no such"),
        (["a", "b"], "--live follows a single source, but 2 were specified"),
        (["usb:97"], "no such device"),
        (["http://127.0.0.1:9/x"], "127.0.0.1:9"),
    ],
)
def test_live_sources_that_are_not_there(
    folder: Path, call: Any, source: list[str], text: str
) -> None:
    code, _, err = call(*source, "--plant", folder / "plant.toml", "--live", "--limit", 1)
    assert code == 2
    assert text in err
    assert err.strip().count("\n") == 0, err
