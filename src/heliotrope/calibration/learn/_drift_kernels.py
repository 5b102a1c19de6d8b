"""Compiled: covariances of sightings whose parameters drift in time, and their consequences.

The whitened residual of sighting i is −Σ_p J_ip x_p(t_i) + noise. Each x_p is a constant
with a variance, plus an offset that lasts as long as a regime, plus Ornstein-Uhlenbeck
processes of some amplitude and time; so two sightings share

    K_ij = Σ_p J_ip J_jpᵀ (σ_p² + ρ_p² [same regime] + δ_p² min(e_i, e_j)
                            + Σ_c a_c² exp(−|t_i − t_j| / τ_c))

with e the number of steps of the zeros before the sighting. A sighting at an unknown time (NaN)
shares no drift with any other.
"""

import math

import numpy as np
from numba import njit

from heliotrope.jit import OPTIONS


@njit(**OPTIONS)
def gram(
    first,
    first_time,
    first_regime,
    first_epoch,
    second,
    second_time,
    second_regime,
    second_epoch,
    same,
    static,
    regime,
    step,
    part,
    amplitude,
    tau,
):
    """K (2 n, 2 m) of sightings with Jacobians (n, 2, P) and (m, 2, P).

    ``part`` (C,) is the parameter of each process, ``amplitude`` and ``tau`` (C,) theirs;
    ``same``: both are the same rows, so that i = j shares its drift even at an unknown time.
    """
    n, m, size = first.shape[0], second.shape[0], first.shape[2]
    out = np.empty((2 * n, 2 * m))
    weight = np.empty(size)
    for i in range(n):
        for j in range(m):
            apart = abs(first_time[i] - second_time[j])
            if same and i == j:
                apart = 0.0
            for p in range(size):
                weight[p] = static[p]
            if first_regime[i] == second_regime[j] and first_regime[i] != 0:
                for p in range(size):
                    weight[p] += regime[p]
            shared = min(first_epoch[i], second_epoch[j])
            if shared > 0:
                for p in range(size):
                    weight[p] += shared * step[p]
            if math.isfinite(apart):
                for c in range(part.shape[0]):
                    weight[part[c]] += amplitude[c] * amplitude[c] * math.exp(-apart / tau[c])
            for a in range(2):
                for b in range(2):
                    total = 0.0
                    for p in range(size):
                        total += weight[p] * first[i, a, p] * second[j, b, p]
                    out[2 * i + a, 2 * j + b] = total
    return out


@njit(**OPTIONS)
def _decaying_gram(
    jacobian, time, label, epoch, static, regime, step, part, group, amplitude, tau, decay
):
    """As `gram` of the same rows, by symmetry; fills the lower half of ``decay`` (n, n, G).

    Processes of one group have one time constant, so that one exponential serves them all. With
    unknown times the decay is 0.
    """
    n, size = jacobian.shape[0], jacobian.shape[2]
    out = np.empty((2 * n, 2 * n))
    weight = np.empty(size)
    for i in range(n):
        for j in range(i + 1):
            apart = abs(time[i] - time[j])
            if i == j:
                apart = 0.0
            for g in range(tau.shape[0]):
                decay[i, j, g] = math.exp(-apart / tau[g]) if math.isfinite(apart) else 0.0
            for p in range(size):
                weight[p] = static[p]
            if label[i] == label[j] and label[i] != 0:
                for p in range(size):
                    weight[p] += regime[p]
            shared = min(epoch[i], epoch[j])
            if shared > 0:
                for p in range(size):
                    weight[p] += shared * step[p]
            for c in range(part.shape[0]):
                weight[part[c]] += amplitude[c] * amplitude[c] * decay[i, j, group[c]]
            for a in range(2):
                for b in range(2):
                    total = 0.0
                    for p in range(size):
                        total += weight[p] * jacobian[i, a, p] * jacobian[j, b, p]
                    out[2 * i + a, 2 * j + b] = total
                    out[2 * j + b, 2 * i + a] = total
    return out


@njit(**OPTIONS)
def cost_and_gradient(
    jacobian, time, label, epoch, residual, static, regime, step, part, group, amplitude, tau, noise
):
    """Negative log likelihood and its gradient by log (noise, amplitudes (C,), times (G,)).

    ``group`` (C,) says which of the G times a process has; ``tau`` is (G,).
    """
    n, parts, times = len(residual), part.shape[0], tau.shape[0]
    decay = np.empty((n, n, times))
    matrix = _decaying_gram(
        jacobian, time, label, epoch, static, regime, step, part, group, amplitude, tau, decay
    )
    for k in range(2 * n):
        matrix[k, k] += noise * noise
    gradient = np.zeros(1 + parts + times)
    inverse = np.linalg.inv(matrix)
    flat = np.ascontiguousarray(residual).reshape(2 * n)
    alpha = inverse @ flat
    cost = 0.5 * np.dot(flat, alpha) + np.sum(np.log(np.diag(np.linalg.cholesky(matrix))))
    trace = 0.0
    for k in range(2 * n):
        trace += inverse[k, k] - alpha[k] * alpha[k]
    gradient[0] = trace * noise * noise
    for i in range(n):
        for j in range(i + 1):
            apart = abs(time[i] - time[j]) if i != j else 0.0
            if not math.isfinite(apart):
                continue
            twice = 1.0 if i == j else 2.0
            for c in range(parts):
                p = part[c]
                total = 0.0
                for a in range(2):
                    for b in range(2):
                        w = inverse[2 * i + a, 2 * j + b] - alpha[2 * i + a] * alpha[2 * j + b]
                        total += w * jacobian[i, a, p] * jacobian[j, b, p]
                total *= 0.5 * twice * amplitude[c] * amplitude[c] * decay[i, j, group[c]]
                gradient[1 + c] += 2.0 * total
                gradient[1 + parts + group[c]] += total * apart / tau[group[c]]
    return cost, gradient


@njit(**OPTIONS)
def pooled_block(
    jacobian,
    time,
    label,
    epoch,
    residual,
    offsets,
    static,
    regime,
    step,
    part,
    group,
    amplitude,
    tau,
    noise,
    costs,
    gradients,
    start,
    stop,
):
    """Cost and gradient of heliostats ``start`` to ``stop``, one a row."""
    for i in range(start, stop):
        a, b = offsets[i], offsets[i + 1]
        cost, gradient = cost_and_gradient(
            jacobian[a:b],
            time[a:b],
            label[a:b],
            epoch[a:b],
            residual[a:b],
            static[i],
            regime,
            step,
            part,
            group,
            amplitude,
            tau,
            noise,
        )
        costs[i] = cost
        gradients[i] = gradient


@njit(**OPTIONS)
def left_out(inverse, alpha, n):
    """Squared distance of each sighting from the prediction of all others, and its variance.

    ``inverse`` is K⁻¹ (2 n, 2 n), ``alpha`` K⁻¹ r. Returns (z² (n,), error (n, 2),
    covariance (n, 2, 2)); z² is χ² with two degrees of freedom. (Rasmussen & Williams,
    Gaussian Processes for Machine Learning, (5.12), in blocks of two.)
    """
    square, error, spread = np.empty(n), np.empty((n, 2)), np.empty((n, 2, 2))
    for i in range(n):
        a, b, c = inverse[2 * i, 2 * i], inverse[2 * i, 2 * i + 1], inverse[2 * i + 1, 2 * i + 1]
        determinant = a * c - b * b
        spread[i, 0, 0], spread[i, 1, 1] = c / determinant, a / determinant
        spread[i, 0, 1] = spread[i, 1, 0] = -b / determinant
        x, y = alpha[2 * i], alpha[2 * i + 1]
        error[i, 0] = spread[i, 0, 0] * x + spread[i, 0, 1] * y
        error[i, 1] = spread[i, 1, 0] * x + spread[i, 1, 1] * y
        square[i] = x * error[i, 0] + y * error[i, 1]
    return square, error, spread


@njit(**OPTIONS)
def remove_farthest(inverse, residual, most):
    """Remove the sighting farthest from the others repeatedly.

    Returns (which (most,), their z² (most,)) in the order of removal.
    """
    n = len(residual)
    inverse = inverse.copy()
    flat = residual.copy().reshape(2 * n)
    which, squares = np.empty(most, dtype=np.int64), np.empty(most)
    gone = np.zeros(n, dtype=np.bool_)
    for step in range(most):
        square, _, spread = left_out(inverse, inverse @ flat, n)
        best = -1
        for i in range(n):
            if not gone[i] and (best < 0 or square[i] > square[best]):
                best = i
        which[step], squares[step] = best, square[best]
        gone[best] = True
        # Schur: the inverse without rows and columns of ``best``.
        pair = inverse[:, 2 * best : 2 * best + 2].copy()
        inverse -= pair @ spread[best] @ np.ascontiguousarray(pair.T)
        for k in (2 * best, 2 * best + 1):
            inverse[k, :] = 0.0
            inverse[:, k] = 0.0
            inverse[k, k] = 1.0
            flat[k] = 0.0
    return which, squares


@njit(**OPTIONS)
def step_gains(inverse, alpha, slope, variance):
    """Gain in log evidence by a step of the zeros before each sighting, sorted by time, (n,).

    ``slope`` (n, 2, Z) are the derivatives by the Z zeros, ``variance`` (Z,) of the step.
    With U the derivatives of the rows from k on, the gain is
    −½ log |1 + V UᵀK⁻¹U| + ½ bᵀ(V⁻¹ + UᵀK⁻¹U)⁻¹ b, b = UᵀK⁻¹r (matrix determinant lemma).
    """
    n, size = slope.shape[0], slope.shape[2]
    gains = np.zeros(n)
    total, right = np.zeros((size, size)), np.zeros(size)
    for k in range(n - 1, 0, -1):
        for z in range(size):
            for a in range(2):
                right[z] += slope[k, a, z] * alpha[2 * k + a]
        for j in range(k, n):
            twice = 1.0 if j == k else 2.0
            for y in range(size):
                for z in range(size):
                    block = 0.0
                    for a in range(2):
                        for b in range(2):
                            w = inverse[2 * k + a, 2 * j + b]
                            block += (
                                slope[k, a, y] * w * slope[j, b, z]
                                + slope[k, a, z] * w * slope[j, b, y]
                            )
                    total[y, z] += 0.5 * twice * block
        spread = total.copy()
        for z in range(size):
            spread[z, z] += 1.0 / variance[z]
        log_size = np.log(np.linalg.det(spread)) + np.sum(np.log(variance))
        gains[k] = 0.5 * np.dot(right, np.linalg.solve(spread, right)) - 0.5 * log_size
    return gains
