"""Run the tests nearest to what changed, and the linters on the changed files.

``python -m scripts.quick [--since COMMIT] [--seconds 25] [--list] [FILE …]`` (``make quick``).
Without files it takes those that differ from where the branch left ``main``, uncommitted ones
too. A test is near if few imports lead from it to a changed file, and nearest if it names that
file. The nearest files of tests run until the time is over; the rest is counted. The exit code is
1 if a test or a linter fails. pytest loads this module as a plugin too.
"""

import argparse
import ast
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest
from scripts.house import Module, arrows, modules, read

ROOT = Path(__file__).parents[1]
#: Most imports between a test and a changed file; `make test` runs the tests farther away.
FAR = 4
#: Most files of tests in one run: each takes time to be collected, whether its tests run or not.
MOST = 16
#: Environment variable: seconds after the first test at which no further test begins.
SECONDS = "HELIOTROPE_QUICK_SECONDS"
_START: list[float] = []


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Skip a test once the time is over, before its fixtures are made."""
    if not _START:
        _START.append(time.monotonic())
    if time.monotonic() - _START[0] > float(os.environ[SECONDS]):
        pytest.skip("the time is over; make test runs it")


def changed(root: Path, since: str) -> list[str]:
    """Return the files that differ from where the branch left a commit, relative to the root."""

    def git(*words: str) -> list[str]:
        done = subprocess.run(  # noqa: S603  # fixed program
            ["git", "-C", str(root), *words],  # noqa: S607
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(f"quick: git {words[0]}: {done.stderr.strip()}; name the files, or --since")
        return done.stdout.splitlines()

    names = git("diff", "--name-only", *git("merge-base", since, "HEAD"))
    return sorted({*names, *git("ls-files", "--others", "--exclude-standard")})


def known(root: Path) -> dict[str, Module]:
    """Return the modules of ``src``, tests, scripts, benchmarks and examples, with imports."""
    found = modules(root)
    others = []
    for folder in ("tests", "scripts", "benchmarks", "examples"):
        base = root / "tests" if folder == "tests" else root
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(base).with_suffix("").parts
            face = parts[-1] == "__init__"
            others.append(Module(".".join(parts[:-1] if face else parts), path, 0, face))
    found |= {module.name: module for module in others}
    for module in others:
        read(module, found)
        _read_attributes(module, found)
    return found


def _read_attributes(module: Module, found: dict[str, Module]) -> None:
    """Replace the import of a whole package, as ``ht``, by the names that are used of it."""
    tree = ast.parse(module.path.read_text(encoding="utf-8"))
    alias = {
        name.asname or name.name: name.name
        for node in ast.walk(tree) if isinstance(node, ast.Import)
        for name in node.names if name.name in found and found[name.name].face
    }  # fmt: skip
    used = [
        (alias[node.value.id], node.attr)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
        and node.value.id in alias
    ]  # fmt: skip
    whole = set(alias.values()) & {origin for origin, _ in used}
    inner = {f"{origin}.{name}" for origin, name in used}
    module.taken = [one for one in module.taken if one[0] not in whole or one[1]]
    module.taken += [
        (f"{origin}.{name}", "") if f"{origin}.{name}" in inner & found.keys() else (origin, name)
        for origin, name in used
    ]


def nearest(root: Path, files: list[str]) -> dict[str, int]:
    """Return the test files near the changed files, nearest first.

    Parameters
    ----------
    root
        Root of the repository.
    files
        Changed files, relative to it.

    Returns
    -------
    dict
        Number of imports from each test file to a changed file, by path relative to the root.
    """
    found = known(root)
    name_of = {str(module.path.relative_to(root)): name for name, module in found.items()}
    importers: dict[str, set[str]] = defaultdict(set)
    for name, ends in arrows(found, through_faces=True).items():
        for end in ends:
            importers[end].add(name)
    starts = {name_of[file] for file in files if file in name_of}
    for name, ends in arrows(found, through_faces=False).items():
        for face in ends & starts:
            importers[face].add(name)
    # Tests use the fixtures of the conftest.py beside them and above them.
    for module in found.values():
        if module.path.name == "conftest.py":
            below = module.path.parent.rglob("test_*.py")
            importers[module.name] |= {name_of[str(path.relative_to(root))] for path in below}
    distance = dict.fromkeys(starts, 0)
    ring = starts
    for step in range(1, FAR + 1):
        ring = {
            name for start in ring if start in starts or not found[start].face
            for name in importers[start]
        } - distance.keys()  # fmt: skip
        distance |= dict.fromkeys(ring, step)
    tests = [module for module in found.values() if module.path.name.startswith("test_")]
    for test in tests:
        text = test.path.read_text(encoding="utf-8")
        if any(_names(text, file) for file in files):
            distance[test.name] = min(1, distance.get(test.name, 1))
    rooms = {part for file in files for part in Path(file).parts}

    def rank(test: Module) -> tuple[int, bool, str]:
        return distance[test.name], test.path.parent.name not in rooms, test.name

    near = sorted((test for test in tests if test.name in distance), key=rank)
    return {str(test.path.relative_to(root)): distance[test.name] for test in near}


def _names(text: str, file: str) -> bool:
    """Return whether a test names a file that no test imports: a page, a script, a setting."""
    path = Path(file)
    if path.parts[0] == "src":
        return False
    return file in text or (path.name in text and path.name not in ("__init__.py", "index.md"))


def linters(files: list[str]) -> list[list[str]]:
    """Return the commands of the linters for the files that changed."""
    there = [file for file in files if (ROOT / file).exists()]
    python = [file for file in there if file.endswith((".py", ".pyi"))]
    commands = []
    if python:
        commands += [["ruff", "check", "--force-exclude", *python]]
        commands += [["ruff", "format", "--check", "--force-exclude", *python]]
    if any(file.startswith("src/") for file in python):
        commands += [["lint-imports"], ["mypy"]]
    return [[str(Path(sys.executable).parent / name), *rest] for name, *rest in commands]


def main() -> int:
    """Run the tests and the linters; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", metavar="FILE", help="instead of those git names")
    parser.add_argument("--since", default="main", help="commit to compare with (main)")
    parser.add_argument("--seconds", type=float, default=25.0, help="for the tests (25)")
    parser.add_argument("--list", action="store_true", help="print the tests, run nothing")
    given = parser.parse_args()
    files = given.files or changed(ROOT, given.since)
    tests = nearest(ROOT, files)
    if given.list:
        print(*(f"{steps} {test}" for test, steps in tests.items()), sep="\n")
        return 0
    run = list(tests)[:MOST]
    print(
        f"{len(files)} changed files; {len(tests)} test files within {FAR} imports, the nearest "
        f"{len(run)} run",
        flush=True,
    )
    failed = []
    running = [
        (words, subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE, text=True))  # noqa: S603
        for words in linters(files)
    ]
    if run:
        command = [sys.executable, "-m", "pytest", "-q", "-m", "not slow", "-p", "scripts.quick",
                   "-n", "2", "--dist", "loadfile", "--no-loadscope-reorder", *run]  # fmt: skip
        environment = os.environ | {SECONDS: str(given.seconds)}
        done = subprocess.run(command, cwd=ROOT, env=environment, check=False)  # noqa: S603
        # 5: no test was left, as all of them are slow.
        failed += ["pytest"] * (done.returncode not in (0, 5))
    for words, process in running:
        said, _ = process.communicate()
        if process.returncode:
            failed.append(" ".join([Path(words[0]).name, *words[1:2]]))
            print(said)
    print("quick: " + (f"failed: {', '.join(failed)}" if failed else "passed"))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
