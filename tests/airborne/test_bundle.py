"""The bundle adjustment: derivatives, what it recovers, what it says of itself."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.airborne.evaluate.bundle import (
    Adjusted,
    Corners,
    Priors,
    State,
    _Layout,
    adjust,
    jacobian_matrix,
    residuals,
)
from heliotrope.airborne.simulate.simulation import (
    Errors,
    Flight,
    fly,
    hover_grid,
    install,
    look_counts,
)
from heliotrope.airborne.standing import join_standing, standing
from heliotrope.errors import InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.geometry import rotation
from support.drone_case import camera, field, flight

SIGMA = 0.1 / 1140.0
OFFSET = (0.018, -0.018, 0.017)


def turn(small: np.ndarray) -> np.ndarray:
    return rotation(small, np.linalg.norm(small))


def corners_of(flown: Flight, seed: int, growth: float = 0.0) -> Corners:
    """Exact corners with white noise; all outlines may look smaller or larger than they are."""
    rng = np.random.default_rng(seed)
    stand = flown.truth
    seen = replace(stand, outline=stand.outline * (1.0 + growth)).corners
    places = []
    for photo in flown.taken:
        local = (seen - photo.position) @ photo.rotation
        places.append(local[..., :2] / local[..., 2:])
    shape = (len(flown.taken), *seen.shape[:2])
    index = [i.ravel() for i in np.indices(shape)]
    place = np.array(places).reshape(-1, 2)
    noise = rng.normal(0.0, SIGMA, place.shape)
    return Corners(*index, place + noise, np.full(len(place), SIGMA))


def run(flown: Flight, corners: Corners, survey: float, seed: int = 0) -> Adjusted:
    rng = np.random.default_rng(seed)
    turns = np.array([p.rotation @ turn(rng.normal(0.0, 1e-3, 3)) for p in flown.taken])
    return adjust(
        np.array([p.position for p in flown.recorded]),
        np.array([p.sigma_position for p in flown.recorded]),
        turns,
        standing(flown.heliostats, flown.counts),
        corners,
        Priors(position=survey),
    )


def test_derivatives_against_finite_differences() -> None:
    flown = flight(Errors(slope=0.0), columns=2, rows=1)
    corners = corners_of(flown, 1)
    stand = standing(flown.heliostats, flown.counts)
    state = State(
        np.array([p.position for p in flown.recorded]),
        np.array([p.rotation for p in flown.recorded]),
        np.zeros((2, 3)),
        np.zeros(3),
        stand,
        np.zeros((len(stand), 3)),
    )
    gap, parts = residuals(state, corners)
    # Mirrors 7 and 8 are taken for one heliostat's in two poses.
    owner = np.arange(len(stand))
    owner[8] = 7
    layout = _Layout.of(2, len(stand), owner)
    J = jacobian_matrix(corners, parts, layout).toarray()
    step, at = 1e-6, 12

    def moved(unknown: int) -> State:
        e = np.zeros(8)
        if unknown < at:
            photo, which = divmod(unknown, 6)
            e[which] = step
            turns, error = state.rotation.copy(), state.error.copy()
            turns[photo] = turns[photo] @ turn(e[:3])
            error[photo] += e[3:6]
            return replace(state, rotation=turns, error=error)
        if unknown < at + 3:
            e[unknown - at] = step
            return replace(state, offset=e[:3])
        mirror, which = divmod(unknown - at - 3, 8)
        e[which] = step
        vertex, turns, outline = stand.vertex.copy(), stand.rotation.copy(), stand.outline.copy()
        vertex[mirror] += e[:3]
        turns[mirror] = turns[mirror] @ turn(e[3:6])
        outline[mirror, :, :2] *= 1.0 + e[6:]
        return replace(state, stand=replace(stand, vertex=vertex, rotation=turns, outline=outline))

    for unknown in (*range(at + 3), *range(at + 3 + 8 * 7, at + 3 + 8 * 8)):
        changed, _ = residuals(moved(unknown), corners, derivative=False)
        numeric = (gap - changed).ravel() / step
        np.testing.assert_allclose(J[:, unknown], numeric, atol=3e-7, err_msg=str(unknown))
    for axis in range(3):
        both = sum(J[:, layout.mirror + 8 * m + axis] for m in (7, 8))
        np.testing.assert_array_equal(J[:, layout.survey + 3 * 7 + axis], both)


def test_common_offset_and_attitudes_are_found() -> None:
    offset = (0.018, -0.018, 0.016)
    flown = flight(Errors(slope=0.0, survey=0.001, rtk_offset=offset))
    found = run(flown, corners_of(flown, 2), 0.001)
    assert found.converged
    error = found.state.offset - offset
    sigma = np.sqrt(np.diag(found.offset_covariance))
    assert (np.abs(error) < 3.5 * sigma).all()
    assert (sigma < 0.012).all()
    assert 0.9 < found.deviation < 1.1
    for R, taken in zip(found.state.rotation, flown.taken, strict=True):
        assert np.arccos(0.5 * (np.trace(R.T @ taken.rotation) - 1.0)) < 0.5e-3


def test_stated_accuracy_of_the_offset_is_honest() -> None:
    ratios = []
    for seed in range(12):
        flown = flight(Errors(slope=0.0, mechanism={}), columns=2, rows=2, seed=seed)
        found = run(flown, corners_of(flown, seed), 0.005, seed)
        ratios.append(found.state.offset / np.sqrt(np.diag(found.offset_covariance)))
    # 36 numbers of mean square 1: beyond these limits in one of 10,000.
    assert 0.35 < np.mean(np.square(ratios)) < 2.0


def test_outlines_that_look_too_small_do_not_move_the_camera() -> None:
    flown = flight(Errors(slope=0.0, survey=0.001))
    plain = run(flown, corners_of(flown, 4), 0.001)
    shrunk = run(flown, corners_of(flown, 4, growth=-0.01), 0.001)
    # One per cent of size, taken for distance, would be half a metre.
    moved = np.abs(shrunk.state.position - plain.state.position)
    assert moved.max() < 0.01


def test_wrong_corners_lose_their_weight() -> None:
    flown = flight(Errors(slope=0.0, survey=0.001))
    corners = corners_of(flown, 5)
    wrong = np.arange(0, len(corners), 40)
    place = corners.place.copy()
    place[wrong] += 30.0 * SIGMA
    clean, soiled = run(flown, corners, 0.001), run(flown, replace(corners, place=place), 0.001)
    assert soiled.outlier[wrong].mean() > 0.95
    assert np.delete(soiled.outlier, wrong).mean() < 0.01
    assert np.abs(clean.state.offset - soiled.state.offset).max() < 0.01


def test_no_corner_is_refused() -> None:
    flown = flight(Errors(slope=0.0), columns=1, rows=1)
    corners = corners_of(flown, 1)
    none = Corners(*(a[:0] for a in vars(corners).values()))
    with pytest.raises(InputError, match="no corner of a mirror"):
        run(flown, none, 0.01)


def several(
    seed: int, survey: float, hovers: list[tuple[float, float, float]], mirrors: Heliostats
) -> list[Flight]:
    """Flights over the same heliostats, each from another side."""
    errors = Errors(slope=0.0, survey=survey, rtk_offset=OFFSET, mechanism={})
    middle = mirrors.position.mean(axis=0) + [0.0, 0.0, 1.2]
    installed = install(mirrors, range(len(mirrors)), errors, seed=seed)
    return [
        fly(
            mirrors,
            camera(),
            look_counts(mirrors, place),
            hover_grid(place, middle, 3, 3, 0.7),
            middle,
            errors=errors,
            seed=seed,
            installed=installed,
            flight=k,
        )
        for k, place in enumerate(hovers)
    ]


def together(flown: list[Flight], survey: float, seed: int) -> Adjusted:
    """One adjustment of several flights over the same heliostats."""
    count, photos = len(flown[0].truth), len(flown[0].recorded)
    parts = [corners_of(f, seed + 100 * k) for k, f in enumerate(flown)]
    corners = Corners(
        np.concatenate([p.photo + photos * k for k, p in enumerate(parts)]),
        np.concatenate([p.mirror + count * k for k, p in enumerate(parts)]),
        *(np.concatenate([getattr(p, n) for p in parts]) for n in ("corner", "place", "sigma")),
    )
    told = [p for f in flown for p in f.recorded]
    return adjust(
        np.array([p.position for p in told]),
        np.array([p.sigma_position for p in told]),
        np.array([p.rotation for f in flown for p in f.taken]),
        join_standing([standing(f.heliostats, f.counts) for f in flown]),
        corners,
        Priors(position=survey, kinematics=2e-4),
        owner=np.tile(np.arange(count), len(flown)),
    )


def test_flights_from_several_sides_find_the_offset_better() -> None:
    """Survey errors are the same in all poses: from several sides they are not taken for b."""
    sides = [(0.0, -5.0, 45.0), (35.0, 10.0, 40.0), (-35.0, 10.0, 40.0)]
    ratios, alone, joint = [], [], []
    for seed in range(5):
        flown = several(seed, 0.003, sides, field())
        one = run(flown[0], corners_of(flown[0], seed), 0.003, seed)
        all_three = together(flown, 0.003, seed)
        for found, errors in ((one, alone), (all_three, joint)):
            errors.append(found.state.offset - OFFSET)
        ratios.append(joint[-1] / np.sqrt(np.diag(all_three.offset_covariance)))
    assert np.mean(np.square(joint)) < 0.6 * np.mean(np.square(alone))
    # 15 numbers of mean square 1.
    assert 0.25 < np.mean(np.square(ratios)) < 2.5


def test_offset_of_30_mm_is_found_to_5_mm() -> None:
    """72 mirrors surveyed to 3 mm, three sides with nine photographs each."""
    sides = [(0.0, -10.0, 60.0), (50.0, 45.0, 55.0), (-50.0, 45.0, 55.0)]
    found = together(several(0, 0.003, sides, field(9, 8)), 0.003, 0)
    assert np.linalg.norm(OFFSET) > 0.03
    assert np.linalg.norm(found.state.offset - OFFSET) < 0.005
    assert np.sqrt(np.trace(found.offset_covariance)) < 0.005


def test_where_mirrors_stand_as_seen_from_the_drone_is_honest() -> None:
    squares = []
    for seed in range(8):
        flown = flight(Errors(slope=0.0, survey=0.003, mechanism={}), columns=2, rows=2, seed=seed)
        found = run(flown, corners_of(flown, seed), 0.003, seed)
        true = flown.truth.vertex - np.mean([p.position for p in flown.taken], axis=0)
        off = found.state.stand.vertex - found.state.position.mean(axis=0) - true
        scaled = np.linalg.solve(found.place_covariance, off[..., None])[..., 0]
        squares.append(np.mean(np.sum(off * scaled, axis=-1)) / 3.0)
    # The mirrors of a flight share most of it: 8 flights of 3 numbers.
    assert 0.3 < np.mean(squares) < 2.2
