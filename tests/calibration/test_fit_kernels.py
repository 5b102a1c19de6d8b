"""The derivatives that the fit steps along, against differences of its cost."""

from typing import Any

import numpy as np
import pytest
from numba import njit

from heliotrope.calibration.fit import _fit_kernels as kernels
from heliotrope.calibration.fit._residual_kernels import scratch_mechanism
from heliotrope.geometry import direction, tangent_axes
from heliotrope.mechanism.chain import Mechanism
from support.machines import every_kind, imperfect, random_counts

ROWS = 12


@njit
def normal_equations(problem, y, loss, scale, curved, hessian, gradient):  # type: ignore[no-untyped-def]
    return kernels._normal_equations(problem, y, loss, scale, curved, hessian, gradient)


@njit
def loss_and_weights(square, loss):  # type: ignore[no-untyped-def]
    return kernels.loss_and_weights(square, loss)


def _problem(mechanism: Mechanism) -> tuple[Any, ...]:
    """What the kernel reads: ends near and far away, and every parameter there is."""
    rng = np.random.default_rng(3)
    counts = random_counts(mechanism, ROWS)
    pose = mechanism.pose(counts)
    far = np.arange(ROWS) % 3 == 0
    source = pose.normal + 0.3 * direction(rng.uniform(0, 6, ROWS), 0.2)
    source /= np.linalg.norm(source, axis=-1, keepdims=True)
    near = np.arange(ROWS) % 2 == 0
    data = (
        counts, np.where(near[:, None], pose.vertex + 40.0 * source, source), ~near,
        np.where(far[:, None], pose.normal, pose.vertex + 30.0 * pose.normal), far,
        tangent_axes(pose.normal), rng.normal(0, 20.0, (ROWS, 2, 2)), np.arange(ROWS) != 5,
    )  # fmt: skip
    codes = mechanism.codes(tuple(mechanism.parameters))
    sigma = np.array([row.prior for row in mechanism.parameters.values()])
    arrays = mechanism[None].kernel_arrays
    base = tuple(a if k == 6 else a[0] for k, a in enumerate(arrays))
    joints, drives = len(mechanism.joints), len(mechanism.driven)
    scratch = scratch_mechanism(joints, drives, arrays[5].shape[2], len(sigma))
    work = np.full(ROWS, np.nan), scratch, np.zeros((3, 2, 6)), np.empty((2, len(sigma)))
    return base, codes, sigma, (0, ROWS), data, *work


@pytest.mark.parametrize("loss", [kernels.SQUARE, kernels.HUBER, kernels.CAUCHY])
@pytest.mark.parametrize("kind", every_kind())
def test_gradient_is_that_of_the_cost(kind: str, loss: int) -> None:
    mechanism = imperfect(every_kind()[kind])
    problem = _problem(mechanism)
    size = len(problem[2])
    hessian, gradient, unused = np.empty((size, size)), np.empty(size), np.empty(size)
    scale, y = 1.7, np.random.default_rng(1).normal(0, 0.3, size)

    def cost(moved: np.ndarray, out: np.ndarray = unused) -> float:
        args = problem, moved, loss, scale, False, hessian, out
        return float(normal_equations(*args))

    cost(y, gradient)
    steps = 1e-5 * np.eye(size)
    # The gradient is half the cost's, as the hessian.
    found = np.array([(cost(y + h) - cost(y - h)) / 4e-5 for h in steps])
    # The ratio of a worm is searched, and no fit moves it: its derivative counts as 0.
    moved = [not name.endswith("_worm_ratio") for name in mechanism.parameters]
    assert gradient[moved] == pytest.approx(found[moved], rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("loss", [kernels.HUBER, kernels.CAUCHY])
def test_curvature_of_the_loss_is_that_of_its_weight(loss: int) -> None:
    for square in (0.3, 2.0, 4.0):
        h = 1e-6
        up, down = (loss_and_weights(square + d, loss) for d in (h, -h))
        value, weight, bend = loss_and_weights(square, loss)
        assert value > 0.0
        assert weight == pytest.approx((up[0] - down[0]) / (2 * h), abs=1e-8)
        assert bend == pytest.approx((up[1] - down[1]) / h, abs=1e-8)


def test_a_far_outlier_does_not_turn_the_step_around() -> None:
    square = 100.0
    _, weight, bend = loss_and_weights(square, kernels.CAUCHY)
    assert weight + bend * square == pytest.approx(0.0, abs=1e-15)
