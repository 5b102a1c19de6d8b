"""Predict each sighting from the sightings before it, as a plant in service does."""

from collections.abc import Mapping
from dataclasses import fields

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import BeamErrors
from heliotrope.calibration.fit.residuals import linearise
from heliotrope.calibration.learn import stream
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.learn.learned import (
    Learned,
    Prediction,
    moved_by,
    predict,
    predict_with,
)
from heliotrope.calibration.learn.learning import Progress, Runner, learn
from heliotrope.calibration.learn.stream import Belief
from heliotrope.calibration.learn.unusable import is_usable
from heliotrope.calibration.sightings import Sightings

#: Number of sightings predicted at once. Memory grows with this number times the number of
#: sightings of a heliostat.
CHUNK = 50


def beliefs_of(learned: Learned) -> tuple[Belief, ...]:
    """Return the belief of each heliostat after the sightings from which it was learnt.

    This is done overnight. The hyperparameters, the centre of the priors and the derivatives of
    past sightings come from the learnt field, with each sighting linearised about the posterior at
    its time. Steps, regimes and faulty sightings are assessed anew as the sightings are replayed.
    ``stream.observe`` then continues with new sightings.
    """
    sightings = learned.sightings
    beliefs = []
    for i, member in enumerate(learned.members):
        rows = np.flatnonzero((sightings.heliostat == i) & learned.used & ~learned.unusable)
        # Sightings at unknown times come first, because they say nothing about drift and a belief
        # cannot go back in time.
        when = np.nan_to_num(sightings.time[rows], nan=-np.inf)
        rows = rows[np.argsort(when, kind="stable")]
        belief = stream.begin(member.hyper, member.data.centre, member.data.own)
        if len(rows):
            mine = sightings.take(rows)
            at, _ = learned.parameters_at(mine.heliostat, mine.time)
            moved = moved_by(learned.mechanism, mine.heliostat, learned.names, at)
            line = linearise(moved, mine, learned.names)
            gap = at - member.data.centre
            value = np.einsum("nap,np->na", line.jacobian, gap) - line.residual
            for k in np.flatnonzero(is_usable(line)):
                belief = stream.update(belief, line.jacobian[k], value[k], mine.time[k] / DAY)
        beliefs.append(belief)
    return tuple(beliefs)


def predict_by_stream(learned: Learned, progress: Progress | None = None) -> Prediction:
    """Return the held-out sightings, each predicted by the belief after all earlier sightings.

    Parameters
    ----------
    learned
        Field learnt from the earliest sightings of each heliostat.
    progress
        Called with the numbers of held-out sightings (done, total).
    """
    sightings, size = learned.sightings, len(learned.names)
    beliefs = list(beliefs_of(learned))
    asked = np.flatnonzero(~learned.used)
    values, spread = np.empty((len(asked), size)), np.empty((len(asked), size, size))
    order = np.argsort(sightings.time[asked], kind="stable")
    for done, place in enumerate(order):
        row = asked[place]
        i = int(sightings.heliostat[row])
        values[place], spread[place] = beliefs[i].at(sightings.time[row] / DAY)
        beliefs[i] = stream.observe(
            beliefs[i], learned.mechanism[i : i + 1], sightings.take([row]).of(i)
        )
        if progress:
            progress(done + 1, len(asked))
    return predict_with(learned, sightings.take(asked), values, spread)


def predict_in_turn(
    learned: Learned,
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    runner: Runner | None = None,
    progress: Progress | None = None,
) -> Prediction:
    """Return the held-out sightings, each predicted from the heliostat's earlier sightings.

    The hyperparameters remain those of the training part, so other heliostats contribute only
    through the population. For every prediction the parameters, regimes, steps and outliers are
    learnt again from all the earlier sightings. Simultaneous sightings do not influence each other.

    Parameters
    ----------
    learned
        Field learnt from the earliest sightings of each heliostat.
    priors, runner
        As for `heliotrope.calibration.learn.learn`; ``priors`` as scalars or (N,).
    progress
        Called with the numbers of held-out sightings (done, total).
    """
    asked = np.flatnonzero(~learned.used)
    parts = []
    for start in range(0, max(len(asked), 1), CHUNK):
        some = asked[start : start + CHUNK]
        parts.append(_predict(learned, some, dict(priors or {}), runner))
        if progress:
            progress(start + len(some), len(asked))
    return _join(parts)


def _predict(
    learned: Learned,
    asked: npt.NDArray[np.intp],
    priors: dict[str, npt.ArrayLike],
    runner: Runner | None,
) -> Prediction:
    """Predict sightings, each from a copy of its heliostat that has learnt the earlier ones."""
    sightings = learned.sightings
    histories = [_before(learned, int(row)) for row in asked]
    owner = np.repeat(np.arange(len(asked)), [len(h) for h in histories])
    past = sightings.take(np.concatenate([np.empty(0, np.intp), *histories]))
    copies = sightings.heliostat[asked]
    count = len(learned.mechanism)
    cut = {n: np.asarray(v)[copies] if np.shape(v) == (count,) else v for n, v in priors.items()}
    relearned = learn(
        learned.mechanism[copies],
        past.renumbered(owner),
        learned.model,
        priors=cut,
        hyper=learned.hyper,
        runner=runner,
    )
    future = sightings.take(asked).renumbered(np.arange(len(asked)))
    return predict(relearned, future)


def _before(learned: Learned, row: int) -> npt.NDArray[np.intp]:
    """Return the earlier sightings of the heliostat of sighting ``row``.

    If the sighting's time is unknown, return those that the field was learnt from.
    """
    sightings: Sightings = learned.sightings
    mine = sightings.heliostat == sightings.heliostat[row]
    when = sightings.time[row]
    return np.flatnonzero(mine & (sightings.time < when if np.isfinite(when) else learned.used))


def _join(parts: list[Prediction]) -> Prediction:
    errors = {
        f.name: np.concatenate([getattr(p.errors, f.name) for p in parts])
        for f in fields(BeamErrors)
    }
    rest = {
        f.name: np.concatenate([getattr(p, f.name) for p in parts])
        for f in fields(Prediction)
        if f.name != "errors"
    }
    return Prediction(errors=BeamErrors(**errors), **rest)
