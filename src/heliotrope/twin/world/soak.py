"""Many runs: over processes, within a time, going on where an earlier one stopped."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from itertools import islice
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from heliotrope.errors import FormatError, InputError
from heliotrope.links.clock import Clock, SystemClock
from heliotrope.twin.world.simulation import Outcome, Plan, run


@dataclass
class Soaked:
    """What many runs have shown.

    Attributes
    ----------
    runs, seconds
        Their number, and their simulated time.
    checks, faults, states
        As in `twin.simulation.Outcome`, added up.
    broken
        One line for each run that failed: what broke, and the command that replays it.
    """

    runs: int = 0
    seconds: float = 0.0
    checks: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    states: Counter[int] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)

    def add(self, line: dict[str, Any]) -> None:
        """Add one run, as `summary` gives it."""
        self.runs += 1
        self.seconds += line["seconds"]
        self.checks.update({int(k): v for k, v in line["checks"].items()})
        self.faults.update(line["faults"])
        self.states.update({int(k): v for k, v in line["states"].items()})
        if line["broken"]:
            self.broken.append(line["broken"])


def summary(outcome: Outcome) -> dict[str, Any]:
    """Return a run in plain JSON."""
    return {
        "seed": outcome.plan.seed,
        "seconds": outcome.seconds,
        "checks": dict(outcome.checks),
        "faults": dict(outcome.faults),
        "states": dict(outcome.states),
        "broken": "" if outcome.good else f"{outcome.text}; replay: {outcome.command}",
    }


def _one(plan: Plan) -> dict[str, Any]:
    return summary(run(plan))


def soak(
    plans: Iterable[Plan],
    *,
    processes: int = 1,
    budget: float = float("inf"),
    progress: Path | None = None,
    tell: Callable[[Soaked], None] = lambda _: None,
    clock: Clock | None = None,
) -> Soaked:
    """Run plans until all are done or the time is over.

    Parameters
    ----------
    plans
        What to run, each with a seed of its own.
    processes
        How many at a time.
    budget
        After this wall time no further run is begun, s.
    progress
        A file of one line a run: what stands in it is not run again.
    tell
        Called after each run.
    clock
        Of the budget; None: this machine's.

    Raises
    ------
    InputError
        No processes.
    FormatError
        A file that holds something else.
    """
    if processes < 1:
        raise InputError(f"soak with {processes} processes; give 1 or more")
    found = Soaked()
    known = {}
    if progress is not None and progress.exists():
        known = _read(progress)
    todo = []
    for plan in plans:
        if plan.seed in known:
            found.add(known[plan.seed])
        else:
            todo.append(plan)
    clock = clock or SystemClock()
    end = clock.monotonic() + budget
    for line in _results(todo, processes, lambda: clock.monotonic() < end):
        found.add(line)
        if progress is not None:
            with progress.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
        tell(found)
    return found


def _results(
    plans: list[Plan], processes: int, goes_on: Callable[[], bool]
) -> Iterator[dict[str, Any]]:
    if processes == 1:
        for plan in plans:
            if not goes_on():
                return
            yield _one(plan)
        return
    left = iter(plans)
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        running: set[Future[dict[str, Any]]] = set()
        while True:
            if goes_on():
                running |= {
                    pool.submit(_one, plan) for plan in islice(left, 2 * processes - len(running))
                }
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for each in done:
                yield each.result()


def _read(path: Path) -> dict[int, dict[str, Any]]:
    found = {}
    for number, text in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            line = json.loads(text)
            found[int(line["seed"])] = line
            Soaked().add(line)
        except (ValueError, KeyError, TypeError, AttributeError):
            raise FormatError(
                path, "no run of a soak; give another file or remove it", f"line {number}"
            ) from None
    return found
