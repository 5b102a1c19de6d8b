"""Goals of commands: the state that a command requests, and whether it has been reached.

A command is acknowledged when the local controller has accepted it, and done when STATUS shows the
requested state. A command without a goal here is done when it is acknowledged.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

from heliotrope.cluster._nodes import ClusterNode, Nodes
from heliotrope.cluster._reports import Reports
from heliotrope.lcu import messages, names, states
from heliotrope.lcu.states import (
    APPROACHING,
    FAULT,
    IDLE,
    LOCKED,
    SEARCHING,
    STOWED,
    STOWING,
    TRACKING,
)
from heliotrope.links.messages import Stage
from heliotrope.safety import DEFOCUS_BUDGET, STOW_BUDGET

_ALL = frozenset(range(len(states.STATES)))
#: States in which the beam is off the receiver.
_BEAM_OFF = _ALL.difference(states.BEAM_OUT)


#: A STATUS requested sooner than this after the ACK may not show the motion yet, s: a few ticks of
#: a board.
_SETTLE = 0.2
#: Step counts this close to their goal have reached it, because the sun moves them by this much in
#: a few ticks.
_NEAR = 20
#: Time limit of the longest path, from stow to standby, s.
_LONGEST = 900.0


@dataclass(frozen=True)
class Goal:
    """The states that a command requests, and the states on the way there.

    Attributes
    ----------
    goal_states, on_way
        Requested states; states on the way there.
    clear, needed
        Flags that must be clear, and flags that must be set, in one of ``goal_states``; until then
        the heliostat is on its way.
    near
        Whether the step counts must be near their goal. A defocused heliostat keeps its beam beside
        the receiver as the sun moves, so it never stands still.
    evidence
        States and flags, any of which shows that the command was accepted. They are needed if the
        reply was lost and the goal looks like the state before the command. If None, the goal
        itself shows the acceptance.
    limit
        Time allowed until the goal is reached, s.
    """

    goal_states: frozenset[int]
    on_way: frozenset[int] = frozenset()
    clear: int = 0
    needed: int = 0
    near: bool = False
    evidence: tuple[frozenset[int], int] | None = None
    limit: float = _LONGEST

    def reached(self, state: int, flags: int, off: int) -> bool | None:
        """Return True if the goal is reached, None if the heliostat is on its way, otherwise False.

        ``off`` is the distance of the step counts from their goal.
        """
        if state in self.goal_states:
            clear = not flags & self.clear and (not self.near or off <= _NEAR)
            return True if clear and flags & self.needed == self.needed else None
        return None if state in self.on_way else False

    def shown(self, state: int, flags: int) -> bool:
        """Return whether state and flags show that the command was accepted."""
        return self.evidence is None or state in self.evidence[0] or bool(flags & self.evidence[1])


#: Neither states nor flags show whether the command was accepted.
_NOTHING: tuple[frozenset[int], int] = (frozenset(), 0)
GOALS = {
    "APPROACH": Goal(frozenset({IDLE}), frozenset({APPROACHING})),
    "IDLE": Goal(frozenset({IDLE})),
    "TRACK": Goal(frozenset({TRACKING})),
    "REFOCUS": Goal(frozenset({TRACKING})),
    "SEARCH": Goal(frozenset({SEARCHING, IDLE}), evidence=(frozenset({SEARCHING}), 0)),
    "LOCK": Goal(frozenset({LOCKED})),
    "UNLOCK": Goal(_ALL - {LOCKED}),
    "CLEAR_FAULT": Goal(_ALL - {FAULT}),
    "JOG": Goal(frozenset({IDLE}), clear=names.MOVING, evidence=_NOTHING),
    "GOTO": Goal(frozenset({IDLE}), clear=names.MOVING, evidence=_NOTHING),
    "DIAGNOSE": Goal(
        frozenset({IDLE}), clear=names.DIAGNOSING, evidence=(frozenset(), names.DIAGNOSING)
    ),
    "DEFOCUS": Goal(_BEAM_OFF, near=True, limit=DEFOCUS_BUDGET),
    "STOW": Goal(
        _BEAM_OFF - {states.DEFOCUSED}, clear=names.MOVING, needed=names.AT_STOW, limit=STOW_BUDGET
    ),
}
#: Goals that an order leaves in force, besides goals of its own name, because DEFOCUS must not undo
#: a stow.
_SPARED = {"DEFOCUS": ("STOW",)}
assert STOWED in GOALS["STOW"].goal_states
assert STOWING in GOALS["STOW"].goal_states


@dataclass(frozen=True)
class Shift:
    """Change of one axis's goal by a command.

    Attributes
    ----------
    axis
        0 or 1.
    origin, steps
        Goal before the command, and its change, steps.
    """

    axis: int
    origin: int
    steps: int

    def shown(self, goals: tuple[int, int]) -> bool:
        """Return whether only the command can explain the present goals."""
        off = abs(goals[self.axis] - self.origin - self.steps)
        # The sun moves the goals as well, until the command ends tracking.
        return off == 0 or (off <= _NEAR and abs(self.steps) > 2 * _NEAR)


@dataclass
class _Watch:
    identity: str
    name: str
    since: float
    sure: bool  # whether the command is known to have been accepted
    shift: Shift | None = None


class Goals:
    """Goals not yet reached, evaluated at every STATUS."""

    def __init__(self, reports: Reports) -> None:
        self._reports = reports
        self._watches: dict[int, list[_Watch]] = {}

    def begin(
        self,
        identity: str,
        name: str,
        node: ClusterNode,
        now: float,
        *,
        sure: bool = True,
        shift: Shift | None = None,
    ) -> None:
        """Begin the goal of a command that a node acknowledged; this voids other goals (see `end`).

        If not ``sure``, the reply was lost; ``shift``, if known, then shows whether the command was
        accepted.
        """
        if name not in GOALS:
            self._reports.add(identity, Stage.DONE, node.name)
            return
        self.end(node, f"{name} came after it", name)
        others = [w for w in self._watches.get(node.index, []) if w.identity != identity]
        self._watches[node.index] = [*others, _Watch(identity, name, now, sure, shift)]

    def waits(self, node: ClusterNode) -> bool:
        """Return whether a node has a goal."""
        return node.index in self._watches

    def end(self, node: ClusterNode, why: str, name: str) -> None:
        """Abandon the goals of a node.

        Goals of an order of the same ``name`` remain, because the heliostat reaches them anyway.
        The goal of a STOW also remains when a DEFOCUS arrives.
        """
        spared = (name, *_SPARED.get(name, ()))
        self._judge(node, lambda watch: None if watch.name in spared else why)

    def heard(self, node: ClusterNode, asked_at: float) -> None:
        """Evaluate a node's STATUS and STEPS; its STATUS was requested at ``asked_at``."""
        watches = self._watches.get(node.index)
        if watches is None:
            return
        self._judge(node, lambda watch: self._verdict(node, watch, asked_at))

    def second(self, nodes: Nodes, now: float) -> None:
        """Abandon goals that take too long."""
        for index in list(self._watches):
            self._judge(nodes[index], functools.partial(_late, nodes[index], now))

    def _judge(self, node: ClusterNode, verdict: "Callable[[_Watch], str | None]") -> None:
        kept = []
        for watch in self._watches.get(node.index, []):
            text = verdict(watch)
            if text is None:
                kept.append(watch)
            elif text:
                self._reports.add(watch.identity, Stage.FAILED, node.name, f"{watch.name}: {text}")
            else:
                self._reports.add(watch.identity, Stage.DONE, node.name)
        if kept:
            self._watches[node.index] = kept
        else:
            self._watches.pop(node.index, None)

    def _verdict(self, node: ClusterNode, watch: _Watch, asked_at: float) -> str | None:
        """Return the reason for a failure.

        The reason is empty if the goal is reached, and None while the heliostat is on its way.
        """
        if asked_at < watch.since + _SETTLE:
            return None
        if watch.name in messages.SAFE and node.flags & names.COUNTS_UNKNOWN:
            return "its step counts are unknown, so nothing shows where its beam is"
        if (
            watch.name in messages.SAFE
            and node.flags & (names.LOCAL_SWITCH | names.AT_STOW) == names.LOCAL_SWITCH
        ):
            return "its drives are switched off at the mirror, away from stow"
        goal = GOALS[watch.name]
        watch.sure = watch.sure or goal.shown(node.state, node.flags)
        counted = goal.near or (watch.shift is not None and not watch.sure)
        if counted and node.steps_at < watch.since + _SETTLE:
            return None
        primary, secondary, primary_goal, secondary_goal = node.steps
        if watch.shift is not None:
            watch.sure = watch.sure or watch.shift.shown((primary_goal, secondary_goal))
        off = max(abs(primary_goal - primary), abs(secondary_goal - secondary))
        reached = goal.reached(node.state, node.flags, off)
        # A later STATUS would not show it either.
        ended = not watch.sure and goal.evidence is _NOTHING
        if reached is None and not ended:
            return None
        state = states.STATES[node.state]
        if ended or (reached and not watch.sure):
            return (
                f"its reply was lost, and nothing shows that the command was accepted; the "
                f"state is {state}"
            )
        fault = f", {names.FAULTS[node.fault]}" if node.fault else ""
        return "" if reached else f"went to {state}{fault}"


def _late(node: ClusterNode, now: float, watch: _Watch) -> str | None:
    if now - watch.since <= GOALS[watch.name].limit:
        return None
    return f"still {states.STATES[node.state]} after {now - watch.since:.0f} s"
