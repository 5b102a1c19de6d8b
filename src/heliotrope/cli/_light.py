"""Options for the light on a field, shared by ``flux`` and ``aim``."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from heliotrope.cli._common import day_of, parse_numbers, parse_time
from heliotrope.errors import InputError, shown

if TYPE_CHECKING:
    from heliotrope.field.plant import Plant
    from heliotrope.field.tower import Tower
    from heliotrope.optics import FieldOptics

Field = Annotated[Path, typer.Argument(help="Plant file, or a field in another format.")]
Time = Annotated[
    str | None, typer.Option(help="ISO 8601 with a time zone, or now. Default: noon today.")
]
Sun = Annotated[str | None, typer.Option(help="Sun vector east,north,up instead of a time.")]
SiteOption = Annotated[
    str | None, typer.Option(help="LATITUDE,LONGITUDE,HEIGHT of a field without a location.")
]
Dni = Annotated[float, typer.Option(min=0, max=2000, help="Direct normal irradiance, W/m².")]
Shape = Annotated[
    str,
    typer.Option(
        "--sun-shape",
        help="Sun shape: limb, quartic, pillbox, buie:RATIO or gaussian:SIGMA in rad.",
    ),
]
Air = Annotated[
    str,
    typer.Option(
        help="Atmosphere: clear, hazy, mirval, ballestrin-clear, ballestrin-hazy, none, or the "
        "visibility in km."
    ),
]
Slope = Annotated[
    float | None,
    typer.Option(
        min=0,
        max=50,
        help="Slope error of the surface per axis, mrad. Default: from the plant file, or 1.",
    ),
]
Error = Annotated[
    float, typer.Option(min=0, max=100, help="Expected error of the mirror normals, mrad RMS.")
]
Reflectivity = Annotated[
    float | None,
    typer.Option(
        min=0, max=1, help="Reflectivity of a clean mirror. Default: from the plant file, or 0.9."
    ),
]
Clean = Annotated[
    float,
    typer.Option(
        min=0,
        max=1,
        help="Cleanliness: fraction of the reflectivity that remains when the mirrors are soiled.",
    ),
]
Focus = Annotated[
    str,
    typer.Option(
        help="Focal length of all mirrors in m; or slant (the slant range), flat, or plant (as "
        "in the plant file; slant if it gives none)."
    ),
]
FacetOption = Annotated[
    str | None, typer.Option(help="Number of columns and rows of equal facets, such as 5x7.")
]
CantingOption = Annotated[
    str,
    typer.Option(
        help="Canting of these facets: slant (the slant range), a focal length in m, or the time "
        "for which they are canted off-axis."
    ),
]
CellOption = Annotated[
    str | None,
    typer.Option(help="Number of rows and columns of flux cells on each receiver, such as 20x56."),
]
Towers = Annotated[
    list[str] | None,
    typer.Option(help="Obstacle: EAST,NORTH,RADIUS,TOP in m; may be repeated."),
]


def light_of(
    dni: float,
    shape: str,
    air: str,
    slope_mrad: float | None,
    error_mrad: float,
    reflectivity: float | None,
    clean: float,
    focus: str,
    facets: str | None,
    cells: str | None,
    tower: list[str] | None,
) -> "FieldOptics":
    """Return the light that the options describe; its canting requires a plant."""
    from heliotrope.optics import FieldOptics

    return FieldOptics(
        dni=dni,
        shape=shape,
        air=air,
        slope=None if slope_mrad is None else 1e-3 * slope_mrad,
        error=1e-3 * error_mrad,
        reflectivity=reflectivity,
        clean=clean,
        focus=_focus(focus),
        facets=None if facets is None else _facets(facets),
        cells=_cells(cells),
        towers=tuple(_tower(text) for text in tower or ()),
    )


def _focus(text: str) -> Literal["plant", "slant", "flat"] | float:
    words: dict[str, Literal["plant", "slant", "flat"]]
    words = {"plant": "plant", "slant": "slant", "flat": "flat"}
    if text in words:
        return words[text]
    refusal = (
        "--focus must be plant, slant, flat, or a focal length from 0.1 to 1e5 m, not "
        f"{shown(text)}"
    )
    (length,) = parse_numbers(text, refusal, least=0.1, most=1e5)
    return length


def _facets(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", text, re.ASCII)
    if match is None:
        raise InputError(
            f"--facets {shown(text)}: write COLUMNSxROWS, such as 5x7, each number from 1 to 50"
        )
    return int(match[1]), int(match[2])


def canting_of(text: str, facets: tuple[int, int] | None, plant: "Plant") -> Any:
    """Return the canting of facets from "slant", a focal length, or a sun position."""
    from heliotrope.sun import vector

    if text == "slant":
        return text
    if facets is None:
        raise InputError(
            "--canting applies only with --facets; add --facets COLUMNSxROWS, such as 5x7, "
            "or specify the canting in the plant file"
        )
    if re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", text, re.ASCII):
        refusal = f"--canting {shown(text)}: use slant, a focal length from 0.1 to 1e5 m, or a time"
        return parse_numbers(text, refusal, least=0.1, most=1e5)[0]
    light = vector(parse_time(text), plant.site)
    if light[2] <= 0.0:
        raise InputError(
            f"--canting {shown(text)}: the sun is below the horizon at that time; choose a time in "
            "daylight"
        )
    return light


def _cells(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,4})x(\d{1,4})", text, re.ASCII)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if not (min(size) >= 1 and size[0] * size[1] <= 1_000_000):
        raise InputError(
            f"--cells {shown(text)}: write ROWSxCOLUMNS, such as 20x56, at most a million cells"
        )
    return size


def _tower(text: str) -> "Tower":
    from heliotrope.field.tower import Tower

    refusal = f"--tower {shown(text)}: write four numbers in m as east,north,radius,top"
    east, north, radius, top = parse_numbers(text, refusal, count=4)
    # The foot of the tower is below the ground of any field.
    return Tower(east, north, radius, min(top - 1.0, -1e4), top)


def noon(plant: "Plant") -> Any:
    """Return the time at which the sun is highest today."""
    from heliotrope.sun import events

    return events(day_of(parse_time("now"), plant.site), plant.site).culmination
