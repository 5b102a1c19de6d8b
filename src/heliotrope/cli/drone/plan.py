"""``heliotrope drone plan``: a drone campaign over a field, as waypoint files."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._calibration import progress
from heliotrope.cli._common import (
    open_plant,
    parse_duration,
    parse_numbers,
    parse_point,
    print_json,
    print_table,
)
from heliotrope.cli.drone import _shared as shared

if TYPE_CHECKING:
    from heliotrope.airborne.plan.airspace import Airspace
    from heliotrope.airborne.plan.calibration_points import PointSelection
    from heliotrope.field.plant import Plant
    from heliotrope.geometry import FloatArray


def plan(
    field: Annotated[Path, typer.Argument(metavar="PLANT", help="Plant file or PAINT folder.")],
    into: Annotated[Path, typer.Option(help="Folder for the plan.")] = Path("flight"),
    points: Annotated[
        int, typer.Option(min=1, max=1000, help="Calibration points per heliostat.")
    ] = 20,
    model: Annotated[
        str, typer.Option(help="auto, or jacks, malan8, guo6, khalsa8, full.")
    ] = "auto",
    criterion: Annotated[
        Literal["d", "v"],
        typer.Option(
            help=("What points are chosen for: d, most information; v, smallest beam error.")
        ),
    ] = "d",
    distance: Annotated[
        float, typer.Option(min=1, max=10_000, help="Distance of the drone from a cluster, m.")
    ] = 150.0,
    size: Annotated[
        float, typer.Option(min=1, max=10_000, help="Diameter of a cluster, m.")
    ] = 100.0,
    spread_deg: Annotated[
        float,
        typer.Option(
            min=0.1,
            max=180,
            help="Largest angle between an optical axis and the mean of its cluster.",
        ),
    ] = 25.0,
    view_deg: Annotated[
        float,
        typer.Option(min=1, max=179, help="Angle of view across the shorter side of a photograph."),
    ] = 56.0,
    pointing_mrad: Annotated[
        float,
        typer.Option(min=0, max=1000, help="Mirror pointing error that the patterns must cover."),
    ] = 5.0,
    samples: Annotated[
        float, typer.Option(min=1, max=1e6, help="Number of reflections per facet.")
    ] = 9.0,
    facet_focal: Annotated[
        float | None,
        typer.Option(min=1, max=100_000, help="Focal length of the facets, m; default: flat."),
    ] = None,
    least_spacing: Annotated[
        float, typer.Option(min=0.01, max=1000, help="Minimum distance between hover points, m.")
    ] = 0.6,
    led: Annotated[
        str, typer.Option(help="Lamp position relative to the camera: right,down,forward in m.")
    ] = "0,0,0",
    sigma_mrad: Annotated[
        float,
        typer.Option(
            min=0.001, max=1000, help="Standard deviation common to all reflections of a mirror."
        ),
    ] = 0.2,
    scatter_mrad: Annotated[
        float,
        typer.Option(
            min=0.001, max=1000, help="Standard deviation of the normal measured by one reflection."
        ),
    ] = 0.8,
    focal_px: Annotated[
        float, typer.Option(min=1, max=1e6, help="Focal length of the camera, pixels.")
    ] = 3000.0,
    elevations: Annotated[
        str,
        typer.Option(
            help="Minimum,maximum elevation of the drone as seen from the mirrors, degrees."
        ),
    ] = "20,85",
    airspace: Annotated[
        Path | None,
        typer.Option(
            help="JSON file with keep-out volumes, geofence, height limits and take-off place."
        ),
    ] = None,
    tower: Annotated[
        bool,
        typer.Option(
            "--tower/--no-tower", help="Keep out of the volumes around receivers and targets."
        ),
    ] = True,
    min_height: Annotated[
        float, typer.Option(min=0, max=10_000, help="Lower limit above ground, m.")
    ] = 15.0,
    max_height: Annotated[
        float, typer.Option(min=0, max=10_000, help="Upper limit above ground, m.")
    ] = 120.0,
    home: Annotated[str | None, typer.Option(help="Take-off place: east,north,up in m.")] = None,
    drones: Annotated[int, typer.Option(min=1, max=50, help="Drones flying at the same time.")] = 1,
    speed: Annotated[
        float, typer.Option(min=0.01, max=15, help="Speed between stations, m/s.")
    ] = 8.0,
    photo: Annotated[
        str, typer.Option(help="Time to come to rest and take a photograph.")
    ] = "2.5s",
    endurance: Annotated[str, typer.Option(help="Flying time on one battery.")] = "25min",
    change: Annotated[str, typer.Option(help="Time to change the battery.")] = "5min",
    hours_a_day: Annotated[
        float, typer.Option(min=0.01, max=24, help="Flying hours per day.")
    ] = 8.0,
    target_minutes: Annotated[
        float,
        typer.Option(
            min=0.001,
            max=1e6,
            help="For comparison with camera and target: time between photographs.",
        ),
    ] = 2.0,
    formats: Annotated[
        str,
        typer.Option(
            help="Formats of waypoint files: any of dji,qgc,litchi separated by commas, or none."
        ),
    ] = "dji,qgc,litchi",
    aircraft: Annotated[str, typer.Option(help="Drone model for DJI waypoint files.")] = "M3E",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Plan a drone campaign: clusters, hover patterns, heliostat commands, sorties."""
    import numpy as np

    from heliotrope.airborne.plan.flight import Craft
    from heliotrope.airborne.plan.flight_files import write_plan
    from heliotrope.airborne.plan.flight_map import flight_map
    from heliotrope.airborne.plan.flight_plan import PlanSettings, plan_flight
    from heliotrope.airborne.plan.hover import Sampling
    from heliotrope.calibration.plan.report import write_picture

    plant = open_plant(field)
    air, place = _airspace(plant, airspace, tower, (min_height, max_height))
    chosen = shared.formats(formats)
    settings = PlanSettings(
        size=size,
        spread=float(np.radians(spread_deg)),
        view=float(np.radians(view_deg)),
        model=model,
        sampling=Sampling(
            distance=distance,
            pointing=1e-3 * pointing_mrad,
            samples=samples,
            focal=np.inf if facet_focal is None else facet_focal,
            led_offset=parse_point(led, "--led"),
            least_spacing=least_spacing,
            camera=focal_px,
        ),
        selection=_selection(points, criterion, sigma_mrad, scatter_mrad, elevations),
        craft=Craft(
            drones,
            speed,
            photo=parse_duration(photo).total_seconds(),
            endurance=parse_duration(endurance).total_seconds(),
            change=parse_duration(change).total_seconds(),
        ),
        airspace=air,
        home=place if home is None else np.array(parse_point(home, "--home")),
        hours_a_day=hours_a_day,
        photo_minutes=target_minutes,
    )
    _check_aircraft(aircraft)
    with progress("choosing directions", as_json) as step:
        made = plan_flight(plant, settings, step)
    with progress("writing sorties", as_json) as step:
        written = write_plan(made, into, formats=chosen, aircraft=aircraft, progress=step)
    write_picture(into / "map.png", flight_map(made))
    summary = made.summary()
    if as_json:
        print_json({"folder": str(into), "files": len(written) + 1, **summary})
        return
    _print(summary)
    print(f"plan: {into / 'plan.json'}, commands: {into / 'commands.csv'}, map: {into / 'map.png'}")
    if chosen:
        print(f"waypoints of {summary['sorties']} sorties: {into} ({', '.join(chosen)})")


def _selection(
    points: int,
    criterion: Literal["d", "v"],
    sigma_mrad: float,
    scatter_mrad: float,
    elevations: str,
) -> "PointSelection":
    import numpy as np

    from heliotrope.airborne.plan.calibration_points import PointSelection

    refusal = f"--elevations {elevations!r}: use two angles from 0 to 90 degrees, such as 35,80"
    asked = parse_numbers(elevations, refusal, count=2, least=0.0, most=90.0)
    low, high = np.radians(asked).tolist()
    return PointSelection(
        points, criterion, 1e-3 * sigma_mrad, low, high, scatter=1e-3 * scatter_mrad
    )


def _check_aircraft(aircraft: str) -> None:
    from heliotrope.airborne.plan.waypoints import AIRCRAFT
    from heliotrope.errors import UnknownNameError

    if aircraft not in AIRCRAFT:
        raise UnknownNameError("aircraft", aircraft, AIRCRAFT)


def _airspace(
    plant: "Plant", path: Path | None, tower: bool, heights: tuple[float, float]
) -> "tuple[Airspace, FloatArray | None]":
    from heliotrope.airborne.plan.airspace import Airspace
    from heliotrope.airborne.plan.airspace import tower as keep_from_tower
    from heliotrope.airborne.plan.flight_files import read_airspace

    base = Airspace(keep_from_tower(plant) if tower else (), None, *heights, ground=plant.position)
    return (base, None) if path is None else read_airspace(path, base)


def _print(s: dict[str, Any]) -> None:
    patterns, spaces = s["hover_points_of_a_pattern"], s["spacing_m"]
    target = s["camera_target"]
    rows = [
        ["heliostats", f"{s['heliostats']:,}"],
        ["clusters", f"{s['clusters']:,}"],
        ["largest cluster radius, m", f"{s['cluster_radius_m'][1]:.1f}"],
        ["points per heliostat", f"{s['calibration_points']}"],
        ["orientations", f"{s['orientations']:,}"],
        ["hover points of a pattern", f"{patterns[0]} to {patterns[1]}"],
        ["their spacing, m", f"{spaces[0]:.2f} to {spaces[1]:.2f}"],
        ["reflections per facet", f"{s['samples_of_a_facet']:.1f}"],
        ["visible on the median mirror", f"{s['reflections_of_a_mirror'][1]:.1f}"],
        ["photographs", f"{s['photographs']:,}"],
        ["drones", f"{s['drones']}"],
        ["sorties", f"{s['sorties']:,}"],
        ["hours", f"{s['hours']:.1f}"],
        ["working days", f"{s['working_days']:.1f}"],
        ["beam error before, mrad", f"{s['beam_error_before_mrad']:.2f}"],
        ["beam error after, mrad", f"{s['beam_error_after_mrad']:.2f}"],
        ["camera and target, days", f"{target['days']:.1f}"],
        ["camera and target, months", f"{target['months']:.1f}"],
    ]
    print_table(["campaign", ""], rows)
    if few := s["orientations_with_few_reflections"]:
        print(
            f"{few:,} of {s['orientations']:,} orientations will show fewer than 5 reflections, "
            "because their mirrors are too small for the pattern or hidden by others; fly "
            "closer, or raise --samples or the lower of --elevations"
        )
    if s["drones"] > 1:
        print(f"minimum distance between drones in the air: {s['separation_m']:.0f} m")
    if s["fewest_points_of_a_heliostat"] < s["calibration_points"]:
        print(
            "some heliostats cannot reach all directions within their stops; the worst has "
            f"{s['fewest_points_of_a_heliostat']} calibration points: see commands.csv"
        )
