"""Signed frames of a bus: what a stranger at the wire can no longer do, and what anybody can."""

import struct
from binascii import crc32

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from heliotrope.lcu import journal, messages, motion, names, signing, states, wire
from heliotrope.lcu.sender import Sender
from support.lcu_machines import ADDRESS, KEY, START_S, TOKEN, WANTED, Bench, Flash, sha256, signer

BUS_KEY, NEW_KEY = b"sixteen bytes !!", b"sixteen others !"
KEYED = 1 << names.FLAGS.index("BUS_KEY")
ACTING = [row[1] for row in messages.MESSAGES if row[2] in (messages.AUTHORITY, messages.CLUSTER)]


def keyed() -> Bench:
    """A board with a key, in a signed session."""
    bench = Bench(bus_key=BUS_KEY)
    bench.run(1.5)
    assert not bench.controller.flags() & WANTED
    return bench


def set_key(bench: Bench, key: bytes, own_key: bytes = KEY, edition: int = 0) -> int:
    """Give a board a key of the bus; return the result in the ACK."""
    bench.edition = edition or bench.edition + 1
    carried = signing.wrapped(sha256, own_key, bench.edition, key)
    bench.answers.clear()
    values = 0, 0, bench.edition, *struct.unpack("<4I", carried)
    bench.deliver(bench.sender.frame(ADDRESS, "SET_BUS_KEY", *values, key=own_key))
    ((number, (_, of, result)),) = bench.answers
    assert (number, of) == (0x0D, 0x5B)
    return result  # type: ignore[return-value]


def printed(key: bytes) -> int:
    return signing.fingerprint(sha256, signing.pads_of(key))


class Gates:
    """A sender that signs and the gate of a board in its session."""

    def __init__(self) -> None:
        self.sender = Sender(0, 100, sha256)
        self.sender.sign = signer(BUS_KEY)
        self.gate = wire.Gate(sha256, KEY)
        self.keys = signing.BusKeys(sha256, KEY, 4711, 1)
        self.keys.take(BUS_KEY + signing.NO_KEY)
        self.gate.bus = self.keys
        assert self.judge(self.meeting()) == messages.DONE

    def meeting(self) -> bytes:
        return self.sender.session_to(5, TOKEN, self.keys.nonce, signer(BUS_KEY))

    def judge(self, raw: bytes) -> int:
        (frame,) = wire.Reader().feed(raw)
        return self.gate.judge(frame, 0, START_S)

    def track(self) -> bytes:
        return self.sender.frame(5, "TRACK", TOKEN, START_S + 5)

    def held(self) -> tuple[int, int, int]:
        return self.gate.replay.epoch, self.gate.replay.count, self.gate.token


# -- work as usual ---------------------------------------------------------------------------


def test_a_signed_bus_leads_a_mirror_to_the_receiver() -> None:
    bench = Bench(bus_key=BUS_KEY)
    assert bench.controller.flags() & (KEYED | WANTED) == KEYED | WANTED
    bench.to_tracking()
    assert bench.controller.flags() & (KEYED | WANTED) == KEYED
    assert bench.order("SET_DEFOCUS", 0.2, 0.1) == messages.REFUSED_STATE  # not: wrong key
    assert bench.order("DEFOCUS") == messages.DONE


def test_a_board_without_a_key_takes_signed_frames() -> None:
    bench = Bench()
    bench.sender.sign = signer(BUS_KEY)
    bench.to_tracking()


def test_a_board_without_a_key_is_given_one_on_the_bus() -> None:
    bench = Bench()
    bench.run(1.5)
    assert bench.ask_bus()[1:] == (0, 0)
    assert set_key(bench, BUS_KEY) == messages.DONE
    assert bench.ask_bus()[1:] == (printed(BUS_KEY), 0)
    # Whatever anybody has told it before counts no more.
    assert bench.controller.flags() & WANTED
    assert bench.order("AIM", 0.0, 0.0, 50.0) == messages.REFUSED_KEY
    bench.bus_key, bench.sender.sign = BUS_KEY, signer(BUS_KEY)
    bench.to_tracking()


# -- strangers -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ACTING)
def test_unsigned_frames_that_move_or_reassure_are_refused(name: str) -> None:
    ends = Gates()
    held = ends.held()
    ends.sender.sign = None
    codes = wire._single(messages.codes_of(messages.NUMBER_OF[name]))
    values = [0] * len(codes)
    if name == "SESSION":
        values = [101, 0, TOKEN]
    elif messages.NUMBER_OF[name] >= 0x30:
        values[:2] = [TOKEN, START_S + 5]
    assert ends.judge(ends.sender.frame(5, name, *values)) == messages.REFUSED_KEY
    assert ends.held() == held
    assert ends.judge(ends.sender.frame(wire.BROADCAST, name, *values)) == messages.REFUSED_KEY
    assert ends.held() == held


def test_anybody_may_make_it_safe() -> None:
    for name, state in (("DEFOCUS", "DEFOCUSED"), ("STOW", "STOWING")):
        bench = keyed()
        bench.to_tracking()
        bench.deliver(Sender(99, 1).frame(wire.BROADCAST, name))
        assert bench.state == state


def test_questions_of_a_stranger_hold_no_mirror_in_its_place() -> None:
    bench = keyed()
    bench.to_tracking()
    bench.order("LOCK")
    stranger = Sender(0, 1)
    bench.sends_sun = bench.sends_time = False
    for _ in range(100):
        bench.tick(100)
        bench.deliver(stranger.frame(ADDRESS, "QUERY_STATUS"))
        if bench.controller.motion.kind != motion.HOLD:
            return
    pytest.fail("it still holds the beam on the receiver")


@settings(max_examples=300, deadline=None)
@given(data=st.data())
def test_damaged_and_shortened_frames_change_nothing(data: st.DataObject) -> None:
    ends = Gates()
    name = data.draw(st.sampled_from(["session", "meeting", "track", "sun"]))
    raw = {
        "session": lambda: ends.sender.session(TOKEN + 1),
        "meeting": ends.meeting,
        "track": ends.track,
        "sun": lambda: ends.sender.frame(wire.BROADCAST, "SUN", START_S, 1, 2, 3, 4, 5, 6),
    }[name]()
    body = bytearray(wire.unstuff(raw[:-1]) or b"")[:-4]
    before = bytes(body)
    if data.draw(st.booleans()):
        place = data.draw(st.integers(0, 8 * len(body) - 1))
        body[place // 8] ^= 1 << place % 8
    else:
        del body[data.draw(st.integers(8, len(body) - 1)) :]
    held = ends.held()
    # The checksum is made right again: whoever alters a frame on purpose does that too.
    forged = wire.stuff(bytes(body) + struct.pack("<I", crc32(bytes(body)))) + b"\0"
    for frame in wire.Reader().feed(forged):
        safe = messages.who_of(frame.number) in (messages.ANYONE, messages.ASK)
        if frame.for_address(5):
            assert ends.gate.judge(frame, 0, START_S) != messages.DONE or safe
    assert ends.held() == held
    assert bytes(body) != before
    assert ends.judge(raw) == messages.DONE


@settings(max_examples=100, deadline=None)
@given(
    tag=st.binary(min_size=8, max_size=8),
    to=st.sampled_from([5, wire.BROADCAST]),
    sequence=st.integers(0, 65535),
    number=st.sampled_from([messages.NUMBER_OF[name] for name in ACTING]),
)
def test_forged_frames_change_nothing(tag: bytes, to: int, sequence: int, number: int) -> None:
    ends = Gates()
    held = ends.held()
    payload = bytes(struct.calcsize("<" + messages.codes_of(number)))
    forged = wire.Frame(to, 0, sequence, number, payload, tag, wire.SIGNED)
    assert ends.gate.judge(forged, 0, START_S) == messages.REFUSED_KEY
    assert ends.held() == held


# -- recordings ------------------------------------------------------------------------------


def test_a_recording_of_a_session_is_worthless() -> None:
    ends = Gates()
    heard = []
    for _ in range(3):
        heard += [ends.sender.session(TOKEN), ends.track()]
    assert {ends.judge(raw) for raw in heard} == {messages.DONE}
    held = ends.held()
    assert messages.DONE not in {ends.judge(raw) for raw in heard}
    assert ends.held() == held


def test_a_sequence_that_comes_round_does_not_bring_a_recording_back() -> None:
    ends = Gates()
    ends.sender.count = 0x1000
    old = ends.track()
    ends.sender.count = 0x1_0800  # as if 65,536 frames had passed
    assert ends.judge(ends.sender.session(TOKEN)) == messages.DONE
    held = ends.held()
    assert 0 < 0x1001 - (held[1] & 0xFFFF) < 0x8000  # by its sequence alone it would be new
    assert ends.judge(old) == messages.REFUSED_KEY
    assert ends.held() == held
    assert ends.judge(ends.track()) == messages.DONE


def test_a_board_that_was_off_takes_no_recording() -> None:
    bench = Bench(bus_key=BUS_KEY)
    heard: list[bytes] = []
    deliver = bench.deliver
    bench.deliver = lambda data: (heard.append(data), deliver(data))[1]  # type: ignore[method-assign, func-returns-value]
    bench.run(2.5)
    assert bench.controller.sun.fresh()
    del bench.deliver
    bench.start(bench.flash)
    for data in heard:
        bench.deliver(data)
    assert bench.controller.clock.second is None
    assert not bench.controller.sun.fresh()
    assert bench.controller.flags() & WANTED
    bench.run(1.5)  # the true cluster asks for the new number
    assert bench.controller.sun.fresh()


def test_a_recording_from_before_a_rotation_is_worthless_after_a_reboot_too() -> None:
    """Neither with the old key, while it still counts, nor when only the new one does."""
    bench = keyed()
    heard: list[bytes] = []
    deliver = bench.deliver
    bench.deliver = lambda data: (heard.append(data), deliver(data))[1]  # type: ignore[method-assign, func-returns-value]
    bench.run(2.5)
    assert bench.order("AIM", 0.0, 0.0, 50.0) == messages.DONE
    del bench.deliver
    recorded = list(heard)
    assert set_key(bench, NEW_KEY) == messages.DONE
    for rekeyed in (False, True):
        if rekeyed:
            bench.sender.sign = signer(NEW_KEY)
            bench.run(1.5)
            assert set_key(bench, NEW_KEY) == messages.DONE  # the old one ends
        bench.start(bench.flash)
        for data in recorded:
            bench.deliver(data)
        assert bench.controller.clock.second is None
        assert not bench.controller.sun.fresh()
        assert bench.controller.flags() & WANTED


def test_numbers_drawn_never_come_twice_and_are_the_keys() -> None:
    drawn = set()
    for boots in (1, 2):
        keys = signing.BusKeys(sha256, KEY, 4711, boots)
        keys.take(BUS_KEY + signing.NO_KEY)
        for _ in range(50):
            drawn.add(keys.nonce)
            keys._draw()
    other = signing.BusKeys(sha256, KEY, 4712, 1)
    other.take(BUS_KEY + signing.NO_KEY)
    assert len(drawn | {other.nonce}) == 101


def test_a_silent_board_meets_its_cluster_again_even_in_an_earlier_epoch() -> None:
    bench = keyed()
    bench.sends_sun = bench.sends_time = False
    bench.run(11)
    bench.send("QUERY_STATUS")  # whose gate looks at the silence
    assert bench.controller.flags() & WANTED
    bench.sender = bench.new_sender(START_S - 5000)  # it has lost its state and its clock
    bench.sends_sun = bench.sends_time = True
    bench.run(1.5)
    assert bench.node.gate.replay.epoch == START_S - 5000
    assert bench.controller.sun.fresh()


# -- keys ------------------------------------------------------------------------------------


def test_keys_are_rotated() -> None:
    bench = keyed()
    assert set_key(bench, NEW_KEY) == messages.DONE
    assert bench.ask_bus()[1:] == (printed(NEW_KEY), printed(BUS_KEY))
    assert not bench.controller.flags() & WANTED  # the session goes on
    for key in (BUS_KEY, NEW_KEY, BUS_KEY):
        bench.sender.sign = signer(key)
        assert bench.order("AIM", 0.0, 0.0, 50.0) == messages.DONE
    assert set_key(bench, NEW_KEY) == messages.DONE
    assert bench.ask_bus()[1:] == (printed(NEW_KEY), 0)
    assert bench.order("AIM", 0.0, 0.0, 50.0) == messages.REFUSED_KEY
    bench.sender.sign = signer(NEW_KEY)
    assert bench.order("AIM", 0.0, 0.0, 50.0) == messages.DONE
    assert set_key(bench, signing.NO_KEY) == messages.DONE
    assert bench.ask_bus()[1:] == (0, 0)
    bench.sender.sign = None
    assert bench.order("AIM", 0.0, 0.0, 50.0) == messages.DONE


def test_a_key_outlasts_the_supply() -> None:
    bench = Bench()
    bench.run(1.5)
    set_key(bench, BUS_KEY)
    bench.start(bench.flash)
    assert bench.controller.flags() & KEYED
    assert bench.ask_bus()[1:] == (printed(BUS_KEY), 0)


def test_a_key_needs_the_key_of_the_board_and_an_edition() -> None:
    bench = keyed()
    assert set_key(bench, NEW_KEY, b"not the key of it") == messages.REFUSED_KEY
    assert set_key(bench, NEW_KEY, edition=7) == messages.DONE
    assert set_key(bench, BUS_KEY, edition=7) == messages.DUPLICATE
    bench.start(bench.flash)
    assert set_key(bench, BUS_KEY, edition=7) == messages.DUPLICATE
    assert bench.ask_bus()[1:] == (printed(NEW_KEY), printed(BUS_KEY))


def test_a_key_is_not_readable_on_the_wire_and_never_told() -> None:
    bench = Bench()
    bench.run(1.5)
    heard: list[bytes] = []
    deliver = bench.deliver
    bench.deliver = lambda data: (heard.append(data), deliver(data))[1]  # type: ignore[method-assign, func-returns-value]
    assert set_key(bench, BUS_KEY) == messages.DONE
    (sent,) = heard
    (frame,) = wire.Reader().feed(sent)
    assert BUS_KEY not in frame.payload
    del bench.deliver
    bench.answers.clear()
    bench.send("QUERY_STORED", [row[0] for row in journal.ITEMS].index("bus_keys") + 1)
    assert bench.answers == []


def test_a_moving_mirror_takes_no_key() -> None:
    bench = keyed()
    bench.to_tracking()
    assert set_key(bench, NEW_KEY) == messages.REFUSED_STATE
    assert bench.ask_bus()[1:] == (printed(BUS_KEY), 0)
    assert bench.state == "TRACKING"


def test_a_board_whose_flash_fails_keeps_its_key() -> None:
    bench = keyed()
    bench.node.trouble = "flash"
    assert set_key(bench, NEW_KEY) == messages.NOT_STORED
    assert bench.ask_bus()[1:] == (printed(BUS_KEY), 0)


@pytest.mark.parametrize("size", journal.FORMER_SIZES)
def test_settings_of_firmware_without_signatures_are_kept(size: int) -> None:
    bench = Bench()
    flash = Flash()
    # As that firmware wrote them: without the last items.
    raw = bench.flash.read(0, journal.SLOT_SIZE)
    former = raw[: size - 4]
    former += struct.pack("<I", crc32(former))
    flash.write(0, former)
    book = journal.Journal(flash)
    assert book.load() == bench.journal.items
    assert not book.damaged
    book.store({"bus_keys": BUS_KEY + signing.NO_KEY})
    again = journal.Journal(flash)
    assert again.load() == {**bench.journal.items, "bus_keys": BUS_KEY + signing.NO_KEY}


def test_the_flags_say_who_has_a_key() -> None:
    assert not Bench().controller.flags() & (KEYED | WANTED)
    assert keyed().controller.flags() & (KEYED | WANTED) == KEYED
    assert states.STATES[keyed().controller.state] == "STOWED"
