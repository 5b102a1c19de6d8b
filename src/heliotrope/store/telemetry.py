"""Telemetry: the history of every heliostat, day by day, in Parquet.

The archive has one folder per day (UTC) with its segments: ``0001.parquet``, ``0002.parquet``, …
and, while it is being written, ``0003.part``, a stream of Arrow batches. A part is readable up to
its last complete batch whatever happened to its writer. When it is long enough, when its day has
ended, and at the next start, it is converted to a Parquet file: written under a temporary name,
synced and renamed. A row is written when it differs from the last row of its heliostat, and every
keyframe contains all rows. The state of the field at any time therefore follows from the rows of
the preceding keyframe interval.

Columns: ``time``, ``heliostat``, ``state``, ``fault``, ``flags``, ``primary`` and ``secondary``
(counts), ``age`` (s, of the values at that time). `telemetry_query` runs SQL queries.
"""

import os
import queue
import shutil
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import BinaryIO

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet as pq

from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray
from heliotrope.store.database import PRIVATE, make_private
from heliotrope.store.records import StoreError

#: State of a heliostat whose values are stale.
STALE = 255
#: Number of jobs that may wait for the disk.
_WAITING = 64
SCHEMA = pa.schema(
    [
        ("time", pa.timestamp("ms", "UTC")),
        ("heliostat", pa.dictionary(pa.int32(), pa.string())),
        ("state", pa.dictionary(pa.int16(), pa.string())),
        ("fault", pa.uint8()),
        ("flags", pa.uint16()),
        ("primary", pa.int32()),
        ("secondary", pa.int32()),
        ("age", pa.float32()),
    ]
)


@dataclass(frozen=True)
class TelemetrySettings:
    """Settings of the archive.

    Attributes
    ----------
    period
        Interval between two snapshots of the field, s.
    keyframe
        Interval between two snapshots that are written completely, s.
    deadband
        Largest motion of a drive that is not written, steps.
    days
        Number of days kept in addition to the current day.
    rows
        Number of rows in a segment.
    """

    period: float = 60.0
    keyframe: float = 3600.0
    deadband: int = 0
    days: int = 90
    rows: int = 1_000_000

    def __post_init__(self) -> None:
        if not 0.0 < self.period <= self.keyframe:
            raise InputError(
                f"telemetry: the period ({self.period} s) must be above 0 and at most the keyframe "
                f"interval ({self.keyframe} s)"
            )
        if self.deadband < 0 or self.days < 0 or self.rows < 1:
            raise InputError(
                "telemetry: deadband and days must be 0 or more and rows 1 or more, not "
                f"{self.deadband}, {self.days} and {self.rows}"
            )


@dataclass(frozen=True)
class Look:
    """The field at one instant: N rows.

    Attributes
    ----------
    state
        Codes, (N,); `STALE` if the values are stale.
    fault, flags
        Codes, (N,).
    counts
        Step counts of both drives, (N, 2).
    age
        Age of these values, s, (N,).
    """

    state: npt.NDArray[np.uint8]
    fault: npt.NDArray[np.uint8]
    flags: npt.NDArray[np.uint16]
    counts: npt.NDArray[np.int32]
    age: FloatArray


class Telemetry:
    """Writes the archive; the caller never waits for the disk.

    Parameters
    ----------
    folder
        Folder of the archive, created if missing.
    names
        Names of the N heliostats.
    states
        Names of the states, by code.
    settings
        See `TelemetrySettings`.
    inline
        Whether to write in the caller's thread, for virtual time, in which no thread can be
        awaited.

    Raises
    ------
    StoreError
        If the folder cannot be created.
    """

    def __init__(
        self,
        folder: str | Path,
        names: Sequence[str],
        states: Sequence[str],
        settings: TelemetrySettings | None = None,
        *,
        inline: bool = False,
    ) -> None:
        self.folder = Path(folder)
        self.settings = settings or TelemetrySettings()
        self._names = pa.array(names, pa.string())
        words = [*states, *([""] * (STALE - len(states))), "STALE"]
        self._states = pa.array(words, pa.string())
        self._last: Look | None = None
        self._looked_at = self._keyed_at = -np.inf
        #: Why the archive cannot be written now, empty if it can.
        self.problem = ""
        self._lost = False
        self._segment: _Segment | None = None
        try:
            make_private(self.folder)
        except OSError as error:
            raise StoreError(f"telemetry {self.folder}: {error.strerror}") from None
        self._queue: queue.Queue[Callable[[], None] | None] = queue.Queue(_WAITING)
        self._thread: threading.Thread | None = None
        if not inline:
            self._thread = threading.Thread(target=self._run, name="telemetry", daemon=True)
            self._thread.start()
        self._later(lambda: finish_parts(self.folder))

    def take(self, at: float, look: Look) -> int:
        """Take a snapshot of the field, if one is due; return the number of rows written.

        Parameters
        ----------
        at
            POSIX s.
        look
            N rows, which must not be changed afterwards.
        """
        elapsed = at - self._looked_at
        if 0.0 <= elapsed < self.settings.period:
            return 0
        last = self._last
        key = last is None or self._lost or not 0.0 <= at - self._keyed_at < self.settings.keyframe
        if last is None or key:
            rows = np.arange(len(look.state))
            self._keyed_at, self._lost = at, False
        else:
            rows = np.flatnonzero(changed(last, look, self.settings.deadband))
        self._last = look if last is None or key else _merged(last, look, rows)
        self._looked_at = at
        if len(rows):
            self._later(lambda: self._write(at, look, rows))
        return len(rows)

    def close(self, timeout: float = 10.0) -> None:
        """Write the waiting rows, and close; the next start finishes the open part."""
        if self._thread is not None:
            self._queue.put(None)
            self._thread.join(timeout)
        self._drop_segment()

    def _later(self, work: Callable[[], None]) -> None:
        if self._thread is None:
            self._try(work)
            return
        try:
            self._queue.put_nowait(work)
        except queue.Full:
            self._lost = True
            self.problem = self.problem or f"telemetry {self.folder}: its disk is too slow"

    def _run(self) -> None:
        while (work := self._queue.get()) is not None:
            self._try(work)

    def _try(self, work: Callable[[], None]) -> None:
        try:
            work()
            self.problem = ""
        except (OSError, pa.ArrowException) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self.problem = f"telemetry {self.folder}: cannot be written ({why}); check the disk"
            # Nothing after a torn batch can be read, so rows are missing from here on.
            self._lost = True
            self._drop_segment()

    def _drop_segment(self) -> None:
        segment, self._segment = self._segment, None
        if segment is not None:
            segment.close()

    def _write(self, at: float, look: Look, rows: npt.NDArray[np.intp]) -> None:
        day = datetime.fromtimestamp(at, UTC).date()
        segment = self._segment
        if segment is not None and (segment.day != day or segment.rows >= self.settings.rows):
            self._drop_segment()
            finish_parts(self.folder)
            if segment.day != day:
                retain(self.folder, self.settings.days, day)
            segment = None
        if segment is None:
            segment = self._segment = _Segment(self.folder, day)
        segment.write(self._batch(at, look, rows))

    def _batch(self, at: float, look: Look, rows: npt.NDArray[np.intp]) -> pa.RecordBatch:
        columns = [
            pa.array(np.full(len(rows), round(1e3 * at)), SCHEMA.field("time").type),
            pa.DictionaryArray.from_arrays(pa.array(rows, pa.int32()), self._names),
            pa.DictionaryArray.from_arrays(pa.array(look.state[rows], pa.int16()), self._states),
            pa.array(look.fault[rows], pa.uint8()), pa.array(look.flags[rows], pa.uint16()),
            pa.array(look.counts[rows, 0], pa.int32()), pa.array(look.counts[rows, 1], pa.int32()),
            # More digits of an age are noise and take up space.
            pa.array(np.round(look.age[rows], 1), pa.float32()),
        ]  # fmt: skip
        return pa.RecordBatch.from_arrays(columns, schema=SCHEMA)


class _Segment:
    """A part that is being written."""

    def __init__(self, folder: Path, day: date) -> None:
        self.day, self.rows = day, 0
        place = folder / day.isoformat()
        make_private(place)
        number = 1 + max((int(p.stem) for p in place.iterdir() if p.stem.isdigit()), default=0)
        self._file = _new_file(place / f"{number:04d}.part", os.O_EXCL)
        options = pa.ipc.IpcWriteOptions(compression="zstd")
        self._stream = pa.ipc.new_stream(self._file, SCHEMA, options=options)

    def write(self, batch: pa.RecordBatch) -> None:
        """Write a batch; it is on disk when this returns."""
        self._stream.write_batch(batch)
        self._file.flush()
        os.fsync(self._file.fileno())
        self.rows += batch.num_rows

    def close(self) -> None:
        """Close the file, and leave the part as it is."""
        try:
            self._file.close()
        except OSError:
            return  # the failed write has been reported already


def changed(last: Look, look: Look, deadband: int) -> npt.NDArray[np.bool_]:
    """Return a mask of the changed rows, (N,).

    A row has changed if its state, fault or flags differ, or its counts differ by more than a
    deadband.

    A row that was stale and still is stale does not count as changed, because nothing is known
    about it.
    """
    moved = np.abs(look.counts.astype(np.int64) - last.counts).max(axis=-1) > deadband
    other = (look.fault != last.fault) | (look.flags != last.flags) | moved
    known = (look.state != STALE) | (last.state != STALE)
    return np.asarray(known & (other | (look.state != last.state)))


def _merged(last: Look, look: Look, rows: npt.NDArray[np.intp]) -> Look:
    """Return the values last written for each heliostat."""
    arrays = []
    for name in ("state", "fault", "flags", "counts", "age"):
        array = getattr(last, name).copy()
        array[rows] = getattr(look, name)[rows]
        arrays.append(array)
    return Look(*arrays)


def read_part(path: Path) -> list[pa.RecordBatch]:
    """Return the complete batches of a part, up to the point where it is torn."""
    batches = []
    with path.open("rb") as file:
        try:
            stream = pa.ipc.open_stream(file)
            while True:
                batches.append(stream.read_next_batch())
        except (StopIteration, pa.ArrowException, OSError):
            return batches


def finish_parts(folder: Path) -> None:
    """Convert all parts of an archive to Parquet; no part may be open."""
    for part in sorted(folder.glob("????-??-??/*.part")):
        final = part.with_suffix(".parquet")
        # A crash between the two steps below leaves both files; the Parquet file is then complete.
        if not final.exists():
            table = pa.Table.from_batches(read_part(part), SCHEMA)
            if table.num_rows:
                _write_parquet(table, final)
        part.unlink()


def _write_parquet(table: pa.Table, final: Path) -> None:
    table = table.unify_dictionaries()
    # If rows are sorted by heliostat, counts differ little from row to row.
    heliostat = table["heliostat"].combine_chunks().indices.to_numpy()
    order = np.lexsort((table["time"].to_numpy(), heliostat))
    beside = final.with_suffix(".tmp")
    differences = dict.fromkeys(("time", "primary", "secondary"), "DELTA_BINARY_PACKED")
    try:
        with _new_file(beside, os.O_TRUNC) as file:
            pq.write_table(
                table.take(order),
                file,
                compression="zstd",
                use_dictionary=["heliostat", "state", "age"],
                column_encoding=differences,
            )
            file.flush()
            os.fsync(file.fileno())
        beside.replace(final)
    finally:
        beside.unlink(missing_ok=True)
    place = os.open(final.parent, os.O_RDONLY)
    try:
        os.fsync(place)
    finally:
        os.close(place)


def _new_file(path: Path, how: int) -> BinaryIO:
    """Open a file for writing, which only this user may read, and return it."""
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | how, PRIVATE), "wb")


def retain(folder: Path, days: int, today: date) -> list[str]:
    """Remove the days of an archive beyond a given number of days; return the removed days."""
    removed = []
    for place in sorted(folder.glob("????-??-??")):
        try:
            day = date.fromisoformat(place.name)
        except ValueError:
            continue
        if today - day > timedelta(days=days):
            shutil.rmtree(place)
            removed.append(place.name)
    return removed
