"""A plant's memory under load, in processes that are killed: run by test_crash.py.

It imports everything once, then forks a child for each line it is told: ``write PLACE SEED``,
``plant PLACE SEED`` or ``limit PLACE``. A child tells what is confirmed, line by line, into a file
that is its own: what was told before the kill is what must be found afterwards.
"""

import asyncio
import os
import random
import resource
import sys
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import plant_load

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.calibration.sightings import sightings
from heliotrope.links.clock import SystemClock
from heliotrope.plant.orders.audit import Record
from heliotrope.plant.orders.kept_audit import KeptAudit, KeptPoints
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Event, StoreError
from heliotrope.store.telemetry import Look, Telemetry, TelemetrySettings

NAMES = tuple(f"H{i}" for i in range(50))
START = datetime(2026, 6, 21, tzinfo=UTC)


def write(place: Path, seed: int, told: int) -> None:
    """Record without end; tell what is confirmed."""
    chance = random.Random(seed)
    keeper = Keeper(place)
    audit, points = KeptAudit(keeper, SystemClock(), START), KeptPoints(keeper)
    telemetry = Telemetry(
        place / "telemetry", NAMES, ("STOWED", "TRACKING"), TelemetrySettings(period=1.0, rows=2000)
    )
    asyncio.run(_write(keeper, audit, points, telemetry, chance, seed, told))


async def _write(
    keeper: Keeper,
    audit: KeptAudit,
    points: KeptPoints,
    telemetry: Telemetry,
    chance: random.Random,
    seed: int,
    told: int,
) -> None:
    places = points.read()

    def tell(line: str) -> None:
        os.write(told, f"{line}\n".encode())

    tell("open")
    counts = {name: one.version for name, one in keeper.latest_calibrations().items()}
    for k in range(100_000):
        numbers = keeper.record_sightings(NAMES, _sightings(seed, k))
        name = chance.choice(NAMES)
        version = counts[name] = counts.get(name, 0) + 1
        keeper.record_calibration(
            HeliostatCalibration(
                name,
                float(k),
                ("tilt_north",),
                np.array([k + 0.5]),
                np.eye(1),
                np.ones(1),
                sightings=numbers,
                residual_before=np.zeros((len(numbers), 2)),
                residual_after=np.zeros((len(numbers), 2)),
                version=version,
            )
        )
        keeper.record_event(Event(float(k), "load", f"{seed}-{k}"))
        telemetry.take(1.8e9 + 1000.0 * seed + k, _look(k))
        if chance.random() < 0.3:
            identity = f"{seed}-{k}"
            audit.begin(
                Record(identity, "operator", "operator", "AIM", START.isoformat(), (1.0, 2.0))
            )
            tell(f"begun {identity}")
            if chance.random() < 0.7:
                audit.finish(identity, "done", START.isoformat())
                tell(f"finished {identity}")
        if chance.random() < 0.2:
            changed = {chance.choice(NAMES): (float(seed), float(k), 0.5) for _ in range(5)}
            places = {**places, "AIM": {**places.get("AIM", {}), **changed}}
            points.keep(places)
            tell(f"points {seed} {k} {len(places['AIM'])}")
        if chance.random() < 0.5:
            await keeper.confirm()
            tell(f"confirmed {k} {int(numbers[-1])} {name} {version}")


def _sightings(seed: int, k: int) -> object:
    return sightings(
        [0, 1, 2], [[seed, k], [seed, k], [seed, k]], [0.0, 0.0, 1.0], [1.0, 2.0, 3.0], time=k
    )


def _look(k: int) -> Look:
    count = len(NAMES)
    return Look(
        np.full(count, k % 2, np.uint8),
        np.zeros(count, np.uint8),
        np.zeros(count, np.uint16),
        np.full((count, 2), k, np.int32),
        np.zeros(count),
    )


def limit(place: Path, told: int) -> None:
    """Fill a disk (a limit of the size of files), make room, and go on."""
    keeper = Keeper(place)
    audit = KeptAudit(keeper, SystemClock(), START)
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, hard))
    count = _fill(keeper)
    lines = [f"full after {count} {keeper.problem}"]
    try:
        audit.confirm()
        lines.append("audit silent")
    except Exception as error:  # noqa: BLE001 - what it is, the test looks at
        lines.append(f"audit {type(error).__name__}")
    keeper.record_event(Event(0.0, "load", "while full"))
    waiting = keeper.writer.backlog
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    asyncio.run(keeper.confirm())
    audit.confirm()
    lines.append(f"waited {waiting} problem {keeper.problem!r} backlog {keeper.writer.backlog}")
    keeper.close()
    os.write(told, ("\n".join(lines) + "\n").encode())


def _fill(keeper: Keeper) -> int:
    """Record until that fails; return how many events were taken."""
    for k in range(10_000):
        keeper.record_event(Event(float(k), "load", "x" * 2000))
        try:
            asyncio.run(keeper.confirm())
        except StoreError:
            return k + 1
    raise AssertionError("the disk was never full")


def main() -> None:
    """Fork a child for each line, tell its number, and gather it when it has ended."""
    with tempfile.TemporaryDirectory() as folder:
        # What is imported late is imported once, before the forks; no thread may run then.
        Keeper(folder, inline=True).close()
    print("ready", flush=True)
    for line in sys.stdin:
        what, place, *rest = line.split()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                told = os.open(f"{place}.told", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                if what == "write":
                    write(Path(place), int(rest[0]), told)
                elif what == "plant":
                    plant_load.plant(Path(place), int(rest[0]), told)
                else:
                    limit(Path(place), told)
                status = 0
            finally:
                os._exit(status)
        print(child, flush=True)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
