"""Sensors: external readings for the safety table and the schedule.

For example, other programs write readings to files.

A file contains one number, in the unit of the reading's table row, and is replaced with each
reading (written under a temporary name, then renamed). A file that is not replaced yields no new
reading; after some seconds the row assumes the worst case, as if the sensor had failed. See
`safety.conditions`.
"""

import asyncio
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from heliotrope.geometry import FloatArray
from heliotrope.plant.emergency import DNI_READING, OWN_READINGS
from heliotrope.safety import CONDITIONS, FLUX_READING, Watcher, watched_by

#: Readings that must come from outside.
FED = frozenset(row.reading for row in watched_by(CONDITIONS, Watcher.PLANT)) - OWN_READINGS
FED |= {FLUX_READING, DNI_READING}
#: Longest text of a number, bytes.
_LONGEST = 64


@dataclass(frozen=True)
class Readings:
    """Readings that changed since the last check.

    Attributes
    ----------
    values
        New values, by reading.
    problems
        Why a reading cannot be read, by reading; "" once it can be read again.
    made
        When a new value was measured, by reading, monotonic s; readings that are not listed were
        measured now.
    seen
        For a value measured by a camera: the flux fractions in the cells of the receiver, (H, W),
        or on the whole receiver, (); None if the value is only a lower bound.
    """

    values: dict[str, float] = field(default_factory=dict)
    problems: dict[str, str] = field(default_factory=dict)
    made: dict[str, float] = field(default_factory=dict)
    seen: dict[str, FloatArray | None] = field(default_factory=dict)


class Sensors(Protocol):
    """Sensors that supply readings of the safety table."""

    @property
    def names(self) -> frozenset[str]:
        """Readings that the sensors supply."""
        ...

    async def news(self) -> Readings:
        """Return the changes since the last call, without blocking the event loop."""
        ...


class AllSensors:
    """Several sensors as one.

    Parameters
    ----------
    parts
        Sensors that supply different readings.

    Attributes
    ----------
    names
        Readings of all sensors.
    """

    def __init__(self, parts: Sequence[Sensors]) -> None:
        self._parts = tuple(parts)
        self.names = frozenset[str]().union(*(part.names for part in parts))

    async def news(self) -> Readings:
        """Return the changes of all sensors since the last call."""
        found = Readings()
        for part in self._parts:
            news = await part.news()
            found.values.update(news.values)
            found.problems.update(news.problems)
            found.made.update(news.made)
            found.seen.update(news.seen)
        return found


class SensorFiles:
    """Sensors whose readings are in files.

    Parameters
    ----------
    files
        Files by reading of the safety table, one of `FED`.

    Attributes
    ----------
    names
        Readings.
    """

    def __init__(self, files: Mapping[str, Path]) -> None:
        self._files = dict(files)
        self.names = frozenset(files)
        self._written: dict[str, int] = {}
        self._problems: dict[str, str] = {}

    async def news(self) -> Readings:
        """Read all files in a thread; return the changes."""
        return await asyncio.to_thread(self.read)

    def read(self) -> Readings:
        """Read all files; return the changes."""
        found = Readings()
        for name, path in self._files.items():
            problem = ""
            try:
                written = path.stat().st_mtime_ns
                if written == self._written.get(name):
                    continue
                value = float(_content(path))
                if math.isfinite(value):
                    # A file present at start-up may be old.
                    if name in self._written:
                        found.values[name] = value
                    self._written[name] = written
                else:
                    problem = f"{path}: {value} is not a reading; write one finite number"
            except OSError as error:
                problem = f"{path}: cannot be read ({error.strerror})"
            except ValueError:
                problem = f"{path}: contains no number; write one, in the unit of the safety table"
            if problem != self._problems.get(name, ""):
                found.problems[name] = problem
            self._problems[name] = problem
        return found


def _content(path: Path) -> bytes:
    """Return the start of a file, without blocking on a pipe or an endless file."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        return os.read(handle, _LONGEST)
    finally:
        os.close(handle)
