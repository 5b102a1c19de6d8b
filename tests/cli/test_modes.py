"""What a plant makes in its data folder belongs to its user alone."""

import os
import stat
from pathlib import Path

import pytest

from heliotrope.cli.run._shared import Shown, store
from heliotrope.store.database import tighten


def modes(folder: Path) -> dict[str, int]:
    """Modes of everything in a folder, and of itself."""
    paths = [folder, *folder.rglob("*")]
    return {str(path.relative_to(folder)): stat.S_IMODE(path.stat().st_mode) for path in paths}


@pytest.fixture
def open_mask() -> object:
    before = os.umask(0o022)
    yield
    os.umask(before)


def test_a_data_folder_is_private_although_started_by_hand(
    tmp_path: Path, open_mask: object
) -> None:
    data = tmp_path / "data"
    (data / "telemetry" / "2026-06-21").mkdir(parents=True)
    (data / "telemetry" / "2026-06-21" / "10.parquet").touch(0o644)
    (data / "notes.txt").touch(0o644)  # of a person
    with store(Shown(console=False, data=data)) as (_, folder):
        (folder / "targets").mkdir()
        (folder / "targets" / "T1.npz").touch()
        found = modes(folder)
    assert os.umask(0o022) == 0o022
    assert found.pop("notes.txt") == 0o644
    assert "store.sqlite" in found
    folders = {".", "telemetry", "telemetry/2026-06-21", "targets"}
    assert {name for name, mode in found.items() if mode == 0o700} == folders
    assert {mode for name, mode in found.items() if name not in folders} == {0o600}


def test_a_folder_that_is_shared_by_its_nature_is_left_alone(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    tighten(shared)
    assert stat.S_IMODE(shared.stat().st_mode) == 0o1777


def test_a_link_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    other = tmp_path / "other"
    other.touch(0o644)
    (tmp_path / "data" / "first-password").symlink_to(other)
    tighten(tmp_path / "data")
    assert stat.S_IMODE(other.stat().st_mode) == 0o644
