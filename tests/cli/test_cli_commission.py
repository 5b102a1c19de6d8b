"""``heliotrope commission`` on the screen, as JSON, and in files."""

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from heliotrope.cli import main
from heliotrope.field.coded_visits import ReceiverSettings
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.layouts import malan_plant

SPAN = ("--from", "2026-09-01T22:00Z", "--days", "0.5", "--every", "1h")


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("plant") / "plant.toml"
    write_plant(malan_plant(24), file)
    return file


def _call(arguments: list[str], capsys: Any, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setattr(sys, "argv", ["heliotrope", "commission", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    return str(capsys.readouterr().out)


def test_the_screen_shows_hours_and_the_limit(
    plant: Path, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, page, picture = (tmp_path / name for name in ("v.csv", "p.html", "c.svg"))
    files = ["--csv", str(table), "--page", str(page), "--picture", str(picture)]
    out = _call([str(plant), *SPAN, "--together", "4", *files], capsys, monkeypatch)
    assert "2026-09-02T06:00:00Z" in out
    assert "goal of 0.60 mrad" in out
    assert "limited by" in out
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["heliostat"] for row in rows} == set(malan_plant(24).names)
    assert {row["target"] for row in rows} == {"left", "right"}
    assert "goal of 0.60 mrad" in page.read_text(encoding="utf-8")
    assert picture.stat().st_size > 1000


def test_a_drone_first_leaves_no_first_visit(
    plant: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = [str(plant), *SPAN, "--target", "left", "--json"]
    without = json.loads(_call(given, capsys, monkeypatch))
    flown = json.loads(_call([*given, "--drone", "9"], capsys, monkeypatch))
    assert without["flight"] is None
    assert flown["flight"]["hours"] > 0.0
    assert without["curve"][0]["rms_mrad"] == pytest.approx(15.0)
    assert flown["curve"][0]["rms_mrad"] < 2.0
    assert without["visits"][0]["first"]
    assert not any(visit["first"] for visit in flown["visits"])
    assert {visit["target"] for visit in without["visits"]} == {"left"}


def test_the_receiver_is_one_more_place_where_the_plant_file_says_so(
    tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    visits = ReceiverSettings("camera-left", "receiver", least=4, power=0.01)
    file, table = tmp_path / "plant.toml", tmp_path / "visits.csv"
    write_plant(replace(malan_plant(24), receiver_visits=visits), file)
    given = [str(file), "--from", "2026-09-01T22:00Z", "--days", "0.5", "--together", "4"]
    out = _call([*given, "--csv", str(table)], capsys, monkeypatch)
    assert any(line.split()[1:2] == ["receiver"] for line in out.splitlines())
    with table.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {row["target"] for row in rows} == {"left", "receiver", "right"}


@pytest.mark.parametrize(
    ("option", "text"),
    [
        (["--goal-mrad", "0"], "--goal-mrad must be a number from 0.001 to 1,000"),
        (["--together", "0"], "--together must be a whole number from 1 to 1,000"),
        (["--together", "1", "--first", "8"], "joint visits are switched off; set --together to 2"),
        (["--target", "middle"], "middle"),
        (["--drone", "3"], "3 calibration points: the model malan8 has 8 unknowns"),
        (["--picture", "c.txt"], "the name ends in '.txt'"),
    ],
)
def test_bad_options_get_one_line(
    plant: Path, option: list[str], text: str, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["heliotrope", "commission", str(plant), *SPAN, *option])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    told = capsys.readouterr().err
    assert text in told
    assert len(told.strip().splitlines()) == 1
