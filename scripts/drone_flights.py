"""The table of docs/explanation/airborne.md: rendered flights over mirrors that overlap.

``python scripts/drone_flights.py [PHOTOGRAPHS] [FLIGHT …]`` renders and evaluates flights, at most
PHOTOGRAPHS of each (default 100, about two seconds of processor time each), and prints how many
could be used, how many reflections were found on the right mirrors, and true errors beside σ. A
second table says where the reflections were that are shown in a photograph and were not found.

FLIGHT is a station of the default radial field (``heliotrope field layout radial --heliostats 300
--width 3.2 --height 2.54``, then ``drone plan``), such as C1-4, or ``paper``, in HelioPoint's
geometry: mirrors of four facets, 3.2 m by 2.5 m, at 13.5° of elevation and 214° of azimuth, 150 m
away. ``C1-4:7`` or ``paper:7`` has another seed. Without any, it is the paper's flight and those of
the five lowest stations. The flights have all errors of ``drone simulate`` by its defaults;
``clean-paper`` and ``clean-C1-4`` have those of RTK, gimbal, survey, slopes and drives only.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from heliotrope.airborne.photo import LedCamera
from heliotrope.airborne.plan.flight_plan import FlightPlan, PlanSettings, plan_flight
from heliotrope.airborne.simulate.rendered import KINDS, Compared, fly_rendered, paper_flight
from heliotrope.airborne.simulate.rendering import Conditions
from heliotrope.airborne.simulate.simulation import REAL, Errors, Flight, fly, install
from heliotrope.field.layouts import HeliostatSize, lay_out
from heliotrope.field.plant import Plant
from heliotrope.sun import Site

SITE = Site(-28.5, 21.2, 830.0, name="field")
#: The middle of a photograph of 4000 × 3000 px: focal length and size, px.
FOCAL, SIZE = 3000.0, (1800, 1000)
#: Thin clouds, and photographs while the drone moves.
LIGHT = Conditions(clouds=0.1, speed=1.0)


def lens() -> LedCamera:
    """Return the camera, with the distortion of ``drone simulate``."""
    matrix = np.array([[FOCAL, 0, SIZE[0] / 2 - 0.5], [0, FOCAL, SIZE[1] / 2 - 0.5], [0, 0, 1]])
    return LedCamera(SIZE, matrix, np.array([-0.08, 0.06, 3e-4, -2e-4, -0.01]))


def planned(
    plan: FlightPlan, name: str, most: int, seed: int, errors: Errors
) -> tuple[Flight, Plant]:
    """Return the flight of a station over the field of a plan."""
    group = next(iter(plan.plant.groups.values()))
    k = [f"{plan.labels[s.cluster]}-{s.point + 1}" for s in plan.stations].index(name)
    station = plan.stations[k]
    rows = plan.clusters.rows(station.cluster)
    facing = plan.points[station.cluster].facing
    rows, counts = (v[facing.able[station.point]] for v in (rows, facing.counts[station.point]))
    flown = fly(
        group.take(rows),
        lens(),
        counts,
        thinned(station.pattern.camera, most),
        plan.clusters.center[station.cluster],
        errors=errors,
        seed=seed,
        installed=install(group, rows, errors, seed=seed),
        flight=k,
    )
    return flown, plan.plant


def thinned(places: np.ndarray, most: int) -> np.ndarray:
    """Return at most this many places, evenly from all."""
    return places[np.unique(np.linspace(0, len(places) - 1, most).astype(int))]


def line(name: str, found: Compared) -> str:
    """Return a row of the table."""
    error, sigma = (1e3 * float(np.sqrt(np.mean(v**2))) for v in (found.error, found.sigma))
    return (
        f"| {name} | {found.used} of {found.photographs} | {found.found} of {found.shown} | "
        f"{100 * found.identified:.2f} % | {len(found.count)} | {np.median(found.count):.0f} | "
        f"{error:.2f} | {sigma:.2f} | {100 * found.within:.0f} % |"
    )


def main() -> None:
    """Print the table."""
    most = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    names = sys.argv[2:]
    plan = None
    if not names or not all("paper" in name for name in names):
        size = HeliostatSize(3.2, 2.54, 0.5 * 2.54 + 0.7)
        plan = plan_flight(lay_out("radial", 300, mirror=size, site=SITE), PlanSettings())
        low = sorted(plan.stations, key=lambda s: float(s.pattern.direction[2]))[:5]
        names = names or ["paper", *(f"{plan.labels[s.cluster]}-{s.point + 1}" for s in low)]
    print(
        "| flight | photographs used | reflections | identified | mirrors | of each | error |",
        end="",
    )
    print(" σ_tot | in 90 % |\n|---|---|---|---|---|---|---|---|---|")
    missed = {}
    for name in names:
        where, _, number = name.partition(":")
        seed, clean = int(number or 0), where.startswith("clean-")
        errors, light = (Errors(), None) if clean else (REAL, LIGHT)
        where = where.removeprefix("clean-")
        if where == "paper":
            flown, plant = paper_flight(lens(), SITE, errors, seed=seed)
        else:
            assert plan is not None
            flown, plant = planned(plan, where, most, seed, errors)
        with tempfile.TemporaryDirectory() as folder:
            found = fly_rendered(flown, plant, Path(folder), conditions=light, seed=seed)
        print(line(name, found), flush=True)
        missed[name] = found.missed
    print("\n| not found | all | " + " | ".join(KINDS) + " |\n|---|---|" + "---|" * len(KINDS))
    for name, count in missed.items():
        print(f"| {name} | {sum(count.values())} | {' | '.join(map(str, count.values()))} |")


if __name__ == "__main__":
    main()
