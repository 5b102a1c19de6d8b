"""Drone sightings in one fit with others: a turn that all poses of a mirror share."""

import numpy as np
import pytest

from heliotrope.airborne.evaluate.sightings import fit_together
from heliotrope.calibration import sightings as kinds
from heliotrope.calibration.fit.common import derivative_by_turn, turned_back
from heliotrope.calibration.fit.estimator import FieldFit, fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.errors import InputError
from heliotrope.field.formats.frames import orientation
from heliotrope.geometry import MRAD, direction, normalize, reflect
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.kinds import azimuth_elevation

NOMINAL = azimuth_elevation((30.0, 100.0, 0.0), pivot_height=3.0, pivot_offset=0.2)
SIZES = {
    "tilt_north": 1.5e-3, "tilt_east": 1.2e-3, "azimuth_bias": 4e-3, "elevation_bias": 3e-3,
    "non_orthogonality": 1e-3, "position_east": 0.012, "position_up": 0.008,
}  # fmt: skip
#: Of the turn that all poses share, and of each pose beside it, rad per axis of the normal.
SHARED, OWN = 0.14 * MRAD, 0.03 * MRAD


def installed(seed: int) -> Mechanism:
    rng = np.random.default_rng(seed)
    return NOMINAL.with_parameters({k: v * rng.standard_normal() for k, v in SIZES.items()})


def flown(true: Mechanism, turn: np.ndarray, poses: int, seed: int, own: float = OWN):
    """Sightings of a mirror that the drone sees turned, as to_sightings gives them."""
    rng = np.random.default_rng(seed)
    counts = np.stack([rng.uniform(2.2, 4.4, poses), rng.uniform(0.4, 1.3, poses)], axis=-1)
    R, vertex = orientation(true, counts)
    seen = turn + own * rng.standard_normal((poses, 2))
    # ω × n: about x it moves the normal down, about y to the right.
    normal = R[..., 2] - seen[:, :1] * R[..., 1] + seen[:, 1:] * R[..., 0]
    place = vertex + 120.0 * normalize(normal)
    return kinds.drone(np.zeros(poses, int), counts, place, place, sigma=2.0 * SHARED)


def aimed(true: Mechanism, count: int, seed: int, noise: float = 3e-4):
    """Camera-target sightings of an afternoon."""
    rng = np.random.default_rng(seed)
    sun = direction(np.linspace(3.3, 4.2, count), 0.9 - 0.4 * np.linspace(0, 1, count))
    target = np.array([0.0, 0.0, 60.0])
    wanted = normalize(sun + normalize(target - NOMINAL.pose(np.zeros(2)).vertex))
    azimuth = np.arctan2(wanted[:, 0], wanted[:, 1]) % (2 * np.pi)
    counts = np.stack([azimuth, np.arcsin(wanted[:, 2])], axis=-1)
    pose = true.pose(counts)
    way = reflect(sun, pose.normal)
    seen = pose.vertex + 125.0 * (way + noise * rng.standard_normal(way.shape))
    return kinds.camera_target(np.zeros(count, int), counts, sun, seen, sigma=noise)


def error(told: FieldFit, true: Mechanism) -> float:
    """RMS of the normal's error in poses all over the sky, rad."""
    rng = np.random.default_rng(7)
    counts = np.stack([rng.uniform(2.0, 4.6, 60), rng.uniform(0.3, 1.4, 60)], axis=-1)
    model = NOMINAL.with_parameters({n: v[0] for n, v in told.parameters.items()})
    gap = model.pose(counts).normal - true.pose(counts).normal
    return float(np.sqrt(np.mean(np.sum(gap**2, axis=-1))))


def test_both_together_predict_better_than_either_alone_where_slopes_are_not_known() -> None:
    errors: dict[str, list[float]] = {"target": [], "drone": [], "together": []}
    for seed in range(12):
        true = installed(seed)
        shared = SHARED * np.random.default_rng(100 + seed).standard_normal(2)
        drone, ground = flown(true, shared, 15, seed), aimed(true, 5, seed)
        for name, used in (("target", ground), ("drone", drone)):
            told = fit(NOMINAL[None], used, "malan8", loss="square", adapt_scale=False)
            errors[name].append(error(told, true))
        both = fit_together(NOMINAL[None], ground, drone, "malan8")
        errors["together"].append(error(both.calibration, true))
    figures = {name: np.sqrt(np.mean(np.square(v))) for name, v in errors.items()}
    assert figures["together"] < 0.75 * figures["drone"] < 0.5 * figures["target"]


def test_a_turn_is_found_and_known_as_well_as_it_says() -> None:
    lengths, noise = [], []
    for seed in range(20):
        true = installed(seed)
        shared = SHARED * np.random.default_rng(100 + seed).standard_normal(2)
        found = fit_together(
            NOMINAL[None], aimed(true, 8, seed), flown(true, shared, 15, seed), "malan8"
        )
        off = found.turn[0] - shared
        lengths.append(off @ np.linalg.solve(found.turn_covariance[0], off))
        noise.append(found.noise[0])
        assert np.diag(found.turn_covariance[0]).max() < SHARED**2
    # χ² of two degrees of freedom: the mean of 20 is 2 ± 0.45.
    assert 0.8 < np.mean(lengths) < 3.4
    assert np.mean(noise) == pytest.approx(OWN / SHARED, rel=0.15)


def test_a_large_turn_is_taken_out_exactly() -> None:
    names = ("azimuth_bias", "elevation_bias", "tilt_north", "tilt_east")
    true = NOMINAL.with_parameters({n: SIZES[n] for n in names})
    turn = np.array([4.0, -3.0]) * MRAD
    seen = flown(true, turn, 15, 3, own=0.0)
    wide = kinds.drone(seen.heliostat, seen.counts, seen.source, seen.destination, sigma=8.0 * MRAD)
    ground = aimed(true, 40, 3, noise=1e-6)
    priors = dict.fromkeys(names, 1.0)
    found = fit_together(NOMINAL[None], ground, wide, names, priors=priors)
    np.testing.assert_allclose(found.turn[0], turn, atol=0.02 * MRAD)
    assert error(found.calibration, true) < 0.02 * MRAD
    # Taken for what it is not, the turn goes into the parameters.
    drone = fit(NOMINAL[None], wide, names, priors=priors, loss="square", adapt_scale=False)
    assert error(drone, true) > 2.0 * MRAD


def test_the_derivative_by_the_turn() -> None:
    true, step = installed(4), 1e-6
    # At the solution: far from it the axes of the residual turn too.
    seen = flown(true, np.zeros(2), 6, 4, own=0.0)
    many = true[None][np.zeros(len(seen), dtype=int)]
    here = derivative_by_turn(many, seen)
    for i, way in enumerate(step * np.eye(2)):
        up, down = (
            linearise(many, turned_back(seen, true[None], sign * way[None]), ()).residual
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose((up - down) / (2 * step), here[..., i], rtol=1e-5, atol=0.01)


def test_heliostats_that_have_only_one_kind() -> None:
    true = installed(5)
    drone, ground = flown(true, np.zeros(2), 6, 5), aimed(true, 6, 5)
    alone = (
        fit(NOMINAL[None], ground, "malan8", loss="square", adapt_scale=False),
        fit(NOMINAL[None], drone, "malan8", loss="square", adapt_scale=False),
    )
    apart = kinds.Sightings(**{**vars(drone), "heliostat": np.ones(6, dtype=np.intp)})
    found = fit_together(NOMINAL[None][[0, 0, 0]], ground, apart, "malan8")
    np.testing.assert_allclose(found.calibration.values[0], alone[0].values[0], atol=1e-7)
    np.testing.assert_array_equal(found.turn[[0, 2]], 0.0)
    # The drone alone cannot tell the turn from the zeros of the drives: it is not sure of them.
    at = found.calibration.names.index("elevation_bias")
    assert found.calibration.sigma[1, at] > SHARED
    assert np.sqrt(np.diag(found.turn_covariance[1])).max() < 1.001 * SHARED
    assert found.noise[0] == found.noise[2] == 1.0


def test_sightings_of_a_heliostat_that_is_not_there_are_refused() -> None:
    true = installed(6)
    drone, ground = flown(true, np.zeros(2), 3, 6), aimed(true, 3, 6)
    other = kinds.Sightings(**{**vars(drone), "heliostat": np.full(3, 4)})
    with pytest.raises(InputError, match="heliostat index 4"):
        fit_together(NOMINAL[None], ground, other, "malan8")
