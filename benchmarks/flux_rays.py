"""The flux of four fields against random rays: power, efficiency and cells.

The default field of 10,000 mirrors, 600 mirrors before a cavity, the default field with flat
mirrors, and the heliostats of Jülich whose properties are published (HELIOTROPE_DATA names their
folder; left out without it). Suns of 60°, 15° and 4°. Rays take their shading, blocking and sun
disk from `heliotrope.optics.rays`; noise is the rays' own.
"""

import os
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.field.formats import paint
from heliotrope.field.layouts import lay_out
from heliotrope.field.mesh import cavity_wall
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray, direction, normalize
from heliotrope.optics import FieldOptics, field_flux
from heliotrope.optics.plant_flux import PlantFlux

#: Elevations of the suns, and how far each is from noon, °.
SUNS = ((60.0, 0.0), (15.0, 75.0), (4.0, 85.0))
#: Rays of each trace; quick: fewer.
RAYS, FEW = 1e7, 3e4
#: Budgets: power, efficiency of the field (absolute) and cells (RMS over the peak); flat mirrors.
BUDGET = {"power": 1.5e-3, "efficiency": 5e-4, "cells": 5e-3, "flat": 8e-3, "flat, low": 1.7e-2}


def fields(quick: bool) -> Iterator[tuple[str, Plant, FieldOptics]]:
    """Yield the fields, each with its light."""
    part = 30 if quick else 1
    whole = lay_out("radial", 10_000 // part)
    cavity = lay_out("radial", 600 // (part // 10 or 1))
    yield "600, cavity", replace(cavity, receivers=(_cavity(cavity),)), FieldOptics()
    properties = Path(os.environ.get("HELIOTROPE_DATA", "data")) / "properties"
    if properties.is_dir():
        yield "Jülich", paint.read_plant(properties.parent), FieldOptics()
    yield "10,000", whole, FieldOptics()
    yield "10,000, flat", whole, FieldOptics(focus="flat")


def _cavity(plant: Plant) -> Receiver:
    """Return a cavity with its aperture where a plant's receiver is, turned to the field."""
    old, middle = plant.receivers[0], plant.position.mean(axis=0)
    normal = normalize(middle - old.center)
    side = float(min(old.width, old.height))
    # Cells are narrower than the beams.
    wall = cavity_wall(0.9 * side, 2.6, 1.2 * side, (20, 40))
    return Receiver("cavity", "cavity", old.center, normal, side, side, mesh=wall)


def compare(plant: Plant, light: FieldOptics, sun: FloatArray, rays: float) -> Row:
    """Return the differences of the engine from rays at one sun position."""
    begin = time.perf_counter()
    found = field_flux(plant, sun=sun, light=light)
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    traced = field_flux(plant, sun=sun, light=light, rays=rays, seed=1)
    apart = _squares(found, traced) / traced.peak
    noise = float(np.sqrt(np.mean(np.concatenate([e.ravel() for e in traced.errors]) ** 2)))
    return {
        "power_mw": found.power / 1e6,
        "power_percent": 100.0 * (found.power / traced.power - 1.0),
        "power_noise_percent": 100.0 * traced.power_error / traced.power,
        "efficiency_percent": 100.0 * (found.summary["total"] - traced.summary["total"]),
        "cells_percent": 100.0 * apart,
        "cells_noise_percent": 100.0 * noise / traced.peak,
        "seconds": seconds,
        "rays_seconds": time.perf_counter() - begin,
    }


def _squares(one: PlantFlux, other: PlantFlux) -> float:
    away = [a.flux - b.flux for a, b in zip(one.maps, other.maps, strict=True)]
    return float(np.sqrt(np.mean(np.concatenate([each.ravel() for each in away]) ** 2)))


def run(quick: bool) -> Result:
    """Measure; see the module's docstring."""
    rows: list[Row] = []
    for name, plant, light in fields(quick):
        # Noon, as seen from the field: the sun stands behind the tower.
        south = float((plant.position.mean(axis=0) - plant.receivers[0].center)[1]) < 0.0
        noon = 0.0 if south else 180.0
        for elevation, away in SUNS:
            sun = direction(np.radians(noon + away), np.radians(elevation))
            row = compare(plant, light, sun, FEW if quick else RAYS)
            rows.append({"field": name, "elevation_deg": elevation, **row})
    power = max(abs(float(row["power_percent"] or 0.0)) for row in rows)
    cells = max(float(row["cells_percent"] or 0.0) for row in rows)
    kept = all(_kept(row) for row in rows)
    headline = f"power within {power:.3f} % of rays, cells within {cells:.2f} % of the peak (RMS)"
    return Result(rows, headline, {"largest_power_percent": power}, None if quick else kept)


def _kept(row: Row) -> bool:
    flat = "flat" in str(row["field"])
    low = float(row["elevation_deg"] or 0.0) < 30.0
    cells = BUDGET["flat, low" if low else "flat"] if flat else BUDGET["cells"]
    return bool(
        abs(float(row["power_percent"] or 0.0)) <= 100.0 * BUDGET["power"]
        and abs(float(row["efficiency_percent"] or 0.0)) <= 100.0 * BUDGET["efficiency"]
        and float(row["cells_percent"] or 0.0) <= 100.0 * cells
    )
