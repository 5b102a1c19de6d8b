"""``heliotrope evaluate``: how well held-out sightings are predicted."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import open_plant, print_json, print_table
from heliotrope.warm import compiling

if TYPE_CHECKING:
    from heliotrope.calibration.obstruction import Unobstructed
    from heliotrope.calibration.workflow import FieldSightings


def evaluate(
    place: shared.Place,
    split: shared.SplitOption = "random",
    fraction: Annotated[
        float,
        typer.Option(
            min=0.01, max=0.999, help="Fraction of the sightings to fit; the others are the test."
        ),
    ] = 0.7,
    seed: shared.SeedOption = 0,
    model: shared.ModelOption = "auto",
    sightings: shared.TableOption = None,
    centroid: shared.CentroidOption = "utis",
    prior: shared.PriorOption = None,
    scheduler: shared.SchedulerOption = None,
    learner: Annotated[
        Literal["stream", "batch"],
        typer.Option(
            help="How --split sequential adds each sighting: by updating the last fit, or by "
            "fitting from scratch."
        ),
    ] = "stream",
    neighbours: Annotated[
        bool,
        typer.Option(
            "--neighbours", help="Correct centroids for shading and blocking by neighbours."
        ),
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn from some of each heliostat's sightings and print the errors of the others.

    Everything is learnt from the training part alone, including the model and the hyperparameters
    of the field.
    """
    import time

    from heliotrope.calibration import evaluation, workflow
    from heliotrope.calibration.learn.assessment import unexplained_mirrors

    evaluation.check_fraction(fraction)
    priors = shared.parse_priors(prior or [])
    plant = open_plant(place)
    with compiling():
        field = workflow.read_field_sightings(
            plant, place, sightings, centroid=centroid, now=time.time()
        )
        freed = _unobstructed(field) if neighbours else None
    with shared.workers(scheduler) as runner, shared.progress_of_steps(as_json) as steps:
        outcome = workflow.evaluate(
            field.heliostats.names,
            field.heliostats.mechanism,
            field.sightings if freed is None else freed.sightings,
            shared.parse_model(model),
            split=split,
            fraction=fraction,
            seed=seed,
            priors=priors,
            runner=runner,
            steps=steps,
            learner=learner,
            targets=plant.targets,
        )
    document = {
        "split": split,
        "fraction": fraction,
        "seed": seed,
        **outcome.document(),
        "left_out": list(field.left_out),
    }
    clock = workflow.clock_of(field, outcome.learned)
    document["clock"] = None if clock is None else clock.document()
    if freed is not None:
        document["neighbours"] = freed.summary()
    document["unexplained_mirrors"] = unexplained_mirrors(field.heliostats.names, outcome.learned)
    document["unusable_sightings"] = [field.ids[k] for k in outcome.assessment.unusable]
    document["unexplained_sightings"] = [field.ids[k] for k in outcome.assessment.unexplained]
    if as_json:
        print_json(document)
        return
    _print(document)
    for line in (*field.notes, *([] if clock is None else [str(clock)])):
        print(line)
    _print_left_out(document)
    shared.print_left_out(field.left_out)
    if freed is not None:
        print(freed)
    for line in outcome.choice.describe() if outcome.choice else ():
        print(line)


def _unobstructed(field: "FieldSightings") -> "Unobstructed":
    """Return the sightings corrected for neighbours, assumed to aim at the first receiver."""
    from heliotrope.calibration.obstruction import unobstructed

    plant = field.plant
    aim = (plant.receivers or plant.targets)[0].center
    return unobstructed(field.heliostats, plant.targets, field.sightings, aim)


def _print_axes(document: dict[str, Any], shown: Callable[[Any], str]) -> None:
    keys = ("gamma_0_mrad", "sigma_gamma_mrad", "alpha_0_mrad", "sigma_alpha_mrad")
    rows = [
        [name, *(shown(h[key]) for key in keys)]
        for name, h in document["heliostats"].items()
        if keys[0] in h
    ]
    print_table(
        ["heliostat", "γ₀", "σγ", "α₀", "σα"],
        rows,
        title="each axis, mrad: offset before the fit, scatter after it (Guo (44)-(47))",
    )


def _print_left_out(document: dict[str, Any]) -> None:
    if document["unexplained_sightings"]:
        print(
            "no mechanism explains the sightings "
            f"{', '.join(document['unexplained_sightings'])}; without them the mean of means is "
            f"{document['mean_of_means_explained_mrad']:.2f} mrad"
        )
    for line in document["unexplained_mirrors"]:
        print(line)
    if document["unusable_sightings"]:
        print(
            f"left out: {', '.join(document['unusable_sightings'])}: motor counts are outside "
            "the range of the drives; check them against the measurement log"
        )


def _print(document: dict[str, Any]) -> None:
    def shown(value: Any, digits: int = 2) -> str:
        return f"{value:.{digits}f}" if value is not None and math.isfinite(value) else "–"

    rows = [
        [
            name,
            str(h["n"]),
            str(h["n_held_out"]),
            shown(h["median_beam_mrad"]),
            shown(h["mean_beam_mrad"]),
            shown(h["rms_beam_mrad"]),
            shown(h["p95_beam_mrad"]),
            shown(h["median_normal_mrad"]),
            shown(h["coverage_90"]),
        ]
        for name, h in document["heliostats"].items()
    ]
    print_table(
        [
            "heliostat",
            "sightings",
            "held out",
            "median",
            "mean",
            "RMS",
            "95 %",
            "normal, median",
            "in 90 % ellipse",
        ],
        rows,
        title=f"beam error of held-out sightings, mrad ({document['split']} split)",
    )
    _print_axes(document, shown)
    group = f"heliostats with {document['enough']} or more"
    if not document["enough"]:
        group = "all heliostats (none has 20 sightings)"
    print(
        f"{group}: median of medians "
        f"{shown(document['median_of_medians_mrad'])} mrad, mean of means "
        f"{shown(document['mean_of_means_mrad'])} mrad, "
        f"{shown(100 * document['coverage_90'], 1)} % within the 90 % ellipse"
    )
    if document["blunders_held_out"]:
        print(
            f"{document['blunders_held_out']} held-out sightings lie more than 5.3 standard "
            "deviations away; every figure includes them"
        )
