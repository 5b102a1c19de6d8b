"""Viewers of the live stream: their places, what they may send, and when they are sent away."""

import contextlib
import time
from collections import deque
from collections.abc import Callable
from typing import Any, cast

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.frames import Frame, Opcode
from websockets.sync.client import ClientConnection, connect

from heliotrope.console import api, roster
from heliotrope.console.live import OWN, RESERVED, Stream
from heliotrope.plant.interface import BusyError
from heliotrope.plant.orders.authority import Person, Role
from support.live_console import LiveConsole

OLGA = Person("Olga", Role.OPERATOR)


def viewer(number: int) -> Person:
    return Person(f"viewer {number}", Role.VIEWER)


def taken(stack: contextlib.ExitStack, stream: Stream, who: Callable[[int], Person]) -> int:
    """Return how many places are taken before one is refused."""
    for number in range(1000):
        try:
            stack.enter_context(stream.place(who(number)))
        except BusyError:
            return number
    raise AssertionError("no place is refused")


def test_one_person_takes_few_places() -> None:
    stream = Stream(cast("Any", None), most=100)
    with contextlib.ExitStack() as stack:
        assert taken(stack, stream, lambda _: viewer(1)) == OWN
        with pytest.raises(BusyError, match=f"{OWN} streams of viewer 1 are already open"):
            stack.enter_context(stream.place(viewer(1)))
        stack.enter_context(stream.place(viewer(2)))
    with contextlib.ExitStack() as stack:  # all were given back
        assert taken(stack, stream, lambda _: viewer(1)) == OWN


def test_viewers_leave_places_to_operators() -> None:
    stream = Stream(cast("Any", None), most=100)
    with contextlib.ExitStack() as stack:
        assert taken(stack, stream, viewer) == round(100 * (1.0 - RESERVED))
        assert taken(stack, stream, lambda _: OLGA) == OWN
        with pytest.raises(BusyError, match="100 streams are already open"):
            stack.enter_context(stream.place(Person("Otto", Role.OPERATOR)))


@pytest.fixture
def watch(console: LiveConsole, tokens: dict[str, str]) -> Callable[..., ClientConnection]:
    """Open a live stream by a token."""

    def opened(token: str = tokens["viewer"]) -> ClientConnection:
        return connect(
            f"ws{console.address.removeprefix('http')}api/v1/live",
            additional_headers={"Authorization": f"Bearer {token}"},
            proxy=None,
        )

    return opened


def test_a_person_beyond_their_places_is_refused(
    console: LiveConsole, tokens: dict[str, str], watch: Callable[..., ClientConnection]
) -> None:
    with contextlib.ExitStack() as stack:
        lines = [stack.enter_context(watch()) for _ in range(OWN + 1)]
        with pytest.raises(ConnectionClosed) as closed:
            lines[-1].recv(timeout=30.0)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4429
        assert "viewer" in closed.value.rcvd.reason
        operator = stack.enter_context(watch(tokens["operator"]))
        assert operator.recv(timeout=30.0)
    assert console.live.operations is not None


def _frame(opcode: Opcode, size: int) -> bytes:
    return Frame(opcode, bytes(size), fin=opcode is Opcode.PING).serialize(mask=True)


@pytest.mark.parametrize(
    ("first", "then"),
    [
        (_frame(Opcode.BINARY, 60_000), b""),
        # A message of empty parts that never ends.
        (_frame(Opcode.BINARY, 0), _frame(Opcode.CONT, 0) * 200),
        # Their answers are not read.
        (b"", _frame(Opcode.PING, 125) * 10),
    ],
    ids=["long", "parts", "pings"],
)
def test_a_viewer_who_sends_is_cut_off(
    watch: Callable[..., ClientConnection], first: bytes, then: bytes
) -> None:
    """Nothing that a viewer sends is used, and all of it would be kept for a while."""
    with watch() as line:
        assert line.recv(timeout=30.0)
        try:
            line.socket.sendall(first)
            for _ in range(200):
                line.socket.sendall(then)
                time.sleep(0.01)
            line.recv(timeout=30.0)
            line.recv(timeout=30.0)
        except (ConnectionClosed, OSError):
            return
        raise AssertionError("the server took all of it")


@pytest.mark.parametrize("how", ["revoked", "disabled"])
def test_a_stream_ends_with_its_token(
    console: LiveConsole,
    watch: Callable[..., ClientConnection],
    monkeypatch: pytest.MonkeyPatch,
    how: str,
) -> None:
    monkeypatch.setattr(api, "TRUSTED", 0.2)
    monkeypatch.setattr(roster, "TRUSTED", 0.2)
    people, name = console.keeper.people, f"watcher {how}"
    people.add(name, "none", "viewer", time.time())
    made, secret = people.add_token(name, "tests", "viewer", time.time())
    with watch(secret) as line:
        assert line.recv(timeout=30.0)
        if how == "revoked":
            people.revoke_token(made.key)
        else:
            people.change(name, time.time(), disabled=True)
        with pytest.raises(ConnectionClosed) as closed:
            deque(iter(line.recv, None), maxlen=0)
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 4401
