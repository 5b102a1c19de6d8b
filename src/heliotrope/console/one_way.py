"""Sockets whose other end only listens, with a byte limit on the data that it may send.

A viewer of the live stream replies to the server's pings and closes the socket; both take only a
few bytes. All other data that a viewer sends (messages, parts of an endless message, pings whose
replies it does not read) would be kept in memory, so a connection that sends too much is closed.
"""

import time
from typing import Any

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

#: Number of bytes that a viewer may send at once, and per second of its connection.
AT_ONCE, A_SECOND = 4096, 100.0


class OneWaySocket(WebSocketsSansIOProtocol):
    """The server's end of a socket to a viewer."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self._opened, self._received = time.monotonic(), -1

    def data_received(self, data: bytes) -> None:
        """Accept bytes from the viewer.

        The first bytes are the request, which the server has already read.
        """
        if self._received < 0:
            self._received = 0
        else:
            self._received += len(data)
        if self._received > AT_ONCE + A_SECOND * (time.monotonic() - self._opened):
            self.transport.abort()
            return
        super().data_received(data)
