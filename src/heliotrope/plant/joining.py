"""Mirrors that wait to join the receiver: so many a second, and none that waited in vain."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from heliotrope.geometry import FloatArray
from heliotrope.links.messages import Stage
from heliotrope.plant.aims import BeamCheck
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.orders import PlantOrders
from heliotrope.plant.tickets import Ticket
from heliotrope.safety import JoinLimiter


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


class Joiner:
    """Sends mirrors whose turn has come, if the way of their beams is clear now.

    The sun has moved since the aim was accepted, and the mirror may stand anywhere: what is
    proven here is the sweep from where it stands to its aim, at the moment it begins.

    Parameters
    ----------
    queue, orders, beams, field
        Of the plant.
    aims
        As assigned, ENU, m, (N, 3); NaN where none was.
    sun
        Gives the unit vector to the sun now, (3,).
    life
        Of a command whose turn has come, s.
    """

    def __init__(
        self,
        queue: JoinQueue,
        orders: PlantOrders,
        beams: BeamCheck,
        field: FieldState,
        aims: FloatArray,
        sun: Callable[[], FloatArray],
        life: float,
    ) -> None:
        self._queue, self._orders, self._beams, self._field = queue, orders, beams, field
        self._aims, self._sun, self._life = aims, sun, life

    def beat(self, now: float, token: int) -> None:
        """Send those whose turn it is."""
        for job, part in self._queue.admit(now, token):
            wrong = self._problems(job, part) if self._beams.volumes else {}
            job.ticket.block(wrong)
            clear = [name for name in part if name not in wrong]
            self._orders.command(job.ticket, job.name, job.values, clear, token, self._life)

    def _problems(self, job: Job, part: tuple[str, ...]) -> dict[str, str]:
        """Return whose beams may not go to their aims now, and why."""
        rows = np.array([self._field.index[name] for name in part], dtype=np.intp)
        aims = self._aims[rows]
        unknown = ~np.isfinite(aims).all(axis=-1)
        found = {
            part[i]: f"{job.name}: its aim is not known here; give it one (AIM) first"
            for i in np.flatnonzero(unknown)
        }
        if not unknown.all():
            known = rows[~unknown]
            counts, light = self._field.counts(known), self._sun()
            found |= self._beams.on_the_way(known, counts, aims[~unknown], light)
            if job.name == "SEARCH":
                found |= self._beams.around(known, aims[~unknown], job.values[1], light)
        return found
