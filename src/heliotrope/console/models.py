"""Models of the HTTP API: made from the plant's views, and of requests.

The views of `plant.operations` are frozen dataclasses of plain values and arrays. Their models have
the same names and fields, so each has one description. Unknown numbers (NaN, infinite) are null.
"""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from datetime import datetime
from enum import Enum
from typing import Annotated, Any

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    create_model,
    model_validator,
)

from heliotrope.optics import flux
from heliotrope.plant import lockouts
from heliotrope.plant.operations import views

_MADE: dict[type, type[BaseModel]] = {}


def model_of(view: type) -> type[BaseModel]:
    """Return the model of a view."""
    if view not in _MADE:
        hints = typing.get_type_hints(view)
        fields: dict[str, Any] = {
            f.name: (_type(hints[f.name]), ...) for f in dataclasses.fields(view)
        }
        made = create_model(view.__name__, **fields)
        made.__doc__ = view.__doc__
        _MADE[view] = made
    return _MADE[view]


def _type(hint: Any) -> Any:
    """Return the JSON type of a field's type."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return model_of(typing.cast("type", hint))
    if hint is float:
        return float | None
    if origin is np.ndarray:
        return list[Any]
    if origin is tuple:
        if len(inner) == 2 and inner[1] is Ellipsis:
            return list[_type(inner[0])]  # type: ignore[misc]  # made at run time
        return list[Any]
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return dict[str, _type(inner[1])]  # type: ignore[misc]  # made at run time
    if origin in (typing.Union, types.UnionType):
        kinds = [_type(kind) for kind in inner]
        return typing.Union[tuple(kinds)]  # noqa: UP007 - made at run time
    if hint in (str, int, bool, datetime):
        return hint
    return Any


def plain(value: Any) -> Any:
    """Return the JSON values of views: lists, dictionaries, numbers, text; NaN as None."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Enum):
        return value.name.lower()
    if value is None or isinstance(value, str | bool | int):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, datetime):
        return value.isoformat()
    return str(value)


def points_like(given: Any) -> Any:
    """Return points whose shape is right; the first wrong one is named, not each of 200,000.

    Raises
    ------
    ValueError
        A name or a point of another shape.
    """
    for name, point in given.items() if isinstance(given, dict) else ():
        numbers = isinstance(point, list) and len(point) == 3 and all(map(_bounded, point))
        if not numbers or not 0 < len(name) <= 64:
            raise ValueError(f"{name[:64]}: give east, north and up, m")
    return given


def _bounded(value: Any) -> bool:
    return isinstance(value, int | float) and -1e5 <= value <= 1e5


class Strict(BaseModel):
    """A request, without any further fields."""

    model_config = ConfigDict(extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _few(cls, given: Any) -> Any:
        """Refuse many unknown fields in one error, not in one each."""
        if isinstance(given, dict) and len(given) > len(cls.model_fields) + 5:
            raise ValueError("too many fields")
        return given


Name = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f]+$")]
#: The first wrong one is named: an error for each of 200,000 would take a second and 200 MB.
Names = Annotated[
    list[Name], Field(max_length=200_000, fail_fast=True, description="Names; [] for all.")
]
Words = Annotated[str, Field(max_length=500, pattern=r"^[^\x00-\x1f\x7f]*$")]
Coordinate = Annotated[float, Field(ge=-1e5, le=1e5, allow_inf_nan=False)]
Point = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
#: Points by heliostat, ENU, m.
Points = Annotated[dict[Name, Point], Field(max_length=200_000), BeforeValidator(points_like)]
Place = Annotated[list[float], Field(min_length=3, max_length=3)]
Number = Annotated[float, Field(ge=-2147483648, le=2147483647, allow_inf_nan=False)]


class LogIn(Strict):
    """Name and password."""

    name: Name
    password: Annotated[str, Field(min_length=1, max_length=200)]


class CallerState(BaseModel):
    """The caller: name and role in this plant, and the way of signing in."""

    name: str
    role: str
    by: str = Field(description='"session" or "token"')
    expires: float | None = Field(description="POSIX s")
    csrf: str = Field("", description="Send it as X-CSRF-Token with every change")


class SomeHeliostats(Strict):
    """Some heliostats, or all."""

    heliostats: Names = []


class CommandOrder(SomeHeliostats):
    """A command of the wire with its values, see the table of messages."""

    command: Annotated[str, Field(pattern=r"^[A-Z_]{2,20}$")]
    values: Annotated[list[Number], Field(max_length=8)] = []


class AimOrder(SomeHeliostats):
    """Aim heliostats at a receiver or target by its name, or at points by heliostat, ENU, m."""

    where: Words = ""
    points: Points = {}


class StandbyOrder(Strict):
    """Standby points by heliostat, ENU, m."""

    points: Annotated[Points, Field(min_length=1)]


class GivenReason(Strict):
    """The reason."""

    reason: Words


class EmergencyCall(Strict):
    """Order for the whole field, and the reason."""

    act: Annotated[str, Field(pattern="^(DEFOCUS|STOW)$")] = "DEFOCUS"
    reason: Words = ""


class Acknowledged(Strict):
    """The alarm."""

    condition: Name
    subject: Words = ""


class HoldOrder(SomeHeliostats):
    """Heliostats to take out of service, the reason, and the hours until they are expected back."""

    heliostats: Annotated[list[Name], Field(min_length=1, max_length=200_000)]
    reason: Words
    hours: Annotated[float, Field(gt=0.0, le=8760.0)] | None = None


class GivenBack(Strict):
    """Heliostats to give back to service, each by its name."""

    heliostats: Annotated[list[Name], Field(min_length=1, max_length=200_000)]


class Switch(Strict):
    """On or off."""

    on: bool


class Confirmed(Strict):
    """A change of accounts or tokens, which needs your own password again."""

    own_password: Annotated[str, Field(min_length=1, max_length=200)]


class NewAccount(Confirmed):
    """A new account."""

    name: Name
    role: Annotated[str, Field(pattern="^(viewer|operator|engineer)$")]
    password: Annotated[str, Field(min_length=10, max_length=200)]


class AccountChange(Confirmed):
    """Changes to an account; null: unchanged."""

    role: Annotated[str, Field(pattern="^(viewer|operator|engineer)$")] | None = None
    password: Annotated[str, Field(min_length=10, max_length=200)] | None = None
    disabled: bool | None = None


class OwnPassword(Strict):
    """Your password, and the new one."""

    old: Annotated[str, Field(min_length=1, max_length=200)]
    new: Annotated[str, Field(min_length=10, max_length=200)]


class GivenPassword(BaseModel):
    """A new password of a person; it is shown in this answer only."""

    name: str
    password: str


class NewToken(Confirmed):
    """A token for a program."""

    label: Name
    role: Annotated[str, Field(pattern="^(viewer|operator|engineer)$")]
    days: Annotated[float, Field(gt=0, le=365)] = 30.0


class TicketState(BaseModel):
    """Progress of an accepted command."""

    identity: str
    command: str
    heliostats: int
    counted: dict[str, int] = Field(description="Number of heliostats at each stage")
    finished: bool
    good: bool = Field(description="Whether every heliostat is done")
    text: str
    refusals: dict[str, str] = Field(description="Reasons of the first hundred")


class AuthorityState(BaseModel):
    """Holder of the command authority."""

    holder: str
    role: str
    mine: bool
    lifetime: float = Field(description="Life without renewal, s")


class KeepOutOutline(BaseModel):
    """A keep-out volume, as seen on a map."""

    name: str
    outline: list[tuple[float, float]] = Field(description="East and north of its corners, m")


class FieldDesign(BaseModel):
    """Everything about the field that does not change, in the order of all its rows."""

    plant: str
    names: list[str]
    positions: list[Place] = Field(description="ENU, m")
    clusters: list[str]
    cluster: list[int] = Field(description="Place in clusters")
    size: float = Field(description="Larger side of a mirror, m, the median")
    tower: Place = Field(description="Centre of the receivers, ENU, m")
    receivers: list[str]
    targets: list[str]
    keep_outs: list[KeepOutOutline]
    surfaces: list[str] = Field(description="Places that `on` of a row names")
    states: list[str]
    faults: list[str]


class Problem(BaseModel):
    """Reason of a refusal."""

    detail: str | list[Any]


class CameraReading(BaseModel):
    """Findings of the software in the last photograph of a target."""

    target: str
    version: int = Field(description="Rises with each photograph; 0 before the first")
    at: float | None
    reading: list[str]
    centroid: list[float] | None = Field(description="Right of and above its centre, m")


class AccountState(BaseModel):
    """An account."""

    name: str
    role: str
    disabled: bool
    created: float


class TokenState(BaseModel):
    """A token of a program; its secret is shown once, when it is created."""

    key: str
    name: str
    label: str
    role: str
    created: float
    expires: float | None
    last_used: float | None
    secret: str = ""


def many(model: type[BaseModel]) -> Any:
    """Return the model of a list."""
    return list[model]  # type: ignore[valid-type]  # models of views are made at run time


#: Answers with the data of views.
Summary, SunView = model_of(views.Summary), model_of(views.SunView)
FluxView, HeliostatView = model_of(flux.FluxView), model_of(views.HeliostatView)
ClusterRow, AlarmRow = model_of(views.ClusterRow), model_of(views.AlarmRow)
EventRow, PacketRow = model_of(views.EventRow), model_of(views.PacketRow)
CalibrationView, Planned = model_of(views.CalibrationView), model_of(views.Planned)
Lockout, EmergencyView = model_of(lockouts.Lockout), model_of(views.EmergencyView)
