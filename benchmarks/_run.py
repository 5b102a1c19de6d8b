"""Shared by the benchmarks: timing, memory, the machine, and storage of results."""

import json
import os
import platform
import statistics
import subprocess
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PACKAGES = (
    "heliotrope",
    "numpy",
    "opencv-python-headless",
    "numba",
    "scipy",
    "pvlib",
    "pandas",
    "pyarrow",
)
#: A measurement is doubtful if other programs take more than this share of the cores.
BUSY = 0.1

Call = Callable[[], Any]
Row = dict[str, str | int | float | None]


class BenchmarkError(RuntimeError):
    """A benchmark cannot be run, or its contenders differ in their results."""


@dataclass(frozen=True)
class Result:
    """Result of a benchmark.

    Attributes
    ----------
    rows
        One row for each size and contender, all with the same keys; the keys name the units.
    headline
        The result in one line.
    figures
        Figures that hold for all rows.
    within_budget
        Whether the budget of the design is kept; None if it has no budget for these sizes.
    """

    rows: list[Row]
    headline: str
    figures: dict[str, float | int | str] = field(default_factory=dict)
    within_budget: bool | None = None


@dataclass(frozen=True)
class Times:
    """Least and median wall time, and least processor time of the process, in seconds."""

    best: float
    median: float
    processor: float


class Neighbours:
    """Measures how much of the processors other programs take from now on.

    The load average cannot tell them from the benchmark itself, and lags by a minute.
    """

    def __init__(self) -> None:
        self._start = self._now()

    @staticmethod
    def _now() -> tuple[float, float, float]:
        with Path("/proc/stat").open(encoding="ascii") as lines:
            user, nice, system, _, _, irq, softirq, steal = map(int, lines.readline().split()[1:9])
        busy = (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")
        return time.perf_counter(), busy, sum(os.times()[:4])

    def cores(self) -> float:
        """Return the number of cores that other programs have kept busy since then."""
        wall, busy, own = (b - a for a, b in zip(self._start, self._now(), strict=True))
        return max(0.0, busy - own) / wall if wall > 0.0 else 0.0


def _revision() -> str | None:
    """Return the commit of the tree, with a + if files differ from it; None outside git."""
    git = ("git", "-C", str(ROOT))
    try:
        commit = subprocess.run(
            [*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True
        ).stdout.strip()
        # The results are left out: `all` writes them while it runs.
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--", ":/", f":(exclude){RESULTS}"],
            capture_output=True,
            text=True,
            check=True,
        ).stdout
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + ("+" if changed else "")


def machine() -> dict[str, Any]:
    """Return the machine, the versions and the date of a measurement."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    models = [line.split(":", 1)[1].strip() for line in cpuinfo if line.startswith("model name")]
    return {
        "cpu": models[0] if models else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES},
        "commit": _revision(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "load_average": os.getloadavg()[0],
    }


def timed(contenders: dict[str, Call], repeats: int) -> dict[str, Times]:
    """Time contenders in turn, after a round to warm up, so that a disturbance affects all."""
    walls: dict[str, list[float]] = {name: [] for name in contenders}
    works: dict[str, list[float]] = {name: [] for name in contenders}
    for call in contenders.values():
        call()
    for _ in range(repeats):
        for name, call in contenders.items():
            wall, work = time.perf_counter(), time.process_time()
            call()
            walls[name].append(time.perf_counter() - wall)
            works[name].append(time.process_time() - work)
    return {
        name: Times(min(walls[name]), statistics.median(walls[name]), min(works[name]))
        for name in contenders
    }


def peak_bytes(call: Call) -> int:
    """Return the peak growth of the memory of Python and NumPy during a call, bytes."""
    tracemalloc.start()
    try:
        before = tracemalloc.get_traced_memory()[0]
        call()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()


def why_missing(variable: str, modules: tuple[str, ...]) -> str | None:
    """Return why a peer cannot take part, None if it can.

    Parameters
    ----------
    variable
        Environment variable that names the peer's interpreter.
    modules
        Modules that the interpreter must be able to import.
    """
    python = os.environ.get(variable)
    if not python:
        return f"not set: {variable}"
    try:
        asked = [python, "-c", f"import {', '.join(modules)}"]
        failed = subprocess.run(asked, capture_output=True, check=False).returncode != 0
    except OSError:
        failed = True
    return f"{python} cannot import {' and '.join(modules)}" if failed else None


def agree(what: str, apart: float, limit: float, unit: str) -> float:
    """Return the largest difference between the contenders.

    Raises
    ------
    BenchmarkError
        If it exceeds the limit.
    """
    if not apart <= limit:
        raise BenchmarkError(
            f"{what}: the contenders differ by {apart:.2g} {unit}, limit {limit:g}; "
            "they do not compute the same, so their times mean nothing"
        )
    return apart


def keep(name: str, result: dict[str, Any]) -> Path:
    """Write a result to its file, whole or not at all."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(path)
    return path
