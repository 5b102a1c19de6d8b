"""Print the structure of the code: packages, floors, imports, and what should not be there.

``python scripts/house.py [ROOT]`` (``make house``) reads the imports of ``src/heliotrope`` from the
source, without running it, and the floors from import-linter's contract in ``pyproject.toml``.
With ``--check`` it ends with status 1 if an import runs up, two files import each other, a package
imports another package's underscore module, or a module has neither a caller nor a place in a
public face. ``python -m scripts.pages`` writes its picture of the floors.
"""

import argparse
import ast
import gc
import re
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

NAME = "heliotrope"
#: Started by name and not by an import: the command line, `python -m heliotrope.warm`, the
#: console's process, Alembic.
STARTED = re.compile(
    rf"{NAME}(\.cli|\.warm|\.console\.(__main__|urgent_process)|\.store\.migrations(\..*)?|\.lcu\.node)?$"
)


#: Colours, type and the head of an arrow.
_LOOK = (
    "<style>rect{fill:#fff3e0;stroke:#e65100}path{fill:none;stroke:#8d6e63;opacity:.7;"
    "marker-end:url(#a)}text{font-family:sans-serif;text-anchor:middle;fill:#212121}"
    ".n{font-size:14px;font-weight:600}.r{font-size:10px}</style>"
    '<defs><marker id="a" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
    'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" style="fill:#8d6e63;'
    'stroke:none;marker-end:none"/></marker></defs>'
)


@dataclass
class Module:
    """One source file, with its imports from this project."""

    name: str
    path: Path
    lines: int
    face: bool
    skips: int = 0
    #: Names imported from other modules: (module, name or "").
    taken: list[tuple[str, str]] = field(default_factory=list)
    #: Modules that the names of a face come from.
    homes: dict[str, tuple[str, str]] = field(default_factory=dict)
    #: Public names of a face.
    offers: list[str] = field(default_factory=list)

    @property
    def room(self) -> str:
        """The package of the module, or the module itself if it lies at the top."""
        parts = self.name.split(".")
        return parts[1] if len(parts) > 1 else ""

    @cached_property
    def tree(self) -> ast.Module:
        """The syntax of the module."""
        return ast.parse(self.path.read_text(encoding="utf-8"))

    @cached_property
    def nodes(self) -> list[ast.AST]:
        """All that is in the syntax of the module."""
        return [*ast.walk(self.tree)]


def modules(root: Path) -> dict[str, Module]:
    """Return all modules below ``root/src``."""
    source = root / "src"
    found: dict[str, Module] = {}
    for path in sorted((source / NAME).rglob("*.py")):
        parts = path.relative_to(source).with_suffix("").parts
        face = parts[-1] == "__init__"
        name = ".".join(parts[:-1] if face else parts)
        text = path.read_text(encoding="utf-8")
        found[name] = Module(name, path, text.count("\n"), face, text.count("# fmt: skip"))
    # A million nodes stay: searching them for garbage takes a third of the time.
    gc.disable()
    try:
        for module in found.values():
            read(module, found)
    finally:
        gc.enable()
    return found


def read(module: Module, known: dict[str, Module]) -> None:
    """Fill in what a module imports from the known ones, and what it offers."""
    package = module.name if module.face else module.name.rpartition(".")[0]
    for node in module.nodes:
        if isinstance(node, ast.Import):
            module.taken += [(a.name, "") for a in node.names if a.name in known]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            origin = node.module or ""
            if node.level:
                origin = ".".join([*above, *([origin] if origin else [])])
            if origin not in known:
                continue
            for alias in node.names:
                inner = f"{origin}.{alias.name}"
                taken = (inner, "") if inner in known else (origin, alias.name)
                module.taken.append(taken)
                if module.face:
                    module.homes[alias.asname or alias.name] = taken
    for node in module.tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            named = any(isinstance(t, ast.Name) and t.id == "__all__" for t in targets)
            if named and isinstance(node.value, ast.List | ast.Tuple):
                module.offers = [e.value for e in node.value.elts if isinstance(e, ast.Constant)]


def home(known: dict[str, Module], origin: str, name: str) -> str:
    """Return the module that defines a name, looked up through the faces of packages."""
    for _ in range(10):
        module = known.get(origin)
        if module is None or not name or name not in module.homes:
            return origin
        origin, name = module.homes[name]
    return origin


def arrows(known: dict[str, Module], *, through_faces: bool) -> dict[str, set[str]]:
    """Return the modules that each module imports, itself left out."""
    found: dict[str, set[str]] = {}
    for module in known.values():
        ends = {
            home(known, origin, name) if through_faces else origin for origin, name in module.taken
        }
        found[module.name] = {end for end in ends if end in known and end != module.name}
    return found


def circles(known: dict[str, Module]) -> list[tuple[str, ...]]:
    """Return the sets of files that import each other, directly or not (Tarjan 1972)."""
    graph = {
        name: {e for e in ends if not known[e].face}
        for name, ends in arrows(known, through_faces=True).items()
        if not known[name].face
    }
    order: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[tuple[str, ...]] = []

    def visit(name: str) -> None:
        order[name] = low[name] = len(order)
        stack.append(name)
        for end in graph[name]:
            if end not in order:
                visit(end)
                low[name] = min(low[name], low[end])
            elif end in stack:
                low[name] = min(low[name], order[end])
        if low[name] == order[name]:
            group = []
            while not group or group[-1] != name:
                group.append(stack.pop())
            if len(group) > 1:
                found.append(tuple(sorted(group)))

    for name in graph:
        if name not in order:
            visit(name)
    return sorted(found)


def floors(root: Path) -> list[list[str]]:
    """Return the floors from the top down, from import-linter's contract."""
    with (root / "pyproject.toml").open("rb") as file:
        contracts = tomllib.load(file)["tool"]["importlinter"]["contracts"]
    layers = next(c["layers"] for c in contracts if c["type"] == "layers")
    return [[room.strip() for room in layer.split("|")] for layer in layers]


def upward(known: dict[str, Module], levels: list[list[str]]) -> list[str]:
    """Return the imports that run up, or sideways on a floor."""
    at = {room: i for i, rooms in enumerate(levels) for room in rooms}
    found = []
    for name, ends in arrows(known, through_faces=False).items():
        for end in ends:
            a, b = known[name].room, known[end].room
            if a != b and a in at and b in at and at[b] <= at[a]:
                found.append(f"{name} → {end}")
    return sorted(found)


def foreign(known: dict[str, Module]) -> list[str]:
    """Return the imports of another package's underscore module or name."""
    found = []
    for module in known.values():
        for origin, name in module.taken:
            parts = [*origin.split(".")[1:], name]
            if parts[0] != module.room and any(p.startswith("_") for p in parts):
                if name == "__version__":
                    continue
                found.append(
                    f"{module.name} → {origin if not name.startswith('_') else f'{origin}.{name}'}"
                )
    return sorted(set(found))


def orphans(known: dict[str, Module]) -> list[str]:
    """Return the modules that nothing imports and no face offers."""
    graph = arrows(known, through_faces=True)
    used = {end for name, ends in graph.items() for end in ends if not known[name].face}
    for module in known.values():
        if module.face:
            offered = {home(known, *module.homes[n]) for n in module.offers if n in module.homes}
            used |= offered
            used |= {f"{module.name}.{n}" for n in module.offers}
            # The faces of the command line's rooms assemble them.
            if module.room == "cli":
                used |= graph[module.name]
    return sorted(
        m.name for m in known.values()
        if not m.face and m.name not in used and not STARTED.match(m.name)
    )  # fmt: skip


def repeated(known: dict[str, Module]) -> dict[str, int]:
    """Return the names of classes that several modules define, with their count."""
    count: Counter[str] = Counter()
    for module in known.values():
        count.update({n.name for n in module.nodes if isinstance(n, ast.ClassDef)})
    return {name: n for name, n in sorted(count.items()) if n > 1 and not name.startswith("_")}


def literals(known: dict[str, Module]) -> tuple[list[str], list[str]]:
    """Return where `plant` and `cluster` write out sets of command names, and sets of states.

    Traits of `lcu/messages.py` and sets of `lcu/states.py` give names to both.
    """
    commands = _table(known[f"{NAME}.lcu.messages"], "MESSAGES", column=1)
    states = _table(known[f"{NAME}.lcu.states"], "STATES")
    found: tuple[list[str], list[str]] = [], []
    for node, place in _nodes(known, ("plant", "cluster")):
        if isinstance(node, ast.Set | ast.Tuple | ast.List) and not _stored(node):
            texts = [e.value for e in node.elts if isinstance(e, ast.Constant)]
            some = sum(text in commands for text in texts)
            if some > 1 or (some and isinstance(node, ast.Set)):
                found[0].append(place)
            if sum(_word(each) in states for each in node.elts) > 1:
                found[1].append(place)
    return found


def reasons(known: dict[str, Module]) -> list[str]:
    """Return the functions in `plant` that return a mapping of texts: heliostat to reason."""
    return [
        f"{place} {node.name}"
        for node, place in _nodes(known, ("plant",))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and node.returns is not None
        and re.search(r"(dict|Mapping)\[str, str\]", ast.unparse(node.returns))
    ]


def _nodes(known: dict[str, Module], rooms_: tuple[str, ...]) -> Iterator[tuple[ast.AST, str]]:
    """Yield the syntax of some packages, with the place of each node."""
    for module in known.values():
        if module.room in rooms_:
            for node in module.nodes:
                yield node, f"{module.name.removeprefix(NAME + '.')}:{getattr(node, 'lineno', 0)}"


def _table(module: Module, name: str, column: int = 0) -> set[str]:
    """Return the texts of a tuple at the top of a module; of its rows, those of a column."""
    for node in module.tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == name:
            assert isinstance(node.value, ast.Tuple)
            rows = [
                each.elts[column] if isinstance(each, ast.Tuple) else each
                for each in node.value.elts
            ]
            return {each.value for each in rows if isinstance(each, ast.Constant)}
    raise KeyError(f"{module.name} defines no {name}")


def _stored(node: ast.AST) -> bool:
    return isinstance(getattr(node, "ctx", None), ast.Store)


def _word(node: ast.expr) -> str:
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def rooms(known: dict[str, Module], levels: list[list[str]]) -> list[tuple[str, int, int, int]]:
    """Return each package with its rooms, files and lines, from the top floor down."""
    per: dict[str, list[Module]] = defaultdict(list)
    for module in known.values():
        per[module.room].append(module)
    order = [room for rooms_ in levels for room in rooms_]
    names = [*order, *sorted(set(per) - set(order))]
    table = []
    for name in names:
        own = per.get(name, [])
        inner = sum(m.face for m in own) - 1 if any(m.face for m in own) else 0
        if own:
            table.append((name or "(top)", inner, len(own), sum(m.lines for m in own)))
    return table


def between(known: dict[str, Module]) -> dict[str, set[str]]:
    """Return the packages that each package imports."""
    found: dict[str, set[str]] = defaultdict(set)
    for name, ends in arrows(known, through_faces=False).items():
        for end in ends:
            a, b = known[name].room, known[end].room
            if a and b and a != b:
                found[a].add(b)
    return found


def reduced(graph: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Return the imports that no chain over other packages implies."""

    def below(name: str) -> set[str]:
        seen: set[str] = set()
        ahead = [*graph.get(name, ())]
        while ahead:
            here = ahead.pop()
            if here not in seen:
                seen.add(here)
                ahead += graph.get(here, ())
        return seen

    return sorted(
        (a, b)
        for a, ends in graph.items()
        for b in ends
        if not any(b in below(other) for other in ends - {b})
    )


def drawing(known: dict[str, Module], levels: list[list[str]]) -> str:
    """Return the floors as SVG: a box for each package, an arrow for each import not implied."""
    width, height, gap, tall = 128, 46, 22, 40
    wide = max(len(rooms_) for rooms_ in levels) * (width + gap) + gap
    inner = defaultdict(list)
    for module in known.values():
        parts = module.name.split(".")
        if module.face and len(parts) == 3:
            inner[parts[1]].append(parts[2])
    places: dict[str, tuple[float, float]] = {}
    boxes = []
    for i, names in enumerate(levels):
        y = gap + i * (height + tall)
        left = (wide - len(names) * (width + gap) + gap) / 2
        for k, name in enumerate(names):
            x = left + k * (width + gap)
            places[name] = (x + width / 2, y)
            boxes.append(
                f'<rect x="{x:g}" y="{y}" width="{width}" height="{height}" rx="6"/>'
                f'<text x="{x + width / 2:g}" y="{y + 19}" class="n">{name}</text>'
            )
            rooms_ = sorted(inner[name])
            said = " ".join(rooms_) if len(rooms_) < 4 else f"{len(rooms_)} rooms"
            if said:
                boxes.append(f'<text x="{x + width / 2:g}" y="{y + 35}" class="r">{said}</text>')
    lines = []
    for a, b in reduced(between(known)):
        if a in places and b in places:
            (x1, y1), (x2, y2) = places[a], places[b]
            y1 += height
            bend = (y2 - y1) / 2
            curve = f"C{x1:g} {y1 + bend:g} {x2:g} {y2 - bend:g} {x2:g} {y2:g}"
            lines.append(f'<path d="M{x1:g} {y1:g} {curve}"/>')
    bottom = gap + len(levels) * (height + tall)
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {bottom}" role="img">',
            "<title>The floors of Heliotrope: imports run downwards only</title>",
            _LOOK,
            f'<rect width="{wide}" height="{bottom}" style="fill:#fffdf9;stroke:none"/>',
            *lines,
            *boxes,
            "</svg>",
            "",
        ]
    )


def pages() -> dict[str, str]:
    """Return the picture of docs/explanation/architecture.md, by path."""
    root = Path(__file__).parents[1]
    return {"docs/images/floors.svg": drawing(modules(root), floors(root))}


def main() -> int:
    """Print the structure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", nargs="?", type=Path, default=Path(__file__).parents[1])
    parser.add_argument("--check", action="store_true", help="status 1 if something is wrong")
    parser.add_argument("--verbose", action="store_true", help="name every place")
    given = parser.parse_args()
    known, levels = modules(given.root), floors(given.root)
    print(f"{'package':14} {'rooms':>5} {'files':>5} {'lines':>6}")
    for name, inner, files, lines in rooms(known, levels):
        print(f"{name:14} {inner or '':>5} {files:5} {lines:6}")
    total = sum(m.lines for m in known.values())
    print(f"{'in all':14} {'':5} {len(known):5} {total:6}")
    print(f"\nfloors: {len(levels)}, from the top: {'; '.join(' | '.join(f) for f in levels)}")
    wrong = {
        "imports that run up or sideways": upward(known, levels),
        "file circles": [" ↔ ".join(c) for c in circles(known)],
        "imports of another package's underscore names": foreign(known),
        "modules without a caller": orphans(known),
    }
    for what, places in wrong.items():
        print(f"{what}: {len(places)}")
        for place in places if given.verbose or len(places) <= 12 else ():
            print(f"  {place}")
    print(f"fmt: skip: {sum(m.skips for m in known.values())}")
    faces = [m for m in known.values() if m.face]
    shown = sum(bool(m.offers) for m in faces)
    print(f"packages and rooms with a public face (__all__): {shown} of {len(faces)}")
    listed = dict(zip(("command sets", "state sets"), literals(known), strict=True))
    counted = {f"literal {what} in plant and cluster": at for what, at in listed.items()}
    counted["functions in plant that return heliostat → reason"] = reasons(known)
    for what, places in counted.items():
        print(f"{what}: {len(places)}")
        for place in places if given.verbose else ():
            print(f"  {place}")
    names = repeated(known)
    print(f"class names in several modules: {len(names)}")
    if given.verbose:
        print("  " + ", ".join(f"{name} {n}" for name, n in names.items()))
    return 1 if given.check and any(wrong.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
