"""``heliotrope plan``: the next measurements of some heliostats or of a whole field."""

import sys
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._calibration import progress
from heliotrope.cli._common import (
    open_plant,
    parse_duration,
    parse_time,
    print_json,
    print_table,
)
from heliotrope.errors import FormatError, InputError, TimeError

if TYPE_CHECKING:
    from heliotrope.calibration.plan.campaign import Timing
    from heliotrope.calibration.plan.fleets import Fleet
    from heliotrope.calibration.plan.planning import SightingPlan
    from heliotrope.calibration.sightings import Sightings
    from heliotrope.field.plant import Plant
    from heliotrope.field.target import Target

#: Number of rows of a campaign that are displayed.
SHOWN = 20


def plan(
    field: Annotated[Path, typer.Argument(metavar="PLANT", help="Plant file or PAINT folder.")],
    heliostat: Annotated[
        list[str] | None, typer.Option(help="Heliostat; may be repeated. Default: all.")
    ] = None,
    begin: Annotated[
        str, typer.Option("--from", help="ISO 8601 with a time zone, or now.")
    ] = "now",
    end: Annotated[str | None, typer.Option("--to", help="ISO 8601 with a time zone.")] = None,
    days: Annotated[
        float | None,
        typer.Option(min=0.01, max=3660, help="Length in days instead of --to; default 7."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=100_000,
            help="Maximum number of measurements: per heliostat (default 10), or with --campaign "
            "in total (default no limit).",
        ),
    ] = None,
    target: Annotated[
        list[str] | None, typer.Option(help="Target with a camera; may be repeated. Default: all.")
    ] = None,
    model: Annotated[
        str, typer.Option(help="auto, jacks, malan8, guo6, khalsa8 or full.")
    ] = "auto",
    criterion: Annotated[
        Literal["d", "v"],
        typer.Option(
            help=("What measurements are chosen for: d, most information; v, smallest beam error.")
        ),
    ] = "d",
    sightings: Annotated[
        Path | None, typer.Option(help="Table of the sightings made so far.")
    ] = None,
    campaign: Annotated[
        bool,
        typer.Option(
            "--campaign",
            help="Schedule the whole field, with only one beam on each target at a time.",
        ),
    ] = False,
    every: Annotated[str, typer.Option(help="Step between the times considered.")] = "30m",
    sigma_mrad: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=1000,
            help="Standard deviation of a measured beam per direction, mrad.",
        ),
    ] = 0.5,
    settle: Annotated[str, typer.Option(help="Time for the beam to settle on the target.")] = "5s",
    exposure: Annotated[str, typer.Option(help="Exposure time of the camera.")] = "2s",
    clear: Annotated[str, typer.Option(help="Time for the beam to leave the target.")] = "5s",
    by_slot: Annotated[
        bool,
        typer.Option(
            "--by-slot", help="Campaign: plan one time slot at a time instead of one day at a time."
        ),
    ] = False,
    worth: Annotated[
        float,
        typer.Option(
            min=0,
            max=1,
            help="Campaign: minimum fraction by which a measurement must reduce the "
            "squared error of its heliostat.",
        ),
    ] = 0.05,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    csv: Annotated[Path | None, typer.Option("--csv", help="File for the table.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="File for the picture, .png, .svg or .pdf.")
    ] = None,
) -> None:
    """Plan the most informative measurements: times, targets, and the expected beam error."""
    from heliotrope.calibration.plan.campaign import Timing
    from heliotrope.calibration.plan.fleets import fleets_of
    from heliotrope.calibration.plan.report import check_picture

    if picture is not None:
        check_picture(picture)
    plant = open_plant(field)
    check_outputs((csv, picture), field, sightings)
    order = _PlanOrder(
        span=span_of(begin, end, days),
        targets=targets_of(plant, target),
        every=parse_duration(every).total_seconds(),
        timing=Timing(*(parse_duration(t).total_seconds() for t in (settle, exposure, clear))),
        count=count,
        csv=csv,
        picture=picture,
        as_json=as_json,
    )
    sigma = 1e-3 * sigma_mrad
    made = made_so_far(plant, sightings)
    with progress("computing the errors over the year", as_json) as step:
        fleets = fleets_of(
            plant,
            tuple(heliostat or ()),
            year=order.span[0].year,
            model=model,
            made=made,
            sigma=sigma,
            progress=step,
        )
    if campaign:
        _campaign(plant, fleets, order, ahead=not by_slot, worth=worth)
    else:
        _plans(plant, fleets, order, criterion)


@dataclass(frozen=True)
class _PlanOrder:
    span: tuple[datetime, datetime]
    targets: "tuple[Target, ...]"
    every: float
    timing: "Timing"
    count: int | None
    csv: Path | None
    picture: Path | None
    as_json: bool

    @property
    def seconds(self) -> tuple[float, float]:
        """The time span, in Unix seconds."""
        return self.span[0].timestamp(), self.span[1].timestamp()

    @property
    def target_names(self) -> list[str]:
        """Names of the targets."""
        return [t.name for t in self.targets]

    def print_json(self, document: dict[str, Any]) -> None:
        """Print a document with the time span."""
        print_json({"from": self.span[0], "to": self.span[1], **document})

    def print_files(self) -> None:
        """Report which files have been written."""
        for what, path in (("table", self.csv), ("picture", self.picture)):
            if path is not None:
                print(f"{what}: {path}")


def check_outputs(outputs: tuple[Path | None, ...], field: Path, sightings: Path | None) -> None:
    """Refuse an output that cannot be written, or that would replace an input or an output."""
    from heliotrope.files.documents import read_toml

    read = {path.resolve() for path in (field, sightings) if path is not None}
    if field.suffix.lower() == ".toml" and field.is_file():
        table = read_toml(field, "a plant file").get("heliostats")
        if isinstance(table, str):
            read.add((field.parent / table).resolve())
    written: set[Path] = set()
    for file in (path for path in outputs if path is not None):
        if file.resolve() in written:
            raise InputError(
                f"{file}: two outputs have this name; choose another name for one of them"
            )
        written.add(file.resolve())
        if not file.parent.is_dir():
            raise InputError(f"{file}: the folder {file.parent} does not exist; create it first")
        inside = field.is_dir() and field.resolve() in file.resolve().parents and file.exists()
        if file.resolve() in read or inside:
            raise InputError(f"{file}: this file is an input; choose another name for the output")


def span_of(begin: str, end: str | None, days: float | None) -> tuple[datetime, datetime]:
    """Return the start and end of a plan; by default it lasts a week."""
    start = parse_time(begin)
    if end is not None and days is not None:
        raise InputError("use --to or --days, not both")
    if end is not None:
        stop = parse_time(end)
    else:
        try:
            stop = start + timedelta(days=7.0 if days is None else days)
        except OverflowError:
            raise TimeError(f"--from {begin}: the period extends beyond the year 9999") from None
    if stop <= start:
        raise TimeError(f"--to {stop.isoformat()} is not after --from {start.isoformat()}")
    return start, stop


def targets_of(plant: "Plant", names: list[str] | None) -> "tuple[Target, ...]":
    """Return the targets with the given names, or all targets if there are no names."""
    targets = tuple(plant.target(name) for name in dict.fromkeys(names or ())) or plant.targets
    if not targets:
        raise InputError("this plant has no target; camera measurements need one")
    return targets


def made_so_far(plant: "Plant", path: Path | None) -> "Sightings | None":
    """Return the sightings in a table, and report which measurements were omitted."""
    if path is None:
        return None
    from heliotrope.calibration.plausibility import judge_in
    from heliotrope.calibration.sighting_table import read_sightings

    sightings, _, left_out = read_sightings(
        path, plant.names, lambda sightings, kinds: judge_in(plant, sightings, kinds).reasons
    )
    if not len(sightings):
        reason = f"; the first: {left_out[0]}" if left_out else ""
        raise FormatError(path, f"no sighting can be used{reason}")
    for line in left_out[:3]:
        print(f"left out: {line}", file=sys.stderr)
    if len(left_out) > 3:
        print(f"left out: {len(left_out) - 3} more", file=sys.stderr)
    return sightings


def _plans(
    plant: "Plant", fleets: "list[Fleet]", order: _PlanOrder, criterion: Literal["d", "v"]
) -> None:
    from heliotrope.calibration.plan import report
    from heliotrope.calibration.plan.fleets import plan_each

    with progress("planning", order.as_json) as step:
        plans, possible = plan_each(
            fleets,
            plant.site,
            order.targets,
            *order.seconds,
            every=order.every,
            slot=order.timing.slot,
            count=10 if order.count is None else order.count,
            criterion=criterion,
            progress=step,
        )
    tables = {name: report.plan_rows(name, mirror_plan) for name, mirror_plan in plans.items()}
    if order.csv is not None:
        report.write_table(order.csv, [row for rows in tables.values() for row in rows])
    if order.picture is not None:
        report.write_picture(order.picture, report.plan_picture(plans, possible))
    if order.as_json:
        document = report.plans_document(plans, fleets, order.target_names)
        order.print_json({"criterion": criterion, **document})
        return
    for name, mirror_plan in plans.items():
        _print_plan(name, mirror_plan, tables[name])
    order.print_files()


def _print_plan(name: str, mirror_plan: "SightingPlan", rows: list[dict[str, Any]]) -> None:
    print_table(
        ["time", "target", "sun azimuth", "elevation", "rank", "error"],
        [
            [
                r["time"],
                r["target"],
                f"{r['sun_azimuth_deg']:.1f}°",
                f"{r['sun_elevation_deg']:.1f}°",
                str(r["rank"]),
                f"{r['expected_beam_rms_mrad']:.2f}",
            ]
            for r in rows
        ],
        title=f"{name}: expected beam error {1e3 * mirror_plan.before:.2f} mrad before, "
        f"{1e3 * mirror_plan.error[-1]:.2f} mrad after",
    )


def _campaign(
    plant: "Plant", fleets: "list[Fleet]", order: _PlanOrder, *, ahead: bool, worth: float
) -> None:
    import numpy as np

    from heliotrope.calibration.plan import report
    from heliotrope.calibration.plan.campaign import plan_campaign

    with progress("scheduling", order.as_json) as step:
        campaign = plan_campaign(
            fleets,
            plant.site,
            order.targets,
            *order.seconds,
            timing=order.timing,
            every=order.every,
            ahead=ahead,
            worth=worth,
            count=order.count,
            progress=step,
        )
    document = report.campaign_document(campaign, fleets, order.target_names)
    rows = document["measurements"]
    if order.csv is not None:
        report.write_table(order.csv, rows)
    if order.picture is not None:
        position = np.concatenate([fleet.mechanism.position for fleet in fleets])
        figure = report.campaign_picture(campaign, position, order.target_names)
        report.write_picture(order.picture, figure)
    if order.as_json:
        order.print_json(document)
        return
    _print_campaign(rows)
    print(
        f"{len(rows):,} measurements in {campaign.slots:,} slots, "
        f"{len(np.unique(campaign.heliostat)):,} of {sum(map(len, fleets)):,} heliostats; expected "
        f"beam error of the field: {1e3 * campaign.before:.2f} mrad before, "
        f"{1e3 * campaign.after:.2f} mrad after"
    )
    order.print_files()


def _print_campaign(rows: list[dict[str, Any]]) -> None:
    print_table(
        ["time", "target", "heliostat", "leaves", "its error", "the field's"],
        [
            [
                r["time"],
                r["target"],
                r["heliostat"],
                r["leave"][11:19],
                f"{r['heliostat_expected_beam_rms_mrad']:.2f}",
                f"{r['field_expected_beam_rms_mrad']:.2f}",
            ]
            for r in rows[:SHOWN]
        ],
        title="expected beam error after each, mrad",
    )
    if len(rows) > SHOWN:
        print(f"and {len(rows) - SHOWN:,} more; --csv FILE writes them all")
