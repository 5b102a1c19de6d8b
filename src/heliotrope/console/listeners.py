"""The listening sockets of a console, which stay open while its processes restart.

The plant's process holds the sockets and passes them on, so that connections wait while a process
starts, and no other program can take a port in the meantime.
"""

import socket
import threading
from dataclasses import replace

from heliotrope.console.settings import ConsoleSettings
from heliotrope.errors import InputError

#: Number of connections that may wait in the system.
_BACKLOG = 2048


class Listeners:
    """The sockets of the page and of the EMERGENCY path.

    Parameters
    ----------
    settings
        Settings of the console.

    Attributes
    ----------
    settings
        The settings, with the actual ports once `open` has found them.
    """

    def __init__(self, settings: ConsoleSettings) -> None:
        self.settings = settings
        self._turn = threading.Lock()
        self._sockets: tuple[socket.socket, socket.socket] | None = None

    def open(self) -> tuple[socket.socket, socket.socket]:
        """Return the sockets, always the sockets of the first call; any thread may call this.

        Raises
        ------
        InputError
            If a port is not available; the next call tries again.
        """
        with self._turn:
            if self._sockets is None:
                self._sockets = self._open()
            return self._sockets

    def _open(self) -> tuple[socket.socket, socket.socket]:
        chosen = self.settings
        page = _taken(chosen.host, chosen.port, "--port")
        port = int(page.getsockname()[1])
        try:
            emergency = self._open_way(port)
        except BaseException:
            page.close()
            raise
        self.settings = replace(chosen, port=port, emergency_port=int(emergency.getsockname()[1]))
        return page, emergency

    def _open_way(self, page: int) -> socket.socket:
        """Open the requested port; by default the next port or, if that is taken, a free one."""
        host, chosen = self.settings.host, self.settings.emergency_port
        if chosen is not None:
            return _taken(host, chosen, "--emergency-port")
        try:
            if self.settings.port and page < 65_535:
                return listening(host, page + 1)
        except OSError:
            pass
        return listening(host, 0)

    def close(self) -> None:
        """Stop listening."""
        with self._turn:
            for line in self._sockets or ():
                line.close()
            self._sockets = None


def listening(host: str, port: int) -> socket.socket:
    """Return a listening socket."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, port), family=family, backlog=_BACKLOG)


def _taken(host: str, port: int, option: str) -> socket.socket:
    try:
        return listening(host, port)
    except OSError:
        raise InputError(
            f"console: {host} port {port} is not available; another program may use it, choose "
            f"another with {option}"
        ) from None
