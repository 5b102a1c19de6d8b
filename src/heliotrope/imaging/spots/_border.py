"""Estimate the light of a beam beyond the target border from its decline at the border."""

from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.rectify import Mask, Rectified

#: Number of rays from the centroid.
_RAYS = 120
#: Distance before the border over which the decline is measured, m.
_SLOPE = 0.3
#: Maximum decline, relative to a Gaussian of the beam's second moments.
_STEEPER = 3.0
#: If its brightness at the border is below the first fraction of its peak, a beam ends there; above
#: the second, it continues.
_ENDS, _GOES_ON = 0.05, 0.25


@dataclass(frozen=True)
class Beyond:
    """Estimated light beyond the border.

    Attributes
    ----------
    share
        Light beyond the border, as a fraction of all the light of the beam.
    shift
        Shift of the centroid, m, (2,).
    most
        Upper bound of the shift, m, (2,): the shift if the beam continued indefinitely as a
        Gaussian.
    """

    share: float
    shift: FloatArray
    most: FloatArray


NOTHING = Beyond(0.0, np.zeros(2), np.zeros(2))


def beyond(
    picture: Rectified,
    soft: Image,
    region: Mask,
    total: float,
    peak: float,
    centroid: FloatArray,
    moments: FloatArray,
) -> Beyond:
    """Return the light of a beam beyond the border of the visible target.

    Parameters
    ----------
    picture
        The face.
    soft
        Light of beams, smoothed, (H, W).
    region
        Pixels of the beam, (H, W).
    total, peak, centroid, moments
        Sum, m², maximum, centre, m, and second moments, m², of the visible light.

    Notes
    -----
    Consider a ray from the centroid that crosses the border at r0, where the brightness is b.
    Beyond the border the beam is assumed to be b exp((r0² − r²)/2σ²). σ follows from the second
    moments in this direction, and is smaller if the beam falls more steeply just before the border.
    The light is then b σ² per radian, and its first moment b (σ² r0 + σ³ √(π/2) erfcx(r0/√2σ)).

    Heliostat beams end where a Gaussian would continue, so the light beyond the border is weighted
    from 0, where b is a twentieth of the peak, to 1, where b is a quarter of it. For 107 rendered
    beams that lose up to a tenth of their light, a third of the shift remains uncorrected.
    """
    from scipy.special import erfcx

    turn = np.arange(_RAYS) * (2.0 * np.pi / _RAYS)
    ray = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    r0, light, steep = _at_border(picture, soft, region, centroid, ray)
    if not (light > 0.0).any() or total <= 0.0:
        return NOTHING
    floor = np.eye(2) * (2.0 * picture.step) ** 2
    square = 1.0 / np.einsum("ti,ij,tj->t", ray, np.linalg.inv(moments + floor), ray)
    gaussian = np.maximum(r0 - 0.5 * _SLOPE, picture.step) / square
    square = square / np.clip(steep / gaussian, 1.0, _STEEPER)
    sigma = np.sqrt(square)
    part = 2.0 * np.pi / _RAYS
    tail = np.sqrt(0.5 * np.pi) * erfcx(r0 / (np.sqrt(2.0) * sigma))
    power, moment = light * square * part, light * square * (r0 + sigma * tail) * part
    goes_on = np.clip((light / peak - _ENDS) / (_GOES_ON - _ENDS), 0.0, 1.0)
    lost, most = float(goes_on @ power), float(power.sum())
    return Beyond(
        lost / (total + lost),
        np.asarray((goes_on * moment) @ ray / (total + lost)),
        np.asarray(moment @ ray / (total + most)),
    )


def _at_border(
    picture: Rectified, soft: Image, region: Mask, centroid: FloatArray, ray: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return where rays leave a beam, the brightness there, and the logarithmic decline, 1/m.

    The brightness is 0 for rays that leave the beam before they reach the border.
    """
    r = picture.step * np.arange(1, int(np.hypot(*picture.shape)))
    pixel = np.round(picture.pixels(centroid + r[:, None, None] * ray)).astype(int)
    column, row = pixel[..., 0], pixel[..., 1]
    valid = (row >= 0) & (column >= 0) & (row < picture.shape[0]) & (column < picture.shape[1])
    row, column = np.where(valid, row, 0), np.where(valid, column, 0)
    inside = valid & region[row, column]
    surface = valid & picture.surface[row, column]
    index = np.arange(ray.shape[0])
    last = len(r) - 1 - inside[::-1].argmax(axis=0)
    cut = inside.any(axis=0) & ~surface[np.minimum(last + 2, len(r) - 1), index]
    before = np.maximum(last - round(_SLOPE / picture.step), 0)
    light = soft[row[last, index], column[last, index]].astype(np.float64)
    earlier = soft[row[before, index], column[before, index]].astype(np.float64)
    light = np.where(cut, np.maximum(light, 0.0), 0.0)
    steep = np.log(np.maximum(earlier, 1e-6) / np.maximum(light, 1e-6)) / _SLOPE
    return r[last], light, steep
