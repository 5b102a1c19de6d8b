"""Which tests and runs can notice a mutant: probes in the unchanged code, for all mutants at once.

A mutant is *executed* where its statement runs, and *felt* where the changed expression has another
value than the unchanged one. Whatever feels nothing ends as on the unchanged code, so it need not
be tried. One pass of the tests and the runs of the simulation with probes tells this for a whole
sample. A probe gives the unchanged value on; the changed one is computed beside it where that
has no effect of its own: the widest expression without calls, so that a limit of 6 or 7 s is not
felt by an age of 1 s. Elsewhere, being executed counts as being felt.
"""

import ast
import builtins
import copy
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from mutant_operators import SOURCE, Mutant, changed, walk

#: Numbers of the mutants executed and felt since `taken`.
_executed: set[int] = set()
_felt: set[int] = set()
_PURE = (
    ast.Name, ast.Attribute, ast.Constant, ast.Compare, ast.BoolOp, ast.UnaryOp, ast.BinOp,
    ast.Subscript, ast.Tuple, ast.IfExp, ast.expr_context, ast.operator, ast.cmpop, ast.boolop,
    ast.unaryop,
)  # fmt: skip
_PURE_CALLS = ("abs", "bool", "float", "int", "isinstance", "len", "max", "min")
_HIT, _COMPARED, _APPLIED = "_mutant_hit", "_mutant_compared", "_mutant_applied"


def taken() -> tuple[set[int], set[int]]:
    """Return the numbers of the mutants executed and felt since the last call."""
    found = set(_executed), set(_felt)
    _executed.clear()
    _felt.clear()
    return found


def _hit(number: int, value: Any = None) -> Any:
    _executed.add(number)
    _felt.add(number)
    return value


def _same(one: Any, two: Any) -> bool:
    return type(one) is type(two) and bool(one == two)


def _compared(number: int, value: Any, other: Callable[[], Any]) -> Any:
    _executed.add(number)
    if number not in _felt:
        try:
            same = _same(value, other())
        except Exception:  # noqa: BLE001 - the changed expression fails: that is felt
            same = False
        if not same:
            _felt.add(number)
    return value


def _applied(
    number: int, left: Any, right: Any, old: Callable[[Any, Any], Any], new: Callable[..., Any]
) -> Any:
    return _compared(number, old(left, right), lambda: new(left, right))


def install() -> None:
    """Make the functions known to code in which probes are."""
    for name, function in ((_HIT, _hit), (_COMPARED, _compared), (_APPLIED, _applied)):
        setattr(builtins, name, function)


def _is_pure(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        known = isinstance(node.func, ast.Name) and node.func.id in _PURE_CALLS
        return known and not node.keywords and all(map(_is_pure, node.args))
    return isinstance(node, _PURE) and all(map(_is_pure, ast.iter_child_nodes(node)))


class _Planting(ast.NodeTransformer):
    """Puts wrappers around expressions and marks before statements, the inner ones first."""

    def __init__(self) -> None:
        self.wrappers: dict[int, list[Callable[[ast.AST], ast.AST]]] = defaultdict(list)
        self.outer: dict[int, list[Callable[[ast.AST], ast.AST]]] = defaultdict(list)
        self.marks: dict[int, list[int]] = defaultdict(list)
        self.entries: dict[int, set[int]] = defaultdict(set)

    def visit(self, node: ast.AST) -> Any:
        place = id(node)
        new = self.generic_visit(node)
        for wrap in (*self.wrappers.get(place, ()), *self.outer.get(place, ())):
            new = ast.copy_location(wrap(new), node)
        if isinstance(new, ast.FunctionDef | ast.AsyncFunctionDef):
            new.body[:0] = [_mark(number) for number in sorted(self.entries.get(place, ()))]
        if place in self.marks:
            return [*map(_mark, self.marks[place]), new]
        return new


def _mark(number: int) -> ast.stmt:
    return ast.Expr(_call(_HIT, ast.Constant(number)))


def _call(name: str, *arguments: Any) -> ast.Call:
    return ast.Call(ast.Name(name, ast.Load()), list(arguments), [])


def _function(body: Any, *names: str) -> ast.Lambda:
    known = [ast.arg(name) for name in names]
    return ast.Lambda(ast.arguments([], known, None, [], [], None, []), body)


def _replaced(top: ast.AST, node: ast.AST, new: ast.AST) -> Any:
    """Return a copy of an expression in which one node is another."""
    return copy.deepcopy(top, {id(node): copy.deepcopy(new)})


def _plant(number: int, mutant: Mutant, chain: Sequence[ast.AST], planting: _Planting) -> None:
    node = chain[-1]
    if isinstance(node, ast.If):
        planting.outer[id(node.test)].append(lambda inner: _call(_HIT, ast.Constant(number), inner))
        return
    if isinstance(node, ast.stmt):
        planting.marks[id(node)].append(number)
        return
    if any(isinstance(each, ast.pattern) for each in chain):
        match = next(each for each in reversed(chain) if isinstance(each, ast.stmt))
        planting.marks[id(match)].append(number)
        return
    new: Any = next(new for words, new in changed(node) if words == mutant.change)
    depth = len(chain) - 1
    while _is_pure(chain[depth]) and _is_read(chain[depth - 1]) and _is_pure(chain[depth - 1]):
        depth -= 1
    top, over = chain[depth], chain[depth - 1]
    if not _is_pure(top):
        sides = isinstance(node, ast.BinOp | ast.Compare)
        kept = _sides(new) if sides else None
        planting.wrappers[id(node)].append(lambda inner: _both_sides(number, inner, kept))
    elif isinstance(over, ast.BinOp) or (isinstance(over, ast.Compare) and len(over.ops) == 1):
        kept = _sides(over, top, _replaced(top, node, new))
        planting.wrappers[id(over)].append(lambda inner: _both_sides(number, inner, kept))
    else:
        other = _function(_replaced(top, node, new))
        planting.wrappers[id(top)].append(
            lambda inner: _call(_COMPARED, ast.Constant(number), inner, other)
        )


def _is_read(node: ast.AST) -> bool:
    return isinstance(node, ast.expr) and isinstance(getattr(node, "ctx", ast.Load()), ast.Load)


def _sides(node: ast.AST, side: ast.AST | None = None, new: Any = None) -> ast.Lambda:
    """Return an operator as a function of its sides, one of which may be another expression."""
    one, two = ast.Name("one", ast.Load()), ast.Name("two", ast.Load())
    if isinstance(node, ast.BinOp):
        left, right = (new if side is s else n for s, n in ((node.left, one), (node.right, two)))
        return _function(ast.BinOp(left, node.op, right), "one", "two")
    assert isinstance(node, ast.Compare)
    left, right = (
        new if side is s else n for s, n in ((node.left, one), (node.comparators[0], two))
    )
    return _function(ast.Compare(left, node.ops, [right]), "one", "two")


def _both_sides(number: int, inner: Any, new: ast.Lambda | None) -> ast.AST:
    """Apply both operators to sides that are computed once, for another mutant too."""
    if new is not None and isinstance(inner, ast.BinOp | ast.Compare):
        right = inner.right if isinstance(inner, ast.BinOp) else inner.comparators[0]
        return _call(_APPLIED, ast.Constant(number), inner.left, right, _sides(inner), new)
    if new is not None and isinstance(inner, ast.Call) and _is_named(inner.func, _APPLIED):
        left, right = inner.args[1:3]
        inner.args[1:3] = ast.Name("one", ast.Load()), ast.Name("two", ast.Load())
        return _call(
            _APPLIED, ast.Constant(number), left, right, _function(inner, "one", "two"), new
        )
    return _call(_HIT, ast.Constant(number), inner)


def _is_named(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


def chain_to(tree: ast.AST, place: int) -> list[ast.AST]:
    """Return the nodes from the root of a tree to the one of a mutant."""
    wanted = next(node for at, node in enumerate(walk(tree)) if at == place)

    def above(node: ast.AST) -> list[ast.AST]:
        if node is wanted:
            return [node]
        for child in ast.iter_child_nodes(node):
            found = above(child)
            if found:
                return [node, *found]
        return []

    return above(tree)


def function_of(chain: Sequence[ast.AST]) -> str:
    """Return the name of the function in whose body the last node is; "" outside functions."""
    for each in reversed(chain[:-1]):
        is_function = isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)
        if is_function and any(line in chain for line in each.body):
            return str(each.name)
    return ""


def words(chain: Sequence[ast.AST]) -> list[str]:
    """Return the names that a mutant outside functions is used by."""
    for node in reversed(chain):
        match node:
            case ast.AnnAssign(target=ast.Name(id=name)):
                return [name]
            case ast.Assign(targets=targets):
                return [n.id for t in targets for n in ast.walk(t) if isinstance(n, ast.Name)]
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                return [name]
    return []


def _uses(function: ast.AST) -> set[str]:
    found = set()
    for node in ast.walk(function):
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name) | ast.keyword(arg=str(name)):
                found.add(name)
    return found


def _is_compiled(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """Whether numba compiles it, which knows no probes; kernels are parts of lower packages."""
    return any("njit" in _uses(each) for each in function.decorator_list)


def called_outside_functions() -> set[str]:
    """Return the names of functions that the sources call as they are imported."""

    def outside(node: ast.AST) -> Iterator[ast.AST]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                for each in child.decorator_list:
                    yield each
                    yield from outside(each)
            elif not isinstance(child, ast.Lambda):
                yield child
                yield from outside(child)

    found = set()
    for path in SOURCE.rglob("*.py"):
        for node in outside(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call):
                found |= _uses(node.func)
    return found


def probed(mutants: Sequence[Mutant]) -> dict[str, ast.Module]:
    """Return the trees of all files that must change, with probes for mutants by their numbers.

    A mutant outside functions is executed and felt by every function that uses its name.
    """
    inside: dict[str, list[int]] = defaultdict(list)
    named: dict[str, set[int]] = defaultdict(set)
    for number, mutant in enumerate(mutants):
        source = (SOURCE / mutant.file).read_text(encoding="utf-8")
        chain = chain_to(ast.parse(source), mutant.place)
        if function_of(chain):
            inside[mutant.file].append(number)
        else:
            for word in words(chain):
                named[word].add(number)
    found = {}
    for path in sorted(SOURCE.rglob("*.py")):
        file = str(path.relative_to(SOURCE))
        tree, planting = ast.parse(path.read_text(encoding="utf-8")), _Planting()
        for number in inside[file]:
            chain = chain_to(tree, mutants[number].place)
            _plant(number, mutants[number], chain, planting)
        if named:
            for node in ast.walk(tree):
                kinds = ast.FunctionDef | ast.AsyncFunctionDef
                if isinstance(node, kinds) and not _is_compiled(node):
                    for word in named.keys() & _uses(node):
                        planting.entries[id(node)] |= named[word]
        if planting.wrappers or planting.outer or planting.marks or planting.entries:
            new = planting.visit(tree)
            assert isinstance(new, ast.Module)
            found[file] = ast.fix_missing_locations(new)
    return found
