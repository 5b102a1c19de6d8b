"""Plant each defect of `tests/support` in the simulation, and write what found it into the docs.

Run as ``python scripts/defects.py --processes 2``. It tries seeds 0 to 19 for each defect, until
an invariant that may find it breaks, and writes the table in docs/explanation/simulation.md. The
exit code is 1 if one is not found.
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
#: Seeds that may be spent on a defect.
SEEDS = 20


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


def main() -> None:
    """Find all defects and write the table."""
    from support.twin_defects import DEFECTS

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--only", default="", help="defects whose name contains this; no table")
    given = parser.parse_args()
    chosen = [i for i, defect in enumerate(DEFECTS) if given.only in defect.name]
    rows = ["| defect | invariant | first seed | at, s | computed, s |", "|---|---|---|---|---|"]
    missed = []
    with ProcessPoolExecutor(given.processes, mp_context=get_context("spawn")) as pool:
        for name, invariant, seed, at, took in pool.map(found, chosen):
            rows.append(f"| {name} | {invariant or '-'} | {seed or '-'} | {at:.0f} | {took:.0f} |")
            print(rows[-1], flush=True)
            if not invariant:
                missed.append(name)
    if not given.only:
        head, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
        tail = rest.partition(END)[2]
        PAGE.write_text(head + BEGIN + "\n".join(rows) + "\n" + END + tail, encoding="utf-8")
    sys.exit(f"not found within {SEEDS} seeds: {', '.join(missed)}" if missed else 0)


if __name__ == "__main__":
    main()
