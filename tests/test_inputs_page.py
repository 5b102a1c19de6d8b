"""Every test that the page of inputs names exists."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "explanation" / "inputs.md").read_text(encoding="utf-8")
ROWS = [
    line for line in PAGE.splitlines() if line.startswith("| ") and not line.startswith("| input |")
]


@pytest.mark.parametrize("row", ROWS, ids=[row.split("|")[1].strip()[:40] for row in ROWS])
def test_a_row_names_a_test(row: str) -> None:
    (file, name) = re.findall(r"`(tests/\w+/\w+\.py)(?:::(\w+))?` \|$", row)[0]
    text = (ROOT / file).read_text(encoding="utf-8")
    assert not name or f"def {name}(" in text
