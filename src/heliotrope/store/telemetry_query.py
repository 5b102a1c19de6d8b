"""Runs read-only SQL queries on the telemetry archive, with DuckDB.

The table is called ``telemetry``; `telemetry` lists its columns; times are UTC without a time zone.
The current day is included up to its last complete batch.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa

from heliotrope.errors import InputError
from heliotrope.store.records import StoreError
from heliotrope.store.telemetry import SCHEMA, read_part

#: A part may become a Parquet file during the search.
_TRIES = 5
#: DuckDB would otherwise look for extensions on the network.
_CONFIG: dict[str, Any] = {
    "memory_limit": "1GB",
    "autoinstall_known_extensions": False,
    "autoload_known_extensions": False,
}


def query(folder: str | Path, sql: str, parameters: Sequence[Any] = ()) -> pa.Table:
    """Return the result of one SELECT.

    Parameters
    ----------
    folder
        Folder of the archive.
    sql
        A read-only statement, such as ``SELECT heliostat, max(time) FROM telemetry WHERE
        state = ? GROUP BY ALL``. It has no access to files, settings or variables.
    parameters
        Values for its placeholders.

    Raises
    ------
    InputError
        If the statement is malformed, or does anything other than read.
    StoreError
        If there is no archive, or it cannot be read.
    """
    place = Path(folder)
    if not place.is_dir():
        raise StoreError(f"telemetry {place}: no such folder; check the path")
    files, parts = _content(place)
    with duckdb.connect(config=_CONFIG) as connection:
        try:
            _show(connection, files, parts)
        except duckdb.Error as error:
            raise StoreError(f"telemetry {place}: {_line(error)}") from None
        try:
            _check(connection.extract_statements(sql))
            answer = connection.sql(sql, params=list(parameters) or None)
            return answer.to_arrow_table()
        except duckdb.IOException as error:
            raise StoreError(f"telemetry {place}: {_line(error)}") from None
        except duckdb.Error as error:
            raise InputError(f"query: {_line(error)}") from None


def _show(connection: duckdb.DuckDBPyConnection, files: Sequence[str], parts: pa.Table) -> None:
    """Give a connection access to the archive and to nothing else."""
    connection.register("parts", parts)
    sources = ["SELECT * FROM parts"]
    if files:
        listed = ", ".join("'" + f.replace("'", "''") + "'" for f in files)
        sources.insert(0, f"SELECT * FROM read_parquet([{listed}])")  # noqa: S608 - our files
        connection.execute(f"SET allowed_paths=[{listed}]")
    rows = " UNION ALL BY NAME ".join(sources)
    connection.execute(
        "CREATE VIEW telemetry AS "  # noqa: S608 - our files
        f"SELECT * REPLACE (CAST(time AS TIMESTAMP) AS time) FROM ({rows})"
    )
    for setting in (
        "python_enable_replacements=false",
        "enable_external_access=false",
        "lock_configuration=true",
    ):
        connection.execute(f"SET {setting}")


def _check(statements: Sequence[Any]) -> None:
    kinds = [statement.type for statement in statements]
    if kinds not in ([duckdb.StatementType.SELECT], [duckdb.StatementType.EXPLAIN]):
        raise InputError("query: write a single SELECT; nothing else is allowed")


def _line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


def _content(folder: Path) -> tuple[list[str], pa.Table]:
    """Return the Parquet files, and the rows of parts that are not in these files."""
    for _ in range(_TRIES):
        paths = sorted(folder.glob("????-??-??/*.*"))
        files = [p for p in paths if p.suffix == ".parquet"]
        parts = [p for p in paths if p.suffix == ".part" and p.with_suffix(".parquet") not in files]
        try:
            batches = [batch for part in parts for batch in read_part(part)]
        except FileNotFoundError:
            continue
        return [str(file) for file in files], pa.Table.from_batches(batches, SCHEMA)
    raise StoreError(f"telemetry {folder}: its files keep changing; try again")
