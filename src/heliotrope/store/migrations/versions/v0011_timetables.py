"""Calibration timetables activated by operators."""

from alembic import op
from sqlalchemy import Column, Double, Text

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "timetable",
        Column("at", Double, primary_key=True),
        Column("person", Text, nullable=False),
        Column("document", Text, nullable=False),
    )
