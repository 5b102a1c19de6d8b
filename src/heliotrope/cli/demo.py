"""``heliotrope demo``: measure, calibrate and track an example plant for a day."""

from datetime import date, timedelta
from pathlib import Path
from typing import Annotated, Any

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import print_json
from heliotrope.warm import compiling

#: The day of the demonstration; mirrors are measured during the week before it.
DAY = date(2026, 9, 2)
#: Number of heliostats with their own pictures in the report, enough to see what a report shows.
SECTIONS = 2
#: The usual parameters of this kind of mechanism, and the survey.
MODEL = (
    "tilt_north", "tilt_east", "azimuth_bias", "elevation_bias", "non_orthogonality",
    "canting", "position_east", "position_north", "position_up",
)  # fmt: skip


def demo(
    into: Annotated[Path, typer.Option(help="Folder for plant and report.")] = Path("out/demo"),
    seed: Annotated[
        int, typer.Option(min=0, max=2**63 - 1, help="Seed of the imperfections and the noise.")
    ] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Create an example plant, measure it, calibrate it, track it for a day, and report."""
    import numpy as np

    from heliotrope.calibration.demonstration import day_picture, measure, track_day
    from heliotrope.calibration.report.page import write_report
    from heliotrope.calibration.workflow import FieldSightings, calibrate
    from heliotrope.field.example import example_plant, roughly_installed
    from heliotrope.field.formats.plant_file import write_plant
    from heliotrope.files.text import write_file

    say = (lambda _text: None) if as_json else print
    plant = example_plant()
    group, target = plant.groups["azel"], plant.targets[0]
    truth = roughly_installed(group.mechanism, seed)
    into.mkdir(parents=True, exist_ok=True)
    say(f"plant: {len(plant)} heliostats, installed with errors of about 10 mrad")
    days = tuple(DAY - timedelta(days=back) for back in range(7, 0, -2))
    with compiling():
        sightings = measure(group.mechanism, truth, target, plant.site, days, seed=seed)
    say(f"measured: {len(sightings)} sightings on the target in the preceding week")
    report = calibrate(FieldSightings(plant, "azel", sightings, (), ()), MODEL, seed=seed)
    calibrated = plant.with_calibration(report.results)
    write_plant(calibrated, into / "plant.toml")
    day = track_day(calibrated.groups["azel"], truth, target.center, plant.site, DAY)
    figure = day_picture(day)
    write_file(into / "day.png", lambda stream: figure.savefig(stream, dpi=110, format="png"))
    with shared.progress("drawing", as_json) as advance:
        page = write_report(report, into / "report", advance, most=SECTIONS)
    figures: dict[str, Any] = {
        "heliostats": len(report.names),
        "sightings": len(sightings),
        "before_mrad": 1e3 * float(np.median([row.before.median for row in report.rows])),
        "held_out_mrad": 1e3 * float(np.median([row.held.median for row in report.rows])),
        "date": str(DAY),
        "positions": len(day.times),
        "day_before_mrad": 1e3 * day.rms[0],
        "day_after_mrad": 1e3 * day.rms[1],
    }
    if as_json:
        print_json({**figures, "plant": str(into / "plant.toml"), "report": str(page)})
        return
    print(
        "median beam error: {before_mrad:.2f} mrad as installed, {held_out_mrad:.3f} mrad "
        "calibrated, on held-out measurements".format(**figures)
    )
    print(
        "tracked {date}, {positions} positions of {heliostats} heliostats: beam error against "
        "the true mirrors {day_before_mrad:.2f} mrad before, {day_after_mrad:.3f} mrad after "
        "(RMS)".format(**figures)
    )
    print(f"plant file: {into / 'plant.toml'}")
    print(f"the day:    {into / 'day.png'}")
    print(f"report:     {page}")
