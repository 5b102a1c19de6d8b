"""Hyperparameters of a heliostat group, learnt overnight from a running plant's photographs.

The learning itself is step 3 of `learning`, as in ``heliotrope evaluate``. This module adds what an
unattended plant needs. It limits the number of sightings, so that the work can be done in one
night, and checks that the new values would have predicted the photographs better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from heliotrope.calibration.fit.estimator import FieldFit, FitOutcome, fit
from heliotrope.calibration.learn import drift, learning, present
from heliotrope.calibration.learn.drift import DAY, TEACHERS, Hyperparameters, Process
from heliotrope.calibration.sightings import Sightings, join
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.mechanism.chain import Mechanism
from heliotrope.values import amount

#: Maximum number of sightings of one heliostat, in whole visits spread over its history. The cost
#: grows as the cube of this number.
MOST = 120
#: Sightings further apart than this belong to different visits, s.
APART = 3600.0


@dataclass(frozen=True)
class GroupHistory:
    """All measurements of a group of heliostats.

    Attributes
    ----------
    mechanism
        Nominal mechanisms of the N heliostats, (N,).
    sightings
        One entry for each of the N heliostats: its photographs, as sightings of heliostat 0, or
        None if it has none.
    model
        The constant parameters.
    before
        Current hyperparameters.
    """

    mechanism: Mechanism
    sightings: tuple[Sightings | None, ...]
    model: tuple[str, ...]
    before: Hyperparameters


@dataclass(frozen=True)
class GroupTask:
    """Data from which a group is learnt: M sightings of K of its heliostats.

    The attributes are those of `GroupHistory`.
    """

    mechanism: Mechanism
    sightings: Sightings
    model: tuple[str, ...]
    before: Hyperparameters


@dataclass(frozen=True)
class LearntGroup:
    """The hyperparameters of a group.

    Attributes
    ----------
    hyper
        Hyperparameters of the group.
    heliostats, sightings
        Number of heliostats and of sightings from which they were learnt.
    gain
        How much better the new hyperparameters predict a sighting from earlier sightings than the
        previous hyperparameters did: the mean gain in log probability density.
    """

    hyper: Hyperparameters
    heliostats: int
    sightings: int
    gain: float


def defaults(mechanism: Mechanism, model: tuple[str, ...]) -> Hyperparameters:
    """Return the hyperparameters that apply until a group has been learnt."""
    return replace(drift.start(mechanism, model), rate=drift.step_rate(()))


def able(histories: Sequence[Sightings | None]) -> npt.NDArray[np.intp]:
    """Return the indices of heliostats with enough sightings to learn from, on two days or more."""
    rows = []
    for row, sightings in enumerate(histories):
        known = np.zeros(0) if sightings is None else sightings.time[np.isfinite(sightings.time)]
        if len(known) >= learning.FEWEST and np.ptp(known) >= DAY:
            rows.append(row)
    return np.array(rows, dtype=np.intp)


def gathered(group: GroupHistory) -> GroupTask:
    """Return the data from which to learn a group.

    Raises
    ------
    InputError
        If fewer than `TEACHERS` heliostats have enough sightings.
    """
    rows = able(group.sightings)
    if len(rows) < TEACHERS:
        raise InputError(
            f"{amount(len(rows), 'heliostat')} with {learning.FEWEST} photographs on different "
            f"days; {TEACHERS} are needed"
        )
    if len(rows) > learning.SAMPLE:
        rows = rows[np.linspace(0, len(rows) - 1, learning.SAMPLE).round().astype(np.intp)]
    parts = []
    for place, row in enumerate(rows):
        sightings = thinned(cast("Sightings", group.sightings[row]))
        parts.append(sightings.renumbered(np.full(len(sightings), place)))
    return GroupTask(group.mechanism[rows], join(parts), group.model, group.before)


def thinned(sightings: Sightings, most: int = MOST) -> Sightings:
    """Return at most ``most`` sightings of a heliostat, as whole visits in order of time.

    The latest visit is always included. Visits are kept whole so that they show motion over hours,
    and are spread over the whole history so that they show motion over months.
    """
    order = np.flatnonzero(np.isfinite(sightings.time))
    sightings = sightings.take(order[np.argsort(sightings.time[order], kind="stable")])
    if len(sightings) <= most:
        return sightings
    visit = np.concatenate([[0], np.cumsum(np.diff(sightings.time) > APART)])
    count = int(visit[-1]) + 1
    share = max(1, int(most * count / len(sightings)))
    kept = np.linspace(count - 1, 0, share).round().astype(np.intp)
    return sightings.take(np.flatnonzero(np.isin(visit, kept))[-most:])


def learn_group(task: GroupTask) -> LearntGroup:
    """Return the hyperparameters learnt from a group's sightings, and the gain they bring."""
    every = np.ones(len(task.sightings), np.bool_)
    with threadpool_limits(1, "blas"):
        hyper = learning.field_of(
            task.mechanism, task.sightings, every, learning.Task(task.model, {})
        )
        fitted = fit(task.mechanism, task.sightings, task.model)
        densities = [density(task, fitted, choice) for choice in (task.before, hyper)]
    gain = (densities[1] - densities[0]) / len(task.sightings)
    return LearntGroup(hyper, len(task.mechanism), len(task.sightings), gain)


def density(task: GroupTask, fitted: FieldFit, hyper: Hyperparameters) -> float:
    """Return the log density of all sightings, each predicted from the earlier sightings."""
    total = 0.0
    for row in range(len(task.mechanism)):
        if int(fitted.outcome[row]) == FitOutcome.CONVERGED:
            single, sightings = fitted.only(row), task.sightings.of(row)
            mechanism = task.mechanism[row : row + 1]
            own = present.hyper_of(mechanism, single, hyper)
            total += present.replayed(mechanism, sightings, single, own).density
    return total


def described(hyper: Hyperparameters) -> str:
    """Describe the drift and the noise in words."""
    tau = dict(zip(hyper.groups, hyper.tau.tolist(), strict=True))
    parts = []
    for group in hyper.groups:
        mine = [
            size for p, size in zip(hyper.processes, hyper.amplitude, strict=True)
            if p.group == group
        ]  # fmt: skip
        what = "zeros wander" if group != "hours" else "normals move"
        sizes = " and ".join(f"{1e3 * size:.2g}" for size in mine)
        time = f"{tau[group]:.0f} days" if tau[group] >= 2.0 else f"{24 * tau[group]:.1f} hours"
        parts.append(f"{what} by {sizes} mrad over {time}")
    parts.append(f"a step in {1.0 / hyper.rate:.0f} days" if hyper.rate > 0.0 else "no steps")
    parts.append(f"noise {hyper.noise:.2f} times a photograph's sigma")
    return ", ".join(parts)


_ARRAYS = ("mean", "spread", "regime", "step", "wide", "amplitude", "tau")


def document_of(hyper: Hyperparameters) -> dict[str, Any]:
    """Return hyperparameters as a JSON object."""
    return {
        "names": list(hyper.names),
        "processes": [[p.parameter, p.group] for p in hyper.processes],
        **{name: cast("FloatArray", getattr(hyper, name)).tolist() for name in _ARRAYS},
        "noise": hyper.noise,
        "rate": hyper.rate,
        "heavy": hyper.heavy,
    }


def read_hyperparameters(document: dict[str, Any]) -> Hyperparameters:
    """Return the hyperparameters of a document made by `document_of`.

    Raises
    ------
    InputError
        If the document is not valid.
    """
    try:
        arrays: dict[str, Any] = {n: np.array(document[n], dtype=np.float64) for n in _ARRAYS}
        numbers: dict[str, Any] = {n: float(document[n]) for n in ("noise", "rate", "heavy")}
        hyper = Hyperparameters(
            names=tuple(document["names"]),
            processes=tuple(Process(*pair) for pair in document["processes"]),
            **arrays,
            **numbers,
        )
        count = len(hyper.names)
        sizes = [getattr(hyper, name).shape == (count,) for name in _ARRAYS[:5]]
        sizes += [hyper.amplitude.shape == (len(hyper.processes),)]
        sizes += [hyper.tau.shape == (len(hyper.groups),), len(hyper.part) == len(hyper.processes)]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"hyperparameters: {error!r}; learn the group again") from error
    figures = np.concatenate([*arrays.values(), list(numbers.values())])
    if not (all(sizes) and np.isfinite(figures).all() and hyper.noise > 0.0):
        raise InputError(
            "hyperparameters: array shapes or values are inconsistent; learn the group again"
        )
    return hyper
