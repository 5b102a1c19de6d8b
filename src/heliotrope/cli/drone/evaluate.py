"""``heliotrope drone evaluate``: mirror orientations from a drone's photographs."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import open_plant, print_json, print_table
from heliotrope.cli.drone import _shared as shared

if TYPE_CHECKING:
    from heliotrope.airborne.evaluate.flight import CampaignResult
    from heliotrope.airborne.evaluate.reference import Compared

#: Maximum number of warnings, and of orientations, that are printed.
_WARNINGS, _ORIENTATIONS = 12, 40


def evaluate(
    folder: shared.CampaignArgument,
    field: shared.FieldOption,
    camera: shared.CameraOption = None,
    commands: shared.CommandsOption = None,
    cluster: shared.ClusterOption = "",
    point: shared.PointOption = "",
    slopes: Annotated[
        Path | None,
        typer.Option(help="Folder of slope maps: NAME.npz, NAME.csv or (PAINT) NAME.h5."),
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Table (CSV) of normals from another method, to compare with the result."
        ),
    ] = None,
    axis: Annotated[
        Literal["area", "plain"],
        typer.Option(
            help="Optical axis: mean of the normals over the mirror area, or over the "
            "reflections with equal weights (plain)."
        ),
    ] = "area",
    matches: Annotated[
        Path | None,
        typer.Option(
            help="Table (CSV) of mirrors identified by hand, as prepared by `drone match`."
        ),
    ] = None,
    focal: shared.FocalOption = None,
    survey_mm: shared.SurveyOption = 10.0,
    kinematics_mm: shared.KinematicsOption = 30.0,
    rtk_mm: shared.RtkOption = 30.0,
    out: shared.OutOption = Path("out/drone"),
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write the report with its plots.")
    ] = True,
    processes: shared.ProcessesOption = 0,
    scheduler: calibration.SchedulerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Find mirrors and the lamp in a drone's photographs, and print orientations with accuracy."""
    from heliotrope.airborne.evaluate.bundle import Priors
    from heliotrope.airborne.evaluate.flight import evaluate_flight
    from heliotrope.airborne.evaluate.reference import (
        compare,
        read_reference,
        reference_document,
    )
    from heliotrope.airborne.evaluate.reference_page import write_reference
    from heliotrope.airborne.evaluate.report import write_result

    known = None if reference is None else read_reference(reference)
    with calibration.connected(scheduler) as client, shared.stages(as_json) as progress:
        result = evaluate_flight(
            folder,
            open_plant(field),
            camera=camera,
            commands=commands,
            cluster=cluster,
            point=point,
            slopes=slopes,
            focal=float("inf") if focal is None else focal,
            axis=axis,
            matches=matches,
            priors=Priors(1e-3 * rtk_mm, 1e-3 * survey_mm, 1e-3 * kinematics_mm),
            keep=out / "photographs",
            processes=shared.cores(processes),
            client=client,
            progress=progress,
        )
    for line in (*result.warnings, *result.not_used, *result.impossible):
        print(f"heliotrope: {line}", file=sys.stderr)
    with calibration.progress("drawing", as_json) as advance:
        write_result(result, out, page=report, progress=advance)
        compared = () if known is None else compare(result.flights, known)
        if compared:
            write_reference(compared, out, page=report)
    if as_json:
        print_json(result.document() | reference_document(compared))
        return
    _show(result, out)
    if compared:
        _show_reference(compared, out)


def _show(result: "CampaignResult", out: Path) -> None:
    total = sum(len(f.photos) + len(f.problems) for f in result.data)
    used = sum(len(f.evaluation.photos) for f in result.flights)
    mirrors = sum(len(s.mirror) for f in result.flights for s in f.evaluation.seen)
    reflections = sum(len(f.evaluation.reflections) for f in result.flights)
    flights = f"{len(result.flights)} of {len(result.data)} flights, "
    print(
        f"{flights if len(result.data) > 1 else ''}{used} of {total} photographs used, {mirrors} "
        f"pictures of mirrors, {reflections} reflections"
    )
    print(result.campaign.offset_text())
    _show_orientations(result, out)
    warned = result.orientation_warnings()
    for name, warning in warned[:_WARNINGS]:
        print(f"{name}: {warning}")
    if len(warned) > _WARNINGS:
        print(f"and {len(warned) - _WARNINGS} more warnings; use --json to see them all")
    for name, reason in list(result.left_out().items())[:_WARNINGS]:
        print(f"left out: {name}: {reason}")
    print(
        f"written to {out}: orientations, reflections, sightings and, without --no-report, the "
        "report"
    )


def _show_orientations(result: "CampaignResult", out: Path) -> None:
    rows = [(f.label(r["heliostat"]), r) for f in result.flights for r in f.measured.rows()]
    names = ("rot", "sigma_mean", "sigma_tot")
    body = [
        [name, str(row["points"]), str(row["outliers"])]
        + [f"{row[f'{n}_{a}_mrad']:{'+' if n == 'rot' else ''}.3f}" for n in names for a in "xy"]
        for name, row in rows[:_ORIENTATIONS]
    ]
    head = ["heliostat", "points", "outliers", "rotX", "rotY"]
    head += ["σ_mean X", "σ_mean Y", "σ_tot X", "σ_tot Y"]
    print_table(head, body, "Orientation minus command, mrad")
    if len(rows) > _ORIENTATIONS:
        print(f"and {len(rows) - _ORIENTATIONS} more in {out / 'orientations.csv'}")


def _show_reference(compared: "Sequence[Compared]", out: Path) -> None:
    from heliotrope.airborne.evaluate.reference_page import offset_table

    table = offset_table(compared)
    body = [*table["rows"][:_ORIENTATIONS], *table["rows"][max(_ORIENTATIONS, len(compared)) :]]
    print_table(table["head"], body, "Orientation minus reference, mrad")
    print(f"written to {out}: reference.csv and, without --no-report, reference.html")
