"""``heliotrope evaluate``: how well a field is learnt, on sightings that were held out."""

from typing import Annotated, Any

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import print_json, print_table


def evaluate(
    place: shared.Place,
    split: shared.SplitOption = "random",
    fraction: Annotated[float, typer.Option(help="Share of the sightings to learn from.")] = 0.7,
    seed: shared.SeedOption = 0,
    model: shared.ModelOption = "auto",
    sightings: shared.TableOption = None,
    centroid: shared.CentroidOption = "utis",
    prior: shared.PriorOption = None,
    scheduler: shared.SchedulerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn from a part of each heliostat's sightings and print the errors of the rest.

    Everything, the model and what is common to the field included, is learnt from the
    training part alone.
    """
    from heliotrope.calibration import evaluation
    from heliotrope.calibration.learn import assessment

    evaluation.check_fraction(fraction)
    priors = shared.parse_priors(prior or [])
    loaded = shared.load(place, centroid, sightings)
    training = evaluation.split(loaded.seen, split, fraction, seed)
    chosen, scored = shared.choose_model(loaded, model, as_json, training)
    learned = shared.learn(
        loaded, chosen, used=training, priors=priors, scheduler=scheduler, quiet=as_json
    )
    found = assessment.assess(loaded.heliostats.names, learned)
    document: dict[str, Any] = {
        "split": split,
        "fraction": fraction,
        "seed": seed,
        "model": list(learned.model),
        **found.document(),
        "left_out": list(loaded.left_out),
    }
    if scored:
        document["models"] = {
            c.name: {
                "parameters": len(c.parameters),
                "log_predictive": c.log_predictive,
                "behind": c.behind,
                "behind_error": c.behind_error,
                "log_evidence": c.log_evidence,
            }
            for c in scored
        }
    if as_json:
        print_json(document)
        return
    _print(document)
    for line in shared.describe(scored):
        print(line)


def _print(document: dict[str, Any]) -> None:
    import math

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
    whose = f"heliostats with {document['enough']} or more"
    if not document["enough"]:
        whose = "all heliostats (none has 20 sightings)"
    print(
        f"{whose}: median of medians "
        f"{shown(document['median_of_medians_mrad'])} mrad, mean of means "
        f"{shown(document['mean_of_means_mrad'])} mrad, "
        f"{shown(100 * document['coverage_90'], 1)} % within the 90 % ellipse"
    )
    if document["blunders_held_out"]:
        print(
            f"{document['blunders_held_out']} held-out sightings lie more than 5.3 standard "
            "deviations away; they are in every figure"
        )
