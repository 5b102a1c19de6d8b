"""The page of limits shows the numbers that the control code uses."""

import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "scripts" / "limits_page.py"))


def test_the_page_of_limits_is_current(script: dict[str, Any]) -> None:
    now = script["page"]().splitlines()
    then = script["PAGE"].read_text(encoding="utf-8").splitlines()
    changed = [line for line in now if line not in then]
    assert now == then, f"run python scripts/limits_page.py and read {changed}"


def test_a_changed_limit_shows_on_the_page(
    script: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("heliotrope.safety.proof.FLUX_LIMIT", 0.11)
    assert script["page"]() != script["PAGE"].read_text(encoding="utf-8")
