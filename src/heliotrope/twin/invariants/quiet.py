"""The observer of work: in an undisturbed period, orders must be carried out.

A field that does less than ordered, or does it later, violates no safety invariant. If nothing has
failed near a heliostat for a while, and no alarm names it, this observer expects that SUN and
STATUS arrive at their rates, that an order sent by the plant results in the requested state, that
the beam is at its point to within the step size, that no heliostat stops working by itself, and
that the plant is informed (invariant 16). It knows the orders from the line, the boards, and the
faults of the run; its time limits are its own.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from math import inf

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states, wire
from heliotrope.lcu.node import Node
from heliotrope.links.messages import Command, Progress, Stage
from heliotrope.mechanism.board_items import items_of
from heliotrope.plant.controller import PlantController
from heliotrope.plant.orders.authority import Person
from heliotrope.safety import Act, Alarm
from heliotrope.twin.boards.outfit import RECEIVER, STANDBY
from heliotrope.twin.invariants._account import HeliostatAccount
from heliotrope.twin.invariants.beams import slew
from heliotrope.twin.invariants.invariants import OFF, Judge, Observer

#: An undisturbed period begins this long after the last fault, a board's boot, and the end of the
#: last alarm that names a heliostat or its cluster, s.
SETTLED = 15.0
#: Maximum age of the last SUN that has reached a board, and of the board's last STATUS that has
#: reached the cluster, s. Both are sent every second.
SUN_EVERY, STATUS_EVERY = 3.0, 5.0
#: Time from an order that the plant sends to the state that it requests, s; for APPROACH and STOW
#: the slew of both axes, one after the other, at 8000 steps/s: a turn takes 50 s. A path from the
#: ground that crosses the keyhole, where the stops forbid the short turn, makes nearly two turns.
SOON, APPROACH_WITHIN, STOW_WITHIN = 5.0, 150.0, 120.0
#: Time from the state to the plant's knowledge of it, and to the confirmation of an emergency, s.
TOLD_WITHIN, PROVEN_WITHIN = 8.0, 20.0
#: Time for a beam to come to its point after an order or a change of state, s; if it is not there
#: by then, its drives have the time that they need from there, see `beams.slew`.
ON_POINT_WITHIN = 12.0
#: Largest distance of a beam from its point, according to the steps made: a fraction of the beam's
#: length, rad, plus a distance, m. Coarse steps turn the mirror by 0.25 mrad, and pushed biases by
#: 0.1 mrad; beams turn by twice as much.
NEAR, NEAR_M = 1.2e-3, 0.05
#: Time until the clusters know a new authority; and time within which two orders may cross, s.
GRANTED, CROSSING = 4.0, 3.0

#: Reasons in a refusal, and how long an undisturbed period may have lasted by then, s: statuses
#: arrive every second, and stored items are requested again after 30 s.
UNHEARD_REASON, UNHEARD_FOR = "it has sent nothing since", 0.0
UNCOMPARED_REASON, UNCOMPARED_FOR = "not been compared with the intended", 45.0
#: Reason of a refusal because of doubtful step counts, which is wrong if the counts are right.
DOUBT_REASON = "step counts may be wrong"

#: States from which each order must be carried out, and the states that it requests.
ORDERS = {
    "APPROACH": ((states.STOWED,), (states.IDLE,), APPROACH_WITHIN),
    "TRACK": ((states.IDLE, states.DEFOCUSED, states.SEARCHING), (states.TRACKING,), SOON),
    "REFOCUS": ((states.DEFOCUSED,), (states.TRACKING,), SOON),
    "IDLE": ((states.TRACKING, states.SEARCHING, states.DEFOCUSED), (states.IDLE,), SOON),
    "LOCK": (
        (states.STOWED, states.IDLE, states.TRACKING, states.DEFOCUSED), (states.LOCKED,), SOON,
    ),
    "SEARCH": ((states.IDLE, states.TRACKING), (states.SEARCHING,), SOON),
}  # fmt: skip
#: The same for orders that anyone may give.
SAFE_ORDERS = {
    "DEFOCUS": (
        (states.APPROACHING, states.IDLE, states.TRACKING, states.SEARCHING),
        (states.DEFOCUSED, states.STOWING, states.STOWED),
        SOON,
    ),
    "STOW": (
        (states.APPROACHING, states.IDLE, states.TRACKING, states.SEARCHING, states.DEFOCUSED),
        (states.STOWED,),
        STOW_WITHIN,
    ),
}
#: Orders that require the path from stow, and orders that change neither state nor motion.
_BY_WAY = ("TRACK", "REFOCUS", "SEARCH")
_ASIDE = ("AIM", "STANDBY", "ROUGH", "LOCK_AIM")
#: Orders after which an IDLE heliostat is not at its standby point.
_ELSEWHERE = ("JOG", "GOTO", "DIAGNOSE", "UNLOCK", "CLEAR_FAULT", "LOCK", "ZERO")
#: States in which a heliostat works until ordered otherwise, and states that it must not fall into.
_WORKS = (states.APPROACHING, states.IDLE, states.TRACKING, states.SEARCHING)
_FALLS = (states.DEFOCUSED, states.STOWING, states.STOWED, states.FAULT)
#: Items of a board that must be the heliostat's own if its work is to be judged.
_OWN = ("location", "armature", "drives", "limits_primary", "limits_secondary")


@dataclass
class _Order:
    """An order that must be carried out: its final states, its time limit, and when it was done."""

    identity: str
    name: str
    at: float
    ends: tuple[int, ...]
    within: float
    done_at: float | None = None


@dataclass
class _Mirror:
    """One heliostat: the observer's record of it, its expected state, and when it last changed."""

    account: HeliostatAccount
    cluster: str
    order: _Order | None = None
    ordered_at: float = -inf
    aim: tuple[float, ...] | None = None
    standby: tuple[float, ...] | None = STANDBY
    pointed_at: float = -inf
    due_at: float = inf
    state: int = -1
    since: float = -inf
    node: Node | None = None
    booted_at: float = -inf
    elsewhere: bool = False
    own: dict[str, bytes] = field(default_factory=dict)
    off_since: float | None = None
    quiet_since: float = inf
    sure_since: float = inf

    @property
    def name(self) -> str:
        """Name of the heliostat."""
        return self.account.name


class QuietObserver(Judge):
    """Observes the work in undisturbed periods; see the module.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    clusters
        Observers of the clusters, by name.
    sun
        Function that returns the true direction to the sun, (3,), at a time in s.
    reaches
        Whether every heliostat can reach its points throughout the run.
    near
        Largest distance of a beam from its point, as a fraction of the beam's length, rad.

    """

    def __init__(
        self,
        start: float,
        clusters: Mapping[str, Observer],
        sun: Callable[[float], FloatArray],
        *,
        reaches: bool,
        near: float = NEAR,
    ) -> None:
        super().__init__(start)
        self._sun, self._reaches, self._near = sun, reaches, near
        self._clusters = clusters
        self._mirrors = {
            account.name: _Mirror(account, cluster)
            for cluster, observer in clusters.items()
            for account in observer.accounts
        }
        for mirror in self._mirrors.values():
            outfit = mirror.account.board.outfit
            items = items_of(outfit.mechanism, outfit.machine)
            mirror.own = {name: items[name] for name in _OWN if name in items}
        self._quiet: frozenset[str] = frozenset()
        self._refusals: list[tuple[_Mirror, bool, str]] = []
        self._alarms: dict[tuple[str, str], str] = {}
        self._named_at: dict[str, float] = {}
        self._token, self._token_at = 0, -inf

    def _calmly(self, good: bool, now: float, mirror: _Mirror, saw: str) -> None:
        state = states.STATES[mirror.state]
        self.check(16, good, now, mirror.name, f"{state} in a quiet stretch: {saw}")

    @property
    def stretches(self) -> frozenset[str]:
        """Heliostats that are in an undisturbed period."""
        return self._quiet

    def calm(self) -> frozenset[str]:
        """Return the heliostats that are in an undisturbed period."""
        return self._quiet

    # -- orders and reports ------------------------------------------------------------------

    def on_lease(self, token: int, now: float) -> None:
        """Record a lease that has left the plant."""
        if token != self._token:
            self._token, self._token_at = token, now

    def on_command(self, message: Command, heliostats: Sequence[str], now: float) -> None:
        """Record a command that has left the plant."""
        for name in heliostats:
            mirror = self._mirrors[name]
            if message.name in ("AIM", "STANDBY"):
                self._pointed(mirror, message, now)
            if message.name in _ASIDE:
                continue
            begins, ends, within = ORDERS.get(message.name, ((), (), 0.0))
            may = mirror.state in begins and self._commands(message, now)
            if message.name in _BY_WAY:
                may &= mirror.account.by_way and mirror.aim is not None
            if message.name == "IDLE" and mirror.state == states.DEFOCUSED:
                may &= mirror.account.by_way  # it would hold wherever its beam is: refused
            mirror.elsewhere |= message.name in _ELSEWHERE
            # What is refused by the state table leaves an approach alone.
            if mirror.state == states.APPROACHING and message.name in ("APPROACH", *_BY_WAY):
                continue
            self._expect(mirror, may, _Order(message.identity, message.name, now, ends, within))

    def _commands(self, message: Command, now: float) -> bool:
        """Return whether the clusters must already know the authority that a command carries."""
        return message.token == self._token != 0 and now - self._token_at > GRANTED

    def on_emergency(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Record a DEFOCUS or STOW from the plant."""
        begins, ends, within = SAFE_ORDERS[name]
        for heliostat in heliostats:
            mirror = self._mirrors[heliostat]
            before = mirror.order
            if name == "DEFOCUS" and before is not None and before.name == "STOW":
                continue  # a stow is not undone by a defocus
            self._expect(mirror, mirror.state in begins, _Order("", name, now, ends, within))

    def _expect(self, mirror: _Mirror, may: bool, order: _Order) -> None:
        crosses = order.at - mirror.ordered_at < CROSSING
        mirror.ordered_at = order.at
        known = mirror.account.board.node
        able = known is not None and known.controller.motion.known and known.journal.doubt == 0
        may &= able and not crosses and mirror.name in self._quiet and self._is_own(mirror)
        mirror.order = order if may else None

    def _pointed(self, mirror: _Mirror, message: Command, now: float) -> None:
        """Record a new point; it counts as unknown if the cluster or the board may refuse it."""
        mirror.pointed_at = now
        taken = mirror.name in self._quiet and mirror.state not in (
            states.APPROACHING, states.SEARCHING, states.STOWING,
        )  # fmt: skip
        point = message.values if taken and self._commands(message, now) else None
        if message.name == "AIM":
            mirror.aim = point
        else:
            mirror.standby = point

    def on_refused(
        self, person: Person, token: int, asked: tuple[str, Sequence[str]], reason: str, now: float
    ) -> None:
        """Record the reason why a command to one heliostat is refused, if it can be checked here.

        The reason is judged at the next look, which knows of a fault that has just begun.
        """
        del person, token
        heliostat = asked[1][0] if len(asked[1]) == 1 else ""
        if heliostat not in self._quiet:
            return
        mirror = self._mirrors[heliostat]
        calm = now - mirror.quiet_since
        saw = f"refused: {reason}; it has been quiet for {calm:.0f} s"
        good = True
        if UNHEARD_REASON in reason:
            good = calm <= UNHEARD_FOR
        elif UNCOMPARED_REASON in reason:
            good = calm <= UNCOMPARED_FOR
        elif DOUBT_REASON in reason:
            sure = now - mirror.sure_since
            saw = f"refused: {reason}; its step counts have been certain for {sure:.0f} s"
            good = sure <= STATUS_EVERY
        self._refusals.append((mirror, good, saw))

    def on_progress(self, message: Progress, now: float) -> None:
        """Record that the plant was told that orders are done."""
        del now
        if message.stage is Stage.DONE:
            for name in message.heliostats:
                order = self._mirrors[name].order if name in self._mirrors else None
                if order is not None and order.identity == message.identity:
                    order.identity = ""

    def on_alarm(self, alarm: Alarm, now: float) -> None:
        """Record an alarm of the plant; the heliostats that it names need not work."""
        del now
        key = alarm.condition, alarm.subject
        if alarm.active:
            self._alarms[key] = alarm.subject
        else:
            self._alarms.pop(key, None)

    def on_end(self, now: float) -> None:
        """Record that the plant program, and its alarms with it, has ended."""
        del now
        self._alarms.clear()

    # -- judgement ---------------------------------------------------------------------------

    def look(
        self,
        plant: PlantController | None,
        carried: Set[str],
        rest: Mapping[str, float],
        now: float,
    ) -> None:
        """Judge all work.

        Parameters
        ----------
        plant
            The plant; None if it is not running.
        carried
            Clusters that the plant can reach.
        rest
            When the last fault affecting each heliostat ended, s.
        now
            s.
        """
        sun = self._sun(now)
        quiet = set()
        self._named_at.update(dict.fromkeys(self._alarms.values(), now))
        for mirror in self._mirrors.values():
            before = mirror.state
            self._notes(mirror, now)
            named = (self._named_at.get(subject, -inf) for subject in (mirror.name, mirror.cluster))
            calm = now - max(rest[mirror.name], mirror.booted_at, *named) > SETTLED
            if plant is None or mirror.cluster not in carried or mirror.state < 0 or not calm:
                mirror.order = mirror.off_since = None
                mirror.quiet_since = inf
                continue
            mirror.quiet_since = min(mirror.quiet_since, now)
            if mirror.name in self._quiet:
                self._served(mirror, now)
                self._carried_out(mirror, now)
                self._stays(mirror, before, now)
                self._on_point(mirror, sun, now)
                self._proven(mirror, plant, sun, now)
            quiet.add(mirror.name)
        self._quiet = frozenset(quiet)
        self._reasoned(now)

    def _reasoned(self, now: float) -> None:
        """Judge the reasons for refusals since the last look, if nothing has failed since then."""
        refusals, self._refusals = self._refusals, []
        for mirror, good, saw in refusals:
            if mirror.name in self._quiet:
                self._calmly(good, now, mirror, saw)

    def _notes(self, mirror: _Mirror, now: float) -> None:
        board = mirror.account.board
        if board.node is not mirror.node:
            mirror.node, mirror.booted_at, mirror.aim = board.node, now, None
        if board.state != mirror.state:
            mirror.state, mirror.since = board.state, now
        if mirror.state not in (states.IDLE, states.FAULT, states.LOCKED):
            mirror.elsewhere = False
        sure = board.node is not None and board.node.journal.doubt == 0
        mirror.sure_since = min(mirror.sure_since, now) if sure else inf

    def _is_own(self, mirror: _Mirror) -> bool:
        node = mirror.account.board.node
        held = {} if node is None else node.journal.items
        return all(held.get(name) == value for name, value in mirror.own.items())

    def _served(self, mirror: _Mirror, now: float) -> None:
        """Check that SUN and STATUS arrive at their rates."""
        account = mirror.account
        age = now - account.sun_at
        saw = f"the last sun has reached it {age:.1f} s ago, limit {SUN_EVERY:g} s"
        self._calmly(age <= SUN_EVERY, now, mirror, saw)
        age = now - (account.statuses[-1][0] if account.statuses else -inf)
        saw = f"its cluster last received its state {age:.1f} s ago, limit {STATUS_EVERY:g} s"
        self._calmly(age <= STATUS_EVERY, now, mirror, saw)

    def _told_off(self, mirror: _Mirror) -> float:
        """Return when the cluster last sent DEFOCUS or STOW to a heliostat, s."""
        safe = self._clusters[mirror.cluster].frames.safe
        never = -inf
        return max(safe.get(mirror.account.address, never), safe.get(wire.BROADCAST, never))

    def _carried_out(self, mirror: _Mirror, now: float) -> None:
        """Check that an order is carried out by its deadline and that the plant is notified."""
        order = mirror.order
        if order is None:
            return
        ordinary = order.name in ORDERS
        # A heliostat that turned away without following the sun stows by itself, despite commands.
        void = ordinary and order.name != "APPROACH" and mirror.state == states.STOWING
        void |= ordinary and now - self._token_at < GRANTED
        if void or (ordinary and self._told_off(mirror) >= order.at):
            mirror.order = None
            return
        if order.done_at is None:
            if mirror.state in order.ends:
                order.done_at = now
            passed = now - order.at
            saw = f"{order.name} was ordered {passed:.1f} s ago, limit {order.within:g} s"
            self._calmly(passed <= order.within, now, mirror, saw)
            return
        if mirror.state not in order.ends:
            mirror.order = None
            return
        passed = now - order.done_at
        saw = f"{order.name} was done {passed:.1f} s ago, but the plant has received no report"
        self._calmly(not order.identity or passed <= TOLD_WITHIN, now, mirror, saw)

    def _stays(self, mirror: _Mirror, before: int, now: float) -> None:
        """Check that a heliostat does not stop working by itself."""
        falls = before in _WORKS and mirror.state in _FALLS
        if falls and self._reaches and self._is_own(mirror):
            passed = now - self._told_off(mirror)
            saw = f"it has left {states.STATES[before]} by itself"
            self._calmly(passed <= CROSSING, now, mirror, saw)

    def _on_point(self, mirror: _Mirror, sun: FloatArray, now: float) -> None:
        """Check that the beam is at its aim or standby point, according to the steps made."""
        tracks = mirror.state == states.TRACKING
        point = mirror.aim if tracks else mirror.standby
        stands = mirror.state == states.IDLE and mirror.account.by_way and not mirror.elsewhere
        settled = now - max(mirror.pointed_at, mirror.since, mirror.ordered_at) > ON_POINT_WITHIN
        if not (tracks or stands) or point is None or not settled or not self._is_own(mirror):
            mirror.due_at = inf
            return
        board = mirror.account.board
        goal = (point[0], point[1], point[2])
        miss = board.miss(sun, goal, believed=True)
        far = float(np.linalg.norm(np.subtract(goal, board.outfit.mechanism.position)))
        limit = self._near * far + NEAR_M
        if miss <= limit:
            mirror.due_at = inf
        elif mirror.due_at == inf:
            mirror.due_at = now + slew(board, sun, goal)
        saw = f"its beam is {miss:.2f} m from its point, limit {limit:.2f} m"
        self._calmly(miss <= limit or now < mirror.due_at, now, mirror, saw)

    def _proven(self, mirror: _Mirror, plant: PlantController, sun: FloatArray, now: float) -> None:
        """Check that an emergency order that was carried out is also confirmed as done."""
        order = plant.sentinel.order if plant.sentinel.on else None  # not if withdrawn
        if order is None or not self._is_own(mirror):
            mirror.off_since = None
            return
        off = mirror.state == states.DEFOCUSED and mirror.account.board.miss(sun, RECEIVER) > OFF
        if order.act is Act.STOW:
            off = mirror.state == states.STOWED
        if not off:
            mirror.off_since = None
            return
        mirror.off_since = now if mirror.off_since is None else mirror.off_since
        passed = now - max(mirror.off_since, order.at)
        saw = f"{order.act.name} was done {passed:.1f} s ago, but is not proven for it"
        self._calmly(passed <= PROVEN_WITHIN or order.is_done(mirror.name), now, mirror, saw)
