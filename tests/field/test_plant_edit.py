"""Changes of a plant file by name, and its stored versions."""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.formats import plant_edit
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.plant import Plant
from support.small_plant import TABLE, TOML

NOON = datetime(2026, 3, 3, 12, tzinfo=UTC)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "field.csv").write_text(TABLE)
    (tmp_path / "plant.toml").write_text(TOML)
    return tmp_path / "plant.toml"


def _parameter(plant: Plant, name: str, heliostat: str) -> float:
    group, row = plant.find(heliostat)
    return float(group.parameters[name][row])


def test_a_position_and_parameters_change_and_all_other_cells_stay(file: Path) -> None:
    given = {"east_m": "0.25", "tilt_north_mrad": "-1.5", "tilt_east_rad": "0.003"}
    edited = plant_edit.edit(file, "A1", given, note="survey", now=NOON)
    plant = read_plant(file)
    assert plant.position[0].tolist() == [0.25, -30.0, 0.0]
    assert _parameter(plant, "tilt_north", "A1") == pytest.approx(-0.0015, abs=1e-15)
    assert _parameter(plant, "tilt_east", "A1") == pytest.approx(0.003, abs=1e-15)
    # The group's other heliostat has the nominal value in the new column.
    assert _parameter(plant, "tilt_east", "A2") == 0.0
    assert _parameter(plant, "tilt_north", "A2") == -0.001
    assert (
        file.with_name("field.csv").read_text().splitlines()[2] == "A2,azel,10,-30.00,0,-0.001,0.0"
    )
    assert file.read_text() == TOML
    shown = {c.name: (c.old, c.new, c.unit) for c in edited.changes}
    assert shown["east_m"] == ("0", "0.25", "m")
    assert shown["parameters.tilt_east_rad"] == ("", "0.003", "rad")


def test_a_stored_version_is_a_plant_file_and_comes_back(file: Path) -> None:
    edited = plant_edit.edit(file, "A1", {"up_m": "0.4"}, note="survey of March", now=NOON)
    assert edited.version == "2026-03-03T120000Z"
    (kept,) = plant_edit.versions(file)
    assert kept.name == edited.version
    assert "A1: up_m 0 -> 0.4 (survey of March)" in kept.note
    stored = file.with_name("plant.versions") / kept.name / "plant.toml"
    assert read_plant(stored).position[0, 2] == 0.0
    again = plant_edit.restore(file, kept.name, now=NOON)
    assert file.with_name("field.csv").read_text() == TABLE
    assert again == "2026-03-03T120000Z-2"
    assert read_plant(stored.parents[1] / again / "plant.toml").position[0, 2] == 0.4


def test_a_version_comes_back_when_the_present_file_is_broken(file: Path) -> None:
    kept = plant_edit.edit(file, "A1", {"up_m": "0.4"}, now=NOON).version
    file.write_text("no plant at all")
    again = plant_edit.restore(file, kept, now=NOON)
    assert read_plant(file).position[0, 2] == 0.0
    assert (
        file.with_name("plant.versions") / again / "plant.toml"
    ).read_text() == "no plant at all"


def test_a_target_turns_and_moves_with_its_marks(file: Path) -> None:
    given = {"facing_deg": "90", "center_m": "1,2,14"}
    edited = plant_edit.edit(file, "target", given, now=NOON)
    target = read_plant(file).target("target")
    assert target.normal == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    # One metre to the left, as seen from the front, before and after.
    assert target.plane_coordinates(target.marks[0].point) == pytest.approx([-1.0, 0.0], abs=1e-9)
    assert target.center.tolist() == [1.0, 2.0, 14.0]
    assert "# east" in file.read_text()
    assert any("rename it too" in text for text in edited.warnings)


def test_a_target_leans_and_keeps_its_size(file: Path) -> None:
    plant_edit.edit(file, "target", {"tilt_deg": "-10"}, now=NOON)
    target = read_plant(file).target("target")
    lean = np.radians(-10.0)
    assert target.normal == pytest.approx([0.0, -np.cos(lean), np.sin(lean)], abs=1e-8)
    assert (target.width, target.height) == pytest.approx((3.0, 2.0), abs=1e-8)
    assert target.plane_coordinates(target.marks[0].point) == pytest.approx([-1.0, 0.0], abs=1e-8)
    # And back, from the corners that it has now.
    plant_edit.edit(file, "target", {"tilt_deg": "0", "facing_deg": "180"}, now=NOON)
    assert read_plant(file).target("target").normal == pytest.approx([0.0, -1.0, 0.0], abs=1e-8)


def test_a_receiver_turns_and_a_renamed_target_stays_with_its_camera(file: Path) -> None:
    plant_edit.edit(file, "receiver", {"tilt_deg": "-20"}, now=NOON)
    lean = np.radians(-20.0)
    normal = read_plant(file).receivers[0].normal
    assert normal == pytest.approx([0.0, -np.cos(lean), np.sin(lean)], abs=1e-8)
    edited = plant_edit.edit(file, "target", {"name": "target-2", "center_m": "0,0,14"}, now=NOON)
    plant = read_plant(file)
    assert [t.name for t in plant.targets] == ["target-2"]
    assert plant.cameras[0].targets == ("target-2",)
    assert not any("rename" in text for text in edited.warnings)


@pytest.mark.parametrize(
    ("who", "given", "text"),
    [
        ("A1", {"east_m": "90000"}, "outside -50000 to 50000 m"),
        ("A1", {"cluster": ""}, "the values are already in use"),
        ("A1", {"group": "azal"}, "group 'azal' is not in plant.toml"),
        ("A1", {"east_m": "ten"}, "enter a number"),
        ("target", {"center_m": "1,2"}, "three numbers in metres"),
        ("target", {"tilt_deg": "90"}, "between -90° and 90°"),
        ("target", {"width_m": "-3"}, "greater than 0"),
    ],
)
def test_what_the_check_would_refuse_is_not_written(
    file: Path, who: str, given: dict[str, str], text: str
) -> None:
    with pytest.raises(InputError, match=text) as caught:
        plant_edit.edit(file, who, given, now=NOON)
    assert ".plant-" not in str(caught.value)
    assert (file.read_text(), file.with_name("field.csv").read_text()) == (TOML, TABLE)
    assert sorted(p.name for p in file.parent.iterdir()) == ["field.csv", "plant.toml"]


def test_unknown_names_are_refused(file: Path) -> None:
    with pytest.raises(UnknownNameError, match="did you mean target"):
        plant_edit.edit(file, "targt", {"center_m": "0,0,1"})
    with pytest.raises(UnknownNameError, match="value of heliostat A1 'tilt_nort_mrad'"):
        plant_edit.edit(file, "A1", {"tilt_nort_mrad": "1"})
    with pytest.raises(UnknownNameError, match="value of target 'tilt_mrad'"):
        plant_edit.edit(file, "target", {"tilt_mrad": "1"})
    with pytest.raises(UnknownNameError, match="stored version '2020'"):
        plant_edit.restore(file, "2020")


def test_a_value_in_another_unit_gets_a_warning(file: Path) -> None:
    edited = plant_edit.edit(file, "A1", {"tilt_north_rad": "-1.5"}, dry=True)
    assert any("check the unit" in text for text in edited.warnings)
    assert edited.version == ""
    assert file.with_name("field.csv").read_text() == TABLE


def test_a_parquet_table_changes_too(file: Path) -> None:
    write_plant(read_plant(file), file, "parquet")
    plant_edit.edit(file, "A2", {"north_m": "-31.5", "azimuth_bias_mrad": "2"}, now=NOON)
    plant = read_plant(file)
    assert plant.position[1].tolist() == [10.0, -31.5, 0.0]
    assert _parameter(plant, "azimuth_bias", "A1") == 0.0
    assert _parameter(plant, "azimuth_bias", "A2") == pytest.approx(0.002, abs=1e-15)


def test_the_command_shows_sets_lists_and_restores(file: Path) -> None:
    def run(*words: str) -> str:
        done = CliRunner().invoke(app, ["field", *words], catch_exceptions=False)
        assert done.exit_code == 0
        return done.output

    place = str(file)
    assert "facing_deg" in run("set", place, "target")
    assert "nothing was written" in run("set", place, "A1", "up_m=0.5", "--dry-run")
    assert "no stored versions" in run("versions", place)
    assert "until" not in run("set", place, "A1", "up_m=0.5")
    listed = run("versions", place)
    assert "A1: up_m 0 -> 0.5" in listed
    assert "restored" in run("restore", place, listed.split()[0])
    assert file.with_name("field.csv").read_text() == TABLE
