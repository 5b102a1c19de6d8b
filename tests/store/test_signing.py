"""Signed backups: what the key has not signed is not restored."""

import json
import stat
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from typer.testing import CliRunner

from heliotrope.cli import app
from heliotrope.errors import FormatError, InputError
from heliotrope.store import backup as backups
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Event
from heliotrope.store.signing import PublicKey, SigningKey, make_key

NOW = datetime(2026, 6, 21, tzinfo=UTC)


@pytest.fixture
def key(tmp_path: Path) -> Path:
    (tmp_path / "data").mkdir()
    make_key(tmp_path / "data" / "sign.key")
    return tmp_path / "data" / "sign.key"


@pytest.fixture
def made(tmp_path: Path, key: Path) -> Path:
    """A signed backup with telemetry; the key lies in the data folder."""
    keeper = Keeper(tmp_path / "data", inline=True)
    keeper.record_event(Event(1.0, "test", "kept"))
    day = tmp_path / "data" / "telemetry" / "2026-06-21"
    day.mkdir(parents=True)
    (day / "10.parquet").write_bytes(b"telemetry")
    backups.backup(
        keeper.database,
        tmp_path / "backup",
        NOW,
        tmp_path / "data" / "telemetry",
        key=SigningKey(key),
    )
    keeper.close()
    return tmp_path / "backup"


def public(key: Path) -> PublicKey:
    return PublicKey(key.with_name("sign.key.pub"))


def resum(folder: Path) -> None:
    """Make the manifest anew, as somebody without the key can."""
    path = folder / backups.MANIFEST
    manifest = json.loads(path.read_text())
    manifest["files"] = {n: backups.checksum(folder / n) for n in manifest["files"]}
    path.write_text(json.dumps(manifest, indent=1))


def test_a_signed_backup_is_restored_and_has_no_key_in_it(
    made: Path, key: Path, tmp_path: Path
) -> None:
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    found = backups.restore(made, tmp_path / "new", NOW, tmp_path / "old", signed_by=public(key))
    assert found.made == NOW.isoformat()
    assert (tmp_path / "old" / "2026-06-21" / "10.parquet").read_bytes() == b"telemetry"
    secret = key.read_bytes().splitlines()[1]
    files = [path for path in made.rglob("*") if path.is_file()]
    assert len(files) == 4
    assert not any(secret in path.read_bytes() for path in files)


def alter(made: Path) -> None:
    (made / "telemetry" / "2026-06-21" / "10.parquet").write_bytes(b"other")
    resum(made)


def leave_out(made: Path) -> None:
    (made / backups.SIGNATURE).unlink()


def spoil(made: Path) -> None:
    (made / backups.SIGNATURE).write_bytes(b"AAAA\n")


def rename(made: Path) -> None:
    path = made / backups.MANIFEST
    path.write_text(path.read_text().replace("2026", "2027"))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (alter, "its signature was not made with the key"),
        (spoil, "its signature was not made with the key"),
        (rename, "its signature was not made with the key"),
        (leave_out, "it is not signed"),
    ],
)
def test_what_the_key_has_not_signed_is_refused(
    change: Callable[[Path], None], text: str, made: Path, key: Path, tmp_path: Path
) -> None:
    change(made)
    with pytest.raises(FormatError, match=text):
        backups.restore(made, tmp_path / "new", NOW, signed_by=public(key))
    assert not (tmp_path / "new").exists()


def test_another_key_is_refused(made: Path, tmp_path: Path) -> None:
    other = PublicKey(make_key(tmp_path / "other.key"))
    with pytest.raises(FormatError, match="its signature was not made with the key"):
        backups.restore(made, tmp_path / "new", NOW, signed_by=other)


def test_a_file_that_was_put_in_is_refused(made: Path, key: Path, tmp_path: Path) -> None:
    (made / "telemetry" / "2026-06-21" / "11.parquet").write_bytes(b"put in")
    with pytest.raises(FormatError, match="the manifest does not name it"):
        backups.restore(made, tmp_path / "new", NOW, tmp_path / "old", signed_by=public(key))


def test_keys_are_checked(key: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="already exists, and keys are never overwritten"):
        make_key(key)
    with pytest.raises(FormatError, match="not a public key"):
        PublicKey(key)
    empty = tmp_path / "x"
    empty.touch(0o600)
    with pytest.raises(FormatError, match="not a private key"):
        SigningKey(empty)
    key.chmod(0o640)
    with pytest.raises(FormatError, match="others may read it"):
        SigningKey(key)


def test_commands_sign_and_demand_a_key_or_the_word(tmp_path: Path) -> None:
    Keeper(tmp_path / "data", inline=True).close()

    def run(*words: object) -> tuple[int, str]:
        found = CliRunner().invoke(app, ["store", *map(str, words)])
        return found.exit_code, found.output + str(found.exception or "")

    key, backup, plain = tmp_path / "k", tmp_path / "b", tmp_path / "plain"
    code, said = run("key", key)
    assert code == 0
    assert "k.pub" in said
    assert run("backup", tmp_path / "data", "--to", backup, "--sign", key)[0] == 0
    assert run("backup", tmp_path / "data", "--to", plain)[0] == 0
    code, said = run("restore", backup, tmp_path / "new")
    assert code != 0
    assert "use --key FILE.pub, or --unsigned" in said
    assert run("restore", backup, tmp_path / "new", "--key", tmp_path / "k.pub")[0] == 0
    code, said = run("restore", plain, tmp_path / "two", "--key", tmp_path / "k.pub")
    assert "it is not signed" in said
    assert run("restore", plain, tmp_path / "two", "--unsigned")[0] == 0
