"""A second plant with the same keys: a backup that somebody starts while the first plant runs.

It has the records, points and parameters of the moment at which it is started, people of its own,
and the same lines, which it and the first plant take from each other.
"""

import asyncio
import random
from collections.abc import Callable, Mapping, Sequence

from heliotrope.field.plant import Plant
from heliotrope.links.clock import VirtualClock
from heliotrope.links.tapped import TappedLink
from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant.controller import PlantController
from heliotrope.plant.field.assigned import Assigned
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import Alarm, Condition
from heliotrope.twin.boards.outfit import Ball, Outfit
from heliotrope.twin.invariants.beams import BeamObserver
from heliotrope.twin.invariants.panel import Panel
from heliotrope.twin.invariants.persons import PersonsObserver
from heliotrope.twin.invariants.plant_observer import PlantObserver
from heliotrope.twin.records import AssignedDisk, RecordsDisk, SimulatedAudit
from heliotrope.twin.world.operator import Operator
from heliotrope.twin.world.pod import PlantEar, Pod
from heliotrope.twin.world.worlds import Habits

#: Mean time between two commands of its people, s.
_PAUSE = 1.5


class SecondPlant:
    """The second plant, which runs now and then.

    Parameters
    ----------
    clock, seed
        True time; seed of everything that it draws.
    design, homes, settings, table
        As of the first plant.
    wanted, assigned
        Of the first plant, copied at each start.
    pods, fits, keep_out
        Clusters, heliostats, and the middle of a keep-out volume.
    beams, flux
        Observer of the beams; returns the share of the beams on the receiver.
    on_alarm
        Called with each alarm.

    Attributes
    ----------
    observer
        Observer of this plant's authority, records and messages.
    operator
        Its people.
    plant
        None while it does not run.
    """

    def __init__(
        self,
        clock: VirtualClock,
        seed: int,
        design: Plant,
        homes: Mapping[str, Sequence[str]],
        settings: PlantSettings,
        table: tuple[Condition, ...],
        wanted: Wanted,
        assigned: Assigned,
        pods: Sequence[Pod],
        fits: Sequence[Outfit],
        keep_out: Ball,
        beams: BeamObserver,
        flux: Callable[[], float],
        on_alarm: Callable[[Alarm], None],
    ) -> None:
        self._clock, self._chance = clock, random.Random(f"twice {seed}")
        self._design, self._homes, self._settings, self._table = design, homes, settings, table
        self._wanted, self._assigned, self._pods = wanted, assigned, pods
        self._on_alarm = on_alarm
        self.plant: PlantController | None = None
        self._disk = RecordsDisk()
        self.observer = PlantObserver(
            clock.monotonic(), self._disk, settings, [pod.observer for pod in pods]
        )
        self._persons = PersonsObserver(clock.monotonic(), ())
        panel = Panel(self.observer, beams, self._persons)
        self.operator = Operator(
            clock,
            -1 - seed,
            Habits(),
            panel,
            fits,
            pods,
            keep_out[0],
            flux,
        )
        self._program: list[asyncio.Task[None]] = []

    async def work(self) -> None:
        """Let its people lead mirrors on, one at a time."""
        while True:
            await asyncio.sleep(self._chance.expovariate(1.0 / _PAUSE))
            if self.plant is not None:
                self.operator.clear(self.plant)
                self.operator.onward(self.plant)

    def turn(self, group: asyncio.TaskGroup, *, on: bool) -> None:
        """Start its program, or kill it."""
        if on and self.plant is None:
            self._start(group)
        elif not on and self.plant is not None:
            self._end()

    def _start(self, group: asyncio.TaskGroup) -> None:
        links = {}
        for pod in self._pods:
            link = pod.line.end(0, pod.name, self._clock, seed=self._chance.getrandbits(31))
            links[pod.name] = TappedLink(link, self._clock, PlantEar(pod, self.operator.panel))
        assigned = AssignedDisk()
        assigned.keep(self._assigned.read())
        self.plant = PlantController(
            self._design,
            links,
            self._clock,
            SimulatedAudit(self._disk, self._clock.utc().isoformat()),
            clusters=self._homes,
            settings=self._settings,
            wanted=Wanted({name: dict(some) for name, some in self._wanted.items.items()}),
            assigned=assigned,
            table=self._table,
            entropy=self._chance.randbytes,
            on_alarm=self._on_alarm,
        )
        self.operator.begins(self.plant)
        parts = (*(link.run() for link in links.values()), self.plant.run())
        self._program = [group.create_task(part) for part in parts]

    def _end(self) -> None:
        for task in self._program:
            task.cancel()
        self._program, self.plant = [], None
        self._disk.lose()
        self.operator.begins(None)
        self._persons.forget()
        self.observer.on_end(self._clock.monotonic())
