"""Finds the real measurements that some tests read; they are not part of the project."""

import os
from pathlib import Path

import pytest

_REPOSITORY = Path(__file__).resolve().parents[2]


def juelich() -> Path:
    """Return the folder of the Jülich measurements, or skip the test that asks.

    ``HELIOTROPE_DATA`` names it; without that it is ``../shared/data/juelich`` beside
    the repository. A folder that was named and is not there fails the test.
    """
    named = os.environ.get("HELIOTROPE_DATA")
    folder = Path(named) if named else _REPOSITORY.parent / "shared" / "data" / "juelich"
    if (folder / "measurements.csv").is_file():
        return folder
    if named:
        pytest.fail(f"HELIOTROPE_DATA={named}: there is no measurements.csv in it")
    pytest.skip("the Jülich measurements are not here; set HELIOTROPE_DATA to their folder")


def fields() -> Path:
    """Return the folder of published fields, or skip the test that asks.

    It is ``../shared/data/fields`` beside the repository, unless ``HELIOTROPE_FIELDS`` names it; a
    folder that was named and is not there fails the test.
    """
    named = os.environ.get("HELIOTROPE_FIELDS")
    folder = Path(named) if named else _REPOSITORY.parent / "shared" / "data" / "fields"
    if (folder / "dunhuang" / "layout.csv").is_file():
        return folder
    if named:
        pytest.fail(f"HELIOTROPE_FIELDS={named}: there is no dunhuang/layout.csv in it")
    pytest.skip("the published fields are not here; set HELIOTROPE_FIELDS to their folder")
