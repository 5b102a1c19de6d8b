"""Hash chains over events, audit and accounts, which reveal altered or removed records.

Each link contains the SHA-256 of a record's content and of the previous digest. An event has one
link; an audit record has two, one at acceptance and one with its result; an account or token has
one link per change, with its state before and after. The single writer creates the links in the
transaction of the record, so they cost no further sync, and a plant that is killed leaves
consistent chains.

Anyone who can write to the database can recompute all digests, or remove the newest records. The
heads (`heads`) are therefore stored on another computer, and `verify` compares them. Old events are
removed. What remains is the anchor: the number and the digest of the last event removed. A stored
head of that event is compared with the anchor; a head of an older event can no longer be compared.
"""

import hashlib
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, RowMapping, func, select

from heliotrope.errors import InputError
from heliotrope.files.times import format_time
from heliotrope.safety import Severity
from heliotrope.store import _rows as rows
from heliotrope.store import tables
from heliotrope.store.digests import ACCOUNT, AUDIT, CHAINS, EVENT, GENESIS, Head, digest_of
from heliotrope.store.records import AuditEntry, StoreError

ACCEPTED, RESULT = "accepted", "result"
#: Rows of the table ``about`` with the digest and number of the last event removed.
ANCHOR, ANCHOR_NUMBER = "event_anchor", "event_anchor_number"
_EVENT, _AUDIT = tables.event, tables.audit
_LINKS = {EVENT: tables.event_link, AUDIT: tables.audit_link, ACCOUNT: tables.account_link}
#: An account or a token: its kind, and its name or key.
Key = tuple[str, str]


def _event(row: Mapping[str, Any] | RowMapping) -> list[Any]:
    values = {str(k): float(x) if math.isfinite(x) else None for k, x in row["values"].items()}
    rank = Severity(row["severity"]).rank
    return [row["number"], float(row["at"]), row["source"], rank, row["heliostat"], row["text"],
            values]  # fmt: skip


def _accepted(entry: AuditEntry, number: int) -> list[Any]:
    return [entry.identity, number, entry.who, entry.role, entry.what, entry.at,
            [float(x) for x in entry.values], list(entry.heliostats), entry.note]  # fmt: skip


# -- adding ------------------------------------------------------------------------------


def add_event(connection: Connection, row: dict[str, Any]) -> None:
    """Insert an event and its link; inserting it twice has the same effect as once."""
    if not rows.insert(connection, _EVENT, [row]):
        return
    digest = digest_of(_last(connection, EVENT)[1], _event(row))
    link = {"number": row["number"], "digest": digest}
    connection.execute(_LINKS[EVENT].insert().values(link))
    # A connection is closed after a failure, and what it remembers is lost with it.
    connection.info[EVENT] = row["number"], digest


def add_accepted(connection: Connection, entry: AuditEntry, number: int) -> None:
    """Add the link for an accepted audit record."""
    _add_link(connection, entry.identity, ACCEPTED, _accepted(entry, number))


def add_result(connection: Connection, identity: str, result: str, finished: str) -> None:
    """Add the link for a record's result."""
    _add_link(connection, identity, RESULT, [identity, result, finished])


def _add_link(connection: Connection, identity: str, part: str, content: list[Any]) -> None:
    _append(connection, AUDIT, {"identity": identity, "part": part}, content)


@contextmanager
def changing_accounts(connection: Connection, names: Iterable[str] | None) -> Iterator[None]:
    """Add links for the changes that a block makes to persons' accounts and tokens (None: all)."""
    chosen = None if names is None else sorted(set(names))
    before = _states(connection, chosen)
    yield
    after = _states(connection, chosen)
    for key in sorted({*before, *after}):
        link = dict(zip(("kind", "key"), key, strict=True))
        link |= {"before": before.get(key, ""), "state": after.get(key, "")}
        if link["before"] != link["state"]:
            _append(connection, ACCOUNT, link, list(link.values()))


def _states(connection: Connection, names: list[str] | None) -> dict[Key, str]:
    """Return the states of accounts and tokens as JSON, without transient values and secrets."""

    def rows_of(table: Any) -> list[RowMapping]:
        of = table.c.name
        query = select(table).order_by(*table.primary_key)
        chosen = query if names is None else query.where(of.in_(names))
        return list(connection.execute(chosen).mappings())

    due = {row["name"] for row in rows_of(tables.password_due)}
    factors = {
        row["name"]: [row["word"], float(row["since"]), bool(row["confirmed"])]
        for row in rows_of(tables.second_factor)
    }
    codes: dict[str, list[str]] = {}
    for row in rows_of(tables.recovery_code):
        codes.setdefault(row["name"], []).append(row["digest"])
    states: dict[Key, list[Any]] = {}
    for row in rows_of(tables.account):
        name, kept = row["name"], hashlib.sha256(row["password_hash"].encode()).hexdigest()
        times = [float(row["created"]), float(row["changed"])]
        of_factor = [factors.get(name), sorted(codes.get(name, ()))]
        state = [row["role"], kept, bool(row["disabled"]), *times, name in due, *of_factor]
        states["account", name] = state
    for row in rows_of(tables.api_token):
        ends = None if row["expires"] is None else float(row["expires"])
        about = [row["name"], row["label"], row["role"], float(row["created"]), ends]
        states["token", row["key"]] = about
    return {key: json.dumps(state, ensure_ascii=False) for key, state in states.items()}


def _append(
    connection: Connection, chain: str, link: Mapping[str, str], content: list[Any]
) -> None:
    """Add a link to a chain whose links are numbered separately."""
    number, before = _last(connection, chain)
    digest = digest_of(before, content)
    row = {"number": number + 1, **link, "digest": digest}
    connection.execute(_LINKS[chain].insert().values(row))
    connection.info[chain] = number + 1, digest


def _last(connection: Connection, chain: str) -> tuple[int, str]:
    """Return the number and the digest of the last link, as the writing connection knows them."""
    if chain not in connection.info:
        connection.info[chain] = _read_last(connection, chain)
    number, digest = connection.info[chain]
    return int(number), str(digest)


def _read_last(connection: Connection, chain: str) -> tuple[int, str]:
    table = _LINKS[chain].c
    query = select(table.number, table.digest).order_by(table.number.desc()).limit(1)
    row = connection.execute(query).first()
    return (row[0], row[1]) if row is not None else (0, _anchor(connection, chain))


def _anchor(connection: Connection, chain: str) -> str:
    return _about(connection, ANCHOR) or GENESIS if chain == EVENT else GENESIS


def _about(connection: Connection, name: str) -> str | None:
    return connection.scalar(select(tables.about.c.value).where(tables.about.c.name == name))


def _anchor_number(connection: Connection) -> int:
    """Return the number of the last event removed; 0 if none was removed."""
    noted = _about(connection, ANCHOR_NUMBER)
    if noted is not None:
        return int(noted)
    if _about(connection, ANCHOR) is None:
        return 0
    # Earlier programs did not record it. The numbers are consecutive.
    return (connection.scalar(select(func.min(_LINKS[EVENT].c.number))) or 1) - 1


def forget_events(connection: Connection, before: float) -> None:
    """Remove the oldest events, up to the first event that is not before a given time."""
    e = _EVENT.c
    kept = connection.scalar(select(func.min(e.number)).where(e.at >= before))
    last = connection.scalar(select(func.max(e.number)))
    end = kept if kept is not None else (last or 0) + 1
    links = _LINKS[EVENT]
    removed = select(links.c.number, links.c.digest).where(links.c.number < end)
    newest = connection.execute(removed.order_by(links.c.number.desc()).limit(1)).first()
    if newest is not None:
        anchor = {ANCHOR_NUMBER: str(newest[0]), ANCHOR: str(newest[1])}
        anchors = [{"name": name, "value": value} for name, value in anchor.items()]
        rows.replace(connection, tables.about, anchors)
        # A chain without links begins where the last one ended.
        connection.info.pop(EVENT, None)
    connection.execute(links.delete().where(links.c.number < end))
    connection.execute(_EVENT.delete().where(e.number < end))


# -- heads on other computers --------------------------------------------------------------

#: File of exported heads, with one line per export: the time and both heads.
HEADS = "heads"


def write_heads(folder: Path, new: Iterable[Head], at: datetime) -> None:
    """Append heads to the file `HEADS` in a folder; the heads are on disk when this returns.

    Raises
    ------
    StoreError
        If they cannot be written.
    """
    line = f"{at.isoformat(timespec='seconds')} {' '.join(map(str, new))}\n"
    path = folder / HEADS
    try:
        handle = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        try:
            os.write(handle, line.encode())
            os.fsync(handle)
        finally:
            os.close(handle)
    except OSError as error:
        raise StoreError(f"{path}: cannot be written ({error.strerror})") from None


def read_heads(path: Path) -> list[Head]:
    """Return the heads in a file.

    The file has the lines of `write_heads`, or is any text that contains heads.

    Raises
    ------
    InputError
        If the file contains no heads, or cannot be read.
    """
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    listed = [
        Head.read(match)
        for match in re.findall(rf"\b(?:{'|'.join(CHAINS)}):\d+:[0-9a-f]{{64}}\b", text)
    ]
    if not listed:
        raise InputError(f"{path}: contains no head; specify a file that --heads or syslog wrote")
    return list(dict.fromkeys(listed))


# -- checking ----------------------------------------------------------------------------


def heads(connection: Connection) -> tuple[Head, ...]:
    """Return the heads of the `CHAINS`."""
    return tuple(Head(chain, *_read_last(connection, chain)) for chain in CHAINS)


@dataclass(frozen=True)
class Verified:
    """The result of a check.

    Attributes
    ----------
    heads
        The heads of the `CHAINS`.
    fitting
        Earlier heads that are in the chains, or match the anchor.
    old
        Heads of events before the anchor, and of chains that were empty; these cannot be checked.
    since
        Time of the oldest stored event, POSIX s; None if there is none.
    """

    heads: tuple[Head, ...]
    fitting: tuple[Head, ...]
    old: tuple[Head, ...]
    since: float | None


def verify(connection: Connection, known: Iterable[Head] = ()) -> Verified:
    """Check the chains, and that earlier heads are in them.

    Raises
    ------
    StoreError
        If a record does not fit the chain (the text names the first such record), or if heads are
        specified but none of them can be compared.
    """
    _verify_events(connection)
    _verify_audit(connection)
    _verify_accounts(connection)
    fitting, old = list[Head](), list[Head]()
    for head in known:
        (fitting if _verify_head(connection, head) else old).append(head)
    since = connection.scalar(select(func.min(_EVENT.c.at)))
    if old and not fitting:
        raise StoreError(
            f"none of the {len(old)} heads could be checked: {kept_since(since)}; use a newer head"
        )
    return Verified(heads(connection), tuple(fitting), tuple(old), since)


def kept_since(since: float | None) -> str:
    """Return in words the time since which events are kept."""
    return "no event is kept" if since is None else f"events are kept since {format_time(since)}"


def _verify_events(connection: Connection) -> None:
    before, links = _anchor(connection, EVENT), _LINKS[EVENT].c
    linked = connection.execute(select(links.number, links.digest))
    kept = {int(number): str(digest) for number, digest in linked}
    query = select(_EVENT).order_by(_EVENT.c.number)
    for row in connection.execute(query).mappings():
        digest = digest_of(before, _event(row))
        if digest != kept.pop(row["number"], ""):
            raise StoreError(
                f"event {row['number']} ({row['text'][:80]!r}) does not fit: it was altered, or "
                "events before it were removed"
            )
        before = digest
    if kept:
        raise StoreError(f"event {min(kept)} was removed")


def _verify_audit(connection: Connection) -> None:
    numbers = select(_AUDIT.c.identity, _AUDIT.c.number)
    number_of = {name: int(number) for name, number in connection.execute(numbers)}
    entries = {
        entry.identity: entry for entry in rows.records(connection, AuditEntry, select(_AUDIT))
    }
    before, linked = GENESIS, set()
    for row in connection.execute(
        select(_LINKS[AUDIT]).order_by(_LINKS[AUDIT].c.number)
    ).mappings():
        entry = entries.get(row["identity"])
        if entry is None:
            raise StoreError(f"audit record {row['identity']} was removed")
        content = (
            _accepted(entry, number_of[entry.identity])
            if row["part"] == ACCEPTED
            else [entry.identity, entry.result, entry.finished]
        )
        digest = digest_of(before, content)
        if digest != row["digest"]:
            raise StoreError(
                f"audit record {entry.identity} ({entry.what} by {entry.who}, {row['part']}) does "
                "not fit: it was altered, or links before it were"
            )
        linked.add((entry.identity, row["part"]))
        before = digest
    for name, entry in entries.items():
        parts = (ACCEPTED, RESULT) if entry.result else (ACCEPTED,)
        if any((name, part) not in linked for part in parts):
            raise StoreError(f"audit record {name} ({entry.what} by {entry.who}) is not linked")


def _verify_accounts(connection: Connection) -> None:
    links, last = _LINKS[ACCOUNT], GENESIS
    states: dict[Key, str] = {}
    for row in connection.execute(select(links).order_by(links.c.number)).mappings():
        key, before, state = (row["kind"], row["key"]), row["before"], row["state"]
        last = digest_of(last, [*key, before, state])
        if last != row["digest"]:
            raise StoreError(
                f"link {row['number']} of the accounts ({key[0]} {key[1][:40]}) does not "
                "fit: it was altered, or links before it were removed"
            )
        _compare(key, states.pop(key, ""), before, f" before its change in link {row['number']}")
        if state:
            states[key] = state
    found = _states(connection, None)
    for key in sorted({*states, *found}):
        _compare(key, states.get(key, ""), found.get(key, ""), "")


def _compare(key: Key, linked: str, found: str, when: str) -> None:
    """Check that an account or token matches its last link; a state of "": it did not exist."""
    if linked != found:
        what = "altered" if linked and found else "removed" if linked else "added"
        raise StoreError(
            f"{_named(key, found or linked)} was {what}{when}, and not by the program; disable it, "
            "and ask its engineers"
        )


def _named(key: Key, state: str) -> str:
    """Return an account or a token in words."""
    kind, name = key
    values = json.loads(state)
    return (
        f"account {name} ({values[0]})"
        if kind == "account"
        else f"token {values[1]} of {values[0]}"
    )


def _verify_head(connection: Connection, head: Head) -> bool:
    """Check a head; return whether there is still a record to compare it with."""
    if head.number == 0:
        return False
    table = _LINKS[head.chain]
    digest = connection.scalar(select(table.c.digest).where(table.c.number == head.number))
    if digest is None and head.chain == EVENT:
        anchor = _anchor_number(connection)
        if head.number < anchor:
            return False
        if head.number == anchor:
            digest = _anchor(connection, EVENT)
    if digest != head.digest:
        what = "is missing" if digest is None else "has a different digest"
        raise StoreError(
            f"head {head}: link {head.number} {what}; records have since been removed or rewritten"
        )
    return True
