"""``heliotrope plan``: what to measure next, of a heliostat or of a whole field."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
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

if TYPE_CHECKING:
    from heliotrope.calibration.plan.planning import CandidateSightings, SightingPlan
    from heliotrope.calibration.sightings import Sightings
    from heliotrope.field.heliostats import Heliostats
    from heliotrope.field.plant import Plant
    from heliotrope.field.target import Target
    from heliotrope.geometry import FloatArray
    from heliotrope.mechanism.chain import Mechanism

#: Rows of a campaign that are shown on the screen.
SHOWN = 20


def plan(
    field: Annotated[Path, typer.Argument(metavar="PLANT", help="Plant file or PAINT folder.")],
    heliostat: Annotated[
        list[str] | None, typer.Option(help="Name; repeat it for several. Default: all.")
    ] = None,
    begin: Annotated[str, typer.Option("--from", help="ISO 8601 with a zone, or now.")] = "now",
    end: Annotated[str | None, typer.Option("--to", help="ISO 8601 with a zone.")] = None,
    days: Annotated[float | None, typer.Option(help="Instead of --to; default 7.")] = None,
    count: Annotated[
        int | None, typer.Option(help="Measurements of a heliostat (10), or of a campaign (all).")
    ] = None,
    target: Annotated[
        list[str] | None, typer.Option(help="With a camera; repeat it for several. Default: all.")
    ] = None,
    model: Annotated[
        str, typer.Option(help="auto, or jacks, malan8, guo6, khalsa8, full.")
    ] = "auto",
    criterion: Annotated[
        Literal["d", "v"], typer.Option(help="d: most information; v: smallest beam error.")
    ] = "d",
    sightings: Annotated[
        Path | None, typer.Option(help="Table of the sightings made already.")
    ] = None,
    campaign: Annotated[
        bool, typer.Option("--campaign", help="Schedule the field: one beam a target at a time.")
    ] = False,
    every: Annotated[str, typer.Option(help="Step of the times looked at.")] = "30m",
    sigma_mrad: Annotated[float, typer.Option(help="Of a measured beam, a direction.")] = 0.5,
    settle: Annotated[str, typer.Option(help="Time to come to rest on the target.")] = "5s",
    exposure: Annotated[str, typer.Option(help="Time of the camera.")] = "2s",
    clear: Annotated[str, typer.Option(help="Time to leave the target.")] = "5s",
    by_slot: Annotated[
        bool,
        typer.Option("--by-slot", help="Of a campaign: fill each slot as if it were the last."),
    ] = False,
    worth: Annotated[
        float, typer.Option(help="Of a campaign: least share of its error that each must take.")
    ] = 0.05,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
    csv: Annotated[Path | None, typer.Option("--csv", help="File for the table.")] = None,
    picture: Annotated[Path | None, typer.Option(help="File .png, .svg or .pdf.")] = None,
) -> None:
    """Plan the measurements that tell most: times, targets, and the beam error to expect."""
    from heliotrope.calibration.plan.campaign import Timing
    from heliotrope.calibration.plan.report import check_picture

    if picture is not None:
        check_picture(picture)
    plant = open_plant(field)
    _check_outputs((csv, picture), field, sightings)
    order = _Order(
        span=_span(begin, end, days),
        targets=_targets(plant, target),
        criterion=criterion,
        sigma=1e-3 * _above(sigma_mrad, "--sigma-mrad"),
        every=parse_duration(every).total_seconds(),
        timing=Timing(*(parse_duration(t).total_seconds() for t in (settle, exposure, clear))),
        ahead=not by_slot,
        worth=worth,
        count=count,
        csv=csv,
        picture=picture,
        as_json=as_json,
    )
    made = _made(plant, sightings)
    with progress("looking at the year", as_json) as step:
        parts = _parts(plant, heliostat, model, made, order.span[0], step)
    (_campaign if campaign else _plans)(plant, parts, order)


@dataclass(frozen=True)
class _Order:
    span: tuple[datetime, datetime]
    targets: "tuple[Target, ...]"
    criterion: Literal["d", "v"]
    sigma: float
    every: float
    timing: Any
    ahead: bool
    worth: float
    count: int | None
    csv: Path | None
    picture: Path | None
    as_json: bool


@dataclass(frozen=True)
class _Part:
    """Heliostats of one kind with what is known of them."""

    labels: tuple[str, ...]
    mechanism: "Mechanism"
    names: tuple[str, ...]
    information: "FloatArray"
    form: "FloatArray"
    aim: "FloatArray"


def _check_outputs(outputs: tuple[Path | None, ...], field: Path, sightings: Path | None) -> None:
    """Refuse what could not be written, or would replace what is read."""
    import tomllib

    from heliotrope.errors import InputError

    read = {path.resolve() for path in (field, sightings) if path is not None}
    if field.suffix.lower() == ".toml" and field.is_file():
        table = tomllib.loads(field.read_text(encoding="utf-8-sig")).get("heliostats")
        if isinstance(table, str):
            read.add((field.parent / table).resolve())
    for file in (path for path in outputs if path is not None):
        if not file.parent.is_dir():
            raise InputError(f"{file}: there is no folder {file.parent}; make it first")
        inside = field.is_dir() and field.resolve() in file.resolve().parents and file.exists()
        if file.resolve() in read or inside:
            raise InputError(f"{file}: this file is read from; give another name to write to")


def _span(begin: str, end: str | None, days: float | None) -> tuple[datetime, datetime]:
    from heliotrope.errors import InputError, TimeError

    start = parse_time(begin)
    if end is not None and days is not None:
        raise InputError("give --to or --days, not both")
    if end is not None:
        stop = parse_time(end)
    else:
        length = 7.0 if days is None else _above(days, "--days")
        if length > 3660.0:
            raise InputError(f"--days {length:g}: give at most 3660")
        try:
            stop = start + timedelta(days=length)
        except OverflowError:
            raise TimeError(f"--from {begin}: the span runs beyond the year 9999") from None
    if stop <= start:
        raise TimeError(f"--to {stop.isoformat()} is not after --from {start.isoformat()}")
    return start, stop


def _above(value: float, what: str) -> float:
    import math

    from heliotrope.errors import InputError

    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"{what} {value:g}: give a number above 0")
    return value


def _targets(plant: "Plant", wanted: list[str] | None) -> "tuple[Target, ...]":
    from heliotrope.errors import InputError

    found = tuple(plant.target(name) for name in dict.fromkeys(wanted or ())) or plant.targets
    if not found:
        raise InputError("this plant has no target; a measurement with a camera needs one")
    return found


def _made(plant: "Plant", path: Path | None) -> "Sightings | None":
    if path is None:
        return None
    from heliotrope.calibration.sighting_table import read_sightings
    from heliotrope.errors import FormatError

    seen, _, left_out = read_sightings(path, plant.names)
    if not len(seen):
        reason = f"; the first: {left_out[0]}" if left_out else ""
        raise FormatError(path, f"no sighting can be used{reason}")
    for line in left_out[:3]:
        print(f"left out: {line}", file=sys.stderr)
    if len(left_out) > 3:
        print(f"left out: {len(left_out) - 3} more", file=sys.stderr)
    return seen


def _parts(
    plant: "Plant",
    wanted: list[str] | None,
    model: str,
    made: "Sightings | None",
    start: datetime,
    step: Callable[[int, int], None],
) -> list[_Part]:
    import numpy as np

    from heliotrope.calibration.uncertainty import error_form, precision, suns_of_year
    from heliotrope.mechanism.parameters import model as model_names

    names = list(dict.fromkeys(wanted or plant.names))
    for name in names:
        plant.find(name)
    suns = suns_of_year(plant.site, start.year)
    chosen, place = set(names), {name: i for i, name in enumerate(plant.names)}
    parts = []
    for done, group in enumerate(plant.groups.values()):
        step(done, len(plant.groups))
        rows = np.array([i for i, n in enumerate(group.names) if n in chosen], dtype=np.intp)
        if not rows.size:
            continue
        labels = tuple(group.names[i] for i in rows)
        mechanism, aim = group.calibrated[rows], _aims(plant, group)[rows]
        kind = _model(mechanism) if model == "auto" else model
        parameters = model_names(kind, mechanism.parameters)
        seen = None if made is None else _of(made, [place[n] for n in labels], len(place))
        parts.append(
            _Part(
                labels,
                mechanism,
                parameters,
                precision(mechanism, parameters, seen),
                error_form(mechanism, aim, suns, parameters),
                aim,
            )
        )
    return parts


def _of(made: "Sightings", rows: list[int], total: int) -> "Sightings":
    """The sightings of the heliostats at ``rows`` of the plant, renumbered."""
    import numpy as np

    number = np.full(total, -1, dtype=np.intp)
    number[rows] = np.arange(len(rows))
    part = made.take(np.flatnonzero(number[made.heliostat] >= 0))
    return replace(part, heliostat=number[part.heliostat])


def _model(mechanism: "Mechanism") -> str:
    from heliotrope.mechanism.parameters import MODELS

    for name in ("jacks", "malan8"):
        if all(p in mechanism.parameters for p in MODELS[name]):
            return name
    return "full"


def _aims(plant: "Plant", group: "Heliostats") -> "FloatArray":
    """Where each is aimed in operation: its own aim, else the first receiver or target."""
    import numpy as np

    centers = [s.center for s in plant.receivers] + [s.center for s in plant.targets]
    common = np.broadcast_to(centers[0], (len(group), 3))
    if group.aim is None:
        return common
    return np.where(np.isfinite(group.aim).all(axis=-1, keepdims=True), group.aim, common)


def _plans(plant: "Plant", parts: list[_Part], order: _Order) -> None:
    from heliotrope.calibration.plan.report import (
        plan_picture,
        plan_rows,
        write_picture,
        write_table,
    )

    with progress("planning", order.as_json) as step:
        plans, possible = _all_plans(plant, parts, order, step)
    tables = {name: plan_rows(name, one) for name, one in plans.items()}
    if order.csv is not None:
        write_table(order.csv, [row for rows in tables.values() for row in rows])
    if order.picture is not None:
        write_picture(order.picture, plan_picture(plans, possible))
    if order.as_json:
        print_json(
            {
                **_head(parts, order),
                "criterion": order.criterion,
                "heliostats": {
                    name: {
                        "before_expected_beam_rms_mrad": 1e3 * one.before,
                        "log_det_gain": one.log_det,
                        "measurements": tables[name],
                    }
                    for name, one in plans.items()
                },
            }
        )
        return
    for name, one in plans.items():
        _print_plan(name, one, tables[name])
    _print_files(order)


def _all_plans(
    plant: "Plant", parts: list[_Part], order: _Order, step: Callable[[int, int], None]
) -> "tuple[dict[str, SightingPlan], CandidateSightings]":
    import numpy as np

    from heliotrope.calibration.plan import planning
    from heliotrope.errors import InputError

    start, stop = (t.timestamp() for t in order.span)
    times, slot = planning.grid(start, stop, order.every), order.timing.slot
    rows = [(part, i) for part in parts for i in range(len(part.labels))]
    plans: dict[str, SightingPlan] = {}
    taken: set[tuple[int, float]] = set()
    possible = None
    for number, (part, i) in enumerate(rows):
        # Each on its own part of a step, so that two are not on a target at once.
        shift = slot * (number % max(1, int(order.every // slot)))
        found = planning.candidates(
            part.mechanism[i : i + 1],
            plant.site,
            order.targets,
            times + shift,
            part.names,
            sigma=order.sigma,
        )
        free = [
            t <= stop - slot and (int(k), float(t)) not in taken
            for k, t in zip(found.target, found.time, strict=True)
        ]
        found = found.take(np.array(free, dtype=np.bool_))
        name = part.labels[i]
        if not len(found):
            raise InputError(
                f"heliostat {name}: no measurement is possible; the sun, the stops, the limits "
                "or the other heliostats' turns leave no time; widen the span"
            )
        plans[name] = planning.plan(
            found,
            10 if order.count is None else order.count,
            part.information[i],
            part.form[i],
            criterion=order.criterion,
        )
        chosen = plans[name].chosen
        taken |= {(int(k), float(t)) for k, t in zip(chosen.target, chosen.time, strict=True)}
        possible = possible or found
        step(number + 1, len(rows))
    assert possible is not None
    return plans, possible


def _print_plan(name: str, one: "SightingPlan", rows: list[dict[str, Any]]) -> None:
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
        title=f"{name}: expected beam error {1e3 * one.before:.2f} mrad before, "
        f"{1e3 * one.error[-1]:.2f} mrad after",
    )


def _head(parts: list[_Part], order: _Order) -> dict[str, Any]:
    return {
        "from": order.span[0],
        "to": order.span[1],
        "targets": [t.name for t in order.targets],
        "parameters": list(dict.fromkeys(p for part in parts for p in part.names)),
        "sigma_mrad": 1e3 * order.sigma,
    }


def _print_files(order: _Order) -> None:
    for what, path in (("table", order.csv), ("picture", order.picture)):
        if path is not None:
            print(f"{what}: {path}")


def _campaign(plant: "Plant", parts: list[_Part], order: _Order) -> None:
    import numpy as np

    from heliotrope.calibration.plan import campaign as planner
    from heliotrope.calibration.plan.report import (
        campaign_picture,
        campaign_rows,
        write_picture,
        write_table,
    )

    fleets = [
        planner.Fleet(p.mechanism, p.names, p.information, p.form, p.aim, order.sigma)
        for p in parts
    ]
    start, stop = (t.timestamp() for t in order.span)
    with progress("scheduling", order.as_json) as step:
        found = planner.campaign(
            fleets,
            plant.site,
            order.targets,
            start,
            stop,
            timing=order.timing,
            every=order.every,
            ahead=order.ahead,
            worth=order.worth,
            count=order.count,
            progress=step,
        )
    labels = [name for p in parts for name in p.labels]
    targets = [t.name for t in order.targets]
    rows = campaign_rows(found, labels, targets)
    if order.csv is not None:
        write_table(order.csv, rows)
    if order.picture is not None:
        position = np.concatenate([p.mechanism.position for p in parts])
        write_picture(order.picture, campaign_picture(found, position, targets))
    after = float(found.error[-1]) if len(found) else found.before
    if order.as_json:
        print_json(
            {
                **_head(parts, order),
                "slots": found.slots,
                "before_expected_beam_rms_mrad": 1e3 * found.before,
                "after_expected_beam_rms_mrad": 1e3 * after,
                "measurements": rows,
            }
        )
        return
    _print_campaign(rows)
    print(
        f"{len(rows):,} measurements in {found.slots:,} slots, "
        f"{len(np.unique(found.heliostat)):,} of {len(labels):,} heliostats; expected beam error "
        f"of the field: {1e3 * found.before:.2f} mrad before, {1e3 * after:.2f} mrad after"
    )
    _print_files(order)


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
