"""Predicts each sighting from what was measured before it, as a plant in service does."""

from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.evaluation import BeamErrors
from heliotrope.calibration.learn.learning import (
    Learned,
    Prediction,
    Progress,
    Runner,
    learn,
    predict,
)
from heliotrope.calibration.sightings import Sightings

#: Sightings predicted at once: memory grows with this times the sightings of a heliostat.
CHUNK = 50


def predict_in_turn(
    learned: Learned,
    *,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    runner: Runner | None = None,
    progress: Progress | None = None,
) -> Prediction:
    """Return the held-out sightings, each predicted from all earlier ones of its heliostat.

    The hyperparameters remain those of the training part, so other heliostats contribute through
    the population alone. Every history is learnt afresh: parameters, regimes, steps and outliers.
    Sightings at the same time do not see each other.

    Parameters
    ----------
    learned
        Learnt from the earliest sightings of each heliostat.
    priors, runner
        As for `heliotrope.calibration.learn.learn`; ``priors`` as scalars or (N,).
    progress
        Called with (done, all) held-out sightings.
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
    """Predict some sightings, each by a copy of its heliostat that has seen the earlier ones."""
    seen = learned.sightings
    histories = [_before(learned, int(row)) for row in asked]
    owner = np.repeat(np.arange(len(asked)), [len(h) for h in histories])
    past = seen.take(np.concatenate([np.empty(0, np.intp), *histories]))
    copies = seen.heliostat[asked]
    count = len(learned.mechanism)
    cut = {n: np.asarray(v)[copies] if np.shape(v) == (count,) else v for n, v in priors.items()}
    found = learn(
        learned.mechanism[copies],
        replace(past, heliostat=owner.astype(np.intp)),
        learned.model,
        priors=cut,
        hyper=learned.hyper,
        runner=runner,
    )
    wanted = replace(seen.take(asked), heliostat=np.arange(len(asked), dtype=np.intp))
    return predict(found, wanted)


def _before(learned: Learned, row: int) -> npt.NDArray[np.intp]:
    """Rows of the same heliostat measured before ``row``; with an unknown time: those learnt."""
    seen: Sightings = learned.sightings
    mine = seen.heliostat == seen.heliostat[row]
    when = seen.time[row]
    return np.flatnonzero(mine & (seen.time < when if np.isfinite(when) else learned.used))


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
