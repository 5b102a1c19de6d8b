"""What a command is to bring about at a heliostat, and whether it has.

A command is acknowledged when the local controller has taken it, and done when STATUS shows the
state that it asks for. Commands that are not in the table are done when they are acknowledged.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

from heliotrope.cluster._nodes import Node
from heliotrope.cluster._reports import Reports
from heliotrope.lcu import names, states
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
#: States in which a beam may be on the receiver, on its standby point, or under way to them.
BEAM_OUT = frozenset({APPROACHING, IDLE, TRACKING, SEARCHING})

_MOVING = 1 << names.FLAGS.index("MOVING")
_AT_STOW = 1 << names.FLAGS.index("AT_STOW")
_DIAGNOSING = 1 << names.FLAGS.index("DIAGNOSING")

#: A STATUS asked for sooner after the ACK may not show the motion yet, s: a few ticks of a board.
_SETTLE = 0.2
#: Of the step counts from where they are going: a few ticks' worth of the sun.
_NEAR = 20
#: For the longest way from stow to standby, s.
_LONGEST = 900.0


@dataclass(frozen=True)
class Goal:
    """States that a command leads to, and those on the way there.

    Attributes
    ----------
    there, on_way
        States.
    clear, needed
        Flags that must be clear, and set, in one of ``there``; until then it is on its way.
    near
        The step counts must be near their goal: a mirror that is defocused goes on with the sun,
        beside the receiver, so that it never stands still.
    told
        For a goal that looks like what was before: where the answer was lost, one of these states
        or flags must have been seen, or nobody knows whether the command was taken; None: the goal
        itself shows it.
    limit
        For getting there, s.
    """

    there: frozenset[int]
    on_way: frozenset[int] = frozenset()
    clear: int = 0
    needed: int = 0
    near: bool = False
    told: tuple[frozenset[int], int] | None = None
    limit: float = _LONGEST

    def reached(self, state: int, flags: int, off: int) -> bool | None:
        """Return True if it is there, None if it is on its way, False if it is neither.

        ``off`` is how far the step counts are from where they are going.
        """
        if state in self.there:
            clear = not flags & self.clear and (not self.near or off <= _NEAR)
            return True if clear and flags & self.needed == self.needed else None
        return None if state in self.on_way else False

    def shown(self, state: int, flags: int) -> bool:
        """Whether state and flags are none that would be there without the command."""
        return self.told is None or state in self.told[0] or bool(flags & self.told[1])


#: Nothing that is told shows whether it was taken.
_NOTHING: tuple[frozenset[int], int] = (frozenset(), 0)
GOALS = {
    "APPROACH": Goal(frozenset({IDLE}), frozenset({APPROACHING})),
    "IDLE": Goal(frozenset({IDLE})),
    "TRACK": Goal(frozenset({TRACKING})),
    "REFOCUS": Goal(frozenset({TRACKING})),
    "SEARCH": Goal(frozenset({SEARCHING, IDLE}), told=(frozenset({SEARCHING}), 0)),
    "LOCK": Goal(frozenset({LOCKED})),
    "UNLOCK": Goal(_ALL - {LOCKED}),
    "CLEAR_FAULT": Goal(_ALL - {FAULT}),
    "JOG": Goal(frozenset({IDLE}), clear=_MOVING, told=_NOTHING),
    "GOTO": Goal(frozenset({IDLE}), clear=_MOVING, told=_NOTHING),
    "DIAGNOSE": Goal(frozenset({IDLE}), clear=_DIAGNOSING, told=(frozenset(), _DIAGNOSING)),
    "DEFOCUS": Goal(_ALL - BEAM_OUT, near=True, limit=DEFOCUS_BUDGET),
    "STOW": Goal(
        _ALL - BEAM_OUT - {states.DEFOCUSED}, clear=_MOVING, needed=_AT_STOW, limit=STOW_BUDGET
    ),
}
assert STOWED in GOALS["STOW"].there
assert STOWING in GOALS["STOW"].there


@dataclass(frozen=True)
class Shift:
    """What a command changes of where the step counts of an axis go.

    Attributes
    ----------
    axis
        0 or 1.
    origin, steps
        Where they went before, and by how many steps that changes.
    """

    axis: int
    origin: int
    steps: int

    def shown(self, goals: tuple[int, int]) -> bool:
        """Whether where the counts go now can only be due to the command."""
        off = abs(goals[self.axis] - self.origin - self.steps)
        # The sun moves them as well, until the command ends that.
        return off == 0 or (off <= _NEAR and abs(self.steps) > 2 * _NEAR)


@dataclass
class _Watch:
    identity: str
    name: str
    since: float
    sure: bool  # that it was taken
    shift: Shift | None = None


class Goals:
    """Who is to reach what; told of every STATUS."""

    def __init__(self, reports: Reports) -> None:
        self._reports = reports
        self._watches: dict[int, list[_Watch]] = {}

    def begin(
        self,
        identity: str,
        name: str,
        node: Node,
        now: float,
        *,
        sure: bool = True,
        shift: Shift | None = None,
    ) -> None:
        """Note that a node has acknowledged a command; goals of other commands are void.

        Not ``sure``: it may have, its answer was lost; ``shift``, if known, tells whether it has.
        """
        if name not in GOALS:
            self._reports.add(identity, Stage.DONE, node.name)
            return
        same = [watch for watch in self._watches.get(node.index, []) if watch.name == name]
        if not same:
            self.end(node, f"{name} came after it")
        self._watches[node.index] = [*same, _Watch(identity, name, now, sure, shift)]

    def waits(self, node: Node) -> bool:
        """Whether a node is to reach something."""
        return node.index in self._watches

    def end(self, node: Node, why: str) -> None:
        """Give up the goals of a node."""
        for watch in self._watches.pop(node.index, []):
            self._reports.add(watch.identity, Stage.FAILED, node.name, f"{watch.name}: {why}")

    def heard(self, node: Node, asked_at: float) -> None:
        """Judge STATUS and STEPS, the first of which was asked for at an instant."""
        watches = self._watches.get(node.index)
        if watches is None:
            return
        self._judge(node, lambda watch: self._verdict(node, watch, asked_at))

    def second(self, nodes: list[Node], now: float) -> None:
        """Give up what takes too long."""
        for index in list(self._watches):
            self._judge(nodes[index], functools.partial(_late, nodes[index], now))

    def _judge(self, node: Node, verdict: "Callable[[_Watch], str | None]") -> None:
        left = []
        for watch in self._watches.get(node.index, []):
            text = verdict(watch)
            if text is None:
                left.append(watch)
            elif text:
                self._reports.add(watch.identity, Stage.FAILED, node.name, f"{watch.name}: {text}")
            else:
                self._reports.add(watch.identity, Stage.DONE, node.name)
        if left:
            self._watches[node.index] = left
        else:
            self._watches.pop(node.index, None)

    def _verdict(self, node: Node, watch: _Watch, asked_at: float) -> str | None:
        """Return "" if it is done, a text if it cannot be any more, None if neither."""
        if asked_at < watch.since + _SETTLE:
            return None
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
        # What nothing will show later need not be waited for.
        ended = not watch.sure and goal.told is _NOTHING
        if reached is None and not ended:
            return None
        state = states.STATES[node.state]
        if ended or (reached and not watch.sure):
            return f"its answer was lost, and nothing shows that it was taken; it is {state}"
        fault = f", {names.FAULTS[node.fault]}" if node.fault else ""
        return "" if reached else f"went to {state}{fault}"


def _late(node: Node, now: float, watch: _Watch) -> str | None:
    if now - watch.since <= GOALS[watch.name].limit:
        return None
    return f"still {states.STATES[node.state]} after {now - watch.since:.0f} s"
