"""``heliotrope simulate``: plant and clusters in virtual time, with faults and invariants."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Annotated, Any

import typer

from heliotrope.cli._common import print_json, print_table


def simulate(
    seed: Annotated[
        int,
        typer.Option(
            min=0,
            max=2**63 - 1,
            help="Seed of all random numbers; with --runs, the seed of the first run.",
        ),
    ] = 0,
    hours: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=8760,
            help="Simulated time per run, hours; default: 0.1, or 14 minutes with --world days.",
        ),
    ] = None,
    heliostats: Annotated[
        int, typer.Option(min=1, max=32, help="Number of heliostats on the bus, 1 to 32.")
    ] = 4,
    pause: Annotated[
        float, typer.Option(min=0.01, max=1e6, help="Mean time between faults, s.")
    ] = 12.0,
    only: Annotated[
        list[str] | None, typer.Option(help="Inject only faults of this kind; may be repeated.")
    ] = None,
    world: Annotated[
        list[str] | None,
        typer.Option(
            help="Add a harder environment; may be repeated. any: each run draws its own."
        ),
    ] = None,
    runs: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Number of runs, with consecutive seeds.")
    ] = 1,
    processes: Annotated[int, typer.Option(min=1, max=1024, help="Runs in parallel.")] = 1,
    minutes: Annotated[
        float | None,
        typer.Option(min=0.001, max=1e6, help="Time after which no further run is started."),
    ] = None,
    progress: Annotated[
        Path | None,
        typer.Option(help="File that records the finished runs; if it exists, continue from it."),
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(help="JSON file for the result: commit, worlds, seeds, checks, violations."),
    ] = None,
    shrink: Annotated[
        bool,
        typer.Option(
            help="Reduce the faults of a failed run to a smaller set that still reproduces the "
            "failure."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Run the real plant, clusters and local controllers in virtual time, with random faults.

    Nineteen safety invariants and four liveness invariants are checked; the exit code is 1 if one
    is violated.
    """
    from heliotrope.files.text import write_text
    from heliotrope.twin.world.simulation import RunPlan
    from heliotrope.twin.world.soak import run_many
    from heliotrope.twin.world.worlds import ANY, length_of, mixed

    plans = []
    for number in range(seed, seed + runs):
        worlds = mixed(number) if world == [ANY] else tuple(world or ())
        seconds = length_of(worlds, hours)
        plans.append(RunPlan(number, seconds, heliostats, pause, tuple(only or ()), worlds=worlds))
    result = run_many(
        plans,
        processes=processes,
        budget=float("inf") if minutes is None else 60.0 * minutes,
        progress=progress,
    )
    document = _document(result)
    if results is not None:
        about = {"commit": _commit(), "worlds": world or [], "seeds": [seed, seed + runs - 1]}
        write_text(results, json.dumps(about | document, indent=1) + "\n")
    if shrink and result.broken:
        document["shrunk"] = _shrunk(plans, result)
    if as_json:
        print_json(document)
    else:
        _print(document)
    if result.broken:
        raise typer.Exit(1)


def _commit() -> str:
    """Return the commit of the program; empty outside a repository."""
    git = shutil.which("git")
    if git is None:
        return ""
    command = [git, "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    done = subprocess.run(  # noqa: S603 - every word is our own
        command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False
    )
    return done.stdout.strip()


def _document(result: Any) -> dict[str, Any]:
    from heliotrope.lcu import states
    from heliotrope.twin.invariants.invariants import TITLES, named

    return {
        "runs": result.runs,
        "hours": result.seconds / 3600.0,
        "faults": dict(sorted(result.faults.items())),
        "emergencies": result.counts["emergencies"],
        "proofs": result.counts["proofs"],
        "states": {states.STATES[k]: v for k, v in sorted(result.states.items())},
        "checks": [
            {"number": n, "name": named(n), "invariant": title, "checks": result.checks[n]}
            for n, title in TITLES.items()
        ],
        "broken": result.broken,
    }


def _shrunk(plans: list[Any], result: Any) -> list[str]:
    """Return the reduced faults of the first run that failed."""
    from heliotrope.twin.world.simulation import run, shrink

    for plan in plans:
        if any(f"--seed {plan.seed} " in line for line in result.broken):
            outcome = run(plan)
            if not outcome.good:
                less = shrink(outcome)
                return [less.text, *map(str, less.plan.drawn)]
    return []


def _print(document: dict[str, Any]) -> None:
    rows = [[c["name"], c["invariant"], f"{c['checks']:,}"] for c in document["checks"]]
    title = f"{document['runs']} runs, {document['hours']:.2f} simulated hours"
    print_table(["", "invariant", "checks"], rows, title=title)
    for what in ("faults", "states"):
        print(f"{what}: " + ", ".join(f"{name} {count}" for name, count in document[what].items()))
    for line in document["broken"]:
        print(f"broken: {line}")
    for line in document.get("shrunk", []):
        print(f"  {line}")
    if not document["broken"]:
        print("no invariant was broken")
