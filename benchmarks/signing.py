"""Signed frames of a bus: bytes on the wire, and the time that a local controller takes for one.

The frames are those that a cluster sends each second (SESSION, TIME, SUN) and a command. Times are
those of a local controller's own code in CPython here; ``docs/explanation/performance.md`` has the
same under MicroPython.
"""

import time
from collections.abc import Callable
from functools import partial

from benchmarks._run import Result, Row
from heliotrope.cluster._exchange import sha256
from heliotrope.lcu import messages, signing, wire
from heliotrope.lcu.sender import Sender

KEY, OWN_KEY = b"sixteen bytes !!", bytes(range(32))
ADDRESS, TOKEN, NOW = 5, 0x51A2B3C4, 1_480_000_000
BAUD_RATES, BITS = (19_200, 115_200), 10
EVERY_SECOND = ("SESSION", "TIME", "SUN")
SUN = (NOW, 612_345_678, -423_456_789, 771_234_567, -1234, 2345, 321)
#: At most this share of a second may go to the tags of the broadcasts at the slowest rate.
BUDGET = 0.02


def frames(sign: bool, count: int) -> dict[str, list[bytes]]:
    """Return frames by name; the first SESSION opens the session of a board that was off."""
    sender = Sender(wire.CLUSTER_ADDRESS, NOW, sha256)
    keys = board(sign).bus
    made: dict[str, list[bytes]] = {"SESSION": [], "TIME": [], "SUN": [], "TRACK": []}
    opening = sender.session(TOKEN)
    if isinstance(keys, signing.BusKeys):
        sender.sign = partial(signing.tag, sha256, signing.pads_of(KEY))
        opening = sender.session_to(ADDRESS, TOKEN, keys.nonce, sender.sign)
    made["OPENING"] = [opening]
    for _ in range(count):
        made["SESSION"].append(sender.session(TOKEN))
        made["TIME"].append(sender.frame(wire.BROADCAST, "TIME", 2447, 345_678_901, 1))
        made["SUN"].append(sender.frame(wire.BROADCAST, "SUN", *SUN))
        made["TRACK"].append(sender.frame(ADDRESS, "TRACK", TOKEN, NOW + 5))
    return made


def board(sign: bool) -> wire.Gate:
    """Return the gate of a local controller."""
    gate = wire.Gate(sha256, OWN_KEY)
    if sign:
        gate.bus = signing.BusKeys(sha256, OWN_KEY, 4711, 1)
        gate.bus.take(KEY + signing.NO_KEY)
    return gate


def _judged(sign: bool, count: int) -> tuple[dict[str, int], float]:
    """Return bytes by name, and the time of reading and judging a frame, s."""
    made = frames(sign, count)
    gate, reader = board(sign), wire.Reader()
    order = [raw for group in zip(*(made[name] for name in made if name != "OPENING"), strict=True)
             for raw in group]  # fmt: skip
    begin = time.perf_counter()
    for raw in made["OPENING"] + order:
        for frame in reader.feed(raw):
            assert gate.judge(frame, 0, NOW) == messages.DONE
    took = (time.perf_counter() - begin) / len(order)
    return {name: len(raws[-1]) for name, raws in made.items()}, took


def _best(
    work: Callable[[], tuple[dict[str, int], float]], runs: int
) -> tuple[dict[str, int], float]:
    return min((work() for _ in range(runs)), key=lambda found: found[1])


def run(quick: bool) -> Result:
    """Return the figures."""
    rows: list[Row] = []
    runs, count = (1, 50) if quick else (7, 1000)
    (plain, plain_s), (signed, signed_s) = (
        _best(partial(_judged, sign, count), runs) for sign in (False, True)
    )
    for name in (*EVERY_SECOND, "TRACK"):
        more = signed[name] - plain[name]
        rows.append(
            {
                "frame": name,
                "plain_bytes": plain[name],
                "signed_bytes": signed[name],
                **{f"more_ms_at_{rate}_baud": 1e3 * BITS * more / rate for rate in BAUD_RATES},
            }
        )
    more = sum(signed[name] - plain[name] for name in EVERY_SECOND)
    share = BITS * more / BAUD_RATES[0]
    return Result(
        rows,
        f"{more} bytes a second more, {100 * share:.2g} % of {BAUD_RATES[0]:,} baud; a signed "
        f"frame takes {signed_s / plain_s:.2f} times as long to read and judge",
        {"budget_share": BUDGET, "share": share, "plain_us": 1e6 * plain_s,
         "signed_us": 1e6 * signed_s},
        share <= BUDGET,
    )  # fmt: skip
