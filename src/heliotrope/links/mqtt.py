"""Links over an MQTT broker (Mosquitto), version 5 of the protocol.

Each cluster has two topics, one per direction, and a third for information only::

    PREFIX/CLUSTER/down      plant to cluster
    PREFIX/CLUSTER/up        cluster to plant
    PREFIX/CLUSTER/status    "online", and as the last will of the cluster "offline"; retained

Messages are sent with QoS 1, never retained, and with their remaining lifetime as message expiry,
so that the broker discards messages that it holds too long. The broker counts in whole seconds, and
not while it is frozen, so the receiver checks again (envelope.py). Sessions begin clean and end
with the connection; nothing is kept for an absent cluster. A retained message on the up or down
topic is not a current command; it is rejected and counted.

Any client that the broker admits may publish to a cluster's topic. The broker is told the size of
the largest envelope and does not forward longer messages; a longer one that arrives anyway is
rejected before anything is computed from it.

Nothing depends on the status, on the last will or on MQTT's keepalive, because a frozen broker
keeps its connections. Our heartbeats pass through the broker to the other end and back, and their
absence ends a connection.

Nagle's algorithm is disabled at this end; the broker needs ``set_tcp_nodelay true``, otherwise it
adds up to 40 ms to a small message.
"""

import asyncio
import contextlib
import logging
import math
import socket
from dataclasses import dataclass

import aiomqtt
import paho.mqtt.client as paho
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.subscribeoptions import SubscribeOptions

from heliotrope.errors import InputError
from heliotrope.links.clock import Clock
from heliotrope.links.connection import CarriedLink
from heliotrope.links.envelope import OVERHEAD, SealKeys
from heliotrope.links.keys import BrokerPassword, KeyRing, ring_of
from heliotrope.links.link import LinkError, LinkLostError, LinkSettings, Statistics
from heliotrope.links.tls import TlsSource, context_of

#: Consecutive messages that the broker may leave unconfirmed before the connection is abandoned. It
#: is below 20, the number from which paho would hold messages back and send them later.
_UNCONFIRMED = 10
#: Time limit for disconnecting cleanly at the end of a connection, in s.
_GOODBYE = 0.5
#: aiomqtt waits without a limit of its own; the link sets the limits (`asyncio.timeout`). Before
#: Python 3.12, `asyncio.wait_for`, which aiomqtt uses for limits, loses a cancellation that arrives
#: at the same instant as the reply. The heartbeat then continued, and a link could not be closed.
_NO_LIMIT = math.inf
#: Maximum number of messages between the socket and the link, which reads them at once.
_WAITING = 1000
#: Bytes of a packet besides topic and payload: header and properties, such as ours.
_ROOM = 256
#: aiomqtt logs a line for each message that does not fit, so a stranger could fill the log.
_LOG = logging.getLogger(f"{__name__}.library")
_LOG.setLevel(logging.ERROR)


@dataclass(frozen=True)
class Broker:
    """Address of the broker, and our credentials there.

    Parameters
    ----------
    host, port
        Address; the port usually is 1883, or 8883 with TLS.
    username, password
        Credentials; None if the broker requires none.
    tls
        TLS context, see `heliotrope.links.tls.client_tls`; None if the connection is unencrypted.
    keepalive_s
        MQTT's own keepalive, in whole seconds. Nothing depends on it; it lets the broker clean up.
    """

    host: str
    port: int = 1883
    username: str | None = None
    password: str | BrokerPassword | None = None
    tls: TlsSource = None
    keepalive_s: int = 60


@dataclass(frozen=True)
class _Ends:
    """Topics and identity of one end of the link."""

    out: str
    into: str
    status: str
    identifier: str


def _ends(prefix: str, cluster: str, *, plant: bool) -> _Ends:
    for name, value in (("prefix", prefix), ("cluster", cluster)):
        if not value or any(sign in value for sign in "+#\0") or value != value.strip("/"):
            raise InputError(
                f"MQTT {name} {value!r} must not be empty, begin or end with a slash, or contain + "
                "or #, which stand for any topic"
            )
    if "/" in cluster:
        raise InputError(f"MQTT cluster {cluster!r}: a name of one level, without a slash")
    topic = f"{prefix}/{cluster}"
    out, into = ("down", "up") if plant else ("up", "down")
    identifier = f"{topic}/{'plant' if plant else 'cluster'}"
    return _Ends(f"{topic}/{out}", f"{topic}/{into}", f"{topic}/status", identifier)


def _word_of(password: str | BrokerPassword | None) -> str | None:
    word = password.word if isinstance(password, BrokerPassword) else password
    return word or None


class _MqttCarrier:
    """Successive connections to the broker, each with a new client.

    A reused client would repeat all unconfirmed messages, too late.
    """

    def __init__(
        self,
        broker: Broker,
        ends: _Ends,
        ring: KeyRing,
        statistics: Statistics,
        settings: LinkSettings,
        *,
        reports: bool,
    ) -> None:
        self._broker = broker
        self._ends = ends
        self._ring = ring
        self._statistics = statistics
        self._limit, self._longest = settings.open_limit, settings.largest + OVERHEAD
        self._reports = reports
        self._client: aiomqtt.Client | None = None
        self._unconfirmed = 0

    def _make(self) -> aiomqtt.Client:
        broker = self._broker
        will = aiomqtt.Will(self._ends.status, b"offline", qos=1, retain=True)
        client = aiomqtt.Client(
            broker.host,
            broker.port,
            username=broker.username,
            password=_word_of(broker.password),
            identifier=self._ends.identifier,
            protocol=aiomqtt.ProtocolVersion.V5,
            will=will if self._reports else None,
            clean_start=True,
            timeout=_NO_LIMIT,
            keepalive=broker.keepalive_s,
            max_queued_incoming_messages=_WAITING,
            properties=_asked_of_broker(self._longest + len(self._ends.into.encode())),
            logger=_LOG,
            tls_context=context_of(broker.tls),
            socket_options=[(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)],
        )
        inner = client._client  # noqa: SLF001 (aiomqtt offers no other way)
        inner.connect_timeout = self._limit  # it runs in a thread, which nothing can end early
        _write_while_open(inner)
        return client

    async def open(self) -> SealKeys:
        """Connect and subscribe."""
        client = self._make()
        try:
            await client.__aenter__()
            await client.subscribe(
                self._ends.into,
                # The retained flag must be kept even on messages forwarded as they are published.
                options=SubscribeOptions(qos=1, noLocal=True, retainAsPublished=True),
            )
            if self._reports:
                await client.publish(self._ends.status, b"online", qos=1, retain=True)
        except (aiomqtt.MqttError, ValueError) as error:
            await _discard(client)
            raise LinkError(
                f"broker {self._broker.host}:{self._broker.port} refuses the connection ({error})"
            ) from None
        except BaseException:
            await _discard(client)
            raise
        self._client = client
        self._unconfirmed = 0
        return lambda: self._ring.keys

    def _connected(self) -> aiomqtt.Client:
        if self._client is None:
            raise LinkLostError("closed")
        return self._client

    async def ready(self) -> None:
        """Return at once, or fail if the broker no longer confirms messages."""
        self._connected()
        if self._unconfirmed >= _UNCONFIRMED:
            raise LinkLostError(f"the broker left {_UNCONFIRMED} messages unconfirmed")

    async def write(self, envelope: bytes, lifetime: float | None) -> None:
        """Publish an envelope, and return once the broker has confirmed it.

        Heartbeats are confirmed as well: they then take the way of the orders, and the link is
        renewed if the broker delivers no more confirmed messages, as after a flood of them.
        """
        properties = None
        if lifetime is not None:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.MessageExpiryInterval = max(1, math.ceil(lifetime))
        client = self._connected()
        self._unconfirmed += 1
        try:
            await client.publish(
                self._ends.out, envelope, qos=1, retain=False, properties=properties
            )
        except aiomqtt.MqttError as error:
            raise LinkLostError(f"the broker did not accept a message ({error})") from None
        self._unconfirmed = 0

    async def read(self) -> bytes:
        """Wait for the next envelope that the broker did not retain."""
        while True:
            try:
                message = await anext(aiter(self._connected().messages))
            except aiomqtt.MqttError as error:
                raise LinkLostError(f"the connection to the broker was lost ({error})") from None
            if message.retain:
                self._statistics.retained += 1
            elif len(message.payload) > self._longest:
                self._statistics.refused += 1
            else:
                return message.payload

    async def close(self) -> None:
        """Disconnect, and notify the broker if it accepts that at once."""
        client, self._client = self._client, None
        if client is None:
            return
        try:
            with contextlib.suppress(aiomqtt.MqttError, TimeoutError):
                async with asyncio.timeout(_GOODBYE):
                    if self._reports:
                        await client.publish(self._ends.status, b"offline", qos=1, retain=True)
                    await client.__aexit__(None, None, None)
        finally:  # even if the link is closed during the disconnection
            await _discard(client)


def _asked_of_broker(longest: int) -> Properties:
    """Return the connection requests to the broker, which limit packets to an envelope's size."""
    properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
    properties.MaximumPacketSize = longest + _ROOM
    return properties


def _write_while_open(client: paho.Client) -> None:
    """Let the loop write for a client, but never to the file descriptor of a closed socket.

    aiomqtt requests the write by file descriptor, and does so later; by then the descriptor may be
    unused, or belong to another connection.
    """
    loop = asyncio.get_running_loop()

    def register(client: paho.Client, userdata: object, sock: "paho.SocketLike") -> None:
        del userdata

        def add() -> None:
            if sock.fileno() >= 0:
                loop.add_writer(sock.fileno(), client.loop_write)

        loop.call_soon_threadsafe(add)

    client.on_socket_register_write = register


def _refuse_socket(client: paho.Client, userdata: object, sock: "paho.SocketLike") -> None:
    del client, userdata
    sock.close()


async def _discard(client: aiomqtt.Client) -> None:
    """Close the remaining parts of a client.

    If aiomqtt stops waiting for the broker's reply or is cancelled, it leaves the socket, its
    callbacks and a task behind, and it has no public way to end them.
    """
    inner = client._client  # noqa: SLF001
    # The connecting thread may still be running; it closes the socket that it obtains.
    inner.on_socket_open = _refuse_socket
    await asyncio.sleep(0)  # let what it has scheduled so far be done now
    inner._sock_close()  # noqa: SLF001
    task = client._misc_task  # noqa: SLF001
    if task is not None:
        task.cancel()
        await asyncio.wait([task])
    # The cause was reported where it occurred; nothing awaits these futures any longer.
    for future in (client._connected, client._disconnected):  # noqa: SLF001
        if future.done() and not future.cancelled():
            future.exception()


def mqtt_link(
    broker: Broker,
    prefix: str,
    cluster: str,
    key: bytes | KeyRing,
    clock: Clock,
    settings: LinkSettings | None = None,
    *,
    plant: bool,
) -> CarriedLink:
    """Return one end of a link through a broker.

    Parameters
    ----------
    broker
        See `Broker`.
    prefix
        Prefix of all topics of a plant, such as "heliotrope/upington".
    cluster
        Name of the cluster, one level of a topic.
    key
        Key shared by both ends, at least 16 bytes; messages under another key are rejected, even if
        the broker admits them. The keys of a ring may change while the link runs.
    clock, settings
        As in `CarriedLink`.
    plant
        Whether this end is the plant's.

    Raises
    ------
    InputError
        If names cannot form a topic, or a key is too short.
    """
    ring = ring_of(cluster, key)
    settings = settings or LinkSettings()
    statistics = Statistics()
    ends = _ends(prefix, cluster, plant=plant)
    carrier = _MqttCarrier(broker, ends, ring, statistics, settings, reports=not plant)
    name = f"cluster {cluster}" if plant else "plant"
    where = f"{name} via {broker.host}:{broker.port}"
    return CarriedLink(where, carrier, clock, settings, statistics)
