"""Child processes that end when this process ends, for whatever reason, and give way to it."""

import contextlib
import os
import signal
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context, parent_process
from multiprocessing.connection import wait


def pool(processes: int, niceness: int | None = None) -> ProcessPoolExecutor:
    """Return a pool of freshly started processes that end when this process ends.

    The processes are not forked, because a forked child would inherit the locks of this process's
    threads. They end even if this process is killed; otherwise they would wait for ever for work.
    With a ``niceness`` they can run beside a plant. They then give way to the plant from their
    first import on, use one thread each and ignore Ctrl-C in its terminal.
    """
    return ProcessPoolExecutor(
        processes,
        mp_context=get_context("spawn"),
        initializer=_begin,
        initargs=(niceness,),
    )


def give_way(niceness: int) -> None:
    """Let this process use only the CPU time that others leave, if the system permits it."""
    # A systemd unit may deny the call; then all processes have equal priority.
    with contextlib.suppress(OSError):
        os.nice(niceness)


def end(pool: ProcessPoolExecutor) -> None:
    """End a pool at once and discard its unfinished work."""
    # From Python 3.14 on, kill_workers does this.
    running = list((pool._processes or {}).values())  # noqa: SLF001
    pool.shutdown(wait=False, cancel_futures=True)
    for process in running:
        process.kill()


def _begin(niceness: int | None) -> None:
    """Prepare a new process before it imports anything."""
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
