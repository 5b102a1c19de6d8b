"""The mutants of `scripts/mutants.py`: what is changed, what is spared, and the table."""

import ast
import builtins
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

SCRIPTS = Path(__file__).parents[1] / "scripts"
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
    """The scripts, as they find each other when one of them runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        names = ("mutant_operators", "mutant_probes", "mutant_trials", "mutants")
        yield SimpleNamespace(**{name: importlib.import_module(name) for name in names})
        for name in names:
            del sys.modules[name]


@pytest.fixture(scope="module")
def mutants(scripts: Any) -> Any:
    return scripts.mutant_operators


def test_the_tests_of_mutants_are_where_they_are_looked_for(scripts: Any) -> None:
    assert all(Path(each).exists() for each in scripts.mutant_trials.folders())


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
    package = ("links",)
    first = mutants.sampled(20, 3, package)
    assert first == mutants.sampled(20, 3, package)
    assert first != mutants.sampled(20, 4, package)
    everywhere = {Path(each.file).parts[0] for each in mutants.sampled(20, 3)}
    assert len(everywhere) > 1
    assert everywhere <= set(mutants.PACKAGES)
    some = mutants.sampled(20, 3, ("plant/emergency", "optics/standing.py"))
    assert len(some) == 20
    assert {each.file for each in some} <= {
        "optics/standing.py",
        *(
            f"plant/emergency/{name}.py"
            for name in ("callers", "order", "sentinel", "standing", "table")
        ),
    }


def test_a_change_elsewhere_in_a_file_draws_the_same_mutants(mutants: Any) -> None:
    more = SOURCE.replace(
        "LIMIT: float", "MOST = 4\n\ndef early() -> int:\n    return 1\n\nLIMIT: float"
    )
    names = [{each.name for each in mutants.mutants_of("a.py", text)} for text in (SOURCE, more)]
    assert names[1] - names[0] == {" 4 to 5 1", ".early 1 to 2 1"}
    assert not names[0] - names[1]
    assert len(names[0]) == len(mutants.mutants_of("a.py", SOURCE))


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


PROBED = """
LIMIT = 6

class Watch:
    def __init__(self):
        self.seen = 0

    def late(self, ages, first, known):
        if known and first < 3:
            self.seen += 1
        for age in ages:
            if self.of(age) <= 4:
                return age - 2
        match first:
            case 5:
                self.of(1)
        return len(ages) + first > 30

    def of(self, age):
        return age * LIMIT
"""


@pytest.fixture
def probed(scripts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """`PROBED` with probes for all its mutants, and a function that tells which were seen."""
    (tmp_path / "a.py").write_text(PROBED, encoding="utf-8")
    probes, operators = scripts.mutant_probes, scripts.mutant_operators
    for name in ("_mutant_hit", "_mutant_compared", "_mutant_applied"):
        monkeypatch.setattr(builtins, name, None, raising=False)  # put back at the end
    monkeypatch.setattr(probes, "SOURCE", tmp_path)
    mutants = operators.mutants_of("a.py", PROBED)
    probes.install()
    space: dict[str, Any] = {}
    exec(compile(probes.probed(mutants)["a.py"], "a.py", "exec"), space)
    watch = space["Watch"]()

    def seen(*arguments: Any) -> tuple[Any, set[str], set[str]]:
        probes.taken()
        value = watch.late(*arguments)
        lines = PROBED.splitlines()
        executed, felt = (
            {f"{lines[mutants[n].line - 1].strip()}: {mutants[n].change}" for n in numbers}
            for numbers in probes.taken()
        )
        return value, executed, felt

    return seen


def test_a_probe_feels_a_mutant_only_where_its_value_differs(probed: Any) -> None:
    value, executed, felt = probed([], 0, False)
    condition = "if known and first < 3:"
    assert value is False
    assert {f"{condition}: And to Or", f"{condition}: 3 to 4"} <= executed
    assert f"{condition}: And to Or" in felt
    assert f"{condition}: 3 to 4" not in felt  # as nothing is known
    assert probed([], 3, True)[2] >= {f"{condition}: 3 to 4", f"{condition}: Lt to LtE"}
    last = "return len(ages) + first > 30"
    assert f"{last}: Gt to GtE" in executed - felt
    assert f"{last}: Gt to GtE" in probed([1], 29, True)[2]


def test_operands_with_effects_are_computed_once(probed: Any) -> None:
    condition = "if self.of(age) <= 4:"
    value, executed, felt = probed([0], 9, True)
    assert value == -2
    assert f"{condition}: LtE to Lt" in executed - felt
    assert f"{condition}: 4 to 5" in executed - felt
    assert f"{condition}: condition negated" in felt
    # A constant of the module is felt by whoever uses its name.
    assert "LIMIT = 6: 6 to 7" in felt
    assert "self.of(1): call left out" not in executed
    assert "self.of(1): call left out" in probed([], 5, True)[2]
    assert "self.seen += 1: assignment left out" in probed([], 1, True)[2]


def test_a_compiled_function_has_no_probe(
    scripts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numba would refuse it, and with it every test that needs the kernel."""
    body = "    return LIMIT * age\n"
    source = f"LIMIT = 6\n\n@njit(**OPTIONS)\ndef kernel(age):\n{body}\ndef plain(age):\n{body}"
    (tmp_path / "a.py").write_text(source, encoding="utf-8")
    monkeypatch.setattr(scripts.mutant_probes, "SOURCE", tmp_path)
    (mutant,) = [m for m in scripts.mutant_operators.mutants_of("a.py", source) if m.line == 1]
    kernel, plain = scripts.mutant_probes.probed([mutant])["a.py"].body[1:]
    assert [len(function.body) for function in (kernel, plain)] == [1, 2]


def test_what_is_called_as_the_sources_are_imported_is_known(scripts: Any) -> None:
    found = scripts.mutant_probes.called_outside_functions()
    assert "namedtuple" in found or "dataclass" in found
    assert "late" not in found


def test_what_feels_a_mutant_is_noted_for_each_test(
    scripts: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    reach, mutant = scripts.mutant_trials.Reach(), scripts.mutant_operators.Mutant("a", 1, 2, "x")
    reach.begin([mutant])
    for name, seen in (("one", ({0}, {0})), ("two", ({0}, set())), ("three", (set(), set()))):
        monkeypatch.setattr(scripts.mutant_probes, "taken", lambda seen=seen: seen)
        reach.note([mutant], name, 0.25)
    assert reach.executed == {mutant.key: {"one", "two"}}
    assert reach.felt == {mutant.key: {"one"}}
    assert reach.seconds == dict.fromkeys(("one", "two", "three"), 0.25)


def test_what_feels_a_mutant_is_kept_until_the_sources_or_its_test_change(
    scripts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials, path = scripts.mutant_trials, tmp_path / "reach.json"
    monkeypatch.setattr(trials, "SOURCE", tmp_path / "src")
    monkeypatch.setattr(trials, "ROOT", tmp_path)
    for folder in ("src", "tests"):
        (tmp_path / folder).mkdir()
    for file in ("src/a.py", "tests/conftest.py", "tests/test_a.py", "tests/test_b.py"):
        (tmp_path / file).write_text("pass", encoding="utf-8")
    assert trials.Reach.read(path) == trials.Reach()
    one, two, run = "tests/test_a.py::test_one", "tests/test_b.py::test_two", "a run"
    kept = trials.Reach({one: 0.5, two: 0.5, run: 3.0}, {"m": {one, two, run}}, {"m": {two, run}})
    kept.keep(path)
    assert trials.Reach.read(path) == kept
    (tmp_path / "tests" / "test_b.py").write_text("changed", encoding="utf-8")
    left = trials.Reach({one: 0.5, run: 3.0}, {"m": {one, run}}, {"m": {run}})
    assert trials.Reach.read(path) == left
    for file in ("src/a.py", "tests/conftest.py"):
        kept.keep(path)
        (tmp_path / file).write_text("changed", encoding="utf-8")
        assert trials.Reach.read(path) == trials.Reach()


def test_a_new_mutant_is_measured_with_all_tests_and_a_known_one_with_new_tests(
    scripts: Any,
) -> None:
    old, new = (scripts.mutant_operators.Mutant("a", n, n, "x") for n in (1, 2))
    reach = scripts.mutant_trials.Reach({"t": 0.5}, {old.key: {"t", "u"}}, {old.key: {"u"}})
    reach.begin([old])
    assert (reach.seconds, reach.executed) == ({"t": 0.5}, {old.key: {"t"}})
    assert reach.felt == {old.key: set()}
    reach.begin([old, new])
    assert (reach.seconds, reach.executed) == ({}, {old.key: set(), new.key: set()})


def test_tests_that_read_a_constant_themselves_come_first(scripts: Any, tmp_path: Path) -> None:
    trials = scripts.mutant_trials
    bench = trials.Bench([], [], tmp_path / "reach.json", 1, 0.0, print)
    table, other = "tests/links/test_leap_seconds.py::test_a", "tests/lcu/test_wire.py::test_b"
    bench._items = {table: None, other: None}
    assert bench._naming(["LEAP_SECONDS"]) == {table}
    assert bench._naming([]) == set()
    bench._reach.seconds.update({table: 3.0, other: 1.0})
    mutant = scripts.mutant_operators.Mutant("links/clock.py", 1, 2, "x")
    assert bench._shortest(mutant, {table, other}, {table})[0] == [table, other]
    assert bench._shortest(mutant, {table, other})[0] == [other, table]
    # Of the module's own file all parameters have their turn before the tests of others.
    own = [f"tests/lcu/test_wire.py::test_c[{n}]" for n in (1, 2)]
    mutant = scripts.mutant_operators.Mutant("lcu/wire.py", 1, 2, "x")
    found = bench._shortest(mutant, {table, *own})[0]
    assert (sorted(found[:2]), found[2:]) == (own, [table])


@pytest.mark.parametrize("most", [-1e9, 1e9])
def test_tests_that_are_left_out_when_the_time_is_up_find_nothing(
    tmp_path: Path, most: float
) -> None:
    """In an interpreter of its own: its status would count a mutant as found."""
    failing = tmp_path / "test_one.py"
    failing.write_text("def test_one():\n    assert False\n")
    begin = f"import sys, mutant_trials as m\nm.MOST_TESTS, m.OPTIONS = {most}, ()"
    run = f"sys.exit(m._alone('unit outside', ['test_one.py::test_one'], {str(tmp_path)!r}, 60.0))"
    path = os.pathsep.join([str(SCRIPTS), *sys.path])
    ended = subprocess.run(
        [sys.executable, "-c", f"{begin}\n{run}"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == (0 if most < 0 else 1), ended.stdout + ended.stderr


@pytest.mark.parametrize("kind", ["unit", "simulation"])
def test_a_mutant_that_stops_the_import_is_found_at_once(
    scripts: Any, tmp_path: Path, kind: str
) -> None:
    """No test begins, so none can be repeated without the mutant."""
    lines: list[dict[str, Any]] = []
    trials = scripts.mutant_trials
    mutant = scripts.mutant_operators.Mutant("links/a.py", 3, 1, "Or to And")
    bench = trials.Bench([mutant], [], tmp_path / "reach.json", 1, 0.0, lines.append)
    bench._judge(trials.Trial(f"{kind} outside", mutant, ["one"], 1.0), good=False)
    assert [(line["trial"], line["by"]) for line in lines] == [(kind, "import")]
    assert not bench._ready


def test_the_table_counts_and_names_survivors(scripts: Any) -> None:
    lines = [
        {
            "mutant": name,
            "package": package,
            "unit": unit,
            "simulation": run,
            "executed": seen,
            "felt": run,
            "seconds": 3.0,
        }
        for name, package, unit, run, seen in (
            ("lcu/a.py:1", "lcu", True, False, True),
            ("lcu/b.py:2", "lcu", False, False, False),
            ("plant/c.py:3", "plant", True, True, True),
        )
    ]
    text = scripts.mutants.table(lines)
    assert "| lcu | 2 | 1 | 0 | 1 | 1 | 1 | 1 |" in text
    assert "| all | 3 | 2 | 1 | 2 | 1 | 1 | 1 |" in text
    assert "- computed: 3.0 s of one core a mutant" in text
    assert "- by the simulation, of those it executes: 50 % (9 to 91 %)" in text
    assert text.endswith("- survived: `lcu/b.py:2`")


def test_an_interval_is_wilsons(scripts: Any) -> None:
    """With no hit in n tries it ends at z² / (n + z²)."""
    assert scripts.mutants.interval(0, 10) == "0 % (0 to 28 %)"
    assert scripts.mutants.interval(0, 0) == "–"


def test_trials_are_joined_and_the_later_counts(scripts: Any, tmp_path: Path) -> None:
    mutant = scripts.mutant_operators.Mutant("lcu/a.py", 3, 7, "1 to 2")
    path = tmp_path / "mutants.jsonl"
    line = {"mutant": mutant.key, "package": "lcu", "executed": 2, "felt": 1, "seconds": 0.1}
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
    assert joined["seconds"] == pytest.approx(0.2)
