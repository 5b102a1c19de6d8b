"""A scripted operator at the plant's end of a link: leases, commands and mistakes, by a seed.

He leads the heliostats onwards from state to state, changes aims, orders emergencies, pushes
parameters; he also sends the same command twice, with a wrong token, or too late. He is told only
what the cluster tells him. What he does is noted with the observer as he does it.
"""

import asyncio
import random
import struct
from collections import Counter

from heliotrope.control.clock import Clock, sleep_until
from heliotrope.control.link import Link, LinkClosedError, Outcome
from heliotrope.control.protocol import (
    NEVER,
    Acknowledge,
    Alarm,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    ProtocolError,
    Status,
    decode,
    encode,
)
from heliotrope.lcu import states
from heliotrope.twin.invariants import Observer
from heliotrope.twin.ledger import Order
from heliotrope.twin.outfit import RECEIVER, STANDBY

TOKEN = 0x5EED0001
#: A lease that is under way for longer is not delivered, s.
LEASE_EXPIRY = 1.0
#: A cluster counts a command's life from when it comes: so long it may have been under way, s.
UNDER_WAY = 0.8
#: What leads on from a state.
ONWARDS = {
    states.STOWED: ("APPROACH",), states.IDLE: ("TRACK", "TRACK", "TRACK", "SEARCH", "JOG"),
    states.TRACKING: ("AIM", "AIM", "IDLE", "ROUGH"), states.DEFOCUSED: ("REFOCUS", "IDLE"),
    states.SEARCHING: ("TRACK", "IDLE"), states.LOCKED: ("UNLOCK",),
    states.FAULT: ("CLEAR_FAULT",),
}  # fmt: skip


class Operator:
    """The plant's end.

    Parameters
    ----------
    clock
        True time.
    seed
        Of what he does.
    observer
        Is told of everything.
    addresses
        Of the heliostats, by name.

    Attributes
    ----------
    link
        Set by who owns it; another one after the cluster has started again.
    silent
        Whether he stands still.
    carried
        Whether line and cluster are there: an order of now must be carried out.
    counts
        Of what he did and was told.
    """

    def __init__(
        self, clock: Clock, seed: int, observer: Observer, addresses: dict[str, int]
    ) -> None:
        self.link: Link | None = None
        self.silent = False
        self.carried = True
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._chance = random.Random(f"operator {seed}")
        self._observer = observer
        self._addresses = addresses
        self._number = 0
        self._names: tuple[str, ...] = ()
        self._told: dict[str, int] = {}
        self._rest_until = 0.0
        self._alarms: set[str] = set()

    # -- what he is told -------------------------------------------------------------------

    async def listen(self, link: Link) -> None:
        """Take what comes over a link until it is closed."""
        while True:
            try:
                data = await link.receive()
            except LinkClosedError:
                return
            try:
                self._take(decode(data))
            except ProtocolError:
                self.counts["refused messages"] += 1

    def _take(self, message: Message) -> None:
        now = self._clock.monotonic()
        if isinstance(message, Status):
            self.counts["status"] += 1
            self._names = message.names or self._names
            if len(self._names) == len(message.nodes()):
                self._observer.status(message, self._names, now)
                for name, row in zip(self._names, message.nodes(), strict=True):
                    if int(row["heard_ms"]) != NEVER:
                        self._told[name] = int(row["state"])
        elif isinstance(message, Progress):
            self.counts[f"progress {message.stage.value}"] += 1
            self._observer.progress(message, now)
        elif isinstance(message, Alarm):
            self.counts["alarms"] += 1
            if message.active:
                self._alarms.add(message.condition)
            else:
                self._alarms.discard(message.condition)

    # -- what he does ----------------------------------------------------------------------

    async def _send(self, message: Message, lifetime: float) -> bool:
        if self.link is None:
            return False
        expires = self._clock.monotonic() + lifetime
        return await self.link.send(encode(message), expires=expires) is Outcome.SENT

    async def lease(self) -> None:
        """Send the lease every second, unless he stands still."""
        while True:
            begin = self._clock.monotonic()
            if not self.silent and await self._send(Lease(TOKEN), LEASE_EXPIRY):
                self._observer.leased(begin)
            await sleep_until(self._clock, begin + 1.0)

    async def work(self) -> None:
        """Command, for ever."""
        while True:
            await asyncio.sleep(self._chance.expovariate(1 / 3.0))
            if self.silent or self._clock.monotonic() < self._rest_until:
                continue
            for condition in sorted(self._alarms):
                await self._acknowledge(condition)
            does = self._chance.choices(
                [self._onward, self._everybody, self._parameters, self._emergency, self._lock,
                 self._wrong],
                [60, 12, 8, 4, 3, 5],
            )[0]  # fmt: skip
            await does()

    async def _acknowledge(self, condition: str) -> None:
        self._number += 1
        self.counts["acknowledgements"] += 1
        await self._send(
            Acknowledge(f"a{self._number}", condition, "operator", "operator"), lifetime=5.0
        )

    async def _command(self, name: str, heliostats: tuple[str, ...], *, token: int = TOKEN) -> None:
        self._number += 1
        self.counts["commands"] += 1
        lifetime = self._chance.choice([1.5, 5.0, 10.0])
        command = Command(f"c{self._number}", name, self._values(name), heliostats, token, lifetime)
        now = self._clock.monotonic()
        addresses = frozenset(self._addresses[each] for each in heliostats or self._addresses)
        self._observer.ordered(
            Order(
                command.identity, name, addresses, now, now + lifetime + UNDER_WAY, token == TOKEN
            )
        )
        await self._send(command, lifetime)

    def _values(self, name: str) -> tuple[float, ...]:
        chance = self._chance
        if name == "AIM":
            return tuple(x + chance.uniform(-1.0, 1.0) for x in RECEIVER)
        if name == "STANDBY":
            return tuple(x + chance.uniform(-0.5, 0.5) for x in STANDBY)
        if name == "SEARCH":
            return 2e-3, chance.choice([4e-3, 8e-3])
        if name == "JOG":
            return float(chance.randrange(2)), float(chance.choice([-100, 100]))
        if name == "ROUGH":
            return (float(chance.randrange(2)),)
        return ()

    async def _onward(self) -> None:
        name = self._chance.choice(sorted(self._addresses))
        state = self._told.get(name, states.STOWED)
        what = self._chance.choice(ONWARDS.get(state, ("APPROACH",)))
        if what == "APPROACH":
            await self._command("AIM", (name,))
        await self._command(what, (name,))

    async def _everybody(self) -> None:
        for what in self._chance.choice(
            [("AIM",), ("APPROACH",), ("TRACK",), ("IDLE",), ("REFOCUS",), ("STANDBY",),
             ("AIM", "APPROACH"), ("DIAGNOSE",)]
        ):  # fmt: skip
            await self._command(what, ())

    async def _lock(self) -> None:
        await self._command("LOCK", (self._chance.choice(sorted(self._addresses)),))

    async def _wrong(self) -> None:
        """With the token of somebody who has no authority any more."""
        what = self._chance.choice(["TRACK", "APPROACH", "AIM", "REFOCUS"])
        name = self._chance.choice(sorted(self._addresses))
        await self._command(what, (name,), token=self._chance.choice([0, TOKEN + 1]))

    async def _parameters(self) -> None:
        """Push two items of the calibration to one heliostat."""
        self._number += 1
        self.counts["parameters"] += 1
        chance = self._chance
        name = chance.choice(sorted(self._addresses))
        items = {
            "biases": struct.pack("<ff", chance.gauss(0.0, 1e-4), chance.gauss(0.0, 1e-4)),
            "defocus": struct.pack("<ff", chance.uniform(0.08, 0.12), chance.uniform(0.05, 0.06)),
        }
        message = Parameters.of(f"p{self._number}", name, items, TOKEN)
        now = self._clock.monotonic()
        self._observer.ordered(
            Order(
                message.identity, "PARAMETERS", frozenset((self._addresses[name],)), now,
                now + message.lifetime + UNDER_WAY, authorised=True,
            )
        )  # fmt: skip
        await self._send(message, message.lifetime)

    async def _emergency(self) -> None:
        self._number += 1
        self.counts["emergencies"] += 1
        what = self._chance.choice(["DEFOCUS", "STOW"])
        now = self._clock.monotonic()
        self._observer.emergency(what, now, carried=self.carried)
        # Nothing else until what was ordered is done, or is overdue.
        self._rest_until = now + self._chance.choice([2.0, 33.0, 33.0, 310.0])
        await self._send(Emergency(f"e{self._number}", what), 5.0)
