"""``heliotrope drone evaluate``: the orientations of mirrors from a drone's photographs."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli import _drone_shared as shared
from heliotrope.cli._common import print_json, print_table

if TYPE_CHECKING:
    from heliotrope.airborne.evaluation import Evaluation
    from heliotrope.airborne.mirror import MirrorShape
    from heliotrope.airborne.orientation import Orientations


def evaluate(
    folder: shared.FolderArgument,
    field: shared.FieldOption,
    camera: shared.CameraOption = None,
    commands: shared.CommandsOption = None,
    cluster: shared.ClusterOption = "",
    point: shared.PointOption = "",
    slopes: Annotated[
        Path | None, typer.Option(help="Folder of slope maps, NAME.npz or NAME.csv a heliostat.")
    ] = None,
    focal: shared.FocalOption = None,
    survey_mm: shared.SurveyOption = 10.0,
    kinematics_mm: Annotated[
        float, typer.Option(min=0.0, help="Standard deviation of vertices in their poses, mm.")
    ] = 30.0,
    out: shared.OutOption = Path("out/drone"),
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write the page with its pictures.")
    ] = True,
    processes: shared.ProcessesOption = 0,
    scheduler: calibration.SchedulerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Find mirrors and lamp in a drone's photographs: orientations with their accuracy."""
    import numpy as np

    from heliotrope.airborne.budget import Budget
    from heliotrope.airborne.bundle import Priors
    from heliotrope.airborne.evaluation import evaluate as evaluate_flight
    from heliotrope.airborne.orientation import measure_field

    flight = shared.open_flight(folder, field, camera, commands, cluster, point, focal)
    surfaces = _surfaces(flight, slopes)
    seen = shared.read_flight(flight, out / "photographs", processes, scheduler, as_json)
    for line in flight.problems:
        print(f"heliotrope: {line}", file=sys.stderr)
    found = evaluate_flight(
        flight.photos, seen, flight.camera, flight.stand, surfaces.__getitem__,
        priors=Priors(position=1e-3 * survey_mm),
    )  # fmt: skip
    for line in found.problems:
        print(f"heliotrope: {line}", file=sys.stderr)
    offset_sigma = float(np.sqrt(np.trace(found.adjusted.offset_covariance) / 3.0))
    budget = Budget(1e-3 * survey_mm, 1e-3 * kinematics_mm, offset_sigma)
    orientations = measure_field(
        found.reflections, flight.stand.names, surfaces.__getitem__, flight.stand.rotation,
        found.stand.vertex, budget=budget,
    )  # fmt: skip
    _write(out, flight, found, orientations)
    if report:
        _report(out, flight, found, orientations, surfaces, as_json)
    if as_json:
        print_json(_document(found, orientations, flight.problems))
    else:
        _show(found, orientations, out, len(flight.photos) + len(flight.problems))


def _surfaces(flight: shared.FlightFolder, slopes: Path | None) -> "list[MirrorShape]":
    """Return the mirrors' surfaces, with the slope maps that there are."""
    from heliotrope.airborne.slopes import read_slopes
    from heliotrope.errors import InputError

    surfaces, missing = [], []
    for row, name in enumerate(flight.stand.names):
        shape = flight.shape(row)
        if slopes is not None:
            files = [slopes / f"{name}{suffix}" for suffix in (".npz", ".csv")]
            there = next((f for f in files if f.exists()), None)
            if there is None:
                missing.append(name)
            else:
                shape = shape.with_slopes(read_slopes(there, len(shape)))
        surfaces.append(shape)
    if slopes is not None and len(missing) == len(surfaces):
        raise InputError(
            f"{slopes}: there is no slope map in it; name them after heliostats, {missing[0]}.npz"
        )
    for name in missing:
        print(f"heliotrope: {slopes}: no slope map of {name}; taken as ideal", file=sys.stderr)
    return surfaces


def _write(
    out: Path, flight: shared.FlightFolder, found: "Evaluation", orientations: "Orientations"
) -> None:
    import numpy as np
    import pandas as pd

    from heliotrope.airborne.flight_report import orientation_rows
    from heliotrope.airborne.reflections import write_reflections
    from heliotrope.airborne.sightings import to_sightings
    from heliotrope.calibration.report import write_beside
    from heliotrope.calibration.sighting_table import write_sightings

    out.mkdir(parents=True, exist_ok=True)
    names = flight.stand.names
    write_reflections(out / "reflections.csv", found.reflections, names)
    times = [p.time.timestamp() for p in found.photos if p.time is not None]
    sightings = to_sightings(
        orientations, flight.counts, time=float(np.mean(times)) if times else 0.0,
        per="orientation",
    )  # fmt: skip
    write_sightings(out / "sightings.csv", sightings, names, ["drone"] * len(sightings))
    table = pd.DataFrame(orientation_rows(orientations))
    write_beside(out / "orientations.csv", lambda part: table.to_csv(part, index=False))


def _report(
    out: Path, flight: shared.FlightFolder, found: "Evaluation", orientations: "Orientations",
    surfaces: "list[MirrorShape]", quiet: bool,
) -> None:  # fmt: skip
    from heliotrope.airborne.flight_report import write_flight_report

    notes = (f"{_offset(found)}.", *found.problems, *flight.problems)
    with calibration.progress("drawing", quiet) as advance:
        write_flight_report(
            orientations, surfaces.__getitem__, found.stand.vertex, out, notes=notes,
            progress=advance,
        )  # fmt: skip


def _offset(found: "Evaluation") -> str:
    import numpy as np

    adjusted = found.adjusted
    parts = [
        f"{axis} {1e3 * o:+.1f} ± {1e3 * s:.1f}"
        for axis, o, s in zip(
            ("E", "N", "U"), adjusted.state.offset, np.sqrt(np.diag(adjusted.offset_covariance)),
            strict=True,
        )
    ]  # fmt: skip
    return f"common offset of RTK, told less true: {', '.join(parts)} mm"


def _document(
    found: "Evaluation", orientations: "Orientations", problems: tuple[str, ...]
) -> dict[str, Any]:
    import numpy as np

    from heliotrope.airborne.flight_report import orientation_rows

    adjusted = found.adjusted
    return {
        "photographs": [p.name for p in found.photos],
        "not_used": [*problems, *found.problems],
        "reflections": len(found.reflections),
        "rtk_offset_m": adjusted.state.offset.tolist(),
        "rtk_offset_sigma_m": np.sqrt(np.diag(adjusted.offset_covariance)).tolist(),
        "orientations": orientation_rows(orientations),
        "warnings": {orientations.names[o.heliostat]: list(o.warnings)
                     for o in orientations.found if o.warnings},
        "left_out": dict(orientations.left_out),
    }  # fmt: skip


def _show(found: "Evaluation", orientations: "Orientations", out: Path, given: int) -> None:
    from heliotrope.airborne.flight_report import orientation_rows

    mirrors = sum(len(s.mirror) for s in found.seen)
    print(f"{len(found.photos)} of {given} photographs used, {mirrors} pictures of mirrors, "
          f"{len(found.reflections)} reflections")  # fmt: skip
    print(_offset(found))
    rows = orientation_rows(orientations)
    names = ("rot", "sigma_mean", "sigma_tot")
    body = [
        [row["heliostat"], str(row["points"]), str(row["outliers"])]
        + [f"{row[f'{n}_{a}_mrad']:{'+' if n == 'rot' else ''}.3f}" for n in names for a in "xy"]
        for row in rows[:40]
    ]
    print_table(
        ["heliostat", "points", "outliers", "rotX", "rotY", "σ_mean X", "σ_mean Y", "σ_tot X",
         "σ_tot Y"], body, "Orientation less command, mrad",
    )  # fmt: skip
    if len(rows) > 40:
        print(f"and {len(rows) - 40} more in {out / 'orientations.csv'}")
    warned = [(orientations.names[o.heliostat], w) for o in orientations.found for w in o.warnings]
    for name, warning in warned[:12]:
        print(f"{name}: {warning}")
    if len(warned) > 12:
        print(f"and {len(warned) - 12} more warnings with --json")
    for name, reason in list(orientations.left_out.items())[:12]:
        print(f"left out: {name}: {reason}")
    print(f"written: {out}: orientations, reflections, sightings, and the report if wanted")
