"""Sends the commands of queued heliostats when their turn comes."""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from heliotrope.lcu import messages
from heliotrope.plant.field.part import Part
from heliotrope.plant.motion.proofs import BeamError, PathProofs
from heliotrope.plant.orders.authority import RefusedError
from heliotrope.plant.orders.guards import Asked, Guards
from heliotrope.plant.orders.joining import JoiningJob, JoinQueue
from heliotrope.plant.orders.queue import PlantOrders
from heliotrope.plant.refusals import BEAM_REFUSED

#: Function that returns which of some heliostats may be sent a command with values, and why the
#: others may not.
Examine = Callable[
    [str, tuple[float, ...], tuple[str, ...]], tuple[tuple[str, ...], dict[str, str]]
]


class JoinDispatcher(Part):
    """Sends heliostats whose turn has come, if the paths of their beams are clear now.

    The sun has moved since the aim was accepted, and the heliostat may point anywhere. The sweep
    from its present direction to its aim is therefore checked at the moment it begins.

    Parameters
    ----------
    queue, orders, proofs
        Parts of the plant.
    life
        Life of a command whose turn has come, s.
    held
        Function that returns whether new motions are blocked.
    guards
        What blocks heliostats when their turn comes.
    examine
        Function that examines a slice of the heliostats that leave stow.
    """

    def __init__(
        self,
        queue: JoinQueue,
        orders: PlantOrders,
        proofs: PathProofs,
        life: float,
        held: Callable[[], bool],
        guards: Guards,
        examine: Examine,
    ) -> None:
        self._queue, self._orders, self._now = queue, orders, orders.clock.monotonic
        self._proofs, self._life, self._held = proofs, life, held
        self._guards, self._examine = guards, examine

    def on_beat(self, now: float) -> None:
        """Send the heliostats whose turn it is, unless new motions are blocked."""
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
        """Queue again the heliostats whose cluster refused an outdated token."""
        self._queue.put(replace(job, waiting=deque(heliostats)))

    def _clear(self, job: JoiningJob, part: tuple[str, ...]) -> tuple[str, ...]:
        """Return the heliostats whose turn has come and that may go.

        The ticket ends for heliostats that may not go.
        """
        try:
            if job.name in messages.SLICED:
                blocked = self._examine(job.name, job.values, part)[1]
            else:
                # AIM brings a new aim; every other command leads to the present aims.
                points = np.tile(job.values, (len(part), 1)) if job.name == "AIM" else None
                blocked = self._proofs.joining(job.name, job.values, part, self._now())
                blocked |= self._guards.reasons(Asked(job.name, part, points), BEAM_REFUSED)
        except BeamError as error:
            blocked = error.refusals
        except RefusedError as error:
            blocked = dict.fromkeys(part, str(error))
        job.ticket.block(blocked)
        return tuple(name for name in part if name not in blocked)
