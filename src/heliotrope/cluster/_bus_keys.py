"""The bus key: local controllers join the cluster in a signed session, and receive keys.

A local controller shows in its STATUS whether it has a key, and whether it wants a session signed
over a random number that it has drawn (`lcu.signing`). The cluster requests that number and the
fingerprints of its keys, and sends the session (`meet`). Each second it also sends one local
controller a key that it lacks, or retires an old one (`supply`): encrypted under the key of that
local controller, and only while its heliostat is at rest.

During a key change, the cluster signs with the old key until every local controller that responds
has the new key. No lease is therefore lost, whatever the order of events.
"""

import struct
from collections.abc import Callable
from functools import partial

from heliotrope.cluster._exchange import Exchange, sha256
from heliotrope.cluster._nodes import ClusterNode, Nodes
from heliotrope.cluster._orders import stored
from heliotrope.cluster._reports import Reports
from heliotrope.cluster.memory import Kept
from heliotrope.lcu import messages, names
from heliotrope.lcu.controller import HARMLESS
from heliotrope.lcu.signing import NO_KEY, fingerprint, pads_of, tag, wrapped
from heliotrope.links.keys import KeyRing
from heliotrope.safety import alarms

#: Time available in each second for sessions and keys of single local controllers, s; the sun
#: vector is sent after it.
_SHARE = 0.2
#: A local controller that does not reply is polled again this often, then after a pause, s.
_TRIES, _PAUSE = 3, 60.0
#: A problem is reported after this time, s; a key is normally delivered within a few seconds.
_PATIENCE = 15.0

_MOVES = "they accept the key once they are at rest (stowed, locked, idle or defocused)"
_DEAF = (
    "they do not reply to QUERY_BUS because their firmware is older or they have no key of "
    "their own"
)
_OWN = "their own keys are not in the cluster's key file, or differ from it"


class _Held:
    """The cluster's knowledge of the bus keys that one local controller holds."""

    def __init__(self, boots: int) -> None:
        self.boots = boots
        self.prints: tuple[int, int] | None = None  # fingerprints of the newest key and the old key
        self.tries = 0
        self.again = 0.0  # when to query again, monotonic s
        self.why = ""  # why it lacks the keys that it should have


class BusKeys:
    """Meets the local controllers in signed sessions, and sends them keys.

    Parameters
    ----------
    cluster
        Name of the cluster.
    ring
        Bus keys, newest first. If empty, local controllers that have a key lose it. If None, the
        cluster signs nothing and changes no key.
    nodes, exchange, reports, kept
        Parts of the cluster.
    clock
        Function that returns the monotonic time, s.
    """

    def __init__(
        self,
        cluster: str,
        ring: KeyRing | None,
        nodes: Nodes,
        exchange: Exchange,
        reports: Reports,
        kept: Kept,
        clock: Callable[[], float],
    ) -> None:
        self._cluster, self._ring = cluster, ring
        self._nodes, self._exchange = nodes, exchange
        self._reports, self._kept, self._clock = reports, kept, clock
        self._keys: dict[int, bytes] = {}  # by fingerprint, the newest first
        self._taken: tuple[bytes, ...] = ()
        self._held: dict[int, _Held] = {}
        self._next = 0
        self._missing: dict[int, float] = {}  # nodes that lack the keys, and since when
        self._reported: set[int] = set()
        self._look()

    # -- the keys ----------------------------------------------------------------------------

    def _look(self) -> None:
        """Adopt changed keys and decide which key signs."""
        keys = () if self._ring is None else self._ring.keys
        if keys != self._taken:
            self._taken = keys
            self._keys = {fingerprint(sha256, pads_of(key)): key for key in keys}
        if not keys:
            self._exchange.sign(None)
            return
        newest = next(iter(self._keys))
        chosen = keys[0] if len(keys) == 1 or self._all_have(newest) else keys[-1]
        self._exchange.sign(_signer(chosen))

    def _all_have(self, newest: int) -> bool:
        heard = [node for node in self._nodes if node.known and node.missed == 0]
        held = [self._held.get(node.index) for node in heard if node.flags & names.BUS_KEY]
        return bool(heard) and all(
            own is not None and own.prints is not None and newest in own.prints for own in held
        )

    def _due(self, prints: tuple[int, int]) -> bytes | None:
        """Return the key that a node with these keys lacks; None if the node needs no key."""
        newest, old = prints
        if not self._keys:
            return NO_KEY if newest else None
        keys = list(self._keys)
        if newest not in keys and old not in keys:
            return self._keys[keys[-1]]  # the key that signs now
        if newest != keys[0] or (len(keys) == 1 and old):
            return self._keys[keys[0]]
        return None

    # -- sessions ----------------------------------------------------------------------------

    async def meet(self, token: int) -> None:
        """Query nodes whose keys are unknown, and send sessions to nodes that want a session."""
        self._look()
        begin = self._clock()
        count = len(self._nodes)
        first, self._next = self._next, 0
        for place in range(first, first + count):
            if self._ring is None or not self._exchange.connected:
                return
            now = self._clock()
            if now - begin > _SHARE:
                self._next = place % count
                return
            node = self._nodes[place % count]
            if node.known and node.missed == 0:
                await self._meet(node, token, now)

    async def _meet(self, node: ClusterNode, token: int, now: float) -> None:
        held = self._held.get(node.index)
        if held is None or held.boots != node.status[8]:
            held = self._held[node.index] = _Held(node.status[8])
        wants = bool(node.flags & names.SESSION_WANTED) and bool(self._keys)
        known = held.prints is not None and bool(held.prints[0]) == bool(node.flags & names.BUS_KEY)
        if (known and not wants) or now < held.again:
            return
        answer = await self._exchange.ask(node, "QUERY_BUS", expires=now + 1.0, numbers=("BUS",))
        if answer is None:
            held.tries += 1
            if held.tries >= _TRIES:
                held.tries, held.again, held.why = 0, now + _PAUSE, _DEAF
            return
        high, low, newest, old = answer.values
        held.prints, held.tries, held.why = (newest, old), 0, ""
        key = self._keys.get(newest) or self._keys.get(old)
        if wants and key is not None:
            number = struct.pack("<II", high, low)
            await self._exchange.send_session(node.address, token, number, _signer(key))

    # -- keys for local controllers ----------------------------------------------------------

    async def supply(self) -> None:
        """Send one local controller the key that it lacks; report nodes that lack their keys."""
        if self._ring is not None and self._exchange.connected:
            for node in sorted(self._nodes, key=lambda node: self._waited(node.index)):
                held = self._held.get(node.index)
                if held is None or held.prints is None or not node.known or node.missed:
                    continue
                key = self._due(held.prints)
                if key is not None and self._may(node, held):
                    held.again = self._clock()
                    await self._give(node, held, key)
                    break
        self._report()

    def _waited(self, index: int) -> float:
        held = self._held.get(index)
        return 0.0 if held is None else held.again

    def _may(self, node: ClusterNode, held: _Held) -> bool:
        if not node.member.key:
            held.why = _OWN
        elif node.state not in HARMLESS:
            held.why = _MOVES
        else:
            return True
        return False

    async def _give(self, node: ClusterNode, held: _Held, key: bytes) -> None:
        now = self._clock()
        data = await stored(self._exchange, node, "edition", now + 0.5)
        if data is None:
            return
        try:
            edition = self._kept.next_edition(struct.unpack("<I", data)[0] if data else 0)
        except OSError:
            return  # the alarm of the epoch reports it; the next second tries again
        if edition is None:
            return
        carried = wrapped(sha256, node.member.key, edition, key)
        answer = await self._exchange.ask(
            node,
            "SET_BUS_KEY",
            0,
            0,
            edition,
            *struct.unpack("<4I", carried),
            key=node.member.key,
            expires=self._clock() + 1.0,
            stored=True,
        )
        if answer is None:
            return
        result = answer.values[2]
        if result == messages.DONE:
            held.prints = None  # to be requested again
        elif result == messages.REFUSED_KEY:
            held.why, held.again = _OWN, now + _PAUSE
        elif result == messages.REFUSED_STATE:
            held.why = _MOVES

    # -- reports -----------------------------------------------------------------------------

    def _report(self) -> None:
        now = self._clock()
        without = {node.index for node in self._nodes if node.known and self._lacks_keys(node)}
        self._missing = {index: self._missing.get(index, now) for index in without}
        late = {index for index, since in self._missing.items() if now - since > _PATIENCE}
        kind = alarms.BUS_KEY_MISSING if self._ring is None else alarms.BUS_UNSIGNED
        if late - self._reported:
            if self._reported:
                self._reports.clear(kind.ended(cluster=self._cluster))
            self._reported = without
            listed = ", ".join(self._nodes[index].name for index in sorted(without))
            known = (self._held.get(index) for index in sorted(without))
            why = next((held.why for held in known if held is not None and held.why), _MOVES)
            self._reports.alarm(kind.raised(cluster=self._cluster, heliostats=listed, why=why))
        elif self._reported and not without:
            self._reported = set()
            self._reports.clear(kind.ended(cluster=self._cluster))

    def _lacks_keys(self, node: ClusterNode) -> bool:
        if self._ring is None:
            return bool(node.flags & names.BUS_KEY)
        if not self._keys:
            return bool(node.flags & names.BUS_KEY)
        held = self._held.get(node.index)
        if held is None or held.prints is None:
            return not node.flags & names.BUS_KEY
        return not set(held.prints) & set(self._keys)


def _signer(key: bytes) -> Callable[[bytes], bytes]:
    return partial(tag, sha256, pads_of(key))
