r"""Fits of sightings that share errors.

All reflections measured in a flight share the errors of the drone's position and of its lens, and
all poses of one mirror share the apparent rotation caused by its slope deviations. If such errors
were treated as independent, they would seem to average out over many sightings, and the remainder
would be attributed to the heliostats. Here the shared errors are unknowns of the fit: K of them, z,
common to all heliostats, and one rotation per mirror, in addition to the parameters of each
heliostat.

Let H be the normal matrix of one heliostat's own unknowns, B its coupling with z, and C the
covariance of z given all heliostats. The covariance of the heliostat's own unknowns is then

$$ H^{-1} + H^{-1} B\, C\, B^T H^{-1}, \qquad
   C^{-1} = C_0^{-1} + \sum_i (Z_i - B_i^T H_i^{-1} B_i) $$

by the Schur complement. The term of heliostat i in the sum is its entry in `CommonFit.information`,
which is the information that its sightings provide about z.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit._fit_kernels import CAUCHY_WIDTH
from heliotrope.calibration.fit.estimator import FieldFit, Loss, fit
from heliotrope.calibration.fit.residuals import linearise, whitening
from heliotrope.calibration.sightings import Sightings, ray_directions
from heliotrope.field.formats.frames import mirror_frame
from heliotrope.geometry import FloatArray, as_float, normalize, rotation
from heliotrope.mechanism.chain import Mechanism

#: Maximum number of rounds, each a fit and a step of the common unknowns. Two or three rounds
#: suffice, because the unknowns are small.
_ROUNDS = 12
#: The iteration ends when no common unknown changes by more than this fraction of its prior sigma.
_SETTLED = 1e-3
#: Standard deviation that keeps a rotation at 0 where none occurs, rad.
_NEVER = 1e-9


@dataclass(frozen=True)
class CommonErrors:
    """Errors that M sightings of N heliostats have in common; K of them are shared by all.

    Attributes
    ----------
    shift
        Displacement of both ends of each sighting per unit of each shared error, recorded minus
        true, ENU, m, (M, 3, K). Only ends that are points are displaced.
    mean, covariance
        Prior knowledge of the shared errors: mean (K,), and covariance (K, K), positive definite.
    turned
        Whether slope deviations make the mirror appear rotated in each sighting, (M,).
    turn_sigma
        Standard deviation of that rotation about each of two mirror axes, rad, (N,); 0 for no
        rotation.
    """

    shift: FloatArray
    mean: FloatArray
    covariance: FloatArray
    turned: npt.NDArray[np.bool_]
    turn_sigma: FloatArray


@dataclass(frozen=True)
class CommonFit:
    """A fit of N heliostats together with the errors that their sightings share.

    Attributes
    ----------
    fitted
        The fit; its covariance includes the common errors.
    turn, turn_covariance
        Rotation about the mirror's x and y axes, rad, (N, 2), and its covariance, rad², (N, 2, 2).
    shared, shared_covariance
        The K shared errors given these sightings, and their covariance.
    information, pull
        What each heliostat's sightings contribute to the inverse covariance of the shared errors,
        (N, K, K), and to that inverse covariance times their mean, (N, K).
    sightings
        The sightings corrected for the errors that were found.
    """

    fitted: FieldFit
    turn: FloatArray
    turn_covariance: FloatArray
    shared: FloatArray
    shared_covariance: FloatArray
    information: FloatArray
    pull: FloatArray
    sightings: Sightings


def fit_common(
    mechanism: Mechanism,
    sightings: Sightings,
    model: str | tuple[str, ...],
    common: CommonErrors,
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    loss: Loss = "cauchy",
    adapt_scale: bool = True,
) -> CommonFit:
    """Return the maximum a posteriori parameters together with the common errors.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, batch shape (N,).
    sightings
        M sightings of these heliostats.
    model, priors, loss, adapt_scale
        See `heliotrope.calibration.fit.estimator.fit`.
    common
        The common errors.

    Raises
    ------
    InputError, UnknownNameError
        See `heliotrope.calibration.fit.estimator.fit`.
    """
    count, shared = len(mechanism), as_float(common.mean).copy()
    turn = np.zeros((count, 2))
    spread = np.sqrt(np.diagonal(common.covariance))
    parameters: dict[str, FloatArray] = {}
    for _ in range(_ROUNDS):
        fixed = mechanism.with_parameters(parameters) if parameters else mechanism
        corrected = _without(sightings, fixed, common, turn, shared)
        fitted = fit(mechanism, corrected, model, priors=priors, loss=loss, adapt_scale=adapt_scale)
        parameters = fitted.parameters
        step = _Step.of(mechanism, corrected, fitted, common, turn, shared, robust=loss == "cauchy")
        turn, shared = turn + step.turn, shared + step.shared
        moved = np.abs(step.shared) / np.maximum(spread, 1e-300)
        leaned = np.abs(step.turn) / np.maximum(common.turn_sigma, _NEVER)[:, None]
        if max(moved.max(initial=0.0), leaned.max(initial=0.0)) < _SETTLED:
            break
    p = len(fitted.names)
    return CommonFit(
        replace(fitted, covariance=step.covariance[:, :p, :p]),
        turn,
        step.covariance[:, p:, p:],
        shared,
        step.shared_covariance,
        step.information,
        # The gradients were computed at the shared errors before the step.
        np.einsum("nkl,l->nk", step.information, shared - step.shared) + step.push,
        corrected,
    )


@dataclass(frozen=True)
class _Step:
    """A Gauss-Newton step of the common errors, and the covariances of all unknowns."""

    turn: FloatArray
    shared: FloatArray
    covariance: FloatArray
    shared_covariance: FloatArray
    information: FloatArray
    push: FloatArray

    @classmethod
    def of(
        cls,
        mechanism: Mechanism,
        sightings: Sightings,
        fitted: FieldFit,
        common: CommonErrors,
        turn: FloatArray,
        shared: FloatArray,
        *,
        robust: bool,
    ) -> "_Step":
        count, row = len(mechanism), sightings.heliostat
        mechanisms = mechanism.with_parameters(fitted.parameters)[row]
        lines = linearise(mechanisms, sightings, fitted.names)
        by_turn = np.where(
            common.turned[:, None, None], derivative_by_turn(mechanisms, sightings), 0.0
        )
        own = np.concatenate([lines.jacobian, by_turn], axis=-1)
        by_shared = derivative_by_shared(mechanisms, sightings, common.shift)
        weight = fitted.scale[row] ** -2.0
        if robust:
            weight = weight / (1.0 + (fitted.lengths / CAUCHY_WIDTH) ** 2)
        known = np.maximum(common.turn_sigma, _NEVER) ** -2.0
        prior = np.concatenate([fitted.prior**-2.0, np.repeat(known[:, None], 2, axis=1)], axis=1)
        off = np.concatenate([fitted.values - fitted.centre, turn], axis=1)
        hessian, gradient = prior[:, :, None] * np.eye(prior.shape[1]), prior * off
        coupling = np.zeros((count, prior.shape[1], len(shared)))
        revealed, pulled = (
            np.zeros((count, len(shared), len(shared))),
            np.zeros_like(coupling[:, 0]),
        )
        for total, term in (
            (hessian, np.einsum("m,map,maq->mpq", weight, own, own)),
            (gradient, np.einsum("m,map,ma->mp", weight, own, lines.residual)),
            (coupling, np.einsum("m,map,mak->mpk", weight, own, by_shared)),
            (revealed, np.einsum("m,mak,mal->mkl", weight, by_shared, by_shared)),
            (pulled, np.einsum("m,mak,ma->mk", weight, by_shared, lines.residual)),
        ):
            np.add.at(total, row, term)
        inverse = np.linalg.inv(hessian)
        back = inverse @ coupling
        information = revealed - np.swapaxes(coupling, -1, -2) @ back
        push = -(pulled - np.einsum("npk,np->nk", back, gradient))
        before = np.linalg.inv(common.covariance)
        covariance = np.linalg.inv(before + information.sum(axis=0))
        moved = covariance @ (push.sum(axis=0) - before @ (shared - common.mean))
        step = -np.einsum("npq,nq->np", inverse, gradient) - back @ moved
        spread = inverse + back @ covariance @ np.swapaxes(back, -1, -2)
        return cls(step[:, -2:], moved, spread, covariance, information, push)


def turned_back(flights: Sightings, mechanism: Mechanism, turn: FloatArray) -> Sightings:
    """Return sightings corrected for their mirrors' rotation, by rotating rays about the vertices.

    Parameters
    ----------
    flights
        M sightings of N heliostats.
    mechanism, turn
        Mechanisms of the N heliostats, and the rotation about the mirror's x and y axes, rad, (N,
        2).
    """
    mechanisms = mechanism[flights.heliostat]
    axes, vertex = _axes(mechanisms, flights.counts), mechanisms.pose(flights.counts).vertex
    axis = -np.einsum("mij,mi->mj", axes, turn[flights.heliostat])
    back = rotation(axis, np.linalg.norm(axis, axis=-1))
    ends = (
        base + np.einsum("mij,mj->mi", back, end - base)
        for end, base in (
            (flights.source, np.where(flights.source_at_infinity[:, None], 0.0, vertex)),
            (flights.destination, np.where(flights.destination_at_infinity[:, None], 0.0, vertex)),
        )
    )
    source, destination = ends
    return replace(flights, source=source, destination=destination)


def derivative_by_turn(mechanism: Mechanism, sightings: Sightings) -> FloatArray:
    """Return the derivative of whitened residuals with respect to the removed rotation, (M, 2, 2).

    Parameters
    ----------
    mechanism
        One mechanism per sighting, batch shape (M,).
    sightings
        M sightings.
    """
    vertex = mechanism.pose(sightings.counts).vertex
    axes, whiten = whitening(sightings, vertex)
    source, destination = ray_directions(sightings, vertex)
    # The bisector v turns back by ω × v, and enters the residual with a minus sign.
    moved = np.cross(_axes(mechanism, sightings.counts), normalize(source + destination)[:, None])
    return as_float(np.einsum("mab,mbk,mik->mai", whiten, axes, moved))


def _axes(mechanism: Mechanism, counts: FloatArray) -> FloatArray:
    """Return the x and y axes of mirrors in ENU, (M, 2, 3)."""
    frame = mirror_frame(mechanism.normal)
    # A mechanism rotates any direction fixed to the mirror just as it rotates the normal.
    right = replace(mechanism, normal=frame[..., 0]).pose(counts).normal
    up = np.cross(mechanism.pose(counts).normal, right)
    return np.stack([right, up], axis=1)


def derivative_by_shared(
    mechanism: Mechanism, sightings: Sightings, shift: FloatArray
) -> FloatArray:
    """Return the derivative of whitened residuals with respect to removed shared errors, (M, 2, K).

    Parameters
    ----------
    mechanism
        One mechanism per sighting, batch shape (M,).
    sightings, shift
        M sightings, and the displacement of their ends by one unit of each error, (M, 3, K).
    """
    vertex = mechanism.pose(sightings.counts).vertex
    axes, whiten = whitening(sightings, vertex)
    directions = ray_directions(sightings, vertex)
    turned = np.zeros((len(sightings), 3, 3))
    for direction, end, far in (
        (directions[0], sightings.source, sightings.source_at_infinity),
        (directions[1], sightings.destination, sightings.destination_at_infinity),
    ):
        distance = np.where(far, np.inf, np.linalg.norm(end - vertex, axis=-1))
        turned += (np.eye(3) - direction[:, :, None] * direction[:, None, :]) / distance[
            :, None, None
        ]
    size = np.linalg.norm(directions[0] + directions[1], axis=-1)[:, None, None]
    # The ends move back by shift @ z, and the bisector enters the residual with a minus sign.
    return as_float(whiten @ axes @ (turned / size) @ shift)


def _without(
    sightings: Sightings,
    mechanism: Mechanism,
    common: CommonErrors,
    turn: FloatArray,
    shared: FloatArray,
) -> Sightings:
    """Return sightings corrected for the common errors."""
    moved = common.shift @ shared
    near = replace(
        sightings,
        source=np.where(
            sightings.source_at_infinity[:, None], sightings.source, sightings.source - moved
        ),
        destination=np.where(
            sightings.destination_at_infinity[:, None],
            sightings.destination,
            sightings.destination - moved,
        ),
    )
    back = turned_back(near, mechanism, turn)
    kept = common.turned[:, None]
    return replace(
        near,
        source=np.where(kept, back.source, near.source),
        destination=np.where(kept, back.destination, near.destination),
    )
