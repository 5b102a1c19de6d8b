"""Make docs/reference/limits.md: the limits, periods and defaults of the control code."""

import ast
import dataclasses
import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
PAGE = "docs/reference/limits.md"
PACKAGES = ("safety", "plant", "cluster", "lcu", "links")
SAID = """# Limits and periods

This page lists, by module, every named number of the control code with its meaning, and the default
of every numeric setting. It is generated from the code (`python -m scripts.pages`), and a test
fails if the page and the code differ, so that no limit changes unnoticed. A name that begins with
an underscore is private to its module. A meaning that covers several names is repeated for each of
them, and explains them in the order in which they are listed. The settings that a user can change
are described with the [plant file](plant-format.md) and the [cluster file](cluster-format.md).
"""


def _numbers(value: object) -> bool:
    if isinstance(value, tuple | frozenset):
        return bool(value) and all(map(_numbers, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _text(value: object) -> str:
    if isinstance(value, frozenset):
        return ", ".join(_text(each) for each in sorted(value))
    if isinstance(value, tuple):
        return ", ".join(map(_text, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def _comment(lines: list[str], at: int) -> str:
    """Return the comment ``#:`` above a line."""
    words: list[str] = []
    while at > 0 and lines[at - 1].startswith("#:"):
        at -= 1
        words.insert(0, lines[at][2:].strip())
    return " ".join(words)


def _constants(module: ModuleType, text: str) -> Iterator[tuple[str, object, str]]:
    """Yield name, value and meaning of a module's constants; its text has the meanings."""
    lines = text.splitlines()
    for node in ast.parse(text).body:
        match node:
            case ast.Assign(targets=[ast.Name(id=name)]) | ast.AnnAssign(target=ast.Name(id=name)):
                names = [name]
            case ast.Assign(targets=[ast.Tuple(elts=some)]):
                names = [each.id for each in some if isinstance(each, ast.Name)]
            case _:
                continue
        said = _comment(lines, node.lineno - 1)
        for name in names:
            value = getattr(module, name, None)
            if said and _numbers(value):
                yield name, value, said


def _defaults(module: ModuleType) -> Iterator[tuple[str, object]]:
    """Yield name and default of each field of settings: of public classes that do not change."""
    for name, kind in vars(module).items():
        here = isinstance(kind, type) and kind.__module__ == module.__name__
        if not here or name.startswith("_"):
            continue
        found: dict[str, object] = dict(getattr(kind, "_field_defaults", {}))
        if dataclasses.is_dataclass(kind) and kind.__dataclass_params__.frozen:
            found |= {each.name: each.default for each in dataclasses.fields(kind)}
        if hasattr(kind, "model_fields"):
            found |= {field: each.default for field, each in kind.model_fields.items()}
        for field, value in found.items():
            if _numbers(value) or isinstance(value, bool):
                yield f"{name}.{field}", value


def pages() -> dict[str, str]:
    """Return the page's text, by path."""
    rows = [SAID]
    for package in PACKAGES:
        for path in sorted((ROOT / "src" / "heliotrope" / package).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
            module = importlib.import_module(name.removesuffix(".__init__"))
            text = path.read_text(encoding="utf-8")
            named, defaults = list(_constants(module, text)), list(_defaults(module))
            short = module.__name__.removeprefix("heliotrope.")
            if named or defaults:
                rows += [f"\n## `{short}`\n"]
            if named:
                rows += ["| name | value | meaning |", "|---|---|---|"]
                rows += [f"| `{n}` | {_text(v)} | {w.replace('|', '/')} |" for n, v, w in named]
            if defaults:
                rows += [""] * bool(named) + ["| setting | default |", "|---|---|"]
                rows += [f"| `{n}` | {_text(v)} |" for n, v in defaults]
    return {PAGE: "\n".join(rows) + "\n"}
