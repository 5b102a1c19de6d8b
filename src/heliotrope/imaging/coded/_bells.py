"""Gaussian beams and their derivatives on a set of points."""

import numpy as np

from heliotrope.geometry import FloatArray

#: Third derivatives of a Gaussian needed for the Jacobian of movements. The axis of the movement is
#: followed by the two axes of a second moment.
_MOMENTS = ((0, 0), (0, 1), (1, 1))


def bell(points: FloatArray, place: FloatArray, moments: FloatArray) -> FloatArray:
    """Return the values, 1/m², (N,), of a Gaussian with power 1 at points (N, 2)."""
    q = np.linalg.inv(moments)
    d = points - place
    form = q[0, 0] * d[:, 0] ** 2 + 2.0 * q[0, 1] * d[:, 0] * d[:, 1] + q[1, 1] * d[:, 1] ** 2
    return np.asarray(np.exp(-0.5 * form) * (np.sqrt(np.linalg.det(q)) / (2.0 * np.pi)))


def slopes(points: FloatArray, place: FloatArray, moments: FloatArray) -> FloatArray:
    """Return the change of a Gaussian with power 1 per metre moved along each axis, (2, N)."""
    s = (points - place) @ np.linalg.inv(moments)
    return np.asarray(s.T * bell(points, place, moments))


def slope_derivatives(
    points: FloatArray, place: FloatArray, moments: FloatArray, power: float
) -> FloatArray:
    """Return the derivatives of ``power`` times `slopes`, (6, 2, N).

    Derivatives are with respect to power, position (2) and second moments (right, cross, up). The
    derivative of a Gaussian with respect to a second moment is half its second spatial derivative.
    """
    q = np.linalg.inv(moments)
    s = ((points - place) @ q).T
    f = bell(points, place, moments)
    out = np.empty((6, 2, len(points)))
    out[0] = s * f
    for a in range(2):
        for b in range(2):
            out[1 + b, a] = power * (s[a] * s[b] - q[a, b]) * f
        for k, (b, c) in enumerate(_MOMENTS):
            third = s[a] * s[b] * s[c] - q[a, b] * s[c] - q[a, c] * s[b] - q[b, c] * s[a]
            out[3 + k, a] = power * (0.5 if b == c else 1.0) * third * f
    return out


def moved(
    points: FloatArray, place: FloatArray, moments: FloatArray, moves: FloatArray
) -> FloatArray:
    """Return a Gaussian of power 1 at K positions minus the same Gaussian at rest, (K, N).

    A code has few different values, so equal movements are computed only once.
    """
    distinct, which = np.unique(moves, axis=0, return_inverse=True)
    rest = bell(points, place, moments)
    drawn = np.stack([bell(points, place + move, moments) - rest for move in distinct])
    return np.asarray(drawn[which.reshape(-1)])
