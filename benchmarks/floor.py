"""The floor of `evaluate` on Jülich's real measurements: the least error that the data allow.

What a mirror does between its sightings is drawn anew: noise of a photograph, motion within hours,
creep, steps. Their covariance is learnt from all sightings. An oracle that knows it exactly
predicts the held-out sightings from the training part as well as is possible at all: its errors are
drawn here. Beside it stand the learner on measurements that are drawn from the same covariance,
constants at the bound of Cramér and Rao, and the differences of pairs of sightings, which show
whether the covariance is the real one. Needs the data (HELIOTROPE_DATA).
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from benchmarks._run import Result, Row
from benchmarks.splits import ENOUGH, FEW, _data
from heliotrope.calibration.evaluation import Split, partition
from heliotrope.calibration.fit.residuals import frame, linearise
from heliotrope.calibration.learn import Learned, assess, drift, learn
from heliotrope.calibration.learn.drift import Hyperparameters, Linear
from heliotrope.calibration.learn.learned import moved_by
from heliotrope.calibration.learn.sequential import predict_by_stream
from heliotrope.calibration.sightings import Sightings, of_measurements, ray_directions
from heliotrope.field.formats import measurements, paint
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.parameters import MODELS

Mask = npt.NDArray[np.bool_]

SPLITS: tuple[Split, ...] = ("random", "sequential", "chronological", "neighbour", "azimuth")
#: Upper edges of the times between two sightings of a mirror, days, and their names.
APART = (15 / 1440, 1 / 24, 0.25, 1.0, 7.0, 30.0, np.inf)
NAMES = ("15 min", "1 h", "6 h", "1 day", "1 week", "1 month", "longer")
#: Draws of errors, and of whole sets of measurements that are learnt from.
DRAWS, SETS = 400, 3


@dataclass(frozen=True)
class Mirror:
    """One heliostat under the covariance that was learnt from all of its sightings.

    Attributes
    ----------
    hyper, data
        See `drift`; the outliers are left out.
    rows
        Rows of the sightings, (n,).
    beam
        Turns a whitened residual into a beam error, (n, 2, 2).
    constant
        What its constants, regimes and steps explain of the values, (n, 2).
    """

    hyper: Hyperparameters
    data: Linear
    rows: npt.NDArray[np.intp]
    beam: FloatArray
    constant: FloatArray

    def covariance(self, **changed: object) -> FloatArray:
        """Return the covariance of the values, (2 n, 2 n), with some hyperparameters changed."""
        return drift.covariance(replace(self.hyper, **changed), self.data)  # type: ignore[arg-type]

    @property
    def wander(self) -> FloatArray:
        """The covariance of what the constants leave: drift and noise."""
        nothing = np.zeros_like(self.hyper.amplitude)
        return self.covariance() - self.covariance(amplitude=nothing, noise=0.0)

    def of_visit(self, *, moves: bool) -> FloatArray:
        """Return the covariance of what is drawn anew, (n, 2, 2): noise, and motion in hours."""
        h = self.hyper
        hours = np.array([p.group == "hours" for p in h.processes]) & moves
        only = replace(h, amplitude=np.where(hours, h.amplitude, 0.0))
        whole = drift.covariance(only, self.data)
        whole = whole - drift.covariance(
            replace(h, amplitude=0.0 * h.amplitude, noise=0.0), self.data
        )
        n = len(self.rows)
        return np.einsum("iaib->iab", whole.reshape(n, 2, n, 2))


def _mirrors(learned: Learned) -> list[Mirror]:
    found, seen = [], learned.sightings
    at, _ = learned.parameters_at(seen.heliostat, seen.time)
    moved = moved_by(learned.mechanism, seen.heliostat, learned.names, at)
    beam = linearise(moved, seen, learned.names).beam
    for i, member in enumerate(learned.members):
        rows = learned.rows[i][~learned.outlier[learned.rows[i]]]
        data = member.data
        x, _ = member.at(data.time, data.regime, wander=False)
        constant = np.einsum("nap,np->na", data.jacobian, x - data.centre)
        found.append(Mirror(member.hyper, data, rows, beam[rows], constant))
    return found


def _predicted(k: FloatArray, training: Mask, tested: Mask) -> FloatArray:
    """Return the covariance of the errors of the tested values, given those of the training."""
    a, b = np.repeat(training, 2), np.repeat(tested, 2)
    if not a.any():
        return np.asarray(k[np.ix_(b, b)])
    cross = k[np.ix_(a, b)]
    return np.asarray(k[np.ix_(b, b)] - cross.T @ np.linalg.solve(k[np.ix_(a, a)], cross))


def _in_turn(k: FloatArray, time: FloatArray, tested: Mask) -> FloatArray:
    """Return the covariances (h, 2, 2) of tested values, each given all that came before it."""
    order = np.argsort(np.nan_to_num(time, nan=-np.inf), kind="stable")
    both = np.stack([2 * order, 2 * order + 1], axis=-1).ravel()
    root = np.linalg.cholesky(k[np.ix_(both, both)])
    n = len(order)
    blocks = np.einsum("iaib->iab", root.reshape(n, 2, n, 2))
    found = np.empty((n, 2, 2))
    found[order] = blocks @ np.swapaxes(blocks, 1, 2)
    return found[tested]


def _drawn(spread: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return errors (DRAWS, h, 2): of a joint covariance (2 h, 2 h), or of each alone (h, 2, 2)."""
    values, vectors = np.linalg.eigh(spread)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    if spread.ndim == 3:
        z = rng.standard_normal((DRAWS, len(spread), 2))
        return np.einsum("hab,dhb->dha", root, z)
    return (rng.standard_normal((DRAWS, len(spread))) @ root.T).reshape(DRAWS, -1, 2)


def _medians(
    mirror: Mirror, tested: Mask, spread: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Return the median beam error of the tested sightings in each draw, rad, (DRAWS,)."""
    error = np.einsum("hab,dhb->dha", mirror.beam[tested], _drawn(spread, rng))
    return np.asarray(np.median(np.linalg.norm(error, axis=-1), axis=1))


def _floors(
    mirrors: list[Mirror],
    split: Split,
    training: Mask,
    tested: Mask,
    rng: np.random.Generator,
) -> dict[str, FloatArray]:
    """Return medians of medians in each draw, rad, (DRAWS,), by predictor."""
    each: dict[str, list[FloatArray]] = {
        "oracle": [],
        "visit": [],
        "photograph": [],
        "constants": [],
    }
    for m in mirrors:
        a, b = training[m.rows], tested[m.rows]
        if not b.any():
            continue
        k = m.covariance()
        oracle = _in_turn(k, m.data.time, b) if split == "sequential" else _predicted(k, a, b)
        each["oracle"].append(_medians(m, b, oracle, rng))
        each["visit"].append(_medians(m, b, m.of_visit(moves=True)[b], rng))
        each["photograph"].append(_medians(m, b, m.of_visit(moves=False)[b], rng))
        # Constants alone, as well known as the training part allows: the bound of Cramér and Rao.
        still = m.covariance(amplitude=0.0 * m.hyper.amplitude)
        bound = _predicted(still, a, b) - m.hyper.noise**2 * np.eye(2 * int(b.sum()))
        each["constants"].append(_medians(m, b, bound, rng))
    return {name: np.median(parts, axis=0) for name, parts in each.items()}


def _measured_again(learned: Learned, mirrors: list[Mirror], rng: np.random.Generator) -> Sightings:
    """Return the sightings with drift and noise drawn anew, as beams elsewhere on the target."""
    seen = learned.sightings
    shift = np.zeros((len(seen), 2))
    for m in mirrors:
        values, vectors = np.linalg.eigh(m.wander)
        z = rng.standard_normal(len(values)) * np.sqrt(np.maximum(values, 0.0))
        new = m.constant + (vectors @ z).reshape(-1, 2)
        shift[m.rows] = np.einsum("nab,nb->na", m.beam, new - m.data.value)
    at, _ = learned.parameters_at(seen.heliostat, seen.time)
    vertex = moved_by(learned.mechanism, seen.heliostat, learned.names, at).pose(seen.counts).vertex
    _, way = ray_directions(seen, vertex)
    slant = np.linalg.norm(seen.destination - vertex, axis=-1)
    across = np.einsum("mck,mc->mk", frame(way), shift)
    return replace(seen, destination=seen.destination + slant[:, None] * across)


def _learnt(
    learned: Learned, seen: Sightings, split: Split, training: Mask, tested: Mask
) -> tuple[float, float]:
    """Return the learner's median of medians, rad, and its coverage, from the training part."""
    found = learn(learned.mechanism, seen, learned.model, used=training)
    told = predict_by_stream(found) if split == "sequential" else None
    names = tuple(map(str, range(len(learned.members))))
    figures = assess(names, found, told, tested)
    return figures.median_of_medians, figures.coverage


def _pairs(mirrors: list[Mirror], rng: np.random.Generator) -> dict[str, float | int | str]:
    """Return the error of one sighting that pairs show, measured and drawn, by the time apart."""
    measured: dict[int, list[FloatArray]] = {k: [] for k in range(len(APART))}
    drawn: dict[int, list[FloatArray]] = {k: [] for k in range(len(APART))}
    for m in mirrors:
        n = len(m.rows)
        i, j = np.triu_indices(n, 1)
        apart = np.abs(m.data.time[i] - m.data.time[j])
        same = np.isfinite(apart) & (m.data.regime[i] == m.data.regime[j])
        i, j, which = i[same], j[same], np.searchsorted(APART, apart[same])
        # The constants are fitted to the same sightings: to the drawn ones in the same way.
        k, still = m.covariance(), m.covariance(amplitude=0.0 * m.hyper.amplitude, noise=0.0)
        keep = np.eye(2 * n) - still @ np.linalg.inv(k)
        rest = (keep @ m.data.rest(m.hyper).ravel()).reshape(n, 2)
        root = keep @ np.linalg.cholesky(k)
        copies = np.stack([(root @ rng.standard_normal(2 * n)).reshape(n, 2) for _ in range(20)])
        for one, into in ((rest[None], measured), (copies, drawn)):
            error = np.einsum("nab,dnb->dna", m.beam, one)
            away = np.linalg.norm(error[:, i] - error[:, j], axis=-1) / np.sqrt(2.0)
            for b in range(len(APART)):
                into[b].append(away[:, which == b].ravel())
    found: dict[str, float | int | str] = {}
    for b, name in enumerate(NAMES):
        a, c = np.concatenate(measured[b]), np.concatenate(drawn[b])
        if len(a):
            found[f"pairs_{name.replace(' ', '_')}"] = (
                f"{len(a):,} pairs: {1e3 * np.median(a):.2f} mrad measured, "
                f"{1e3 * np.median(c):.2f} drawn"
            )
    return found


def run(quick: bool) -> Result:
    """Return the floors of each split, or why there are none."""
    data = _data()
    columns = (
        "split", "measured_mrad", "measured_within_90", "learner_on_drawn_mrad",
        "learner_on_drawn_within_90", "oracle_mrad", "oracle_low_mrad", "oracle_high_mrad",
        "visit_mrad", "photograph_mrad", "constants_mrad",
    )  # fmt: skip
    if data is None:
        nothing: Row = dict.fromkeys(columns)
        return Result([nothing | {"split": "none"}], "skipped: HELIOTROPE_DATA is not set")
    ((_, group),) = paint.read_plant(data).groups.items()
    seen, _ = of_measurements(measurements.read_measurements(data), group)
    enough = np.flatnonzero(np.bincount(seen.heliostat, minlength=len(group)) >= ENOUGH)
    chosen = enough[:FEW] if quick else np.arange(len(group))
    kept = np.flatnonzero(np.isin(seen.heliostat, chosen))
    whole = learn(group.mechanism, seen.take(kept), MODELS["jacks"])
    everybody = _mirrors(whole)
    mirrors = [everybody[i] for i in enough if i in chosen]
    rng, seen = np.random.default_rng(26), whole.sightings
    table: list[Row] = []
    for split in SPLITS[:1] if quick else SPLITS:
        training, tested = partition(seen, split)
        real = _learnt(whole, seen, split, training, tested)
        sets = [_measured_again(whole, everybody, rng) for _ in range(1 if quick else SETS)]
        again = np.mean([_learnt(whole, one, split, training, tested) for one in sets], axis=0)
        floors = _floors(mirrors, split, training, tested, rng)
        low, high = np.quantile(floors["oracle"], (0.05, 0.95))
        table.append(
            {
                "split": split,
                "measured_mrad": 1e3 * real[0],
                "measured_within_90": real[1],
                "learner_on_drawn_mrad": 1e3 * float(again[0]),
                "learner_on_drawn_within_90": float(again[1]),
                "oracle_mrad": 1e3 * float(floors["oracle"].mean()),
                "oracle_low_mrad": 1e3 * float(low),
                "oracle_high_mrad": 1e3 * float(high),
                "visit_mrad": 1e3 * float(floors["visit"].mean()),
                "photograph_mrad": 1e3 * float(floors["photograph"].mean()),
                "constants_mrad": 1e3 * float(floors["constants"].mean()),
            }
        )
    first = table[0]
    return Result(
        table,
        f"{first['split']} split: {first['measured_mrad']:.2f} mrad, of which the data set "
        f"{first['oracle_mrad']:.2f}",
        _pairs(mirrors, rng),
    )
