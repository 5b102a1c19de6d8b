"""Errands: operations that involve several commands, followed to their result.

An operator requests a calibration, takes a heliostat out of service, or gives it to automatic
control. Each of these operations also has a `Ticket`, which states what each heliostat is doing or
waiting for, and which ends with the result, or with the reason why there is none.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from heliotrope.links.clock import Clock
from heliotrope.links.messages import Stage
from heliotrope.plant.orders.tickets import Ticket


@dataclass(frozen=True)
class Step:
    """Progress of an operation for a heliostat: text and stage; a stage of None: still waiting."""

    text: str
    stage: Stage | None = None


#: Function that returns the progress of an operation for some heliostats, by name.
Progress = Callable[[Sequence[str]], Mapping[str, Step]]


@dataclass(frozen=True)
class _Errand:
    """An operation in progress: its ticket, its time limit, and a function to call on giving up."""

    ticket: Ticket
    progress: Progress
    until: float
    dropped: Callable[[Sequence[str], str], None] | None


class Errands:
    """The operations in progress.

    Parameters
    ----------
    clock
        Clock of the plant.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock, self._numbers = clock, count(1)
        self._open: list[_Errand] = []

    def begin(
        self,
        name: str,
        heliostats: Sequence[str],
        progress: Progress,
        patience: float,
        dropped: Callable[[Sequence[str], str], None] | None = None,
    ) -> Ticket:
        """Return the ticket of a new operation.

        Parameters
        ----------
        name, heliostats
            The operation, and its heliostats.
        progress
            See `Progress`.
        patience
            Time limit, s; a heliostat that is not done by then has failed.
        dropped
            Called with the heliostats for which the operation is given up, and why.
        """
        ticket = Ticket(f"{name.lower()}-{next(self._numbers)}", name, heliostats, self._clock, 0.0)
        made = _Errand(ticket, progress, self._clock.monotonic() + patience, dropped)
        self._open.append(made)
        self._look_at(made)
        return ticket

    def look(self) -> None:
        """Note the progress of all operations."""
        for errand in self._open:
            self._look_at(errand)
        self._open = [errand for errand in self._open if not errand.ticket.finished]

    def end(self, why: str) -> None:
        """End all operations that are still in progress."""
        for errand in self._open:
            left = errand.ticket.waiting(errand.ticket.heliostats)
            errand.ticket.step(dict.fromkeys(left, why), Stage.FAILED)
        self._open.clear()

    def _look_at(self, errand: _Errand) -> None:
        ticket = errand.ticket
        found = errand.progress(ticket.waiting(ticket.heliostats))
        late = self._clock.monotonic() >= errand.until
        by_stage: dict[Stage | None, dict[str, str]] = {}
        for name, step in found.items():
            by_stage.setdefault(step.stage, {})[name] = step.text
        for stage, texts in by_stage.items():
            ticket.step(texts, stage)
        if late and (left := ticket.waiting(ticket.heliostats)):
            spent = math.floor(self._clock.monotonic() - ticket.accepted_at)
            texts = {name: f"not finished within {spent} s: {ticket.steps[name]}" for name in left}
            ticket.step(texts, Stage.FAILED)
            if errand.dropped is not None:
                errand.dropped(left, f"not started within {spent} s")
