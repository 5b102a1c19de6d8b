"""A second plant with the same keys: a backup that is started while the first plant runs.

The second plant has the records, points and parameters of the time at which it is started, its own
operators, and the same lines, for which the two plants compete.
"""

import asyncio
import random
from collections.abc import Callable, Mapping, Sequence

from heliotrope.links.clock import VirtualClock
from heliotrope.links.link import Link
from heliotrope.links.tapped import TappedLink
from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.field.assigned import Assigned
from heliotrope.twin.invariants.panel import Panel
from heliotrope.twin.records import AssignedDisk, RecordsDisk, SimulatedAudit
from heliotrope.twin.world.operator import Operator
from heliotrope.twin.world.pod import PlantEar, Pod
from heliotrope.twin.world.worlds import Habits

#: Mean time between two commands of its operators, s.
_PAUSE = 1.5


#: Creates a plant program from its links, its stores, and a source of random bytes.
Begins = Callable[[Mapping[str, Link], Stores, Callable[[int], bytes]], PlantController]
#: Creates the operators of a plant from a seed, their habits, its observers, and whether they enter
#: the flux on the receiver.
People = Callable[[int, Habits, Panel, bool], Operator]


class SecondPlant:
    """The second plant, which runs occasionally.

    Parameters
    ----------
    clock, seed
        Clock that shows true time; seed of all random choices.
    wanted, assigned
        Parameters and points of the first plant, copied at each start.
    pods
        The clusters whose lines the second plant takes over.
    observers
        Function that creates the observers of a plant with records on a disk.
    people
        Function that creates the operators of a plant.
    begins
        Function that creates the plant program from its links, its stores, and a source of random
        bytes.

    Attributes
    ----------
    observer
        Observer of this plant's authority, records and messages.
    operator
        Its operators.
    plant
        The plant; None while it is not running.
    """

    def __init__(
        self,
        clock: VirtualClock,
        seed: int,
        wanted: Wanted,
        assigned: Assigned,
        pods: Sequence[Pod],
        observers: Callable[[RecordsDisk], Panel],
        people: People,
        begins: Begins,
    ) -> None:
        self._clock, self._chance = clock, random.Random(f"twice {seed}")
        self._wanted, self._assigned, self._pods, self._begins = wanted, assigned, pods, begins
        self.plant: PlantController | None = None
        self._disk = RecordsDisk()
        panel = observers(self._disk)
        self.observer, self._persons = panel.plant, panel.persons
        self.operator = people(-1 - seed, Habits(), panel, True)
        self._program: list[asyncio.Task[None]] = []

    async def work(self) -> None:
        """Let the second plant's operators raise heliostats one at a time."""
        while True:
            await asyncio.sleep(self._chance.expovariate(1.0 / _PAUSE))
            if self.plant is not None:
                self.operator.clear(self.plant)
                self.operator.onward(self.plant)

    def turn(self, group: asyncio.TaskGroup, *, on: bool) -> None:
        """Start the second plant's program, or kill it."""
        if on and self.plant is None:
            self._start(group)
        elif not on and self.plant is not None:
            self._end()

    def _start(self, group: asyncio.TaskGroup) -> None:
        links = {}
        for pod in self._pods:
            link = pod.line.end(0, pod.name, self._clock, seed=self._chance.getrandbits(31))
            links[pod.name] = TappedLink(link, self._clock, PlantEar(pod, self.operator.panel))
        assigned, wanted = AssignedDisk(), self._wanted.items
        assigned.keep(self._assigned.read())
        stores = Stores(
            SimulatedAudit(self._disk, self._clock.utc().isoformat()),
            Wanted({name: dict(some) for name, some in wanted.items()}),
            assigned,
        )
        self.plant = self._begins(links, stores, self._chance.randbytes)
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
