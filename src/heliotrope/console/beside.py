"""The two console processes beside the plant: one for page and API, one for EMERGENCY."""

import asyncio
import socket
from collections.abc import Callable, Mapping
from typing import Any

from heliotrope.console.listeners import Listeners
from heliotrope.console.settings import ConsoleSettings
from heliotrope.plant.interface import CONSOLE, EMERGENCY_WAY, ConsoleProcess, PlantInterface
from heliotrope.plant.interface.console_process import Patience
from heliotrope.safety import Alarm


class ConsoleProcesses:
    """Starts both processes, monitors them, and restarts each independently of the other.

    Parameters
    ----------
    interface, on_alarm, on_address, patience
        As in `ConsoleProcess`.
    settings
        Settings of the console.

    Attributes
    ----------
    page, way
        The process for page and API, and the process for EMERGENCY.
    """

    def __init__(
        self,
        interface: PlantInterface,
        settings: ConsoleSettings,
        on_alarm: Callable[[Alarm], None],
        on_address: Callable[[str], None],
        patience: Patience | None = None,
    ) -> None:
        self._listeners = Listeners(settings)
        self.page = ConsoleProcess(
            interface, CONSOLE, self._listen(0), on_alarm, on_address, patience
        )
        self.emergency = ConsoleProcess(
            interface, EMERGENCY_WAY, self._listen(1), on_alarm, lambda _: None, patience
        )

    def _listen(self, which: int) -> Callable[[], tuple[socket.socket, Mapping[str, Any]]]:
        def listen() -> tuple[socket.socket, Mapping[str, Any]]:
            line = self._listeners.open()[which]
            return line, self._listeners.settings.values

        return listen

    @property
    def settings(self) -> ConsoleSettings:
        """The settings, which contain the actual ports once a process has started."""
        return self._listeners.settings

    async def run(self) -> None:
        """Keep both processes running until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self.emergency.run())
                group.create_task(self.page.run())
        finally:
            self._listeners.close()
