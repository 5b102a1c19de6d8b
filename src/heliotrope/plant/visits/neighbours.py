"""Corrects a photographed centroid for the shift caused by shading and blocking neighbours.

The plant knows the poses of the neighbours, because their step counts are reported and their
mechanisms are believed. Most mirrors are unobstructed, as a quick corner test shows; the shift
of an obstructed mirror takes some milliseconds, and is computed outside the event loop.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from heliotrope.calibration.obstruction import UNKNOWN, shift_of
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import Drive
from heliotrope.optics import Mirrors, Scene, Shading, nearest
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.state import FieldState
from heliotrope.plant.visits.photographs import Shot, TargetCamera
from heliotrope.plant.workers import Worker

#: An axis is moving if it is further than this from its goal, rad.
_TURNS = 2e-3
#: Age of step counts above which the shift is unknown, s.
_OLD = 30.0


@dataclass(frozen=True)
class Standing:
    """The poses of the N heliostats of a field when a photograph was taken.

    Attributes
    ----------
    counts, goals
        Step counts as last known, and their goals, (N, 2).
    at
        When the counts were valid, monotonic s, (N,); minus infinity if they were never known.
    """

    counts: FloatArray
    goals: FloatArray
    at: FloatArray

    @classmethod
    def of(cls, field: FieldState) -> "Standing":
        """Return the present poses of a field."""
        every = np.arange(len(field), dtype=np.intp)
        return cls(field.posed.copy(), field.goals(every), field.posed_at.copy())


class Unhidden:
    """Corrects centroids for obstruction by neighbours.

    Parameters
    ----------
    plant
        Plant that knows the positions, sizes and step counts of the mirrors.
    worker
        Function that computes a shift.
    """

    def __init__(self, plant: PlantController, worker: Worker) -> None:
        self._plant, self._worker = plant, worker
        found = [plant.design.find(name) for name in plant.field.names]
        self._size = np.array([(group.width[i], group.height[i]) for group, i in found])
        self._near = nearest(plant.beams.position)

    async def shot(
        self, target: Target, heliostat: str, shot: Shot, standing: Standing | None = None
    ) -> Shot:
        """Return a shot with the centroid that its mirror would have without neighbours.

        Parameters
        ----------
        target, heliostat
            The target (or receiver face), and the name of the heliostat.
        shot
            The shot as photographed.
        standing
            Poses of the field at the exposure; None: the poses have not changed since.

        Notes
        -----
        The shift of the centroid is uncertain by a quarter of its size (`calibration.obstruction`),
        and by its full size if an obstructing neighbour was moving, or did not report for half a
        minute. Neighbours whose step counts were never known are left out.
        """
        if shot.reasons or not np.isfinite(shot.point).all():
            return shot
        plant, row = self._plant, self._plant.field.place(heliostat)
        stood = Standing.of(plant.field) if standing is None else standing
        rows = np.array([row, *self._near[row]], dtype=np.intp)
        rows = rows[np.isfinite(stood.at[rows])]
        if not (len(rows) > 1 and rows[0] == row):
            return shot
        drives = Drive(plant.beams.drives.table[rows])
        angles = np.asarray(drives.angles(stood.counts[rows]))
        normals, vertices = Armature(plant.beams.armature.table[rows]).pose(angles)
        turns = np.abs(np.asarray(drives.angles(stood.goals[rows])) - angles).max(axis=-1) > _TURNS
        unsure = (turns | (shot.at - stood.at[rows] > _OLD))[1:]
        sun = plant.sun_vector(shot.at - plant.now())
        mirrors = Mirrors.of(vertices, normals, tuple(self._size[rows].T), shot.point)
        hides = Shading(Scene(sun, 0.0, mirrors, ())).hiding(0)
        if not len(hides):
            return shot
        group, place = plant.design.find(heliostat)
        unknown = 1.0 if unsure[hides - 1].any() else UNKNOWN
        shift, spread, hidden = await self._worker(
            partial(shift_of, unknown=unknown),
            group,
            place,
            target,
            shot.point,
            sun,
            vertices[0],
            mirrors.take(hides),
        )
        if not hidden or not np.isfinite(shift).all():
            return shot
        axes = target.axes
        return replace(shot, point=shot.point - shift @ axes).wider(axes.T @ spread @ axes)


class UnhiddenCamera:
    """A target camera whose shots are corrected for obstruction by neighbours.

    Parameters
    ----------
    camera
        Camera that takes the photographs.
    unhidden
        Corrects the photographs.
    """

    def __init__(self, camera: TargetCamera, unhidden: Unhidden) -> None:
        self._camera, self._unhidden = camera, unhidden

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return a heliostat's beam in a new photograph, as if it stood alone."""
        shot = await self._camera.photograph(target, heliostat)
        return await self._unhidden.shot(target, heliostat, shot)
