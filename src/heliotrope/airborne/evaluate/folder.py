"""The folder of a flight: photographs, camera and commands, for a given plant."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.reading import PhotoReading
from heliotrope.airborne.mirror import MirrorShape, ideal
from heliotrope.airborne.photo import SUFFIXES, LedCamera, Photo, read_camera, read_photos
from heliotrope.airborne.standing import MirrorPoses, join_standing, read_commands, standing
from heliotrope.errors import InputError
from heliotrope.field.formats.deflectometry import measured_slopes
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray


@dataclass(frozen=True)
class FlightData:
    """One flight: P photographs of N stationary mirrors.

    Attributes
    ----------
    name
        Name of the flight; empty if it is the only flight.
    photos
        Photographs as recorded by the drone.
    camera
        The camera with its lamp.
    stand
        The mirrors, as commanded.
    heliostat
        Indices of the heliostats in the plant, (N,).
    counts
        Drive counts, (N, D).
    shapes
        Surfaces of the mirrors, (N,), with slope maps if available.
    problems
        A message for each photograph that cannot be used.
    seen
        What the photographs show, (P,), once they have been evaluated.
    """

    name: str
    photos: tuple[Photo, ...]
    camera: LedCamera
    stand: MirrorPoses
    heliostat: npt.NDArray[np.intp]
    counts: FloatArray
    shapes: tuple[MirrorShape, ...]
    problems: tuple[str, ...] = ()
    seen: tuple[PhotoReading, ...] = ()

    def shape(self, row: int) -> MirrorShape:
        """Return the surface of a mirror."""
        return self.shapes[row]

    @property
    def corners(self) -> int:
        """Number of corners visible in the photographs of the flight."""
        return sum(int(np.isfinite(s.corners).all(axis=-1).sum()) for s in self.seen)

    @property
    def dark(self) -> bool:
        """Whether the photographs show the lamp but no mirror edge.

        A dark flight is evaluated without the other flights of its campaign.
        """
        return not self.corners and any(s.has_lights for s in self.seen)

    def unused(self) -> list[str]:
        """Return a message for each photograph that was evaluated but cannot be used."""
        if self.dark:
            return [s.why_unused() for s in self.seen if s.problem]
        lines = [s.why_unused() for s in self.seen if not s.has_corners]
        if not self.corners:
            lines.append(f"none of its {len(self.photos)} photographs can be used")
        return lines


def open_flights(
    folder: Path,
    plant: Plant,
    *,
    camera: Path | None = None,
    commands: Path | None = None,
    cluster: str = "",
    point: str = "",
    slopes: Path | None = None,
    focal: float = np.inf,
) -> tuple[list[FlightData], list[str], list[str]]:
    """Return the flights in a folder, sorted by name.

    A folder with photographs is one flight. A folder of such folders is a campaign, in which each
    flight has its own ``camera.toml`` and ``commands.csv`` or shares those of the campaign. From a
    shared table, flight ``C-P`` takes the commands of cluster C and calibration point P.

    Parameters
    ----------
    folder
        Folder of one flight, or of a campaign.
    plant
        The field.
    camera, commands
        Files to use instead of ``camera.toml`` and ``commands.csv``.
    cluster, point
        Cluster and point whose commands are used for a single flight; "" for all commands.
    slopes
        Folder of slope maps, NAME.npz or NAME.csv, or of deflectometry files in PAINT's format,
        NAME.h5.
    focal
        Focal length of the facets, m; inf for flat facets.

    Returns
    -------
    The flights, a message for each flight that cannot be used, and a message for each heliostat
    without a slope map.

    Raises
    ------
    InputError
        If no flight can be used, or no slope map exists.
    """
    surfaces = _Surfaces(plant, slopes, focal)
    inside = [] if _has_photos(folder) or not folder.is_dir() else sorted(folder.iterdir())
    below = [d for d in inside if d.is_dir() and _has_photos(d)]
    if not below:
        flight = open_flight(folder, plant, surfaces.of, camera, commands, cluster, point)
        return [flight], [], surfaces.missing
    flights, problems = [], []
    for subfolder in sorted(below, key=lambda d: natural_key(d.name)):
        lens = (
            subfolder / "camera.toml"
            if (subfolder / "camera.toml").exists()
            else folder / "camera.toml"
        )
        table, of, at = subfolder / "commands.csv", cluster, point
        own = commands is None and table.exists()
        if not own:
            table = commands or folder / "commands.csv"
            of, _, at = subfolder.name.rpartition("-")
        try:
            if not (own or (of and at)):
                raise InputError(
                    "its commands are unknown; name the folder CLUSTER-POINT, such as C1-3, or put "
                    "its commands.csv into it"
                )
            flight = open_flight(subfolder, plant, surfaces.of, camera or lens, table, of, at)
        except InputError as error:
            problems.append(f"{subfolder.name}: {error}")
            continue
        flights.append(replace(flight, name=subfolder.name))
    if not flights:
        raise InputError(f"{folder}: none of {len(below)} flights can be used; {problems[0]}")
    return flights, problems, surfaces.missing


def open_flight(
    folder: Path,
    plant: Plant,
    shape: Callable[[str], MirrorShape],
    camera: Path | None = None,
    commands: Path | None = None,
    cluster: str = "",
    point: str = "",
) -> FlightData:
    """Return the photographs of one folder, with the camera and the mirrors as commanded.

    Parameters
    ----------
    folder, plant, camera, commands, cluster, point
        See `open_flights`.
    shape
        Function that returns the surface of a heliostat, given its name.
    """
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
            "evaluate the groups one by one, each with its own table of commands"
        )
    stand = join_standing(parts)
    return FlightData(
        "",
        photos,
        lens,
        stand,
        np.concatenate(order),
        np.concatenate(values),
        tuple(shape(name) for name in stand.names),
        problems,
    )


def natural_key(name: str) -> list[tuple[str, int]]:
    """Return a sort key that places C1-2 before C1-10."""
    return [(text, int(number or 0)) for text, number in re.findall(r"([^0-9]*)([0-9]*)", name)]


def designed_shape(plant: Plant, focal: float = np.inf) -> Callable[[str], MirrorShape]:
    """Return a function that returns the designed surface of a heliostat, given its name."""
    return lambda name: ideal(*plant.find(name), focal=focal)


class _Surfaces:
    """Surfaces of heliostats by name; reads each slope map once and records missing maps."""

    def __init__(self, plant: Plant, slopes: Path | None, focal: float) -> None:
        self._designed, self._folder = designed_shape(plant, focal), slopes
        self._known: dict[str, MirrorShape] = {}
        self._maps = 0
        self._without: list[str] = []

    def of(self, name: str) -> MirrorShape:
        """Return the surface of a heliostat."""
        if name not in self._known:
            shape = self._designed(name)
            if self._folder is not None:
                slopes = measured_slopes(self._folder, name, shape.facets, shape.focal)
                if slopes is None:
                    self._without.append(name)
                else:
                    shape = shape.with_slopes(slopes)
                    self._maps += 1
            self._known[name] = shape
        return self._known[name]

    @property
    def missing(self) -> list[str]:
        """Messages, one for each heliostat without a slope map.

        Raises
        ------
        InputError
            If the folder has no map of any heliostat.
        """
        if self._without and not self._maps:
            raise InputError(
                f"{self._folder}: there is no slope map in it; name the files after heliostats, "
                f"{self._without[0]}.npz"
            )
        return [f"{self._folder}: no slope map of {n}; assumed ideal" for n in self._without]


def _has_photos(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    return any(f.suffix.lower() in SUFFIXES or f.name == "photos.csv" for f in folder.iterdir())
