"""Random slope maps for simulation; `heliotrope.field.formats.slopes` reads maps from files."""

import numpy as np

from heliotrope.airborne.mirror import MirrorShape
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float


def smooth_slopes(
    shape: MirrorShape,
    generator: np.random.Generator,
    rms: float,
    *,
    length: float = 0.3,
    cells: int = 24,
) -> FloatArray:
    """Return random slope deviations of a mirror, (F, cells, cells, 2), rad.

    Each facet's surface is smooth and random, so that both slopes belong to one surface. The mean
    over each facet is 0, which preserves its canting and the mirror's orientation; the root mean
    square over the mirror is ``rms`` for each of the two components.

    Parameters
    ----------
    shape
        Shape of the mirror.
    generator
        Source of random numbers.
    rms
        RMS of ∂z/∂u and of ∂z/∂v over the mirror, rad.
    length
        Correlation length of the slopes, m, which is that of the Gaussian filter of the heights.
    cells
        Number of cells along each edge of a facet.

    Raises
    ------
    InputError
        If rms is negative, or length or cells is not above 0.
    """
    if not (rms >= 0.0 and length > 0.0 and cells > 1):
        raise InputError(
            f"smooth_slopes: rms {rms} rad, length {length} m and {cells} cells; use an rms of 0 "
            "or more, a length above 0 and at least two cells"
        )
    from scipy.ndimage import gaussian_filter

    slope = np.zeros((len(shape), cells, cells, 2))
    for k, (half_width, half_height) in enumerate(shape.half_size):
        step = np.array([2.0 * half_height, 2.0 * half_width]) / cells
        # A border as wide as the filter ensures that the edges are as rough as the interior.
        border = [int(np.ceil(3.0 * length / s)) for s in step]
        size = [cells + 2 * b for b in border]
        high = gaussian_filter(generator.standard_normal(size), length / step, mode="wrap")
        by_v, by_u = (as_float(g) for g in np.gradient(high, step[0], step[1]))
        inner = tuple(slice(b, b + cells) for b in border)
        slope[k] = np.stack([by_u[inner], by_v[inner]], axis=-1)
    slope -= slope.mean(axis=(1, 2), keepdims=True)
    spread = as_float(np.sqrt(np.mean(slope**2, axis=(0, 1, 2))))
    return as_float(slope * (rms / np.maximum(spread, 1e-300)))
