"""The node: order of flash and steps, answers, failures of flash, the supply's fall."""

import random

import pytest

from heliotrope.lcu import controller, messages, node, wire
from heliotrope.lcu.journal import ITEMS, Journal
from heliotrope.lcu.messages import DONE, NOT_STORED
from heliotrope.lcu.sender import Sender
from support.lcu_machines import (
    ADDRESS,
    AIM,
    KEY,
    STOW,
    TOKEN,
    Bench,
    Flash,
    items_of_heliostat,
    sha256,
    standing_by,
    tracking,
)


class Frail(Flash):
    """Flash that wears out: from then on it takes no bits."""

    worn = False

    def write(self, offset: int, data: bytes) -> None:
        if not self.worn:
            super().write(offset, data)


def frail(bench: Bench) -> Frail:
    """Put flash that can wear out under a bench."""
    flash = Frail()
    flash.data[:] = bench.flash.data
    bench.flash = bench.journal._storage = flash
    return flash


def test_the_smallest_use() -> None:
    # As in the head of the module: nothing but what a board has.
    sent: list[bytes] = []
    bench = Bench()
    own = node.Node(Flash(), bench.motors, sent.append, 0, serial=1, sha256=sha256, key=KEY)
    assert own.controller.state == 0
    own.on_bytes(Sender(0, 1).frame(0xFFFF, "DISCOVER", 0, 9), 0)
    for now in range(0, 1000, 10):
        own.on_tick(now)
    (frame,) = wire.Reader().feed(b"".join(sent))
    assert (frame.name, frame.values()) == ("HERE", (1, 0, 0))


def test_answers_carry_the_sequence_of_the_question_and_the_old_address() -> None:
    bench = standing_by()
    sent: list[bytes] = []
    bench.node._write = sent.append
    bench.send("QUERY_STEPS")
    asked = bench.sender.count & 0xFFFF
    bench.edition += 1
    head = TOKEN, bench.gps_ms() // 1000 + 5, bench.edition
    bench.send("SET_ADDRESS", *head, 4711, 99)
    bench.send("QUERY_STEPS", to=99)
    frames = wire.Reader().feed(b"".join(sent))
    assert [frame.name for frame in frames] == ["STEPS", "ACK", "STEPS"]
    assert [frame.sender for frame in frames] == [ADDRESS, ADDRESS, 99]
    assert [frame.sequence - asked for frame in frames] == [0, 1, 2]
    assert frames[1].values() == (asked + 1, messages.NUMBER_OF["SET_ADDRESS"], DONE)


def test_nobody_answers_a_question_to_everybody_but_discover() -> None:
    bench = standing_by()
    bench.answers.clear()
    for name in ("QUERY_STEPS", "QUERY_STATUS", "QUERY_POSITION", "QUERY_DIAGNOSIS"):
        bench.send(name, to=0xFFFF)
    bench.send("QUERY_STORED", 1, to=0xFFFF)
    bench.run(1)
    assert bench.answers == []


@pytest.mark.parametrize("item", [*range(len(ITEMS) + 2), 255])
def test_stored_items_are_told_but_for_the_key_and_what_is_none(item: int) -> None:
    bench = standing_by()
    bench.answers.clear()
    bench.send("QUERY_STORED", item)
    name = ITEMS[item - 1][0] if 1 <= item <= len(ITEMS) else ""
    if name in ("", "key_id", "bus_keys"):
        assert bench.answers == []
    else:
        data = items_of_heliostat(bench.machine).get(name, b"")
        assert bench.answers == [(0x0A, (item, data))]


def test_slots_of_questions_in_the_same_instant_differ() -> None:
    own = Bench().node
    assert len({own._draw(5000) for _ in range(100)}) > node.HERE_SLOTS // 2


def test_slots_are_drawn_evenly_and_by_each_for_itself() -> None:
    nodes = [
        node.Node(Flash(), Bench().motors, lambda data: None, 0, serial=serial)
        for serial in range(40)
    ]
    drawn = [[own._draw(now) for now in range(0, 50_000, 1000)] for own in nodes]
    counts = [sum(row.count(slot) for row in drawn) for slot in range(node.HERE_SLOTS)]
    mean = 40 * 50 / node.HERE_SLOTS
    # Chi-squared with 31 degrees of freedom: 70 is passed once in 10,000 times.
    assert sum((count - mean) ** 2 / mean for count in counts) < 70
    same = sum(a == b for a, b in zip(drawn[0], drawn[1], strict=True))
    assert same < 10


def test_all_of_a_bus_are_found_in_some_rounds() -> None:
    # Frames in one slot destroy each other; who was heard is left out of the next ranges.
    serials = random.Random(5).sample(range(1 << 32), 32)
    found: set[int] = set()
    out: dict[int, list[int]] = {}

    def board(serial: int) -> node.Node:
        def write(data: bytes) -> None:
            assert data
            out[clock[0]].append(serial)

        return node.Node(Flash(), Bench().motors, write, 0, serial)

    boards = {serial: board(serial) for serial in serials}
    clock = [0]
    for _ in range(40):
        ask = Sender(0, 1).frame(0xFFFF, "DISCOVER", 0, 0xFFFFFFFF)
        for serial, own in boards.items():
            if serial not in found:
                own.on_bytes(ask, clock[0])
        for _ in range(node.HERE_SLOTS + 1):
            out[clock[0]] = []
            for own in boards.values():
                own.on_tick(clock[0])
            if len(out[clock[0]]) == 1:
                found.add(out[clock[0]][0])
            clock[0] += node.HERE_SLOT_MS
        if len(found) == len(serials):
            break
    assert found == set(serials)


def test_steps_are_played_after_flash_tells_of_them() -> None:
    bench = standing_by()
    order: list[str] = []
    write, play = bench.flash.write, bench.motors.play
    bench.flash.write = lambda *a: (order.append("write"), write(*a))  # type: ignore
    bench.motors.play = lambda *a: (order.append("play"), play(*a))  # type: ignore
    bench.sends_sun = False
    bench.order("STOW")
    while "play" not in order:
        bench.tick()
    assert order[order.index("play") - 1] == "write"


def test_flash_that_fails_latches_a_fault_and_the_beam_still_goes() -> None:
    bench = tracking()
    flash = frail(bench)
    flash.worn = True
    bench.order("DEFOCUS")
    bench.run(1)
    assert bench.node.trouble
    assert bench.state == "FAULT"
    assert bench.controller.fault == controller.JOURNAL
    bench.run(19)
    assert bench.miss(AIM) > 5.0
    assert bench.order("CLEAR_FAULT") == messages.REFUSED_STATE
    bench.run(300)
    assert tuple(bench.made) == STOW
    # A boot on such flash knows nothing of the counts.
    bench.start(bench.flash)
    assert bench.state == "FAULT"
    assert not bench.controller.motion.known
    bench.run(2)
    assert bench.order("CLEAR_FAULT") == messages.REFUSED_STATE


def test_what_flash_does_not_hold_is_not_acknowledged() -> None:
    bench = standing_by()
    flash = frail(bench)
    assert bench.order("SET_DEFOCUS", 0.21, 0.22) == DONE
    flash.worn = True
    assert bench.order("SET_DEFOCUS", 0.22, 0.22) == NOT_STORED
    assert bench.controller.fault == controller.JOURNAL
    assert bench.state == "FAULT"
    # The old values lie in the other slot.
    kept = Journal(flash)
    kept.load()
    assert kept.numbers("defocus") == pytest.approx((0.21, 0.22))


def test_the_supply_falls_amid_a_motion() -> None:
    bench = tracking()
    bench.order("STOW")
    bench.run(6)
    assert not bench.controller.motion.still()
    assert bench.node.on_supply_failing(bench.now)
    bench.check()
    assert bench.controller.fault == controller.SUPPLY
    assert bench.motors.stops == 1
    made = list(bench.made)
    bench.start(bench.flash)
    assert bench.made == made
    assert bench.slip == [0, 0]
    assert bench.controller.motion.known
    assert bench.journal.doubt == 0


def test_steps_that_the_timer_still_held_are_not_counted_when_the_supply_falls() -> None:
    bench = tracking()
    bench.order("STOW")
    bench.run(6)
    bench.motors.undone = 37, -11
    before = list(bench.made)
    assert bench.node.on_supply_failing(bench.now)
    assert bench.made == [before[0] - 37, before[1] + 11]
    kept = Journal(bench.flash)
    kept.load()
    assert [kept.primary, kept.secondary] == bench.made


def test_the_last_record_of_a_falling_supply_leaves_out_steps_that_were_not_made() -> None:
    # The supply dies right after that record: no other one corrects it.
    bench = tracking()
    bench.order("STOW")
    bench.run(6)
    flash = frail(bench)
    bench.motors.undone = 37, -11
    brown_out = bench.journal.brown_out

    def last(primary: int, secondary: int) -> bool:
        kept = brown_out(primary, secondary)
        flash.worn = True
        return kept

    bench.journal.brown_out = last  # type: ignore[method-assign]
    assert bench.node.on_supply_failing(bench.now)
    kept = Journal(flash)
    kept.load()
    assert [kept.primary, kept.secondary] == bench.made
    assert kept.rest
    assert kept.doubt == 0


def test_a_minute_without_trouble_is_healthy() -> None:
    bench = tracking()
    bench.start(bench.flash)
    bench.start(bench.flash)
    assert bench.journal.unhealthy == 2
    bench.run(59)
    assert bench.journal.unhealthy == 2
    bench.run(2)
    assert bench.journal.unhealthy == 0


def test_settings_that_were_lost_are_a_fault_that_can_be_cleared() -> None:
    flash = Flash()
    flash.data[:8192] = bytes(8192)
    bench = Bench(flash)
    assert bench.state == "UNCONFIGURED"
    assert bench.controller.fault == controller.JOURNAL
    assert not bench.node.trouble


def test_measurements_are_told_within_their_ranges() -> None:
    bench = standing_by()
    bench.node.measured(123_456, -300)
    bench.answers.clear()
    bench.send("QUERY_STATUS")
    assert bench.answers[0][1][5:7] == (0xFFFF, -128)


def test_the_way_is_set_kept_and_gone() -> None:
    bench = Bench()
    bench.run(2)
    points = [(30.0, 40.0, 1.0), (20.0, 10.0, 12.0)]
    numbers = [*points[0], *points[1], *[0.0] * 6]
    assert bench.order("SET_WAY", 0, 2, *numbers) == messages.REFUSED_STATE  # not while STOWED
    assert bench.order("LOCK") == DONE
    assert bench.order("SET_WAY", 1, 2, *numbers) == DONE
    bench.start(bench.flash)
    assert bench.state == "LOCKED"
    assert bench.controller.config.azimuth_axis == 1
    bench.sender = Sender(0, bench.sender.epoch + 1, sha256)  # the cluster restarts
    bench.run(2)
    assert bench.order("SET_WAY", 0, 2, *numbers) == DONE
    assert bench.order("UNLOCK") == DONE
    assert bench.order("AIM", *AIM) == DONE
    assert bench.order("APPROACH") == DONE
    passed = dict.fromkeys(points, 1000000000.0)
    while bench.state == "APPROACHING":
        bench.run(0.05)
        for point in points:
            passed[point] = min(passed[point], bench.miss(point))
    assert bench.state == "IDLE"
    # A pose holds for the sun of when its motion begins; in the 100 s of the longest one the sun
    # goes on by 7 mrad: 0.33 m at 45 m.
    assert max(passed.values()) < 0.33


@pytest.mark.parametrize(
    ("axis", "count", "east"), [(2, 0, 0.0), (0, 5, 0.0), (0, 1, 1e6), (0, 1, float("nan"))]
)
def test_a_way_that_is_none_is_refused(axis: int, count: int, east: float) -> None:
    bench = Bench()
    bench.run(2)
    bench.order("LOCK")
    before = dict(bench.journal.items)
    if east != east:
        payload = bytearray(
            wire.pack("SET_WAY", TOKEN, bench.gps_ms() // 1000 + 5, 1, 0, 1, *[0.0] * 12)
        )
        payload[14:18] = b"\xff" * 4
        frame = wire.Frame(ADDRESS, 0, (bench.sender.count + 1) & 0xFFFF, 0x59, bytes(payload))
        frame.mac = wire.authenticate(sha256, KEY, frame)
        bench.deliver(wire.encode(frame))
        assert bench.answers[-1][1][-1] == messages.BAD_VALUE
    else:
        assert bench.order("SET_WAY", axis, count, east, *[0.0] * 11) == messages.BAD_VALUE
    assert bench.controller.config.path == []
    assert bench.controller.config.azimuth_axis == 0
    assert bench.journal.items == before


def test_tracking_spares_the_flash_and_a_cut_says_what_is_in_doubt() -> None:
    bench = tracking()
    written = 0
    write = bench.flash.write

    def counted(offset: int, data: bytes) -> None:
        nonlocal written
        written += 1
        write(offset, data)

    bench.flash.write = counted  # type: ignore[method-assign]
    begin = list(bench.made)
    bench.run(120)
    steps = max(abs(now - was) for now, was in zip(bench.made, begin, strict=True))
    assert steps > 1000
    assert written <= 1 + 2 * steps // bench.journal.stride
    # A cut without a warning: doubtful, by no more than the stride.
    made = list(bench.made)
    bench.start(bench.flash)
    assert bench.journal.doubt == bench.journal.stride
    assert max(abs(now - was) for now, was in zip(bench.made, made, strict=True)) <= 1000
    # With a warning nothing is lost.
    again = tracking()
    again.run(30)
    made = list(again.made)
    assert again.node.on_supply_failing(again.now)
    again.start(again.flash)
    assert again.made == made
    assert again.journal.doubt == 0
    # And what stands is told at once.
    locked = tracking()
    locked.run(30)
    assert locked.order("LOCK") == DONE
    locked.run(3)
    assert locked.journal.rest


def resting(full: int = 8) -> Bench:
    """A bench whose drivers rest between motions; it has come to standby."""
    bench = Bench()
    bench.run(2)
    assert bench.motors.powered
    assert bench.order("LOCK") == DONE
    assert bench.order("SET_STEPPING", full, full, 1) == DONE
    assert bench.order("UNLOCK") == DONE
    assert bench.order("AIM", *AIM) == bench.order("APPROACH") == DONE
    bench.run(240, until="IDLE")
    return bench


def test_drivers_that_rest_are_off_between_steps_and_on_for_fine_stepping() -> None:
    bench = resting()
    assert bench.order("TRACK") == DONE
    bench.run(30)
    on = off = 0
    for _ in range(600):
        bench.run(0.05)
        on, off = on + bench.motors.powered, off + (not bench.motors.powered)
        if not bench.motors.powered:
            assert [made % 8 for made in bench.made] == [0, 0]
    assert off > 0 < on
    # Between full steps a motor needs its current.
    assert bench.order("ROUGH", 0) == DONE
    bench.run(5)
    assert any(made % 8 for made in bench.made)
    assert all(bench.motors.powered for _ in range(100) if bench.run(0.05) is None)
    assert bench.order("ROUGH", 1) == DONE
    assert bench.order("STOW") == DONE
    bench.run(400, until="STOWED")
    bench.run(1)
    assert not bench.motors.powered


def test_stepping_is_kept_and_rough_from_the_start() -> None:
    bench = resting()
    assert bench.order("STOW") == DONE
    bench.run(400, until="STOWED")
    bench.start(bench.flash)
    assert bench.controller.config.microsteps == (8, 8)
    assert bench.controller.motion.rough
    bench.sender = Sender(0, bench.sender.epoch + 1, sha256)
    bench.run(2)
    assert not bench.motors.powered
    assert bench.order("LOCK") == DONE
    assert bench.order("SET_STEPPING", 1, 1, 0) == DONE
    bench.run(1)
    assert bench.motors.powered
    assert not bench.controller.motion.rough


@pytest.mark.parametrize("numbers", [(0, 8, 1), (8, 0, 1), (8, 257, 1), (8, 8, 2)])
def test_stepping_out_of_range_is_refused(numbers: tuple[int, int, int]) -> None:
    bench = Bench()
    bench.run(2)
    assert bench.order("LOCK") == DONE
    assert bench.order("SET_STEPPING", *numbers) == messages.BAD_VALUE
    assert bench.controller.config.microsteps == (1, 1)
    assert not bench.controller.config.rests
