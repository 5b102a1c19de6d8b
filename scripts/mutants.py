"""Mutation score of the control code: small errors planted one at a time, and what finds them.

Each mutant is one change to one expression or statement of `lcu`, `links`, `cluster`, `plant` or
`safety` (`mutant_operators.py`). The unit tests that feel it run on it, and the runs of the
simulation that feel it (`mutant_trials.py`). Run as
``python scripts/mutants.py --sample 500 --progress out/mutants.jsonl``; a run that was stopped goes
on where it was. Which tests and runs feel a mutant is measured first, in one pass with probes for
the whole sample (`mutant_probes.py`). The tests of a file that has changed are measured again, and
everything when the sources or what tests share have.
"""

import argparse
import json
import math
import os
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mutant_operators import PACKAGES, ROOT, Mutant, sampled

#: Lines of a progress file by mutant and kind of trial.
Trials = dict[tuple[str, str], dict[str, Any]]


def interval(hits: int, tries: int) -> str:
    """Return a share in per cent with its 95 % interval, Wilson's."""
    if tries == 0:
        return "–"
    z, p = 1.96, hits / tries
    middle = (p + z * z / (2 * tries)) / (1 + z * z / tries)
    half = z * math.sqrt(p * (1 - p) / tries + z * z / (4 * tries * tries)) / (1 + z * z / tries)
    low = max(0.0, middle - half)
    return f"{100 * p:.0f} % ({100 * low:.0f} to {100 * (middle + half):.0f} %)"


def table(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table, the shares and the survivors as Markdown."""
    heads = ("package", "mutants", "by unit tests", "simulation", "either", "survived",
             "not executed", "not felt")  # fmt: skip
    rows = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    names = dict.fromkeys([*PACKAGES, *(line["package"] for line in lines)])
    names = [p for p in names if any(line["package"] == p for line in lines)]
    for name in [*names, "all"]:
        some = [line for line in lines if name in (line["package"], "all")]
        count = _counted(some)
        rows.append(
            f"| {name} | {len(some)} | {count['unit']} | {count['simulation']} | {count['either']} "
            f"| {len(some) - count['either']} | {len(some) - count['executed']} "
            f"| {count['executed'] - count['felt']} |"
        )
    count, all_ = _counted(lines), len(lines)
    rows += [
        "",
        f"- by either: {interval(count['either'], all_)}",
        f"- by the simulation: {interval(count['simulation'], all_)}",
        "- by the simulation, of those it executes: "
        + interval(count["simulation"], count["executed"]),
        "- by the simulation, of those it feels: " + interval(count["simulation"], count["felt"]),
    ]
    if lines:
        mean = sum(line["seconds"] for line in lines) / all_
        rows.append(f"- computed: {mean:.1f} s of one core a mutant, without the pass with probes")
    survived = [line["mutant"] for line in lines if not (line["unit"] or line["simulation"])]
    return "\n".join([*rows, "", *(f"- survived: `{each}`" for each in survived)])


def _counted(lines: Sequence[dict[str, Any]]) -> Counter[str]:
    count = Counter[str]()
    for line in lines:
        for name in ("unit", "simulation", "executed", "felt"):
            count[name] += line[name]
        count["either"] += line["unit"] or line["simulation"]
    return count


def joined(todo: Sequence[Mutant], known: Trials) -> list[dict[str, Any]]:
    """Return a line for each mutant of which both trials are known."""
    lines = []
    for each in todo:
        unit, run = known.get((each.key, "unit")), known.get((each.key, "simulation"))
        if unit is not None and run is not None:
            lines.append({
                "mutant": each.key, "package": unit["package"], "unit": bool(unit["by"]),
                "simulation": bool(run["by"]), "executed": bool(run["executed"]),
                "felt": bool(run["felt"]), "seconds": unit["seconds"] + run["seconds"],
            })  # fmt: skip
    return lines


def read(path: Path) -> Trials:
    """Return the trials of a progress file by mutant and kind; the later counts."""
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    return {(line["mutant"], line["trial"]): line for line in map(json.loads, text.splitlines())}


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sample", type=int, default=500, help="mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--minutes", type=float, default=600.0, help="begin no trial after this")
    parser.add_argument("--progress", type=Path, default=ROOT / "out" / "mutants.jsonl")
    parser.add_argument("--reach", type=Path, default=ROOT / "out" / "mutants-reach.json")
    parser.add_argument("--only", choices=("unit", "simulation"), help="one kind of trials")
    parser.add_argument(
        "--below", nargs="+", default=PACKAGES, help="packages and files below src/heliotrope"
    )
    given = parser.parse_args()
    progress: Path = given.progress
    progress.parent.mkdir(parents=True, exist_ok=True)
    sample, known = sampled(given.sample, given.seed, given.below), read(progress)
    kinds = (given.only,) if given.only else ("unit", "simulation")
    todo = [(kind, m) for m in sample for kind in kinds if (m.key, kind) not in known]

    def keep(line: dict[str, Any]) -> None:
        known[line["mutant"], line["trial"]] = line
        with progress.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    if todo:
        import mutant_trials

        end = time.monotonic() + 60.0 * given.minutes
        mutant_trials.try_all(sample, todo, given.reach, given.processes, end, keep)
    done = joined(sample, known)
    print(f"{len(done)} of {len(sample)} mutants tried, seed {given.seed}\n\n{table(done)}")


if __name__ == "__main__":
    main()
