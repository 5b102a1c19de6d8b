"""The thesis's prototype for real: every controller a process, 115,200 baud, power-on to stow.

Eighteen heliostats in three clusters of six, and one cluster of 32: local controllers in processes
of their own at a bus whose bytes take their time, `heliotrope cluster` for each cluster, TCP to the
plant. Only motors and mirrors are simulated.
"""

import asyncio
import contextlib
import json
import re
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Receiver, Target
from heliotrope.lcu import states
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import running
from heliotrope.links.messages import Stage
from heliotrope.links.tcp import TcpServer
from heliotrope.mechanism.board_items import Wanted
from heliotrope.plant.controller import PlantController, Stores
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.plant.settings import PlantSettings
from heliotrope.plant.visits import CalibrationCycle, CycleSettings, Shot
from heliotrope.sun import Site
from heliotrope.twin.boards import outfit
from support.boards_process import PrototypeField, key_of, prototype_field
from support.paced_pty import PacedBus
from support.whole_plant import ENGINEER

TESTS = Path(__file__).parents[1]
CLUSTER = [sys.executable, "-c", "from heliotrope.cli import main; main()", "cluster"]
#: Real seconds for what should take a fraction of them; the machine may be busy.
PATIENCE = 60.0


def _noon() -> Site:
    """Return a place where the sun stands high now, whenever this is run."""
    now = datetime.now(UTC)
    hours = now.hour + now.minute / 60.0
    return Site(-20.0 if 3 < now.month < 10 else 20.0, (12.0 - hours) * 15.0, 0.0, name="noon")


class Installation:
    """The processes of a field, its plant in this one."""

    def __init__(self, folder: Path, clusters: int, members: int, per_process: int) -> None:
        self.folder, self.clusters, self.members = folder, clusters, members
        self.per_process = per_process
        self.field: PrototypeField = prototype_field(clusters * members, seed=5)
        self.clock = SystemClock()
        self.site = _noon()
        self.keys = {f"K{k + 1}": secrets.token_bytes(32) for k in range(clusters)}
        self.boards: list[subprocess.Popen[str]] = []
        self.buses: list[PacedBus] = []
        self.token = 0

    # -- processes -------------------------------------------------------------------------

    def _bus(self, cluster: int, stack: contextlib.ExitStack) -> str:
        """Start a cluster's bus and its local controllers; return the master's port."""
        bus = stack.enter_context(PacedBus(self.members + 1))
        self.buses.append(bus)
        master, *ports = bus.paths
        for begin in range(0, self.members, self.per_process):
            first = cluster * self.members + begin
            part = ports[begin : begin + self.per_process]
            process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "support.boards_process",
                    str(len(self.field.names)),
                    "5",
                    str(first),
                    *part,
                ],
                cwd=TESTS,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            stack.callback(_end, process)
            self.boards.append(process)
        return master

    def _cluster(self, cluster: int, port: str, plant: int, stack: contextlib.ExitStack) -> None:
        name = f"K{cluster + 1}"
        own = range(cluster * self.members, (cluster + 1) * self.members)
        names = [self.field.names[i] for i in own]
        tables = "".join(
            f'[[heliostats]]\nname = "{self.field.names[i]}"\naddress = {11 + i}\n' for i in own
        )
        (self.folder / f"{name}.toml").write_text(
            f'format = "heliotrope-cluster"\nversion = 1\nname = "{name}"\n'
            f'keys = "{name}.keys"\ntime = {{error_s = 0.5}}\n'
            f"[site]\nlatitude_deg = {self.site.latitude_deg}\n"
            f"longitude_deg = {self.site.longitude_deg}\nheight_m = {self.site.height}\n"
            f'[bus]\nurl = "{port}"\nanswer_s = 0.2\nstored_answer_s = 1.0\n'
            f'[plant]\nurl = "tcp://127.0.0.1:{plant}"\n{tables}'
        )
        keys = self.folder / f"{name}.keys"
        keys.touch(0o600)
        lines = [f'plant = "{self.keys[name].hex()}"', "[heliostats]"]
        lines += [f'{n} = "{key_of(i).hex()}"' for n, i in zip(names, own, strict=True)]
        keys.write_text("\n".join(lines) + "\n")
        log = stack.enter_context((self.folder / f"{name}.log").open("w"))
        process = subprocess.Popen(
            [*CLUSTER, str(self.folder / f"{name}.toml"), "--every", "5"],
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        stack.callback(_end, process)

    # -- running ---------------------------------------------------------------------------

    @contextlib.asynccontextmanager
    async def alive(self) -> AsyncIterator["Installation"]:
        """Start everything, and wait until the plant hears all heliostats."""
        server = TcpServer("127.0.0.1", 0, self.keys, self.clock)
        self.audit = JsonLines(self.folder / "audit.jsonl", self.clock.utc())
        self.plant = PlantController(
            self._design(),
            server.links,
            self.clock,
            Stores(self.audit, Wanted(dict(zip(self.field.names, self.field.items, strict=True)))),
            settings=PlantSettings(),
        )
        with contextlib.ExitStack() as stack:
            async with running(server), running(self.plant):
                await server.listening()
                ports = [self._bus(k, stack) for k in range(self.clusters)]
                for process in self.boards:
                    assert process.stdout is not None
                    assert (await asyncio.to_thread(process.stdout.readline)).strip() == "ready"
                for k, port in enumerate(ports):
                    self._cluster(k, port, server.port, stack)
                await self.until(
                    lambda: bool(self.plant.field.live(self.plant.now()).all()), PATIENCE
                )
                self.token = self.plant.take_authority(ENGINEER).token
                staying = asyncio.create_task(self._stay())
                try:
                    await asyncio.sleep(8.0)  # what was silent at the start has to clear
                    yield self
                finally:
                    staying.cancel()
        self.audit.close()

    def _design(self) -> Plant:
        count = len(self.field.names)
        homes = tuple(f"K{i // self.members + 1}" for i in range(count))
        corners = ((3.0, 0.0, 43.0), (-3.0, 0.0, 43.0), (-3.0, 0.0, 37.0), (3.0, 0.0, 37.0))
        mirrors = Heliostats(
            self.field.names,
            self.field.perfect,
            np.full(count, 3.0),
            np.full(count, 2.0),
            cluster=homes,
        )
        receiver = Receiver(
            "receiver", "planar", np.array(outfit.RECEIVER), np.array([0.0, 1.0, 0.0]), 4.0, 4.0
        )
        white = Target("white", np.array(corners), np.array([0.0, 0.0, 40.0]))
        return Plant(
            "prototype", self.site, {"all": mirrors}, targets=(white,), receivers=(receiver,)
        )

    async def _stay(self) -> None:
        while True:
            await asyncio.sleep(1.0)
            self.plant.authority.keep(ENGINEER, self.token)

    async def until(self, holds: Callable[[], bool | Awaitable[bool]], limit: float) -> float:
        """Wait until something holds; return how long that took, s."""
        begin = time.monotonic()
        while True:
            found = holds()
            if found if isinstance(found, bool) else await found:
                return time.monotonic() - begin
            assert time.monotonic() - begin < limit, f"not within {limit} s: {self._told()}"
            await asyncio.sleep(0.1)

    async def accepted(self, command: Callable[[], Ticket]) -> Ticket:
        """Give a command until the plant takes it: what was silent at the start must clear."""
        begin = time.monotonic()
        while True:
            try:
                return command()
            except RefusedError:
                if time.monotonic() - begin > PATIENCE:
                    raise
            await asyncio.sleep(0.5)

    def _told(self) -> dict[str, Any]:
        rows = self.plant.field.rows
        told = dict(zip(self.field.names, (states.STATES[s] for s in rows["state"]), strict=True))
        return {**told, "alarms": [alarm.text for alarm in self.plant.alarms][-5:]}

    # -- truth -----------------------------------------------------------------------------

    async def where(self) -> dict[str, tuple[str, int, int]]:
        """State and motors of every board, in truth."""
        found: dict[str, tuple[str, int, int]] = {}
        for process in self.boards:
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write("\n")
            process.stdin.flush()
            line = await asyncio.to_thread(process.stdout.readline)
            found.update({name: tuple(row) for name, row in json.loads(line).items()})
        return found

    async def all_are(self, state: str) -> bool:
        return {row[0] for row in (await self.where()).values()} == {state}

    async def beams(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and directions of the reflected rays, in truth, (N, 3)."""
        found = await self.where()
        counts = np.array([found[name][1:] for name in self.field.names], dtype=np.float64)
        pose = self.field.truth.pose(counts)
        sun = self.plant.sun_vector()
        ray = 2.0 * (pose.normal @ sun)[:, None] * pose.normal - sun
        return pose.vertex, ray

    async def misses(self) -> np.ndarray:
        """By how much each beam passes the receiver's centre, m; infinite if it goes away."""
        vertex, ray = await self.beams()
        way = np.array(outfit.RECEIVER) - vertex
        along = np.einsum("ij,ij->i", way, ray)
        across = np.linalg.norm(way - along[:, None] * ray, axis=1)
        return np.asarray(np.where(along > 0.0, across, np.inf))

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """The camera: an exact centroid."""
        at = self.clock.monotonic()
        place = self.field.names.index(heliostat)
        vertex, ray = await self.beams()
        point = target.intersect(vertex[place], ray[place])
        away = np.abs(target.plane_coordinates(point))
        good = bool(np.isfinite(point).all() and away[0] < 3.0 and away[1] < 3.0)
        return Shot(point, at, 1e-4, () if good else ("no beam on the target",))


def _end(process: "subprocess.Popen[Any]") -> None:
    if process.stdin is not None:
        process.stdin.close()
    else:
        process.send_signal(signal.SIGTERM)
    try:
        process.wait(20.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout is not None:
        process.stdout.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("clusters", "members", "per_process"), [(3, 6, 1), (1, 32, 8)], ids=["3x6", "1x32"]
)
def test_from_power_on_to_tracking_to_calibration_to_stow(
    tmp_path: Path, clusters: int, members: int, per_process: int
) -> None:
    async def main() -> dict[str, Any]:
        async with Installation(tmp_path, clusters, members, per_process).alive() as here:
            return await scene(here)

    async def scene(here: Installation) -> dict[str, Any]:
        plant, token, seen = here.plant, here.token, {}
        assert await here.all_are("STOWED")
        # Those whose parameters have not been compared yet would be left out of the approach.
        names = here.field.names
        await here.until(lambda: not any(map(plant._sync.differing, names)), 2 * PATIENCE)
        aimed = await here.accepted(lambda: plant.aim(ENGINEER, token, plant.default_aims()))
        assert await aimed.end(PATIENCE), aimed.text
        approach = plant.command(ENGINEER, token, "APPROACH")
        assert await approach.reached(Stage.ACKNOWLEDGED, PATIENCE), approach.text
        seen["approach"] = await here.until(lambda: here.all_are("IDLE"), 200.0)
        assert await approach.end(PATIENCE), approach.text
        assert (await here.misses() > 2.0).all()
        assert await plant.command(ENGINEER, token, "TRACK").end(PATIENCE), "TRACK"
        await here.until(lambda: here.all_are("TRACKING"), PATIENCE)
        await asyncio.sleep(10.0)
        before = await here.misses()
        assert (before < 2.0).all()
        logs = "".join(log.read_text() for log in tmp_path.glob("*.log"))
        seen["poll_cycles"] = sorted(map(float, re.findall(r"cycle ([0-9.]+) s", logs)))
        worst = int(np.argmax(before))
        name = here.field.names[worst]
        cycle = CalibrationCycle(plant, here, CycleSettings(interval=5.0))
        result = await cycle.run(ENGINEER, token, name, "white")
        assert result.text.startswith("calibrated: beam error"), result.text
        await here.until(lambda: here.all_are("TRACKING"), PATIENCE)
        await asyncio.sleep(10.0)
        after = await here.misses()
        seen["miss"] = before[worst], after[worst]
        assert after[worst] < 0.3 * before[worst]
        order = plant.raise_emergency("anybody")
        seen["acknowledged"] = await here.until(
            lambda: not order.report(plant.now()).unacknowledged, PATIENCE
        )
        seen["off"] = await here.until(_off(here), 30.0)
        seen["stowed"] = await here.until(lambda: here.all_are("STOWED"), 300.0)
        seen["bus"] = [bus.statistics() for bus in here.buses]
        return seen

    def _off(here: Installation) -> Callable[[], Awaitable[bool]]:
        async def off() -> bool:
            return bool((await here.misses() > 2.0).all())

        return off

    seen = asyncio.run(main())
    print(json.dumps({key: str(value) for key, value in seen.items()}, indent=1))
    assert seen["off"] < 30.0
    assert seen["stowed"] < 300.0
    assert all(bus["spoilt"] == 0 for bus in seen["bus"])
