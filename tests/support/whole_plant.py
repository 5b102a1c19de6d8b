"""A whole plant in virtual time: the plant, real clusters, real local controllers, true mirrors."""

import asyncio
import contextlib
import random
import struct
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.cluster.controller import Cluster
from heliotrope.cluster.timekeeping import SystemTime
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.lcu import states
from heliotrope.links.clock import VirtualClock, sleep_until
from heliotrope.links.connection import CarriedLink
from heliotrope.links.in_process import MemoryLine, memory_pair
from heliotrope.links.link import Link, running
from heliotrope.mechanism import kinds
from heliotrope.mechanism.board_items import Wanted, items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits.photographs import Shot
from heliotrope.safety import FLUX_READING
from heliotrope.sun import Site
from heliotrope.twin.boards import outfit
from heliotrope.twin.boards.board import Board
from heliotrope.twin.boards.bus import TwinBus

ENGINEER = Person("Egon", Role.ENGINEER)
SITE = Site(37.09, -2.36, 500.0, name="Tabernas")
_CORNERS = ((3.0, 0.0, 43.0), (-3.0, 0.0, 43.0), (-3.0, 0.0, 37.0), (3.0, 0.0, 37.0))
#: Without marks: for cameras that read no pixels.
TARGET = Target("white", np.array(_CORNERS), np.array([0.0, 0.0, 40.0]))
MACHINE = outfit.MACHINE


def nominal(count: int) -> Mechanism:
    """Perfect heliostats in an arc north of the tower."""
    bearing = np.radians(np.linspace(-30.0, 30.0, count))
    away = np.linspace(70.0, 110.0, count)
    place = np.stack([away * np.sin(bearing), away * np.cos(bearing), np.zeros(count)], axis=-1)
    gear = {"steps_per_turn": 200, "gear_ratio": outfit.STEPS_PER_TURN / 800, "microsteps": 4}
    return kinds.azimuth_elevation(
        place, pivot_height=2.0, pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear))
    )


def installed(perfect: Mechanism, seed: int) -> Mechanism:
    """As they really stand: some milliradians off."""
    rng = np.random.default_rng(seed)
    causes = ("azimuth_bias", "elevation_bias", "tilt_north", "tilt_east", "canting")
    return perfect.with_parameters({name: rng.normal(0.0, 2e-3, len(perfect)) for name in causes})


class WholePlant:
    """Clusters of two heliostats each, with everything real but motors, mirrors and bus."""

    def __init__(
        self,
        clock: VirtualClock,
        folder: Path,
        clusters: int = 2,
        seed: int = 1,
        target: Target = TARGET,
        *,
        tilt_sensors: bool = False,
        **options: Any,
    ) -> None:
        self.clock = clock
        count = 2 * clusters
        names = tuple(f"H{i + 1}" for i in range(count))
        homes = tuple(f"K{i // 2 + 1}" for i in range(count))
        perfect = nominal(count)
        self.truth = installed(perfect, seed)
        self.design = Plant(
            "whole",
            SITE,
            {
                "all": Heliostats(
                    names,
                    perfect,
                    np.full(count, 3.0),
                    np.full(count, 2.0),
                    cluster=homes,
                    machines=(replace(MACHINE, tilt_sensor=True),) * count if tilt_sensors else (),
                )
            },
            targets=(target,),
            receivers=(
                Receiver(
                    "receiver",
                    "planar",
                    np.array(outfit.RECEIVER),
                    np.array([0.0, 1.0, 0.0]),
                    4.0,
                    4.0,
                ),
            ),
        )
        wanted = {name: items_of(perfect[i], MACHINE) for i, name in enumerate(names)}
        like = outfit.outfits(1)[0]
        self.boards: dict[str, Board] = {}
        self.clusters: list[Cluster] = []
        self.parts: list[Any] = []
        links: dict[str, Link] = {}
        self.lines: dict[str, MemoryLine] = {}
        for k in range(clusters):
            members, stations = [], []
            for i in (2 * k, 2 * k + 1):
                address = 11 + i
                items = {**wanted[names[i]], "address": struct.pack("<H", address)}
                fit = replace(
                    like,
                    name=names[i],
                    address=address,
                    serial=5000 + i,
                    key=bytes([address]) * 32,
                    mechanism=self.truth[i],
                    items=items,
                )
                board = self.boards[names[i]] = Board(fit, seed=seed + i)
                stations.append(board)
                members.append(Member(names[i], address, serial=5000 + i, key=fit.key))
            near, far, line = memory_pair(clock, names=("plant", f"K{k + 1}"), seed=10 * seed + k)
            self.lines[f"K{k + 1}"] = line
            links[f"K{k + 1}"] = near
            self.parts.append(near)
            self._cluster(ClusterConfig(f"K{k + 1}", SITE, tuple(members)), stations, far)
        self.audit = JsonLines(folder / "audit.jsonl", clock.utc())
        chance = random.Random(seed)
        self.plant = PlantController(
            self.design,
            links,
            clock,
            Stores(self.audit, Wanted(wanted)),
            entropy=chance.randbytes,
            **{"settings": PlantSettings(sensors=frozenset({FLUX_READING})), **options},
        )
        self.token = 0

    def _cluster(self, config: ClusterConfig, stations: list[Board], link: CarriedLink) -> None:
        bus, time = TwinBus(self.clock, [*stations]), SystemTime(self.clock)
        self.parts += [bus, time, link]
        self.clusters.append(Cluster(config, bus, link, self.clock, time))

    async def _tick(self) -> None:
        while True:
            now = self.clock.monotonic()
            for board in self.boards.values():
                if board.due(now) <= now:
                    board.step(now)
            await asyncio.sleep(0.05)

    async def _stay(self) -> None:
        """The engineer keeps the authority up, and the receiver's flux is measured."""
        while True:
            await asyncio.sleep(1.0)
            grant = self.plant.authority.grant
            if grant is not None and grant.token == self.token:
                self.plant.authority.keep(ENGINEER, self.token)
            self.plant.put(FLUX_READING, self.flux())

    @contextlib.asynccontextmanager
    async def alive(self) -> AsyncIterator["WholePlant"]:
        """Run everything beside a block, from power-on."""
        for board in self.boards.values():
            board.power_on(self.clock.monotonic())
        async with asyncio.TaskGroup() as group:
            others = [group.create_task(self._tick()), group.create_task(self._stay())]
            async with running(*self.parts), running(*self.clusters), running(self.plant):
                await self.until(lambda: self.plant.field.live(self.clock.monotonic()).all(), 10.0)
                self.token = self.plant.take_authority(ENGINEER).token
                await self.wait(5.0)
                yield self
            for other in others:
                other.cancel()
        self.audit.close()

    async def wait(self, seconds: float) -> None:
        """Let time pass."""
        await sleep_until(self.clock, self.clock.monotonic() + seconds)

    async def until(self, holds: Any, limit: float) -> float:
        """Wait until something holds; return how long that took, s."""
        begin = self.clock.monotonic()
        while not holds():
            assert self.clock.monotonic() - begin < limit, f"not within {limit} s: {self.states()}"
            await asyncio.sleep(0.1)
        return self.clock.monotonic() - begin

    def states(self) -> dict[str, str]:
        """States of the boards, in truth."""
        return {name: states.STATES[board.state] for name, board in self.boards.items()}

    def all_are(self, state: str) -> bool:
        """Whether all boards are in a state, in truth."""
        return set(self.states().values()) == {state}

    def miss(self, name: str, point: tuple[float, float, float] = outfit.RECEIVER) -> float:
        """By how much a beam passes a point, m, in truth."""
        return self.boards[name].miss(self.plant.sun_vector(), point)

    def flux(self) -> float:
        """Share of the beams on the receiver, in truth."""
        return float(np.mean([self.miss(name) < 3.0 for name in self.boards]))

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """The camera: an exact centroid, a second after it is asked."""
        await self.wait(1.0)
        at = self.clock.monotonic()
        vertex, ray = self.boards[heliostat].beam(self.plant.sun_vector())
        point = target.intersect(vertex, ray)
        away = np.abs(target.plane_coordinates(point))
        good = bool(np.isfinite(point).all() and away[0] < 3.0 and away[1] < 3.0)
        return Shot(point, at, 1e-4, () if good else ("no beam on the target",))
