"""Faults of a simulated run, drawn from a seed as a list.

A fault is data: kind, time, duration, heliostat, severity. The same seed yields the same list. A
list that violates an invariant is reduced by omitting faults (`shrunk`).
"""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from heliotrope.errors import InputError
from heliotrope.lcu import ticks
from heliotrope.twin.world.worlds import OWN_FAULTS, pause_of, weights_of

#: Everything that can go wrong: kind, weight in the random draw, and meaning.
KINDS = {
    "line_cut": (3, "plant and cluster cannot hear each other"),
    "line_one_way": (1, "one of them cannot hear the other"),
    "line_drop": (2, "the connection breaks and both notice"),
    "line_bad": (3, "messages are lost, doubled, overtaken, damaged, delayed"),
    "plant_silent": (2, "the plant freezes"),
    "plant_crash": (3, "the plant crashes and restarts later"),
    "audit_full": (2, "the disk of the plant's records is full"),
    "nobody_there": (1, "nobody renews the command authority"),
    "cluster_crash": (3, "the cluster crashes and restarts later"),
    "bus_bad": (6, "frames are lost, damaged, doubled, delayed, late"),
    "bus_stuck": (2, "a transmitter blocks the bus"),
    "bus_unplugged": (1, "the cluster's adapter is unplugged"),
    "power_cut": (6, "a board loses its supply at any instant"),
    "brown_out": (2, "a board loses its supply with a warning"),
    "flash_cut": (8, "a board loses its supply in the middle of its next flash write"),
    "tick_jump": (3, "a board's counter jumps"),
    "time_jump": (4, "the cluster's time jumps"),
    "time_lost": (2, "the cluster has no reliable time"),
    "replay": (8, "a recorded frame is sent again"),
    "forgery": (6, "an intruder without authority or key sends commands"),
    "stranger_safe": (3, "an intruder sends DEFOCUS or STOW"),
    "noise": (4, "an intruder sends noise"),
}
#: Faults that occur only in some worlds, by name of the world.
KINDS_OF_WORLDS = {
    "frozen": {
        "cluster_frozen": (8, "the cluster's program freezes, then continues"),
        "plant_frozen": (4, "the plant's program freezes, then continues"),
    },
    "twice": {"plant_twice": (8, "a second plant with the same keys runs")},
    "disk": {"disk_slow": (10, "the disk of the plant's records is slow")},
    "days": {
        "plant_crash": (6, "the plant crashes and restarts later"),
        "cluster_crash": (2, "the cluster crashes and restarts later"),
        "gust": (2, "a gust passes"),
        "sensor_silent": (2, "a sensor gives no reading"),
        "sensor_jumps": (1, "a sensor jumps"),
    },
    "repairs": {
        "board_exchanged": (6, "a spare board with another mirror's parameters is installed"),
        "cluster_file": (
            4,
            "a cluster restarts with a file in which a mirror is missing or has a different name",
        ),
        "plant_file": (2, "the plant restarts with another stow position in its file"),
        "plant_restored": (3, "the plant restarts with a backup of its store"),
        "stall": (3, "the motors of a mirror stall"),
        "plant_crash": (5, "the plant crashes and restarts later"),
        "cluster_crash": (2, "the cluster crashes and restarts later"),
        "line_cut": (1, "plant and cluster cannot hear each other"),
        "power_cut": (2, "a board loses its supply at any instant"),
    },
    "sensors": {
        "sensor_stuck": (3, "a sensor repeats its last value for ever"),
        "sensor_jumps": (2, "a sensor jumps"),
        "sensor_silent": (3, "a sensor gives no reading"),
        "sensor_nan": (2, "a sensor gives something that is not a number"),
        "gust": (2, "a gust passes"),
    },
}
#: Longest duration of a fault, s.
_LONGEST = {
    "line_cut": 60.0, "line_one_way": 60.0, "line_bad": 60.0, "plant_silent": 60.0,
    "plant_crash": 40.0, "audit_full": 40.0, "nobody_there": 60.0,
    "cluster_crash": 40.0, "bus_bad": 60.0, "bus_stuck": 40.0, "bus_unplugged": 30.0,
    "power_cut": 20.0, "brown_out": 20.0, "flash_cut": 5.0, "time_lost": 60.0,
    "sensor_stuck": 60.0, "sensor_jumps": 30.0, "sensor_silent": 60.0, "sensor_nan": 60.0,
    "cluster_frozen": 90.0, "plant_frozen": 90.0, "disk_slow": 60.0,
    "plant_twice": 60.0,
    "board_exchanged": 120.0, "cluster_file": 90.0, "plant_file": 20.0, "plant_restored": 20.0,
    "stall": 60.0,
}  # fmt: skip
#: Time after which a heliostat that is cut off must be at stow, s.
_LONG = 330.0


@dataclass(frozen=True)
class Fault:
    """One fault.

    Attributes
    ----------
    kind
        One of `KINDS`.
    at, lasts
        Start, in s since the beginning of the run; duration, s (0 for an instantaneous fault).
    target
        Index of the heliostat, for faults of a single heliostat.
    size
        Severity, 0 to 1; each kind interprets it in its own way.
    """

    kind: str
    at: float
    lasts: float
    target: int
    size: float

    def __str__(self) -> str:
        what = f"{self.at:9.3f} s  {self.kind} for {self.lasts:.2f} s"
        return f"{what}, of {self.target}, size {self.size:.3f}"


def drawn(
    seed: int,
    seconds: float,
    heliostats: int,
    *,
    pause: float = 12.0,
    only: Sequence[str] = (),
    worlds: Sequence[str] = (),
) -> list[Fault]:
    """Return the faults of a run, sorted by time.

    Parameters
    ----------
    seed
        Seed of the draw.
    seconds
        Length of the run, s.
    heliostats
        Number of possible targets.
    pause
        Mean time between faults, s.
    only
        Kinds to draw from; () for all.
    worlds
        Names of `worlds.WORLDS`: some worlds add kinds of faults, and "swarm" draws the weights and
        the pause of this run at random.

    Raises
    ------
    InputError
        If a kind is unknown, or the pause is not above 0.
    """
    others = {k: v for kinds in KINDS_OF_WORLDS.values() for k, v in kinds.items()}
    known = KINDS | {k: v for k, v in others.items() if k not in KINDS}
    for kind in only:
        if kind not in known:
            raise InputError(f"fault {kind!r} is not known; known: {', '.join(known)}")
    if not pause > 0.0:
        raise InputError(f"the pause between faults must be above 0, not {pause} s")
    chance = random.Random(f"faults {seed}")
    possible = {} if not OWN_FAULTS.isdisjoint(worlds) else dict(KINDS)
    for world in worlds:
        possible |= KINDS_OF_WORLDS.get(world, {})
    kinds = list(only) or list(possible)
    weighed = weights_of(worlds, seed, {kind: possible.get(kind, known[kind])[0] for kind in kinds})
    weights = [weighed[kind] for kind in kinds]
    pause = pause_of(worlds, seed, pause)
    faults: list[Fault] = []
    at = chance.expovariate(1.0 / pause)
    while at < seconds:
        kind = chance.choices(kinds, weights)[0]
        longest = _LONGEST.get(kind, 0.0)
        lasts = longest * chance.random() ** 3
        if longest > 20.0 and chance.random() < 0.03:
            lasts = _LONG
        faults.append(Fault(kind, at, lasts, chance.randrange(heliostats), chance.random()))
        at += chance.expovariate(1.0 / pause)
    return faults


def tick_jump(size: float) -> int:
    """Return a jump of a tick counter, ms: small, large, or up to half its period."""
    chance = random.Random(f"jump {size}")
    return chance.choice(
        [-1, 1, -900, 3000, -5000, 40_000, 10**6, -(10**7), ticks.HALF - 1, -ticks.HALF + 1]
    )


def time_jump(size: float) -> float:
    """Return a jump of the cluster's time, s, which ranges from less than a second to years."""
    chance = random.Random(f"jump {size}")
    return chance.choice([-0.4, 0.4, -1.5, 2.5, -4.0, 7.0, -30.0, 100.0, -3600.0, 86400.0, -3e7])


def disk_delay(size: float) -> float:
    """Return the time that a slow disk takes for each piece of work, s."""
    return random.Random(f"disk {size}").choice([0.05, 0.3, 1.0, 2.5, 20.0])


def shrunk(
    faults: Sequence[Fault], fails: Callable[[list[Fault]], bool], most: int = 200
) -> list[Fault]:
    """Return fewer faults that still fail: delta debugging (Zeller and Hildebrandt 2002, ddmin).

    Parameters
    ----------
    faults
        Faults with which a run fails.
    fails
        Function that returns whether a run with the given faults fails.
    most
        Maximum number of runs.
    """
    remaining, parts, spent = list(faults), 2, 0
    if spent < most and remaining and fails([]):
        return []
    while len(remaining) >= 2 and spent < most:
        size = -(-len(remaining) // parts)
        for start in range(0, len(remaining), size):
            rest = remaining[:start] + remaining[start + size :]
            spent += 1
            if rest and fails(rest):
                remaining, parts = rest, max(2, parts - 1)
                break
            if spent >= most:
                break
        else:
            if size == 1:
                break
            parts = min(len(remaining), 2 * parts)
    return remaining
