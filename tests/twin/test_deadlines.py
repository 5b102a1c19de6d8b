"""A firmware-true board and time in steps around its deadlines: Hypothesis looks for a way past."""

import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from heliotrope.lcu import states, ticks, wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import gps_seconds
from heliotrope.sun import broadcast_values
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.clocks import TickCounter
from heliotrope.twin.boards.outfit import RECEIVER, outfits, sha256
from support.midsummer import SITE, START
from support.twin_defects import DEFECTS

TOKEN, ADDRESS = 5, 11
#: Around the ends of a slot, a second, the lease, the two silences and the wait for stow, ms.
WAITS = (
    1,
    49,
    50,
    51,
    999,
    1000,
    1001,
    5949,
    5999,
    6000,
    6001,
    6051,
    9999,
    10_001,
    19_999,
    20_001,
    29_999,
    30_000,
    30_001,
    36_001,
)
JUMPS = (-1, 1, -6000, 5999, 6001, 30_001, ticks.HALF - 1, -ticks.HALF + 1)
#: The lease, and how late a board may look, ms.
LEASE_MS, LOOK_MS = 6000, 60


class Deadlines(RuleBasedStateMachine):
    """One board, one sender, and the true time in ms."""

    @initialize(start=st.sampled_from([0, ticks.PERIOD - 100_000, ticks.HALF - 90_000]))
    def to_tracking(self, start: int) -> None:
        self.ms, self.sun_ms, self.dark_ms = 0, -(10**9), 0
        self.jumped = False
        self.board = Board(outfits(1, seed=2)[0], ticks=TickCounter(start))
        self.board.power_on(0.0)
        self.sender = Sender(0, int(gps_seconds(START)), sha256)
        for name, seconds in (("AIM", 1), ("APPROACH", 60), ("TRACK", 4)):
            self.second()
            self.command(name)
            for _ in range(seconds):
                self.wait(1000)
                self.second()
        assert self.board.state == states.TRACKING

    @property
    def gps(self) -> float:
        return gps_seconds(START) + self.ms / 1000.0

    def hear(self, name: str, *values: float, to: int = wire.BROADCAST) -> None:
        self.board.hear(self.sender.frame(to, name, *values), self.ms / 1000.0)

    @rule()
    def second(self) -> None:
        self.time()
        values = broadcast_values(int(self.gps), START.timestamp() + self.ms / 1000.0, SITE)
        assert values is not None
        self.hear("SUN", *values)
        # A second sun of the same second renews nothing.
        self.sun_ms = max(self.sun_ms, self.ms)
        self.dark_ms = self.ms

    @rule()
    def time(self) -> None:
        self.board.hear(self.sender.session(TOKEN), self.ms / 1000.0)
        week, second = divmod(self.gps, 604_800)
        self.hear("TIME", int(week), int(1000 * second), 1)

    @rule(name=st.sampled_from(["APPROACH", "TRACK", "IDLE", "REFOCUS", "AIM"]))
    def command(self, name: str) -> None:
        values = RECEIVER if name == "AIM" else ()
        self.hear(name, TOKEN, int(self.gps) + 5, *values, to=ADDRESS)

    @rule(name=st.sampled_from(["DEFOCUS", "STOW"]))
    def emergency(self, name: str) -> None:
        self.hear(name)
        assert self.board.state not in (*states.NEED_SUN, states.IDLE)

    @rule(milliseconds=st.sampled_from(WAITS))
    def wait(self, milliseconds: int) -> None:
        end = self.ms + milliseconds
        while self.ms < end:
            now = self.ms / 1000.0
            due = int(1000.0 * max(now, self.board.due(now))) + 1
            self.ms = min(end, due)
            self.board.step(self.ms / 1000.0)
            self.needs_a_sun()

    @rule(milliseconds=st.sampled_from(JUMPS))
    def jump(self, milliseconds: int) -> None:
        self.board.ticks.jump(milliseconds)
        self.board.step(self.ms / 1000.0)

    @rule(warned=st.booleans())
    def cut(self, warned: bool) -> None:
        self.board.power_off(self.ms / 1000.0, warned=warned)
        self.board.power_on(self.ms / 1000.0)
        self.dark_ms = self.ms
        assert self.board.state in (states.STOWED, states.DEFOCUSED, states.FAULT)

    @invariant()
    def needs_a_sun(self) -> None:
        if hasattr(self, "board") and self.board.state in states.NEED_SUN:
            assert self.ms - self.sun_ms <= LEASE_MS + LOOK_MS

    def teardown(self) -> None:
        """Left alone it is off the receiver in 30 s and at stow in 5 minutes."""
        if not hasattr(self, "board"):
            return
        self.wait(30_000)
        assert self.board.state not in states.NEED_SUN
        self.wait(270_000)
        own = self.board.controller
        assert own is not None
        assert own.motion.at_stow() or not own.motion.known


TestDeadlines = Deadlines.TestCase
TestDeadlines.settings = settings(max_examples=12, stateful_step_count=20)


def test_it_can_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    next(each for each in DEFECTS if each.name == "lease that never ends").plant(monkeypatch)
    with pytest.raises(AssertionError):
        run_state_machine_as_test(
            Deadlines,
            settings=settings(max_examples=5, stateful_step_count=10, phases=[Phase.generate]),
        )
