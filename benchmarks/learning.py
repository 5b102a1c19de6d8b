"""The streaming learner beside learning the history afresh: time, equality, memory.

One mirror is measured again and again over years. "stream" is one sighting observed
(`calibration.learn.stream.observe`: linearised about the belief, all hypotheses weighed); "batch"
is what an update cost before: the whole history learnt under known hyperparameters, with regimes,
steps and outliers. Equality is that of the posterior with known events, in standard deviations.
"""

import dataclasses
import sys
import time
from typing import Any

import numpy as np

from benchmarks._run import BenchmarkError, Result, Row, timed
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import drift, stream
from heliotrope.calibration.learn.learning import learn
from heliotrope.calibration.learn.own_model import OwnModel
from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.geometry import direction, reflect
from heliotrope.mechanism import kinds
from heliotrope.mechanism.parameters import MODELS

NAMES = (*MODELS["guo6"],)
NOISE, START, DAY = 3e-4, 1.7e9, 86400.0
#: Days between two sightings of a mirror.
EVERY = 2.5
HISTORIES = (30, 100, 300)
MIRRORS = 10_000
#: Sightings of 100 years, one a day.
LIFE = 36_500
#: Largest difference from the batch, standard deviations.
EQUAL = 1e-6
#: Budget of one sighting, s, and least ratio to learning afresh.
BUDGET_S, RATIO = 1e-3, 100.0


def _case(count: int) -> tuple[Any, Sightings, drift.Hyperparameters]:
    rng = np.random.default_rng(0)
    nominal = kinds.azimuth_elevation([[80.0, 150.0, 0.0]], pivot_height=2.0)
    truth = nominal.with_parameters(
        {n: rng.normal(0, 0.5 * nominal.parameter(n).prior, 1) for n in NAMES}
    )
    counts = rng.uniform((-0.7, 0.3), (0.7, 1.3), (count, 2)) + [np.pi, 0.0]
    pose = truth[np.zeros(count, np.intp)].pose(counts)
    sun = pose.normal + 0.4 * direction(rng.uniform(0, 6, count), 0.3)
    sun /= np.linalg.norm(sun, axis=-1, keepdims=True)
    ray = reflect(sun, pose.normal) + rng.normal(0, NOISE, sun.shape)
    seen = sightings(
        np.zeros(count, np.intp),
        counts,
        sun,
        pose.vertex + 300.0 * ray,
        time=START + EVERY * DAY * np.arange(count),
        sigma=NOISE,
    )
    return nominal, seen, dataclasses.replace(drift.start(nominal, NAMES), rate=1e-3, noise=1.0)


def _after(nominal: Any, seen: Sightings, hyper: drift.Hyperparameters) -> stream.Belief:
    belief = stream.begin(hyper)
    for k in range(len(seen)):
        belief = stream.observe(belief, nominal, seen.take([k]))
    return belief


def _difference(nominal: Any, seen: Sightings, hyper: drift.Hyperparameters) -> float:
    """Largest difference of stream and batch for the same derivatives, standard deviations."""
    line = linearise(nominal[seen.heliostat], seen, hyper.names)
    size, count = len(hyper.names), len(seen)
    data = drift.Linear(
        jacobian=line.jacobian,
        value=-line.residual,
        time=seen.time / DAY,
        regime=np.zeros(count, np.int64),
        centre=np.zeros(size),
        own=np.zeros(size, np.bool_),
        steps=np.empty(0),
        suspect=np.zeros(count, np.bool_),
    )
    when = data.time[-1] + 1.0
    values, spread = drift.posterior(hyper, data).at(np.array([when]), np.zeros(1, np.int64))
    belief = stream.begin(hyper)
    for k in range(count):
        belief = stream.update(
            belief, data.jacobian[k], data.value[k], data.time[k], stream.Event.NOTHING
        )
    found, _ = belief.at(when)
    return float(np.abs((found - values[0]) / np.sqrt(np.diagonal(spread[0]))).max())


def _bytes(belief: stream.Belief) -> int:
    arrays = (belief.weight, belief.mean, belief.covariance, belief.regime, belief.centre)
    return sum(a.nbytes for a in arrays) + sys.getsizeof(belief)


def _visit(count: int) -> float:
    """Time of what a visit of a running plant fits after so many sightings, s."""
    nominal, seen, _ = _case(count)
    begun = time.process_time()
    OwnModel("guo6", NAMES).fitting(nominal, seen)
    return time.process_time() - begun


def run(quick: bool) -> Result:
    """Measure one update after histories of several lengths, and a field."""
    rows: list[Row] = []
    ratio = np.nan
    lengths = HISTORIES[:1] if quick else HISTORIES
    nominal, seen, hyper = _case(max(lengths) + 1)
    slowest, belief = 0.0, stream.begin(hyper)
    for length in lengths:
        past, new = seen.take(np.arange(length)), seen.take([length])
        belief = _after(nominal, past, hyper)
        whole = seen.take(np.arange(length + 1))
        both = timed(
            {
                "stream": lambda b=belief, n=new: stream.observe(b, nominal, n),
                "batch": lambda w=whole: learn(nominal, w, NAMES, hyper=hyper),
            },
            1 if quick else 7,
        )
        one, all_again = both["stream"].processor, both["batch"].processor
        difference = _difference(nominal, past, hyper)
        if difference > EQUAL:
            raise BenchmarkError(f"stream and batch differ by {difference:.1e} standard deviations")
        slowest = max(slowest, one)
        ratio = all_again / one
        rows.append(
            {
                "sightings_before": length,
                "stream_us": 1e6 * one,
                "batch_ms": 1e3 * all_again,
                "ratio": ratio,
                "difference_sigma": difference,
                "hypotheses": len(belief.weight),
                "state_kB": _bytes(belief) / 1e3,
            }
        )
    count = 100 if quick else MIRRORS
    beliefs = [belief] * count
    start = time.perf_counter()
    beliefs = [stream.observe(b, nominal, seen.take([length])) for b in beliefs]
    field_s = time.perf_counter() - start
    size = sum(_bytes(b) for b in beliefs)
    visit_s = _visit(365 if quick else LIFE)
    return Result(
        rows,
        f"{1e6 * slowest:.0f} µs a sighting; {ratio:.0f} times faster than afresh after "
        f"{lengths[-1]} sightings",
        {
            "mirrors": count,
            "one_sighting_each_s": field_s,
            "all_states_MB": size / 1e6,
            "visit_after_100_years_s": visit_s,
        },
        None if quick else slowest <= BUDGET_S and ratio >= RATIO,
    )
