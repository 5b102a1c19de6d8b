"""A thin client of the HTTP API: for scripts, and for `heliotrope ctl`."""

import json
import struct
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any

import httpx
import numpy as np
import numpy.typing as npt

from heliotrope.console.live import MARK, ROW
from heliotrope.errors import HeliotropeError

#: Where the console of this machine is.
HERE = "http://127.0.0.1:8080/"


class RemoteError(HeliotropeError):
    """What the console has refused, or why it cannot be reached; ``status`` 0 if it cannot."""

    def __init__(self, text: str, status: int = 0) -> None:
        super().__init__(text)
        self.status = status


@dataclass(frozen=True)
class Message:
    """One message of the live stream: its header, and the rows that it tells of."""

    header: Mapping[str, Any]
    rows: npt.NDArray[Any]


def read_message(data: bytes) -> Message:
    """Return a message of the live stream.

    Raises
    ------
    RemoteError
        If it is none.
    """
    if len(data) < 8 or data[:4] != MARK:
        raise RemoteError(f"live stream: {len(data)} bytes that do not begin with {MARK.decode()}")
    (length,) = struct.unpack_from("<I", data, 4)
    rest = len(data) - 8 - length
    if rest < 0 or rest % ROW.itemsize:
        raise RemoteError(f"live stream: {rest} bytes behind a header of {length} are no rows")
    header = json.loads(data[8 : 8 + length])
    return Message(header, np.frombuffer(data, ROW, offset=8 + length))


class Client:
    """A connection to a console, as whoever a token belongs to.

    Parameters
    ----------
    token
        Of the API; "" for what needs none.
    url
        Address of the console.
    timeout
        Of each request, s.
    """

    def __init__(self, token: str = "", url: str = HERE, timeout: float = 30.0) -> None:
        self._url = url.rstrip("/") + "/"
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._headers = headers
        self._http = httpx.Client(
            base_url=f"{self._url}api/v1/", headers=headers, timeout=timeout, trust_env=False
        )

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        self._http.close()

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """Send a request to a path below ``/api/v1/``; return what it answers.

        Raises
        ------
        RemoteError
            What the console says against it, or that it cannot be reached.
        """
        try:
            answer = self._http.request(method, path.lstrip("/"), json=body)
        except httpx.HTTPError as error:
            raise RemoteError(
                f"console {self._url}: {str(error) or type(error).__name__}; is it running there?"
            ) from None
        if answer.is_success:
            return None if answer.status_code == 204 else answer.json()
        raise RemoteError(_detail(answer), answer.status_code)

    def get(self, path: str) -> Any:
        """Return what a path tells."""
        return self.ask("GET", path)

    def command(
        self, name: str, heliostats: Sequence[str] = (), values: Sequence[float] = ()
    ) -> Any:
        """Give a command; return its state, see `TicketState`."""
        order = {"command": name, "heliostats": list(heliostats), "values": list(values)}
        return self.ask("POST", "commands", order)

    def sign_in(self, name: str, password: str) -> None:
        """Begin a session: what follows is done as this person.

        Raises
        ------
        RemoteError
            If name or password is wrong.
        """
        who = self.ask("POST", "session", {"name": name, "password": password})
        self._http.headers["X-CSRF-Token"] = who["csrf"]

    async def live(self) -> AsyncIterator[Message]:
        """Give the messages of the live stream: the whole field, then what has changed.

        Raises
        ------
        RemoteError
            If the console ends it, or cannot be reached.
        """
        from websockets.asyncio.client import connect
        from websockets.exceptions import WebSocketException

        url = f"ws{self._url.removeprefix('http')}api/v1/live"
        try:
            async with connect(url, additional_headers=self._headers, proxy=None) as socket:
                async for data in socket:
                    yield read_message(data if isinstance(data, bytes) else data.encode())
        except (WebSocketException, OSError) as error:
            raise RemoteError(f"console {self._url}: the live stream has ended: {error}") from None


def _detail(answer: httpx.Response) -> str:
    try:
        detail = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        return f"the console answers {answer.status_code}"
    if isinstance(detail, str):
        return detail
    return "; ".join(f"{'.'.join(map(str, one['loc'][1:]))}: {one['msg']}" for one in detail)
