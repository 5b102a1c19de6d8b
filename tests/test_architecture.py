"""The house rules that no linter holds."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
LONGEST_FUNCTION = 60


#: Constructors that may have more parameters than `MOST_PARAMETERS`, with the reason: a value that
#: holds some of them does not fit into the heap of a board that compiles the code in it.
MANY_PARAMETERS = {"Node": 11}
MOST_PARAMETERS = 8


Sizes = list[tuple[str, int]]


@pytest.fixture(scope="module")
def sizes() -> tuple[Sizes, Sizes]:
    """Parameters of each constructor, and lines of each function, by file and name."""
    parameters: Sizes = []
    lines: Sizes = []
    for path in SOURCES:
        file = path.relative_to(ROOT / "src")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                for made in node.body:
                    if isinstance(made, ast.FunctionDef) and made.name == "__init__":
                        given = made.args
                        count = len([*given.posonlyargs, *given.args, *given.kwonlyargs]) - 1
                        parameters.append((f"{file}: {node.name}", count))
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                body = node.body[ast.get_docstring(node) is not None :]
                if body:
                    length = (body[-1].end_lineno or 0) - body[0].lineno + 1
                    lines.append((f"{file}: {node.name}", length))
    return parameters, lines


def test_a_constructor_has_few_parameters(sizes: tuple[Sizes, Sizes]) -> None:
    """A class that needs more is cut in the wrong place."""
    constructors, _ = sizes
    assert len(constructors) > 100
    for name, count in constructors:
        most = MANY_PARAMETERS.get(name.rpartition(" ")[2], MOST_PARAMETERS)
        assert count <= most, f"{name}: {count} parameters; give at most {most}"


def test_a_function_fits_on_a_screen(sizes: tuple[Sizes, Sizes]) -> None:
    _, functions = sizes
    assert len(functions) > 1000
    long = [f"{name}: {lines} lines" for name, lines in functions if lines > LONGEST_FUNCTION]
    assert not long, "\n".join(long)


def test_no_place_of_a_machine_in_the_tree() -> None:
    listed = subprocess.run(
        ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    pattern = re.compile(
        r"(?:^|[^\w.~/-])/(?:work|root|home|tmp)/\w|index-url|\"resolved\": *\"http"
    )
    found = []
    for name in listed:
        path = ROOT / name
        binary = path.suffix in {".png", ".jpg", ".parquet"}
        if binary or path == Path(__file__) or not path.exists():
            continue
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            if pattern.search(line):
                found.append(f"{name}:{number}: {line.strip()[:80]}")
    assert not found
