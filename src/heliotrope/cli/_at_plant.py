"""`heliotrope ctl` at the plant itself: API requests over the local interface.

No console is needed. EMERGENCY, DEFOCUS and STOW use a separate socket of the plant, even without a
valid token. No heavy library is imported, so that an emergency starts at once.
"""

import json
from array import array
from pathlib import Path
from types import TracebackType
from typing import Any

from heliotrope.local import (
    EMERGENCY,
    ORDINARY,
    CallError,
    ask_once,
    fetch_once,
    socket_folder,
)

#: Requests that use the socket for emergencies.
URGENT = frozenset({"POST emergency", "POST stow", "POST defocus"})
#: First frame of a caller without a token.
_USER: dict[str, Any] = {"user": True}


class AtPlant:
    """A caller with the methods of `console.Client` that `heliotrope ctl` needs.

    Parameters
    ----------
    token
        API token; "" for no token. The plant's own user and root need no token to see the plant and
        to order EMERGENCY, DEFOCUS and STOW.
    data
        Data folder of the plant.
    """

    def __init__(self, token: str, data: Path) -> None:
        self._hello: dict[str, Any] = {"token": token} if token else _USER
        self._folder = socket_folder(data)

    def __enter__(self) -> "AtPlant":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Do nothing, because each call has its own connection."""

    def ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        """Send an API request and return the reply.

        Raises
        ------
        HeliotropeError
            If the plant refuses the request, or cannot be reached.
        """
        request, arguments, blob = f"{method} {path}", dict(body or {}), b""
        if request in ("POST aim", "POST standby"):
            points = arguments.pop("points", {})
            arguments["points"] = list(points)
            blob = array("d", [x for point in points.values() for x in point]).tobytes()
        if request == "POST flights":
            arguments, blob = {}, json.dumps(arguments).encode()
        if request not in URGENT:
            return ask_once(self._folder / ORDINARY, self._hello, request, arguments, blob)
        try:
            return ask_once(self._folder / EMERGENCY, self._hello, request, arguments)
        except CallError:
            # An expired token, or a viewer's token, must not prevent an emergency.
            return ask_once(self._folder / EMERGENCY, _USER, request, arguments)

    def get(self, path: str) -> Any:
        """Return the view at a path."""
        return self.ask("GET", path)

    def picture(self, path: str) -> bytes:
        """Return the JPEG at a path."""
        return fetch_once(self._folder / ORDINARY, self._hello, f"GET {path}", {})[1]
