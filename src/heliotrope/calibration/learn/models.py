"""Choose the parameters that a field needs, by predictive score, and report the evidence.

Every candidate is learnt on a sample of the field. Its score is the mean log probability density of
each sighting given the heliostat's other sightings (leave-one-out cross-validation in closed form:
Rasmussen & Williams 2006, (5.10)-(5.12)). The simplest candidate within one standard error of the
best is chosen (Breiman et al. 1984).
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.fit.estimator import names_of
from heliotrope.calibration.learn import learning
from heliotrope.calibration.learn.learned import Learned
from heliotrope.calibration.learn.misfits import find_misfits
from heliotrope.calibration.named import Field, members
from heliotrope.calibration.sightings import Sightings
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.mechanism.drives import SLOTS

#: Models are compared on this many heliostats: those with the most sightings.
HELIOSTATS = 16
#: A larger model must gain more than this in mean log density, that is, about one per cent.
WORTH = 0.01
#: The log density of one sighting counts as at least this, so that outliers do not decide the
#: choice of model.
WORST = -25.0


@dataclass(frozen=True)
class ScoredModel:
    """A model with its score.

    Attributes
    ----------
    name, parameters
        Name of the model, and names of its parameters.
    log_predictive
        Mean log probability density of a sighting given the heliostat's other sightings.
    behind, behind_error
        Difference between ``log_predictive`` and that of the best candidate, and the standard error
        of this difference.
    log_evidence
        Log evidence of all sightings under the learnt hyperparameters.
    """

    name: str
    parameters: tuple[str, ...]
    log_predictive: float
    behind: float
    behind_error: float
    log_evidence: float

    def document(self) -> dict[str, float]:
        """Return the score as a JSON object."""
        return {
            "parameters": len(self.parameters),
            "log_predictive": self.log_predictive,
            "behind": self.behind,
            "behind_error": self.behind_error,
            "log_evidence": self.log_evidence,
        }


def candidate_models(mechanism: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return the models that suit this kind of mechanism, by name, the simplest first."""
    known = mechanism.parameters
    candidates: dict[str, tuple[str, ...]] = {}
    for name in ("guo6", "jacks", "khalsa8", "malan8"):
        with contextlib.suppress(UnknownNameError):
            candidates[name] = parameter_table.model(name, known)
    if "jacks" in candidates:
        candidates = {"jacks": candidates["jacks"]}
        candidates["jacks8"] = tuple(
            p for p in candidates["jacks"] if not p.endswith("_offset")
        ) + tuple(p for p in candidates["jacks"] if p.endswith("stroke_offset"))
    for name in [n for n in candidates if n != "jacks8"]:
        for extra in _extras(mechanism):
            label = f"{name}+{extra[0]}"
            if all(p in known and p not in candidates[name] for p in extra[1]):
                candidates[label] = candidates[name] + extra[1]
    candidates["full"] = parameter_table.model("full", known)
    worms = tuple(name for names in _worms(mechanism).values() for name in names)
    if worms:
        candidates["full+worm"] = candidates["full"] + worms
    return dict(sorted(candidates.items(), key=lambda item: len(item[1])))


def _extras(mechanism: Mechanism) -> list[tuple[str, tuple[str, ...]]]:
    joints = [mechanism.joints[k] for k in mechanism.driven]
    extras = [("sag", ("sag",)), ("position", parameter_table.MODELS["malan8"][:3])]
    extras.append(("radii", tuple(f"{j}_pivot_radius" for j in joints)))
    extras.append(("scales", tuple(f"{j}_scale" for j in joints)))
    worms = _worms(mechanism)
    extras += [(f"{joint}_worm", names) for joint, names in worms.items()]
    if len(worms) > 1:
        extras.append(("worm", tuple(name for names in worms.values() for name in names)))
    return extras


def _worms(mechanism: Mechanism) -> dict[str, tuple[str, ...]]:
    """Return the parameters of the periodic error of each drive whose ratio is known, by joint."""
    ratio = mechanism.drives.table[..., SLOTS["worm_ratio"]].reshape(-1, len(mechanism.driven))
    joints = [mechanism.joints[k] for k in mechanism.driven]
    return {
        joint: (f"{joint}_worm_cos", f"{joint}_worm_sin")
        for joint, known in zip(joints, (ratio != 0.0).all(axis=0), strict=True)
        if known
    }


def compare_models(
    mechanism: Field,
    sightings: Sightings,
    models: Mapping[str, str | Sequence[str]] | None = None,
    *,
    used: npt.ArrayLike | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[ScoredModel, ...]:
    """Return models with their scores, in the order given.

    Parameters
    ----------
    mechanism
        Heliostats, as for `learn`.
    sightings
        M sightings of these heliostats.
    models
        Candidates by name. Each is the name of a model or the names of its parameters. Default:
        `candidate_models`, the simplest first.
    used
        Mask of the sightings to learn from, (M,).
    progress
        Called with the name of each model before it is learnt.

    Raises
    ------
    InputError
        If no heliostat has enough sightings, or there are no models.
    UnknownNameError
        If a model or parameter does not exist.
    """
    field = members(mechanism)
    nominal, sightings = field.mechanism, field.rows_of(sightings)
    candidates = candidate_models(nominal) if models is None else models
    trials = {name: names_of(model, nominal) for name, model in candidates.items()}
    keep = np.ones(len(sightings), np.bool_) if used is None else np.asarray(used, np.bool_)
    counts = np.bincount(sightings.heliostat[keep], minlength=len(nominal))
    chosen = np.argsort(-counts, kind="stable")[:HELIOSTATS]
    chosen = np.sort(chosen[counts[chosen] >= learning.FEWEST])
    if not len(chosen) or not trials:
        raise InputError(
            f"models: no heliostat has {learning.FEWEST} sightings; name the model instead of auto"
        )
    place = np.full(len(nominal), -1)
    place[chosen] = np.arange(len(chosen))
    part = sightings.take(np.flatnonzero(keep & (place[sightings.heliostat] >= 0)))
    part = part.renumbered(place[part.heliostat])
    misfits = find_misfits(nominal[chosen], part)
    part = part.take(~np.isin(part.heliostat, [misfit.row for misfit in misfits]))
    scores, evidence, good = {}, {}, np.ones(len(part), dtype=np.bool_)
    for name, names in trials.items():
        if progress:
            progress(name)
        learned = learning.learn(nominal[chosen], part, names, own=False, rounds=2, misfits=())
        score, mask = _scores(learned)
        scores[name], good = score, good & ~mask
        evidence[name] = float(sum(m.log_evidence() for m in learned.members))
    means = {name: float(score[good].mean()) for name, score in scores.items()}
    best = max(means, key=lambda name: means[name])
    result = []
    for name, names in trials.items():
        gap = scores[best][good] - scores[name][good]
        error = float(gap.std() / np.sqrt(max(len(gap), 1)))
        result.append(
            ScoredModel(name, names, means[name], float(gap.mean()), error, evidence[name])
        )
    return tuple(result)


def choose_model(scored: tuple[ScoredModel, ...]) -> ScoredModel:
    """Return the simplest candidate within one standard error, or within ``WORTH``, of the best."""
    able = [c for c in scored if c.behind <= max(c.behind_error, WORTH)]
    return min(able, key=lambda c: len(c.parameters))


def describe(scored: tuple[ScoredModel, ...]) -> tuple[str, ...]:
    """Return one line on the comparison of models; no lines if there was none."""
    if not scored:
        return ()
    listed = ", ".join(f"{c.name} {c.behind:.3f}±{c.behind_error:.3f}" for c in scored)
    line = f"Model {choose_model(scored).name}, the simplest that explains the data. Mean log "
    return (f"{line}predictive density below the best: {listed}.",)


def _scores(learned: Learned) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Return the log predictive density of each sighting, and the mask of outliers."""
    score = np.full(len(learned.sightings), WORST)
    for i, member in enumerate(learned.members):
        rows = learned.rows[i][~learned.outlier[learned.rows[i]]]
        score[rows] = np.maximum(member.log_predictive(), WORST)
    return score, learned.outlier
