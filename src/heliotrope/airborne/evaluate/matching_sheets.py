"""Photographs with numbered outlines, in which a user identifies mirrors.

Each picture shows possible mirrors, numbered, and the heliostats at the positions expected from the
recorded position and gimbal angles. A table beside the pictures has a row for each number, with an
empty name.
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heliotrope.airborne.evaluate.detection import Patches, Picture, decode, find_patches
from heliotrope.airborne.evaluate.identification import expected_size
from heliotrope.airborne.evaluate.matching import COLUMNS, MIDDLE
from heliotrope.airborne.photo import LedCamera, Photo
from heliotrope.airborne.standing import MirrorPoses
from heliotrope.errors import InputError
from heliotrope.files.text import write_file, write_text

if TYPE_CHECKING:
    from heliotrope.airborne.evaluate.folder import FlightData

#: Colours, as blue, green, red.
_FOUND, _EXPECTED, _RULER = (0, 0, 255), (255, 160, 0), (255, 255, 255)
#: Distance between the ruler's ticks, and between ticks with a number, px.
_TICK, _NUMBER = 100, 500


@dataclass(frozen=True)
class Sheets:
    """Files that were written (pictures and table), and number of outlines in each picture."""

    pictures: tuple[Path, ...]
    table: Path
    outlines: tuple[int, ...]


def write_sheets(flights: "Sequence[FlightData]", names: Sequence[str], out: Path) -> Sheets:
    """Write a picture of each chosen photograph, and the table to be filled in.

    Parameters
    ----------
    flights
        Flights whose photographs have been read.
    names
        Names of photographs, NAME or FLIGHT/NAME; if empty, all photographs in which no mirror was
        identified.
    out
        Folder.

    Raises
    ------
    InputError
        If there is nothing to identify, a photograph is unknown, or the folder already contains a
        table.
    """
    table = out / "matches.csv"
    if table.exists():
        raise InputError(
            f"{table}: this file already exists and may contain names; move it, or use --out"
        )
    chosen = _chosen(flights, names)
    pictures, counts, rows = [], [], []
    for flight, photo in chosen:
        assert photo.path is not None
        picture = decode(photo.path)
        patches = _patches(picture, flight.camera, photo, flight.stand)
        label = f"{flight.name}/{photo.name}" if flight.name else photo.name
        drawn = _drawn(picture, flight.camera, photo, flight.stand, patches)
        pictures.append(_write(out / f"match-{label.replace('/', '-')}", drawn))
        counts.append(len(patches))
        for number, (x, y) in enumerate(patches.center, start=1):
            rows.append([label, number, "", MIDDLE, f"{x:.1f}", f"{y:.1f}"])
        if not len(patches):
            rows.append([label, "", "", "", "", ""])
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([COLUMNS[0], "number", *COLUMNS[1:]])
    writer.writerows(rows)
    write_text(table, text.getvalue())
    return Sheets(tuple(pictures), table, tuple(counts))


def _chosen(
    flights: "Sequence[FlightData]", names: Sequence[str]
) -> "list[tuple[FlightData, Photo]]":
    every = [
        (flight, photo, reading)
        for flight in flights
        for photo, reading in zip(flight.photos, flight.seen, strict=True)
        if photo.path is not None
    ]
    if not names:
        unnamed = [(f, p) for f, p, reading in every if reading.nameable]
        if not unnamed:
            raise InputError(
                "the mirrors in all photographs are identified or not visible, so there is "
                "nothing to name. --photo NAME writes the picture of a specific photograph"
            )
        return unnamed
    chosen = []
    for name in names:
        mine = [(f, p) for f, p, _ in every if name in (p.name, f"{f.name}/{p.name}")]
        if not mine:
            raise InputError(f"--photo: there is no photograph {name}; use the name of a file")
        chosen += mine
    return chosen


def _patches(picture: Picture, camera: LedCamera, photo: Photo, stand: MirrorPoses) -> Patches:
    """Return the largest set of patches whose number does not far exceed the number of mirrors."""
    side, near = expected_size(camera, photo, stand)
    if not near.any():
        return Patches(np.empty((0, 2)), np.empty(0))
    patches = find_patches(picture, float(np.median(side[near])) ** 2)
    few = [p for p in patches if len(p) <= 2 * int(near.sum())]
    return max(few, key=len, default=patches[0])


def _drawn(
    picture: Picture, camera: LedCamera, photo: Photo, stand: MirrorPoses, patches: Patches
) -> Picture:
    import cv2

    drawn = picture.copy()
    height, width = drawn.shape[:2]
    size = max(max(width, height) / 2500.0, 0.6)
    thick = max(1, round(1.5 * size))

    def write(text: str, x: float, y: float, colour: tuple[int, int, int]) -> None:
        place, font = (round(x), round(y)), cv2.FONT_HERSHEY_SIMPLEX
        for wide, ink in ((3 * thick, (0, 0, 0)), (thick, colour)):
            cv2.putText(drawn, text, place, font, 0.7 * size, ink, wide, cv2.LINE_AA)

    corners = photo.pixels(camera, stand.corners)
    for name, outline in zip(stand.names, corners, strict=True):
        if np.isfinite(outline).all() and (np.abs(outline) < 1e5).all():
            whole = np.round(outline).astype(np.int32)[None]
            cv2.polylines(drawn, [whole], True, _EXPECTED, thick, cv2.LINE_AA)
            write(name, outline[:, 0].min(), outline[:, 1].max() + 20 * size, _EXPECTED)
    for number, (center, area) in enumerate(zip(patches.center, patches.area, strict=True), 1):
        half = 0.5 * float(np.sqrt(area))
        low, high = ((round(c - half), round(c + half)) for c in center)
        cv2.rectangle(drawn, (low[0], high[0]), (low[1], high[1]), _FOUND, thick, cv2.LINE_AA)
        write(str(number), center[0] - 8 * size, center[1] + 8 * size, _FOUND)
    for length, across in ((width, True), (height, False)):
        for at in range(0, length, _TICK):
            long = round((24 if at % _NUMBER == 0 else 10) * size)
            end = (at, long) if across else (long, at)
            cv2.line(drawn, (at, 0) if across else (0, at), end, _RULER, thick)
            if at % _NUMBER == 0 and at:
                x, y = (at + 4, 24 * size) if across else (28 * size, at + 8)
                write(str(at), x, y, _RULER)
    return drawn


def _write(path: Path, drawn: Picture) -> Path:
    import cv2

    _, encoded = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 90])
    data = encoded.tobytes()
    file = path.with_suffix(".jpg")
    write_file(file, lambda stream: stream.write(data))
    return file
