"""What the benchmarks share: timing, the machine, and keeping the results."""

import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("heliotrope", "numpy", "numba", "scipy", "pvlib", "pandas")


def machine() -> dict[str, Any]:
    """Return what the figures were measured on."""
    model = "unknown"
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.split(":", 1)[1].strip()
                break
    pages = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return {
        "cpu": model,
        "cores": len(os.sched_getaffinity(0)),
        "memory_gib": round(pages / 2**30, 1),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "load_average": os.getloadavg()[0],
        "versions": {name: version(name) for name in PACKAGES},
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def best(contenders: dict[str, Callable[[], Any]], repeats: int) -> dict[str, dict[str, float]]:
    """Time contenders in turn, so that a disturbance meets all of them.

    Returns for each the least and the median wall time and the least processor time of
    the process, in seconds.
    """
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
        name: {
            "best_s": min(walls[name]),
            "median_s": statistics.median(walls[name]),
            "processor_s": min(works[name]),
        }
        for name in contenders
    }


def keep(name: str, result: dict[str, Any]) -> Path:
    """Write a result beside its place and rename it."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    part = path.with_suffix(".part")
    part.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    part.replace(path)
    return path
