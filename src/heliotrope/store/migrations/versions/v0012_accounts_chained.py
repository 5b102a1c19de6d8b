"""A hash chain over accounts and tokens; existing entries are chained as they are."""

import hashlib
import json
from typing import Any

from alembic import op
from sqlalchemy import BigInteger, Column, Integer, MetaData, Table, Text, text

revision = "0012"
down_revision = "0011"

metadata = MetaData(naming_convention={"pk": "pk_%(table_name)s"})
#: SQLite takes only INTEGER for the number of a row itself.
Number = BigInteger().with_variant(Integer, "sqlite")
account_link = Table(
    "account_link",
    metadata,
    Column("number", Number, primary_key=True, autoincrement=False),
    *(Column(name, Text, nullable=False) for name in ("kind", "key", "before", "state", "digest")),
)


def upgrade() -> None:
    """Create the links."""
    connection = op.get_bind()
    metadata.create_all(connection, checkfirst=False)
    before, made = "0" * 64, []
    for number, (kind, key, state) in enumerate(_states(connection), 1):
        content = [kind, key, "", json.dumps(state, ensure_ascii=False)]
        line = json.dumps(content, ensure_ascii=False, separators=(",", ":"), sort_keys=True)
        whole = f"{before}\n{line}".encode(errors="surrogatepass")
        before = hashlib.sha256(whole).hexdigest()
        row = dict(zip(("kind", "key", "before", "state"), content, strict=True))
        made.append({"number": number, **row, "digest": before})
    if made:
        connection.execute(account_link.insert(), made)


def _states(connection: Any) -> list[tuple[str, str, list[Any]]]:
    def rows(query: str) -> list[Any]:
        return list(connection.execute(text(query)))

    due = {name for (name,) in rows("SELECT name FROM password_due")}
    factors = {
        name: [word, float(since), bool(confirmed)]
        for name, word, since, confirmed in rows(
            "SELECT name, word, since, confirmed FROM second_factor"
        )
    }
    codes: dict[str, list[str]] = {}
    for name, digest in rows("SELECT name, digest FROM recovery_code"):
        codes.setdefault(name, []).append(digest)
    states: list[tuple[str, str, list[Any]]] = []
    for name, role, password, disabled, created, changed in rows(
        "SELECT name, role, password_hash, disabled, created, changed FROM account ORDER BY name"
    ):
        kept = hashlib.sha256(password.encode()).hexdigest()
        state = [role, kept, bool(disabled), float(created), float(changed), name in due]
        state += [factors.get(name), sorted(codes.get(name, ()))]
        states.append(("account", name, state))
    for key, name, label, role, created, ends in rows(
        "SELECT key, name, label, role, created, expires FROM api_token ORDER BY key"
    ):
        about = [name, label, role, float(created), None if ends is None else float(ends)]
        states.append(("token", key, about))
    return states
