"""The common base class of all frame sources, and a source whose frames a function creates."""

import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from itertools import islice
from typing import Self

from heliotrope.errors import InputError
from heliotrope.imaging.frame import Frame


@dataclass(kw_only=True)
class Source(ABC):
    """A context manager that yields frames one after the other while it is open.

    Attributes
    ----------
    name
        Name used in errors and frames; by default the folder, file, address or device.
    limit
        Number of frames after which the source ends; None for no limit.
    stop
        Event that ends the source when set.
    wanted
        Event that is set when a caller waits for a frame; a source that takes frames at intervals
        then takes a frame at once.
    """

    name: str = ""
    limit: int | None = None
    stop: threading.Event = field(default_factory=threading.Event, repr=False)
    wanted: threading.Event = field(default_factory=threading.Event, repr=False)

    def __enter__(self) -> Self:
        self._begin()
        return self

    def __exit__(self, *reason: object) -> None:
        self._end()

    def __iter__(self) -> Iterator[Frame]:
        if self.limit is not None and self.limit < 1:
            raise InputError(f"source {self.name}: limit must be 1 frame or more, not {self.limit}")
        return islice(self._frames(), self.limit)

    @abstractmethod
    def _frames(self) -> Iterator[Frame]:
        """Yield frames until the source is stopped."""

    def _begin(self) -> None:  # noqa: B027 - some sources have nothing to open
        """Open the source; raise an error if that fails."""

    def _end(self) -> None:  # noqa: B027
        """Close the source."""


@dataclass
class SimulatedSource(Source):
    """Frames that ``function`` creates for the current time of ``clock``."""

    function: Callable[[datetime], Frame]
    clock: Callable[[], datetime]

    def _frames(self) -> Iterator[Frame]:
        while not self.stop.is_set():
            time = self.clock()
            frame = self.function(time)
            yield frame if frame.time is not None else replace(frame, time=time, time_deviation=0.0)


def hide_password(url: str) -> str:
    """Return an address without user name and password."""
    return re.sub(r"(?<=://)[^/?#]*@", "", url)
