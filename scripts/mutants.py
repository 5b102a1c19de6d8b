"""Mutation score of the control code: small errors planted one at a time, and what finds them.

Each mutant is one change to one expression or statement of `lcu`, `links`, `cluster`, `plant` or
`safety`. The unit tests of its package run on it first, then the simulation. Run as
``python scripts/mutants.py --sample 500 --progress out/mutants.jsonl``; a run that was stopped goes
on where it was.
"""

import argparse
import ast
import copy
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "heliotrope"
PACKAGES = ("lcu", "links", "cluster", "plant", "safety")
#: Runs of the simulation that a mutant must survive: first seed, number, options.
WORLDS = (
    ("11", "2", ("--world", "calm", "--pause", "60")),
    ("21", "2", ("--world", "swarm")),
    ("31", "2", ()),
)
_SIMULATE = "from heliotrope.cli import main; main()"
#: Time limits of the unit tests and of each world, s; a mutant that hangs is found.
UNIT_LIMIT, WORLD_LIMIT = 900.0, 600.0

_COMPARED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_COUNTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.FloorDiv, ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One planted error.

    Attributes
    ----------
    file
        Path below `SOURCE`.
    place
        Number of the changed node in a walk of the file's tree.
    line
        Its line.
    change
        The change in words.
    """

    file: str
    place: int
    line: int
    change: str

    @property
    def key(self) -> str:
        """Identity in the progress file."""
        return f"{self.file}:{self.line} [{self.place}] {self.change}"


def changed(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Yield the changes of one node: words, and the node that takes its place."""
    new: Any = copy.copy(node)
    match node:
        case ast.Compare(ops=[op]) if type(op) in _COMPARED:
            new.ops = [_COMPARED[type(op)]()]
            yield f"{type(op).__name__} to {type(new.ops[0]).__name__}", new
        case ast.BoolOp(op=op):
            new.op = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield f"{type(op).__name__} to {type(new.op).__name__}", new
        case ast.UnaryOp(op=ast.Not()):
            yield "not left out", new.operand
        case ast.BinOp(op=op, left=left) if type(op) in _COUNTED and not _is_text(left):
            new.op = _COUNTED[type(op)]()
            yield f"{type(op).__name__} to {type(new.op).__name__}", new
        case ast.Constant(value=bool(value)):
            yield f"{value} to {not value}", ast.Constant(not value)
        case ast.Constant(value=int(value) | float(value)):
            yield f"{value} to {value + 1}", ast.Constant(value + 1)
        case ast.If(test=test) if not _is_type_checking(test):
            new.test = ast.UnaryOp(ast.Not(), new.test)
            yield "condition negated", new
        case ast.Expr(value=ast.Call()):
            yield "call left out", ast.Pass()
        case ast.Assign(targets=[ast.Attribute()]) | ast.AugAssign():
            yield "assignment left out", ast.Pass()


def _is_text(node: ast.AST) -> bool:
    return isinstance(node, ast.JoinedStr) or (
        isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)
    )


def _is_type_checking(test: ast.AST) -> bool:
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def _spared(node: ast.AST) -> tuple[ast.AST, ...]:
    """Return the children of a node in which nothing is changed: annotations, errors' texts."""
    match node:
        case ast.AnnAssign(annotation=annotation):
            return (annotation,)
        case ast.arg(annotation=ast.AST() as annotation):
            return (annotation,)
        case ast.FunctionDef(decorator_list=some, returns=returns):
            return (*some, *([] if returns is None else [returns]))
        case ast.AsyncFunctionDef(decorator_list=some, returns=returns):
            return (*some, *([] if returns is None else [returns]))
        case ast.Raise() | ast.JoinedStr() | ast.Assert():
            return tuple(ast.iter_child_nodes(node))
    return ()


def walk(tree: ast.AST) -> Iterator[ast.AST]:
    """Walk the nodes that may be changed, always in the same order."""
    yield tree
    spared = _spared(tree)
    for child in ast.iter_child_nodes(tree):
        if child not in spared:
            yield from walk(child)


def mutants_of(file: str, source: str) -> list[Mutant]:
    """Return all mutants of a file."""
    return [
        Mutant(file, place, getattr(node, "lineno", 0), words)
        for place, node in enumerate(walk(ast.parse(source)))
        for words, _ in changed(node)
    ]


class _Change(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self._old, self._new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        if node is self._old:
            return ast.copy_location(self._new, node)
        return self.generic_visit(node)


def mutated(mutant: Mutant, source: str) -> str:
    """Return the text of a file with one mutant in it."""
    tree = ast.parse(source)
    node = next(node for place, node in enumerate(walk(tree)) if place == mutant.place)
    new = next(new for words, new in changed(node) if words == mutant.change)
    return ast.unparse(ast.fix_missing_locations(_Change(node, new).visit(tree))) + "\n"


def sampled(count: int, seed: int) -> list[Mutant]:
    """Return a seeded sample of the mutants of all packages."""
    found = [
        mutant
        for package in PACKAGES
        for path in sorted((SOURCE / package).rglob("*.py"))
        for mutant in mutants_of(str(path.relative_to(SOURCE)), path.read_text(encoding="utf-8"))
    ]
    return random.Random(seed).sample(found, min(count, len(found)))


# -- running -----------------------------------------------------------------------------------


def _planted(mutant: Mutant, folder: Path) -> Path:
    """Make a tree of sources with one mutant: links to everything but the changed file."""
    here, there, parts = SOURCE, folder / "heliotrope", Path(mutant.file).parts
    for part in parts:
        there.mkdir(parents=True)
        for each in here.iterdir():
            if each.name != part:
                (there / each.name).symlink_to(each)
        here, there = here / part, there / part
    there.write_text(mutated(mutant, here.read_text(encoding="utf-8")), encoding="utf-8")
    return folder


def _fails(command: Sequence[str], sources: Path, limit: float) -> bool:
    """Run a command on planted sources; True if it fails, or takes too long."""
    paths = os.pathsep.join([str(sources), str(ROOT / "tests")])
    env = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(  # noqa: S603 - this interpreter
            [sys.executable, *command],
            cwd=ROOT, env=env, capture_output=True, timeout=limit, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return True
    return done.returncode != 0


def _tests_of(mutant: Mutant) -> tuple[list[str], list[str]]:
    """Return the tests of a mutant's package: those that name its module, and the others."""
    path = Path(mutant.file)
    tests = sorted((ROOT / "tests" / path.parts[0]).rglob("test_*.py"))
    near = [t for t in tests if path.stem.strip("_") in t.read_text(encoding="utf-8")]
    return [str(t) for t in near], [str(t) for t in tests if t not in near]


def judged(mutant: Mutant, *, far: bool) -> dict[str, Any]:
    """Try a mutant; ``far``: also by the tests of its package that do not name its module."""
    begin = time.monotonic()
    options = ("-q", "-x", "-m", "not slow", "-p", "no:cacheprovider")
    with tempfile.TemporaryDirectory() as folder:
        sources = _planted(mutant, Path(folder))
        near, others = _tests_of(mutant)
        rounds = [near, others] if far else [near]
        unit = any(
            _fails(("-m", "pytest", *options, *tests), sources, UNIT_LIMIT)
            for tests in rounds
            if tests
        )
        simulated = any(
            _fails(
                ("-c", _SIMULATE, "simulate", "--seed", seed, "--runs", runs, "--hours", "0.05",
                 "--heliostats", "3", *more),
                sources, WORLD_LIMIT,
            )
            for seed, runs, more in WORLDS
        )  # fmt: skip
    return {
        "mutant": mutant.key, "package": Path(mutant.file).parts[0], "unit": unit,
        "simulation": simulated, "seconds": round(time.monotonic() - begin, 1),
    }  # fmt: skip


def table(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table and the survivors as Markdown."""
    rows = ["| package | mutants | by unit tests | by simulation | by either | survived |"]
    rows.append("|---|---|---|---|---|---|")
    names = [p for p in PACKAGES if any(line["package"] == p for line in lines)]
    for name in [*names, "all"]:
        some = [line for line in lines if name in (line["package"], "all")]
        count = Counter[str]()
        for line in some:
            count["unit"] += line["unit"]
            count["simulation"] += line["simulation"]
            count["either"] += line["unit"] or line["simulation"]
        left = len(some) - count["either"]
        rows.append(
            f"| {name} | {len(some)} | {count['unit']} | {count['simulation']} "
            f"| {count['either']} | {left} |"
        )
    survived = [line["mutant"] for line in lines if not (line["unit"] or line["simulation"])]
    return "\n".join([*rows, "", *(f"- survived: `{each}`" for each in survived)])


def measure(
    todo: Sequence[Mutant], known: dict[str, dict[str, Any]], processes: int, minutes: float,
    keep: Callable[[dict[str, Any]], None], *, far: bool,
) -> None:  # fmt: skip
    """Try the mutants that are not known yet, until all are tried or the time is up."""
    end = time.monotonic() + 60.0 * minutes

    def one(mutant: Mutant) -> dict[str, Any] | None:
        return judged(mutant, far=far) if time.monotonic() < end else None

    with ThreadPoolExecutor(processes) as pool:
        waiting = [pool.submit(one, each) for each in todo if each.key not in known]
        for each in as_completed(waiting):
            line = each.result()
            if line is not None:
                keep(line)


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sample", type=int, default=500, help="mutants to try")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--minutes", type=float, default=600.0, help="begin no mutant after this")
    parser.add_argument("--progress", type=Path, default=ROOT / "out" / "mutants.jsonl")
    parser.add_argument("--near", action="store_true", help="only tests that name the module")
    given = parser.parse_args()
    todo = sampled(given.sample, given.seed)
    progress: Path = given.progress
    progress.parent.mkdir(parents=True, exist_ok=True)
    lines = progress.read_text(encoding="utf-8").splitlines() if progress.exists() else []
    known = {line["mutant"]: line for line in map(json.loads, lines)}

    def keep(line: dict[str, Any]) -> None:
        known[line["mutant"]] = line
        with progress.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")

    measure(todo, known, given.processes, given.minutes, keep, far=not given.near)
    done = [known[each.key] for each in todo if each.key in known]
    print(f"{len(done)} of {len(todo)} mutants tried, seed {given.seed}\n\n{table(done)}")


if __name__ == "__main__":
    main()
