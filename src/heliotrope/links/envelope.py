"""Envelopes of a link: order, freshness and authenticity, independent of the transport.

A receiver can bound the age of a message without a common clock. Every envelope carries the
sender's monotonic time, the latest *receiver* time that the sender has received, and how long ago
that time was received. The envelope was therefore sent after that time on the receiver's own clock,
which bounds its age to within the path delay, whatever the wall clocks say. Between two such bounds
the better bound is carried forward with the sender's own times, minus the maximum drift between two
clocks.

Liveness is judged by the same bound, so heartbeats that were delayed and arrive in a burst renew
nothing. A copy, a message from an earlier connection and a reflected message have the wrong count
or the wrong session, and are rejected.
"""

import hmac
import math
import secrets
import struct
from collections.abc import Callable
from dataclasses import dataclass

from heliotrope.links.clock import Clock
from heliotrope.links.link import LinkSettings, Statistics

_BEAT, _DATA = 0x11, 0x12
#: Kind; sender's session; session that it has received; count; sender's time; latest time that it
#: has received, and how long ago; time to live (0: no expiry). Times in µs.
_HEADER = struct.Struct("<BQQQQQII")
_MAC_SIZE = 16
_LONGEST = 0xFFFFFFFF
#: Bytes that an envelope adds to a message.
OVERHEAD = _HEADER.size + _MAC_SIZE
#: The rates of two clocks are assumed to agree within this, twice the largest slew of NTP.
_DRIFT = 1e-3
#: Function that returns the present keys of a connection, newest first; never empty.
SealKeys = Callable[[], tuple[bytes, ...]]


def _mac(key: bytes, data: bytes) -> bytes:
    return hmac.digest(key, data, "sha256")[:_MAC_SIZE]


@dataclass(slots=True)
class _Peer:
    """The other end of a conversation, as of its last envelope."""

    session: int
    stamp: int = 0  # its time, in µs
    at: float = 0.0  # when that arrived, by our clock
    count: int = 0
    bound: float = -math.inf  # our time minus its time is at least this
    bound_at: float = 0.0


class Conversation:
    """Envelopes in and out, independent of the transport: their order, freshness and authenticity.

    Parameters
    ----------
    clock
        Clock, of which only the monotonic time is used. The other end has its own clock.
    settings
        Settings, of which `LinkSettings.horizon` and `largest` are used here.
    statistics
        Counters to use.
    entropy
        Function that returns random bytes, for session numbers.

    Attributes
    ----------
    alive_at
        Latest time, by our clock, at which the other end was certainly alive.
    heard_at
        Latest time of our clock that the other end has certainly received.

    Notes
    -----
    The MAC is HMAC-SHA256 truncated to 16 bytes. Even with an empty key, the MAC detects damage.
    During a change from an old key to a new one, envelopes under either key are accepted. Each
    connection has a new session, so that nothing from an older connection is accepted.
    """

    def __init__(
        self,
        clock: Clock,
        settings: LinkSettings,
        statistics: Statistics,
        entropy: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._clock = clock
        self._settings = settings
        self._statistics = statistics
        self._entropy = entropy
        self.restart(lambda: (b"",))

    def restart(self, keys: SealKeys) -> None:
        """Begin a new session with the given keys; nothing from the old session is accepted."""
        self._keys = keys
        self._proved: bytes | None = None
        self._session = int.from_bytes(self._entropy(8), "little") or 1
        self._count = 0
        self._peer: _Peer | None = None
        self._candidate: _Peer | None = None
        self.alive_at = -math.inf
        self.heard_at = -math.inf

    @property
    def behind(self) -> bool:
        """Whether the other end has not yet used the newest key."""
        keys = self._keys()
        return len(keys) > 1 and self._proved != keys[0]

    def _sealing(self) -> tuple[bytes, ...]:
        """Return the keys for heartbeats: the newest key that both ends hold, and any newer keys.

        The last key seals messages. Both ends have both keys in their lists during a key change, so
        a newer key is offered with every heartbeat until the other end uses it.
        """
        keys = self._keys()
        return keys[: keys.index(self._proved) + 1] if self._proved in keys else keys

    def beats(self) -> list[bytes]:
        """Return the heartbeats to send: one, or two while a new session requests a response.

        While the other end may not have a newer key, heartbeats are sent under both keys.
        """
        known = [peer for peer in (self._peer, self._candidate) if peer is not None]
        self._candidate = None
        ends: list[_Peer | None] = [*known] or [None]
        return [self._seal(_BEAT, peer, 0, b"", key) for key in self._sealing() for peer in ends]

    def data(self, message: bytes, expires: float | None) -> bytes:
        """Return the envelope for a message that is sent now.

        Raises
        ------
        TimeoutError
            If it has expired.
        """
        lifetime = 0
        if expires is not None:
            lifetime = math.floor((expires - self._clock.monotonic()) * 1e6)
            if lifetime <= 0:
                raise TimeoutError
        return self._seal(_DATA, self._peer, lifetime, message, self._sealing()[-1])

    def _seal(
        self, kind: int, peer: _Peer | None, lifetime: int, message: bytes, key: bytes
    ) -> bytes:
        now = self._clock.monotonic()
        self._count += 1
        session, echo, held = 0, 0, 0
        if peer is not None:
            session, echo = peer.session, peer.stamp
            held = min(_LONGEST, math.floor((now - peer.at) * 1e6))
        header = _HEADER.pack(
            kind, self._session, session, self._count, math.floor(now * 1e6), echo, held, lifetime
        )
        return header + message + _mac(key, header + message)

    def _opens(self, body: bytes, mac: bytes) -> bool:
        """Return whether an envelope is sealed with one of the keys; record the newest one used."""
        keys = self._keys()
        for key in keys:
            if hmac.compare_digest(mac, _mac(key, body)):
                if self._proved not in keys or keys.index(key) < keys.index(self._proved):
                    self._proved = key
                return True
        return False

    def feed(self, envelope: bytes) -> tuple[tuple[bytes, float] | None, bool]:
        """Process an envelope as it arrived.

        Returns
        -------
        arrival
            The message and its expiry on our clock (infinite if it has none). None for a heartbeat,
            and for an envelope that must not be delivered; such envelopes are counted.
        prompt
            Whether to send a heartbeat at once because the other end waits for it.
        """
        now = self._clock.monotonic()
        self._statistics.last_received = now
        body, mac = envelope[:-_MAC_SIZE], envelope[-_MAC_SIZE:]
        if len(body) < _HEADER.size or not self._opens(body, mac):
            self._statistics.refused += 1
            return None, False
        kind, session, heard, count, stamp, echo, held, lifetime = _HEADER.unpack_from(body)
        if kind not in (_BEAT, _DATA) or session == self._session:
            self._statistics.refused += 1
            return None, False
        if heard != self._session or held == _LONGEST:
            return None, self._unproved(kind, session, stamp, count, now)
        proof = echo / 1e6 + held / 1e6 * (1.0 - _DRIFT)
        peer = self._take(session, count, proof, now)
        if peer is None:
            return None, False
        first = peer.bound == -math.inf
        sent_at = self._learn(peer, stamp, count, proof, now)
        self.heard_at = max(self.heard_at, echo / 1e6)
        if kind == _BEAT:
            return None, first
        expires = math.inf if lifetime == 0 else sent_at + lifetime / 1e6
        if expires <= now or lifetime / 1e6 > self._settings.horizon:
            self._statistics.late += 1
            return None, first
        return (body[_HEADER.size :], expires), first

    def _unproved(self, kind: int, session: int, stamp: int, count: int, now: float) -> bool:
        """Handle an envelope of unknown age, which does not show that its sender heard from us."""
        if kind == _DATA:
            self._statistics.refused += 1
            return False
        if self._peer is not None and self._peer.session == session:
            return False
        new = self._candidate is None or self._candidate.session != session
        self._candidate = _Peer(session, stamp, now, count)
        return new

    def _take(self, session: int, count: int, proof: float, now: float) -> _Peer | None:
        """Return the sender of an envelope; None if the envelope is not acceptable."""
        peer = self._peer
        if peer is not None and peer.session == session:
            if count > peer.count:
                return peer
            self._statistics.repeated += 1
            return None
        # A new session is believed if it received from us later than the old session was alive.
        if proof > now or (peer is not None and proof <= self.alive_at):
            self._statistics.refused += 1
            return None
        self._peer = _Peer(session)
        return self._peer

    def _learn(self, peer: _Peer, stamp: int, count: int, proof: float, now: float) -> float:
        """Record an accepted envelope, and return the earliest time at which it was sent."""
        kept = peer.bound - _DRIFT * (now - peer.bound_at)
        peer.bound, peer.bound_at = max(proof - stamp / 1e6, kept), now
        peer.stamp, peer.at, peer.count = stamp, now, count
        sent_at = min(now, stamp / 1e6 + peer.bound)
        self.alive_at = max(self.alive_at, sent_at)
        return sent_at
