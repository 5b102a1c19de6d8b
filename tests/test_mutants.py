"""The mutants of `scripts/mutants.py`: what is changed, what is spared, and the table."""

import ast
import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
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
def scripts() -> Iterator[Any]:
    """The three scripts, as they find each other when one of them runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parents[1] / "scripts"))
        names = ("mutant_operators", "mutant_trials", "mutants")
        yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
        for name in names:
            del sys.modules[name]


@pytest.fixture(scope="module")
def mutants(scripts: Any) -> Any:
    return scripts.mutant_operators


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


def test_what_only_asserts_is_spared(mutants: Any) -> None:
    source = """
@dataclass(frozen=True)
class Row:
    size = 3

def pairs(a, b):
    return list(zip(a, b, strict=True))
"""
    assert [each.change for each in mutants.mutants_of("a.py", source)] == ["3 to 4"]


def test_the_function_that_differs_is_found_and_what_is_outside_functions_is_told(
    scripts: Any,
) -> None:
    changes = {}
    for each in scripts.mutant_operators.mutants_of("a.py", SOURCE):
        plain = compile(ast.parse(SOURCE), "a.py", "exec")
        new = compile(scripts.mutant_operators.planted(each, SOURCE), "a.py", "exec")
        (found,) = scripts.mutant_trials.changes(plain, new)
        changes[each.change] = None if found is None else [code.co_name for code in found]
    assert changes.pop("6.0 to 7.0") is None  # a constant of the module
    assert changes.pop("True to False") is None  # a default
    assert set(map(tuple, changes.values())) == {("late", "late")}


def test_a_mutant_is_reached_by_what_executes_it_or_uses_its_name(scripts: Any) -> None:
    trials, operators = scripts.mutant_trials, scripts.mutant_operators
    file = "lcu/ticks.py"
    source = (operators.SOURCE / file).read_text(encoding="utf-8")
    all_ = operators.mutants_of(file, source)
    inside = next(m for m in all_ if "later - earlier" in source.splitlines()[m.line - 1])
    outside = next(m for m in all_ if source.splitlines()[m.line - 1].startswith("PERIOD"))
    uses = [n for n, text in enumerate(source.splitlines(), 1) if "PERIOD" in text]
    lines = {inside.line: {"a test"}, outside.line: {""}, uses[2]: {"a run"}}
    assert inside.line != uses[2]
    reach = trials.Reach(lines={file: lines})
    assert trials.reaching(inside, reach) == ({"a test"}, False)
    assert trials.reaching(outside, reach) == ({"a test", "a run"}, True)


def test_what_reaches_a_line_is_kept_until_the_sources_change(
    scripts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials, path = scripts.mutant_trials, tmp_path / "reach.json"
    assert trials.Reach.read(path) is None
    kept = trials.Reach({"a test": 0.5}, {"lcu/a.py": {3: {"a test", ""}}})
    kept.keep(path)
    assert trials.Reach.read(path) == kept
    monkeypatch.setattr(trials, "stamp", lambda: "changed")
    assert trials.Reach.read(path) is None


def test_the_table_counts_and_names_survivors(scripts: Any) -> None:
    lines = [
        {"mutant": name, "package": package, "unit": unit, "simulation": run, "executed": seen}
        for name, package, unit, run, seen in (
            ("lcu/a.py:1", "lcu", True, False, True),
            ("lcu/b.py:2", "lcu", False, False, False),
            ("plant/c.py:3", "plant", True, True, True),
        )
    ]
    text = scripts.mutants.table(lines)
    assert "| lcu | 2 | 1 | 0 | 1 | 1 | 1 |" in text
    assert "| all | 3 | 2 | 1 | 2 | 1 | 1 |" in text
    assert "- by the simulation, of those it executes: 50 % (9 to 91 %)" in text
    assert text.endswith("- survived: `lcu/b.py:2`")


def test_an_interval_is_wilsons(scripts: Any) -> None:
    """With no hit in n tries it ends at z² / (n + z²)."""
    assert scripts.mutants.interval(0, 10) == "0 % (0 to 28 %)"
    assert scripts.mutants.interval(0, 0) == "–"


def test_trials_are_joined_and_the_later_counts(scripts: Any, tmp_path: Path) -> None:
    mutant = scripts.mutant_operators.Mutant("lcu/a.py", 3, 7, "1 to 2")
    path = tmp_path / "mutants.jsonl"
    line = {"mutant": mutant.key, "package": "lcu", "reached": 2, "seconds": 0.1}
    told = [
        {**line, "trial": "unit", "by": ""},
        {**line, "trial": "simulation", "by": "calm 11"},
        {**line, "trial": "unit", "by": "a test"},
    ]
    path.write_text("".join(json.dumps(each) + "\n" for each in told[:1]), encoding="utf-8")
    assert scripts.mutants.joined([mutant], scripts.mutants.read(path)) == []
    path.write_text("".join(json.dumps(each) + "\n" for each in told), encoding="utf-8")
    (joined,) = scripts.mutants.joined([mutant], scripts.mutants.read(path))
    assert (joined["unit"], joined["simulation"], joined["executed"]) == (True, True, True)
