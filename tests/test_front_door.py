"""What a newcomer meets first."""

import os
import re
import subprocess
from importlib.metadata import version
from pathlib import Path

import pytest

from heliotrope import __version__

ROOT = Path(__file__).parents[1]


def test_readme_names_both_commands() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "make run" in text
    assert "make test" in text


@pytest.mark.parametrize(
    "target", ["setup", "run", "notebook", "test", "soak", "lint", "docs", "bench", "clean"]
)
def test_make_knows_its_targets(target: str) -> None:
    done = subprocess.run(
        ["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    shown = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert re.search(rf"^{target}\s", shown.stdout, re.MULTILINE)


def test_ci_runs_tests_before_linters() -> None:
    script = ROOT / ".ci" / "run"
    assert os.access(script, os.X_OK)
    calls = re.findall(r"^make (\w+)$", script.read_text(encoding="utf-8"), re.MULTILINE)
    assert calls == ["test", "lint", "docs"]


def test_changelog_has_the_version_below_what_is_unreleased() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert headings[0] == "Unreleased"
    assert re.fullmatch(rf"{re.escape(__version__)} \(\d{{4}}-\d\d-\d\d\)", headings[1])
    assert len(text.partition(f"## {headings[1]}")[2].partition("\n## ")[0].splitlines()) <= 80
    assert version("heliotrope") == __version__


def test_setup_refuses_an_old_python(tmp_path: Path) -> None:
    old = tmp_path / "python-old"
    old.write_text('#!/bin/sh\n[ "$1" = --version ] && echo "Python 3.9.2" && exit 0\nexit 1\n')
    old.chmod(0o755)
    done = subprocess.run(
        ["bash", "scripts/setup.sh"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHON": str(old), "VENV": str(tmp_path / "venv")},
    )
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "Python 3.9.2 is too old" in done.stderr
    assert not (tmp_path / "venv").exists()


def test_constraints_pin_all_direct_dependencies() -> None:
    import tomllib

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    pinned = {
        line.split("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    }
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    names = {re.split(r"[<>=!~\[;]", d)[0].lower() for group in groups for d in group}
    assert names - {"heliotrope"} <= pinned
