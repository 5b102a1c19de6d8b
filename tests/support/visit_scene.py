"""What the tests of visits by many heliostats share: a scene, its person, what is believed."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np

from heliotrope.calibration.record import HeliostatCalibration
from heliotrope.lcu import states
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.visits import CycleSettings
from support.live import LivePlant

START = datetime(2026, 10, 21, 7, tzinfo=UTC)
ENGINEER = Person("Egon", Role.ENGINEER)
BIASES = ("azimuth_bias", "elevation_bias")
#: One sighting is fitted, which the plant's own settings would not do.
CYCLE = CycleSettings(least=1, model=BIASES, sigma=2e-4)


@dataclass
class VisitScene:
    """A plant whose heliostats are up, and an engineer in command; `stages` are those told."""

    live: LivePlant
    token: int
    stages: list[str] = field(default_factory=list)
    during: Callable[[str], None] = lambda _: None

    @property
    def names(self) -> tuple[str, ...]:
        return self.live.plant.field.names

    def tell(self, stage: str) -> None:
        self.stages.append(stage)
        self.during(stage)

    def photographs(self) -> int:
        return sum(stage.startswith("photograph") for stage in self.stages)

    def states(self) -> dict[str, str]:
        rows = self.live.plant.field.rows["state"]
        return {name: states.STATES[rows[i]] for i, name in enumerate(self.names)}


def believe(live: LivePlant, sigma: float) -> None:
    """Take all mirrors for calibrated, their zeros within ``sigma``, rad."""
    at, spread = live.clock.utc().timestamp(), np.diag([sigma**2, sigma**2])
    for name in live.plant.field.names:
        record = HeliostatCalibration(name, at, BIASES, np.zeros(2), spread, np.full(2, 5e-3))
        live.plant.beliefs.take(record)


def left_to_work(made: VisitScene) -> None:
    """Take all mirrors for calibrated to 1 mrad, and leave the field to automatic control."""
    live = made.live
    believe(live, 1e-3)
    live.plant.release_authority(ENGINEER, made.token)
    live.operations.give_back(ENGINEER)
    live.operations.automatic.switch(on=True)


async def raised(live: LivePlant, limit: float = 600.0) -> None:
    """Let automatic control raise the field; return when all track, and it has halted."""
    until = live.clock.monotonic() + limit
    while not live.plant.field.among((states.TRACKING,), live.plant.now()).all():
        assert live.clock.monotonic() < until, live.plant.field.counted()
        await asyncio.sleep(1.0)
    await live.operations.automatic.halt()


async def in_command(made: VisitScene, play: Callable[[], Awaitable[None]]) -> None:
    """Play a scene while the engineer keeps the command authority, as long as it is theirs."""

    async def stay() -> None:
        plant = made.live.plant
        while True:
            if plant.authority.token == made.token:
                plant.authority.keep(ENGINEER, made.token)
            await asyncio.sleep(1.0)

    async with asyncio.TaskGroup() as group:
        staying = group.create_task(stay())
        try:
            await play()
        finally:
            staying.cancel()
