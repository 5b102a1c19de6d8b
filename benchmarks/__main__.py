"""``python -m benchmarks NAME [--json] [--quick]``; NAME may be all.

A benchmark may have options of its own, as ``first_run --prototype``; README.md names them.
``all`` keeps every result in benchmarks/results, except with ``--quick``.
"""

import argparse
import importlib
import json
import sys
import time
from typing import Any

from benchmarks._run import BUSY, BenchmarkError, Neighbours, keep, machine

#: The registry: each is a module of this package with ``run(quick: bool) -> Result``; it may take
#: more by name, from the parser that its ``options()`` returns.
NAMES = (
    "tracking", "calibration", "imaging", "sun", "field", "startup", "bus", "frames", "clusters",
    "control", "plant", "airborne", "console", "day", "learning", "signing",
    "splits", "coded", "production", "commission", "drifting", "obstruction", "floor",
    "prototype", "heliopoint", "spots", "first_run", "flux", "flux_rays", "clouds",
    "aiming",
)  # fmt: skip
#: Width of a table that goes to a file or a pipe, characters.
WIDTH = 180


def _measure(name: str, quick: bool, words: list[str]) -> dict[str, Any]:
    module = importlib.import_module(f"benchmarks.{name}")
    own = getattr(module, "options", argparse.ArgumentParser)()
    chosen = vars(own.parse_args(words))
    where = machine()
    neighbours, start = Neighbours(), time.perf_counter()
    result = module.run(quick, **chosen)
    return {
        "name": name,
        "headline": result.headline,
        "within_budget": result.within_budget,
        **result.figures,
        "quick": quick,
        "seconds": time.perf_counter() - start,
        "others_cores": neighbours.cores(),
        "machine": where,
        "rows": result.rows,
    }


def _text(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _print_table(title: str, rows: list[dict[str, Any]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title, box=SIMPLE_HEAD)
    for column in rows[0]:
        words, left = column.split("_"), isinstance(rows[0][column], str)
        table.add_column(
            " ".join(words),
            justify="left" if left else "right",
            no_wrap=left,
            min_width=max(map(len, words)),
        )
    for row in rows:
        table.add_row(*map(_text, row.values()))
    Console(width=None if sys.stdout.isatty() else WIDTH).print(table)


def _show(result: dict[str, Any]) -> None:
    m = result["machine"]
    title = f"{result['name']}: {m['cpu']}, {m['cores']} cores, commit {m['commit'] or 'unknown'}"
    _print_table(title, result["rows"])
    for key, value in result.items():
        if key not in {"name", "machine", "rows", "quick"} and value is not None:
            print(f"{key.replace('_', ' ')}: {_text(value)}")
    if result["others_cores"] > BUSY * m["cores"]:
        print(
            f"the machine was busy: others took {result['others_cores']:.1f} cores meanwhile "
            f"(load average before: {m['load_average']:.1f}); these times are too long"
        )


def main() -> int:
    """Run the benchmarks named on the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", nargs="?", help=f"all, {', '.join(NAMES)}")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    given, words = parser.parse_known_args()
    if given.name is None:
        print("\n".join(NAMES))
        return 0
    if given.name not in (*NAMES, "all"):
        known = ", ".join(NAMES)
        print(f"benchmarks: there is no {given.name!r}; known: all, {known}", file=sys.stderr)
        return 2
    results = {}
    for name in NAMES if given.name == "all" else (given.name,):
        try:
            results[name] = _measure(name, given.quick, words)
        except BenchmarkError as error:
            print(f"benchmarks: {name}: {error}", file=sys.stderr)
            return 1
        if given.name == "all" and not given.quick:
            keep(name, results[name])
        if not given.json:
            _show(results[name])
    if given.json:
        print(json.dumps(results if given.name == "all" else results[given.name], allow_nan=False))
    elif given.name == "all":
        kept = ("name", "headline", "within_budget", "others_cores", "seconds")
        _print_table("summary", [{key: result[key] for key in kept} for result in results.values()])
    return 0


if __name__ == "__main__":
    sys.exit(main())
