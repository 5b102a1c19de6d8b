"""``heliotrope drone evaluate``: the orientations of mirrors from a drone's photographs."""

import re
import sys
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import print_json, print_table
from heliotrope.cli.drone import _shared as shared

if TYPE_CHECKING:
    from heliotrope.airborne.evaluate.budget import Budget
    from heliotrope.airborne.evaluate.campaign import Campaign
    from heliotrope.airborne.evaluate.evaluation import Evaluation
    from heliotrope.airborne.evaluate.orientation import Orientations
    from heliotrope.airborne.mirror import MirrorShape
    from heliotrope.calibration.sightings import Sightings


@dataclass(frozen=True)
class _Measured:
    """One flight with what came of it."""

    flight: shared.FlightFolder
    found: "Evaluation"
    surfaces: "list[MirrorShape]"
    orientations: "Orientations"
    budget: "Budget"

    def rows(self) -> list[dict[str, Any]]:
        """Return one record an orientation, the systematic part told by its causes."""
        from heliotrope.airborne.evaluate.report import orientation_rows

        return orientation_rows(
            self.orientations, self.budget, self.flight.name, self.found.place_covariance
        )


def evaluate(
    folder: shared.CampaignArgument,
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
    kinematics_mm: shared.KinematicsOption = 30.0,
    rtk_mm: shared.RtkOption = 30.0,
    out: shared.OutOption = Path("out/drone"),
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write the page with its pictures.")
    ] = True,
    processes: shared.ProcessesOption = 0,
    scheduler: calibration.SchedulerOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Find mirrors and lamp in a drone's photographs: orientations with their accuracy."""
    from heliotrope.airborne.evaluate.budget import Budget
    from heliotrope.airborne.evaluate.bundle import Priors
    from heliotrope.airborne.evaluate.campaign import Pose, evaluate_campaign

    flights, problems = shared.open_campaign(folder, field, camera, commands, cluster, point, focal)
    flights.sort(key=lambda flight: _natural(flight.name))
    surfaces = _all_surfaces(flights, slopes)
    poses = []
    for flight, shapes in zip(flights, surfaces, strict=True):
        seen = shared.read_flight(flight, out / "photographs", processes, scheduler, as_json)
        poses.append(
            Pose(
                flight.name,
                flight.photos,
                seen,
                flight.camera,
                flight.stand,
                flight.heliostat,
                shapes.__getitem__,
            )
        )
    _tell(problems)
    for flight in flights:
        _tell(flight.problems, flight.name)
    priors = Priors(1e-3 * rtk_mm, 1e-3 * survey_mm, 1e-3 * kinematics_mm)
    found = evaluate_campaign(poses, priors)
    for flight, lines in zip(flights, found.problems, strict=True):
        _tell(lines, flight.name)
    _tell(_far_off(found, priors.offset))
    budget = Budget(priors.position, priors.kinematics, 0.0)
    measured = _measure(flights, surfaces, found, budget)
    _write(out, measured)
    if not report:
        _write_orientations(out, measured)
    else:
        _report(out, measured, found, _not_used(flights, found, problems), as_json)
    if as_json:
        print_json(_document(measured, found, _not_used(flights, found, problems)))
    else:
        _show(measured, found, out, sum(len(f.photos) + len(f.problems) for f in flights))


def _natural(name: str) -> list[tuple[str, int]]:
    """Return a key by which C1-2 stands before C1-10."""
    return [(text, int(number or 0)) for text, number in re.findall(r"([^0-9]*)([0-9]*)", name)]


def _tell(lines: Iterable[str], flight: str = "") -> None:
    for line in lines:
        print(f"heliotrope: {flight}: {line}" if flight else f"heliotrope: {line}", file=sys.stderr)


def _far_off(found: "Campaign", prior: float) -> list[str]:
    """Return a line if RTK's offset is far larger than it was said to be."""
    import numpy as np

    size = float(np.abs(found.offset).max())
    if size <= 3.0 * prior:
        return []
    line = (
        f"RTK's common offset is {1e3 * size:.0f} mm, --rtk-mm {1e3 * prior:.0f}: is the base "
        "where it is said to be? Give what is known of it with --rtk-mm"
    )
    return [line]


def _measure(
    flights: list[shared.FlightFolder],
    surfaces: "list[list[MirrorShape]]",
    found: "Campaign",
    budget: "Budget",
) -> list[_Measured]:
    from heliotrope.airborne.evaluate.orientation import measure_field

    measured = []
    for flight, shapes, one in zip(flights, surfaces, found.flights, strict=True):
        if one is None:
            continue
        # Where the mirrors stand is known from the photographs, and how well.
        orientations = measure_field(
            one.reflections,
            flight.stand.names,
            shapes.__getitem__,
            flight.stand.rotation,
            one.stand.vertex,
            budget=budget,
            places=one.place_covariance,
        )
        measured.append(_Measured(flight, one, shapes, orientations, budget))
    return measured


def _all_surfaces(
    flights: list[shared.FlightFolder], slopes: Path | None
) -> "list[list[MirrorShape]]":
    """Return the surfaces of all flights' mirrors; a map that is missing is told once."""
    told: set[str] = set()
    return [_surfaces(flight, slopes, told) for flight in flights]


def _surfaces(
    flight: shared.FlightFolder, slopes: Path | None, told: set[str]
) -> "list[MirrorShape]":
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
    _tell(f"{slopes}: no slope map of {n}; taken as ideal" for n in missing if n not in told)
    told.update(missing)
    return surfaces


def _write(out: Path, measured: list[_Measured]) -> None:
    from heliotrope.airborne.evaluate.reflections import write_reflections
    from heliotrope.calibration.sighting_table import write_sightings
    from heliotrope.calibration.sightings import join

    out.mkdir(parents=True, exist_ok=True)
    for one in measured:
        name = f"reflections-{one.flight.name}".rstrip("-")
        write_reflections(out / f"{name}.csv", one.found.reflections, one.flight.stand.names)
    parts = [_sightings(one) for one in measured if one.orientations.found]
    if parts:
        sightings = join(parts)
        names = measured[0].flight.plant.names
        write_sightings(out / "sightings.csv", sightings, names, ["drone"] * len(sightings))


def _write_orientations(out: Path, measured: list[_Measured]) -> None:
    """Write the table that the report has too."""
    import pandas as pd

    from heliotrope.files.text import write_text

    table = pd.DataFrame([row for one in measured for row in one.rows()])
    write_text(out / "orientations.csv", table.to_csv(index=False))


def _sightings(one: _Measured) -> "Sightings":
    """Return a flight's orientations as sightings, heliostats as the plant counts them."""
    import numpy as np

    from heliotrope.airborne.evaluate.sightings import to_sightings

    times = [p.time.timestamp() for p in one.found.photos if p.time is not None]
    made = to_sightings(
        one.orientations,
        one.flight.counts,
        time=float(np.mean(times)) if times else 0.0,
        per="orientation",
    )
    return replace(made, heliostat=one.flight.heliostat[made.heliostat])


def _report(
    out: Path, measured: list[_Measured], found: "Campaign", not_used: list[str], quiet: bool
) -> None:
    from heliotrope.airborne.evaluate.report import Flown, write_campaign_report

    notes = (f"{_offset(found)}.", *not_used)
    flown = [
        Flown(
            f.flight.name,
            f.orientations,
            f.surfaces.__getitem__,
            f.found.stand.vertex,
            f.budget,
            f.found.place_covariance,
        )
        for f in measured
    ]
    with calibration.progress("drawing", quiet) as advance:
        write_campaign_report(flown, out, notes=notes, progress=advance)


def _offset(found: "Campaign") -> str:
    import numpy as np

    parts = [
        f"{axis} {1e3 * o:+.1f} ± {1e3 * s:.1f}"
        for axis, o, s in zip(
            ("E", "N", "U"), found.offset, np.sqrt(np.diag(found.offset_covariance)), strict=True
        )
    ]
    return f"common offset of RTK, told less true: {', '.join(parts)} mm"


def _not_used(
    flights: list[shared.FlightFolder], found: "Campaign", problems: list[str]
) -> list[str]:
    """Return a line for each flight and photograph that was not used."""
    lines = [(f.name, line) for f in flights for line in f.problems]
    lines += [(f.name, x) for f, own in zip(flights, found.problems, strict=True) for x in own]
    return [*problems, *(f"{name}: {x}" if name else x for name, x in lines)]


def _document(measured: list[_Measured], found: "Campaign", not_used: list[str]) -> dict[str, Any]:
    import numpy as np

    every = [(m, o) for m in measured for o in m.orientations.found]
    return {
        "photographs": [_full(m, p.name) for m in measured for p in m.found.photos],
        "not_used": not_used,
        "reflections": sum(len(m.found.reflections) for m in measured),
        "rtk_offset_m": found.offset.tolist(),
        "rtk_offset_sigma_m": np.sqrt(np.diag(found.offset_covariance)).tolist(),
        "orientations": [row for m in measured for row in m.rows()],
        "warnings": {
            _full(m, m.orientations.names[o.heliostat]): list(o.warnings)
            for m, o in every
            if o.warnings
        },
        "left_out": {
            _full(m, name): reason
            for m in measured
            for name, reason in m.orientations.left_out.items()
        },
    }


def _full(one: _Measured, name: str) -> str:
    return f"{one.flight.name}/{name}" if one.flight.name else name


def _show(measured: list[_Measured], found: "Campaign", out: Path, given: int) -> None:
    used = sum(len(m.found.photos) for m in measured)
    mirrors = sum(len(s.mirror) for m in measured for s in m.found.seen)
    reflections = sum(len(m.found.reflections) for m in measured)
    flights = f"{len(measured)} of {len(found.flights)} flights, " if len(found.flights) > 1 else ""
    print(
        f"{flights}{used} of {given} photographs used, {mirrors} pictures of mirrors, "
        f"{reflections} reflections"
    )
    print(_offset(found))
    _show_orientations(measured, out)
    warned = [
        (_full(m, m.orientations.names[o.heliostat]), w)
        for m in measured
        for o in m.orientations.found
        for w in o.warnings
    ]
    for name, warning in warned[:12]:
        print(f"{name}: {warning}")
    if len(warned) > 12:
        print(f"and {len(warned) - 12} more warnings with --json")
    missing = [(_full(m, n), why) for m in measured for n, why in m.orientations.left_out.items()]
    for name, reason in missing[:12]:
        print(f"left out: {name}: {reason}")
    print(f"written: {out}: orientations, reflections, sightings, and the report if wanted")


def _show_orientations(measured: list[_Measured], out: Path) -> None:
    from heliotrope.airborne.evaluate.report import orientation_rows

    rows = [
        (_full(m, r["heliostat"]), r) for m in measured for r in orientation_rows(m.orientations)
    ]
    names = ("rot", "sigma_mean", "sigma_tot")
    body = [
        [name, str(row["points"]), str(row["outliers"])]
        + [f"{row[f'{n}_{a}_mrad']:{'+' if n == 'rot' else ''}.3f}" for n in names for a in "xy"]
        for name, row in rows[:40]
    ]
    print_table(
        [
            "heliostat",
            "points",
            "outliers",
            "rotX",
            "rotY",
            "σ_mean X",
            "σ_mean Y",
            "σ_tot X",
            "σ_tot Y",
        ],
        body,
        "Orientation less command, mrad",
    )
    if len(rows) > 40:
        print(f"and {len(rows) - 40} more in {out / 'orientations.csv'}")
