"""Models of the HTTP API: models of the plant's views, and models of requests about accounts.

The models for orders are in `plant.interface.orders`, because the plant checks them again.

The plant's views are frozen dataclasses of plain values and arrays. Their models have the same
names and fields, so each has only one description. Unknown numbers (NaN, infinite) are null.
"""

import dataclasses
import types
import typing
from collections.abc import Mapping
from datetime import datetime
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, create_model

from heliotrope.plant.interface.orders import Name, Strict
from heliotrope.store.people import LONGEST_NAME

_MADE: dict[type, type[BaseModel]] = {}


def model_of(view: type) -> type[BaseModel]:
    """Return the model of a view."""
    if view not in _MADE:
        hints = typing.get_type_hints(view)
        fields: dict[str, Any] = {
            f.name: (json_type(hints[f.name]), ...) for f in dataclasses.fields(view)
        }
        made = create_model(view.__name__, **fields)
        made.__doc__ = view.__doc__
        _MADE[view] = made
    return _MADE[view]


def json_type(hint: Any) -> Any:
    """Return the type that describes the JSON form of a value of a given type."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return model_of(typing.cast("type", hint))
    if hint is float:
        return float | None
    if origin is np.ndarray:
        return list[Any]
    if origin is tuple:
        alike = len(set(inner) - {Ellipsis}) == 1
        return list[json_type(inner[0]) if alike else Any]  # type: ignore[misc]  # at run time
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return dict[str, json_type(inner[1])]  # type: ignore[misc]  # made at run time
    if origin in (typing.Union, types.UnionType):
        kinds = [json_type(kind) for kind in inner]
        return typing.Union[tuple(kinds)]  # noqa: UP007 - made at run time
    if hint in (str, int, bool, datetime):
        return hint
    return Any


AccountName = Annotated[
    str, Field(min_length=1, max_length=LONGEST_NAME, pattern=r"^[^\x00-\x1f\x7f]+$")
]
Code = Annotated[str, Field(max_length=40)]


class LogIn(Strict):
    """Name and password, and the code of a second factor if the account has one."""

    name: AccountName
    password: Annotated[str, Field(min_length=1, max_length=200)]
    code: Code = ""


class CallerState(BaseModel):
    """The caller: name and role in this plant, and the way of signing in."""

    name: str
    role: str
    by: str = Field(description='"session" or "token"')
    expires: float | None = Field(description="POSIX s")
    csrf: str = Field("", description="Send it as X-CSRF-Token with every change")
    owes: str = Field(
        "", description='What is due before anything else: "password", "factor" or ""'
    )
    factor: bool = Field(False, description="Whether the account has a second factor")
    no_password: bool = Field(False, description="Whether the account has no password yet")
    session_hours: float = Field(0.0, description="Length of a session, see --session")
    idle_minutes: float = Field(
        0.0, description="Time after which a command needs the password again; 0: never"
    )
    sign_ins_per_hour: int = Field(
        0,
        description=(
            "Failed sign-ins for one name from one address after which further attempts must wait"
        ),
    )


class Confirmed(Strict):
    """A change of accounts or tokens, which requires your own password again."""

    own_password: Annotated[str, Field(min_length=1, max_length=200)]


class ConfirmedTwice(Confirmed):
    """A change that requires your own password and, if active, a code of your second factor."""

    own_code: Code = ""


class FactorCode(Strict):
    """A code of a second factor."""

    code: Code


class NewFactor(BaseModel):
    """The secret of a second factor, which is shown only in this response."""

    secret: str = Field(description="Base32")
    uri: str = Field(description="The secret as an authenticator reads it")
    qr: str = Field(description="The same as a QR code: a data URI with SVG")


class RecoveryCodes(BaseModel):
    """Codes that each replace a second-factor code once; shown only in this response."""

    codes: list[str]


class NewAccount(Confirmed):
    """A new account."""

    name: AccountName
    role: Annotated[str, Field(pattern="^(viewer|operator|engineer)$")]
    password: Annotated[str, Field(min_length=10, max_length=200)]


class AccountChange(Confirmed):
    """Changes to an account; null leaves a field unchanged."""

    role: Annotated[str, Field(pattern="^(viewer|operator|engineer)$")] | None = None
    password: Annotated[str, Field(min_length=10, max_length=200)] | None = None
    disabled: bool | None = None


class OwnPassword(Strict):
    """Your password (empty if your account has none yet), and your new password."""

    old: Annotated[str, Field(max_length=200)]
    new: Annotated[str, Field(min_length=10, max_length=200)]


class GivenPassword(BaseModel):
    """A user's new password, which is shown only in this response."""

    name: str
    password: str


class NewToken(Confirmed):
    """A token for a program."""

    label: Name
    role: Annotated[str, Field(pattern="^(viewer|operator|engineer)$")]
    days: Annotated[float, Field(gt=0, le=365)] = 30.0


class Problem(BaseModel):
    """The reason for a refusal."""

    detail: str | list[Any]


class AccountState(BaseModel):
    """An account."""

    name: str
    role: str
    disabled: bool
    created: float
    factor: bool = Field(description="Whether it has a second factor")


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
