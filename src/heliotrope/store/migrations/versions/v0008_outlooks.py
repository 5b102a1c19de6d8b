"""The plant's predictions of the field errors."""

from alembic import op
from sqlalchemy import Column, Double, Text

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "outlook",
        Column("at", Double, primary_key=True),
        Column("document", Text, nullable=False),
    )
