"""DEFOCUS and STOW: broadcast three times, then confirmed by each heliostat.

Anyone can order DEFOCUS and STOW, and so can the safety table. These orders take precedence over
all other bus traffic. A heliostat that has not acknowledged the order is reported by name, and
polled every second until it has. The cluster itself issues the first order at start-up: a DEFOCUS
of all heliostats on the bus, which needs no acknowledgement.
"""

from collections import deque
from collections.abc import Callable, Iterable

from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._goals import Goals
from heliotrope.cluster._nodes import ClusterNode, Nodes
from heliotrope.cluster._reports import Reports
from heliotrope.links.messages import Stage
from heliotrope.safety import ORDER_BUDGET, alarms

_CALLS = 3
#: Time for repeated queries in each second after the first, s; polling and the sun vector continue.
_SHARE = 0.3
#: Attempts for each node in the first round.
_ROUNDS = 3
#: A node that missed this many consecutive queries is queried after all others.
_SILENT = 3
#: After this time a node is reported to the plant as failed, s; it is still queried.
_PATIENCE = 30.0


class _Order:
    def __init__(
        self, identity: str, name: str, nodes: list[ClusterNode], everybody: bool, now: float
    ):
        self.identity, self.name, self.everybody = identity, name, everybody
        self.began = now
        self.calls = _CALLS if everybody else 0
        self.waiting = deque(sorted(nodes, key=lambda node: node.missed >= _SILENT))
        self.tries = {node.index: 0 for node in nodes}
        self.sent: set[int] = set()  # nodes that were sent the broadcast or a query
        self.new = True
        self.given_up = False


def _rank(order: _Order) -> tuple[bool, bool, bool]:
    """Return the sort key of an order; the lowest is served first."""
    silent = all(node.missed >= _SILENT for node in order.waiting)
    return bool(order.sent), silent, not order.new


class Emergencies:
    """Emergency orders that not all heliostats have acknowledged.

    Attributes
    ----------
    pressing
        Whether an emergency order must be sent before anything else.
    """

    def __init__(
        self,
        nodes: Nodes,
        exchange: Exchange,
        goals: Goals,
        reports: Reports,
        clock: Callable[[], float],
    ) -> None:
        self._nodes, self._exchange = nodes, exchange
        self._goals, self._reports, self._clock = goals, reports, clock
        # Heliostats may be out of stow, and one that is missing in the cluster's file receives no
        # other order.
        self._orders = [_Order("", "DEFOCUS", [], True, clock())]
        self._serving = 0.0
        self._asked: set[tuple[str, int]] = set()
        self.pressing = True

    def begin(self, identity: str, name: str, nodes: list[ClusterNode]) -> None:
        """Accept an emergency order for some or all heliostats; a repeated order counts once."""
        if identity and any(order.identity == identity for order in self._orders):
            return
        everybody = len(nodes) == len(self._nodes)
        if name == "STOW" and everybody:
            for older in self._orders:
                # A heliostat that has not defocused yet goes directly to stow.
                older.name = name
        self._orders.append(_Order(identity, name, nodes, everybody, self._clock()))
        for node in nodes:
            self._reports.add(identity, Stage.ACCEPTED, node.name)
        self.pressing = True

    async def serve(self) -> None:
        """Broadcast and query until every order has had its round.

        Orders that were never sent go first, and among these the orders for heliostats that reply.
        Once these rounds have used up the time budget of an order, silent heliostats wait for the
        next second, so that many orders on a dead bus take no longer than a few.
        """
        self._serving = self._clock()
        self._asked.clear()
        while self.pressing:
            self.pressing = False
            for order in self._orders:
                await self._call(order)
            for order in sorted(self._orders, key=_rank):
                await self._round(order)
                if self.pressing:
                    break
        self._exchange.resume()
        self._orders = [order for order in self._orders if order.waiting or order.calls]

    def second(self) -> None:
        """Begin a second: report heliostats that have not acknowledged, and query them again."""
        now = self._clock()
        for order in self._orders:
            self._name(order, now)
        self.pressing = bool(self._orders)

    def waits(self, node: ClusterNode) -> bool:
        """Return whether a node has yet to acknowledge an order."""
        return any(node in order.waiting for order in self._orders)

    async def _call(self, order: _Order) -> None:
        while order.calls > 0:
            if not await self._exchange.broadcast(order.name, urgent=True):
                return
            order.calls -= 1
            self._sent(order, order.waiting)

    def _sent(self, order: _Order, nodes: Iterable[ClusterNode]) -> None:
        for node in nodes:
            if node.index not in order.sent:
                order.sent.add(node.index)
                self._reports.add(order.identity, Stage.SENT, node.name)

    async def _round(self, order: _Order) -> None:
        """Query each node that has not acknowledged."""
        begin = self._clock()
        for number in range(_ROUNDS if order.new else 1):
            if number and self._clock() - begin > ORDER_BUDGET:
                break
            for _ in range(len(order.waiting)):
                if self.pressing or not self._exchange.connected:
                    return
                if not order.new and self._clock() - begin > _SHARE:
                    return
                node = order.waiting.popleft()
                if self._later(order, node, number):
                    order.waiting.append(node)
                else:
                    await self._ask(order, node)
        order.new = False

    def _later(self, order: _Order, node: ClusterNode, number: int) -> bool:
        """Return whether a node is left out of this round of the order."""
        if order.given_up and node.missed > 0:
            return True  # polling finds the node when it comes back
        if node.missed < _SILENT:
            return False
        # Another order may have requested the same state from the node.
        if order.new:
            enough = order.tries[node.index] > number
        else:
            enough = (order.name, node.index) in self._asked
        return enough or self._clock() - self._serving > ORDER_BUDGET

    async def _ask(self, order: _Order, node: ClusterNode) -> None:
        begin = self._clock()
        answer = await self._exchange.ask(node, order.name, expires=begin + 1.0, urgent=True)
        self._asked.add((order.name, node.index))
        # An order that arrived after this frame was sent needs its own query.
        same = [
            other
            for other in self._orders
            if other is not order
            and other.name == order.name
            and other.began <= begin
            and node in other.waiting
        ]
        for emergency in (order, *same):
            emergency.tries[node.index] += 1
            self._sent(emergency, [node])
        if answer is None:
            node.retried()
            order.waiting.append(node)
            return
        self._reports.clear(alarms.ORDER_UNACKNOWLEDGED.ended(node.name))
        self._acknowledged(order, node)
        for other in same:
            other.waiting.remove(node)
            self._acknowledged(other, node)

    def _acknowledged(self, order: _Order, node: ClusterNode) -> None:
        if not order.given_up:
            self._reports.add(order.identity, Stage.ACKNOWLEDGED, node.name)
            self._goals.begin(order.identity, order.name, node, self._clock())

    def _name(self, order: _Order, now: float) -> None:
        """Report the nodes that have not acknowledged in time by name."""
        age = now - order.began
        if age <= ORDER_BUDGET:
            return
        for node in order.waiting:
            self._reports.alarm(alarms.ORDER_UNACKNOWLEDGED.raised(node.name, order=order.name))
            if age > _PATIENCE and not order.given_up:
                self._reports.add(
                    order.identity,
                    Stage.FAILED,
                    node.name,
                    f"{order.name} not acknowledged within {_PATIENCE:g} s; it is repeated",
                )
        order.given_up = order.given_up or age > _PATIENCE
