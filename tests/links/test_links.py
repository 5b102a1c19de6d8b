"""Links: what is promised of messages, in virtual time; TCP against real sockets."""

import asyncio
import contextlib
import random
import select
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from heliotrope.errors import FormatError, InputError
from heliotrope.links.clock import SystemClock, VirtualClock, run_virtual, sleep_until
from heliotrope.links.envelope import OVERHEAD, Conversation
from heliotrope.links.in_process import Faults, memory_pair
from heliotrope.links.keys import Keys
from heliotrope.links.link import (
    Backoff,
    Heartbeat,
    Link,
    LinkClosedError,
    LinkError,
    LinkSettings,
    SendOutcome,
    Statistics,
    received,
    running,
)
from heliotrope.links.tcp import (
    _NEWCOMERS,
    _NEWCOMERS_EACH,
    TcpServer,
    _Newcomers,
    _proof,
    tcp_link,
)
from heliotrope.links.tls import client_tls, server_tls
from support.absence import absent

SETTINGS = LinkSettings(period=0.5, deadline=1.5)
#: For real sockets: quick beats, so that a test need not wait.
QUICK = LinkSettings(period=0.05, deadline=0.6, first_pause=0.02, longest_pause=0.1)
KEY, OTHER_KEY = bytes(range(32)), bytes(32)
PATIENCE = 60.0


async def connected(*links: Link) -> None:
    async with asyncio.timeout(PATIENCE):
        while not all(link.connected for link in links):
            await asyncio.sleep(0.01)


async def until(holds: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE):
        while not holds():
            await asyncio.sleep(0.01)


# -- the parts -------------------------------------------------------------------------


def test_pauses_double_to_their_limit_and_begin_anew() -> None:
    backoff = Backoff(0.1, 2.0, random.Random(3))
    pauses = [backoff.next() for _ in range(9)]
    for pause, whole in zip(pauses, [0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0, 2.0, 2.0], strict=True):
        assert 0.5 * whole <= pause <= whole
    assert len(set(pauses)) == len(pauses)
    backoff.reset()
    assert backoff.next() <= 0.1


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"period": 1.0, "deadline": 1.5}, "must be at least twice the period"),
        ({"first_pause": 3.0}, "at most the longest"),
        ({"capacity": 0}, "capacity must be at least 1, .* not 0,"),
        ({"largest": 0}, "largest message at least 1 byte .* 0 bytes"),
        ({"horizon": 0.0}, "horizon 0 to 4000 s, .* 0.0 s"),
        ({"horizon": 9000.0}, "horizon 0 to 4000 s, .* 9000.0 s"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(
    values: dict[str, float], text: str
) -> None:
    with pytest.raises(InputError, match=text):
        LinkSettings(**values)  # type: ignore[arg-type]


def test_the_smallest_and_the_largest_settings_are_taken() -> None:
    for values in ({"capacity": 1, "largest": 1}, {"horizon": 4000.0}, {"deadline": 1.0}):
        LinkSettings(period=0.5, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"loss": 1.5}, "probability of loss must be between 0 and 1, not 1.5"),
        ({"delay": (0.2, 0.1)}, "delay of 0.2 to 0.1 s"),
    ],
)
def test_faults_that_make_no_sense_are_refused(values: dict[str, object], text: str) -> None:
    with pytest.raises(InputError, match=text):
        Faults(**values)  # type: ignore[arg-type]


def test_a_heartbeat_keeps_its_rhythm_and_counts_silence() -> None:
    async def main(clock: VirtualClock) -> None:
        heart = Heartbeat(clock, 0.5, 1.5)
        times: list[float] = []
        begin = clock.monotonic()

        async def beat() -> None:
            times.append(clock.monotonic() - begin)
            await asyncio.sleep(0.8 if len(times) == 3 else 0.1)

        assert not heart.alive
        heart.heard()
        async with asyncio.TaskGroup() as group:
            task = group.create_task(heart.run(beat))
            await asyncio.sleep(1.4)
            assert heart.alive
            await asyncio.sleep(1.0)
            assert heart.silent_for == pytest.approx(2.4)
            assert not heart.alive
            heart.heard(begin + 0.1)
            assert heart.silent_for == pytest.approx(2.3)
            heart.heard(begin)  # older news renews nothing
            assert heart.silent_for == pytest.approx(2.3)
            heart.prompt()
            await asyncio.sleep(0.2)
            task.cancel()
        # The third took 0.8 s: the fourth follows at once, and none is made up for.
        assert times == pytest.approx([0.0, 0.5, 1.0, 1.8, 2.3, 2.4])

    run_virtual(main)


# -- conversations ---------------------------------------------------------------------


class Pair:
    """Two conversations with clocks of different beginnings, and time by hand."""

    def __init__(self, rate: float = 1.0) -> None:
        self.base = VirtualClock()
        self.other = VirtualClock(lambda: self.base.monotonic() + 5000.0, rate=rate)
        chance = random.Random(1)
        self.counts = Statistics(), Statistics()
        self.a = Conversation(self.base, SETTINGS, self.counts[0], chance.randbytes)
        self.b = Conversation(self.other, SETTINGS, self.counts[1], chance.randbytes)

    def meet(self) -> None:
        """As at the beginning of a connection: each beats once, then each answers."""
        for _ in range(2):
            for speaker, listener in ((self.a, self.b), (self.b, self.a)):
                for beat in speaker.beats():
                    listener.feed(beat)
                self.base.advance(0.01)


def test_an_arrival_carries_its_expiry_in_the_receivers_time() -> None:
    pair = Pair()
    pair.meet()
    envelope = pair.a.data(b"aim", pair.base.monotonic() + 1.0)
    pair.base.advance(0.3)
    arrival, _ = pair.b.feed(envelope)
    assert arrival is not None
    data, expires = arrival
    assert data == b"aim"
    # 0.7 s are left; the path's delay and the drift allowed for make it earlier, never later.
    assert 0.65 <= expires - pair.other.monotonic() <= 0.7


@pytest.mark.parametrize("rate", [1.0, 1.0005, 0.9995])
def test_what_was_held_up_beyond_its_expiry_is_refused_whatever_the_clocks_do(rate: float) -> None:
    pair = Pair(rate)
    pair.meet()
    for _ in range(2000):  # a quarter of an hour of beats
        pair.base.advance(0.5)
        for speaker, listener in ((pair.a, pair.b), (pair.b, pair.a)):
            for beat in speaker.beats():
                listener.feed(beat)
    in_time = pair.a.data(b"1", pair.base.monotonic() + 1.0)
    late = pair.a.data(b"2", pair.base.monotonic() + 1.0)
    pair.base.advance(0.9)
    assert pair.b.feed(in_time)[0] is not None
    pair.base.advance(0.11)
    assert pair.b.feed(late)[0] is None
    assert pair.counts[1].late == 1


def test_old_heartbeats_in_a_bunch_renew_nothing() -> None:
    pair = Pair()
    pair.meet()
    held_up = []
    for _ in range(6):
        pair.base.advance(0.5)
        held_up += pair.a.beats()
    last = pair.other.monotonic()
    pair.base.advance(20.0)
    for beat in held_up:
        pair.b.feed(beat)
    assert last - 0.1 <= pair.b.alive_at <= last


def test_a_copy_and_what_was_overtaken_are_not_delivered() -> None:
    pair = Pair()
    pair.meet()
    first, second = pair.a.data(b"1", None), pair.a.data(b"2", None)
    assert pair.b.feed(second)[0] is not None
    assert pair.b.feed(first)[0] is None
    assert pair.b.feed(second)[0] is None
    assert pair.counts[1].repeated == 2


def test_every_single_flipped_bit_is_noticed() -> None:
    pair = Pair()
    pair.meet()
    envelope = pair.a.data(b"aim", None)
    for bit in range(8 * len(envelope)):
        damaged = bytearray(envelope)
        damaged[bit // 8] ^= 1 << bit % 8
        assert pair.b.feed(bytes(damaged))[0] is None
    assert pair.counts[1].refused == 8 * len(envelope)
    assert pair.b.feed(envelope)[0] is not None
    for size in range(OVERHEAD + 3):
        assert pair.b.feed(envelope[:size])[0] is None


@pytest.mark.parametrize("number", [0, 1])
def test_who_has_heard_nobody_is_not_believed_whatever_the_number_of_the_session(
    number: int,
) -> None:
    clock = VirtualClock()
    own = Conversation(clock, SETTINGS, Statistics(), lambda size: number.to_bytes(size, "little"))
    other = Conversation(clock, SETTINGS, Statistics(), random.Random(1).randbytes)
    assert own.feed(other.data(b"aim", None)) == (None, False)


def test_nothing_of_an_earlier_connection_is_taken() -> None:
    pair = Pair()
    pair.meet()
    before = pair.a.data(b"before", None)
    pair.b.restart(lambda: (b"",))
    assert pair.b.feed(before)[0] is None
    pair.meet()
    assert pair.b.feed(before)[0] is None
    assert pair.counts[1].refused == 2
    assert pair.b.feed(pair.a.data(b"after", None))[0] is not None


def test_a_message_does_not_pass_under_another_key_nor_come_back_to_its_sender() -> None:
    pair = Pair()
    pair.a.restart(lambda: (KEY,))
    pair.b.restart(lambda: (OTHER_KEY,))
    pair.meet()
    assert pair.a.alive_at == pair.b.alive_at == -float("inf")
    pair.b.restart(lambda: (KEY,))
    pair.meet()
    envelope = pair.a.data(b"aim", None)
    refused = pair.counts[0].refused
    assert pair.a.feed(envelope)[0] is None
    assert pair.counts[0].refused == refused + 1


def test_a_restarted_end_is_taken_up_at_once_and_a_stale_one_is_not() -> None:
    pair = Pair()
    pair.meet()
    pair.base.advance(0.1)
    stale = pair.a.beats()
    pair.base.advance(0.1)
    pair.a.restart(lambda: (b"",))
    pair.meet()
    assert pair.b.feed(pair.a.data(b"new", None))[0] is not None
    alive = pair.b.alive_at
    for beat in stale:
        assert pair.b.feed(beat) == (None, False)
    assert pair.b.alive_at == alive
    assert pair.b.feed(pair.a.data(b"still", None))[0] is not None


# -- memory links in virtual time ------------------------------------------------------


def test_a_line_that_damages_everything_connects_nobody() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock, seed=2)
        line.faults = Faults(corruption=1.0)
        async with running(plant, cluster):
            await asyncio.sleep(60.0)
            assert not plant.connected
            assert not cluster.connected
            assert plant.statistics.refused > 20

    run_virtual(main)


def test_on_a_line_of_uneven_delay_nothing_is_overtaken() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock, seed=3)
        line.faults = Faults(delay=(0.0, 0.2))
        async with running(plant, cluster):
            await plant.established()
            for number in range(50):
                await plant.send(bytes([number]))
                await asyncio.sleep(0.05)
            async with asyncio.timeout(10.0):
                got = [await cluster.receive() for _ in range(50)]
            assert got == [bytes([number]) for number in range(50)]
            assert cluster.statistics.repeated == 0

    run_virtual(main)


def test_messages_pass_both_ways_in_order() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, _ = memory_pair(clock)
        async with running(plant, cluster):
            await plant.established()
            await cluster.established()
            for number in range(5):
                assert await plant.send(bytes([number])) is SendOutcome.SENT
                assert await cluster.send(bytes([10 + number])) is SendOutcome.SENT
            assert [await cluster.receive() for _ in range(5)] == [bytes([n]) for n in range(5)]
            assert [await plant.receive() for _ in range(5)] == [bytes([n + 10]) for n in range(5)]
            assert (plant.name, cluster.name) == ("cluster", "plant")
            assert plant.problem == ""
        assert plant.closed
        assert plant.problem == "closed"
        assert plant.statistics.sent == cluster.statistics.received == 5
        assert plant.statistics.last_received is not None
        with pytest.raises(LinkClosedError):
            await plant.receive()
        with pytest.raises(LinkClosedError):
            await plant.send(b"")

    for seed in range(10):
        run_virtual(main, seed)


def test_a_partition_is_noticed_by_both_within_the_deadline_and_nothing_is_kept() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock, settings=SETTINGS)
        async with running(plant, cluster):
            await plant.established()
            await asyncio.sleep(10.0)
            line.cut()
            begin = clock.monotonic()
            in_doubt = await plant.send(b"while cut", expires=begin + 1.0)
            assert in_doubt is SendOutcome.SENT  # nobody can know yet
            ends = begin + cluster.lasts
            while plant.connected or cluster.connected:
                await asyncio.sleep(0.01)
            assert 1.0 <= clock.monotonic() - begin <= 1.52
            assert ends == pytest.approx(clock.monotonic(), abs=0.52)
            assert plant.lasts == cluster.lasts == 0.0
            assert await plant.send(b"dropped", expires=begin + 60.0) is SendOutcome.DISCONNECTED
            assert plant.statistics.dropped == 1
            await asyncio.sleep(5.0)
            assert plant.problem == "no heartbeat from the other end for 1.5 s"
            assert plant.silent_for >= 5.0
            line.heal()
            await plant.established()
            await cluster.established()
            assert await plant.send(b"after") is SendOutcome.SENT
            assert await cluster.receive() == b"after"
            assert plant.statistics.reconnects >= 1

    for seed in range(10):
        run_virtual(main, seed)


@pytest.mark.parametrize("deaf", [True, False])
def test_a_line_that_passes_one_way_only_counts_as_cut_at_both_ends(deaf: bool) -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock, settings=SETTINGS)
        async with running(plant, cluster):
            await plant.established()
            await asyncio.sleep(3.0)
            line.cut(first_to_second=deaf, second_to_first=not deaf)
            await asyncio.sleep(2.05)
            assert not plant.connected
            assert not cluster.connected
            problem = plant.problem if deaf else cluster.problem
            assert problem == "the other end has not heard us for 1.5 s"

    run_virtual(main)


def test_what_is_held_waits_for_the_connection_until_it_expires() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock)
        line.reachable = False
        async with running(plant, cluster):
            now = clock.monotonic()
            assert await plant.send(b"1", expires=now + 2.0, hold=True) is SendOutcome.EXPIRED
            assert clock.monotonic() == pytest.approx(now + 2.0)
            assert plant.statistics.expired == 1
            assert plant.problem == "the line is not reachable"
            assert plant.statistics.failures >= 3
            async with asyncio.TaskGroup() as group:
                sending = group.create_task(
                    plant.send(b"2", expires=clock.monotonic() + 30.0, hold=True)
                )
                await asyncio.sleep(5.0)
                line.reachable = True
            assert sending.result() is SendOutcome.SENT
            assert await cluster.receive() == b"2"

    run_virtual(main)


def test_a_message_is_not_delivered_from_a_slow_line_or_a_full_queue_after_its_expiry() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock)
        async with running(plant, cluster):
            await plant.established()
            line.faults = Faults(delay=(0.4, 0.4))
            assert await plant.send(b"slow", expires=clock.monotonic() + 0.3) is SendOutcome.SENT
            await asyncio.sleep(0.5)
            assert cluster.statistics.late == 1
            line.faults = Faults()
            await plant.established()
            await plant.send(b"lies about", expires=clock.monotonic() + 1.0)
            await plant.send(b"stays good")
            await asyncio.sleep(1.0)
            assert await cluster.receive() == b"stays good"
            assert cluster.statistics.late == 2
            assert await plant.send(b"", expires=clock.monotonic()) is SendOutcome.EXPIRED

    run_virtual(main)


def test_a_full_queue_drops_its_oldest() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, _ = memory_pair(clock, settings=LinkSettings(capacity=4))
        async with running(plant, cluster):
            await plant.established()
            for number in range(10):
                await plant.send(bytes([number]))
            await asyncio.sleep(0.1)
            assert [await cluster.receive() for _ in range(4)] == [b"\6", b"\7", b"\10", b"\11"]
            assert cluster.statistics.overflowed == 6
            assert cluster.statistics.received == 4

    run_virtual(main)


def test_a_dropped_connection_is_made_again_and_what_was_under_way_is_lost() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, line = memory_pair(clock, faults=Faults(delay=(0.1, 0.1)))
        async with running(plant, cluster):
            await plant.established()
            await plant.send(b"lost", expires=clock.monotonic() + 9.0)
            line.drop()
            await asyncio.sleep(0.01)
            assert plant.problem == "the line was dropped"
            await plant.established()
            await cluster.established()
            await plant.send(b"new")
            assert await cluster.receive() == b"new"
            assert plant.statistics.reconnects == cluster.statistics.reconnects == 1

    run_virtual(main)


def test_bad_messages_are_refused_with_a_reason() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, _, _ = memory_pair(clock, settings=LinkSettings(largest=8))
        now = clock.monotonic()
        with pytest.raises(InputError, match="a message of 9 bytes; at most 8"):
            await plant.send(bytes(9))
        with pytest.raises(InputError, match="only a message with an expiry can be held"):
            await plant.send(b"", hold=True)
        with pytest.raises(InputError, match="above the horizon of 3600 s"):
            await plant.send(b"", expires=now + 4000.0)
        with pytest.raises(InputError, match="above the horizon"):
            await plant.send(b"", expires=float("nan"))
        assert await plant.send(b"nobody") is SendOutcome.DISCONNECTED

    run_virtual(main)


def test_a_link_runs_once_and_a_failing_block_comes_out_as_it_is() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, _ = memory_pair(clock)

        async def block() -> None:
            async with running(plant, cluster):
                await plant.established()
                with pytest.raises(LinkError, match="it is already running"):
                    await plant.run()
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            await block()
        assert plant.closed

    run_virtual(main)


def test_messages_can_be_looped_over_until_the_link_is_closed() -> None:
    async def main(clock: VirtualClock) -> None:
        plant, cluster, _ = memory_pair(clock)
        got: list[bytes] = []

        async def listen() -> None:
            async for message in received(cluster):
                got.append(message)  # noqa: PERF401 (seen while it goes on)

        async with asyncio.TaskGroup() as group, running(plant, cluster):
            group.create_task(listen())
            await plant.established()
            await plant.send(b"1")
            await plant.send(b"2")
            await asyncio.sleep(0.1)
        assert got == [b"1", b"2"]

    run_virtual(main)


async def _storm(clock: VirtualClock, seed: int) -> dict[str, int]:
    """Send for a minute over a line that does everything wrong; hold every promise."""
    chance = random.Random(seed)
    other = VirtualClock(lambda: 77.0 + clock.monotonic(), rate=chance.uniform(0.9995, 1.0005))
    plant, cluster, line = memory_pair(
        clock,
        seed=seed,
        settings=SETTINGS,
        clocks=(clock, other),
        faults=Faults(0.1, 0.1, 0.1, 0.05, (0.0, 0.3)),
    )
    sent: list[float] = []  # expiry of each message, whose number is its place here
    got: list[int] = []

    async def listen() -> None:
        async for message in received(cluster):
            number = int.from_bytes(message, "little")
            assert clock.monotonic() < sent[number], "delivered after its expiry"
            got.append(number)

    async def trouble() -> None:
        for _ in range(8):
            await asyncio.sleep(chance.uniform(1.0, 8.0))
            chance.choice(
                [line.cut, line.heal, line.drop, lambda: line.cut(first_to_second=False)]
            )()

    async with asyncio.TaskGroup() as group, running(plant, cluster):
        group.create_task(listen())
        group.create_task(trouble())
        end = clock.monotonic() + 60.0
        while clock.monotonic() < end:
            sent.append(clock.monotonic() + chance.uniform(0.05, 1.0))
            await plant.send((len(sent) - 1).to_bytes(4, "little"), expires=sent[-1])
            await asyncio.sleep(chance.uniform(0.0, 0.3))
        line.faults = Faults()
        line.heal()
        await plant.established()
        await cluster.established()
        sent.append(clock.monotonic() + 1.0)
        await plant.send((len(sent) - 1).to_bytes(4, "little"), expires=sent[-1])
        await asyncio.sleep(0.1)
    assert got == sorted(set(got)), "out of order or twice"
    assert got[-1] == len(sent) - 1, "not there after the faults were over"
    counts = cluster.statistics
    return {
        "sent": len(sent),
        "got": len(got),
        "late": counts.late,
        "repeated": counts.repeated,
        "refused": counts.refused,
        "reconnects": counts.reconnects,
    }


def test_every_promise_holds_in_a_storm_of_faults() -> None:
    totals: dict[str, int] = {}
    for seed in range(12):
        counts = run_virtual(lambda clock, seed=seed: _storm(clock, seed), seed)
        totals = {name: totals.get(name, 0) + value for name, value in counts.items()}
    # The storm was one: each promise was at stake, and much came through nevertheless.
    assert totals["got"] > totals["sent"] // 8
    assert min(totals.values()) > 10


def test_the_same_seed_gives_the_same_run() -> None:
    runs = [run_virtual(lambda clock: _storm(clock, 5), 5) for _ in range(2)]
    assert runs[0] == runs[1]


# -- TCP -------------------------------------------------------------------------------


def real(main: Callable[[], Awaitable[None]]) -> None:
    """Run against real sockets, with a limit that only a hanging test reaches."""

    async def limited() -> None:
        async with asyncio.timeout(2.0 * PATIENCE):
            await main()

    asyncio.run(limited())


def server(keys: dict[str, bytes] | None = None, **options: object) -> TcpServer:
    keys = keys or {"north": KEY}
    return TcpServer("127.0.0.1", 0, keys, SystemClock(), QUICK, **options)  # type: ignore[arg-type]


def test_all_clusters_of_a_field_may_call_in_the_same_instant() -> None:
    async def main() -> None:
        plant = server({f"C{i:03}": KEY for i in range(300)})
        async with running(plant):
            await plant.listening()
            with contextlib.ExitStack() as stack:
                # Its loop does not turn meanwhile; a call that the system drops waits for a second.
                for _ in range(300):
                    call = socket.create_connection(("127.0.0.1", plant.port), timeout=0.5)
                    stack.enter_context(call)

    asyncio.run(main())


def client(port: int, name: str = "north", key: bytes = KEY, **options: object) -> Link:
    return tcp_link("127.0.0.1", port, name, key, SystemClock(), QUICK, **options)  # type: ignore[arg-type]


def test_clusters_find_their_links_at_the_server() -> None:
    async def main() -> None:
        plant = server({"north": KEY, "south": OTHER_KEY})
        async with running(plant):
            await plant.listening()
            north, south = client(plant.port), client(plant.port, "south", OTHER_KEY)
            async with running(north, south):
                await connected(north, south, *plant.links.values())
                expires = SystemClock().monotonic() + PATIENCE
                for name in ("north", "south"):
                    sent = await plant.links[name].send(name.encode(), expires=expires)
                    assert sent is SendOutcome.SENT
                assert await south.receive() == b"south"
                assert await north.receive() == b"north"
                large = random.Random(1).randbytes(QUICK.largest)
                for _ in range(20):
                    assert await north.send(large) is SendOutcome.SENT
                    assert await plant.links["north"].receive() == large
        assert plant.refused == 0

    real(main)


@pytest.mark.parametrize(("name", "key"), [("north", OTHER_KEY), ("east", KEY)])
def test_who_cannot_prove_its_name_is_refused(name: str, key: bytes) -> None:
    async def main() -> None:
        plant = server()
        async with running(plant):
            await plant.listening()
            stranger = client(plant.port, name, key)
            async with running(stranger):
                await until(lambda: plant.refused >= 2)
                assert "could not prove" in plant.last_refusal
                assert f"refuses cluster {name}" in stranger.problem
                assert not stranger.connected
                assert not plant.links["north"].connected

    real(main)


def test_a_server_without_the_key_is_refused_by_the_cluster() -> None:
    async def main() -> None:
        async def pretend(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write((32).to_bytes(4, "big") + bytes(32))
            await reader.read(256)
            writer.write((32).to_bytes(4, "big") + bytes(32))
            await reader.read()
            writer.close()

        false = await asyncio.start_server(pretend, "127.0.0.1", 0)
        north = client(false.sockets[0].getsockname()[1])
        async with running(north):
            await until(lambda: north.statistics.failures >= 1)
            assert "could not prove that it knows the key of cluster north" in north.problem
        false.close()
        await asyncio.sleep(0.05)

    real(main)


@pytest.mark.parametrize(
    ("bytes_sent", "text"),
    [
        (
            (1 << 20).to_bytes(4, "big") + b"x",
            "received a frame of 1048576 bytes; a frame has 32 to 128",
        ),
        ((3).to_bytes(4, "big") + b"abc", "received a frame of 3 bytes; a frame has 32 to 128"),
        ((40).to_bytes(4, "big") + bytes(40), "could not prove"),
        ((40).to_bytes(4, "big") + bytes(100), "more than one frame before its proof"),
        (b"", "took too long"),
        ((100).to_bytes(4, "big") + bytes(40), "took too long"),  # half a handshake
        (bytes(200_000), "received a frame of 0 bytes"),  # 50,000 frames of nothing
        (b"\x16\x03\x01\x02" + bytes(200), "a frame of 369295618 bytes"),  # TLS
    ],
)
def test_whoever_speaks_otherwise_is_cut_off(bytes_sent: bytes, text: str) -> None:
    async def main() -> None:
        settings = LinkSettings(open_limit=0.3)
        plant = TcpServer("127.0.0.1", 0, {"north": KEY}, SystemClock(), settings)
        async with running(plant):
            await plant.listening()
            reader, writer = await asyncio.open_connection("127.0.0.1", plant.port)
            writer.write(bytes_sent)
            with pytest.raises((asyncio.IncompleteReadError, ConnectionError)):
                await reader.readexactly(1000)
            writer.close()
            await until(lambda: plant.refused == 1)
            assert text in plant.last_refusal

    real(main)


def test_a_recorded_handshake_passes_no_second_time() -> None:
    """Each connection has random numbers of its own, so its frames fit no other."""

    async def main() -> None:
        plant = server()
        async with running(plant):
            await plant.listening()
            recorded = b""
            for turn in range(2):
                reader, writer = await asyncio.open_connection("127.0.0.1", plant.port)
                number = (await reader.readexactly(4 + 32))[4:]
                if not recorded:
                    own = bytes(32)
                    proof = _proof(KEY, b"client", number, own, b"north")
                    recorded = (
                        len(own + proof + b"north").to_bytes(4, "big") + own + proof + b"north"
                    )
                writer.write(recorded)
                answer = b""
                with contextlib.suppress(asyncio.IncompleteReadError, ConnectionError):
                    answer = await reader.readexactly(4 + 32)
                assert bool(answer) == (turn == 0)
                writer.close()
            await until(lambda: plant.refused == 1)
            assert "could not prove" in plant.last_refusal

    real(main)


def test_too_many_newcomers_are_turned_away_and_a_cluster_still_gets_in() -> None:
    async def main() -> None:
        plant = server()
        async with running(plant):
            await plant.listening()
            idle = []
            for _ in range(140):  # 17 in their handshake, the others cut off
                made = socket.create_connection(("127.0.0.1", plant.port))
                made.setblocking(False)
                idle.append(made)
                await asyncio.sleep(0)
            await asyncio.sleep(0.1)
            for made in idle:
                made.close()
            north = client(plant.port)
            async with running(north):
                await connected(north, plant.links["north"])

    real(main)


@pytest.mark.parametrize("encrypted", [False, True])
def test_silent_strangers_do_not_delay_a_cluster(
    encrypted: bool, certificate: tuple[Path, Path]
) -> None:
    """They hold their connections; the oldest give way, so that a cluster joins at once."""

    async def main() -> None:
        ours = server_tls(*certificate) if encrypted else None
        theirs = client_tls(certificate[0]) if encrypted else None
        patient = LinkSettings(open_limit=2.0 * PATIENCE)
        plant = TcpServer("127.0.0.1", 0, {"north": KEY}, SystemClock(), patient, tls=ours)
        async with running(plant):
            await plant.listening()
            idle = [socket.create_connection(("127.0.0.1", plant.port)) for _ in range(90)]
            await asyncio.sleep(0.1)
            idle += [socket.create_connection(("127.0.0.1", plant.port)) for _ in range(50)]
            await until(lambda: plant.refused >= 140 - _NEWCOMERS_EACH - 1)
            assert "127.0.0.1 has too many connections" in plant.last_refusal
            began = time.monotonic()
            north = client(plant.port, tls=theirs)
            async with running(north):
                await connected(north, plant.links["north"])
                # The cluster must not wait for the end of the strangers' handshakes.
                assert time.monotonic() - began < patient.open_limit
            for made in idle:
                made.close()

    real(main)


def test_strangers_of_many_addresses_push_out_their_busiest() -> None:
    ended: list[str] = []

    class Stub:
        def __init__(self, address: str) -> None:
            self.address = address

        def lose(self, why: str) -> None:
            ended.append(self.address)
            assert self.address in why

    newcomers = _Newcomers(1)
    cluster = Stub("10.0.0.1")
    newcomers.enter(cluster)  # type: ignore[arg-type]
    for number in range(200):
        newcomers.enter(Stub(f"10.0.1.{number % 10}"))  # type: ignore[arg-type]
    assert len(ended) == 201 - 1 - _NEWCOMERS
    assert "10.0.0.1" not in ended


class Gate(threading.Thread):
    """A relay that can stop passing bytes on without closing anything: a half-open line."""

    def __init__(self, port: int) -> None:
        super().__init__()
        self.passing = threading.Event()
        self.passing.set()
        self._to = port
        self._ending = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._peers: dict[socket.socket, socket.socket] = {}
        self.port = self._listener.getsockname()[1]

    def __enter__(self) -> "Gate":
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self.join()

    def run(self) -> None:
        with self._listener:
            while not self._ending.is_set():
                ends = self._peers if self.passing.is_set() else ()
                for ready in select.select([self._listener, *ends], [], [], 0.02)[0]:
                    if ready is self._listener:
                        near, _ = self._listener.accept()
                        far = socket.create_connection(("127.0.0.1", self._to))
                        self._peers.update({near: far, far: near})
                    elif ready in self._peers:
                        self._pass_on(ready)
            for end in self._peers:
                end.close()

    def _pass_on(self, end: socket.socket) -> None:
        other = self._peers[end]
        try:
            if data := end.recv(65536):
                other.sendall(data)
                return
        except OSError:
            pass
        for gone in (end, other):
            del self._peers[gone]
            gone.close()


def test_a_half_open_line_is_noticed_by_the_heartbeat_and_healed_anew() -> None:
    async def main() -> None:
        plant = server()
        async with running(plant):
            await plant.listening()
            with Gate(plant.port) as gate:
                north = client(gate.port)
                async with running(north):
                    far = plant.links["north"]
                    await connected(north, far)
                    gate.passing.clear()
                    await until(lambda: not north.connected and not far.connected)
                    assert far.silent_for >= QUICK.deadline
                    await until(lambda: "0.6 s" in far.problem)
                    assert await far.send(b"now") is SendOutcome.DISCONNECTED
                    gate.passing.set()
                    await connected(north, far)
                    assert await far.send(b"then") is SendOutcome.SENT
                    assert await north.receive() == b"then"

    real(main)


def test_what_a_stalled_line_held_back_is_not_delivered_after_its_expiry() -> None:
    async def main() -> None:
        clock, calm = SystemClock(), LinkSettings(period=0.1, deadline=10.0)
        plant = TcpServer("127.0.0.1", 0, {"north": KEY}, clock, calm)
        async with running(plant):
            await plant.listening()
            with Gate(plant.port) as gate:
                north = tcp_link("127.0.0.1", gate.port, "north", KEY, clock, calm)
                async with running(north):
                    far = plant.links["north"]
                    await connected(north, far)
                    gate.passing.clear()
                    await asyncio.sleep(0.1)  # what select has reported already is still passed on
                    expires = clock.monotonic() + 0.2
                    assert await far.send(b"old", expires=expires) is SendOutcome.SENT
                    await sleep_until(clock, expires)
                    gate.passing.set()
                    await far.send(b"new")
                    assert await north.receive() == b"new"
                    assert north.statistics.late == 1
                    assert north.statistics.reconnects == 0

    real(main)


def test_a_reader_that_stands_still_fills_no_memory() -> None:
    async def main() -> None:
        clock, calm = SystemClock(), LinkSettings(period=0.1, deadline=10.0)
        plant = TcpServer("127.0.0.1", 0, {"north": KEY}, clock, calm)
        async with running(plant):
            await plant.listening()
            with Gate(plant.port) as gate:
                north = tcp_link("127.0.0.1", gate.port, "north", KEY, clock, calm)
                async with running(north):
                    far = plant.links["north"]
                    await connected(north, far)
                    gate.passing.clear()
                    outcomes = []
                    while SendOutcome.EXPIRED not in outcomes and len(outcomes) < 500:
                        sent = await far.send(bytes(60000), expires=clock.monotonic() + 0.2)
                        outcomes.append(sent)
                    assert outcomes[-1] is SendOutcome.EXPIRED
                    pipe = plant._slots["north"]._last
                    assert pipe is not None
                    assert pipe._transport is not None
                    assert pipe._transport.get_write_buffer_size() <= 60000 + OVERHEAD + 4
                    assert far.statistics.expired == 1

    real(main)


def test_a_new_connection_of_a_cluster_takes_the_place_of_the_old_at_once() -> None:
    async def main() -> None:
        clock, calm = SystemClock(), LinkSettings(period=0.1, deadline=20.0)
        plant = TcpServer("127.0.0.1", 0, {"north": KEY}, clock, calm)
        async with running(plant):
            await plant.listening()
            with Gate(plant.port) as gate:
                old = tcp_link("127.0.0.1", gate.port, "north", KEY, clock, calm)
                new = tcp_link("127.0.0.1", plant.port, "north", KEY, clock, calm)
                async with running(old):
                    far = plant.links["north"]
                    await connected(old, far)
                    gate.passing.clear()
                    async with running(new):
                        await connected(new)
                        assert far.statistics.reconnects == 1
                        assert await far.send(b"here") is SendOutcome.SENT
                        assert await new.receive() == b"here"

    real(main)


def test_a_restarted_plant_is_found_again() -> None:
    async def main() -> None:
        first = server()
        async with running(first):
            await first.listening()
            north = client(first.port)
            async with running(north):
                await connected(north, first.links["north"])
                await first.close()
                await until(lambda: not north.connected)
                assert await north.send(b"nobody there") is SendOutcome.DISCONNECTED
                second = TcpServer("127.0.0.1", first.port, {"north": KEY}, SystemClock(), QUICK)
                async with running(second):
                    await connected(north, second.links["north"])
                    assert await north.send(b"again") is SendOutcome.SENT
                    assert await second.links["north"].receive() == b"again"

    real(main)


def test_a_place_that_is_taken_is_named() -> None:
    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            plant = TcpServer("127.0.0.1", taken.getsockname()[1], {}, SystemClock())
            with pytest.raises(LinkError, match="check whether another plant is running there"):
                await plant.run()

    real(main)


@pytest.mark.parametrize(
    ("name", "key", "text"),
    [("north", b"short", "a key of 5 bytes"), ("", KEY, "1 to 64 bytes"), ("n" * 65, KEY, "1 to")],
)
def test_keys_and_names_that_cannot_be_used_are_refused(name: str, key: bytes, text: str) -> None:
    with pytest.raises(InputError, match=text):
        TcpServer("127.0.0.1", 0, {name: key}, SystemClock())
    with pytest.raises(InputError, match=text):
        tcp_link("127.0.0.1", 1, name, key, SystemClock())


def test_small_messages_go_out_at_once() -> None:
    async def main() -> None:
        plant = server()
        async with running(plant):
            await plant.listening()
            north = client(plant.port)
            async with running(north):
                await connected(north, plant.links["north"])
                pipe = plant._slots["north"]._last
                assert pipe is not None
                assert pipe._transport is not None
                link = pipe._transport.get_extra_info("socket")
                assert link.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)

    real(main)


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate for 127.0.0.1 that signs itself, and its key."""
    if shutil.which("openssl") is None:
        absent("openssl is not installed: no certificate to test TLS with")
    folder = tmp_path_factory.mktemp("tls")
    pem, key = folder / "plant.pem", folder / "plant.key"
    subprocess.run(
        [
            "openssl",
            "req",
            "-x509",
            "-newkey",
            "ec",
            "-pkeyopt",
            "ec_paramgen_curve:prime256v1",
            "-nodes",
            "-days",
            "2",
            "-subj",
            "/CN=plant",
            "-addext",
            "subjectAltName=IP:127.0.0.1",
            "-keyout",
            key,
            "-out",
            pem,
        ],
        check=True,
        capture_output=True,
    )
    return pem, key


def test_tls_by_files(certificate: tuple[Path, Path]) -> None:
    pem, key = certificate

    async def main() -> None:
        plant = server(tls=server_tls(pem, key))
        async with running(plant):
            await plant.listening()
            north, clear = client(plant.port, tls=client_tls(pem)), client(plant.port)
            async with running(north, clear):
                far = plant.links["north"]
                await connected(north, far)
                assert await north.send(b"hidden") is SendOutcome.SENT
                assert await far.receive() == b"hidden"
                assert not clear.connected

    real(main)


def test_tls_with_wrong_files_is_refused(certificate: tuple[Path, Path], tmp_path: Path) -> None:
    pem, key = certificate
    nothing = tmp_path / "nothing.pem"
    with pytest.raises(InputError, match=r"nothing\.pem.*belong together"):
        server_tls(pem, nothing)
    with pytest.raises(InputError, match=r"nothing\.pem"):
        client_tls(nothing)
    with pytest.raises(InputError, match="specify both"):
        client_tls(pem, certificate=pem)
    assert server_tls(pem, key, pem).verify_mode.name == "CERT_REQUIRED"


@pytest.mark.parametrize("size", [15, 16, 17, 31, 32, 64, 65])
@pytest.mark.parametrize("odd", [False, True])
def test_a_key_in_a_file_is_whole_bytes(size: int, odd: bool, tmp_path: Path) -> None:
    path = tmp_path / "keys.toml"
    text = bytes(range(size)).hex() + "a" * odd
    path.write_text(f'plant = "{text}"\n', encoding="utf-8")
    path.chmod(0o600)
    if 16 <= size <= 64 and not odd:
        assert Keys(path, "clusters").plant == (bytes(range(size)),)
    else:
        with pytest.raises(FormatError, match=f"a key of {len(text)} characters; use 16 to 64"):
            Keys(path, "clusters")
