"""Worlds: what a run may add to the usual one, by name, and what is wrong from the start."""

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from heliotrope.errors import InputError
from heliotrope.sun import Site

#: Everything that a run may add, and its meaning.
WORLDS = {
    "calm": "persons seldom take mirrors off the receiver",
    "swarm": "each run draws its own weights of faults and of what persons do",
    "held": "mirrors that are locked, unconfigured or left elsewhere by a person are judged too",
    "clock": "the clock of a cluster is wrong from the start, by a minute to an hour",
    "site": "the site of a cluster is wrong by up to 2.5 degrees of longitude or latitude",
    "addresses": "two boards of a cluster have exchanged addresses",
}


def checked(worlds: Sequence[str]) -> None:
    """Check the names of worlds.

    Raises
    ------
    InputError
        An unknown one.
    """
    for name in worlds:
        if name not in WORLDS:
            raise InputError(f"world {name!r} is not known; known: {', '.join(WORLDS)}")


@dataclass(frozen=True)
class Habits:
    """What the simulated persons do, and how often.

    Attributes
    ----------
    pause
        Mean time between two actions, s.
    weights
        Of their actions: lead a mirror on, command all, push parameters, raise an emergency, take
        one mirror off, lock one, command without authority, change the authority, aim at a
        keep-out volume.
    idle
        Whether they command IDLE to all: heliostats at stow are stuck in it.
    """

    pause: float = 2.0
    weights: tuple[float, ...] = (60, 14, 8, 4, 2, 3, 5, 4, 4)
    idle: bool = True

    @classmethod
    def of(cls, worlds: Sequence[str], seed: int) -> "Habits":
        """Return the habits of a run."""
        calm = "calm" in worlds
        habits = cls(4.0, (60, 10, 2, 0.2, 0.3, 0.3, 2, 2, 4), idle=False) if calm else cls()
        if "swarm" not in worlds:
            return habits
        chance = random.Random(f"habits {seed}")
        scales = [chance.choice([0.0, 0.1, 1.0, 1.0, 3.0]) for _ in habits.weights[1:]]
        weights = [w * s for w, s in zip(habits.weights[1:], scales, strict=True)]
        return cls(chance.choice([1.0, 2.0, 5.0]), (habits.weights[0], *weights), habits.idle)


def weights_of(worlds: Sequence[str], seed: int, weights: Mapping[str, float]) -> dict[str, float]:
    """Return the weights of the kinds of faults of a run, not all of them 0."""
    if "swarm" not in worlds:
        return dict(weights)
    chance = random.Random(f"weights {seed}")
    found = {k: w * chance.choice([0.0, 0.0, 0.3, 1.0, 3.0]) for k, w in weights.items()}
    return found if any(found.values()) else dict(weights)


def pause_of(worlds: Sequence[str], seed: int, pause: float) -> float:
    """Return the mean time between two faults of a run, s."""
    if "swarm" not in worlds:
        return pause
    return pause * random.Random(f"pause {seed}").choice([0.5, 1.0, 3.0, 10.0])


class PodErrors:
    """What is wrong with one cluster from the start.

    Parameters
    ----------
    worlds
        Names of `WORLDS`.
    seed
        Seed of the run.
    index
        Number of the cluster.
    """

    def __init__(self, worlds: Sequence[str], seed: int, index: int) -> None:
        self._worlds = worlds
        self._name = f"{seed} {index}"

    def _chance(self, world: str) -> random.Random | None:
        return random.Random(f"{world} {self._name}") if world in self._worlds else None

    def start(self, start: datetime) -> datetime:
        """Return the time that the cluster's clock begins with."""
        chance = self._chance("clock")
        if chance is None:
            return start
        wrong = chance.choice([-1, 1]) * chance.choice([60.0, 300.0, 600.0, 3600.0])
        return start + timedelta(seconds=wrong)

    def site(self, site: Site) -> Site:
        """Return the site that the cluster is configured with."""
        chance = self._chance("site")
        if chance is None:
            return site
        wrong = chance.choice([-1, 1]) * chance.uniform(0.5, 2.5)
        if chance.random() < 0.5:
            return replace(site, longitude_deg=site.longitude_deg + wrong)
        return replace(site, latitude_deg=site.latitude_deg + wrong)

    def addresses(self, addresses: list[int]) -> list[int]:
        """Return the addresses that the cluster is configured with."""
        chance = self._chance("addresses")
        if chance is None or len(addresses) < 2:
            return addresses
        one, two = chance.sample(range(len(addresses)), 2)
        found = list(addresses)
        found[one], found[two] = addresses[two], addresses[one]
        return found
