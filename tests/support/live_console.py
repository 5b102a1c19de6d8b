"""A small plant of the twin at work, at some speed, and its console: a thread each.

They speak through the plant's sockets, as the two processes of `heliotrope run` do; with ``child``
the console is such a process itself.
"""

import asyncio
import contextlib
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from heliotrope.console import _secrets
from heliotrope.console.beside import ConsoleProcesses
from heliotrope.console.listeners import Listeners
from heliotrope.console.process import ProcessInput
from heliotrope.console.remote import RemotePlant
from heliotrope.console.serve import ConsoleServer
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.urgent_process import server_of, way_of
from heliotrope.field.approval import ApprovalSettings
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.layouts import malan_plant
from heliotrope.field.volumes import Box
from heliotrope.links.clock import VirtualClock
from heliotrope.links.link import running
from heliotrope.local import EMERGENCY, LocalConnection
from heliotrope.plant.interface import PlantInterface
from heliotrope.plant.interface.console_process import Patience
from heliotrope.plant.operations.automatic import AutomaticSettings
from heliotrope.plant.operations.pictures import Pictures
from heliotrope.plant.orders.audit import JsonLines
from heliotrope.plant.orders.authority import Person, RefusedError, Role
from heliotrope.plant.settings import PlantSettings
from heliotrope.store.keeper import Keeper
from heliotrope.twin.live.loop import PacedLoop
from support.live import LiveOptions, LivePlant

PASSWORD = "correct horse"
ROLES = ("viewer", "operator", "engineer")
#: South of the field, where no beam goes: north of the tower, beams that rise to standby cross.
GATE = Box("gate", (0.0, -125.0, 2.0), (6.0, 4.0, 4.0))
T = TypeVar("T")


@contextlib.asynccontextmanager
async def serving(
    interface: PlantInterface, settings: ConsoleSettings
) -> AsyncIterator[tuple[ConsoleServer, str]]:
    """Serve a console of a plant during a block; yield it with its address."""
    lines = Listeners(settings)
    page, way = lines.open()
    plant = RemotePlant(interface.folder, interface.key)
    server = ConsoleServer(plant, lines.settings, page)
    urgent = LocalConnection(interface.folder / EMERGENCY, {"key": interface.key}, 10.0)
    inputs = ProcessInput(interface.folder, interface.key, lines.settings, way)
    second = way_of(urgent, inputs)
    beside = server_of(second, inputs)
    async with asyncio.TaskGroup() as group:
        connecting = [group.create_task(one.run()) for one in (plant, urgent, second.roster)]
        async with running(server), running(beside):
            await plant.up()
            while not urgent.up:
                await asyncio.sleep(0.02)
            yield server, await server.address()
        for one in connecting:
            one.cancel()


class LiveConsole:
    """Starts at once; `close` ends it and raises what went wrong.

    Attributes
    ----------
    address
        Of the console.
    process, way, beside
        The console's processes, with ``child``, and what starts them.
    live, interface
        The plant and its interface; touch them with `call` only.
    server
        The console; wait for it with `console_wait`.
    """

    def __init__(
        self,
        folder: Path,
        heliostats: int,
        *,
        speed: float = 1.0,
        rendered: bool = False,
        boards: bool = False,
        child: Patience | None = None,
        settings: ConsoleSettings | None = None,
        marks: Path | None = None,
        file: Path | None = None,
        work: AutomaticSettings | None = None,
        given: frozenset[str] = frozenset(),
        together: bool = False,
        approval: ApprovalSettings | None = None,
        pictures: Path | None = None,
    ) -> None:
        self.folder, self.address = folder, ""
        self._approval = approval or ApprovalSettings()
        self._pictures = None if pictures is None else Pictures(pictures)
        self._made, self._child = (heliostats, speed), child
        self._settings = settings or ConsoleSettings(port=0)
        self._marks, self._file = marks, file
        self._options = LiveOptions(
            rendered=rendered,
            boards=boards,
            work=work or AutomaticSettings(wanted=True),
            plant=PlantSettings(given=given),
            together=together,
        )
        self._ready, self._over = threading.Event(), threading.Event()
        self._problem: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="plant")
        self._thread.start()
        self._ready.wait(300.0)
        if not self.address:
            self.close()

    def _run(self) -> None:
        speed = self._made[1]
        try:
            with asyncio.Runner(loop_factory=lambda: PacedLoop(speed)) as runner:
                runner.run(self._main())
        except BaseException as error:  # noqa: BLE001 - told by `close`, in the test's thread
            self._problem = error
        self._ready.set()

    async def _main(self) -> None:
        heliostats, speed = self._made
        self._loop = asyncio.get_running_loop()
        clock = VirtualClock(self._loop.time)
        self.keeper = Keeper(self.folder / "store.sqlite")
        now = time.time()
        for role in ROLES:
            self.keeper.people.add(role, _secrets.hash_password(PASSWORD), role, now)
        design = replace(malan_plant(heliostats), keep_outs=(GATE,), approval=self._approval)
        if self._file is not None:
            write_plant(design, self._file)
        self.live = LivePlant(
            design,
            clock,
            self._options,
            audit=JsonLines(self.folder / "audit.jsonl", clock.utc()),
            records=self.keeper,
            extra=lambda: {"speed": speed},
            marks=self._marks,
            file=self._file,
            pictures=self._pictures,
        )
        self.interface = PlantInterface(self.live.operations, self.keeper.people, self.folder)
        settings = self._settings
        if self._child is None:
            async with self.live.running(), self.interface.running():
                await asyncio.to_thread(self._serve, settings)
        else:
            beside = ConsoleProcesses(
                self.interface,
                settings,
                self.live.assembly.logbook.take_alarm,
                self._tell,
                self._child,
            )
            self.process, self.way, self.beside = beside.page, beside.emergency, beside
            async with self.live.running(), self.interface.running(beside.run):
                await asyncio.to_thread(self._over.wait)
        self.keeper.close()

    @property
    def emergency_port(self) -> int:
        """Port of the page's second way for EMERGENCY."""
        settings = self.server.app.state.console.settings if self._child is None else None
        found = (settings or self.beside.settings).emergency_port
        assert found is not None
        return int(found)

    def _tell(self, address: str) -> None:
        self.address = address
        self._ready.set()

    def settle(self, name: str, password: str) -> None:
        """Give an account a password as its owner would: it need not be changed."""
        self.keeper.people.change(name, time.time(), password_hash=_secrets.hash_password(password))

    def _serve(self, settings: ConsoleSettings) -> None:
        """Run the console in this thread until the end."""
        asyncio.run(self._console(settings))

    async def _console(self, settings: ConsoleSettings) -> None:
        self._console_loop = asyncio.get_running_loop()
        async with serving(self.interface, settings) as (self.server, self.address):
            self._ready.set()
            while not self._over.is_set():
                await asyncio.sleep(0.1)

    def call(self, work: Callable[[], T]) -> T:
        """Do something in the plant's loop."""

        async def inside() -> T:
            return work()

        return asyncio.run_coroutine_threadsafe(inside(), self._loop).result(120.0)

    def wait(self, work: Coroutine[Any, Any, T]) -> T:
        """Do something in the plant's loop that takes its time."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(120.0)

    def console_call(self, work: Callable[[], T]) -> T:
        """Do something in the console's loop."""

        async def inside() -> T:
            return work()

        return self.console_wait(inside())

    def console_wait(self, work: Coroutine[Any, Any, T]) -> T:
        """Do something in the console's loop that takes its time."""
        return asyncio.run_coroutine_threadsafe(work, self._console_loop).result(120.0)

    def until(self, holds: Callable[[], Any], within: float = 120.0) -> Any:
        """Wait until something holds in the plant's loop; return it."""
        end = time.monotonic() + within
        while not (found := self.call(holds)):
            assert time.monotonic() < end, f"not within {within} s"
            time.sleep(0.1)
        return found

    def states(self) -> dict[str, int]:
        """How many heliostats are in each state, as the plant knows them."""
        return self.call(lambda: dict(self.live.operations.summary().states))

    def produced(self) -> bool:
        """Whether two figures are kept in which a receiver gets power."""
        rows = self.keeper.figures(0.0, 1e11)
        powers = (v for row in rows for name, v in row.values.items() if "power" in name)
        return sum(v > 0.0 for v in powers) > 1

    def release(self) -> None:
        """Release the command authority, whoever holds it: a failed test keeps nothing."""

        def give_back() -> None:
            plant = self.live.plant
            if (grant := plant.authority.grant) is not None:
                plant.release_authority(grant.holder, grant.token)

        self.call(give_back)

    def calm(self) -> None:
        """Withdraw an emergency, and acknowledge what it left as soon as its causes have gone."""
        who = Person("engineer", Role.ENGINEER)
        here = self.live.operations

        def quiet() -> bool:
            for alarm in here.logbook.alarms():
                if not alarm.acknowledged_by:
                    with contextlib.suppress(RefusedError):
                        here.acknowledge(who, alarm.condition, alarm.subject)
            self._why = here.plant.sentinel.refusal(here.plant.field.clusters)
            return not self._why

        def withdraw() -> None:
            for call in here.plant.sentinel.calls:
                # As its own: an order that others withdraw again and again makes its person pause.
                here.withdraw(Person(call.who, Role.ENGINEER))

        # In one turn of the loop: a page may be withdrawing too.
        self.call(withdraw)
        try:
            self.until(quiet)
        except AssertionError:
            raise AssertionError(f"not calm: {self._why}") from None

    def close(self) -> None:
        """End it."""
        self._over.set()
        self._thread.join(60.0)
        if self._problem is not None:
            raise self._problem
