"""Personal locks: one per operator, also on targets, receivers and the tower."""

import sqlalchemy as sa
from alembic import op

revision = "0010"
down_revision = "0009"

_STANDING = sa.text("ended IS NULL")


def upgrade() -> None:
    """Identify locked places by kind and name, and allow one lock for each person."""
    op.drop_index("uq_hold_standing", "hold")
    kind = sa.Column("kind", sa.Text, nullable=False, server_default="heliostat")
    op.add_column("hold", kind)
    op.execute("ALTER TABLE hold RENAME COLUMN heliostat TO name")
    op.create_index(
        "uq_hold_standing",
        "hold",
        ["kind", "name", "person"],
        unique=True,
        sqlite_where=_STANDING,
        postgresql_where=_STANDING,
    )
