"""Run the console over a plant in its own process."""

import asyncio
import contextlib
from collections.abc import Iterator

import uvicorn

from heliotrope.console.app import create
from heliotrope.console.remote import RemotePlant
from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import InputError


class _Server(uvicorn.Server):
    """A server that leaves signals to the owner of the process."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


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
        config = uvicorn.Config(
            self.app,
            host=chosen.host,
            port=chosen.port,
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            lifespan="on",
            ws="websockets-sansio",
            ws_per_message_deflate=False,
            ws_max_size=1 << 16,
            timeout_graceful_shutdown=2,
            ssl_certfile=chosen.certificate,
            ssl_keyfile=chosen.key,
        )
        # This reads modules and certificates from the disk, which no loop may wait for.
        config.load()
        self._server = _Server(config)

    async def run(self) -> None:
        """Serve until closed.

        Raises
        ------
        InputError
            If the address is not available.
        """
        try:
            await self._server.serve()
        except SystemExit:
            # uvicorn's way of saying that it could not start.
            raise InputError(
                f"console: {self.settings.host} port {self.settings.port} is not "
                "available; another program may use it, choose another with --port"
            ) from None

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
