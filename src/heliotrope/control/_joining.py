"""Mirrors that wait to join the receiver: so many a second, and none that waited in vain."""

from collections import deque
from dataclasses import dataclass

from heliotrope.control._emergency import JoinLimiter
from heliotrope.control._tickets import Ticket
from heliotrope.control.protocol import Stage


@dataclass
class Job:
    """Part of a command that brings mirrors to the receiver.

    Attributes
    ----------
    ticket, name, values, token
        Of the command.
    waiting
        Heliostats whose turn has not come.
    until
        When those are given up, monotonic s.
    """

    ticket: Ticket
    name: str
    values: tuple[float, ...]
    token: int
    waiting: deque[str]
    until: float


class JoinQueue:
    """First come, first served, as fast as a `JoinLimiter` admits."""

    def __init__(self, rate: float, burst: int) -> None:
        self._limiter = JoinLimiter(rate, burst)
        self._jobs: deque[Job] = deque()

    def __len__(self) -> int:
        return sum(len(job.waiting) for job in self._jobs)

    def put(self, job: Job) -> None:
        """Add a job at the end."""
        self._jobs.append(job)

    def admit(self, now: float, token: int) -> list[tuple[Job, tuple[str, ...]]]:
        """Return who may go now; jobs of another authority than the present one are dropped."""
        for job in self._jobs:
            if job.token != token:
                self._fail(job, "the command authority changed while it waited to join")
            elif now >= job.until:
                self._fail(job, "it waited too long to join; command it again")
        self._jobs = deque(job for job in self._jobs if job.waiting)
        self._limiter, granted = self._limiter.admit(len(self), now)
        admitted = []
        while granted > 0 and self._jobs:
            job = self._jobs[0]
            part = tuple(job.waiting.popleft() for _ in range(min(granted, len(job.waiting))))
            granted -= len(part)
            admitted.append((job, part))
            if not job.waiting:
                self._jobs.popleft()
        return admitted

    def drop(self, text: str, heliostats: frozenset[str] | None = None, name: str = "") -> None:
        """Give up all who wait, or some, or those of one command; ``text`` says why."""
        for job in self._jobs:
            if name in ("", job.name):
                self._fail(job, text, heliostats)
        self._jobs = deque(job for job in self._jobs if job.waiting)

    @staticmethod
    def _fail(job: Job, text: str, heliostats: frozenset[str] | None = None) -> None:
        gone = [name for name in job.waiting if heliostats is None or name in heliostats]
        job.ticket.advance(gone, Stage.FAILED, text)
        left = set(gone)
        job.waiting = deque(name for name in job.waiting if name not in left)
