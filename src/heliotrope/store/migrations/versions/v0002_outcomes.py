"""Stores outcomes by name, the origin of a calibration, and sightings left out of a fit."""

from alembic import op
from sqlalchemy import Boolean, Column, Text, column, false, table, true, update

revision = "0002"
down_revision = "0001"

#: How a fit ended was kept as a sentence.
_ENDINGS = {
    "converged": "converged",
    "the iteration did not settle; the parameters may not be the best": "not_converged",
    "no sightings: the parameters are the prior's": "too_few",
}


def upgrade() -> None:
    """Add the columns, and convert outcomes stored as sentences to names."""
    op.add_column(
        "parameter_version", Column("provenance", Text, nullable=False, server_default="camera")
    )
    op.add_column(
        "parameter_sighting", Column("used", Boolean, nullable=False, server_default=true())
    )
    op.add_column("visit", Column("outcome", Text, nullable=False, server_default="unchanged"))
    visit = table("visit", column("good", Boolean), column("outcome", Text))
    op.execute(update(visit).where(visit.c.good != false()).values(outcome="calibrated"))
    version = table("parameter_version", column("outcome", Text))
    for text, name in _ENDINGS.items():
        op.execute(update(version).where(version.c.outcome == text).values(outcome=name))
    # Only fits that ended well were ever kept; other words come from imported records.
    known = list(dict.fromkeys(_ENDINGS.values()))
    op.execute(update(version).where(version.c.outcome.not_in(known)).values(outcome="converged"))
