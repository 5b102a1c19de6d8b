"""The operator's console: a page, an HTTP API and a live stream over one plant at work.

`Client` is a thin client of the API for scripts; it needs the base installation only. The server
needs the extra ``console``: `console.app.create` makes the application, and
`console.serve.ConsoleServer` runs it; `console.settings.ConsoleSettings` holds address and limits.
"""

from heliotrope.console.client import Client
from heliotrope.console.stream import LiveMessage, RemoteError, read_message

__all__ = ["Client", "LiveMessage", "RemoteError", "read_message"]
