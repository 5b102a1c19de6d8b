"""The observer of progress: automatic control raises and calibrates the field in time.

The operators tell the observer which heliostats they have put under automatic control, and who
holds the command authority. In an undisturbed period (`quiet`) a heliostat under automatic control
must leave stow, and be measured when a target is free; a visit must end, and leave no beam on its
target; no part of the work may fail; and measurements must continue while some heliostats are not
calibrated (16). A heliostat that stays at stow because volumes obstruct its path must be named.
Whatever a visit has taken is released: no heliostat stays LOCKED without a visit, an operator or an
emergency that holds it (L1). A heliostat under automatic control tracks the receiver, or is in a
visit, within a time limit (L3). An emergency, and the list of heliostats out of service, survive a
restart (L4). Taking the command authority ends no visit, and a heliostat that is being photographed
uses fine steps, whatever an operator sets (16). All time limits are the observer's own.
"""

from collections import Counter
from collections.abc import Collection, Sequence, Set
from math import asin, inf, radians

from heliotrope.calibration.record import CalibrationOutcome
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.views import Running
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import RECEIVER
from heliotrope.twin.invariants.day import LOWEST
from heliotrope.twin.invariants.invariants import L1, L3, L4, OFF, Judge

#: The field belongs up once the sun is this much higher than the elevation below which it belongs
#: at stow, rad, or if it was never below it.
HIGHER = radians(1.1)
#: A heliostat under automatic control leaves stow within this time, s; after a loss, automatic
#: control waits for 30 s.
RAISED_WITHIN = 60.0
#: Longest time for which a target may be idle while a heliostat is ready for it, s; and the same if
#: heliostats wait for one another.
IDLE_WITHIN, TOGETHER_WITHIN = 25.0, 110.0
#: A visit ends within this time, s.
VISIT_WITHIN = 260.0
#: A beam may stay on a target without a visit for this long, wherever an operator has sent it, s.
LEFT_WITHIN = 30.0
#: Longest time for which a heliostat may be LOCKED without an owner, s; writing parameters takes
#: seconds.
LOCKED_WITHIN = 60.0
#: A heliostat under automatic control tracks within the first time, s: ten minutes are allowed, and
#: a few heliostats that leave stow one per second need three. While some are not calibrated, a
#: measurement is made within the second time, s.
TRACKS_WITHIN, MEASURED_WITHIN = 240.0, 300.0
#: After an operator has taken the command authority, a visit must not be broken off within this
#: time, s.
GOES_ON = 3.0
#: Names of the alarms which say that a part of the work has failed, that a path from stow is
#: obstructed, and that nobody held the command authority for a while.
FAILED, BLOCKED, NOBODY = "work", "beam_blocked", "authority_lost"
#: Word in the names of the visit stages in which photographs are taken.
PHOTOGRAPH = "photograph "


class ProgressObserver(Judge):
    """Checks the progress of automatic control; see the module.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats.
    targets
        Calibration targets.
    together
        Whether heliostats wait for one another in order to be measured together.
    across
        Whether keep-out volumes may obstruct the paths from stow.
    lowest
        Sun elevation below which the field belongs at stow, rad.
    dark
        Heliostats whose beams no camera sees, because the plant file is so wrong about them that
        their beams miss the receiver and the targets, or because the mirror is covered.
    limited
        Whether a flux limit may keep heliostats at standby while others track the receiver.

    """

    def __init__(
        self,
        start: float,
        boards: Sequence[Board],
        targets: Sequence[Target],
        *,
        together: bool,
        across: bool,
        lowest: float = LOWEST,
        dark: Collection[str] = (),
        limited: bool = False,
    ) -> None:
        super().__init__(start)
        self._targets = {target.name: target for target in targets}
        self._boards = {board.outfit.name: board for board in boards}
        self._together, self._across = together, across
        self._assigned: set[str] = set()
        self._out: dict[str, float] = {}
        self._since: dict[tuple[str, ...], float] = {}
        self._lowest, self._dark, self._limited = lowest, frozenset(dark), limited
        self._up: bool | None = None
        self._locked: set[str] = set()
        self._calibrates, self._measured = True, 0.0
        self._took_at, self._begun = -inf, dict[str, set[str]]()
        self._emergency = self._called = self._ended = False

    # -- operators -----------------------------------------------------------------------------

    def given(self, heliostats: Sequence[str]) -> None:
        """Record that an operator has put heliostats under automatic control."""
        self._assigned.update(heliostats)

    def taken(self, heliostats: Sequence[str]) -> None:
        """Record that an operator has moved heliostats.

        The operator may move them until they are given back to automatic control.
        """
        self._assigned.difference_update(heliostats)

    def commanded(self, what: str, heliostats: Sequence[str]) -> None:
        """Record an operator command that the plant has accepted; a LOCK then has an owner."""
        if what == "LOCK":
            self._locked.update(heliostats)
        elif what == "UNLOCK":
            self._locked.difference_update(heliostats)

    def took(self, operations: Operations, now: float) -> None:
        """Record that an operator has taken the command authority."""
        running = operations.automatic.view().running
        self._took_at = now
        here = (run for run in running if run.target in self._targets)
        self._begun = {run.target: set(run.heliostats) for run in here}

    def switched(self, *, on: bool) -> None:
        """Record that an operator has switched calibration on or off."""
        self._calibrates = on

    def emergency(self, *, on: bool) -> None:
        """Record that an operator has called an emergency, or that it was cleared."""
        self._called = on

    def on_end(self, now: float) -> None:
        """Record that the plant program has ended."""
        del now
        self._ended, self._calibrates = True, True
        self._since.clear()
        self._assigned.clear()
        self._begun.clear()

    def held(self, heliostats: Sequence[str], now: float, *, out: bool) -> None:
        """Record that an operator has taken heliostats out of service, or put them back."""
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
        """Check the progress.

        Parameters
        ----------
        operations
            The plant's operations; None if its program is not running, or is frozen.
        quiet
            Heliostats in an undisturbed period.
        sun
            True direction to the sun, (3,).
        now
            s.
        governs
            Whether automatic control holds the command authority.
        """
        if operations is None:
            self._since.clear()
            return
        rows = operations.logbook.alarms()
        self._recalled(operations, now)
        failures = [row.text for row in rows if row.condition == FAILED]
        self.check(16, not failures, now, "automatic control", failures[0] if failures else "")
        if operations.plant.sentinel.order is not None:
            self._assigned.clear()
        running = operations.automatic.view().running
        visited = {name for run in running for name in run.heliostats}
        self._visits(running, now)
        lost = any(row.condition == NOBODY and row.active for row in rows)
        well = not (operations.plant.sentinel.on or operations.automatic.waits or lost)
        self._go_on(operations, self._assigned & quiet if well else set(), now)
        self._step_finely(running, quiet, sun, now)
        stowed = {n for n, board in self._boards.items() if board.state == states.STOWED}
        blocked = {row.subject for row in rows if row.condition == BLOCKED and row.active}
        stowed -= blocked if self._across else set()
        may = governs and not operations.automatic.waits and self._high(sun)
        may &= not operations.plant.sentinel.on
        self._owned(visited, quiet, now)
        working = [name for name in self._assigned & quiet if may and name not in self._out]
        lit = self._limited and any(
            board.state == states.TRACKING and board.miss(sun, RECEIVER) <= OFF
            for board in self._boards.values()
        )
        for name, board in self._boards.items():
            mine = name in working and name not in visited
            self._within(
                ("raised", name),
                mine and name in stowed,
                now,
                RAISED_WITHIN,
                name,
                "it has been at stow",
            )
            on_receiver = name in self._dark or board.miss(sun, RECEIVER) <= OFF
            tracks = board.state == states.TRACKING and on_receiver
            saw = "it is under automatic control, but has not tracked the receiver"
            locked = name in self._locked and board.state == states.LOCKED
            rests = lit and board.state == states.IDLE
            away = mine and not (tracks or rests or locked)  # the person gives the lock back
            self._within(("tracks", name), away, now, TRACKS_WITHIN, name, saw, L3)
            for target in self._targets.values():
                lights = mine and board.state == states.TRACKING and self._on(board, target, sun)
                saw = f"no visit is under way, but its beam has been on {target.name}"
                key = ("left", name, target.name)
                self._within(key, lights, now, LEFT_WITHIN, name, saw)
        self._idle(operations, working, running, now)
        self._measures(operations, working, may=may, now=now)

    def _idle(
        self,
        operations: Operations,
        working: Sequence[str],
        running: Sequence[Running],
        now: float,
    ) -> None:
        """Check that no target is free for long while a heliostat is ready for it."""
        visited = {name for run in running for name in run.heliostats}
        busy = {run.target for run in running}
        results = operations.automatic.view().results
        # After a failure it rests for longer than a day of "days"; one taken out has not failed.
        whole = (e for e in results if e.outcome is not CalibrationOutcome.TAKEN_OUT)
        failed = {entry.heliostat for entry in whole if not entry.good}
        limit = TOGETHER_WITHIN if self._together else IDLE_WITHIN
        for name in self._boards:
            up = self._boards[name].state in (states.IDLE, states.TRACKING)
            ready = name in working and name not in visited and up and self._calibrates
            if self._together:  # a schedule may leave alone whom it knows well, or who has failed
                ready &= operations.plant.beliefs.record(name) is None and name not in failed
            for place in self._targets:
                free = ready and place not in busy
                saw = f"{place} has been free, and the heliostat ready for a visit"
                self._within(("idle", name, place), free, now, limit, name, saw)

    def _high(self, sun: FloatArray) -> bool:
        """Return whether the field should be up: the sun was high enough, and has not set since."""
        above = asin(float(sun[2])) - self._lowest
        if self._up is None or above < 0.0:
            self._up = above > 0.0
        self._up |= above > HIGHER
        return self._up

    def _owned(self, visited: Set[str], quiet: Set[str], now: float) -> None:
        """Check that no heliostat is LOCKED without an owner while nothing has failed."""
        for name, board in self._boards.items():
            locked = board.state == states.LOCKED and name in quiet and not self._emergency
            locked &= name not in visited | self._locked and name not in self._out
            saw = "no visit, person or emergency holds it, but it has been LOCKED"
            self._within(("locked", name), locked, now, LOCKED_WITHIN, name, saw, L1)

    def _recalled(self, operations: Operations, now: float) -> None:
        """Check that a new program continues the emergency and the locks that were in force."""
        on = operations.plant.sentinel.on
        if self._ended:
            self._ended = False
            saw = (
                "a person's emergency was active when the last program ended, but the new "
                "program continues"
            )
            good = on or bool(operations.automatic.waits) or not self._called
            self.check(L4, good, now, "plant", saw)
            out = {lockout.name for lockout in operations.automatic.service.out}
            lost = sorted(self._out.keys() - out)
            saw = f"a restart has returned to service: {', '.join(lost)}"
            self.check(L4, not lost, now, "plant", saw)
        self._emergency = on

    def _go_on(self, operations: Operations, untouched: Set[str], now: float) -> None:
        """Check that an operator's taking command ends no visit of heliostats left untouched."""
        view = operations.automatic.view()
        if now - self._took_at > GOES_ON:
            self._begun.clear()
        for place, names in list(self._begun.items()):
            if any(run.target == place and names >= set(run.heliostats) for run in view.running):
                continue
            del self._begun[place]
            ends = {entry.heliostat: entry.outcome for entry in reversed(view.results)}
            off = all(ends.get(name) is CalibrationOutcome.REFUSED for name in names)
            saw = f"a person took the command authority {now - self._took_at:.1f} s ago, and "
            saw += (
                f"a visit of {', '.join(names)}, whose heliostats nobody has commanded, was aborted"
            )
            self.check(16, not (off and untouched >= set(names)), now, place, saw)

    def _step_finely(
        self, running: Sequence[Running], quiet: Set[str], sun: FloatArray, now: float
    ) -> None:
        """Check that heliostats whose beams are photographed on a target use fine steps."""
        for run in running:
            target = self._targets.get(run.target)
            if target is None or PHOTOGRAPH not in run.stage:
                continue
            for name in self._assigned & quiet & set(run.heliostats):
                board = self._boards[name]
                photographed = board.state == states.TRACKING and self._on(board, target, sun)
                rough = board.node is not None and board.node.controller.motion.rough > 0
                saw = f"it is being photographed on {run.target}, but is in rough stepping mode"
                self.check(16, not (photographed and rough), now, name, saw)

    def _measures(
        self, operations: Operations, working: Sequence[str], *, may: bool, now: float
    ) -> None:
        """Check that measurements continue while some heliostats are not calibrated."""
        beliefs = operations.plant.beliefs
        results = operations.automatic.view().results
        done = {result.heliostat for result in results} | self._dark
        remaining = [name for name in working if name not in done and beliefs.record(name) is None]
        last = max((result.at for result in results if result.new), default=0.0)
        fresh, self._measured = last > self._measured, max(last, self._measured)
        holds = may and bool(remaining and self._targets) and self._calibrates and not fresh
        saw = (
            f"{len(remaining)} heliostats are not calibrated, and no visit has measured any of them"
        )
        self._within(("measured",), holds, now, MEASURED_WITHIN, "automatic control", saw)

    def _within(
        self,
        key: tuple[str, ...],
        holds: bool,
        now: float,
        limit: float,
        name: str,
        what: str,
        number: int = 16,
    ) -> None:
        """Check that a condition does not hold for longer than a time limit."""
        if not holds:
            self._since.pop(key, None)
            return
        passed = now - self._since.setdefault(key, now)
        saw = f"{what} for {passed:.0f} s, limit {limit:.0f} s"
        self.check(number, passed <= limit, now, name, saw)

    def _on(self, board: Board, target: Target, sun: FloatArray) -> bool:
        """Return whether a beam is on a target, according to the steps made."""
        x, y, z = (float(coordinate) for coordinate in target.center)
        return board.miss(sun, (x, y, z), believed=True) < 0.5 * min(target.width, target.height)

    def _visits(self, running: Sequence[Running], now: float) -> None:
        """Check the visits that are shown as in progress."""
        counted = Counter(name for run in running for name in run.heliostats)
        for name, count in counted.items():
            self.check(16, count == 1, now, name, f"it is shown in {count} visits at once")
        kept = {("visit", run.target, f"{run.since}") for run in running}
        for key in [key for key in self._since if key[0] == "visit" and key not in kept]:
            del self._since[key]
        for run in running:
            key = ("visit", run.target, f"{run.since}")
            fresh = key not in self._since
            saw = f"its visit to {run.target} has been under way"
            self._within(key, True, now, VISIT_WITHIN, run.heliostat, saw)
            for name in run.heliostats:
                out_at = self._out.get(name, inf)
                saw = f"it was taken out of service {now - out_at:.1f} s ago, but a visit begins"
                self.check(16, not (fresh and now - out_at > 1.0), now, name, saw)
