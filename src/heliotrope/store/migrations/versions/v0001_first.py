"""The first tables.

This module is a copy of `store.tables` at that time, because a migration must not change with the
program.
"""

from alembic import op
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
)

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(column_0_N_label)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "ck": "ck_%(table_name)s_%(constraint_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)
#: SQLite takes only INTEGER for the number of a row itself.
Number = BigInteger().with_variant(Integer, "sqlite")


def _number() -> "Column[int]":
    return Column("number", Number, primary_key=True, autoincrement=False)


def _text(name: str, *, key: bool = False) -> "Column[str]":
    return Column(name, Text, nullable=False, primary_key=key)


def _real(name: str, *, needed: bool = False) -> "Column[float]":
    return Column(name, Double, nullable=not needed)


about = Table("about", metadata, _text("name", key=True), _text("value"))

sighting = Table(
    "sighting",
    metadata,
    _number(),
    _text("heliostat"),
    _text("kind"),
    _text("target"),
    _text("campaign"),
    _real("time"),
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
    *(Column(name, JSON, nullable=False) for name in ("names", "value", "covariance", "prior")),
    _real("error_before"),
    _real("error_after"),
    _real("scale"),
    _text("outcome"),
    _text("person"),
    _text("campaign"),
    _text("note"),
    Column("pushed", JSON, nullable=False),
    _text("code"),
)

#: The sightings to which a version was fitted, in order, and their residuals.
parameter_sighting = Table(
    "parameter_sighting",
    metadata,
    _text("heliostat", key=True),
    Column("version", Integer, primary_key=True, autoincrement=False),
    Column("place", Integer, primary_key=True, autoincrement=False),
    Column("sighting", Number, ForeignKey(sighting.c.number), nullable=False),
    *(_real(f"{when}_{side}") for when in ("before", "after") for side in ("right", "above")),
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
    Column("expected", JSON, nullable=False),
    Column("found", JSON, nullable=False),
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
        _real(name)
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
    Index(None, "heliostat"),
)

plan = Table(
    "plan",
    metadata,
    Column("place", Integer, primary_key=True, autoincrement=False),
    _text("heliostat"),
    _text("target"),
    _real("due", needed=True),
    _real("gain"),
    _text("note"),
)

hold = Table(
    "hold",
    metadata,
    _number(),
    _text("heliostat"),
    _text("reason"),
    _text("person"),
    _real("since", needed=True),
    _real("until"),
    _real("ended"),
    _text("ended_by"),
)
Index(
    "uq_hold_standing",
    hold.c.heliostat,
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
    Column("severity", Integer, nullable=False),
    _text("heliostat"),
    _text("text"),
    Column("values", JSON, nullable=False),
    Index(None, "at"),
    Index(None, "heliostat"),
)

alarm = Table(
    "alarm",
    metadata,
    _number(),
    _text("condition"),
    _text("subject"),
    _text("severity"),
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
    Column("values", JSON, nullable=False),
    Column("heliostats", JSON, nullable=False),
    _text("note"),
    _text("result"),
    _text("finished"),
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

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Create the tables."""
    metadata.create_all(op.get_bind(), checkfirst=False)
