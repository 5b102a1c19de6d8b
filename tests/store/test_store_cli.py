"""``heliotrope store``: a thin shell, and one line for bad input."""

import json
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from heliotrope.calibration.sightings import Sightings
from heliotrope.cli._noted import note_use
from heliotrope.cli._store import app
from heliotrope.local import name_here
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


def test_what_people_do_with_the_records_is_recorded(data: Path, tmp_path: Path) -> None:
    run("backup", data, "--to", tmp_path / "b")
    run("export", data, "--to", tmp_path / "csv", "--heliostat", "A")
    run("query", data, "SELECT heliostat\n FROM telemetry")
    run("restore", tmp_path / "b", tmp_path / "new", "--unsigned")
    me = name_here(os.geteuid())
    with closing(Keeper(data, inline=True)) as keeper:
        assert [(e.source, e.text) for e in reversed(keeper.events())] == [
            ("security", f"{me}: made a backup: {tmp_path / 'b'}"),
            ("security", f"{me}: exported calibrations: 1 heliostat to {tmp_path / 'csv'}"),
            ("security", f"{me}: queried the telemetry: SELECT heliostat FROM telemetry"),
        ]
    with closing(Keeper(tmp_path / "new", inline=True)) as keeper:
        assert keeper.events()[0].text.startswith(f"{me}: restored the backup of ")


def test_a_use_that_cannot_be_recorded_is_reported(
    data: Path, tmp_path: Path, opened: Callable[..., Keeper], capsys: pytest.CaptureFixture[str]
) -> None:
    """A plant that holds its store does not answer; the backup is made all the same."""
    opened(data)
    note_use(str(data), "BACKED_UP", str(tmp_path))
    assert "not recorded in the store: store" in capsys.readouterr().err
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("HELIOTROPE_PLANT", raising=False)
        note_use("postgresql://nobody@127.0.0.1:1/none", "BACKED_UP", str(tmp_path))
    assert "not recorded in the store" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["info", "migrate"])
def test_a_store_that_is_not_there(tmp_path: Path, command: str) -> None:
    done = run(command, tmp_path / "none")
    assert "no store here" in str(done.exception)
    assert not (tmp_path / "none").exists()
