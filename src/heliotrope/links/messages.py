"""Messages between the plant and its clusters, sent over a `Link`.

A message is one line of JSON, a newline, and a block of bytes (empty except in STATUS and
PARAMETERS). The line contains the kind and the fields. Unknown fields are ignored, so that a newer
plant can talk to an older cluster; an unknown kind is rejected by name.

Plant to cluster: `Lease`, `Command`, `Emergency`, `Parameters`, `Ask`, `Acknowledge`.
Cluster to plant: `ClusterStatus`, `Progress`, `Alarm`, `Answer`.

Every message that moves a beam towards the receiver carries the token of the command authority and
is sent with a link expiry; `Emergency` needs neither, and is accepted from any sender.
"""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from heliotrope.errors import HeliotropeError
from heliotrope.safety import Alarm, Severity

VERSION = 1

#: Header of each entry in a bus recording: seconds since its beginning; sent (0) or received (1) by
#: the cluster; number of bytes.
BUS_ENTRY = "<fBH"
BUS_SENT, BUS_RECEIVED = 0, 1

#: One row per heliostat of a cluster, in the order of its configuration. ``heard_ms`` is the age of
#: its STATUS when the row was written (2^32 - 1: none has arrived, and the row is meaningless);
#: states and flags as in `lcu.names`. ``steps_ms`` is the age of its step counts and goals, which
#: may be requested less often.
NODE = np.dtype(
    [
        ("state", "u1"),
        ("fault", "u1"),
        ("flags", "<u4"),
        ("heard_ms", "<u4"),
        ("primary", "<i4"),
        ("secondary", "<i4"),
        ("primary_goal", "<i4"),
        ("secondary_goal", "<i4"),
        ("sun_age_ms", "<u4"),
        ("supply_mv", "<u2"),
        ("temperature_degc", "i1"),
        ("boots", "<u2"),
        ("armature_crc", "<u4"),
        ("asked", "<u4"),
        ("answered", "<u4"),
        ("steps_ms", "<u4"),
    ]
)
NEVER = 0xFFFFFFFF


class ProtocolError(HeliotropeError):
    """The bytes are not a message, or this side does not know the message."""


class Stage(Enum):
    """Stage of a command at one heliostat; the last three stages are final."""

    ACCEPTED = "accepted"  # by the cluster
    SENT = "sent"  # on the bus
    ACKNOWLEDGED = "acknowledged"  # by the local controller
    DONE = "done"  # the requested state is reached
    REFUSED = "refused"
    FAILED = "failed"  # never acknowledged, or expired


@dataclass(frozen=True)
class Lease:
    """Shows that the plant is present, and permits commands under its token (0: no commands).

    The cluster may continue for ``lifetime`` s after the arrival of the lease, and for another
    ``autonomy`` s. The lease's expiry on the link limits its time in transit. ``run`` identifies
    one start of one plant; it is "" from an older plant.
    """

    kind: ClassVar[str] = "lease"
    token: int
    lifetime: float = 3.0
    autonomy: float = 0.0
    run: str = ""


@dataclass(frozen=True)
class Command:
    """A bus command, by its name and values, for named heliostats, () for all.

    ``identity`` is repeated in every `Progress`. ``lifetime`` in s counts from the arrival at the
    cluster; the command arrives before its link expiry, or not at all.
    """

    kind: ClassVar[str] = "command"
    identity: str
    name: str
    values: tuple[float, ...] = ()
    heliostats: tuple[str, ...] = ()
    token: int = 0
    lifetime: float = 10.0


@dataclass(frozen=True)
class Emergency:
    """DEFOCUS or STOW for named heliostats, () for all.

    It is accepted from any sender, and has priority.
    """

    kind: ClassVar[str] = "emergency"
    identity: str
    name: str
    heliostats: tuple[str, ...] = ()


@dataclass(frozen=True)
class Parameters:
    """Items to be stored in the journal of one heliostat (`lcu.journal.ITEMS`).

    ``sizes`` are the sizes of the items in ``block``; ``lifetime`` is as in `Command`.
    """

    kind: ClassVar[str] = "parameters"
    identity: str
    heliostat: str
    names: tuple[str, ...]
    sizes: tuple[int, ...]
    token: int = 0
    lifetime: float = 30.0
    block: bytes = b""

    @classmethod
    def of(
        cls, identity: str, heliostat: str, items: Mapping[str, bytes], token: int
    ) -> "Parameters":
        """Return the message for items that are given by name."""
        names = tuple(items)
        sizes = tuple(len(items[name]) for name in names)
        block = b"".join(items.values())
        return cls(identity, heliostat, names, sizes, token, block=block)

    def items(self) -> dict[str, bytes]:
        """Return the items by name.

        Raises
        ------
        ProtocolError
            If names, sizes and block are inconsistent.
        """
        if len(self.names) != len(self.sizes) or sum(self.sizes) != len(self.block):
            raise ProtocolError(
                f"parameters of {self.heliostat}: {len(self.names)} names, sizes {self.sizes}, "
                f"{len(self.block)} bytes do not fit together"
            )
        result, place = {}, 0
        for name, size in zip(self.names, self.sizes, strict=True):
            result[name] = self.block[place : place + size]
            place += size
        return result


@dataclass(frozen=True)
class Ask:
    """A query.

    The kinds of query are ``checksums``, ``stored`` and ``diagnosis`` (for a heliostat),
    ``statistics``, ``discover`` and ``frames``. The reply to ``diagnosis`` is the ``result`` of the
    last motion diagnosis (`lcu.diagnosis`). The reply to ``statistics`` names all heliostats in the
    order of the rows of `ClusterStatus`. The reply to ``frames``, a record of the bus traffic, is
    sent when the requested time or number of frames is reached; its block contains a `BUS_ENTRY`
    and the bytes of each frame.
    """

    kind: ClassVar[str] = "ask"
    identity: str
    what: str
    heliostat: str = ""


@dataclass(frozen=True)
class Acknowledge:
    """An operator's acknowledgement of a latched row of the cluster's safety table.

    An `Alarm` shows such a row. ``role`` is the name of a `safety.AcknowledgeRole`. `Progress`
    reports DONE, or REFUSED with the reason.
    """

    kind: ClassVar[str] = "acknowledge"
    identity: str
    condition: str
    who: str
    role: str


@dataclass(frozen=True)
class ClusterStatus:
    """State of the cluster and all its heliostats, sent once per second.

    ``names``, in the order of the rows, is sent in the first message of a connection and in every
    tenth message after that, as any message may be lost; otherwise it is (). ``utc_s`` is the
    cluster's own time (POSIX seconds), ``time_error_s`` the bound on its error. ``site`` contains
    the `Site.numbers` for which the cluster computes the sun vector; it is () from an older
    cluster. ``settings`` is the checksum of the settings that all clusters should share, eight
    hexadecimal digits (`links.common_settings`); it is "" from an older cluster. ``lease_left`` is
    in s; below 0 the plant's lease has expired. ``cycle_s`` is the duration of the last poll cycle.
    ``run`` is the plant run that the cluster belongs to, ``barred`` lists the runs that get no
    lease. A status with names also lists the active ``alarms`` of the cluster, each as "condition
    subject", and ``alarms_listed`` is true; an alarm that is not listed has cleared, even if the
    clearing message was lost. In the same way it lists, with ``commands_listed``, the identities of
    the ``commands`` that were acknowledged and have not ended.
    """

    kind: ClassVar[str] = "status"
    cluster: str
    count: int
    utc_s: float
    time_quality: str
    time_error_s: float
    lease_left: float
    cycle_s: float
    acts: tuple[str, ...] = ()
    names: tuple[str, ...] = ()
    block: bytes = b""
    site: tuple[float, ...] = ()
    run: str = ""
    barred: tuple[str, ...] = ()
    alarms: tuple[str, ...] = ()
    alarms_listed: bool = False
    settings: str = ""
    commands: tuple[str, ...] = ()
    commands_listed: bool = False

    def nodes(self) -> "npt.NDArray[Any]":
        """Return the rows, of dtype `NODE`, read-only.

        Raises
        ------
        ProtocolError
            If the block is not a whole number of rows.
        """
        if len(self.block) % NODE.itemsize:
            raise ProtocolError(
                f"status of {self.cluster}: {len(self.block)} bytes are not rows of {NODE.itemsize}"
            )
        return np.frombuffer(self.block, dtype=NODE)


@dataclass(frozen=True)
class Progress:
    """A stage that a command has reached; ``text`` states why it was refused or failed.

    Without a heliostat, the stage concerns the whole command.
    """

    kind: ClassVar[str] = "progress"
    identity: str
    stage: Stage
    heliostats: tuple[str, ...] = ()
    text: str = ""


@dataclass(frozen=True)
class Answer:
    """The reply to an `Ask`; ``data`` is plain JSON, ``block`` contains stored bytes."""

    kind: ClassVar[str] = "answer"
    identity: str
    data: Mapping[str, Any] = field(default_factory=dict)
    block: bytes = b""


Message = (
    Lease
    | Command
    | Emergency
    | Parameters
    | Ask
    | Acknowledge
    | ClusterStatus
    | Progress
    | Alarm
    | Answer
)
_KINDS: dict[str, type[Any]] = {
    message.kind: message
    for message in (
        Lease,
        Command,
        Emergency,
        Parameters,
        Ask,
        Acknowledge,
        ClusterStatus,
        Progress,
        Alarm,
        Answer,
    )
}


def encode(message: Message) -> bytes:
    """Return the bytes of a message."""
    fields: dict[str, Any] = {"kind": message.kind, "version": VERSION}
    for name, _, _ in _FIELDS[message.kind]:
        value = getattr(message, name)
        fields[name] = value.value if isinstance(value, Stage) else value
    return _ENCODER.encode(fields).encode() + b"\n" + getattr(message, "block", b"")


def decode(data: bytes) -> Message:
    """Return the message encoded in given bytes.

    Raises
    ------
    ProtocolError
        If the bytes are not a message, or this side does not know its kind or version.
    """
    line, _, block = data.partition(b"\n")
    try:
        fields = _DECODER.decode(line.decode())
    except (ValueError, RecursionError):
        raise ProtocolError(f"message of {len(data)} bytes does not begin with JSON") from None
    if not isinstance(fields, dict) or fields.get("version") != VERSION:
        version = fields.get("version") if isinstance(fields, dict) else None
        raise ProtocolError(f"message of version {version!r}; this side speaks {VERSION}")
    kind = _KINDS.get(str(fields.get("kind")))
    if kind is None:
        raise ProtocolError(f"message of unknown kind {fields.get('kind')!r}")
    values: dict[str, Any] = {"block": block} if hasattr(kind, "block") else {}
    for name, expected, read in _FIELDS[kind.kind]:
        if name in fields:
            value = values[name] = read(fields[name])
            if value is None:
                received = fields[name]
                raise ProtocolError(f"{kind.kind}: {name} is {received!r:.60}, not {expected}")
    try:
        message: Message = kind(**values)
    except TypeError as error:
        raise ProtocolError(f"{kind.kind}: {error}") from None
    return message


def _no_number(text: str) -> float:
    raise ValueError(text)


# The tables below are created once, because each cluster sends and receives several messages a
# second.
_ENCODER = json.JSONEncoder(separators=(",", ":"), allow_nan=False)
_DECODER = json.JSONDecoder(parse_constant=_no_number)


def _is_whole(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: object) -> bool:
    try:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        return number and math.isfinite(float(value))  # type: ignore[arg-type]
    except OverflowError:
        return False


def _list_of(good: Callable[[object], bool]) -> Callable[[Any], Any]:
    return lambda value: tuple(value) if isinstance(value, list) and all(map(good, value)) else None


def _is_text(value: object) -> bool:
    return isinstance(value, str)


#: For each field type: a function that converts its JSON value, None if the type is wrong.
_READERS: dict[Any, Callable[[Any], Any]] = {
    Stage: lambda value: next((stage for stage in Stage if stage.value == value), None),
    Severity: lambda value: Severity.read(value) if isinstance(value, str) else None,
    str: lambda value: value if isinstance(value, str) else None,
    bool: lambda value: value if isinstance(value, bool) else None,
    int: lambda value: value if _is_whole(value) else None,
    float: lambda value: float(value) if _is_number(value) else None,
    tuple[str, ...]: _list_of(_is_text),
    tuple[int, ...]: _list_of(_is_whole),
    tuple[float, ...]: _list_of(_is_number),
    Mapping[str, Any]: lambda value: value if isinstance(value, dict) else None,
}
#: For each kind: names, types and converters of the fields in its line.
_FIELDS: dict[str, tuple[tuple[str, Any, Callable[[Any], Any]], ...]] = {
    kind: tuple(
        (field.name, field.type, _READERS[field.type])
        for field in dataclasses.fields(of)
        if field.name != "block"
    )
    for kind, of in _KINDS.items()
}
