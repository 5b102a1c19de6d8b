"""Passwords set by someone else, which must be changed at first use."""

from alembic import op
from sqlalchemy import Column, ForeignKey, Text

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Create the table; passwords already in use need not be changed."""
    op.create_table(
        "password_due",
        Column(
            "name",
            Text,
            ForeignKey("account.name", ondelete="CASCADE", name="fk_password_due_name"),
            primary_key=True,
        ),
    )
