"""Compiled: the maximum a posteriori fit of one heliostat after another.

Levenberg-Marquardt in parameters scaled by their priors, y = x / σ, so that the prior
is the unit matrix and the damping means the same for a metre and a milliradian:
minimise Σ ρ(|r|²) + |y|², r the two whitened components of normal minus bisector.
"""

import math

import numpy as np
from numba import njit

from heliotrope.mechanism._chain_kernels import chain_derivative, chain_pose
from heliotrope.mechanism._drive_kernels import drive_angle
from heliotrope.mechanism._jit import OPTIONS
from heliotrope.mechanism._slots import (
    MOVES_ALONG_NORMAL,
    MOVES_DRIVE,
    MOVES_JOINT,
    MOVES_ORIGIN,
    MOVES_POSITION,
    MOVES_VERTEX,
)

CONVERGED = 0
NOT_CONVERGED = 1
TOO_FEW = 2
FAILED = 3

# Robust losses.
SQUARE = 0
HUBER = 1
CAUCHY = 2

#: Where Huber and Cauchy leave the square, in standard deviations; 95 % efficient
#: for Gaussian noise in one dimension.
HUBER_WIDTH, CAUCHY_WIDTH = 1.345, 2.385
#: Degrees of freedom that the sightings' stated sigma is worth when the scale is found.
PRIOR_FREEDOM = 5.0


@njit(**OPTIONS)
def apply_parameters(codes, x, position, origins, angles, drives, vertex, normal):
    """Move the arrays of one mechanism by x (P,), in place."""
    for p in range(codes.shape[0]):
        what, index, sub = codes[p, 0], codes[p, 1], codes[p, 2]
        if what == MOVES_JOINT:
            angles[index] += x[p]
        elif what == MOVES_DRIVE:
            drives[index, sub] += x[p]
        elif what == MOVES_POSITION:
            position[sub] += x[p]
        elif what == MOVES_ORIGIN:
            origins[index, sub] += x[p]
        elif what == MOVES_VERTEX:
            vertex[sub] += x[p]
        elif what == MOVES_ALONG_NORMAL:
            for k in range(3):
                vertex[k] += x[p] * normal[k]


@njit(**OPTIONS)
def _unit_way(end, far, m, way):
    """Unit vector from m to ``end``; returns its distance, infinite for a direction."""
    if far:
        way[:] = end
        return np.inf
    size = 0.0
    for k in range(3):
        way[k] = end[k] - m[k]
        size += way[k] * way[k]
    size = math.sqrt(size)
    for k in range(3):
        way[k] /= size
    return size


@njit(**OPTIONS)
def _bisector_shift(s, s_distance, t, t_distance, v, size, dm, db):
    """Change of the bisector v when the vertex moves by dm."""
    s_along = s[0] * dm[0] + s[1] * dm[1] + s[2] * dm[2]
    t_along = t[0] * dm[0] + t[1] * dm[1] + t[2] * dm[2]
    along = 0.0
    for k in range(3):
        db[k] = -(dm[k] - s_along * s[k]) / s_distance - (dm[k] - t_along * t[k]) / t_distance
        along += db[k] * v[k]
    for k in range(3):
        db[k] = (db[k] - along * v[k]) / size


@njit(**OPTIONS)
def sighting_residual(
    mechanism, codes, counts, source, far_source, destination, far_destination, axes, whiten,
    work, residual, jacobian, derivatives,
):  # fmt: skip
    """Whitened residual (2,) of one sighting and, if wanted, its derivative (2, P)."""
    position, orientation, joint_axes, origins, angles, drives, driven, vertex, normal = mechanism
    frames, screw_axes, screw_points, joint_angles, vectors = work
    n, m, s, t, v = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    dn, dm, db = vectors[5], vectors[6], vectors[7]
    for k in range(driven.shape[0]):
        joint_angles[k] = drive_angle(drives[k], counts[k])
    chain_pose(
        position, orientation, joint_axes, origins, angles, driven, joint_angles, vertex, normal,
        frames, screw_axes, screw_points, n, m,
    )  # fmt: skip
    s_distance = _unit_way(source, far_source, m, s)
    t_distance = _unit_way(destination, far_destination, m, t)
    size = 0.0
    for k in range(3):
        v[k] = s[k] + t[k]
        size += v[k] * v[k]
    size = math.sqrt(size)
    for k in range(3):
        v[k] /= size
    _project(axes, whiten, n, v, residual)
    if derivatives:
        for p in range(codes.shape[0]):
            chain_derivative(
                codes[p, 0], codes[p, 1], codes[p, 2], drives, driven, counts,
                frames, screw_axes, screw_points, n, m, dn, dm,
            )  # fmt: skip
            _bisector_shift(s, s_distance, t, t_distance, v, size, dm, db)
            _project(axes, whiten, dn, db, jacobian[:, p])


@njit(**OPTIONS)
def _project(axes, whiten, a, b, out):
    x, y = 0.0, 0.0
    for k in range(3):
        x += axes[0, k] * (a[k] - b[k])
        y += axes[1, k] * (a[k] - b[k])
    out[0] = whiten[0, 0] * x + whiten[0, 1] * y
    out[1] = whiten[1, 0] * x + whiten[1, 1] * y


@njit(**OPTIONS)
def loss_and_weight(square, loss, scale):
    """(ρ, dρ/d|r|²) of a squared residual, |r| measured in ``scale``."""
    square = square / (scale * scale)
    if loss == HUBER and square > HUBER_WIDTH * HUBER_WIDTH:
        size = math.sqrt(square)
        return 2.0 * HUBER_WIDTH * size - HUBER_WIDTH * HUBER_WIDTH, HUBER_WIDTH / size
    if loss == CAUCHY:
        ratio = square / (CAUCHY_WIDTH * CAUCHY_WIDTH)
        return CAUCHY_WIDTH * CAUCHY_WIDTH * math.log1p(ratio), 1.0 / (1.0 + ratio)
    return square, 1.0


@njit(**OPTIONS)
def cholesky_solve(matrix, right, factor, out):
    """Solve matrix · out = right for a positive definite matrix; returns whether it is."""
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


@njit(**OPTIONS)
def inverse_from(factor, out):
    """Inverse of factor · factorᵀ."""
    size = factor.shape[0]
    lower = np.zeros((size, size))
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


@njit(**OPTIONS)
def _moved(base, codes, x):
    """Copies of one mechanism's arrays, moved by x."""
    position, orientation, axes, origins, angles, drives, driven, vertex, normal = base
    position, origins, angles = position.copy(), origins.copy(), angles.copy()
    drives, vertex = drives.copy(), vertex.copy()
    apply_parameters(codes, x, position, origins, angles, drives, vertex, normal)
    return position, orientation, axes, origins, angles, drives, driven, vertex, normal


@njit(**OPTIONS)
def _normal_equations(
    base, codes, sigma, y, rows, loss, scale, data, work, hessian, gradient, squares, derivatives
):
    """Cost at y; with ``derivatives`` also hessian (P, P) and gradient (P,) by y."""
    counts, source, far_source, destination, far_destination, axes, whiten, keep = data
    size = codes.shape[0]
    moved = _moved(base, codes, y * sigma)
    residual, jacobian = np.empty(2), np.zeros((2, size))
    cost = 0.0
    if derivatives:
        hessian[:] = 0.0
        gradient[:] = 0.0
    for p in range(size):
        cost += y[p] * y[p]
        if derivatives:
            hessian[p, p] = 1.0
            gradient[p] = y[p]
    for i in range(rows[0], rows[1]):
        sighting_residual(
            moved, codes, counts[i], source[i], far_source[i], destination[i],
            far_destination[i], axes[i], whiten[i], work, residual, jacobian, derivatives,
        )  # fmt: skip
        square = residual[0] * residual[0] + residual[1] * residual[1]
        squares[i] = square
        if not keep[i]:
            continue
        value, weight = loss_and_weight(square, loss, scale)
        cost += value
        if derivatives:
            weight /= scale * scale
            for p in range(size):
                a, b = jacobian[0, p] * sigma[p], jacobian[1, p] * sigma[p]
                gradient[p] += weight * (a * residual[0] + b * residual[1])
                for q in range(p + 1):
                    hessian[p, q] += weight * sigma[q] * (a * jacobian[0, q] + b * jacobian[1, q])
    return cost


@njit(**OPTIONS)
def _minimise(base, codes, sigma, y, rows, loss, scale, data, work, arrays, limit):
    """Levenberg-Marquardt from y, in place; returns (cost, iterations, converged)."""
    hessian, gradient, damped, factor, step, trial, squares = arrays
    size = codes.shape[0]
    damping = 1e-4
    cost = _normal_equations(
        base, codes, sigma, y, rows, loss, scale, data, work, hessian, gradient, squares, True
    )
    if not math.isfinite(cost):
        return cost, 0, False
    for iteration in range(1, limit + 1):
        improved, new = False, cost
        for _ in range(25):
            for p in range(size):
                for q in range(p + 1):
                    damped[p, q] = hessian[p, q]
                damped[p, p] += damping * hessian[p, p]
            if cholesky_solve(damped, gradient, factor, step):
                for p in range(size):
                    trial[p] = y[p] - step[p]
                new = _normal_equations(
                    base, codes, sigma, trial, rows, loss, scale, data, work, hessian, gradient,
                    squares, False,
                )  # fmt: skip
                if new <= cost:
                    improved = True
                    break
            damping = max(damping, 1e-10) * 8.0
        if not improved:
            # Rounding is all that is left to gain.
            return cost, iteration, True
        gained = cost - new
        for p in range(size):
            y[p] = trial[p]
        cost = _normal_equations(
            base, codes, sigma, y, rows, loss, scale, data, work, hessian, gradient, squares, True
        )
        damping *= 0.1
        if gained <= 1e-12 * (1.0 + cost):
            return cost, iteration, True
    return cost, limit, False


@njit(**OPTIONS)
def _median_scale(squares, keep, rows):
    """Robust scale of residual lengths: the median of Rayleigh noise is 1.1774 σ."""
    kept = 0
    for i in range(rows[0], rows[1]):
        kept += keep[i]
    lengths = np.empty(kept)
    kept = 0
    for i in range(rows[0], rows[1]):
        if keep[i]:
            lengths[kept] = math.sqrt(squares[i])
            kept += 1
    return np.median(lengths) / 1.1774100225154747


@njit(**OPTIONS)
def fit_block(
    arrays, codes, sigma, offsets, data, loss, rounds, limit, lowest_scale,
    x, covariance, scales, squares, costs, iterations, status, start, stop,
):  # fmt: skip
    """Fit heliostats ``start`` to ``stop``.

    ``offsets`` (N + 1,) are the sightings of each, ``rounds`` how often the scale of the
    residuals is estimated anew (0: it stays 1).
    """
    size, joints = codes.shape[0], arrays[2].shape[1]
    drives = arrays[6].shape[0]
    work = (
        np.empty((joints + 1, 3, 3)), np.empty((joints, 3)), np.empty((joints, 3)),
        np.empty(drives), np.empty((8, 3)),
    )  # fmt: skip
    hessian, damped, factor = np.empty((size, size)), np.empty((size, size)), np.zeros((size, size))
    gradient, step, trial, y = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
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
        y[:] = 0.0
        scale, total, converged, cost = 1.0, 0, False, np.nan
        scratch = (hessian, gradient, damped, factor, step, trial, squares)
        if kept > 0:
            for turn in range(rounds + 1):
                cost, steps, converged = _minimise(
                    base, codes, sigma[i], y, rows, loss if turn > 0 or rounds == 0 else CAUCHY,
                    scale, data, work, scratch, limit,
                )  # fmt: skip
                total += steps
                if turn < rounds:
                    # Few sightings fit themselves: the stated sigma counts as some more.
                    free = max(0.0, 2.0 * kept - size)
                    new = _median_scale(squares, keep, rows)
                    total_square = PRIOR_FREEDOM + 2.0 * kept * new * new * (free > 0.0)
                    scale = max(lowest_scale, math.sqrt(total_square / (PRIOR_FREEDOM + free)))
        for p in range(size):
            x[i, p] = y[p] * sigma[i, p]
        scales[i], costs[i], iterations[i] = scale, cost, total
        status[i] = CONVERGED if converged else NOT_CONVERGED
        if kept == 0:
            status[i] = TOO_FEW
            hessian[:] = 0.0
            for p in range(size):
                hessian[p, p] = 1.0
        elif not math.isfinite(cost):
            status[i] = FAILED
        if status[i] != FAILED and cholesky_solve(hessian, gradient, factor, step):
            inverse_from(factor, covariance[i])
            for p in range(size):
                for q in range(size):
                    covariance[i, p, q] *= sigma[i, p] * sigma[i, q]
        else:
            covariance[i] = np.nan
