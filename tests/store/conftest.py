"""Stores to test on: SQLite in a folder, and a real PostgreSQL server, one for all tests."""

import getpass
import itertools
import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.store.keeper import Keeper
from support.absence import absent

_COUNT = itertools.count()


def _programs() -> Path | None:
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"), key=lambda p: p.parts[-3])
    if found:
        return found[-1].parent
    there = shutil.which("initdb")
    return Path(there).parent if there else None


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    """The URL of a running PostgreSQL server, without a schema."""
    programs = _programs()
    if programs is None:
        absent("PostgreSQL is not installed: no initdb in /usr/lib/postgresql or on the path")
    folder = Path(tempfile.mkdtemp(prefix="pg"))
    # The server refuses to run as root.
    user = getpass.getuser()
    as_other: dict[str, str] = {}
    if os.geteuid() == 0:
        known = {entry.pw_name for entry in pwd.getpwall()}
        user = "postgres" if "postgres" in known else "nobody"
        as_other = {"user": user}
        shutil.chown(folder, user)

    def run(*command: str) -> None:
        done = subprocess.run(
            [str(programs / command[0]), *command[1:]],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            **as_other,
        )
        assert done.returncode == 0, done.stdout + done.stderr

    data = folder / "data"
    try:
        run(
            "initdb",
            "-D",
            str(data),
            "-A",
            "trust",
            "-U",
            "plant",
            "-E",
            "UTF8",
            "--locale=C",
            "--no-sync",
            "--no-instructions",
        )
        options = f"-c listen_addresses='' -c unix_socket_directories='{folder}' -c fsync=off"
        run("pg_ctl", "-D", str(data), "-w", "-l", str(folder / "log"), "-o", options, "start")
        try:
            yield f"postgresql://plant@/postgres?host={quote(str(folder), safe='')}"
        finally:
            run("pg_ctl", "-D", str(data), "-w", "-m", "immediate", "stop")
    finally:
        shutil.rmtree(folder)


@pytest.fixture
def schema(server: str) -> str:
    """The URL of a new, empty schema."""
    import psycopg

    name = f"t{next(_COUNT)}"
    with psycopg.connect(server, autocommit=True) as connection:
        connection.execute(f"CREATE SCHEMA {name}")
    return f"{server}&options=-csearch_path%3D{name}"


@pytest.fixture(params=["sqlite", "postgresql"])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> str | Path:
    """An empty place for a store, of each kind."""
    if request.param == "sqlite":
        return tmp_path / "data"
    return str(request.getfixturevalue("schema"))


@pytest.fixture
def opened() -> Iterator[Callable[..., Keeper]]:
    """Opens keepers, and closes what is still open at the end."""
    held: list[Keeper] = []

    def open_(*args: object, **options: object) -> Keeper:
        keeper = Keeper(*args, **options)  # type: ignore[arg-type]
        held.append(keeper)
        return keeper

    yield open_
    for keeper in held:
        if keeper.database.locked:
            keeper.close()


@pytest.fixture
def keeper(place: str | Path, opened: Callable[..., Keeper]) -> Keeper:
    return opened(place)


@pytest.fixture
def seen() -> Sightings:
    """Ten sightings of three heliostats, of all kinds, with numbers of many digits."""
    return make_sightings(10)


def make_sightings(count: int, seed: int = 5) -> Sightings:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, 3, 3))
    root[::2] = 0.0
    return sightings(
        np.arange(count) % 3,
        rng.integers(-200_000, 200_000, (count, 2)),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)) * 100.0,
        time=1.8e9 + rng.uniform(0.0, 1e5, count).cumsum(),
        source_at_infinity=rng.random(count) < 0.5,
        destination_at_infinity=rng.random(count) < 0.2,
        sigma=rng.uniform(1e-4, 1e-3, count),
        destination_covariance=1e-4 * root @ np.swapaxes(root, -1, -2),
    )
