"""``heliotrope drone dome``: a flight over coded targets that checks RTK (appendix A)."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli import _calibration as calibration
from heliotrope.cli._common import open_plant, parse_numbers, parse_point
from heliotrope.cli.drone import _shared as shared

if TYPE_CHECKING:
    from heliotrope.airborne.plan.dome import Dome


def dome(
    field: Annotated[Path, typer.Argument(metavar="PLANT", help="Plant file or PAINT folder.")],
    into: Annotated[Path, typer.Option(help="Folder for waypoints and targets.")] = Path("dome"),
    at: Annotated[
        str, typer.Option(help="Centre of the targets on the ground, E,N,U in m.")
    ] = "0,0,0",
    home: Annotated[
        str, typer.Option(help="Take-off point, E,N,U in m; default: the centre of the targets.")
    ] = "",
    radius: Annotated[
        float, typer.Option(min=1, max=1000, help="Distance of the photographs, m.")
    ] = 15.0,
    elevations: Annotated[
        str, typer.Option(help="Elevations of the rings, degrees.")
    ] = "35,50,65,80",
    photographs: Annotated[
        int, typer.Option(min=1, max=10_000, help="Total number of photographs.")
    ] = 48,
    targets: Annotated[
        int, typer.Option(min=1, max=10_000, help="Number of coded targets, laid out in a square.")
    ] = 25,
    spacing: Annotated[
        float, typer.Option(min=0.01, max=1000, help="Distance between targets, m.")
    ] = 2.5,
    target_mm: Annotated[
        float, typer.Option(min=1, max=100_000, help="Side length of a target's black square.")
    ] = 400.0,
    formats: Annotated[
        str,
        typer.Option(
            help="Formats of waypoint files: any of dji,qgc,litchi separated by commas, or none."
        ),
    ] = "dji,qgc,litchi",
    aircraft: Annotated[str, typer.Option(help="Drone model for DJI waypoint files.")] = "M3E",
    simulate: Annotated[
        bool,
        typer.Option("--simulate", help="Also render the photographs, with their ground truth."),
    ] = False,
    size: Annotated[
        str, typer.Option(help="Size of a rendered photograph, WIDTHxHEIGHT, pixels.")
    ] = "4000x3000",
    rtk_mm: Annotated[
        str, typer.Option(help="RTK error of each rendered position, E,N,U in mm.")
    ] = "6,6,8",
    seed: Annotated[
        int, typer.Option(min=0, max=2**63 - 1, help="Seed of all random numbers.")
    ] = 0,
) -> None:
    """Plan a dome flight over coded targets; `drone rtk --targets` evaluates its photographs."""
    import numpy as np

    from heliotrope.airborne.plan.dome import plan_dome, write_dome

    plant = open_plant(field)
    middle = parse_point(at, "--at")
    planned = plan_dome(
        middle,
        radius=radius,
        elevations=np.radians(_degrees(elevations)),
        photographs=photographs,
        targets=targets,
        spacing=spacing,
        side=1e-3 * target_mm,
    )
    write_dome(
        planned,
        plant.site,
        into,
        home=parse_point(home, "--home") if home else middle,
        formats=shared.formats(formats),
        aircraft=aircraft,
    )
    print(f"{len(planned)} photographs of {len(planned.targets)} coded targets: {into}")
    print(f"sheets to print: {into / 'targets'}, where to place them: {into / 'targets.csv'}")
    if simulate:
        _simulate(planned, field, into / "photographs", size, rtk_mm, seed)


def _degrees(text: str) -> list[float]:
    refusal = f"--elevations {text!r}: use angles from 0 to 90 degrees, such as 35,50,65,80"
    return list(parse_numbers(text, refusal, count=None, least=0.0, most=90.0))


def _simulate(
    planned: "Dome", field: Path, folder: Path, size: str, rtk_mm: str, seed: int
) -> None:
    from heliotrope.airborne.simulate.ground_targets import fly_dome, render_dome
    from heliotrope.airborne.simulate.rendering import Conditions
    from heliotrope.airborne.simulate.simulation import REAL
    from heliotrope.files.text import write_text

    site = open_plant(field).site
    east, north, up = (1e-3 * v for v in parse_point(rtk_mm, "--rtk-mm"))
    errors = replace(REAL, rtk=(east, north, up))
    flown = fly_dome(planned, shared.rendered_camera(size), errors, seed)
    origin = (site.latitude_deg, site.longitude_deg, site.height)
    with calibration.progress("rendering", False) as advance:
        render_dome(
            flown, folder, origin, conditions=Conditions(speed=1.0), seed=seed, progress=advance
        )
    lines = ["name,east_m,north_m,up_m"]
    lines += [f"{p.name},{','.join(f'{v:.6f}' for v in p.position)}" for p in flown.taken]
    (folder / "truth").mkdir(exist_ok=True)
    write_text(folder / "truth" / "photographs.csv", "\n".join(lines) + "\n")
    print(f"photographs: {folder}, truth: {folder / 'truth'}")
