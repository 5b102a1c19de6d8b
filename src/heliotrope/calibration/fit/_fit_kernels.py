"""Compiled kernels: the maximum a posteriori fit of each heliostat in turn.

Levenberg-Marquardt minimises Σ ρ(|r|²) + |y|², where r holds the two whitened components of normal
minus bisector, and y = x / σ are the parameters scaled by their priors. In these units the prior is
the identity matrix, and damping acts equally on a metre and a milliradian. Every trial step is
evaluated with its derivatives, because nearly every one is accepted.
"""

import math

import numpy as np
from numba import njit

from heliotrope.calibration.fit._residual_kernels import (
    place_mechanism,
    residual_jacobian,
    scratch_mechanism,
    sighting_residual,
)
from heliotrope.calibration.median import median
from heliotrope.jit import INNER, OPTIONS

CONVERGED = 0
NOT_CONVERGED = 1
TOO_FEW = 2
FAILED = 3

# Robust losses.
SQUARE = 0
HUBER = 1
CAUCHY = 2

#: Widths of the Huber and Cauchy losses in standard deviations. With these widths both are 95 %
#: efficient for one-dimensional Gaussian noise.
HUBER_WIDTH, CAUCHY_WIDTH = 1.345, 2.385
#: Weight of the sightings' stated sigma in the estimate of the scale, as a number of degrees of
#: freedom.
PRIOR_FREEDOM = 5.0
#: The fit has converged when the quadratic model puts the minimum closer than this, in standard
#: deviations of the parameters.
NEAR = 1e-7
#: The same limit while the scale is still being estimated.
ROUGHLY = 1e-6
#: A step with a smaller predicted gain is accepted unchecked, because rounding of the cost hides
#: it.
UNSEEN = 1e-9
#: Damping after the first refused step, its factor per further refusal, and the most refusals.
DAMPING, HARDER, REFUSALS = 1e-3, 8.0, 25


@njit(**INNER)
def loss_and_weights(square, loss):
    """Return the loss ρ(s), its derivative ρ', and its curvature along the residual, 2 ρ''.

    For large residuals the loss is concave along the residual. The curvature is then taken as 0, so
    that the matrix of the step stays positive definite.
    """
    if loss == HUBER and square > HUBER_WIDTH * HUBER_WIDTH:
        size = math.sqrt(square)
        weight = HUBER_WIDTH / size
        return 2.0 * HUBER_WIDTH * size - HUBER_WIDTH * HUBER_WIDTH, weight, -weight / square
    if loss == CAUCHY:
        ratio = square / (CAUCHY_WIDTH * CAUCHY_WIDTH)
        weight = 1.0 / (1.0 + ratio)
        bend = -2.0 * weight * weight / (CAUCHY_WIDTH * CAUCHY_WIDTH)
        if ratio > 1.0:
            bend = -weight / square
        return CAUCHY_WIDTH * CAUCHY_WIDTH * math.log1p(ratio), weight, bend
    return square, 1.0, 0.0


@njit(**INNER)
def cholesky_solve(matrix, right, factor, out):
    """Solve matrix · out = right; return False if the matrix is not positive definite."""
    size = matrix.shape[0]
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                factor[i, i] = math.sqrt(total)
            else:
                factor[i, j] = total / factor[j, j]
    for i in range(size):
        total = right[i]
        for k in range(i):
            total -= factor[i, k] * out[k]
        out[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = out[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * out[k]
        out[i] = total / factor[i, i]
    return True


@njit(**INNER)
def inverse_from(factor, out):
    """Compute the inverse of factor · factorᵀ; only the lower half of ``factor`` is read."""
    size = factor.shape[0]
    lower = np.empty((size, size))
    for j in range(size):
        lower[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, size):
            total = 0.0
            for k in range(j, i):
                total -= factor[i, k] * lower[k, j]
            lower[i, j] = total / factor[i, i]
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for k in range(i, size):
                total += lower[k, i] * lower[k, j]
            out[i, j] = total
            out[j, i] = total


@njit(**INNER)
def _normal_equations(problem, y, loss, scale, curved, hessian, gradient):
    """Return the cost at y; fill its gradient (P,) and the lower half of its Hessian (P, P) in y.

    The Hessian is the Gauss-Newton approximation weighted by the loss, from which the covariance is
    also computed. ``curved`` = 1.0 adds the curvature of the loss, which yields a better step. It
    is a float because numba would compile one kernel for each bool.
    """
    base, codes, sigma, rows, data, squares, scratch, wrenches, jacobian = problem
    size = codes.shape[0]
    g = place_mechanism(base, codes, sigma, y, scratch)
    drives, keep = scratch[0][3], data[7]
    inverse = 1.0 / scale
    cost = 0.0
    for p in range(size):
        cost += y[p] * y[p]
        gradient[p] = y[p]
        for q in range(size):
            hessian[p, q] = 0.0
        hessian[p, p] = 1.0
    for i in range(rows[0], rows[1]):
        a, b = sighting_residual(g, drives, data, i, inverse, wrenches)
        square = a * a + b * b
        squares[i] = square * scale * scale
        if not keep[i]:
            continue
        value, weight, bend = loss_and_weights(square, loss)
        cost += value
        if curved == 0.0:
            bend = 0.0
        residual_jacobian(drives, data[0], i, scratch, wrenches, jacobian)
        w_aa, w_ab, w_bb = weight + bend * a * a, bend * a * b, weight + bend * b * b
        for p in range(size):
            x, z = jacobian[0, p], jacobian[1, p]
            gradient[p] += weight * (a * x + b * z)
            part_a, part_b = w_aa * x + w_ab * z, w_ab * x + w_bb * z
            for q in range(p + 1):
                hessian[p, q] += part_a * jacobian[0, q] + part_b * jacobian[1, q]
    return cost


@njit(**INNER)
def _minimise(problem, y, loss, scale, near, arrays, limit):
    """Run Levenberg-Marquardt from y, in place; return (cost, iterations, converged).

    Because the prior keeps the matrix well conditioned, damping begins only after a refused step.
    """
    hessians, gradients, damped, factor, step, trial = arrays
    size = y.shape[0]
    damping, side = 0.0, 0
    cost = _normal_equations(problem, y, loss, scale, 1.0, hessians[0], gradients[0])
    if not math.isfinite(cost):
        return cost, 0, False
    for iteration in range(limit):
        hessian, gradient = hessians[side], gradients[side]
        solved = cholesky_solve(hessian, gradient, factor, step)
        distance = np.inf
        if solved:
            distance = 0.0
            for p in range(size):
                distance += gradient[p] * step[p]
            if distance <= near * near:
                return cost, iteration, True
        new = np.nan
        for _ in range(REFUSALS):
            if damping > 0.0:
                for p in range(size):
                    for q in range(p + 1):
                        damped[p, q] = hessian[p, q]
                    damped[p, p] += damping * hessian[p, p]
                solved = cholesky_solve(damped, gradient, factor, step)
            if solved:
                for p in range(size):
                    trial[p] = y[p] - step[p]
                new = _normal_equations(
                    problem, trial, loss, scale, 1.0, hessians[1 - side], gradients[1 - side]
                )
                if new <= cost or (distance <= UNSEEN and math.isfinite(new)):
                    break
            damping = max(HARDER * damping, DAMPING)
            new = np.nan
        if math.isnan(new):
            # Further gains would be rounding errors.
            _normal_equations(problem, y, loss, scale, 1.0, hessian, gradient)
            return cost, iteration + 1, True
        for p in range(size):
            y[p] = trial[p]
        cost, side = new, 1 - side
        damping = 0.1 * damping if damping > DAMPING else 0.0
    return cost, limit, False


@njit(**INNER)
def _median_scale(squares, keep, rows):
    """Return the robust scale of residual lengths; the median of Rayleigh noise is 1.1774 σ."""
    kept = 0
    for i in range(rows[0], rows[1]):
        kept += keep[i]
    lengths = np.empty(kept)
    kept = 0
    for i in range(rows[0], rows[1]):
        if keep[i]:
            lengths[kept] = math.sqrt(squares[i])
            kept += 1
    return median(lengths) / 1.1774100225154747


@njit(**INNER)
def _covariance(hessian, sigma, gradient, factor, step, out):
    """Compute the covariance of x = y σ, (P, P), unless the Hessian is singular."""
    if cholesky_solve(hessian, gradient, factor, step):
        inverse_from(factor, out)
        for p in range(sigma.shape[0]):
            for q in range(sigma.shape[0]):
                out[p, q] *= sigma[p] * sigma[q]


@njit(**OPTIONS)
def fit_block(
    arrays,
    codes,
    sigma,
    offsets,
    data,
    loss,
    rounds,
    limit,
    lowest_scale,
    x,
    covariance,
    scales,
    squares,
    costs,
    iterations,
    status,
    start,
    stop,
):
    """Fit heliostats ``start`` to ``stop``.

    ``offsets`` (N + 1,) delimit the sightings of each heliostat. ``rounds`` is how often the scale
    of the residuals is estimated; with 0 rounds the scale stays 1.
    """
    size, joints = codes.shape[0], arrays[2].shape[1]
    drives = arrays[6].shape[0]
    scratch = scratch_mechanism(joints, drives, arrays[5].shape[2], size)
    wrenches, jacobian = np.empty((3, 2, 6)), np.empty((2, size))
    # Matrices at the present point and at the trial point, swapped when the trial is accepted.
    solver = (
        np.empty((2, size, size)), np.empty((2, size)), np.empty((size, size)),
        np.empty((size, size)), np.empty(size), np.empty(size),
    )  # fmt: skip
    hessian, gradient, y = solver[0][0], solver[1][0], np.empty(size)
    keep = data[7]
    for i in range(start, stop):
        base = (
            arrays[0][i], arrays[1][i], arrays[2][i], arrays[3][i], arrays[4][i], arrays[5][i],
            arrays[6], arrays[7][i], arrays[8][i],
        )  # fmt: skip
        rows = (offsets[i], offsets[i + 1])
        kept = 0
        for k in range(rows[0], rows[1]):
            kept += keep[k]
        for p in range(size):
            y[p] = 0.0
        scale, total, converged, cost = 1.0, 0, False, np.nan
        problem = (base, codes, sigma[i], rows, data, squares, scratch, wrenches, jacobian)
        kind = loss
        if kept > 0:
            for turn in range(rounds + 1):
                kind = loss if turn > 0 or rounds == 0 else CAUCHY
                near = NEAR if turn == rounds else ROUGHLY
                cost, steps, converged = _minimise(problem, y, kind, scale, near, solver, limit)
                total += steps
                if turn < rounds:
                    # With few sightings the residuals understate the noise, so the stated sigma is
                    # blended in.
                    free = max(0.0, 2.0 * kept - size)
                    new = _median_scale(squares, keep, rows)
                    total_square = PRIOR_FREEDOM + 2.0 * kept * new * new * (free > 0.0)
                    scale = max(lowest_scale, math.sqrt(total_square / (PRIOR_FREEDOM + free)))
            _normal_equations(problem, y, kind, scale, 0.0, hessian, gradient)
        for p in range(size):
            x[i, p] = y[p] * sigma[i, p]
        scales[i], costs[i], iterations[i] = scale, cost, total
        status[i] = CONVERGED if converged else NOT_CONVERGED
        if kept == 0:
            status[i] = TOO_FEW
            for p in range(size):
                for q in range(size):
                    hessian[p, q] = 1.0 * (p == q)
        elif not math.isfinite(cost):
            status[i] = FAILED
        for p in range(size):
            for q in range(size):
                covariance[i, p, q] = np.nan
        if status[i] != FAILED:
            _covariance(hessian, sigma[i], gradient, solver[3], solver[4], covariance[i])
