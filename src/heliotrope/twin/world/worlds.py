"""Environments (worlds) that a run adds to the usual environment, and initial errors."""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from heliotrope.errors import InputError
from heliotrope.mechanism.board_items import items_of, packed
from heliotrope.mechanism.machine import Stepping
from heliotrope.sun import Site
from heliotrope.twin.boards.outfit import MACHINE, Outfit

#: Everything that a run may add, with its meaning.
WORLDS = {
    "calm": "people rarely take mirrors off the receiver",
    "swarm": "each run draws its own weights of faults and of people's actions",
    "clock": "the clock of a cluster is wrong from the start, by a minute to an hour",
    "site": "the site of a cluster is wrong by up to 2.5 degrees of longitude or latitude",
    "addresses": "two boards of a cluster have exchanged addresses",
    "frozen": (
        "the programs of clusters and of the plant freeze for seconds to minutes, then continue"
    ),
    "disk": "the disk of the plant's records is slow now and then",
    "place": (
        "date, hour, site, field and keep-out volumes are drawn; the volumes lie across the "
        "beams' paths"
    ),
    "sensors": "wind and flux are measured, by sensors that sometimes give false readings",
    "parameters": "boards store wrong parameters from the start",
    "tour": (
        "nothing fails, and each heliostat is taken through all commands, and must carry them out"
    ),
    "calibrations": "people and beliefs change parameters, correctly or wrongly",
    "twice": "a second plant with the same keys runs for a while, on the same lines",
    "visits": "automatic control raises and calibrates the field, by photographs that may mislead",
    "day": (
        "automatic control meets the sun's elevation limit in the morning or evening, at any site"
    ),
    "lights": (
        "as visits; stray lights stay on the targets for minutes, and most visits do not "
        "search for a beam"
    ),
    "parties": "as visits, by the plant's own schedule: many at once on a target and the receiver",
    "repairs": "boards, files and stores are replaced by wrong ones, drives stall, people lock",
    "common": "plant and clusters begin with the same wrong time, which a sun sensor contradicts",
    "limit": "automatic control aims under a flux limit, and often a ramp, while clouds pass",
    "days": "as parties, from morning to evening stow: several people act at any stage of a visit",
}
#: A short working day, and its length, s.
DAYS, DAY = "days", 840.0
#: Boards, files and stores are exchanged; plant and clusters share a wrong time.
REPAIRS, COMMON = "repairs", "common"
#: Worlds in which only their own faults occur.
OWN_FAULTS = frozenset({DAYS, REPAIRS})
#: Automatic control under a flux limit, and its minimum numbers of heliostats: without and with a
#: ramp, along which single beams must be small steps.
LIMIT, LIMITED, CLIMBING = "limit", 4, 8
#: Worlds with automatic control.
WORKING = ("visits", "day", "lights", "parties", LIMIT, DAYS)
#: Fraction of these runs whose receiver may be heated only along a ramp.
_RAMPED = 0.5
#: Worlds with joint visits and receiver visits, and their minimum number of heliostats.
PARTIES, PARTY = ("parties", DAYS), 6
#: Worlds in which site, date, hour, and places are drawn.
DRAWN = ("place", "day")
#: Factor on the time between faults in runs with automatic control, because a visit takes a minute,
#: and most events of a day are actions of operators.
_SELDOM, _SELDOM_BY_DAY = 4.0, 50.0
#: Factor on the time between faults in runs with repairs, which take longer.
_REPAIRED = 2.0
#: Name by which each run draws its worlds; see `mixed`.
ANY = "any"
#: Worlds from which `mixed` chooses.
MIX = (
    "calm", "swarm", "frozen", "disk", "place", "sensors", "parameters", "calibrations",
    "twice",
    "visits", "day",
)  # fmt: skip
#: Worlds that `mixed` adds, each to this fraction of runs, in addition to those that it draws. A
#: cluster that is wrong from the start is detected within seconds, and its heliostats then do
#: nothing.
RARE, RARE_SHARE = ("lights", "clock", "site", "addresses", COMMON), 0.04
#: Motors with a full step of 0.5 mrad at the joint; coarse stepping uses full steps.
COARSE = Stepping((32, 32))
#: Fractions of days with motors that step coarsely, and with heliostats that are wrong in the plant
#: file; range of that error, rad of the mirror.
_COARSE_DAYS, _UNSURVEYED, _BESIDE = 1.0 / 3.0, 1.0 / 3.0, (0.018, 0.022)
#: Fraction of the days on which a mirror is covered, so that it reflects no light.
_COVERED = 0.25
#: Fraction of the runs of `mixed` that are only a working day; about the same for repairs, and for
#: a flux limit.
ALONE_SHARE = 0.1


def checked(worlds: Sequence[str]) -> None:
    """Check that the names of worlds are known.

    Raises
    ------
    InputError
        If a name is unknown.
    """
    for name in worlds:
        if name not in WORLDS:
            raise InputError(f"world {name!r} is not known; known: {', '.join(WORLDS)}")


def mixed(seed: int) -> tuple[str, ...]:
    """Return worlds drawn from a seed.

    These are some of `MIX`, rarely with a world of `RARE`, or a single world.
    """
    for alone in (DAYS, REPAIRS, LIMIT):
        if random.Random(f"{alone} {seed}").random() < ALONE_SHARE:
            return (alone,)
    chance = random.Random(f"worlds {seed}")
    share = chance.choice([0.0, 0.2, 0.5, 0.8])
    worlds = [name for name in MIX if chance.random() < share]
    worlds += [name for name in RARE if random.Random(f"{name} {seed}").random() < RARE_SHARE]
    # Automatic control of a second plant is not judged.
    return tuple(name for name in worlds if name != "twice" or not works(worlds))


#: Weights of the operators' actions during repairs: with frequent emergencies, and for operators
#: who leave heliostats up for a while.
_REPAIRING = (60, 14, 2, 6, 2, 2, 2, 3, 1)
_REPAIRING_CALMLY = (60, 10, 1, 1.5, 0.3, 0.3, 2, 2, 1)


@dataclass(frozen=True)
class Habits:
    """The actions of simulated operators, and their rates.

    Attributes
    ----------
    pause
        Mean time between two actions, s.
    weights
        Weights of the operators' actions: advance a heliostat, command all heliostats, push
        parameters, call an emergency, order one heliostat off, lock one, issue a command without
        authority, hand over the authority, aim at a keep-out volume.
    idle
        Whether the operators order IDLE for all heliostats; heliostats at stow then stay in IDLE.
    calibrates
        Fraction of the actions that change parameters, in addition to those of every run.
    locks
        Fraction of the operators' actions that lock a heliostat, remove a lock, write to a locked
        heliostat, or repair a board.
    """

    pause: float = 2.0
    weights: tuple[float, ...] = (60, 14, 8, 4, 2, 3, 5, 4, 4)
    idle: bool = True
    calibrates: float = 0.0
    locks: float = 0.0

    @classmethod
    def of(cls, worlds: Sequence[str], seed: int) -> "Habits":
        """Return the operators' habits in a run."""
        if REPAIRS in worlds:
            calm = "calm" in worlds
            return cls(2.0, _REPAIRING_CALMLY if calm else _REPAIRING, locks=0.02 if calm else 0.5)
        calibrates = 0.15 if "calibrations" in worlds else 0.0
        habits = cls(calibrates=calibrates)
        if "calm" in worlds:
            habits = cls(4.0, (60, 10, 2, 0.2, 0.3, 0.3, 2, 2, 4), False, calibrates)
        if "swarm" not in worlds:
            return habits
        chance = random.Random(f"habits {seed}")
        scales = [chance.choice([0.0, 0.1, 1.0, 1.0, 3.0]) for _ in habits.weights[1:]]
        weights = [w * s for w, s in zip(habits.weights[1:], scales, strict=True)]
        pause = chance.choice([1.0, 2.0, 5.0])
        return replace(habits, pause=pause, weights=(habits.weights[0], *weights))


def weights_of(worlds: Sequence[str], seed: int, weights: Mapping[str, float]) -> dict[str, float]:
    """Return the weights of the kinds of faults of a run, which are not all 0."""
    if "swarm" not in worlds:
        return dict(weights)
    chance = random.Random(f"weights {seed}")
    scaled = {k: w * chance.choice([0.0, 0.0, 0.3, 1.0, 3.0]) for k, w in weights.items()}
    return scaled if any(scaled.values()) else dict(weights)


def pause_of(worlds: Sequence[str], seed: int, pause: float) -> float:
    """Return the mean time between two faults of a run, s."""
    if works(worlds):
        pause *= _SELDOM_BY_DAY if DAYS in worlds else _SELDOM
    if REPAIRS in worlds:
        pause *= _REPAIRED
    if "swarm" not in worlds:
        return pause
    return pause * random.Random(f"pause {seed}").choice([0.5, 1.0, 3.0, 10.0])


def works(worlds: Sequence[str]) -> bool:
    """Return whether automatic control works in a run."""
    return not set(worlds).isdisjoint(WORKING)


def ramped(seed: int) -> bool:
    """Return whether the flux limit of a run has a ramp."""
    return random.Random(f"ramp {seed}").random() < _RAMPED


def joint_visits(worlds: Sequence[str]) -> bool:
    """Return whether several heliostats are measured at once in a run."""
    return not set(worlds).isdisjoint(PARTIES)


def measured(worlds: Sequence[str]) -> bool:
    """Return whether wind and flux sensors supply a run's plant with readings."""
    return not {"sensors", DAYS}.isdisjoint(worlds)


def length_of(worlds: Sequence[str], hours: float | None) -> float:
    """Return the duration of a run, s.

    It is ``hours`` if specified, otherwise a day for "days" and 0.1 h for all other worlds.
    """
    if hours is not None:
        return 3600.0 * hours
    return DAY if DAYS in worlds else 360.0


def drawn(worlds: Sequence[str]) -> bool:
    """Return whether the site, date, hour and heliostat positions of a run are drawn at random."""
    return not set(worlds).isdisjoint(DRAWN)


def knows_boards(worlds: Sequence[str]) -> bool:
    """Return whether a run's plant knows what every board should store, as a real plant does."""
    return works(worlds) or not {"parameters", "calibrations", REPAIRS}.isdisjoint(worlds)


def stored_by(fits: Sequence[Outfit], worlds: Sequence[str], seed: int) -> list[Outfit]:
    """Return heliostats with the items that their boards store at the start.

    In the world "parameters" half of the boards store wrong items: another heliostat's items, their
    own items with a small to gross error, or limits that are too narrow. If addresses are swapped,
    no board stores another heliostat's items, because a board with the address and the armature of
    another heliostat is indistinguishable from that heliostat's board, except by a photograph.
    """
    if "parameters" not in worlds:
        return list(fits)
    chance = random.Random(f"parameters {seed}")
    others = [] if "addresses" in worlds else fits
    return [
        replace(fit, items={**fit.items, **wrong_items(fit, others, chance)})
        if chance.random() < 0.5
        else fit
        for fit in fits
    ]


def motors_of(fits: Sequence[Outfit], worlds: Sequence[str], seed: int) -> list[Outfit]:
    """Return heliostats with their motors, which make coarse steps on one day in three."""
    coarse = DAYS in worlds and random.Random(f"motors {seed}").random() < _COARSE_DAYS
    if not coarse:
        return list(fits)
    stepping = items_of(fits[0].mechanism, replace(MACHINE, stepping=COARSE))["stepping"]
    return [
        replace(
            fit,
            machine=replace(fit.machine, stepping=COARSE),
            items={**fit.items, "stepping": stepping},
        )
        for fit in fits
    ]


def surveyed(fits: Sequence[Outfit], worlds: Sequence[str], seed: int) -> list[Outfit]:
    """Return heliostats as the plant file has them, with three wrong on one day in three.

    At 80 m and beyond, the beams of the wrong heliostats miss the targets, so that no photograph
    shows them.
    """
    chance = random.Random(f"survey {seed}")
    if DAYS not in worlds or chance.random() >= _UNSURVEYED:
        return list(fits)
    believed = list(fits)
    for i in chance.sample(range(len(fits)), 3):
        fit, size = fits[i], chance.choice([-1.0, 1.0]) * chance.uniform(*_BESIDE)
        causes = {**fit.causes, "canting": fit.causes["canting"] + size}
        mechanism = fit.with_causes(causes)
        items = {**fit.items, **items_of(mechanism, fit.machine)}
        believed[i] = replace(fit, causes=causes, mechanism=mechanism, items=items)
    return believed


def covered_by(names: Sequence[str], worlds: Sequence[str], seed: int) -> frozenset[str]:
    """Return the heliostats with covered mirrors: one heliostat on one day in four."""
    chance = random.Random(f"covers {seed}")
    if DAYS not in worlds or chance.random() >= _COVERED:
        return frozenset()
    return frozenset({chance.choice(list(names))})


def wrong_items(fit: Outfit, others: Sequence[Outfit], chance: random.Random) -> dict[str, bytes]:
    """Return wrong items for a heliostat, or another heliostat's position and armature."""
    what = chance.choice([*(["another"] if others else []), "armature", "biases", "machine"])
    if what == "another":
        other = items_of(chance.choice(list(others)).mechanism)
        return {name: other[name] for name in ("location", "armature")}
    size = chance.choice([1e-3, 5e-3, 30e-3])
    if what == "armature":
        causes = {k: v + chance.gauss(0.0, size) for k, v in fit.causes.items()}
        return {"armature": items_of(fit.with_causes(causes))["armature"]}
    if what == "biases":
        return {"biases": packed("biases", (chance.gauss(0.0, size), chance.gauss(0.0, size)))}
    return narrow_limits()


def narrow_limits() -> dict[str, bytes]:
    """Return items that give the axes a smaller range and speed than `MACHINE` does."""
    axes = tuple(
        replace(axis, low=axis.low + 1000, high=axis.high - 1000, rate=axis.rate // 2)
        for axis in MACHINE.axes
    )
    ends = ("primary", "secondary")
    return {
        f"limits_{end}": packed(
            f"limits_{end}", (axis.low, axis.high, axis.rate, axis.acceleration, axis.backlash)
        )
        for axis, end in zip(axes, ends, strict=True)
    }


def common_error(worlds: Sequence[str], seed: int) -> timedelta:
    """Return by how much the time shared by plant and clusters is ahead of true time, s."""
    if COMMON not in worlds:
        return timedelta()
    chance = random.Random(f"{COMMON} {seed}")
    return timedelta(seconds=chance.choice([-1, 1]) * chance.choice([300.0, 600.0, 3600.0]))


class PodErrors:
    """The errors that one cluster has from the start.

    Parameters
    ----------
    worlds
        Names of `WORLDS`.
    seed
        Seed of the run.
    index
        Index of the cluster.

    Attributes
    ----------
    freezes
        Whether the cluster program may be frozen.
    shared
        Whether a second plant occasionally takes over the cluster's line.
    """

    def __init__(self, worlds: Sequence[str], seed: int, index: int) -> None:
        self._worlds = worlds
        self._name = f"{seed} {index}"
        self.freezes, self.shared = "frozen" in worlds, "twice" in worlds

    def _chance(self, world: str) -> random.Random | None:
        return random.Random(f"{world} {self._name}") if world in self._worlds else None

    def start(self, start: datetime) -> datetime:
        """Return the time at which the cluster's clock starts."""
        chance = self._chance("clock")
        if chance is None:
            return start
        error = chance.choice([-1, 1]) * chance.choice([60.0, 300.0, 600.0, 3600.0])
        return start + timedelta(seconds=error)

    def site(self, site: Site) -> Site:
        """Return the site that the cluster is configured with."""
        chance = self._chance("site")
        if chance is None:
            return site
        error = chance.choice([-1, 1]) * chance.uniform(0.5, 2.5)
        if chance.random() < 0.5:
            return replace(site, longitude_deg=site.longitude_deg + error)
        return replace(site, latitude_deg=site.latitude_deg + error)

    def addresses(self, addresses: list[int]) -> list[int]:
        """Return the addresses that the cluster is configured with."""
        chance = self._chance("addresses")
        if chance is None or len(addresses) < 2:
            return addresses
        first, second = chance.sample(range(len(addresses)), 2)
        exchanged = list(addresses)
        exchanged[first], exchanged[second] = addresses[second], addresses[first]
        return exchanged
