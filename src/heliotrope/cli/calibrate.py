"""``heliotrope calibrate``: learn the heliostats' imperfections from measurements."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import print_json, print_table

if TYPE_CHECKING:
    from heliotrope.calibration.report.page import CalibrationReport


def calibrate(
    place: shared.Place,
    model: shared.ModelOption = "auto",
    sightings: shared.TableOption = None,
    centroid: shared.CentroidOption = "utis",
    prior: shared.PriorOption = None,
    split: shared.SplitOption = "random",
    fraction: Annotated[
        float, typer.Option(help="Share to learn from when testing; 1: no test.")
    ] = 0.7,
    seed: shared.SeedOption = 0,
    scheduler: shared.SchedulerOption = None,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("out/calibration"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Learn every heliostat from all its sightings, test on held-out ones, write a report."""
    from heliotrope.calibration import evaluation
    from heliotrope.calibration.learn import assessment
    from heliotrope.calibration.report.page import CalibrationReport

    priors = shared.parse_priors(prior or [])
    if fraction != 1.0:
        evaluation.check_fraction(fraction)
    loaded = shared.load(place, centroid, sightings)
    chosen, scored = shared.choose_model(loaded, model, as_json)
    options: dict[str, Any] = {"priors": priors, "scheduler": scheduler, "quiet": as_json}
    assessed = None
    if fraction != 1.0:
        training = evaluation.split(loaded.seen, split, fraction, seed)
        tested = shared.learn(loaded, chosen, used=training, **options)
        assessed = assessment.assess(loaded.heliostats.names, tested)
    learned = shared.learn(loaded, chosen, **options)
    note = f"{split} split, {100 * fraction:.0f} % to learn from, seed {seed}"
    result = CalibrationReport(
        loaded.heliostats.names,
        learned,
        loaded.plant,
        loaded.group,
        assessed,
        loaded.ids,
        loaded.left_out,
        note,
        shared.describe(scored),
    )
    _show(result, report, as_json)


def _show(result: "CalibrationReport", report: Path, as_json: bool) -> None:
    from heliotrope.files.text import write_text

    page = show_report(result, report, quiet=as_json)
    left_out = result.left_out
    if as_json:
        print_json({**as_document(result), "left_out": left_out, "report": str(page)})
        return
    print_result(result)
    for line in result.comparison:
        print(line)
    if left_out:
        listing = report / "left_out.txt"
        write_text(listing, "\n".join(left_out) + "\n")
        reasons = Counter(line.split(": ", 1)[-1] for line in left_out)
        for reason, count in reasons.most_common():
            print(f"left out: {count} measurements: {reason} (named in {listing})")
    print(f"report: {page}")


def show_report(result: "CalibrationReport", folder: Path, quiet: bool) -> Path:
    """Write the report behind a progress bar."""
    from heliotrope.calibration.report.page import write_report

    with shared.progress("drawing", quiet) as advance:
        return write_report(result, folder, advance)


def as_document(result: "CalibrationReport") -> dict[str, Any]:
    """Return the figures of a calibration for JSON."""
    learned, found = result.learned, result.results
    tested = {h.name: h for h in result.assessment.heliostats} if result.assessment else {}
    heliostats: dict[str, dict[str, Any]] = {}
    for row in result.rows():
        mine = learned.sightings.heliostat == row.index
        heliostats[row.name] = {
            "n": row.before.count,
            "outliers": int(learned.outlier[mine].sum()),
            "before_median_beam_mrad": 1e3 * row.before.median,
            "after_median_beam_mrad": 1e3 * row.after.median,
            "after_rms_beam_mrad": 1e3 * row.after.rms,
            "n_held_out": row.held.count,
            "held_out_median_beam_mrad": 1e3 * row.held.median,
            "held_out_rms_beam_mrad": 1e3 * row.held.rms,
            "held_out_p95_beam_mrad": 1e3 * row.held.p95,
            "held_out_coverage_90": tested[row.name].coverage if row.name in tested else None,
            "outcome": row.outcome.name.lower(),
            "parameters": {n: float(found.values[row.index, p]) for p, n in enumerate(found.names)},
            "sigma": {n: float(found.sigma[row.index, p]) for p, n in enumerate(found.names)},
        }
    document: dict[str, Any] = {"model": list(learned.model), "heliostats": heliostats}
    if result.assessment is not None:
        document["held_out_median_of_medians_mrad"] = 1e3 * result.assessment.median_of_medians
        document["held_out_coverage_90"] = result.assessment.coverage
    return document


def print_result(result: "CalibrationReport") -> None:
    """Print the table of a calibration and its overall figures."""
    import numpy as np

    def shown(value: float) -> str:
        return f"{1e3 * value:.2f}" if np.isfinite(value) else "–"

    learned = result.learned
    rows = [
        [
            row.name,
            str(row.before.count),
            str(int(learned.outlier[learned.sightings.heliostat == row.index].sum())),
            shown(row.before.median),
            shown(row.after.median),
            shown(row.held.median),
            shown(row.held.p95),
            row.outcome.name.lower(),
        ]
        for row in result.rows()
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
    a = result.assessment
    if a is not None and np.isfinite(a.median_of_medians):
        print(
            f"median of the held-out medians (heliostats with {a.fewest} or more): "
            f"{1e3 * a.median_of_medians:.2f} mrad of beam; {100 * a.coverage:.0f} % within the "
            "90 % ellipse"
        )
