"""Second approvals in the plant file: off unless asked for, written and read, limited."""

from dataclasses import replace
from pathlib import Path

import pytest

from heliotrope.errors import FormatError
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.formats.plant_file import read_plant, write_plant
from heliotrope.field.layouts import malan_plant

ASKED = ApprovalSettings(parameters=True, within=3600.0)


def test_no_change_needs_a_second_person_unless_the_file_says_so(tmp_path: Path) -> None:
    write_plant(malan_plant(6), tmp_path / "plant.toml")
    assert "approval" not in (tmp_path / "plant.toml").read_text()
    assert read_plant(tmp_path / "plant.toml").approval == ApprovalSettings()
    assert not ApprovalSettings().parameters


def test_the_table_is_written_and_read(tmp_path: Path) -> None:
    for settings in (ASKED, ApprovalSettings(parameters=True)):
        write_plant(replace(malan_plant(6), approval=settings), tmp_path / "plant.toml")
        assert read_plant(tmp_path / "plant.toml").approval == settings


@pytest.mark.parametrize(
    ("before", "after", "text"),
    [
        (
            "within_s = 3600.0",
            "within_s = 59",
            "within_s must be between 60 and 604800 (7 days), not 59",
        ),
        (
            "within_s = 3600.0",
            "within_s = 604801",
            "within_s must be between 60 and 604800 (7 days), not 604801",
        ),
        ("within_s = 3600.0", "within = 3600", "approval.within"),
        ("parameters = true", "parameter = true", "did you mean 'parameters'"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(
    before: str, after: str, text: str, tmp_path: Path
) -> None:
    path = tmp_path / "plant.toml"
    write_plant(replace(malan_plant(6), approval=ASKED), path)
    written = path.read_text(encoding="utf-8")
    assert written.count(before) == 1
    path.write_text(written.replace(before, after), encoding="utf-8")
    with pytest.raises(FormatError) as caught:
        read_plant(path)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)
