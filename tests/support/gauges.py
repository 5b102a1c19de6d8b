"""Run `heliotrope` with gauges in the plant: ``gauges.py FILE COUNT run …``.

Each 50 ms a line is added to the file: the time, the longest wait of the plant's loop since the
line before, the longest time since a cluster's last lease, and the time since which every one of
the ``COUNT`` simulated local controllers has heard DEFOCUS or STOW; POSIX s and s. Where
``FILE.withdraw`` appears, the emergency is withdrawn, past all interfaces, and the file removed.
The simulated field is a program of its own, with a gauge that writes ``FILE.heard``. Its port for
clusters is its own: another is opened in the plant's loop for the attacks, and its number written
to ``FILE.port``.
"""

import asyncio
import contextlib
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.cli import main
from heliotrope.cli.run import twin_process
from heliotrope.errors import HeliotropeError
from heliotrope.links.clock import SystemClock
from heliotrope.links.tcp import TcpServer
from heliotrope.plant.field.clusters import ClusterEnd
from heliotrope.plant.interface import PlantInterface
from heliotrope.plant.operations import Operations
from heliotrope.plant.orders.authority import Person, Role
from heliotrope.twin.field.field_bus import FieldBus

#: Time between two looks at the loop, and between two lines, s.
_LOOK, _LINE = 0.02, 0.05


class Gauges:
    """What is noted, by the plant's loop and by a thread of its own."""

    def __init__(self, file: Path, count: int) -> None:
        self._file, self.count = file, count
        self._leases: dict[str, float] = {}
        self._gap = 0.0
        self.loop: asyncio.AbstractEventLoop | None = None
        self.operations: Operations | None = None
        self._listens: asyncio.Task[None] | None = None

    async def listen(self) -> None:
        """Open a port for clusters in the plant's loop, and keep it."""
        server = TcpServer("127.0.0.1", 0, {"gauges": bytes(32)}, SystemClock())
        async with asyncio.TaskGroup() as group:
            group.create_task(server.run())
            await server.listening()
            file = self._file.with_name(f"{self._file.name}.port")
            file.write_text(str(server.port), encoding="ascii")

    def start(self, operations: Operations) -> None:
        """Begin, in the plant's loop."""
        self.loop, self.operations = asyncio.get_running_loop(), operations
        self._listens = self.loop.create_task(self.listen())

    def lease(self, cluster: str) -> None:
        """Note a lease for a cluster."""
        now = time.monotonic()
        self._gap = max(self._gap, now - self._leases.get(cluster, now))
        self._leases[cluster] = now

    def run(self) -> None:
        """Write lines for ever."""
        with self._file.open("w", encoding="ascii", buffering=1) as out:
            while True:
                lag, until = 0.0, time.monotonic() + _LINE
                self._withdraw()
                while time.monotonic() < until:
                    lag = max(lag, self._look())
                    time.sleep(_LOOK)
                now, self._gap, gap = time.monotonic(), 0.0, self._gap
                gap = max([gap, *(now - at for at in self._leases.values())])
                out.write(f"{time.time()} {lag} {gap} {self._heard()}\n")

    def _heard(self) -> float:
        """Return the time since which all have heard DEFOCUS or STOW, POSIX s."""
        try:
            return float(_heard_file(self._file).read_text("ascii"))
        except (OSError, ValueError):
            return 0.0

    def _withdraw(self) -> None:
        """Withdraw the emergency if that is asked for, and acknowledge the alarms that it left."""
        asked = self._file.with_name(f"{self._file.name}.withdraw")
        if self.loop is None or self.operations is None or not asked.exists():
            return
        who, operations, over = Person("gauges", Role.ENGINEER), self.operations, Future[bool]()

        def work() -> None:
            for call in operations.plant.sentinel.calls:
                operations.withdraw(Person(call.who, Role.ENGINEER))
            for alarm in operations.logbook.alarms():
                if not alarm.acknowledged_by:
                    with contextlib.suppress(HeliotropeError):
                        operations.acknowledge(who, alarm.condition, alarm.subject)
            over.set_result(not operations.viewer.emergency().on)

        self.loop.call_soon_threadsafe(work)
        if over.result(60.0):
            asked.unlink()

    def _look(self) -> float:
        """Return how long the plant's loop takes to do something, s."""
        done, begun = threading.Event(), time.perf_counter()
        if self.loop is None or self.loop.is_closed():
            return 0.0
        try:
            self.loop.call_soon_threadsafe(done.set)
        except RuntimeError:  # it was closed meanwhile
            return 0.0
        done.wait(60.0)
        return time.perf_counter() - begun


def attach(gauges: Gauges) -> None:
    """Let the classes of the plant tell the gauges."""
    keep, serve = ClusterEnd.keep, PlantInterface.__init__

    def served(self: PlantInterface, operations: Operations, *given: Any) -> None:
        serve(self, operations, *given)
        gauges.start(operations)

    async def kept(self: ClusterEnd, lease: Callable[[], Any], *given: Any) -> None:
        def noted() -> Any:
            gauges.lease(self.name)
            return lease()

        await keep(self, noted, *given)

    PlantInterface.__init__ = served  # type: ignore[method-assign]
    ClusterEnd.keep = kept  # type: ignore[method-assign]
    threading.Thread(target=gauges.run, daemon=True).start()


def attach_to_field(file: Path, count: int) -> None:
    """Note in the simulated field's program when its controllers hear DEFOCUS or STOW."""
    tell, heard = FieldBus._tell, np.zeros(count)

    def told(self: FieldBus, name: str, rows: range) -> None:
        # A cluster sends STOW in place of a DEFOCUS that it has not sent when STOW arrives.
        if name in ("DEFOCUS", "STOW"):
            heard[rows.start : rows.stop] = time.time()
            _heard_file(file).write_text(str(heard.min()), encoding="ascii")
        tell(self, name, rows)

    FieldBus._tell = told  # type: ignore[method-assign]


def _heard_file(file: Path) -> Path:
    return file.with_name(f"{file.name}.heard")


if __name__ == "__main__":
    path, heliostats = Path(sys.argv[1]), int(sys.argv[2])
    attach(Gauges(path, heliostats))
    twin_process._MAIN = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parents[1])!r}); "
        "from pathlib import Path; from support import gauges; from heliotrope.cli import main; "
        f"gauges.attach_to_field(Path({str(path)!r}), {heliostats}); main()"
    )
    sys.argv[1:3] = []
    sys.exit(main())
