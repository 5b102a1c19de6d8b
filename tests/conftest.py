"""Settings of all tests: seeded, the same on every run, and no time limits."""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "default",
    derandomize=True,
    deadline=None,
    max_examples=60,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
#: A long random search, by hand: HYPOTHESIS_PROFILE=search pytest -n 2
settings.register_profile(
    "search", settings.get_profile("default"), derandomize=False, max_examples=3000, database=None
)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


@pytest.fixture(scope="session", autouse=True)
def copied_stores(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A new SQLite store is a copy of the first one: to migrate each takes 0.1 s of a core."""
    from heliotrope.store.database import FILE, Database

    migrate, first = Database.migrate, list[Path]()

    def copied(database: Database) -> None:
        if database.file is not None and not database.file.exists():
            if not first:
                with Database(tmp_path_factory.mktemp("first") / FILE) as made:
                    migrate(made)
                first.append(made.file)
            with contextlib.suppress(OSError):
                shutil.copy(first[0], database.file)
                return
        migrate(database)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Database, "migrate", copied)
        yield
