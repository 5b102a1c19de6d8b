"""The dome flight in HelioPoint's appendix A: photographs of coded targets from a hemisphere.

Photogrammetry needs rays that intersect at wide angles, from all sides and several heights. Every
photograph is therefore aimed at the middle of the targets. The paper shows such a flight (figure 7)
but states neither its radius nor the number of photographs; the values here are our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.coded_targets import NUMBERS, CodedTarget, square_target, target_sheet
from heliotrope.airborne.photo import gimbal_of_rotation
from heliotrope.airborne.plan.flight_files import write_missions
from heliotrope.airborne.plan.waypoints import Mission
from heliotrope.errors import InputError
from heliotrope.field.camera import look_at
from heliotrope.files.text import write_text
from heliotrope.geometry import FloatArray, as_float, as_vectors, direction, enu_to_geodetic
from heliotrope.sun import Site

#: Elevations of the rings of photographs, rad.
RINGS = tuple(np.radians([35.0, 50.0, 65.0, 80.0]).tolist())


@dataclass(frozen=True)
class Dome:
    """A dome flight.

    Attributes
    ----------
    center
        Middle of the targets on the ground, ENU metres, (3,).
    position
        Positions of the P photographs in flight order, ENU metres, (P, 3).
    rotation
        Rotation from camera axes to ENU, (P, 3, 3).
    targets
        Positions where the targets are to be placed, to within some decimetres.
    side
        Side of the black squares of the targets, m.
    """

    center: FloatArray
    position: FloatArray
    rotation: FloatArray
    targets: tuple[CodedTarget, ...]
    side: float

    def __len__(self) -> int:
        return len(self.position)


def plan_dome(
    center: npt.ArrayLike,
    *,
    radius: float = 15.0,
    elevations: Sequence[float] | FloatArray = RINGS,
    photographs: int = 48,
    targets: int = 25,
    spacing: float = 2.5,
    side: float = 0.4,
) -> Dome:
    """Return a dome over a square of coded targets.

    Parameters
    ----------
    center
        Middle of the targets on the ground, ENU metres, (3,).
    radius
        Distance of the photographs from ``center``, m.
    elevations
        Elevations of the rings of photographs, rad.
    photographs
        Total number of photographs. Each ring receives a number in proportion to its circumference,
        but at least four.
    targets, spacing, side
        Number of targets, laid out in a square; distance between neighbours, m; side of the black
        squares, m.

    Raises
    ------
    InputError
        If an argument is out of range.
    """
    for name, value, low, high in (
        ("radius", radius, 2.0, 200.0),
        ("photographs", photographs, 12, 500),
        ("targets", targets, 4, NUMBERS),
        ("spacing", spacing, 1.5 * side, 50.0),
        ("side", side, 0.05, 5.0),
    ):
        if not low <= value <= high:
            raise InputError(f"dome: {name} must be between {low:g} and {high:g}, not {value:g}")
    rings = np.sort(as_float(elevations))
    if len(rings) < 2 or rings[0] < np.radians(15.0) or rings[-1] > np.radians(88.0):
        raise InputError(
            f"dome: elevations {np.degrees(rings).tolist()}°; use two or more from 15 to 88"
        )
    middle = as_vectors(center, "center")
    share = np.cos(rings) / np.cos(rings).sum()
    places: list[FloatArray] = []
    for ring, (up, part) in enumerate(zip(rings, share, strict=True)):
        count = max(4, round(photographs * part))
        # Neighbouring rings are rotated against each other, and flown in opposite directions.
        turns = 2.0 * np.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        around = turns if ring % 2 == 0 else turns[::-1]
        places += [middle + radius * direction(a, float(up)) for a in around.tolist()]
    position = np.stack(places)
    across = int(np.ceil(np.sqrt(targets)))
    grid = np.stack(np.divmod(np.arange(targets), across), axis=-1)[:, ::-1] - 0.5 * (across - 1)
    laid = tuple(
        square_target(k, middle + [spacing * x, -spacing * y, 0.0], side, [1, 0, 0], [0, -1, 0])
        for k, (x, y) in enumerate(grid.tolist())
    )
    rotation = np.stack([look_at(place, middle) for place in position])
    return Dome(middle, position, rotation, laid, side)


def write_dome(
    dome: Dome,
    site: Site,
    folder: Path,
    *,
    home: npt.ArrayLike,
    formats: Sequence[str],
    aircraft: str = "M3E",
    speed: float = 3.0,
    rest: float = 2.5,
) -> list[Path]:
    """Write waypoint files, a printable sheet for each target, and a table of target positions.

    Parameters
    ----------
    dome, site, folder
        The flight, the site of the ENU origin, and the output folder.
    home
        Take-off position, ENU metres, (3,).
    formats, aircraft
        See `heliotrope.airborne.plan.flight_files.write_plan`.
    speed, rest
        Speed between photographs, m/s, and time to come to rest, s.
    """
    origin = site.latitude_deg, site.longitude_deg, site.height
    start = as_vectors(home, "home")
    lat, lon, _ = enu_to_geodetic(dome.position, origin)
    angles = np.degrees([gimbal_of_rotation(r)[:2] for r in dome.rotation])
    count = len(dome)
    geodetic = tuple(float(v) for v in enu_to_geodetic(start, origin))
    mission = Mission(
        "dome",
        lat,
        lon,
        dome.position[:, 2] - start[2],
        angles[:, 0] % 360.0,
        angles[:, 1],
        np.full(count, rest),
        np.ones(count, np.bool_),
        speed,
        (geodetic[0], geodetic[1], geodetic[2]),
        float(dome.position[:, 2].max() - start[2]),
    )
    written = write_missions(folder, [mission], formats=formats, aircraft=aircraft)
    lines = ["number,east_m,north_m,up_m"]
    (folder / "targets").mkdir(exist_ok=True)
    for target in dome.targets:
        path = folder / "targets" / f"target-{target.number:03d}.svg"
        write_text(path, target_sheet(target.number, 1e3 * dome.side))
        written.append(path)
        middle = target.corners.mean(axis=0)
        lines.append(f"{target.number},{','.join(f'{v:.3f}' for v in middle)}")
    write_text(folder / "targets.csv", "\n".join(lines) + "\n")
    return [folder / "targets.csv", *written]
