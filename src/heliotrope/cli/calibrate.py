"""``heliotrope calibrate``: learn the heliostats' imperfections from measurements."""

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._common import print_json, print_table

if TYPE_CHECKING:
    from heliotrope.calibration.report import Result


def calibrate(
    folder: Annotated[Path, typer.Argument(help="Folder with measurements, properties, tower.")],
    model: Annotated[str, typer.Option(help="jacks, full, malan8, guo6 or khalsa8.")] = "jacks",
    centroid: Annotated[
        Literal["utis", "helios"], typer.Option(help="Which published centroid to believe.")
    ] = "utis",
    split: Annotated[
        Literal["random", "chronological"], typer.Option(help="How sightings are held out.")
    ] = "random",
    fraction: Annotated[float, typer.Option(help="Share of the sightings to learn from.")] = 0.7,
    seed: Annotated[int, typer.Option(help="Of the random choice.")] = 0,
    report: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("out/calibration"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Fit each heliostat, test it on held-out measurements, and write a report with pictures."""
    result, left_out = _fit(folder, model, centroid, split, fraction, seed)
    from heliotrope.calibration.report import write_beside

    page = show_report(result, report, quiet=as_json)
    if as_json:
        print_json({**as_document(result), "left_out": left_out, "report": str(page)})
        return
    print_result(result)
    if left_out:
        listing = report / "left_out.txt"
        write_beside(listing, lambda p: p.write_text("\n".join(left_out) + "\n", encoding="utf-8"))
        reasons = Counter(line.split(": ", 1)[1] for line in left_out)
        for reason, count in reasons.most_common():
            print(f"left out: {count} measurements: {reason} (named in {listing})")
    print(f"report: {page}")


def _fit(
    folder: Path, model: str, centroid: Literal["utis", "helios"],
    split: Literal["random", "chronological"], fraction: float, seed: int,
) -> "tuple[Result, list[str]]":  # fmt: skip
    from heliotrope.calibration import estimator, evaluation
    from heliotrope.calibration.report import Result
    from heliotrope.calibration.sightings import of_measurements
    from heliotrope.errors import FormatError
    from heliotrope.field.formats import measurements, paint

    plant = paint.read_plant(folder)
    (group,) = plant.groups.values()
    found = measurements.read_measurements(folder, centroid=centroid)
    seen, left_out = of_measurements(found, group)
    if not len(seen):
        reason = f"; the first: {found.left_out[0]}" if found.left_out else ""
        raise FormatError(folder, f"no measurement can be used{reason}")
    training = evaluation.split(seen, split, fraction, seed)
    calibration = estimator.fit(group.mechanism, seen, model, keep=training)
    result = Result(group.names, group.mechanism, seen, calibration, training, model)
    return result, [*found.left_out, *left_out]


def show_report(result: "Result", folder: Path, quiet: bool) -> Path:
    """Write the report behind a progress bar."""
    from rich.progress import track as bar

    from heliotrope.calibration.report import write_report

    hidden = quiet or not sys.stdout.isatty()
    steps = iter(bar(range(len(result.names) + 1), "drawing", transient=True, disable=hidden))

    def advance(_done: int, _total: int) -> None:
        next(steps, None)

    return write_report(result, folder, advance)


def as_document(result: "Result") -> dict[str, Any]:
    """Return the figures of a calibration for JSON."""
    import numpy as np

    heliostats: dict[str, dict[str, Any]] = {}
    for i, (name, before, after, held, outcome) in enumerate(result.rows()):
        if not before.count:
            continue
        heliostats[name] = {
            "n": before.count,
            "before_median_beam_mrad": 1e3 * before.median,
            "training_median_beam_mrad": 1e3 * after.median,
            "training_rms_beam_mrad": 1e3 * after.rms,
            "n_held_out": held.count,
            "held_out_median_beam_mrad": 1e3 * held.median,
            "held_out_rms_beam_mrad": 1e3 * held.rms,
            "held_out_p95_beam_mrad": 1e3 * held.p95,
            "outcome": outcome.name.lower(),
            "parameters": {
                n: float(result.calibration.values[i, p])
                for p, n in enumerate(result.calibration.names)
            },
        }
    enough = [h["held_out_median_beam_mrad"] for h in heliostats.values() if h["n"] >= ENOUGH]
    overall = float(np.median(enough)) if enough else float("nan")
    return {
        "model": result.model,
        "heliostats": heliostats,
        f"median_of_medians_held_out_mrad_n{ENOUGH}": overall,
    }


#: Heliostats with fewer sightings than this are shown but do not enter the overall figure.
ENOUGH = 20


def print_result(result: "Result") -> None:
    """Print the table of a calibration and its one overall figure."""
    import numpy as np

    def shown(value: float) -> str:
        return f"{1e3 * value:.2f}" if np.isfinite(value) else "–"

    rows = []
    for name, before, after, held, outcome in result.rows():
        if before.count:
            rows.append(
                [name, str(before.count), shown(before.median), shown(after.median),
                 shown(held.median), shown(held.p95), outcome.name.lower()]
            )  # fmt: skip
    print_table(
        ["heliostat", "sightings", "median before", "after", "held out", "held out 95 %", "fit"],
        rows,
        title="beam error, mrad",
    )
    key = f"median_of_medians_held_out_mrad_n{ENOUGH}"
    overall = as_document(result)[key]
    if np.isfinite(overall):
        print(f"median of the held-out medians (heliostats with {ENOUGH} or more): "
              f"{overall:.2f} mrad of beam")  # fmt: skip
