"""Gain from one more sighting, by rank-two updates of covariances; batch axes come first.

With C the covariance of the parameters and J the whitened derivative (2, P) of a sighting, the
information increases by JᵀJ. With S = 1 + J C Jᵀ, the matrix determinant lemma and Woodbury's
identity yield

    log det grows by log det S,   C' = C − (J C)ᵀ S⁻¹ (J C),
    tr(A C) falls by tr(S⁻¹ (J C) A (J C)ᵀ).
"""

import numpy as np

from heliotrope.geometry import FloatArray


def _terms(covariance: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return J C (..., 2, P) and S (..., 2, 2)."""
    product = jacobian @ covariance
    return product, np.eye(2) + product @ np.swapaxes(jacobian, -1, -2)


def _inverse(s: FloatArray) -> FloatArray:
    """Return the inverse of symmetric matrices (..., 2, 2) that exceed the unit matrix."""
    turned = np.empty_like(s)
    turned[..., 0, 0], turned[..., 1, 1] = s[..., 1, 1], s[..., 0, 0]
    turned[..., 0, 1] = turned[..., 1, 0] = -s[..., 0, 1]
    return np.asarray(turned / _determinant(s)[..., None, None])


def _determinant(s: FloatArray) -> FloatArray:
    return np.asarray(s[..., 0, 0] * s[..., 1, 1] - s[..., 0, 1] * s[..., 1, 0])


def information_gain(covariance: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return the growth of the log determinant of the information, nats, (...)."""
    return np.asarray(np.log(_determinant(_terms(covariance, jacobian)[1])))


def variance_gain(covariance: FloatArray, jacobian: FloatArray, form: FloatArray) -> FloatArray:
    """Return the decrease of tr(form · C), (...)."""
    product, s = _terms(covariance, jacobian)
    spread = product @ form @ np.swapaxes(product, -1, -2)
    return np.asarray(np.sum(_inverse(s) * spread, axis=(-1, -2)))


def updated(covariance: FloatArray, jacobian: FloatArray) -> FloatArray:
    """Return the covariance after the sighting, (..., P, P)."""
    product, s = _terms(covariance, jacobian)
    after = covariance - np.swapaxes(product, -1, -2) @ _inverse(s) @ product
    return np.asarray(0.5 * (after + np.swapaxes(after, -1, -2)))
