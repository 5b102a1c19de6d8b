"""Parameters of local controllers: compared with the wanted ones at connection, then pushed."""

import asyncio
import math
from collections.abc import Callable, Mapping

from heliotrope.lcu import states
from heliotrope.links.messages import Answer, ProtocolError
from heliotrope.mechanism.board_items import CALIBRATION_ITEMS, Wanted, checksums
from heliotrope.plant import refusals
from heliotrope.plant.audit import AuditError
from heliotrope.plant.clusters import Clusters
from heliotrope.plant.field_state import FieldState
from heliotrope.plant.orders import PlantOrders
from heliotrope.plant.tickets import Ticket
from heliotrope.safety import Alarm, alarms

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
#: Pause before another attempt, s.
AGAIN = 30.0


def stored_items(answer: Answer) -> dict[str, bytes]:
    """Return the items in an answer to ``stored``; none if the cluster could not read them.

    Raises
    ------
    ProtocolError
        Names, sizes and block that do not fit together.
    """
    names, sizes = answer.data.get("names"), answer.data.get("sizes")
    if "error" in answer.data:
        return {}
    if not (isinstance(names, list) and isinstance(sizes, list)) or len(names) != len(sizes):
        raise ProtocolError(f"answer {answer.identity}: it lacks the names and sizes of items")
    if not all(isinstance(size, int) for size in sizes) or sum(sizes) != len(answer.block):
        raise ProtocolError(f"answer {answer.identity}: names, sizes and block do not fit together")
    found, place = {}, 0
    for name, size in zip(names, sizes, strict=True):
        found[str(name)] = answer.block[place : place + size]
        place += size
    return found


class ParameterSync:
    """Comparison of the stored parameters with the wanted ones, and the push of those that differ.

    Parameters
    ----------
    field, wanted, orders, clusters
        Of the plant.
    tell
        Called with each alarm.
    """

    def __init__(
        self,
        field: FieldState,
        wanted: Wanted,
        orders: PlantOrders,
        clusters: Clusters,
        tell: Callable[[Alarm], None],
    ) -> None:
        self._field, self._wanted, self._orders = field, wanted, orders
        self._clusters, self._tell = clusters, tell
        #: Heliostats to be compared, each with its time, monotonic s.
        self._due = dict.fromkeys(wanted.items, -math.inf)
        self._tickets: dict[str, Ticket] = {}
        self._tried: dict[str, float] = {}

    def compare(self, heliostat: str) -> None:
        """Compare a heliostat as soon as possible."""
        if heliostat in self._wanted.items:
            self._due[heliostat] = -math.inf

    def push(self, ticket: Ticket, heliostat: str, items: Mapping[str, bytes], token: int) -> None:
        """Send items of an accepted ticket; compare the heliostat when the ticket has ended."""
        self._orders.parameters(ticket, heliostat, items, token)
        self._tickets[heliostat] = ticket

    async def stored(self, heliostat: str, timeout: float) -> dict[str, int]:
        """Return the checksums of the items that a local controller stores, by item.

        Raises
        ------
        RefusedError
            If no answer comes within ``timeout`` s, or nothing is stored.
        """
        future: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()

        def take(answer: Answer) -> None:
            if not future.done():
                future.set_result(answer)

        self._clusters.ask(self._clusters.home(heliostat), "stored", take, heliostat)
        try:
            async with asyncio.timeout(timeout):
                answer = await future
        except TimeoutError:
            late = f"nothing within {timeout:g} s; check that it is live"
            raise refusals.NO_ANSWER.error(heliostat=heliostat, problem=late) from None
        items = stored_items(answer)
        if not items:
            problem = answer.data.get("error", "nothing is stored")
            raise refusals.NO_ANSWER.error(heliostat=heliostat, problem=problem)
        return checksums(items)

    def beat(self, now: float, token: int, allowed: bool) -> None:
        """Ask for and push what is due; nothing is pushed unless ``allowed``."""
        for name, ticket in list(self._tickets.items()):
            if ticket.finished:
                del self._tickets[name]
                self.compare(name)
        live = self._field.live(now)
        for name, due in self._due.items():
            if now >= due and live[self._field.index[name]]:
                self._due[name] = now + AGAIN
                self._ask(name)
        if token and allowed:
            for name, missing in list(self._wanted.missing.items()):
                if live[self._field.index[name]] and name not in self._tickets:
                    self._push(name, missing, token, now)

    def _ask(self, name: str) -> None:
        def take(answer: Answer) -> None:
            items = stored_items(answer)
            if not items:
                return
            self._due.pop(name, None)
            differing = self._wanted.compare(name, checksums(items))
            if differing:
                self._tell(alarms.PARAMETERS_DIFFER.raised(name, items=", ".join(differing)))

        self._clusters.ask(self._clusters.home(name), "stored", take, name)

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
        items = {item: self._wanted.items[name][item] for item in able}
        try:
            ticket = self._orders.accept(
                ("plant", "plant", "PARAMETERS"), (), (name,), ", ".join(able)
            )
        except AuditError:
            return  # nothing is sent without its record; the safety table reports the disk
        self.push(ticket, name, items, token)
