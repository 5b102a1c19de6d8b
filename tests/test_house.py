"""The house rules that `make house` prints."""

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
