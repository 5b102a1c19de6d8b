"""Position of a spot on its target, with the covariance due to spot, view and survey."""

from dataclasses import dataclass

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.spots.spot import Spot
from heliotrope.imaging.targets.rectify import Rectified
from heliotrope.imaging.targets.view import Face


@dataclass(frozen=True)
class PlacedSpot:
    """A spot and its position.

    Attributes
    ----------
    spot
        Shape of the spot, on its face.
    target
        The target on which the centroid lies; None if it is beside all targets.
    plane
        Metres to the right of and above the target centre (or the face origin if there is no
        target), (2,).
    covariance
        Covariance of ``plane`` from spot, view and survey, m², (2, 2).
    point
        ENU metres, (3,).
    covariance_enu
        Covariance of the point, m², (3, 3); 0 perpendicular to the plane.
    pixel
        Pixel of the frame, (2,).
    flux
        Light divided by the frame's exposure and gain (unit: full scale times m² per second, at a
        gain of one), which makes frames from one camera comparable; NaN if exposure or gain is
        unknown.
    """

    spot: Spot
    target: Target | None
    plane: FloatArray
    covariance: FloatArray
    point: FloatArray
    covariance_enu: FloatArray
    pixel: FloatArray
    flux: float = float("nan")

    @property
    def deviation(self) -> float:
        """Standard deviation along the worse axis, m."""
        return float(np.sqrt(max(float(np.linalg.eigvalsh(self.covariance)[-1]), 0.0)))


def place(picture: Rectified, spot: Spot, gathered: float = float("nan")) -> PlacedSpot:
    """Locate a spot on its target, and add the covariance of the view.

    Parameters
    ----------
    picture
        The face on which the spot was found.
    spot
        The spot.
    gathered
        Exposure times gain of the frame, s; NaN or 0 if unknown.
    """
    face, view = picture.face, picture.view
    point = face.point(spot.centroid)
    covariance, pixel = spot.covariance, picture.pixels(spot.centroid)
    if view is not None:
        covariance = covariance + view.covariance_at(spot.centroid)
        pixel = view.to_pixels(spot.centroid)
    target = _target_at(face, point)
    if target is None:
        axes, plane = face.axes, spot.centroid
    else:
        # The targets of a face may be a few millimetres off its plane, and slightly rotated.
        axes, plane = target.axes, target.plane_coordinates(point)
        point = target.point(plane)
    return PlacedSpot(
        spot,
        target,
        np.asarray(plane),
        covariance,
        np.asarray(point),
        np.asarray(axes.T @ covariance @ axes),
        np.asarray(pixel),
        spot.light / gathered if gathered > 0.0 else float("nan"),
    )


def _target_at(face: Face, point: FloatArray) -> Target | None:
    for target in face.targets:
        low = target.plane_coordinates(target.corners).min(axis=0)
        high = target.plane_coordinates(target.corners).max(axis=0)
        at = target.plane_coordinates(point)
        if (at >= low).all() and (at <= high).all():
            return target
    return None
