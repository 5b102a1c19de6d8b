"""Frames of the wire: what passes, what is refused, and what acts."""

import hashlib
import hmac
import math
import random
import re
import struct
from collections import defaultdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.lcu import messages, names, states, wire

KEY = b"a key of sixteen"
NAMES = [row[1] for row in messages.MESSAGES]
WHOLE = {code: st.integers(low, high) for code, (low, high) in wire.RANGES.items()}
NUMBERS = {
    **WHOLE,
    "f": st.floats(width=32, allow_nan=False, allow_infinity=False),
    "d": st.floats(allow_nan=False, allow_infinity=False),
    "s": st.binary(max_size=wire.PAYLOAD_LIMIT - 1),
}


def sha256(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()


def codes(name: str) -> str:
    return wire._single(messages.codes_of(messages.NUMBER_OF[name]))


def frame_of(name: str, payload: bytes, sequence: int = 1, to: int = 5) -> wire.Frame:
    number = messages.NUMBER_OF[name]
    frame = wire.Frame(to, 0, sequence, number, payload)
    if messages.who_of(number) == messages.KEY:
        frame.mac = wire.authenticate(sha256, KEY, frame)
    return frame


def example(name: str, rng: random.Random) -> bytes:
    made = {
        "f": lambda: rng.uniform(-1e4, 1e4),
        "d": lambda: rng.uniform(-1e4, 1e4),
        "s": lambda: rng.randbytes(rng.randrange(60)),
    }
    values = [
        rng.randint(*wire.RANGES[code]) if code in wire.RANGES else made[code]()
        for code in codes(name)
    ]
    return wire.pack(name, *values)


def traffic(count: int, seed: int) -> list[tuple[wire.Frame, bytes]]:
    rng = random.Random(seed)
    frames = []
    for sequence in range(count):
        frame = frame_of(name := rng.choice(NAMES), example(name, rng), sequence)
        frames.append((frame, wire.encode(frame)))
    return frames


def same(one: wire.Frame, other: wire.Frame) -> bool:
    return one.body() == other.body() and one.mac == other.mac


# The table.


def test_table_is_sound() -> None:
    assert len({row[0] for row in messages.MESSAGES}) == len(messages.MESSAGES) == len(set(NAMES))
    for number, name, who, row_codes, fields, _ in messages.MESSAGES:
        assert messages.name_of(number) == name
        assert messages.who_of(number) == who
        counted = [c for c in row_codes if not c.isdigit()]
        assert len(counted) == len(fields.split()), name
        if not row_codes.endswith("s"):
            size = struct.calcsize("<" + messages.codes_of(number))
            assert size + wire.MAC_SIZE <= wire.PAYLOAD_LIMIT
        heads = {
            messages.AUTHORITY: ["token", "expires_s"],
            messages.KEY: ["token", "expires_s", "edition"],
        }
        head = heads.get(who, [])
        assert messages.fields_of(number)[: len(head)] == head
    assert messages.name_of(0xEE) == ""
    assert messages.who_of(0xEE) == -1


def test_only_what_makes_the_field_safe_is_taken_from_anyone() -> None:
    free = {row[1] for row in messages.MESSAGES if row[2] == messages.ANYONE}
    assert free == {"DEFOCUS", "STOW"}


def test_traits_are_those_that_the_docstring_explains() -> None:
    used = {trait for row in messages.MESSAGES for trait in row[5].split()}
    assert messages.__doc__ is not None
    assert used == set(re.findall(r"^([a-z]+)  +[a-z]", messages.__doc__, re.MULTILINE))
    sent = {messages.ANYONE, messages.AUTHORITY, messages.KEY}
    assert all(row[2] in sent for row in messages.MESSAGES if row[5])


def test_traits_agree_with_the_state_table() -> None:
    motions, ends = defaultdict[str, set[str]](set), defaultdict[str, set[int]](set)
    for _, event, state, motion in names.transitions():
        motions[event].add(motion)
        ends[event].add(state)
    commands = {name for name in NAMES if motions[name]} - messages.SAFE
    moved = {"approach", "standby", "track", "search", "move", "diagnose"}
    assert {name for name in commands if motions[name] & moved} == messages.MOTIONS
    assert {name for name in commands if ends[name] <= set(states.ON_AIM)} == messages.JOINING
    for trait, does in (
        (messages.TO_STANDBY, {"approach", "standby"}),
        (messages.BY_COUNTS, {"move", "diagnose"}),
    ):
        assert {name for name in commands if motions[name] & does} == trait
    assert {name for name in commands if motions[name] == {"hold"}} == messages.RELEASES
    assert not messages.HARMLESS & messages.MOTIONS
    assert messages.SETTINGS < messages.HARMLESS
    assert {"AIM", "STANDBY"} == messages.POINTS


def test_an_operator_may_not_drive_by_hand() -> None:
    engineers = {row[1] for row in messages.MESSAGES if row[2] == messages.AUTHORITY}
    assert engineers - messages.BY_OPERATORS == messages.BY_COUNTS | {"CLEAR_FAULT", "ROUGH"}


def test_results_have_texts() -> None:
    assert len(messages.RESULTS) == messages.REFUSED_SWITCH + 1


def test_the_suns_rate_fits_its_field() -> None:
    fastest = 2 * math.pi / 86164.1  # rad/s, of the sky
    assert fastest * 2**28 < 32767 < fastest * 2**29


# Numbers that others published.


@pytest.mark.parametrize(
    ("plain", "stuffed"),
    [  # Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM ToN 7 (1999)
        (b"\0", b"\1\1"),
        (b"\0\0", b"\1\1\1"),
        (b"\0\x11\0", b"\1\2\x11\1"),
        (b"\x11\x22\0\x33", b"\3\x11\x22\2\x33"),
        (b"\x11\x22\x33\x44", b"\5\x11\x22\x33\x44"),
        (b"\x11\0\0\0", b"\2\x11\1\1\1"),
        (bytes(range(1, 255)), b"\xff" + bytes(range(1, 255))),
        (bytes(range(255)), b"\1\xff" + bytes(range(1, 255))),
        (bytes(range(1, 256)), b"\xff" + bytes(range(1, 255)) + b"\2\xff"),
    ],
)
def test_stuffing(plain: bytes, stuffed: bytes) -> None:
    assert wire.stuff(plain) == stuffed
    assert wire.unstuff(stuffed) == plain


def test_hmac_of_rfc_4231() -> None:
    expected = "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843"
    assert wire.hmac_sha256(sha256, b"Jefe", b"what do ya want for nothing?").hex() == expected


@given(st.binary(min_size=1, max_size=200), st.binary(max_size=300))
def test_hmac_is_that_of_the_library(key: bytes, data: bytes) -> None:
    assert wire.hmac_sha256(sha256, key, data) == hmac.new(key, data, "sha256").digest()


@pytest.mark.parametrize("zero", [252, 253, 254, 255, 256, 508, 509])
@pytest.mark.parametrize("after", [0, 1, 253, 254, 255])
def test_stuffing_keeps_a_zero_beside_the_end_of_a_full_block(zero: int, after: int) -> None:
    data = b"\1" * zero + b"\0" + b"\2" * after
    stuffed = wire.stuff(data)
    assert 0 not in stuffed
    assert wire.unstuff(stuffed) == data


@given(st.binary(max_size=600))
def test_stuffing_leaves_no_zero_and_comes_back(data: bytes) -> None:
    stuffed = wire.stuff(data)
    assert 0 not in stuffed
    assert len(stuffed) <= len(data) + 1 + len(data) // 254
    assert wire.unstuff(stuffed) == data


# Round trips.


@given(st.data())
@pytest.mark.parametrize("name", NAMES)
def test_every_message_comes_back(name: str, data: st.DataObject) -> None:
    values = tuple(data.draw(NUMBERS[code]) for code in codes(name))
    header = tuple(data.draw(NUMBERS["H"]) for _ in range(3))
    number = messages.NUMBER_OF[name]
    sent = wire.Frame(*header, number, wire.pack(name, *values))
    if messages.who_of(number) == messages.KEY:
        sent.mac = wire.authenticate(sha256, KEY, sent)
    raw = wire.encode(sent)
    assert len(raw) <= wire.FRAME_LIMIT
    assert raw.find(b"\0") == len(raw) - 1
    reader = wire.Reader()
    (got,) = reader.feed(raw)
    assert (got.to, got.sender, got.sequence, got.name) == (*header, name)
    assert got.values() == values
    assert same(got, sent)
    assert reader.good == 1


@given(st.integers(0, 2**32), st.lists(st.integers(1, 400), min_size=1, max_size=50))
def test_any_chunks_give_the_same_frames(seed: int, sizes: list[int]) -> None:
    sent = traffic(8, seed)
    stream = b"".join(raw for _, raw in sent)
    reader, got, start, turn = wire.Reader(), [], 0, 0
    while start < len(stream):
        size = sizes[turn % len(sizes)]
        got += reader.feed(stream[start : start + size])
        start, turn = start + size, turn + 1
    assert len(got) == len(sent)
    assert all(same(a, b) for a, (b, _) in zip(got, sent, strict=True))


def test_an_unknown_type_comes_raw() -> None:
    reader = wire.Reader()
    (got,) = reader.feed(wire.encode(wire.Frame(1, 2, 3, 0xEE, b"later")))
    assert (got.number, got.name, got.payload, got.values()) == (0xEE, "", b"later", None)


def test_addresses() -> None:
    assert wire.Frame(7, 0, 0, 0x20, b"").for_address(7)
    assert wire.Frame(wire.BROADCAST, 0, 0, 0x20, b"").for_address(7)
    assert not wire.Frame(8, 0, 0, 0x20, b"").for_address(7)


# Damage.


def counted(reader: wire.Reader) -> int:
    return reader.crc + reader.cobs + reader.length + reader.version


@pytest.mark.parametrize("name", NAMES)
def test_no_single_bit_passes(name: str) -> None:
    rng = random.Random(name)
    raw = wire.encode(frame_of(name, example(name, rng)))
    after = wire.encode(frame_of("DEFOCUS", b"", 2))
    for place in range(len(raw)):
        for bit in range(8):
            damaged = bytearray(raw)
            damaged[place] ^= 1 << bit
            reader = wire.Reader()
            got = reader.feed(bytes(damaged) + after + after)
            # Damage to the zero at the end takes the next frame with it, never the one after.
            assert [frame.name for frame in got] in (["DEFOCUS"] * 2, ["DEFOCUS"])
            assert len(got) == 2 or place == len(raw) - 1
            assert counted(reader) >= 1


def test_random_damage_never_makes_another_frame() -> None:
    rng = random.Random(11)
    sent = traffic(400, 12)
    reader, got, hurt = wire.Reader(), [], 0
    for _, raw in sent:
        damaged = bytearray(raw)
        if rng.random() < 0.5:
            hurt += 1
            for _ in range(rng.randint(1, 6)):
                damaged[rng.randrange(len(damaged))] = rng.randrange(256)
            if rng.random() < 0.3:
                damaged = damaged[: rng.randrange(len(damaged))]
            if rng.random() < 0.3:
                damaged += rng.randbytes(rng.randrange(300))
        got += reader.feed(bytes(damaged))
    originals = {frame.sequence: frame for frame, _ in sent}
    assert all(same(frame, originals[frame.sequence]) for frame in got)
    assert [frame.sequence for frame in got] == sorted({frame.sequence for frame in got})
    assert reader.good == len(got) > 0.3 * len(sent)
    assert min(reader.crc, reader.cobs, reader.length) > 0
    assert hurt > 150


def test_garbage_makes_no_frame() -> None:
    """1e5 pieces: half of them noise, half well stuffed with the right version, so that only
    the checksum stands against them (2e-5 false frames expected in all)."""
    rng = random.Random(13)
    reader, got = wire.Reader(), []
    for _ in range(50000):
        body = b"\2" + rng.randbytes(rng.randrange(11, 40))
        got += reader.feed(wire.stuff(body) + b"\0" + rng.randbytes(rng.randrange(1, 30)) + b"\0")
    assert got == []
    assert reader.crc > 50000
    assert reader.cobs > 40000
    (frame,) = reader.feed(wire.encode(frame_of("STOW", b"")))
    assert frame.name == "STOW"


def sealed(body: bytes) -> bytes:
    return wire.stuff(body + struct.pack("<I", wire.crc32(body))) + b"\0"


@pytest.mark.parametrize(
    ("raw", "count"),
    [
        (b"\x09abc\0", "cobs"),
        (wire.stuff(b"\2\5\0\0\0\1\0\x20abcd") + b"\0", "crc"),
        (sealed(b"\2\5\0\0\0\1\0"), "length"),
        (sealed(b"\2\5\0\0\0\1\0\x20x"), "length"),  # DEFOCUS has no payload
        (sealed(b"\2\5\0\0\0\1\0\x58" + bytes(7)), "length"),  # KEY, shorter than a MAC
        (b"x" * 250 + b"\0", "length"),
        (sealed(b"\4\5\0\0\0\1\0\x20"), "version"),
        (sealed(b"\3\5\0\0\0\1\0\x11" + bytes(29)), "length"),  # signed, one byte short
    ],
)
def test_what_is_refused_is_counted(raw: bytes, count: str) -> None:
    reader = wire.Reader()
    assert reader.feed(raw) == []
    counts = {name: getattr(reader, name) for name in ("good", "crc", "cobs", "length", "version")}
    assert counts == {**dict.fromkeys(counts, 0), count: 1}
    assert [frame.name for frame in reader.feed(sealed(b"\2\5\0\0\0\1\0\x20"))] == ["DEFOCUS"]


def test_zeros_between_frames_are_nothing() -> None:
    reader = wire.Reader()
    raw = wire.encode(frame_of("STOW", b""))
    assert len(reader.feed(b"\0\0" + raw + b"\0\0" + raw)) == 2
    assert counted(reader) == 0


def test_memory_is_bounded() -> None:
    reader = wire.Reader()
    rng = random.Random(14)
    for _ in range(300):
        reader.feed(bytes(rng.randrange(1, 256) for _ in range(rng.randrange(700))))
        assert len(reader._kept) < wire.FRAME_LIMIT
    assert reader.feed(b"\0") == []
    assert reader.length == 1


# Refusals.


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("WAVE", (), "no message 'WAVE'"),
        ("AIM", (1, 2, 3.0), "AIM: 3 values, 5 needed: token expires_s east_m north_m up_m"),
        ("JOG", (1, 2, 256, 0), "JOG, value 3: 256 is not within 0 to 255"),
        ("JOG", (1, 2, 0, 2**31), "JOG, value 4: 2147483648 is not within"),
        ("GOTO", (-1, 2, 0, 0), "GOTO, value 1: -1 is not within 0 to 4294967295"),
        ("GOTO", (1, 2, 0.5, 0), "GOTO, value 3: 0.5 is not a whole number"),
        ("AIM", (1, 2, math.nan, 0, 0), "AIM, value 3: nan is not a finite number"),
        ("AIM", (1, 2, math.inf, 0, 0), "inf is not a finite number"),
        ("AIM", (1, 2, 1e39, 0, 0), "1e\\+39 is not within"),
        ("SET_POSITION", (1, 2, 3, 10**400, 0, 0), "is not within"),
        ("AIM", (1, 2, "3", 0, 0), "AIM, value 3: '3' is not a finite number"),
        ("STORED", (1, "text"), "STORED, value 2: 'text' is not bytes"),
    ],
)
def test_pack_refuses(name: str, values: tuple[object, ...], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        wire.pack(name, *values)


@pytest.mark.parametrize(
    ("frame", "text"),
    [
        (wire.Frame(70000, 0, 0, 0x20, b""), "DEFOCUS: to: 70000 is not within 0 to 65535"),
        (wire.Frame(0, -1, 0, 0x20, b""), "DEFOCUS: from: -1"),
        (wire.Frame(0, 0, 65536, 0x20, b""), "DEFOCUS: sequence: 65536"),
        (wire.Frame(0, 0, 0, 256, b""), "message 256: type: 256"),
        (wire.Frame(0, 0, 0, 0x20, b"x"), "DEFOCUS: a payload of 1 bytes does not fit"),
        (wire.Frame(0, 0, 0, 0x58, bytes(20)), "SET_DEFOCUS: a MAC of 0 bytes, 8 needed"),
        (wire.Frame(0, 0, 0, 0x20, b"", bytes(8)), "DEFOCUS: a MAC of 8 bytes, 0 needed"),
        (wire.Frame(0, 0, 0, 0x0A, bytes(237)), "STORED: 237 bytes .* at most 236"),
    ],
)
def test_encode_refuses(frame: wire.Frame, text: str) -> None:
    with pytest.raises(ValueError, match=text):
        wire.encode(frame)


def test_the_longest_frame_is_as_long_as_said() -> None:
    raw = wire.encode(wire.Frame(0, 0, 0, 0x0A, bytes(wire.PAYLOAD_LIMIT)))
    assert len(raw) == wire.FRAME_LIMIT
    assert len(wire.Reader().feed(raw)) == 1


def test_unpack_refuses_a_wrong_length_and_what_is_no_number() -> None:
    aim = messages.NUMBER_OF["AIM"]
    payload = wire.pack("AIM", 1, 2, 3.0, 4.0, 5.0)
    assert wire.unpack(aim, payload) == (1, 2, 3.0, 4.0, 5.0)
    assert wire.unpack(aim, payload[:-1]) is None
    assert wire.unpack(aim, payload + b"\0") is None
    assert wire.unpack(0xEE, b"") is None
    assert wire.unpack(messages.NUMBER_OF["STORED"], b"") is None
    for bad in (math.nan, math.inf):
        assert wire.unpack(aim, struct.pack("<IIfff", 1, 2, 3, bad, 5)) is None


# Keys.


def test_a_mac_covers_header_and_payload() -> None:
    frame = frame_of("SET_STOW", wire.pack("SET_STOW", 7, 100, 1, -5, 6))
    assert wire.verify(sha256, KEY, frame)
    assert not wire.verify(sha256, KEY + b"x", frame)
    assert not wire.verify(sha256, b"", frame)
    for field in ("to", "sender", "sequence", "number"):
        other = frame_of("SET_STOW", frame.payload)
        setattr(other, field, getattr(other, field) ^ 1)
        assert not wire.verify(sha256, KEY, other), field
    for place in range(len(frame.payload) * 8):
        changed = bytearray(frame.payload)
        changed[place // 8] ^= 1 << place % 8
        other = wire.Frame(5, 0, 1, frame.number, bytes(changed), frame.mac)
        assert not wire.verify(sha256, KEY, other)
    for place in range(64):
        mac = bytearray(frame.mac)
        mac[place // 8] ^= 1 << place % 8
        other = wire.Frame(5, 0, 1, frame.number, frame.payload, bytes(mac))
        assert not wire.verify(sha256, KEY, other)
    other = wire.Frame(5, 0, 1, frame.number, frame.payload, frame.mac[:4])
    assert not wire.verify(sha256, KEY, other)


def test_an_empty_key_signs_nothing() -> None:
    with pytest.raises(ValueError, match="SET_STOW: needs a key"):
        wire.authenticate(sha256, b"", wire.Frame(5, 0, 1, 0x56, bytes(20)))
    # What an attacker would send to a controller without a key.
    forged = wire.Frame(5, 0, 1, 0x56, bytes(20))
    forged.mac = wire.hmac_sha256(sha256, b"", forged.body())[:8]
    assert not wire.verify(sha256, b"", forged)


# Clock.


@pytest.mark.parametrize(
    ("expires_s", "now_s", "void"),
    [
        (1000, 999, False),
        (1000, 1000, False),
        (1000, 1001, True),
        (1000, None, True),
        (3, 2**32 - 5, False),
        (2**32 - 5, 3, True),  # across the wrap
        (1000 + wire.HORIZON_S, 1000, False),
        (1001 + wire.HORIZON_S, 1000, True),
        (1000, 1000 + 2**31, True),
        (0, 1, True),
    ],
)
def test_expiry(expires_s: int, now_s: int | None, void: bool) -> None:
    assert wire.expired(expires_s, now_s) is void


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1))
def test_what_is_void_stays_void(expires_s: int, later: int) -> None:
    """No time after the expiry, up to the whole wrap less the horizon, makes a command good."""
    now = (expires_s + 1 + later % (2**32 - wire.HORIZON_S - 1)) & 0xFFFFFFFF
    assert wire.expired(expires_s, now)
