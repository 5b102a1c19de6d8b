"""Child processes that end with this one, however it ends, and yield the CPU to it."""

import contextlib
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait


def pool(processes: int, niceness: int | None = None) -> ProcessPoolExecutor:
    """Return a pool of processes that begin anew and end with this one.

    A forked child would inherit the locks of this process's threads. When this process is killed,
    they end; else they would wait for work for ever. With a ``niceness`` they compute beside a
    plant: they leave it the machine from their first import on, have one thread each, and Ctrl-C in
    its terminal is not theirs.
    """
    return ProcessPoolExecutor(
        processes,
        mp_context=get_context("spawn"),
        initializer=_begin,
        initargs=(niceness,),
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


def _begin(niceness: int | None) -> None:
    """Prepare a process; it has loaded nothing yet."""
    if niceness is not None:
        give_way(niceness)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.environ["HELIOTROPE_THREADS"] = "1"
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
