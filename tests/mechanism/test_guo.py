"""Guo's formula: its law, its singular cases, its symmetries, its mappings, its statistics."""

from dataclasses import FrozenInstanceError, replace
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import (
    TAU,
    FloatArray,
    angle_between,
    direction,
    normalize,
    reflect,
    rotation,
    wrap_signed,
)
from heliotrope.mechanism.drives import linear_guo
from heliotrope.mechanism.guo import (
    MALAN_NAMES,
    REACHED,
    GuoParameters,
    angles,
    forward,
    from_heliotrope,
    from_malan,
    mirror_normal,
    regularise,
    to_heliotrope,
    to_malan,
    track,
)

EAST, NORTH, UP = np.eye(3)
PI = np.pi

properties = settings(max_examples=30, deadline=None, derandomize=True, database=None)
any_angle = st.floats(-3 * PI, 3 * PI)
small_angle = st.floats(-0.1, 0.1)


def machines(angle: st.SearchStrategy[float]) -> st.SearchStrategy[GuoParameters]:
    """Return machines whose angles may be anything, their offset included."""
    return st.builds(
        GuoParameters,
        tilt=angle,
        tilt_azimuth=any_angle,
        azimuth_zero=any_angle,
        elevation_zero=any_angle,
        tau_1=angle,
        mu=angle,
        offset=st.floats(-0.5, 0.5),
    )


def positions(seed: int = 7, count: int = 20) -> tuple[FloatArray, FloatArray]:
    """Return drive positions (α, γ) over the whole range of both drives."""
    alpha, gamma = np.random.default_rng(seed).uniform(-PI, PI, (2, count))
    return alpha, gamma


def same_machine(a: GuoParameters, b: GuoParameters, limit: float = 1e-13) -> bool:
    alpha, gamma = positions()
    return bool((angle_between(forward(alpha, gamma, a), forward(alpha, gamma, b)) < limit).all())


def our_chain(ours: dict[str, FloatArray], alpha: FloatArray, gamma: FloatArray) -> FloatArray:
    """Return the normals of the design's chain of joints, as a product of rotations."""
    frame = (
        rotation(-EAST, ours["tilt_north"])
        @ rotation(NORTH, ours["tilt_east"])
        @ rotation(-UP, gamma + ours["azimuth_bias"])
        @ rotation(NORTH, ours["non_orthogonality"])
        @ rotation(EAST, alpha + ours["elevation_bias"])
        @ rotation(-UP, ours["canting"])
    )
    return frame @ NORTH


# The law


@properties
@given(machines(small_angle), st.floats(0, TAU), st.floats(0.1, 1.4), st.floats(0, TAU))
def test_the_sun_lands_on_the_target(parameters, sun_azimuth, sun_elevation, target_azimuth):
    sun = direction(sun_azimuth, sun_elevation)
    target = 40.0 * direction(target_azimuth, 0.3)
    found = track(target, sun, parameters, exact=True)
    assume(found.reachable)
    for branch in range(2):
        n = forward(found.alpha[branch], found.gamma[branch], parameters)
        from_vertex = target - parameters.offset * n
        off = np.linalg.norm(np.cross(from_vertex, reflect(sun, n)))
        assert off < 1e-12
        assert np.dot(from_vertex, reflect(sun, n)) > 0


def test_the_exact_offset_bisects_at_the_true_vertex():
    ratio, theta = np.meshgrid(np.linspace(-0.99, 0.99, 67), np.linspace(0.0, 1.55, 200))
    sun, target = direction(-theta, 0.0), 10.0 * direction(theta, 0.0)
    n = mirror_normal(target, sun, 10.0 * ratio, exact=True).normal
    from_vertex = normalize(target - 10.0 * ratio[..., None] * n)
    # At a ratio of 0.99 the vertex is 0.1 m from the target, which costs two digits.
    assert np.abs(angle_between(sun, n) - angle_between(from_vertex, n)).max() < 1e-13


@pytest.mark.parametrize("ratio", [0.01, 0.1, 0.3, 0.5, -0.5])
def test_the_error_of_5_stays_below_its_bound(ratio):
    theta = np.linspace(0.0, 1.55, 200)
    sun, target = direction(-theta, 0.0), direction(theta, 0.0)
    by_5 = mirror_normal(target, sun, ratio).normal
    exact = mirror_normal(target, sun, ratio, exact=True).normal
    assert angle_between(by_5, exact).max() < ratio**4 / 40.0


@properties
@given(machines(any_angle))
def test_forward_is_a_product_of_rotations(parameters):
    p = parameters
    alpha, gamma = positions()
    lean_about = [-np.cos(p.tilt_azimuth), np.sin(p.tilt_azimuth), 0.0]
    frame = (
        rotation(lean_about, p.tilt)
        @ rotation(-UP, gamma - p.azimuth_zero)
        @ rotation(NORTH, -p.tau_1)
        @ rotation(EAST, alpha - p.elevation_zero)
        @ rotation(-UP, p.mu)
    )
    assert angle_between(forward(alpha, gamma, p), frame @ NORTH).max() < 1e-14


@pytest.mark.parametrize(("azimuth_deg", "towards"), [(0, NORTH), (90, EAST), (270, -EAST)])
def test_a_tilt_leans_the_azimuth_axis_towards_its_azimuth(azimuth_deg, towards):
    leaning = GuoParameters(tilt=0.01, tilt_azimuth=np.radians(azimuth_deg))
    expected = np.cos(0.01) * UP + np.sin(0.01) * towards
    assert forward(PI / 2, 0.0, leaning) == pytest.approx(expected, abs=1e-15)


# The inverse and its singular cases


@properties
@given(machines(any_angle), any_angle, any_angle)
def test_the_branches_hold_the_position_that_made_the_normal(parameters, alpha, gamma):
    assume(abs(np.cos(parameters.mu) * np.cos(parameters.tau_1)) > 0.05)
    # At α = ±90° the branches meet and an error of the normal is magnified without bound.
    assume(abs(np.cos(alpha - parameters.elevation_zero)) > 0.01)
    normal = forward(alpha, gamma, parameters)
    found = angles(normal, parameters)
    assert found.reachable
    assert found.residual < 1e-14
    miss = np.abs(wrap_signed(found.alpha - alpha))
    branch = int(np.argmin(miss))
    assert miss[branch] < 1e-11
    # Near the azimuth axis the normal does not tell the azimuth.
    axis = forward(PI / 2, 0.0, replace(parameters, tau_1=0, mu=0, elevation_zero=0))
    away = np.sin(angle_between(normal, axis))
    assert abs(wrap_signed(found.gamma[branch] - gamma)) * away < 1e-11


@properties
@given(machines(any_angle), any_angle, st.floats(-PI / 2, PI / 2))
def test_angles_lie_in_their_ranges(parameters, azimuth, elevation):
    assume(abs(np.cos(parameters.mu) * np.cos(parameters.tau_1)) > 0.05)
    found = angles(direction(azimuth, elevation), parameters)
    joint = found.alpha - parameters.elevation_zero
    slack = 1e-14
    assert -PI / 2 - slack <= joint[0] <= PI / 2 + slack <= joint[1] + 2 * slack
    assert joint[1] <= 3 * PI / 2 + slack
    assert ((found.gamma >= 0) & (found.gamma < TAU)).all()


@pytest.mark.parametrize("beta", [1e-3, 1e-5, 1e-7, 1e-9])
@pytest.mark.parametrize("pole", [1, -1])
def test_the_keyhole_keeps_every_digit(beta, pole):
    # Synthetic truth: an ideal machine whose normal stands β from its azimuth axis.
    alpha = pole * (PI / 2 - beta)
    normal = [np.sin(beta) * np.sin(0.7), np.sin(beta) * np.cos(0.7), pole * np.cos(beta)]
    found = angles(normal, GuoParameters())
    ours = abs(found.alpha[0] - alpha)
    assert ours < 5e-16
    assert found.gamma[0] == pytest.approx(0.7, abs=1e-14)
    if beta < 1e-6:
        by_arcsin = abs(np.arcsin(normal[2]) - alpha)
        assert by_arcsin > 1e5 * max(ours, 1e-16)


def test_at_the_keyhole_the_residual_is_better_than_by_arcsin():
    rng = np.random.default_rng(3)
    p = GuoParameters(tilt=0.003, tilt_azimuth=1.0, tau_1=0.002, mu=0.002)
    alpha, gamma = PI / 2 - 10.0 ** rng.uniform(-9, -6, 200), rng.uniform(0, TAU, 200)
    normal = forward(alpha, gamma, p)
    found = angles(normal, p)
    assert found.residual.max() < 2e-15

    axis = forward(PI / 2, 0.0, replace(p, tau_1=0, mu=0))
    sine = (normal @ axis - np.sin(p.mu) * np.sin(p.tau_1)) / (np.cos(p.mu) * np.cos(p.tau_1))
    by_arcsin = np.arcsin(np.clip(sine, -1.0, 1.0))
    miss = angle_between(normal, forward(by_arcsin, found.gamma[:, 0], p))
    assert miss.max() > 1e-9


@pytest.mark.parametrize(("up", "tau_1", "mu"), [(1, 0, 0), (-1, 0, 0), (1, 0.02, -0.01)])
def test_on_the_azimuth_axis_the_azimuth_joint_stays_at_zero(up, tau_1, mu):
    p = GuoParameters(azimuth_zero=0.25, elevation_zero=0.5, tau_1=tau_1, mu=mu)
    found = angles([0.0, 0.0, up], p)
    assert found.gamma == pytest.approx(0.25)
    assert wrap_signed(found.alpha - 0.5 - up * PI / 2) == pytest.approx(0.0, abs=1e-15)
    assert found.residual == pytest.approx(abs(mu - tau_1), abs=1e-15)


@pytest.mark.parametrize("pole", [1, -1])
@properties
@given(tau_1=st.floats(-0.3, 0.3), mu=st.floats(-0.3, 0.3), part=st.floats(0.0, 0.95))
def test_in_a_dead_cone_the_nearest_pose_is_given(pole, tau_1, mu, part):
    radius = abs(mu - tau_1) if pole > 0 else abs(mu + tau_1)
    assume(radius > 1e-3)
    p = GuoParameters(tilt=0.02, tilt_azimuth=2.0, tau_1=tau_1, mu=mu)
    zeta = part * radius
    axis_frame = rotation([-np.cos(2.0), np.sin(2.0), 0.0], 0.02)
    normal = axis_frame @ (pole * direction(1.1, PI / 2 - zeta))
    found = angles(normal, p)
    assert found.status == "unreachable"
    assert found.residual == pytest.approx(radius - zeta, abs=1e-14)
    # No pose of a fine search comes nearer.
    alpha, gamma = np.meshgrid(np.linspace(-PI / 2, PI / 2, 61), np.linspace(0, TAU, 120))
    assert angle_between(normal, forward(alpha, gamma, p)).min() > found.residual - 1e-12


@properties
@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(0.0, 1.0), st.floats(0.0, TAU))
def test_outside_the_dead_cones_everything_is_reached(tau_1, mu, part, azimuth):
    low, high = abs(mu - tau_1), PI - abs(mu + tau_1)
    zeta = low + part * (high - low)
    found = angles(direction(azimuth, PI / 2 - zeta), GuoParameters(tau_1=tau_1, mu=mu))
    assert found.residual < REACHED
    assert found.reachable


def test_retroreflection_is_an_ordinary_case():
    sun = direction(0.4, 0.6)
    found = mirror_normal(25.0 * sun, sun, 0.3)
    assert found.theta == pytest.approx(0.0, abs=1e-15)
    assert found.tau == pytest.approx(0.0, abs=1e-15)
    assert angle_between(found.normal, sun) < 1e-15


def test_a_field_at_many_times_is_what_one_heliostat_is():
    rng = np.random.default_rng(11)
    sun = direction(rng.uniform(1, 5, 4), rng.uniform(0.2, 1.2, 4))
    target = rng.uniform(-50, 50, (3, 3)) + 80.0 * UP
    tilt, mu, offset = 0.01 * rng.normal(size=3), 0.01 * rng.normal(size=3), np.full(3, 0.2)
    field = GuoParameters(tilt=tilt, mu=mu, offset=offset)
    together = track(target, sun[:, None, :], field)
    assert together.alpha.shape == together.gamma.shape == (4, 3, 2)
    assert together.normal.shape == (4, 3, 3)
    assert together.residual.shape == together.reachable.shape == together.status.shape == (4, 3)
    for i, j in product(range(4), range(3)):
        one = GuoParameters(tilt=tilt[j], mu=mu[j], offset=offset[j])
        alone = track(target[j], sun[i], one)
        assert together.alpha[i, j] == pytest.approx(alone.alpha, abs=1e-15)
        assert together.gamma[i, j] == pytest.approx(alone.gamma, abs=1e-15)


def test_many_machines_take_one_normal_and_one_position():
    three = GuoParameters(tilt=[0.0, 0.1, 0.2])
    assert forward(0.3, 0.4, three).shape == (3, 3)
    assert angles(UP, three).alpha.shape == (3, 2)
    assert angles(np.empty((0, 3)), GuoParameters()).alpha.shape == (0, 2)


# The symmetries of (31) to (40)

# Parameters that make the same machine: the normal at every drive position is the same.
RELATIONS = {
    "turn of the tilt": lambda p: replace(p, tilt=p.tilt + TAU),
    "turn of its azimuth": lambda p: replace(p, tilt_azimuth=p.tilt_azimuth - TAU),
    "turn of the azimuth zero": lambda p: replace(p, azimuth_zero=p.azimuth_zero + TAU),
    "turn of the elevation zero": lambda p: replace(p, elevation_zero=p.elevation_zero - TAU),
    "turn of tau_1": lambda p: replace(p, tau_1=p.tau_1 + TAU),
    "turn of mu": lambda p: replace(p, mu=p.mu - TAU),
    "tilt to the other side (37)": lambda p: replace(
        p, tilt=-p.tilt, tilt_azimuth=p.tilt_azimuth + PI
    ),
    "elevation axis end for end (40)": lambda p: replace(
        p,
        tau_1=PI - p.tau_1,
        azimuth_zero=p.azimuth_zero + PI,
        elevation_zero=p.elevation_zero + PI,
    ),
    "mirror over the axis (39)": lambda p: replace(
        p, mu=PI - p.mu, elevation_zero=p.elevation_zero + PI
    ),
}


@pytest.mark.parametrize("name", RELATIONS)
@properties
@given(parameters=machines(any_angle))
def test_a_relation_leaves_the_machine_the_same(name, parameters):
    assert same_machine(parameters, RELATIONS[name](parameters))


@pytest.mark.parametrize("name", RELATIONS)
@properties
@given(parameters=machines(any_angle))
def test_regularise_undoes_every_relation(name, parameters):
    a, b = regularise(parameters), regularise(RELATIONS[name](parameters))
    assert same_machine(a, b)
    # At the edge of a range two neighbours may come out at its two ends.
    edges = (a.tilt, PI - a.tilt, PI / 2 - abs(a.tau_1), PI / 2 - abs(a.elevation_zero))
    assume(min(edges) > 1e-9)
    for field in vars(a):
        if field != "offset":
            assert abs(wrap_signed(getattr(a, field) - getattr(b, field))) < 1e-13, field


def test_there_are_no_further_relations():
    """Of all sign changes and half turns of the six angles, the group keeps eight."""
    names = ("tilt", "tilt_azimuth", "azimuth_zero", "elevation_zero", "tau_1", "mu")
    truth = (0.31, 0.7, 1.3, -0.9, 0.23, -0.17)
    changes = list(product(product((1, -1), (0.0, PI)), repeat=6))
    values = np.array([[s * v + h for (s, h), v in zip(c, truth, strict=True)] for c in changes])
    machine = GuoParameters(**dict(zip(names, truth, strict=True)))
    every = GuoParameters(**{n: values[:, k, None] for k, n in enumerate(names)})
    alpha, gamma = positions(count=12)
    miss = angle_between(forward(alpha, gamma, every), forward(alpha, gamma, machine))
    kept = {changes[i] for i in np.flatnonzero(miss.max(axis=1) < 1e-9)}

    same, half, flip, back = (1, 0.0), (1, PI), (-1, 0.0), (-1, PI)
    tilts = [(same, same), (flip, half)]
    axes = [
        (same, same, same, same),
        (half, half, back, same),
        (same, half, same, back),
        (half, same, back, back),
    ]
    assert kept == {(*t, *a) for t, a in product(tilts, axes)}


# Relations between poses: the drives run differently, so they are no freedom of a fit.
# Each gives the other machine, its α and γ over ours, and the signs of the normal.
POSES = {
    "mirror image": lambda p: (
        {"tilt_azimuth": -p.tilt_azimuth, "azimuth_zero": -p.azimuth_zero}
        | {"tau_1": -p.tau_1, "mu": -p.mu},
        (1, -1),
        (-1, 1, 1),
    ),
    "elevation drive reversed": lambda p: (
        {"tau_1": p.tau_1 + PI, "mu": -p.mu, "elevation_zero": -p.elevation_zero},
        (-1, 1),
        (1, 1, 1),
    ),
    "azimuth drive reversed": lambda p: (
        {"tilt": p.tilt + PI, "azimuth_zero": -2 * p.tilt_azimuth - p.azimuth_zero}
        | {"tau_1": -p.tau_1, "elevation_zero": p.elevation_zero + PI},
        (1, -1),
        (1, 1, 1),
    ),
    "back of the mirror": lambda p: ({"mu": p.mu + PI}, (1, 1), (-1, -1, -1)),
}


@pytest.mark.parametrize("name", POSES)
@properties
@given(parameters=machines(any_angle))
def test_a_relation_between_poses(name, parameters):
    alpha, gamma = positions()
    changes, drives, signs = POSES[name](parameters)
    other = forward(drives[0] * alpha, drives[1] * gamma, replace(parameters, **changes))
    assert angle_between(forward(alpha, gamma, parameters), signs * other).max() < 1e-13


@properties
@given(machines(any_angle))
def test_regularise_gives_natural_ranges_and_the_same_machine(parameters):
    once = regularise(parameters)
    assert 0 <= once.tilt <= PI
    assert 0 <= once.tilt_azimuth < TAU
    assert -PI <= once.azimuth_zero < PI
    assert abs(once.elevation_zero) <= PI / 2
    assert abs(once.tau_1) <= PI / 2
    # The sign of this product is the same for all equivalent sets.
    product_of_cosines = np.cos(parameters.tau_1) * np.cos(parameters.mu)
    product_of_cosines = product_of_cosines * np.cos(parameters.elevation_zero)
    assume(abs(product_of_cosines) > 1e-9)
    assert (abs(once.mu) <= PI / 2) == (product_of_cosines > 0)
    assert once.offset == parameters.offset
    assert same_machine(parameters, once)
    twice = regularise(once)
    for field in vars(once):
        assert getattr(twice, field) == getattr(once, field), field


@properties
@given(machines(st.floats(-PI / 2, PI / 2)))
def test_an_axis_above_the_horizon_gets_a_tilt_below_a_right_angle(parameters):
    assert regularise(parameters).tilt <= PI / 2


@pytest.mark.parametrize("tilt", [PI, -PI, 0.0, -0.0])
def test_regularise_at_the_ends_of_the_tilt(tilt):
    start = GuoParameters(tilt=tilt, tilt_azimuth=4.0, azimuth_zero=0.3, tau_1=0.1)
    once = regularise(start)
    assert same_machine(start, once)
    assert regularise(once).tilt_azimuth == once.tilt_azimuth
    if tilt == 0:
        assert once.tilt_azimuth == 0


def test_an_elevation_zero_beyond_a_right_angle_becomes_a_mirror_that_looks_back():
    start = GuoParameters(elevation_zero=np.radians(170.0), mu=np.radians(2.0))
    once = regularise(start)
    assert np.degrees(once.elevation_zero) == pytest.approx(-10.0, abs=1e-12)
    assert np.degrees(once.mu) == pytest.approx(178.0, abs=1e-12)
    assert same_machine(start, once)


def test_regularise_leaves_natural_parameters_alone():
    small = GuoParameters(
        tilt=1e-3, tilt_azimuth=6.0, azimuth_zero=-1e-3, elevation_zero=3e-4, tau_1=-1e-5, mu=2e-4
    )
    for name, value in vars(regularise(small)).items():
        assert value == getattr(small, name), name


# Mappings


@properties
@given(machines(any_angle))
def test_our_chain_with_the_mapped_parameters_is_the_same_machine(parameters):
    alpha, gamma = positions()
    ours = our_chain(to_heliotrope(parameters), alpha, gamma)
    assert angle_between(forward(alpha, gamma, parameters), ours).max() < 1e-14


@properties
@given(st.tuples(*[any_angle] * 6))
def test_guos_parameters_of_our_chain_are_the_same_machine(values):
    names = (*MALAN_NAMES.values(), "canting")
    ours = dict(zip(names, values, strict=True))
    alpha, gamma = positions()
    guo = forward(alpha, gamma, from_heliotrope(ours))
    assert angle_between(guo, our_chain(ours, alpha, gamma)).max() < 1e-14


@properties
@given(machines(st.floats(0.01, 1.5)))
def test_mapping_there_and_back(parameters):
    there = to_heliotrope(parameters)
    back = from_heliotrope(there)
    for name in vars(parameters):
        difference = getattr(back, name) - getattr(parameters, name)
        assert abs(wrap_signed(difference)) < 1e-13, name


def test_the_twist_is_half_the_product_of_the_tilts():
    north, east = 0.003, -0.002
    parameters = from_heliotrope({"tilt_north": north, "tilt_east": east})
    assert parameters.azimuth_zero == pytest.approx(-north * east / 2, rel=1e-4)


def test_a_field_is_mapped_at_once():
    field = from_heliotrope({"tilt_north": [0.001, 0.002], "tilt_east": 0.001, "canting": 0.01})
    assert field.tilt == pytest.approx([0.001 * np.sqrt(2), 0.001 * np.sqrt(5)], rel=1e-5)
    assert to_heliotrope(field)["tilt_north"] == pytest.approx([0.001, 0.002])


@properties
@given(st.tuples(*[st.floats(-0.2, 0.2)] * 5))
def test_malan_there_and_back(values):
    malan = dict(zip(MALAN_NAMES, values, strict=True))
    assert to_malan(from_malan(malan)) == pytest.approx(malan, abs=1e-14)


# The actuator, (41)-(42)


def test_from_the_sun_to_the_length_of_a_jack():
    side_a, side_b, slope, at_zero = 0.4, 1.1, 0.7, 0.9
    jack = linear_guo(side_a, side_b, slope, at_zero, 1e-5)
    found = track([0.0, 60.0, 40.0], direction(2.5, 0.8), GuoParameters(tau_1=0.004, mu=0.003))
    alpha = found.alpha[0]
    # (41) as printed.
    length = np.sqrt(side_a**2 + side_b**2 + 2 * side_a * side_b * np.cos(alpha + slope))
    assert jack.counts(alpha) == pytest.approx((length - at_zero) / 1e-5, abs=1e-8)
    assert jack.angles(jack.counts(alpha)) == pytest.approx(alpha, abs=1e-13)


# Bad input

SUN = direction(1.0, 0.7)
TARGET = np.array([0.0, 40.0, 20.0])


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: GuoParameters(tilt=[0.0, np.nan]), r"parameter tilt\[1\]: nan is not finite"),
        (lambda: GuoParameters(mu="much"), r"parameter mu: 'much' is not an array of numbers"),
        (
            lambda: GuoParameters(tilt=[0.0, 0.1], mu=[0.0, 0.1, 0.2]),
            r"do not broadcast together: tilt \(2,\), mu \(3,\)",
        ),
        (lambda: track([TARGET, 0 * TARGET], SUN, GuoParameters()), r"to_target\[1\]: .* pivot"),
        (lambda: track(TARGET, 0 * SUN, GuoParameters()), "sun: a vector of length 0"),
        (lambda: track(TARGET[:2], SUN, GuoParameters()), r"to_target: shape \(2,\)"),
        (lambda: track(TARGET, [0, np.inf, 0], GuoParameters()), r"sun\[1\]: inf"),
        (lambda: track(TARGET, -TARGET, GuoParameters()), "opposite as seen from the mirror"),
        (
            lambda: track(TARGET, SUN, GuoParameters(offset=[0.3, 300.0])),
            r"offset\[1\]: 300 m reaches the target, 44.7214 m away",
        ),
        (
            lambda: track(TARGET, SUN, GuoParameters(tau_1=[0.0, PI / 2])),
            r"Guo's parameters\[1\]: cos μ cos τ₁ = 0 at mu 0 rad, tau_1 1.5708 rad",
        ),
        (lambda: angles(UP, GuoParameters(mu=-PI / 2)), "cos μ cos τ₁ = 0 at mu -1.5708 rad"),
        (lambda: angles([0, 0, 0], GuoParameters()), "normal: a vector of length 0"),
        (
            lambda: track([TARGET] * 2, [SUN] * 3, GuoParameters()),
            r"broadcast together: to_target \(2,\), sun \(3,\)",
        ),
        (
            lambda: angles([UP] * 2, GuoParameters(mu=[0.0] * 3)),
            r"broadcast together: normal \(2,\), mu \(3,\)",
        ),
        (lambda: forward(np.nan, 0.0, GuoParameters()), "alpha: nan is not finite"),
        (lambda: forward(0.0, [0.0, -np.inf], GuoParameters()), r"gamma\[1\]: -inf"),
        (
            lambda: forward([0.0] * 2, 0.0, GuoParameters(mu=[0.0] * 3)),
            r"broadcast together: alpha \(2,\), mu \(3,\)",
        ),
        (lambda: from_heliotrope({"canting": np.nan}), "canting: nan is not finite"),
        (
            lambda: from_heliotrope({"tilt_north": [0.0] * 2, "canting": [0.0] * 3}),
            r"broadcast together: tilt_north \(2,\), canting \(3,\)",
        ),
        (
            lambda: to_malan(GuoParameters(mu=[0.0, 0.002])),
            "canting: up to 0.002 rad, but Malan's model has none",
        ),
        (
            lambda: to_malan(GuoParameters(offset=-0.1)),
            "pivot_offset: up to 0.1 m, but Malan's model has none",
        ),
    ],
)
def test_bad_input_gets_one_clear_line(call, text):
    with pytest.raises(InputError, match=text) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_unknown_names_get_a_suggestion():
    with pytest.raises(UnknownNameError, match=r"parameter of Guo's model 'cantin'.*canting\?"):
        from_heliotrope({"cantin": 0.0})
    with pytest.raises(UnknownNameError, match=r"parameter of Malan's model 'epN'.*eptN"):
        from_malan({"epN": 0.0})


def test_parameters_cannot_be_changed():
    tilt = np.zeros(2)
    parameters = GuoParameters(tilt=tilt)
    tilt[0] = 1.0
    assert parameters.tilt[0] == 0.0
    with pytest.raises(FrozenInstanceError):
        parameters.tilt = tilt
    with pytest.raises(ValueError, match="read-only"):
        parameters.tilt[0] = 1.0
