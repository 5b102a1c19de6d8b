"""Simulate the radio layer that Malan recommends (3.5), under our wire: ``malan_radio.py``.

10,000 heliostats hear the sun each second, report their state, and must hear an emergency. The
frames are ours (`heliotrope.lcu.wire`), byte for byte; the radios are IEEE 802.15.4 at 250 kbit/s
and LoRa at a spreading factor of 7. Each node's reception is a Gilbert-Elliott channel: short loss
all the time, and bursts (a lorry, a mirror that turns) in which nearly everything is lost.

Sources: a frame of 802.15.4 has 6 bytes before its PSDU, 133 bytes last 4.256 ms (CC2420 data
sheet, figure 18; Freescale, "ZigBee technology overview"); time on air of LoRa: Semtech SX1261/2
data sheet, 6.1.4; currents of 20 and 17.4 mA: table 3 of PMC4507673. Ours: the bursts, the supply
of 3 V, the guard times, LoRa's currents, and one hop from transmitter to node.
"""

import math
import struct
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from heliotrope.lcu import messages
from heliotrope.lcu.wire import MAC_SIZE, SIGNED, Frame, encode

HELIOSTATS = 10_000
#: Least time without the sun after which a heliostat defocuses by itself, s.
LEASE = 6.0
#: Share of the time in a burst, its mean length (s), and the loss outside and inside of one.
BURSTS, BURST_S, LOSS, LOSS_IN_BURST = 0.02, 0.5, 0.01, 0.9
#: Header of the MAC layer: control, sequence, network, two short addresses, checksum.
MAC_BYTES = 2 + 1 + 2 + 2 + 2 + 2
SUPPLY_V = 3.0


@dataclass(frozen=True)
class Radio:
    """A radio: bit rate of 802.15.4 (bit/s), or spreading factor and bandwidth (Hz) of LoRa.

    ``turn`` is the change from receiving to sending, s; currents are in A.
    """

    name: str
    channels: int
    turn: float
    receive: float
    send: float
    rate: float = 0.0
    spreading: int = 0
    bandwidth: float = 125e3

    def airtime(self, size: int) -> float:
        """Return the time on the air of a MAC payload of ``size`` bytes, s."""
        psdu = size + MAC_BYTES
        if self.rate:
            return 8.0 * (6 + psdu) / self.rate
        return lora_airtime(psdu, self.spreading, self.bandwidth)


def lora_airtime(size: int, spreading: int, bandwidth: float = 125e3) -> float:
    """Return LoRa's time on air, s: preamble of 8, explicit header, checksum, rate 4/5."""
    symbol = 2.0**spreading / bandwidth
    low_rate = 2 if symbol >= 16e-3 else 0
    blocks = math.ceil((8 * size - 4 * spreading + 28 + 16) / (4 * (spreading - low_rate)))
    return (8 + 4.25 + 8 + 5 * max(blocks, 0)) * symbol


RADIOS = (
    Radio("802.15.4", 16, 192e-6, 20e-3, 17.4e-3, rate=250e3),
    Radio("LoRa SF7", 8, 1e-3, 11e-3, 29e-3, spreading=7),
)


def size_of(name: str) -> int:
    """Return the length of one of our frames on the wire, bytes; all but answers are signed."""
    number = next(row[0] for row in messages.MESSAGES if row[1] == name)
    payload = bytes(struct.calcsize("<" + messages.codes_of(number)))
    if messages.who_of(number) == messages.NODE:
        return len(encode(Frame(1, 0, 1, number, payload)))
    return len(encode(Frame(1, 0, 1, number, payload, bytes(MAC_SIZE), SIGNED)))


class Channel:
    """Gilbert-Elliott reception of N nodes: in a burst or not, and loss in both."""

    def __init__(self, nodes: int, rng: np.random.Generator) -> None:
        self._rng = rng
        self._burst = rng.random(nodes) < BURSTS

    def keep(self, left: npt.NDArray[np.bool_]) -> None:
        """Go on with some of the nodes."""
        self._burst = self._burst[left]

    def heard(self, passed: float) -> npt.NDArray[np.bool_]:
        """Return which nodes hear a frame sent ``passed`` s after the last one."""
        # A two-state Markov process in continuous time, sampled at its exact transition rates.
        fade = math.exp(-passed / (BURST_S * (1.0 - BURSTS)))
        chance = BURSTS + (self._burst - BURSTS) * fade
        self._burst = self._rng.random(len(self._burst)) < chance
        return self._rng.random(len(self._burst)) >= np.where(self._burst, LOSS_IN_BURST, LOSS)


def sun_gaps(seconds: int, calls: int, rng: np.random.Generator) -> float:
    """Return how often a day a node is without the sun for `LEASE` s; ``calls`` a second."""
    channel = Channel(HELIOSTATS, rng)
    since, trips = np.zeros(HELIOSTATS), 0
    for _ in range(seconds * calls):
        before = since
        since = np.where(channel.heard(1.0 / calls), 0.0, since + 1.0 / calls)
        trips += int(((since >= LEASE) & (before < LEASE)).sum())
    return trips * 86_400.0 / seconds / HELIOSTATS


def polled(radio: Radio, nodes: int, rng: np.random.Generator) -> tuple[float, float]:
    """Return the time of a round of questions, s, and the share of nodes without an answer."""
    step = radio.airtime(size_of("QUERY_STATUS")) + radio.airtime(size_of("STATUS"))
    step += 2.0 * radio.turn
    channel, spent, left = Channel(nodes, rng), 0.0, nodes
    for attempt in range(3):
        # Question and answer must both arrive; the unanswered are asked again after the round.
        good = channel.heard(spent if attempt else 1.0) & (rng.random(left) >= LOSS)
        spent += left * step
        channel.keep(~good)
        left = int((~good).sum())
    return spent, left / nodes


def slotted(radio: Radio, nodes: int, rng: np.random.Generator) -> tuple[float, float]:
    """Return the time of a round of slots (TDMA), s, and the share of nodes not heard."""
    # The beacon is the sun; clocks of 30 ppm drift apart by 60 µs in a second.
    guard = radio.turn + 2.0 * 30e-6
    spent = radio.airtime(size_of("SUN")) + nodes * (radio.airtime(size_of("STATUS")) + guard)
    return spent, float(1.0 - Channel(nodes, rng).heard(1.0).mean())


def emergency(
    radio: Radio, rng: np.random.Generator, *, calls: int, senders: int, every: float
) -> tuple[float, float, int]:
    """Call DEFOCUS to all; return the times to 99.99 % and to the last node, s, and the unheard.

    ``calls`` at most; each node hears ``senders`` transmitters by independent channels in turn.
    """
    air = radio.airtime(size_of("DEFOCUS"))
    # The longest frame may be on the air when the order comes.
    wait = rng.random() * radio.airtime(size_of("AIM"))
    every = max(every, senders * air)
    paths = [Channel(HELIOSTATS, rng) for _ in range(senders)]
    left, most = HELIOSTATS, math.inf
    for call in range(calls):
        missed = np.ones(left, dtype=np.bool_)
        for path in paths:
            missed &= ~path.heard(every if call else 1.0)
        for path in paths:
            path.keep(missed)
        left = int(missed.sum())
        now = wait + call * every + senders * air
        if left <= HELIOSTATS * 1e-4:
            most = min(most, now)
        if not left:
            return most, now, 0
    return most, math.inf, left


def power(radio: Radio, window: float, period: float) -> float:
    """Return the mean power of a node, W, that listens for ``window`` in each ``period`` (s)."""
    send = radio.airtime(size_of("STATUS"))
    return SUPPLY_V * (radio.receive * min(window / period, 1.0) + radio.send * send)


def study(seed: int = 0, trials: int = 40) -> dict[str, float]:
    """Return the figures by name: s, shares, trips a day, W."""
    rng = np.random.default_rng(seed)
    found: dict[str, float] = {}
    for radio in RADIOS:
        nodes = HELIOSTATS // radio.channels
        for name in ("SUN", "QUERY_STATUS", "STATUS", "DEFOCUS"):
            found[f"{radio.name}, {name}, ms"] = 1e3 * radio.airtime(size_of(name))
        found[f"{radio.name}, polling, s"], lost = polled(radio, nodes, rng)
        found[f"{radio.name}, polling, unheard"] = lost
        found[f"{radio.name}, slots, s"], lost = slotted(radio, nodes, rng)
        found[f"{radio.name}, slots, unheard"] = lost
        second = sum(radio.airtime(size_of(name)) for name in ("TIME", "SUN", "SESSION"))
        found[f"{radio.name}, air for time, sun, session"] = second
        for label, calls, senders in (
            ("3 calls", 3, 1),
            ("1 sender", 4000, 1),
            ("2 senders", 4000, 2),
        ):
            runs = [
                emergency(radio, rng, calls=calls, senders=senders, every=20e-3)
                for _ in range(trials)
            ]
            most, last, unheard = (
                np.array(column, dtype=float) for column in zip(*runs, strict=True)
            )
            found[f"{radio.name}, {label}, 99.99 %, s"] = float(np.max(most))
            found[f"{radio.name}, {label}, last, s"] = float(np.max(last))
            found[f"{radio.name}, {label}, unheard"] = float(np.mean(unheard))
        found[f"{radio.name}, always on, W"] = power(radio, 1.0, 1.0)
        found[f"{radio.name}, beacon, W"] = power(radio, 2e-3 + radio.airtime(size_of("SUN")), 1.0)
    for calls in (1, 2):
        found[f"trips a day, {calls} a second"] = sun_gaps(1200, calls, rng)
    return found


def main() -> dict[str, float]:
    """Print the figures and return them."""
    found = study()
    table = Table("", *(radio.name for radio in RADIOS), box=SIMPLE_HEAD)
    first = RADIOS[0].name
    for key in [name for name in found if name.startswith(first)]:
        short = key.removeprefix(f"{first}, ")
        table.add_row(short, *(f"{found[f'{radio.name}, {short}']:.4g}" for radio in RADIOS))
    console = Console(width=90)
    console.print(table)
    slots, polling = (found[f"{first}, {name}, s"] for name in ("slots", "polling"))
    console.print(
        f"{HELIOSTATS:,} heliostats on {first}: slots save {100 * (1 - slots / polling):.0f} % of "
        "the time of polling"
    )
    for calls in (1, 2):
        trips = found[f"trips a day, {calls} a second"]
        console.print(f"sun called {calls} x a second: {trips:.3g} defocus a heliostat and day")
    return found


if __name__ == "__main__":
    main()
