"""Many beams on one target, told apart by coded movements: truth recovered, mistakes named."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.imaging.coded import (
    ExpectedBeam,
    Separation,
    Stack,
    Verdict,
    coded_movements,
    photographs_for,
    separate,
    shared_codes,
)

#: Standard deviation of the beams, m, and of their expected places, m.
WIDTH, PLACED = 0.45, 0.1
#: Side of the target, size of a pixel and movement, m.
SIDE, STEP, MOVE = 5.0, 0.06, 0.03
NOISE = 0.004


@dataclass(frozen=True)
class Field:
    """Beams of nine mirrors, closer to each other than they are wide, and what is wrong."""

    seed: int = 0
    stuck: tuple[int, ...] = ()
    absent: tuple[int, ...] = ()
    exchanged: tuple[int, ...] = ()
    clouds: dict[int, float] = field(default_factory=dict)
    uncoded: tuple[float, float] | None = None
    photographs: int = 32


def bell(x: np.ndarray, y: np.ndarray, at: np.ndarray, width: np.ndarray) -> np.ndarray:
    lines = [np.exp(-0.5 * ((a - c) / w) ** 2) for a, c, w in zip((x, y), at, width, strict=True)]
    return np.outer(lines[1], lines[0]) / (2.0 * np.pi * width.prod())


def photographed(given: Field) -> tuple[Stack, np.ndarray, list[ExpectedBeam], np.ndarray]:
    rng = np.random.default_rng(given.seed)
    across = np.linspace(-1.0, 1.0, 3)
    expected = np.array([(a, b) for b in across for a in across])
    true = expected + PLACED * rng.standard_normal(expected.shape)
    moves = MOVE * coded_movements(9, given.photographs)
    made = moves.copy()
    made[:, list(given.stuck)] = 0.0
    made[:, list(given.exchanged)] = moves[:, list(given.exchanged)[::-1]]
    width = WIDTH * rng.uniform(0.8, 1.2, (9, 2))
    power = 0.3 * rng.uniform(0.9, 1.1, 9)
    power[list(given.absent)] = 0.0
    count = int(SIDE / STEP)
    x = -0.5 * SIDE + STEP * (np.arange(count) + 0.5)
    y = -x
    empty = np.broadcast_to(0.15 * (1.0 + 0.1 * x / SIDE), (count, count))
    factors = 1.0 + 0.02 * rng.standard_normal(len(moves))
    factors[list(given.clouds)] = list(given.clouds.values())
    still = np.zeros((count, count))
    if given.uncoded is not None:
        still = 0.3 * bell(x, y, np.array(given.uncoded), np.full(2, WIDTH))
    values = np.empty((len(moves), count, count))
    for k, factor in enumerate(factors):
        beams = still.copy()
        for i in range(9):
            beams += power[i] * bell(x, y, true[i] + made[k, i], width[i])
        values[k] = empty + factor * beams + NOISE * rng.standard_normal((count, count))
    first = np.array([x[0], y[0]])
    stack = Stack(values, STEP, first, np.ones((count, count), bool), None, empty)
    spread = np.eye(2)
    beams_expected = [
        ExpectedBeam(f"AA{i}", place, PLACED**2 * spread, WIDTH**2 * spread)
        for i, place in enumerate(expected)
    ]
    return stack, moves, beams_expected, true


def separated(given: Field) -> tuple[Separation, np.ndarray]:
    stack, moves, expected, true = photographed(given)
    return separate(stack, moves, expected), true


def verdicts(found: Separation) -> dict[str, Verdict]:
    return {b.heliostat: b.verdict for b in found.beams if b.verdict is not Verdict.PROVEN}


def errors(found: Separation, true: np.ndarray) -> np.ndarray:
    return np.linalg.norm([b.centroid for b in found.beams] - true, axis=-1)


@pytest.mark.parametrize("mirrors", [1, 3, 4, 25, 31, 32, 50])
def test_codes_are_orthogonal_and_mean_free(mirrors: int) -> None:
    codes = coded_movements(mirrors).reshape(photographs_for(mirrors), -1)
    assert np.array_equal(np.abs(codes), np.ones_like(codes))
    assert not codes.sum(axis=0).any()
    assert np.array_equal(codes.T @ codes, len(codes) * np.eye(2 * mirrors))
    # A beam that moves along both axes changes with the product, which is nobody's code.
    assert not ((codes[:, ::2] * codes[:, 1::2]).T @ codes).any()
    assert photographs_for(mirrors) <= max(8, 4 * mirrors)


@pytest.mark.parametrize(("mirrors", "photographs"), [(4, 8), (3, 24), (1, 2048), (0, None)])
def test_codes_that_cannot_be_are_refused(mirrors: int, photographs: int | None) -> None:
    with pytest.raises(InputError, match="codes: "):
        coded_movements(mirrors, photographs)


def test_overlapping_beams_are_found_with_honest_ellipses() -> None:
    inside, deviations = [], []
    for seed in range(8):
        found, true = separated(Field(seed=seed))
        assert verdicts(found) == {}
        assert len(found.uncoded) == 0
        for beam, place in zip(found.proven, true, strict=True):
            away = beam.centroid - place
            inside.append(away @ np.linalg.solve(beam.covariance, away) < 2.0 * np.log(10.0))
            deviations.append(away)
            assert abs(beam.gain - 1.0) < 4.0 * beam.gain_sigma
            assert abs(beam.power - 0.3) < 0.05
            assert abs(np.sqrt(np.trace(beam.second_moments) / 2.0) - WIDTH) < 0.12
    assert 0.82 <= np.mean(inside) <= 0.98
    # A tenth of a milliradian from 100 m.
    assert np.sqrt(np.mean(np.sum(np.square(deviations), axis=-1))) < 0.012


@pytest.mark.parametrize("along", [0, 1])
def test_movements_along_one_axis_need_half_as_many_photographs(along: int) -> None:
    """Beams whose places nobody knows, all over the target, each with a code of its own."""
    rng = np.random.default_rng(along)
    count, mirrors = 60, 15
    step, width = SIDE / count, 0.4
    assert photographs_for(mirrors, along) == 16 == photographs_for(mirrors) // 2
    codes = coded_movements(mirrors, along=along)
    assert not codes[..., 1 - along].any()
    np.testing.assert_array_equal(codes[..., along].T @ codes[..., along], 16.0 * np.eye(mirrors))
    assert not codes.sum(axis=0).any()
    moves = 0.15 * codes
    true = rng.uniform(-1.6, 1.6, (mirrors, 2))
    x = -0.5 * SIDE + step * (np.arange(count) + 0.5)
    values = 0.15 + NOISE * rng.standard_normal((16, count, count))
    stuck = 4
    for k, i in np.ndindex(16, mirrors):
        here = true[i] + (moves[k, i] if i != stuck else 0.0)
        shape = np.array([width, 0.7 * width])
        values[k] += 0.3 * bell(x, -x, here, shape)
    seen = np.ones((count, count), bool)
    stack = Stack(values, step, np.array([x[0], -x[0]]), seen, None, np.full((count, count), 0.15))
    spread = np.diag([width**2, 0.5 * width**2])
    beams = [ExpectedBeam(f"AA{i}", np.zeros(2), np.eye(2), spread) for i in range(mirrors)]
    found = separate(stack, moves, beams)
    assert set(verdicts(found)) == {f"AA{stuck}"}
    away = np.delete(np.array([b.centroid for b in found.beams]) - true, stuck, axis=0)
    assert np.abs(away).max() < 0.03
    deviations = [
        d @ np.linalg.solve(b.covariance, d) for b, d in zip(found.proven, away, strict=True)
    ]
    assert np.mean(np.array(deviations) < 2.0 * np.log(10.0)) > 0.7
    with pytest.raises(InputError, match="linearly dependent"):
        separate(stack, np.zeros_like(moves), beams)


@pytest.mark.parametrize(
    ("over", "aimed", "verdict"),
    [
        (0.15, 0.0, None),
        (0.6, 0.0, None),
        (1.2, 0.0, Verdict.ELSEWHERE),
        (1.6, 0.0, Verdict.ELSEWHERE),
        (20.0, 1.6, Verdict.FAINT),
    ],
)
def test_a_beam_beyond_the_edge_is_not_proven_and_harms_no_other(
    over: float, aimed: float, verdict: Verdict | None
) -> None:
    """A tail on the target does not say where its beam is, nor how strong; half a beam does.

    One that was missed before aims beside the target.
    """
    rng = np.random.default_rng(3)
    count, mirrors, width = 96, 12, 0.125
    x = 2.0 * ((np.arange(count) + 0.5) / count - 0.5)
    true = rng.uniform(-0.8, 0.8, (mirrors, 2))
    true[0] = 1.0 + over * width, 0.7
    moves = 0.076 * coded_movements(mirrors, along=0)
    values = 0.05 + 0.0005 * rng.standard_normal((len(moves), count, count))
    for k, i in np.ndindex(len(moves), mirrors):
        values[k] += 0.006 * bell(x, -x, true[i] + moves[k, i], np.full(2, width))
    empty = np.full((count, count), 0.05)
    stack = Stack(values, x[1] - x[0], np.array([x[0], -x[0]]), empty > 0.0, None, empty)
    place, spread = np.zeros((mirrors, 2)), np.eye(2)
    place[0] = aimed, 0.0
    expected = [
        ExpectedBeam(f"AA{i}", place[i], 0.85**2 * spread, width**2 * spread)
        for i in range(mirrors)
    ]
    found = separate(stack, moves, expected)
    assert verdicts(found) == ({} if verdict is None else {"AA0": verdict}), found.beams
    assert errors(found, true)[0 if verdict is None else 1 :].max() < 0.01


def test_a_mirror_that_does_not_move_is_named_and_harms_no_other() -> None:
    found, true = separated(Field(stuck=(4,)))
    assert verdicts(found) == {"AA4": Verdict.STUCK}
    assert np.isnan(found.beams[4].centroid).all()
    assert np.delete(errors(found, true), 4).max() < 0.04


def test_an_absent_mirror_is_too_faint() -> None:
    found, true = separated(Field(absent=(0,)))
    assert verdicts(found) == {"AA0": Verdict.FAINT}
    assert errors(found, true)[1:].max() < 0.04


def test_exchanged_mirrors_are_named_with_each_other() -> None:
    found, true = separated(Field(exchanged=(2, 6)))
    assert verdicts(found) == {"AA2": Verdict.EXCHANGED, "AA6": Verdict.EXCHANGED}
    assert (found.beams[2].other, found.beams[6].other) == ("AA6", "AA2")
    # The code tells the truth: AA2's movements are seen at AA6's place.
    assert np.linalg.norm(found.beams[2].centroid - true[6]) < 0.04


def test_an_unknown_beam_is_found_or_spoils_the_proof_that_it_covers() -> None:
    found, true = separated(Field(uncoded=(1.9, -1.9)))
    assert verdicts(found) == {}
    assert np.linalg.norm(found.uncoded - [1.9, -1.9], axis=-1).min() < 0.3
    assert errors(found, true).max() < 0.04
    covered, true = separated(Field(uncoded=(0.0, 0.0)))
    assert verdicts(covered) == {"AA4": Verdict.JOINED}
    assert covered.beams[4].gain < 0.7
    assert errors(covered, true).max() < 0.04


def test_photographs_under_a_cloud_are_left_out_until_too_few_are_left() -> None:
    some = {9: 0.8, 10: 0.3, 11: 0.1, 12: 0.7}
    found, true = separated(Field(clouds=some))
    assert np.flatnonzero(~found.used).tolist() == [10, 11]
    assert found.factors[[9, 12]] == pytest.approx([0.8, 0.7], abs=0.06)
    assert verdicts(found) == {}
    assert errors(found, true).max() < 0.04
    dark, _ = separated(Field(clouds=dict.fromkeys(range(6, 21), 0.1)))
    assert set(verdicts(dark).values()) == {Verdict.CLOUD}
    assert dark.proven == ()


def test_exposures_marks_and_finer_pixels_change_nothing() -> None:
    stack, moves, expected, true = photographed(Field(seed=3))
    seen = np.ones(stack.seen.shape, bool)
    seen[38:44, 20:26] = False
    longer = np.where(np.arange(len(moves)) % 2, 2.0, 1.0)
    values = stack.values * longer[:, None, None]
    values[:, ~seen] = np.nan
    fine = np.repeat(np.repeat(values, 2, axis=1), 2, axis=2)
    again = Stack(
        fine,
        0.5 * STEP,
        stack.first + 0.25 * STEP * np.array([-1.0, 1.0]),
        np.repeat(np.repeat(seen, 2, axis=0), 2, axis=1),
        longer,
        np.repeat(np.repeat(stack.empty, 2, axis=0), 2, axis=1),
    )
    found = separate(again, moves, expected)
    assert verdicts(found) == {}
    assert errors(found, true).max() < 0.04


def test_other_light_may_rest_on_the_surface_if_powers_are_known() -> None:
    stack, moves, expected, true = photographed(Field(stuck=(5,)))
    assert stack.empty is not None
    # Ten times the light of the coded beams, as on a receiver in production.
    bright = replace(stack, values=stack.values + 10.0 * stack.values.mean(axis=0), empty=None)
    known = [replace(beam, power=0.3) for beam in expected]
    found = separate(bright, moves, known)
    assert verdicts(found) == {"AA5": Verdict.FAINT}
    assert np.delete(errors(found, true), 5).max() < 0.05


def test_wrong_inputs_are_refused() -> None:
    stack, moves, expected, _ = photographed(Field())
    with pytest.raises(InputError, match="moves of shape"):
        separate(stack, moves[:-1], expected)
    twice = moves.copy()
    twice[:, 1] = twice[:, 0]
    with pytest.raises(InputError, match=r"AA0 and AA1 have the same code, \d\.\d standard"):
        separate(stack, twice, expected)
    twice[3, 1] = -twice[3, 1]
    with pytest.raises(InputError, match="linearly dependent"):
        separate(stack, twice, expected)
    with pytest.raises(InputError, match="exposure must be above 0"):
        replace(stack, exposures=np.zeros(len(moves)))
    with pytest.raises(InputError, match="seen has shape"):
        replace(stack, seen=np.ones((3, 3), bool))


def crowded(
    stuck: tuple[int, ...] = (), traded: tuple[int, ...] = ()
) -> tuple[Separation, np.ndarray, np.ndarray]:
    """Sixteen mirrors with the seven codes of 16 photographs; some rest, two are exchanged."""
    rng = np.random.default_rng(5)
    line, width = np.linspace(-3.0, 3.0, 4), 0.6
    expected = np.array([(a, b) for b in line for a in line])
    spread = (width**2 + PLACED**2) * np.eye(2)
    code = shared_codes(expected, np.repeat(spread[None], 16, axis=0), 7)
    assert code is not None
    sizes = MOVE * rng.uniform(0.8, 1.3, (16, 1))
    moves = coded_movements(7)[:, code] * sizes
    true = expected + PLACED * rng.standard_normal(expected.shape)
    true[list(traded)] = true[list(traded)[::-1]]
    made = moves.copy()
    made[:, list(stuck)] = 0.0
    x = np.arange(-4.97, 5.0, STEP)
    first = np.array([x[0], -x[0]])
    values = 0.1 + NOISE * rng.standard_normal((len(moves), len(x), len(x)))
    for i in range(16):
        for k, move in enumerate(made[:, i]):
            values[k] += 0.3 * bell(x, -x, true[i] + move, np.full(2, width))
    seen = np.ones(values.shape[1:], bool)
    stack = Stack(values, STEP, first, seen, None, np.full(seen.shape, 0.1))
    beams = [
        ExpectedBeam(f"AA{i}", place, PLACED**2 * np.eye(2), width**2 * np.eye(2))
        for i, place in enumerate(expected)
    ]
    return separate(stack, moves, beams), true, code


def test_beams_far_apart_share_a_code_and_are_told_apart_by_place() -> None:
    found, true, code = crowded()
    assert len(set(code.tolist())) <= 7
    assert verdicts(found) == {}
    assert errors(found, true).max() < 0.04
    distance = [
        (b.centroid - at) @ np.linalg.solve(b.covariance, b.centroid - at)
        for b, at in zip(found.beams, true, strict=True)
    ]
    assert np.mean(np.array(distance) < 2.0 * np.log(10.0)) > 0.6


def test_shared_codes_name_one_that_stands_and_two_that_are_exchanged() -> None:
    found, true, code = crowded(stuck=(5,), traded=(2, 3))
    assert code[2] != code[3]
    assert verdicts(found) == {
        "AA5": Verdict.STUCK,
        "AA2": Verdict.EXCHANGED,
        "AA3": Verdict.EXCHANGED,
    }
    good = np.setdiff1d(np.arange(16), [2, 3, 5])
    assert errors(found, true)[good].max() < 0.04


def test_too_few_codes_are_not_shared_by_beams_that_overlap() -> None:
    places = np.array([(0.3 * k, 0.0) for k in range(9)])
    shapes = np.repeat(0.25 * np.eye(2)[None], 9, axis=0)
    assert shared_codes(places, shapes, 7) is None
    code = shared_codes(places, shapes, 8)
    assert code is not None
    for a, b in zip(*np.triu_indices(9, 1), strict=True):
        assert code[a] != code[b] or np.linalg.norm(places[a] - places[b]) >= 4.5 * 0.5
