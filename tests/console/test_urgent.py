"""EMERGENCY by a way of its own: the second listener."""

import asyncio
import hashlib
import socket
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack
from typing import Any

import httpx
import pytest

from heliotrope.console import roster
from heliotrope.console.listeners import Listeners
from heliotrope.console.settings import ConsoleSettings
from heliotrope.console.urgent import EmergencyWay
from heliotrope.errors import HeliotropeError, InputError
from heliotrope.local import AwayError, Buckets, CallError
from support.live_console import LiveConsole

Ask = Callable[..., httpx.Response]


@pytest.fixture
def way(console: LiveConsole) -> Iterator[httpx.Client]:
    """Return a client of the second listener; the emergency is withdrawn afterwards."""
    port = console.server.app.state.console.emergency_port
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", trust_env=False) as client:
        yield client
    console.calm()


def ordered(console: LiveConsole) -> int:
    """Return how many emergencies were ordered so far."""
    events = console.call(lambda: console.live.operations.logbook.events(1000))
    return sum("EMERGENCY" in event.text for event in events)


def test_a_viewer_orders_it_once_by_both_ways(
    console: LiveConsole, ask: Ask, way: httpx.Client, tokens: dict[str, str]
) -> None:
    before = ordered(console)
    order = {"act": "DEFOCUS", "reason": "smoke", "call": "one word"}
    bearer = {"Authorization": f"Bearer {tokens['viewer']}"}
    answer = way.post("/api/v1/emergency", json=order, headers=bearer)
    assert answer.status_code == 200, answer.text
    assert answer.json()["on"]
    assert ask("viewer", "POST", "emergency", order).json()["on"]
    assert ordered(console) == before + 1
    # An equal one with another word merges with it; one with another reason is new.
    assert ask("viewer", "POST", "emergency", {**order, "call": "other"}).status_code == 200
    assert ordered(console) == before + 1
    more = {**order, "call": "third", "reason": "a fire"}
    assert ask("viewer", "POST", "emergency", more).status_code == 200
    assert ordered(console) == before + 2


@pytest.mark.parametrize("word", [True, False])
@pytest.mark.parametrize("origin", ["page", "elsewhere", "other port", None])
def test_a_session_orders_it_from_its_page_only(
    console: LiveConsole, signed_in: httpx.Client, way: httpx.Client, word: bool, origin: str | None
) -> None:
    before = ordered(console)
    page = console.address.rstrip("/")
    origins = {"page": page, "elsewhere": "http://evil.example", "other port": "http://127.0.0.1:1"}
    headers = {"Content-Type": "text/plain"}
    if origin is not None:
        headers["Origin"] = origins[origin]
    order: dict[str, Any] = {"reason": "smoke"}
    if word:
        order["csrf"] = signed_in.headers["X-CSRF-Token"]
    cookies = {"heliotrope_session": signed_in.cookies["heliotrope_session"]}
    answer = httpx.post(
        f"{way.base_url}/api/v1/emergency",
        json=order,
        headers={**headers, "Cookie": f"heliotrope_session={cookies['heliotrope_session']}"},
        trust_env=False,
    )
    good = word and origin in ("page", None)
    assert answer.status_code == (200 if good else 403)
    assert ordered(console) == before + good
    shown = answer.headers.get("access-control-allow-origin")
    assert shown == (page if origin == "page" else None)


def test_it_serves_nothing_else(way: httpx.Client, tokens: dict[str, str]) -> None:
    bearer = {"Authorization": f"Bearer {tokens['engineer']}"}
    for method, path in (("GET", "/"), ("GET", "/api/v1/emergency"), ("POST", "/api/v1/stow")):
        assert way.request(method, path, headers=bearer).status_code == 404
    url = "/api/v1/emergency"
    assert way.post(url).status_code == 401
    assert way.post(url, headers=bearer, content=b"x" * 4000).status_code == 413
    assert way.post(url, headers=bearer, content=b"[[").status_code == 422
    assert way.post(url, headers=bearer, json={"act": "TRACK"}).status_code == 422
    assert way.post(url, headers={**bearer, "Host": "evil.example"}).status_code == 421


def test_held_connections_do_not_close_it(
    console: LiveConsole, way: httpx.Client, tokens: dict[str, str]
) -> None:
    """Both ports are full of half-open connections; the order is given all the same."""
    bearer = {"Authorization": f"Bearer {tokens['viewer']}"}
    ports = [console.server.app.state.console.emergency_port, httpx.URL(console.address).port]
    with ExitStack() as stack:
        for port in ports:
            for _ in range(250):
                line = socket.create_connection(("127.0.0.1", port), timeout=10.0)
                stack.enter_context(line).sendall(b"POST /api/v1/emergency HTTP/1.1\r\n")
        begun = time.monotonic()
        assert way.post("/api/v1/emergency", headers=bearer).status_code == 200
        assert time.monotonic() - begun < 5.0


def test_the_page_may_reach_it(console: LiveConsole, signed_in: httpx.Client) -> None:
    port = console.server.app.state.console.emergency_port
    answer = signed_in.get(f"{console.address}emergency")
    assert (
        f"connect-src 'self' http://127.0.0.1:{port};" in answer.headers["content-security-policy"]
    )
    assert f'name="heliotrope-emergency" content="{port}"' in answer.text
    assert f'name="heliotrope-csrf" content="{signed_in.headers["X-CSRF-Token"]}"' in answer.text
    assert "csrf" not in httpx.get(f"{console.address}emergency", trust_env=False).text


def test_its_port() -> None:
    """The next one; another if that is taken, unless it was asked for. The page's is given back."""
    with socket.create_server(("127.0.0.1", 0)) as line:
        taken = line.getsockname()[1]
        lines = Listeners(ConsoleSettings(port=0, emergency_port=taken))
        with pytest.raises(InputError, match="choose another with --emergency-port"):
            lines.open()
        with pytest.raises(InputError, match="choose another with --port"):
            Listeners(ConsoleSettings(port=taken)).open()
    lines = Listeners(ConsoleSettings(port=0))
    assert [one.getsockname()[1] for one in lines.open()] == [
        lines.settings.port,
        lines.settings.emergency_port,
    ]
    assert lines.open() is lines.open()
    lines.close()


def test_its_port_where_the_next_one_is_taken() -> None:
    for _ in range(100):
        with socket.create_server(("127.0.0.1", 0)) as line:
            taken = line.getsockname()[1]
            lines = Listeners(ConsoleSettings(port=taken - 1))
            try:
                lines.open()
            except InputError:
                continue  # another program has the port before it
            assert lines.settings.emergency_port not in (None, taken - 1, taken)
            lines.close()
            break
    else:
        pytest.fail("no two free ports side by side")
    with pytest.raises(InputError, match="or 0 for a free port, not 70000"):
        ConsoleSettings(emergency_port=70_000)
    assert ConsoleSettings.of(lines.settings.values) == lines.settings


class Plant:
    """Answers the calls of the way; ``away`` is what it says instead to the store's."""

    def __init__(self) -> None:
        self.away: HeliotropeError | None = None
        self.valid = ["good"]
        self.orders = self.asked = 0

    async def ask(self, call: str, given: dict[str, Any], **_: Any) -> tuple[Any, bytes]:
        if call == "order_emergency":
            self.orders += 1
            return {"on": True}, b""
        self.asked += 1
        if self.away is not None:
            raise self.away
        assert call == "people.valid"
        made = {"name": "ada", "role": "viewer", "expires": None}
        keys = [hashlib.sha256(word.encode() * 16).hexdigest() for word in self.valid]
        found = [{"key": key, **made} for key in keys]
        return {"sessions": found, "tokens": found}, b""


class Caller:
    """Orders emergencies by tokens."""

    def __init__(self, way: EmergencyWay) -> None:
        self.way = way

    async def by_token(self, word: str, times: int = 1) -> list[int]:
        """Return the statuses of some orders."""
        transport = httpx.ASGITransport(app=self.way)
        headers = {"Authorization": f"Bearer {word * 16}"}
        async with httpx.AsyncClient(
            transport=transport, base_url="http://127.0.0.1", headers=headers
        ) as client:
            url = "/api/v1/emergency"
            sent = [client.post(url, json={}) for _ in range(times)]
            return [answer.status_code for answer in await asyncio.gather(*sent)]


def at_work(plant: Plant, work: Callable[[Caller], Coroutine[Any, Any, None]]) -> None:
    """Do something at a way whose roster is read."""

    async def main() -> None:
        way = EmergencyWay(plant.ask, ConsoleSettings())
        async with asyncio.timeout(30.0), asyncio.TaskGroup() as group:
            reading = group.create_task(way.roster.run())
            await work(Caller(way))
            reading.cancel()

    asyncio.run(main())


@pytest.mark.parametrize("away", [AwayError("no answer"), CallError("store", "it is full")])
def test_it_knows_everybody_whom_the_store_knew_lately(
    away: HeliotropeError, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = Plant()
    plant.valid = ["good", "unmet"]

    async def work(caller: Caller) -> None:
        assert await caller.by_token("good") == [200]
        plant.away = away
        monkeypatch.setattr(roster, "TRUSTED", -1.0)
        assert await caller.by_token("good") == [200]
        assert await caller.by_token("unmet") == [200]
        assert await caller.by_token("evil") == [503]
        plant.away, plant.valid = None, ["good"]
        assert await caller.by_token("evil") == [401]
        assert await caller.by_token("unmet") == [401]  # revoked
        assert plant.orders == 3

    at_work(plant, work)


def test_strangers_are_counted_and_people_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """An unmet token neither counts with strangers nor waits behind them for the store."""
    monkeypatch.setattr(roster, "_WAITS", 20.0)  # this test asks 200 times at once
    plant = Plant()

    async def work(caller: Caller) -> None:
        caller.way._stranger = Buckets(1.0, 10.0, lambda: 0.0)
        before = plant.asked
        assert sorted(await caller.by_token("evil", 200)) == [401] * 10 + [429] * 190
        assert plant.asked <= before + 4
        plant.valid.append("unmet")
        assert await caller.by_token("unmet", 30) == [200] * 30
        assert await caller.by_token("good", 30) == [200] * 30

    at_work(plant, work)


@pytest.mark.parametrize(
    ("headers", "body", "status"),
    [
        ({"Origin": "http://["}, b"{}", 401),
        ({"Origin": "http://[::1", "Authorization": f"Bearer {'good' * 16}"}, b"{}", 403),
        ({"Cookie": f"heliotrope_session={'good' * 16}"}, b'{"csrf": "\\ud800"}', 403),
    ],
)
def test_text_that_cannot_be_read_is_refused_like_any_other(
    headers: dict[str, str], body: bytes, status: int
) -> None:
    """An address without its bracket, and half a surrogate pair, were mistakes of the program."""
    plant = Plant()

    async def work(caller: Caller) -> None:
        transport = httpx.ASGITransport(app=caller.way)
        url = "http://127.0.0.1/api/v1/emergency"
        async with httpx.AsyncClient(transport=transport, headers=headers) as client:
            assert (await client.post(url, content=body)).status_code == status

    at_work(plant, work)
    assert plant.orders == 0
