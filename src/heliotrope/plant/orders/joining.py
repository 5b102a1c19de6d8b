"""The queue of heliostats that join the receiver, at a bounded rate and after a bounded wait.

An APPROACH of many waits in it too: the proof of 10,000 ways from stow takes 0.6 s, in which no
lease could be renewed. So they go in slices, one a beat.
"""

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from heliotrope.lcu import messages
from heliotrope.links.messages import Stage
from heliotrope.plant.field.part import Part
from heliotrope.plant.motion.beam_watch import BeamError, BeamWatch
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.orders.tickets import Ticket
from heliotrope.safety import JoinLimiter

#: Heliostats of a slice: their proof takes 30 ms.
SLICE = 500
#: Returns which of some heliostats may be sent a command with values, and why the others may not.
Examine = Callable[
    [str, tuple[float, ...], tuple[str, ...]], tuple[tuple[str, ...], dict[str, str]]
]

#: Returns which of some heliostats may go now; the ticket ends for the others.
Clear = Callable[[tuple[str, ...]], tuple[str, ...]]
#: Assigns the points of some heliostats, as far as they may still go, then sends these.
Assign = Callable[[tuple[str, ...], Clear, Callable[[tuple[str, ...]], None]], None]
#: Returns which of some heliostats may no longer be commanded under a token.
Lost = Callable[[int, Iterable[str]], frozenset[str]]


def in_slices(name: str, heliostats: Sequence[str]) -> bool:
    """Whether a command to some heliostats is examined and sent in slices."""
    return name in messages.SLICED and len(heliostats) > SLICE


@dataclass
class JoiningJob:
    """A command whose heliostats go one after the other, and those of them that still wait.

    Attributes
    ----------
    ticket, name, values, token
        Of the command; the token is the holder's or a mandate's.
    waiting
        Heliostats still to be sent.
    until
        Time at which they are given up, monotonic s.
    assign
        Assigns the point of heliostats whose turn has come, and sends them; None: the command
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
    """The waiting heliostats: first come, first served, as fast as a `JoinLimiter` admits.

    Of those that leave stow, a slice goes at each look.

    Parameters
    ----------
    rate, burst
        Heliostats that may join in a second, and at once after a rest.
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
        """Return how many wait to join the receiver."""
        return sum(len(job.waiting) for job in self._jobs if job.name not in messages.SLICED)

    def waiting(self, name: str) -> frozenset[str]:
        """Return the heliostats that wait with a command."""
        return frozenset(n for job in self._jobs if job.name == name for n in job.waiting)

    def put(self, job: JoiningJob) -> None:
        """Add a job at the end."""
        self._jobs.append(job)

    def admit(
        self, now: float, lost: Lost, *, held: bool = False
    ) -> list[tuple[JoiningJob, tuple[str, ...]]]:
        """Return the heliostats that may go now, none while ``held``; drop jobs that are over.

        ``lost`` returns those that may no longer be commanded under the token of their job.
        """
        for job in self._jobs:
            if gone := lost(job.token, job.waiting):
                self._fail(job, "the command authority changed while it waited its turn", gone)
            if now >= job.until:
                self._fail(job, "it waited too long for its turn; command it again")
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
        """Give up waiting heliostats: all, some, or those of one command; ``text`` says why."""
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


class JoinDispatcher(Part):
    """The sending of heliostats whose turn has come, if the way of their beams is clear now.

    The sun has moved since the aim was accepted, and the heliostat may point anywhere. So the sweep
    from its present direction to its aim is proven at the moment it begins.

    Parameters
    ----------
    queue, orders, beams
        Of the plant.
    life
        Life of a command whose turn has come, s.
    held
        Returns whether no new motion may begin.
    blocked
        Returns the heliostats that guards stop when their turn comes, and the reasons.
    examine
        Examines a slice of those that leave stow.
    """

    def __init__(
        self,
        queue: JoinQueue,
        orders: PlantOrders,
        beams: BeamWatch,
        life: float,
        held: Callable[[], bool],
        blocked: Callable[[str, tuple[float, ...], tuple[str, ...]], dict[str, str]],
        examine: Examine,
    ) -> None:
        self._queue, self._orders, self._now = queue, orders, orders.clock.monotonic
        self._beams, self._life, self._held = beams, life, held
        self._blocked, self._examine = blocked, examine

    def on_beat(self, now: float) -> None:
        """Send the heliostats whose turn it is, unless no new motion may begin."""
        for job, part in self._queue.admit(now, self._orders.authority.lost, held=self._held()):
            clear = self._clear(job, part)
            if job.assign is None or not clear:
                self._send(job, clear)
            else:
                job.assign(clear, partial(self._clear, job), partial(self._send, job))

    def _send(self, job: JoiningJob, heliostats: tuple[str, ...]) -> None:
        again = partial(self._wait_again, job)
        values, token = job.values, job.token
        self._orders.command(job.ticket, job.name, values, heliostats, token, self._life, again)

    def _wait_again(self, job: JoiningJob, heliostats: tuple[str, ...]) -> None:
        """Let heliostats whose cluster refused an earlier token wait for another turn."""
        self._queue.put(replace(job, waiting=deque(heliostats)))

    def _clear(self, job: JoiningJob, part: tuple[str, ...]) -> tuple[str, ...]:
        """Return the heliostats whose turn has come and that may go; end the ticket for others."""
        wrong = self._wrong(job, part)
        job.ticket.block(wrong)
        return tuple(name for name in part if name not in wrong)

    def _wrong(self, job: JoiningJob, part: tuple[str, ...]) -> dict[str, str]:
        """Return which heliostats whose turn has come may not go, and why."""
        if job.name not in messages.SLICED:
            wrong = self._beams.joining(job.name, job.values, part, self._now())
            return wrong | self._blocked(job.name, job.values, part)
        try:
            return self._examine(job.name, job.values, part)[1]
        except BeamError as error:
            return dict(error.refusals)
        except RefusedError as error:
            return dict.fromkeys(part, str(error))
