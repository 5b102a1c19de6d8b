"""Every step of a calibration as CSV."""

import csv
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.record import HeliostatCalibration, Provenance
from heliotrope.calibration.sighting_table import read_sightings
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.store.export import export, folder_name
from heliotrope.store.keeper import Keeper

NAMES = ("A/1", "B", "C")


def read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture
def exported(keeper: Keeper, seen: Sightings, tmp_path: Path) -> Path:
    numbers = keeper.record_sightings(NAMES, seen, kind="")
    mine = numbers[seen.heliostat == 0]
    for k in (1, 2):
        keeper.record_calibration(
            HeliostatCalibration(
                "A/1",
                1.8e9 + k,
                ("tilt_north", "azimuth_bias"),
                np.array([1 / 3, -2e-3]) / k,
                np.array([[4e-8, 1e-8], [1e-8, 1e-8]]),
                np.array([0.01, 0.02]),
                0.015,
                3e-4,
                1.2,
                FitOutcome.CONVERGED,
                mine[: k + 1],
                np.zeros(0, np.int64),
                np.full((k + 1, 2), [3e-3, 4e-3]),
                np.full((k + 1, 2), 1e-5 / k),
                "two",
                Provenance.CAMERA,
                "anna",
                "spring",
                "a, note",
                ("AXES",),
                version=k,
            )
        )
    keeper.writer.confirmed().result(10.0)
    told: list[tuple[int, int]] = []
    written = export(keeper.database, tmp_path / "out", progress=lambda *n: told.append(n))
    assert written == ["A/1", "B", "C"]
    assert told == [(1, 3), (2, 3), (3, 3)]
    return tmp_path / "out"


def test_sightings_can_be_read_again(exported: Path, seen: Sightings) -> None:
    found, _, left_out = read_sightings(exported / "A%2F1" / "sightings.csv", NAMES)
    assert left_out == []
    wanted = seen.of(0)
    np.testing.assert_array_equal(found.counts, wanted.counts)
    np.testing.assert_array_equal(found.destination, wanted.destination)
    np.testing.assert_array_equal(found.destination_covariance, wanted.destination_covariance)
    np.testing.assert_array_equal(found.time, wanted.time)


def test_residuals_say_what_each_sighting_missed_by(exported: Path) -> None:
    found = read(exported / "A%2F1" / "residuals.csv")
    assert [r["version"] for r in found] == ["1", "1", "2"], "those that are new"
    sightings = read(exported / "A%2F1" / "sightings.csv")
    for residual in found:
        assert sightings[int(residual["row"]) - 1]["time"] == residual["time"]
        assert float(residual["before_beam_rad"]) == pytest.approx(5e-3)
    assert float(found[-1]["after_right_rad"]) == 5e-6


def test_parameters_and_covariance(exported: Path) -> None:
    found = read(exported / "A%2F1" / "parameters.csv")
    assert [(r["version"], r["parameter"]) for r in found[:2]] == [
        ("1", "tilt_north"),
        ("1", "azimuth_bias"),
    ]
    assert float(found[0]["value"]) == 1 / 3
    assert float(found[0]["sigma"]) == pytest.approx(2e-4)
    pairs = read(exported / "A%2F1" / "covariance.csv")
    assert len(pairs) == 6
    assert (pairs[1]["parameter_1"], pairs[1]["parameter_2"]) == ("tilt_north", "azimuth_bias")
    assert float(pairs[1]["correlation"]) == pytest.approx(0.5)
    versions = read(exported / "A%2F1" / "versions.csv")
    assert [v["sightings"] for v in versions] == ["2", "3"]
    assert versions[0]["at"] == "2027-01-15T08:00:01Z"
    assert versions[0]["note"] == "a, note"


def test_heliostats_without_a_version(exported: Path) -> None:
    index = read(exported / "heliostats.csv")
    assert [(r["heliostat"], r["versions"]) for r in index] == [
        ("A/1", "2"),
        ("B", "0"),
        ("C", "0"),
    ]
    assert index[0]["beam_error_after_rad"] == "0.0003"
    assert read(exported / "B" / "parameters.csv") == []
    assert len(read(exported / "B" / "sightings.csv")) == 3


def test_only_some(keeper: Keeper, exported: Path, tmp_path: Path) -> None:
    assert export(keeper.database, tmp_path / "one", ["B", "B"]) == ["B"]
    with pytest.raises(UnknownNameError, match="no heliostat in the store 'X'; known: A/1, B, C"):
        export(keeper.database, tmp_path / "two", ["X"])
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="choose a folder to write to"):
        export(keeper.database, tmp_path / "file")


@pytest.mark.parametrize(
    ("name", "wanted"),
    [("AA39", "AA39"), ("..", "%2E%2E"), ("a/b", "a%2Fb"), ("Größe 2", "Gr%C3%B6%C3%9Fe 2")],
)
def test_names_that_a_file_system_takes(name: str, wanted: str) -> None:
    assert folder_name(name) == wanted
