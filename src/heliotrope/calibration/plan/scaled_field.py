"""What is known of all heliostats in a plan, and what a target visit would add at one sun position.

Heliostats are numbered consecutively over all fleets. Parameters are scaled by their current
standard deviations, so that metres and radians have equal weight, and padded to the number of the
largest model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan.fleets import Fleet
from heliotrope.calibration.plan.planning import SightingLimits, aim_at, sighting_jacobian
from heliotrope.calibration.uncertainty import CHUNK
from heliotrope.errors import InputError
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import SLOTS
from heliotrope.mechanism.tracking import track


@dataclass(frozen=True)
class TargetView:
    """Some heliostats aimed at one target at one instant.

    Attributes
    ----------
    able
        Whether each pose is within the stops and limits, (N,).
    slope
        Whitened derivative with respect to the scaled parameters, (N, 2, P).
    seconds
        Slew time from the aim to the target, s, (N,).
    counts
        Drive counts, (N, D).
    """

    able: npt.NDArray[np.bool_]
    slope: FloatArray
    seconds: FloatArray
    counts: FloatArray


class ScaledField:
    """N heliostats of all fleets, with covariances of P scaled parameters.

    Attributes
    ----------
    fleets, offsets
        The fleets, and the index of each fleet's first heliostat.
    covariance, form
        Covariance of the scaled parameters, and form of the squared beam error, (N, P, P).
    counted
        Number of heliostats that can serve their aim.

    Raises
    ------
    InputError
        If no heliostat can serve its aim.
    """

    def __init__(self, fleets: Sequence[Fleet], limits: SightingLimits) -> None:
        self.fleets, self.limits = tuple(fleets), limits
        sizes = [len(f) for f in fleets]
        self.offsets = np.concatenate([[0], np.cumsum(sizes)])
        total, most = int(self.offsets[-1]), max(len(f.names) for f in fleets)
        self.covariance = np.broadcast_to(np.eye(most), (total, most, most)).copy()
        self.form = np.zeros((total, most, most))
        self._scale = np.ones((total, most))
        for k, fleet in enumerate(fleets):
            part, p = slice(self.offsets[k], self.offsets[k + 1]), len(fleet.names)
            scale = 1.0 / np.sqrt(np.diagonal(fleet.information, axis1=1, axis2=2))
            both = scale[:, :, None] * scale[:, None]
            self.covariance[part, :p, :p] = np.linalg.inv(fleet.information * both)
            self.form[part, :p, :p] = fleet.form * both
            self._scale[part, :p] = scale
        self.counted = int(self.form.any(axis=(1, 2)).sum())
        if not self.counted:
            raise InputError("campaign: no heliostat can reach its aim point; check aims and stops")
        self._armatures = [f.mechanism.armature.table for f in fleets]

    def __len__(self) -> int:
        return len(self.covariance)

    def squares(self, rows: npt.NDArray[np.intp] | slice = slice(None)) -> FloatArray:
        """Return the expected squared beam error of ``rows`` (default: all), rad², (K,)."""
        return np.asarray(np.einsum("npq,nqp->n", self.form[rows], self.covariance[rows]))

    def part(self, k: int, rows: slice, sun: FloatArray, target: Target) -> TargetView:
        """Return heliostats ``rows`` of fleet ``k`` aimed at a target."""
        fleet = self.fleets[k]
        some, armature = fleet.mechanism[rows], Armature(self._armatures[k][rows])
        home = track(armature, sun, fleet.aim[rows], drives=some.drives)
        stand = home.best_counts
        stand = np.where(np.isfinite(stand), stand, 0.0)
        aimed = aim_at(some, sun, target, self.limits, current=stand)
        speed = some.drives.table[..., SLOTS["speed"]]
        able, p = aimed.able, len(fleet.names)
        seconds = np.full(len(able), np.inf)
        seconds[able] = (np.abs(aimed.counts - stand) / speed)[able].max(axis=-1)
        slope = np.zeros((len(able), 2, self.form.shape[-1]))
        slope[able, :, :p] = sighting_jacobian(
            some[np.flatnonzero(able)],
            aimed.counts[able],
            np.broadcast_to(sun, (int(able.sum()), 3)),
            target,
            fleet.names,
            fleet.sigma,
        )
        mine = slice(self.offsets[k] + rows.start, self.offsets[k] + rows.stop)
        return TargetView(able, slope * self._scale[mine, None], seconds, aimed.counts)

    def single(self, i: int, sun: FloatArray, target: Target) -> TargetView:
        """Return the view of heliostat ``i`` alone, (1,), aimed at a target."""
        k = int(np.searchsorted(self.offsets, i, side="right")) - 1
        row = i - int(self.offsets[k])
        return self.part(k, slice(row, row + 1), sun, target)

    def view(self, sun: FloatArray, target: Target) -> TargetView:
        """Return the view of all heliostats aimed at a target, fleet after fleet."""
        parts = [
            self.part(k, slice(a, min(a + CHUNK, len(fleet))), sun, target)
            for k, fleet in enumerate(self.fleets)
            for a in range(0, len(fleet), CHUNK)
        ]
        return TargetView(
            *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(TargetView))
        )
