"""The benchmarks run and say on what; how long they take is nobody's business here."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMES = ("tracking", "calibration", "sun", "field", "startup")


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "benchmarks", *arguments],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_quick_run_gives_json(name: str) -> None:
    done = _run(name, "--json", "--quick")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["name"] == name
    assert result["rows"]
    assert {"cpu", "cores", "versions", "load_average", "date"} <= set(result["machine"])
    assert result["machine"]["versions"]["numpy"]


def test_names_and_unknown_name() -> None:
    assert _run().stdout.split() == list(NAMES)
    done = _run("flying")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "there is no 'flying'" in done.stderr
