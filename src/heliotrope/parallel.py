"""Split independent rows across threads.

The numeric kernels are compiled with ``nogil`` and treat every row (heliostat, time) independently,
so contiguous blocks of rows can run on as many threads as there are cores. The result does not
depend on the number of threads, because no row reads what another row writes.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise

from heliotrope.errors import InputError

#: Below this number of rows a second thread costs more than it gains.
MINIMUM_ROWS = 256


def threads() -> int:
    """Return the number of threads: ``HELIOTROPE_THREADS`` or the number of available cores.

    Raises
    ------
    InputError
        If ``HELIOTROPE_THREADS`` is not a whole number from 1 to 1024.
    """
    text = os.environ.get("HELIOTROPE_THREADS", "")
    if text:
        if not text.isdigit() or not 1 <= int(text) <= 1024:
            raise InputError(
                f"HELIOTROPE_THREADS must be a whole number from 1 to 1024, not {text!r}; correct "
                "it or unset it"
            )
        return int(text)
    return len(os.sched_getaffinity(0))


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="heliotrope")


def run_blocks(
    kernel: Callable[[int, int], None], rows: int, minimum_rows: int = MINIMUM_ROWS
) -> None:
    """Call ``kernel(start, stop)`` for blocks that together cover ``range(rows)``.

    Parameters
    ----------
    kernel
        Function that writes rows ``start`` to ``stop`` of its outputs and nothing else.
    rows
        Number of rows.
    minimum_rows
        With fewer rows than this, the kernel runs on the calling thread.
    """
    workers = threads()
    if workers == 1 or rows < minimum_rows:
        kernel(0, rows)
        return
    # Four blocks per thread balance the load when rows differ in cost.
    blocks = min(4 * workers, rows)
    edges = [rows * k // blocks for k in range(blocks + 1)]
    pool = _pool(workers)
    pending = [pool.submit(kernel, a, b) for a, b in pairwise(edges)]
    for future in pending:
        future.result()
