"""Time from a receiver at a real port: a pseudo-terminal, and a serial server in the network."""

import asyncio
import contextlib
import os
import tty
from collections.abc import Awaitable, Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from heliotrope.cluster.discipline import DisciplineSettings
from heliotrope.cluster.gps import GpsSettings, GpsTime
from heliotrope.cluster.timekeeping import SystemTime, TimeKeeper
from heliotrope.errors import InputError
from heliotrope.links.clock import SystemClock
from heliotrope.links.link import LinkError, running
from support.nmea_talk import gga, rmc, zda

PATIENCE = 20.0
#: A receiver of ten fixes a second, and a wide latency, since a busy machine takes its time.
DISCIPLINE = DisciplineSettings(
    latency=2.0, largest_error=3.0, confirm=0.4, fresh=3.0, system_tolerance=5.0
)
QUICK = GpsSettings(discipline=DISCIPLINE, first_pause=0.02, longest_pause=0.1)


def real(main: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(2.0 * PATIENCE):
            await main()

    asyncio.run(limited())


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.01)


class Receiver:
    """A receiver at the far end of a pseudo-terminal, which tells the time of this machine."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.talk: Callable[[datetime], bytes] = rmc
        self._over = False
        self.plug_in()

    def plug_in(self) -> None:
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._near, False)  # nobody may read
        self.path.unlink(missing_ok=True)
        self.path.symlink_to(os.ttyname(self._far))

    def unplug(self) -> None:
        self.path.unlink()  # the terminal's number may be another test's at once
        near, self._near = self._near, -1
        os.close(near)
        os.close(self._far)

    async def run(self) -> None:
        while not self._over:
            if self._near >= 0 and (data := self.talk(datetime.now(UTC))):
                with contextlib.suppress(BlockingIOError):
                    os.write(self._near, data)
            await asyncio.sleep(0.1)

    async def close(self) -> None:
        self._over = True


@pytest.fixture
def receiver(tmp_path: Path) -> Iterator[Receiver]:
    made = Receiver(tmp_path / "gps")
    yield made
    if made._near >= 0:
        made.unplug()


def of(receiver: Receiver, settings: GpsSettings = QUICK) -> GpsTime:
    return GpsTime(str(receiver.path), SystemClock(), settings)


@pytest.mark.parametrize("talk", [rmc, lambda utc: gga(utc) + zda(utc)])
def test_the_time_comes_through_a_port(
    receiver: Receiver, talk: Callable[[datetime], bytes]
) -> None:
    receiver.talk = talk

    async def main() -> None:
        keeper = of(receiver)
        assert keeper.time().quality == "none"
        assert keeper.problem == f"GPS receiver {receiver.path}: not opened yet"
        async with running(receiver, keeper):
            await until(lambda: keeper.time().quality == "gps")
            now = keeper.time()
            assert now.utc_s == pytest.approx(datetime.now(UTC).timestamp(), abs=now.error + 0.5)
            assert (now.jumped, keeper.problem, keeper.connected) == (False, "", True)
            assert abs(keeper.system_ahead) <= now.error + 0.5
            with pytest.raises(LinkError, match="it runs already"):
                await keeper.run()
        assert not keeper.connected
        assert keeper.time().error > now.error

    real(main)


def test_it_is_a_time_keeper_as_the_system_is() -> None:
    keepers: list[TimeKeeper] = [
        GpsTime("/dev/null", SystemClock(), QUICK),
        SystemTime(SystemClock()),
    ]

    async def main() -> None:
        async with running(*keepers):
            await asyncio.sleep(0.05)
        for keeper in keepers:  # closed before it runs: it ends at once
            await keeper.run()

    real(main)
    assert [keeper.time().quality for keeper in keepers] == ["none", "system"]


def test_without_its_receiver_it_holds_over_and_comes_back(receiver: Receiver) -> None:
    async def main() -> None:
        keeper = of(receiver)
        async with running(receiver, keeper):
            await until(lambda: keeper.time().quality == "gps")
            receiver.unplug()
            await until(lambda: keeper.time().quality == "holdover")
            assert not keeper.connected
            assert f"{receiver.path}: it cannot be opened" in keeper.problem
            assert keeper.failures >= 1
            receiver.plug_in()
            await until(lambda: keeper.time().quality == "gps")
            assert not keeper.time().jumped

    real(main)


def test_a_silent_port_is_opened_anew(receiver: Receiver) -> None:
    async def main() -> None:
        keeper = of(receiver, GpsSettings(discipline=DISCIPLINE, silence=0.3, first_pause=0.2))
        receiver.talk = lambda _: b""
        async with running(receiver, keeper):
            await until(lambda: keeper.problem.endswith("silent for 0.3 s"))
            receiver.talk = rmc
            await until(lambda: keeper.time().quality == "gps")

    real(main)


def test_rubbish_is_no_time_and_ends_nothing(receiver: Receiver) -> None:
    async def main() -> None:
        keeper = of(receiver)
        receiver.talk = lambda _: os.urandom(200)
        async with running(receiver, keeper):
            await until(lambda: "baud rate" in keeper.problem)
            assert keeper.time().quality == "none"
            receiver.talk = rmc
            await until(lambda: keeper.time().quality == "gps")

    real(main)


def test_a_serial_server_in_the_network_has_a_receiver_too() -> None:
    async def main() -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while not over.is_set() and not reader.at_eof():
                writer.write(rmc(datetime.now(UTC)))
                await asyncio.sleep(0.1)
            writer.close()
            gone.set()

        over, gone = asyncio.Event(), asyncio.Event()
        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        keeper = GpsTime(f"socket://127.0.0.1:{port}", SystemClock(), QUICK)
        async with running(keeper):
            await until(lambda: keeper.time().quality == "gps")
            over.set()
            await gone.wait()
            server.close()
            await until(lambda: keeper.time().quality == "holdover")
            assert "cannot be opened" in keeper.problem
        await asyncio.sleep(0.05)  # for the server's own tasks to see their end

    real(main)


@pytest.mark.parametrize("url", ["/dev/no-such-port", "nonsense://x"])
def test_a_port_that_is_not_there_is_named(url: str) -> None:
    async def main() -> None:
        keeper = GpsTime(url, SystemClock(), QUICK)
        async with running(keeper):
            await until(lambda: keeper.failures >= 2)
            assert f"{url}: it cannot be opened" in keeper.problem
            assert keeper.time().quality == "none"

    real(main)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"baud_rate": 300}, "300 baud; give 1200 to 921600"),
        ({"silence": 0.0}, "a silence of 0.0 s"),
        ({"first_pause": 9.0}, "not above the longest"),
    ],
)
def test_settings_that_no_receiver_has_are_refused(values: dict[str, float], text: str) -> None:
    with pytest.raises(InputError, match=text):
        GpsSettings(**values)  # type: ignore[arg-type]
