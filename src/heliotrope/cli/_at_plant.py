"""`heliotrope ctl` at the plant itself: the API's requests as calls of the local interface.

It needs no console, and EMERGENCY, DEFOCUS and STOW take the plant's own socket for them, with no
valid token either. Nothing heavy is imported: an emergency starts at once.
"""

import json
from array import array
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any
from urllib.parse import parse_qsl, unquote

from heliotrope.errors import InputError
from heliotrope.local import EMERGENCY, ORDINARY, CallError, ask_once, socket_folder

_VIEWS = (
    "alarms", "authority", "calibration", "clusters", "emergency", "events", "field", "flights",
    "holds", "learning", "packets", "retries", "schedule", "summary", "sun",
    "timetable",
)  # fmt: skip
#: Calls of the socket for emergencies.
_URGENT = ("order_emergency", "stow", "defocus")
#: First frame of a caller without a token.
_USER: dict[str, Any] = {"user": True}
#: Calls by the method and the path of their request.
_CALLS = {
    **{("GET", view): view for view in _VIEWS},
    ("POST", "emergency"): "order_emergency",
    ("DELETE", "emergency"): "withdraw_emergency",
    ("POST", "stow"): "stow",
    ("POST", "defocus"): "defocus",
    ("POST", "commands"): "command",
    ("POST", "aim"): "aim",
    ("POST", "authority"): "take_authority",
    ("PUT", "authority"): "keep_authority",
    ("DELETE", "authority"): "release_authority",
    ("POST", "alarms/acknowledge"): "acknowledge",
    ("PUT", "calibration"): "switch_calibration",
    ("POST", "calibration/next"): "calibrate",
    ("POST", "flights"): "take_flight",
    ("POST", "learning"): "learn",
    ("PUT", "timetable"): "put_timetable",
    ("POST", "holds"): "hold",
    ("POST", "holds/release"): "unhold",
    ("POST", "parameters"): "set_parameters",
    ("POST", "automatic"): "automatic",
    ("POST", "automatic/resume"): "resume",
}
#: Calls about one thing, by the method, the beginning and the end of the path.
_NAMED = (
    ("GET", "heliostats/", "/parameters", "parameters"),
    ("GET", "heliostats/", "", "heliostat"),
    ("GET", "commands/", "", "one_command"),
    ("POST", "clusters/", "/frames", "bus_frames"),
    ("POST", "targets/", "/photograph", "take_photograph"),
    ("PUT", "readings/", "", "give_reading"),
)


class AtPlant:
    """Has the methods of `console.Client` that `heliotrope ctl` needs.

    Parameters
    ----------
    token
        API token; "": none, which the plant's own user and root need not have to see the plant and
        to give EMERGENCY, DEFOCUS and STOW.
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
        """Do nothing: each call has a connection of its own."""

    def ask(self, method: str, path: str, body: dict[str, Any] | None = None) -> Any:
        """Make the call of a request; return its value.

        Raises
        ------
        HeliotropeError
            If the plant refuses it, or cannot be reached.
        """
        given, blob = dict(body or {}), b""
        call = _CALLS.get((method, path))
        if call is None:
            call, given = _named(method, path, given)
        if not call:
            raise InputError(f"ctl: {path} is only known to the console; leave out --data")
        if call == "command" and given["command"] in ("STOW", "DEFOCUS"):
            call, given = given["command"].lower(), {"heliostats": given["heliostats"]}
        if call == "aim":
            points = given.pop("points", {})
            given["points"] = list(points)
            blob = array("d", [x for point in points.values() for x in point]).tobytes()
        if call == "take_flight":
            given, blob = {}, json.dumps(given).encode()
        if call not in _URGENT:
            return ask_once(self._folder / ORDINARY, self._hello, call, given, blob)
        try:
            return ask_once(self._folder / EMERGENCY, self._hello, call, given)
        except CallError:
            # A token that has expired, or of a viewer, must not stop an emergency.
            return ask_once(self._folder / EMERGENCY, _USER, call, given)

    def get(self, path: str) -> Any:
        """Return the view of a path."""
        return self.ask("GET", path)

    def command(
        self, name: str, heliostats: Sequence[str] = (), values: Sequence[float] = ()
    ) -> Any:
        """Give a command; return its progress."""
        order = {"command": name, "heliostats": list(heliostats), "values": list(values)}
        return self.ask("POST", "commands", order)


def _named(method: str, path: str, given: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the call about one thing, or about kept photographs, and its arguments."""
    place, _, query = path.partition("?")
    if (method, place) == ("GET", "photographs"):
        asked = dict(parse_qsl(query))
        return "kept_photographs", {
            "heliostat": asked.get("heliostat", ""),
            "limit": int(asked.get("limit", "50")),
        }
    for way, head, tail, call in _NAMED:
        name = path.removeprefix(head).removesuffix(tail)
        if way == method and path == f"{head}{name}{tail}" and name:
            return call, {**given, "name": unquote(name)}
    return "", given
