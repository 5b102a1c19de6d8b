"""The observer of progress: automatic control raises the field and calibrates it, in time.

It knows from the persons what they have given to automatic control, and who has the command
authority. In a quiet stretch (`quiet`) a heliostat that was given must leave stow, and be measured
when a target is free; a visit must end, and leave no beam on its target; no part of the work may
fail (16). One that stays at stow because volumes lie across its way must be named. All times are
the observer's own.
"""

from collections import Counter
from collections.abc import Sequence, Set
from math import inf, radians, sin

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.views import Running
from heliotrope.twin.boards.board import Board
from heliotrope.twin.invariants.invariants import InvariantError, Violation

#: Vertical part of the sun's direction above which the field belongs up: 9.5 degrees.
HIGH = sin(radians(9.5))
#: A heliostat that was given leaves stow within this: losses rest for 30 s; s.
RAISED_WITHIN = 60.0
#: A target is idle this long at most while a heliostat is ready for it; the same where heliostats
#: wait for each other, s.
IDLE_WITHIN, TOGETHER_WITHIN = 25.0, 110.0
#: A visit ends within this, s.
VISIT_WITHIN = 260.0
#: A beam may stay on a target without a visit for this long, wherever a person has sent it, s.
LEFT_WITHIN = 30.0
#: Names of the alarms that a part of the work has failed, and that a way from stow is not free.
FAILED, BLOCKED = "work", "beam_blocked"


class ProgressObserver:
    """Observes the progress of automatic control; see the module.

    Parameters
    ----------
    start
        Zero of the times that it reports, s.
    boards
        All heliostats.
    targets
        Calibration targets.
    together
        Whether heliostats wait for each other, to be measured at once.
    across
        Whether keep-out volumes may lie across the ways from stow.

    Attributes
    ----------
    checks
        Number of checks of each invariant.
    """

    def __init__(
        self,
        start: float,
        boards: Sequence[Board],
        targets: Sequence[Target],
        *,
        together: bool,
        across: bool,
    ) -> None:
        self.checks: Counter[int] = Counter()
        self._start, self._targets = start, {target.name: target for target in targets}
        self._boards = {board.outfit.name: board for board in boards}
        self._together, self._across = together, across
        self._given: set[str] = set()
        self._out: dict[str, float] = {}
        self._since: dict[tuple[str, ...], float] = {}

    def _check(self, good: bool, now: float, subject: str, saw: str) -> None:
        self.checks[16] += 1
        if not good:
            raise InvariantError(Violation(16, now - self._start, subject, saw))

    # -- persons -----------------------------------------------------------------------------

    def given(self, heliostats: Sequence[str]) -> None:
        """Note that a person has given heliostats to automatic control."""
        self._given.update(heliostats)

    def taken(self, heliostats: Sequence[str]) -> None:
        """Note that a person has moved heliostats, and may do so until they are given again."""
        self._given.difference_update(heliostats)

    def held(self, heliostats: Sequence[str], now: float, *, out: bool) -> None:
        """Note that a person has taken heliostats out of service, or given them back."""
        for name in heliostats:
            if out:
                self._out.setdefault(name, now)
            else:
                self._out.pop(name, None)

    # -- judgement ---------------------------------------------------------------------------

    def look(
        self,
        operations: Operations | None,
        quiet: Set[str],
        sun: FloatArray,
        now: float,
        *,
        governs: bool,
    ) -> None:
        """Judge the progress.

        Parameters
        ----------
        operations
            None: the plant's program does not run, or is frozen.
        quiet
            Heliostats in a quiet stretch.
        sun
            True direction to the sun, (3,).
        now
            s.
        governs
            Whether automatic control has the command authority.
        """
        if operations is None:
            self._since.clear()
            return
        rows = operations.alarms()
        failures = [row.text for row in rows if row.condition == FAILED]
        self._check(not failures, now, "automatic control", failures[0] if failures else "")
        if operations.plant.emergency is not None:
            self._given.clear()
        running = operations.calibration().running
        visited = {name for run in running for name in run.heliostats}
        self._visits(running, now)
        stowed = {n for n, board in self._boards.items() if board.state == states.STOWED}
        blocked = {row.subject for row in rows if row.condition == BLOCKED and row.active}
        stowed -= blocked if self._across else set()
        may = governs and not operations.automatic.waits and sun[2] > HIGH
        may &= not operations.plant.emergency_on
        working = [name for name in self._given & quiet if may and name not in self._out]
        for name, board in self._boards.items():
            mine = name in working and name not in visited
            self._within(
                ("raised", name),
                mine and name in stowed,
                now,
                RAISED_WITHIN,
                name,
                "it has stood at stow",
            )
            for target in self._targets.values():
                lights = mine and board.state == states.TRACKING and self._on(board, target, sun)
                saw = f"no visit is under way, and its beam has been on {target.name}"
                key = ("left", name, target.name)
                self._within(key, lights, now, LEFT_WITHIN, name, saw)
        busy = {run.target for run in running}
        limit = TOGETHER_WITHIN if self._together else IDLE_WITHIN
        for name in self._boards:
            up = self._boards[name].state in (states.IDLE, states.TRACKING)
            ready = name in working and name not in visited and up
            if self._together:  # a schedule may leave alone whom it knows well
                ready &= operations.plant.beliefs.record(name) is None
            for place in self._targets:
                free = ready and place not in busy
                saw = f"{place} has been free, and it ready for a visit"
                self._within(("idle", name, place), free, now, limit, name, saw)

    def _within(
        self, key: tuple[str, ...], holds: bool, now: float, limit: float, name: str, what: str
    ) -> None:
        """Check that something does not hold for longer than a time."""
        if not holds:
            self._since.pop(key, None)
            return
        passed = now - self._since.setdefault(key, now)
        self._check(passed <= limit, now, name, f"{what} for {passed:.0f} s, limit {limit:.0f} s")

    def _on(self, board: Board, target: Target, sun: FloatArray) -> bool:
        """Whether a beam is within a target, by the steps that were made."""
        x, y, z = (float(each) for each in target.center)
        return board.miss(sun, (x, y, z), believed=True) < 0.5 * min(target.width, target.height)

    def _visits(self, running: Sequence[Running], now: float) -> None:
        """Check the visits that are shown as under way."""
        counted = Counter(name for run in running for name in run.heliostats)
        for name, count in counted.items():
            self._check(count == 1, now, name, f"it is shown in {count} visits at once")
        kept = {("visit", run.target, *run.heliostats) for run in running}
        for key in [key for key in self._since if key[0] == "visit" and key not in kept]:
            del self._since[key]
        for run in running:
            key = ("visit", run.target, *run.heliostats)
            fresh = key not in self._since
            saw = f"its visit to {run.target} has been under way"
            self._within(key, True, now, VISIT_WITHIN, run.heliostat, saw)
            for name in run.heliostats:
                gone = self._out.get(name, inf)
                saw = f"it was taken out of service {now - gone:.1f} s ago, and a visit begins"
                self._check(not (fresh and now - gone > 1.0), now, name, saw)
