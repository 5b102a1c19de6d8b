"""Many runs: in several processes, within a time limit, resumed where the last batch stopped."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

from heliotrope.errors import FormatError, InputError
from heliotrope.links.clock import Clock, SystemClock
from heliotrope.processes import pool
from heliotrope.twin.world.simulation import RunPlan, RunResult, run


@dataclass
class SoakResult:
    """Result of many runs.

    Attributes
    ----------
    runs, seconds
        Number of runs and their simulated time.
    checks, faults, counts, states
        Sums over all runs; see `twin.world.simulation.RunResult`.
    broken
        One line for each failed run: what failed, and the command that replays it.
    """

    runs: int = 0
    seconds: float = 0.0
    checks: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    states: Counter[int] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)

    def add(self, line: dict[str, Any]) -> None:
        """Add one run, as returned by `summary`."""
        self.runs += 1
        self.seconds += line["seconds"]
        self.checks.update({int(k): v for k, v in line["checks"].items()})
        self.faults.update(line["faults"])
        self.counts.update(line["counts"])
        self.states.update({int(k): v for k, v in line["states"].items()})
        if line["broken"]:
            self.broken.append(line["broken"])


def summary(outcome: RunResult) -> dict[str, Any]:
    """Return the summary of a run as plain JSON."""
    return {
        "seed": outcome.plan.seed,
        "seconds": outcome.seconds,
        "checks": dict(outcome.checks),
        "faults": dict(outcome.faults),
        "counts": dict(outcome.counts),
        "states": dict(outcome.states),
        "broken": "" if outcome.good else f"{outcome.text}; replay: {outcome.command}",
    }


def _run_plan(plan: RunPlan) -> dict[str, Any]:
    return summary(run(plan))


def run_many(
    plans: Iterable[RunPlan],
    *,
    processes: int = 1,
    budget: float = float("inf"),
    progress: Path | None = None,
    tell: Callable[[SoakResult], None] = lambda _: None,
    clock: Clock | None = None,
) -> SoakResult:
    """Run plans until all are done or the time has expired.

    Parameters
    ----------
    plans
        Plans, each with its own seed.
    processes
        Number of processes.
    budget
        Wall-clock time after which no further run is started, s.
    progress
        File with one line per run; runs already in the file are skipped.
    tell
        Function that is called after each run.
    clock
        Clock of the time limit; None for the system clock.

    Raises
    ------
    InputError
        If there is less than one process.
    FormatError
        If the progress file does not contain such runs.
    """
    if processes < 1:
        raise InputError(f"a soak needs 1 process or more, not {processes}")
    result = SoakResult()
    known = {}
    if progress is not None and progress.exists():
        known = _read(progress)
    todo = []
    for plan in plans:
        if plan.seed in known:
            result.add(known[plan.seed])
        else:
            todo.append(plan)
    clock = clock or SystemClock()
    end = clock.monotonic() + budget
    for line in _results(todo, processes, lambda: clock.monotonic() < end):
        result.add(line)
        if progress is not None:
            with progress.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        tell(result)
    return result


def _results(
    plans: list[RunPlan], processes: int, goes_on: Callable[[], bool]
) -> Iterator[dict[str, Any]]:
    if processes == 1:
        for plan in plans:
            if not goes_on():
                return
            yield _run_plan(plan)
        return
    queue = iter(plans)
    with pool(processes) as workers:
        running: set[Future[dict[str, Any]]] = set()
        while True:
            if goes_on():
                running |= {
                    workers.submit(_run_plan, plan)
                    for plan in islice(queue, 2 * processes - len(running))
                }
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()


def _read(path: Path) -> dict[int, dict[str, Any]]:
    lines = {}
    for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            line = json.loads(text)
            lines[int(line["seed"])] = line
            SoakResult().add(line)
        except (ValueError, KeyError, TypeError, AttributeError):
            raise FormatError(
                path, "not a run of a soak; name another file, or remove this one", f"line {number}"
            ) from None
    return lines
