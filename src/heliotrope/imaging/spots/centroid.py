"""User-defined centroid functions, which convert the picture of a beam to its position."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError, kind_of
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_float
from heliotrope.imaging.frame import Image
from heliotrope.imaging.spots.background import Background
from heliotrope.imaging.spots.placed import PlacedSpot, place
from heliotrope.imaging.spots.spot import beam_light, pixel_variance
from heliotrope.imaging.targets.rectify import Mask, Rectified


@dataclass(frozen=True)
class BeamPicture:
    """A beam on its target, seen from the front, as passed to a user-defined centroid function.

    Brightness is relative to full scale; row 0 is at the top. If other targets lie in the same
    plane, the picture shows them too, because a beam may extend onto them.

    Attributes
    ----------
    target
        The target.
    picture, background
        Brightness with the beam, and estimated brightness without it, (H, W).
    light
        Difference of ``picture`` and ``background``, as paint with the usual reflectance would show
        it, (H, W); interpolated on marks.
    mask
        Pixels of this beam, including its tails, (H, W).
    paint
        Pixels of bare paint, (H, W).
    clipped
        Fraction of each pixel that is at full scale, (H, W).
    right, up
        Metres to the right of and above the target centre, (H, W).
    noise
        Standard deviation of a pixel's light from noise and uneven paint, as if pixels were
        independent.
    """

    target: Target
    picture: Image
    background: Image
    light: Image
    mask: Mask
    paint: Mask
    clipped: Image
    right: FloatArray
    up: FloatArray
    noise: float


#: A function that takes a picture and returns the beam position, metres to the right of and above
#: the target centre, (2,), and its covariance, m², (2, 2).
Centroid = Callable[[BeamPicture], tuple[npt.ArrayLike, npt.ArrayLike]]


def with_centroid(
    placed: PlacedSpot, target: Target, picture: Rectified, background: Background, own: Centroid
) -> PlacedSpot:
    """Return a spot moved to the position and covariance that a user-defined centroid returns.

    The covariance of the view is added, as for the built-in centroid. The shape of the spot, and
    therefore its quality checks, remain unchanged.

    Parameters
    ----------
    placed, target
        A spot, and the target on which it lies.
    picture, background
        Picture and background of the face.
    own
        The user-defined centroid function.

    Raises
    ------
    InputError
        If the function does not return a position on the target and a covariance.
    """
    across, upwards = np.meshgrid(*picture.axes)
    points = picture.face.point(np.stack([across, upwards], axis=-1))
    at = target.plane_coordinates(points)
    result = own(
        BeamPicture(
            target,
            picture.values,
            background.values,
            beam_light(picture, background),
            placed.spot.region,
            picture.paint,
            picture.clipped,
            at[..., 0],
            at[..., 1],
            float(np.sqrt(pixel_variance(picture, background))),
        )
    )
    plane, covariance = _checked(result, target)
    centroid = picture.face.plane(target.point(plane))
    moved = place(picture, replace(placed.spot, centroid=centroid, covariance=covariance))
    if moved.target is None or moved.target.name != target.name:
        raise InputError(
            f"custom centroid: position {plane.tolist()} m is not on target {target.name}, "
            f"{target.width:.4g} × {target.height:.4g} m; return metres right of and above its "
            "centre"
        )
    return replace(moved, flux=placed.flux)


def _checked(result: object, target: Target) -> tuple[FloatArray, FloatArray]:
    """Return position and covariance as arrays."""
    if not (isinstance(result, tuple | list) and len(result) == 2):
        raise InputError(
            f"custom centroid: it returned {kind_of(result)} for target {target.name}; return a "
            "position (2,) in metres and its covariance (2, 2) in m²"
        )
    try:
        plane, covariance = as_float(result[0]), as_float(result[1])
    except (TypeError, ValueError):
        raise InputError(
            f"custom centroid: position or covariance on target {target.name} is not an array of "
            "numbers; return a position (2,) in metres and its covariance (2, 2) in m²"
        ) from None
    if plane.shape != (2,) or not np.isfinite(plane).all():
        raise InputError(
            f"custom centroid: position {plane.tolist()} on target {target.name}; return 2 finite "
            "numbers, metres right of and above its centre"
        )
    good = covariance.shape == (2, 2) and bool(np.isfinite(covariance).all())
    if good:
        least, most = np.linalg.eigvalsh(0.5 * (covariance + covariance.T))
        uneven = abs(covariance[0, 1] - covariance[1, 0])
        good = bool(least >= 0.0 < most and uneven <= 1e-9 * most)
    if not good:
        raise InputError(
            f"custom centroid: covariance {covariance.tolist()} on target {target.name}; return a "
            "symmetric and positive (2, 2) matrix in m²"
        )
    return plane, covariance
