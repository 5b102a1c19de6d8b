"""The observer of beams: the true beam of each heliostat compared with its intended position.

It knows the true heliostat (mechanism, joints, sun vector) and the orders that left the plant, each
for a heliostat by name. Apart from the name of a board's state it uses nothing from the code under
test, so an error in clock, site, armature, address or step counts appears as a beam that is off its
position. The observer checks invariants 12 to 15.
"""

import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.lcu import states
from heliotrope.lcu.node import Node
from heliotrope.links.messages import ClusterStatus, Command, Progress, Stage
from heliotrope.mechanism.tracking import TrackingStatus, track
from heliotrope.plant.controller import PlantController
from heliotrope.plant.emergency import EmergencyOrder
from heliotrope.plant.orders.authority import Person
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import Act, Alarm, alarms
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.outfit import LIMITS, RANGES, RECEIVER, STANDBY, Ball
from heliotrope.twin.invariants._account import NEAR_STOW, steps_from_stow
from heliotrope.twin.invariants.invariants import OFF, Judge

Point = tuple[float, ...]

#: A beam this far from its commanded point is astray, m. Backlash, coarse steps, pushed biases and
#: drifting clocks stay below this distance at 130 m.
ASTRAY = 1.5
#: Time that a heliostat has to reach its commanded position after an order or a change of state, s.
SETTLE = 10.0
#: An alarm names an astray beam, and the beam is off, within these times, s, plus the time that the
#: drives need to bring it to its point; see `slew`.
NAMED_WITHIN, OFF_WITHIN = 10.0, 30.0
#: A heliostat that is done is off the receiver or at stow this long after the confirmation, s.
DONE_WITHIN = 5.0
#: Heliostats that leave within this time leave together, s; orders no older than this explain it.
TOGETHER = 10.0
#: Longest time from sending an order to join to its execution, s: its lifetime plus delay on the
#: bus.
UNDER_WAY = 5.0
#: A status waits up to a second, and may be in transit for another, s.
TOLD_WITHIN = 2.2
#: Period within which automatic control must count losses together, s: its 30 s less its delay.
LOST_TOGETHER = 15.0
#: After this many reports that include a board, automatic control knows its state.
REPORTS = 5
#: A report includes a board if its reply is no older than this, s.
_HEARD = 1.5
#: Half angle of the simulated operators' largest search, rad.
_SEARCH = 8e-3
#: Beam error of heliostats about which the plant file is wrong, until they are calibrated, rad:
#: twice that of their normals.
UNSURVEYED = 45e-3
#: From this number on, heliostats must not all turn away by the same angles.
_MANY = 3
#: States in which a beam is sent to a point.
_LIT = {states.TRACKING: "aims", states.SEARCHING: "aims", states.IDLE: "standbys"}
_ON = (states.TRACKING, states.SEARCHING)
#: States from which automatic control may lose a heliostat.
_UP = (states.APPROACHING, states.IDLE, *_ON)
#: States in which a heliostat stands where an operator has left it.
_HELD = (states.LOCKED, states.UNCONFIGURED)
#: Commands that leave an idle heliostat away from its standby point.
_ELSEWHERE = ("JOG", "GOTO", "DIAGNOSE", "UNLOCK", "CLEAR_FAULT", "LOCK", "ZERO")
#: Commands that take a heliostat off the receiver, and commands that resume.
_TAKES_OFF = ("IDLE", "LOCK")
_RESUMES = ("TRACK", "REFOCUS", "SEARCH")
#: Commands that send a beam to a point, and states from which IDLE needs such a point.
_CALLS = ("APPROACH", "IDLE", *_RESUMES)
_AWAY = (states.STOWED, states.DEFOCUSED)


@dataclass
class _Mirror:
    """One heliostat as the observer knows it.

    Attributes
    ----------
    aims, standbys
        Order identities with their points: the last point reported as done, and all later points.
    state, node, settled_at
        Last state and program seen; when it must have reached its commanded position, s.
    elsewhere, approached
        Whether its last motion went to given step counts and not to its standby point; whether it
        has reached its standby point along the path from stow since it last was without power or at
        stow.
    astray_since, lit_since, inside_since
        Since when its beam has been off its position, on the receiver without an order, or inside a
        volume, s.
    due_at
        Earliest time at which the drives can have brought its stray beam to its position, s.
    named_at
        When an alarm last named it, s.
    ordered_at, off_at, resumed_at
        When the plant last sent it any order; when the plant last ordered it off the receiver; when
        an operator last sent it to the receiver, s.
    lost_at
        When it last left TRACKING or SEARCHING without an order, s.
    assigned, assigned_at
        Whether an operator has put it under automatic control, and since when, s.
    up, changed_at, reports, seen_up
        Whether it is up, since when, s, and how many reports have said so; whether automatic
        control has seen it up since the plant last took it off the receiver.
    called_at, uncalled
        When the plant last sent its beam to a point, s; whether the beam went to a point without an
        order.
    shines_since
        Since when its beam is on the receiver while an emergency holds, s.
    """

    board: Board
    cluster: str
    aims: deque[tuple[str, Point]] = field(default_factory=lambda: deque(maxlen=40))
    standbys: deque[tuple[str, Point]] = field(default_factory=lambda: deque(maxlen=40))
    state: int = -1
    node: Node | None = None
    settled_at: float = float("-inf")
    elsewhere: bool = False
    approached: bool = False
    astray_since: float | None = None
    lit_since: float | None = None
    inside_since: float | None = None
    due_at: float = float("-inf")
    named_at: float = float("-inf")
    ordered_at: float = float("-inf")
    off_at: float = float("-inf")
    resumed_at: float = float("-inf")
    lost_at: float = float("-inf")
    assigned: bool = False
    assigned_at: float = float("-inf")
    up: bool = False
    changed_at: float = float("-inf")
    reports: int = 0
    seen_up: bool = False
    called_at: float = float("-inf")
    uncalled: bool = False
    shines_since: float | None = None

    @property
    def name(self) -> str:
        """Name of the heliostat."""
        return self.board.outfit.name

    @property
    def elsewhere_idle(self) -> bool:
        """Whether the heliostat is IDLE and holds still, in any position."""
        return self.state == states.IDLE and (self.elsewhere or not self.approached)


def slew(board: Board, sun: FloatArray, point: Point) -> float:
    """Return the shortest time in which the drives can bring a beam to a point, s.

    The time is 0 if the point is out of reach.

    Near the zenith, in the keyhole, a small beam movement takes half a turn of the azimuth, or more
    if a stop blocks the shorter direction. Two poses reach the point; the result is for the pose
    that the true heliostat reaches sooner, at the boards' lowest rate and with the ramp.
    """
    mechanism, (rate, acceleration, _) = board.outfit.mechanism, LIMITS
    low, high = np.transpose(RANGES)
    drives = mechanism.drives.replace(min_count=low, max_count=high)
    counts = np.array([axis.turned for axis in board.axes], dtype=np.float64)
    solution = track(mechanism, sun, point, drives=drives, current=counts)
    if solution.chosen(solution.status) != TrackingStatus.OK:
        return 0.0
    return float(np.abs(solution.best_counts - counts).max()) / rate + rate / acceleration


def _since(holds: bool, before: float | None, now: float) -> float | None:
    return None if not holds else now if before is None else before


class BeamObserver(Judge):
    """Observes beams, alarms and confirmations.

    Parameters
    ----------
    start
        Origin of the times that it reports, s.
    boards
        Boards by cluster name.
    sun
        Function that returns the true direction to the sun, (3,), at a time in s.
    keep_outs
        Spheres that no beam may enter.
    losses
        Number of heliostats that automatic control may lose together and raise again without an
        operator; None: only operators command.
    unsurveyed
        Heliostats about which the plant file is wrong. Until they are calibrated, their beams may
        be off by as much as that error causes.

    Attributes
    ----------
    losses
        Number of losses after which the field waits for an operator.
    proofs
        Number of emergency orders that every heliostat was confirmed to have carried out.
    contradicted
        Whether a witness contradicts the time that plant and clusters share. In that case no
        heliostat may join the receiver, and the positions of idle beams are unknown. Set by the
        owner.
    """

    def __init__(
        self,
        start: float,
        boards: Mapping[str, Sequence[Board]],
        sun: Callable[[float], FloatArray],
        keep_outs: Sequence[Ball],
        losses: int | None = None,
        unsurveyed: Collection[str] = (),
    ) -> None:
        super().__init__(start)
        self.losses = 0
        self._sun, self._most = sun, losses
        self._keep_outs, self._unsurveyed = tuple(keep_outs), set(unsurveyed)
        self._mirrors = {
            board.outfit.name: _Mirror(board, cluster)
            for cluster, some in boards.items()
            for board in some
        }
        for mirror in self._mirrors.values():
            mirror.standbys.append(("", STANDBY))
        self._alarms: dict[tuple[str, str], tuple[float, bool]] = {}
        self._departures: deque[tuple[float, str]] = deque(maxlen=64)
        self._lost_at = self._lost_known_at = self._released_at = float("-inf")
        self._proved: dict[tuple[str, str], float] = {}
        self._stalled, self._exchanged = set[str](), set[str]()
        self.proofs, self._complete_order, self.contradicted = 0, "", False

    # -- orders, reports and alarms ----------------------------------------------------------

    def on_command(self, message: Command, heliostats: Sequence[str], now: float) -> None:
        """Record a command that has left the plant."""
        for name in heliostats:
            mirror = self._mirrors[name]
            mirror.ordered_at = now
            if message.name in _TAKES_OFF:
                mirror.off_at = now
            if message.name in _CALLS:
                mirror.called_at, mirror.uncalled = now, False
            if message.name in ("AIM", "STANDBY"):
                mirror.settled_at = max(mirror.settled_at, now + SETTLE)
            if message.name == "AIM":
                mirror.aims.append((message.identity, message.values))
            elif message.name == "STANDBY":
                mirror.standbys.append((message.identity, message.values))
            elif message.name in _ELSEWHERE:
                mirror.elsewhere = True

    def on_emergency(self, name: str, heliostats: Sequence[str], now: float) -> None:
        """Record a DEFOCUS or STOW from the plant."""
        del name
        for heliostat in heliostats or self._mirrors:
            mirror = self._mirrors[heliostat]
            mirror.ordered_at = mirror.off_at = now
            mirror.seen_up &= not mirror.up  # it leaves because of this order, so it is not lost
            if mirror.state == states.LOCKED:  # it has left once unlocked, unless IDLE
                mirror.reports = 0

    def on_accepted(
        self, person: Person, token: int, ticket: Ticket, what: str, now: float
    ) -> None:
        """Record an operator command that the plant has accepted."""
        del person, token
        if what not in ("ROUGH", "PARAMETERS"):
            self.resumed(ticket.heliostats, what, now)

    def on_safe(self, person: Person, ticket: Ticket, what: str, now: float) -> None:
        """Record an operator's DEFOCUS or STOW, which ends automatic control of its heliostats."""
        del person, what, now
        self.taken(ticket.heliostats)

    def on_call(self, owner: str, act: Act, now: float) -> None:
        """Record an operator's emergency, which removes all heliostats from automatic control."""
        del owner, act, now
        self.taken(self._mirrors)

    def resumed(self, heliostats: Iterable[str], what: str, now: float) -> None:
        """Record an operator command that the plant has accepted."""
        self.taken(heliostats)
        if what in _RESUMES:
            for name in heliostats:
                self._mirrors[name].resumed_at = now

    def taken(self, heliostats: Iterable[str]) -> None:
        """Record that an operator commands heliostats; automatic control may not move them now."""
        for name in heliostats:
            self._mirrors[name].assigned = False

    def given(self, heliostats: Iterable[str], now: float) -> None:
        """Record that an operator puts heliostats under automatic control, with no losses yet."""
        for name in heliostats:
            mirror = self._mirrors[name]
            if not mirror.assigned:
                mirror.assigned, mirror.assigned_at = True, now

    def released(self, now: float) -> None:
        """Record that an operator lets automatic control resume after a loss."""
        self._departures.clear()
        self._released_at = now
        for mirror in self._mirrors.values():
            mirror.resumed_at = now
            if mirror.board.state not in _UP:  # it left since the last check: lost before
                mirror.seen_up = False

    def on_status(self, status: ClusterStatus, names: Sequence[str], now: float) -> None:
        """Record a report to the plant, the only source of what automatic control can know.

        The true states determine which heliostats are lost; the report only determines since when
        automatic control knows.
        """
        for name, row in zip(names, status.nodes(), strict=True):
            mirror, age = self._mirrors.get(name), 1e-3 * int(row["heard_ms"])
            if mirror is None:
                continue  # the cluster's file does not name it
            locked = mirror.state == states.LOCKED
            if not locked and age <= _HEARD and now - age >= mirror.changed_at:
                mirror.reports += 1
                if mirror.reports == REPORTS:
                    self._known(mirror, now)

    def _known(self, mirror: _Mirror, now: float) -> None:
        """Record that automatic control now knows whether a heliostat is up."""
        lost, mirror.seen_up = mirror.seen_up and not mirror.up, mirror.up
        at = mirror.changed_at
        lost = lost and mirror.assigned and at >= max(mirror.assigned_at, self._released_at)
        if self._most is None or not lost:
            return
        self._departures.append((at, mirror.name))
        together = [
            departure for departure in self._departures if abs(departure[0] - at) <= LOST_TOGETHER
        ]
        if len({name for _, name in together}) > self._most:
            self._lost_at, self._lost_known_at = max(together)[0], now
            self.losses += 1

    def on_progress(self, message: Progress, now: float) -> None:
        """Drop all points older than the point that is reported as done."""
        del now
        if message.stage is not Stage.DONE:
            return
        for name in message.heliostats:
            mirror = self._mirrors.get(name)
            for points in () if mirror is None else (mirror.aims, mirror.standbys):
                if any(identity == message.identity for identity, _ in points):
                    while points[0][0] != message.identity:
                        points.popleft()

    def on_alarm(self, alarm: Alarm, now: float) -> None:
        """Record an alarm of the plant."""
        self._alarms[alarm.condition, alarm.subject] = (now, alarm.active)

    def stalled(self, heliostat: str) -> None:
        """Record that a drive has stalled, which only the flux reveals.

        The heliostat is then exempt, except when all heliostats are confirmed as done.
        """
        self._stalled.add(heliostat)

    def exchanged(self, heliostat: str) -> None:
        """Record that a heliostat has another's board, so its beam position is unknown."""
        self._exchanged.add(heliostat)

    def on_end(self, now: float) -> None:
        """Record that the plant program, and its alarms with it, has ended.

        The next program must name each heliostat with doubtful step counts again, within the usual
        time.
        """
        del now
        for mirror in self._mirrors.values():
            if self._doubted(mirror):
                mirror.astray_since = None
        self._alarms.clear()
        self._proved.clear()
        self._departures.clear()
        for mirror in self._mirrors.values():
            mirror.assigned = mirror.seen_up = False
            mirror.reports = 0

    # -- judgement ---------------------------------------------------------------------------

    def look(self, plant: PlantController | None, carried: Set[str], now: float) -> None:
        """Check all beams.

        Parameters
        ----------
        plant
            The plant; None if it is not running.
        carried
            Clusters that the plant can reach.
        now
            s.
        """
        sun = self._sun(now)
        named = {subject for (_, subject), (_, active) in self._alarms.items() if active}
        on = 0
        for mirror in self._mirrors.values():
            if mirror.cluster not in carried or named & {mirror.name, mirror.cluster}:
                mirror.named_at = now
            if mirror.node is not mirror.board.node:  # it was without power, however briefly
                mirror.node, mirror.approached = mirror.board.node, False
            self._enters(mirror, mirror.board.state, now)
            on += mirror.state in _ON
            if mirror.state not in (-1, states.LOCKED) and (mirror.state in _UP) != mirror.up:
                mirror.up, mirror.changed_at, mirror.reports = not mirror.up, now, 0
            if mirror.state < 0:
                mirror.astray_since = mirror.lit_since = mirror.inside_since = None
                continue
            if self.contradicted or mirror.name in self._exchanged:
                self._stays_off(mirror, now)
            elif mirror.name not in self._stalled:
                self._placed(mirror, sun, now)
                self._dark(mirror, sun, now)
        if self._most is None:
            self._loss(on, now)
        if plant is not None:
            beliefs = plant.beliefs
            # Parameters that an operator has set say nothing about the other heliostats.
            records = {name: beliefs.record(name) for name in self._unsurveyed}
            self._unsurveyed = {n for n, r in records.items() if r is None or not len(r.sightings)}
            if plant.sentinel.on:  # automatic control has released the field
                self.taken(self._mirrors)
            self._proofs(plant, sun, now)

    def _stays_off(self, mirror: _Mirror, now: float) -> None:
        """Check that no heliostat tracks on a wrong sun direction or another's parameters."""
        node, own = mirror.node, mirror.board.outfit.items["armature"]
        foreign = node is not None and node.journal.items.get("armature") != own
        by = "a contradicted sun position" if self.contradicted else "another mirror's parameters"
        # On its way to a target, its beam may reveal the sun position.
        points = [point for _, point in mirror.aims] or [RECEIVER]
        joins = self.contradicted and any(math.dist(point, RECEIVER) <= OFF for point in points)
        good = mirror.state not in _ON or not (foreign or joins)
        self.check(12, good, now, mirror.name, f"{states.STATES[mirror.state]}, by {by}")

    def _enters(self, mirror: _Mirror, state: int, now: float) -> None:
        """Record a new state."""
        before, mirror.state = mirror.state, state
        if state == before:
            return
        mirror.settled_at = max(mirror.settled_at, now + SETTLE)
        if (before, state) == (states.APPROACHING, states.IDLE):
            mirror.approached = True
        elif state in (-1, states.STOWED, states.STOWING):
            mirror.approached = False
        if state not in (states.IDLE, states.FAULT, *_HELD):
            mirror.elsewhere = False
        if state not in (states.APPROACHING, *_LIT):
            mirror.uncalled = False
        elif state != states.IDLE or before in _AWAY:
            mirror.uncalled = now - mirror.called_at > TOGETHER
        if state == states.DEFOCUSED:
            self._parted(mirror, now)
        if state in _ON and before not in _ON:
            self._returns(mirror, now)
        elif before in _ON and state not in _ON and now - mirror.off_at > TOGETHER:
            mirror.lost_at = now
            if self._most is None:
                self._departures.append((now, mirror.name))

    def _parted(self, mirror: _Mirror, now: float) -> None:
        """Check that beams do not all turn away alike, which would make a hot spot elsewhere."""
        aside = [m.node for m in self._mirrors.values() if m.board.state == states.DEFOCUSED]
        turns = [node.journal.items.get("defocus") for node in aside if node is not None]
        known = [turn for turn in turns if turn is not None]
        saw = f"{len(known)} heliostats turned away by the same angles"
        self.check(13, len(known) < _MANY or len(set(known)) > 1, now, mirror.name, saw)

    def _returns(self, mirror: _Mirror, now: float) -> None:
        """Check that a heliostat lost from the receiver returns only on an operator's order."""
        known = self._lost_at + TOLD_WITHIN if self._most is None else self._lost_known_at
        losses = [(self._lost_at, known, "the field")]
        if self._most is None:
            losses.append((mirror.lost_at, mirror.lost_at + TOLD_WITHIN, "this mirror"))
        for lost_at, known_at, whose in losses:
            saw = (
                f"{states.STATES[mirror.state]} {now - lost_at:.1f} s after the loss of "
                f"{whose}, with no command from a person since"
            )
            # An order that was sent before the plant could know of the loss cannot be recalled.
            unknowing = mirror.called_at <= known_at
            late = unknowing and now - mirror.called_at <= UNDER_WAY
            good = late or mirror.resumed_at >= lost_at
            self.check(14, good, now, mirror.name, saw)

    def _placed(self, mirror: _Mirror, sun: FloatArray, now: float) -> None:
        """Check that a beam sent to a point is there; otherwise an alarm names it and it is off.

        A heliostat at standby is off if its beam is neither on the receiver nor in a volume. If its
        step counts are wrong, no order can bring it to a better position, so only an active alarm
        is required. Other alarms about standby have a better remedy.
        """
        sent = _LIT.get(mirror.state)
        if sent is None or (mirror.elsewhere_idle and not mirror.uncalled):
            mirror.astray_since = None
            return
        points = [] if mirror.uncalled else [point for _, point in getattr(mirror, sent)]
        slack = ASTRAY
        if mirror.state == states.SEARCHING:
            slack += _SEARCH * 150.0
        if mirror.name in self._unsurveyed:
            slack += UNSURVEYED * 150.0
        miss = min(
            (mirror.board.miss(sun, (p[0], p[1], p[2])) for p in points), default=float("inf")
        )
        stray = mirror.uncalled or (miss > slack and now >= mirror.settled_at)
        if stray and mirror.astray_since is None:
            mirror.due_at = now + max((slew(mirror.board, sun, p) for p in points), default=0.0)
        mirror.astray_since = _since(stray, mirror.astray_since, now)
        state, since = states.STATES[mirror.state], mirror.astray_since
        since = None if since is None else max(since, mirror.due_at)
        passed = 0.0 if since is None else now - since
        where = "where nobody sent it" if not points else f"{miss:.1f} m from where it was sent"
        beside = f"{state}, its beam {where} for {passed:.1f} s"
        unnamed = 0.0 if since is None else now - max(since, mirror.named_at)
        saw = f"{beside}, and no alarm names it"
        self.check(12, unnamed <= NAMED_WITHIN, now, mirror.name, saw)
        off = (
            self._doubted(mirror) and mirror.state == states.IDLE and not self._lights(mirror, sun)
        )
        self.check(12, off or passed <= OFF_WITHIN, now, mirror.name, beside)

    def _doubted(self, mirror: _Mirror) -> bool:
        """Return whether an alarm names a heliostat because of its step counts."""
        return self._alarms.get((alarms.COUNTS_DOUBTFUL.name, mirror.name), (0.0, False))[1]

    def _lights(self, mirror: _Mirror, sun: FloatArray) -> bool:
        """Return whether a beam is on the receiver or inside a keep-out volume."""
        inside = any(mirror.board.miss(sun, at) <= radius for at, radius in self._keep_outs)
        return inside or mirror.board.miss(sun, RECEIVER) <= OFF

    def _dark(self, mirror: _Mirror, sun: FloatArray, now: float) -> None:
        """Check that a beam leaves the receiver or a volume if nobody sent it there."""
        board, sent = mirror.board, mirror.state in _ON
        shines = not sent and board.miss(sun, RECEIVER) <= OFF
        mirror.lit_since = _since(shines, mirror.lit_since, now)
        inside = any(board.miss(sun, middle) <= radius for middle, radius in self._keep_outs)
        mirror.inside_since = _since(inside, mirror.inside_since, now)
        state = states.STATES[mirror.state]
        for since, where in (
            (mirror.lit_since, "on the receiver, where nobody sent it"),
            (mirror.inside_since, "inside a keep-out volume"),
        ):
            passed = 0.0 if since is None else now - since
            saw = f"{state}, its beam {where} for {passed:.1f} s"
            self.check(13, passed <= OFF_WITHIN, now, mirror.name, saw)

    def _loss(self, on: int, now: float) -> None:
        """Record a loss that took every heliostat (at least two) off the receiver."""
        while self._departures and now - self._departures[0][0] > TOGETHER:
            self._departures.popleft()
        if on == 0 and len({name for _, name in self._departures}) >= 2:
            self._departures.clear()
            self._lost_at = now
            self.losses += 1

    def _proofs(self, plant: PlantController, sun: FloatArray, now: float) -> None:
        """Check that a heliostat confirmed as done is truly off the receiver or at stow."""
        order = plant.sentinel.order
        if order is None:
            return
        self._complete(order, sun, now, holds=plant.sentinel.on)
        for mirror in self._mirrors.values():
            key = (order.ticket.identity, mirror.name)
            if key not in self._proved:
                if not order.is_done(mirror.name):
                    continue
                self._proved[key] = now
            begin, board = self._proved[key], mirror.board
            if begin == float("inf"):
                continue
            away = (
                mirror.state < 0
                or mirror.name in self._stalled | self._exchanged
                or mirror.ordered_at > order.at + 1.0
            )
            if order.act is Act.STOW:
                off = steps_from_stow(board)
                saw, good = f"{off} steps from stow", off <= NEAR_STOW
            else:
                miss = board.miss(sun, RECEIVER)
                saw, good = f"{miss:.1f} m from the middle of the receiver", miss > OFF
            if good or away:
                self._proved[key] = float("inf")
                good = True
            saw = f"{order.act.name} is reported as proven for it, but its beam or mirror is {saw}"
            self.check(15, good or now - begin <= DONE_WITHIN, now, mirror.name, saw)

    def _complete(self, order: EmergencyOrder, sun: FloatArray, now: float, *, holds: bool) -> None:
        """Check that beams confirmed as done, one by one or all together, are off the receiver."""
        complete = holds and order.report(now).complete
        if complete and order.ticket.identity != self._complete_order:
            self.proofs, self._complete_order = self.proofs + 1, order.ticket.identity
        done = {name for name in self._mirrors if name not in self._stalled and order.is_done(name)}
        for mirror in self._mirrors.values():
            shining = holds and mirror.state >= 0 and mirror.board.miss(sun, RECEIVER) <= OFF
            mirror.shines_since = _since(shining, mirror.shines_since, now)
            passed = 0.0 if mirror.shines_since is None else now - mirror.shines_since
            shines = f"and its beam has been on the receiver for {passed:.1f} s"
            if complete:
                saw = f"every heliostat is reported to have carried out {order.act.name}, {shines}"
                self.check(15, passed <= DONE_WITHIN, now, mirror.name, saw)
            if holds and mirror.name in done:
                saw = f"{order.act.name} is proven for it, {shines}"
                self.check(15, passed <= DONE_WITHIN, now, mirror.name, saw)
