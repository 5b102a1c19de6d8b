"""Limits on repeated log lines, so that requests from strangers cannot fill the log."""

import logging
import time
from collections.abc import Callable

#: Loggers whose lines can be caused by strangers.
NOISY = ("asyncio", "heliotrope.console", "uvicorn.error", "websockets.server")
#: Number of lines of one kind within a span, s, and number of kinds that are remembered.
MOST, SPAN, KINDS = 5, 60.0, 500


class Repeated(logging.Filter):
    """Passes a few lines of each kind within a time span, then one line with the suppressed count.

    Parameters
    ----------
    monotonic
        Function that returns the time, s.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = monotonic
        self._counts: dict[tuple[str, int], tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a line is to be written."""
        kind = (record.name, record.lineno)  # never the text, which a stranger may choose
        now = self._now()
        begun, count = self._counts.get(kind, (now, 0))
        if now - begun >= SPAN:
            if count > MOST:
                record.msg = f"{record.msg} ({count - MOST} more like this were left out)"
            begun, count = now, 0
        if len(self._counts) >= KINDS and kind not in self._counts:
            del self._counts[next(iter(self._counts))]
        self._counts[kind] = (begun, count + 1)
        return count < MOST


def limit() -> None:
    """Limit repeated lines of the noisy loggers, once per process."""
    for name in NOISY:
        logger = logging.getLogger(name)
        if not any(isinstance(entry, Repeated) for entry in logger.filters):
            logger.addFilter(Repeated())
