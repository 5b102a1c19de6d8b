"""904 heliostats, each with the efficiencies that SolarPILOT computed at one sun (NREL/HALOS)."""

import csv
from typing import NamedTuple

import numpy as np

from heliotrope.geometry import FloatArray, bisector, direction, normalize
from heliotrope.optics.attenuation import air_loss
from heliotrope.optics.scene import Mirrors, Scene
from heliotrope.optics.shading import Shading
from support.data import fields

#: Sides of the mirrors, m, found by fitting the blocking.
SIDE = 12.0


class Known(NamedTuple):
    """The scene, and SolarPILOT's columns."""

    scene: Scene
    columns: dict[str, FloatArray]


def read() -> Known:
    with (fields() / "halos" / "radial-daggett-50.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def of(name: str) -> FloatArray:
        return np.array([float(row[name]) for row in rows])

    position, aim = (np.stack([of(f"{w}-{c}") for c in "xyz"], axis=-1) for w in ("Pos", "Aim"))
    sun = direction(np.radians(192.654), np.radians(78.319))
    normal = bisector(sun, normalize(aim - position))
    mirrors = Mirrors.of(position, normal, (SIDE, SIDE), aim, focal=np.inf)
    names = {"cosine": "Cosine eff", "air": "Attenuation", "blocking": "Blocking"}
    return Known(Scene(sun, 950.0, mirrors, ()), {k: of(v) for k, v in names.items()})


def by_its_own_rule(mirrors: Mirrors, rays: FloatArray) -> FloatArray:
    """Blocking as SolarPILOT sums it: the rectangle below each neighbour's upper corner.

    The corner is carried along the beam into the mirror's plane. If it lies on the mirror, all
    that is below it and to its side is lost, and the losses by all neighbours are added.
    """
    lost = np.zeros(len(mirrors))
    half = 0.5 * SIDE
    for i in range(len(mirrors)):
        away = np.linalg.norm(mirrors.center - mirrors.center[i], axis=-1)
        for j in np.flatnonzero((away < 60.0) & (away > 0.0)):
            for side in (-1.0, 1.0):
                corner = mirrors.center[j] + half * (side * mirrors.right[j] + mirrors.up[j])
                off = corner - mirrors.center[i]
                along = (off @ mirrors.normal[i]) / (rays[i] @ mirrors.normal[i])
                off = off - along * rays[i]
                x, y = off @ mirrors.right[i], off @ mirrors.up[i]
                if along > 0.0 and max(abs(x), abs(y)) < half:
                    lost[i] += (half + side * x) * (half + y) / SIDE**2
                    break
    return 1.0 - lost


def test_cosine_and_air_are_solarpilot_s() -> None:
    known = read()
    assert np.abs(known.scene.incidence - known.columns["cosine"]).max() < 1e-4
    loss = air_loss(known.scene.mirrors.slant)
    assert np.abs(1.0 - loss - known.columns["air"]).max() < 1e-4


def test_its_blocking_is_found_by_its_rule_and_differs_from_the_exact_union() -> None:
    known = read()
    mirrors, theirs = known.scene.mirrors, known.columns["blocking"]
    exact = Shading(known.scene).lit
    # Under a sun at 78° nothing is shaded.
    assert exact.shading.min() == 1.0
    difference = exact.blocking - theirs
    assert np.sqrt(np.mean(difference**2)) < 3.8e-3
    assert np.abs(difference).max() < 0.0235
    ruled = by_its_own_rule(mirrors, normalize(mirrors.aim - mirrors.center))
    # 46 rows are blocked by heliostats that the file lacks; in 54 it leaves out a blocker that
    # the file has. In the others the two are alike.
    both = (ruled < 1.0) & (theirs < 1.0)
    assert both.sum() == 61
    assert np.abs(ruled - theirs)[both].max() < 3e-4
    neither = (ruled == 1.0) & (theirs == 1.0)
    assert (exact.blocking[neither] > 0.999).all()
