"""Simulated heliostats: imperfect mechanisms, and the items that their boards store."""

import hashlib
import math
import random
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.lcu.journal import CODES_OF
from heliotrope.mechanism import kinds
from heliotrope.mechanism.board_items import items_of
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary
from heliotrope.mechanism.machine import AxisLimits, Machine, spread_machines

#: Steps per turn of a joint: 15.7 µrad per step. At 8000 steps/s a turn takes 50 s.
STEPS_PER_TURN = 400_000
#: Rate (steps/s), acceleration (steps/s²) and backlash (steps) of both axes.
LIMITS = (8000, 16_000, 40)
#: Stow, steps: azimuth east, mirror facing up.
STOW = (100_000, 97_900)
RANGES = ((-20_000, 406_000), (-4000, 104_000))
#: Centre of the receiver, and the standby point beside and below it, ENU, m.
RECEIVER = (0.0, 0.0, 50.0)
STANDBY = (12.0, 0.0, 40.0)
DEFOCUS = (0.1, 0.05)
#: Items that the boards of `outfits` store besides their mechanisms, except the defocus spread.
MACHINE = Machine(
    (AxisLimits(*RANGES[0], *LIMITS), AxisLimits(*RANGES[1], *LIMITS)), STOW, DEFOCUS, STANDBY
)
#: Centre and radius of a sphere that no beam may enter, m; no path leads there unless ordered.
KEEP_OUT, KEEP_OUT_RADIUS = (-12.0, 0.0, 25.0), 2.0
#: Centre and radius of a ball, ENU, m.
Ball = tuple[tuple[float, float, float], float]
#: Parameters whose imperfections are drawn.
CAUSES = ("tilt_north", "tilt_east", "canting", "non_orthogonality")
#: Maximum number of heliostats in a cluster.
MOST = 32


@dataclass(frozen=True)
class Outfit:
    """One heliostat: its name, addresses, key, true mechanism and journal.

    Attributes
    ----------
    causes
        Imperfections, by parameter name, rad.
    items
        Items of the heliostat's journal, by name; see `lcu.journal.ITEMS`.
    machine
        Motor limits and rest positions.
    """

    name: str
    address: int
    serial: int
    key: bytes
    mechanism: Mechanism
    causes: dict[str, float]
    items: dict[str, bytes]
    machine: Machine = MACHINE

    def with_causes(self, causes: Mapping[str, float]) -> Mechanism:
        """Return the true mechanism with other imperfections (rad, by parameter name)."""
        return _perfect(self.mechanism.position).with_parameters(causes)

    @property
    def stow(self) -> tuple[int, int]:
        """Stow position of both axes, steps."""
        primary, secondary = struct.unpack(CODES_OF["stow"], self.items["stow"])
        return primary, secondary


def sha256(data: bytes) -> bytes:
    """Return the SHA-256 hash of some bytes, as the boards compute it."""
    return hashlib.sha256(data).digest()


def outfits(count: int, seed: int = 0, places: Sequence[tuple[float, float]] = ()) -> list[Outfit]:
    """Return heliostats north of a tower at the origin, 60 to 130 m away.

    Parameters
    ----------
    count
        1 to 32.
    seed
        Seed of positions and imperfections.
    places
        East and north of each heliostat, m; () if they are drawn at random.

    Raises
    ------
    InputError
        If there are not 1 to 32 heliostats.
    """
    if not 1 <= count <= MOST:
        raise InputError(f"a bus must have 1 to {MOST} heliostats, not {count}")
    chance = random.Random(seed)
    fits = []
    machines = spread_machines(MACHINE, [f"H{i + 1:02d}" for i in range(count)])
    for i, machine in enumerate(machines):
        bearing = math.radians(-35.0 + 70.0 * (i + chance.uniform(0.2, 0.8)) / count)
        away = chance.uniform(60.0, 130.0)
        drawn = (away * math.sin(bearing), away * math.cos(bearing))
        perfect = _perfect((*(places[i] if places else drawn), 0.0))
        causes = {name: chance.gauss(0.0, 3e-3) for name in CAUSES}
        mechanism = perfect.with_parameters(causes)
        address = 11 + i
        key = sha256(b"key %d" % address)
        fits.append(
            Outfit(
                f"H{i + 1:02d}",
                address,
                5000 + i,
                key,
                mechanism,
                causes,
                {**items_of(mechanism, machine), **own_items(address)},
                machine,
            )
        )
    return fits


def _perfect(places: npt.ArrayLike) -> Mechanism:
    """Return mechanisms without imperfections at positions (..., 3)."""
    gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
    return kinds.azimuth_elevation(
        places, pivot_height=2.0, pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear))
    )


def stow_beams(
    places: Sequence[tuple[float, float]], suns: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the vertices, (N, 1, 3), and directions, (N, S, 3), of the beams at stow.

    Parameters
    ----------
    places
        East and north of N heliostats without imperfections, m.
    suns
        Unit vectors to the sun, (S, 3).
    """
    pose = _perfect([(*place, 0.0) for place in places]).pose(np.tile(STOW, (len(places), 1)))
    normal = pose.normal[:, None]
    return pose.vertex[:, None], 2.0 * (normal @ suns.T).swapaxes(1, 2) * normal - suns


def mechanisms(fits: Sequence[Outfit]) -> Mechanism:
    """Return the true mechanisms of heliostats as one array, (N,)."""
    perfect = _perfect(np.stack([fit.mechanism.position for fit in fits]))
    return perfect.with_parameters(
        {name: np.array([fit.causes[name] for fit in fits]) for name in CAUSES}
    )


def own_items(address: int) -> dict[str, bytes]:
    """Return the items that belong to the board itself, which the plant never sends."""
    return {"address": struct.pack(CODES_OF["address"], address)}
