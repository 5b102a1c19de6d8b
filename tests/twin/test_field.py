"""The vectorised field beside firmware-true boards: the same steps, from stow to stow."""

import numpy as np
import pytest

from heliotrope.control._sun_line import sun_values
from heliotrope.control.clock import gps_seconds
from heliotrope.errors import InputError
from heliotrope.lcu import states, wire
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.sun import vector
from heliotrope.twin.board import Board
from heliotrope.twin.field import Field
from heliotrope.twin.outfit import (
    CAUSES,
    DEFOCUS,
    LIMITS,
    RANGES,
    RECEIVER,
    STANDBY,
    STEPS_PER_TURN,
    STOW,
    outfits,
    sha256,
)
from heliotrope.twin.simulation import SITE, START

TOKEN, COUNT = 0xF1E1D, 3


def field_of(mechanism: Mechanism) -> Field:
    return Field(
        mechanism, stow=STOW, ranges=RANGES, limits=LIMITS, standby=STANDBY, defocus=DEFOCUS
    )


class Both:
    """Boards and a field that are told the same at the same time."""

    def __init__(self) -> None:
        made = outfits(COUNT, seed=4)
        self.boards = [Board(outfit, seed=i) for i, outfit in enumerate(made)]
        gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
        perfect = kinds.azimuth_elevation(
            np.array([outfit.mechanism.position for outfit in made]), pivot_height=2.0,
            pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear)),
        )  # fmt: skip
        self.field = field_of(
            perfect.with_parameters(
                {name: np.array([outfit.causes[name] for outfit in made]) for name in CAUSES}
            )
        )
        for board, row in zip(self.boards, self.field.mechanism.armature.table, strict=True):
            assert np.allclose(board.outfit.mechanism.armature.table, row, atol=1e-12)
        self.ticks = 0
        self.sender = wire.Sender(0, int(gps_seconds(START)), sha256)
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
        values = sun_values(gps, START.timestamp() + self.ticks / 20, SITE)
        assert values is not None
        self.hear(self.sender.session(TOKEN))
        week, second = divmod(gps, 604_800)
        self.hear(self.sender.frame(wire.BROADCAST, "TIME", week, 1000 * second, 1))
        self.hear(self.sender.frame(wire.BROADCAST, "SUN", *values))
        self.field.take_sun(values)

    def same(self) -> None:
        counts = [[b.controller.motion.place(k) for k in (0, 1)] for b in self.boards]  # type: ignore[union-attr]
        at = f"at {self.now:.2f} s"
        assert self.field.axes["count"].tolist() == counts, at
        assert self.field.state.tolist() == [board.state for board in self.boards], at

    def angles_apart(self) -> float:
        """Largest angle between the normals of boards and field, rad."""
        normals = [
            board.outfit.mechanism.pose([axis.emitted for axis in board.axes]).normal
            for board in self.boards
        ]
        return float(np.linalg.norm(self.field.normals() - normals, axis=1).max())

    def states(self) -> set[str]:
        return {states.STATES[state] for state in self.field.state}


def test_field_and_boards_make_the_same_steps() -> None:
    both = Both()
    both.run(2)
    both.order("AIM", *RECEIVER)
    both.order("APPROACH")
    both.run(60)
    assert both.states() == {"IDLE"}
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
            values = sun_values(second, START.timestamp() + second - gps_seconds(START), SITE)
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


def test_what_a_field_refuses() -> None:
    made = outfits(1)[0]
    with pytest.raises(InputError, match=r"field: mechanisms of shape \(\) with 2 drives; give"):
        field_of(made.mechanism)
    field = Both().field
    with pytest.raises(InputError, match="field: 70 ms are no multiple of 50 ms"):
        field.advance(70)
    with pytest.raises(InputError, match="field: 'JUMP' with aim None; see Field"):
        field.order("JUMP")
