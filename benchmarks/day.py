"""A day unattended: what a field learns from sun to sun, and eight hours of a plant.

Part one: a day of the real schedule and the real fit, on mirrors as a quick installation leaves
them, beside two baselines that look at the least known heliostat first; the errors are the twin's
truth. Part two: the whole program (plant, clusters, cameras with exact centroids, automatic
control) in virtual time; its memory and processor time hour by hour.
"""

import asyncio
import os
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from benchmarks._run import BenchmarkError, Result, Row
from benchmarks.days import Days
from benchmarks.least_known import LeastKnown
from heliotrope.field.layouts import malan_plant
from heliotrope.field.plant import Plant
from heliotrope.geometry import MRAD
from heliotrope.links.clock import VirtualClock, VirtualLoop
from heliotrope.plant.assembly import AssemblySettings, MachineTables, PlantAssembly
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.schedule import Weather
from heliotrope.plant.schedule.plant_schedule import settings_for
from heliotrope.plant.schedule.scheduler import Scheduler
from heliotrope.sun import vector
from heliotrope.twin.live import CYCLE, World, WorldOptions

#: Midsummer, an hour after midnight, UTC.
BEGIN = datetime(2026, 6, 21, 1, 0, tzinfo=UTC)
MORNING = datetime(2026, 6, 21, 8, 0, tzinfo=UTC)
#: Heliostats compared with the truth, at most.
SAMPLE = 400
#: Growth of memory that is allowed from the third hour to the last.
GROWTH = 0.02


def _memory() -> float:
    """Return the resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _row(work: str, heliostats: int, **figures: float | int | None) -> Row:
    columns = (
        "simulated_h", "calibrated", "visits", "field_median_mrad", "field_rms_mrad", "median_mrad",
        "rms_mrad", "predicted_mrad", "within_90", "cpu_s_per_h", "memory_mib",
    )  # fmt: skip
    return {"work": work, "heliostats": heliostats, **{c: figures.get(c) for c in columns}}


def _worlds(plant: Plant, begin: datetime) -> dict[str, Days]:
    """Return the same day under each rule of choice."""
    settings, weather = settings_for(CYCLE), Weather(dni=850.0, wind=3.0)
    gain = Scheduler(plant, settings, now=begin)
    worlds = {"by gain": Days(plant, gain, begin, noise=CYCLE.sigma, weather=weather)}
    for name, pairs in (("least known", False), ("pair by pair", True)):
        rule = LeastKnown(plant, settings, begin, pairs=pairs)
        worlds[name] = Days(
            plant, rule.scheduler, begin, rule.next, noise=CYCLE.sigma, weather=weather
        )
    return worlds


def _day(count: int, hours: float) -> tuple[list[Row], str]:
    plant = malan_plant(count)
    begin = BEGIN if hours >= 24.0 else MORNING
    times = begin.timestamp() + 86400.0 + 3600.0 * np.arange(24)
    times = times[vector(times, plant.site)[:, 2] > np.sin(np.radians(10.0))]
    sample = plant.names[:: max(1, count // SAMPLE)]
    worlds = _worlds(plant, begin)
    installed = worlds["by gain"].look(times, sample)
    rows = [_row("as installed", count, **_errors("field_", installed.error))]
    for work, days in worlds.items():
        spent = time.process_time()
        days.live(timedelta(hours=hours), timedelta(minutes=5))
        spent = time.process_time() - spent
        if not days.values:
            raise BenchmarkError(f"a day {work} without a calibrated heliostat")
        after = days.look(times, tuple(list(days.values)[:: max(1, len(days.values) // SAMPLE)]))
        rows.append(
            _row(
                work,
                count,
                simulated_h=hours,
                calibrated=len(days.values),
                visits=len(days.made),
                **_errors("field_", days.look(times, sample).error),
                **_errors("", after.error),
                predicted_mrad=_rms(after.predicted),
                within_90=after.within,
                cpu_s_per_h=spent / hours,
                memory_mib=_memory(),
            )
        )
    field = ", ".join(f"{row['field_rms_mrad']:.2f} {row['work']}" for row in rows)
    return rows, f"{count:,} heliostats, {hours:g} h: {field} (mrad RMS of the field)"


def _errors(prefix: str, error: np.ndarray) -> dict[str, float]:
    median = float(np.nanmedian(error)) / MRAD
    return {f"{prefix}median_mrad": median, f"{prefix}rms_mrad": _rms(error)}


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(error**2))) / MRAD


async def _live(count: int, minutes: float, looks: int) -> list[Row]:
    clock = VirtualClock(asyncio.get_running_loop().time, MORNING)
    rows: list[Row] = []
    design = malan_plant(count)
    world = World(design, clock, WorldOptions(rendered=False))
    settings = AssemblySettings(
        AutomaticSettings(wanted=True), cycle=CYCLE, machines=MachineTables.HELD
    )
    live = PlantAssembly(design, world.ports(), settings)
    async with live.running():
        before = time.process_time()
        for look in range(1, looks + 1):
            await asyncio.sleep(60.0 * minutes / looks)
            now, summary = time.process_time(), live.operations.automatic.view()
            hours = minutes / looks / 60.0
            last = summary.quality[-1].truth_median if summary.quality else float("nan")
            rows.append(
                _row(
                    "whole program",
                    count,
                    simulated_h=look * hours,
                    calibrated=summary.done,
                    cpu_s_per_h=(now - before) / hours,
                    memory_mib=_memory(),
                    median_mrad=last / MRAD if np.isfinite(last) else None,
                )
            )
            before = now
        await live.end()
    return rows


def run(quick: bool) -> Result:
    """Return the figures."""
    sizes = ((10, 0.5),) if quick else ((300, 24.0), (10_000, 24.0))
    parts = [_day(count, hours) for count, hours in sizes]
    rows = [row for part, _ in parts for row in part]
    text = "; ".join(text for _, text in parts)
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        whole = runner.run(_live(4, 1.0, 2) if quick else _live(64, 480.0, 8))
    # The first hour loads modules, fills caches and calibrates every heliostat once.
    first, last = whole[len(whole) // 4], whole[-1]
    growth = float(last["memory_mib"] or 0.0) / float(first["memory_mib"] or 1.0) - 1.0
    figures: dict[str, float | int | str] = {"memory_growth": growth}
    return Result(
        rows + whole,
        f"{text}; whole program, {whole[0]['heliostats']} heliostats, "
        f"{whole[-1]['simulated_h']:.3g} h: memory {100 * growth:+.1f} %",
        figures,
        None if quick else growth < GROWTH,
    )
