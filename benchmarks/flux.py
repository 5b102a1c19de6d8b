"""Flux on a cylinder of 2,016 cells, with shading and blocking: time, error and memory.

Fields are spirals of mirrors of 11.42 m × 10.42 m around a tower, and the real plant of 11,915
where its published positions are (HELIOTROPE_FIELDS names their folder), at suns of 60° and 15°.
Mirrors are focused at their slant range, flat, or of 35 flat facets that are canted to it.
"Moved": one mirror in a hundred takes another aim, and the flux is brought up to date. Random rays
(`embreex`) are timed on the same scene, and their time is scaled to the cells' error of the engine:
noise falls with the root of their number. SolarPILOT computes the first field where
HELIOTROPE_PYSAM_PYTHON names an interpreter with NREL-PySAM.
"""

import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import _solarpilot
from benchmarks._run import Result, Row, timed
from heliotrope.errors import HeliotropeError
from heliotrope.geometry import FloatArray, bisector, direction, normalize
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import FacetTable, Mirrors, Scene
from heliotrope.optics.surfaces import Cylinder

#: Size of the mirrors, m; rows and columns of cells; mirrors of the real plant.
SIZE, CELLS, PLANT = (11.42, 10.42), (36, 56), 11_915
#: Ground for each mirror, m².
GROUND = 600.0
#: Radius and height of the receiver, m.
RADIUS, TALL = 7.565, 18.6
#: Budgets: milliseconds cold, and after one mirror in a hundred moved.
BUDGET = {(PLANT, "focused"): (60.0, 5.0), (PLANT, "flat"): (250.0, None),
          (PLANT, "faceted"): (250.0, None), (100_000, "focused"): (700.0, None)}  # fmt: skip
#: Rays that are timed.
RAYS = 300_000


def spiral(count: int) -> tuple[FloatArray, FloatArray, float]:
    """Return positions and aims of a field of that many, and the height of its receiver, m."""
    k = np.arange(count) + 0.5
    turn, radius = k * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt(GROUND / np.pi * k + 120.0**2)
    place = np.stack([radius * np.sin(turn), radius * np.cos(turn), np.zeros(count)], axis=-1)
    height = 229.3 * max(1.0, np.sqrt(count / PLANT))
    return place, _aims(place, height), height


def _aims(place: FloatArray, height: float) -> FloatArray:
    """Return points on the cylinder that face the mirrors."""
    flat = place * [1.0, 1.0, 0.0]
    return np.asarray(RADIUS * normalize(flat) + np.array([0.0, 0.0, height]))


def published() -> tuple[FloatArray, FloatArray] | None:
    """Return positions and aims of the real plant; None without the data."""
    named = os.environ.get("HELIOTROPE_FIELDS")
    file = Path(named or "fields") / "dunhuang" / "ref_eff_dunhuang.json"
    if not file.is_file():
        return None
    known = json.loads(file.read_text(encoding="utf-8"))
    return np.array(known["positions"]), np.array(known["aims"])


def scene(
    place: FloatArray, aim: FloatArray, height: float, figure: str, elevation: float = 60.0
) -> Scene:
    """Return the scene under a sun in the south, or in the south-east if it is low."""
    sun = direction(np.radians(180.0 if elevation > 30.0 else 105.0), np.radians(elevation))
    up, north = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
    center = np.array([0.0, 0.0, height])
    receiver = Cylinder("receiver", center, up, north, RADIUS, TALL, shape=CELLS)
    return Scene(sun, 1000.0, mirrors(place, aim, sun, figure), (receiver,))


def mirrors(place: FloatArray, aim: FloatArray, sun: FloatArray, figure: str) -> Mirrors:
    """Return mirrors that are "focused", "flat" or "faceted"."""
    normal = bisector(np.broadcast_to(sun, place.shape), normalize(aim - place))
    slant = np.linalg.norm(aim - place, axis=-1)
    focal = np.full(len(place), np.inf) if figure == "flat" else np.round(slant, -1)
    built = Mirrors.of(place, normal, SIZE, aim, focal=focal, slope=1.5e-3, reflectivity=1.0)
    if figure != "faceted":
        return built
    x = (np.arange(5) - 2.0) * SIZE[0] / 5
    y = (np.arange(7) - 3.0) * SIZE[1] / 7
    one = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=-1)
    center = np.broadcast_to(one, (len(place), 35, 2))
    half = np.broadcast_to([0.5 * SIZE[0] / 5, 0.5 * SIZE[1] / 7], center.shape)
    tilt = -center / (2.0 * focal[:, None, None])
    return built.with_facets(FacetTable(center, tilt, half, np.full(center.shape[:2], np.inf)))


def mover(found: FieldFlux, figure: str) -> Callable[[], object]:
    """Return what moves one mirror in a hundred up and down by 2 m at the receiver."""
    given = found.scene
    rows = np.arange(0, len(given.mirrors), 100)
    aim = given.mirrors.aim.copy()
    aim[rows, 2] += 2.0
    # The focus stays what it was.
    other = mirrors(given.mirrors.center, aim, given.sun, figure)
    poses = [other, given.mirrors]

    def move() -> object:
        poses.reverse()
        return found.move(rows, poses[0])

    return move


def measure(name: str, given: Scene, figure: str, elevation: float, repeats: int) -> Row:
    """Return times, and the budget for them."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = FieldFlux(given, sun="pillbox")
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    calls = {"cold": lambda: FieldFlux(given, sun="pillbox"), "moved": mover(found, figure)}
    times = timed(calls, repeats)
    count = len(given.mirrors)
    limits = BUDGET.get((count, figure), (None, None))
    return {
        "field": name,
        "mirrors": count,
        "figure": figure,
        "sun_deg": elevation,
        "cold_ms": 1e3 * times["cold"].best,
        "limit_ms": limits[0],
        "moved_ms": 1e3 * times["moved"].best,
        "moved_limit_ms": limits[1],
        "cold_processor_ms": 1e3 * times["cold"].processor,
        "grown_mb": grown / 1024.0,
    }


def rays(given: Scene) -> dict[str, float | str]:
    """Return what random rays take for the engine's error of the cells."""
    try:
        from heliotrope.optics.rays import trace

        trace(given, 1e4, sun="pillbox")
        start = time.perf_counter()
        traced = trace(given, RAYS, sun="pillbox")
    except HeliotropeError as missing:
        return {"rays": f"not run: {missing}"}
    seconds = time.perf_counter() - start
    flux = FieldFlux(given, sun="pillbox").maps[0]
    noise = float(np.sqrt(np.mean(traced.error[0] ** 2)) / flux.max())
    apart = float(np.sqrt(np.mean((traced.flux[0] - flux) ** 2)) / flux.max())
    # What is left of the difference without the rays' own noise, but at least a tenth of it.
    error = max(np.sqrt(max(apart**2 - noise**2, 0.0)), 0.1 * noise)
    return {
        "rays": RAYS,
        "rays_s": seconds,
        "rays_noise_of_peak": noise,
        "difference_of_peak": apart,
        "error_of_peak_at_most": float(error),
        "rays_s_at_equal_error": seconds * (noise / float(error)) ** 2,
    }


def solarpilot(place: FloatArray, aim: FloatArray, height: float) -> dict[str, float | str]:
    """Return SolarPILOT's seconds for a sun position, and its efficiencies less the engine's."""
    if (reason := _solarpilot.why_skipped()) is not None:
        return {"solarpilot": f"not run: {reason}"}
    found = _solarpilot.flux({
        "positions": place[:, :2].tolist(), "width": SIZE[0], "height": SIZE[1], "slope": 1.5e-3,
        "tower": height, "diameter": 2.0 * RADIUS, "tall": TALL, "cells": CELLS,
    })  # fmt: skip
    apart = []
    for azimuth, elevation, efficiency in found["suns"]:
        sun = direction(np.radians(azimuth), np.radians(elevation))
        given = replace(
            scene(place, aim, height, "focused"),
            sun=sun,
            mirrors=mirrors(place, aim, sun, "focused"),
        )
        sunlight = given.dni * given.mirrors.area.sum()
        apart.append(efficiency - FieldFlux(given, sun="pillbox").powers[0] / sunlight)
    return {
        "solarpilot_layout_s": found["layout_s"],
        "solarpilot_s": found["sun_s"],
        "solarpilot_efficiency_apart_percent": 100.0 * float(max(apart, key=abs)),
    }


_START = """
import time; a = time.perf_counter()
from benchmarks.flux import CELLS, scene, spiral
b = time.perf_counter()
from heliotrope.optics.receiver_flux import FieldFlux
FieldFlux(scene(*spiral(100), "focused"), sun="pillbox")
print(b - a, time.perf_counter() - b)
"""


def start() -> tuple[float, float]:
    """Return seconds for imports, and for a first flux whose kernels are loaded from the cache."""
    command = [sys.executable, "-c", _START]
    text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    imports, first = map(float, text.split())
    return imports, first


def run(quick: bool) -> Result:
    """Measure; see the module's docstring."""
    real, repeats = published(), 3 if quick else 9
    fields = {"spiral": spiral(2_000 if quick else PLANT)}
    if real is not None:
        fields = {"plant": (*real, 229.3)}
    rows = [
        measure(name, scene(*field, figure, elevation), figure, elevation, repeats)
        for name, field in fields.items()
        for figure, elevation in (
            ("focused", 60.0), ("focused", 15.0), ("flat", 60.0), ("faceted", 60.0),
        )
    ]  # fmt: skip
    sizes = (1_000, 10_000) if quick else (1_000, 3_000, 10_000, 30_000, 100_000)
    rows += [
        measure("spiral", scene(*spiral(count), "focused"), "focused", 60.0, 3) for count in sizes
    ]
    imports, first = start()
    field = next(iter(fields.values()))
    second = rays(scene(*field, "focused"))
    figures: dict[str, float | int | str] = {
        "import_s": imports,
        "first_flux_from_cache_s": first,
        **second,
        **solarpilot(*field),
    }
    cold = float(rows[0]["cold_ms"] or 0.0)
    if "solarpilot_s" in figures:
        figures["solarpilot_slower"] = 1e3 * float(figures["solarpilot_s"]) / cold
    if "rays_s_at_equal_error" in second:
        figures["rays_slower"] = 1e3 * float(second["rays_s_at_equal_error"]) / cold
    kept = all(
        row[limit] is None or float(row[value] or 0.0) <= float(row[limit] or 0.0)
        for row in rows
        for value, limit in (("cold_ms", "limit_ms"), ("moved_ms", "moved_limit_ms"))
    )
    headline = (
        f"flux of {rows[0]['mirrors']:,} mirrors on {CELLS[0] * CELLS[1]:,} cells in "
        f"{cold:.0f} ms, {rows[0]['moved_ms']:.1f} ms after one in a hundred moved"
    )
    return Result(rows, headline, figures, within_budget=kept)
