"""Calibration photographs, stored with their results and found by heliostat and time.

The pictures are JPEG files in a folder, with one record each in `pictures.sqlite` beside them. Old
pictures are thinned out, and the folder never exceeds its limit by more than one visit; the oldest
pictures are removed first. A disk failure costs pictures, never a calibration. The photographs of a
coded visit are stored once, and found under each of its heliostats.
"""

import asyncio
import contextlib
import sqlite3
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np

from heliotrope.errors import HeliotropeError, InputError, UnknownNameError
from heliotrope.field.target import Target
from heliotrope.files.disk import AtOnce, Disk, DiskBusyError
from heliotrope.imaging.targets.view import FaceView
from heliotrope.plant.operations.views import CalibrationEntry, CameraView, PictureRow
from heliotrope.plant.visits.photographs import Shot
from heliotrope.plant.visits.target_light import Exposed, LightCamera, TargetLight

#: Maximum number of photographs kept of one visit; of a long search, the last photographs are kept.
_MOST = 24
#: The same for a coded visit; of a long series, or of several series, the last photographs are
#: kept.
_MOST_CODED = 32
#: Interval between checks for pictures that are too old, s.
_THIN_EVERY = 600.0
_DAY = 86_400.0
T = TypeVar("T")
#: A heliostat of a coded visit, whether its beam was identified, its outcome, and a text for users.
_Member = tuple[str, bool, str, str]
_TABLE = """
CREATE TABLE IF NOT EXISTS picture (
    identity INTEGER PRIMARY KEY AUTOINCREMENT, heliostat TEXT NOT NULL, target TEXT NOT NULL,
    at REAL NOT NULL, used INTEGER NOT NULL, reading TEXT NOT NULL, outcome TEXT NOT NULL,
    text TEXT NOT NULL, size INTEGER NOT NULL);
CREATE INDEX IF NOT EXISTS picture_of ON picture (heliostat, at);
CREATE INDEX IF NOT EXISTS picture_at ON picture (at);
CREATE TABLE IF NOT EXISTS party (
    identity INTEGER NOT NULL, heliostat TEXT NOT NULL, used INTEGER NOT NULL,
    outcome TEXT NOT NULL, text TEXT NOT NULL, PRIMARY KEY (identity, heliostat));
CREATE INDEX IF NOT EXISTS party_of ON party (heliostat);
"""
#: Pictures of each heliostat and day, except the first used one, or the first if none was used.
_SPARE = """
SELECT identity FROM (
    SELECT identity, ROW_NUMBER() OVER (
        PARTITION BY heliostat, CAST(at / 86400 AS INTEGER) ORDER BY used DESC, at) AS place
    FROM picture WHERE at < ?) WHERE place > 1
"""
#: Pictures of a heliostat's own visits and of coded visits.
_FOUND = """
SELECT identity, heliostat, target, at, used, reading, outcome, text FROM picture
WHERE heliostat = :name
UNION ALL
SELECT identity, party.heliostat, target, at, party.used, reading, party.outcome, party.text
FROM party JOIN picture USING (identity) WHERE party.heliostat = :name
ORDER BY at DESC LIMIT :most
"""


@dataclass(frozen=True)
class PictureSettings:
    """How long pictures are kept.

    Attributes
    ----------
    whole
        Age up to which every picture is kept, days; after that, one per day for each heliostat and
        for the joint visits to each target.
    last
        Age at which the remaining pictures are removed, days.
    most
        Maximum size of all pictures, bytes.

    Raises
    ------
    InputError
        If an age or the size is not above 0, or ``whole`` is above ``last``.
    """

    whole: float = 30.0
    last: float = 400.0
    most: float = 4e9

    def __post_init__(self) -> None:
        if not (0.0 < self.whole <= self.last and self.most > 0.0):
            raise InputError(
                f"pictures: all are kept for {self.whole:g} days, some for {self.last:g} days, in "
                f"{self.most / 1e9:g} GB; the days must be above 0, no more for all than for some, "
                f"and the size must be above 0"
            )


@dataclass(frozen=True)
class _Taken:
    view: CameraView
    shot: Shot


class Pictures:
    """The pictures of a plant's calibrations.

    Parameters
    ----------
    folder
        Folder of the pictures; created if it does not exist.
    settings
        See `PictureSettings`.
    disk
        Runs all work that accesses the folder; None: the caller's thread does.

    Attributes
    ----------
    problem
        Why the last picture could not be stored; empty if it was stored.
    """

    def __init__(
        self, folder: Path, settings: PictureSettings | None = None, disk: Disk | None = None
    ) -> None:
        self._folder, self._settings = folder, settings or PictureSettings()
        self._disk = disk or AtOnce()
        self._taken: dict[str, list[_Taken]] = {}
        self._coded: dict[str, deque[CameraView]] = {}
        self._thinned = float("-inf")
        self.problem = ""

    def close(self) -> None:
        """Write the pending pictures, and end."""
        self._disk.close()

    # -- a visit ---------------------------------------------------------------------------

    def begin(self, heliostat: str) -> None:
        """Begin a visit; photographs of an earlier visit without a result are discarded."""
        self._taken.pop(heliostat, None)

    def take(self, heliostat: str, view: CameraView, shot: Shot) -> None:
        """Accept a photograph of a visit."""
        taken = self._taken.setdefault(heliostat, [])
        taken.append(_Taken(view, shot))
        del taken[:-_MOST]

    def conclude(self, entry: CalibrationEntry) -> None:
        """Store the photographs of a visit with its result."""
        taken = self._taken.pop(entry.heliostat, [])
        if taken:
            self._put(taken, entry.heliostat, entry.outcome.name.lower(), entry.text, entry.at)

    def begin_coded(self, target: str) -> None:
        """Begin a coded visit to a surface."""
        self._coded.pop(target, None)

    def take_coded(self, view: CameraView) -> None:
        """Accept a photograph of a coded visit."""
        self._coded.setdefault(view.target, deque(maxlen=_MOST_CODED)).append(view)

    def conclude_coded(self, target: str, entries: Sequence[CalibrationEntry]) -> None:
        """Store the photographs of a coded visit once, with the result of each heliostat."""
        views = self._coded.pop(target, None)
        if not views or not entries:
            return
        proven = sum(entry.new > 0 for entry in entries)
        text = f"the beams of {proven} of {len(entries)} heliostats were identified together"
        members = [
            (entry.heliostat, entry.new > 0, entry.outcome.name.lower(), entry.text)
            for entry in entries
        ]
        reasons = () if proven else (text,)
        taken = [_Taken(view, Shot(np.full(3, np.nan), view.at, 0.0, reasons)) for view in views]
        self._put(taken, f"together on {target}", "joint visit", text, entries[-1].at, members)

    def keep(self, view: CameraView, shot: Shot, who: str) -> None:
        """Store a photograph that a user requested, without assigning it to a heliostat."""
        self._put([_Taken(view, shot)], "", "asked for", f"requested by {who}", view.at)

    def _put(
        self,
        taken: list[_Taken],
        heliostat: str,
        outcome: str,
        text: str,
        now: float,
        members: Sequence[_Member] = (),
    ) -> None:
        def done(error: Exception | None) -> None:
            self.problem = "" if error is None else str(error)

        try:
            self._disk.do(lambda: self._write(taken, heliostat, outcome, text, now, members), done)
        except DiskBusyError as error:
            done(error)

    def _write(
        self,
        taken: list[_Taken],
        heliostat: str,
        outcome: str,
        text: str,
        now: float,
        members: Sequence[_Member],
    ) -> None:
        with self._table() as table:
            for one in taken:
                row = table.execute(
                    "INSERT INTO picture (heliostat, target, at, used, reading, outcome, text, "
                    "size) VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                    (
                        heliostat,
                        one.view.target,
                        one.view.at,
                        not one.shot.reasons,
                        "\n".join(one.view.reading),
                        outcome,
                        text,
                        len(one.view.jpeg),
                    ),
                )
                identity = int(row.lastrowid or 0)
                table.executemany(
                    "INSERT INTO party VALUES (?, ?, ?, ?, ?)",
                    [(identity, *member) for member in members],
                )
                self._path(identity).write_bytes(one.view.jpeg)
            self._thin(table, now)

    def _thin(self, table: sqlite3.Connection, now: float) -> None:
        settings = self._settings
        gone: list[int] = []
        if now - self._thinned >= _THIN_EVERY:
            self._thinned = now
            old = "SELECT identity FROM picture WHERE at < ?"
            gone += [row[0] for row in table.execute(old, (now - _DAY * settings.last,))]
            gone += [row[0] for row in table.execute(_SPARE, (now - _DAY * settings.whole,))]
        self._remove(table, gone)
        (size,) = table.execute("SELECT COALESCE(SUM(size), 0) FROM picture").fetchone()
        gone = []
        for identity, own in table.execute("SELECT identity, size FROM picture ORDER BY at"):
            if size <= settings.most:
                break
            size -= own
            gone.append(identity)
        self._remove(table, gone)

    def _remove(self, table: sqlite3.Connection, gone: list[int]) -> None:
        for identity in gone:
            self._path(identity).unlink(missing_ok=True)
            table.execute("DELETE FROM picture WHERE identity = ?", (identity,))
            table.execute("DELETE FROM party WHERE identity = ?", (identity,))

    # -- finding ---------------------------------------------------------------------------

    def find(
        self, heliostat: str, limit: int, then: Callable[[list[PictureRow] | Exception], None]
    ) -> None:
        """Call ``then`` with the newest pictures of a heliostat ("": pictures users requested)."""

        def work() -> list[PictureRow]:
            with self._table() as table:
                rows = table.execute(_FOUND, {"name": heliostat, "most": limit}).fetchall()
            return [
                PictureRow(i, name, target, at, bool(used), tuple(said.splitlines()), outcome, text)
                for i, name, target, at, used, said, outcome, text in rows
            ]

        self._ask(work, then)

    def read(self, identity: int, then: Callable[[bytes | Exception], None]) -> None:
        """Call ``then`` with a picture as JPEG."""

        def work() -> bytes:
            try:
                return self._path(identity).read_bytes()
            except FileNotFoundError:
                raise UnknownNameError("kept photograph", str(identity), ()) from None

        self._ask(work, then)

    def _ask(self, work: Callable[[], T], then: Callable[[T | Exception], None]) -> None:
        found: list[T] = []

        def told(error: Exception | None) -> None:
            then(found[0] if error is None else error)

        try:
            self._disk.do(lambda: found.append(work()), told)
        except DiskBusyError as error:
            then(error)

    def _path(self, identity: int) -> Path:
        return self._folder / f"{identity:08d}.jpg"

    @contextlib.contextmanager
    def _table(self) -> Iterator[sqlite3.Connection]:
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with contextlib.closing(sqlite3.connect(self._folder / "pictures.sqlite")) as table:
                table.executescript(_TABLE)
                with table:
                    yield table
        except (OSError, sqlite3.Error) as error:
            raise PicturesError(f"pictures: {self._folder}: {error}") from None


class PicturesError(HeliotropeError):
    """The folder of the pictures cannot be read or written."""


class KeptCamera:
    """A camera of targets whose photographs are stored.

    Parameters
    ----------
    camera
        Camera that returns the last photograph of each target by ``view``.
    pictures
        Store of the photographs.
    """

    def __init__(self, camera: "ViewedCamera", pictures: Pictures) -> None:
        self._camera, self._pictures = camera, pictures
        #: Version of the last stored photograph of a joint visit, by target.
        self._kept = dict[str, int]()

    async def photograph(self, target: Target, heliostat: str) -> Shot:
        """Return a heliostat's beam in a new photograph."""
        before = self._camera.view(target.name).version
        shot = await self._camera.photograph(target, heliostat)
        view = self._camera.view(target.name)
        if view.version != before:
            self._pictures.take(heliostat, view, shot)
        return shot

    async def expose(self, target: Target, view: FaceView | None = None) -> Exposed:
        """Take a photograph of a joint visit, and store it once it is evaluated."""
        before = self._camera.view(target.name).version
        exposed = await self._camera.expose(target, view)

        async def kept() -> TargetLight:
            seen = await exposed.light
            taken = self._camera.view(target.name)
            if taken.version not in (before, self._kept.get(target.name)):
                self._kept[target.name] = taken.version
                self._pictures.take_coded(taken)
            return seen

        return Exposed(exposed.at, asyncio.create_task(kept()))


class ViewedCamera(LightCamera, Protocol):
    """A camera of targets that shows the last photograph of each."""

    def view(self, target: str) -> CameraView:
        """Return the last photograph of a target, for display."""
        ...
