"""``heliotrope drone match``: pictures and a table in which a user names mirrors."""

from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli._common import open_plant
from heliotrope.cli.drone import _shared as shared


def match(
    folder: shared.CampaignArgument,
    field: shared.FieldOption,
    photo: Annotated[
        list[str] | None,
        typer.Option(help="A photograph, NAME or FLIGHT/NAME; default: all unidentified ones."),
    ] = None,
    camera: shared.CameraOption = None,
    commands: shared.CommandsOption = None,
    cluster: shared.ClusterOption = "",
    point: shared.PointOption = "",
    out: shared.OutOption = Path("out/drone"),
    processes: shared.ProcessesOption = 0,
) -> None:
    """Show photographs with numbered outlines, so that a user can name the mirrors by hand."""
    from heliotrope.airborne.evaluate.flight import read_flight
    from heliotrope.airborne.evaluate.folder import open_flights
    from heliotrope.airborne.evaluate.matching_sheets import write_sheets

    flights, unusable, _ = open_flights(
        folder, open_plant(field), camera=camera, commands=commands, cluster=cluster, point=point
    )
    with shared.stages(False) as progress:
        read = [
            read_flight(
                flight,
                keep=out / "photographs",
                processes=shared.cores(processes),
                progress=progress,
            )
            for flight in flights
        ]
    sheets = write_sheets(read, photo or (), out)
    for line in unusable:
        typer.echo(f"heliotrope: {line}", err=True)
    for picture, count in zip(sheets.pictures, sheets.outlines, strict=True):
        print(f"{picture}: {count} outlines")
    print(
        f"In {sheets.table}, enter the heliostat names of three or more mirrors in each "
        "photograph, far apart from each other; rows without a name are ignored."
    )
    print(f"Then run: heliotrope drone evaluate {folder} --field {field} --matches {sheets.table}")
