"""The sightings behind calibration versions, each stored from its first to its last version.

Before this revision, every version listed all its sightings, although each version builds on the
sightings of the previous version.
"""

from alembic import op
from sqlalchemy import (
    BigInteger,
    Boolean,
    Column,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Integer,
    MetaData,
    Table,
    Text,
    true,
)

revision = "0009"
down_revision = "0008"

metadata = MetaData(
    naming_convention={
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)
#: SQLite takes only INTEGER for the number of a row itself.
Number = BigInteger().with_variant(Integer, "sqlite")
sighting = Table("sighting", metadata, Column("number", Number, primary_key=True))
version = Table(
    "parameter_version",
    metadata,
    Column("heliostat", Text, primary_key=True),
    Column("version", Integer, primary_key=True),
)
_MISSES = ("before_right", "before_above", "after_right", "after_above")
parameter_sighting = Table(
    "parameter_sighting",
    metadata,
    Column("heliostat", Text, primary_key=True),
    Column(
        "sighting", Number, ForeignKey(sighting.c.number), primary_key=True, autoincrement=False
    ),
    Column("version", Integer, primary_key=True, autoincrement=False),
    Column("until", Integer),
    *(Column(name, Double) for name in _MISSES),
    Column("used", Boolean, nullable=False, server_default=true()),
    ForeignKeyConstraint(["heliostat", "version"], [version.c.heliostat, version.c.version]),
)

#: Successive versions of a heliostat that use a sighting in the same way have the same difference
#: between version number and row number.
_RUNS = """
CREATE TABLE behind AS
SELECT heliostat, sighting, used, MIN(version) AS version, MAX(version) AS last
FROM (
    SELECT s.heliostat, s.sighting, s.used, s.version, v.nth - ROW_NUMBER() OVER (
        PARTITION BY s.heliostat, s.sighting, s.used ORDER BY s.version) AS run
    FROM parameter_sighting s
    JOIN (
        SELECT heliostat, version,
            ROW_NUMBER() OVER (PARTITION BY heliostat ORDER BY version) AS nth
        FROM parameter_version
    ) v ON v.heliostat = s.heliostat AND v.version = s.version
) runs
GROUP BY heliostat, sighting, used, run
"""
_ROWS = """
CREATE TABLE rows_behind AS
SELECT b.heliostat, b.sighting, b.version,
    (SELECT MIN(v.version) FROM parameter_version v
     WHERE v.heliostat = b.heliostat AND v.version > b.last) AS until,
    s.before_right, s.before_above, s.after_right, s.after_above, b.used
FROM behind b
JOIN parameter_sighting s
    ON s.heliostat = b.heliostat AND s.version = b.version AND s.sighting = b.sighting
"""
_BACK = """
INSERT INTO parameter_sighting (heliostat, sighting, version, until, before_right, before_above,
    after_right, after_above, used)
SELECT heliostat, sighting, version, until, before_right, before_above, after_right, after_above,
    used
FROM rows_behind
"""


def upgrade() -> None:
    """Store each sighting once for all successive versions that use it in the same way."""
    op.execute(_RUNS)
    op.execute(_ROWS)
    op.drop_table("parameter_sighting")
    parameter_sighting.create(op.get_bind())
    op.execute(_BACK)
    op.drop_table("behind")
    op.drop_table("rows_behind")
