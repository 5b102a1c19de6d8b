"""Simple centroids for comparison.

Neither gives a covariance or reports a failure; `heliotrope.imaging.spots.spot` does.
"""

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.spots.background import Background
from heliotrope.imaging.targets.rectify import Rectified


def threshold_centroid(
    picture: Rectified, background: Background, low: float = 0.2, high: float = 0.985
) -> FloatArray | None:
    r"""Return the intensity-weighted centroid between two thresholds, m in the face's plane, (2,).

    Our reading of Malan, §5.6, (5.2)-(5.4); the text of the thesis was not available, and
    the constants are ours. The empty target is subtracted, d = v - b, and

    .. math:: w = d \text{ where } t_{low} < d \text{ and } v < t_{high}, \text{ else } 0,
              \qquad t_{low} = \bar d + low (d_{max} - \bar d)

    .. math:: c = Σ w p / Σ w

    over the places p of the target.

    Parameters
    ----------
    picture, background
        A face, and the same without beams.
    low
        Lower threshold between the mean and the greatest difference.
    high
        Pixels above this share of the full scale count as clipped and are left out.

    Returns
    -------
    None if no pixel lies between the thresholds.
    """
    difference = np.where(picture.paint, picture.values - background.values, 0.0)
    mean = float(difference[picture.paint].mean()) if picture.paint.any() else 0.0
    threshold = mean + low * (float(difference.max()) - mean)
    weight = np.where((difference > threshold) & (picture.values < high), difference, 0.0)
    return _mean_place(picture, weight)


def moments_centroid(picture: Rectified) -> FloatArray | None:
    """Return the centre of the pixels above Otsu's threshold, m in the face's plane, (2,).

    Plain OpenCV: ``threshold`` with ``THRESH_OTSU``, then ``moments`` of the binary picture.

    Returns
    -------
    None if nothing is bright.
    """
    import cv2

    scaled = np.where(picture.paint, picture.values, 0.0) * 255.0
    grey = np.clip(scaled, 0.0, 255.0).astype(np.uint8)
    _, bright = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    found = cv2.moments(bright, binaryImage=True)
    if found["m00"] <= 0.0:
        return None
    column, row = found["m10"] / found["m00"], found["m01"] / found["m00"]
    return picture.plane(np.array([column, row]))


def _mean_place(picture: Rectified, weight: FloatArray) -> FloatArray | None:
    total = float(weight.sum())
    if total <= 0.0:
        return None
    x, y = picture.axes
    return np.array([weight.sum(axis=0) @ x, weight.sum(axis=1) @ y], dtype=np.float64) / total
