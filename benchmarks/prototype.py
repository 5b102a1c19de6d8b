"""Malan's prototype: how many of its heliostats are calibrated ten minutes after a start, how well.

The real plant commands 18 simulated boards in virtual time, and reads rendered photographs. Each
start has its own mirrors, and its own sun. ``python -m benchmarks.prototype SEED@HOUR …`` measures
chosen starts, with ``--json`` for programs; an hour is UTC on 21 June 2026.
"""

import argparse
import asyncio
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.field.stellenbosch import prototype
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.twin.live import CYCLE, World, WorldOptions

#: Length of a run, s; that of a quick one shows a visit under way.
LENGTH, QUICK = 600.0, 60.0
#: Heliostats that must be calibrated, and the largest median of their tracking errors, mrad.
CALIBRATED, ERROR = 15, 0.6
#: Midnight of the day, and the starts of the benchmark: the seed of the mirrors and the hour, UTC.
_DAY = datetime(2026, 6, 21, tzinfo=UTC)
STARTS = ((0, 7.5), (1, 9.0), (2, 10.0), (3, 11.0), (4, 13.0), (5, 12.0))


@dataclass(frozen=True)
class Outcome:
    """What a start has led to.

    Attributes
    ----------
    heliostats, calibrated
        Numbers.
    error
        Median true tracking error of the calibrated ones, mrad; None without one.
    calibrated_at
        When `CALIBRATED` were calibrated, s after the start; None: they were not.
    idle
        Longest time without a visit after the first one, s.
    left
        The other heliostats, and the last result of each.
    """

    heliostats: int
    calibrated: int
    error: float | None
    calibrated_at: float | None
    idle: float
    left: dict[str, str]


def outcome(seed: int, hour: float, length: float = LENGTH) -> Outcome:
    """Return what the prototype reaches in some time (s) from an hour of the day, UTC, on."""
    start = _DAY + timedelta(hours=hour)

    async def main(clock: VirtualClock) -> Outcome:
        world = World(prototype(), clock, WorldOptions(seed, boards=True))
        work = AutomaticSettings(wanted=True)
        settings = AssemblySettings(work=work, cycle=CYCLE, machines=MachineTables.HELD)
        plant = PlantAssembly(world.design, world.ports(), settings)
        begin, busy_at, idle, reached = clock.monotonic(), None, 0.0, None
        async with plant.running():
            while (now := clock.monotonic()) < begin + length:
                view = plant.operations.automatic.view()
                if view.running:
                    busy_at = now
                elif busy_at is not None:
                    idle = max(idle, now - busy_at)
                if reached is None and view.done >= CALIBRATED:
                    reached = now - begin
                await asyncio.sleep(1.0)
            return _outcome(plant, world, reached, idle)

    return run_virtual(main, seed, start=start)


def _outcome(plant: PlantAssembly, world: World, reached: float | None, idle: float) -> Outcome:
    names, beliefs = plant.plant.field.names, plant.plant.beliefs
    known = np.array([beliefs.record(name) is not None for name in names])
    last = {
        entry.heliostat: entry.text for entry in plant.operations.automatic.view().results[::-1]
    }
    left = {name: last.get(name, "") for name, good in zip(names, known, strict=True) if not good}
    error = 1e3 * float(np.nanmedian(world.errors()[known])) if known.any() else None
    return Outcome(len(names), int(known.sum()), error, reached, idle, left)


def run(quick: bool) -> Result:
    """Run the benchmark."""
    return _measured(STARTS[:1] if quick else STARTS, QUICK if quick else LENGTH)


def _measured(starts: Sequence[tuple[int, float]], length: float) -> Result:
    rows: list[Row] = []
    good = 0
    for seed, hour in starts:
        found = outcome(seed, hour, length)
        good += found.calibrated >= CALIBRATED and (found.error or 0.0) <= ERROR
        left = "; ".join(f"{name}: {text}" for name, text in found.left.items())
        rows.append({
            "seed": seed,
            "start_utc": f"{int(hour):02d}:{round(60.0 * (hour % 1.0)):02d}",
            "heliostats": found.heliostats,
            "calibrated": found.calibrated,
            "calibrated_15_after_s": found.calibrated_at,
            "true_median_mrad": found.error,
            "longest_pause_s": found.idle,
            "not_calibrated": left,
        })  # fmt: skip
    say = (
        f"{good} of {len(rows)} starts: {CALIBRATED} or more of 18 calibrated after "
        f"{length / 60.0:g} min, and a true tracking error of {ERROR} mrad at most (median)"
    )
    return Result(rows, say, within_budget=None if length < LENGTH else good == len(rows))


def _main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.prototype", description=__doc__)
    parser.add_argument("starts", nargs="+", metavar="SEED@HOUR")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    starts = [
        (int(seed), float(hour)) for seed, _, hour in (s.partition("@") for s in given.starts)
    ]
    found = _measured(starts, LENGTH)
    if given.json:
        json.dump(found.rows, sys.stdout)
        return
    for row in found.rows:
        sys.stdout.write(", ".join(f"{name} {value}" for name, value in row.items()) + "\n")
    sys.stdout.write(found.headline + "\n")


if __name__ == "__main__":
    _main()
