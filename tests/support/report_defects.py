"""Defects by which boards, clusters and alarms say what is not so: for `twin_defects`."""

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from heliotrope.cluster._nodes import ClusterNode
from heliotrope.cluster._plant_link import PlantLink
from heliotrope.cluster._polling import Polling
from heliotrope.cluster._reports import Reports
from heliotrope.lcu.controller import Controller
from heliotrope.lcu.stepper import Axis
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import alarms

Plant = Callable[[pytest.MonkeyPatch], None]


def _restless(patch: pytest.MonkeyPatch) -> None:
    """A board never says that it moves."""
    flags = Controller.flags
    patch.setattr(Controller, "flags", lambda self: flags(self) & ~1)


def _boots_kept(patch: pytest.MonkeyPatch) -> None:
    """A board does not count its boots."""
    status = Controller.status
    patch.setattr(Controller, "status", lambda self: (*status(self)[:-1], 1))


def _goals_exchanged(patch: pytest.MonkeyPatch) -> None:
    """A cluster reports the goals of the two axes in each other's place."""
    take = ClusterNode.take_steps

    def exchanged(self: Any, steps: tuple[Any, ...], asked_at: float) -> None:
        take(self, (*steps[:2], steps[3], steps[2]), asked_at)

    patch.setattr(ClusterNode, "take_steps", exchanged)


def _time_behind(patch: pytest.MonkeyPatch) -> None:
    """A cluster reports the time of three seconds ago; the plant allows it two."""
    report = PlantLink.report

    def behind(self: Any, present: Any, begin: float) -> None:
        report(self, replace(present, utc_s=present.utc_s - 1.9), begin)

    patch.setattr(PlantLink, "report", behind)


def _false_silence(patch: pytest.MonkeyPatch) -> None:
    """Once a minute a cluster calls a local controller silent that answers."""
    end = Polling.end_second

    def hasty(self: Any, now: float) -> None:
        end(self, now)
        node = self._by_address[0]
        if self._number % 60 == 55:
            self._reports.alarm(alarms.NODE_SILENT.raised(node.name, silence=10.0, last="none"))
        elif self._number % 60 == 57:
            self._reports.clear(alarms.NODE_SILENT.ended(node.name))

    patch.setattr(Polling, "end_second", hasty)


def _silence_untold(patch: pytest.MonkeyPatch) -> None:
    """A cluster does not say that a local controller is silent."""
    patch.setattr(Polling, "_report_silence", lambda self, node, limit: None)


def _never_over(patch: pytest.MonkeyPatch) -> None:
    """A cluster does not say that a local controller answers again."""
    clear = Reports.clear

    def keeping(self: Any, alarm: Any) -> None:
        if alarm.condition != alarms.NODE_SILENT.name:
            clear(self, alarm)

    patch.setattr(Reports, "clear", keeping)


def _never_expires(patch: pytest.MonkeyPatch) -> None:
    """A command that nobody answers stays under way for ever."""
    patch.setattr(Ticket, "expire", lambda self, now: None)


def _too_brisk(patch: pytest.MonkeyPatch) -> None:
    """The axes speed up and slow down twice as fast as they may."""
    init = Axis.__init__

    def brisk(self: Any, *values: Any) -> None:
        init(self, *values)
        self.change *= 2

    patch.setattr(Axis, "__init__", brisk)


def unseen(patch: pytest.MonkeyPatch) -> None:
    """A callback of the cluster fails once a second, and nobody awaits it."""
    begin = Polling.begin_second

    def failing(self: Any) -> None:
        begin(self)
        asyncio.get_running_loop().call_soon(math.sqrt, -1.0)

    patch.setattr(Polling, "begin_second", failing)


#: Invariants, name, defect, kinds of faults, pause between them, s, worlds, and whether the normal
#: tests leave it to the slow ones.
ROWS: tuple[tuple[tuple[int, ...], str, Plant, tuple[str, ...], float, tuple[str, ...], bool], ...]
ROWS = (
    ((11,), "a board never says that it moves", _restless, ("line_drop",), 60.0, (), False),
    ((11,), "boots are not counted", _boots_kept, ("power_cut",), 8.0, (), True),
    ((11,), "the goals of the axes exchanged", _goals_exchanged, ("line_drop",), 60.0, (), True),
    ((11,), "a cluster's time is late", _time_behind, ("line_drop",), 60.0, ("calm",), True),
    ((16,), "an alarm without a cause", _false_silence, ("line_drop",), 60.0, ("calm",), True),
    ((16,), "an alarm that is not raised", _silence_untold, ("power_cut",), 20.0, (), True),
    ((16,), "an alarm that does not end", _never_over, ("power_cut",), 40.0, (), True),
    (
        (16,),
        "a ticket that never ends",
        _never_expires,
        ("line_cut", "cluster_crash"),
        12.0,
        (),
        True,
    ),
    ((8,), "an axis speeds up too fast", _too_brisk, ("line_drop",), 60.0, (), False),
)
