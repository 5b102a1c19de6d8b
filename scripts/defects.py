"""Plant each defect of `tests/support` in the simulation, and write what found it into the docs.

Run as ``python scripts/defects.py --processes 2``; ``--world days`` tries the defects of one world.
Each defect has seeds 0 to 20, until an invariant that may find it breaks; then its row of the table
in docs/explanation/simulation.md is written anew. The exit code is 1 if one is not found.
"""

import argparse
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))
PAGE = ROOT / "docs" / "explanation" / "simulation.md"
BEGIN, END = "<!-- defects -->\n", "<!-- /defects -->\n"
#: The head of the table.
HEAD = ("| defect | invariant | first seed | at, s | computed, s |", "|---|---|---|---|---|")
#: Seeds that may be spent on a defect.
SEEDS = 21


def found(number: int) -> tuple[str, str, str, float, float]:
    """Return name, invariant and seed of a defect, and simulated and real time to its finding, s.

    Invariant and seed are "" if no seed finds it.
    """
    from heliotrope.twin.invariants.invariants import named
    from heliotrope.twin.world.simulation import run
    from support.twin_defects import DEFECTS

    defect, begin = DEFECTS[number], time.process_time()
    for seed in range(SEEDS):
        with pytest.MonkeyPatch.context() as patch:
            defect.plant(patch)
            outcome = run(defect.plan(seed))
        broken = outcome.violation
        if broken is not None and broken.number in defect.numbers:
            took = time.process_time() - begin
            return defect.name, named(broken.number), str(seed), broken.at, took
    return defect.name, "", "", 0.0, time.process_time() - begin


def written(rows: dict[str, str], order: list[str], page: str) -> str:
    """Return the page with some rows of its table anew, by the names of their defects.

    The rows of other defects stay; those of defects that are no more go.
    """
    head, _, rest = page.partition(BEGIN)
    table, _, tail = rest.partition(END)
    kept = {row.split("|")[1].strip(): row for row in table.splitlines()[len(HEAD) :]} | rows
    lines = [*HEAD, *(kept[name] for name in order if name in kept)]
    return head + BEGIN + "\n".join(lines) + "\n" + END + tail


def main() -> None:
    """Find defects and write their rows of the table."""
    from support.twin_defects import DEFECTS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--only", default="", help="defects whose name contains this")
    parser.add_argument("--world", default="", help="defects that are planted in this world")
    given = parser.parse_args()
    chosen = [
        number
        for number, defect in enumerate(DEFECTS)
        if given.only in defect.name and given.world in ("", *defect.worlds)
    ]
    rows, missed = {}, []
    with ProcessPoolExecutor(given.processes, mp_context=get_context("spawn")) as pool:
        for name, invariant, seed, at, took in pool.map(found, chosen):
            rows[name] = f"| {name} | {invariant or '-'} | {seed or '-'} | {at:.0f} | {took:.0f} |"
            print(rows[name], flush=True)
            if not invariant:
                missed.append(name)
    names = [defect.name for defect in DEFECTS]
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(written(rows, names, page), encoding="utf-8")
    sys.exit(f"not found within {SEEDS} seeds: {', '.join(missed)}" if missed else 0)


if __name__ == "__main__":
    main()
