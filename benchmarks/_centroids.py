"""Simple centroids for comparison.

Neither gives a covariance or reports a failure; `heliotrope.imaging.spots.spot` does.
"""

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.imaging.targets.rectify import Rectified


def marker_threshold(values: FloatArray) -> float:
    """Return Malan's T1, (5.2): pixels below it are his black markers.

    T1 = darkest + 0.2 · lightest, over the pixels of the cropped target.
    """
    return float(values.min() + 0.2 * values.max())


def malan_centroid(picture: Rectified) -> FloatArray | None:
    """Return Malan's centroid, (5.3)-(5.4), m in the face's plane, (2,).

    T2 = (mean + lowest) / 2; pixels below it become black, and the centroid is the centre of mass
    of what is left, weighted by brightness. The threshold lies below the mean, so the lit paint
    beside the beam keeps its weight and draws the centroid towards the target's middle.

    Parameters
    ----------
    picture
        The rectified face. Its paint stands for his picture cropped to the target.

    Returns
    -------
    None if the picture is black.
    """
    paint = picture.values[picture.paint]
    if not paint.size:
        return None
    threshold = 0.5 * (float(paint.mean()) + float(paint.min()))
    kept = picture.paint & (picture.values >= threshold)
    return _mean_place(picture, np.where(kept, picture.values, 0.0))


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
