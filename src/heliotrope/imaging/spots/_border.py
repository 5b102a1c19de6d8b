"""What the border of a target cuts off a beam, estimated from how it falls there."""

from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Image
from heliotrope.imaging.targets.rectify import Mask, Rectified

#: Rays from the centroid.
_RAYS = 120
#: How steeply a beam falls is read over this much before the border, m.
_SLOPE = 0.3
#: It falls as a Gaussian of its second moments does, or up to so many times as steeply.
_STEEPER = 3.0
#: Where it is fainter than this part of its peak it ends; from the second on it goes on.
_ENDS, _GOES_ON = 0.05, 0.25


@dataclass(frozen=True)
class Beyond:
    """Light that the border cuts off.

    Attributes
    ----------
    share
        Of all light, what is cut off included.
    shift
        By how much it moves the centroid, m, (2,).
    most
        By how much it would if the beam went on as a Gaussian however faint, m, (2,).
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
    """Return what of a beam lies beyond the border of what is seen.

    Parameters
    ----------
    picture
        The face.
    soft
        Light of beams, softened, (H, W).
    region
        The beam's, (H, W).
    total, peak, centroid, moments
        Sum of its light, m², and greatest; its centre, m, and second moments, m², of what
        is seen.

    Notes
    -----
    Along a ray from the centroid the beam is taken as b exp((r0² − r²)/2σ²) beyond the
    border at r0, where it has the brightness b, with the σ of the second moments in that
    direction, or less if it falls more steeply before the border. Its light is then b σ² for
    each radian, and its first moment b (σ² r0 + σ³ √(π/2) erfcx(r0/√2σ)).

    Beams of heliostats end where a Gaussian goes on: what lies beyond counts from nothing
    where b is a twentieth of the peak to full where it is a quarter. On 107 rendered beams
    that lose up to a tenth of their light this leaves a third of the shift.
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
    """Where rays leave the seen part of a beam, its brightness, and its logarithm's fall, 1/m.

    The brightness is 0 where they leave it elsewhere than at the border.
    """
    r = picture.step * np.arange(1, int(np.hypot(*picture.shape)))
    pixel = np.round(picture.pixels(centroid + r[:, None, None] * ray)).astype(int)
    column, row = pixel[..., 0], pixel[..., 1]
    there = (row >= 0) & (column >= 0) & (row < picture.shape[0]) & (column < picture.shape[1])
    row, column = np.where(there, row, 0), np.where(there, column, 0)
    inside = there & region[row, column]
    surface = there & picture.surface[row, column]
    each = np.arange(ray.shape[0])
    last = len(r) - 1 - inside[::-1].argmax(axis=0)
    cut = inside.any(axis=0) & ~surface[np.minimum(last + 2, len(r) - 1), each]
    before = np.maximum(last - round(_SLOPE / picture.step), 0)
    light = soft[row[last, each], column[last, each]].astype(np.float64)
    earlier = soft[row[before, each], column[before, each]].astype(np.float64)
    light = np.where(cut, np.maximum(light, 0.0), 0.0)
    steep = np.log(np.maximum(earlier, 1e-6) / np.maximum(light, 1e-6)) / _SLOPE
    return r[last], light, steep
