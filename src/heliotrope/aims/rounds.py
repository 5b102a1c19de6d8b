"""Moves heliostats from their present aims to better ones, a few at a time, within the limit.

Every heliostat that has an aim is treated as if its beam were on the receiver, so that any of them
may join at any time. This is safe because fewer beams never bring more light to a cell. Each step
moves a few heliostats. A moving heliostat may be anywhere on its path. A step is therefore taken
only if the light of all other heliostats, plus the most that each moving beam brings to a cell
anywhere on its path, stays below the limit less the margin for errors. A cell that is already above
this level must not get more light. The heliostats whose moves relieve the fullest cells most go
first. If no move is possible, some heliostats rest and return later at other aims.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.aims.candidates import middles, surface_in, turns
from heliotrope.aims.scene_aims import Demand, SceneAims, aim_scene, risk_of
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float
from heliotrope.optics.receiver_flux import FieldFlux, Images
from heliotrope.optics.scene import Scene

#: Aims closer together than this count as the same, m.
ALIKE = 0.05
#: Maximum number of positions on a beam's path at which its image is computed; one per beam width.
PLACES = 9
#: New aims are adopted if they add this fraction of power, or if the old aims exceed the limit.
BETTER = 5e-3
#: Share of the limit that counts as room where beams that stay leave none.
LEAST = 0.02
#: Excess over the limit that counts as zero, and the fraction of the limit from which a cell binds.
HOLDS, BINDS = 3e-3, 0.99
#: Maximum number of heliostats whose moves are examined in one round.
LOOKED = 400
#: Share of the field that the safe spread keeps from one attempt to the next.
THINNER = 0.85
#: Age at which images are computed anew, s.
FRESH = 600.0
#: Fraction of the mirrors that rest before the mirrors that must also rest are computed anew.
SHED = 0.01

Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.intp]
#: A mirror's image before a move, its cell-wise maximum on the path, and its image after, (columns,
#: rows).
PathImages = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Round:
    """The state of H mirrors when aims are computed.

    Attributes
    ----------
    scene
        Has one receiver; its aims and dark mirrors are ignored.
    demand
        The limit.
    at
        Time, s.
    aims
        Aims assigned to the mirrors, ENU m, (H, 3); NaN: none.
    free
        Mirrors that may be assigned new aims, (H,).
    shining
        Mirrors whose beams are on the receiver, (H,).
    fixed
        Positions of beams that an operator has aimed and that stay there, ENU m, (H, 3); NaN: none.
    spread
        Aims of the plant file, for the safe spread, ENU m, (H, 3).
    most, together
        Maximum numbers of shining mirrors that may move in this round, and at the same time.
    ramp
        Flux up to which the receiver may be heated in this round, in the scene's irradiance, W/m²,
        (rows, columns); None: no ramp.
    """

    scene: Scene
    demand: Demand
    at: float
    aims: FloatArray
    free: Mask
    shining: Mask
    fixed: FloatArray
    spread: FloatArray
    most: int
    together: int
    ramp: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class Move:
    """Mirrors that get new aims at the same time.

    Attributes
    ----------
    rows
        Indices of the mirrors, (K,).
    aims
        New aims, ENU m, (K, 3); NaN if the mirror is to rest.
    """

    rows: Rows
    aims: FloatArray


@dataclass(frozen=True, eq=False)
class Heat:
    """Flux on the receiver, and its limit.

    Attributes
    ----------
    flux, above, limit
        Flux of the beams that shine now, what errors may add, and the limit less the margin, W/m²,
        (rows, columns).
    power
        Power of the present aims, W.
    """

    flux: FloatArray
    above: FloatArray
    limit: FloatArray
    power: float

    @property
    def excess(self) -> float:
        """Largest ratio of the flux, including errors, to the limit, minus 1."""
        return float(((self.flux + self.above) / self.limit).max()) - 1.0

    @property
    def fullest(self) -> tuple[float, float]:
        """Flux including errors, and limit, of the cell with their largest ratio, W/m²."""
        flux = self.flux + self.above
        cell = np.unravel_index((flux / self.limit).argmax(), flux.shape)
        return float(flux[cell]), float(self.limit[cell])

    @property
    def binding(self) -> int:
        """Number of cells that the limit binds."""
        return int((self.flux + self.above > BINDS * self.limit).sum())


@dataclass(frozen=True, eq=False)
class Answer(Heat):
    """Result of a round.

    Attributes
    ----------
    flux, above, limit, power
        See `Heat`.
    moves
        Moves, to be made one after the other.
    safe
        The safe spread: aims from the plant file for as many mirrors as the limit allows, (H, 3).
    planned
        Power of the best aims, W.
    gap
        Upper bound on the power that still better aims could add, as a fraction of the planned
        power.
    left
        Mirrors whose aims are not yet the best ones.
    waiting
        Mirrors that only the ramp keeps from joining.
    unlit
        Free mirrors that send no light to any cell, wherever they aim, (K,).
    problem
        Why no aims respect the limit together with the beams that stay; empty if there are such
        aims.
    worth
        Power that a smaller squared error of each mirror would add under the limit, W/rad², (H,);
        empty if there are no aims.
    """

    moves: tuple[Move, ...]
    safe: FloatArray
    planned: float
    gap: float
    left: int
    waiting: int = 0
    unlit: Rows = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    problem: str = ""
    worth: FloatArray = field(default_factory=lambda: np.zeros(0))


#: The last aims computed in this process, with the time of their images and the mirrors in these
#: images.
_last: list[tuple[float, Mask, SceneAims]] = []


def forget() -> None:
    """Forget the last aims computed in this process, as a new process does."""
    _last.clear()


def next_round(now: Round, **light: Any) -> Answer:
    """Return the moves that bring the mirrors closer to the aims of maximum power.

    Parameters
    ----------
    now
        The mirrors, the limit, and the permitted moves.
    **light
        Arguments of `FieldFlux`.

    Returns
    -------
    Answer
        If beams that stay leave no room, its moves take other mirrors off the cells concerned.

    Raises
    ------
    InputError
        If no aims respect the limit, although all beams may move.
    """
    rows, columns = surface_in(now.scene).shape
    limit = now.demand.limit.on(rows, columns)
    fixed, room = _room(now, limit, light)
    best, target_aims, problem = None, now.aims, ""
    try:
        best = _best(now, room, light)
        target_aims = np.where((now.free & ~best.defocused)[:, None], best.aims, np.nan)
    except InputError:
        if not (problem := _kept(now, fixed, limit)):
            raise
    engine = FieldFlux(_posed(now.scene, now.aims), **light)
    above = risk_of(engine, now.demand, room).above
    power = engine.powers[0]
    better = power if best is None else best.engine.powers[0]
    more = above if best is None else np.maximum(above, best.risk.above)
    cap = limit_cap = as_float(room - more)
    full = ((engine.maps[0] + above) / room).max() > 1.0 + HOLDS
    if now.ramp is not None:
        # The ramp is no limit that must hold with a probability.
        warm = now.ramp - fixed
        full = full or (engine.maps[0] > (1.0 + HOLDS) * np.maximum(warm, 0.0) + 1.0).any()
        cap = np.minimum(limit_cap, warm)
    moves: tuple[Move, ...] = ()
    remaining = waiting = 0
    if full or better > (1.0 + BETTER) * power or not now.free[_aimed(now.aims)].all():
        moves, remaining, waiting = steps(now, target_aims, as_float(cap), limit_cap, light)
    shown = FieldFlux(_posed(now.scene, np.where(now.shining[:, None], now.aims, np.nan)), **light)
    risk = risk_of(shown, now.demand, limit)
    safe = _safe(now, room, light)
    unlit = now.free & (best is not None and best.field.power.max(axis=1) <= 0.0)
    return Answer(
        shown.maps[0] + fixed,
        risk.above,
        limit,
        power,
        moves,
        safe,
        better,
        np.nan if best is None else best.gap,
        remaining,
        waiting,
        np.flatnonzero(unlit),
        problem,
        np.zeros(0) if best is None else _worth(best),
    )


def _worth(best: SceneAims) -> FloatArray:
    """Return the power that a smaller squared error of each mirror would add, W/rad², (H,)."""
    square = np.trace(best.engine.scene.mirrors.pointing, axis1=1, axis2=2)
    return as_float(np.where(square > 0.0, best.gain / np.maximum(square, 1e-300), 0.0))


def heat(scene: Scene, demand: Demand, aims: FloatArray, **light: Any) -> Heat:
    """Return the flux of beams at aims (H, 3), whoever has aimed them; NaN: no beam.

    Parameters
    ----------
    scene, demand
        See `Round`.
    aims
        Positions of the beams, ENU m.
    **light
        Arguments of `FieldFlux`.
    """
    rows, columns = surface_in(scene).shape
    limit = demand.limit.on(rows, columns)
    if not _aimed(aims).any():
        return Heat(np.zeros_like(limit), np.zeros_like(limit), limit, 0.0)
    engine = FieldFlux(_posed(scene, aims), **light)
    return Heat(
        engine.maps[0], risk_of(engine, demand, limit).above, limit, float(engine.powers[0])
    )


def _room(now: Round, limit: FloatArray, light: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """Return the flux of the beams that stay, and the room that they leave under the limit.

    A fraction `LEAST` of the limit counts as room even where they leave none, so that mirrors which
    heat other cells may stay.
    """
    fixed, room = np.zeros_like(limit), limit
    if _aimed(now.fixed).any():
        engine = FieldFlux(_posed(now.scene, now.fixed), **light)
        fixed = engine.maps[0]
        room = limit - fixed - risk_of(engine, now.demand, limit).above
    return fixed, as_float(np.maximum(room, LEAST * limit))


def _kept(now: Round, fixed: FloatArray, limit: FloatArray) -> str:
    """Return that beams which stay leave no room under the limit; empty if they leave some."""
    most = float((fixed / limit).max())
    if most <= 1.0 - LEAST:
        return ""
    return (
        f"aims: {int(_aimed(now.fixed).sum())} beams have fixed aims, set by an operator or kept "
        f"for the return from a visit, and alone reach {100.0 * most:.0f} % of the limit; move "
        "some of them, or raise the limit"
    )


def steps(
    now: Round,
    target_aims: FloatArray,
    cap: FloatArray,
    limit_cap: FloatArray,
    light: dict[str, Any],
) -> tuple[tuple[Move, ...], int, int]:
    """Return the moves towards target aims (H, 3), how many mirrors remain, and wait for the ramp.

    ``cap`` is the allowable expected flux, W/m², (rows, columns), and ``limit_cap`` what it would
    be without the ramp.
    """
    aimed, goes = _aimed(now.aims), _aimed(target_aims)
    if not aimed.any() and now.ramp is None:
        # No mirror shines, so all may take their best aims at once.
        moves = [Move(np.flatnonzero(goes), target_aims[goes])] if goes.any() else []
        return tuple(moves), 0, 0
    taken = aimed & ~now.free
    path = _Path(now, target_aims, light)
    moves = [_rest(np.flatnonzero(taken))] if taken.any() else []
    have = aimed & now.free
    differs = have != goes
    differs |= have & goes & (np.linalg.norm(now.aims - target_aims, axis=1) > ALIKE)
    todo = np.flatnonzero(differs & ~taken)
    walk = _Walk(path, path.flux(have), as_float(np.maximum(cap, 0.0).T), now)
    waiting = 0
    if now.ramp is None:
        moves += walk.through(todo, target_aims)
    else:
        # Mirrors join first; others move meanwhile only if the ramp is not what mirrors wait for.
        # Neighbours one after the other would heat the same cells first.
        todo = todo[np.argsort(turns(len(have))[todo], kind="stable")]
        moves += walk.through(todo[~have[todo]], target_aims)
        waiting = walk.waiting(todo[~have[todo]], as_float(np.maximum(limit_cap, 0.0).T))
        if not waiting:
            moves += walk.through(todo[have[todo]], target_aims)
    moves += walk.relieved(np.flatnonzero(have & ~np.isin(np.arange(len(have)), walk.done)))
    return tuple(moves), len(todo) - len(np.intersect1d(todo, walk.done)), waiting


def _rest(rows: Rows) -> Move:
    return Move(rows, np.full((len(rows), 3), np.nan))


class _Path:
    """Images of mirrors on their paths from present to target aims."""

    def __init__(self, now: Round, target_aims: FloatArray, light: dict[str, Any]) -> None:
        self.aimed, self.goes = _aimed(now.aims), _aimed(target_aims)
        start = np.where(self.aimed[:, None], now.aims, target_aims)
        engine = FieldFlux(_posed(now.scene, start), **light)
        start = np.where(_aimed(start)[:, None], start, middles(now.scene))
        end = np.where(self.goes[:, None], target_aims, start)
        width = engine.scene.mirrors.slant * 5e-3
        far = np.linalg.norm(end - start, axis=1) / np.maximum(width, 1e-6)
        count = int(np.clip(np.ceil(far.max(initial=0.0)) + 1, 2, PLACES))
        at = np.linspace(0.0, 1.0, count)[:, None]
        looks = start[:, None] + at * (end - start)[:, None]
        self.images: Images = engine.images(as_float(looks), np.zeros(len(start), dtype=np.int64))

    def flux(self, which: Mask) -> FloatArray:
        """Return the flux of mirrors at their present aims, (columns, rows)."""
        total = np.zeros(self.images.shape[::-1])
        for row in np.flatnonzero(which):
            total += self.images.of(int(row))
        return total

    def most(self, row: int, *, shines: bool) -> PathImages:
        """Return a mirror's image before the move, the maximum on the path, and the image after."""
        before = self.images.of(row) if self.aimed[row] else np.zeros(self.images.shape[::-1])
        after = self.images.of(row, -1) if self.goes[row] else np.zeros_like(before)
        greatest = np.maximum(before, after)
        if shines and self.aimed[row] and self.goes[row]:
            for place in range(1, self.images.looks - 1):
                greatest = np.maximum(greatest, self.images.of(row, place))
        return before, greatest, after


class _Walk:
    """A sequence of moves, with the flux after each."""

    def __init__(self, path: _Path, flux: FloatArray, cap: FloatArray, now: Round) -> None:
        self._path, self._flux, self._cap, self._now = path, flux, cap, now
        self.done: Rows = np.zeros(0, dtype=np.intp)
        self._moved = 0

    def through(self, todo: Rows, target_aims: FloatArray) -> list[Move]:
        """Return the possible moves; if there are none, some mirrors rest."""
        moves, shining = [], self._now.shining
        paths = {int(row): self._path.most(row, shines=bool(shining[row])) for row in todo[:LOOKED]}
        while paths:
            batch = self._batch(paths)
            if batch:
                moves.append(Move(np.array(batch, dtype=np.intp), target_aims[batch]))
            else:
                batch = self._resting(paths)
                if not batch:
                    break
                moves.append(_rest(np.array(batch, dtype=np.intp)))
            self._moved += int(shining[batch].sum())
            self.done = np.union1d(self.done, batch).astype(np.intp)
            for row in batch:
                before, _, after = paths.pop(row)
                rests = not np.isfinite(moves[-1].aims).all()
                self._flux = self._flux - before + (0.0 if rests else after)
        return moves

    def _batch(self, paths: dict[int, PathImages]) -> list[int]:
        """Return the mirrors that move next; mirrors that relieve the fullest cells come first."""
        fullness = (self._flux / np.maximum(self._cap, 1.0)) ** 8
        gain = {row: float(((after - b) * fullness).sum()) for row, (b, _, after) in paths.items()}
        bound = self._flux.copy()
        batch: list[int] = []
        most = np.maximum((1.0 + HOLDS) * self._cap, self._flux) + 1e-3
        for row in sorted(paths, key=gain.__getitem__):
            before, greatest, _ = paths[row]
            if self._now.shining[row] and self._moved + len(batch) >= self._now.most:
                continue
            tried = bound - before + greatest
            if (tried <= most).all():
                batch.append(row)
                bound = tried
            if len(batch) >= self._now.together:
                break
        return batch

    def _resting(self, paths: dict[int, PathImages]) -> list[int]:
        """Select mirrors to rest, so that others can move; they return later."""
        if self._moved >= self._now.most:
            return []
        stuck = [row for row in paths if self._path.aimed[row] and self._path.goes[row]]
        full = self._flux > BINDS * self._cap
        stuck.sort(key=lambda row: -float(paths[row][0][full].sum()))
        return stuck[: min(self._now.together, self._now.most - self._moved)]

    def waiting(self, joins: Rows, limit_cap: FloatArray) -> int:
        """Return how many mirrors do not join, although each could without the ramp."""
        most = (1.0 + HOLDS) * limit_cap
        rows = np.setdiff1d(joins, self.done)[:LOOKED]
        after = (self._flux + self._path.images.of(int(row), -1) for row in rows)
        return sum(bool((flux <= most).all()) for flux in after)

    def relieved(self, rows: Rows) -> list[Move]:
        """Rest mirrors, the most effective first, until no cell is above the limit.

        All these mirrors rest in a single move.
        """
        resting: list[int] = []
        lighting = [int(row) for row in rows]
        while lighting:
            over = np.maximum(self._flux - (1.0 + HOLDS) * self._cap, 0.0)
            if not over.any():
                break
            share = {row: float((self._path.images.of(row) * over).sum()) for row in lighting}
            lighting.sort(key=share.__getitem__)
            for _ in range(1 + int(SHED * len(lighting))):
                if not lighting or share[lighting[-1]] <= 0.0:
                    break
                self._flux = self._flux - self._path.images.of(lighting[-1])
                resting.append(lighting.pop())
            else:
                continue
            break
        self.done = np.union1d(self.done, resting).astype(np.intp)
        return [_rest(np.array(resting, dtype=np.intp))] if resting else []


def _best(now: Round, room: FloatArray, light: dict[str, Any]) -> SceneAims:
    """Return the aims of maximum power in the room that beams which stay leave.

    The search starts from this process's earlier aims if they fit the scene.
    """
    scene = replace(now.scene, dark=~now.free)
    at, start = now.at, None
    if _last:
        before_at, were_free, before = _last[0]
        same = len(were_free) == len(now.free) and _alike(before.engine.scene, scene)
        same = same and before.choice.power > 0.0
        # Images of mirrors that were dark are empty.
        if same and 0.0 <= now.at - before_at < FRESH and not (now.free & ~were_free).any():
            at, start = before_at, before
    computed = aim_scene(scene, now.demand, room=room, start=start, **light)
    _last[:] = [(at, now.free, computed)]
    return computed


def _alike(scene: Scene, other: Scene) -> bool:
    """Return whether two scenes have equal mirrors and receivers; arrays may be copies."""
    first, second = surface_in(scene), surface_in(other)
    return bool(
        first.shape == second.shape
        and first.name == second.name
        and np.array_equal(first.cells.center, second.cells.center)
        and np.allclose(scene.mirrors.center, other.mirrors.center, atol=1.0)
    )


def _safe(now: Round, room: FloatArray, light: dict[str, Any]) -> FloatArray:
    """Return the plant file's aims for as many free mirrors as the limit allows, (H, 3)."""
    turn, share = turns(len(now.free)), 1.0
    while share > 0.5 / len(now.free):
        aims = np.where((now.free & (turn < share))[:, None], now.spread, np.nan)
        engine = FieldFlux(_posed(now.scene, aims), **light)
        over = (engine.maps[0] + risk_of(engine, now.demand, room).above) / room
        most = float(over.max())
        if most <= 1.0:
            return as_float(aims)
        share *= min(THINNER, 1.0 / most)
    return np.full(now.aims.shape, np.nan)


def _posed(scene: Scene, aims: FloatArray) -> Scene:
    """Return the scene with its mirrors at aims (H, 3); mirrors without an aim are dark."""
    aimed = _aimed(aims)
    places = np.where(aimed[:, None], aims, middles(scene))
    return replace(scene, mirrors=scene.mirrors.toward(scene.sun, places), dark=~aimed)


def _aimed(aims: FloatArray) -> Mask:
    return np.asarray(np.isfinite(aims).all(axis=1))
