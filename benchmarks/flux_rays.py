"""The flux of five fields against random rays: power, efficiency and cells.

The default field of 10,000 mirrors, 600 mirrors before a cavity, the default field with flat
mirrors, the heliostats of Jülich whose properties are published (HELIOTROPE_DATA names their
folder; left out without it), and 904 heliostats of SolarPILOT's (HELIOTROPE_FIELDS; likewise).
Suns of 60°, 15° and 4°. Rays take their shading, blocking and sun disk from
`heliotrope.optics.rays`; noise is the rays' own.

The blocking of the 904 heliostats is compared with the efficiencies that SolarPILOT computed for
them. Where both differ, and the blocker is in the file, rays decide.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import _halos
from benchmarks._run import Result, Row
from heliotrope.field.formats import paint
from heliotrope.field.layouts import lay_out
from heliotrope.field.mesh import cavity_wall
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver
from heliotrope.geometry import FloatArray, direction, normalize
from heliotrope.optics import FieldOptics
from heliotrope.optics.rays import trace
from heliotrope.optics.scene import Scene
from heliotrope.optics.shading import Shading

#: Elevations of the suns, and how far each is from noon, °.
SUNS = ((60.0, 0.0), (15.0, 75.0), (4.0, 85.0))
#: Rays of each trace; quick: fewer; more where the noise of the cells would hide the budget.
RAYS, FEW = 1e7, 3e4
MORE = {"600, cavity": 3e7, "Jülich": 3e7}
#: Budgets: power, efficiency of the field (absolute) and cells (RMS over the peak); flat mirrors.
BUDGET = {"power": 1.5e-3, "efficiency": 5e-4, "cells": 5e-3, "flat": 8e-3, "flat, low": 1.7e-2}


#: The scene of a field at a sun position.
Making = Callable[[FloatArray], Scene]


def fields(quick: bool) -> Iterator[tuple[str, Making, FieldOptics]]:
    """Yield the fields, each with its scene and its light."""
    part = 30 if quick else 1
    whole = lay_out("radial", 10_000 // part)
    cavity = lay_out("radial", 600 // (part // 10 or 1))
    cavity = replace(cavity, receivers=(_cavity(cavity),))
    light, flat = FieldOptics(), FieldOptics(focus="flat")
    yield "600, cavity", _scenes(cavity, light), light
    properties = Path(os.environ.get("HELIOTROPE_DATA", "data")) / "properties"
    if properties.is_dir():
        yield "Jülich", _scenes(paint.read_plant(properties.parent), light), light
    if (known := halos()) is not None:
        yield "904", known.scene, _halos.LIGHT
    yield "10,000", _scenes(whole, light), light
    yield "10,000, flat", _scenes(whole, flat), flat


def halos() -> _halos.Published | None:
    """Return the 904 heliostats of SolarPILOT's; None without the data."""
    return _halos.read(Path(os.environ.get("HELIOTROPE_FIELDS", "fields")))


def _scenes(plant: Plant, light: FieldOptics) -> Making:
    return lambda sun: light.scene(plant, sun, None, ())


def _cavity(plant: Plant) -> Receiver:
    """Return a cavity with its aperture where a plant's receiver is, turned to the field."""
    old, middle = plant.receivers[0], plant.position.mean(axis=0)
    normal = normalize(middle - old.center)
    side = float(min(old.width, old.height))
    # Cells are narrower than the beams.
    wall = cavity_wall(0.9 * side, 2.6, 1.2 * side, (20, 40))
    return Receiver("cavity", "cavity", old.center, normal, side, side, mesh=wall)


def compare(scene: Scene, light: FieldOptics, rays: float) -> Row:
    """Return the differences of the engine from rays at one sun position."""
    begin = time.perf_counter()
    found = light.engine(scene)
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    traced = trace(scene, rays, sun=light.shape, air=light.air, seed=1)
    power, reference = sum(found.powers), float(traced.power.sum())
    apart = _rms([a - b for a, b in zip(found.maps, traced.flux, strict=True)])
    peak = max(float(flux.max()) for flux in traced.flux)
    return {
        "power_mw": power / 1e6,
        "power_percent": 100.0 * (power / reference - 1.0),
        "power_noise_percent": 100.0 * float(np.linalg.norm(traced.power_error)) / reference,
        "efficiency_percent": 100.0
        * (power - reference)
        / (scene.dni * float(scene.mirrors.area.sum())),
        "cells_percent": 100.0 * apart / peak,
        "cells_noise_percent": 100.0 * _rms(traced.error) / peak,
        "seconds": seconds,
        "rays_seconds": time.perf_counter() - begin,
    }


def _rms(values: Sequence[FloatArray]) -> float:
    return float(np.sqrt(np.mean(np.concatenate([each.ravel() for each in values]) ** 2)))


def blocking(known: _halos.Published, rays: float) -> dict[str, float | int]:
    """Return how blocking by the engine and by SolarPILOT differ from rays where both differ."""
    scene, theirs = known.scene(), known.shares["blocking"]
    ours = Shading(scene).lit.blocking
    chosen = _halos.decided(theirs, ours, scene)
    traced = _halos.traced_blocking(scene, chosen, rays)
    truth, count = traced.blocking[chosen], traced.count[chosen]
    away = {"ours": ours[chosen] - truth, "solarpilot": theirs[chosen] - truth}
    found: dict[str, float | int] = {
        "blocking_mirrors": int(chosen.sum()),
        "blocking_rays_noise": _rms([np.sqrt(truth * (1.0 - truth) / count)]),
        "blocking_ours_closer": int((np.abs(away["ours"]) < np.abs(away["solarpilot"])).sum()),
    }
    for name, values in away.items():
        found[f"blocking_{name}_rms"] = _rms([values])
        found[f"blocking_{name}_most"] = float(np.abs(values).max())
    return found


def run(quick: bool) -> Result:
    """Measure; see the module's docstring."""
    rows: list[Row] = []
    for name, making, light in fields(quick):
        place = making(np.array([0.0, 0.0, 1.0])).mirrors.center.mean(axis=0)
        # Noon, as seen from the field: the sun stands behind the tower.
        noon = 0.0 if place[1] < 0.0 else 180.0
        for elevation, away in SUNS:
            sun = direction(np.radians(noon + away), np.radians(elevation))
            row = compare(making(sun), light, FEW if quick else MORE.get(name, RAYS))
            rows.append({"field": name, "elevation_deg": elevation, **row})
    power = max(abs(float(row["power_percent"] or 0.0)) for row in rows)
    cells = max(float(row["cells_percent"] or 0.0) for row in rows)
    kept = all(_kept(row) for row in rows)
    headline = f"power within {power:.3f} % of rays, cells within {cells:.2f} % of the peak (RMS)"
    figures: dict[str, float | int | str] = {"largest_power_percent": power}
    if (known := halos()) is not None:
        figures |= blocking(known, FEW if quick else RAYS)
    return Result(rows, headline, figures, None if quick else kept)


def _kept(row: Row) -> bool:
    flat = "flat" in str(row["field"])
    low = float(row["elevation_deg"] or 0.0) < 30.0
    cells = BUDGET["flat, low" if low else "flat"] if flat else BUDGET["cells"]
    return bool(
        abs(float(row["power_percent"] or 0.0)) <= 100.0 * BUDGET["power"]
        and abs(float(row["efficiency_percent"] or 0.0)) <= 100.0 * BUDGET["efficiency"]
        and float(row["cells_percent"] or 0.0) <= 100.0 * cells
    )
