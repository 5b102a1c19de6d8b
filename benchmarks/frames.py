"""Damaged frames that a receiver accepts: version 2, and Malan's packet for comparison.

A frame (or packet) is damaged at random in one of five ways, and a fresh receiver reads it between
whole ones. A *false accept* is a frame that comes out and was never sent. Frames that survive
because the damage missed them (an insertion after the end, say) do not count.
"""

import os
from collections import Counter
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from benchmarks._run import Result, Row
from heliotrope.lcu import messages, wire

WAYS = ("flip", "burst", "drop", "insert", "splice")
TRIALS, QUICK = 10_000_000, 20_000
SHARE = 100_000
#: Longest burst, drop and insertion, bytes.
LONGEST = 12

#: Malan, figure 5.9 and (5.1): twelve bytes, the last of them the sum of the others modulo 256.
PACKET_SIZE = 12

Table = Counter[tuple[str, str, str]]


def frames(rng: np.random.Generator, packets: bool) -> list[bytes]:
    """Return examples of all messages, or packets, with random contents."""
    if packets:
        return [
            body + bytes([sum(body) % 256])
            for body in (rng.bytes(PACKET_SIZE - 1) for _ in range(400))
        ]
    made = []
    for number, name, who, codes, *_ in messages.MESSAGES * 8:
        size = sum(_size(code) for code in wire._single(messages.codes_of(number)))
        payload = rng.bytes(size + (int(rng.integers(160)) if codes.endswith("s") else 0))
        mac = rng.bytes(wire.MAC_SIZE) if who == messages.KEY else b""
        to, sender, sequence = (int(value) for value in rng.integers(65536, size=3))
        made.append(wire.encode(wire.Frame(to, sender, sequence, number, payload, mac)))
        assert name
    return made


def _size(code: str) -> int:
    return {"B": 1, "b": 1, "H": 2, "h": 2, "I": 4, "i": 4, "f": 4, "d": 8, "s": 0}[code]


def damaged(way: str, data: bytes, other: bytes, draw: list[int], noise: bytes) -> bytes:
    """Return ``data`` damaged in one way; ``draw`` holds three random numbers below 2^30."""
    at = draw[0] % len(data)
    size = 1 + draw[1] % LONGEST
    if way == "flip":  # one to three bits
        whole = int.from_bytes(data, "little")
        for value in draw[: 1 + draw[1] % 3]:
            whole ^= 1 << value % (8 * len(data))
        return whole.to_bytes(len(data), "little")
    if way == "burst":
        return data[:at] + noise[:size][: len(data) - at] + data[at + size :]
    if way == "drop":
        return data[:at] + data[at + size :]
    if way == "insert":
        return data[:at] + noise[:size] + data[at:]
    return data[:at] + other[draw[2] % len(other) :]


def _accepted(data: bytes, packets: bool) -> list[bytes]:
    """Return the frames that a receiver accepts, each encoded again."""
    if packets:
        # Silence separates the packets, which the thesis's receiver does not use: its best case.
        whole = len(data) == PACKET_SIZE and sum(data[:-1]) % 256 == data[-1]
        return [data] if whole else []
    return [wire.encode(frame) for frame in wire.Reader().feed(data + b"\0")]


def share(job: tuple[int, int, bool]) -> Table:
    """Return counts by (format, way of damage, outcome) of some trials of a seed."""
    seed, trials, packets = job
    rng = np.random.default_rng([61, seed, packets])
    known = frames(rng, packets)
    draws = rng.integers(2**30, size=(trials, 6)).tolist()
    noises = rng.bytes(trials * LONGEST)
    kind = "12-byte packet" if packets else "version 2"
    found: Table = Counter()
    for i, (first, second, kind_of, *draw) in enumerate(draws):
        way = WAYS[kind_of % len(WAYS)]
        data, other = known[first % len(known)], known[second % len(known)]
        noise = noises[LONGEST * i : LONGEST * i + LONGEST]
        bad = damaged(way, data, other, draw, noise)
        if bad == data:
            found[kind, way, "unhurt"] += 1
            continue
        taken = _accepted(bad, packets)
        false = any(one not in (data, other) for one in taken)
        found[kind, way, "false" if false else "survived" if taken else "refused"] += 1
    return found


def sliding(size: int) -> int:
    """Return the number of packets that a receiver finds in noise by trying every byte."""
    noise = np.frombuffer(np.random.default_rng(62).bytes(size), np.uint8).astype(np.int64)
    total = np.convolve(noise, np.ones(PACKET_SIZE - 1, np.int64), "valid")[:-1]
    return int(np.count_nonzero(total % 256 == noise[PACKET_SIZE - 1 :]))


def run(quick: bool) -> Result:
    """Return the figures."""
    trials = QUICK if quick else TRIALS
    each = min(SHARE, trials)
    jobs = [(seed, each, packets) for packets in (False, True) for seed in range(trials // each)]
    found: Table = Counter()
    workers = 1 if quick else min(2, os.cpu_count() or 1)
    with ProcessPoolExecutor(workers) as pool:
        for counts in pool.map(share, jobs):
            found.update(counts)
    rows: list[Row] = []
    for kind in ("version 2", "12-byte packet"):
        for way in WAYS:
            number = {
                what: found[kind, way, what] for what in ("refused", "survived", "unhurt", "false")
            }
            hurt = number["refused"] + number["survived"] + number["false"]
            row: Row = {"format": kind, "way": way, "trials": sum(number.values()), **number}
            rows.append(row | {"one_false_in": hurt / number["false"] if number["false"] else None})
    false = {
        kind: sum(found[kind, way, "false"] for way in WAYS)
        for kind in ("version 2", "12-byte packet")
    }
    noise = 100_000 if quick else 10_000_000
    return Result(
        rows,
        f"{trials:,} damaged frames: {false['version 2']} taken for true; Malan's packet: "
        f"{false['12-byte packet']:,}",
        {"noise_bytes": noise, "packets_found_in_noise_at_every_byte": sliding(noise)},
        false["version 2"] == 0,
    )
