"""Arguments, options and progress bars that the drone commands share."""

import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli import _calibration as calibration

if TYPE_CHECKING:
    from heliotrope.airborne.photo import LedCamera

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder with photographs, camera.toml and commands.csv.")
]
CampaignArgument = Annotated[
    Path,
    typer.Argument(
        help=(
            "Folder with photographs, camera.toml and commands.csv; or a campaign folder with "
            "one such folder per flight, named CLUSTER-POINT if commands.csv comes from the "
            "plan."
        )
    ),
]
FieldOption = Annotated[Path, typer.Option("--field", help="Plant file or folder.")]
CameraOption = Annotated[
    Path | None, typer.Option(help="Camera file (TOML); default: camera.toml in the folder.")
]
CommandsOption = Annotated[
    Path | None,
    typer.Option(help="Table of commands (CSV); default: commands.csv in the folder."),
]
ClusterOption = Annotated[
    str, typer.Option(help="Cluster that was measured, as named in the commands.")
]
PointOption = Annotated[
    str, typer.Option(help="Calibration point that was measured, as numbered in the commands.")
]
SurveyOption = Annotated[
    float, typer.Option(min=0.1, max=100_000, help="Standard deviation of surveyed positions, mm.")
]
KinematicsOption = Annotated[
    float,
    typer.Option(
        min=0,
        max=100_000,
        help="Standard deviation of mirror vertices from their kinematic model, mm.",
    ),
]
RtkOption = Annotated[
    float,
    typer.Option(
        min=0.1, max=100_000, help="Standard deviation of the common RTK offset (base station), mm."
    ),
]
ProcessesOption = Annotated[
    int, typer.Option(min=0, max=1024, help="Processes on this machine; 0: one for each core.")
]
FocalOption = Annotated[
    float | None,
    typer.Option(min=1, max=100_000, help="Focal length of the facets, m; default: flat."),
]
OutOption = Annotated[Path, typer.Option(help="Folder for the results.")]


def cores(processes: int) -> int:
    """Return the number of processes to use: as specified, or one per core."""
    return processes or len(os.sched_getaffinity(0))


@contextmanager
def stages(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """Yield a function (what, done, total) that draws a progress bar for each stage."""
    with ExitStack() as stack:
        bars: dict[str, Callable[[int, int], None]] = {}

        def show(what: str, done: int, of: int) -> None:
            if what not in bars:
                stack.close()
                bars.clear()
                bars[what] = stack.enter_context(calibration.progress(what, quiet))
            bars[what](done, of)

        yield show


def rendered_camera(size: str, focal_px: float = 0.0) -> "LedCamera":
    """Return the camera of rendered photographs.

    A focal length of 0 means 3/4 of the image width.
    """
    import numpy as np

    from heliotrope.airborne.photo import LedCamera
    from heliotrope.errors import InputError

    match = re.fullmatch(r"(\d{2,5})[x×](\d{2,5})", size)
    if not match:
        raise InputError(f"--size {size!r}: write WIDTHxHEIGHT in pixels, such as 4000x3000")
    width, height = int(match[1]), int(match[2])
    if 0.0 < focal_px < 1.0:
        raise InputError(
            f"--focal-px {focal_px:g}: use 1 or more pixels, or 0 for 3/4 of the width"
        )
    f = focal_px or 0.75 * width
    matrix = np.array([[f, 0.0, 0.5 * (width - 1)], [0.0, f, 0.5 * (height - 1)], [0, 0, 1.0]])
    return LedCamera((width, height), matrix, np.array([-0.08, 0.06, 3e-4, -2e-4, -0.01]))


def formats(text: str) -> tuple[str, ...]:
    """Return the formats of waypoint files that --formats specifies."""
    from heliotrope.airborne.plan.flight_files import FORMATS
    from heliotrope.errors import InputError

    names = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    if names == ("none",):
        return ()
    for name in names:
        if name not in FORMATS:
            raise InputError(f"--formats {name!r}: choose from {','.join(FORMATS)}, or none")
    return names
