"""The house rules that `make house` prints, and the pages that are drawn from the code."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def house(*options: str) -> subprocess.CompletedProcess[str]:
    """Run `scripts/house.py`."""
    return subprocess.run(
        [sys.executable, str(ROOT / "scripts" / "house.py"), *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def test_the_house_is_in_order() -> None:
    done = house("--check", "--verbose")
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_picture_of_the_floors_is_that_of_the_code(tmp_path: Path) -> None:
    assert house("--draw", str(tmp_path / "floors.svg")).returncode == 0
    kept = ROOT / "docs" / "images" / "floors.svg"
    assert (tmp_path / "floors.svg").read_text() == kept.read_text(), (
        "python scripts/house.py --draw docs/images/floors.svg"
    )
