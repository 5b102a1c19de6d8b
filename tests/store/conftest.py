"""Stores to test on: SQLite in a folder, and a real PostgreSQL server, one for all tests."""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from heliotrope.calibration.sightings import Sightings, sightings
from heliotrope.store.keeper import Keeper
from support.postgres import postgres_server

_COUNT = itertools.count()


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    """The URL of a running PostgreSQL server, without a schema."""
    with postgres_server() as running:
        yield running.url()


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
