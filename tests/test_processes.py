"""Pools of processes: none of them outlives the one that made it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

MAKES_POOL = """
import os
import time
from heliotrope.processes import pool

if __name__ == "__main__":
    with pool(2) as workers:
        print(*{workers.submit(os.getpid).result() for _ in range(8)}, flush=True)
        time.sleep(60.0)
"""


def test_a_pool_ends_with_a_process_that_is_killed(tmp_path: Path) -> None:
    program = tmp_path / "makes_pool.py"
    program.write_text(MAKES_POOL)
    with subprocess.Popen([sys.executable, program], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        workers = [int(word) for word in parent.stdout.readline().split()]
        assert workers
        assert all(_runs(each) for each in workers)
        parent.send_signal(signal.SIGKILL)
    until = time.monotonic() + 20.0
    while any(_runs(each) for each in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(_runs(each) for each in workers)


def _runs(number: int) -> bool:
    """Whether a process runs: one that has ended, and that nobody has waited for, does not."""
    try:
        os.kill(number, 0)
        return ") Z " not in Path(f"/proc/{number}/stat").read_text(encoding="utf-8")
    except (ProcessLookupError, FileNotFoundError):
        return False
