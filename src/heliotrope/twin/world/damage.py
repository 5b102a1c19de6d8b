"""Applies the faults of a run to a simulated plant, and removes them."""

import asyncio
import math
import random
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

from heliotrope.links.in_process import Faults
from heliotrope.plant.controller import PlantController
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import BusFaults
from heliotrope.twin.boards.flash import NorFlash
from heliotrope.twin.boards.outfit import outfits, own_items
from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.records import RecordsDisk
from heliotrope.twin.world import faults as kinds
from heliotrope.twin.world.faults import Fault
from heliotrope.twin.world.instruments import READINGS, Instruments
from heliotrope.twin.world.operator import Operator
from heliotrope.twin.world.pod import Pod

#: Faults of one heliostat, and of one cluster; all other faults concern the whole field. Also the
#: time within which clusters join a new run of the plant, s.
_OF_BOARD = ("power_cut", "brown_out", "flash_cut", "tick_jump", "board_exchanged", "stall")
#: Faults after which the pose of the mirror is unknown.
_MISLEAD = ("board_exchanged", "stall")
_DOWN = ("plant_crash", "plant_file", "plant_restored")
_NEW_RUN, _RUN_WITHIN = (*_DOWN, "plant_twice"), 15.0
_OF_CLUSTER = ("line", "bus", "cluster", "time", "replay", "forgery", "stranger_safe", "noise")
#: Time for which a heliostat has no supply while its board is exchanged, s.
_EXCHANGE = 5.0
#: Kinds of faults during which an order need not be carried out.
_HINDERS = ("line", "bus", "plant", "cluster_frozen")


class SimulatedPlant(Protocol):
    """The simulated plant that faults affect; see `Simulation` for its attributes."""

    begin: float
    boards: list[Board]
    pods: list[Pod]
    plant: PlantController | None
    disk: RecordsDisk
    operator: Operator
    instruments: Instruments
    beams: BeamObserver
    faults: Counter[str]

    def pod_of(self, fault: Fault) -> Pod:
        """Return the cluster that a fault affects."""
        ...

    def start_plant(self, group: asyncio.TaskGroup) -> None:
        """Start the plant program."""
        ...

    def crash_plant(self, now: float) -> None:
        """Kill the plant program at once."""
        ...

    def edit_plant_file(self, fault: Fault) -> None:
        """Write another stow position of a heliostat into the plant file."""
        ...

    def restore_store(self) -> None:
        """Replace the plant's store with a backup."""
        ...

    def run_twice(self, group: asyncio.TaskGroup, *, on: bool) -> None:
        """Run a second plant with the same keys, or end it."""
        ...

    def hang_plant(self, now: float, *, silent: bool, frozen: bool) -> None:
        """Silence the plant program, freeze it, or let it continue."""
        ...


class Damage:
    """Applies faults to a simulated plant.

    Parameters
    ----------
    world
        The simulated plant.
    faults
        Faults of the run, sorted by time.

    Attributes
    ----------
    next
        Time of the next change, s.
    """

    def __init__(self, world: SimulatedPlant, faults: Sequence[Fault]) -> None:
        self._of = world
        self._begin = world.begin
        self._pending = deque(sorted(faults, key=lambda fault: fault.at))
        self._active: list[tuple[float, Fault]] = []
        self._off: dict[int, float] = {}  # boards without power, and when it returns
        self._own: dict[int, NorFlash] = {}  # flash of the boards that were exchanged
        #: When the last fault of a heliostat, of a cluster, or of the whole field ended, s.
        self._rest: dict[str, float] = {}
        self._pause = 1.0  # until a board that lost power during a write restarts
        self.next = -math.inf

    def hinders(self, pod: Pod) -> bool:
        """Return whether a fault may keep the plant's orders from a cluster's heliostats."""
        return not pod.runs or any(
            fault.kind.startswith("plant")
            or (fault.kind.startswith(_HINDERS) and self._of.pod_of(fault) is pod)
            for _, fault in self._active
        )

    @property
    def rest(self) -> dict[str, float]:
        """Return when the last fault that affects each heliostat ended or will end, s."""
        return {
            board.outfit.name: max(
                self._rest.get(key, -math.inf) for key in ("", pod.name, board.outfit.name)
            )
            for pod in self._of.pods
            for board in pod.boards
        }

    def _concerns(self, fault: Fault, now: float) -> None:
        """Record what a fault affects, and until when.

        A wrong time affects the plant to the end of the run.
        """
        key = ""
        if fault.kind in _OF_BOARD:
            key = self._of.boards[fault.target].outfit.name
        elif fault.kind.startswith(_OF_CLUSTER):
            key = self._of.pod_of(fault).name
        until = now + fault.lasts
        if fault.kind == "time_jump" or fault.kind in _MISLEAD:
            until = math.inf
        elif fault.kind in _NEW_RUN:
            until += _RUN_WITHIN
        self._rest[key] = max(self._rest.get(key, -math.inf), until)

    def look(self, now: float, group: asyncio.TaskGroup) -> None:
        """Start and end all faults that are due."""
        changed = False
        while self._pending and self._begin + self._pending[0].at <= now:
            fault = self._pending.popleft()
            self._of.faults[fault.kind] += 1
            self._begins(fault, now)
            changed = True
        over = [fault for until, fault in self._active if until <= now]
        if over:
            self._active = [(until, fault) for until, fault in self._active if until > now]
            changed = True
        for fault in over:
            self._ends(fault, now)
        if changed:
            self._apply(group, now)
        self._supply(now)
        times = [until for until, _ in self._active] + list(self._off.values())
        if self._pending:
            times.append(self._begin + self._pending[0].at)
        self.next = min(times, default=math.inf)

    def _begins(self, fault: Fault, now: float) -> None:
        of, board, pod = self._of, self._of.boards[fault.target], self._of.pod_of(fault)
        self._concerns(fault, now)
        if fault.lasts > 0.0:
            self._active.append((now + fault.lasts, fault))
        if fault.kind in ("power_cut", "brown_out"):
            board.power_off(now, warned=fault.kind == "brown_out")
            self._off[fault.target] = now + fault.lasts
        elif fault.kind == "flash_cut":
            chance = random.Random(f"flash {fault.size}")
            board.flash.budget = chance.choice([chance.randrange(40), chance.randrange(5000)])
            board.flash.ragged = chance.random() < 0.5
            self._pause = 0.1 + fault.lasts
        elif fault.kind == "tick_jump":
            pod.observer.jumped(now, pod.boards.index(board))
            board.ticks.jump(kinds.tick_jump(fault.size))
        elif fault.kind == "time_jump":
            _time_jump(pod, fault, now)
        elif fault.kind == "line_drop":
            pod.line.drop()
            pod.observer.disturbed(now)
        elif fault.kind == "cluster_crash":
            pod.crash()
            pod.observer.disturbed(now, crashed=True)
        elif fault.kind in _DOWN:
            of.crash_plant(now)
            if fault.kind == "plant_file":
                of.edit_plant_file(fault)
            elif fault.kind == "plant_restored":
                of.restore_store()
        elif fault.kind == "board_exchanged":
            self._exchanges(fault, now)
        elif fault.kind == "stall":
            of.beams.stalled(board.outfit.name)
            pod.observer.doubt(board)
            for axis in board.axes:
                axis.stalled = True
        elif fault.kind == "gust":
            of.instruments.gust(fault.size)
        else:
            _strangers(pod, pod.boards.index(board), fault)

    def _exchanges(self, fault: Fault, now: float) -> None:
        """Fit a spare board that was last used on another heliostat and has its counts at stow."""
        of, target = self._of, fault.target
        board, pod = of.boards[target], of.pod_of(fault)
        if target in self._own:
            return
        others = [candidate.outfit for candidate in of.boards if candidate is not board]
        if fault.size < 0.5 or not others:  # from another field, which this plant does not know
            others = outfits(1, seed=int(1e6 * fault.size))
        other = others[int(1e3 * fault.size) % len(others)]
        board.power_off(now)
        spare = {**other.items, **own_items(board.outfit.address)}
        self._own[target] = board.exchange(other.serial, spare)
        self._off[target] = now + _EXCHANGE
        pod.observer.doubt(board)
        of.beams.exchanged(board.outfit.name)

    def _ends(self, fault: Fault, now: float) -> None:
        board = self._of.boards[fault.target]
        if fault.kind == "stall":
            for axis in board.axes:
                axis.stalled = False
        elif fault.kind == "board_exchanged" and fault.target in self._own:
            board.power_off(now)
            board.exchange(board.outfit.serial, self._own.pop(fault.target))
            self._off[fault.target] = now + _EXCHANGE
            self._of.pod_of(fault).observer.doubt(board)

    def _apply(self, group: asyncio.TaskGroup, now: float) -> None:
        """Apply every lasting fault that is currently active."""
        of = self._of
        everywhere = {fault.kind for _, fault in self._active}
        of.operator.away = "nobody_there" in everywhere
        of.instruments.lies = dict.fromkeys(READINGS, "") | {
            READINGS[fault.target % len(READINGS)]: fault.kind
            for _, fault in self._active
            if fault.kind.startswith("sensor")
        }
        of.disk.set_full(now, full="audit_full" in everywhere)
        slow = [fault.size for _, fault in self._active if fault.kind == "disk_slow"]
        of.disk.set_slow(now, max(map(kinds.disk_delay, slow), default=0.0))
        for pod in of.pods:
            active = {fault.kind: fault for _, fault in self._active if of.pod_of(fault) is pod}
            pod.edit(self._file(active.get("cluster_file"), pod), group)
            if "cluster_crash" not in active and not pod.runs:
                pod.start(group)
            pod.freeze(on="cluster_frozen" in active and pod.runs)
            _apply_to(pod, active)
        # The plant does not start without disk space for its records.
        if everywhere.isdisjoint(_DOWN) and not of.disk.full and of.plant is None:
            of.start_plant(group)
        of.run_twice(group, on="plant_twice" in everywhere)
        frozen, silent = "plant_frozen" in everywhere, "plant_silent" in everywhere
        of.hang_plant(now, silent=silent, frozen=frozen)

    def _file(self, fault: Fault | None, pod: Pod) -> dict[str, str]:
        """Return the errors in a cluster's file; see `Pod`."""
        if fault is None:
            return {}
        name = self._of.boards[fault.target].outfit.name
        missing = fault.size < 0.6 and len(pod.boards) > 1
        return {name: "" if missing else f"{name}x"}

    def _supply(self, now: float) -> None:
        """Restore power to boards, including those that lost it during a flash write."""
        for place, board in enumerate(self._of.boards):
            if board.node is not None:
                continue
            back = self._off.setdefault(place, now + self._pause)
            name = board.outfit.name
            self._rest[name] = max(self._rest.get(name, -math.inf), back)
            if now >= back:
                del self._off[place]
                board.power_on(now)


def _apply_to(pod: Pod, active: dict[str, Fault]) -> None:
    if pod.time is not None:
        pod.time.quality = "none" if "time_lost" in active else "gps"
    bad = active.get("bus_bad")
    pod.bus.faults = replace(
        BusFaults() if bad is None else _bus_faults(bad.size), stuck="bus_stuck" in active
    )
    pod.bus.plugged = "bus_unplugged" not in active
    one_way = active.get("line_one_way")
    pod.line.cut(
        first_to_second="line_cut" in active or (one_way is not None and one_way.size < 0.5),
        second_to_first="line_cut" in active or (one_way is not None and one_way.size >= 0.5),
    )
    poor = active.get("line_bad")
    pod.line.faults = Faults() if poor is None else _line_faults(poor.size)


def _time_jump(pod: Pod, fault: Fault, now: float) -> None:
    seconds = kinds.time_jump(fault.size)
    # A program that starts later cannot know of the jump: the plant compares its time.
    noticed = pod.runs and (pod.time is None or pod.time.quality != "none")
    if abs(seconds) > 1.0 and noticed:
        pod.observer.time_jumped(now)
    else:
        pod.observer.jumped(now)
    if pod.time is None:
        pod.clock.jump(seconds)
    else:
        pod.time.detects = fault.target % 2 == 0
        pod.time.jump(seconds)


def _strangers(pod: Pod, target: int, fault: Fault) -> None:
    intruder, bus = pod.intruder, pod.bus
    if fault.kind == "replay" and (old := intruder.recorded(fault.size)):
        bus.inject(old, how="replayed")
    elif fault.kind == "forgery":
        bus.inject(intruder.forged(target, fault.size), how="forged")
    elif fault.kind == "stranger_safe":
        bus.inject(intruder.safe(target, fault.size), how="forged")
    elif fault.kind == "noise":
        bus.inject(intruder.noise(fault.size), how="damaged")


def _bus_faults(size: float) -> BusFaults:
    chance = random.Random(f"bus {size}")
    names = ("loss", "corruption", "burst", "duplication", "late")
    some = chance.sample(names, chance.randint(1, 3))
    chances = {name: chance.choice([0.02, 0.1, 0.4]) for name in some}
    loss, corruption, burst, duplication, late = (chances.get(name, 0.0) for name in names)
    delay = chance.choice([0.0, 0.1, 0.4])
    return BusFaults(loss, corruption, burst, duplication, late, delay)


def _line_faults(size: float) -> Faults:
    chance = random.Random(f"line {size}")
    names = ("loss", "duplication", "reordering", "corruption")
    some = chance.sample(names, chance.randint(1, 3))
    return Faults(
        **{name: chance.choice([0.02, 0.1, 0.3]) for name in some},
        delay=chance.choice([(0.0, 0.0), (0.01, 0.1), (0.0, 0.6)]),
    )
