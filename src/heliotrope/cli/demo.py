"""``heliotrope demo``: an example plant is measured, calibrated and tracked for a day."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli._common import print_json

if TYPE_CHECKING:
    from heliotrope.calibration.report.page import CalibrationReport
    from heliotrope.field.plant import Plant
    from heliotrope.geometry import FloatArray

#: The day of the demonstration; mirrors are measured during the week before it.
DAY = datetime(2026, 9, 2, tzinfo=UTC)
#: Noise of a centroid on the target, m.
CENTROID_NOISE = 5e-3


def demo(
    into: Annotated[Path, typer.Option(help="Folder for plant and report.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Of the imperfections and the noise.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Make an example plant, measure it, calibrate it, track a day, and write a report."""
    from heliotrope.calibration import evaluation
    from heliotrope.calibration.learn import assessment, learning
    from heliotrope.calibration.report.page import CalibrationReport
    from heliotrope.cli.calibrate import show_report
    from heliotrope.field.example import prototype, roughly_installed
    from heliotrope.field.formats.plant_file import write_plant
    from heliotrope.files.text import write_file

    say = (lambda _text: None) if as_json else print
    plant = prototype()
    group = plant.groups["azel"]
    truth = roughly_installed(group.mechanism, seed)
    into.mkdir(parents=True, exist_ok=True)
    say(f"plant: {len(plant)} heliostats, installed with errors of some 10 mrad")
    seen = _measure(plant, truth, seed)
    say(f"measured: {len(seen)} sightings on the target in the week before")
    model = (
        "tilt_north", "tilt_east", "azimuth_bias", "elevation_bias", "non_orthogonality",
        "canting", "position_east", "position_north", "position_up",
    )  # fmt: skip
    training = evaluation.split(seen, "random", 0.7, seed)
    tested = learning.learn(group.mechanism, seen, model, used=training)
    learned = learning.learn(group.mechanism, seen, model)
    result = CalibrationReport(
        group.names,
        learned,
        plant,
        "azel",
        assessment.assess(group.names, tested),
        note="random split, 70 % to learn from",
    )
    calibrated = plant.with_groups({"azel": result.results.apply(group)})
    write_plant(calibrated, into / "plant.toml")
    day = _track_day(calibrated, truth)
    picture = _day_picture(day)
    write_file(into / "day.png", lambda stream: picture.savefig(stream, dpi=110, format="png"))
    page = show_report(result, into / "report", quiet=as_json)
    figures = _figures(result, day)
    if as_json:
        print_json({**figures, "plant": str(into / "plant.toml"), "report": str(page)})
        return
    print(
        "beam error, median: {before_mrad:.2f} mrad as installed, {held_out_mrad:.3f} mrad "
        "calibrated, on measurements held out".format(**figures)
    )
    print(
        "tracked {date}, {positions} positions of {heliostats} heliostats: beam error against "
        "the true mirrors {day_before_mrad:.2f} mrad before, {day_after_mrad:.3f} mrad after "
        "(RMS)".format(**figures)
    )
    print(f"plant file: {into / 'plant.toml'}")
    print(f"the day:    {into / 'day.png'}")
    print(f"report:     {page}")


def _measure(plant: "Plant", truth: Any, seed: int) -> Any:
    """Sightings as a camera on the target takes them: every mirror, eight times a day."""
    import numpy as np

    from heliotrope import sun as solar
    from heliotrope.calibration.sightings import sightings
    from heliotrope.geometry import reflect
    from heliotrope.mechanism.tracking import track

    rng = np.random.default_rng((seed, 1))
    nominal = plant.groups["azel"].mechanism
    target = plant.targets[0]
    parts = []
    for back in range(7, 0, -2):
        day = (DAY - timedelta(days=back)).date()
        times = solar.daylight(day, plant.site, every=timedelta(minutes=70), min_elevation=0.2)
        suns = solar.vector(times, plant.site)
        for k, sun in enumerate(suns):
            wanted = track(nominal, sun, target.center)
            counts = np.round(wanted.chosen(wanted.counts))
            pose = truth.pose(counts)
            spot = target.intersect(pose.vertex, reflect(sun, pose.normal))
            noise = rng.normal(0.0, CENTROID_NOISE, (len(nominal), 2)) @ target.axes
            lit = np.flatnonzero(np.isfinite(spot).all(axis=-1))
            parts.append(
                (
                    lit,
                    counts[lit],
                    np.tile(sun, (len(lit), 1)),
                    (spot + noise)[lit],
                    np.full(len(lit), times[k].timestamp()),
                )
            )
    rows, counts, source, spots, seconds = (np.concatenate(p) for p in zip(*parts, strict=True))
    distance = np.linalg.norm(nominal.position[rows] - target.center, axis=-1)
    return sightings(rows, counts, source, spots, time=seconds, sigma=CENTROID_NOISE / distance)


def _track_day(plant: "Plant", truth: Any) -> dict[str, Any]:
    """Beam errors of the true mirrors over a day, commanded without and with calibration."""
    import numpy as np

    from heliotrope import sun as solar
    from heliotrope.geometry import angle_between, reflect
    from heliotrope.mechanism.tracking import track

    group = plant.groups["azel"]
    aim = plant.targets[0].center
    times = solar.daylight(DAY.date(), plant.site, every=timedelta(minutes=5), min_elevation=0.1)
    suns = solar.vector(times, plant.site)

    def beam(mechanism: Any) -> "FloatArray":
        wanted = track(mechanism, suns[:, None, :], aim)
        pose = truth.pose(np.round(wanted.chosen(wanted.counts)))
        way = aim - pose.vertex
        way = way / np.linalg.norm(way, axis=-1, keepdims=True)
        return angle_between(reflect(suns[:, None, :], pose.normal), way)

    return {
        "times": times,
        "names": group.names,
        "before": beam(group.mechanism),
        "after": beam(group.calibrated),
    }


def _figures(result: "CalibrationReport", day: dict[str, Any]) -> dict[str, Any]:
    import numpy as np

    rows = result.rows()
    return {
        "heliostats": len(result.names),
        "sightings": len(result.learned.sightings),
        "before_mrad": 1e3 * float(np.median([row.before.median for row in rows])),
        "held_out_mrad": 1e3 * float(np.median([row.held.median for row in rows])),
        "date": str(DAY.date()),
        "positions": len(day["times"]),
        "day_before_mrad": 1e3 * float(np.sqrt(np.mean(day["before"] ** 2))),
        "day_after_mrad": 1e3 * float(np.sqrt(np.mean(day["after"] ** 2))),
    }


def _day_picture(day: dict[str, Any]) -> Any:
    import numpy as np
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    ax = figure.subplots()
    hours = np.array([(t - DAY).total_seconds() / 3600.0 for t in day["times"]])
    for key, colour, label in (
        ("before", "#999999", "as installed"),
        ("after", "#0072b2", "calibrated"),
    ):
        lines = ax.plot(hours, 1e3 * day[key], color=colour, lw=0.8, alpha=0.7)
        lines[0].set_label(f"{label} (18 heliostats)")
    ax.set_yscale("log")
    ax.set_xlabel(f"hour of {DAY.date()}, UTC")
    ax.set_ylabel("beam error of the true mirror, mrad")
    ax.grid(alpha=0.3, which="both")
    ax.legend(frameon=False)
    return figure
