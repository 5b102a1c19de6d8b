"""Disk work, done outside the event loop that renews leases and sends emergency orders.

A `Disk` executes jobs in the order of their arrival, and reports their outcome to the event loop.
`DiskThread` executes them in its own thread; `AtOnce` executes them immediately, as virtual time
requires.
"""

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable
from typing import Protocol

from heliotrope.errors import HeliotropeError

#: Largest number of pending jobs.
MOST = 1000

Work = Callable[[], object]
Then = Callable[[Exception | None], None]


class DiskBusyError(HeliotropeError):
    """Too many jobs are waiting for the disk."""


class Disk(Protocol):
    """Executor of jobs that wait for a disk."""

    def do(self, work: Work, then: Then) -> None:
        """Do work after all earlier work, then call ``then`` in the event loop.

        The argument of ``then`` is the error of the work, or None if the work succeeded.

        Raises
        ------
        DiskBusyError
            If too many jobs are already pending.
        """
        ...

    def close(self) -> None:
        """Finish the pending work, if the disk is fast enough, and stop."""
        ...


class AtOnce:
    """Executor that does work immediately, in the calling thread."""

    def do(self, work: Work, then: Then) -> None:
        """Do work now; see `Disk.do`."""
        then(_error_of(work))

    def close(self) -> None:
        """Do nothing, because no work is pending."""


class DiskThread:
    """A thread that does the work.

    Parameters
    ----------
    most
        Largest number of pending jobs.
    """

    def __init__(self, most: int = MOST) -> None:
        self._most = most
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="disk", daemon=True)
        self._thread.start()

    def do(self, work: Work, then: Then) -> None:
        """Do work in the thread; see `Disk.do`."""
        if (count := self._waiting.qsize()) >= self._most:
            raise DiskBusyError(f"{count} records are waiting to be written; check the disk")
        loop = asyncio.get_running_loop()

        def run() -> None:
            error = _error_of(work)
            with contextlib.suppress(RuntimeError):  # the event loop has ended
                loop.call_soon_threadsafe(then, error)

        self._waiting.put(run)

    def close(self, timeout: float = 10.0) -> None:
        """Finish the pending work within ``timeout`` s, and end the thread."""
        self._waiting.put(None)
        self._thread.join(timeout)

    def _run(self) -> None:
        while (run := self._waiting.get()) is not None:
            run()


def _error_of(work: Work) -> Exception | None:
    try:
        work()
    except Exception as error:  # noqa: BLE001 - it goes to the loop
        return error
    return None
