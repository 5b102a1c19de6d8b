"""A real cluster whose heliostats are rows of a vectorised field."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable

import numpy as np
import pytest

from heliotrope.cluster.config import ClusterConfig, Member
from heliotrope.cluster.controller import Cluster
from heliotrope.errors import InputError
from heliotrope.lcu import journal, messages, names, states, wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.clock import VirtualClock, run_virtual
from heliotrope.links.in_process import memory_pair
from heliotrope.links.keys import KeyRing
from heliotrope.links.link import LinkClosedError, SendOutcome, running
from heliotrope.links.messages import Command, Emergency, Lease, Stage, decode, encode
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import rotary
from heliotrope.twin.boards.clocks import SimulatedTime
from heliotrope.twin.boards.outfit import MACHINE, RECEIVER, STEPS_PER_TURN, STOW
from heliotrope.twin.field.field import Field
from heliotrope.twin.field.field_bus import FieldBus, _stuffed, _unstuffed
from support.lcu_machines import sha256
from support.midsummer import SITE

TOKEN = 77


def a_field() -> Field:
    gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
    place = np.array([(-20.0, 80.0, 0.0), (5.0, 90.0, 0.0), (30.0, 100.0, 0.0), (9.0, 70.0, 0.0)])
    machine = kinds.azimuth_elevation(
        place, pivot_height=2.0, pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear))
    )
    return Field(machine, MACHINE)


def test_a_cluster_leads_rows_of_a_field() -> None:
    field = a_field()
    told: list[tuple[str, range]] = []

    async def main(clock: VirtualClock) -> list[object]:
        plant, mine, _ = memory_pair(clock)
        # The first row is another cluster's.
        bus = FieldBus(field, range(1, 4), lambda name, rows: told.append((name, rows)))
        members = tuple(Member(f"H{n}", n) for n in (1, 2, 3))
        cluster = Cluster(ClusterConfig("C", SITE, members), bus, mine, clock, SimulatedTime(clock))
        heard: list[object] = []

        async def listen() -> None:
            while True:
                heard.append(decode(await plant.receive()))

        async def live(seconds: int) -> None:
            for tick in range(20 * seconds):
                if tick % 20 == 0:
                    await plant.send(encode(Lease(TOKEN)), expires=clock.monotonic() + 1.0)
                await asyncio.sleep(0.05)
                field.advance(50)

        async with (
            asyncio.TaskGroup() as group,
            running(plant, mine, bus),
            running(cluster),
        ):
            listener = group.create_task(listen())
            await live(4)
            for identity, name, values in (("a", "AIM", RECEIVER), ("b", "APPROACH", ())):
                command = Command(identity, name, values, token=TOKEN)
                await plant.send(encode(command), expires=clock.monotonic() + 5.0)
            await live(60)
            assert field.state.tolist() == [states.STOWED] + 3 * [states.IDLE]
            track = Command("c", "TRACK", token=TOKEN)
            await plant.send(encode(track), expires=clock.monotonic() + 5.0)
            await live(15)
            assert field.state.tolist() == [states.STOWED] + 3 * [states.TRACKING]
            await plant.send(encode(Emergency("d", "DEFOCUS")), expires=clock.monotonic() + 5)
            await live(3)
            assert field.state.tolist() == [states.STOWED] + 3 * [states.DEFOCUSED]
            listener.cancel()
        return heard

    heard = run_virtual(main)
    done = [m for m in heard if getattr(m, "stage", None) is Stage.DONE]
    assert {m.identity for m in done} >= {"a", "b", "c", "d"}  # type: ignore[attr-defined]
    assert ("DEFOCUS", range(1, 4)) in told
    assert ("AIM", range(2, 3)) in told


OWN = [bytes([k]) * 32 for k in range(4)]
BUS_KEY, REFUSED_KEY = b"the bus's key...", messages.REFUSED_KEY


@contextlib.asynccontextmanager
async def signed(
    field: Field, clock: VirtualClock, ring: KeyRing | None
) -> AsyncIterator[tuple[FieldBus, Cluster, Callable[[float], Awaitable[None]]]]:
    """Run a cluster that signs the bus of a field whose local controllers have gates."""
    plant, mine, _ = memory_pair(clock)
    bus = FieldBus(field, range(4), keys=OWN)
    members = tuple(Member(f"H{n}", n + 1, n + 1, OWN[n]) for n in range(4))
    config = ClusterConfig("C", SITE, members)
    cluster = Cluster(config, bus, mine, clock, SimulatedTime(clock), bus_keys=ring)

    async def live(seconds: float) -> None:
        for tick in range(round(20 * seconds)):
            if tick % 20 == 0:
                await plant.send(encode(Lease(TOKEN)), expires=clock.monotonic() + 1.0)
            await asyncio.sleep(0.05)
            field.advance(50)

    async with running(plant, mine, bus), running(cluster):
        yield bus, cluster, live


def flags(bus: FieldBus) -> list[set[str]]:
    """Flags that the local controllers tell."""
    told = [int.from_bytes(each[1:5], "little") for each in bus._statuses()]
    return [{name for k, name in enumerate(names.FLAGS) if word >> k & 1} for word in told]


async def result(bus: FieldBus, frame: bytes) -> int:
    """Send a frame to one local controller; return the result in its answer."""
    (answer,) = wire.Reader().feed(await bus.transact(frame, 0.1))
    values = answer.values()
    assert answer.name == "ACK"
    assert values is not None
    return int(values[2])


def test_a_field_takes_the_key_of_its_bus_and_obeys_its_cluster_only() -> None:
    field = a_field()

    async def main(clock: VirtualClock) -> None:
        async with signed(field, clock, KeyRing(BUS_KEY)) as (bus, cluster, live):
            await live(12)
            assert all({"BUS_KEY", "SUN_FRESH"} <= each for each in flags(bus))
            assert all("SESSION_WANTED" not in each for each in flags(bus))
            stored = {field.journals.items(row)["bus_keys"] for row in range(4)}
            assert stored == {BUS_KEY + bytes(16)}  # what came over the wire was encrypted
            # A stranger who knows epoch, count, token and time, but no key.
            own = cluster._exchange.sender
            stranger = Sender(wire.CLUSTER_ADDRESS, own.epoch, sha256)
            stranger.count = own.count + 5
            expires = int(cluster._broadcast.bus_time() or 0) + 9
            token = cluster._exchange.token(TOKEN)
            for name in ("LOCK", "IDLE", "APPROACH"):
                assert await result(bus, stranger.frame(1, name, token, expires)) == REFUSED_KEY
            lease = field.leases(np.arange(4)).tolist()
            await bus.transmit(stranger.frame(wire.BROADCAST, "SUN", 1, 0, 0, 1 << 30, 0, 0, 0))
            assert field.leases(np.arange(4)).tolist() == lease
            assert set(field.state.tolist()) == {states.STOWED}
            number = 1 + [row[0] for row in journal.ITEMS].index("bus_keys")
            data = await bus.transact(stranger.frame(1, "QUERY_STORED", number), 0.1)
            assert wire.Reader().feed(data)[0].payload == bytes([number])
            # One whose supply was cut forgets the session, and is given one over its own number.
            field.cut(np.array([2]))
            await live(3)
            field.restore(np.array([2]))
            await bus.transact(stranger.frame(3, "QUERY_STATUS"), 0.1)  # it starts with that
            assert {"BUS_KEY", "SESSION_WANTED"} <= flags(bus)[2]
            await live(8)
            assert {"BUS_KEY", "SUN_FRESH"} <= flags(bus)[2]
            assert set(field.state.tolist()) == {states.STOWED}
            await bus.transmit(stranger.frame(wire.BROADCAST, "DEFOCUS"))
            assert await result(bus, stranger.frame(1, "STOW")) == messages.DONE

    run_virtual(main)


def test_the_same_stranger_locks_a_field_whose_bus_is_not_signed() -> None:
    field = a_field()

    async def main(clock: VirtualClock) -> None:
        async with signed(field, clock, None) as (bus, cluster, live):
            await live(5)
            own = cluster._exchange.sender
            stranger = Sender(wire.CLUSTER_ADDRESS, own.epoch, sha256)
            stranger.count = own.count + 5
            expires = int(cluster._broadcast.bus_time() or 0) + 9
            token = cluster._exchange.token(TOKEN)
            for word, until, wanted in (
                (token, expires - 30, messages.EXPIRED),
                (token + 1, expires, messages.REFUSED_AUTHORITY),
                (token, expires, messages.DONE),
            ):
                assert await result(bus, stranger.frame(1, "LOCK", word, until)) == wanted
            old = Sender(wire.CLUSTER_ADDRESS, own.epoch, sha256)
            repeated = old.frame(1, "UNLOCK", token, expires)
            assert await result(bus, repeated) == messages.DUPLICATE
            assert field.state.tolist() == [states.LOCKED] + 3 * [states.STOWED]

    run_virtual(main)


def test_a_field_without_gates_takes_signed_frames_as_its_boards_would() -> None:
    field = a_field()
    bus = FieldBus(field, range(4))
    sender = Sender(0, 1)
    sender.sign = lambda data: bytes(8)

    async def main(clock: VirtualClock) -> None:
        del clock
        await bus.transmit(sender.frame(wire.BROADCAST, "SUN", 1, 0, 0, 1 << 30, 0, 0, 0))
        assert (field.leases(np.arange(4)) > 0).all()

    run_virtual(main)


def test_answers_are_frames_of_the_wire() -> None:
    field = a_field()
    bus = FieldBus(field, range(4))
    sender = Sender(0, 1)

    async def main(clock: VirtualClock) -> list[bytes]:
        del clock
        asked = [sender.frame(3, name) for name in ("QUERY_STATUS", "QUERY_STEPS", "DEFOCUS")]
        asked += [sender.frame(9, "QUERY_STATUS"), b"\x01\0", sender.frame(3, "SEARCH", 7, 8, 1, 1)]
        answers = [await bus.transact(frame, 0.1) for frame in asked]
        bus.plugged = False
        assert await bus.transact(asked[0], 0.1) == b""
        assert await bus.transmit(asked[0]) is SendOutcome.DISCONNECTED
        await bus.close()
        with pytest.raises(LinkClosedError, match="field bus: closed"):
            await bus.transmit(asked[0])
        with pytest.raises(LinkClosedError, match="field bus: closed"):
            await bus.transact(asked[0], 0.1)
        return answers

    status, steps, ack, nobody, broken, refused = run_virtual(main)
    (frame,) = wire.Reader().feed(status)
    values = frame.values()
    assert (frame.name, frame.sender, frame.sequence) == ("STATUS", 3, 1)
    assert values is not None
    assert values[0] == states.STOWED
    (frame,) = wire.Reader().feed(steps)
    assert frame.values() == (*STOW, *STOW)
    (frame,) = wire.Reader().feed(ack)
    assert frame.values() == (3, 0x20, 0)
    assert nobody == broken == b""
    (frame,) = wire.Reader().feed(refused)
    assert frame.values() == (5, 0x45, 1)


def test_frames_are_stuffed_as_the_wire_does() -> None:
    rng = np.random.default_rng(6)
    for _ in range(500):
        # Many zeros, as frames have them, and none.
        data = (rng.integers(0, 256, rng.integers(1, 240)) * rng.integers(0, 2)).astype(np.uint8)
        data = np.where(rng.random(len(data)) < rng.choice([0.0, 0.5]), 0, data)
        raw = data.astype(np.uint8).tobytes()
        assert _stuffed(raw) == wire.stuff(raw)
        assert _unstuffed(_stuffed(raw) + b"\0") == raw
    for bad in (b"", b"\0", b"\x01\x02", b"\x05\x01\0", b"\x03\0\x01\0", b"\xff\x01\0"):
        assert _unstuffed(bad) == b""


def test_status_tells_faults_at_once_and_without_supply_nothing() -> None:
    field = a_field()
    bus = FieldBus(field, range(4))
    sender = Sender(0, 1)
    every = np.arange(4)

    async def main(clock: VirtualClock) -> None:
        del clock

        async def ask(address: int) -> tuple[object, ...]:
            answer = await bus.transact(sender.frame(address, "QUERY_STATUS"), 0.1)
            frames = wire.Reader().feed(answer)
            assert len(frames) == (answer != b"")
            return (frames[0].values() or ()) if frames else ()

        first = await ask(2)
        assert (first[0], first[2], first[4]) == (states.STOWED, 0, 0xFFFFFFFF)
        # Nothing is kept too long: sun, orders, faults, cuts and time are seen at once.
        field.take_sun((1, 0, 0, 1 << 30, 0, 0, 0))
        assert (await ask(2))[4] == 0
        field.advance(50)
        assert (await ask(2))[4] == 50
        field.order("LOCK", every[1:2])
        assert (await ask(2))[0] == states.LOCKED
        field.fail(every[1:2], 3)
        assert (await ask(2))[2] == 3
        field.cut(every[1:2])
        assert await ask(2) == ()
        assert await bus.transact(sender.frame(2, "DEFOCUS"), 0.1) == b""
        field.restore(every[1:2])
        assert (await ask(2))[0] == states.LOCKED
        assert (await ask(3))[0] == states.STOWED

    run_virtual(main)


def test_rows_that_are_not_there() -> None:
    with pytest.raises(InputError, match=r"field bus: rows range\(2, 9\) are not within 0 to 3"):
        FieldBus(a_field(), range(2, 9))
