"""Orientations from reflections: truth recovered, faults named, sightings that fit."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.airborne.evaluate.budget import Budget, lever
from heliotrope.airborne.evaluate.orientation import (
    Orientations,
    differences,
    measure,
    measure_field,
    rotation_between,
    turned,
)
from heliotrope.airborne.evaluate.reflections import Reflections, join, reflections
from heliotrope.airborne.evaluate.sightings import to_sightings
from heliotrope.airborne.mirror import MirrorShape, measured_normal, reflection_points
from heliotrope.airborne.simulate.trial import (
    TrialConditions,
    Trials,
    four_facets,
    trial_mirror,
    trials,
)
from heliotrope.calibration import sightings as kinds
from heliotrope.calibration.fit.estimator import fit
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.errors import InputError
from heliotrope.field.formats.frames import orientation
from heliotrope.geometry import MRAD, direction, normalize, reflect, tangent_axes
from heliotrope.mechanism.kinds import azimuth_elevation

EXACT = TrialConditions(
    slope=0.0, rtk=0.0, reflection=0.0, pointing=8e-3, budget=Budget(0, 0, 0, 0)
)
SHAPE = four_facets()


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("mean", ["plain", "area"])
@pytest.mark.parametrize("slope", [0.0, 0.8e-3])
def test_the_truth_is_found_where_nothing_is_wrong(mean: str, slope: float) -> None:
    s = trial_mirror(SHAPE, replace(EXACT, slope=slope), 4)
    found = measure(
        s.reflections,
        s.shape,
        s.expected_rotation,
        s.expected_vertex,
        mean=mean,
        budget=EXACT.budget,
    )
    assert np.linalg.norm(rotation_between(s.rotation, found.rotation)) < 1e-4 * MRAD
    np.testing.assert_allclose(
        found.correction, rotation_between(s.expected_rotation, s.rotation)[:2], atol=1e-7
    )
    assert np.abs(found.difference).max() < 1e-3 * MRAD
    assert (found.systematic == 0.0).all()
    assert found.azimuth == pytest.approx(np.arctan2(*s.rotation[:2, 2]) % (2 * np.pi), abs=1e-7)
    assert found.elevation == pytest.approx(np.arcsin(s.rotation[2, 2]), abs=1e-7)
    assert np.linalg.norm(found.normal) == pytest.approx(1.0)


def test_two_rounds_are_enough() -> None:
    s = trial_mirror(SHAPE, EXACT, 4)
    error = []
    for rounds in (0, 1, 2):
        found = measure(
            s.reflections,
            SHAPE,
            s.expected_rotation,
            s.expected_vertex,
            rounds=rounds,
            mean="plain",
        )
        error.append(float(np.linalg.norm(rotation_between(s.rotation, found.rotation)[:2])))
    assert error[0] > 100.0 * error[1]
    assert error[2] < 1e-6 * MRAD


def test_the_vertex_turns_about_the_pivot() -> None:
    """A vertex 0.4 m in front of its pivot moves by 0.4 m times the turn."""
    s = trial_mirror(SHAPE, EXACT, 4)
    pivot = np.array([0.0, 0.0, -0.4])
    expected_vertex = s.vertex + (s.rotation - s.expected_rotation) @ pivot
    found = measure(s.reflections, SHAPE, s.expected_rotation, expected_vertex, pivot=pivot)
    np.testing.assert_allclose(found.vertex, s.vertex, atol=1e-6)
    assert np.linalg.norm(rotation_between(s.rotation, found.rotation)[:2]) < 1e-4 * MRAD
    without = measure(s.reflections, SHAPE, s.expected_rotation, expected_vertex)
    assert np.linalg.norm(rotation_between(s.rotation, without.rotation)[:2]) > 5e-3 * MRAD


def test_rotations_about_the_mirrors_own_axes() -> None:
    """rotX leans the normal down along the mirror, rotY to the right."""
    R = turned(np.eye(3), [2e-3, 3e-3])
    np.testing.assert_allclose(R[:2, 2], [3e-3, -2e-3], atol=1e-8)
    np.testing.assert_allclose(rotation_between(np.eye(3), R), [2e-3, 3e-3, 0.0], atol=1e-12)
    assert (turned(R, [0.0, 0.0]) == R).all()


def test_gross_errors_are_left_out() -> None:
    s = trial_mirror(SHAPE, replace(EXACT, reflection=0.01), 3)
    x = s.reflections.x.copy()
    x[[5, 11]] += [1.1, 0.9]
    wrong = replace(s.reflections, x=np.clip(x, -1.6, 2.5))
    found = measure(wrong, SHAPE, s.expected_rotation, s.expected_vertex)
    assert set(np.flatnonzero(found.outlier)) >= {5, 11}
    assert found.count == len(wrong) - found.outlier.sum()
    assert np.linalg.norm(rotation_between(s.rotation, found.rotation)[:2]) < 0.05 * MRAD


def test_a_canted_facet_is_named() -> None:
    turns = np.zeros((4, 2))
    turns[2] = [2.5 * MRAD, -2.0 * MRAD]
    s = trial_mirror(SHAPE.canted(turns), replace(EXACT, reflection=0.01, hover=0.05), 3)
    found = measure(s.reflections, SHAPE, s.expected_rotation, s.expected_vertex)
    told = [w for w in found.warnings if "canted off by" in w]
    assert len(told) == 1
    assert told[0].startswith("facet 2 is canted off by +2.")
    apart = found.facets[2].mean - np.mean([found.facets[k].mean for k in (0, 1, 3)], axis=0)
    np.testing.assert_allclose(apart, turns[2], atol=0.1 * MRAD)


def test_uneven_sampling_is_named() -> None:
    s = trial_mirror(SHAPE, replace(EXACT, reflection=0.01), 3)
    part = s.reflections.take(s.reflections.x > 0.0)
    told = measure(part, SHAPE, s.expected_rotation, s.expected_vertex).warnings
    assert any(w.startswith("asymmetric sampling: the centre of the points is +0.") for w in told)
    assert sum("it may be canted off, dirty or shaded" in w for w in told) == 2
    few = measure(s.reflections.take([3]), SHAPE, s.expected_rotation, s.expected_vertex)
    assert few.warnings[0].startswith("only 1 reflections")
    assert (few.sigma_mean > 0.8 * MRAD).all()


def test_a_mirror_with_few_reflections_is_taken_to_scatter_like_the_others() -> None:
    rough = [
        trial_mirror(SHAPE, replace(EXACT, slope=2.5e-3, columns=6, rows=5), k) for k in range(7)
    ]
    parts = [
        replace(s.reflections, heliostat=np.full(len(s.reflections), k))
        for k, s in enumerate(rough)
    ]
    parts[6] = parts[6].take([5, 20])
    found = measure_field(
        join(parts),
        [str(k) for k in range(7)],
        lambda _: SHAPE,
        [s.expected_rotation for s in rough],
        [s.expected_vertex for s in rough],
    )
    alone = measure(parts[6], SHAPE, rough[6].expected_rotation, rough[6].expected_vertex)
    typical = np.median([o.sigma.mean() for o in found.found[:6]])
    assert found.found[6].count == 2
    assert found.found[6].sigma_mean.mean() > 1.5 * alone.sigma_mean.mean()
    assert found.found[6].sigma_mean.mean() > 0.7 * typical / np.sqrt(2.0)


def test_differences_that_are_not_normal_are_named() -> None:
    s = trial_mirror(SHAPE, EXACT, 3)
    rng = np.random.default_rng(0)
    shift = 0.02 * rng.choice([-1.0, 1.0], len(s.reflections))
    odd = replace(s.reflections, x=s.reflections.x + shift)
    told = measure(odd, SHAPE, s.expected_rotation, s.expected_vertex).warnings
    assert any("not normally distributed" in w for w in told)


def test_a_field_goes_on_where_one_heliostat_fails() -> None:
    s = trial_mirror(SHAPE, EXACT, 3)
    one = s.reflections
    strange = replace(one, heliostat=one.heliostat + 2, facet=one.facet + 4)
    both = join([one, strange])
    found = measure_field(
        both,
        ("A", "B", "C"),
        lambda _: SHAPE,
        np.tile(s.expected_rotation, (3, 1, 1)),
        np.tile(s.expected_vertex, (3, 1)),
    )
    assert [o.heliostat for o in found.found] == [0]
    assert found.left_out["B"] == "no reflection in any photograph"
    assert "the mirror has 4 facets" in found.left_out["C"]
    assert found.of("A") is found.found[0]
    assert found.of("B") is None


def test_what_cannot_be_measured_is_refused() -> None:
    s = trial_mirror(SHAPE, EXACT, 3)
    pose = (SHAPE, s.expected_rotation, s.expected_vertex)
    with pytest.raises(InputError, match="no reflections"):
        measure(s.reflections.take([]), *pose)
    two = join([s.reflections, replace(s.reflections, heliostat=s.reflections.heliostat + 1)])
    with pytest.raises(InputError, match="of several heliostats"):
        measure(two, *pose)
    with pytest.raises(InputError, match="unknown mean 'median'"):
        measure(s.reflections, *pose, mean="median")  # type: ignore[arg-type]


def test_levers_are_derivatives() -> None:
    rng = np.random.default_rng(2)
    point = rng.normal(0.0, 1.0, (5, 3))
    camera = point + 120.0 * direction(rng.uniform(0, 6, 5), rng.uniform(0.5, 1.2, 5))
    led = camera + rng.normal(0.0, 3.0, (5, 3))
    normal = measured_normal(point, camera, led)
    axes = tangent_axes(normal)
    both, lamp = lever(point, camera, led, axes)
    for k, move in enumerate(np.eye(3) * 1e-4):
        turn = measured_normal(point, camera + move, led + move) - normal
        np.testing.assert_allclose(
            np.einsum("nak,nk->na", axes, turn) / 1e-4, both[..., k], atol=1e-7
        )
        turn = measured_normal(point, camera, led + move) - normal
        np.testing.assert_allclose(
            np.einsum("nak,nk->na", axes, turn) / 1e-4, lamp[..., k], atol=1e-7
        )


def test_the_papers_systematic_budget() -> None:
    """10 mm of position and 30 mm of kinematics at 150 m: 0.21 mrad; 0.29 with 0.20 of the mean."""
    budget = Budget(0.010, 0.030, 0.0, 0.0)
    assert budget.systematic(150.0) == pytest.approx(0.21 * MRAD, abs=0.005 * MRAD)
    assert np.hypot(budget.systematic(150.0), 0.20 * MRAD) == pytest.approx(0.29e-3, abs=0.005e-3)
    s = trial_mirror(SHAPE, EXACT, 1)
    found = measure(s.reflections, SHAPE, s.expected_rotation, s.expected_vertex, budget=budget)
    np.testing.assert_allclose(found.systematic, budget.systematic(150.0), rtol=1e-3)
    with pytest.raises(InputError, match="rtk must be 0 or more, not -1"):
        Budget(rtk=-1.0)
    with pytest.raises(InputError, match=r"lamp must be .* not nan"):
        Budget(lamp=float("nan"))


WIDE = TrialConditions(columns=13, rows=10, reflection=0.020)


@pytest.fixture(scope="module")
def many_points() -> Trials:
    return trials(WIDE, 14)


@pytest.mark.parametrize("pattern", ["narrow", "wide"])
def test_the_papers_figures(pattern: str, many_points: Trials) -> None:
    """σ_mean 0.07-0.19 mrad with the ideal surface; true error beside it; honest totals."""
    narrow = TrialConditions(columns=7, rows=6, reflection=0.010)
    t = many_points if pattern == "wide" else trials(narrow, 14)
    assert 30 < t.count.mean() < 110
    assert 0.07 < 1e3 * rms(t.sigma_mean) < 0.19
    assert 0.07 < 1e3 * rms(t.sigma_plain) < 0.19
    # What the evaluation says is near the truth, and rather above it.
    assert 0.8 < rms(t.sigma_mean) / rms(t.error) < 2.0
    assert rms(t.systematic) == pytest.approx(0.21 * MRAD, rel=0.02)
    assert 0.2 < 1e3 * rms(t.total_error) < 0.3
    assert 0.82 < t.coverage <= 1.0


def test_a_measured_surface_gives_hundredths() -> None:
    c = TrialConditions(columns=7, rows=6, reflection=0.020)
    t = trials(c, 12, map_known=True)
    assert 0.01 < 1e3 * rms(t.sigma_mean) < 0.04
    assert rms(t.error) < 0.04 * MRAD


def test_the_mean_over_the_area_beats_the_mean_over_points(many_points: Trials) -> None:
    plain = trials(WIDE, 8, mean="plain")
    assert rms(many_points.error[:8]) < 0.9 * rms(plain.error)


def test_a_distance_of_zero_is_refused() -> None:
    with pytest.raises(InputError, match="must be above 0"):
        TrialConditions(distance=0.0)


# Into the model ------------------------------------------------------------------------------

TRUTH = {
    "tilt_north": 1.5e-3, "tilt_east": -1.2e-3, "azimuth_bias": 4e-3, "elevation_bias": -3e-3,
    "non_orthogonality": 1e-3, "position_east": 0.012, "position_up": -0.008,
}  # fmt: skip


def flown(
    mechanism: object, true: object, counts: np.ndarray, shape: MirrorShape, seed: int
) -> Orientations:
    """Orientation of one mirror in one pose, seen from a small pattern."""
    rng = np.random.default_rng(seed)
    R, v = orientation(true, counts)  # type: ignore[arg-type]
    told_R, told_v = orientation(mechanism, counts)  # type: ignore[arg-type]
    xy = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-0.8, 0.8, 4)), -1).reshape(-1, 2)
    camera = v + np.c_[xy, np.full(len(xy), 120.0)] @ R.T
    led = camera + 0.12 * R[:, 0]
    seen = reflection_points(shape, R, v, camera, led)
    off = 0.008 * rng.standard_normal(camera.shape)
    noisy = seen.xy + 0.015 * rng.standard_normal(seen.xy.shape)
    found = reflections(
        seen.position,
        0,
        seen.facet,
        noisy,
        (camera + off)[seen.position],
        (led + off)[seen.position],
        0.015,
    )
    return measure_field(found, ("A",), lambda _: shape, told_R[None], told_v[None])


def test_sightings_say_what_the_orientation_says() -> None:
    mechanism = azimuth_elevation((0.0, 100.0, 0.0), pivot_height=3.0, pivot_offset=0.2)
    true = mechanism.with_parameters(TRUTH)
    counts = np.array([2.5, 0.9])
    one = flown(mechanism, true, counts, SHAPE, 1)
    o = one.found[0]
    for per in ("reflection", "orientation"):
        seen = to_sightings(one, counts[None], per=per, time=12.0)
        ends = [normalize(e - o.vertex) for e in (seen.source, seen.destination)]
        bisectors = normalize(ends[0] + ends[1])
        weights = 1.0 / seen.sigma**2
        weights /= weights.sum()
        gap = (bisectors - o.normal) @ o.rotation[:, :2]
        rot = np.stack([-gap[:, 1], gap[:, 0]], axis=-1)
        wanted = o.difference[~o.outlier] if per == "reflection" else np.zeros((1, 2))
        np.testing.assert_allclose(rot, wanted, atol=1e-9)
        # All together they weigh what the budget says; a beam turns by twice the normal.
        together = 1.0 / np.sqrt(np.sum(1.0 / seen.sigma**2))
        assert together == pytest.approx(2.0 * rms(o.sigma_total))
        assert (seen.time == 12.0).all()
        # Single ones weigh as in the mean over the area: together they say what it says.
        if per == "reflection" and (o.weight[~o.outlier] > 0.1 / o.count).all():
            np.testing.assert_allclose(weights, o.weight[~o.outlier])
        assert np.abs(weights @ rot).max() < 0.02 * MRAD
    less = to_sightings(one, counts[None], per="orientation", systematic=False)
    assert less.sigma[0] == pytest.approx(2.0 * rms(o.sigma_mean))


def targets(mechanism: object, true: object, count: int, seed: int) -> kinds.Sightings:
    """Camera-target sightings of one afternoon, 0.3 mrad of noise."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(3.3, 4.2, count)
    sun = direction(azimuth, 0.9 - 0.4 * np.linspace(0, 1, count))
    target = np.array([0.0, 0.0, 60.0])
    nominal = mechanism.pose(np.zeros(2)).vertex  # type: ignore[attr-defined]
    wanted = normalize(sun + normalize(target - nominal))
    counts = np.stack(
        [np.arctan2(wanted[:, 0], wanted[:, 1]) % (2 * np.pi), np.arcsin(wanted[:, 2])], -1
    )
    pose = true.pose(counts)  # type: ignore[attr-defined]
    way = reflect(sun, pose.normal)
    length = np.linalg.norm(target - nominal)
    seen = pose.vertex + length * (way + 3e-4 * rng.standard_normal(way.shape))
    return kinds.camera_target(np.zeros(count, dtype=int), counts, sun, seen, sigma=3e-4)


def test_both_together_predict_better_than_either_alone() -> None:
    """5 camera-target and 15 drone sightings in one fit; the slope map is known.

    Without it the same slopes shift all poses alike, which no number of poses averages.
    """
    mechanism = azimuth_elevation((30.0, 100.0, 0.0), pivot_height=3.0, pivot_offset=0.2)
    errors: dict[str, list[float]] = {"target": [], "drone": [], "both": []}
    for seed in range(4):
        rng = np.random.default_rng(seed)
        values = {k: v * rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.5) for k, v in TRUTH.items()}
        true = mechanism.with_parameters(values)
        slopes = trial_mirror(SHAPE, TrialConditions(), 50 + seed).shape
        poses = np.stack([rng.uniform(2.2, 4.4, 15), rng.uniform(0.4, 1.3, 15)], axis=-1)
        flights = kinds.join(
            [
                to_sightings(
                    flown(mechanism, true, p, slopes, 99 * seed + k),
                    p[None],
                    per="orientation",
                    time=0.0,
                    systematic=False,
                )
                for k, p in enumerate(poses)
            ]
        )
        ground = targets(mechanism, true, 5, seed)
        held = targets(mechanism, true, 40, 1000 + seed)
        later = np.stack([rng.uniform(2.0, 4.6, 40), rng.uniform(0.3, 1.4, 40)], axis=-1)
        for name, used in (
            ("target", ground),
            ("drone", flights),
            ("both", kinds.join([ground, flights])),
        ):
            told = fit(mechanism[None], used, "malan8", loss="square", adapt_scale=False)
            model = mechanism.with_parameters(
                {n: told.values[0, p] for p, n in enumerate(told.names)}
            )
            everywhere = np.concatenate([held.counts, later])
            gap = model.pose(everywhere).normal - true.pose(everywhere).normal
            errors[name].append(rms(gap) * np.sqrt(3.0))
    figures = {name: rms(np.array(v)) for name, v in errors.items()}
    assert figures["both"] < figures["drone"] < figures["target"]
    assert figures["both"] < 0.3 * MRAD


def test_drone_sightings_have_the_derivatives_of_all_others() -> None:
    mechanism = azimuth_elevation((0.0, 100.0, 0.0), pivot_height=3.0, pivot_offset=0.2)
    counts = np.array([2.5, 0.9])
    one = flown(mechanism, mechanism, counts, SHAPE, 1)
    seen = to_sightings(one, counts[None])
    names = ("azimuth_bias", "tilt_north", "position_up")
    many = mechanism[None][np.zeros(len(seen), dtype=np.intp)]
    here = linearise(many, seen, names)
    for p, name in enumerate(names):
        step = 1e-6
        up, down = (linearise(many.with_parameters({name: s}), seen, names) for s in (step, -step))
        by = (up.residual - down.residual) / (2 * step)
        np.testing.assert_allclose(by, here.jacobian[..., p], rtol=1e-4, atol=1e-2)


def test_wrong_sightings_are_refused() -> None:
    nothing = Orientations(("A",), (), {"A": "no reflection in any photograph"})
    with pytest.raises(InputError, match="no heliostat has an orientation"):
        to_sightings(nothing, np.zeros((1, 2)))
    with pytest.raises(InputError, match="per='photo'"):
        to_sightings(nothing, np.zeros((1, 2)), per="photo")  # type: ignore[arg-type]
    s = trial_mirror(SHAPE, EXACT, 3)
    o = measure(s.reflections, SHAPE, s.expected_rotation, s.expected_vertex)
    with pytest.raises(InputError, match="counts of 2 heliostats for 1 names"):
        to_sightings(Orientations(("A",), (o,), {}), np.zeros((2, 2)))


def test_differences_have_their_sign_from_the_expected_normal_to_the_measured() -> None:
    s = trial_mirror(SHAPE, EXACT, 3)
    away = turned(s.rotation, [-1 * MRAD, 2 * MRAD])
    omega = differences(s.reflections, SHAPE, away, s.vertex)
    # To first order: the points move with the mirror, but not the measured normals.
    np.testing.assert_allclose(omega, np.broadcast_to([1e-3, -2e-3], omega.shape), atol=5e-5)


def test_reflections_is_a_table() -> None:
    s: Reflections = trial_mirror(SHAPE, EXACT, 3).reflections
    assert len(s.take([])) == 0
    assert len(s.of(0)) == len(s)
    assert len(s.of(1)) == 0
    assert len(join([])) == 0
