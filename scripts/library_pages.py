"""Make the pages of the library: each package's public names, as its ``__all__`` lists them.

A name that several faces offer is described once, in the package that defines it.
"""

import ast
import functools
import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = "docs/reference/library"
#: Packages in the order of the reference: from what a researcher needs to the programs of a plant.
ORDER = (
    "", "sun", "geometry", "mechanism", "field", "optics", "aims", "plot", "calibration", "imaging",
    "airborne", "files", "errors", "links", "safety", "cluster", "plant", "store", "console", "lcu",
    "twin",
)  # fmt: skip


@functools.cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


@functools.cache
def _face(path: Path) -> tuple[list[str], dict[str, str]]:
    """Return the public names of a face, with the modules that they come from."""
    tree = _tree(path)
    names: list[str] = []
    homes: dict[str, str] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("heliotrope"):
            homes |= {a.asname or a.name: f"{node.module}.{a.name}" for a in node.names}
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(t, ast.Name) and t.id == "__all__" for t in targets):
                assert isinstance(node.value, ast.List | ast.Tuple), path
                names = [e.value for e in node.value.elts if isinstance(e, ast.Constant)]
    return names, homes


def _defined(path: Path) -> list[str]:
    """Return the public names that a module without a face defines."""
    tree = _tree(path)
    kinds = (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    return [n.name for n in tree.body if isinstance(n, kinds) and not n.name.startswith("_")]


def _described(place: str) -> bool:
    """Return whether a name has a definition of its own, not one shared with other names."""
    module, _, name = place.rpartition(".")
    if _source(place.removeprefix("heliotrope.")).exists():
        return True
    path = _source(module.removeprefix("heliotrope").lstrip("."))
    return name in _names(path)


@functools.cache
def _names(path: Path) -> set[str]:
    """Return the names that a module defines or assigns anywhere."""
    found = set()
    for node in ast.walk(_tree(path)):
        found.add(getattr(node, "name", ""))
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return found


def _lead(path: Path) -> str:
    """Return the docstring of a face."""
    text = ast.get_docstring(_tree(path)) or ""
    return re.sub(r"::$", ":", text, flags=re.MULTILINE)


def _source(room: str) -> Path:
    base = ROOT / "src" / "heliotrope" / room.replace(".", "/")
    return base / "__init__.py" if base.is_dir() else base.with_suffix(".py")


def _home(place: str) -> str:
    """Return the module that defines a name, looked up through the faces of packages."""
    for _ in range(10):
        module, _, name = place.rpartition(".")
        path = _source(module.removeprefix("heliotrope").lstrip("."))
        if path.name != "__init__.py" or not path.exists():
            return place
        _, homes = _face(path)
        if name not in homes or homes[name] == place:
            return place
        place = homes[name]
    return place


def _rooms(package: str) -> list[str]:
    """Return a package and its inner rooms."""
    base = ROOT / "src" / "heliotrope" / package
    inner = sorted(p.parent for p in base.rglob("*/__init__.py")) if base.is_dir() else []
    rooms = [".".join((package, *p.relative_to(base).parts)) for p in inner]
    return [package, *(room for room in rooms if "migrations" not in room)]


def _listed(room: str) -> list[tuple[str, str]]:
    """Return the public names of a room, each with the place that defines it."""
    path = _source(room)
    dotted = f"heliotrope.{room}" if room else "heliotrope"
    if path.name != "__init__.py":
        return [(name, f"{dotted}.{name}") for name in _defined(path)]
    names, homes = _face(path)
    return [
        (name, _home(homes.get(name, f"{dotted}.{name}")))
        for name in names if name != "__version__"
    ]  # fmt: skip


def pages() -> dict[str, str | None]:
    """Return the pages by path, None for those of packages that are gone."""
    kept = (ROOT / PAGES).glob("*.md")
    found: dict[str, str | None] = dict.fromkeys(str(path.relative_to(ROOT)) for path in kept)
    written = set()
    for package in ORDER[1:]:
        lines = [f"# heliotrope.{package}", ""]
        for room in _rooms(package):
            if room != package:
                lines += [f"## heliotrope.{room}", ""]
            lines += [_lead(_source(room)), ""]
            for name, place in _listed(room):
                if place in written:
                    lines += [f"- [`{name}`][{place}]", ""]
                elif not _described(place):
                    lines += [f"- `{name}`", ""]
                else:
                    written.add(place)
                    lines += [f"::: heliotrope.{room}.{name}"]
                    lines += ["    options: {heading_level: 3}", ""]
        found[f"{PAGES}/{package}.md"] = "\n".join(lines).rstrip() + "\n"
    lines = ["# The library", "", _lead(_source("")), ""]
    links = [(name, place) for name, place in _listed("")]
    lines += [f"- [`heliotrope.{name}`][{place}]" for name, place in links if place in written]
    lines += ["", "Packages:", ""]
    for package in ORDER[1:]:
        first = _lead(_source(package)).split("\n\n")[0].replace("\n", " ")
        lines.append(f"- [`heliotrope.{package}`]({package}.md): {first}")
    lines.append("")
    for _, place in links:
        if place not in written and place.removeprefix("heliotrope.") not in ORDER:
            lines += [f"::: {place}", "    options: {heading_level: 2}", ""]
    found[f"{PAGES}/index.md"] = "\n".join(lines).rstrip() + "\n"
    return found
