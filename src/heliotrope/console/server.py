"""One listener served by uvicorn, which counts and times connections and renews certificates."""

import asyncio
import contextlib
import logging
import socket
from collections.abc import Iterator

import uvicorn
from starlette.types import ASGIApp

from heliotrope.console._logs import limit
from heliotrope.console.connections import RESERVE, Doors, Limits, Listener, raise_descriptors
from heliotrope.console.one_way import OneWaySocket
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import InputError
from heliotrope.links.clock import SystemClock
from heliotrope.links.papers import Papers
from heliotrope.links.tls import RenewedTls, server_tls
from heliotrope.safety import Alarm

_LOG = logging.getLogger(__name__)


class Server(uvicorn.Server):
    """A server for one listener.

    The server leaves signals to the owner of the process.

    Parameters
    ----------
    app
        The application.
    line
        Listening socket, which is closed at the end.
    limits
        Limits of the connections if there are enough descriptors.
    settings
        Settings of the console.
    page
        Whether the application has a lifespan, and web sockets.

    Attributes
    ----------
    listener
        The listener; its limits follow from the descriptors that this process may open.
    """

    def __init__(
        self,
        app: ASGIApp,
        line: socket.socket,
        limits: Limits,
        settings: ConsoleSettings,
        *,
        page: bool = True,
    ) -> None:
        shared = ("127.0.0.1", "::1", *settings.proxies)
        self.listener = Listener(line, app, limits.within(raise_descriptors() - RESERVE), shared)
        config = uvicorn.Config(
            Doors(self.listener),
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            lifespan="on" if page else "off",
            # It limits the length of headers; the listener enforces the deadlines.
            http="h11",
            timeout_keep_alive=3600,
            ws=OneWaySocket if page else "none",
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            ssl_certfile=settings.certificate,
            ssl_keyfile=settings.key,
        )
        # This reads modules and certificates from the disk, for which no event loop may wait.
        config.load()
        limit()
        super().__init__(config)
        self._address = settings.address(self.listener.port)
        self._papers, self._tls = Papers(SystemClock()), None
        if (papers := settings.papers) is not None:
            self._tls = RenewedTls(lambda: server_tls(*papers))
            self._papers.renew("certificate of the console", papers, self._tls.renew)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Do nothing, because the owner of the process handles signals."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start the application."""
        del sockets
        await self.lifespan.startup()
        if self.lifespan.should_exit:
            raise RuntimeError("console: the application has not started, see the log")
        self.servers = [self.listener]  # type: ignore[list-item]  # what `shutdown` uses

    async def main_loop(self) -> None:
        """Serve until the server is told to end."""
        config, state = self.config, self.lifespan.state

        def protocol() -> asyncio.Protocol:
            made: asyncio.Protocol = config.http_protocol_class(  # type: ignore[call-arg]
                config=config, server_state=self.server_state, app_state=state
            )
            return made

        async with self._papers.watched(_tell), asyncio.TaskGroup() as group:
            work = group.create_task(self.listener.run(protocol, self._tls))
            self.started = True
            await super().main_loop()
            work.cancel()

    async def run(self) -> None:  # type: ignore[override]  # there is a loop already
        """Serve until closed."""
        await self.serve()

    async def close(self) -> None:
        """Stop serving, and disconnect viewers."""
        self.should_exit = True

    async def address(self, within: float = 30.0) -> str:
        """Wait until the server listens, then return its address.

        Raises
        ------
        InputError
            If the server does not listen within a few seconds.
        """
        loop = asyncio.get_running_loop()
        until = loop.time() + within
        while not self.started:
            if loop.time() > until:
                raise InputError(f"console: it does not listen after {within:g} s")
            await asyncio.sleep(0.02)
        return self._address


def _tell(alarm: Alarm) -> None:
    _LOG.warning("console: %s", alarm.text)
