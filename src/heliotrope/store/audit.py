"""The audit table: one record per accepted command, written at acceptance and completed later."""

from collections.abc import Iterable, Mapping

from sqlalchemy import Connection, bindparam, delete, func, select, update

from heliotrope.errors import InputError
from heliotrope.store import _rows as rows
from heliotrope.store import chain, tables
from heliotrope.store.records import AuditEntry

_AUDIT = tables.audit
#: Points by heliostat name, ENU, m.
Places = Mapping[str, tuple[float, ...]]


def begin(connection: Connection, entry: AuditEntry) -> None:
    """Store a record without a result; storing it twice has the same effect as once.

    Raises
    ------
    InputError
        If another record has the same identity.
    """
    known = _find(connection, entry.identity)
    if known is not None:
        if (known.who, known.what, known.at) != (entry.who, entry.what, entry.at):
            raise InputError(
                f"audit: record {entry.identity} already exists; each identity must be unique"
            )
        return
    number = (connection.scalar(select(func.max(_AUDIT.c.number))) or 0) + 1
    row = rows.row_of(_AUDIT, entry, number=number, result="", finished="")
    rows.insert(connection, _AUDIT, [row])
    chain.add_accepted(connection, entry, number)


def finish(connection: Connection, identity: str, result: str, at: str) -> None:
    """Add the result to a record; adding it twice has the same effect as once.

    Raises
    ------
    InputError
        If the record was not begun, or has another result.
    """
    open_ = (_AUDIT.c.identity == identity) & (_AUDIT.c.result == "")
    values = {"result": result, "finished": at}
    if connection.execute(update(_AUDIT).where(open_).values(values)).rowcount:
        chain.add_result(connection, identity, result, at)
        return
    known = _find(connection, identity)
    if known is None or known.result != result:
        raise InputError(f"audit: no record {identity} is waiting for a result")


def finish_open(connection: Connection, result: str, at: str) -> int:
    """Add the same result to all records that have none; return the number of these records."""
    query = select(_AUDIT.c.identity).where(_AUDIT.c.result == "").order_by(_AUDIT.c.number)
    identities = connection.scalars(query).all()
    for identity in identities:
        finish(connection, identity, result, at)
    return len(identities)


def entries(connection: Connection, limit: int = 100, before: int = 0) -> list[AuditEntry]:
    """Return records, latest first; if a number is specified, only earlier records."""
    query = select(_AUDIT).order_by(_AUDIT.c.number.desc()).limit(limit)
    if before:
        query = query.where(_AUDIT.c.number < before)
    return rows.records(connection, AuditEntry, query)


def _find(connection: Connection, identity: str) -> AuditEntry | None:
    query = select(_AUDIT).where(_AUDIT.c.identity == identity)
    matches = rows.records(connection, AuditEntry, query)
    return matches[0] if matches else None


def probe(connection: Connection) -> None:
    """Write a meaningless row, because only a write shows whether the disk accepts writes."""
    about = tables.about
    known = connection.scalar(select(about.c.value).where(about.c.name == "probe"))
    row = {"name": "probe", "value": str(int(known or 0) + 1)}
    rows.replace(connection, about, [row])


# -- assigned points ---------------------------------------------------------------------


def points(connection: Connection) -> dict[str, dict[str, tuple[float, ...]]]:
    """Return the assigned points by kind and heliostat."""
    places_of: dict[str, dict[str, tuple[float, ...]]] = {}
    for row in connection.execute(select(tables.assigned_point)).mappings():
        place = (row["east"], row["north"], row["up"])
        places_of.setdefault(row["kind"], {})[row["heliostat"]] = place
    return places_of


def doubt_points(connection: Connection) -> None:
    """Mark all assigned points as not acknowledged by their local controllers.

    This is expressed by an earlier point that is equal to the assigned point; see
    `plant.field.assigned`.
    """
    known = points(connection)
    doubted = {
        f"{kind}-1": {n: p for n, p in places.items() if n not in known.get(f"{kind}-1", {})}
        for kind, places in known.items()
        if "-" not in kind
    }
    change_points(connection, doubted, {})


def change_points(
    connection: Connection, new: Mapping[str, Places], removed: Mapping[str, Iterable[str]]
) -> None:
    """Replace the assigned points, by kind."""
    table = tables.assigned_point
    keys = [{"of": kind, "named": name} for kind, names in removed.items() for name in names]
    if keys:
        which = (table.c.kind == bindparam("of")) & (table.c.heliostat == bindparam("named"))
        connection.execute(delete(table).where(which), keys)
    for kind, places in new.items():
        rows.replace(
            connection,
            table,
            [
                {"kind": kind, "heliostat": name, "east": p[0], "north": p[1], "up": p[2]}
                for name, p in places.items()
            ],
        )
