"""The mutants of `scripts/mutants.py`: what is changed, what is spared, and the table."""

import ast
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SOURCE = '''"""A module."""
LIMIT: float = 6.0

def late(age: int, known: bool = True) -> bool:
    """Whether it is late."""
    if not known and age < 3:
        raise ValueError(f"age {age + 1}")
    note(age)
    return age + 1 > LIMIT
'''


@pytest.fixture(scope="module")
def mutants() -> Any:
    path = Path(__file__).parents[1] / "scripts" / "mutants.py"
    spec = importlib.util.spec_from_file_location("mutants", path)
    assert spec is not None
    assert spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(spec)
    sys.modules["mutants"] = module
    spec.loader.exec_module(module)
    return module


def test_each_change_is_made_once_and_alone(mutants: Any) -> None:
    found = mutants.mutants_of("a.py", SOURCE)
    words = sorted(each.change for each in found)
    assert words == sorted(
        ["6.0 to 7.0", "True to False", "condition negated", "And to Or", "not left out",
         "Lt to LtE", "3 to 4", "call left out", "Gt to GtE", "Add to Sub", "1 to 2"]
    )  # fmt: skip
    texts = {mutants.mutated(each, SOURCE) for each in found}
    assert len(texts) == len(found)
    plain = ast.unparse(ast.parse(SOURCE)).splitlines()
    for text in texts:
        changed = text.splitlines()
        assert len(changed) == len(plain)
        assert sum(a != b for a, b in zip(plain, changed, strict=True)) == 1


def test_the_same_seed_draws_the_same_mutants(mutants: Any) -> None:
    first = mutants.sampled(20, 3)
    assert first == mutants.sampled(20, 3)
    assert first != mutants.sampled(20, 4)
    assert {Path(each.file).parts[0] for each in first} <= set(mutants.PACKAGES)


def test_the_table_counts_and_names_survivors(mutants: Any) -> None:
    lines = [
        {"mutant": "lcu/a.py:1", "package": "lcu", "unit": True, "simulation": False},
        {"mutant": "lcu/b.py:2", "package": "lcu", "unit": False, "simulation": False},
        {"mutant": "plant/c.py:3", "package": "plant", "unit": True, "simulation": True},
    ]
    text = mutants.table(lines)
    assert "| lcu | 2 | 1 | 0 | 1 | 1 |" in text
    assert "| all | 3 | 2 | 1 | 2 | 1 |" in text
    assert text.endswith("- survived: `lcu/b.py:2`")
