"""Reads the reference cases: one JSON file a kind, from one or more folders."""

import json
import os
from pathlib import Path
from typing import Any

import pytest

OWN = Path(__file__).parent / "cases"


def load(kind: str) -> list[tuple[str, Any]]:
    """Return (id, case) of every case in the files ``{kind}_cases.json``.

    They are read from ``tests/reference/cases`` and from every folder that
    ``HELIOTROPE_CASES`` names, separated by colons. A folder need not have a file of
    this kind, but it must exist. The id is the case's name; where an earlier folder
    has it already, the folder's name stands before it.
    """
    named = [Path(text) for text in os.environ.get("HELIOTROPE_CASES", "").split(":") if text]
    for folder in named:
        if not folder.is_dir():
            pytest.fail(f"HELIOTROPE_CASES names {folder}, which is not a folder", pytrace=False)
    found: dict[str, Any] = {}
    for folder in [OWN, *named]:
        path = folder / f"{kind}_cases.json"
        if not path.is_file():
            continue
        for case in json.loads(path.read_text(encoding="utf-8"))["cases"]:
            name = _name(case)
            while name in found:
                name = f"{folder.name}/{name}"
            found[name] = case
    return list(found.items())


def params(kind: str) -> list[Any]:
    """Return the cases of a kind as arguments of ``pytest.mark.parametrize``."""
    return [pytest.param(case, id=name) for name, case in load(kind)]


def _name(case: dict[str, Any]) -> str:
    return str(case["name"]) if "name" in case else f"{case['site']} {case['utc']}"
