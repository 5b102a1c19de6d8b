"""A thin client of the HTTP API, for scripts and for `heliotrope ctl`."""

from collections.abc import AsyncIterator, Sequence
from types import TracebackType
from typing import Any

import httpx

from heliotrope.console.stream import LiveMessage, RemoteError, read_message

#: Address of the console on this computer.
HERE = "http://127.0.0.1:8080/"


class Client:
    """A connection to a console.

    Parameters
    ----------
    token
        API token; "" for routes that need no token.
    url
        Address of the console.
    timeout
        Timeout of each request, s.
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
        """Close the connection."""
        self._http.close()

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """Send a request to a path below ``/api/v1/`` and return the reply.

        Raises
        ------
        RemoteError
            If the console refuses the request, or cannot be reached.
        """
        answer = self._request(method, path, body)
        return None if answer.status_code == 204 else answer.json()

    def get(self, path: str) -> Any:
        """Return the reply to a GET request for a path."""
        return self.ask("GET", path)

    def picture(self, path: str) -> bytes:
        """Return the JPEG at a path; see `ask`."""
        return self._request("GET", path, None).content

    def _request(self, method: str, path: str, body: Any) -> httpx.Response:
        try:
            answer = self._http.request(method, path.lstrip("/"), json=body)
        except httpx.ReadTimeout:
            after = "it is too busy; try again"
            if method != "GET":
                after = "the order may still take effect: look at the events before you repeat it"
            raise RemoteError(
                f"console {self._url}: no answer within {self._http.timeout.read:g} s; {after}"
            ) from None
        except httpx.HTTPError as error:
            raise RemoteError(
                f"console {self._url}: {str(error) or type(error).__name__}; check that it is "
                "running there"
            ) from None
        if answer.is_success:
            return answer
        raise RemoteError(_detail(answer), answer.status_code)

    def command(
        self, name: str, heliostats: Sequence[str] = (), values: Sequence[float] = ()
    ) -> Any:
        """Send a command and return its state; see `TicketState`."""
        order = {"command": name, "heliostats": list(heliostats), "values": list(values)}
        return self.ask("POST", "commands", order)

    def sign_in(self, name: str, password: str, code: str = "") -> None:
        """Sign in; later requests are then made as this user.

        Raises
        ------
        RemoteError
            If name, password or code is wrong; with status 428 if a code is required.
        """
        self._http.cookies.clear()
        who = self.ask("POST", "session", {"name": name, "password": password, "code": code})
        self._http.headers["X-CSRF-Token"] = who["csrf"]

    def change_password(self, old: str, new: str) -> None:
        """Change your own password, which ends all sessions and tokens.

        Raises
        ------
        RemoteError
            If the old password is wrong, or the new one is not accepted.
        """
        self.ask("PUT", "session/password", {"old": old, "new": new})

    async def live(self) -> AsyncIterator[LiveMessage]:
        """Yield the messages of the live stream: the whole field, then the changes.

        Raises
        ------
        RemoteError
            If the console closes the stream, or cannot be reached.
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
        return f"the console replied with status {answer.status_code}"
    if isinstance(detail, str):
        return detail
    return "; ".join(
        f"{'.'.join(map(str, problem['loc'][1:]))}: {problem['msg']}" for problem in detail
    )
