"""Compiled kernels: covariances of sightings whose parameters drift, and derived quantities.

The whitened residual of sighting i is −Σ_p J_ip x_p(t_i) + noise. Each x_p is a constant with a
variance, plus an offset that lasts for one regime, plus Ornstein-Uhlenbeck processes with given
amplitudes and time constants. The covariance of two sightings is therefore

    K_ij = Σ_p J_ip J_jpᵀ (σ_p² + ρ_p² [same regime] + δ_p² min(e_i, e_j)
                            + Σ_c a_c² exp(−|t_i − t_j| / τ_c))

where e is the number of zero steps before the sighting. A sighting at an unknown time (NaN) shares
no drift with any other sighting.
"""

import math

import numpy as np
from numba import njit

from heliotrope.geometry import FloatArray
from heliotrope.jit import INNER, OPTIONS


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
    """Return K (2 n, 2 m) for two sets of sightings with Jacobians (n, 2, P) and (m, 2, P).

    ``part``, ``amplitude`` and ``tau`` (C,) are the parameter, the amplitude and the time constant
    of each process. ``same`` means that both sets are the same sightings, so that a sighting shares
    drift with itself even if its time is unknown.
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


@njit(**INNER)
def _decaying_gram(
    jacobian, time, label, epoch, static, regime, step, part, group, amplitude, tau, decay
):
    """Return the matrix of `gram` for one set of sightings; fill the lower half of ``decay``.

    ``decay`` (n, n, G) holds one exponential per group, because the processes of a group have the
    same time constant. It is 0 where a time is unknown.
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


@njit(**INNER)
def cost_and_gradient(
    jacobian, time, label, epoch, residual, static, regime, step, part, group, amplitude, tau, noise
):
    """Return the negative log likelihood and its gradient with respect to the logarithms.

    The logarithms are those of the noise, the amplitudes (C,) and the time constants (G,).

    ``group`` (C,) says which of the G time constants ``tau`` (G,) a process has.
    """
    n, parts, times = len(residual), part.shape[0], tau.shape[0]
    decay = np.empty((n, n, times))
    matrix = _decaying_gram(
        jacobian, time, label, epoch, static, regime, step, part, group, amplitude, tau, decay
    )
    for k in range(2 * n):
        matrix[k, k] += noise * noise
    gradient = np.zeros(1 + parts + times)
    inverse, factor = np.linalg.inv(matrix), np.linalg.cholesky(matrix)
    flat, alpha, cost, trace = np.empty(2 * n), np.empty(2 * n), 0.0, 0.0
    for i in range(n):
        flat[2 * i], flat[2 * i + 1] = residual[i, 0], residual[i, 1]
    for k in range(2 * n):
        total = 0.0
        for j in range(2 * n):
            total += inverse[k, j] * flat[j]
        alpha[k] = total
        cost += 0.5 * total * flat[k] + math.log(factor[k, k])
        trace += inverse[k, k] - total * total
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
    """Fill the cost and gradient of heliostats ``start`` to ``stop``, one heliostat per row."""
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
        for k in range(gradients.shape[1]):
            gradients[i, k] = gradient[k]


@njit(**OPTIONS)
def step_sums(inverse, alpha, slope):
    """Return UᵀK⁻¹U (n, Z, Z) and UᵀK⁻¹r (n, Z), summed over each sighting and all later ones.

    ``slope`` (n, 2, Z) holds the derivatives with respect to the Z drive zeros, and U those of the
    sightings from k onwards.
    """
    n, size = slope.shape[0], slope.shape[2]
    totals, rights = np.zeros((n, size, size)), np.zeros((n, size))
    for k in range(n - 1, -1, -1):
        for z in range(size):
            if k + 1 < n:
                rights[k, z] = rights[k + 1, z]
                for y in range(size):
                    totals[k, y, z] = totals[k + 1, y, z]
            for a in range(2):
                rights[k, z] += slope[k, a, z] * alpha[2 * k + a]
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
                    totals[k, y, z] += 0.5 * twice * block
    return totals, rights


def step_gains(
    inverse: FloatArray, alpha: FloatArray, slope: FloatArray, variance: FloatArray
) -> FloatArray:
    """Return the gain in log evidence from a step of the zeros before each sighting, (n,).

    The sightings are sorted by time. ``variance`` (Z,) is the variance of the step; no step
    precedes the first sighting. The gain is −½ log |1 + V UᵀK⁻¹U| + ½ bᵀ(V⁻¹ + UᵀK⁻¹U)⁻¹ b, b =
    UᵀK⁻¹r (matrix determinant lemma).
    """
    totals, rights = step_sums(inverse, alpha, slope)
    spread = totals + np.diag(1.0 / variance)
    log_size = np.linalg.slogdet(spread)[1] + np.sum(np.log(variance))
    solved = np.linalg.solve(spread, rights[..., None])[..., 0]
    gains = 0.5 * np.sum(rights * solved, axis=-1) - 0.5 * log_size
    gains[:1] = 0.0
    return np.asarray(gains)
