"""Second factors, and recovery codes as their SHA-256."""

from alembic import op
from sqlalchemy import BigInteger, Boolean, Column, Double, ForeignKey, Text

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Create the tables."""
    op.create_table(
        "second_factor",
        Column(
            "name",
            Text,
            ForeignKey("account.name", ondelete="CASCADE", name="fk_second_factor_name"),
            primary_key=True,
        ),
        Column("word", Text, nullable=False),
        Column("since", Double, nullable=False),
        Column("confirmed", Boolean, nullable=False),
        Column("used", BigInteger, nullable=False),
    )
    op.create_table(
        "recovery_code",
        Column("digest", Text, primary_key=True),
        Column(
            "name",
            Text,
            ForeignKey("account.name", ondelete="CASCADE", name="fk_recovery_code_name"),
            nullable=False,
        ),
    )
