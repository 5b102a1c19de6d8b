"""``heliotrope calibrate``: learn the imperfections of heliostats from measurements."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import open_plant, print_json, print_table
from heliotrope.warm import compiling

if TYPE_CHECKING:
    from heliotrope.calibration.report.content import CalibrationReport


def calibrate(
    place: shared.Place,
    model: shared.ModelOption = "auto",
    sightings: shared.TableOption = None,
    centroid: shared.CentroidOption = "utis",
    prior: shared.PriorOption = None,
    split: shared.SplitOption = "random",
    fraction: Annotated[
        float,
        typer.Option(
            min=0.01,
            max=1,
            help="Fraction of the sightings to fit when testing on the others; 1: no test.",
        ),
    ] = 0.7,
    seed: shared.SeedOption = 0,
    scheduler: shared.SchedulerOption = None,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("out/calibration"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn heliostats from their sightings, test on held-out sightings, and write a report."""
    import time

    from heliotrope.calibration import evaluation, workflow
    from heliotrope.calibration.report.page import write_report
    from heliotrope.files.text import write_text

    priors = shared.parse_priors(prior or [])
    if fraction != 1.0:
        evaluation.check_fraction(fraction)
    plant = open_plant(place)
    with compiling():
        field = workflow.read_field_sightings(
            plant, place, sightings, centroid=centroid, now=time.time()
        )
    with shared.workers(scheduler) as runner, shared.progress_of_steps(as_json) as steps:
        content = workflow.calibrate(
            field,
            shared.parse_model(model),
            split=split,
            fraction=fraction,
            seed=seed,
            priors=priors,
            runner=runner,
            steps=steps,
        )
    with shared.progress("drawing", as_json) as advance:
        page = write_report(content, report, advance)
    left_out = content.left_out
    listing = report / "left_out.txt"
    if left_out:
        write_text(listing, "\n".join(left_out) + "\n")
    if as_json:
        print_json({**content.document(), "left_out": left_out, "report": str(page)})
        return
    _print(content)
    shared.print_left_out(left_out, listing)
    print(f"report: {page}")


def _print_guo(content: "CalibrationReport") -> None:
    from heliotrope.mechanism.guo_names import NAMES

    parameters = content.guo
    if parameters is None:
        return
    six = [name for name, (_, _, unit) in NAMES.items() if unit == "°"]
    print_table(
        ["heliostat", *(NAMES[name][0] for name in six)],
        [[row, *(f"{values[f'{n}_deg']:.4f}" for n in six)] for row, values in parameters.items()],
        title="Guo's six parameters, °",
    )


def _print(content: "CalibrationReport") -> None:
    def shown(value: float) -> str:
        return f"{1e3 * value:.2f}" if math.isfinite(value) else "–"

    rows = [
        [
            row.name,
            str(row.before.count),
            str(row.outliers),
            shown(row.before.median),
            shown(row.after.median),
            shown(row.held.median),
            shown(row.held.p95),
            row.outcome.name.lower(),
        ]
        for row in content.rows
    ]
    print_table(
        [
            "heliostat",
            "sightings",
            "outliers",
            "median before",
            "after",
            "held out",
            "held out 95 %",
            "fit",
        ],
        rows,
        title="beam error, mrad",
    )
    _print_guo(content)
    a = content.assessment
    if a is not None and math.isfinite(a.median_of_medians):
        print(
            f"median of the held-out medians (heliostats with {a.fewest} or more): "
            f"{1e3 * a.median_of_medians:.2f} mrad beam error; {100 * a.coverage:.0f} % within the "
            "90 % ellipse"
        )
    for line in (*content.remarks, *content.comparison):
        print(line)
