"""The 12-byte packet, and why it is told apart by silence."""

import random
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from heliotrope.lcu import messages, packet12, ticks, wire

CHARACTER_US = 1042  # 9600 baud
VALUES = {"f": st.floats(width=32, allow_nan=False, allow_infinity=False)} | {
    code: st.integers(low, high) for code, (low, high) in wire.RANGES.items()
}


def bare_codes(name: str) -> str:
    """Codes of a message without its head."""
    return messages.ROW_OF[messages.NUMBER_OF[name]][3]


def test_layout() -> None:
    packet = packet12.build(0x1234, 0xD8, b"\1\2\3")
    assert packet == b"\x12\x34\xd8\1\2\3\0\0\0\0\0" + bytes([(0x12 + 0x34 + 0xD8 + 6) & 0xFF])
    assert packet12.parse(packet) == (0x1234, 0xD8, b"\1\2\3\0\0\0\0\0")


def test_parts_hold_their_messages() -> None:
    kinds = [part[0] for row in packet12.PARTS for part in row[1]]
    assert len(set(kinds)) == len(kinds)
    assert packet12.SEARCH_OR_DIAGNOSE not in kinds
    for name, parts in packet12.PARTS:
        assert "".join(codes for _, codes in parts) == bare_codes(name)
        room = packet12.DATA_SIZE - (len(parts) > 1)
        assert all(struct.calcsize(">" + codes) <= room for _, codes in parts)


@given(st.data(), st.integers(0, 0xFFFF), st.integers(0, 255))
@pytest.mark.parametrize("name", [row[0] for row in packet12.PARTS])
def test_messages_come_back(name: str, data: st.DataObject, address: int, tag: int) -> None:
    values = tuple(data.draw(VALUES[code]) for code in bare_codes(name))
    packets = packet12.to_packets(address, name, values, tag)
    assert all(len(packet) == packet12.SIZE for packet in packets)
    joiner = packet12.Joiner()
    got = [joiner.feed(packet) for packet in packets]
    assert got == [None] * (len(packets) - 1) + [(address, name, values)]


@given(st.integers(0, 0xFFFF), st.integers(0, 10**7))
def test_search_and_diagnosis_share_a_type(pitch: int, radius: int) -> None:
    joiner = packet12.Joiner()
    (packet,) = packet12.to_packets(9, "SEARCH", (pitch * 1e-6, radius * 1e-6))
    assert packet[2] == 0xD8
    assert joiner.feed(packet) == (9, "SEARCH", (pitch * 1e-6, radius * 1e-6))
    (packet,) = packet12.to_packets(9, "DIAGNOSE", ())
    assert packet[2] == 0xD8
    assert joiner.feed(packet) == (9, "DIAGNOSE", ())
    assert joiner.feed(packet12.build(9, 0xD8, b"\7")) is None


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("SET_STOW", (1, 2), "SET_STOW: no 12-byte packet holds it; send it by version 2"),
        ("SESSION", (1, 2, 3), "SESSION: no 12-byte packet"),
        ("JOG", (0, 2**31), "JOG, value 4: 2147483648 is not within"),
        ("SEARCH", (0.1, 0.1), "SEARCH: pitch 0.1 rad: must be 0 to 0.065535"),
    ],
)
def test_what_no_packet_holds(name: str, values: tuple[float, ...], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        packet12.to_packets(1, name, values)


@pytest.mark.parametrize(
    ("address", "kind", "data"), [(-1, 0, b""), (65536, 0, b""), (0, 256, b""), (0, 0, bytes(9))]
)
def test_build_refuses(address: int, kind: int, data: bytes) -> None:
    with pytest.raises(ValueError, match=f"packet to {address}, type {kind}, {len(data)} bytes"):
        packet12.build(address, kind, data)


def test_parts_of_two_messages_never_make_one() -> None:
    first = packet12.to_packets(9, "POSITION", (1.0, 2.0, 3.0), 1)
    second = packet12.to_packets(9, "POSITION", (4.0, 5.0, 6.0), 2)
    joiner = packet12.Joiner()
    for packet in (first[0], second[1], second[2], second[0], first[1], first[2]):
        assert joiner.feed(packet) is None
    other = packet12.to_packets(8, "POSITION", (1.0, 2.0, 3.0), 1)
    for packet in (first[0], other[1], other[2], first[0], first[2], first[1]):
        assert joiner.feed(packet) is None
    assert [joiner.feed(packet) for packet in second][-1] == (9, "POSITION", (4.0, 5.0, 6.0))


def test_damaged_unknown_and_infinite_packets_are_nothing() -> None:
    joiner = packet12.Joiner()
    assert joiner.feed(b"") is None
    assert joiner.feed(packet12.build(9, 0x7F, b"")) is None
    for kind, number in ((0x95, 1.0), (0x96, float("nan")), (0x97, 1.0)):
        assert joiner.feed(packet12.build(9, kind, struct.pack(">f", number))) is None
    packet = packet12.to_packets(9, "GOTO", (1000, -2000))[0]
    for place in range(packet12.SIZE):
        for change in range(1, 256):
            damaged = bytearray(packet)
            damaged[place] ^= change
            assert packet12.parse(bytes(damaged)) is None


# On the line.


class Line:
    """Gives the splitter runs of bytes with silences between them, in pieces."""

    def __init__(self, tick: int = 0) -> None:
        self.splitter = packet12.Splitter(CHARACTER_US)
        self.tick = tick
        self.got: list[bytes] = []

    def send(self, run: bytes, silence_us: int, rng: random.Random | None = None) -> None:
        while run:
            size = rng.randint(1, len(run)) if rng else len(run)
            self.got += self.splitter.feed(self.tick, run[:size])
            self.tick = ticks.add(self.tick, size * CHARACTER_US)
            run = run[size:]
        self.tick = ticks.add(self.tick, silence_us)
        self.got += self.splitter.feed(self.tick)


def packets(rng: random.Random, count: int) -> list[bytes]:
    return [
        packet12.build(rng.randrange(32), rng.choice((0x43, 0x42, 0x91)), rng.randbytes(8))
        for _ in range(count)
    ]


@given(st.integers(0, ticks.PERIOD - 1), st.integers(0, 2**32))
def test_silence_tells_packets_apart(start: int, seed: int) -> None:
    rng = random.Random(seed)
    line, sent = Line(start), packets(rng, 20)
    for packet in sent:
        line.send(packet, rng.choice((4000, 10**6, 4 * 10**8, 7 * 10**8)), rng)
    assert line.got == sent
    assert (line.splitter.good, line.splitter.bad) == (20, 0)


def test_without_silence_nothing_passes() -> None:
    line = Line()
    one, two = packets(random.Random(41), 2)
    line.send(one, 3000)  # shorter than 3.5 characters
    line.send(two, 4000)
    assert line.got == []
    assert line.splitter.bad == 1
    line.send(two[:6], 4000)
    line.send(two[6:], 4000)
    assert line.got == []
    line.send(two, 4000)
    assert line.got == [two]


def test_the_silence_is_a_parameter() -> None:
    splitter = packet12.Splitter(CHARACTER_US, 20_000)
    (packet,) = packets(random.Random(42), 1)
    assert splitter.feed(0, packet[:6]) == []
    assert splitter.feed(6 * CHARACTER_US + 19_000, packet[6:]) == []
    assert splitter.feed(12 * CHARACTER_US + 19_000 + 20_000) == [packet]


def test_memory_is_bounded() -> None:
    splitter = packet12.Splitter(CHARACTER_US)
    for turn in range(100):
        splitter.feed(turn * 500 * CHARACTER_US & (ticks.PERIOD - 1), bytes(500))
        assert len(splitter._kept) <= packet12.SIZE


def sliding(stream: bytes) -> list[bytes]:
    """What a receiver takes that looks for a packet at every byte."""
    found, place = [], 0
    while place + packet12.SIZE <= len(stream):
        window = stream[place : place + packet12.SIZE]
        if packet12.parse(window) is None:
            place += 1
        else:
            found.append(window)
            place += packet12.SIZE
    return found


def test_a_sliding_window_takes_false_packets_and_silence_takes_none() -> None:
    """20,000 packets, one in twenty of which lost or gained bytes on the way."""
    rng = random.Random(43)
    sent = packets(rng, 20_000)
    line, stream, whole = Line(), b"", 0
    for packet in sent:
        run = packet
        if rng.random() < 0.05:
            cut = rng.randrange(1, 12)
            run = packet[:cut] if rng.random() < 0.5 else packet[:cut] + rng.randbytes(5)
        whole += run == packet
        stream += run
        line.send(run, 4000)
    true = set(sent)
    false_sliding = sum(found not in true for found in sliding(stream))
    assert false_sliding > 20  # of about 1000 damaged ones
    assert line.splitter.good == whole
    assert all(found in true for found in line.got)


def test_rate_of_false_packets_in_noise() -> None:
    """One place in 256 has a matching sum: the measured rate, within 5 standard deviations."""
    noise = random.Random(44).randbytes(200_000)
    places = len(noise) - packet12.SIZE + 1
    hits = sum(
        packet12.parse(noise[place : place + packet12.SIZE]) is not None for place in range(places)
    )
    assert abs(hits - places / 256) < 5 * (places / 256) ** 0.5
    line = Line()
    line.send(noise, 4000)  # one run of noise
    assert line.got == []
