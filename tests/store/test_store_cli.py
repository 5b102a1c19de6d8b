"""``heliotrope store``: a thin shell, and one line for bad input."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from heliotrope.calibration.sightings import Sightings
from heliotrope.cli._store import app
from heliotrope.store.database import HEAD
from heliotrope.store.keeper import Keeper
from heliotrope.store.telemetry import Look, Telemetry


def run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(w) for w in words])


@pytest.fixture
def data(tmp_path: Path, opened: Callable[..., Keeper], seen: Sightings) -> Path:
    folder = tmp_path / "data"
    keeper = opened(folder)
    keeper.record_sightings(("A", "B", "C"), seen)
    keeper.close()
    made = Telemetry(folder / "telemetry", ("A", "B", "C"), ("STOWED",), inline=True)
    zeros = np.zeros(3, np.uint8)
    made.take(1.8e9, Look(zeros, zeros, zeros.astype(np.uint16), np.zeros((3, 2), np.int32), zeros))
    made.close()
    return folder


def test_info(data: Path) -> None:
    done = run("info", data, "--json")
    found = json.loads(done.stdout)
    assert (found["rows"]["sighting"], found["revision"]) == (10, HEAD)
    assert found["first_sighting"].startswith("2027-01-1")
    assert "sighting" in run("info", data).stdout


def test_backup_and_restore(data: Path, tmp_path: Path) -> None:
    done = run("backup", data, "--to", tmp_path / "b")
    assert done.exit_code == 0
    assert "made" in done.stdout
    done = run("restore", tmp_path / "b", tmp_path / "new", "--unsigned", "--json")
    assert json.loads(done.stdout)["revision"] == HEAD
    assert json.loads(run("info", tmp_path / "new", "--json").stdout)["rows"]["sighting"] == 10
    found = run("query", tmp_path / "new", "SELECT count(*) AS n FROM telemetry", "--json")
    assert json.loads(found.stdout) == [{"n": 3}]
    assert run("backup", data, "--to", tmp_path / "c", "--without-telemetry").exit_code == 0
    assert not (tmp_path / "c" / "telemetry").exists()


def test_export_migrate_and_query(data: Path, tmp_path: Path) -> None:
    done = run("export", data, "--to", tmp_path / "csv", "--heliostat", "A", "--heliostat", "C")
    assert "2 heliostats" in done.stdout
    assert (tmp_path / "csv" / "C" / "sightings.csv").exists()
    assert "up to date" in run("migrate", data).stdout
    done = run("query", data, "SELECT heliostat, state FROM telemetry ORDER BY 1")
    assert done.stdout.split()[-6:] == ["A", "STOWED", "B", "STOWED", "C", "STOWED"]


@pytest.mark.parametrize("command", ["info", "migrate"])
def test_a_store_that_is_not_there(tmp_path: Path, command: str) -> None:
    done = run(command, tmp_path / "none")
    assert "no store here" in str(done.exception)
    assert not (tmp_path / "none").exists()
