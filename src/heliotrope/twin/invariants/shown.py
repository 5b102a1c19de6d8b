"""The observer of displays: tables, heliostat pages, summary and events, against the truth.

The observer makes the same requests as a page. It knows from the boards where their motors are and
where their beams go, from the bus what the boards have reported and when, and from the operators
what they have done. A displayed row must contain what was reported, and its age must be the true
age; a calibration is shown with the error that follows from its own covariance; each action of an
operator is an event, exactly once, and no event names an operator who did nothing (invariant 11).
"""

from collections import deque
from collections.abc import Collection, Mapping, Sequence, Set
from math import inf, isfinite

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.mechanism.tracking import track
from heliotrope.plant.operations import Operations
from heliotrope.plant.operations.views import FieldFrame, HeliostatView
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import RECEIVER
from heliotrope.twin.invariants.invariants import Judge
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.visits import across, slope_of

#: Time between two looks, s.
EVERY = 2.0
#: A frame is kept for a second; a value waits up to a second for a connection, and may be in
#: transit for another, s.
FRAME, TRANSIT = 1.1, 2.2
#: State and surface displayed in a row that is not live.
STALE, NOWHERE = 255, ""
#: Step counts may be older than the row by this, including transit to the plant, s: a cluster
#: requests them less often, and a request may be lost.
COUNTED = 10.0
#: Maximum age of a row in an undisturbed period, s.
OLD = 6.0
#: Steps by which a shown count may be beyond those of the last seconds, and a share of their span.
STEPS, AHEAD = 100.0, 0.3
#: A beam that is shown on a surface has its point this near to it by the steps made, m, after it
#: was sent there for this long, s.
NEAR, SETTLED = 6.0, 20.0
#: A heliostat that has turned by more than this many steps within this time, s, is still moving to
#: its aim; the longest motion takes less than the last time, s.
FOLLOWS, SLEW, LONGEST = 1000.0, 1.0, 60.0
#: The predicted error of a row agrees with the observer's own to within this share.
SHARE = 0.25
#: An operator's action becomes an event within this time, s.
NOTED_WITHIN = 1.0


class ShownObserver(Judge):
    """Checks what is displayed; see the module.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        All heliostats.
    homes
        Names of the heliostats of each cluster.
    targets
        Calibration targets.
    plant
        Observer of the plant, which knows the boards' reports and the holder of the command
        authority.
    persons
        Names of the operators whose actions are reported to this observer.
    dark
        Heliostats about which the plant file is wrong, so their beam positions are unknown.

    """

    def __init__(
        self,
        start: float,
        boards: Sequence[Board],
        homes: Mapping[str, Sequence[str]],
        targets: Sequence[Target],
        plant: PlantObserver,
        persons: Sequence[str],
        dark: Collection[str] = (),
    ) -> None:
        super().__init__(start)
        self._plant, self._persons = plant, tuple(persons)
        self._dark = frozenset(dark)
        self._boards = {board.outfit.name: board for board in boards}
        self._homes = {name: cluster for cluster, names in homes.items() for name in names}
        self._middles = {target.name: target.center for target in targets}
        self._middles["receiver"] = np.array(RECEIVER)
        self._counts: dict[str, deque[tuple[float, FloatArray]]] = {
            name: deque(maxlen=40) for name in self._boards
        }
        self._states: dict[str, tuple[int, float]] = {}
        self._out: set[str] = set()
        self._changed: dict[str, float] = {}
        self._acts: list[tuple[float, str, str, Operations | None]] = []
        self._judged: set[tuple[float, str, str]] = set()
        self._places: dict[str, tuple[str, float]] = {}
        self._program: Operations | None = None
        self._waited = True
        self._begun = self._judged_at = -inf
        self._frame = 0
        self._turn = 0

    # -- operators -----------------------------------------------------------------------------

    def acted(self, operations: Operations | None, person: str, word: str, now: float) -> None:
        """Record an operator's action in a program; the event's text must contain ``word``."""
        self._acts.append((now, person, word, operations))

    def held(self, heliostats: Sequence[str], now: float, *, out: bool) -> None:
        """Record that an operator has taken heliostats out of service, or put them back."""
        for name in heliostats:
            self._changed[name] = now
            if out:
                self._out.add(name)
            else:
                self._out.discard(name)

    # -- judgement ---------------------------------------------------------------------------

    def look(
        self, operations: Operations | None, quiet: Set[str], sun: FloatArray, now: float
    ) -> None:
        """Check the displays; ``operations`` is None if the plant is not running or is frozen."""
        for name, board in self._boards.items():
            steps = np.array([(a.turned, a.emitted) for a in board.axes], dtype=np.float64).T
            self._counts[name].append((now, steps - board.slip))
            if self._states.get(name, (-1, 0.0))[0] != board.state:
                self._states[name] = board.state, now
        if operations is None:
            self._waited = True
            return
        if operations is not self._program:
            self._program, self._frame, self._waited = operations, 0, True
            self._judged.clear()
            self._acts = [act for act in self._acts if act[3] is operations]
        if self._waited:
            self._begun, self._waited = now, False
        self._events(operations, now)
        if now - self._judged_at < EVERY:
            return
        self._judged_at = now
        frame = operations.viewer.frame()
        self._rows(operations, frame, quiet, sun, now)
        self._head(operations, now)
        names = operations.names
        name = names[self._turn % len(names)]
        self._turn += 1
        view = operations.viewer.heliostat(name)
        self._detail(operations, view, quiet, now)

    def _events(self, operations: Operations, now: float) -> None:
        """Check that each operator action produces exactly one event, and nothing else does."""
        for row in operations.logbook.events(100):
            key = (row.at, row.who, row.text)
            if row.who not in self._persons or key in self._judged:
                continue
            self._judged.add(key)
            own = [act for act in self._acts if act[1] == row.who and act[2] in row.text]
            saw = f"an event names {row.who}, who did no such thing: {row.text}"
            self.check(11, bool(own), now, "logbook", saw)
            self._acts.remove(own[0])
        for at, who, word, _ in self._acts:
            saw = f"{who} did {word!r} {now - at:.1f} s ago, but no event says so"
            self.check(11, now - at <= NOTED_WITHIN, now, "logbook", saw)

    def _rows(
        self,
        operations: Operations,
        frame: FieldFrame,
        quiet: Set[str],
        sun: FloatArray,
        now: float,
    ) -> None:
        fresh = frame.number > self._frame
        self.check(11, frame.number >= self._frame, now, "frame", "its number decreases")
        self._frame = frame.number
        made = now if fresh else now - FRAME
        for row, name in enumerate(operations.names):
            age, state = float(frame.age[row]), int(frame.state[row])
            home = operations.plant.field.clusters[int(frame.cluster[row])]
            saw = f"it is shown in {home}, but is in {self._homes[name]}"
            self.check(11, home == self._homes[name], now, name, saw)
            if now - self._changed.get(name, -inf) > FRAME:
                held = bool(frame.held[row])
                saw = f"it is shown as {'out of' if held else 'in'} service, but is not"
                self.check(11, held == (name in self._out), now, name, saw)
            if state == STALE:
                saw = f"it is shown as stale, {age:.1f} s old"
                calm = name in quiet and now - self._begun > OLD
                self.check(11, not calm, now, name, saw)
                continue
            reported = self._plant.reports(name, made - age - TRANSIT - FRAME)
            saw = f"it is shown as {states.STATES[state]}; it has not reported that state"
            self.check(11, state in reported, now, name, saw)
            if name in quiet:  # on a bad bus, replies are lost one after another
                self._counted(name, frame.counts[row], made - age, now)
            place = operations.viewer.aim_names[int(frame.on[row])]
            self._placed(name, place, sun, now, calm=name in quiet)
        self._calibrations(operations, frame, quiet, sun, now)

    def _counted(self, name: str, counts: FloatArray, at: float, now: float) -> None:
        """Check that the displayed step counts occurred within the last seconds."""
        low, high = self._span(name, at)
        shown = ", ".join(str(int(count)) for count in counts)
        saw = f"its counts are shown as {shown}, but were between {low} and {high}"
        self.check(11, bool(((counts >= low) & (counts <= high)).all()), now, name, saw)

    def _span(self, name: str, at: float) -> tuple[FloatArray, FloatArray]:
        """Return the least and the greatest step counts, each (2,), that a row may show.

        Steps count once they are sent to the motors, which is before they are made.
        """
        some = [c for when, c in self._counts[name] if when >= at - COUNTED]
        if self._boards[name].node is None or len(some) < 2 or any(self._boards[name].slip):
            return np.full(2, -inf), np.full(2, inf)
        # Between two looks a heliostat may have begun a motion, replied, and been called back.
        some += [np.array([s, s], dtype=float) for s in self._plant.true_counts(name, at - COUNTED)]
        low, high = np.min(some, axis=(0, 1)), np.max(some, axis=(0, 1))
        room = STEPS + AHEAD * (high - low)
        return low - room, high + room

    def _placed(self, name: str, place: str, sun: FloatArray, now: float, *, calm: bool) -> None:
        """Check that a beam shown on a surface is there, according to the steps made."""
        state, since = self._states[name]
        before = self._places.get(name)
        if before is None or before[0] != place or not calm:
            self._places[name] = before = place, now
        aimed = self._plant.aimed(name)  # two looks may miss an aim that is withdrawn at once
        if not calm or now - max(since, before[1], aimed) < SETTLED:
            return
        works = state in (states.TRACKING, states.SEARCHING)
        saw = f"{states.STATES[state]}, and its beam is shown on {place or 'nothing'}"
        self.check(11, works == (place != NOWHERE), now, name, saw)
        known = place in self._middles and name not in self._dark
        if state == states.TRACKING and known and self._came(name, now):
            x, y, z = (float(coordinate) for coordinate in self._middles[place])
            miss = self._boards[name].miss(sun, (x, y, z), believed=True)
            saw += f", {miss:.1f} m from its middle"
            self.check(11, miss <= NEAR, now, name, saw)

    def _came(self, name: str, now: float) -> bool:
        """Return whether a heliostat follows its aim, or has had the time for the longest motion.

        Near the keyhole an axis turns far for a small motion of the beam, so it takes longer than
        elsewhere.
        """
        some = [counts for at, counts in self._counts[name] if at >= now - SLEW]
        turned = float(np.ptp(np.stack(some), axis=0).max())
        return turned <= FOLLOWS or now - self._states[name][1] >= LONGEST

    def _calibrations(
        self,
        operations: Operations,
        frame: FieldFrame,
        quiet: Set[str],
        sun: FloatArray,
        now: float,
    ) -> None:
        beliefs = operations.plant.beliefs
        for row, name in enumerate(operations.names):
            record = beliefs.record(name)
            at = float(frame.calibrated_at[row])
            saw = f"it is shown with{'' if isfinite(at) else 'out'} a calibration"
            if record is None:
                self.check(11, not isfinite(at), now, name, saw)
                continue
            if now - (record.at - self._zero(operations)) < FRAME + 1.0 or now - self._begun < 15.0:
                continue
            self.check(11, at == record.at, now, name, saw)
            state, since = self._states[name]
            # The error depends on the pose, so only a heliostat near its working pose is compared.
            works = state in (states.IDLE, states.TRACKING) and now - since > SETTLED
            if not works or name not in quiet:
                continue
            own = _expected(operations, name, self._counts[name][-1][1][0], sun)
            said = float(frame.error[row])
            saw = (
                f"its predicted error is shown as {1e3 * said:.3f} mrad, but it is {1e3 * own:.3f}"
            )
            good = not isfinite(own) or abs(said - own) <= SHARE * own
            self.check(11, good, now, name, saw)

    def _zero(self, operations: Operations) -> float:
        clock = operations.plant.clock
        return clock.utc().timestamp() - clock.monotonic()

    def _head(self, operations: Operations, now: float) -> None:
        head = operations.summary()
        total = sum(head.states.values())
        count = len(self._boards)
        saw = f"{total} of {count} heliostats are counted by state, but {head.heliostats} in total"
        self.check(11, total == count == head.heliostats, now, "summary", saw)
        holder = self._plant.holder(now)
        saw = f"{head.holder or 'nobody'} is shown with the command authority, but {holder} has it"
        self.check(11, holder is None or head.holder == holder, now, "summary", saw)
        rows = operations.logbook.alarms()
        still = sum(row.active or not row.acknowledged_by for row in rows)
        saw = f"{head.alarms} alarms are counted, but {still} are shown"
        self.check(11, head.alarms == still, now, "summary", saw)
        for row in operations.logbook.cluster_rows(operations.plant):
            members = [name for name, home in self._homes.items() if home == row.name]
            saw = f"{row.heliostats} heliostats are shown, but there are {len(members)}"
            self.check(11, row.heliostats == len(members), now, row.name, saw)
            good = not isfinite(row.answered) or 0.0 <= row.answered <= 1.0
            self.check(11, good, now, row.name, f"it is shown to have answered {row.answered:.2f}")

    def _detail(
        self, operations: Operations, view: HeliostatView, quiet: Set[str], now: float
    ) -> None:
        name, board = view.name, self._boards[view.name]
        where = board.outfit.mechanism.position
        off = float(np.linalg.norm(view.position - np.asarray(where).reshape(-1)[:3]))
        self.check(11, off < 1.0, now, name, f"it is shown {off:.1f} m from where it is")
        if view.live:
            reported = {
                states.STATES[state] for state in self._plant.reports(name, now - view.age - 3.3)
            }
            self.check(
                11, view.state in reported, now, name, f"it is shown as {view.state} in detail"
            )
            for drive, axis in zip(view.drives, (0, 1), strict=True):
                if name in quiet:
                    self._drive(name, drive.count, axis, now - view.age, now)
        if view.calibration is not None:
            for key, value in view.calibration.parameters.items():
                shown = view.parameters.get(key)
                saw = f"its parameter {key} is shown as {shown}, but is {value}"
                self.check(11, shown is not None and shown.value == value, now, name, saw)
        saw = f"why it is out of service is shown as {view.hold!r}"
        self.check(11, bool(view.hold) == (name in self._out), now, name, saw)
        if view.planned is not None:
            at = view.planned.at - self._zero(operations)
            saw = f"its next visit is shown as planned {now - at:.0f} s ago"
            self.check(11, at >= now - 1800.0 and view.planned.heliostat == name, now, name, saw)

    def _drive(self, name: str, count: int, axis: int, at: float, now: float) -> None:
        low, high = self._span(name, at)
        saw = f"drive {axis} is shown at {count}; it was {low[axis]:.0f} to {high[axis]:.0f}"
        self.check(11, bool(low[axis] <= count <= high[axis]), now, name, saw)


def _expected(operations: Operations, name: str, present: FloatArray, sun: FloatArray) -> float:
    """Return the error of a normal expected from its covariance, at the receiver, rad.

    Of the two poses, the pose nearer to the present counts (2,) is used.
    """
    beliefs = operations.plant.beliefs
    record = beliefs.record(name)
    assert record is not None
    nominal = beliefs.nominal(name)[0]
    aim = operations.plant.default_aims((name,))[name]
    counts = track(record.mechanism(nominal), sun, np.asarray(aim), current=present).best_counts
    if not np.isfinite(counts).all():
        return inf
    # Only displacements away from the aim count; a shift along the beam causes no error.
    direction = np.asarray(aim) - record.mechanism(nominal).pose(counts).vertex
    slope = slope_of(record, nominal, counts, sun, np.asarray(aim)) @ across(direction).T
    return 0.5 * float(np.sqrt(np.trace(slope.T @ record.covariance @ slope)))
