"""``heliotrope commission``: plan the days on which a new field is calibrated."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli._calibration import progress
from heliotrope.cli._common import open_plant, parse_duration, print_json, print_table
from heliotrope.cli.plan import check_outputs, made_so_far, span_of, targets_of

if TYPE_CHECKING:
    from heliotrope.calibration.plan.commission import CommissionPlan, CommissionTerms
    from heliotrope.calibration.plan.fleets import Fleet
    from heliotrope.calibration.plan.joint_terms import JointTerms
    from heliotrope.calibration.plan.receiver_terms import ReceiverTerms
    from heliotrope.field.plant import Plant

_MRAD = 1e-3


def commission(
    field: Annotated[Path, typer.Argument(metavar="PLANT", help="Plant file or PAINT folder.")],
    begin: Annotated[
        str, typer.Option("--from", help="ISO 8601 with a time zone, or now.")
    ] = "now",
    days: Annotated[float, typer.Option(min=0.01, max=3660, help="Length of the plan.")] = 3.0,
    goal_mrad: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=1000,
            help="Beam error that 90 % of the heliostats must not exceed, mrad.",
        ),
    ] = 0.6,
    installed_mrad: Annotated[
        float,
        typer.Option(
            min=0.001, max=1000, help="Expected beam error before the first measurement, mrad RMS."
        ),
    ] = 15.0,
    target: Annotated[
        list[str] | None, typer.Option(help="Target with a camera; may be repeated. Default: all.")
    ] = None,
    together: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=1000,
            help="Heliostats per later joint visit. Default: the plant file's; 1: none.",
        ),
    ] = None,
    first: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=1000,
            help="Heliostats per joint first visit. Default: the plant file's; 0: single visits.",
        ),
    ] = None,
    step: Annotated[str, typer.Option(help="Time per photograph in a joint visit.")] = "2.2s",
    shots: Annotated[int, typer.Option(min=1, max=1000, help="Photographs in a single visit.")] = 3,
    interval: Annotated[str, typer.Option(help="Time per photograph.")] = "20s",
    settle: Annotated[str, typer.Option(help="Time of a visit excluding the photographs.")] = "20s",
    look: Annotated[
        str, typer.Option(help="Time of each further search for a beam not found.")
    ] = "20s",
    sigma_mrad: Annotated[
        float,
        typer.Option(min=0.001, max=1000, help="Accuracy of a photograph per direction, mrad."),
    ] = 0.5,
    sigma_together_mrad: Annotated[
        float,
        typer.Option(min=0.001, max=1000, help="Accuracy of joint visits per direction, mrad."),
    ] = 0.22,
    repeat_mrad: Annotated[
        float,
        typer.Option(
            min=0,
            max=1000,
            help="Error that differs from visit to visit, per direction, mrad.",
        ),
    ] = 0.0,
    drone: Annotated[
        int,
        typer.Option(
            min=0, max=1000, help="Fly a drone first, with this many poses per heliostat."
        ),
    ] = 0,
    drones: Annotated[int, typer.Option(min=1, max=50, help="Drones flying at the same time.")] = 1,
    model: Annotated[
        str, typer.Option(help="auto, jacks, malan8, guo6, khalsa8 or full.")
    ] = "auto",
    sightings: Annotated[
        Path | None, typer.Option(help="Table of the sightings made so far.")
    ] = None,
    clear: Annotated[
        float, typer.Option(min=0.01, max=1, help="Fraction of the time without clouds.")
    ] = 1.0,
    every: Annotated[
        str, typer.Option(help="Interval at which the gain of each possible visit is computed.")
    ] = "30m",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    csv: Annotated[Path | None, typer.Option("--csv", help="File for the visits.")] = None,
    page: Annotated[Path | None, typer.Option(help="HTML file for the report.")] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture to write (.png, .svg or .pdf).")
    ] = None,
) -> None:
    """Plan the days on which a new field is calibrated to its goal: heliostats, times, targets."""
    from heliotrope.calibration.plan.commission import CommissionTerms
    from heliotrope.calibration.plan.report import check_picture

    if picture is not None:
        check_picture(picture)
    plant = open_plant(field)
    check_outputs((csv, page, picture), field, sightings)
    terms = CommissionTerms(
        goal=_MRAD * goal_mrad,
        settle=parse_duration(settle).total_seconds(),
        shots=shots,
        interval=parse_duration(interval).total_seconds(),
        look=parse_duration(look).total_seconds(),
        sigma=_MRAD * sigma_mrad,
        joint=_joint(plant, together, first, step, sigma_together_mrad),
        receiver=_receiver(plant, sigma_together_mrad),
        repeat=_MRAD * repeat_mrad,
        clear=clear,
        every=parse_duration(every).total_seconds(),
    )
    installed = _MRAD * installed_mrad
    start, stop = span_of(begin, None, days)
    fleets, measured, flight = _fleets(
        plant, start.year, model, sightings, terms, installed, (drone, drones), as_json
    )
    names = [t.name for t in targets_of(plant, target)]
    plan = _planned(
        plant, fleets, names, (start.timestamp(), stop.timestamp()), measured, terms, as_json
    )
    _tell(plan, plant, fleets, names, flight, (csv, page, picture), as_json)


def _joint(
    plant: "Plant", together: int | None, first: int | None, step: str, sigma_mrad: float
) -> "JointTerms | None":
    """Return the joint visits of the plant file, modified by the options."""
    from heliotrope.calibration.plan.joint_terms import JointTerms
    from heliotrope.errors import InputError
    from heliotrope.field.coded_visits import JointSettings

    if together == 1 or (plant.joint_visits is None and together is None):
        if first:
            raise InputError(
                f"--first {first}: joint visits are switched off; set --together to 2 or more"
            )
        return None
    settings = plant.joint_visits or JointSettings()
    most = settings.most if together is None else together
    alike = settings.first if together is None else min(settings.first, together)
    return replace(
        JointTerms.of(settings, 0.0),
        most=most,
        least=min(settings.least, most),
        first=alike if first is None else first,
        step=parse_duration(step).total_seconds(),
        sigma=_MRAD * sigma_mrad,
    )


def _receiver(plant: "Plant", sigma_mrad: float) -> "ReceiverTerms | None":
    """Return the receiver visits of the plant file."""
    from heliotrope.calibration.plan.receiver_terms import ReceiverTerms

    terms = ReceiverTerms.of(plant, 0.0)
    return None if terms is None else replace(terms, sigma=_MRAD * sigma_mrad)


def _fleets(
    plant: "Plant",
    year: int,
    model: str,
    sightings: Path | None,
    terms: "CommissionTerms",
    installed: float,
    flight: tuple[int, int],
    quiet: bool,
) -> "tuple[list[Fleet], Any, dict[str, Any] | None]":
    """Return the knowledge of all heliostats, the measured heliostats, and a flight's results."""
    import numpy as np

    from heliotrope.calibration.plan.fleets import fleets_of

    made = made_so_far(plant, sightings)
    with progress("computing the errors over the year", quiet) as step:
        fleets = fleets_of(
            plant,
            year=year,
            model=model,
            made=made,
            sigma=terms.sigma,
            installed=installed,
            progress=step,
        )
    measured = set() if made is None else {plant.names[i] for i in np.unique(made.heliostat)}
    labels = [name for fleet in fleets for name in fleet.labels]
    if not flight[0]:
        return fleets, np.array([name in measured for name in labels]), None
    fleets, summary = _flown(plant, fleets, model, flight, quiet)
    return fleets, np.ones(len(labels), dtype=np.bool_), summary


def _flown(
    plant: "Plant", fleets: "list[Fleet]", model: str, flight: tuple[int, int], quiet: bool
) -> "tuple[list[Fleet], dict[str, Any]]":
    """Return the fleets after a flight; each heliostat in them represents its whole cluster."""
    import numpy as np

    from heliotrope.airborne.plan import Craft, PlanSettings, PointSelection, plan_flight
    from heliotrope.errors import InputError

    points, drones = flight
    with progress("planning the flights", quiet) as step:
        flown = plan_flight(
            plant,
            PlanSettings(
                model=model, selection=PointSelection(points=points), craft=Craft(count=drones)
            ),
            step,
        )
    kinds = {fleet.names for fleet in fleets}
    if len(kinds) != 1:
        raise InputError(
            "--drone: the heliostat types use different models; choose one with --model"
        )
    (names,) = kinds
    gained: dict[str, Any] = {}
    for k, look in enumerate(flown.points):
        slope = look.plan.chosen.jacobian.reshape(-1, len(names))
        for i in flown.clusters.rows(k).tolist():
            gained[flown.mirrors.names[i]] = slope.T @ slope
    after = [
        replace(
            fleet,
            information=fleet.information + np.stack([gained[name] for name in fleet.labels]),
        )
        for fleet in fleets
    ]
    summary = flown.summary()
    keys = ("drones", "sorties", "hours", "working_days", "calibration_points")
    return after, {key: summary[key] for key in keys}


def _planned(
    plant: "Plant",
    fleets: "list[Fleet]",
    targets: list[str],
    span: tuple[float, float],
    measured: Any,
    terms: "CommissionTerms",
    quiet: bool,
) -> "CommissionPlan":
    import numpy as np

    from heliotrope.calibration.plan.commission import plan_commission

    wide = {
        name: max(float(w), float(h))
        for group in plant.groups.values()
        for name, w, h in zip(group.names, group.width, group.height, strict=True)
    }
    with progress("planning", quiet) as step:
        return plan_commission(
            fleets,
            plant.site,
            [plant.target(name) for name in targets],
            *span,
            size=np.array([wide[name] for fleet in fleets for name in fleet.labels]),
            measured=measured,
            terms=terms,
            progress=step,
        )


def _tell(
    plan: "CommissionPlan",
    plant: "Plant",
    fleets: "list[Fleet]",
    targets: list[str],
    flight: dict[str, Any] | None,
    files: tuple[Path | None, Path | None, Path | None],
    as_json: bool,
) -> None:
    from heliotrope.calibration.plan import commission_report as told
    from heliotrope.calibration.plan.report import write_picture, write_table

    csv, page, picture = files
    labels = [name for fleet in fleets for name in fleet.labels]
    if csv is not None:
        write_table(csv, told.visit_rows(plan, labels, targets))
    if page is not None:
        told.write_page(page, plan, plant.name, targets)
    if picture is not None:
        write_picture(picture, told.curve_picture(plan))
    if as_json:
        print_json({"flight": flight, **told.document(plan, labels, targets)})
        return
    _print_hours(told.hour_rows(plan, targets), plan)
    if flight is not None:
        print(
            f"before the first day: {flight['sorties']:,} flights of {flight['drones']} drones, "
            f"{flight['hours']:.0f} h, {flight['calibration_points']} poses per heliostat"
        )
    print(told.sentence(plan))
    for what, path in (("visits", csv), ("report", page), ("picture", picture)):
        if path is not None:
            print(f"{what}: {path}", file=sys.stdout)


def _print_hours(rows: list[dict[str, Any]], plan: "CommissionPlan") -> None:
    middle, high = 1e3 * plan.percentiles[0]
    print_table(
        ["hour", "target", "visits", "mirrors", "first", "error after", "median", "90 %"],
        [
            [
                r["hour"],
                r["target"],
                f"{r['visits']:,}",
                f"{r['mirrors']:,}",
                f"{r['first']:,}",
                f"{r['expected_beam_rms_mrad']:.2f}",
                f"{r['field_median_mrad']:.2f}",
                f"{r['field_90_mrad']:.2f}",
            ]
            for r in rows
        ],
        title=f"beam errors in mrad; field before the first visit: median {middle:.2f}, 90 % "
        f"{high:.2f}",
    )
