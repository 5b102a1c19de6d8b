"""The writer: groups what waits, keeps it through failures, and drops only what is wrong."""

import asyncio
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import Connection, select
from sqlalchemy.exc import IntegrityError, OperationalError

from heliotrope.store import _rows as rows
from heliotrope.store import tables
from heliotrope.store.database import Database
from heliotrope.store.keeper import Keeper
from heliotrope.store.records import Event, StoreError
from heliotrope.store.writer import Writer


class Failing(Database):
    """A database that can be told to fail, as a full disk does."""

    fails = False
    transactions = 0

    def connect(self) -> Connection:
        connection = super().connect()
        database = self

        class Refusing:
            """The connection, but for its transactions."""

            def begin(self) -> Any:
                database.transactions += 1
                if database.fails:
                    text = "database or disk is full"
                    raise OperationalError("COMMIT", {}, Exception(text))
                return connection.begin()

            def __getattr__(self, name: str) -> Any:
                return getattr(connection, name)

        return Refusing()  # type: ignore[return-value]


@pytest.fixture
def database(place: str | Path) -> Iterator[Failing]:
    if isinstance(place, Path):
        place.mkdir()
    made = Failing(place)
    made.lock()
    made.prepare()
    yield made
    made.close()


@pytest.fixture(params=[False, True], ids=["thread", "inline"])
def writer(database: Failing, request: pytest.FixtureRequest) -> Iterator[Writer]:
    made = Writer(database, inline=request.param, limit=20)
    yield made
    database.fails = False
    made.close()


def note(name: str) -> Callable[[Connection], str]:
    def work(connection: Connection) -> str:
        rows.insert(connection, tables.about, [{"name": name, "value": "x"}])
        return name

    return work


def notes(database: Database) -> set[str]:
    with database.reading() as connection:
        return set(connection.scalars(select(tables.about.c.name)))


def test_work_is_done_and_gives_its_result(writer: Writer, database: Failing) -> None:
    writer.put(note("first"))
    assert writer.do(note("second")) == "second"
    # What was put before is written before.
    assert notes(database) == {"first", "second"}
    assert writer.backlog == 0


def test_what_waits_shares_a_commit(database: Failing) -> None:
    writer = Writer(database)
    try:
        begun = database.transactions
        gate = threading.Event()
        writer.put(lambda _: gate.wait(10.0))
        for i in range(100):
            writer.put(note(str(i)))
        gate.set()
        writer.confirmed().result(10.0)
    finally:
        writer.close()
    assert len(notes(database)) == 100
    assert database.transactions - begun <= 3


def test_a_failure_keeps_what_was_put_and_gives_up_what_was_tried(
    writer: Writer, database: Failing
) -> None:
    database.fails = True
    writer.put(note("kept"))
    with pytest.raises(StoreError, match=r"disk is full.*check the disk"):
        writer.do(note("tried"))
    assert "disk is full" in writer.problem
    with pytest.raises(StoreError, match="disk is full"):
        writer.confirmed().result(10.0)
    assert writer.backlog == 1
    database.fails = False
    # By itself, or at the latest when somebody asks.
    writer.confirmed().result(10.0)
    assert notes(database) == {"kept"}
    assert (writer.problem, writer.backlog) == ("", 0)


def test_the_thread_recovers_by_itself(database: Failing) -> None:
    writer = Writer(database)
    database.fails = True
    written = threading.Event()
    writer.put(lambda _: written.set())
    with pytest.raises(StoreError):
        writer.do(note("tried"))
    database.fails = False
    assert written.wait(10.0)
    writer.close()


def test_work_that_is_wrong_holds_up_nothing(writer: Writer, database: Failing) -> None:
    def wrong(connection: Connection) -> None:
        connection.execute(tables.about.insert().values(name="half", value="done"))
        connection.execute(tables.about.insert().values(name="no value"))

    gate = threading.Event()
    if not writer.inline:
        writer.put(lambda _: gate.wait(10.0))
    writer.put(note("before"))
    writer.put(wrong)
    writer.put(note("after"))
    done = writer.attempt(note("last")) if not writer.inline else None
    gate.set()
    assert done is None or done.result(10.0) == "last"
    writer.confirmed().result(10.0)
    assert notes(database) - {"last"} == {"before", "after"}
    assert writer.refused_count == 1
    assert "a record was refused" in writer.refused
    assert writer.problem == ""


def test_an_error_of_the_work_comes_back(writer: Writer) -> None:
    def bad(_: Connection) -> None:
        raise ZeroDivisionError("of its own")

    with pytest.raises(ZeroDivisionError, match="of its own"):
        writer.do(bad)
    with pytest.raises(StoreError, match="refused"):
        writer.do(lambda c: c.execute(tables.about.insert().values(name="x")))
    assert writer.do(note("goes on")) == "goes on"


def test_a_queue_that_is_full_takes_no_more(writer: Writer, database: Failing) -> None:
    database.fails = True
    for i in range(20):
        writer.put(note(str(i)))
    with pytest.raises(StoreError, match=r"20 records are waiting.*no more are accepted"):
        writer.put(note("too many"))
    database.fails = False
    writer.confirmed().result(10.0)
    assert len(notes(database)) == 20


def test_it_never_waits_longer_than_asked(database: Failing) -> None:
    writer = Writer(database)
    begun, gate = threading.Event(), threading.Event()
    writer.put(lambda _: begun.set() or gate.wait(10.0))
    assert begun.wait(10.0)
    try:
        with pytest.raises(StoreError, match=r"it took longer than 0\.05 s"):
            writer.do(note("too late"), 0.05)
    finally:
        gate.set()
        writer.close()
    # It was given up before it was begun.
    assert notes(database) == set()


def test_closing_writes_what_waits_and_tells_what_is_lost(database: Failing) -> None:
    writer = Writer(database)
    for i in range(50):
        writer.put(note(str(i)))
    writer.close()
    assert len(notes(database)) == 50
    with pytest.raises(StoreError, match="it is closed"):
        writer.put(note("late"))
    database.fails = True
    other = Writer(database)
    other.put(note("lost"))
    with pytest.raises(StoreError, match=r"1 records are lost.*disk is full"):
        other.close()


def test_the_loop_goes_on_while_the_disk_is_slow(keeper: Keeper) -> None:
    gate = threading.Event()

    async def run() -> int:
        keeper.writer.put(lambda _: gate.wait(10.0))
        keeper.record_event(Event(1.0, "test", "waits"))
        turns = 0
        waiting = asyncio.ensure_future(keeper.confirm())
        while not waiting.done():
            await asyncio.sleep(0)
            turns += 1
            if turns == 1000:
                gate.set()
        await waiting
        return turns

    assert asyncio.run(run()) >= 1000
    assert [e.text for e in keeper.events()] == ["waits"]


def test_a_server_that_drops_its_connections(
    schema: str, server: str, opened: Callable[..., Keeper]
) -> None:
    import psycopg

    keeper = opened(schema)
    keeper.record_event(Event(1.0, "test", "before"))
    keeper.writer.confirmed().result(10.0)
    assert len(keeper.events()) == 1
    with psycopg.connect(server) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
            "WHERE pid <> pg_backend_pid() AND backend_type = 'client backend'"
        )
    keeper.record_event(Event(2.0, "test", "meanwhile"))
    with pytest.raises(StoreError, match="cannot be written"):
        keeper.writer.confirmed().result(10.0)
    keeper.writer.confirmed().result(10.0)
    assert [e.text for e in keeper.events()] == ["meanwhile", "before"]
    # It has the lock again.
    with pytest.raises(StoreError, match="another process writes to it"):
        opened(schema)


def test_in_virtual_time_records_are_there_at_once(tmp_path: Path) -> None:
    keeper = Keeper(tmp_path, inline=True)
    keeper.record_event(Event(1.0, "test", "there"))
    assert [e.text for e in keeper.events()] == ["there"]
    asyncio.run(keeper.confirm())
    keeper.close()


def test_integrity_is_told_from_the_state_of_the_disk() -> None:
    from heliotrope.store.writer import _is_of_database

    assert _is_of_database(OperationalError("x", {}, Exception("disk I/O error")))
    assert not _is_of_database(IntegrityError("x", {}, Exception("UNIQUE")))
    assert not _is_of_database(ValueError("own"))
