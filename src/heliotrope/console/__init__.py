"""The operator console: a page, an HTTP API and a live stream for one running plant.

`Client` is a thin client of the API for scripts; it needs only the base installation. The server
needs the extra ``console``: `console.app.create` creates the application, and
`console.serve.ConsoleServer` runs it; `console.settings.ConsoleSettings` contains address and
limits.
"""

from heliotrope.console.client import Client
from heliotrope.console.stream import LiveMessage, RemoteError, read_message

__all__ = ["Client", "LiveMessage", "RemoteError", "read_message"]
