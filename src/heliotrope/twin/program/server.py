"""HTTP server of a simulated field: photographs, clock state and true errors.

The standard library's server answers each request in a thread; requests that concern the field are
executed in the field's event loop. Photographs are rendered in a separate process
(`drawing.Drawer`).
"""

import asyncio
import json
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import unquote

from heliotrope.errors import HeliotropeError
from heliotrope.imaging.files import encode_image
from heliotrope.imaging.frame import Frame

#: Longest wait for a reply from the event loop, s.
_PATIENCE = 20.0


class _Server(ThreadingHTTPServer):
    allow_reuse_address = daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print nothing, because a plant that ends may leave replies unread."""


class TwinServer:
    """The server of a simulated field.

    Parameters
    ----------
    serves
        Host and port.
    secret
        First part of every valid path; any other path is answered with "not found".
    clock
        Function that returns the state of the clock; may be called in any thread.
    loop
        The field's event loop.
    photograph
        Function that takes a photograph with a named camera; called in a thread.
    errors
        Function that returns the true errors; called in the loop.
    begin
        Function that starts the field; called in the loop.
    """

    def __init__(
        self,
        serves: tuple[str, int],
        secret: str,
        clock: Callable[[], dict[str, Any]],
        loop: asyncio.AbstractEventLoop,
        photograph: Callable[[str], Frame],
        errors: Callable[[], bytes],
        begin: Callable[[], bytes],
    ) -> None:
        def answer(path: str) -> tuple[int, str, bytes]:
            parts = path.strip("/").split("/")
            if parts[0] != secret:
                return 404, "text/plain", b"there is nothing here\n"
            match parts[1:]:
                case ["clock"]:
                    return 200, "application/json", json.dumps(clock()).encode()
                case ["begin"]:
                    return 200, "text/plain", _asked(loop, begin)
                case ["errors"]:
                    return 200, "application/octet-stream", _asked(loop, errors)
                case ["cameras", name] if name.endswith(".png"):
                    try:
                        frame = photograph(unquote(name[: -len(".png")]))
                    except HeliotropeError as error:
                        return 503, "text/plain", f"{error}\n".encode()
                    return 200, "image/png", encode_image(frame, ".png")
            return 404, "text/plain", b"there is nothing here\n"

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_GET(self) -> None:
                code, kind, body = answer(self.path)
                self.send_response(code)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
                """Write nothing, because cameras are polled all the time."""

        self._server = _Server(serves, Handler)
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)

    def start(self) -> None:
        """Start serving requests."""
        self._thread.start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()


def _asked(loop: asyncio.AbstractEventLoop, function: Callable[[], bytes]) -> bytes:
    """Call a function in the event loop and return its result."""

    async def call() -> bytes:
        return function()

    return asyncio.run_coroutine_threadsafe(call(), loop).result(_PATIENCE)
