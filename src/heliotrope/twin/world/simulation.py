"""Deterministic simulation: a real plant, clusters and nodes in virtual time, with faults.

A seed and a duration define a run. The seed determines the heliostats and clusters, the actions of
operators, the list of faults, the drift of the clocks, and the order in which the event loop runs
ready callbacks. The same seed yields the same run, so one command replays a violated invariant
(`RunResult.command`). The observers (`twin.invariants`) check every step.
"""

import asyncio
import contextlib
import random
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, azimuth_elevation
from heliotrope.lcu import ticks
from heliotrope.links.clock import VirtualClock, VirtualLoop, context_of
from heliotrope.links.common_settings import CommonSettings
from heliotrope.links.link import Link
from heliotrope.links.tapped import TappedLink
from heliotrope.mechanism.board_items import Wanted, packed
from heliotrope.mechanism.tracking import track
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.emergency import DNI_READING, EmergencyRecord
from heliotrope.plant.field.assigned import Assigned
from heliotrope.plant.field.witnesses import SENSOR_ERROR
from heliotrope.plant.operations.service import Service
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import FLUX_READING, Alarm, conditions
from heliotrope.sun import clear_sky, vector
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.clocks import TickCounter
from heliotrope.twin.boards.outfit import (
    MACHINE,
    RECEIVER,
    STANDBY,
    Outfit,
    outfits,
)
from heliotrope.twin.cameras import FieldSnapshot
from heliotrope.twin.invariants.alarms import AlarmObserver
from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.day import DayObserver
from heliotrope.twin.invariants.flux import FluxObserver
from heliotrope.twin.invariants.invariants import OFF, InvariantError, Observer, Violation
from heliotrope.twin.invariants.panel import Panel
from heliotrope.twin.invariants.persons import PersonsObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.invariants.progress import ProgressObserver
from heliotrope.twin.invariants.quiet import NEAR, QuietObserver
from heliotrope.twin.invariants.results import ResultObserver
from heliotrope.twin.invariants.sensors import SensorObserver
from heliotrope.twin.invariants.shown import ShownObserver
from heliotrope.twin.invariants.tickets import TicketObserver
from heliotrope.twin.invariants.visits import VisitObserver
from heliotrope.twin.invariants.watch import Watch
from heliotrope.twin.records import AssignedDisk, EmergencyDisk, RecordsDisk, SimulatedAudit
from heliotrope.twin.true_mirrors import TrueMirror, mirrors_of
from heliotrope.twin.world import faults as kinds
from heliotrope.twin.world.acts import Acts
from heliotrope.twin.world.crew import CREW, Crew, CrewAct
from heliotrope.twin.world.damage import Damage
from heliotrope.twin.world.design import MIRROR, design_of, limited, wanted_of
from heliotrope.twin.world.faults import Fault
from heliotrope.twin.world.instruments import READINGS, Instruments, Sky
from heliotrope.twin.world.maintenance import Maintenance
from heliotrope.twin.world.operator import Operator
from heliotrope.twin.world.pod import PlantEar, Pod
from heliotrope.twin.world.scene import Scene, scene_of
from heliotrope.twin.world.shift import Shift, Working
from heliotrope.twin.world.store import PlantStore
from heliotrope.twin.world.tour import TOUR, TOUR_LENGTH, Tour
from heliotrope.twin.world.twice import SecondPlant
from heliotrope.twin.world.work import DAY_WORK, LIT_WORK, LOSSES, USUAL_WORK, Work
from heliotrope.twin.world.worlds import (
    CLIMBING,
    COARSE,
    COMMON,
    DAYS,
    LIMIT,
    LIMITED,
    PARTY,
    REPAIRS,
    Habits,
    PodErrors,
    checked,
    common_error,
    covered_by,
    drawn,
    joint_visits,
    knows_boards,
    measured,
    motors_of,
    ramped,
    stored_by,
    surveyed,
    works,
)

#: Longest interval between checks of the boards, and between checks of everything, s. A board that
#: an order has set in motion in the meantime has passed steps for 0.1 s to its timer.
LOOK, JUDGE = 0.09, 0.5
#: The true sun is computed this often (s) and interpolated linearly, to within 1e-6 rad.
_SUN_EVERY = 30.0
#: The plant's program, for freezing it.
_PLANT = "plant"
#: Worlds in which a cluster is wrong from the start, so that its heliostats may do nothing.
_WRONG = ("addresses", "clock", "site", COMMON)
#: The witness in the world "common".
WITNESSES = frozenset({"sun sensor"})
#: Plant files are edited so that stow is on the receiver beyond this size of the fault.
_ON_RECEIVER = 0.7
#: Longest run, since the sun must stay up, h.
MOST_HOURS = 8.0
#: Mean time between interruptions by operators, alone and with joint visits, which take two
#: minutes, s.
SHIFT_PAUSE, PARTY_PAUSE = 90.0, 300.0
#: The same as `NEAR` for motors in coarse steps, which may lag by two full steps, rad.
NEAR_COARSE = 4e-3
#: With so few heliostats, they join one at a time.
SETTINGS = PlantSettings(
    join_rate=0.5,
    join_burst=1,
    stow_rate=1.0,
    sensors=frozenset({FLUX_READING}),
    common=CommonSettings(),
)
#: The same plant in the world "sensors".
MEASURED = replace(SETTINGS, sensors=frozenset(READINGS))
#: The table without the rows on the fraction of failed nodes, which one of three or four exceeds.
TABLE = tuple(row for row in conditions() if row.reading != "node_fault_share")


@dataclass(frozen=True)
class RunPlan:
    """Definition of a run.

    Parameters
    ----------
    seed
        Seed of every random choice.
    seconds
        Duration in simulated time, s.
    heliostats
        Number of heliostats, 1 to 32; the seed puts them on one bus or on two.
    pause
        Mean time between faults, s.
    only
        Kinds of faults to draw from; () for all.
    faults
        Faults of the run; None if they are drawn from the seed.
    worlds
        Names of `WORLDS` that this run adds to the usual environment.
    acts
        Actions of the crew on a day ("days"); None if they are drawn from the seed.

    Raises
    ------
    InputError
        If a world is unknown, or a length or a number of heliostats cannot be simulated.
    """

    seed: int
    seconds: float = 600.0
    heliostats: int = 4
    pause: float = 12.0
    only: tuple[str, ...] = ()
    faults: tuple[Fault, ...] | None = None
    worlds: tuple[str, ...] = ()
    acts: tuple[CrewAct, ...] | None = None

    def __post_init__(self) -> None:
        checked(self.worlds)
        if not 0.0 < self.seconds <= 3600.0 * MOST_HOURS:
            raise InputError(
                f"the simulation must last more than 0 and at most {MOST_HOURS:g} h, as long as "
                f"the sun is up, not {self.seconds / 3600.0:g} h"
            )
        if not 1 <= self.heliostats <= 32:
            raise InputError(f"simulation of {self.heliostats} heliostats; a cluster has 1 to 32")
        if self.faults is None:
            kinds.drawn(0, 1.0, 1, pause=self.pause, only=self.only)

    @property
    def size(self) -> int:
        """Number of heliostats, large enough for joint visits or a flux limit if there are any."""
        least = PARTY if joint_visits(self.worlds) else 1
        if LIMIT in self.worlds:
            least = max(least, CLIMBING if ramped(self.seed) else LIMITED)
        return max(self.heliostats, least)

    @property
    def clusters(self) -> int:
        """Number of clusters, which is two for every third seed."""
        return 2 if self.seed % 3 == 2 and self.size > 1 else 1

    @property
    def drawn(self) -> tuple[Fault, ...]:
        """Faults of the run."""
        if self.faults is not None:
            return self.faults
        if TOUR in self.worlds:
            return ()
        return tuple(
            kinds.drawn(
                self.seed,
                self.seconds,
                self.size,
                pause=self.pause,
                only=self.only,
                worlds=self.worlds,
            )
        )


@dataclass
class RunResult:
    """Result of a run.

    Attributes
    ----------
    plan
        Definition of the run.
    violation
        The first violated invariant; None if none was violated.
    problem
        An exception from the code under test; empty if there was none.
    checks
        Number of checks of each invariant.
    faults
        Number of faults of each kind.
    counts
        Numbers of operator actions and of messages to the plant.
    states
        Number of times each state was entered.
    seconds
        Simulated time, s.
    """

    plan: RunPlan
    violation: Violation | None = None
    problem: str = ""
    checks: Counter[int] = field(default_factory=Counter)
    faults: Counter[str] = field(default_factory=Counter)
    counts: Counter[str] = field(default_factory=Counter)
    states: Counter[int] = field(default_factory=Counter)
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        """Whether no invariant was violated and no program failed."""
        return self.violation is None and not self.problem

    @property
    def command(self) -> str:
        """The command that replays the run."""
        plan = self.plan
        return (
            f"heliotrope simulate --seed {plan.seed} --hours {plan.seconds / 3600.0!r} "
            f"--heliostats {plan.heliostats} --pause {plan.pause!r}"
            + "".join(f" --only {kind}" for kind in plan.only)
            + "".join(f" --world {name}" for name in plan.worlds)
        )

    @property
    def text(self) -> str:
        """The failure in one line; empty for a good run."""
        if self.violation is not None:
            return str(self.violation)
        return self.problem


class Simulation:
    """One run; use `run`.

    Parameters
    ----------
    plan
        Definition of the run.
    loop
        Event loop whose virtual time is true time.

    Attributes
    ----------
    begin
        Start, s.
    boards, pods
        All heliostats, and the clusters that they belong to.
    plant
        The plant program; None while it is not running.
    disk
        Store of the plant's records.
    operator
        The operators of the plant.
    faults
        Number of faults of each kind so far.
    """

    def __init__(self, plan: RunPlan, loop: VirtualLoop) -> None:
        self.plan = plan
        self.faults: Counter[str] = Counter()
        self._chance = random.Random(f"simulation {plan.seed}")
        scene = self._scene = scene_of(plan.worlds, plan.seed, plan.seconds, plan.size)
        error = common_error(plan.worlds, plan.seed)
        self._loop, self._clock = loop, VirtualClock(loop.time, scene.start + error)
        self.begin = loop.time()
        self._suns: dict[int, FloatArray] = {}
        fits = motors_of(outfits(plan.size, plan.seed, scene.places), plan.worlds, plan.seed)
        known = surveyed(fits, plan.worlds, plan.seed)
        self._coarse = fits[0].machine.stepping == COARSE
        self._unsurveyed = {a.name for a, b in zip(fits, known, strict=True) if a is not b}
        stored = [
            replace(fit, items=stored_fit.items)
            for fit, stored_fit in zip(fits, stored_by(known, plan.worlds, plan.seed), strict=True)
        ]
        self.boards = [self._board(outfit) for outfit in stored]
        self.pods = self._new_pods()
        self._observe(scene)
        self._measured = measured(plan.worlds)
        homes = {pod.name: tuple(b.outfit.name for b in pod.boards) for pod in self.pods}
        together = joint_visits(plan.worlds)
        self._design, self._homes = design_of(known, homes, scene, together=together), homes
        self._sky: Sky | None = None
        if LIMIT in plan.worlds:
            sun = self.sun(self.begin)
            self._design = limited(self._design, sun, ramp=ramped(plan.seed))
            clear = clear_sky(float(azimuth_elevation(sun)[1]), scene.site.height)
            self._sky = Sky(self._clock, plan.seed, plan.seconds, clear)
        # The boards' desired items and assigned points survive the plant's program.
        self._fits = known
        self._wanted = wanted_of(known) if knows_boards(plan.worlds) else Wanted()
        self._exits = contextlib.ExitStack()
        self._store: PlantStore | None = None
        self._stows: dict[str, bytes] = {}
        self._emergency: EmergencyRecord = EmergencyDisk()
        self._assigned: Assigned = AssignedDisk()
        if REPAIRS in plan.worlds:
            self._store = PlantStore(self._clock, self.persons, self._exits)
            self._assigned, self._emergency = self._store.points, self._store.keeper
        self._assigned.keep({"STANDBY": {outfit.name: STANDBY for outfit in fits}})
        self.disk = RecordsDisk()
        self._outfits = fits
        self._employ()
        self.plant: PlantController | None = None
        self._program: list[asyncio.Task[None]] = []

    def _observe(self, scene: Scene) -> None:
        """Attach observers to boards, beams, sensors, alarms and operators."""
        plan = self.plan
        alone = "twice" not in plan.worlds
        self.persons = PersonsObserver(self.begin, self.boards, alone=alone)
        boards = {pod.name: pod.boards for pod in self.pods}
        most = LOSSES if works(plan.worlds) else None
        self.beams = BeamObserver(
            self.begin, boards, self.sun, scene.keep_outs, most, self._unsurveyed
        )
        self.beams.contradicted = COMMON in plan.worlds
        self.readings = SensorObserver(self.begin, boards)
        self.alarms = AlarmObserver(self.begin, boards, plan.worlds)
        accounts = {account.name: account for pod in self.pods for account in pod.observer.accounts}
        self.tickets = TicketObserver(self.begin, accounts)
        self.quiet = self._quiet_observer()
        for pod in self.pods:
            if self.quiet is not None:
                pod.answers.quiet = self.quiet.calm
        self.instruments = Instruments(self._clock, plan.seed, self._flux, self.readings)

    def _employ(self) -> None:
        """Create the operators, automatic control and the tour, and the plant's observer."""
        plan = self.plan
        observers = [pod.observer for pod in self.pods]
        self.observer = PlantObserver(
            self.begin, self.disk, SETTINGS, observers, automatic=works(plan.worlds)
        )
        others = (self.readings, self.alarms, self.tickets)
        panel = Panel(
            self.observer,
            self.beams,
            self.persons,
            others if self.quiet is None else (*others, self.quiet),
        )
        self.operator = self._people(
            plan.seed, Habits.of(plan.worlds, plan.seed), panel, not self._measured
        )
        self._maintenance: Maintenance | None = None
        if self._store is not None:
            self._maintenance = self.operator.maintenance = Maintenance(
                self.operator, self.boards, self._clock, plan.seed
            )
        self._work = self._new_work() if works(plan.worlds) else None
        self._tour: Tour | None = None
        if TOUR in plan.worlds:
            self._tour = Tour(self.operator, self.boards, self._clock, self.sun, plan.seed)
        self._second = self._second_plant() if "twice" in plan.worlds else None
        self._judges = panel.each
        if self._work is not None:
            self._judges += self._work.watch.each
        for pod in self.pods:
            pod.plant = self.observer

    def _quiet_observer(self) -> QuietObserver | None:
        """Return the observer of work; None if errors from the start hinder the work."""
        if not set(_WRONG).isdisjoint(self.plan.worlds):
            return None
        observers = {pod.name: pod.observer for pod in self.pods}
        near = NEAR_COARSE if self._coarse else NEAR
        return QuietObserver(
            self.begin, observers, self.sun, reaches=not drawn(self.plan.worlds), near=near
        )

    def _new_work(self) -> Working:
        """Return automatic control with its operators and its observer."""
        plan, clock = self.plan, self._clock
        boards = {board.outfit.name: board for board in self.boards}
        all_mirrors = mirrors_of(boards, MIRROR, MIRROR)
        self._covered = covered_by(tuple(boards), plan.worlds, plan.seed)

        def mirrors() -> Sequence[TrueMirror]:
            """Return the mirrors that reflect light."""
            return [mirror for mirror in all_mirrors() if mirror.heliostat not in self._covered]

        sight = FieldSnapshot(clock, mirrors, lambda: self.sun(clock.monotonic()))
        lights, together = "lights" in plan.worlds, joint_visits(plan.worlds)
        kind = DAY_WORK if DAYS in plan.worlds else LIT_WORK if lights else USUAL_WORK
        kind = replace(kind, together=together, lowest=self._scene.lowest)
        flux = None
        if self._sky is not None:
            flux = FluxObserver(self.begin, self.boards, self._design, self._sky)
        work = Work(plan.seed, sight, self._exits, kind, flux)
        watch = replace(self._new_watch(work, together=together), flux=flux)
        truth = {name: board.outfit.causes for name, board in boards.items()}
        acts = Acts(work, self.operator, watch, truth, clock, plan.seed)
        if DAYS in plan.worlds:
            crew = Crew(acts, self.boards, plan.seconds, rough=self._coarse, planned=plan.acts)
            return Working(work, crew, watch)
        pause = PARTY_PAUSE if together else SHIFT_PAUSE
        return Working(work, Shift(acts, pause, aims=flux is not None), watch)

    def _new_watch(self, work: Work, *, together: bool) -> Watch:
        begin, boards, targets = self.begin, self.boards, self._scene.targets
        dark = self._unsurveyed | self._covered
        zero = self._clock.utc().timestamp() - self._clock.monotonic()
        results = ResultObserver(
            begin, boards, work.records, self.sun, zero, dark, together=together
        )
        work.camera.on_photograph = results.photographed
        persons = [person.name for person in CREW]
        lowest = self._scene.lowest
        return Watch(
            VisitObserver(
                begin, boards, targets, work.away, followed=work.centred, dark=self._unsurveyed
            ),
            DayObserver(begin, boards, lowest),
            results,
            ProgressObserver(
                begin,
                boards,
                targets,
                together=together,
                across=drawn(self.plan.worlds),
                lowest=lowest,
                dark=dark,
                limited=LIMIT in self.plan.worlds,
            ),
            ShownObserver(
                begin, boards, self._homes, targets, self.observer, persons, self._unsurveyed
            ),
        )

    def _board(self, outfit: Outfit) -> Board:
        chance = self._chance
        start = chance.choice([0, chance.randrange(ticks.PERIOD), ticks.PERIOD - 2_000_000])
        counter = TickCounter(start, chance.choice([0.0, 1e-4, -1e-4, 5e-4]))
        play = chance.choice([0.0, 30.0])
        board = Board(outfit, seed=chance.getrandbits(32), ticks=counter, play=play)
        board.power_on(self.begin)
        return board

    def _new_pods(self) -> list[Pod]:
        count = self.plan.clusters
        cut = -(-len(self.boards) // count)
        pods = []
        for i in range(count):
            part = self.boards[i * cut : (i + 1) * cut]
            observer = Observer(part, self.begin, self.sun, self._scene.keep_outs)
            site, start = self._scene.site, self._clock.utc()
            name, errors = f"C{i + 1}", PodErrors(self.plan.worlds, self.plan.seed, i)
            pods.append(Pod(name, part, observer, self._clock, start, site, self._chance, errors))
        return pods

    def sun(self, now: float) -> FloatArray:
        """Return the true direction to the sun at a given loop time, (3,)."""
        place, part = divmod(now - self.begin, _SUN_EVERY)
        first, second = self._sun_at(int(place)), self._sun_at(int(place) + 1)
        mixed = first + (second - first) * (part / _SUN_EVERY)
        return np.asarray(mixed / np.linalg.norm(mixed))

    def _sun_at(self, place: int) -> FloatArray:
        sun = self._suns.get(place)
        if sun is None:
            sun = vector(self._scene.start.timestamp() + _SUN_EVERY * place, self._scene.site)
            self._suns[place] = sun
        return sun

    def _flux(self) -> float:
        """Return the fraction of beams on the receiver."""
        sun = self.sun(self._clock.monotonic())
        return float(np.mean([board.miss(sun, RECEIVER) <= OFF for board in self.boards]))

    def pod_of(self, fault: Fault) -> Pod:
        """Return the cluster that a fault affects."""
        board = self.boards[fault.target]
        return next(pod for pod in self.pods if board in pod.boards)

    @property
    def checks(self) -> Counter[int]:
        """Number of checks of each invariant."""
        judges = (*self._judges, *(judge for pod in self.pods for judge in pod.judges))
        return sum((judge.checks for judge in judges), Counter())

    # -- the plant -------------------------------------------------------------------------

    def start_plant(self, group: asyncio.TaskGroup) -> None:
        """Start the plant program, which inherits only the disk and the desired parameters."""
        links = {}
        for pod in self.pods:
            seed = self._chance.getrandbits(31)
            link = pod.line.end(0, pod.name, self._clock, seed=seed)
            pod.ear = PlantEar(pod, self.operator.panel)
            pod.tap = TappedLink(link, self._clock, pod.ear)
            links[pod.name] = pod.tap
        audit = self._audit = SimulatedAudit(self.disk, self._clock.utc().isoformat())
        if self._work is not None:
            self._wanted = wanted_of(self._fits)  # superseded by the store; see `Work.begins`
            noted = self.alarms.on_alarm
            self._work.control.opens(lambda alarm: noted(alarm, self._clock.monotonic()))
        if self._store is not None:
            self._read_plant_file()
        context = context_of(_PLANT)
        slow = self.disk.queue(self._clock, context) if "disk" in self.plan.worlds else None
        stores = Stores(audit, self._wanted, self._assigned, self._emergency, slow)
        plant = self.plant = self._begins(links, stores, self._chance.randbytes, self._settings())
        self.operator.begins(plant)
        self.instruments.plant = plant
        if self._sky is not None:
            self._sky.plant = plant
        parts = [*(link.run() for link in links.values()), plant.run()]
        if self._store is not None:
            parts.append(self._parks(self._store.service(plant, self._alarmed), self._store))
        if COMMON in self.plan.worlds:
            parts.append(self._sees(plant))
        if self._work is not None:
            parts.append(self._work.control.begins(plant).run())
        self._program = [group.create_task(part, context=context) for part in parts]

    def _begins(
        self,
        links: Mapping[str, Link],
        stores: Stores,
        entropy: Callable[[int], bytes],
        settings: PlantSettings = SETTINGS,
    ) -> PlantController:
        """Return a new plant program."""
        return PlantController(
            self._design,
            links,
            self._clock,
            stores,
            settings=settings,
            table=TABLE,
            entropy=entropy,
            on_alarm=self._alarmed,
        )

    def _people(self, seed: int, habits: Habits, panel: Panel, feeds: bool) -> Operator:
        """Return the operators who command a plant."""
        return Operator(
            self._clock,
            seed,
            habits,
            panel,
            self._outfits,
            self.pods,
            self._scene.keep_outs[0][0],
            self._flux if feeds else None,
        )

    def _settings(self) -> PlantSettings:
        """Return the settings of the plant."""
        settings = MEASURED if self._measured else SETTINGS
        if self._sky is not None:
            settings = replace(settings, sensors=settings.sensors | {DNI_READING})
        return replace(settings, witnesses=WITNESSES) if COMMON in self.plan.worlds else settings

    async def _parks(self, service: Service, store: PlantStore) -> None:
        """Send locked heliostats to stow, as automatic control does, and make backups."""
        assert self._maintenance is not None
        self._maintenance.service = service
        while True:
            service.park()
            store.look()
            await asyncio.sleep(1.0)

    async def _sees(self, plant: PlantController) -> None:
        """Show the true sun to a sun sensor."""
        (name,) = WITNESSES
        while True:
            plant.witnesses.take(name, self.sun(self._clock.monotonic()), SENSOR_ERROR)
            await asyncio.sleep(2.0)

    def edit_plant_file(self, fault: Fault) -> None:
        """Write another stow position into the plant file: nearby, or lighting the receiver.

        The plant must not send the second kind, because the stowed heliostat's beam would be on the
        receiver.
        """
        fit = self._fits[fault.target]
        steps = np.array([2000, -2000]) if fault.size < 0.5 else np.array([-1500, 1000])
        stow = np.array(MACHINE.stow) + steps
        if fault.size > _ON_RECEIVER:
            counts = np.array(MACHINE.stow, dtype=np.float64)
            sun = self.sun(self._clock.monotonic())
            best = track(fit.mechanism, sun, np.array(RECEIVER), current=counts).best_counts
            stow = np.rint(best).astype(int)
        self._stows = {fit.name: packed("stow", (int(stow[0]), int(stow[1])))}

    def _read_plant_file(self) -> None:
        """Require the plant file's stow positions; the next program finds the file corrected."""
        for fit in self._fits:
            self._wanted.set(fit.name, {"stow": self._stows.get(fit.name, fit.items["stow"])})
        self._stows = {}

    def restore_store(self) -> None:
        """Replace the plant's store with a backup."""
        if self._store is not None:
            self._store.restore()
            self._assigned, self._emergency = self._store.points, self._store.keeper

    def _second_plant(self) -> SecondPlant:
        def observers(disk: RecordsDisk) -> Panel:
            own = PlantObserver(self.begin, disk, SETTINGS, [pod.observer for pod in self.pods])
            return Panel(own, self.beams, PersonsObserver(self.begin, ()))

        return SecondPlant(
            self._clock,
            self.plan.seed,
            self._wanted,
            self._assigned,
            self.pods,
            observers,
            self._people,
            self._begins,
        )

    def run_twice(self, group: asyncio.TaskGroup, *, on: bool) -> None:
        """Run a second plant with the same keys, or end it."""
        if self._second is not None:
            self._second.turn(group, on=on)

    def _alarmed(self, alarm: Alarm) -> None:
        if self._work is not None:
            self._work.control.take_alarm(alarm)
        for each in self._judges:
            each.on_alarm(alarm, self._clock.monotonic())

    def crash_plant(self, now: float) -> None:
        """Kill the plant program at whatever point it is; the clusters lose their connections."""
        for pod in self.pods:
            if pod.ear is not None:
                pod.ear.end()
        if self._work is not None:
            self._work.control.ends()
        if self.plant is not None:
            self._audit.lose()
        for task in self._program:
            task.cancel()
        self._program, self.plant = [], None
        self.operator.waits = False
        self._loop.kill(_PLANT)
        self.disk.lose()
        self.operator.begins(None)
        if self._maintenance is not None:
            self._maintenance.service = None
        self.instruments.plant = None
        if self._sky is not None:
            self._sky.plant = None
        for each in self._judges:
            each.on_end(now)
        for pod in self.pods:
            pod.tap = pod.ear = None
            pod.line.drop()
            pod.observer.disturbed(now, crashed=True)

    def hang_plant(self, now: float, *, silent: bool, frozen: bool) -> None:
        """Silence the plant program, freeze it, or let it continue.

        A silenced program continues without its lines. In a frozen program nothing runs, and the
        operators wait.
        """
        runs = self.plant is not None
        self.observer.hangs(now, on=(silent or frozen) and runs, stands=frozen and runs)
        self._frozen(on=frozen and runs)
        for pod in self.pods:
            if pod.ear is not None:
                pod.ear.hang(on=silent)

    def _frozen(self, *, on: bool) -> None:
        self.operator.waits = on
        (self._loop.freeze if on else self._loop.thaw)(_PLANT)

    # -- the world -------------------------------------------------------------------------

    async def live(self) -> None:
        """Run to the end.

        Raises
        ------
        InvariantError
            Within an exception group, if an invariant is violated.
        """
        damage = Damage(self, self.plan.drawn)
        async with contextlib.AsyncExitStack() as stack:
            stack.enter_context(self._exits)
            group = await stack.enter_async_context(asyncio.TaskGroup())
            for pod in self.pods:
                pod.start(group)
            self.start_plant(group)
            tasks = [self.operator.keep(), self._persons()]
            if self._second is not None:
                tasks += [self._second.operator.keep(), self._second.work()]
            if self._measured:
                tasks.append(self.instruments.run())
            if self._sky is not None:
                tasks.append(self._sky.run())
            others = [group.create_task(work) for work in tasks]
            try:
                await self._turn(damage, group)
            finally:
                self._frozen(on=False)  # a frozen program could not end
                for pod in self.pods:
                    pod.freeze(on=False)
            if self._tour is not None and self.plan.seconds >= TOUR_LENGTH:
                saw = f"the tour has not ended after {self.plan.seconds:g} s"
                self.observer.check(11, self._tour.over, self._clock.monotonic(), "plant", saw)
            self.crash_plant(self._clock.monotonic())
            self.run_twice(group, on=False)
            for pod in self.pods:
                pod.crash()
            for task in others:
                task.cancel()

    async def _persons(self) -> None:
        if self._work is not None:
            await self._work.shift.work()
        await (self.operator if self._tour is None else self._tour).work()

    async def _turn(self, damage: Damage, group: asyncio.TaskGroup) -> None:
        """Advance boards, faults and observers until the end."""
        end, judged = self.begin + self.plan.seconds, self.begin
        while (now := self._clock.monotonic()) < end:
            # A fault that ends now has had an effect until now.
            hindered = [damage.hinders(pod) for pod in self.pods]
            damage.look(now, group)
            for board in self.boards:
                if board.due(now) <= now:
                    board.step(now)
            for pod, before in zip(self.pods, hindered, strict=True):
                pod.look(now, hindered=before or damage.hinders(pod))
            if now >= judged:
                for pod in self.pods:
                    pod.observer.look(now)
                self.observer.look(self.plant, now)
                carried = {pod.name for pod in self.pods if pod.carried(now)}
                self.beams.look(self.plant, carried, now)
                writes = not (self.disk.full or self.disk.busy(now))
                if self.quiet is not None:
                    going = None if self.operator.waits else self.plant
                    self.quiet.look(going, carried, damage.rest, now)
                    for pod in self.pods:
                        pod.answers.look(now)
                    self.alarms.look(
                        damage.rest,
                        carried,
                        now,
                        runs=going is not None,
                        writes=writes,
                        files={k: v for pod in self.pods for k, v in pod.file.items()},
                    )
                self.persons.look(self.plant, now)
                going_on = self.plant is not None and not self.operator.waits
                if COMMON in self.plan.worlds:
                    self.alarms.contradicted(now, runs=going_on)
                self.tickets.look(now, runs=going_on and writes)
                if self._work is not None:
                    calm = None if self.quiet is None else self.quiet.stretches
                    self._work.look(
                        self.plant,
                        calm,
                        self.sun(now),
                        now,
                        waits=self.operator.waits,
                        governs=self.observer.automatic,
                    )
                if self._measured:
                    runs = self.plant is not None and not self.operator.waits
                    self.readings.look(carried, now, runs=runs)
                judged = now + JUDGE
            times = [board.due(now) for board in self.boards]
            due = min(*times, damage.next, now + LOOK, end)
            await asyncio.sleep(max(1e-3, due - now))


# -- running -----------------------------------------------------------------------------------


def run(plan: RunPlan) -> RunResult:
    """Run a plan; failures are part of the outcome and are not raised."""
    outcome = RunResult(plan, seconds=plan.seconds)
    runner = asyncio.Runner(loop_factory=lambda: VirtualLoop(plan.seed))
    loop = runner.get_loop()
    assert isinstance(loop, VirtualLoop)
    begin = loop.time()
    loop.set_exception_handler(lambda _, about: _lost(about, outcome))
    simulation = Simulation(plan, loop)
    try:
        runner.run(simulation.live())
    except (Exception, BaseExceptionGroup) as error:  # noqa: BLE001 - it is the finding
        _blame(error, outcome)
        outcome.seconds = loop.time() - begin
    try:
        runner.close()
    except RuntimeError as error:  # a task does not end, for example in a frozen program
        outcome.problem = outcome.problem or f"the run does not end: {error}"
    outcome.checks = simulation.checks
    outcome.faults = simulation.faults
    outcome.counts = sum((pod.counts for pod in simulation.pods), simulation.operator.counts)
    outcome.counts["proofs"] = simulation.beams.proofs
    outcome.states = sum((pod.observer.entered for pod in simulation.pods), Counter())
    return outcome


def _lost(about: dict[str, Any], outcome: RunResult) -> None:
    """Record an exception of a task or of a callback that nobody awaited."""
    error = about.get("exception")
    if isinstance(error, Exception) and not outcome.problem:
        outcome.problem = f"{about['message']}: {type(error).__name__}: {error}"


def _blame(error: BaseException, outcome: RunResult) -> None:
    """Return the first failure among all exceptions in a task group."""
    errors = list(_leaves(error))
    for leaf in errors:
        if isinstance(leaf, InvariantError):
            outcome.violation = leaf.violation
            return
    first = errors[0]
    place = traceback.extract_tb(first.__traceback__)[-1]
    where = f"{Path(place.filename).name}, line {place.lineno}"
    outcome.problem = f"{type(first).__name__} at {where}: {first}"


def _leaves(error: BaseException) -> Iterator[BaseException]:
    if isinstance(error, BaseExceptionGroup):
        for part in error.exceptions:
            yield from _leaves(part)
    else:
        yield error


def shrink(outcome: RunResult, most: int = 60) -> RunResult:
    """Return a failed run with fewer faults that violates the same invariant.

    Parameters
    ----------
    outcome
        A failed run.
    most
        Maximum number of runs.

    Raises
    ------
    InputError
        If the run did not fail.
    """
    if outcome.good:
        raise InputError(
            f"seed {outcome.plan.seed}: no invariant was broken, so there are no faults to reduce"
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
