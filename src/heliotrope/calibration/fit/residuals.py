"""Whitened residuals of sightings and their derivatives, for all sightings at once."""

from dataclasses import dataclass

import numpy as np

from heliotrope.calibration.sightings import Sightings, bisector_covariance, ray_directions
from heliotrope.geometry import FloatArray, tangent_axes
from heliotrope.mechanism.chain import Mechanism


@dataclass(frozen=True)
class Linearised:
    """Residuals of M sightings at given mechanisms, and their derivatives.

    Attributes
    ----------
    residual
        Normal minus bisector in the plane tangent to the bisector, whitened by the sightings'
        covariance, (M, 2).
    jacobian
        Derivative of the residual with respect to the named parameters, (M, 2, P).
    beam
        Matrices that convert a whitened residual into the beam error to the right of and above the
        destination as seen from the mirror, rad, (M, 2, 2).
    """

    residual: FloatArray
    jacobian: FloatArray
    beam: FloatArray


def linearise(mechanism: Mechanism, s: Sightings, names: tuple[str, ...]) -> Linearised:
    """Return the residuals of sightings ``s`` and their derivatives.

    Parameters
    ----------
    mechanism
        One mechanism per sighting, batch shape (M,).
    s
        M sightings.
    names
        P parameters of the table.
    """
    jacobian = mechanism.jacobian(s.counts, names)
    n, m = jacobian.pose.normal, jacobian.pose.vertex
    axes, whiten = whitening(s, m)
    source, destination = ray_directions(s, m)
    total = source + destination
    size = np.linalg.norm(total, axis=-1, keepdims=True)
    v = total / size
    db = np.zeros_like(jacobian.normal)
    for ends, far, unit in (
        (s.source, s.source_at_infinity, source),
        (s.destination, s.destination_at_infinity, destination),
    ):
        distance = np.where(far, np.inf, np.linalg.norm(ends - m, axis=-1))[:, None, None]
        along = np.sum(jacobian.vertex * unit[:, None], axis=-1, keepdims=True)
        db -= (jacobian.vertex - along * unit[:, None]) / distance
    db -= np.sum(db * v[:, None], axis=-1, keepdims=True) * v[:, None]
    db /= size[:, :, None]
    gap = np.einsum("mak,mk->ma", axes, n - v)
    slope = np.einsum("mak,mpk->map", axes, jacobian.normal - db)
    return Linearised(
        residual=np.einsum("mab,mb->ma", whiten, gap),
        jacobian=np.einsum("mab,mbp->map", whiten, slope),
        beam=_beam_map(axes, v, source, destination) @ np.linalg.inv(whiten),
    )


def whitening(s: Sightings, vertex: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return axes of the tangent plane, (M, 2, 3), and matrices that whiten along these axes.

    Parameters
    ----------
    s
        M sightings.
    vertex
        Vertices of the mirrors, ENU metres, (M, 3).

    Returns
    -------
    Axes (M, 2, 3) across the bisector, and W (M, 2, 2) with W C Wᵀ = 1 for the
    covariance C of the bisector along the axes.
    """
    source, destination = ray_directions(s, vertex)
    total = source + destination
    axes = tangent_axes(total / np.linalg.norm(total, axis=-1, keepdims=True))
    whiten = np.linalg.inv(np.linalg.cholesky(bisector_covariance(s, vertex, axes)))
    return axes, whiten


def frame(direction: FloatArray) -> FloatArray:
    """Return unit vectors to the right and up, (M, 2, 3), as seen along directions (M, 3)."""
    right = np.stack([direction[:, 1], -direction[:, 0], np.zeros(len(direction))], axis=-1)
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-12)
    return np.stack([right, np.cross(right, direction)], axis=1)


def _beam_map(
    axes: FloatArray, v: FloatArray, source: FloatArray, destination: FloatArray
) -> FloatArray:
    """Return the derivative of the reflected ray with respect to the normal, (M, 2, 2)."""
    # d(2 (n·s) n − s) = 2 ((dn·s) n + (n·s) dn)
    across = frame(destination)
    along = np.einsum("mak,mk->ma", axes, source)
    cosine = np.sum(v * source, axis=-1)[:, None, None]
    first = np.einsum("mck,mk->mc", across, v)[:, :, None] * along[:, None, :]
    return np.asarray(2.0 * (first + cosine * np.einsum("mck,mak->mca", across, axes)))
