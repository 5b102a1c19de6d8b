"""``heliotrope standby`` and ``heliotrope glare``: the light of a field at standby."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from heliotrope.cli._calibration import progress
from heliotrope.cli._common import open_plant, parse_point, print_json, print_table
from heliotrope.cli.field import noon_suns
from heliotrope.errors import InputError

if TYPE_CHECKING:
    from heliotrope.field.plant import Plant
    from heliotrope.geometry import FloatArray
    from heliotrope.plant.motion.standby import EyeYear, Rest

_Plant = Annotated[Path, typer.Argument(help="Plant file (TOML).")]


def standby(
    plant: _Plant,
    limit_suns: Annotated[
        float | None,
        typer.Option(
            min=1,
            max=1e6,
            help="Maximum irradiance in the air, suns; default: only print the irradiance with "
            "the current standby points.",
            show_default=False,
        ),
    ] = None,
    csv: Annotated[
        Path | None, typer.Option("--csv", help="File for the new, spread standby points.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Picture to write (.png, .svg or .pdf).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Spread standby points so that the light in the air stays below a limit.

    Printed are the strongest light with the whole field at standby, where it is, and the return to
    the receiver, for the points of the plant file and for the spread points. The field follows
    `heliotrope ctl standby POINTS` with the CSV file.
    """
    from heliotrope.plant.motion.standby import StandbyField

    _check(plant, csv, picture, limit_suns)
    design = open_plant(plant)
    field = StandbyField(design, noon_suns(design.site.latitude_deg))
    rests = {"today": field.rest(field.today)}
    if limit_suns is not None:
        with progress("spreading standby points", as_json) as step:
            points = field.spread(limit_suns, step)
        rests["spread"] = field.rest(points, limit_suns)
        if csv is not None:
            from heliotrope.field.points import write_points

            write_points(csv, design.names, points)
        if picture is not None:
            from heliotrope.calibration.plan.report import write_picture
            from heliotrope.plot.light import standby_figure

            write_picture(picture, standby_figure(design, field.today, points))
    if as_json:
        print_json(
            {name: _document(rest) for name, rest in rests.items()} | {"limit_suns": limit_suns}
        )
        return
    _print(rests, noon_suns(design.site.latitude_deg))
    for name, path in (("csv", csv), ("picture", picture)):
        if path is not None:
            print(f"{name}: {path}")


def _check(plant: Path, csv: Path | None, picture: Path | None, limit: float | None) -> None:
    from heliotrope.calibration.plan.report import check_picture
    from heliotrope.cli.plan import check_outputs

    if limit is None and (csv is not None or picture is not None):
        raise InputError("standby: --csv and --picture need spread points; add --limit-suns")
    if picture is not None:
        check_picture(picture)
    check_outputs(tuple(path for path in (csv, picture) if path is not None), plant, None)


def _document(rest: "Rest") -> dict[str, Any]:
    import numpy as np

    return {
        "suns": [light.suns for light in rest.light],
        "bound_suns": [light.bound for light in rest.light],
        "point_m": [light.point for light in rest.light],
        "move_median_s": float(np.median(rest.moves)),
        "move_max_s": float(rest.moves.max()),
        "return_s": rest.returns,
        "blocked": list(rest.blocked),
    }


def _print(rests: "dict[str, Rest]", suns: "FloatArray") -> None:
    import numpy as np

    rows = []
    for k, sun in enumerate(suns):
        for name, rest in rests.items():
            light, moves = rest.light[k], rest.moves[k]
            rows.append(
                [
                    _sun_text(sun) if name == "today" else "",
                    name,
                    f"{light.suns:.0f}, at most {light.bound:.0f}",
                    ", ".join(f"{round(x)}" for x in light.point),
                    f"{np.median(moves):.1f} s, {moves.max():.1f} s",
                    f"{rest.returns[k]:.0f} s",
                    str(rest.blocked[k]),
                ]
            )
    heads = ("sun", "points", "suns", "at, m", "move: median, longest", "return", "no path")
    print_table(heads, rows)


def _sun_text(sun: "FloatArray") -> str:
    import numpy as np

    azimuth = np.degrees(np.arctan2(sun[0], sun[1])) % 360.0
    return f"az {azimuth:.0f}°, el {np.degrees(np.arcsin(sun[2])):.0f}°"


def glare(
    plant: _Plant,
    at: Annotated[
        list[str] | None,
        typer.Option(
            help="Eye position of an observer, as NAME=EAST,NORTH,UP in m; default: eyes_m of "
            "the plant file.",
            show_default=False,
        ),
    ] = None,
    standby: Annotated[
        Path | None,
        typer.Option(help="Standby points (CSV); default: those of the plant file."),
    ] = None,
    csv: Annotated[Path | None, typer.Option("--csv", help="File for the hours of glare.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print the hours of glare in a year at places of eyes, with the whole field at standby.

    The sky is always clear. The figures are for information only; see the module
    heliotrope.optics.glare.
    """
    import numpy as np

    from heliotrope.cli.plan import check_outputs
    from heliotrope.optics.standing import hours_of_the_year
    from heliotrope.plant.motion.standby import StandbyField

    check_outputs((csv,), plant, standby)
    design = open_plant(plant)
    eyes = _eyes(design, at)
    suns, hours = hours_of_the_year(float(np.radians(design.site.latitude_deg)))
    field = StandbyField(design, suns)
    points = _points(design, field.today, standby)
    with progress("a year of glare", as_json) as step:
        years = field.glare(points, np.stack(list(eyes.values())), hours, step)
    documents = [_year(name, year) for name, year in zip(eyes, years, strict=True)]
    if csv is not None:
        _write(csv, documents)
    if as_json:
        print_json(documents)
        return
    heads = ("eye", "low", "after-image", "damage", "peak suns", "with the sun at")
    rows = [
        (
            row["eye"],
            *(f"{row[key]:.0f} h" for key in ("low_h", "after_image_h", "damage_h")),
            f"{row['suns']:.3g}",
            _sun_text(year.sun) if year.suns else "no light",
        )
        for row, year in zip(documents, years, strict=True)
    ]
    print_table(heads, rows)
    if csv is not None:
        print(f"csv: {csv}")


def _eyes(design: "Plant", at: list[str] | None) -> "dict[str, FloatArray]":
    import numpy as np

    eyes = {} if at else dict(design.eyes)
    for text in at or ():
        name, sign, place = text.partition("=")
        if not (name and sign) or name in eyes:
            raise InputError(
                f"--at {text!r}: write NAME=EAST,NORTH,UP in m, and use each name only once"
            )
        eyes[name] = np.array(parse_point(place, f"eye {name}"))
    if not eyes:
        raise InputError(
            f"glare: {design.name} has no eyes_m; add eye positions with --at NAME=EAST,NORTH,UP"
        )
    return eyes


def _points(design: "Plant", today: "FloatArray", file: Path | None) -> "FloatArray":
    points = today.copy()
    if file is not None:
        from heliotrope.field.points import read_points

        rows = {name: row for row, name in enumerate(design.names)}
        for name, point in read_points(file, design.names).items():
            points[rows[name]] = point
    return points


def _year(name: str, year: "EyeYear") -> dict[str, Any]:
    import numpy as np

    low, after, damage = year.hours.tolist()
    return {
        "eye": name,
        "low_h": low,
        "after_image_h": after,
        "damage_h": damage,
        "suns": year.suns,
        "sun_azimuth_deg": float(np.degrees(np.arctan2(year.sun[0], year.sun[1])) % 360.0),
        "sun_elevation_deg": float(np.degrees(np.arcsin(year.sun[2]))),
    }


def _write(path: Path, documents: list[dict[str, Any]]) -> None:
    import csv
    import io

    from heliotrope.files import write_text

    text = io.StringIO(newline="")
    rows = csv.DictWriter(text, list(documents[0]), lineterminator="\n")
    rows.writeheader()
    rows.writerows(documents)
    write_text(path, text.getvalue())
