"""Calibrate a field from its files: read the sightings, choose a model, learn, test, report.

`read_field_sightings` reads a folder or a table, `calibrate` returns the content of a report, and
`evaluate` only tests how well held-out sightings are predicted.
"""

import math
import numbers
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from heliotrope.calibration import evaluation
from heliotrope.calibration.clock import ClockCheck, check_clock
from heliotrope.calibration.evaluation import Split
from heliotrope.calibration.learn import models
from heliotrope.calibration.learn.assessment import Assessment, assess
from heliotrope.calibration.learn.learned import Learned
from heliotrope.calibration.learn.learning import FEWEST, Runner, learn
from heliotrope.calibration.learn.misfits import Misfit, find_misfits
from heliotrope.calibration.learn.models import ScoredModel
from heliotrope.calibration.learn.periodic import (
    PeriodicError,
    search_periodic_errors,
    with_ratios,
)
from heliotrope.calibration.learn.sequential import predict_by_stream, predict_in_turn
from heliotrope.calibration.plausibility import Judgement, judge_in
from heliotrope.calibration.report.content import CalibrationReport
from heliotrope.calibration.sighting_table import read_sightings
from heliotrope.calibration.sightings import Sightings, of_measurements
from heliotrope.errors import FormatError, InputError, require, shown
from heliotrope.field.formats import measurements
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.mechanism.chain import Mechanism

#: Learners that may be used after training with the split "sequential".
Learner = Literal["stream", "batch"]
#: Function called with (name of the step, done, total).
Steps = Callable[[str, int, int], None]


@dataclass(frozen=True)
class FieldSightings:
    """Sightings together with the heliostats that they measure.

    Attributes
    ----------
    plant, group
        The plant, and the name of the group that contains the heliostats.
    sightings
        The sightings.
    ids
        Name of each sighting.
    left_out
        One message for each measurement that could not be used.
    notes
        Notes on contradictions that affect most of the sightings.
    """

    plant: Plant
    group: str
    sightings: Sightings
    ids: tuple[str, ...]
    left_out: tuple[str, ...]
    notes: tuple[str, ...] = ()

    @property
    def heliostats(self) -> Heliostats:
        """The heliostats of the group."""
        return self.plant.groups[self.group]


def read_field_sightings(
    plant: Plant,
    place: str | Path,
    table: str | Path | None = None,
    *,
    centroid: Literal["utis", "helios"] = "utis",
    now: float | None = None,
) -> FieldSightings:
    """Return the plausible sightings from a folder in PAINT's format, or from a table.

    Parameters
    ----------
    plant
        Plant with one group of heliostats.
    place
        The folder or file from which the plant was read.
    table
        Table of sightings; without a table ``place`` must be a folder with measurements.
    centroid
        Which published centroid to use.
    now
        Time by the computer's clock, Unix seconds; sightings with later times are left out.

    Raises
    ------
    InputError
        If the plant has several groups, or there are no measurements.
    FormatError
        If no measurement can be used.
    """
    require("plant", plant, Plant, "a plant from heliotrope.open")
    require("place", place, (str, Path), "the file or folder that the plant was read from")
    place = Path(place)
    if centroid not in ("utis", "helios"):
        raise InputError(f"centroid must be 'utis' or 'helios', not {shown(centroid)}")
    if now is not None:
        require("now", now, numbers.Real, "Unix seconds")
        if not math.isfinite(now):
            raise InputError(f"now must be in Unix seconds, not {now}")
    if table is not None:
        field = _read_table(plant, place, Path(table), now)
    elif place.is_dir():
        field = _read_folder(plant, place, centroid, now)
    else:
        raise InputError(
            f"{place}: the plant has no measurements; specify --sightings TABLE, or a folder with "
            "plant and measurements"
        )
    if not len(field.sightings):
        reason = f"; the first: {field.left_out[0]}" if field.left_out else ""
        raise FormatError(table or place, f"no measurement can be used{reason}")
    return field


def _read_table(plant: Plant, place: Path, table: Path, now: float | None) -> FieldSightings:
    if len(plant.groups) != 1:
        raise InputError(
            f"{place}: {len(plant.groups)} groups of heliostats; calibrate them one at a time, "
            "each as a plant with one group"
        )
    ((group, heliostats),) = plant.groups.items()
    judged: list[Judgement] = []

    def judge(observed: Sightings, kinds: Sequence[str]) -> Mapping[int, str]:
        judged.append(judge_in(plant, observed, kinds, now))
        return judged[0].reasons

    observed, _, left_out = read_sightings(table, heliostats.names, judge)
    ids = tuple(f"{heliostats.names[h]} {k}" for k, h in enumerate(observed.heliostat))
    return FieldSightings(plant, group, observed, ids, tuple(left_out), judged[0].notes)


def _read_folder(
    plant: Plant, place: Path, centroid: Literal["utis", "helios"], now: float | None
) -> FieldSightings:
    ((group, heliostats),) = plant.groups.items()
    table = measurements.read_measurements(place, centroid=centroid)
    observed, left_out = of_measurements(table, heliostats)
    known = set(heliostats.names)
    pairs = zip(table.heliostat, table.ids, strict=True)
    ids = [f"{name} {number}" for name, number in pairs if name in known]
    judged = judge_in(plant, observed, ["camera_target"] * len(observed), now)
    kept = [k for k in range(len(observed)) if k not in judged.reasons]
    impossible = [f"{ids[k]}: {reason}" for k, reason in sorted(judged.reasons.items())]
    return FieldSightings(
        plant,
        group,
        observed.take(kept),
        tuple(ids[k] for k in kept),
        (*table.left_out, *left_out, *impossible),
        judged.notes,
    )


@dataclass(frozen=True)
class ModelChoice:
    """The simplest model that explains the sightings of a field.

    Attributes
    ----------
    parameters
        Parameters to be fitted.
    mechanism
        Nominal mechanisms, (N,), with the ratios of the periodic errors that were found and
        included.
    scores
        Scores of all compared models; empty if there are too few sightings.
    periodic
        The best periodic error of each drive whose ratio is unknown, significant or not.
    """

    parameters: tuple[str, ...]
    mechanism: Mechanism
    scores: tuple[ScoredModel, ...] = ()
    periodic: tuple[PeriodicError, ...] = ()

    def describe(self) -> tuple[str, ...]:
        """Return lines for display: the comparison, and the periodic errors that were found."""
        lines = tuple(f"{error}." for error in self.periodic if error.found)
        return (*models.describe(self.scores), *lines)


def find_model(
    mechanism: Mechanism,
    sightings: Sightings,
    used: npt.NDArray[np.bool_] | None = None,
    steps: Steps | None = None,
) -> ModelChoice:
    """Return the simplest model that explains the sightings.

    The periodic error of a drive is among the candidates if the plant specifies its ratio, or if
    `search_periodic_errors` finds one in the residuals.

    Parameters
    ----------
    mechanism
        Nominal mechanisms, (N,).
    sightings
        M sightings of these heliostats; if there are too few for a comparison, the smallest model
        is returned without scores.
    used
        Mask of the sightings to learn from, (M,).
    steps
        Progress.
    """
    keep = np.ones(len(sightings), np.bool_) if used is None else used
    counts = np.bincount(sightings.heliostat[keep], minlength=len(mechanism))
    if counts.max(initial=0) < FEWEST:
        return ModelChoice(next(iter(models.candidate_models(mechanism).values())), mechanism)
    errors = search_periodic_errors(mechanism, sightings, used=keep)
    geared = with_ratios(mechanism, errors)
    trials = models.candidate_models(geared)
    tried: list[str] = []

    def next_model(name: str) -> None:
        if steps:
            steps("comparing models", len(tried), len(trials))
        tried.append(name)

    scored = models.compare_models(geared, sightings, trials, used=keep, progress=next_model)
    chosen = models.choose_model(scored).parameters
    part = tuple(e for e in errors if f"{e.joint}_worm_cos" in chosen)
    return ModelChoice(chosen, with_ratios(mechanism, part), scored, errors)


@dataclass(frozen=True)
class HeldOutEvaluation:
    """How well held-out sightings are predicted.

    Attributes
    ----------
    learned
        Field learnt from the training part alone.
    assessment
        Results for the held-out part.
    choice
        How the model was chosen; None if it was specified.
    """

    learned: Learned
    assessment: Assessment
    choice: ModelChoice | None = None

    def document(self) -> dict[str, Any]:
        """Return the results for JSON."""
        document = {"model": list(self.learned.model), **self.assessment.document()}
        if self.choice is not None and self.choice.scores:
            document["models"] = {c.name: c.document() for c in self.choice.scores}
        if self.choice is not None and self.choice.periodic:
            document["periodic_errors"] = [e.document() for e in self.choice.periodic]
        return document


def evaluate(
    names: tuple[str, ...],
    mechanism: Mechanism,
    sightings: Sightings,
    model: str | tuple[str, ...] = "auto",
    *,
    split: Split = "random",
    fraction: float = 0.7,
    seed: int = 0,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    runner: Runner | None = None,
    steps: Steps | None = None,
    learner: Learner = "stream",
    misfits: tuple[Misfit, ...] | None = None,
    targets: Sequence[Target] = (),
) -> HeldOutEvaluation:
    """Learn from a part of each heliostat's sightings and assess the rest.

    Everything, including the model and the hyperparameters of the field, is learnt only from the
    training part.

    Parameters
    ----------
    names, mechanism
        Names and nominal mechanisms of N heliostats.
    sightings
        M sightings of these heliostats.
    model
        Name of a model, names of parameters, or "auto" to have the model chosen.
    split, fraction, seed
        How to choose the training part; see `heliotrope.calibration.evaluation.split`.
    priors
        Standard deviations that replace those of the table, by name.
    runner
        Runner that learns chunks elsewhere; see `heliotrope.calibration.learn.on_dask`.
    steps
        Progress.
    learner
        For the split "sequential": "stream" updates a belief sighting by sighting
        (`heliotrope.calibration.learn.stream`); "batch" learns from the whole history again each
        time.
    misfits
        As for `learn`.
    targets
        Targets of the plant, for `find_misfits`.

    Raises
    ------
    InputError
        If the fraction is not between 0 and 1 or the split is unknown.
    """
    training, tested = evaluation.partition(sightings, split, fraction, seed)
    choice = None
    if misfits is None:
        misfits = find_misfits(mechanism, sightings, training, targets)
    if model == "auto":
        fits = ~np.isin(sightings.heliostat, [misfit.row for misfit in misfits])
        choice = find_model(mechanism, sightings, training & fits, steps)
        model, mechanism = choice.parameters, choice.mechanism
    learned = learn(
        mechanism,
        sightings,
        model,
        used=training,
        priors=priors,
        misfits=misfits,
        runner=runner,
        progress=_step(steps, "learning from the training part"),
    )
    prediction = None
    if split == "sequential":
        step = _step(steps, "predicting each sighting from those before it")
        if learner == "stream":
            prediction = predict_by_stream(learned, progress=step)
        else:
            prediction = predict_in_turn(learned, priors=priors, runner=runner, progress=step)
    return HeldOutEvaluation(learned, assess(names, learned, prediction, tested), choice)


def calibrate(
    field: FieldSightings,
    model: str | tuple[str, ...] = "auto",
    *,
    split: Split = "random",
    fraction: float = 0.7,
    seed: int = 0,
    priors: Mapping[str, npt.ArrayLike] | None = None,
    runner: Runner | None = None,
    steps: Steps | None = None,
) -> CalibrationReport:
    """Learn every heliostat from all its sightings, and test on a held-out part.

    Parameters
    ----------
    field
        Heliostats and sightings.
    model, split, seed, priors, runner, steps
        As for `evaluate`; the model is chosen once, from all sightings.
    fraction
        Training fraction in the test; 1 for no test.
    """
    require("field", field, FieldSightings, "the result of read_field_sightings")
    require("fraction", fraction, numbers.Real, "a share from 0 to 1")
    require("seed", seed, numbers.Integral, "a whole number, 0 or more")
    if seed < 0:
        raise InputError(f"seed must be a whole number, 0 or more, not {seed}")
    if fraction != 1.0:
        evaluation.check_fraction(fraction)
    names, mechanism = field.heliostats.names, field.heliostats.mechanism
    misfits = find_misfits(mechanism, field.sightings, targets=field.plant.targets)
    fits = ~np.isin(field.sightings.heliostat, [misfit.row for misfit in misfits])
    comparison: tuple[str, ...] = ()
    if model == "auto":
        choice = find_model(mechanism, field.sightings, fits, steps)
        model, mechanism, comparison = choice.parameters, choice.mechanism, choice.describe()
    options: dict[str, Any] = {"priors": priors, "runner": runner, "misfits": misfits}
    tested = None
    if fraction != 1.0:
        tested = evaluate(
            names,
            mechanism,
            field.sightings,
            model,
            split=split,
            fraction=fraction,
            seed=seed,
            steps=steps,
            **options,
        ).assessment
    learned = learn(mechanism, field.sightings, model, progress=_step(steps, "learning"), **options)
    clock = clock_of(field, learned)
    return CalibrationReport(
        names,
        learned if clock is None or not clock.found else learned.doubted(),
        _with_mechanism(field.plant, field.group, mechanism),
        field.group,
        tested,
        field.ids,
        field.left_out,
        f"{split} split, {100 * fraction:.0f} % to learn from, seed {seed}",
        comparison,
        clock,
        field.notes,
    )


def clock_of(field: FieldSightings, learned: Learned) -> ClockCheck | None:
    """Return the common clock error, estimated from all heliostats that fit their sightings."""
    rows = [misfit.row for misfit in learned.misfits]
    observed = field.sightings.take(~np.isin(field.sightings.heliostat, rows))
    return check_clock(learned.mechanism, observed, learned.model, field.plant.site)


def _with_mechanism(plant: Plant, group: str, mechanism: Mechanism) -> Plant:
    """Return the plant with new nominal mechanisms, including found ratios, in one group."""
    if mechanism is plant.groups[group].mechanism:
        return plant
    changed = replace(plant.groups[group], mechanism=mechanism)
    return replace(plant, groups={**plant.groups, group: changed})


def _step(steps: Steps | None, name: str) -> Callable[[int, int], None] | None:
    return None if steps is None else lambda done, total: steps(name, done, total)
