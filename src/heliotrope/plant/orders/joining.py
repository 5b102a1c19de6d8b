"""The queue of heliostats that join the receiver, with a limited rate and a limited wait.

An APPROACH of a large number of heliostats is queued too, because checking 10,000 paths from stow
takes 0.6 s, in which no lease could be renewed. It is therefore processed in slices, one per beat.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from heliotrope.lcu import messages
from heliotrope.links.messages import Stage
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import JoinLimiter

#: Number of heliostats in a slice; checking their paths takes 30 ms.
SLICE = 500
#: Returns which of some heliostats may go now; the ticket ends for the others.
Clear = Callable[[tuple[str, ...]], tuple[str, ...]]
#: Assigns the points of the heliostats that may still go, then sends these heliostats.
Assign = Callable[[tuple[str, ...], Clear, Callable[[tuple[str, ...]], None]], None]
#: Returns which of some heliostats may no longer be commanded under a token.
Lost = Callable[[int, Iterable[str]], frozenset[str]]


def in_slices(name: str, heliostats: Sequence[str]) -> bool:
    """Return whether a command to some heliostats is examined and sent in slices."""
    return name in messages.SLICED and len(heliostats) > SLICE


@dataclass
class JoiningJob:
    """A command whose heliostats start one after the other, and the heliostats still waiting.

    Attributes
    ----------
    ticket, name, values, token
        Parts of the command; the token belongs to the authority holder or to a mandate.
    waiting
        Heliostats still to be sent.
    until
        Time at which the command is abandoned for the waiting heliostats, monotonic s.
    assign
        Assigns the points of heliostats whose turn has come, and sends them; None: the command
        assigns none.
    """

    ticket: Ticket
    name: str
    values: tuple[float, ...]
    token: int
    waiting: deque[str]
    until: float
    assign: Assign | None = None


class JoinQueue:
    """The waiting heliostats: first come, first served, at the rate that a `JoinLimiter` admits.

    At each check, one slice of the heliostats that leave stow starts.

    Parameters
    ----------
    rate, burst
        Number of heliostats that may join per second, and number that may join at once after a
        pause.
    patience
        Longest time that a heliostat waits for its turn, s.

    Attributes
    ----------
    patience
        As given.
    """

    def __init__(self, rate: float, burst: int, patience: float) -> None:
        self._limiter, self.patience = JoinLimiter(rate, burst), patience
        self._jobs: deque[JoiningJob] = deque()

    def __len__(self) -> int:
        """Return the number of heliostats that wait to join the receiver."""
        return sum(len(job.waiting) for job in self._jobs if job.name not in messages.SLICED)

    def waiting(self, name: str) -> frozenset[str]:
        """Return the heliostats that wait for their turn with a command."""
        return frozenset(n for job in self._jobs if job.name == name for n in job.waiting)

    def put(self, job: JoiningJob) -> None:
        """Add a job at the end."""
        self._jobs.append(job)

    def admit(
        self, now: float, lost: Lost, *, held: bool = False
    ) -> list[tuple[JoiningJob, tuple[str, ...]]]:
        """Return the heliostats that may go now; drop jobs that have ended.

        While ``held``, no heliostat may go.

        ``lost`` returns the heliostats that may no longer be commanded under the token of their
        job.
        """
        for job in self._jobs:
            if gone := lost(job.token, job.waiting):
                self._fail(job, "the command authority changed while it was waiting", gone)
            if now >= job.until:
                self._fail(job, "it waited too long in the queue; repeat the command")
        self._jobs = deque(job for job in self._jobs if job.waiting)
        if held:
            return []
        self._limiter, granted = self._limiter.admit(len(self), now)
        leave, admitted = SLICE, []
        for job in self._jobs:
            most = leave if job.name in messages.SLICED else granted
            part = tuple(job.waiting.popleft() for _ in range(min(most, len(job.waiting))))
            if not part:
                continue
            admitted.append((job, part))
            if job.name in messages.SLICED:
                leave -= len(part)
            else:
                granted -= len(part)
        self._jobs = deque(job for job in self._jobs if job.waiting)
        return admitted

    def drop(self, text: str, heliostats: frozenset[str] | None = None, name: str = "") -> None:
        """Drop waiting heliostats: all, some, or all of one command; ``text`` says why."""
        for job in self._jobs:
            if name in ("", job.name):
                self._fail(job, text, heliostats)
        self._jobs = deque(job for job in self._jobs if job.waiting)

    @staticmethod
    def _fail(job: JoiningJob, text: str, heliostats: frozenset[str] | None = None) -> None:
        gone = [name for name in job.waiting if heliostats is None or name in heliostats]
        job.ticket.advance(gone, Stage.REFUSED, text)
        left = set(gone)
        job.waiting = deque(name for name in job.waiting if name not in left)
