"""A link through a live broker to which strangers may publish what they like, for some seconds."""

import asyncio
import contextlib
import itertools
import json
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from heliotrope.links.clock import SystemClock
from heliotrope.links.link import Link, LinkSettings, received, running
from heliotrope.links.mqtt import Broker, mqtt_link
from support import broker_strangers
from support.broker import Mosquitto, mosquitto_for

KEY, PREFIX, CLOCK = bytes(range(32)), "heliotrope/test", SystemClock()
SETTINGS = LinkSettings(deadline=10.0, open_limit=5.0)
#: Length of an attack, s, growth of this process's memory meanwhile, MB, and patience, s.
SECONDS, GROWTH, PATIENCE = 10.0, 64.0, 60.0
#: The plant's leases last this long, s; its loop must not stand still for so long.
LEASE = 3.0


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[Mosquitto]:
    yield from mosquitto_for(tmp_path)


def memory() -> float:
    """Return the memory of this process, MB."""
    fields = Path("/proc/self/status").read_text("ascii").split("VmRSS:")[1].split()
    return int(fields[0]) * 1024 / 1e6


@contextlib.asynccontextmanager
async def strangers(port: int, rate: float) -> AsyncIterator[dict[str, int]]:
    """Strangers publish during a block, which ends after them; yield what each has published."""
    counts = dict[str, int]()
    program = str(Path(broker_strangers.__file__))
    words = [str(port), f"{PREFIX}/north/down", str(SETTINGS.largest), str(rate), str(SECONDS)]
    process = await asyncio.create_subprocess_exec(
        sys.executable, program, *words, stdout=asyncio.subprocess.PIPE
    )
    yield counts
    text, _ = await process.communicate()
    counts.update(json.loads(text))


async def longest_gap(over: asyncio.Event) -> float:
    """Return the longest time for which this loop did nothing else, s."""
    worst, last = 0.0, CLOCK.monotonic()
    while not over.is_set():
        await asyncio.sleep(0.02)
        now = CLOCK.monotonic()
        worst, last = max(worst, now - last), now
    return worst


def attacked(mosquitto: Mosquitto, rate: float) -> tuple[Link, list[bytes], list[bytes], float]:
    """Send an order every 0.1 s during an attack, and one after it.

    Returns
    -------
    The link's end at the cluster, the orders sent and those received, and the longest gap of the
    loop, s.
    """
    sent, heard = list[bytes](), list[bytes]()

    async def main() -> tuple[Link, float]:
        broker, over = Broker("127.0.0.1", mosquitto.port), asyncio.Event()
        plant, cluster = (
            mqtt_link(broker, PREFIX, "north", KEY, CLOCK, SETTINGS, plant=side)
            for side in (True, False)
        )

        async def listen() -> None:
            async for message in received(cluster):
                heard.append(message)

        async with running(plant, cluster), asyncio.timeout(2.0 * PATIENCE):
            while not (plant.connected and cluster.connected):
                await asyncio.sleep(0.02)
            async with asyncio.TaskGroup() as group:
                listening = group.create_task(listen())
                watching = group.create_task(longest_gap(over))
                async with strangers(mosquitto.port, rate) as counts:
                    until = CLOCK.monotonic() + SECONDS
                    for number in itertools.count():
                        if CLOCK.monotonic() > until:
                            break
                        sent.append(b"order %d" % number)
                        await plant.send(sent[-1])
                        await asyncio.sleep(0.1)
                over.set()
                # What they published reaches the cluster no more, and the link is well again.
                while b"the last order" not in heard:
                    await plant.send(b"the last order")
                    await asyncio.sleep(0.1)
                listening.cancel()
            print(f"{rate:g}/s: {counts}, gap {watching.result():.2f} s, {cluster.statistics}")
            assert sum(counts.values()) > 100
        return cluster, watching.result()

    before = memory()
    cluster, gap = asyncio.run(main())
    grown = memory() - before
    print(f"memory +{grown:.0f} MB")
    assert grown < GROWTH
    return cluster, sent, heard, gap


@pytest.mark.slow
def test_messages_of_strangers_change_nothing(mosquitto: Mosquitto) -> None:
    cluster, sent, heard, gap = attacked(mosquitto, 100.0)
    assert heard[: len(sent)] == sent
    assert cluster.statistics.reconnects == 0
    assert cluster.statistics.retained > 50
    assert cluster.statistics.refused > 50
    assert cluster.statistics.repeated > 10
    assert gap < LEASE


@pytest.mark.slow
def test_a_flood_at_the_broker_ends_and_the_link_is_made_again(mosquitto: Mosquitto) -> None:
    cluster, sent, heard, gap = attacked(mosquitto, 0.0)
    # Each order at most once and in order, whatever the flood has pushed out of the broker.
    ours = [order for order in heard if order != b"the last order"]
    assert ours == [order for order in sent if order in set(ours)]
    assert cluster.statistics.refused > 100
    assert gap < LEASE
