"""Processes beside this one that end with it, however it ends, and leave it the machine."""

import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait


def pool(processes: int, begin: Callable[[], None] | None = None) -> ProcessPoolExecutor:
    """Return a pool of processes, each of which calls ``begin`` first.

    They begin anew: a forked child would inherit the locks of this process's threads. When this
    process is killed, they end; else they would wait for work for ever.
    """
    return ProcessPoolExecutor(
        processes,
        mp_context=get_context("spawn"),
        initializer=_end_with_parent,
        initargs=(begin,),
    )


def give_way(niceness: int) -> None:
    """Let this process take what others leave of the machine, where the system allows that."""
    # A unit of systemd may deny the call: then all are equal.
    with contextlib.suppress(OSError):
        os.nice(niceness)


def end(pool: ProcessPoolExecutor) -> None:
    """End a pool at once; what its processes compute is lost."""
    # Python 3.14 has kill_workers for this.
    running = list((pool._processes or {}).values())  # noqa: SLF001
    pool.shutdown(wait=False, cancel_futures=True)
    for process in running:
        process.kill()


def _end_with_parent(begin: Callable[[], None] | None) -> None:
    """Arrange for this process to end when its parent ends."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
    if begin is not None:
        begin()
