"""Keep-out volumes as the kernels read them."""

from collections.abc import Sequence

import numpy as np

from heliotrope.field.volumes import Box, Cylinder, Prism, Sphere, Volume
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics import _keep_out_kernels as kernels


def packed(volumes: Sequence[Volume]) -> tuple[FloatArray, FloatArray]:
    """Return the rows (V, SIZE) and corners (C, 2) that the kernels read."""
    table = np.zeros((len(volumes), kernels.SIZE))
    corners: list[FloatArray] = []
    count = 0
    for row, volume in zip(table, volumes, strict=True):
        match volume:
            case Sphere():
                _head(row, kernels.SPHERE, as_float(volume.center), volume.radius)
            case Box():
                half = 0.5 * as_float(volume.size)
                _head(row, kernels.BOX, as_float(volume.center), float(np.linalg.norm(half)))
                row[5:8] = half
                # To the right is (cos, −sin) of the azimuth, forwards (sin, cos).
                row[8:10] = np.cos(volume.azimuth), -np.sin(volume.azimuth)
            case Cylinder():
                start, end = as_float(volume.start), as_float(volume.end)
                length = float(np.linalg.norm(end - start))
                bound = float(np.hypot(0.5 * length, volume.radius))
                _head(row, kernels.CYLINDER, 0.5 * (start + end), bound)
                row[5:8] = (end - start) / length
                row[8:10] = 0.5 * length, volume.radius
            case Prism():
                given = as_float(volume.corners)
                middle = 0.5 * (given.min(axis=0) + given.max(axis=0))
                half_height = 0.5 * (volume.top - volume.bottom)
                wide = float(np.linalg.norm(given - middle, axis=1).max())
                center = np.array([*middle, 0.5 * (volume.top + volume.bottom)])
                _head(row, kernels.PRISM, center, float(np.hypot(wide, half_height)))
                row[5:8] = half_height, count, len(given)
                corners.append(given)
                count += len(given)
    return table, np.concatenate(corners) if corners else np.empty((0, 2))


def _head(row: FloatArray, kind: int, center: FloatArray, bound: float) -> None:
    row[0], row[1:4], row[4] = kind, center, bound
