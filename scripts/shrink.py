"""Shrink the local controller's modules for a board: the same code in less memory.

MicroPython does none of this itself:

- integer constants replace their names, in other modules too;
- the names of the states, which only the state table uses there, become letters;
- code that no board calls is left out (the sender's side of the wire, texts for people);
- private attributes get short names, which classes share: each name of its own costs memory, and
  their table grows at once by 4 kB;
- docstrings, annotations and code for the type checker are left out, and the texts of ValueError,
  which a board answers with "value out of range".

Nothing else changes, so a traceback names the same functions.
"""

import ast
import importlib
import re
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import TypeVar

CORE = Path(__file__).parents[1] / "src" / "heliotrope" / "lcu"
PACKAGE = "heliotrope.lcu"

#: A definition: module and name.
Key = tuple[str, str]
Documented = TypeVar("Documented", ast.FunctionDef, ast.ClassDef)


class Module:
    """One parsed module, with the names that it defines and imports."""

    def __init__(self, name: str, text: str) -> None:
        self.name = name
        self.tree = ast.parse(text)
        self.tree.body = [node for node in self.tree.body if not _typing_only(node)]
        self.modules: dict[str, str] = {}
        self.taken: dict[str, Key] = {}
        self.definitions: dict[str, ast.stmt] = {}
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom) and node.level:
                for alias in node.names:
                    if node.module is None:
                        self.modules[alias.asname or alias.name] = alias.name
                    else:
                        self.taken[alias.asname or alias.name] = (node.module, alias.name)
        for node in self.tree.body:
            for word in _defined(node):
                self.definitions[word] = node

    def meant(self, node: ast.AST) -> "Key | None":
        """Return the definition that an expression names, None if it is not in these modules."""
        if isinstance(node, ast.Name):
            if node.id in self.taken:
                return self.taken[node.id]
            return (self.name, node.id) if node.id in self.definitions else None
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = self.modules.get(node.value.id)
            return None if owner is None else (owner, node.attr)
        return None


def _typing_only(node: ast.stmt) -> bool:
    if isinstance(node, ast.If):
        return ast.unparse(node.test) == "TYPE_CHECKING"
    return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "TYPE_CHECKING"


def _defined(node: ast.stmt) -> list[str]:
    """Return the names that a statement at the top of a module defines."""
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        return [node.name]
    if isinstance(node, (ast.Assign, ast.AnnAssign)):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        return [
            inner.id
            for target in targets
            for inner in ast.walk(target)
            if isinstance(inner, ast.Name) and isinstance(inner.ctx, ast.Store)
        ]
    return []


def constants(modules: dict[str, Module], loaded: dict[str, ModuleType]) -> dict[Key, int]:
    """Return the integers that are defined once, at the top of a module, in capitals.

    Texts composed of others at import are written out in place.
    """
    found = {}
    for name, module in modules.items():
        for word, node in module.definitions.items():
            value = getattr(loaded[name], word)
            if word.isupper() and type(value) is int:
                found[name, word] = value
            elif word.isupper() and type(value) is str and isinstance(node, ast.Assign):
                node.value = ast.copy_location(ast.Constant(value), node.value)
    return found


def letters(module: Module) -> None:
    """Replace the names in ``STATES`` by letters, and so in columns 1 and 3 of ``TABLE``."""
    names, table = (module.definitions[word] for word in ("STATES", "TABLE"))
    assert isinstance(names, ast.Assign)
    assert isinstance(table, ast.Assign)
    text: str = ast.literal_eval(table.value)
    short = {name: chr(ord("A") + i) for i, name in enumerate(ast.literal_eval(names.value))}
    text = re.sub(
        r"(?m)^(\w+) (\w+) (\w+)", lambda row: f"{short[row[1]]} {row[2]} {short[row[3]]}", text
    )
    table.value = ast.copy_location(ast.Constant(text), table.value)
    names.value = ast.copy_location(ast.Constant("".join(short.values())), names.value)


def shared_names(modules: Iterable[Module]) -> dict[str, str]:
    """Return a short name for each private attribute that is no method.

    Two attributes may share one if no class uses both on itself.
    """
    methods, together = set(), []
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.FunctionDef):
                methods.add(node.name)
            elif isinstance(node, ast.ClassDef):
                assert all(ast.unparse(base) in ("Protocol", "Base") for base in node.bases)
                together.append(
                    {
                        inner.attr
                        for inner in ast.walk(node)
                        if isinstance(inner, ast.Attribute) and ast.unparse(inner.value) == "self"
                    }
                )
    private = {
        name
        for names in together
        for name in names
        if name.startswith("_") and not name.startswith("__") and name not in methods
    }
    found: dict[str, str] = {}
    for name in sorted(private):
        taken = {
            found[other] for names in together if name in names for other in names & set(found)
        }
        found[name] = next(short for i in range(len(private)) if (short := f"_{i}") not in taken)
    return found


class _Inliner(ast.NodeTransformer):
    """Replaces names of constants by their values; drops docstrings and annotations."""

    def __init__(self, module: Module, numbers: dict[Key, int], short: dict[str, str]) -> None:
        self.module, self.numbers, self.short = module, numbers, short

    def visit_Name(self, node: ast.Name) -> ast.expr:
        return self._replaced(node)

    def visit_Attribute(self, node: ast.Attribute) -> ast.AST:
        replaced = self._replaced(node)
        if replaced is not node:
            return replaced
        node.attr = self.short.get(node.attr, node.attr)
        return self.generic_visit(node)

    def _replaced(self, node: "ast.Name | ast.Attribute") -> ast.expr:
        meant = self.module.meant(node)
        if isinstance(node.ctx, ast.Load) and meant in self.numbers:
            return ast.copy_location(ast.Constant(self.numbers[meant]), node)
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> "ast.ImportFrom | None":
        if node.module and node.level:
            node.names = [
                alias for alias in node.names if (node.module, alias.name) not in self.numbers
            ]
        return node if node.names else None

    def visit_AnnAssign(self, node: ast.AnnAssign) -> "ast.Assign | None":
        if node.value is None:
            return None
        plain = ast.Assign([self.visit(node.target)], self.visit(node.value))
        return ast.fix_missing_locations(ast.copy_location(plain, node))

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        node.returns = None
        for argument in (*node.args.args, *node.args.kwonlyargs):
            argument.annotation = None
        if node.args.vararg is not None:
            node.args.vararg.annotation = None
        return self.generic_visit(_undocumented(node))

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        if isinstance(node.exc, ast.Call) and ast.unparse(node.exc.func) == "ValueError":
            node.exc = node.exc.func
        return self.generic_visit(node)

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        return self.generic_visit(_undocumented(node))


def _undocumented(node: Documented) -> Documented:
    if ast.get_docstring(node) is not None:
        node.body = node.body[1:] or [ast.Pass()]
    return node


class _Reach:
    """The definitions that are called from some roots, directly or through others.

    A method counts as called if its name occurs anywhere in called code, as an attribute or as a
    word of a text (the state table names the motions). That keeps more than needed, never less. All
    public methods of a class that is a root count as called.
    """

    def __init__(self, modules: dict[str, Module], roots: Iterable[Key]) -> None:
        self.modules = modules
        self.keys: set[Key] = set()
        self.words: set[str] = set()
        self._seen: set[int] = set()
        self._classes: list[tuple[Module, ast.ClassDef]] = []
        for module in modules.values():
            for node in module.tree.body:
                if not _defined(node) and not isinstance(node, (ast.Import, ast.ImportFrom)):
                    self._read(module, node)
        for key in roots:
            self._reach(key)
            root = modules[key[0]].definitions[key[1]]
            if isinstance(root, ast.ClassDef):
                self.words |= {
                    node.name
                    for node in root.body
                    if isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
                }
        size = -1
        while size != len(self._seen):
            size = len(self._seen)
            for module, owner in list(self._classes):
                for node in owner.body:
                    if self.keeps(node):
                        self._read(module, node)

    def keeps(self, node: ast.stmt) -> bool:
        """Return whether a statement in the body of a class is needed."""
        if isinstance(node, ast.FunctionDef):
            return node.name in self.words or node.name.startswith("__")
        return True

    def _reach(self, key: Key) -> None:
        if key in self.keys or key[0] not in self.modules:
            return
        module = self.modules[key[0]]
        if key[1] not in module.definitions:
            raise KeyError(f"{key[0]}.py defines no {key[1]}")
        self.keys.add(key)
        node = module.definitions[key[1]]
        if isinstance(node, ast.ClassDef):
            self._classes.append((module, node))
            for outer in (*node.bases, *node.decorator_list):
                self._read(module, outer)
        else:
            self._read(module, node)

    def _read(self, module: Module, node: ast.AST) -> None:
        if id(node) in self._seen:
            return
        self._seen.add(id(node))
        for inner in ast.walk(node):
            if isinstance(inner, ast.Attribute):
                self.words.add(inner.attr)
            elif isinstance(inner, ast.Constant) and isinstance(inner.value, str):
                self.words.update(inner.value.split())
            meant = module.meant(inner)
            if meant is not None and isinstance(getattr(inner, "ctx", None), ast.Load):
                self._reach(meant)


def _emit(module: Module, reach: _Reach) -> str:
    """Return a module's text with only the definitions that are called."""
    body: list[ast.stmt] = []
    for node in module.tree.body:
        names = _defined(node)
        if names and not any((module.name, name) in reach.keys for name in names):
            continue
        if isinstance(node, ast.ClassDef):
            node.body = [inner for inner in node.body if reach.keeps(inner)] or [ast.Pass()]
        body.append(node)
    rest = [node for node in body if not isinstance(node, (ast.Import, ast.ImportFrom))]
    used = {inner.id for node in rest for inner in ast.walk(node) if isinstance(inner, ast.Name)}
    kept: list[ast.stmt] = []
    for node in body:
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            node.names = [a for a in node.names if (a.asname or a.name) in used]
            if not node.names:
                continue
        kept.append(node)
    if kept and isinstance(kept[0], ast.Expr):
        kept = kept[1:]  # the module's docstring
    return ast.unparse(ast.Module(kept, [])) + "\n"


def shrink(roots: Iterable[Key], folder: Path = CORE, package: str = PACKAGE) -> dict[str, str]:
    """Return the texts of the modules that a board needs, by name.

    Parameters
    ----------
    roots
        Definitions that the board calls: module and name.
    folder, package
        Folder of the modules, and the package that they are imported from here.

    Raises
    ------
    KeyError
        If no module defines a root.
    """
    modules = {
        path.stem: Module(path.stem, path.read_text(encoding="utf-8"))
        for path in sorted(folder.glob("*.py"))
        if path.stem != "__init__"
    }
    loaded = {name: importlib.import_module(f"{package}.{name}") for name in modules}
    numbers = constants(modules, loaded)
    if "states" in modules:
        letters(modules["states"])
    short = shared_names(modules.values())
    for module in modules.values():
        _Inliner(module, numbers, short).visit(module.tree)
    reach = _Reach(modules, roots)
    needed = {name for name, _ in reach.keys}
    return {"__init__": ""} | {
        name: _emit(module, reach) for name, module in modules.items() if name in needed
    }
