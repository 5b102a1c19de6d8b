r"""Aims found by gradient ascent, for comparison: each aim moves continuously on the receiver.

The objective is the power less the penalties of an augmented Lagrangian for the flux limit, and its
gradient is that of the flux engine, with shading and blocking held fixed in each step. Adam (Kingma
and Ba, arXiv:1412.6980) moves the aims; each then stays in the region of the candidates. No mirror
is defocused.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from heliotrope.aims.candidates import on_receiver, regions, surface_in
from heliotrope.aims.optimiser import Step
from heliotrope.geometry import FloatArray, as_float, normalize, reflect
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import Scene

#: Number of steps; each costs one computation of the whole field.
STEPS = 120
#: First and last length of a step, as a fraction of the beam's standard deviation.
FIRST, LAST = 0.3, 0.01
#: Memory of Adam's averages of the gradient and of its square.
MEMORY, SQUARE = 0.8, 0.95
#: Penalty for excess flux; see `optimiser.STEEP`. The multipliers change every few steps.
STEEP, EVERY = 30.0, 4
#: Steps between two estimates of what errors may add.
AGAIN = 30


def ascend(
    scene: Scene,
    cap_of: Callable[[FieldFlux], FloatArray],
    start: FloatArray,
    progress: Step | None,
    **light: Any,
) -> tuple[FloatArray, FloatArray]:
    """Return aims, ENU m, (H, 3), and the prices of the cells, W per W/m², (rows, columns).

    Parameters
    ----------
    scene
        Has one receiver; its aims are ignored.
    cap_of
        Returns the flux limit less what errors may add to a flux, W/m², (rows, columns). The flux
        of the result may exceed it.
    start
        Displacement of each first aim to the right and up from the point at half height that faces
        the mirror, m, (H, 2).
    progress
        Called with the number of steps done and their total number.
    **light
        Arguments of `FieldFlux`.
    """
    width, aside, room = regions(scene)
    edge = np.stack([aside, room], axis=-1)
    place, mean, square = np.clip(start, -edge, edge), np.zeros_like(start), np.zeros_like(start)
    area = float(surface_in(scene).cells.area[0])
    prices = cap = np.zeros(surface_in(scene).shape)
    for k in range(STEPS):
        aims = on_receiver(scene, place)
        engine = FieldFlux(scene.with_mirrors(scene.mirrors.toward(scene.sun, aims)), **light)
        if k % AGAIN == 0:
            cap = cap_of(engine)
        charged = np.maximum(prices + STEEP * area / cap * (engine.maps[0] - cap), 0.0)
        if k % EVERY == EVERY - 1:
            prices = charged
        slope = _uphill(engine, place, 1.0 - charged / area)
        mean = MEMORY * mean + (1.0 - MEMORY) * slope
        square = SQUARE * square + (1.0 - SQUARE) * slope**2
        unbiased = mean / (1.0 - MEMORY ** (k + 1))
        size = np.sqrt(square / (1.0 - SQUARE ** (k + 1))).mean(axis=1, keepdims=True)
        length = FIRST * (LAST / FIRST) ** (k / (STEPS - 1)) * width[:, None]
        place = np.clip(place + length * unbiased / np.maximum(size, 1e-12), -edge, edge)
        if progress is not None:
            progress(k + 1, STEPS)
    return on_receiver(scene, place), as_float(prices)


def _uphill(engine: FieldFlux, place: FloatArray, worth: FloatArray) -> FloatArray:
    """Return the derivative of the weighted power with respect to ``place``, W/m, (H, 2)."""
    scene, mirrors, step = engine.scene, engine.scene.mirrors, 1e-3
    slope = engine.power_slope(as_float(worth))
    ray = reflect(np.broadcast_to(scene.sun, mirrors.normal.shape), mirrors.normal)
    right = normalize(np.stack([ray[:, 1], -ray[:, 0], 0.0 * ray[:, 0]], axis=-1))
    axes = np.stack([right, np.cross(right, ray)], axis=1)
    differences = [
        on_receiver(scene, place + s * step) - on_receiver(scene, place - s * step)
        for s in np.eye(2)
    ]
    turned = np.einsum("hkx,mhx->hmk", axes, np.stack(differences)) / (2.0 * step)
    return as_float(np.einsum("hmk,hk->hm", turned, slope) / mirrors.slant[:, None])
