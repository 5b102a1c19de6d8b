"""``calibrate`` with faults of rows, mirrors and the clock crossed: each is named, none ends it."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from calibration.test_plausibility import KIND, NAMES, PLANT, changed, seen_of
from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.calibration.sightings import Sightings, join
from heliotrope.cli import main
from heliotrope.field.formats.plant_file import read_plant, write_plant


@pytest.fixture
def call(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run a command and return what it prints."""

    def run(*arguments: object) -> str:
        monkeypatch.setattr(sys, "argv", ["heliotrope", *map(str, arguments)])
        with pytest.raises(SystemExit) as leaving:
            main()
        captured = capsys.readouterr()
        assert leaving.value.code in (0, None), captured.err
        return str(captured.out)

    return run


def calibrated(call: Any, folder: Path, seen: Sightings, *more: str) -> str:
    write_plant(PLANT, folder / "plant.toml")
    write_sightings(folder / "s.csv", seen, NAMES, [KIND] * len(seen))
    words = ("--sightings", folder / "s.csv", "--report", folder / "out", "--model", "guo6")
    return str(call("calibrate", folder / "plant.toml", *words, "--fraction", "1", *more))


def test_faults_are_named_and_the_other_mirror_is_learnt(call: Any, tmp_path: Path) -> None:
    wrong = seen_of([3])
    wrong = replace(wrong, counts=wrong.counts * [-1.0, 1.0])
    good = seen_of([15])
    rows = changed(changed(good, 4, source=good.source[4] * [1, 1, -1]), 6, time=2.4e11)
    text = calibrated(call, tmp_path, join([wrong, rows, good.take([9, 9])]))
    assert f"{NAMES[3]}: the motor of azimuth seems reversed" in text
    assert "17 heliostats not learnt: parameters unchanged" in text
    assert "left out: 2 measurements, the first: line 42, heliostat P6A, a copy of another" in text
    left = (tmp_path / "out" / "left_out.txt").read_text(encoding="utf-8").splitlines()
    assert [line.split(", ", 2)[-1].split(":")[0] for line in left] == [
        "the sun is below the horizon",
        "column time",
        "a copy of another sighting",
        "a copy of another sighting",
    ]
    group = read_plant(tmp_path / "out" / "plant.toml").groups["azel"]
    changed_rows = np.flatnonzero(group.parameters["tilt_north"])
    assert list(changed_rows) == [15]


def test_a_wrong_clock_is_stated(call: Any, tmp_path: Path) -> None:
    found = json.loads(calibrated(call, tmp_path, seen_of([15], fast=3600.0), "--json"))
    assert found["clock"]["found"]
    assert abs(found["clock"]["error_s"] - 3600.0) < 4.0 * found["clock"]["sigma_s"]
    assert found["heliostats"]["P6A"]["outcome"] == "clock"
    assert found["remarks"][0].startswith("the clock may be wrong by 3")
