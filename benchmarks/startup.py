"""How long a person waits for the command line, beside an empty Python."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks._run import best

BUDGET_S = 0.4


def run(quick: bool) -> dict[str, Any]:
    """Return the figures."""
    command = Path(sys.executable).with_name("heliotrope")

    def call(*arguments: str) -> None:
        subprocess.run(arguments, check=True, capture_output=True)

    times = best(
        {
            "python -c pass": lambda: call(sys.executable, "-c", "pass"),
            "import heliotrope": lambda: call(sys.executable, "-c", "import heliotrope"),
            "heliotrope --help": lambda: call(str(command), "--help"),
            "heliotrope track --help": lambda: call(str(command), "track", "--help"),
        },
        2 if quick else 15,
    )
    empty = times["python -c pass"]["median_s"]
    rows = [
        {"command": n, "median_s": t["median_s"], "ratio_to_empty": t["median_s"] / empty}
        for n, t in times.items()
    ]
    return {"rows": rows, "budget_s": BUDGET_S,
            "within_budget": times["heliotrope --help"]["median_s"] <= BUDGET_S}  # fmt: skip
