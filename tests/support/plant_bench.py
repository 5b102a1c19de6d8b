"""A plant with scripted clusters in virtual time; the test tells them what to do."""

import asyncio
import contextlib
import functools
import struct
from collections.abc import AsyncIterator, Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.field.example import example_plant
from heliotrope.field.plant import Plant
from heliotrope.files.disk import Then, Work
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, sleep_until
from heliotrope.links.in_process import Faults, MemoryLine, memory_pair
from heliotrope.links.link import Link, LinkClosedError, received
from heliotrope.links.messages import (
    NEVER,
    NODE,
    Answer,
    Ask,
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    Stage,
    decode,
    encode,
)
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.settings import PlantSettings

OPERATOR = Person("Olga", Role.OPERATOR)
ENGINEER = Person("Egon", Role.ENGINEER)
VIEWER = Person("Vera", Role.VIEWER)
_STEPS = ("primary", "secondary", "primary_goal", "secondary_goal")
#: State to which a command leads at once.
LEADS = {
    "APPROACH": states.IDLE,
    "IDLE": states.IDLE,
    "TRACK": states.TRACKING,
    "REFOCUS": states.TRACKING,
    "LOCK": states.LOCKED,
    "DEFOCUS": states.DEFOCUSED,
    "STOW": states.STOWED,
    "SEARCH": states.SEARCHING,
    "DIAGNOSE": states.IDLE,
}


Rows = npt.NDArray[Any]


def in_one_cluster() -> Plant:
    """The example plant as one cluster, for tests of whole hours: each line costs its time."""
    plant = example_plant()
    azel = plant.groups["azel"]
    one = replace(azel, cluster=("pod",) * len(azel.names))
    return replace(plant, groups={"azel": one})


class ScriptedCluster:
    """The cluster at the other end of a link: it obeys at once, except as the test tells it.

    Attributes
    ----------
    deaf, stubborn
        Heliostats that acknowledge nothing, and that refuse all commands.
    untold
        Heliostats whose step counts are not heard any more; their states are.
    mute
        It sends no status.
    taken
        Messages in the order of arrival, with their times.
    rows, age_ms
        Its status, and the age of each row.
    polled_ms
        Age of the step counts beyond that of their row.
    stored
        Items of each heliostat's journal.
    poses
        Completes the rows with the step counts of heliostats that track.
    found
        What a search of its bus finds; None: it refuses to search.
    diagnoses
        Results of diagnoses by heliostat, as `lcu.diagnosis` has them; none: it knows no question.
    late, site, settings
        Error of its time, s; the site and the checksum of settings that it reports.
    """

    def __init__(self, name: str, names: tuple[str, ...], link: Link, clock: VirtualClock) -> None:
        self.name, self.names, self.link, self.clock = name, names, link, clock
        self.deaf: set[str] = set()
        self.stubborn: set[str] = set()
        self.untold: set[str] = set()
        self._told: dict[str, tuple[float, Any]] = {}
        self.mute = False
        self.greets = True
        self.taken: list[tuple[float, Message]] = []
        self.rows = np.zeros(len(names), NODE)
        self.rows["state"] = states.STOWED
        self.age_ms = np.zeros(len(names), dtype=np.int64)
        self.polled_ms = 0
        self.stored: dict[str, dict[str, bytes]] = {name: {} for name in names}
        self.token = 0
        self.first = True
        self.poses: Callable[[Rows], Rows] = lambda rows: rows
        self.late = 0.0
        self.site: tuple[float, ...] = ()
        self.settings = ""
        self.found: list[dict[str, Any]] | None = None
        self.diagnoses: dict[str, int] = {}

    def of(self, kind: type[Any] | tuple[type[Any], ...]) -> list[Any]:
        """The messages of a kind, or of some."""
        return [message for _, message in self.taken if isinstance(message, kind)]

    def commands(self, name: str) -> list[Command]:
        """The commands of a name."""
        return [message for message in self.of(Command) if message.name == name]

    def set(self, state: int, *names: str) -> None:
        """Put heliostats (none: all) into a state."""
        for name in names or self.names:
            self.rows["state"][self.names.index(name)] = state

    async def run(self) -> None:
        """Hear and tell until the link is closed."""
        async with asyncio.TaskGroup() as group:
            running = group.create_task(self.link.run())
            telling = group.create_task(self._tell())
            async for data in received(self.link):
                await self._take(decode(data))
            telling.cancel()
            await running

    async def _tell(self) -> None:
        due = self.clock.monotonic()
        while True:
            due += 1.0
            if self.link.connected and not self.mute:
                rows = self.poses(self.rows.copy())
                rows["heard_ms"] = np.where(self.age_ms < 0, NEVER, np.maximum(self.age_ms, 0))
                rows["steps_ms"] = np.where(
                    self.age_ms < 0, NEVER, rows["heard_ms"] + self.polled_ms
                )
                for name in self.untold:
                    at, last = self._told.setdefault(
                        name, (self.clock.monotonic(), rows[self.names.index(name)].copy())
                    )
                    row = rows[self.names.index(name)]
                    for each in _STEPS:
                        row[each] = last[each]
                    row["steps_ms"] += round(1e3 * (self.clock.monotonic() - at))
                greet = self.first and self.greets
                status = ClusterStatus(
                    self.name,
                    len(rows),
                    self.clock.utc().timestamp() - self.late,
                    "gps",
                    1e-3,
                    3.0,
                    0.2,
                    names=self.names if greet else (),
                    site=self.site,
                    settings=self.settings,
                    block=rows.tobytes(),
                )
                await self.send(status)
                self.first = False
            await sleep_until(self.clock, due)

    async def send(self, message: Message) -> None:
        """Send a message, unless the test is over."""
        with contextlib.suppress(LinkClosedError):
            await self.link.send(encode(message), expires=self.clock.monotonic() + 1.0)

    async def _take(self, message: Message) -> None:
        self.taken.append((self.clock.monotonic(), message))
        if isinstance(message, Lease):
            self.token = message.token
        elif isinstance(message, Emergency):
            await self._obey(message.identity, message.name, message.heliostats)
        elif isinstance(message, Command):
            if message.token != self.token or not self.token:
                await self.send(Progress(message.identity, Stage.REFUSED, (), "not the authority"))
                return
            await self._obey(message.identity, message.name, message.heliostats)
        elif isinstance(message, Parameters):
            self.stored[message.heliostat].update(message.items())
            for stage in (Stage.ACCEPTED, Stage.SENT, Stage.ACKNOWLEDGED, Stage.DONE):
                await self.send(Progress(message.identity, stage, (message.heliostat,)))
        elif isinstance(message, Ask):
            await self.send(self._answer(message))

    def _answer(self, ask: Ask) -> Answer:
        if ask.what == "statistics":
            return Answer(ask.identity, {name: {} for name in self.names})
        if ask.what == "discover" and self.found is not None:
            return Answer(ask.identity, {"found": self.found})
        if ask.what == "diagnosis" and ask.heliostat in self.diagnoses:
            return Answer(ask.identity, {"result": self.diagnoses[ask.heliostat]})
        if ask.what == "stored" and ask.heliostat not in self.deaf:
            items = self.stored[ask.heliostat] or {"address": struct.pack("<H", 1)}
            sizes = [len(data) for data in items.values()]
            return Answer(
                ask.identity, {"names": list(items), "sizes": sizes}, b"".join(items.values())
            )
        return Answer(ask.identity, {"error": f"{ask.heliostat} does not answer"})

    async def _obey(self, identity: str, name: str, heliostats: tuple[str, ...]) -> None:
        named = heliostats or self.names
        await self.send(Progress(identity, Stage.ACCEPTED, ()))
        await self.send(Progress(identity, Stage.SENT, named))
        refused = tuple(n for n in named if n in self.stubborn and name not in ("DEFOCUS", "STOW"))
        good = tuple(n for n in named if n not in self.deaf and n not in refused)
        if refused:
            await self.send(Progress(identity, Stage.REFUSED, refused, "not in this state"))
        if not good:
            return
        await self.send(Progress(identity, Stage.ACKNOWLEDGED, good))
        if name in LEADS:
            self.set(LEADS[name], *good)
        await self.send(Progress(identity, Stage.DONE, good))


class Bench:
    """A plant, its scripted clusters, and the lines between them."""

    def __init__(
        self,
        clock: VirtualClock,
        folder: Path,
        *,
        design: Plant | None = None,
        faults: Faults | None = None,
        seed: int = 1,
        **options: Any,
    ) -> None:
        self.clock = clock
        self.design = design or example_plant()
        if "volumes" in options:
            self.design = replace(self.design, keep_outs=tuple(options.pop("volumes")))
        if "eyes" in options:
            eyes = {f"eye {i}": np.array(eye) for i, eye in enumerate(options.pop("eyes"))}
            self.design = replace(self.design, eyes=eyes)
        names = {each.name for each in fields(Stores)}
        kept = {name: options.pop(name) for name in names.intersection(options)}
        self.audit = JsonLines(folder / "audit.jsonl", clock.utc())
        held: dict[str, list[str]] = {}
        for group in self.design.groups.values():
            for name, cluster in zip(group.names, group.cluster, strict=True):
                held.setdefault(cluster, []).append(name)
        links = self.links = dict[str, Link]()
        self.lines: dict[str, MemoryLine] = {}
        self.clusters: dict[str, ScriptedCluster] = {}
        for i, (name, names) in enumerate(held.items()):
            near, far, line = memory_pair(
                clock, names=("plant", name), faults=faults, seed=100 * seed + i
            )
            links[name], self.lines[name] = near, line
            self.clusters[name] = ScriptedCluster(name, tuple(names), far, clock)
        counter = iter(range(1, 10_000))
        self.plant = PlantController(
            self.design,
            links,
            clock,
            Stores(self.audit, **kept),
            entropy=lambda n: (next(counter) * 7919).to_bytes(n, "little"),
            **{"settings": PlantSettings(), **options},
        )
        for cluster in self.clusters.values():
            cluster.poses = functools.partial(self._tracking, cluster)

    def _tracking(self, cluster: ScriptedCluster, rows: Rows) -> Rows:
        """Put heliostats that track, and of which the test says nothing, on their aims."""
        plant = self.plant
        places = np.array([plant.field.place(n) for n in cluster.names], dtype=np.intp)
        silent = ~np.any([rows[n] for n in _STEPS], axis=0) & (rows["state"] == states.TRACKING)
        mine = np.flatnonzero(silent & np.isfinite(plant.aims[places]).all(axis=-1))
        if len(mine):
            found = plant.beams.poses(places[mine], plant.aims[places[mine]], plant.sun_vector())
            counts = np.rint(found.best_counts).astype(np.int32)
            for i, name in enumerate(_STEPS):
                rows[name][mine] = counts[:, i % 2]
        return rows

    def cluster_of(self, name: str) -> ScriptedCluster:
        """The cluster of a heliostat."""
        return next(c for c in self.clusters.values() if name in c.names)

    def count(self, state: int) -> int:
        """How many heliostats are in a state, in truth."""
        return sum(int((c.rows["state"] == state).sum()) for c in self.clusters.values())

    async def wait(self, seconds: float) -> None:
        """Let time pass."""
        await sleep_until(self.clock, self.clock.monotonic() + seconds)

    async def until(self, what: Callable[[], bool], limit: float = 60.0) -> float:
        """Wait until something holds; return how long that took, s."""
        begin = self.clock.monotonic()
        while not what():
            assert self.clock.monotonic() - begin < limit, f"not within {limit} s"
            await self.wait(0.05)
        return self.clock.monotonic() - begin

    async def commanded(self, person: Person = OPERATOR) -> int:
        """Take the authority, and wait until commands are accepted; return the token."""
        token = self.plant.take_authority(person).token
        for _ in range(8):
            await self.wait(0.5)
            self.plant.authority.keep(person, token)
        return token


class SlowDisk:
    """A disk in virtual time that takes some seconds for each piece of work."""

    def __init__(self, clock: VirtualClock) -> None:
        self.clock, self.delay = clock, 0.0
        self._free_at = 0.0

    def do(self, work: Work, then: Then) -> None:
        """Do work when all earlier work is done and the time of this one is over."""
        now = self.clock.monotonic()
        self._free_at = max(self._free_at, now) + self.delay

        def do() -> None:
            try:
                work()
            except Exception as error:  # noqa: BLE001 - as every disk
                then(error)
            else:
                then(None)

        asyncio.get_running_loop().call_later(self._free_at - now, do)

    def close(self) -> None:
        """Nothing to do."""


@contextlib.asynccontextmanager
async def running(bench: Bench) -> AsyncIterator[Bench]:
    """Run a bench, its clusters first, until the block ends."""
    failure: Exception | None = None
    async with asyncio.TaskGroup() as group:
        others = [group.create_task(cluster.run()) for cluster in bench.clusters.values()]
        others += [group.create_task(link.run()) for link in bench.links.values()]
        task = group.create_task(bench.plant.run())
        try:
            await bench.wait(3.0)
            yield bench
        except Exception as error:  # noqa: BLE001 (it goes on as it came, not in a group)
            failure = error
        finally:
            await bench.plant.close()
            await task
            for cluster in bench.clusters.values():
                await cluster.link.close()
            await asyncio.gather(*others)
            bench.audit.close()
    if failure is not None:
        raise failure
