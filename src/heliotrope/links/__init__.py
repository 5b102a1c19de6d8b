"""Links between the plant and its clusters: a message arrives in time or not at all.

`Link` is the protocol of one end of a link; its module ``link`` states the guarantees.
`CarriedLink` is the only implementation. It runs over a `Carrier`: within one process
(`memory_pair`), over TCP (`tcp_link`, `TcpServer`) or through an MQTT broker (module ``mqtt``,
which needs the extra ``control``). `Conversation` seals each message in an envelope that bounds its
age without a common clock.

`encode` and `decode` convert messages (`Lease`, `Command`, `ClusterStatus`, …) to bytes and back. A
`TappedLink` passes the messages of any link to a listener.

`Clock` is the time base of every limit; `run_virtual` runs a program in virtual time.

Begin with `Link` and `memory_pair`.
"""

from heliotrope.links.addresses import url_parts
from heliotrope.links.clock import (
    Clock,
    SystemClock,
    VirtualClock,
    VirtualLoop,
    gps_seconds,
    gps_week,
    leap_seconds,
    run_virtual,
    sleep_until,
    utc_of_gps,
    utc_of_week,
)
from heliotrope.links.connection import CarriedLink, Carrier
from heliotrope.links.envelope import Conversation
from heliotrope.links.in_process import Faults, MemoryLine, memory_pair
from heliotrope.links.keys import KeyRing, Keys
from heliotrope.links.link import (
    Backoff,
    Bus,
    Heartbeat,
    Inbox,
    Link,
    LinkClosedError,
    LinkError,
    LinkLostError,
    LinkSettings,
    SendOutcome,
    Statistics,
    received,
    running,
    until_closed,
)
from heliotrope.links.messages import (
    Acknowledge,
    Answer,
    Ask,
    ClusterStatus,
    Command,
    Emergency,
    Lease,
    Message,
    Parameters,
    Progress,
    ProtocolError,
    Stage,
    decode,
    encode,
)
from heliotrope.links.tapped import LinkListener, TappedLink
from heliotrope.links.tcp import TcpServer, tcp_link
from heliotrope.links.tls import RenewedTls, client_tls, server_tls

__all__ = [
    "Acknowledge",
    "Answer",
    "Ask",
    "Backoff",
    "Bus",
    "CarriedLink",
    "Carrier",
    "Clock",
    "ClusterStatus",
    "Command",
    "Conversation",
    "Emergency",
    "Faults",
    "Heartbeat",
    "Inbox",
    "KeyRing",
    "Keys",
    "Lease",
    "Link",
    "LinkClosedError",
    "LinkError",
    "LinkListener",
    "LinkLostError",
    "LinkSettings",
    "MemoryLine",
    "Message",
    "Parameters",
    "Progress",
    "ProtocolError",
    "RenewedTls",
    "SendOutcome",
    "Stage",
    "Statistics",
    "SystemClock",
    "TappedLink",
    "TcpServer",
    "VirtualClock",
    "VirtualLoop",
    "client_tls",
    "decode",
    "encode",
    "gps_seconds",
    "gps_week",
    "leap_seconds",
    "memory_pair",
    "received",
    "run_virtual",
    "running",
    "server_tls",
    "sleep_until",
    "tcp_link",
    "until_closed",
    "url_parts",
    "utc_of_gps",
    "utc_of_week",
]
