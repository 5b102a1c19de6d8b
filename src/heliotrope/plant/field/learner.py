"""Learns heliostat groups in a process separate from the plant."""

import asyncio
import os
import subprocess
import sys
import threading

from heliotrope.calibration.learn import worker
from heliotrope.calibration.learn.group import GroupHistory, LearntGroup, gathered
from heliotrope.errors import InputError

#: Longest time that learning about one group may take, s; 60 heliostats with 120 sightings each
#: take some minutes.
LONGEST = 4 * 3600.0
_MODULE = "heliotrope.calibration.learn.worker"


class LearnerProcess:
    """Learns groups, each in a separate process that uses the processor time left by the plant.

    Parameters
    ----------
    longest
        Time after which the process is ended, s.
    """

    def __init__(self, longest: float = LONGEST) -> None:
        self._longest = longest

    async def learn(self, group: GroupHistory) -> LearntGroup:
        """Return the result of learning a group.

        Raises
        ------
        InputError
            If the group has too few data yet, or the process fails.
        """
        run = _Run(self._longest)
        try:
            return await asyncio.to_thread(run, group)
        finally:
            run.end()


class _Run:
    """One process, which can be ended from another thread even before it has begun."""

    def __init__(self, longest: float) -> None:
        self._longest, self._ended = longest, False
        self._process: subprocess.Popen[bytes] | None = None
        self._mine = threading.Lock()

    def __call__(self, group: GroupHistory) -> LearntGroup:
        data = worker.asked(gathered(group))
        with self._mine:
            if self._ended:
                raise InputError("the plant is shutting down")
            self._process = subprocess.Popen(  # noqa: S603  # a program of ours
                [sys.executable, "-m", _MODULE],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, **worker.ENVIRONMENT},
                # Ctrl-C in the plant's terminal is only for the plant.
                start_new_session=True,
            )
        with self._process as process:
            try:
                out, _ = process.communicate(data, self._longest)
            except subprocess.TimeoutExpired:
                process.kill()
                raise InputError(f"ended after {self._longest / 3600.0:g} h") from None
        if process.returncode:
            raise InputError(f"its process ended with code {process.returncode}")
        return worker.answered(out)

    def end(self) -> None:
        """End the process; do nothing if it has ended already."""
        with self._mine:
            self._ended = True
            if self._process is not None and self._process.poll() is None:
                self._process.kill()
