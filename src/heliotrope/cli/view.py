"""``heliotrope view``: a heliostat's mechanism moving through a day, in three dimensions."""

from pathlib import Path
from typing import Annotated

import typer

from heliotrope.cli._common import open_plant, parse_time, sunlit
from heliotrope.cli.track import (
    AimOption,
    FieldArgument,
    HeliostatOption,
    TargetOption,
    aim_of,
    check_front,
)
from heliotrope.errors import InputError

#: Simulated time per second of the animation, s.
_PACE = 3600.0

#: Shortest time between two poses, s; a page of 30 s contains 2,000 poses, 10 MB.
_LEAST = 30.0


def view(
    field: FieldArgument,
    out: Annotated[Path, typer.Argument(help="File to write: .html, or .glb for Blender.")],
    heliostat: HeliostatOption,
    aim: AimOption = None,
    target: TargetOption = None,
    time: Annotated[
        str, typer.Option(help="A time on the day to show, ISO 8601 with a zone.")
    ] = "now",
    every: Annotated[str, typer.Option(help="Time between poses, such as 5min or 30s.")] = "10min",
) -> None:
    """Write a day of a heliostat's motion as an animated 3D view."""
    import numpy as np

    from heliotrope import plot
    from heliotrope import sun as solar
    from heliotrope.files.text import write_file
    from heliotrope.mechanism import animation, tracking

    kind = out.suffix.lower()
    if kind not in (".html", ".glb"):
        raise InputError(f"view: {out.name}: the file name must end in .html or .glb")
    plant = open_plant(field)
    mirror = plant[heliostat]
    mechanism, width, height = mirror.calibrated, mirror.width, mirror.height
    goal = np.array(aim_of(plant, heliostat, aim, target))
    times = sunlit(parse_time(time), plant.site, every, _LEAST)
    light = np.asarray(solar.vector(times, plant.site))
    solution = tracking.track(mechanism, light, goal)
    good = solution.reachable
    check_front(plant, heliostat, goal, solution.chosen(solution.vertex)[good])
    if not good.any():
        raise InputError(
            f"heliostat {heliostat}: the beam does not reach the aim at any time of this day"
        )
    angles = np.unwrap(solution.best_angles[good], axis=0)
    chosen = [at for at, reached in zip(times, good, strict=True) if reached]
    seconds = np.array([(at - chosen[0]).total_seconds() for at in chosen]) / _PACE
    if kind == ".glb":
        data = animation.glb(mechanism, angles, seconds, width, height)
    else:
        figure = plot.mechanism_3d(
            mechanism,
            angles,
            width=width,
            height=height,
            labels=[at.strftime("%H:%M UTC") for at in chosen],
            sun=light[good],
            aim=goal,
            title=f"{heliostat}: armature and mirror through a day",
        )
        data = figure.to_html(include_plotlyjs=True, full_html=True).encode()
    write_file(out, lambda stream: stream.write(data))
    span = f"{chosen[0]:%Y-%m-%d %H:%M} to {chosen[-1]:%H:%M} UTC"
    print(f"{out.name}: {heliostat}, {len(chosen)} of {len(good)} poses reach the aim, {span}")
