"""A backup of the plant is started on a second machine while the first one runs."""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator
from pathlib import Path

from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.link import running
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.refusals import RefusedError
from heliotrope.plant.settings import PlantSettings
from heliotrope.safety import FLUX_READING, alarms
from support.whole_plant import ENGINEER, WholePlant

OTHER = Person("Otto", Role.ENGINEER)
_SETTINGS = PlantSettings(sensors=frozenset({FLUX_READING}))


class Backup:
    """The second plant: the same keys, clusters and heliostats; it shares the clusters' lines."""

    def __init__(self, whole: WholePlant, folder: Path) -> None:
        self.links = {
            name: line.end(0, name, whole.clock, seed=77 + i)
            for i, (name, line) in enumerate(whole.lines.items())
        }
        self.audit = JsonLines(folder / "other.jsonl", whole.clock.utc())
        chance = random.Random(99)
        self.plant = PlantController(
            whole.design,
            self.links,
            whole.clock,
            Stores(self.audit),
            settings=_SETTINGS,
            entropy=chance.randbytes,
        )
        self._whole = whole
        self.token = 0

    async def _stay(self) -> None:
        while True:
            self.plant.put(FLUX_READING, self._whole.flux())
            self.plant.authority.keep(OTHER, self.token)
            await asyncio.sleep(1.0)

    @contextlib.asynccontextmanager
    async def alive(self) -> AsyncIterator["Backup"]:
        """Run it beside a block."""
        self.token = self.plant.take_authority(OTHER).token
        async with asyncio.TaskGroup() as group:
            stay = group.create_task(self._stay())
            async with running(*self.links.values()), running(self.plant):
                yield self
            stay.cancel()
        self.audit.close()

    def told(self, kind: alarms.AlarmKind) -> bool:
        """Whether an alarm stands."""
        found = [alarm.active for alarm in self.plant.alarms if alarm.condition == kind.name]
        return bool(found) and found[-1]


def commanded(plant: PlantController, person: Person, token: int, name: str) -> str:
    """Give a command to all; return why it is refused, "" if it is not."""
    try:
        plant.command(person, token, name)
    except RefusedError as error:
        return str(error)
    return ""


def test_the_second_plant_is_named_and_moves_nothing_but_may_defocus(tmp_path: Path) -> None:
    async def main(clock: VirtualClock) -> None:
        async with WholePlant(clock, tmp_path, clusters=1, seed=3).alive() as whole:
            first = whole.plant
            first.aim(ENGINEER, whole.token, first.default_aims())
            first.command(ENGINEER, whole.token, "APPROACH")
            await whole.until(lambda: whole.all_are("IDLE"), 300.0)
            async with Backup(whole, tmp_path).alive() as second:
                await whole.until(lambda: second.told(alarms.SECOND_PLANT), 60.0)
                text = next(a.text for a in second.plant.alarms if a.condition == "second_plant")
                assert f"K1 belong to run {first.name}" in text
                named = [a for a in first.alarms if a.condition == alarms.TWO_PLANTS.name]
                assert second.plant.name in named[0].text
                assert named[0].subject == "K1"
                for _ in range(20):
                    refused = commanded(second.plant, OTHER, second.token, "LOCK")
                    assert "belong to another plant with the same keys" in refused
                    await whole.wait(0.3)
                assert "LOCKED" not in whole.states().values()
                second.plant.defocus("Otto")
                await whole.until(
                    lambda: not {"IDLE", "TRACKING"} & set(whole.states().values()), 10.0
                )
            # The first one has the cluster as before.
            await whole.wait(10.0)
            ticket = first.command(ENGINEER, whole.token, "LOCK")
            assert await ticket.end(20.0), ticket.text
            assert whole.all_are("LOCKED")

    run_virtual(main, seed=5)


def test_a_plant_that_replaces_another_has_the_clusters_once_its_lease_is_over(
    tmp_path: Path,
) -> None:
    async def main(clock: VirtualClock) -> None:
        async with WholePlant(clock, tmp_path, clusters=1, seed=3).alive() as whole:
            whole.lines["K1"].drop()
            await whole.plant.close()
            begin = clock.monotonic()
            async with Backup(whole, tmp_path).alive() as second:
                while not whole.all_are("LOCKED"):
                    assert clock.monotonic() - begin < 30.0
                    commanded(second.plant, OTHER, second.token, "LOCK")
                    await whole.wait(0.1)
                assert clock.monotonic() - begin >= 2.0
                assert not second.told(alarms.SECOND_PLANT)

    run_virtual(main, seed=5)
