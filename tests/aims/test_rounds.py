"""The way from one set of aims to another: no mixture on it passes the limit."""

from dataclasses import replace

import numpy as np
import pytest

from heliotrope.aims import Demand, FluxLimit
from heliotrope.aims.rounds import Answer, Move, Round, next_round
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.optics.receiver_flux import FieldFlux
from heliotrope.optics.scene import Scene
from support.aimed_field import PLATE, SUN, field, in_the_middle

COUNT = 40
SCENE = in_the_middle(field(COUNT, PLATE, 3e-4))
PEAK = float(FieldFlux(SCENE).maps[0].max())
NONE, ALL = np.full((COUNT, 3), np.nan), np.ones(COUNT, dtype=np.bool_)


def given(limit: float, aims: FloatArray, **changes: object) -> Round:
    spread = np.broadcast_to(PLATE.center, (COUNT, 3)).copy()
    demand = Demand(FluxLimit(limit), 0.95)
    shining = np.asarray(np.isfinite(aims).all(axis=1))
    made = Round(SCENE, demand, 0.0, aims, ALL, shining, NONE, spread, 1000, 4)
    return replace(made, **changes)  # type: ignore[arg-type]


def true_flux(aims: FloatArray, scene: Scene = SCENE) -> FloatArray:
    some = np.asarray(np.isfinite(aims).all(axis=1))
    places = np.where(some[:, None], aims, PLATE.center)
    return FieldFlux(replace(scene, mirrors=scene.mirrors.toward(SUN, places), dark=~some)).maps[0]


def moved(aims: FloatArray, move: Move, share: float = 1.0) -> FloatArray:
    """Return the aims with some on their way, those that begin or end at rest there."""
    out = aims.copy()
    on_way = (1.0 - share) * aims[move.rows] + share * move.aims
    out[move.rows] = on_way if share < 1.0 else move.aims
    return out


def followed(aims: FloatArray, answer: Answer, most: float) -> FloatArray:
    """Return the aims after all moves; no mixture and no way between passes ``most``."""
    for move in answer.moves:
        for share in (0.3, 0.7, 1.0):
            flux = true_flux(moved(aims, move, share))
            assert flux.max() <= most, f"{len(move.rows)} on their way at {share}"
        aims = moved(aims, move)
    return aims


def test_from_rest_to_the_best_aims_and_to_a_lower_limit() -> None:
    limit = 0.7 * PEAK
    first = next_round(given(limit, NONE))
    aims = followed(NONE, first, 1.01 * limit)
    again = next_round(given(limit, aims))
    assert again.power > 0.97 * again.planned
    assert not again.moves or again.left == 0
    assert (true_flux(aims) + again.above <= 1.005 * again.limit).all()
    # In steps: the aims of the first limit pass the second, and no step makes that worse.
    lower, most = 0.55 * PEAK, float(true_flux(aims).max())
    for _ in range(6):
        answer = next_round(given(lower, aims))
        aims = followed(aims, answer, 1.005 * most)
        most = max(float(true_flux(aims).max()), lower)
    assert true_flux(aims).max() <= 1.005 * lower
    assert answer.power > 0.9 * answer.planned


def test_the_middle_passes_the_limit_and_heliostats_that_heat_the_spot_rest_at_once() -> None:
    aims = np.broadcast_to(PLATE.center, (COUNT, 3)).copy()
    limit = 0.5 * PEAK
    assert true_flux(aims).max() > limit
    answer = next_round(given(limit, aims, most=0))
    after = followed(aims, answer, PEAK * 1.001)
    assert true_flux(after).max() <= 1.005 * limit
    assert np.isfinite(after).all(axis=1).sum() >= 0.4 * COUNT, "not the whole field"


def test_no_more_shining_heliostats_move_than_may() -> None:
    aims = PLATE.center + np.where(np.arange(COUNT) % 2, 2.9, -2.9)[:, None] * PLATE.up
    answer = next_round(given(2.0 * PEAK, aims, most=5))
    assert sum(len(move.rows) for move in answer.moves) == 5
    assert all(len(move.rows) <= 4 for move in answer.moves)
    assert answer.left > 0
    rests = given(2.0 * PEAK, aims, most=5, shining=np.zeros(COUNT, dtype=np.bool_))
    assert next_round(rests).left == 0, "those at rest get other aims at once"


def test_beams_that_a_person_has_aimed_stay_and_leave_less_room() -> None:
    limit = 0.6 * PEAK
    fixed, free = NONE.copy(), ALL.copy()
    fixed[:8], free[:8] = PLATE.center, False
    answer = next_round(given(limit, NONE, fixed=fixed, free=free))
    aims = fixed.copy()
    for move in answer.moves:
        assert not set(move.rows) & set(range(8))
        aims = moved(aims, move)
    assert true_flux(aims).max() <= 1.01 * limit
    fixed[:], free[:] = PLATE.center, False
    free[-1] = True
    before = true_flux(fixed)
    answer = next_round(given(limit, NONE, fixed=fixed, free=free))
    assert answer.excess > 0.0
    aims = fixed.copy()
    for move in answer.moves:
        aims = moved(aims, move)
    assert (true_flux(aims) - before)[before > limit].max() <= 0.03 * limit


def test_beams_leave_where_no_aims_hold_the_limit() -> None:
    fixed, free = NONE.copy(), ALL.copy()
    fixed[: COUNT // 2], free[: COUNT // 2] = PLATE.center, False
    aims = np.where(free[:, None], PLATE.center, NONE)
    answer = next_round(given(0.3 * PEAK, aims, fixed=fixed, free=free))
    assert answer.excess > 0.5
    for move in answer.moves:
        aims = moved(aims, move)
    over = true_flux(fixed) > 0.3 * PEAK
    assert true_flux(aims)[over].max() < 0.05 * PEAK, "a person's beams exceed the limit alone"


def test_a_limit_below_every_beam_is_refused_unless_beams_that_stay_exceed_it() -> None:
    aims, fixed, free = PLATE.center + np.zeros((COUNT, 3)), NONE.copy(), ALL.copy()
    with pytest.raises(InputError, match="does not allow even the beam"):
        next_round(given(1e-6 * PEAK, aims))
    fixed[0], free[0], aims[0] = PLATE.center, False, np.nan
    answer = next_round(given(1e-6 * PEAK, aims, fixed=fixed, free=free))
    assert "1 beams have fixed aims" in answer.problem
    for move in answer.moves:
        aims = moved(aims, move)
    assert not np.isfinite(aims).any()


def test_the_limit_that_a_refusal_advises_holds_with_its_margin() -> None:
    def refused(limit: float) -> str:
        now = given(1.0, NONE)
        demand = replace(now.demand, limit=FluxLimit(limit, 0.05))
        try:
            return "" if next_round(replace(now, demand=demand)).moves else "no move"
        except InputError as error:
            return str(error)

    text = refused(1e-6 * PEAK)
    assert "kW/m², multiply" not in text, "the limit is a number"
    assert not refused(1e3 * float(text.split("raise the limit there to ")[1].split()[0]))


def test_a_lost_cluster_makes_room_for_others_and_the_safe_spread_holds() -> None:
    limit = 0.6 * PEAK
    aims = followed(NONE, next_round(given(limit, NONE)), 1.01 * limit)
    lost = np.arange(COUNT) < COUNT // 4
    free, shining = ~lost, np.isfinite(aims).all(axis=1) & ~lost
    answer = next_round(given(limit, aims, free=free, shining=shining))
    first, others = answer.moves[0], answer.moves[1:]
    assert set(first.rows) == set(np.flatnonzero(lost & np.isfinite(aims).all(axis=1)))
    aims = followed(moved(aims, first), replace(answer, moves=others), 1.01 * limit)
    assert not np.isfinite(aims[lost]).any()
    back = next_round(given(limit, aims))
    assert answer.planned < back.planned
    assert back.power < back.planned
    safe = true_flux(answer.safe)
    assert 0.3 * limit < safe.max() <= limit
    assert not np.isfinite(answer.safe[lost]).any()


def test_mirrors_join_along_the_ramp_before_others_move() -> None:
    limit, half = 0.7 * PEAK, np.arange(COUNT) % 4 == 0
    best = followed(NONE, next_round(given(limit, NONE)), 1.01 * limit)
    aims = np.where(half[:, None], np.where(np.isfinite(best), PLATE.center, np.nan), np.nan)
    now = true_flux(aims)
    answer = next_round(given(limit, aims, ramp=now + 0.1 * PEAK))
    assert 0 < answer.waiting < answer.left
    after = aims
    for move in answer.moves:
        assert not half[move.rows].any(), "who shines stays while others wait for the ramp"
        after = moved(after, move)
    assert (true_flux(after) <= now + 0.101 * PEAK).all()
    free = next_round(given(limit, aims, ramp=now + PEAK))
    assert free.waiting == 0
    assert any(half[move.rows].any() for move in free.moves)
