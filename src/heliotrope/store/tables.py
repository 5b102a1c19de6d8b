"""The database tables, for both SQLite and PostgreSQL, and their column types.

Times are POSIX seconds (UTC), angles rad, lengths m. The single writing process numbers the rows
(see `keeper`), so a row written twice is stored once.

A column has the name of the field that it stores, or that name as its ``key``. Its type converts
the value, so a field is read back exactly as it was written (see `_rows`).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any

import numpy as np
from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    CheckConstraint,
    Column,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Index,
    Integer,
    MetaData,
    Table,
    Text,
    TypeDecorator,
)
from sqlalchemy.engine import Dialect

from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.record import CalibrationOutcome, Provenance
from heliotrope.geometry import FloatArray
from heliotrope.safety import Severity
from heliotrope.store.records import Kind

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(column_0_N_label)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)
#: SQLite accepts only INTEGER for the row number itself.
Number = BigInteger().with_variant(Integer, "sqlite")


def _finite(value: float | None) -> float | None:
    """Return a float as it is stored; None if it is not finite."""
    return float(value) if value is not None and math.isfinite(value) else None


def _figure(value: float | None) -> float:
    """Return a float as it is read; NaN if None was stored."""
    return math.nan if value is None else value


class _Converted(TypeDecorator[Any], ABC):
    """A type that converts each value as it is written and as it is read."""

    impl: Any = Text

    def process_bind_param(self, value: Any, dialect: Dialect) -> Any:  # noqa: ARG002 - SQLAlchemy gives it
        """Return a value in the form in which the database stores it."""
        return self._written(value)

    def process_result_value(self, value: Any, dialect: Dialect) -> Any:  # noqa: ARG002 - SQLAlchemy gives it
        """Return a value in the form in which a record contains it."""
        return self._read(value)

    @abstractmethod
    def _written(self, value: Any) -> Any: ...

    @abstractmethod
    def _read(self, value: Any) -> Any: ...


class Figure(_Converted):
    """A float; a non-finite float is stored as NULL, and NULL is read as NaN."""

    impl = Double
    cache_ok = True

    def _written(self, value: float | None) -> float | None:
        return _finite(value)

    def _read(self, value: float | None) -> float:
        return _figure(value)


class FiguresByName(_Converted):
    """Floats by name, as a JSON object; non-finite floats become null, and null is read as NaN."""

    impl = JSON
    cache_ok = True

    def _written(self, value: Mapping[str, float]) -> dict[str, float | None]:
        return {str(name): _finite(x) for name, x in value.items()}

    def _read(self, value: Mapping[str, float | None]) -> dict[str, float]:
        return {name: _figure(x) for name, x in value.items()}


class Figures(_Converted):
    """An array of floats with a given number of axes, as nested JSON lists."""

    impl = JSON
    cache_ok = True

    def __init__(self, axes: int = 1) -> None:
        super().__init__()
        self.axes = axes

    def _written(self, value: FloatArray) -> Any:
        return value.tolist()

    def _read(self, value: list[Any]) -> FloatArray:
        # The JSON list of an empty array retains only one of its axes.
        return np.array(value, np.float64) if value else np.zeros((0,) * self.axes)


class Items(_Converted):
    """A tuple of values of one kind, as a JSON list."""

    impl = JSON
    cache_ok = True

    def __init__(self, kind: Callable[[Any], Any]) -> None:
        super().__init__()
        self.kind = kind

    def _written(self, value: Iterable[Any]) -> list[Any]:
        return [self.kind(item) for item in value]

    def _read(self, value: list[Any]) -> tuple[Any, ...]:
        return tuple(value)


class Name(_Converted):
    """A member of an enum, stored as its name in lower case."""

    cache_ok = True

    def __init__(self, kind: type[Enum]) -> None:
        super().__init__()
        self.kind = kind

    def _written(self, value: Any) -> str:
        return self.kind(value).name.lower()

    def _read(self, value: str) -> Enum:
        return self.kind[value.upper()]


class SeverityRank(_Converted):
    """A severity, stored as its rank, so that the database can compare severities."""

    impl = Integer
    cache_ok = True

    def _written(self, value: str) -> int:
        return Severity(value).rank

    def _read(self, value: int) -> Severity:
        return tuple(Severity)[value]


def _number() -> "Column[int]":
    return Column("number", Number, primary_key=True, autoincrement=False)


def _text(name: str, *, key: bool = False) -> "Column[str]":
    return Column(name, Text, nullable=False, primary_key=key)


def _real(name: str, *, needed: bool = False) -> "Column[float]":
    return Column(name, Double, nullable=not needed)


def _figure_of(name: str, key: str | None = None) -> "Column[float]":
    return Column(name, Figure, key=key)


about = Table("about", metadata, _text("name", key=True), _text("value"))

sighting = Table(
    "sighting",
    metadata,
    _number(),
    _text("heliostat"),
    _text("kind"),
    _text("target"),
    _text("campaign"),
    _figure_of("time"),
    Column("counts", JSON, nullable=False),
    *(
        _real(f"{end}_{axis}", needed=True)
        for end in ("source", "destination")
        for axis in ("east", "north", "up")
    ),
    *(Column(f"{end}_at_infinity", Boolean, nullable=False) for end in ("source", "destination")),
    _real("sigma", needed=True),
    *(Column(f"{end}_covariance", JSON(none_as_null=True)) for end in ("source", "destination")),
    Index(None, "heliostat", "time"),
    Index(None, "campaign"),
)

parameter_version = Table(
    "parameter_version",
    metadata,
    _text("heliostat", key=True),
    Column("version", Integer, primary_key=True, autoincrement=False),
    _real("at", needed=True),
    _text("model"),
    Column("names", Items(str), nullable=False),
    Column("value", Figures, key="values", nullable=False),
    Column("covariance", Figures(axes=2), nullable=False),
    Column("prior", Figures, nullable=False),
    _figure_of("error_before", key="before"),
    _figure_of("error_after", key="after"),
    _figure_of("scale"),
    Column("outcome", Name(FitOutcome), nullable=False),
    _text("person"),
    _text("campaign"),
    _text("note"),
    Column("pushed", Items(str), nullable=False),
    _text("code"),
    Column("provenance", Name(Provenance), nullable=False),
)

#: The sightings behind versions. A row applies from one version until before another (NULL: to the
#: last one). It says whether these versions use the sighting, and the residual in the first of
#: them.
parameter_sighting = Table(
    "parameter_sighting",
    metadata,
    _text("heliostat", key=True),
    Column(
        "sighting", Number, ForeignKey(sighting.c.number), primary_key=True, autoincrement=False
    ),
    Column("version", Integer, primary_key=True, autoincrement=False),
    Column("until", Integer),
    *(_figure_of(f"{when}_{side}") for when in ("before", "after") for side in ("right", "above")),
    Column("used", Boolean, nullable=False),
    ForeignKeyConstraint(
        ["heliostat", "version"], [parameter_version.c.heliostat, parameter_version.c.version]
    ),
)

campaign = Table(
    "campaign",
    metadata,
    _text("name", key=True),
    _real("begun", needed=True),
    _real("finished"),
    _text("model"),
    _text("note"),
    Column("expected", FiguresByName, nullable=False),
    Column("found", FiguresByName, nullable=False),
)

#: Imported flights, with the document exactly as in its file. Their sightings are stored among the
#: others, with the flight as their campaign.
flight = Table(
    "flight",
    metadata,
    _text("name", key=True),
    _real("at", needed=True),
    _text("person"),
    _text("document"),
)

#: What was learnt about each heliostat group, version by version.
learning = Table(
    "learning",
    metadata,
    _text("group", key=True),
    Column("version", Integer, primary_key=True, autoincrement=False),
    _real("at", needed=True),
    _text("person"),
    Column("heliostats", Integer, nullable=False),
    Column("sightings", Integer, nullable=False),
    _real("gain", needed=True),
    _text("document"),
)

#: Calibration timetables that operators have activated.
timetable = Table(
    "timetable",
    metadata,
    Column("at", Double, primary_key=True),
    _text("person"),
    _text("document"),
)

#: Predictions of the field errors, as JSON.
outlook = Table(
    "outlook",
    metadata,
    Column("at", Double, primary_key=True, key="made"),
    _text("document"),
)

#: Values for the whole plant, one row per minute.
figures = Table(
    "figures",
    metadata,
    Column("at", Double, primary_key=True),
    Column("values", FiguresByName, nullable=False),
)

visit = Table(
    "visit",
    metadata,
    _number(),
    _text("heliostat"),
    _text("target"),
    _real("begun", needed=True),
    _real("finished", needed=True),
    Column("good", Boolean, nullable=False),
    _text("text"),
    *(
        _figure_of(name)
        for name in (
            "gain",
            "sigma_before",
            "sigma_expected",
            "sigma_after",
            "error_before",
            "error_after",
        )
    ),
    Column("sightings", Integer, nullable=False),
    Column("version", Integer, nullable=False),
    _text("campaign"),
    Column("outcome", Name(CalibrationOutcome), nullable=False),
    Index(None, "heliostat"),
)

#: Empty, because no version has written to it; the next migration that is needed anyway may drop
#: it.
plan = Table(
    "plan",
    metadata,
    Column("place", Integer, primary_key=True, autoincrement=False),
    _text("heliostat"),
    _text("target"),
    Column("due", Double, nullable=False, key="at"),
    _figure_of("gain"),
    Column("note", Text, nullable=False, key="reason"),
)

hold = Table(
    "hold",
    metadata,
    _number(),
    Column("kind", Name(Kind), nullable=False),
    _text("name"),
    _text("reason"),
    Column("person", Text, nullable=False, key="who"),
    _real("since", needed=True),
    _figure_of("until"),
    _real("ended"),
    _text("ended_by"),
)
Index(
    "uq_hold_standing",
    hold.c.kind,
    hold.c.name,
    hold.c.who,
    unique=True,
    sqlite_where=hold.c.ended.is_(None),
    postgresql_where=hold.c.ended.is_(None),
)

event = Table(
    "event",
    metadata,
    _number(),
    _real("at", needed=True),
    _text("source"),
    Column("severity", SeverityRank, nullable=False),
    _text("heliostat"),
    _text("text"),
    Column("values", FiguresByName, nullable=False),
    Index(None, "at"),
    Index(None, "heliostat"),
)

alarm = Table(
    "alarm",
    metadata,
    _number(),
    _text("condition"),
    _text("subject"),
    Column("severity", Name(Severity), nullable=False),
    _text("text"),
    _real("raised", needed=True),
    _real("cleared"),
    _real("acknowledged"),
    _text("acknowledged_by"),
    Index(None, "condition", "subject"),
)

audit = Table(
    "audit",
    metadata,
    _text("identity", key=True),
    Column("number", Number, nullable=False, unique=True),
    _text("who"),
    _text("role"),
    _text("what"),
    _text("at"),
    Column("values", Items(float), nullable=False),
    Column("heliostats", Items(str), nullable=False),
    _text("note"),
    _text("result"),
    _text("finished"),
)

#: One link for each event, two for each audit record (acceptance and result), and one for each
#: change of an account or token; see `chain`.
event_link = Table("event_link", metadata, _number(), _text("digest"))
audit_link = Table(
    "audit_link", metadata, _number(), _text("identity"), _text("part"), _text("digest")
)
account_link = Table(
    "account_link",
    metadata,
    _number(),
    *(_text(name) for name in ("kind", "key", "before", "state", "digest")),
)

assigned_point = Table(
    "assigned_point",
    metadata,
    _text("kind", key=True),
    _text("heliostat", key=True),
    *(_real(axis, needed=True) for axis in ("east", "north", "up")),
)

account = Table(
    "account",
    metadata,
    _text("name", key=True),
    _text("role"),
    _text("password_hash"),
    Column("disabled", Boolean, nullable=False),
    _real("created", needed=True),
    _real("changed", needed=True),
    CheckConstraint("role IN ('viewer', 'operator', 'engineer')", name="role"),
)

#: Accounts whose password was set by someone else and must be changed at first use.
password_due = Table(
    "password_due",
    metadata,
    Column("name", Text, ForeignKey(account.c.name, ondelete="CASCADE"), primary_key=True),
)

#: `used` is the last time step whose code was accepted. `word` is not secret, see `factors`.
second_factor = Table(
    "second_factor",
    metadata,
    Column("name", Text, ForeignKey(account.c.name, ondelete="CASCADE"), primary_key=True),
    _text("word"),
    _real("since", needed=True),
    Column("confirmed", Boolean, nullable=False),
    Column("used", BigInteger, nullable=False),
)
recovery_code = Table(
    "recovery_code",
    metadata,
    _text("digest", key=True),
    Column("name", Text, ForeignKey(account.c.name, ondelete="CASCADE"), nullable=False),
)

session = Table(
    "session",
    metadata,
    _text("key", key=True),
    Column("name", Text, ForeignKey(account.c.name, ondelete="CASCADE"), nullable=False),
    _real("since", needed=True),
    _real("expires", needed=True),
    _text("note"),
)

api_token = Table(
    "api_token",
    metadata,
    _text("key", key=True),
    Column("name", Text, ForeignKey(account.c.name, ondelete="CASCADE"), nullable=False),
    _text("label"),
    _text("role"),
    _real("created", needed=True),
    _real("expires"),
    _real("last_used"),
    CheckConstraint("role IN ('viewer', 'operator', 'engineer')", name="role"),
)
