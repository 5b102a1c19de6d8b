"""The heliostats to plan for, with what is known of their parameters, in one fleet per kind."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.plan.planning import (
    CandidateSightings,
    Criterion,
    SightingPlan,
    candidate_sightings,
    plan_sightings,
    time_grid,
)
from heliotrope.calibration.sightings import Sightings
from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year
from heliotrope.errors import InputError
from heliotrope.field.heliostats import Heliostats
from heliotrope.field.plant import Plant
from heliotrope.field.target import Target
from heliotrope.geometry import FloatArray, as_vectors
from heliotrope.mechanism import parameters as parameter_table
from heliotrope.mechanism.chain import Mechanism
from heliotrope.sun import Site

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Fleet:
    """N heliostats of one kind, with what is known of their parameters.

    Attributes
    ----------
    mechanism
        Best estimates, batch shape (N,).
    names
        P parameters of the model.
    information
        Information matrix of the parameters so far, (N, P, P); see `precision`.
    form
        Quadratic form of the squared beam error, (N, P, P); see `error_form`. A heliostat whose
        form is 0 does not count and is never measured in a campaign.
    aim
        Aim points between measurements, ENU metres, (N, 3).
    sigma
        Standard deviation of the measured beam direction, rad.
    labels
        Names of the heliostats, (N,); may be empty.
    """

    mechanism: Mechanism
    names: tuple[str, ...]
    information: FloatArray
    form: FloatArray
    aim: FloatArray
    sigma: float = 5e-4
    labels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.mechanism.shape) != 1:
            raise InputError(
                f"mechanisms must have one axis (N,), not the shape {self.mechanism.shape}"
            )
        count, p = len(self.mechanism), len(self.names)
        for name in ("information", "form"):
            shape = getattr(self, name).shape
            if shape != (count, p, p):
                raise InputError(f"fleet: {name} has the shape {shape}; expected {(count, p, p)}")
        aim = np.broadcast_to(as_vectors(self.aim, "aim"), (count, 3))
        object.__setattr__(self, "aim", aim)

    def __len__(self) -> int:
        return len(self.mechanism)


def fleets_of(
    plant: Plant,
    heliostats: Sequence[str] = (),
    *,
    year: int,
    model: str = "auto",
    made: Sightings | None = None,
    sigma: float = 5e-4,
    installed: float | None = None,
    progress: Progress | None = None,
) -> list[Fleet]:
    """Return the heliostats of a plant, one fleet per group.

    Parameters
    ----------
    plant
        Plant whose heliostats aim at their own aim points or, by default, at the first receiver or
        target.
    heliostats
        Names; default: all.
    year
        Calendar year whose sun positions weight the beam error.
    model
        A model of the parameter table, or "auto" for the usual model of the kind of mechanism.
    made
        Sightings made so far; indices refer to ``plant.names``.
    sigma
        Standard deviation of a measured beam direction, rad.
    installed
        Expected beam error of a group before any sighting, rad RMS, to which its priors are scaled.
        Default: the priors of the table, unscaled.
    progress
        Called with the numbers of groups (done, total).

    Raises
    ------
    UnknownNameError
        If a heliostat or model does not exist.
    """
    chosen = set(heliostats or plant.names)
    for name in chosen:
        plant.find(name)
    suns = suns_of_year(plant.site, year)
    place = {name: i for i, name in enumerate(plant.names)}
    fleets = []
    for done, group in enumerate(plant.groups.values()):
        if progress:
            progress(done, len(plant.groups))
        rows = np.array([i for i, n in enumerate(group.names) if n in chosen], dtype=np.intp)
        if not rows.size:
            continue
        labels = tuple(group.names[i] for i in rows)
        mechanism, aim = group.calibrated[rows], _aims(plant, group)[rows]
        kind = _usual_model(mechanism) if model == "auto" else model
        names = parameter_table.model(kind, mechanism.parameters)
        observed = None if made is None else _of(made, [place[n] for n in labels], len(place))
        known = precision(mechanism, names, observed)
        form = error_form(mechanism, aim, suns, names)
        if installed is not None:
            prior = precision(mechanism, names)
            known = known + (_mean_square(prior, form) / installed**2 - 1.0) * prior
        fleets.append(Fleet(mechanism, names, known, form, aim, sigma, labels))
    return fleets


def _mean_square(information: FloatArray, form: FloatArray) -> float:
    """Return the expected squared beam error of heliostats that can serve their aim, rad²."""
    counts = form.any(axis=(1, 2))
    square = np.einsum("npq,nqp->n", form[counts], np.linalg.inv(information[counts]))
    return float(square.mean()) if counts.any() else np.nan


def _of(made: Sightings, rows: list[int], total: int) -> Sightings:
    """Return the sightings of the plant's heliostats ``rows``, with indices into ``rows``."""
    number = np.full(total, -1, dtype=np.intp)
    number[rows] = np.arange(len(rows))
    part = made.take(np.flatnonzero(number[made.heliostat] >= 0))
    return part.renumbered(number[part.heliostat])


def _usual_model(mechanism: Mechanism) -> str:
    for name in ("jacks", "malan8"):
        if all(p in mechanism.parameters for p in parameter_table.MODELS[name]):
            return name
    return "full"


def _aims(plant: Plant, group: Heliostats) -> FloatArray:
    centers = [s.center for s in plant.receivers] + [s.center for s in plant.targets]
    common = np.broadcast_to(centers[0], (len(group), 3))
    if group.aim is None:
        return common
    return np.where(np.isfinite(group.aim).all(axis=-1, keepdims=True), group.aim, common)


def plan_each(
    fleets: Sequence[Fleet],
    site: Site,
    targets: tuple[Target, ...],
    start: float,
    stop: float,
    *,
    every: float,
    slot: float,
    count: int = 10,
    criterion: Criterion = "d",
    progress: Progress | None = None,
) -> tuple[dict[str, SightingPlan], CandidateSightings]:
    """Return a plan for each heliostat, by name, and the candidates of the first heliostat.

    Each heliostat has its own part of a time step, so that no two heliostats use a target at once.

    Parameters
    ----------
    fleets
        Fleets with labels.
    site, targets
        Location and atmosphere; targets with cameras.
    start, stop
        Unix seconds (UTC).
    every
        Step between the times considered, s.
    slot
        Time for which one beam occupies a target, s.
    count
        Number of measurements per heliostat.
    criterion
        As for `plan_sightings`.
    progress
        Called with the numbers of heliostats (done, total).

    Raises
    ------
    InputError
        If a heliostat cannot be measured in the time span.
    """
    times = time_grid(start, stop, every)
    rows = [(fleet, i) for fleet in fleets for i in range(len(fleet))]
    plans: dict[str, SightingPlan] = {}
    taken: set[tuple[int, float]] = set()
    possible = None
    for number, (fleet, i) in enumerate(rows):
        shift = slot * (number % max(1, int(every // slot)))
        candidates = candidate_sightings(
            fleet.mechanism[i : i + 1], site, targets, times + shift, fleet.names, sigma=fleet.sigma
        )
        candidates = candidates.take(_free(candidates, taken, stop - slot))
        name = fleet.labels[i]
        if not len(candidates):
            raise InputError(
                f"heliostat {name}: no measurement is possible, because sun, end stops, limits or "
                "visits of other heliostats leave no time; lengthen the period"
            )
        plans[name] = plan_sightings(
            candidates, count, fleet.information[i], fleet.form[i], criterion=criterion
        )
        chosen = plans[name].chosen
        taken |= {(int(k), float(t)) for k, t in zip(chosen.target, chosen.time, strict=True)}
        possible = possible or candidates
        if progress:
            progress(number + 1, len(rows))
    if possible is None:
        raise InputError("planning: there is no heliostat to plan for")
    return plans, possible


def _free(
    candidates: CandidateSightings, taken: set[tuple[int, float]], latest: float
) -> npt.NDArray[np.bool_]:
    """Return a mask of the candidates that end within the span, on a target that is then free."""
    pairs = zip(candidates.target, candidates.time, strict=True)
    return np.array(
        [t <= latest and (int(k), float(t)) not in taken for k, t in pairs], dtype=np.bool_
    )
