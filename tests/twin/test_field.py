"""The vectorised field beside firmware-true boards: the same steps, from stow to stow."""

import functools
from datetime import timedelta
from typing import Any

import numpy as np
import pytest

from heliotrope.errors import InputError
from heliotrope.geometry import reflect
from heliotrope.lcu import states, wire
from heliotrope.lcu.controller import STUCK_PRIMARY
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import gps_seconds
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.sun import broadcast_values, vector
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import (
    CAUSES,
    MACHINE,
    RECEIVER,
    STEPS_PER_TURN,
    outfits,
    sha256,
)
from heliotrope.twin.field.field import Field
from heliotrope.twin.wind import Wind
from support.copies import copied
from support.midsummer import SITE, START

TOKEN, COUNT = 0xF1E1D, 3


def field_of(mechanism: Mechanism, machine: Any = MACHINE, **options: Any) -> Field:
    return Field(mechanism, machine, **options)


class Both:
    """Boards and a field that are told the same at the same time."""

    def __init__(self, play: float = 0.0, wind: Wind | None = None, count: int = COUNT) -> None:
        made = outfits(count, seed=4)
        self.boards = [Board(outfit, seed=i, play=play, wind=wind) for i, outfit in enumerate(made)]
        gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
        perfect = kinds.azimuth_elevation(
            np.array([outfit.mechanism.position for outfit in made]),
            pivot_height=2.0,
            pivot_offset=0.2,
            drives=(rotary(**gear), rotary(**gear)),
        )
        self.field = field_of(
            perfect.with_parameters(
                {name: np.array([outfit.causes[name] for outfit in made]) for name in CAUSES}
            ),
            [outfit.machine for outfit in made],
            play=play,
            wind=wind,
        )
        for board, row in zip(self.boards, self.field.mechanism.armature.table, strict=True):
            assert np.allclose(board.outfit.mechanism.armature.table, row, atol=1e-12)
        self.ticks = self.compared = 0
        self.play = 0.0
        self.sender = Sender(0, int(gps_seconds(START)), sha256)
        for board in self.boards:
            board.power_on(0.0)

    @property
    def now(self) -> float:
        return 0.05 * self.ticks + 1e-6

    def hear(self, data: bytes) -> None:
        for board in self.boards:
            board.hear(data, self.now)

    def order(self, name: str, *values: float, rows: tuple[int, ...] = (0, 1, 2)) -> None:
        """The same command to boards and field, after their tick."""
        expires = int(gps_seconds(START) + self.now) + 5
        for i in rows:
            head = () if name in ("DEFOCUS", "STOW") else (TOKEN, expires)
            self.hear(self.sender.frame(11 + i, name, *head, *values))
        self.field.order(name, np.array(rows), values or None)

    def fail(self, i: int) -> None:
        node = self.boards[i].node
        assert node is not None
        node.on_fault(STUCK_PRIMARY, self.boards[i].ticks.at(self.now), False)
        self.field.fail(np.array([i]), STUCK_PRIMARY)

    def mend(self, i: int) -> None:
        node = self.boards[i].node
        assert node is not None
        node.fault_gone(STUCK_PRIMARY)
        self.field.mend(np.array([i]))

    def cut(self, *rows: int, warned: bool = False) -> None:
        for i in rows:
            self.boards[i].power_off(self.now, warned=warned)
        self.field.cut(np.array(rows), warned=warned)

    def restore(self, *rows: int) -> None:
        for i in rows:
            self.boards[i].power_on(self.now)
        self.field.restore(np.array(rows))

    def run(self, seconds: float, *, sun: bool = True) -> None:
        """Let time pass; steps and states are the same at every tick."""
        for _ in range(round(20 * seconds)):
            self.ticks += 1
            for board in self.boards:
                board.step(self.now)
            self.field.advance(50)
            if self.ticks % 20 == 0 and sun:
                self.second()
            self.same()

    def second(self) -> None:
        gps = round(gps_seconds(START)) + self.ticks // 20
        values = broadcast_values(gps, START.timestamp() + self.ticks / 20, SITE)
        assert values is not None
        self.hear(self.sender.session(TOKEN))
        week, second = divmod(gps, 604_800)
        self.hear(self.sender.frame(wire.BROADCAST, "TIME", week, 1000 * second, 1))
        self.hear(self.sender.frame(wire.BROADCAST, "SUN", *values))
        self.field.take_sun(values)

    def same(self) -> None:
        drives = self.field.drives
        self.play = max(self.play, float((drives.joint - drives.turned).max()))
        at = f"at {self.now:.2f} s"
        assert self.field.state.tolist() == [board.state for board in self.boards], at
        for i, board in enumerate(self.boards):
            own = board.controller
            if own is not None:
                counts = [own.motion.place(k) for k in (0, 1)]
                assert self.field.axes["count"][i].tolist() == counts, at
                goals = [axis.goal for axis in own.motion.stepper.axes]
                assert self.field.axes["goal"][i].tolist() == goals, at
            # Joints can be compared when the timers have played what was emitted.
            if all(axis.idle for axis in board.axes):
                assert drives.turned[i].tolist() == [a.turned for a in board.axes], at
                assert drives.joint[i].tolist() == [a.joint for a in board.axes], at
                self.compared += 1

    def angles_apart(self) -> float:
        """Largest angle between the true normals of boards and field, rad."""
        normals = [board.mirror()[1] for board in self.boards]
        return float(np.linalg.norm(self.field.normals() - normals, axis=1).max())

    def lit(self) -> list[int]:
        """The heliostats whose true beams pass within 4 m of the receiver's middle."""
        normal, vertex = self.field.stand()
        sun = vector(START + timedelta(seconds=self.now), SITE)
        beams = reflect(np.broadcast_to(sun, normal.shape), normal)
        off = np.linalg.norm(np.cross(beams, np.array(RECEIVER) - vertex), axis=1)
        return np.flatnonzero(off < 4.0).tolist()

    def states(self) -> set[str]:
        return {states.STATES[state] for state in self.field.state}


@functools.cache
def _raised(count: int) -> Both:
    both, every = Both(count=count), tuple(range(count))
    both.run(2)
    both.order("AIM", *RECEIVER, rows=every)
    both.order("APPROACH", rows=every)
    both.run(45)
    assert both.states() == {"IDLE"}
    return both


def standing_by(count: int = COUNT) -> Both:
    """Boards and a field of their own, of which all have gone up to standby."""
    return copied(_raised(count))


def test_boards_that_go_on_from_a_copy_do_as_those_that_were_copied() -> None:
    one, other = standing_by(), standing_by()
    for both in (one, other):
        both.order("TRACK")
        both.run(2)
        both.order("DEFOCUS")
        both.run(2)
    np.testing.assert_array_equal(one.field.axes["count"], other.field.axes["count"])
    assert standing_by().states() == {"IDLE"}


def test_field_and_boards_make_the_same_steps() -> None:
    both = standing_by()
    both.order("TRACK")
    both.run(15)
    assert both.states() == {"TRACKING"}
    both.order("AIM", 1.5, -0.5, 49.0, rows=(0, 2))
    both.run(8)
    both.order("DEFOCUS", rows=(1,))
    both.order("IDLE", rows=(2,))
    both.run(8)
    assert both.states() == {"TRACKING", "DEFOCUSED", "IDLE"}
    both.order("REFOCUS", rows=(1,))
    both.run(6)
    both.order("STOW", rows=(0,))
    both.run(40)
    assert both.field.state[0] == states.STOWED
    # And without the sun by itself: off after the lease, and to stow.
    both.run(12, sun=False)
    assert both.states() == {"STOWED", "DEFOCUSED"}
    both.run(50, sun=False)
    assert both.states() == {"STOWED"}
    assert both.angles_apart() < 1e-9


def test_a_lock_and_a_hold_end_with_the_cluster_as_on_the_boards() -> None:
    both = standing_by()
    both.order("TRACK", rows=(0, 1))
    both.run(12)
    both.order("LOCK")
    both.run(3)
    both.order("UNLOCK", rows=(1,))
    both.order("DEFOCUS", rows=(2,))
    both.run(4)
    assert [states.STATES[s] for s in both.field.state] == ["LOCKED", "IDLE", "LOCKED"]
    both.run(12, sun=False)
    assert [states.STATES[s] for s in both.field.state] == ["LOCKED", "DEFOCUSED", "LOCKED"]
    both.run(60, sun=False)
    assert both.field.at_stow().all()
    assert [states.STATES[s] for s in both.field.state] == ["LOCKED", "STOWED", "LOCKED"]
    assert both.angles_apart() < 1e-9


def test_a_lock_in_motion_gives_the_goals_up_as_on_the_boards() -> None:
    both = standing_by()
    both.order("TRACK")
    both.run(0.5)
    assert not both.field.still().any()
    both.order("LOCK")
    both.run(4)
    assert both.field.still().all()
    np.testing.assert_array_equal(both.field.axes["goal"], both.field.axes["count"])
    both.order("UNLOCK")
    both.run(2)


def test_an_approach_called_off_at_once_ends_as_on_the_boards() -> None:
    both = Both()
    both.run(1.5)
    both.order("APPROACH")
    both.order("DEFOCUS", rows=(0, 1))
    both.order("STOW", rows=(2,))
    both.run(3)
    assert (both.field.axes["count"] == MACHINE.stow).all()


def test_a_defocus_from_standby_and_from_an_approach_goes_down_the_way_as_on_the_boards() -> None:
    both = Both()
    both.run(2)
    both.order("APPROACH", rows=(0, 1))
    both.run(30)
    both.order("APPROACH", rows=(2,))
    while both.field._place[2] < 3:
        both.run(0.5)
    assert [states.STATES[s] for s in both.field.state] == ["IDLE", "IDLE", "APPROACHING"]
    both.order("DEFOCUS")
    both.run(12)
    both.order("STOW", rows=(0,))
    both.order("IDLE", rows=(1,))
    both.run(8)
    both.run(10, sun=False)
    both.run(50, sun=False)
    assert both.states() == {"STOWED"}
    assert both.angles_apart() < 1e-9


def test_who_has_turned_away_without_the_way_or_the_sun_takes_no_idle_as_the_boards() -> None:
    both = Both()
    both.run(2)
    both.order("APPROACH", rows=(0, 2))
    both.run(60)
    both.order("APPROACH", rows=(1,))
    both.run(8)
    both.order("DEFOCUS")
    both.run(1)
    both.order("IDLE", rows=(0, 1))
    both.run(2)
    assert [states.STATES[s] for s in both.field.state] == ["IDLE", "DEFOCUSED", "DEFOCUSED"]
    both.run(8, sun=False)
    both.order("IDLE", rows=(2,))
    both.run(1, sun=False)
    assert both.field.state[2] == states.DEFOCUSED
    assert both.angles_apart() < 1e-9


def test_gears_faults_locks_and_supplies_are_those_of_the_boards() -> None:
    wind = Wind(speed=7.0, towards=1.0, seed=3)
    both = Both(play=35.0, wind=wind)
    both.run(2)
    both.order("AIM", *RECEIVER)
    both.order("APPROACH", rows=(0, 1))
    both.run(8)
    both.fail(1)  # on the way
    both.order("LOCK", rows=(2,))
    both.run(60)
    assert both.states() == {"IDLE", "FAULT", "LOCKED"}
    both.order("TRACK")
    both.order("UNLOCK", rows=(2,))
    both.order("CLEAR_FAULT", rows=(1,))  # its cause is still there
    both.run(15)
    assert [states.STATES[s] for s in both.field.state] == ["TRACKING", "FAULT", "STOWED"]
    assert both.angles_apart() < 1e-9
    both.mend(1)
    both.order("APPROACH", rows=(2,))
    both.order("CLEAR_FAULT", rows=(1,))
    both.run(2)
    assert both.field.state[1] in (states.IDLE, states.STOWED)
    both.order("LOCK", rows=(0,))
    both.run(3)
    both.order("DEFOCUS", rows=(0,))
    both.run(8)
    both.cut(0, 1)
    both.run(3)
    both.order("STOW", rows=(0, 1))  # nobody hears it
    both.run(1)
    both.restore(0, 1)
    both.run(20)
    assert both.field.state[0] == states.LOCKED
    assert both.angles_apart() < 1e-9
    both.run(50)
    both.order("TRACK", rows=(2,))
    both.run(12)
    assert both.field.state[2] == states.TRACKING
    both.order("IDLE", rows=(2,))
    both.run(10)
    both.cut(2, warned=True)
    both.run(2)
    both.restore(2)
    both.order("STOW", rows=(0,))
    both.run(40)
    assert [states.STATES[s] for s in both.field.state][::2] == ["LOCKED", "FAULT"]
    # A fault that is left to itself goes to stow, and is one there.
    both.run(30)
    assert both.field.at_stow()[[0, 2]].all()
    both.order("CLEAR_FAULT", rows=(2,))
    both.order("UNLOCK", rows=(0,))
    both.run(1)
    assert both.states() == {"STOWED"}
    assert both.angles_apart() < 1e-9
    # The play has shown: going down, joints have stood above their motors.
    assert both.play == 35.0
    assert both.compared > 0.5 * COUNT * both.ticks


def standing_at_the_receiver() -> Both:
    both = standing_by()
    both.order("TRACK")
    both.run(12)
    assert both.states() == {"TRACKING"}
    return both


def test_a_lock_does_not_end_what_takes_beams_off_as_on_the_boards() -> None:
    both = standing_at_the_receiver()
    both.order("DEFOCUS", rows=(0,))
    both.order("STOW", rows=(1, 2))
    both.run(0.5)
    both.order("LOCK")
    both.order("UNLOCK")  # busy
    both.run(3)
    assert both.states() == {"LOCKED"}
    both.order("DEFOCUS", rows=(2,))  # from its way back
    both.run(1)
    both.run(100)
    assert both.field.at_stow().all()
    both.order("UNLOCK")
    both.run(1)
    assert both.states() == {"STOWED"}


def test_supplies_that_fail_again_and_again_turn_a_beam_away_once_as_on_the_boards() -> None:
    both = standing_at_the_receiver()
    both.order("DEFOCUS", rows=(0, 1))
    both.order("LOCK", rows=(2,))
    both.run(15, sun=False)  # the locked one turns away in silence
    stands = both.field.axes["count"].copy()
    for warned in (False, True, True, False, True):
        both.cut(0, 1, 2, warned=warned)
        both.run(0.5, sun=False)
        both.restore(0, 1, 2)
        both.run(9, sun=False)
        assert (both.field.axes["count"] == stands).all()
    both.run(90, sun=False)
    assert both.field.at_stow().all()


def test_flux_follows_the_beams() -> None:
    rng = np.random.default_rng(2)
    place = np.c_[rng.uniform(-60, 60, 200), rng.uniform(60, 200, 200), np.zeros(200)]
    gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
    field = field_of(
        kinds.azimuth_elevation(
            place, pivot_height=2.0, pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear))
        )
    )
    second = round(gps_seconds(START))

    def shine(seconds: int, *, lit: bool = True) -> None:
        nonlocal second
        for _ in range(seconds):
            values = broadcast_values(second, START.timestamp() + second - gps_seconds(START), SITE)
            assert values is not None
            if lit:
                field.take_sun(values)
            field.advance(1000)
            second += 1

    def flux() -> float:
        utc = START.timestamp() + second - gps_seconds(START)
        return field.flux(vector(utc, SITE), RECEIVER, 3.0)

    shine(1)
    assert field.order("AIM", aim=RECEIVER).all()
    assert field.order("APPROACH").all()
    assert not field.order("TRACK").any()
    shine(70)
    assert flux() == 0.0
    assert field.order("TRACK").all()
    shine(20)
    assert flux() == pytest.approx(1.0, abs=0.02)
    shine(4, lit=False)
    assert flux() > 0.9
    shine(22, lit=False)
    assert flux() < 0.1
    shine(120, lit=False)
    assert (field.state == states.STOWED).all()
    assert field.at_stow().all()


def test_lost_steps_are_in_the_mirrors_and_not_in_the_counts() -> None:
    made = Both().field.mechanism
    perfect, lossy = field_of(made), field_of(made, miss=0.2, seed=8)
    second = round(gps_seconds(START))
    values = broadcast_values(second, START.timestamp(), SITE)
    assert values is not None
    moved = np.zeros((COUNT, 2))
    for field in (perfect, lossy):
        field.take_sun(values)
        assert field.order("APPROACH").all()
    for _ in range(100):
        before = lossy.axes["count"].copy()
        for field in (perfect, lossy):
            field.take_sun(values)
            field.advance(50)
        moved += before != lossy.axes["count"]
    assert np.array_equal(perfect.axes["count"], lossy.axes["count"])
    missed = lossy.drives.missed
    spread = np.sqrt(0.2 * 0.8 * moved.sum())
    assert abs(missed.sum() - 0.2 * moved.sum()) < 4.0 * spread
    # All of it went one way so far: each lost step is missing.
    assert np.array_equal(np.abs(lossy.drives.turned - lossy.axes["count"]), missed)
    # They are 15.7 µrad each.
    apart = np.linalg.norm(lossy.normals() - perfect.normals(), axis=1)
    assert (apart < 15.8e-6 * missed.sum(axis=1)).all()
    # A mirror that still looks up is hardly moved by its azimuth.
    assert apart.min() > 1e-6
    assert apart.max() > 50e-6


def test_the_wind_turns_the_mirrors_of_a_field() -> None:
    wind = Wind(speed=9.0, towards=0.7, seed=2)
    made = Both().field.mechanism
    calm, windy = field_of(made), field_of(made, wind=wind)
    # At stow a mirror is nearly edge on: its normal is off the zenith by its imperfections alone.
    assert np.abs(calm.normals() - windy.normals()).max() < 0.1e-3
    values = broadcast_values(round(gps_seconds(START)), START.timestamp(), SITE)
    assert values is not None
    for field in (calm, windy):
        field.take_sun(values)
        field.order("APPROACH")
    turns = []
    for _ in range(30):
        for field in (calm, windy):
            field.take_sun(values)
            field.advance(1000)
        turns.append(np.linalg.norm(calm.normals() - windy.normals(), axis=1))
    assert np.array_equal(calm.axes, windy.axes)
    last = np.array(turns[-10:])
    assert 0.05e-3 < last.min() < last.max() < 3e-3
    assert (last.std(axis=0) > 0.02 * last.mean(axis=0)).all()
    place = np.broadcast_to(made.position, (COUNT, 3))
    assert np.allclose(windy.normals(), wind.turned(calm.normals(), place, 30.0), atol=1e-12)


def test_without_a_supply_nothing_is_heard() -> None:
    field = Both().field
    values = broadcast_values(round(gps_seconds(START)), START.timestamp(), SITE)
    assert values is not None
    field.cut(np.array([1]))
    field.take_sun(values)
    assert [field.lease_left(i) > 0 for i in range(COUNT)] == [True, False, True]
    assert field.order("APPROACH").tolist() == [True, False, True]
    assert field.order("DEFOCUS").tolist() == [True, False, True]
    field.fail(np.array([0, 1]), STUCK_PRIMARY)
    assert field.fault.tolist() == [STUCK_PRIMARY, 0, 0]
    field.cut(np.array([1]))
    field.restore(np.array([0, 1]))
    assert field.state.tolist() == [states.FAULT, states.STOWED, states.DEFOCUSED]


def test_what_a_field_refuses() -> None:
    made = outfits(1)[0]
    with pytest.raises(InputError, match=r"field: mechanisms of shape \(\) with 2 drives; pass"):
        field_of(made.mechanism)
    field = Both().field
    with pytest.raises(InputError, match="field: 70 ms is not a multiple of 50 ms"):
        field.advance(70)
    with pytest.raises(InputError, match="field: 'JUMP' with aim None; see Field"):
        field.order("JUMP")
    with pytest.raises(
        InputError, match=r"field: a fault must be 1 to 10, as in lcu.names, not 11"
    ):
        field.fail(np.array([0]), 11)
    with pytest.raises(
        InputError, match=r"drives: play must be 0 or more.* not -1.0 steps and 0.0"
    ):
        field_of(field.mechanism, play=-1.0)
    with pytest.raises(InputError, match=r"0 to 1, not .* steps and 1.5"):
        field_of(field.mechanism, miss=1.5)


ORDERS = (
    "APPROACH",
    "IDLE",
    "TRACK",
    "REFOCUS",
    "DEFOCUS",
    "STOW",
    "LOCK",
    "UNLOCK",
    "CLEAR_FAULT",
)


@pytest.mark.parametrize("first", ORDERS)
def test_after_any_two_orders_a_defocus_takes_the_beam_off(first: str) -> None:
    """From standby and from the aim: every order after every other, then TRACK and DEFOCUS.

    The angles of an earlier defocus must not count: from standby it goes down the way, and turns
    nothing beside. Boards and field do the same at every tick.
    """
    both = standing_by(2 * len(ORDERS))
    every = tuple(range(2 * len(ORDERS)))
    both.order("TRACK", rows=every[len(ORDERS) :])
    both.run(6)
    both.order(first, rows=every)
    both.run(1.5)
    for i, second in enumerate(ORDERS):
        both.order(second, rows=(i, i + len(ORDERS)))
    both.run(3)
    both.order("TRACK", rows=every)
    both.run(6)
    # Where it was not ordered to stow, it is off only by the last order.
    assert "TRACKING" in both.states() or first in ("STOW", "LOCK")
    both.order("DEFOCUS", rows=every)
    both.run(6)
    assert "TRACKING" not in both.states()
    assert both.lit() == []
    # A second one turns nothing back.
    both.order("DEFOCUS", rows=every)
    both.run(3)
    assert both.lit() == []
