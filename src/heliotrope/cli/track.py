"""``heliotrope track``: drive positions of a heliostat."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._common import (
    open_field,
    parse_point,
    parse_sun,
    parse_time,
    print_json,
    print_table,
    sunlit,
)
from heliotrope.cli._track_guo import track_by_guo
from heliotrope.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from heliotrope.field.plant import Plant
    from heliotrope.mechanism import TrackedPath
    from heliotrope.mechanism.tracking import TraceStep, Tracking, TrackingStatus


FieldArgument = Annotated[
    Path,
    typer.Argument(help="Plant file (TOML), PAINT folder, HelioK XML, SolarPILOT or OpenCSP CSV."),
]
HeliostatOption = Annotated[str, typer.Option(help="Name of the heliostat.")]
AimOption = Annotated[
    str | None,
    typer.Option(
        help="Aim east,north,up in metres; default: the heliostat's own, or the first target."
    ),
]
TargetOption = Annotated[str | None, typer.Option(help="Aim at the centre of this target.")]


#: Largest distance from a target at which an aim counts as on the target, m.
_ON = 0.01
_TAKE = "recommended pose; shading and blocking by other mirrors are not considered"
_NEAREST = "the nearest pose: the beam does not reach its aim"
_LINE = (
    "single axis: sun and aim are projected onto the plane perpendicular to it; the component of "
    "the light along the axis is unchanged"
)


def track(
    field: FieldArgument,
    heliostat: HeliostatOption,
    aim: AimOption = None,
    target: TargetOption = None,
    time: Annotated[
        str | None,
        typer.Option(help="ISO 8601 with a zone, or now; default: the file's <Sun>, or now."),
    ] = None,
    sun: Annotated[
        str | None, typer.Option(help="Sun vector east,north,up, instead of the one at TIME.")
    ] = None,
    every: Annotated[
        str | None,
        typer.Option(help="Track the whole day of TIME at this interval, such as 30s or 10min."),
    ] = None,
    site: Annotated[
        str | None,
        typer.Option(help="LATITUDE,LONGITUDE,HEIGHT (degrees, m) for a file without a location."),
    ] = None,
    over_the_top: Annotated[
        bool,
        typer.Option(
            help="With --every: let the heliostat go over the top wherever that saves slews or "
            "motion."
        ),
    ] = False,
    calibration: Annotated[
        Path | None,
        typer.Option(help="calibration.json from `heliotrope calibrate`, applied before tracking."),
    ] = None,
    law: Annotated[
        Literal["armature", "guo"],
        typer.Option(
            help="Tracking law: armature works for any mechanism; guo is the closed form for "
            "azimuth-elevation."
        ),
    ] = "armature",
    local: Annotated[
        bool,
        typer.Option(
            help="The aim point moves with the mirror; it is given in the heliostat frame at "
            "zero angles."
        ),
    ] = False,
    trace: Annotated[
        bool, typer.Option(help="Print each iteration on both branches: angles and miss distance.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the normal, joint angles and drive counts of both branches, or of a whole day."""
    import numpy as np

    from heliotrope import sun as solar
    from heliotrope.geometry import normalize
    from heliotrope.mechanism import track_path, tracking

    # If the sun vector is specified, the site does not matter, even for a format without one.
    anywhere = sun is not None and field.suffix.lower() in (".csv", ".txt", ".tsv", ".xml")
    plant = _opened(field, site or ("0,0,0" if anywhere else ""), calibration)
    mechanism = plant[heliostat].calibrated
    _check(every, law, local, trace, target)
    goal = np.array(
        _local_aim(plant, heliostat, aim) if local else aim_of(plant, heliostat, aim, target)
    )
    joints = tuple(mechanism.joints[j] for j in mechanism.driven)
    moment = parse_time(time or "now")
    if every is not None:
        times = sunlit(moment, plant.site, every)
        followed = track_path(
            mechanism, solar.vector(times, plant.site), goal, local=local, over_the_top=over_the_top
        )
        if not local:
            check_front(plant, heliostat, goal, followed.vertex)
        _day(heliostat, [t.isoformat() for t in times], followed, joints, as_json)
        if not followed.reachable.any():
            raise typer.Exit(1)
        return
    own = _sun_of(field) if sun is None and time is None else None
    direction = normalize(parse_sun(sun)) if sun is not None else own
    vector = solar.vector(moment, plant.site) if direction is None else direction
    _check_sun(heliostat, vector, moment.isoformat() if direction is None else "")
    result = tracking.track(mechanism, vector, goal, local=local)
    _check_pose(heliostat, tracking.TrackingStatus(int(result.chosen(result.status))))
    if not local:
        check_front(plant, heliostat, goal, result.chosen(result.vertex))
    if law == "guo":
        track_by_guo(heliostat, mechanism, vector, goal, moment, as_json)
        return
    if trace:
        _trace(heliostat, tracking.trace(mechanism, vector, goal), as_json)
        return
    # The two branches of one axis are the same pose.
    branches = range(min(2, len(joints)))
    document = {
        "heliostat": heliostat,
        "time": moment,
        "sun_from": "file" if own is not None else "option" if sun is not None else "time",
        "sun_vector": vector,
        "sun_elevation_deg": float(np.degrees(np.arcsin(vector[2]))),
        "aim": goal,
        "joints": joints,
        "best": int(result.best),
        "branches": [_branch(result, b) for b in branches],
    }
    if as_json:
        print_json(document)
    else:
        _print_branches(document, heliostat)
    if not result.reachable:
        raise typer.Exit(1)


def _opened(field: Path, place: str, calibration: Path | None) -> "Plant":
    """Return a field at a site ("" for its own site), with a calibration."""
    plant = open_field(field, place or None)
    if calibration is None:
        return plant
    from heliotrope.calibration.report.results import read_json

    return plant.with_calibration(read_json(calibration))


def _check(every: str | None, law: str, local: bool, trace: bool, target: str | None) -> None:
    """Refuse options that exclude each other."""
    if local and target is not None:
        raise InputError(
            "--local needs an aim point that moves with the mirror, and a target does not; use "
            "--aim instead of --target, or leave out --local"
        )
    if law == "guo" and (every is not None or local or trace):
        raise InputError(
            "--law guo prints a single time and aims in ENU only; leave out --every, --local and "
            "--trace, or use --law armature"
        )
    if trace and (every is not None or local):
        raise InputError(
            "--trace prints a single time and aims in ENU only; leave out --every and --local"
        )


def _check_sun(heliostat: str, vector: "np.ndarray", time: str) -> None:
    """Refuse a sun direction that lights no mirror."""
    if vector[2] <= 0.0:
        below = f"the sun is {math.degrees(abs(math.asin(vector[2]))):.2f}° below the horizon"
        when = f" at {time}" if time else ""
        raise InputError(f"heliostat {heliostat}: {below}{when}; choose a time in daylight")


def _check_pose(heliostat: str, status: "TrackingStatus") -> None:
    """Refuse a result without a pose that the heliostat can reach."""
    if status.name in ("NOT_CONVERGED", "DEGENERATE", "BEHIND"):
        raise InputError(f"heliostat {heliostat}: {status.text}; choose another aim")


def _sun_of(field: Path) -> "np.ndarray | None":
    """Return the sun vector in a HelioK file, (3,); None if the file contains none."""
    if field.suffix.lower() != ".xml":
        return None
    from heliotrope.field.formats import heliok

    document = heliok.read(field)
    has = any(True for world in document.root.elements("World") for _ in world.elements("Sun"))
    return heliok.sun(document) if has else None


def aim_of(plant: "Plant", heliostat: str, aim: str | None, target: str | None) -> Any:
    """Return the aim from the options, the heliostat or the first target, in this order, (3,)."""
    if aim is not None and target is not None:
        raise InputError("use --aim or --target, not both")
    if aim is not None:
        return parse_point(aim, "aim")
    if target is not None:
        return plant.target(target).center
    own = plant[heliostat].aim
    if own is not None:
        return own
    if not plant.targets:
        raise InputError("this plant has no target; specify --aim east,north,up in metres")
    return plant.targets[0].center


def _local_aim(plant: "Plant", heliostat: str, aim: str | None) -> Any:
    """Return the point fixed to the mirror, (3,), from --aim or from the heliostat's own aim."""
    if aim is not None:
        return parse_point(aim, "aim")
    own = plant[heliostat].aim
    if own is None:
        raise InputError(
            f"heliostat {heliostat} has no aim point of its own; specify --aim x,y,z in metres, in "
            "its frame at zero angles"
        )
    return own


def check_front(plant: "Plant", heliostat: str, aim: Any, vertices: "np.ndarray") -> None:
    """Refuse an aim that beams from ``vertices`` (..., 3) do not reach because of a target.

    Raises
    ------
    InputError
        If the aim is on a target or an aperture whose back faces the mirror, or a target is in
        front of it.
    """
    import numpy as np

    at = vertices[np.isfinite(vertices).all(axis=-1)]
    planar = [receiver.face for receiver in plant.receivers if receiver.kind == "planar"]
    for surface in (*plant.targets, *planar):
        ahead = (at - surface.center) @ surface.normal
        beyond = float((aim - surface.center) @ surface.normal)
        if surface.holds(aim, _ON) and (ahead <= 0.0).any():
            raise InputError(
                f"heliostat {heliostat} is {-ahead.min():.2f} m behind {surface.name}, so its "
                "beam would hit the back of the surface; choose another target or aim"
            )
        # An aperture may be crossed: the aim is inside a cavity.
        crossed = ahead * beyond < 0.0
        if surface in planar or abs(beyond) <= _ON or not crossed.any():
            continue
        share = ahead[crossed] / (ahead[crossed] - beyond)
        if surface.holds(at[crossed] + share[:, None] * (aim - at[crossed])).any():
            raise InputError(
                f"heliostat {heliostat}: {surface.name} is between it and the aim point; choose "
                "another aim"
            )


def _trace(heliostat: str, steps: "tuple[TraceStep, ...]", as_json: bool) -> None:
    """Print the table of iterations in the format of HelioK's debug output."""
    import numpy as np

    if as_json:
        rows = [
            {"branch": s.branch, "iteration": s.iteration, "angles_rad": s.angles, "miss_m": s.miss}
            for s in steps
        ]
        print_json({"heliostat": heliostat, "steps": rows})
        return
    print_table(
        ["branch", "iteration", "angles", "miss"],
        [
            [
                str(step.branch),
                str(step.iteration),
                "  ".join(f"{np.degrees(angle):.6f}°" for angle in step.angles),
                f"{1e3 * step.miss:.3g} mm",
            ]
            for step in steps
        ],
        title=f"{heliostat}: Grigoriev's iteration, ignoring end stops",
    )


def _branch(result: "Tracking", b: int) -> dict[str, Any]:
    import numpy as np

    from heliotrope.geometry import azimuth_elevation
    from heliotrope.mechanism.tracking import TrackingStatus

    status = TrackingStatus(int(result.status[b]))
    azimuth, elevation = azimuth_elevation(result.normal[b])
    return {
        "branch": b,
        "azimuth_deg": float(np.degrees(azimuth)),
        "elevation_deg": float(np.degrees(elevation)),
        "normal": result.normal[b],
        "vertex": result.vertex[b],
        "angles_rad": result.angles[b],
        "counts": result.counts[b],
        "reachable": bool(result.served[b]),
        "residual_mrad": float(1e3 * result.residual[b]),
        "iterations": int(result.iterations[b]),
        "status": status.name.lower(),
        "text": status.text,
    }


def _print_branches(document: dict[str, Any], heliostat: str) -> None:
    import numpy as np

    rows = []
    for branch in document["branches"]:
        mark = " *" if branch["branch"] == document["best"] else ""
        rows.append(
            [
                f"{branch['branch']}{mark}",
                f"{branch['azimuth_deg']:.4f}°",
                f"{branch['elevation_deg']:.4f}°",
                "  ".join(f"{np.degrees(a):.4f}°" for a in branch["angles_rad"]),
                "  ".join(f"{c:.1f}" for c in branch["counts"]),
                f"{branch['residual_mrad']:.3g} mrad",
                branch["text"],
            ]
        )
    when = "" if document["sun_from"] != "time" else f" at {document['time'].isoformat()}"
    whose = "the file's sun" if document["sun_from"] == "file" else "sun"
    print(f"{heliostat}{when}, {whose} at {document['sun_elevation_deg']:.2f}° elevation")
    names = "joints " + " and ".join(document["joints"])
    print_table(["branch", "azimuth", "elevation", names, "counts", "residual", ""], rows)
    served = document["branches"][document["best"]]["reachable"]
    print(f"* {_TAKE if served else _NEAREST}")
    if len(document["joints"]) == 1:
        print(_LINE)


def _day(
    heliostat: str, times: list[str], path: "TrackedPath", joints: tuple[str, ...], as_json: bool
) -> None:
    import numpy as np

    from heliotrope.geometry import azimuth_elevation

    azimuth, elevation = azimuth_elevation(path.normal)
    slews = {slew.step: slew.reason for slew in path.slews}
    rows = [
        {
            "time": time,
            "branch": int(path.branch[i]),
            "over_the_top": bool(path.over_the_top[i]),
            "azimuth_deg": float(np.degrees(azimuth[i])),
            "elevation_deg": float(np.degrees(elevation[i])),
            "angles_rad": path.angles[i],
            "counts": path.counts[i],
            "reachable": bool(path.reachable[i]),
            "residual_mrad": float(1e3 * path.residual[i]),
            "slew": slews.get(i),
        }
        for i, time in enumerate(times)
    ]
    if as_json:
        print_json({"heliostat": heliostat, "joints": joints, "day": rows})
        return
    print_table(
        ["time", "branch", "azimuth", "elevation", "counts", "residual", *(["slew"] * bool(slews))],
        [
            [
                str(r["time"]),
                str(r["branch"]),
                f"{r['azimuth_deg']:.4f}°",
                f"{r['elevation_deg']:.4f}°",
                "  ".join(f"{c:.1f}" for c in path.counts[i]),
                f"{r['residual_mrad']:.3g} mrad" + ("" if r["reachable"] else " !"),
                *([str(r["slew"] or "")] * bool(slews)),
            ]
            for i, r in enumerate(rows)
        ],
        title=f"{heliostat}, {len(rows)} positions, {len(slews)} slews",
    )
