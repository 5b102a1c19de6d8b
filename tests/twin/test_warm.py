"""What a simulated plant computes in its loop has been compiled before it begins."""

import subprocess
import sys
from pathlib import Path

#: A plant at work, in a process of its own: what others have compiled must not count.
PROGRAM = Path(__file__).parents[1] / "support" / "warm_plant.py"


def test_the_loop_of_a_simulated_plant_compiles_nothing() -> None:
    command = [sys.executable, str(PROGRAM)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300.0)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["calibrated and in an emergency", "compiled: none"]
