"""The SQL of deploy/ on a real server: a role and a database in which the store begins."""

import subprocess
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest
from sqlalchemy import create_engine, text

from heliotrope.cli.run._shared import Shown, store
from heliotrope.errors import InputError

SQL = Path(__file__).parents[2] / "deploy" / "postgresql.sql"


def test_the_store_begins_in_the_database_of_the_sql(server: str) -> None:
    host = parse_qs(urlsplit(server).query)["host"][0]
    done = subprocess.run(
        [
            "psql",
            "-h",
            host,
            "-U",
            "plant",
            "-d",
            "postgres",
            "-v",
            "ON_ERROR_STOP=1",
            "-q",
            "-f",
            str(SQL),
        ],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    url = f"postgresql://heliotrope@/heliotrope?host={host}"
    engine = create_engine(server.replace("postgresql:", "postgresql+psycopg:"))
    try:
        with store(Shown(database=url, console=False)) as (keeper, _):
            assert keeper.people.empty()
        with engine.connect() as connection:
            owner = connection.execute(
                text("SELECT pg_get_userbyid(datdba) FROM pg_database WHERE datname = 'heliotrope'")
            ).scalar()
        assert owner == "heliotrope"
    finally:
        with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
            connection.execute(text("DROP DATABASE heliotrope"))
            connection.execute(text("DROP ROLE heliotrope"))
        engine.dispose()


def test_another_database_is_refused() -> None:
    with pytest.raises(InputError, match="--database must be postgresql://user@host/name"):
        Shown(database="mysql://a/b")
