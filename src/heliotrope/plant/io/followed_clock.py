"""Makes a plant follow the clock of the simulated field that it controls.

A simulated field may begin at a different time, run faster, and slow down if its computer is too
slow. The plant polls the state of the field's clock five times per simulated second
(`ClockReader`), and its event loop runs on that time (`FollowedLoop`). Both are created from the
address in a links file with ``twin``, which excludes all other links, so a plant with real links
has no such clock.
"""

import asyncio
import json
import math
import selectors
import threading
import time
from collections import deque
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from urllib.error import URLError
from urllib.request import ProxyHandler, build_opener

from heliotrope.errors import FetchError
from heliotrope.links.clock import VirtualClock

#: Interval between two polls before the field is ready, and later at its speed; the shortest
#: interval; and the longest wait for a reply, s.
_SOON, _LATER, _LEAST, _PATIENCE = 0.05, 0.2, 0.01, 5.0
#: Longest time by which the plant continues from the last reply, s. The field may be slower than
#: its nominal speed, and a plant far ahead of it would consider its reports old.
_AHEAD = 0.4
#: Time that a simulated field may need to start, s.
_STARTING = 30.0
#: Time over which the true speed is measured, s.
_SPAN = 30.0


@dataclass(frozen=True)
class ClockState:
    """State of a simulated field's clock.

    Attributes
    ----------
    wall
        When the state was read, by this computer's monotonic clock, s.
    now, utc
        The field's monotonic time, s, and its UTC in POSIX seconds.
    speed, asked
        The present and the requested speed of the field's clock, seconds per second.
    waits, begun
        Whether the field waits for its plant; whether the plant controls all of it.
    ahead
        Longest time for which the plant extrapolates from this state, s; infinite if the field has
        gone.
    """

    wall: float
    now: float
    utc: float
    speed: float
    asked: float
    waits: bool
    begun: bool
    ahead: float = _AHEAD

    def at(self, wall: float) -> float:
        """Return the field's monotonic time at another time of this computer, if known."""
        return self.now + min(self.speed * (wall - self.wall), self.ahead)


class ClockReader:
    """Reads the state of a simulated field's clock in a thread.

    Parameters
    ----------
    address
        Address in the links file.

    Attributes
    ----------
    state
        The last state.

    Raises
    ------
    FetchError
        If the simulated field does not reply.
    """

    def __init__(self, address: str) -> None:
        self._address = address
        # A proxy from the environment is meant for other computers.
        self._opener = build_opener(ProxyHandler({}))
        self._states: deque[ClockState] = deque(maxlen=int(_SPAN / _LATER))
        self._stop = threading.Event()
        self.state = self._first()
        self._thread = threading.Thread(target=self._run, name="clock of the field", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._stop.set()

    def clock(self, loop: asyncio.AbstractEventLoop) -> VirtualClock:
        """Return the field's clock, by the time of a `FollowedLoop`."""
        now, state = loop.time(), self.state
        return VirtualClock(loop.time, datetime.fromtimestamp(state.utc + now - state.now, UTC))

    @property
    def pace(self) -> float:
        """Simulated seconds per second over the last half minute."""
        first, last = self._states[0], self.state
        span = last.wall - first.wall
        return (last.now - first.now) / span if span > 1.0 else last.speed

    async def begin(self) -> None:
        """Start the simulated field's clock once the field is ready; until then it stands still."""
        while not self.state.waits:
            await asyncio.to_thread(time.sleep, _SOON)
        await asyncio.to_thread(self.fetch, "begin")

    async def led(self) -> None:
        """Wait until the plant controls all of the field."""
        while not self.state.begun:
            await asyncio.to_thread(time.sleep, _SOON)

    def fetch(self, path: str) -> bytes:
        """Return a document that the simulated field serves.

        Raises
        ------
        FetchError
            If the simulated field does not reply.
        """
        try:
            with self._opener.open(f"{self._address}/{path}", timeout=_PATIENCE) as answer:
                return bytes(answer.read())
        except (OSError, URLError) as error:
            raise FetchError(
                f"simulated field: no reply ({error}); restart it with heliotrope twin"
            ) from None

    def _first(self) -> ClockState:
        """Return the first state; wait if the simulated field has only just been started."""
        until = time.monotonic() + _STARTING
        while True:
            try:
                return self._read()
            except FetchError:
                if time.monotonic() > until:
                    raise
                time.sleep(_SOON)

    def _read(self) -> ClockState:
        begun = time.monotonic()
        found = json.loads(self.fetch("clock"))
        state = ClockState(0.5 * (begun + time.monotonic()), **found)
        self._states.append(state)
        return state

    def _run(self) -> None:
        later = max(_LEAST, _LATER / max(1.0, self.state.asked))
        while not self._stop.wait(later if self.state.begun else _SOON):
            try:
                self.state = self._read()
            except (FetchError, ValueError):
                # The plant continues without the field, and notices that it is silent.
                wall = time.monotonic()
                now = self.state.at(wall)
                utc = self.state.utc + now - self.state.now
                self.state = replace(self.state, wall=wall, now=now, utc=utc, ahead=math.inf)


class _Followed(selectors.DefaultSelector):
    """Waits for files and for the time of another clock."""

    def __init__(self, reader: ClockReader) -> None:
        super().__init__()
        self.reader, self.now = reader, reader.state.now

    def turn(self) -> float:
        """Return the time; it never runs backwards."""
        self.now = max(self.now, self.reader.state.at(time.monotonic()))
        return self.now

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        if timeout is None:
            return list(super().select(None))
        speed = self.reader.state.speed
        wait = timeout / speed if speed > 0.0 else _SOON
        # The speed may change during the wait.
        return list(super().select(max(0.0, min(wait, _LATER)) if timeout > 0.0 else 0.0))


class FollowedLoop(asyncio.SelectorEventLoop):
    """An event loop with the time of a simulated field.

    Parameters
    ----------
    reader
        Reader of the field's clock.
    """

    def __init__(self, reader: ClockReader) -> None:
        self._followed = _Followed(reader)
        super().__init__(self._followed)

    def time(self) -> float:
        """Return the field's time, s."""
        return self._followed.turn()
