"""Start-up time of the command line, beside an empty Python."""

import subprocess
import sys
from functools import partial
from pathlib import Path

from benchmarks._run import BenchmarkError, Result, timed

BUDGET_S = 0.4


def command() -> Path:
    """Return the installed command of this environment.

    Raises
    ------
    BenchmarkError
        If it is not installed.
    """
    path = Path(sys.executable).with_name("heliotrope")
    if not path.is_file():
        raise BenchmarkError("no command 'heliotrope' beside this Python; run `make setup`")
    return path


def run(quick: bool) -> Result:
    """Return the figures."""
    python, heliotrope = sys.executable, str(command())
    commands = {
        "python -c pass": (python, "-c", "pass"),
        "import heliotrope": (python, "-c", "import heliotrope"),
        "heliotrope --help": (heliotrope, "--help"),
        "heliotrope track --help": (heliotrope, "track", "--help"),
    }
    times = timed(
        {
            name: partial(subprocess.run, arguments, check=True, capture_output=True)
            for name, arguments in commands.items()
        },
        2 if quick else 15,
    )
    empty, median = times["python -c pass"].median, times["heliotrope --help"].median
    return Result(
        [
            {
                "command": name,
                "best_s": time.best,
                "median_s": time.median,
                "ratio_to_first": time.median / empty,
            }
            for name, time in times.items()
        ],
        f"heliotrope --help: {median:.2f} s; an empty Python: {empty:.3f} s",
        {"budget_median_s": BUDGET_S},
        None if quick else median <= BUDGET_S,
    )
