"""The law of the board's motion over arrays, beside the scalar code that moves the boards."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from heliotrope.field.layouts import malan_plant
from heliotrope.geometry import FloatArray, as_float, direction
from heliotrope.lcu.config import Config
from heliotrope.lcu.motion import APPROACH, DEFOCUS, HOLD, STANDBY, TRACK, Motion
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.board_motion import end_down_the_path, offsets, safe_paths, turned
from heliotrope.mechanism.machine import AxisLimits, Machine
from heliotrope.twin.field.journals import Journals

COUNT = 48
SUN = direction(np.radians(20.0), np.radians(40.0))


class Lease:
    """A sun that stands, as a lease."""

    since_ms = 0

    def vector(self, ahead_ms: int) -> tuple[float, ...]:
        return tuple(SUN.tolist())

    def fresh(self) -> bool:
        return True


def machines(rng: np.random.Generator) -> list[Machine]:
    """Machines with paths, angles of the defocus and limits of their own."""
    design = malan_plant(COUNT)
    made = []
    for i, name in enumerate(design.names):
        machine = design.machine(name)
        assert machine.standby is not None
        size = rng.uniform(0.02, 0.5, 2) * rng.choice((-1.0, 1.0), 2)
        east, north, up = machine.standby
        way = ((east + 5.0, north - 30.0, 0.0), (east, north, 0.3 * up))[: i % 3]
        made.append(replace(machine, defocus=(float(size[0]), float(size[1])), way=way))
    return made


def board(items: dict[str, bytes], location: FloatArray) -> Motion:
    """The motion of a board with these items in its journal."""
    config, lease = Config(), Lease()
    assert config.load(items)
    config.location = tuple(location.tolist())
    known: Any = lease
    return Motion(config, known, lambda: None)


def narrow(axis: AxisLimits, count: float, rng: np.random.Generator) -> AxisLimits:
    """Limits with an end near a count."""
    near = round(abs(axis.high - axis.low) * rng.uniform(0.0, 0.03))
    if rng.random() < 0.5:
        return replace(axis, low=max(axis.low, round(count) - near))
    return replace(axis, high=min(axis.high, round(count) + near))


@pytest.mark.parametrize("seed", range(4))
def test_safe_paths_and_the_ends_of_defocus_are_those_of_the_boards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    design, own = malan_plant(COUNT), machines(rng)
    mechanism = design.groups["azel"].mechanism
    books, rows = Journals(mechanism, own), np.arange(COUNT)
    path, length = safe_paths(books.corners, books.position, books.origin, books.standby)

    # Each beam is at a point of its path, at its aim or anywhere, in a motion that ends there.
    kind = rng.choice((APPROACH, STANDBY, TRACK, HOLD), COUNT)
    held = (kind == HOLD) & (rng.random(COUNT) < 0.5)  # at standby
    place = np.where((kind == STANDBY) | held, length - 1, rng.integers(0, length))
    aims = books.standby + rng.uniform(-60.0, 60.0, (COUNT, 3))
    aims[rng.random(COUNT) < 0.2] = np.nan
    elsewhere = (kind == HOLD) & ~held
    aimed = np.where((kind == TRACK)[:, None] & np.isfinite(aims), aims, path[rows, place])
    stow = np.array([machine.stow for machine in own], dtype=np.float64)
    angles, good = books.pose(rows, SUN, aimed, stow)
    assert good.mean() > 0.9
    counts = np.floor(books.drives(rows).counts(np.where(good[:, None], angles, 0.5)) + 0.5)
    counts += np.where(elsewhere[:, None], rng.integers(-20_000, 20_000, (COUNT, 2)), 0)
    for i in np.flatnonzero(rng.random(COUNT) < 0.4):
        axes = tuple(narrow(axis, at, rng) for axis, at in zip(own[i].axes, counts[i], strict=True))
        stands = tuple(
            int(np.clip(s, a.low, a.high)) for s, a in zip(own[i].stow, axes, strict=True)
        )
        own[i] = replace(own[i], axes=(axes[0], axes[1]), stow=(stands[0], stands[1]))
    books = Journals(mechanism, own)
    ends = np.array([[(axis.low, axis.high) for axis in each.axes] for each in own])
    counts = np.clip(counts, ends[..., 0], ends[..., 1])

    # The boards.
    goals = np.empty((COUNT, 2))
    for i in rows:
        motion = board(items_of(mechanism[i], own[i]), books.position[i])
        ways = motion.way()
        assert np.allclose(path[i, : length[i]], ways, atol=1e-9)
        motion.declare(int(counts[i, 0]), int(counts[i, 1]), True)
        motion.kind, motion._path, motion._place = int(kind[i]), ways, int(place[i])
        motion.ready = bool(kind[i] != APPROACH)
        motion._target = motion.config.standby if held[i] or kind[i] == STANDBY else None
        motion.aim = tuple(aims[i].tolist()) if np.isfinite(aims[i]).all() else None
        motion.defocus()
        assert motion.kind == DEFOCUS
        goals[i] = motion.goal(0), motion.goal(1)

    # The arrays.
    def pose(some: Any, points: FloatArray) -> tuple[FloatArray, Any]:
        return books.pose(rows[some], SUN, points, counts[some])

    begin = as_float(books.drives(rows).angles(counts))
    angle = np.array([machine.defocus for machine in own])
    stops = np.sort([books.drives(rows).angles(ends[..., k]) for k in (0, 1)], axis=0)
    tracks = kind == TRACK
    other = np.where(tracks[:, None], books.standby, aims)
    offset = offsets(pose, other, begin, angle)
    end = turned(begin, offset, *stops)
    _, lower = end_down_the_path(pose, path, np.where(elsewhere | tracks, 0, place), begin, angle)
    down = np.isfinite(lower[:, 0])
    end[down] = lower[down]
    steps = np.floor(books.drives(rows).counts(end) + 0.5)
    assert np.abs(np.clip(steps, ends[..., 0], ends[..., 1]) - goals).max() <= 1

    # Every part of the law was asked for.
    assert 5 < down.sum() < COUNT - 5
    assert (offset != angle)[~down].any()
    assert (np.abs(end - begin - offset) > 1e-6)[~down].any()
    assert (np.abs(end - begin + offset) < 1e-9)[~down].any()
