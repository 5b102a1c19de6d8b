"""The last commands given through the interface."""

from collections import OrderedDict
from typing import Any

from heliotrope.errors import UnknownNameError
from heliotrope.plant.tickets import Ticket

#: Number of tickets kept; those of whole fields are large.
KEPT = 200


class Tickets:
    """The last tickets, by their identity in the audit."""

    def __init__(self) -> None:
        self._kept: OrderedDict[str, Ticket] = OrderedDict()

    def put(self, ticket: Ticket) -> dict[str, Any]:
        """Keep a ticket; return its progress."""
        self._kept[ticket.identity] = ticket
        while len(self._kept) > KEPT:
            self._kept.popitem(last=False)
        return state_of(ticket)

    def get(self, identity: str) -> dict[str, Any]:
        """Return the progress of a command.

        Raises
        ------
        UnknownNameError
            If it is not among the last ones.
        """
        ticket = self._kept.get(identity)
        if ticket is None:
            raise UnknownNameError("command", identity, list(self._kept)[-5:])
        return state_of(ticket)

    def last(self, limit: int = 50) -> list[dict[str, Any]]:
        """Return the last tickets, newest first."""
        return [state_of(ticket) for ticket in list(self._kept.values())[: -limit - 1 : -1]]


def state_of(ticket: Ticket) -> dict[str, Any]:
    """Return the progress of a command."""
    return {
        "identity": ticket.identity,
        "command": ticket.name,
        "heliostats": len(ticket.heliostats),
        "counted": ticket.counted(),
        "finished": ticket.finished,
        "good": ticket.good,
        "text": ticket.text,
        "refusals": dict(list(ticket.refusals.items())[:100]),
        "steps": dict(list(ticket.steps.items())[:100]),
    }
