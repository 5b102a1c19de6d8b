"""The most recent commands given through the interface."""

from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass

from heliotrope.errors import UnknownNameError
from heliotrope.plant.orders.tickets import Ticket

#: Number of tickets kept; those of whole fields are large.
KEPT = 200


@dataclass(frozen=True)
class TicketState:
    """Progress of an accepted command.

    Attributes
    ----------
    identity, command
        Identity of the command's record in the audit, and the name of the command.
    heliostats
        Number of its heliostats.
    counted
        Number of heliostats at each stage.
    finished
        Whether it has ended for every heliostat.
    good
        Whether every heliostat is done.
    text
        The progress in words.
    refusals
        Reasons for the first hundred heliostats that were refused.
    steps
        What the first hundred heliostats of an operation do or wait for now, or their results.
    """

    identity: str
    command: str
    heliostats: int
    counted: Mapping[str, int]
    finished: bool
    good: bool
    text: str
    refusals: Mapping[str, str]
    steps: Mapping[str, str]

    @classmethod
    def of(cls, ticket: Ticket) -> "TicketState":
        """Return the progress of a command."""
        return cls(
            ticket.identity,
            ticket.name,
            len(ticket.heliostats),
            ticket.counted(),
            ticket.finished,
            ticket.good,
            ticket.text,
            dict(list(ticket.refusals.items())[:100]),
            dict(list(ticket.steps.items())[:100]),
        )


class Tickets:
    """The last tickets, by their identity in the audit."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, Ticket] = OrderedDict()

    def put(self, ticket: Ticket) -> TicketState:
        """Keep a ticket; return its progress."""
        self._kept[ticket.identity] = ticket
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return TicketState.of(ticket)

    def get(self, identity: str) -> TicketState:
        """Return the progress of a command.

        Raises
        ------
        UnknownNameError
            If it is not among the last commands.
        """
        ticket = self._kept.get(identity)
        if ticket is None:
            raise UnknownNameError("command", identity, list(self._kept)[-5:])
        return TicketState.of(ticket)

    def last(self, limit: int = 50) -> tuple[TicketState, ...]:
        """Return the last tickets, newest first."""
        return tuple(TicketState.of(each) for each in list(self._kept.values())[: -limit - 1 : -1])
