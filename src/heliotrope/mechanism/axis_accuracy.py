"""Zero and scatter of each heliostat axis: Guo's evaluation of tracking data, (43)-(47)."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float, common_shape, wrap_signed
from heliotrope.mechanism.guo import numbers, refuse


@dataclass(frozen=True, eq=False)
class AxisAccuracy:
    """Zeros and scatter of the two axes, each in rad, shape (...).

    Attributes
    ----------
    gamma_0, alpha_0
        Mean of measured minus computed angles; these are the estimates of ``azimuth_zero`` and
        ``elevation_zero``.
    sigma_gamma, sigma_alpha
        Standard deviation about the mean.
    sigma_normal
        Standard deviation of the normal in two dimensions (a tracking error): a rotation about the
        azimuth axis moves the normal by cos α times the angle.
    """

    gamma_0: FloatArray
    sigma_gamma: FloatArray
    alpha_0: FloatArray
    sigma_alpha: FloatArray
    sigma_normal: FloatArray


def axis_accuracy(
    measured_alpha: npt.ArrayLike,
    measured_gamma: npt.ArrayLike,
    computed_alpha: npt.ArrayLike,
    computed_gamma: npt.ArrayLike,
    *,
    azimuth_weight: npt.ArrayLike = 1.0,
) -> AxisAccuracy:
    """Return the zero and the scatter of each axis from a set of measurements.

    Differences are measured minus computed, taken on the circle: 359.9° and 0.1° are 0.2°
    apart. Source: Guo (43)-(47), mean and standard deviation (n − 1) per axis.

    Parameters
    ----------
    measured_alpha, measured_gamma, computed_alpha, computed_gamma
        Encoder positions, and the angles (43) that the model predicts for the same sightings, rad,
        shape (..., n), n ≥ 2 measurements.
    azimuth_weight
        Weights of the azimuth, shape (..., n): equal if the axis itself scatters, or cos² α if the
        measured normals scatter, because the azimuth magnifies that scatter.

    Raises
    ------
    InputError
        If fewer than two measurements are given, shapes differ, weights are negative or
        all 0, or the differences spread over half a turn (branches mixed).
    """
    values = (measured_alpha, measured_gamma, computed_alpha, computed_gamma, azimuth_weight)
    names = (
        "measured_alpha",
        "measured_gamma",
        "computed_alpha",
        "computed_gamma",
        "azimuth_weight",
    )
    arrays = {k: numbers(v, k) for k, v in zip(names, values, strict=True)}
    shape = common_shape(**arrays)
    if not shape or shape[-1] < 2:
        raise InputError(f"axis accuracy: shape {shape}; the last axis must hold 2 or more")
    alpha, gamma, alpha_i, gamma_i, weight = (np.broadcast_to(a, shape) for a in arrays.values())
    if (weight < 0.0).any() or (weight.sum(axis=-1) == 0.0).any():
        raise InputError("azimuth_weight: weights must not be negative or all 0; pass cos² α")
    gamma_0, gamma_rest = _circular(gamma - gamma_i, weight, "gamma")
    alpha_0, alpha_rest = _circular(alpha - alpha_i, np.ones(shape), "alpha")
    n = shape[-1]
    across = np.cos(alpha_i) ** 2 * gamma_rest**2
    variance_gamma = (weight * gamma_rest**2).sum(axis=-1) / weight.sum(axis=-1) * n / (n - 1)
    return AxisAccuracy(
        gamma_0=gamma_0,
        sigma_gamma=as_float(np.sqrt(variance_gamma)),
        alpha_0=alpha_0,
        sigma_alpha=as_float(np.sqrt((alpha_rest**2).sum(axis=-1) / (n - 1))),
        sigma_normal=as_float(np.sqrt((alpha_rest**2 + across).sum(axis=-1) / (n - 1))),
    )


def _circular(
    difference: FloatArray, weight: FloatArray, name: str
) -> tuple[FloatArray, FloatArray]:
    """Return the weighted mean of angles along the last axis, and their deviations from it."""
    middle = np.arctan2(
        (weight * np.sin(difference)).sum(axis=-1, keepdims=True),
        (weight * np.cos(difference)).sum(axis=-1, keepdims=True),
    )
    rest = wrap_signed(difference - middle)
    refuse(
        np.abs(rest) > 0.5 * np.pi,
        f"measured minus computed {name}",
        lambda i: f"{np.degrees(rest[i]):.1f}° from the mean, limit ±90°; do not mix branches",
    )
    shift = (weight * rest).sum(axis=-1, keepdims=True) / weight.sum(axis=-1, keepdims=True)
    return wrap_signed(middle + shift)[..., 0], as_float(rest - shift)
