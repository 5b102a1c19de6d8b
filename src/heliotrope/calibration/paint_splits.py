"""PAINT's four official splits of a heliostat's measurements, by sun position or season.

The rules are those of ``paint-csp`` 3.1 (``paint.data.dataset_splits``). For each heliostat they
set aside given numbers of measurements for training and for validation, and at least as many for
testing as for validation. If a heliostat has fewer measurements than PAINT requires, all numbers
are reduced in proportion. Learning here needs no validation part, so that part is used neither for
learning nor for testing. PAINT draws its clusters and samples with a different random generator, so
the balanced split follows PAINT's rule but does not pick the same measurements.
"""

from datetime import UTC, datetime

import numpy as np
import numpy.typing as npt
from scipy.cluster.vq import kmeans2
from scipy.spatial import KDTree

from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray

KINDS = ("azimuth", "solstice", "balanced", "high-variance")
#: Numbers of measurements for training and for validation if a heliostat has enough of them.
TRAINING, VALIDATION = 100, 30
#: Number of neighbours whose mean distance measures how isolated a measurement is.
NEIGHBOURS = 3

Rows = npt.NDArray[np.intp]


def paint_split(
    sightings: Sightings, kind: str, seed: int = 0
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Return two masks (M,), of the training and of the test sightings.

    Parameters
    ----------
    sightings
        Sightings of the sun by any number of heliostats.
    kind
        "azimuth": train in the west, validate in the east, test in between. "solstice": train on
        the sightings nearest to the winter solstice, validate on those nearest to the summer
        solstice, test in between. "balanced": take one sighting for validation and one for testing
        from each of as many clusters of sun positions, and train on the rest. "high-variance":
        validate and test where sun positions are sparse, train where they are dense.
    seed
        Seed of the balanced split.
    """
    training = np.zeros(len(sightings), dtype=np.bool_)
    tested = training.copy()
    for heliostat in np.unique(sightings.heliostat):
        rows = np.flatnonzero(sightings.heliostat == heliostat)
        rows = rows[np.argsort(sightings.time[rows], kind="stable")]
        share = min(1.0, len(rows) / (TRAINING + 2 * VALIDATION))
        counts = (int(share * TRAINING), max(1, int(share * VALIDATION)))
        if len(rows) < counts[0] + 2 * counts[1] or counts[0] < 1:
            training[rows] = True
            continue
        sun = sightings.source[rows]
        # Azimuth from the south, positive to the east, as in PAINT.
        azimuth = np.degrees(np.arctan2(sun[:, 0], -sun[:, 1]))
        place = np.c_[azimuth, np.degrees(np.arcsin(np.clip(sun[:, 2], -1.0, 1.0)))]
        if kind == "azimuth":
            parts = _ends(azimuth, -azimuth, counts)
        elif kind == "solstice":
            time = sightings.time[rows]
            parts = _ends(_from_solstice(time, 12), _from_solstice(time, 6), counts)
        elif kind == "balanced":
            rng = np.random.default_rng((seed, int(heliostat)))
            parts = _balanced(place, counts, rng)
        else:
            parts = _lonely(place, counts)
        training[rows[parts[0]]] = True
        tested[rows[parts[1]]] = True
    return training, tested


def _ends(first: FloatArray, last: FloatArray, counts: tuple[int, int]) -> tuple[Rows, Rows]:
    """Return the training and the test indices.

    Training takes the smallest values of ``first``, validation the smallest of ``last``, and
    testing the rest.
    """
    training = np.argsort(first, kind="stable")[: counts[0]]
    validation = np.argsort(last, kind="stable")[: counts[1]]
    everything = np.arange(len(first))
    tested = np.setdiff1d(everything, np.union1d(training, validation))
    return np.setdiff1d(training, validation), tested


def _from_solstice(time: FloatArray, month: int) -> FloatArray:
    """Return the seconds to the nearest 21st of a month, noon UTC; infinity at an unknown time."""
    known = time[np.isfinite(time)]
    years = sorted({datetime.fromtimestamp(t, UTC).year for t in known}) or [2000]
    noons = [
        datetime(year, month, 21, 12, tzinfo=UTC).timestamp()
        for year in range(years[0] - 1, years[-1] + 2)
    ]
    apart = np.abs(time[:, None] - np.array(noons)).min(axis=1)
    return np.asarray(np.nan_to_num(apart, nan=np.inf))


def _balanced(
    place: FloatArray, counts: tuple[int, int], rng: np.random.Generator
) -> tuple[Rows, Rows]:
    _, cluster = kmeans2(place, counts[1], minit="++", seed=rng, missing="warn")
    validation, tested = [], []
    for label in np.unique(cluster):
        members = rng.permutation(np.flatnonzero(cluster == label))
        validation.append(members[0])
        tested += list(members[1:2])
    pool = rng.permutation(np.setdiff1d(np.arange(len(place)), [*validation, *tested]))
    # A cluster of one sighting yields no test sighting; one is taken from the pool instead.
    missing = max(0, counts[1] - len(tested))
    tested += list(pool[:missing])
    return pool[missing : missing + counts[0]], np.array(tested, dtype=np.intp)


def _lonely(place: FloatArray, counts: tuple[int, int]) -> tuple[Rows, Rows]:
    near = min(NEIGHBOURS, len(place) - 1)
    distance, _ = KDTree(place).query(place, k=near + 1)
    order = np.argsort(-np.asarray(distance)[:, 1:].mean(axis=1), kind="stable")
    many = counts[1]
    return order[2 * many : 2 * many + counts[0]], order[many : 2 * many]
