"""Hash chains over events and audit; existing records are chained as they are."""

import hashlib
import json
import math
from typing import Any

from alembic import op
from sqlalchemy import (
    JSON,
    BigInteger,
    Column,
    Integer,
    MetaData,
    Table,
    Text,
    column,
    select,
    table,
)

revision = "0003"
down_revision = "0002"

metadata = MetaData(naming_convention={"pk": "pk_%(table_name)s"})
#: SQLite takes only INTEGER for the number of a row itself.
Number = BigInteger().with_variant(Integer, "sqlite")
event_link = Table(
    "event_link",
    metadata,
    Column("number", Number, primary_key=True, autoincrement=False),
    Column("digest", Text, nullable=False),
)
audit_link = Table(
    "audit_link",
    metadata,
    Column("number", Number, primary_key=True, autoincrement=False),
    *(Column(name, Text, nullable=False) for name in ("identity", "part", "digest")),
)


def _digest(before: str, content: list[Any]) -> str:
    text = json.dumps(content, ensure_ascii=False, separators=(",", ":"), sort_keys=True)
    return hashlib.sha256(f"{before}\n{text}".encode(errors="surrogatepass")).hexdigest()


def upgrade() -> None:
    """Create the links."""
    connection = op.get_bind()
    metadata.create_all(connection, checkfirst=False)
    _link_events(connection)
    _link_audit(connection)


def _link_events(connection: Any) -> None:
    names = ("number", "at", "source", "severity", "heliostat", "text")
    event = table("event", *map(column, names), column("values", JSON))
    before, made = "0" * 64, []
    query = select(*(event.c[name] for name in names), event.c["values"]).order_by(event.c.number)
    for row in connection.execute(query).all():
        values = {
            k: float(x) if x is not None and math.isfinite(x) else None for k, x in row[6].items()
        }
        before = _digest(before, [row[0], float(row[1]), *row[2:6], values])
        made.append({"number": row[0], "digest": before})
    if made:
        connection.execute(event_link.insert(), made)


def _link_audit(connection: Any) -> None:
    names = ("identity", "number", "who", "role", "what", "at")
    rest = ("note", "result", "finished")
    audit = table(
        "audit", *map(column, (*names, *rest)), column("values", JSON), column("heliostats", JSON)
    )
    before, number = "0" * 64, 0
    for row in connection.execute(select(audit).order_by(audit.c.number)).mappings().all():
        accepted = [row[name] for name in names]
        accepted += [[float(x) for x in row["values"]], list(row["heliostats"]), row["note"]]
        parts = [("accepted", accepted)]
        if row["result"]:
            parts.append(("result", [row["identity"], row["result"], row["finished"]]))
        for part, content in parts:
            before, number = _digest(before, content), number + 1
            made = {"number": number, "identity": row["identity"], "part": part, "digest": before}
            connection.execute(audit_link.insert().values(made))
