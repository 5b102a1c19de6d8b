"""The learnt hyperparameters of each heliostat group."""

from alembic import op
from sqlalchemy import Column, Double, Integer, Text

revision = "0007"
down_revision = "0006"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "learning",
        Column("group", Text, primary_key=True),
        Column("version", Integer, primary_key=True, autoincrement=False),
        Column("at", Double, nullable=False),
        Column("person", Text, nullable=False),
        Column("heliostats", Integer, nullable=False),
        Column("sightings", Integer, nullable=False),
        Column("gain", Double, nullable=False),
        Column("document", Text, nullable=False),
    )
