"""``python -m benchmarks NAME [--json] [--quick]``; NAME may be all."""

import argparse
import importlib
import json
import sys
from typing import Any

from benchmarks._run import keep, machine

NAMES = ("tracking", "calibration", "sun", "field", "startup")


def _show(name: str, result: dict[str, Any]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    m = result["machine"]
    table = Table(title=f"{name}: {m['cpu']}, {m['cores']} cores", box=SIMPLE_HEAD)
    rows = result["rows"]
    for column in rows[0]:
        table.add_column(column, justify="left" if isinstance(rows[0][column], str) else "right")
    for row in rows:
        table.add_row(
            *(f"{v:,.4g}" if isinstance(v, float) else f"{v:,}" if isinstance(v, int) else str(v)
              for v in row.values())
        )  # fmt: skip
    console = Console(width=None if sys.stdout.isatty() else 200)
    console.print(table)
    for key, value in result.items():
        if key not in ("rows", "machine", "name"):
            print(f"{key}: {value}")
    if m["load_average"] > 0.5 * m["cores"]:
        print(f"the machine was busy (load {m['load_average']:.1f}): these times are too long")


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("name", nargs="?", help=f"all, {', '.join(NAMES)}")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    given = parser.parse_args()
    if given.name is None:
        print("\n".join(NAMES))
        return 0
    if given.name not in (*NAMES, "all"):
        known = ", ".join(NAMES)
        print(f"benchmarks: there is no {given.name!r}; known: all, {known}", file=sys.stderr)
        return 2
    results = {}
    for name in NAMES if given.name == "all" else (given.name,):
        before = machine()
        result = {"name": name, "machine": before}
        result |= importlib.import_module(f"benchmarks.{name}").run(given.quick)
        results[name] = result
        if given.name == "all" and not given.quick:
            keep(name, result)
        if not given.json:
            _show(name, result)
    if given.json:
        print(json.dumps(results if given.name == "all" else results[given.name]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
