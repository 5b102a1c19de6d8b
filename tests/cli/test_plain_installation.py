"""After a plain installation every command works, or says in one line which extra it needs."""

import ast
import importlib.metadata
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import pytest

from heliotrope.cli._extras import EXTRAS, missing

ROOT = Path(__file__).parents[2]
#: Tries commands one after the other in one process that has the base dependencies alone.
TRIAL = """
import contextlib, io, json, sys
absent, commands = json.loads(sys.argv[1])

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
from heliotrope.cli import main
found = []
for words in commands:
    sys.argv = ["heliotrope", *words]
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            code = end.code or 0
        except BaseException as error:
            code = repr(error)
    found.append([words, code, err.getvalue()])
print(json.dumps(found))
"""


def tried(commands: list[list[str]], folder: Path) -> list[tuple[list[str], object, str]]:
    done = subprocess.run(
        [sys.executable, "-c", TRIAL, json.dumps([sorted(EXTRAS), commands])],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [tuple(row) for row in json.loads(done.stdout.splitlines()[-1])]  # type: ignore[misc]


def test_a_command_works_or_names_its_extra(tmp_path: Path) -> None:
    cluster = tmp_path / "C1.toml"
    cluster.write_text((ROOT / "examples" / "cluster" / "C1.toml").read_text())
    keys = tmp_path / "C1.keys.toml"
    keys.write_text((ROOT / "examples" / "cluster" / "C1.keys.toml").read_text())
    keys.chmod(0o600)
    need = [
        ["run", "--heliostats", "4"],
        ["run", "--heliostats", "4", "--check"],
        ["run", "--heliostats", "4", "--data", "data"],
        ["store", "info", "data"],
        ["store", "verify", "data"],
        ["cluster", "C1.toml", "--check"],
        ["simulate", "--hours", "0.001"],
    ]
    work = [
        ["sun", "-h"],
        [
            "parameters",
            "--from",
            "malan",
            "eptN=-13.27",
            "eptE=-4.56",
            "eNO=-1.92",
            "gb=-3.79",
            "ab=1.12",
        ],
        ["keys", "bus", "new", "C1.bus.toml"],
        ["keys", "bus", "list", "C1.bus.toml"],
        ["field", "layout", "-h"],
        ["--version"],
    ]
    line = r"heliotrope: \w+: \w+ is not installed; run pip install 'heliotrope\[\w+\]'.*\n"
    for words, code, err in tried(need + work, tmp_path):
        if words in need:
            assert code == 2, (words, code, err)
            assert re.fullmatch(line, err), (words, err)
        else:
            assert (code, err) == (0, ""), (words, code, err)


@pytest.fixture(scope="module")
def owners() -> Mapping[str, list[str]]:
    """Return the distributions of every package that is installed."""
    return importlib.metadata.packages_distributions()


@pytest.mark.parametrize("module", sorted(EXTRAS))
def test_the_extra_brings_the_package(module: str, owners: Mapping[str, list[str]]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extra = project["optional-dependencies"][EXTRAS[module]]
    brought = {re.split(r"[\[<>=]", each)[0].lower() for each in extra}
    indirect = {"starlette": "fastapi"}.get(module)
    assert indirect in brought or brought & {owner.lower() for owner in owners[module]}


def imported() -> dict[str, Path]:
    """Return the packages that the source imports, each with one file that does."""
    found: dict[str, Path] = {}
    for file in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names = [each.name for each in node.names]
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names = [node.module or ""]
            else:
                continue
            found |= {name.partition(".")[0]: file for name in names}
    return {name: file for name, file in found.items() if name not in sys.stdlib_module_names}


def test_every_package_that_is_imported_is_a_dependency(owners: Mapping[str, list[str]]) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    base = {re.split(r"[\[<>=]", each)[0].lower() for each in project["dependencies"]}
    # jinja2 brings markupsafe and aiomqtt brings paho; xarray comes with the notebooks' extra.
    others = {"heliotrope", "markupsafe", "paho", "xarray"}
    found = imported()
    assert {"numpy", "cv2", *others} <= found.keys()
    for name, file in found.items():
        brought = {owner.lower().replace("_", "-") for owner in owners.get(name, ())} & base
        assert brought or name in others or name in EXTRAS, (
            f"{file}: {name} is in no list of pyproject.toml"
        )


def test_another_missing_package_is_no_matter_of_extras() -> None:
    assert missing(ModuleNotFoundError(name="numpy"), "run") is None
    found = missing(ModuleNotFoundError(name="sqlalchemy.orm"), "run")
    assert found is not None
    assert str(found) == ("run: sqlalchemy is not installed; run pip install 'heliotrope[console]'")
