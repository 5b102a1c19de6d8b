"""What the commands of a drone's flight share: a folder of photographs beside its field."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from heliotrope.cli import _calibration as shared
from heliotrope.cli._common import open_plant

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from heliotrope.airborne.evaluate.reading import Seen
    from heliotrope.airborne.mirror import MirrorShape
    from heliotrope.airborne.photo import LedCamera, Photo
    from heliotrope.airborne.standing import Standing
    from heliotrope.field.plant import Plant
    from heliotrope.geometry import FloatArray

FolderArgument = Annotated[
    Path, typer.Argument(help="Folder with photographs, camera.toml and commands.csv.")
]
CampaignArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder with photographs, camera.toml and commands.csv; or of a campaign: one such "
        "folder a flight, named CLUSTER-POINT where commands.csv is the plan's."
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
ClusterOption = Annotated[str, typer.Option(help="Cluster of the commands that was flown over.")]
PointOption = Annotated[str, typer.Option(help="Calibration point of the commands.")]
SurveyOption = Annotated[
    float, typer.Option(min=0.1, help="Standard deviation of surveyed positions, mm.")
]
KinematicsOption = Annotated[
    float,
    typer.Option(min=0.0, help="Standard deviation of vertices in their poses about that, mm."),
]
RtkOption = Annotated[
    float, typer.Option(min=0.1, help="Standard deviation of RTK's common offset (its base), mm.")
]
ProcessesOption = Annotated[
    int, typer.Option(min=0, help="Processes on this machine; 0: one a core.")
]
FocalOption = Annotated[
    float | None, typer.Option(min=1.0, help="Focal length of the facets, m; default: flat.")
]
OutOption = Annotated[Path, typer.Option(help="Folder for what is written.")]


@dataclass(frozen=True)
class FlightFolder:
    """Photographs with the mirrors that they show.

    Attributes
    ----------
    plant
        The field.
    photos
        As the drone tells them.
    problems
        A line for each that cannot be used.
    camera
        With its lamp.
    stand
        The commanded mirrors.
    counts
        Of their drives, (N, D).
    heliostat
        Their rows in the plant, (N,).
    focal
        Of the facets, m; inf if flat.
    name
        Of the flight; "" if it is the only one.
    """

    plant: "Plant"
    photos: "tuple[Photo, ...]"
    problems: tuple[str, ...]
    camera: "LedCamera"
    stand: "Standing"
    counts: "FloatArray"
    heliostat: "npt.NDArray[np.intp]"
    focal: float
    name: str = ""

    def shape(self, row: int) -> "MirrorShape":
        """Return the designed surface of a mirror."""
        from heliotrope.airborne.mirror import ideal

        return ideal(*self.plant.find(self.stand.names[row]), focal=self.focal)


def open_flight(
    folder: Path,
    field: Path,
    camera: Path | None,
    commands: Path | None,
    cluster: str,
    point: str,
    focal: float | None,
) -> FlightFolder:
    """Return the photographs of a folder with the field, the camera and the commands."""
    return _flight(folder, open_plant(field), camera, commands, cluster, point, focal)


def open_campaign(
    folder: Path,
    field: Path,
    camera: Path | None,
    commands: Path | None,
    cluster: str,
    point: str,
    focal: float | None,
) -> tuple[list[FlightFolder], list[str]]:
    """Return the flights of a folder, and a line for each that cannot be used.

    A folder without photographs whose subfolders have some is a campaign. A subfolder holds its
    own ``camera.toml`` and ``commands.csv``, or those of the folder count; there the commands
    of cluster C and point P are those of the subfolder ``C-P``.
    """
    from heliotrope.errors import InputError

    plant = open_plant(field)
    inside = [] if _has_photos(folder) or not folder.is_dir() else sorted(folder.iterdir())
    below = [d for d in inside if d.is_dir() and _has_photos(d)]
    if not below:
        return [_flight(folder, plant, camera, commands, cluster, point, focal)], []
    flights, problems = [], []
    for one in below:
        lens = one / "camera.toml" if (one / "camera.toml").exists() else folder / "camera.toml"
        table, of, at = one / "commands.csv", cluster, point
        own = commands is None and table.exists()
        if not own:
            table = commands or folder / "commands.csv"
            of, _, at = one.name.rpartition("-")
        try:
            if not (own or (of and at)):
                raise InputError(
                    "which commands were given? Call the folder CLUSTER-POINT, as C1-3, or put "
                    "its commands.csv into it"
                )
            flight = _flight(one, plant, camera or lens, table, of, at, focal)
        except InputError as error:
            problems.append(f"{one.name}: {error}")
            continue
        flights.append(replace(flight, name=one.name))
    if not flights:
        raise InputError(f"{folder}: none of {len(below)} flights can be used; {problems[0]}")
    return flights, problems


def _has_photos(folder: Path) -> bool:
    from heliotrope.airborne.photo import SUFFIXES

    if not folder.is_dir():
        return False
    return any(f.suffix.lower() in SUFFIXES or f.name == "photos.csv" for f in folder.iterdir())


def _flight(
    folder: Path,
    plant: "Plant",
    camera: Path | None,
    commands: Path | None,
    cluster: str,
    point: str,
    focal: float | None,
) -> FlightFolder:
    import numpy as np

    from heliotrope.airborne.photo import read_camera, read_photos
    from heliotrope.airborne.standing import join_standing, read_commands, standing
    from heliotrope.errors import InputError

    site = plant.site
    photos, problems = read_photos(folder, (site.latitude_deg, site.longitude_deg, site.height))
    lens = read_camera(camera or folder / "camera.toml")
    rows, counts = read_commands(commands or folder / "commands.csv", plant.names, cluster, point)
    parts, values, order, first = [], [], [], 0
    for heliostats in plant.groups.values():
        mine = np.flatnonzero((rows >= first) & (rows < first + len(heliostats)))
        if len(mine):
            order.append(rows[mine])
            chosen = heliostats.take(rows[mine] - first)
            drives = len(chosen.mechanism.driven)
            values.append(counts[mine, :drives])
            parts.append(standing(chosen, values[-1]))
        first += len(heliostats)
    if len({v.shape[1] for v in values}) > 1:
        raise InputError(
            f"{folder}: the commanded heliostats have mechanisms with different numbers of drives; "
            "evaluate the groups one by one, each with a table of its own commands"
        )
    return FlightFolder(
        plant,
        photos,
        problems,
        lens,
        join_standing(parts),
        np.concatenate(values),
        np.concatenate(order),
        np.inf if focal is None else focal,
    )


def read_flight(
    flight: FlightFolder, keep: Path | None, processes: int, scheduler: str | None, quiet: bool
) -> "tuple[Seen, ...]":
    """Read all photographs behind a progress bar; what was read before is not read again."""
    from heliotrope.airborne.evaluate.evaluation import read_many

    what = f"reading {flight.name}".strip()
    with shared.connected(scheduler) as client, shared.progress(what, quiet) as advance:
        return read_many(
            flight.photos,
            flight.camera,
            flight.stand,
            processes=processes or len(os.sched_getaffinity(0)),
            client=client,
            keep=keep,
            progress=advance,
        )
