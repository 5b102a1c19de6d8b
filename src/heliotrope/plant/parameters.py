"""What local controllers hold is kept as it is wanted: compared at connect, then pushed."""

import math
from collections.abc import Callable, Mapping

from heliotrope.lcu import states
from heliotrope.links.messages import Answer, ProtocolError
from heliotrope.mechanism.board_items import CALIBRATION_ITEMS, Wanted, checksums
from heliotrope.plant.audit import AuditError
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.orders import PlantOrders
from heliotrope.plant.tickets import Ticket

#: States in which a controller takes items of its calibration, and items of its machine.
TAKES_CALIBRATION = (
    states.UNCONFIGURED,
    states.STOWED,
    states.LOCKED,
    states.FAULT,
    states.IDLE,
    states.DEFOCUSED,
)
TAKES_MACHINE = (states.UNCONFIGURED, states.LOCKED, states.FAULT)
#: Before what failed is tried again, s.
AGAIN = 30.0


def stored_items(answer: Answer) -> dict[str, bytes]:
    """Return the items of an answer to ``stored``; empty if it could not be answered.

    Raises
    ------
    ProtocolError
        If names, sizes and block don't fit together.
    """
    names, sizes = answer.data.get("names"), answer.data.get("sizes")
    if "error" in answer.data:
        return {}
    if not (isinstance(names, list) and isinstance(sizes, list)) or len(names) != len(sizes):
        raise ProtocolError(f"answer {answer.identity}: it tells no names and sizes of items")
    if not all(isinstance(size, int) for size in sizes) or sum(sizes) != len(answer.block):
        raise ProtocolError(f"answer {answer.identity}: names, sizes and block do not fit together")
    found, place = {}, 0
    for name, size in zip(names, sizes, strict=True):
        found[str(name)] = answer.block[place : place + size]
        place += size
    return found


class Pusher:
    """Compares and pushes, a heliostat at a time.

    Parameters
    ----------
    field, wanted, orders
        Of the plant.
    ask
        Asks a cluster what a heliostat has stored; returns the question's identity.
    """

    def __init__(
        self, field: FieldState, wanted: Wanted, orders: PlantOrders, ask: Callable[[str], str]
    ) -> None:
        self._field, self._wanted, self._orders, self._ask = field, wanted, orders, ask
        self._due = dict.fromkeys(wanted.items, -math.inf)  # who is to be compared, and when
        self._asked: dict[str, str] = {}
        self._tickets: dict[str, Ticket] = {}
        self._tried: dict[str, float] = {}

    def compare(self, heliostat: str) -> None:
        """Compare a heliostat as soon as may be."""
        if heliostat in self._wanted.items:
            self._due[heliostat] = -math.inf

    def follow(self, heliostat: str, ticket: Ticket) -> None:
        """Compare a heliostat when a push to it has come to its end."""
        self._tickets[heliostat] = ticket

    def take(self, answer: Answer) -> tuple[str, tuple[str, ...]] | None:
        """Take an answer; return the heliostat and what differs, None if it is of no question here.

        Raises
        ------
        ProtocolError
            If it makes no sense.
        """
        heliostat = self._asked.pop(answer.identity, None)
        if heliostat is None:
            return None
        items = stored_items(answer)
        if not items:
            return None
        self._due.pop(heliostat, None)
        return heliostat, self._wanted.compare(heliostat, checksums(items))

    def beat(self, now: float, token: int, allowed: bool) -> None:
        """Ask and push what is due."""
        for name, ticket in list(self._tickets.items()):
            if ticket.finished:
                del self._tickets[name]
                self.compare(name)
        live = self._field.live(now)
        for name, due in self._due.items():
            if now >= due and live[self._field.index[name]]:
                self._due[name] = now + AGAIN
                self._asked[self._ask(name)] = name
        if token and allowed:
            for name, missing in list(self._wanted.missing.items()):
                if live[self._field.index[name]] and name not in self._tickets:
                    self._push(name, missing, token, now)

    def _push(self, name: str, missing: tuple[str, ...], token: int, now: float) -> None:
        state = int(self._field.rows["state"][self._field.index[name]])
        able = [
            item
            for item in missing
            if state in TAKES_MACHINE or (state in TAKES_CALIBRATION and item in CALIBRATION_ITEMS)
        ]
        if not able or now - self._tried.get(name, -math.inf) < AGAIN:
            return
        self._tried[name] = now
        items: Mapping[str, bytes] = {item: self._wanted.items[name][item] for item in able}
        try:
            ticket = self._orders.accept(
                ("plant", "plant", "PARAMETERS"), (), (name,), ", ".join(able)
            )
        except AuditError:
            return  # nothing is sent without its record; the safety table tells of the disk
        self._orders.parameters(ticket, name, items, token)
        self.follow(name, ticket)
