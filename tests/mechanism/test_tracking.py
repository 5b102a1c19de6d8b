"""Tracking: the beam reaches its aim, or the nearest pose is given and says so."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import minimize

from heliotrope.errors import InputError
from heliotrope.geometry import (
    angle_between,
    bisector,
    direction,
    normalize,
    reflect,
    wrap_signed,
)
from heliotrope.mechanism import guo, kinds
from heliotrope.mechanism.armature import Armature
from heliotrope.mechanism.drives import direct, linear_grigoriev
from heliotrope.mechanism.tracking import TrackingStatus, track
from support.machines import every_kind, imperfect

UNIT = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def _miss(sun, aim, normal, vertex) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Distance of the reflected ray from the aim, m; infinite if it goes the other way."""
    ray = reflect(sun, normal)
    way = aim - vertex
    away = np.linalg.norm(np.cross(way, ray), axis=-1)
    return np.where(np.sum(way * ray, axis=-1) > 0, away, np.inf)


@given(UNIT, UNIT, UNIT, UNIT, UNIT, st.floats(0, 0.5), st.floats(5, 1000))
@example(*map(np.array, ((0, 1.0, 0), (0, 0, 1.0), (1.0, 0, 1), (0, 1.0, 0), (0, 1.0, 0))), 0.5, 10)
def test_the_beam_reaches_its_aim(a, b, n, s, p, arm, distance) -> None:  # type: ignore[no-untyped-def]
    a, b, n, s, p = (normalize(v) for v in (a, b, n, s, p))
    if np.linalg.norm(np.cross(a, b)) < 0.05 or np.linalg.norm(np.cross(n, b)) < 0.05:
        return
    if np.dot(s, p) < -0.99:
        return  # nearly opposite: the bisector itself is lost in rounding
    machine = Armature.of(a, (0, 0, 1), b, arm * b + (0, 0, 1), arm * n + arm * b + (0, 0, 1), n)
    aim = distance * p
    found = track(machine, s, aim)
    for branch in (0, 1):
        status = found.status[branch]
        if status == TrackingStatus.OK:
            miss = _miss(s, aim, found.normal[branch], found.vertex[branch])
            assert miss < 1.1e-9 + 1e-15 * distance
            normal, vertex = machine.pose(found.angles[branch])
            np.testing.assert_allclose(found.normal[branch], normal, rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.vertex[branch], vertex, rtol=0, atol=1e-9)
        elif status == TrackingStatus.UNREACHABLE:
            # Honest: the residual is the angle from the bisector at the pose given.
            way = normalize(aim - found.vertex[branch])
            rest = angle_between(found.normal[branch], bisector(s, way))
            assert rest == pytest.approx(found.residual[branch], abs=1e-9)
            assert 2.0 * rest * distance > 1e-9  # a beam that strikes is not called unreachable
        else:
            assert status == TrackingStatus.DEGENERATE or distance < 10


@pytest.mark.parametrize("kind", [k for k in every_kind() if k != "single_axis"])
def test_every_kind_tracks_with_all_imperfections(kind: str) -> None:
    mechanism = imperfect(every_kind()[kind], seed=2)
    sun, aim = direction(2.6, 0.7), np.array([0.0, 0.0, 40.0])
    found = track(mechanism, sun, aim)
    assert found.served.any()
    branch = int(found.best)
    assert found.served[branch]
    pose = mechanism.pose(found.counts[branch])
    assert _miss(sun, aim, pose.normal, pose.vertex) < 2e-9


def test_near_field_needs_newton() -> None:
    machine = kinds.azimuth_elevation((0, 0, 0), pivot_offset=0.5)
    sun, aim = direction(0.5, 0.8), np.array([0.3, 1.2, 0.9])
    plain = track(machine, sun, aim, newton=False, max_iterations=5)
    assert not plain.served.all()
    found = track(machine, sun, aim)
    assert found.served.all()
    assert (_miss(sun, aim, found.normal, found.vertex) < 1e-9).all()


@pytest.mark.parametrize("zeta", [1.0, 1e-1, 1e-2, 1e-3, 1e-5, 1e-7, 1e-9])
def test_keyhole(zeta: float) -> None:
    """The nearer the normal to the primary axis, the slower the fixed point."""
    machine = kinds.azimuth_elevation((0, 0, 0), pivot_height=1.5, pivot_offset=0.4)
    normal = direction(0.4, 0.5 * np.pi - zeta)
    vertex = np.array([0, 0, 1.5]) + 0.4 * normal
    sun = normalize(normal + 0.4 * np.array([1.0, 0.2, 0.0]))
    aim = vertex + 60.0 * reflect(sun, normal)
    found = track(machine, sun, aim)
    assert found.served.all()
    assert (_miss(sun, aim, found.normal, found.vertex) < 1.1e-9).all()


@pytest.mark.parametrize("seed", range(6))
def test_dead_cone_gives_the_nearest_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    machine = kinds.azimuth_elevation((0, 0, 0), pivot_offset=0.2).with_parameters(
        {"canting": 0.15, "non_orthogonality": -0.1}
    )
    wanted = direction(rng.uniform(0, 6), 0.5 * np.pi - 0.02)
    sun = normalize(wanted + rng.normal(0, 0.2, 3) * [1, 1, 0])
    aim = 80.0 * reflect(sun, wanted)
    found = track(machine, sun, aim)
    assert (found.status == TrackingStatus.UNREACHABLE).all()

    def miss(angles: np.ndarray) -> float:
        normal, vertex = machine.armature.pose(angles)
        return float(angle_between(normal, bisector(sun, normalize(aim - vertex))))

    best = min(
        minimize(miss, [a, b], method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-12}).fun
        for a in np.linspace(0, 6, 7)
        for b in (1.3, 1.8)
    )
    assert found.residual.min() == pytest.approx(best, abs=2e-5)


def _stopped(**stops: float):  # type: ignore[no-untyped-def]
    first = {k[2:]: v for k, v in stops.items() if k.startswith("a_")}
    second = {k[2:]: v for k, v in stops.items() if k.startswith("e_")}
    drives = (direct(**first), direct(**second))
    return kinds.azimuth_elevation((0, 0, 0), pivot_offset=0.3, drives=drives)


@pytest.mark.parametrize(
    "stops",
    [
        {"a_min_angle": -0.5, "a_max_angle": 0.4, "e_min_angle": 0.0, "e_max_angle": 1.0},
        {"a_min_angle": -1.0, "a_max_angle": 3.0, "e_min_angle": 0.0, "e_max_angle": 0.3},
        {"a_min_angle": 3.5, "a_max_angle": 5.0, "e_min_angle": 0.2, "e_max_angle": 0.4},
    ],
)
def test_stops_give_the_nearest_pose_within(stops: dict[str, float]) -> None:
    machine = _stopped(**stops)
    sun, aim = direction(1.5, 0.9), np.array([10.0, 40.0, 20.0])
    found = track(machine, sun, aim)
    assert (found.status == TrackingStatus.STOPPED).all()
    low = [stops["a_min_angle"], stops["e_min_angle"]]
    high = [stops["a_max_angle"], stops["e_max_angle"]]
    assert (found.angles >= np.array(low) - 1e-9).all()
    assert (found.angles <= np.array(high) + 1e-9).all()
    grid = np.stack(
        np.meshgrid(*[np.linspace(a, b, 400) for a, b in zip(low, high, strict=True)]), axis=-1
    )
    normal, vertex = machine.armature.pose(grid.reshape(-1, 2))
    scan = angle_between(normal, bisector(sun, normalize(aim - vertex))).min()
    assert found.residual.min() <= scan + 1e-6
    assert found.residual.min() == pytest.approx(scan, abs=5e-3)


def test_count_stops_and_turns() -> None:
    sun, aim = direction(1.0, 0.9), np.array([0.0, 60.0, 20.0])
    free = track(_stopped(), sun, aim)
    angle = free.angles[1] if free.angles[1, 1] < 1.5 else free.angles[0]
    # Wide stops: the turn nearest to where the drive stands.
    wide = _stopped(a_min_angle=-20.0, a_max_angle=20.0, e_min_angle=0.0, e_max_angle=1.6)
    for turns in (-2, 0, 1):
        near = angle + np.array([2 * np.pi * turns, 0.0])
        found = track(wide, sun, aim, current=near + 0.1)
        np.testing.assert_allclose(found.best_angles, near, rtol=0, atol=1e-8)
    # Counts as stops, running against the angle.
    machine = kinds.azimuth_elevation(
        (0, 0, 0),
        pivot_offset=0.3,
        drives=(direct(rate=-1.0, min_count=-7.0, max_count=0.5), direct(max_angle=1.6)),
    )
    found = track(machine, sun, aim)
    best = int(found.best)
    assert found.status[best] == TrackingStatus.OK
    assert -7.0 <= found.counts[best, 0] <= 0.5
    assert found.counts[best, 0] == pytest.approx(-found.angles[best, 0])


def test_least_motion_decides() -> None:
    sun, aim = direction(1.0, 0.9), np.array([0.0, 60.0, 20.0])
    machine = _stopped()
    both = track(machine, sun, aim)
    for branch in (0, 1):
        found = track(machine, sun, aim, current=both.counts[branch] + 0.05)
        assert found.best == branch
    # A slow azimuth makes the other branch the quicker one.
    start = both.counts[0] * [0.3, 0.3] + both.counts[1] * [0.7, 0.7]
    quick = track(_stopped(a_speed=1.0, e_speed=1e6), sun, aim, current=start)
    way = np.abs(wrap_signed(quick.angles[:, 0] - start[0]))
    assert quick.best == int(np.argmin(way))


def test_no_solution() -> None:
    machine = kinds.azimuth_elevation((0, 0, 0), pivot_height=1.0)
    sun = direction(0.3, 0.5)
    opposite = track(machine, sun, np.array([0, 0, 1.0]) - 50.0 * sun)
    assert (opposite.status == TrackingStatus.DEGENERATE).all()
    assert np.isnan(opposite.angles).all()
    inside = track(machine, sun, (0.0, 0.0, 1.0))
    assert (inside.status == TrackingStatus.DEGENERATE).all()
    trough = kinds.single_axis((0, 0, 0), (0, 1, 0))
    along = track(trough, (0.0, 1.0, 0.0), (3.0, 0.0, 5.0))
    assert along.status[0] == TrackingStatus.DEGENERATE
    assert all(status.text for status in TrackingStatus)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"sun": (0.0, 0.0, 2.0)}, "length differs from 1"),
        ({"sun": (np.nan, 0.0, 1.0)}, "not a finite number"),
        ({"aim": (np.inf, 0.0, 1.0)}, "not a finite number"),
        ({"aim": (1.0, 2.0)}, "must have 3 numbers"),
        ({"sun": np.ones((3, 3)) / 3**0.5, "aim": np.ones((2, 3))}, "do not fit together"),
        ({"branch": 2}, "must be 'both', 0 or 1"),
        ({"tolerance": 0.0}, "must be above 0"),
        ({"current": [0.0]}, "finite counts of the 2 drives"),
        ({"drives": direct()}, "its last axis must be 2"),
    ],
)
def test_guards(change: dict, text: str) -> None:
    machine = kinds.azimuth_elevation((0, 0, 0))
    arguments = {"sun": (0.0, 0.0, 1.0), "aim": (0.0, 30.0, 20.0), **change}
    with pytest.raises(InputError, match=text):
        track(machine, **arguments)  # type: ignore[arg-type]


def _field(rows: int):  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(5)
    positions = np.c_[rng.uniform(-300, 300, rows), rng.uniform(30, 600, rows), np.zeros(rows)]
    return imperfect(kinds.azimuth_elevation(positions, pivot_height=2.0, pivot_offset=0.3), 9)


def test_threads_order_and_subsets_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    field, sun, aim = _field(1003), direction(2.5, 0.7), (0.0, 0.0, 90.0)
    results = []
    for threads in (1, 2, 3, 7):
        monkeypatch.setenv("HELIOTROPE_THREADS", str(threads))
        results.append(track(field, sun, aim))
    for other in results[1:]:
        for name in ("angles", "counts", "residual", "iterations", "status", "best"):
            assert (getattr(other, name) == getattr(results[0], name)).all()
    order = np.random.default_rng(1).permutation(1003)[:400]
    part = track(field[order], sun, aim)
    assert (part.angles == results[0].angles[order]).all()
    for branch in (0, 1):
        alone = track(field, sun, aim, branch=branch)  # type: ignore[arg-type]
        assert (alone.angles[:, 0] == results[0].angles[:, branch]).all()


def test_broadcasting() -> None:
    field = _field(4)
    suns = direction(np.linspace(1.5, 4.5, 6), 0.6)
    found = track(field, suns[:, None, :], (0.0, 0.0, 90.0))
    assert found.angles.shape == (6, 4, 2, 2)
    one = track(field[2], suns, (0.0, 0.0, 90.0))
    assert (one.angles == found.angles[:, 2]).all()
    empty = track(field[:0], suns[0], (0.0, 0.0, 90.0))
    assert empty.angles.shape == (0, 2, 2)
    # An armature of no mirror has the drives that it is given.
    bare = track(field[:0].armature, suns[0], (0.0, 0.0, 90.0), drives=field[:0].drives)
    assert bare.angles.shape == (0, 2, 2)
    assert found.chosen(found.normal).shape == (6, 4, 3)


def test_guo_is_the_special_case() -> None:
    """The closed form (with its exact offset) and the armature agree."""
    rng = np.random.default_rng(11)
    machine = kinds.azimuth_elevation((0, 0, 0), pivot_offset=0.3)
    for _ in range(40):
        errors = guo.GuoParameters(
            tilt=rng.uniform(0, 0.05),
            tilt_azimuth=rng.uniform(0, 6),
            tau_1=rng.normal(0, 0.02),
            mu=rng.normal(0, 0.02),
            offset=0.3,
        )
        ours = guo.to_heliotrope(errors)
        assert ours.pop("pivot_offset") == pytest.approx(0.3)
        sun = direction(rng.uniform(0, 6), rng.uniform(0.2, 1.2))
        aim = np.array([rng.uniform(-80, 80), rng.uniform(20, 90), rng.uniform(10, 60)])
        closed = guo.track(aim, sun, errors, exact=True)
        found = track(machine.with_parameters(ours), sun, aim, tolerance=1e-13)
        bias = np.array([ours["azimuth_bias"], 0.0])
        theirs = np.stack([closed.gamma, closed.alpha], axis=-1) + bias
        for branch in (0, 1):
            apart = np.abs(wrap_signed(found.angles - theirs[branch])).max(axis=-1).min()
            assert apart < 1e-9


@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("rate", [1e-5, -1e-5])
def test_a_jack_is_not_tracked_beyond_its_triangle(rate: float, sense: int) -> None:
    """Without stops in counts its reach ends where the triangle is folded or stretched."""
    zero = 1.5 if sense > 0 else 1.7
    jack = linear_grigoriev(0.5, 0.6, 0.75, rate, angle_zero=zero, sense=sense)
    drives = (direct(min_angle=-3.2, max_angle=3.2), jack)
    mechanism = kinds.azimuth_elevation((0.0, 50.0, 0.0), drives=drives)
    elevation = np.radians(np.linspace(0.0, 89.0, 179))
    suns = direction(0.0, elevation)
    found = track(mechanism, suns, (0.0, 0.0, 30.0))
    reached = found.status == TrackingStatus.OK
    assert 0 < reached.sum() < reached.size
    # What is called reached is reached by the counts, and a pose at the end says so.
    angles = mechanism.drives.angles(found.counts)
    np.testing.assert_allclose(angles, found.angles, atol=1e-7)
    pose = mechanism.pose(found.counts)
    off = angle_between(pose.normal, found.normal)
    assert off.max() < 1e-7
    assert (found.residual[~reached] > 1e-9).all()
