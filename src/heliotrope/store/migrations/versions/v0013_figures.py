"""Plant-wide time series: power, readings, states, errors."""

from alembic import op
from sqlalchemy import JSON, Column, Double

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Create the table."""
    op.create_table(
        "figures",
        Column("at", Double, primary_key=True),
        Column("values", JSON, nullable=False),
    )
