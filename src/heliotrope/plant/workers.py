"""Computations outside the plant's event loop, which renews leases and must not wait for them.

A thread would not be enough, because the threads of a process take turns, and one library call may
hold the interpreter for seconds. Computations are therefore functions of their arguments alone,
which are run in processes beside the plant; in virtual time, and if a computation is as short as a
message, they run in the event loop.
"""

import asyncio
import pickle
from collections.abc import Callable
from concurrent.futures import BrokenExecutor
from functools import partial
from typing import Protocol, TypeVar, TypeVarTuple

from heliotrope.errors import HeliotropeError, InputError
from heliotrope.processes import end, pool

T = TypeVar("T")
Given = TypeVarTuple("Given")
#: Number of processes: while one analyses beams for seconds, the other evaluates photographs.
PROCESSES = 2
#: Niceness of the processes, which use the computing time that the plant leaves.
_NICE = 5


class Worker(Protocol):
    """A place where computations run."""

    async def __call__(self, work: Callable[[*Given], T], *given: *Given) -> T:
        """Return the result of a function.

        Parameters
        ----------
        work, given
            A module-level function, and its arguments, which are pickled and must contain
            everything that the function needs. The function must not change any shared state.

        Raises
        ------
        HeliotropeError
            If the function raises it, or the process has ended.
        """
        ...


async def at_once(work: Callable[[*Given], T], *given: *Given) -> T:
    """Return the result of a function, computed in the event loop itself; see `Worker`."""
    return work(*given)


class WorkerProcesses:
    """Processes that compute for a plant; if a process dies, new processes are started.

    Parameters
    ----------
    count
        Number of processes.
    """

    def __init__(self, count: int = PROCESSES) -> None:
        self._count = count
        self._pool = pool(count, _NICE)

    def start(self, *loads: Callable[[], None]) -> None:
        """Start the processes, which share compiled code: each function is compiled once."""
        for load in loads:
            self._pool.submit(load)

    async def __call__(self, work: Callable[[*Given], T], *given: *Given) -> T:
        """Return the result of a function; see `Worker`."""
        used = self._pool
        try:
            return await asyncio.get_running_loop().run_in_executor(
                used, partial(_computed, work, *given)
            )
        except BrokenExecutor:
            if self._pool is used:
                end(used)
                self._pool = pool(self._count, _NICE)
            raise InputError(
                "the plant's computing process has ended; the next computation starts a new "
                "one; if it ends again, check whether the computer runs out of memory"
            ) from None

    def close(self) -> None:
        """End the processes at once; their results are lost."""
        end(self._pool)


def _computed(work: Callable[[*Given], T], *given: *Given) -> T:
    """Return the result of a function, with errors in a form that another process can receive."""
    try:
        return work(*given)
    except HeliotropeError as error:
        try:
            pickle.loads(pickle.dumps(error))  # noqa: S301 - our own
        except TypeError:
            # The arguments of some errors differ from their text.
            raise InputError(str(error)) from None
        raise
