"""Plant queries: checksums, stored items, diagnoses, statistics, discovery, frames."""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from heliotrope.cluster._bus_log import RecordedBus
from heliotrope.cluster._discovery import Discovery
from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._nodes import ClusterNode, Nodes, OrderRefusedError
from heliotrope.cluster._orders import TRIES, stored
from heliotrope.cluster._reports import Reports
from heliotrope.lcu.journal import ITEMS
from heliotrope.links.messages import Answer, Ask

#: Items whose contents are never sent to the plant.
_SECRET = ("key_id", "bus_keys")
_PATIENCE = 5.0
#: Attempts for a node that does not reply, one per second.
_TRIES = 3
_STORED = tuple(name for name, _ in ITEMS if name not in _SECRET)


class _Recall:
    """A query for the stored items of a node, one item at a time."""

    def __init__(self, ask: Ask, node: ClusterNode) -> None:
        self.ask, self.node = ask, node
        self.items: dict[str, bytes] = {}
        self.tries = 0

    @property
    def item(self) -> str:
        """The next item to be requested."""
        return _STORED[len(self.items)]


class Questions:
    """Answers the plant's queries when the bus is free."""

    def __init__(
        self,
        nodes: Nodes,
        exchange: Exchange,
        bus: RecordedBus,
        reports: Reports,
        clock: Callable[[], float],
    ) -> None:
        self._nodes, self._exchange, self._bus = nodes, exchange, bus
        self._reports, self._clock = reports, clock
        self._waiting: deque[Ask | _Recall] = deque(maxlen=64)
        self._later: list[_Recall] = []
        self._discovery: Discovery | None = None
        self._recording = ""  # identity of the query for frames

    @property
    def ready(self) -> bool:
        """Whether a query waits for the bus."""
        return bool(self._waiting)

    def take(self, ask: Ask) -> None:
        """Answer a query, or hold it until the bus is free."""
        if ask.what == "checksums":
            data = {node.name: node.status[7] for node in self._nodes if node.known}
            self._reports.answer(Answer(ask.identity, data))
        elif ask.what == "statistics":
            self._reports.answer(Answer(ask.identity, self.statistics()))
        elif ask.what in ("stored", "diagnosis"):
            self._take_one(ask)
        elif ask.what == "discover":
            self._waiting.append(ask)
        elif ask.what == "frames":
            self._record(ask)
        else:
            known = "checksums, stored, diagnosis, statistics, discover, frames"
            self._error(ask, f"query {ask.what!r} is not known; use one of {known}")

    def statistics(self) -> dict[str, Any]:
        """Return the counts of each node."""
        now = self._clock()
        return {
            node.name: asdict(node.counts)
            | {"heard_s": now - node.heard_at if node.counts.answered else None}
            for node in self._nodes
        }

    def second(self) -> None:
        """Make ready the queries that are to be retried, and send a complete recording."""
        self._waiting.extend(self._later)
        self._later.clear()
        if self._bus.complete:
            utc_s, why, block = self._bus.taken()
            names = {str(node.address): node.name for node in self._nodes}
            data = {"utc_s": utc_s, "over": why, "names": names}
            self._reports.answer(Answer(self._recording, data, block))

    def _record(self, ask: Ask) -> None:
        if self._bus.recording:
            self._error(ask, "another user is recording it; try again in ten seconds")
        else:
            self._recording = ask.identity
            self._bus.record()

    async def serve(self) -> None:
        """Carry out one step of the first query."""
        first = self._waiting[0]
        if isinstance(first, _Recall):
            self._waiting.popleft()
            await self._recall(first)
        elif first.what == "diagnosis":
            self._waiting.popleft()
            await self._diagnosis(first)
        else:
            await self._discover(first)

    async def _discover(self, ask: Ask) -> None:
        if self._discovery is None:
            self._discovery = Discovery(self._nodes, self._exchange)
        await self._discovery.step()
        if self._discovery.done:
            self._waiting.popleft()
            self._reports.answer(Answer(ask.identity, self._discovery.result()))
            self._discovery = None

    def _take_one(self, ask: Ask) -> None:
        try:
            node = self._nodes.named(ask.heliostat)
        except OrderRefusedError as refusal:
            self._error(ask, str(refusal))
        else:
            self._waiting.append(_Recall(ask, node) if ask.what == "stored" else ask)

    async def _diagnosis(self, ask: Ask) -> None:
        """Reply with the result of a node's last motion diagnosis."""
        node = self._nodes.named(ask.heliostat)
        answer = await self._exchange.ask(
            node,
            "QUERY_DIAGNOSIS",
            expires=self._clock() + _PATIENCE,
            tries=TRIES,
            numbers=("DIAGNOSIS",),
        )
        if answer is None:
            self._error(ask, f"{node.name} does not answer")
        else:
            self._reports.answer(Answer(ask.identity, {"result": answer.values[0]}))

    async def _recall(self, recall: _Recall) -> None:
        """Request one item; items already received are not requested again."""
        ask, node, items = recall.ask, recall.node, recall.items
        data = await stored(self._exchange, node, recall.item, self._clock() + _PATIENCE)
        if data is None:
            recall.tries += 1
            if recall.tries < _TRIES:
                self._later.append(recall)
            else:
                self._error(ask, f"{node.name} does not answer")
            return
        items[recall.item] = data
        if len(items) < len(_STORED):
            self._waiting.appendleft(recall)
            return
        data_of = {"names": list(items), "sizes": [len(data) for data in items.values()]}
        self._reports.answer(Answer(ask.identity, data_of, b"".join(items.values())))

    def _error(self, ask: Ask, text: str) -> None:
        self._reports.answer(Answer(ask.identity, {"error": text}))
