"""Commands and parameters on their way to the heliostats: sent, retried, checked, reported.

A command without a reply is sent again as the same frame, which takes effect only once. In the next
second it is sent as a new frame, until it expires. If the reply to an earlier frame was lost,
"duplicate" or "not in this state" may mean that the command was accepted; the reported state then
decides. A command that must not take effect twice (JOG) is not sent as a new frame; the step-count
goals show whether it was accepted.
"""

import re
import struct
from binascii import crc32
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from heliotrope.cluster._discovery import SPAN, heard
from heliotrope.cluster._epoch import Epoch
from heliotrope.cluster._exchange import Exchange
from heliotrope.cluster._goals import GOALS, Goals, Shift
from heliotrope.cluster._nodes import ClusterNode, Nodes, OrderRefusedError
from heliotrope.cluster._reports import Reports
from heliotrope.cluster._watch import Watch
from heliotrope.lcu import messages, names, states, wire
from heliotrope.lcu.journal import CODES_OF, ITEMS, SIZE_OF, TARGETS
from heliotrope.links.messages import Command, Parameters, ProtocolError, Stage

#: Commands by property; see `lcu.messages`.
_RELATIVE = messages.having("relative")
_REPEATED = messages.having("again")
_STORED = messages.having("stored")

#: Number of times that a frame is sent before other jobs get their turn.
TRIES = 3
#: Temporary refusals: the node has not yet received the time, session or authority.
_AGAIN = (messages.DUPLICATE, messages.EXPIRED, messages.REFUSED_AUTHORITY)
#: Refusals that may mean that an earlier frame was accepted and its reply lost.
_MAYBE = (messages.DUPLICATE, messages.REFUSED_STATE, messages.BUSY)
#: Maximum number of jobs for all heliostats; the bus carries about a hundred per second.
_MOST_JOBS = 2048
#: If at most this many heliostats are commanded at a time, their step counts are requested each
#: second for this long, s.
_FEW, FOLLOWED = 4, 60.0
#: Commands that may move a heliostat, refused while a row of the safety table forbids motion.
MOTIONS = messages.MOTIONS | messages.POINTS
#: Lifetime of a command on the bus, s; it is shorter than a local controller's clock allows.
_WIRE_LIFE = wire.HORIZON_S - 2.0
_ITEM_NUMBER = {row[0]: number for number, row in enumerate(ITEMS, 1)}
#: The message that sets an item, and the axis if the item exists for both axes.
_MESSAGE_OF = {
    item: (name, axis if len(items) == 2 else None)
    for name, items in TARGETS.items()
    for axis, item in enumerate(items)
}


@dataclass(frozen=True)
class Step:
    """One message of an order or, if ``item`` is set, the check of a stored item."""

    name: str
    values: tuple[Any, ...] = ()
    item: str = ""
    data: bytes = b""


@dataclass(frozen=True)
class Order:
    """A command or a set of parameters."""

    identity: str
    name: str
    steps: tuple[Step, ...]
    deadline: float
    token: int


class NodeOrder:
    """An order for one heliostat."""

    def __init__(self, order: Order, node: ClusterNode) -> None:
        self.order, self.node = order, node
        self.place = 0
        self.told_sent = False
        self.unanswered = False  # an earlier frame of this step may have been accepted
        self.edition = -1  # of the node's journal; -1: not yet known
        self.last = ""  # reason of the last retry
        self.void = ""  # reason to abandon the job once its frame is answered
        self.origin: tuple[int, int] | None = None  # step-count goals before the job, if known

    @property
    def step(self) -> Step:
        """The step that is carried out now."""
        return self.order.steps[self.place]

    def shift(self) -> Shift | None:
        """The change made by a JOG; None if it is unknown."""
        if self.origin is None:
            return None
        axis, steps = self.step.values
        return Shift(axis, self.origin[axis], steps) if axis < len(self.origin) else None


class Orders:
    """All orders of a cluster.

    Parameters
    ----------
    nodes, exchange, goals, reports, watch, epoch
        Parts of the cluster.
    gps
        Function that returns the GPS time of the local controllers, s; None if they have no time.
    look
        Function that polls the state of a node.
    """

    def __init__(
        self,
        nodes: Nodes,
        exchange: Exchange,
        goals: Goals,
        reports: Reports,
        watch: Watch,
        epoch: Epoch,
        gps: Callable[[], float | None],
        look: Callable[[ClusterNode], Awaitable[None]],
    ) -> None:
        self._nodes, self._exchange, self._goals, self._reports = nodes, exchange, goals, reports
        self._watch, self._epoch, self._gps, self._look = watch, epoch, gps, look
        self._clock = exchange.clock.monotonic
        self._ready: deque[NodeOrder] = deque()
        self._later: list[NodeOrder] = []
        self._at_work: NodeOrder | None = None

    @property
    def ready(self) -> bool:
        """Whether a message can be sent now."""
        return bool(self._ready)

    # -- accepting -------------------------------------------------------------------------

    def accept(self, command: Command, nodes: list[ClusterNode]) -> None:
        """Accept a command for some of its heliostats, or refuse the command."""
        try:
            steps = self._steps_of(command, nodes)
            self._may(command.token, command.lifetime, len(nodes))
        except OrderRefusedError as refusal:
            for name in [node.name for node in nodes] if command.heliostats else ("",):
                self._reports.add(command.identity, Stage.REFUSED, name, str(refusal))
            return
        now = self._clock()
        deadline = now + command.lifetime
        for node, own in zip(nodes, steps, strict=True):
            if len(nodes) <= _FEW:
                node.follow(now + FOLLOWED)
            order = Order(command.identity, command.name, (own,), deadline, command.token)
            self._begin(order, node)

    def _steps_of(self, command: Command, nodes: list[ClusterNode]) -> list[Step]:
        number = messages.NUMBER_OF.get(command.name)
        who = -1 if number is None else messages.who_of(number)
        if number is None or who not in (messages.AUTHORITY, messages.KEY):
            raise OrderRefusedError(f"{command.name!r} is not a command for local controllers")
        if command.name in MOTIONS and self._watch.verdict.forbidden:
            raise OrderRefusedError(self._watch.verdict.forbidden)
        steps = []
        for node in nodes:
            values = command.values
            if command.name == "SET_ADDRESS" and not values:
                if node.member.serial is None:
                    raise OrderRefusedError(
                        f"{node.name}: no serial number is configured; add it to the cluster file"
                    )
                values = node.member.serial, node.address
            if who == messages.KEY and not node.member.key:
                raise OrderRefusedError(
                    f"{node.name}: no key is configured; add it to the key file"
                )
            steps.append(Step(command.name, _typed(number, values)))
        return steps

    def _may(self, token: int, lifetime: float, jobs: int) -> None:
        authority = self._authority()
        if authority == 0:
            raise OrderRefusedError(
                "nobody has the command authority because the plant's lease has expired"
            )
        if token != authority:
            raise OrderRefusedError(
                "no command authority, because the token is out of date; take command authority "
                "first"
            )
        if not 0.0 < lifetime <= 3600.0:
            raise OrderRefusedError(
                f"the lifetime must be above 0 and at most 3600 s, not {lifetime:g} s"
            )
        waiting = len(self._ready) + len(self._later)
        if waiting + jobs > _MOST_JOBS:
            raise OrderRefusedError(
                f"{waiting} orders are waiting, the limit is {_MOST_JOBS}; try again later"
            )
        if self._gps() is None:
            raise OrderRefusedError(
                "the local controllers do not know the time yet, so a command could never expire"
            )

    def _authority(self) -> int:
        return self._watch.authority(self._clock())

    def accept_parameters(self, message: Parameters) -> None:
        """Accept items for the journal of a heliostat, or refuse them."""
        try:
            node = self._nodes.named(message.heliostat)
            steps = _steps_of_items(node, message)
            self._may(message.token, message.lifetime, 1)
        except OrderRefusedError as refusal:
            self._reports.add(message.identity, Stage.REFUSED, message.heliostat, str(refusal))
            return
        deadline = self._clock() + message.lifetime
        self._begin(Order(message.identity, "parameters", steps, deadline, message.token), node)

    def _begin(self, order: Order, node: ClusterNode) -> None:
        self._reports.add(order.identity, Stage.ACCEPTED, node.name)
        if order.name in messages.POINTS:
            self._supersede(order, node)
        self._ready.append(NodeOrder(order, node))

    def _supersede(self, order: Order, node: ClusterNode) -> None:
        """Abandon an earlier point of a node, whose retry would arrive after the new point."""
        why = f"superseded by another {order.name}"

        def earlier(job: NodeOrder) -> bool:
            return job.node is node and job.order.name == order.name

        if self._at_work is not None and earlier(self._at_work):
            self._at_work.void = why
        old = [job for job in (*self._ready, *self._later) if earlier(job)]
        if old:
            self._ready = deque(job for job in self._ready if not earlier(job))
            self._later = [job for job in self._later if not earlier(job)]
            for job in old:
                self._fail(job, why)

    # -- time ------------------------------------------------------------------------------

    def second(self) -> None:
        """Make jobs ready that are to be retried."""
        self._ready.extend(self._later)
        self._later.clear()

    def cancel(self, nodes: Iterable[ClusterNode], name: str, why: str) -> None:
        """Abandon unacknowledged jobs of some heliostats, and goals that DEFOCUS or STOW ends."""
        chosen = {node.index for node in nodes}
        for job in [*self._ready, *self._later]:
            if job.node.index in chosen:
                self._fail(job, why)
        self._ready = deque(job for job in self._ready if job.node.index not in chosen)
        self._later = [job for job in self._later if job.node.index not in chosen]
        if self._at_work is not None and self._at_work.node.index in chosen:
            self._at_work.void = why
        for index in chosen:
            self._goals.end(self._nodes[index], why, name)

    # -- sending ---------------------------------------------------------------------------

    async def serve(self) -> None:
        """Carry out one step of one job."""
        self._at_work = self._ready.popleft()
        await self._work(self._at_work)
        self._at_work = None

    async def _work(self, job: NodeOrder) -> None:
        if job.order.token != self._authority():
            return self._fail(
                job, "the command authority has changed, or the plant's lease has expired"
            )
        if self._clock() >= job.order.deadline:
            return self._fail(job, job.last or "not acknowledged before it expired")
        if not job.told_sent:
            job.told_sent = True
            if job.step.name in _RELATIVE:
                await self._note_origin(job)
            elif self._goals.waits(job.node):
                # A goal reached since the last poll would otherwise be abandoned.
                await self._look(job.node)
            self._reports.add(job.order.identity, Stage.SENT, job.node.name)
        if job.step.item:
            return await self._check(job)
        return await self._set(job)

    async def _note_origin(self, job: NodeOrder) -> None:
        """Query the step-count goals, which show what was done if the reply is lost."""
        node, asked_at = job.node, self._clock()
        node.follow(asked_at + FOLLOWED)
        await self._look(node)
        if node.steps_at >= asked_at:
            job.origin = node.steps[2], node.steps[3]

    async def _set(self, job: NodeOrder) -> None:
        step, node, order = job.step, job.node, job.order
        gps = self._gps()
        if gps is None:
            return self._again(job, "the local controllers have lost the time")
        head: tuple[int, ...] = (self._exchange.token(order.token), self._expiry(gps, order))
        key = b""
        if messages.who_of(messages.NUMBER_OF[step.name]) == messages.KEY:
            if step.name != "SET_ADDRESS" and not await self._knows_edition(job):
                return self._again(job, "no reply to QUERY_STORED before the command expired")
            try:
                edition = self._epoch.kept.next_edition(job.edition)
            except OSError as error:
                return self._again(job, f"the edition cannot be stored: {error.strerror}")
            if edition is None:
                return self._again(job, "the cluster's disk has not stored the edition yet")
            head, key = (*head, edition), node.member.key
        if step.name == "SET_ADDRESS":
            return await self._give_address(job, head, key)
        slow = bool(key) or step.name in _STORED
        answer = await self._exchange.ask(
            node,
            step.name,
            *head,
            *step.values,
            key=key,
            expires=order.deadline,
            tries=TRIES,
            stored=slow,
        )
        if answer is not None:
            return self._judge(job, answer.values[2], lost=job.unanswered or answer.attempt > 0)
        job.unanswered = True
        if step.name in _RELATIVE:
            return self._fail(job, f"no reply to {step.name}; the controller may have accepted it")
        return self._again(job, f"no reply to {step.name} before the command expired")

    async def _give_address(self, job: NodeOrder, head: tuple[int, ...], key: bytes) -> None:
        """Assign an address to a serial number by broadcast, then query the node."""
        serial, address = job.step.values
        frame = self._exchange.sender.frame(
            wire.BROADCAST, "SET_ADDRESS", *head, serial, address, key=key
        )
        await self._exchange.transmit(frame, life=job.order.deadline - self._clock())
        data, sequence = await self._exchange.gather(
            "DISCOVER",
            serial,
            serial,
            span=SPAN,
            stored=True,
            complete=lambda data: data.endswith(b"\0") and bool(data.strip(b"\0")),
        )
        answers = [] if data is None else heard(data, sequence)[0]
        if not answers:
            return self._again(
                job, f"no reply from serial number {serial} before the command expired"
            )
        if answers[0].address != address:
            return self._again(
                job,
                f"serial number {serial} stays at address {answers[0].address}: its key or "
                "edition differs, or its state forbids it",
            )
        return self._advance(job)

    def _expiry(self, gps: float, order: Order) -> int:
        life = min(order.deadline - self._clock(), _WIRE_LIFE)
        return int(gps + life) & 0xFFFFFFFF

    async def _knows_edition(self, job: NodeOrder) -> bool:
        """Query the edition of the node's journal, since another cluster may have written it."""
        if job.edition < 0:
            data = await self._stored(job, "edition")
            if data is None:
                return False
            job.edition = struct.unpack("<I", data)[0] if len(data) == SIZE_OF["edition"] else 0
        return True

    async def _stored(self, job: NodeOrder, item: str) -> bytes | None:
        return await stored(self._exchange, job.node, item, job.order.deadline)

    async def _check(self, job: NodeOrder) -> None:
        """Compare the stored item with the sent item, and check the checksum in STATUS."""
        step, node = job.step, job.node
        data = await self._stored(job, step.item)
        if data is None:
            return self._again(
                job, f"no reply to QUERY_STORED of {step.item} before the command expired"
            )
        same = data == step.data
        if same and step.item == "armature":
            asked_at = self._clock()
            await self._look(node)
            if node.status_at < asked_at:
                return self._again(job, "no reply to QUERY_STATUS before the command expired")
            same = node.status[7] == crc32(data)
        if not same:
            return self._fail(
                job, f"{step.item}: the stored item differs from the one sent; send it again"
            )
        return self._advance(job)

    def _judge(self, job: NodeOrder, result: int, *, lost: bool) -> None:
        """Continue after an ACK; ``lost`` means that an earlier reply may have been lost."""
        name = job.step.name
        if result == messages.DONE:
            self._epoch.taken(job.node.index)
            return self._advance(job)
        text = f"{name}: {self._why(job.node, result)}"
        if lost and result == messages.DUPLICATE and name in _REPEATED:
            job.unanswered = True
            return self._again(job, text)
        if lost and result in _MAYBE and name in GOALS:
            return self._advance(job, sure=False)
        if result in _AGAIN:
            if result == messages.DUPLICATE and not lost:
                self._epoch.duplicate(job.node.index)
            return self._again(job, text)
        self._reports.add(job.order.identity, Stage.REFUSED, job.node.name, text)
        return None

    def _why(self, node: ClusterNode, result: int) -> str:
        text = messages.RESULTS[result] if result < len(messages.RESULTS) else f"result {result}"
        if result == messages.REFUSED_STATE and node.known:
            fault = f", {names.FAULTS[node.fault]}" if node.fault else ""
            text += f" ({states.STATES[node.state]}{fault})"
        return text

    def _advance(self, job: NodeOrder, *, sure: bool = True) -> None:
        """Continue after a step; if not ``sure``, the goal shows whether it was accepted."""
        if job.void:
            return self._fail(job, job.void)
        order, node, done = job.order, job.node, job.step
        shift = job.shift()
        job.place += 1
        job.unanswered = False
        rest = order.steps[job.place :]
        if not done.item and (not rest or rest[0].item):
            self._reports.add(order.identity, Stage.ACKNOWLEDGED, node.name)
        if rest:
            self._ready.append(job)
        elif done.item:
            self._reports.add(order.identity, Stage.DONE, node.name)
        else:
            now = self._clock()
            self._goals.begin(order.identity, done.name, node, now, sure=sure, shift=shift)
        return None

    def _again(self, job: NodeOrder, why: str) -> None:
        if job.void:
            return self._fail(job, job.void)
        job.last = why
        self._later.append(job)
        return None

    def _fail(self, job: NodeOrder, why: str) -> None:
        self._reports.add(job.order.identity, Stage.FAILED, job.node.name, why)


async def stored(exchange: Exchange, node: ClusterNode, item: str, expires: float) -> bytes | None:
    """Return an item that a node stores.

    The item is empty if the node stores none, and None if the node does not reply.
    """
    answer = await exchange.ask(
        node,
        "QUERY_STORED",
        _ITEM_NUMBER[item],
        expires=expires,
        tries=TRIES,
        numbers=("STORED",),
    )
    if answer is None or answer.values[0] != _ITEM_NUMBER[item]:
        return None
    data: bytes = answer.values[1]
    return data


def _typed(number: int, values: Sequence[float]) -> tuple[Any, ...]:
    """Return numbers converted to the types that the bus protocol requires.

    Raises
    ------
    OrderRefusedError
        If there are too many or too few numbers, or one is outside the range of its type.
    """
    name = messages.name_of(number)
    head = len(messages.HEADS[messages.who_of(number)][0])
    typed = [int(v) if float(v).is_integer() else v for v in values]
    codes = "".join(
        code * int(count or "1")
        for count, code in re.findall(r"(\d*)(\D)", messages.ROW_OF[number][3])
    )
    if len(codes) == len(values):
        typed = [
            float(v) if code in "fd" else w for v, w, code in zip(values, typed, codes, strict=True)
        ]
    try:
        wire.pack(name, *([0] * head), *typed)
    except ValueError as error:
        raise OrderRefusedError(str(error)) from None
    return tuple(typed)


def _steps_of_items(node: ClusterNode, message: Parameters) -> tuple[Step, ...]:
    """Return the messages that store items, followed by the checks of these items.

    Raises
    ------
    OrderRefusedError
        If items cannot be stored.
    """
    try:
        items = message.items()
    except ProtocolError as error:
        raise OrderRefusedError(str(error)) from None
    if not node.member.key:
        raise OrderRefusedError(f"{node.name}: no key is configured; add it to the key file")
    if not items:
        raise OrderRefusedError("no items; name at least one item")
    sets, checks = [], []
    for item, data in items.items():
        if item not in SIZE_OF or item in ("key_id", "edition", "address", "bus_keys"):
            raise OrderRefusedError(f"item {item!r} cannot be set by parameters")
        if len(data) != SIZE_OF[item]:
            raise OrderRefusedError(f"item {item}: {len(data)} bytes, {SIZE_OF[item]} needed")
        values = struct.unpack(CODES_OF[item], data)
        name, axis = _MESSAGE_OF.get(item, ("STANDBY", None))
        values = values if axis is None else (axis, *values)
        if not wire.finite(values):
            raise OrderRefusedError(f"item {item}: a number that is not finite")
        sets.append(Step(name, values))
        checks.append(Step("QUERY_STORED", item=item, data=data))
    return (*sets, *checks)
