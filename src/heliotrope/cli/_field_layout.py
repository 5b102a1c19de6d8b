"""``heliotrope field layout``: generate a field as a plant file."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from heliotrope.cli._common import print_json

if TYPE_CHECKING:
    from heliotrope.field.layouts import HeliostatSize
    from heliotrope.field.plant import Plant


def layout(
    kind: Annotated[
        str, typer.Argument(help="Kind of layout: six-packs, twin-field, radial or rows.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Plant file to write (TOML).")],
    heliostats: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Number of heliostats.")
    ] = 10_000,
    width: Annotated[float, typer.Option(min=0.05, max=50, help="Width of a mirror, m.")] = 2.5,
    height: Annotated[float, typer.Option(min=0.05, max=50, help="Height of a mirror, m.")] = 2.0,
    pivot: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=50,
            help="Height of the pivots, m; default: half the mirror height plus 0.7.",
        ),
    ] = None,
    clearance: Annotated[
        float, typer.Option(min=0, max=50, help="Clearance between two mirrors in any pose, m.")
    ] = 0.3,
    tower: Annotated[
        float | None,
        typer.Option(
            min=1,
            max=1000,
            help="Height of the receiver above the pivots, m; default: in proportion to the field.",
        ),
    ] = None,
    latitude: Annotated[
        float, typer.Option(min=-90, max=90, help="Latitude, degrees north.")
    ] = -28.5,
    longitude: Annotated[
        float, typer.Option(min=-180, max=180, help="Longitude, degrees east.")
    ] = 21.2,
    altitude: Annotated[
        float, typer.Option(min=-500, max=9000, help="Altitude of the site, m.")
    ] = 830.0,
    name: Annotated[str, typer.Option(help="Name of the plant; default: the kind of layout.")] = "",
    table: Annotated[
        str, typer.Option(help="Format of the heliostat table: csv or parquet.")
    ] = "csv",
    picture: Annotated[
        Path | None, typer.Option(help="Draw the field into this file (PNG, SVG or PDF).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Write a generated plant: heliostats in clusters, a tower, and two targets with cameras.

    The field lies on the side of the tower away from the equator; the patterns of rows and twin
    fields lie on both sides.
    """
    from heliotrope.errors import InputError
    from heliotrope.field.formats.plant_file import write_plant
    from heliotrope.field.layouts import HeliostatSize, lay_out
    from heliotrope.sun import Site

    kinds = ("png", "svg", "pdf")
    if picture is not None and picture.suffix.removeprefix(".").lower() not in kinds:
        raise InputError(f"picture {picture}: the file name must end in .png, .svg or .pdf")
    mirror = HeliostatSize(
        width, height, 0.5 * height + 0.7 if pivot is None else pivot, clearance=clearance
    )
    plant = lay_out(
        kind,
        heliostats,
        mirror=mirror,
        tower_height=tower,
        site=Site(latitude, longitude, altitude, name=name),
        name=name,
    )
    write_plant(plant, out, _table(table))
    if picture is not None:
        _draw(plant, picture)
    _report(plant, mirror, out, as_json)


def _report(plant: "Plant", mirror: "HeliostatSize", out: Path, as_json: bool) -> None:
    from heliotrope.field.layouts import nearest_gap

    area = mirror.width * mirror.height
    facts = {
        "file": str(out),
        "heliostats": len(plant),
        "clusters": len({c for g in plant.groups.values() for c in g.cluster}),
        "mirror_area_m2": len(plant) * area,
        "receiver_height_m": float(plant.receivers[0].center[2]),
        "nearest_gap_m": nearest_gap(plant.position, mirror),
        "farthest_m": float((plant.position[:, :2] ** 2).sum(axis=1).max() ** 0.5),
    }
    if as_json:
        print_json(facts)
        return
    gap = f"; mirrors stay at least {facts['nearest_gap_m']:.2f} m apart in any pose"
    apart = gap if len(plant) > 1 else ""
    print(
        f"{out}: {facts['heliostats']:,} heliostats of {area:g} m² in {facts['clusters']:,} "
        f"clusters, receiver at {facts['receiver_height_m']:.0f} m, the farthest heliostat "
        f"{facts['farthest_m']:.0f} m away{apart}"
    )


def _table(name: str) -> Literal["csv", "parquet"]:
    from heliotrope.errors import InputError

    if name == "csv":
        return "csv"
    if name == "parquet":
        return "parquet"
    raise InputError(f"table {name!r}: use csv or parquet")


def _draw(plant: "Plant", place: Path) -> None:
    from heliotrope.field.layout_picture import picture
    from heliotrope.files import write_file

    figure = picture(plant)
    ending = place.suffix.removeprefix(".").lower()
    write_file(place, lambda stream: figure.savefig(stream, dpi=110, format=ending))
