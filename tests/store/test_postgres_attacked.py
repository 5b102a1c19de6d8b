"""A plant with its records in PostgreSQL: the server killed, locked, full, slow and frozen.

The plant is that of the attacks (`support.attacked_plant`), with its gauges. Minutes, and figures
that depend on the machine, so it runs with the slow tests only.
"""

import contextlib
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import psycopg
import pytest

from support.attacked_plant import (
    EMERGENCY,
    LAG,
    LEASE,
    LONGEST,
    MEMORY,
    Measured,
    Target,
    by_page,
    plant,
)
from support.bystander import order_emergency, signed_in
from support.postgres import PostgresServer, postgres_server

SQL = Path(__file__).parents[2] / "deploy" / "postgresql.sql"
#: Length of a trouble, time until all is well afterwards, and age of what is known before it, s.
SECONDS, HEALED, KNOWN = 12.0, 60.0, 4.0
#: Connections that the server takes.
MOST = 40


@pytest.fixture(scope="module")
def database() -> Iterator[PostgresServer]:
    """A server with the database of deploy/, which strangers reach too."""
    with postgres_server(f"-c max_connections={MOST}") as server:
        with psycopg.connect(server.url(), autocommit=True) as connection:
            for statement in filter(str.strip, SQL.read_text("utf-8").split(";")):
                connection.execute(statement.encode())
            connection.execute("CREATE ROLE stranger LOGIN")
        yield server


@pytest.fixture(scope="module")
def target(database: PostgresServer, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Target]:
    url = database.url("heliotrope", "heliotrope")
    folder = tmp_path_factory.mktemp("plant")
    with plant(folder, None, "--database", url, heliostats=32) as running:
        yield running


# -- what happens to the server ------------------------------------------------------------------


def nothing(server: PostgresServer) -> contextlib.AbstractContextManager[None]:
    del server
    return contextlib.nullcontext()


@contextlib.contextmanager
def killed(server: PostgresServer) -> Iterator[None]:
    server.kill()
    try:
        yield
    finally:
        server.start()


@contextlib.contextmanager
def locked(server: PostgresServer) -> Iterator[None]:
    """Somebody locks the tables against all others, as a migration by hand does."""
    with psycopg.connect(server.url(database="heliotrope")) as connection:
        connection.execute("LOCK TABLE event, audit, account, session IN ACCESS EXCLUSIVE MODE")
        yield
        connection.rollback()


@contextlib.contextmanager
def full(server: PostgresServer) -> Iterator[None]:
    """A stranger's connections take all places, those that the plant had before too."""
    with contextlib.ExitStack() as stack:
        for _ in range(2):
            with contextlib.suppress(psycopg.OperationalError):
                for _ in range(MOST):
                    held = psycopg.connect(server.url("stranger"))
                    stack.callback(held.close)
            with psycopg.connect(server.url(), autocommit=True) as connection:
                connection.execute(
                    "SELECT pg_terminate_backend(pid) FROM pg_stat_activity "
                    "WHERE usename = 'heliotrope'"
                )
        yield


@contextlib.contextmanager
def slow(server: PostgresServer) -> Iterator[None]:
    """The server works for a tenth of the time."""
    over = threading.Event()

    def work() -> None:
        while not over.is_set():
            with server.frozen():
                over.wait(0.9)
            over.wait(0.1)

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def frozen(server: PostgresServer) -> contextlib.AbstractContextManager[None]:
    return server.frozen()


# -- what is seen --------------------------------------------------------------------------------


def lock_order(olga: httpx.Client, name: str) -> str:
    """Take the command authority and order LOCK for a heliostat; return how far that came."""
    olga.post("authority").raise_for_status()
    order = {"command": "LOCK", "heliostats": [name]}
    answer = olga.post("commands", json=order)
    return str(answer.json().get("text", answer.json()))


def standing(olga: httpx.Client) -> set[str]:
    """Return the alarms about the store that are active."""
    rows = olga.get("alarms").raise_for_status().json()
    return {r["condition"] for r in rows if r["active"]} & {"records", "database_unwritable"}


def work_on(target: Target, olga: httpx.Client, name: str) -> None:
    """Do what must go on whatever the store does."""
    order_emergency(target, target.unmet.pop(), f"{time.time()}").raise_for_status()
    assert olga.get("summary").raise_for_status().json()["emergency"]
    olga.get("events").raise_for_status()
    olga.post("stow", json={"heliostats": [name]}).raise_for_status()


def missing(server: PostgresServer, olga: httpx.Client) -> list[str]:
    """Return the events of the plant that its store does not have."""
    rows = olga.get("events?limit=2000").raise_for_status().json()
    shown = [f"{r['who']}: {r['text']}" if r["who"] else r["text"] for r in rows
             if r["kind"] != "alarm"]  # fmt: skip
    assert len(shown) > 10
    with psycopg.connect(server.url(database="heliotrope")) as connection:
        kept = {text for (text,) in connection.execute("SELECT text FROM event")}
    return [text for text in shown if text not in kept]


@pytest.mark.slow
@pytest.mark.parametrize("trouble", [nothing, killed, locked, full, slow, frozen])
def test_the_plant_works_on_and_loses_no_record(target, database, trouble) -> None:  # type: ignore[no-untyped-def]
    assert target.withdraw()
    with signed_in(target, "Olga") as olga:
        name = olga.get("field").json()["names"][0]
        time.sleep(KNOWN)
        since, found = time.time(), Measured()
        with trouble(database):
            until = time.monotonic() + SECONDS
            while time.monotonic() < until:
                work_on(target, olga, name)
                found.page = max(found.page, by_page(target))
            alarms, text = standing(olga), ""
            if trouble not in (nothing, slow):
                text = lock_order(olga, name)
        healed = time.monotonic() + HEALED
        while standing(olga):
            assert time.monotonic() < healed, "the alarms about the store do not end"
            time.sleep(0.5)
        rows = target.noted(since)
        found.lag, found.lease = max(row[1] for row in rows), max(row[2] for row in rows)
        found.memory = target.memory()
        print(f"{trouble.__name__}: {found}, alarms {alarms}, LOCK: {text}")
        assert target.withdraw()
        if trouble not in (nothing, slow):
            # A frozen server has not failed yet.
            assert alarms >= {"database_unwritable"} | ({"records"} if trouble != frozen else set())
            # No motion without its record.
            assert "1 refused" in text
        assert "waiting" in lock_order(olga, name)
        time.sleep(2.0)
        assert missing(database, olga) == []
    assert found.lag < LAG
    assert found.lease < LEASE
    assert found.page < EMERGENCY
    assert found.memory < MEMORY
    assert target.process.poll() is None


@pytest.mark.slow
def test_the_chains_are_whole_afterwards(target: Target, database: PostgresServer) -> None:
    url = database.url("heliotrope", "heliotrope")
    words = ["heliotrope", "store", "verify", url]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=5 * LONGEST)
    assert done.returncode == 0, done.stdout + done.stderr
    assert target.process.poll() is None
