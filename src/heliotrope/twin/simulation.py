"""Deterministic simulation: a real cluster and real nodes in virtual time, and all that goes wrong.

One run is a seed and a length. The seed gives the heliostats, what the operator does, the list of
faults, the clocks' drifts, and the order in which the event loop takes ready callbacks. The same
seed gives the same run, so what broke an invariant is replayed by one command
(`Outcome.command`). The observer of `twin.invariants` judges every step.
"""

import asyncio
import math
import random
import traceback
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from heliotrope.control._kept import Kept
from heliotrope.control.carried import CarriedLink
from heliotrope.control.clock import VirtualClock, VirtualLoop
from heliotrope.control.cluster import Cluster
from heliotrope.control.cluster_config import ClusterConfig, Member
from heliotrope.control.memory import Faults, MemoryLine, memory_pair
from heliotrope.control.timekeeping import SystemTime
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.lcu import ticks
from heliotrope.sun import Site, vector
from heliotrope.twin import faults as kinds
from heliotrope.twin.board import Board
from heliotrope.twin.bus import BusFaults, TwinBus
from heliotrope.twin.clocks import DriftingClock, SimulatedTime, TickCounter
from heliotrope.twin.faults import Fault
from heliotrope.twin.intruder import Intruder
from heliotrope.twin.invariants import InvariantError, Observer, Violation
from heliotrope.twin.operator import Operator
from heliotrope.twin.outfit import Outfit, outfits

SITE = Site(37.4, -6.0, 100.0, name="simulation")
START = datetime(2026, 6, 21, 9, tzinfo=UTC)
#: The world looks at the boards at least so often, and the observer at everything, s.
LOOK, JUDGE = 0.2, 0.5
#: The true sun is computed so far apart (s), and between it goes straight: 1e-6 rad off.
_SUN_EVERY = 30.0
#: Line, bus and cluster count as whole after so long without a fault, s.
_SETTLED = 4.0
#: Longest run: the sun must stay up.
MOST_HOURS = 8.0


@dataclass(frozen=True)
class Plan:
    """What a run is.

    Parameters
    ----------
    seed
        Of everything.
    seconds
        Length in simulated time.
    heliostats
        On the one bus, 1 to 32.
    pause
        Mean time between two faults, s.
    only
        Kinds of faults to draw from, () for all.
    faults
        None: drawn by the seed.

    Raises
    ------
    InputError
        A length or a number that cannot be simulated.
    """

    seed: int
    seconds: float = 600.0
    heliostats: int = 4
    pause: float = 12.0
    only: tuple[str, ...] = ()
    faults: tuple[Fault, ...] | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.seconds <= 3600.0 * MOST_HOURS:
            raise InputError(
                f"simulation of {self.seconds / 3600.0:g} h; give above 0 and at most "
                f"{MOST_HOURS:g} h, as long as the sun is up"
            )
        if not 1 <= self.heliostats <= 32:
            raise InputError(f"simulation of {self.heliostats} heliostats; a cluster has 1 to 32")
        if self.faults is None:
            kinds.drawn(0, 1.0, 1, pause=self.pause, only=self.only)

    @property
    def drawn(self) -> tuple[Fault, ...]:
        """The faults of the run."""
        if self.faults is not None:
            return self.faults
        return tuple(
            kinds.drawn(self.seed, self.seconds, self.heliostats, pause=self.pause, only=self.only)
        )


@dataclass
class Outcome:
    """What a run has shown.

    Attributes
    ----------
    plan
        What was run.
    violation
        The first broken invariant, or None.
    problem
        An exception of the code that was run, "" if there was none.
    checks
        How often each invariant was checked.
    faults
        How often each kind of fault came.
    counts
        Of what the operator did and was told.
    states
        How often each state was entered.
    seconds
        Simulated time.
    """

    plan: Plan
    violation: Violation | None = None
    problem: str = ""
    checks: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    states: Counter[int] = field(default_factory=Counter)
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        """Whether nothing was broken."""
        return self.violation is None and not self.problem

    @property
    def command(self) -> str:
        """The one command that replays it."""
        plan = self.plan
        return (
            f"heliotrope simulate --seed {plan.seed} --hours {plan.seconds / 3600.0!r} "
            f"--heliostats {plan.heliostats} --pause {plan.pause!r}"
            + "".join(f" --only {kind}" for kind in plan.only)
        )

    @property
    def text(self) -> str:
        """One line on what went wrong, "" if nothing did."""
        if self.violation is not None:
            return str(self.violation)
        return self.problem


class Simulation:
    """One run; use `run`.

    Parameters
    ----------
    plan
        What to run.
    loop
        Its virtual time is the true one.
    """

    def __init__(self, plan: Plan, loop: VirtualLoop) -> None:
        self.plan = plan
        self.faults: Counter[str] = Counter()
        chance = random.Random(f"simulation {plan.seed}")
        self._chance = chance
        self._clock = VirtualClock(loop.time, START)
        self._begin = loop.time()
        self._suns: dict[int, FloatArray] = {}
        self.outfits: list[Outfit] = outfits(plan.heliostats, plan.seed)
        self.boards = [self._board(each) for each in self.outfits]
        self.observer = Observer(self.boards, self._begin, self.sun)
        self.operator = Operator(
            self._clock, plan.seed, self.observer, {o.name: o.address for o in self.outfits}
        )
        self.intruder = Intruder(self.observer.frames, [o.address for o in self.outfits])
        drift = chance.choice([0.0, 50e-6, -50e-6, 200e-6])
        self.cluster_clock = DriftingClock(loop.time, START, drift)
        self.time = SimulatedTime(self.cluster_clock) if chance.random() < 0.5 else None
        self._kept = Kept(None)  # what a cluster has on its disk outlasts its crashes
        self.bus = self._new_bus()
        self.line: MemoryLine | None = None
        self._links: tuple[CarriedLink, CarriedLink] | None = None
        self._running: list[asyncio.Task[None]] = []
        self._whole_since = self._begin

    def _board(self, outfit: Outfit) -> Board:
        chance = self._chance
        start = chance.choice([0, chance.randrange(ticks.PERIOD), ticks.PERIOD - 2_000_000])
        counter = TickCounter(start, chance.choice([0.0, 1e-4, -1e-4, 5e-4]))
        play = chance.choice([0.0, 30.0])
        board = Board(outfit, seed=chance.getrandbits(32), ticks=counter, play=play)
        board.power_on(self._begin)
        return board

    def _new_bus(self) -> TwinBus:
        return TwinBus(
            self._clock, list(self.boards), seed=self._chance.getrandbits(32), tap=self.observer
        )

    def sun(self, now: float) -> FloatArray:
        """Return the true direction to the sun, (3,), at a time of the loop."""
        place, part = divmod(now - self._begin, _SUN_EVERY)
        first, second = self._sun_at(int(place)), self._sun_at(int(place) + 1)
        mixed = first + (second - first) * (part / _SUN_EVERY)
        return np.asarray(mixed / np.linalg.norm(mixed))

    def _sun_at(self, place: int) -> FloatArray:
        found = self._suns.get(place)
        if found is None:
            found = vector(START.timestamp() + _SUN_EVERY * place, SITE)
            self._suns[place] = found
        return found

    # -- the cluster -----------------------------------------------------------------------

    @property
    def cluster_runs(self) -> bool:
        """Whether the cluster's program runs."""
        return bool(self._running)

    def start_cluster(self, group: asyncio.TaskGroup) -> None:
        """Start the cluster anew, with a link and a bus of its own: nothing of before is left."""
        number = self._chance.getrandbits(31)
        plant, mine, self.line = memory_pair(
            self._clock, seed=number, clocks=(self._clock, self.cluster_clock)
        )
        self._links = plant, mine
        self.bus = self._new_bus()
        keeper = self.time or SystemTime(self.cluster_clock)
        members = tuple(Member(o.name, o.address, o.serial, o.key) for o in self.outfits)
        cluster = Cluster(
            ClusterConfig("C1", SITE, members), self.bus, mine, self.cluster_clock, keeper,
            self._kept,
        )  # fmt: skip
        self.operator.link = plant
        start = group.create_task
        self._running = [
            start(plant.run()), start(mine.run()), start(cluster.run()),
            start(self.operator.listen(plant)),
        ]  # fmt: skip

    def crash_cluster(self) -> None:
        """End the cluster's program at once, wherever it is."""
        for task in self._running:
            task.cancel()
        self._running = []
        self._links = self.line = None
        self.operator.link = None

    # -- the world -------------------------------------------------------------------------

    async def live(self) -> None:
        """Run it to its end.

        Raises
        ------
        InvariantError
            In a group: an invariant is broken.
        """
        damage = Damage(self, self.plan.drawn)
        async with asyncio.TaskGroup() as group:
            self.start_cluster(group)
            others = [group.create_task(self.operator.lease()),
                      group.create_task(self.operator.work())]  # fmt: skip
            await self._turn(damage, group)
            self.crash_cluster()
            for task in others:
                task.cancel()

    async def _turn(self, damage: "Damage", group: asyncio.TaskGroup) -> None:
        """Let boards, faults and observer go on until the end."""
        end, judged = self._begin + self.plan.seconds, self._begin
        while (now := self._clock.monotonic()) < end:
            damage.look(now, group)
            for board in self.boards:
                if board.due(now) <= now:
                    board.step(now)
            self._look_at_line(now, damage)
            if now >= judged:
                self.observer.look(now)
                judged = now + JUDGE
            times = [board.due(now) for board in self.boards]
            due = min(*times, damage.next, now + LOOK, end)
            await asyncio.sleep(max(1e-3, due - now))

    def _look_at_line(self, now: float, damage: "Damage") -> None:
        """Whether an order of now would surely be carried out."""
        links = self._links
        whole = links is not None and links[0].connected and links[1].connected
        if damage.hinders or not whole:
            self._whole_since = now
            self.observer.disturbed(now)
        self.operator.carried = now - self._whole_since > _SETTLED


class Damage:
    """Makes the faults of a run happen, and ends them.

    Parameters
    ----------
    simulation
        What they happen to.
    faults
        In the order of their times.

    Attributes
    ----------
    next
        When it has to look again, s.
    """

    def __init__(self, simulation: Simulation, faults: Sequence[Fault]) -> None:
        self._of = simulation
        self._begin = simulation.observer.start
        self._left = deque(sorted(faults, key=lambda fault: fault.at))
        self._active: list[tuple[float, Fault]] = []
        self._off: dict[int, float] = {}  # boards without supply, and when it comes back
        self._pause = 1.0  # until a board that died within a write starts again
        self.next = -math.inf

    @property
    def hinders(self) -> bool:
        """Whether line, bus or cluster are not whole."""
        return not self._of.cluster_runs or any(
            fault.kind.startswith(("line", "bus", "plant")) for _, fault in self._active
        )

    def look(self, now: float, group: asyncio.TaskGroup) -> None:
        """Begin and end what is due."""
        changed = False
        while self._left and self._begin + self._left[0].at <= now:
            fault = self._left.popleft()
            self._of.faults[fault.kind] += 1
            self._begins(fault, now)
            changed = True
        over = [fault for until, fault in self._active if until <= now]
        if over:
            self._active = [(until, fault) for until, fault in self._active if until > now]
            changed = True
        if changed:
            self._apply(group)
        self._supply(now)
        times = [until for until, _ in self._active] + list(self._off.values())
        if self._left:
            times.append(self._begin + self._left[0].at)
        self.next = min(times, default=math.inf)

    def _begins(self, fault: Fault, now: float) -> None:
        of, board = self._of, self._of.boards[fault.target]
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
            of.observer.jumped(now, fault.target)
            board.ticks.jump(kinds.tick_jump(fault.size))
        elif fault.kind == "time_jump":
            self._time_jump(fault, now)
        elif fault.kind == "line_drop" and of.line is not None:
            of.line.drop()
            of.observer.disturbed(now)
        elif fault.kind == "cluster_crash":
            of.crash_cluster()
            of.observer.disturbed(now, crashed=True)
        else:
            self._strangers(fault)

    def _time_jump(self, fault: Fault, now: float) -> None:
        of, seconds = self._of, kinds.time_jump(fault.size)
        of.observer.jumped(now)
        if of.time is None:
            of.cluster_clock.jump(seconds)
        else:
            of.time.detects = fault.target % 2 == 0
            of.time.jump(seconds)

    def _strangers(self, fault: Fault) -> None:
        intruder, bus = self._of.intruder, self._of.bus
        if fault.kind == "replay" and (old := intruder.recorded(fault.size)):
            bus.inject(old, how="replayed")
        elif fault.kind == "forgery":
            bus.inject(intruder.forged(fault.target, fault.size), how="forged")
        elif fault.kind == "stranger_safe":
            bus.inject(intruder.safe(fault.target, fault.size), how="forged")
        elif fault.kind == "noise":
            bus.inject(intruder.noise(fault.size), how="damaged")

    def _apply(self, group: asyncio.TaskGroup) -> None:
        """Set everything that lasts as the active faults say."""
        of = self._of
        active = {fault.kind: fault for _, fault in self._active}
        of.operator.silent = "plant_silent" in active
        if of.time is not None:
            of.time.quality = "none" if "time_lost" in active else "gps"
        if "cluster_crash" not in active and not of.cluster_runs:
            of.start_cluster(group)
        bad = active.get("bus_bad")
        of.bus.faults = replace(
            BusFaults() if bad is None else _bus_faults(bad.size), stuck="bus_stuck" in active
        )
        of.bus.plugged = "bus_unplugged" not in active
        if of.line is not None:
            one_way = active.get("line_one_way")
            of.line.cut(
                first_to_second="line_cut" in active
                or (one_way is not None and one_way.size < 0.5),
                second_to_first="line_cut" in active
                or (one_way is not None and one_way.size >= 0.5),
            )
            poor = active.get("line_bad")
            of.line.faults = Faults() if poor is None else _line_faults(poor.size)

    def _supply(self, now: float) -> None:
        """Give boards their supply back, those too that died within a write of flash."""
        for place, board in enumerate(self._of.boards):
            if board.node is not None:
                continue
            back = self._off.setdefault(place, now + self._pause)
            if now >= back:
                del self._off[place]
                board.power_on(now)


def _bus_faults(size: float) -> BusFaults:
    chance = random.Random(f"bus {size}")
    names = ("loss", "corruption", "burst", "duplication", "late")
    some = chance.sample(names, chance.randint(1, 3))
    chances = {name: chance.choice([0.02, 0.1, 0.4]) for name in some}
    loss, corruption, burst, duplication, late = (chances.get(name, 0.0) for name in names)
    return BusFaults(loss, corruption, burst, duplication, late)


def _line_faults(size: float) -> Faults:
    chance = random.Random(f"line {size}")
    names = ("loss", "duplication", "reordering", "corruption")
    some = chance.sample(names, chance.randint(1, 3))
    return Faults(
        **{name: chance.choice([0.02, 0.1, 0.3]) for name in some},
        delay=chance.choice([(0.0, 0.0), (0.01, 0.1), (0.0, 0.6)]),
    )


# -- running -----------------------------------------------------------------------------------


def run(plan: Plan) -> Outcome:
    """Run a plan; what goes wrong is told in the outcome, not raised."""
    outcome = Outcome(plan, seconds=plan.seconds)
    with asyncio.Runner(loop_factory=lambda: VirtualLoop(plan.seed)) as runner:
        loop = runner.get_loop()
        assert isinstance(loop, VirtualLoop)
        begin = loop.time()
        simulation = Simulation(plan, loop)
        try:
            runner.run(simulation.live())
        except (Exception, BaseExceptionGroup) as error:  # noqa: BLE001 - it is the finding
            _blame(error, outcome)
            outcome.seconds = loop.time() - begin
    outcome.checks = simulation.observer.checks
    outcome.faults = simulation.faults
    outcome.counts = simulation.operator.counts
    outcome.states = simulation.observer.entered
    return outcome


def _blame(error: BaseException, outcome: Outcome) -> None:
    """Find what broke first among all that a task group raises."""
    found = list(_leaves(error))
    for each in found:
        if isinstance(each, InvariantError):
            outcome.violation = each.violation
            return
    first = found[0]
    place = traceback.extract_tb(first.__traceback__)[-1]
    where = f"{Path(place.filename).name}, line {place.lineno}"
    outcome.problem = f"{type(first).__name__} at {where}: {first}"


def _leaves(error: BaseException) -> Iterator[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        for each in error.exceptions:
            yield from _leaves(each)
    else:
        yield error


def shrink(outcome: Outcome, most: int = 60) -> Outcome:
    """Return a failed run with fewer faults that breaks the same invariant.

    Parameters
    ----------
    outcome
        Of a run that failed.
    most
        Runs to spend.

    Raises
    ------
    InputError
        If the run did not fail.
    """
    if outcome.good:
        raise InputError(
            f"seed {outcome.plan.seed}: nothing is broken, so there is nothing to shrink"
        )
    number = outcome.violation.number if outcome.violation is not None else 0
    seconds = min(outcome.plan.seconds, outcome.seconds + 1.0)
    best = outcome

    def fails(faults: list[Fault]) -> bool:
        nonlocal best
        tried = run(replace(outcome.plan, faults=tuple(faults), seconds=seconds))
        same = not tried.good and (tried.violation.number if tried.violation else 0) == number
        if same:
            best = tried
        return same

    kinds.shrunk([fault for fault in outcome.plan.drawn if fault.at < seconds], fails, most)
    return best
