"""How finely the drives of a heliostat move its beam on a target."""

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, reflect
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.plant.controller import PlantController

#: A coded movement has at least this many of the steps in which a beam follows its aim. The ends of
#: a movement are each off by half a step at most, so its size is off by a quarter; a beam that
#: moves by 0.3 more or less than its light says is taken for two (`imaging.coded`).
LEAST_STEPS = 2.0
#: Steps over which a beam's motion is a straight line.
_STRAIGHT = 10.0


def beam_slopes(
    plant: PlantController, row: int, target: Target, sun: FloatArray, counts: FloatArray
) -> FloatArray:
    """Return how far a step of each drive moves a beam on the plane of a target, ENU, m, (2, 3).

    Parameters
    ----------
    plant, row
        The plant, and the row of the heliostat.
    target, sun
        The target, and the unit vector to the sun, (3,).
    counts
        Step counts of the drives, (2,).
    """
    drives = Drive(plant.beams.drives.table[row])
    armature = Armature(plant.beams.armature.table[row])

    def point(at: FloatArray) -> FloatArray:
        normal, vertex = armature.pose(np.asarray(drives.angles(at)))
        return np.asarray(target.intersect(vertex, reflect(sun, normal)))

    here = point(counts)
    return np.stack([here - point(counts - step) for step in _STRAIGHT * np.eye(2)]) / _STRAIGHT


def beam_steps(
    plant: PlantController, row: int, target: Target, sun: FloatArray, aim: FloatArray
) -> FloatArray:
    """Return the steps in which a beam follows its aim, m right and up on the target, (2,).

    In fine stepping a drive stops at whole counts. One that has play follows a goal that goes down
    only once it has gone by the lead (`AxisLimits.lead`).

    Parameters
    ----------
    plant, row, target, sun
        As for `beam_slopes`.
    aim
        Of the beam, ENU, m, (3,).
    """
    counts = plant.beams.poses(np.array([row]), aim[None], sun).best_counts[0]
    slopes = np.abs(beam_slopes(plant, row, target, sun, counts) @ target.axes.T)
    machine = plant.beams.machines.get(plant.beams.names[row])
    each = [1, 1] if machine is None else [max(1, axis.lead) for axis in machine.axes]
    return np.asarray(np.nan_to_num(np.array(each) @ slopes))
