"""After a plain installation every command works, or says in one line which extra it needs."""

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
    line = r"heliotrope: \w+: \w+ is not installed; say pip install 'heliotrope\[\w+\]'.*\n"
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


def test_another_missing_package_is_no_matter_of_extras() -> None:
    assert missing(ModuleNotFoundError(name="numpy"), "run") is None
    found = missing(ModuleNotFoundError(name="sqlalchemy.orm"), "run")
    assert found is not None
    assert str(found) == ("run: sqlalchemy is not installed; say pip install 'heliotrope[console]'")
