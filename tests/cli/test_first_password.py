"""The first account's password: on a terminal, or in a file that only its owner may read."""

import sys
from pathlib import Path

import pytest

from heliotrope.cli.run._shared import FIRST_FILE, first_password


class _Terminal:
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", _Terminal())
    assert "open sesame" in first_password("open sesame", tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_log_does_not_have_it(tmp_path: Path) -> None:
    file = tmp_path / FIRST_FILE
    file.write_text("of a store before")
    file.chmod(0o644)
    said = first_password("open sesame", tmp_path)
    assert "open sesame" not in said
    assert str(file) in said
    assert file.read_text() == "open sesame\n"
    assert file.stat().st_mode & 0o777 == 0o600
