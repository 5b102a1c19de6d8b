"""A plant file edited as text: checked, compared, stored."""

from datetime import UTC, datetime
from pathlib import Path

import pytest

from heliotrope.errors import InputError
from heliotrope.field.formats import plant_edit
from heliotrope.field.formats.plant_file import json_schema
from heliotrope.field.formats.plant_help import plant_help
from heliotrope.field.formats.plant_text import (
    Difference,
    line_of,
    plant_text,
    store_text,
    try_text,
)
from support.small_plant import TABLE, TOML

NOON = datetime(2026, 3, 3, 12, tzinfo=UTC)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "field.csv").write_text(TABLE)
    (tmp_path / "plant.toml").write_text(TOML)
    return tmp_path / "plant.toml"


def line(text: str, start: str) -> int:
    """The only line that begins with a text."""
    (found,) = (n for n, row in enumerate(text.split("\n"), 1) if row.startswith(start))
    return found


@pytest.mark.parametrize(
    ("old", "new", "at", "told"),
    [
        ("width_m = 3", "width_m = -3", "width_m = -3", "-3: input should be greater than 0"),
        ("width_m = 3", "widht_m = 3", "widht_m", "did you mean 'width_m'?"),
        ("width_m = 3\n", "", "[[targets]]", "target target: specify corners_m, or"),
        ('kind = "disc"', 'kind = "disk"', 'kind = "disk"', "'disk': input should be"),
        ("mirror_width_m = 1.83", "mirror_width_m = 0", "mirror_width_m", "greater than 0"),
        ("[320.0, 240.0]", "[320.0, 240.0", "targets = [", "not valid TOML: "),
        ("[640, 480]", "[640]", "size_px", "at least 2 items"),
        ('"field.csv"', '"../field.csv"', "heliostats", "../field.csv is in another folder"),
        ('"field.csv"', '"/etc/passwd"', "heliostats", "/etc/passwd is in another folder"),
        ('["target"]', '["tarjet"]', "", "there is no target 'tarjet'"),
        ('"field.csv"', '"links.toml"', "", "links.toml: no such file"),
    ],
)
def test_an_error_is_told_at_its_line(file: Path, old: str, new: str, at: str, told: str) -> None:
    (file.parent / "links.toml").write_text('key = "secret"\n')
    before = sorted(path.name for path in file.parent.iterdir())
    text = TOML.replace(old, new, 1)
    found = try_text(file, text, TOML)
    assert found.error is not None
    assert told in found.error.text
    assert "secret" not in found.error.text
    assert "/tmp" not in found.error.text
    assert found.error.line == (line(text, at) if at else 0)
    # Nothing was written.
    assert sorted(path.name for path in file.parent.iterdir()) == before
    assert file.read_text() == TOML


def test_the_tables_that_differ_are_named(file: Path) -> None:
    text = TOML.replace("[1000.0, 1000.0]", "[1200.0, 1000.0]").replace('"receiver"', '"salt"')
    found = try_text(file, text.replace("18.87", "18.88"), TOML)
    assert found.error is None
    assert set(found.differs) == {
        Difference("cameras", "eye", "changed", ("focal_px",)),
        Difference("receivers", "receiver", "removed"),
        Difference("receivers", "salt", "new"),
        Difference("site", "", "changed", ("longitude_deg",)),
    }
    assert "-focal_px = [1000.0, 1000.0]" in found.difference
    assert "+focal_px = [1200.0, 1000.0]" in found.difference
    assert found.cameras[0].matrix[0, 0] == 1200.0
    # A comment changes no table, and the same text nothing at all.
    assert not try_text(file, TOML + "# checked\n", TOML).differs
    assert try_text(file, TOML, TOML).difference == ()


def test_a_warning_does_not_hinder(file: Path) -> None:
    found = try_text(file, TOML.replace("13.0,\n]", "-13.0,\n]"), TOML)
    assert found.error is None
    assert any("below every heliostat" in one.text for one in found.findings)


def test_a_text_is_stored_whole_and_the_old_one_kept(file: Path) -> None:
    text = TOML.replace("width_m = 3", "width_m = 4").replace("\n", "\r\n")
    kept = store_text(file, text, "stored by engineer (survey)", now=NOON)
    assert plant_text(file) == TOML.replace("width_m = 3", "width_m = 4")
    (version,) = plant_edit.versions(file)
    assert version.name == kept
    assert "stored by engineer (survey)" in version.note
    plant_edit.restore(file, kept, now=NOON)
    assert file.read_text() == TOML
    assert (file.parent / "field.csv").read_text() == TABLE


def test_what_cannot_be_kept_is_not_replaced(file: Path) -> None:
    (file.parent / "plant.versions").write_text("in the way")
    with pytest.raises((OSError, InputError)):
        store_text(file, TOML.replace("width_m = 3", "width_m = 4"), "", now=NOON)
    assert file.read_text() == TOML


def test_a_place_is_found_in_nested_tables() -> None:
    text = '[a]\nx = 1\n[[b]]\nx = 1\n[[b.c]]\n[[b]]\n"y z" = 2\n[[b.c]]\n[[b.c]]\nx = [\n 1,\n]\n'
    assert line_of(text, "b[1].c[1].x") == 10
    assert line_of(text, "b.1.c.0.x") == 8
    assert line_of(text, "b[1].y z") == 7
    assert line_of(text, "b[0].c[0]") == 5
    assert line_of(text, "a.x.3") == 2
    assert line_of(text, "d") == 0


def test_the_help_has_every_key_of_the_schema() -> None:
    tables = {table.table: {key.key: key for key in table.keys} for table in plant_help()}
    assert set(tables[""]) == set(json_schema()["properties"])
    assert tables["cameras"]["focal_px"].needed
    assert tables["cameras"]["focal_px"].kind == "2 × number > 0"
    assert tables["site"]["latitude_deg"].kind == "number ≥ -90, ≤ 90"
    assert "box | sphere" in tables["keep_out"]["kind"].kind
    assert {"targets.marks", "groups.*", "groups.*.machine.axes.*"} <= set(tables)
