"""Drone flights that the plant has imported."""

from alembic import op
from sqlalchemy import Column, Double, Text

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "flight",
        Column("name", Text, primary_key=True),
        Column("at", Double, nullable=False),
        Column("person", Text, nullable=False),
        Column("document", Text, nullable=False),
    )
