"""Compare Malan's pitch of the target search with ours: how many beams are found, and how soon.

``python malan_search.py``. He steps by half of the target's side (appendix E.2); a visit here steps
by 0.7 of it. Both spirals reach equally far: his has 48 aims, ours 24. A beam misses its aim in a
random direction; it is drawn on the target at every aim of the spiral, as far as it falls there,
and the product's own reading decides whether the photograph shows light.

An aim takes ``LOOK``: the drives move, the mirror comes to rest, the camera takes a photograph.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray
from heliotrope.imaging.frame import Frame
from heliotrope.imaging.photograph import read_crop
from heliotrope.plant.schedule import Settings
from heliotrope.plant.visits.photographs import spiral
from heliotrope.plant.visits.settings import Centring

#: Pitch, as a share of the target's side, and aims beside the middle: his, and ours.
SEARCHES = {"Malan": (0.5, 48), "ours": (Centring().pitch, Centring().most)}
#: Diameters of beams, as a share of the target's side. A mirror of 0.3 m at 40 m has 0.33 on his
#: target of 2 m, one of 2.5 m at 365 m has 0.5 on a target of 12 m.
BEAMS = (0.2, 0.33, 0.5, 0.8)
#: Rings of misses, as shares of the side: on the target, beside it, and to the edge of the reach.
MISSES = (0.0, 0.5, 1.0, 1.5, 1.9)
#: Time of an aim, s, as the schedule plans it.
LOOK = float(Settings().look or 0.0)
#: Side of the target, m, and of its picture, px; light of the target and of a beam, of 255.
SIDE, PIXELS, AMBIENT, LIGHT = 8.0, 160, 60.0, 90.0
#: Step of the places of a beam that are read, as a share of the side, and the farthest one.
STEP, FAR = 0.1, 1.2
#: Beams of each ring.
DRAWN = 4000

_TARGET = Target(
    "t",
    0.5 * SIDE * np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]]),
    np.zeros(3),
)


@dataclass(frozen=True)
class Found:
    """The result of a search for beams of one diameter and one ring of misses.

    Attributes
    ----------
    share
        Beams that were found, of all.
    looks
        Photographs of a beam that was found, on average.
    """

    share: float
    looks: float


def photograph(right: float, up: float, diameter: float, rng: np.random.Generator) -> Frame:
    """Return a picture of the target with a beam; all in shares of its side."""
    places = (np.arange(PIXELS) + 0.5) / PIXELS - 0.5
    away = np.hypot(places[None, :] - right, places[::-1, None] - up)
    # A disk with a soft edge: the sun's image is blurred by the slopes of the mirror.
    disk = 1.0 / (1.0 + np.exp((away - 0.5 * diameter) / (0.05 * diameter)))
    values = AMBIENT + LIGHT * disk + rng.normal(0.0, 1.0, disk.shape)
    return Frame(np.clip(np.round(values), 0, 255).astype(np.uint8))


def visible(diameter: float, rng: np.random.Generator) -> np.ndarray:
    """Return where a beam is read as light, by steps right and up from the middle, (n, n)."""
    steps = np.arange(0.0, FAR + 0.5 * STEP, STEP)
    found = np.zeros((len(steps), len(steps)), dtype=np.bool_)
    for i, right in enumerate(steps):
        for j, up in enumerate(steps[: i + 1]):
            read = read_crop(photograph(right, up, diameter, rng), _TARGET).readings[0]
            found[i, j] = found[j, i] = bool(read.spots)
    return found


def search(misses: FloatArray, pitch: float, most: int, seen: np.ndarray) -> Found:
    """Search for beams that miss their aims by ``misses``, shares of the side, (N, 2)."""
    looks = np.full(len(misses), np.inf)
    for k, place in enumerate([(0, 0), *spiral(most)]):
        at = np.abs(misses + pitch * np.array(place))
        step = np.round(at / STEP).astype(np.int64)
        near = (step < len(seen)).all(axis=1)
        lit = np.zeros(len(misses), dtype=np.bool_)
        lit[near] = seen[step[near, 0], step[near, 1]]
        looks[lit & np.isinf(looks)] = k + 1
    found = np.isfinite(looks)
    return Found(float(found.mean()), float(looks[found].mean()) if found.any() else float("nan"))


def results(
    beams: Sequence[float] = BEAMS, drawn: int = DRAWN
) -> dict[tuple[float, float], dict[str, Found]]:
    """Return the result of both searches, by diameter and by the outer edge of the ring."""
    made = {}
    for diameter in beams:
        rng = np.random.default_rng(34)
        seen = visible(diameter, rng)
        for least, most in pairwise(MISSES):
            far, turn = rng.uniform(least, most, drawn), rng.uniform(0.0, 2.0 * np.pi, drawn)
            misses = far[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
            made[diameter, most] = {
                name: search(misses, pitch, aims, seen) for name, (pitch, aims) in SEARCHES.items()
            }
    return made


def main() -> dict[tuple[float, float], dict[str, Found]]:
    """Print both searches, beam by beam; return their results."""
    made = results()
    for name, (pitch, aims) in SEARCHES.items():
        print(
            f"{name}: pitch {pitch:g} of the side, {aims} aims, {aims * LOOK / 60.0:.0f} min whole"
        )
    for (diameter, miss), both in made.items():
        line = "; ".join(
            f"{name} {100.0 * one.share:.1f} % found after {LOOK * one.looks:.0f} s"
            for name, one in both.items()
        )
        print(f"beam of {diameter:g}, miss up to {miss:g} sides: {line}")
    worst = {name: min(one[name].share for one in made.values()) for name in SEARCHES}
    time = {
        name: LOOK * float(np.mean([one[name].looks for one in made.values()])) for name in SEARCHES
    }
    print(
        "all: "
        + "; ".join(
            f"{name} at least {100.0 * worst[name]:.1f} % found, after {time[name]:.0f} s"
            for name in SEARCHES
        )
    )
    return made


if __name__ == "__main__":
    main()
