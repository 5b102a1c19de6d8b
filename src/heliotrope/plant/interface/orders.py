"""Arguments of the calls, validated on arrival: by the console, and again by the plant.

Lists of points are sent as names in the arguments and coordinates in the blob; see `points_of`.
"""

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from heliotrope.errors import InputError
from heliotrope.field.timetable import DAY, LEAST_INTERVAL, MOST, MOST_TIMES
from heliotrope.geometry import FloatArray
from heliotrope.plant.operations.security import SecurityEvent

#: Largest coordinate of a point, m.
_FAR = 1e5


def points_like(given: Any) -> Any:
    """Check the shape of points and return them.

    The error names only the first wrong point, because there may be 200,000.

    Raises
    ------
    ValueError
        If a name or a point has the wrong shape.
    """
    for name, point in given.items() if isinstance(given, dict) else ():
        numbers = isinstance(point, list) and len(point) == 3 and all(map(_bounded, point))
        if not numbers or not 0 < len(name) <= 64:
            raise ValueError(f"{name[:64]}: specify east, north and up in m")
    return given


def _bounded(value: Any) -> bool:
    return isinstance(value, int | float) and -_FAR <= value <= _FAR


class Strict(BaseModel):
    """A request that may have no unknown fields."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _few(cls, given: Any) -> Any:
        """Refuse many unknown fields with one error, not with one error for each."""
        if isinstance(given, dict) and len(given) > len(cls.model_fields) + 5:
            raise ValueError("too many fields")
        return given


#: No control characters, line breaks of any kind, or marks that reverse the order of letters.
_LETTER = r"[^\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069]"
Name = Annotated[str, Field(min_length=1, max_length=64, pattern=f"^{_LETTER}+$")]
#: The first wrong one is named: an error for each of 200,000 would take a second and 200 MB.
Names = Annotated[
    list[Name],
    Field(max_length=200_000, fail_fast=True, description="Names; [] for all heliostats."),
]
Words = Annotated[str, Field(max_length=500, pattern=f"^{_LETTER}*$")]
Coordinate = Annotated[float, Field(ge=-_FAR, le=_FAR, allow_inf_nan=False)]
Point = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
#: Points by heliostat, ENU, m.
Points = Annotated[dict[Name, Point], Field(max_length=200_000), BeforeValidator(points_like)]
Number = Annotated[float, Field(ge=-2147483648, le=2147483647, allow_inf_nan=False)]


class Nothing(Strict):
    """No arguments."""


class Named(Strict):
    """The name of one object."""

    name: Name


class OneCommand(Strict):
    """The identity of a command."""

    identity: Name


Limit = Annotated[int, Field(ge=1, le=2000)]


class Some(Strict):
    """The newest entries, at most `limit`."""

    limit: Limit = 200


Moment = Annotated[float, Field(ge=0, le=1e11, allow_inf_nan=False, description="POSIX s.")]


class Journal(Some):
    """Journal entries, selected by time, kind, person, heliostat and text."""

    since: Moment = 0.0
    until: Moment = 1e11
    kind: Literal["", "event", "alarm", "command", "note"] = ""
    person: Annotated[str, Field(max_length=64)] = ""
    heliostat: Annotated[str, Field(max_length=64)] = ""
    text: Annotated[str, Field(max_length=100)] = ""
    but: Annotated[str, Field(max_length=64, description="Users whose commands are left out.")] = ""


class Period(Strict):
    """A time span; `until` 0: now, and `since` 0: eight hours before `until`."""

    since: Moment = 0.0
    until: Moment = 0.0


class TrendOrder(Period):
    """A quantity over a time span; `until` 0: now, and `since` 0: a day before `until`."""

    quantity: Annotated[str, Field(min_length=1, max_length=100)]
    heliostat: Annotated[str, Field(max_length=64)] = ""
    points: Annotated[int, Field(ge=10, le=5000)] = 1000


class NoteOrder(Strict):
    """A note for other people."""

    text: Annotated[str, Field(min_length=1, max_length=1000, pattern=f"^{_LETTER}*$")]


class SomePackets(Some):
    """The last messages; only messages of one cluster if it is named."""

    cluster: Annotated[str, Field(max_length=64)] = ""


class SomeVisits(Strict):
    """The next visits, at most `limit`."""

    limit: Limit = 20


class Picture(Strict):
    """A target, and the version of its photograph that the client already has."""

    name: Name
    known: int = -1


class OneCalibration(Strict):
    """A heliostat to be calibrated next, and the target ("": any target).

    Options: only search for its beam; or calibrate other heliostats together with it, in one joint
    visit; or measure all of them on the receiver, where their beams are.
    """

    heliostat: Name
    target: Annotated[str, Field(max_length=64)] = ""
    search: bool = False
    together: Annotated[list[Name], Field(max_length=127)] = []
    receiver: bool = False


class OneGroup(Strict):
    """A heliostat group to be learnt now ("": all groups)."""

    group: Annotated[str, Field(max_length=64)] = ""


class TimetableOrderEntry(Strict):
    """Heliostats to calibrate at times of day, at intervals (from midnight UTC), or both."""

    name: Name
    heliostats: Annotated[list[Name], Field(min_length=1, max_length=20_000, fail_fast=True)]
    target: Annotated[str, Field(max_length=64)] = ""
    at: Annotated[
        list[Annotated[str, Field(max_length=20)]],
        Field(max_length=MOST_TIMES, description="Times of day with a time zone, such as 08:30Z."),
    ] = []
    every_s: Annotated[float, Field(ge=LEAST_INTERVAL, le=DAY)] | None = None
    rule: Annotated[
        Literal["", "first", "never"],
        Field(description="Instead of times: automatic control calibrates them first, or never."),
    ] = ""


class TimetableOrder(Strict):
    """The whole timetable to activate; null: the timetable of the plant file."""

    entries: Annotated[list[TimetableOrderEntry], Field(max_length=MOST)] | None


class Reading(Strict):
    """A reading for the safety table, in the unit of its row, and when it was measured, POSIX s."""

    value: Number
    at: Annotated[float, Field(ge=0.0, le=1e11, allow_inf_nan=False)]


class NamedReading(Reading):
    """A `Reading` as the console passes it to the plant, with its name."""

    name: Name


class ParameterOrder(Strict):
    """New error parameters of a heliostat, or an earlier version to restore, and the reason.

    The parameters are keyed by name, in rad, m or 1.
    """

    heliostat: Name
    values: Annotated[dict[Name, Number], Field(max_length=40)] = {}
    version: Annotated[int, Field(ge=0, le=2**31)] = 0
    reason: Annotated[Words, Field(min_length=1)]


class OneEvent(Strict):
    """The number of an event."""

    number: Annotated[int, Field(ge=1, le=2**53)]


class OneChange(Strict):
    """The number of a change that waits for an approval."""

    number: Annotated[int, Field(ge=1, le=2**53)]


class ReasonGiven(Strict):
    """The reason."""

    reason: Annotated[Words, Field(min_length=1)]


class RefusedChange(OneChange, ReasonGiven):
    """The number of a change, and why it is refused."""


#: Longest text of a plant file, characters: a request must fit into a frame however it is escaped.
LONGEST_FILE = 160_000


class PlantFileText(Strict):
    """The text of a plant file (TOML)."""

    text: Annotated[str, Field(min_length=1, max_length=LONGEST_FILE)]


class PlantFileOrder(PlantFileText, ReasonGiven):
    """A new text of the plant file, the version of the text that it replaces, and the reason."""

    version: Annotated[str, Field(max_length=64)]


class TwoVersions(Strict):
    """A heliostat and two versions of its parameters; 0 is the version in the plant file."""

    name: Name
    first: Annotated[int, Field(ge=0, le=2**31)] = 0
    second: Annotated[int, Field(ge=0, le=2**31)] = 0


#: A pixel of a picture, right and down.
PixelOf = Annotated[list[Coordinate], Field(min_length=2, max_length=2)]


class Clicks(Strict):
    """Points clicked in a held picture, and whether the camera is to use them from now on."""

    number: Annotated[int, Field(ge=1, le=2**53)]
    points: Annotated[dict[Name, PixelOf], Field(max_length=200)]
    save: bool = False


class Marks(Clicks):
    """`Clicks` as the console passes them to the plant, with the target."""

    name: Name


class KeptOf(Strict):
    """The newest stored photographs of a heliostat ("": photographs that operators requested)."""

    heliostat: Annotated[str, Field(max_length=64)] = ""
    limit: Limit = 50


class KeptOne(Strict):
    """A stored photograph."""

    identity: Annotated[int, Field(ge=1, le=2**53)]


class Note(Strict):
    """A security event: its name, the person, the address of the caller, and details.

    ``more`` is the number of further events that the console has only counted.
    """

    kind: Annotated[str, Field(pattern=f"^({'|'.join(SecurityEvent.__members__)})$")]
    who: Words
    address: Words
    detail: Words
    more: Annotated[int, Field(ge=0, le=2**53)] = 0


class Use(Strict):
    """How a user of this computer used the records: the name of the event, and details."""

    kind: Annotated[str, Field(pattern="^(BACKED_UP|EXPORTED|QUERIED)$")]
    detail: Words


class Beat(Strict):
    """A sign of life: the part of a console that sends it, and the address where it listens."""

    part: Annotated[str, Field(pattern="^(console|emergency)$")]
    address: Annotated[str, Field(max_length=200)]


class SomeHeliostats(Strict):
    """Some heliostats, or all."""

    heliostats: Names = []


class CommandOrder(SomeHeliostats):
    """A bus command with its values; see the table of messages."""

    command: Annotated[str, Field(pattern=r"^[A-Z_]{2,20}$")]
    values: Annotated[list[Number], Field(max_length=8)] = []


class AimOrder(SomeHeliostats):
    """Aim heliostats at a receiver or target by name, or each at its own point, ENU, m.

    `right` and `up`: a point on the unrolled receiver, in metres from its middle, as seen from
    outside.
    """

    where: Words = ""
    right: Coordinate | None = None
    up: Coordinate | None = None
    points: Points = {}


class StandbyOrder(Strict):
    """Standby points by heliostat, ENU, m."""

    points: Annotated[Points, Field(min_length=1)]


class PointsOrder(SomeHeliostats):
    """An `AimOrder` or `StandbyOrder` as passed to the plant; the blob holds the points."""

    where: Words = ""
    right: Coordinate | None = None
    up: Coordinate | None = None
    points: Names = []


class GivenReason(Strict):
    """The reason."""

    reason: Words


class EmergencyCall(Strict):
    """An emergency order for the whole field, and the reason."""

    act: Annotated[str, Field(pattern="^(DEFOCUS|STOW)$")] = "DEFOCUS"
    reason: Words = ""
    call: Annotated[
        str,
        Field(
            max_length=64,
            description="A random identifier; if the same order is sent "
            "again, it is carried out only once.",
        ),
    ] = ""


class Withdrawal(Strict):
    """Whose emergency order to withdraw: "" for one's own; engineers may name another owner."""

    owner: Words = ""


class Acknowledged(Strict):
    """The alarm to acknowledge."""

    condition: Name
    subject: Words = ""


class _Places(SomeHeliostats):
    """Heliostats, targets and receivers by name, or the tower; at least one object."""

    targets: Names = []
    receivers: Names = []
    tower: bool = False

    @model_validator(mode="after")
    def _named(self) -> Self:
        if not (self.heliostats or self.targets or self.receivers or self.tower):
            raise ValueError("no object is named; name heliostats, targets, receivers or the tower")
        return self


class HoldOrder(_Places):
    """What to take out of service, the reason, and the expected duration in hours."""

    reason: Words
    hours: Annotated[float, Field(gt=0.0, le=8760.0)] | None = None


class GivenBack(_Places):
    """What to return to service; an engineer may name the ``owner`` whose lock is removed."""

    owner: Words = ""
    reason: Words = ""


class Switch(Strict):
    """On or off."""

    on: bool


def pack_points(order: AimOrder | StandbyOrder) -> tuple[dict[str, Any], bytes]:
    """Return the arguments and the blob of a `PointsOrder`."""
    given = order.model_dump(exclude={"points"})
    blob = np.array(list(order.points.values()), "<f8").tobytes()
    return given | {"points": list(order.points)}, blob


def points_of(order: PointsOrder, blob: bytes) -> dict[str, FloatArray]:
    """Return the points by heliostat, ENU, m.

    Raises
    ------
    InputError
        If there is not exactly one point for each name, or a point is not on the site.
    """
    if len(blob) != 24 * len(order.points):
        raise InputError(f"points: {len(blob)} bytes for {len(order.points)} heliostats")
    found = np.frombuffer(blob, "<f8").reshape(-1, 3)
    if not (np.isfinite(found).all() and (np.abs(found) <= _FAR).all()):
        raise InputError(f"points: a coordinate is not a number within {_FAR:g} m")
    return dict(zip(order.points, found, strict=True))
