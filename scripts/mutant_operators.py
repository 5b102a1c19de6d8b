"""The small errors that `mutants.py` plants: one change to one expression or statement each."""

import ast
import copy
import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "src" / "heliotrope"
PACKAGES = ("lcu", "links", "cluster", "plant", "safety")
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
    name
        Identity that outlives changes elsewhere in the file: function, change, and which of them.
    """

    file: str
    place: int
    line: int
    change: str
    name: str = ""

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
    """Return the children of a node in which nothing is changed.

    They are annotations, decorators (a class that is no longer frozen does the same), texts of
    errors, and assertions, of which ``strict`` of ``zip`` is one.
    """
    match node:
        case ast.AnnAssign(annotation=annotation):
            return (annotation,)
        case ast.arg(annotation=ast.AST() as annotation):
            return (annotation,)
        case ast.FunctionDef(decorator_list=some, returns=returns):
            return (*some, *([] if returns is None else [returns]))
        case ast.AsyncFunctionDef(decorator_list=some, returns=returns):
            return (*some, *([] if returns is None else [returns]))
        case ast.ClassDef(decorator_list=some):
            return tuple(some)
        case ast.keyword(arg="strict"):
            return (node.value,)
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


def _scopes(tree: ast.AST, scope: str, found: dict[ast.AST, str]) -> dict[ast.AST, str]:
    """Note for each node the function or class that it stands in."""
    found[tree] = scope
    if isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        scope = f"{scope}.{tree.name}"
    for child in ast.iter_child_nodes(tree):
        _scopes(child, scope, found)
    return found


def mutants_of(file: str, source: str) -> list[Mutant]:
    """Return all mutants of a file."""
    tree, found, times = ast.parse(source), [], Counter[tuple[str, str]]()
    scopes = _scopes(tree, "", {})
    for place, node in enumerate(walk(tree)):
        for words, _ in changed(node):
            like = scopes[node], words
            times[like] += 1
            name = f"{scopes[node]} {words} {times[like]}"
            found.append(Mutant(file, place, getattr(node, "lineno", 0), words, name))
    return found


class _Change(ast.NodeTransformer):
    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self._old, self._new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        if node is self._old:
            return ast.copy_location(self._new, node)
        return self.generic_visit(node)


def planted(mutant: Mutant, source: str) -> ast.Module:
    """Return the tree of a file with one mutant in it, its lines those of the source."""
    tree = ast.parse(source)
    node = next(node for place, node in enumerate(walk(tree)) if place == mutant.place)
    new = next(new for words, new in changed(node) if words == mutant.change)
    found = _Change(node, new).visit(tree)
    assert isinstance(found, ast.Module)
    ast.fix_missing_locations(found)
    return found


def mutated(mutant: Mutant, source: str) -> str:
    """Return the text of a file with one mutant in it."""
    return ast.unparse(planted(mutant, source)) + "\n"


def sampled(count: int, seed: int, below: Sequence[str] = PACKAGES) -> list[Mutant]:
    """Return a seeded sample of the mutants of some packages or files, in random order.

    Each mutant is drawn by its own name, so a change of the sources changes the sample no further
    than it changes mutants: survivors of one tree can be looked for in the next. ``below``
    are paths below `SOURCE`.
    """
    paths = {
        path
        for each in below
        for path in ((SOURCE / each).rglob("*.py") if (SOURCE / each).is_dir() else [SOURCE / each])
    }
    found = [
        mutant
        for path in sorted(paths)
        for mutant in mutants_of(str(path.relative_to(SOURCE)), path.read_text(encoding="utf-8"))
    ]
    return sorted(found, key=lambda each: _lot(each, seed))[:count]


def _lot(mutant: Mutant, seed: int) -> bytes:
    return hashlib.sha256(f"{seed} {mutant.file} {mutant.name}".encode()).digest()


def make_tree(mutant: Mutant, folder: Path) -> None:
    """Make a tree of sources with one mutant: links to everything but the changed file."""
    here, there, parts = SOURCE, folder / "heliotrope", Path(mutant.file).parts
    for part in parts:
        there.mkdir(parents=True)
        for each in here.iterdir():
            if each.name != part:
                (there / each.name).symlink_to(each)
        here, there = here / part, there / part
    there.write_text(mutated(mutant, here.read_text(encoding="utf-8")), encoding="utf-8")
