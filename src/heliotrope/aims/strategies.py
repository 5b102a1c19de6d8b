"""Chooses aims without an optimiser, for comparison: middle, spread, image-size priority."""

from typing import Literal

import numpy as np

from heliotrope.aims import _choice_kernels as kernels
from heliotrope.aims.candidates import Candidates, surface_in
from heliotrope.geometry import FloatArray
from heliotrope.optics.scene import Scene
from heliotrope.optics.shading import IntArray
from heliotrope.optics.surfaces import Plate

#: Beams of "spread" and "image-size" stay this many standard deviations within the edge.
INSIDE = 2.0
Strategy = Literal["middle", "spread", "image-size", "gradient", "optimal"]
#: Names, in the order of a comparison.
STRATEGIES: tuple[Strategy, ...] = ("middle", "spread", "image-size", "gradient", "optimal")


def choose(field: Candidates, scene: Scene, strategy: Strategy) -> IntArray:
    """Return the candidate that each mirror takes, (H,).

    Parameters
    ----------
    field
        Candidates of the scene's mirrors.
    scene
        The scene for which the candidates were computed.
    strategy
        "middle": all mirrors aim at half height; "spread": each mirror in turn takes the next of
        its heights; "image-size": beginning with the widest beam, each mirror aims where the flux
        so far is lowest (SolarPILOT's image size priority: Wagner and Wendelin, *Solar Energy* 171
        (2018) 185).
    """
    count, heights = len(field.weight), field.shifts.shape[1]
    middle = heights * (field.images.looks // 2)
    if strategy == "middle":
        return np.full(count, middle + heights // 2)
    surface = surface_in(scene)
    step = surface.height / surface.shape[0]
    inside = np.abs(field.shifts) * step <= 0.5 * surface.height - INSIDE * field.width[:, None]
    inside[:, heights // 2] = True
    if strategy == "spread":
        turn = np.arange(count) % inside.sum(axis=1)
        return np.asarray(middle + inside.argmax(axis=1) + turn)
    choice, flux = np.full(count, -1), np.zeros(field.images.shape[::-1])
    order = np.argsort(-field.width, kind="stable")
    cells = np.full((*field.aims.shape[:2], 2), -1)
    here = slice(middle, middle + heights)
    cells[:, here] = np.where(inside[..., None], _cells(scene, field.aims[:, here]), -1)
    kernels.place(order, field.table, field.shifts, cells, choice, flux)
    return choice


def _cells(scene: Scene, points: FloatArray) -> IntArray:
    """Return the column and the row of the cells that contain points on the receiver, (..., 2)."""
    surface = surface_in(scene)
    rows, columns = surface.shape
    away = points - surface.center
    if isinstance(surface, Plate):
        across, axis = away @ surface.right / surface.width + 0.5, surface.up
    else:
        low, high = surface.span
        angle = np.arctan2(away @ surface.side, away @ surface.front) - low
        across, axis = (angle % (2.0 * np.pi)) / (high - low), surface.axis
    along = away @ axis / surface.height + 0.5
    both = np.stack([across * columns, along * rows], axis=-1).astype(np.int64)
    return np.clip(both, 0, [columns - 1, rows - 1])
