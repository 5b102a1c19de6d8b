"""What a plant keeps is gone before its machine leaves service; nothing else is touched."""

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.store import purge as purging
from heliotrope.store.factors import KEY_FILE
from heliotrope.store.keeper import Keeper
from heliotrope.store.purge import purge
from heliotrope.store.records import StoreError


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    keeper = Keeper(folder, inline=True)
    keeper.people.add("anna", "hash", "engineer", 1.0)
    keeper.close()
    (folder / "store.before-0011.sqlite").write_bytes(b"hashes of an earlier program")
    (folder / KEY_FILE).write_text("secret")
    (folder / "first-password").write_text("secret")
    for name in ("telemetry/2026-06-21", "photographs", "targets", "marks"):
        (folder / name).mkdir(parents=True)
        (folder / name / "one").write_bytes(b"1" * 3_000_000)
    (folder / "notes of a person").write_text("kept")
    return folder


def test_everything_is_overwritten_and_removed(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, bytes] = {}
    overwrite = purging._overwrite

    def noted(path: Path, size: int) -> None:
        overwrite(path, size)
        seen[path.name] = path.read_bytes()

    monkeypatch.setattr(purging, "_overwrite", noted)
    count, left = purge(data)
    assert left == [data / "notes of a person"]
    assert count >= 9  # the lock, a store (and its log), its copy, two secrets and four others
    assert set(seen) >= {"store.sqlite", KEY_FILE, "first-password", "one"}
    assert seen["one"] == bytes(3_000_000)
    assert all(not any(text) for text in seen.values())


def test_links_are_removed_and_not_followed(data: Path, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "kept").write_text("kept")
    (data / "telemetry" / "link").symlink_to(other / "kept")
    (data / "photographs" / "folder").symlink_to(other)
    os.link(other / "kept", data / "targets" / "hard")
    purge(data)
    assert (other / "kept").read_text() == "kept"
    assert not (data / "telemetry").exists()


def test_not_under_a_plant_that_runs_and_not_without_one(data: Path, tmp_path: Path) -> None:
    keeper = Keeper(data, inline=True)
    with pytest.raises(StoreError, match="another process writes to it"):
        purge(data)
    keeper.close()
    with pytest.raises(StoreError, match="no store here"):
        purge(tmp_path)
    assert (data / "telemetry" / "2026-06-21" / "one").exists()


def test_it_asks_first(data: Path) -> None:
    run = CliRunner()
    asked = run.invoke(app, ["store", "purge", str(data)], input="n\n")
    assert asked.exit_code == 1
    assert (data / "store.sqlite").exists()
    done = run.invoke(app, ["store", "purge", str(data), "--yes"])
    assert done.exit_code == 0, done.exception
    assert "left in place, not created by a plant: notes of a person" in done.output
