"""Passwords set by someone else, which must be changed at first use."""

from alembic import op
from sqlalchemy import Column, ForeignKey, Text

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Make the table; passwords that are in use already need no change."""
    op.create_table(
        "password_due",
        Column(
            "name",
            Text,
            ForeignKey("account.name", ondelete="CASCADE", name="fk_password_due_name"),
            primary_key=True,
        ),
    )
