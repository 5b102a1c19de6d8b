"""A cluster that signs the frames of its bus: it gives keys, rotates them, and loses no lease."""

import asyncio
from collections.abc import Iterator

import pytest

from heliotrope.lcu import messages, names, signing, wire
from heliotrope.lcu.sender import Sender
from heliotrope.links.keys import KeyRing
from heliotrope.safety import Alarm, Severity
from heliotrope.twin.boards.bus import BusFaults
from support.clusters import TOKEN, Board, Field, key_of, run
from support.lcu_machines import sha256, signer

OLD, NEW = b"the old bus key.", b"the new bus key."
KEYED = 1 << names.FLAGS.index("BUS_KEY")


def printed(key: bytes) -> int:
    return signing.fingerprint(sha256, signing.pads_of(key))


def held(board: Board) -> tuple[int, int]:
    """Fingerprints of a board's keys."""
    bus = board.node._bus
    return (0, 0) if bus is None else bus.told()[2:]


def both(field: Field, *keys: bytes) -> bool:
    wanted = (*(printed(key) for key in keys), 0, 0)[:2]
    return all(held(board) == wanted for board in field.boards)


def stranger(field: Field, name: str, *values: float) -> None:
    """Somebody at the wire who knows everything but the key: epoch, count and token."""
    own = field.cluster._exchange
    sender = Sender(wire.CLUSTER_ADDRESS, own.sender.epoch, sha256)
    sender.count = own.sender.count + 5
    field.bus.inject(sender.frame(wire.BROADCAST, name, *values))


def fresh(field: Field) -> Iterator[bool]:
    for board in field.boards:
        yield board.node.controller.sun.fresh()


async def watched(field: Field, seconds: float, state: str) -> None:
    """Let time pass; no lease may end and no state change."""
    for _ in range(round(20 * seconds)):
        await asyncio.sleep(0.05)
        assert all(fresh(field))
        assert set(field.states()) == {state}


def test_boards_are_given_the_key_and_work_with_it() -> None:
    async def main(field: Field) -> None:
        await field.until(lambda: both(field, OLD), 10.0)
        await asyncio.sleep(3.0)
        await field.order("track", "TRACK")
        await field.until(lambda: set(field.states()) == {"TRACKING"}, 10.0)
        await watched(field, 10.0, "TRACKING")
        assert not field.plant.all(Alarm)
        expires = int(field.cluster._broadcast.bus_time() or 0) + 9
        token = field.cluster._exchange.token(TOKEN)
        for name in ("LOCK", "IDLE"):
            stranger(field, name, token, expires)
        stranger(field, "SESSION", 2**31, 0, 1)
        await watched(field, 3.0, "TRACKING")
        stranger(field, "DEFOCUS")
        assert set(field.states()) == {"DEFOCUSED"}

    run(main, "IDLE", bus_keys=KeyRing(OLD))


def test_the_same_stranger_stops_a_bus_without_a_key() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(3.0)
        expires = int(field.cluster._broadcast.bus_time() or 0) + 9
        stranger(field, "LOCK", field.cluster._exchange.token(TOKEN), expires)
        assert set(field.states()) == {"LOCKED"}

    run(main, "TRACKING")


def test_moving_mirrors_go_on_and_take_the_key_when_they_stand() -> None:
    async def main(field: Field) -> None:
        await asyncio.sleep(2.0)
        await watched(field, 25.0, "TRACKING")
        assert both(field)
        (alarm,) = field.plant.alarms("bus_unsigned")
        assert alarm.severity == Severity.WARNING
        assert alarm.text.startswith("cluster C1 signs its frames, but A1, A2 do not have")
        assert "once they are at rest" in alarm.text
        await field.order("idle", "IDLE")
        await field.until(lambda: both(field, OLD), 10.0)
        await watched(field, 10.0, "IDLE")
        assert not field.plant.alarms("bus_unsigned")[-1].active
        await field.order("again", "TRACK")
        await field.until(lambda: set(field.states()) == {"TRACKING"}, 10.0)
        await watched(field, 10.0, "TRACKING")

    run(main, "TRACKING", bus_keys=KeyRing(OLD))


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_a_key_is_rotated_without_a_missed_lease(loss: float) -> None:
    ring = KeyRing(OLD)

    async def main(field: Field) -> None:
        await field.until(lambda: both(field, OLD), 20.0)
        await asyncio.sleep(3.0)
        await field.order("again", "TRACK")
        await field.until(lambda: set(field.states()) == {"TRACKING"}, 10.0)
        field.bus.faults = BusFaults(loss=loss)
        ring.keys = (NEW, OLD)
        await watched(field, 20.0, "TRACKING")
        assert both(field, OLD)  # they move: the old key goes on
        await field.order("idle", "IDLE", lifetime=10.0)
        await field.until(lambda: both(field, NEW, OLD), 30.0)
        await watched(field, 10.0, "IDLE")
        ring.keys = (NEW,)
        await field.until(lambda: both(field, NEW), 30.0)
        await watched(field, 10.0, "IDLE")
        field.bus.faults = BusFaults()
        await asyncio.sleep(1.0)
        assert not field.plant.alarms("bus_unsigned")

    run(main, "IDLE", seed=3, bus_keys=ring)


def test_frames_are_signed_with_a_new_key_once_all_that_answer_have_it() -> None:
    ring = KeyRing(OLD)

    def signs(field: Field, key: bytes) -> bool:
        sign = field.cluster._exchange.sender.sign
        return sign is not None and sign(b"frame") == signer(key)(b"frame")

    async def main(field: Field) -> None:
        await field.until(lambda: both(field, OLD), 10.0)
        ring.keys = (NEW, OLD)
        while not both(field, NEW, OLD):
            assert signs(field, OLD)
            await asyncio.sleep(0.05)
        await field.until(lambda: signs(field, NEW), 5.0)
        await field.until(field.sun_is_fresh, 5.0)

    run(main, bus_keys=ring)


def test_boards_that_have_their_keys_are_given_no_more() -> None:
    """Each key that is set is a record in flash, and a key set twice ends the old one."""
    ring, sent = KeyRing(OLD), bytearray()

    async def main(field: Field) -> None:
        carry = field.bus.carry
        field.bus.carry = lambda frame: (sent.extend(frame), carry(frame))[1]
        await field.until(lambda: both(field, OLD), 10.0)
        await asyncio.sleep(5.0)
        ring.keys = (NEW, OLD)
        await field.until(lambda: both(field, NEW, OLD), 10.0)
        await asyncio.sleep(5.0)
        assert both(field, NEW, OLD)

    run(main, bus_keys=ring)
    numbers = [frame.number for frame in wire.Reader().feed(bytes(sent))]
    assert numbers.count(messages.NUMBER_OF["SET_BUS_KEY"]) == 4


def test_a_board_that_was_off_during_a_rotation_is_given_the_new_key() -> None:
    ring = KeyRing(OLD)

    async def main(field: Field) -> None:
        await field.until(lambda: both(field, OLD), 10.0)
        first, second = field.boards
        second.on = False
        ring.keys = (NEW, OLD)
        await field.until(lambda: held(first) == (printed(NEW), printed(OLD)), 10.0)
        ring.keys = (NEW,)
        await field.until(lambda: held(first) == (printed(NEW), 0), 10.0)
        second.boot(field.clock.monotonic())
        await field.until(lambda: held(second) == (printed(NEW), 0), 20.0)
        await field.until(field.sun_is_fresh, 5.0)

    run(main, bus_keys=ring)


def test_a_board_that_restarts_and_a_cluster_that_restarts_meet_again() -> None:
    boards: list[Board] = []

    async def first(field: Field) -> None:
        await field.until(lambda: both(field, OLD), 10.0)
        await field.until(field.sun_is_fresh, 5.0)
        field.boards[0].boot(field.clock.monotonic())
        assert not field.sun_is_fresh()
        took = await field.until(field.sun_is_fresh, 5.0)
        assert took < 3.5
        boards.extend(field.boards)

    async def second(field: Field) -> None:
        await field.until(field.sun_is_fresh, 5.0)

    run(first, bus_keys=KeyRing(OLD))
    run(second, boards=boards, bus_keys=KeyRing(OLD))


def test_a_cluster_without_the_key_says_so_and_the_field_is_safe() -> None:
    boards: list[Board] = []

    async def first(field: Field) -> None:
        await field.until(lambda: both(field, OLD), 10.0)
        boards.extend(field.boards)

    async def second(field: Field) -> None:
        await field.until(lambda: bool(field.plant.alarms("bus_key_missing")), 30.0)
        (alarm,) = field.plant.alarms("bus_key_missing")
        assert alarm.severity == Severity.ALARM
        text = "cluster C1 has no bus key, but A1, A2 obey only signed frames"
        assert alarm.text.startswith(text)
        assert not any(fresh(field))
        await field.emergency("now", "DEFOCUS")
        await asyncio.sleep(2.0)
        assert "REFUSED" not in {stage.name for stage in field.plant.stages("now", "A1")}

    async def third(field: Field) -> None:
        await field.until(lambda: both(field), 20.0)
        await field.until(field.sun_is_fresh, 5.0)

    run(first, bus_keys=KeyRing(OLD))
    run(second, boards=boards)
    run(third, boards=boards, bus_keys=KeyRing())  # signed frames are given up


@pytest.mark.parametrize(("own_key", "why"), [(b"", "older firmware"), (b"x" * 32, "differ from")])
def test_a_board_that_cannot_be_given_the_key_is_named(own_key: bytes, why: str) -> None:
    async def main(field: Field) -> None:
        board = field.boards[1]
        board.node._key = board.node.gate._key = own_key
        await field.until(lambda: bool(field.plant.alarms("bus_unsigned")), 30.0)
        (alarm,) = field.plant.alarms("bus_unsigned")
        assert "but A2 do not have" in alarm.text
        assert why in alarm.text
        assert held(field.boards[0]) == (printed(OLD), 0)
        assert all(fresh(field))  # it obeys, as before

    run(main, bus_keys=KeyRing(OLD))


def test_a_key_never_stands_on_the_wire() -> None:
    sent = bytearray()

    async def main(field: Field) -> None:
        carry = field.bus.carry
        field.bus.carry = lambda frame: (sent.extend(frame), carry(frame))[1]
        await field.until(lambda: both(field, OLD), 10.0)

    run(main, bus_keys=KeyRing(OLD))
    numbers = [frame.number for frame in wire.Reader().feed(bytes(sent))]
    assert numbers.count(messages.NUMBER_OF["SET_BUS_KEY"]) == 2
    assert OLD not in sent
    assert key_of(1) not in sent
