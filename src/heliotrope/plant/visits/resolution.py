"""How finely a heliostat's drives move its beam on a target."""

import numpy as np
import numpy.typing as npt

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.controller import PlantController

Rows = npt.NDArray[np.intp]

#: Minimum size of a coded movement, in steps in which a beam follows its aim. Each end of a
#: movement is wrong by up to half a step, so a movement of this size is wrong by up to a quarter.
#: If the movement of a beam differs by 0.3 from that of its light, the light is taken for that of
#: two beams (`imaging.coded`).
LEAST_STEPS = 2.0
#: Number of steps over which a beam's motion is a straight line.
_STRAIGHT = 10.0


def beam_slopes(
    plant: PlantController, row: int | Rows, target: Target, sun: FloatArray, counts: FloatArray
) -> FloatArray:
    """Return the displacement of beams on a target per drive step, ENU, m, (..., 2, 3).

    Parameters
    ----------
    plant, row
        The plant, and indices of heliostats, (...).
    target, sun
        The target, and the unit vector to the sun, (3,).
    counts
        Step counts of the drives, (..., 2).
    """
    drives = Drive(plant.beams.drives.table[row])
    armature = Armature(plant.beams.armature.table[row])

    def point(at: FloatArray) -> FloatArray:
        normal, vertex = armature.pose(np.asarray(drives.angles(at)))
        return np.asarray(target.intersect(vertex, reflect(sun, normal)))

    here = point(counts)
    moved = [here - point(counts - step) for step in _STRAIGHT * np.eye(2)]
    return np.stack(moved, axis=-2) / _STRAIGHT


def beam_steps(
    plant: PlantController, rows: Rows, target: Target, sun: FloatArray, aims: FloatArray
) -> FloatArray:
    """Return the steps in which beams follow their aims, m right and up on the target, (K, 2).

    In fine stepping a drive stops at whole counts. A drive with backlash follows a goal that moves
    down only once the goal has moved by the lead (`AxisLimits.lead`).

    Parameters
    ----------
    plant, target, sun
        As in `beam_slopes`.
    rows, aims
        Indices of the heliostats, (K,), and aims of their beams, ENU, m, (K, 3).
    """
    counts = plant.beams.poses(rows, aims, sun).best_counts
    slopes = np.abs(beam_slopes(plant, rows, target, sun, counts) @ target.axes.T)
    machines = [plant.beams.machines.get(plant.beams.names[row]) for row in rows]
    each = [
        (1, 1) if machine is None else [max(1, axis.lead) for axis in machine.axes]
        for machine in machines
    ]
    leads = np.array(each, dtype=np.float64).reshape(-1, 1, 2)
    return np.asarray(np.nan_to_num((leads @ slopes)[:, 0]))
