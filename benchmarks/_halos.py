"""904 heliostats with the efficiencies that SolarPILOT computed for each (NREL/HALOS).

The sun, the size of the mirrors and the receiver are not in the file; they were found by fitting
its cosine, attenuation and blocking.
"""

import csv
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from heliotrope.geometry import FloatArray, bisector, direction, normalize
from heliotrope.optics import FieldOptics
from heliotrope.optics.rays import RayTrace, trace
from heliotrope.optics.scene import Mirrors, Scene
from heliotrope.optics.surfaces import Cylinder

#: Sides of the mirrors, m; its sun; its light.
SIDE = 12.0
SUN = direction(np.radians(192.654), np.radians(78.319))
LIGHT = FieldOptics(shape="quartic")
#: Blocking that differs by more than this is put to the rays.
APART = 5e-4
#: Receiver: height of its middle, radius and height, m.
_MIDDLE, _RADIUS, _TALL = 150.0, 8.5, 21.0
#: Columns of the file that hold efficiencies.
_SHARES = {"cosine": "Cosine eff", "air": "Attenuation", "blocking": "Blocking"}


@dataclass(frozen=True, eq=False)
class Published:
    """Positions and aims, ENU m, (904, 3), and SolarPILOT's efficiencies by name, (904,)."""

    position: FloatArray
    aim: FloatArray
    shares: dict[str, FloatArray]

    def scene(self, sun: FloatArray = SUN) -> Scene:
        """Return the scene: mirrors focused at their slant range, and the receiver."""
        normal = bisector(np.broadcast_to(sun, self.aim.shape), normalize(self.aim - self.position))
        mirrors = Mirrors.of(
            self.position, normal, (SIDE, SIDE), self.aim, slope=1.53e-3, reflectivity=0.95,
            clean=0.95,
        )  # fmt: skip
        up, north = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])
        receiver = Cylinder("receiver", _MIDDLE * up, up, north, _RADIUS, _TALL)
        return Scene(sun, 950.0, mirrors, (receiver,))


def read(fields: Path) -> Published | None:
    """Return the heliostats from the folder of published fields; None if they are not there."""
    path = fields / "halos" / "radial-daggett-50.csv"
    if not path.is_file():
        return None
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))

    def of(name: str) -> FloatArray:
        return np.array([float(row[name]) for row in rows])

    position, aim = (np.stack([of(f"{w}-{c}") for c in "xyz"], axis=-1) for w in ("Pos", "Aim"))
    return Published(position, aim, {name: of(column) for name, column in _SHARES.items()})


def summed_blocking(scene: Scene) -> FloatArray:
    """Return blocking by SolarPILOT's rule, (H,).

    A neighbour's upper corner is carried along the beam into the mirror's plane. If it lies on the
    mirror, all that is below it and to its side is lost, and the losses by all neighbours are
    added.
    """
    mirrors = scene.mirrors
    rays, half = normalize(mirrors.aim - mirrors.center), 0.5 * SIDE
    lost = np.zeros(len(mirrors))
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


def decided(shares: FloatArray, ours: FloatArray, scene: Scene) -> np.ndarray:
    """Return a mask of the mirrors whose blocking differs and that the file can decide on, (H,).

    46 mirrors are blocked by heliostats that the file lacks: nothing in it is before them, by the
    exact union or by SolarPILOT's own rule.
    """
    alone = (ours == 1.0) & (summed_blocking(scene) == 1.0)
    return np.asarray((np.abs(ours - shares) > APART) & ~alone)


def traced_blocking(scene: Scene, chosen: np.ndarray, rays: float) -> RayTrace:
    """Trace rays from the chosen mirrors (a mask, (H,)); all mirrors of the scene block."""
    return trace(replace(scene, dark=~chosen), rays, sun=LIGHT.shape, air=LIGHT.air, seed=1)
