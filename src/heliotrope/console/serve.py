"""Run the console over a plant in its own process."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import uvicorn

from heliotrope.console._logs import limit
from heliotrope.console.app import create
from heliotrope.console.auth import Console
from heliotrope.console.connections import (
    RESERVE,
    Doors,
    Limits,
    Listener,
    listening,
    raise_descriptors,
)
from heliotrope.console.remote import RemotePlant
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.urgent import LIMITS, EmergencyWay
from heliotrope.errors import InputError
from heliotrope.links.clock import SystemClock
from heliotrope.links.papers import Papers
from heliotrope.links.tls import RenewedTls, server_tls
from heliotrope.safety import Alarm

_LOG = logging.getLogger(__name__)


class _Server(uvicorn.Server):
    """A server whose connections are counted and timed.

    It leaves signals to the owner of the process.

    Parameters
    ----------
    config
        Its configuration.
    doors
        The application, whose listeners it serves.
    listen
        Opens them.
    papers
        The certificate, if there is one: it is taken again when its files are renewed.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        doors: Doors,
        listen: Callable[[], list[Listener]],
        papers: tuple[Path, Path] | None,
    ) -> None:
        super().__init__(config)
        self._doors, self._listen = doors, listen
        self._papers, self._tls = Papers(SystemClock()), None
        if papers is not None:
            self._tls = RenewedTls(lambda: server_tls(*papers))
            self._papers.renew("certificate of the console", papers, self._tls.renew)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application and listen."""
        del sockets
        await self.lifespan.startup()
        if self.lifespan.should_exit:
            raise RuntimeError("console: the application has not started, see the log")
        try:
            self._doors.listeners = self._listen()
        except InputError:
            await self.lifespan.shutdown()
            raise
        self.servers = list(self._doors.listeners)  # type: ignore[arg-type]  # what `shutdown` uses

    async def main_loop(self) -> None:
        """Serve until it should end."""
        config, state = self.config, self.lifespan.state

        def protocol() -> asyncio.Protocol:
            made: asyncio.Protocol = config.http_protocol_class(  # type: ignore[call-arg]
                config=config, server_state=self.server_state, app_state=state
            )
            return made

        async with self._papers.watched(_tell), asyncio.TaskGroup() as group:
            works = [
                group.create_task(one.run(protocol, self._tls)) for one in self._doors.listeners
            ]
            self.started = True
            await super().main_loop()
            for work in works:
                work.cancel()


def _tell(alarm: Alarm) -> None:
    _LOG.warning("console: %s", alarm.text)


class ConsoleServer:
    """The console of one plant.

    Parameters
    ----------
    plant, settings
        As for `app.create`.
    """

    def __init__(self, plant: RemotePlant, settings: ConsoleSettings | None = None) -> None:
        self.settings = settings or ConsoleSettings()
        self.app = create(plant, self.settings)
        chosen = self.settings
        self._doors = Doors(self.app)
        config = uvicorn.Config(
            self._doors,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            lifespan="on",
            # It bounds the length of headers; the listener keeps the deadlines.
            http="h11",
            timeout_keep_alive=3600,
            ws="websockets-sansio",
            ws_per_message_deflate=False,
            ws_max_size=1 << 16,
            timeout_graceful_shutdown=2,
            ssl_certfile=chosen.certificate,
            ssl_keyfile=chosen.key,
        )
        # This reads modules and certificates from the disk, which no loop may wait for.
        config.load()
        limit()
        self._server = _Server(config, self._doors, self._listen, chosen.papers)

    def _listen(self) -> list[Listener]:
        left = raise_descriptors() - RESERVE
        chosen = self.settings
        shared = ("127.0.0.1", "::1", *chosen.proxies)
        try:
            line = listening(chosen.host, chosen.port)
        except OSError:
            raise InputError(
                f"console: {chosen.host} port {chosen.port} is not available; another program "
                "may use it, choose another with --port"
            ) from None
        page = Listener(line, self.app, Limits().within(left - LIMITS.most), shared)
        console: Console = self.app.state.console
        way = EmergencyWay(console, lambda: page.port)
        urgent = Listener(self._listen_urgent(page.port), way, LIMITS.within(left), shared)
        console.emergency_port = urgent.port
        return [page, urgent]

    def _listen_urgent(self, page: int) -> socket.socket:
        """Return the listening socket of the way for EMERGENCY alone."""
        host, given = self.settings.host, self.settings.emergency_port
        try:
            if given is not None or (self.settings.port and page < 65_535):
                return listening(host, page + 1 if given is None else given)
        except OSError:
            if given is not None:
                raise InputError(
                    f"console: {host} port {given} is not available; another program may use it, "
                    "choose another with --emergency-port"
                ) from None
        return listening(host, 0)

    async def run(self) -> None:
        """Serve until closed.

        Raises
        ------
        InputError
            If the address is not available.
        """
        await self._server.serve()

    async def close(self) -> None:
        """Stop serving; viewers are disconnected."""
        self._server.should_exit = True

    async def address(self, within: float = 30.0) -> str:
        """Wait until the console listens; return its address.

        Raises
        ------
        InputError
            If it does not within some seconds.
        """
        loop = asyncio.get_running_loop()
        until = loop.time() + within
        while not self._server.started:
            if loop.time() > until:
                raise InputError(f"console: it does not listen after {within:g} s")
            await asyncio.sleep(0.02)
        port = int(self._server.servers[0].sockets[0].getsockname()[1])
        return self.settings.address(port)
