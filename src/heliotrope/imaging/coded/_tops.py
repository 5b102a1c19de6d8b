"""Find a beam in the pictures of its movement with a matched filter."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray
from heliotrope.imaging.coded._bells import slopes
from heliotrope.imaging.coded.stack import Stack

#: Two peaks with the same code are at least this many standard deviations of a beam apart.
_APART = 3.0


@dataclass(frozen=True)
class Top:
    """The strongest beam that follows a code.

    Attributes
    ----------
    place
        m, (2,).
    power
        Brightness m².
    significance
        Power, in robust standard deviations of the filter output over the surface.
    second
        Power of the second strongest beam, as a fraction of ``power``.
    """

    place: FloatArray
    power: float
    significance: float
    second: float


def find_top(
    stack: Stack,
    picture: FloatArray,
    moments: FloatArray,
    axes: npt.NDArray[np.intp],
    others: Sequence[FloatArray] = (),
) -> Top:
    """Return the strongest beam in the pictures (A, N) of a movement.

    Parameters
    ----------
    stack
        The prepared stack, with N seen pixels.
    picture
        Change per metre of movement along each of the axes.
    moments
        Expected second moments of the beam, m², (2, 2).
    axes
        The A axes of the movement.
    others
        Positions of beams that were subtracted from the pictures. What remains near them is the
        error of their shapes, not a beam.
    """
    from scipy.signal import fftconvolve

    reach = int(np.ceil(3.0 * np.sqrt(np.trace(moments)) / stack.step))
    line = stack.step * np.arange(-reach, reach + 1)
    right, up = np.meshgrid(line, -line)
    points = np.stack([right.ravel(), up.ravel()], axis=-1)
    template = slopes(points, np.zeros(2), moments)[axes].reshape(-1, *right.shape)
    full = np.zeros((len(axes), *stack.seen.shape))
    full[:, stack.seen] = picture
    # A convolution flips the template, which is an odd function.
    score = -sum(fftconvolve(full[a], template[a], mode="same") for a in range(len(axes)))
    norm = (template**2).sum()
    power = np.asarray(score / norm)
    x, y = stack.axes
    spread = float(np.sqrt(0.5 * np.trace(moments)))
    free = np.ones(power.shape, dtype=np.bool_)
    for right_of, above in others:
        free &= np.hypot(x[None, :] - right_of, y[:, None] - above) > _APART * spread
    best = np.unravel_index(int(np.argmax(np.where(free, power, -np.inf))), power.shape)
    place = np.array([x[best[1]], y[best[0]]])
    away = np.hypot(x[None, :] - place[0], y[:, None] - place[1]) > _APART * spread
    beside = power[away & stack.seen]
    # This is the noise of the filter away from the beam; half of the pixels lie within 0.674 σ.
    noise = float(np.median(np.abs(beside))) / 0.674 if beside.size else np.inf
    top = float(power[best])
    second = float(power[away & stack.seen & free].max(initial=0.0))
    return Top(
        place,
        top,
        top / max(noise, 1e-300),
        second / top if top > 0.0 else 0.0,
    )
