"""Heliostats to simulate: imperfect mechanisms with what their boards are told of them."""

import hashlib
import math
import random
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.lcu.drives import ROTARY
from heliotrope.lcu.journal import CODES_OF
from heliotrope.mechanism import kinds
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import rotary

#: Steps of a turn of a joint: 15.7 µrad a step. With 8000 steps/s a turn takes 50 s.
STEPS_PER_TURN = 400_000
#: rate (steps/s), acceleration (steps/s²), backlash (steps) of both axes.
LIMITS = (8000, 16_000, 40)
#: Azimuth looks east, the mirror up.
STOW = (100_000, 97_900)
RANGES = ((-20_000, 406_000), (-4000, 104_000))
#: Centre of the receiver, and the standby point beside it and below.
RECEIVER = (0.0, 0.0, 50.0)
STANDBY = (12.0, 0.0, 40.0)
DEFOCUS = (0.1, 0.05)
#: Middle and radius of a ball that no beam may enter; nothing leads there that is not asked for.
KEEP_OUT, KEEP_OUT_RADIUS = (-12.0, 0.0, 25.0), 2.0
#: Imperfections that are drawn.
CAUSES = ("tilt_north", "tilt_east", "canting", "non_orthogonality")
#: A cluster has no more.
MOST = 32


@dataclass(frozen=True)
class Outfit:
    """One heliostat: its name, its addresses and key, its true mechanism, its journal.

    Attributes
    ----------
    causes
        Its imperfections, by the names of parameters, rad.
    items
        What its journal holds, by name: `lcu.journal.ITEMS`.
    """

    name: str
    address: int
    serial: int
    key: bytes
    mechanism: Mechanism
    causes: dict[str, float]
    items: dict[str, bytes]


def sha256(data: bytes) -> bytes:
    """Return the hash that the boards have."""
    return hashlib.sha256(data).digest()


def outfits(count: int, seed: int = 0) -> list[Outfit]:
    """Return heliostats north of a tower at the origin, 60 to 130 m away.

    Parameters
    ----------
    count
        1 to 32.
    seed
        Of their places and imperfections.

    Raises
    ------
    InputError
        A count that no cluster has.
    """
    if not 1 <= count <= MOST:
        raise InputError(f"{count} heliostats on a bus; a cluster has 1 to {MOST}")
    chance = random.Random(seed)
    found = []
    for i in range(count):
        bearing = math.radians(-35.0 + 70.0 * (i + chance.uniform(0.2, 0.8)) / count)
        away = chance.uniform(60.0, 130.0)
        place = (away * math.sin(bearing), away * math.cos(bearing), 0.0)
        perfect = _perfect(place)
        causes = {name: chance.gauss(0.0, 3e-3) for name in CAUSES}
        mechanism = perfect.with_parameters(causes)
        address = 11 + i
        key = sha256(b"key %d" % address)
        found.append(
            Outfit(
                f"H{i + 1:02d}",
                address,
                5000 + i,
                key,
                mechanism,
                causes,
                items_of(mechanism, address),
            )
        )
    return found


def _perfect(places: npt.ArrayLike) -> Mechanism:
    """Return mechanisms without imperfections at places (..., 3)."""
    gear = {"steps_per_turn": 200, "gear_ratio": STEPS_PER_TURN / 800, "microsteps": 4}
    return kinds.azimuth_elevation(
        places, pivot_height=2.0, pivot_offset=0.2, drives=(rotary(**gear), rotary(**gear))
    )


def mechanisms(fits: Sequence[Outfit]) -> Mechanism:
    """Return the true mechanisms of heliostats as one, (N,)."""
    perfect = _perfect(np.stack([each.mechanism.position for each in fits]))
    return perfect.with_parameters(
        {name: np.array([each.causes[name] for each in fits]) for name in CAUSES}
    )


def items_of(mechanism: Mechanism, address: int) -> dict[str, bytes]:
    """Return what the journal of a board of such a heliostat holds."""
    rate = 2.0 * math.pi / STEPS_PER_TURN
    numbers: dict[str, tuple[float, ...]] = {
        "address": (address,),
        "location": tuple(float(x) for x in mechanism.position),
        "armature": tuple(float(x) for x in mechanism.armature.table),
        "stow": STOW,
        "standby": STANDBY,
        "biases": (0.0, 0.0),
        "defocus": DEFOCUS,
    }
    for i, end in enumerate(("primary", "secondary")):
        numbers[f"drive_{end}"] = (ROTARY, 0.0, rate, *(0.0,) * 8)
        numbers[f"limits_{end}"] = (*RANGES[i], *LIMITS)
    return {name: struct.pack(CODES_OF[name], *values) for name, values in numbers.items()}
