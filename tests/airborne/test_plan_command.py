"""``heliotrope drone plan``: what it prints, writes and refuses."""

import json
from pathlib import Path

import pytest
import typer

from heliotrope.cli.drone.plan import plan
from heliotrope.errors import InputError
from heliotrope.field.example import example_plant
from heliotrope.field.formats.plant_file import write_plant
from support.waypoint_files import read_litchi, read_qgc, read_wpml


@pytest.fixture
def field(tmp_path: Path) -> Path:
    write_plant(example_plant(), tmp_path / "plant.toml")
    return tmp_path / "plant.toml"


def _run(*words: str) -> None:
    app = typer.Typer()
    app.command()(plan)
    app(list(words), standalone_mode=False)


def test_plan_of_the_example(
    field: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    into = tmp_path / "flight"
    _run(str(field), "--into", str(into), "--points", "10", "--pointing-mrad", "2", "--json")
    printed = json.loads(capsys.readouterr().out)
    assert printed["heliostats"] == 18
    assert printed["orientations"] == 180
    photos = 0
    for folder, read in (("dji", read_wpml), ("qgc", read_qgc), ("litchi", read_litchi)):
        files = sorted((into / folder).iterdir())
        assert len(files) == printed["sorties"]
        photos = sum(int(read(file).photo.sum()) for file in files)
        assert photos == printed["photographs"]
    assert printed["files"] == 3 + 3 * printed["sorties"]
    assert (into / "map.png").read_bytes().startswith(b"\x89PNG")
    held = json.loads((into / "plan.json").read_text())
    assert held["plant"] == "example"
    assert [k["name"] for k in held["airspace"]["keep_out"]] == ["receiver", "target"]


def test_table_and_airspace_file(
    field: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    air = tmp_path / "air.json"
    air.write_text('{"max_height_m": 100, "home": [0, -80, 0]}')
    into = tmp_path / "flight"
    _run(
        str(field),
        "--into",
        str(into),
        "--points",
        "10",
        "--airspace",
        str(air),
        "--no-tower",
        "--formats",
        "none",
        "--distance",
        "100",
        "--drones",
        "1",
    )
    shown = capsys.readouterr().out
    assert "camera and target, days" in shown
    assert "waypoints of" not in shown
    held = json.loads((into / "plan.json").read_text())
    assert held["airspace"]["max_height_m"] == 100.0
    assert held["airspace"]["keep_out"] == []
    assert held["sorties"][0]["home_m"] == [0.0, -80.0, 0.0]
    places = [p for s in held["sorties"] for v in s["visits"] for p in v["photographs_m"]]
    assert max(p[2] for p in places) <= 100.0


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--points", "8"], "has 8 unknowns; use 9 points or more"),
        (["--formats", "kml"], "--formats 'kml': choose from dji,qgc,litchi, or none"),
        (["--aircraft", "M4"], "there is no aircraft 'M4'"),
        (
            ["--elevations", "20"],
            "--elevations '20': use two angles from 0 to 90 degrees, such as 35,80",
        ),
        (["--home", "1,2"], "--home '1,2': write three numbers"),
        (["--model", "malan"], "there is no model 'malan'"),
        (["--endurance", "10"], "duration '10': write it as"),
        (["--max-height", "10"], "heights 15 m to 10 m"),
        (["--airspace", "none.json"], "none.json: no such file"),
        (["--distance", "400", "--elevations", "60,80"], "allow no position at 400 m"),
    ],
)
def test_refusals(field: Path, tmp_path: Path, words: list[str], text: str) -> None:
    into = tmp_path / "flight"
    with pytest.raises(InputError, match=text):
        _run(str(field), "--into", str(into), *words)
    assert not into.exists()
