"""What a plant is deployed with, and what its people read: true to the code."""

import ast
import functools
import hashlib
import json
import os
import platform
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from heliotrope.errors import FormatError
from heliotrope.lcu import messages, names, states
from heliotrope.plant import refusals
from heliotrope.plant.io.links_file import TABLES, read_links
from heliotrope.safety import CONDITIONS, AlarmKind, Watcher, alarms
from support.absence import absent

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
HANDBOOK = (ROOT / "docs" / "how-to" / "handbook.md").read_text(encoding="utf-8")
UNITS = (
    "heliotrope-plant.service",
    "heliotrope-cluster@.service",
    "heliotrope-backup.service",
    "heliotrope-backup.timer",
)


# -- the handbook --------------------------------------------------------------------------


def section(title: str) -> str:
    """Return a section of the handbook, with those below it."""
    level, _, _ = title.partition(" ")
    found = re.search(rf"^{title}$(.*?)(?=^#{{1,{len(level)}}} |\Z)", HANDBOOK, re.M | re.S)
    assert found, f"no section {title!r}"
    return found[1]


def rows(title: str) -> set[str]:
    """Return the names in the first column of a section's tables; each has its other columns."""
    lines = [line for line in section(title).splitlines() if line.startswith("| `")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert all(row[1] or row[2] for row in cells)
    found = [row[0].strip("`") for row in cells]
    assert len(found) == len(set(found))
    return set(found)


def test_every_alarm_is_in_the_handbook() -> None:
    assert rows("## Alarms") == {row.name for row in CONDITIONS} | set(alarms.KINDS)


def test_every_refusal_is_in_the_handbook_and_on_the_page() -> None:
    names_of = [kind.name for kind in refusals.KINDS]
    assert rows("## Refusals") == set(names_of)
    assert len(names_of) == len(set(names_of))
    page = (ROOT / "docs" / "reference" / "alarms.md").read_text(encoding="utf-8")
    assert [name for name in names_of if f"| {name} |" not in page] == []


def test_every_reason_why_it_does_not_go_on_is_in_the_handbook() -> None:
    text = section(r"## Why does it not go on\?")
    room = ROOT / "src" / "heliotrope" / "plant" / "operations"
    reasons = {"it is starting"}
    for name, functions in (
        ("automatic.py", ("_why_not", "_why_idle", "_why_waiting")),
        ("raising.py", ("why_not",)),
    ):
        for node in ast.walk(ast.parse((room / name).read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name in functions:
                ends = [end for end in ast.walk(node) if isinstance(end, ast.Return)]
                parts = [part for end in ends for part in ast.walk(end)]
                texts = [p.value for p in parts if isinstance(p, ast.Constant)]
                reasons |= {text.strip() for text in texts if text is not None and len(text) > 2}
    assert len(reasons) > 10
    assert [reason for reason in sorted(reasons) if reason not in text] == []


def test_every_law_of_retries_is_in_the_handbook_and_on_the_page_of_the_plant() -> None:
    page = (ROOT / "docs" / "explanation" / "plant.md").read_text(encoding="utf-8")
    table = page.partition("## What is tried again\n")[2].partition("\n## ")[0]
    told = section(r"## Why does it not go on\?")
    laws = {}
    for path in (ROOT / "src" / "heliotrope").rglob("*.py"):
        source = path.read_text(encoding="utf-8")
        laws |= dict(re.findall(r'^(\w+) = RetryLaw\(\n    "([^"]+)"', source, re.M))
        assert source.count("= RetryLaw(") == len(re.findall(r"^\w+ = RetryLaw\(", source, re.M))
    assert len(laws) >= 7
    assert [name for name in laws if f"(`{name}`)" not in table] == []
    assert [work for work in laws.values() if work not in told] == []


def test_alarms_are_raised_from_the_table_only() -> None:
    """No place in the code names an alarm by a text of its own."""
    found = []
    for path in (ROOT / "src" / "heliotrope").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name)):
                continue
            place = {"Alarm": 0, "AlarmRow": 0, "Action": 3}.get(node.func.id, 99)
            if len(node.args) > place and isinstance(node.args[place], ast.Constant):
                found.append(f"{path}:{node.lineno}")
    assert not found


def test_every_alarm_of_the_table_is_raised() -> None:
    """A kind of alarm that no place raises would be a promise that nobody keeps."""
    source = "".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "src" / "heliotrope").rglob("*.py")
        if path.name != "alarms.py"
    )
    kinds = [name for name, value in vars(alarms).items() if isinstance(value, AlarmKind)]
    assert len(kinds) == len(alarms.KINDS) >= 15
    assert [name for name in kinds if f"alarms.{name}" not in source] == []


def test_every_refusal_of_the_table_is_raised() -> None:
    source = "".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "src" / "heliotrope").rglob("*.py")
        if path.name != "refusals.py"
    )
    kinds = [name for name, value in vars(refusals).items() if isinstance(value, refusals.Refusal)]
    assert len(kinds) == len(refusals.KINDS) >= 10
    assert [name for name in kinds if name not in source] == []


def test_the_page_of_alarms_names_each() -> None:
    page = (ROOT / "docs" / "reference" / "alarms.md").read_text(encoding="utf-8")
    for name in {row.name for row in CONDITIONS} | set(alarms.KINDS):
        assert f"| `{name}` |" in page


def test_an_alarm_says_what_is_wrong_what_happens_and_what_to_do() -> None:
    raised = alarms.NODE_SILENT.raised("H7", worse=True, silence=10.0, last="never heard")
    assert (raised.condition, raised.subject, raised.severity) == ("node_silent", "H7", "alarm")
    assert raised.text == (
        "H7: no reply for 10 s; never heard. The cluster keeps polling it. Assume that its beam "
        "has not moved; check its supply and its cable."
    )
    assert alarms.NODE_SILENT.ended("H7").text == "H7: it replies again"
    for row in CONDITIONS:
        assert row.remedy.endswith("."), row.name
    for kind in alarms.KINDS.values():
        assert kind.consequence.endswith("."), kind.name
        assert kind.remedy.endswith("."), kind.name


@pytest.mark.parametrize(
    ("title", "watcher"),
    [
        ("### Of the plant", Watcher.PLANT),
        ("### Of a cluster", Watcher.CLUSTER),
        ("### Of a local controller", Watcher.NODE),
    ],
)
def test_alarms_stand_where_they_come_from(title: str, watcher: Watcher) -> None:
    here = {row.name for row in CONDITIONS if row.watcher is watcher}
    here |= {kind.name for kind in alarms.KINDS.values() if kind.watcher is watcher}
    assert here == rows(title)


def test_every_state_command_and_fault_is_in_the_handbook() -> None:
    assert rows("## States") == set(states.STATES)
    assert rows("## Faults of a heliostat") == set(names.FAULTS[1:])
    people = {
        row[1] for row in messages.MESSAGES if row[2] in (messages.ANYONE, messages.AUTHORITY)
    }
    assert rows("## Commands") == people | {"ZERO", "LOCK_POSITION", "SET_ADDRESS"}


def test_the_emergency_comes_first() -> None:
    assert re.findall(r"^## (.*)$", HANDBOOK, re.M)[0] == "Emergency"


# -- commands of the pages -----------------------------------------------------------------

PAGES = ("tutorial/first-hour.md", "how-to/handbook.md", "how-to/integrate.md", "how-to/deploy.md")
GROUPS = ("keys", "ctl", "store", "field", "camera", "drone")


def commands() -> list[str]:
    """Return every call of the program in the pages, from the word after its name."""
    found = []
    for page in PAGES:
        text = (ROOT / "docs" / page).read_text(encoding="utf-8").replace("\\\n", " ")
        lines = [
            line
            for block in re.findall(r"```sh\n(.*?)^```", text, re.S | re.M)
            for line in block.splitlines()
        ]
        lines += re.findall(r"`(heliotrope [a-z][^`]*)`", text)
        start = re.compile(r"(?:sudo -u heliotrope )?(?:[./\w]*/)?heliotrope (.*)")
        found += [call[1] for line in lines if (call := start.match(line))]
    return [call for call in dict.fromkeys(found) if not call.startswith("--version")]


@functools.cache
def helped(*words: str) -> str:
    """Return the help of a command."""
    from heliotrope.cli import app

    done = CliRunner().invoke(app, [*words, "--help"])
    assert done.exit_code == 0, done.output
    return done.output


def test_the_pages_have_commands() -> None:
    assert len(commands()) > 20


@pytest.mark.parametrize("call", commands())
def test_commands_of_the_pages_exist(call: str) -> None:
    words = shlex.split(call)
    path = words[: 2 if words[0] in GROUPS and len(words) > 1 else 1]
    text = helped(*path)
    for option in (word for word in words if word.startswith("--")):
        assert re.search(rf"{option}\b", text), f"{' '.join(path)} has no {option}"


# -- units ---------------------------------------------------------------------------------


def test_systemd_takes_the_units(tmp_path: Path) -> None:
    tool = shutil.which("systemd-analyze")
    if tool is None:
        absent("no systemd-analyze here: the units are not verified")
    program = tmp_path / "heliotrope"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for name in UNITS:
        text = (DEPLOY / name).read_text(encoding="utf-8")
        text = text.replace("/opt/heliotrope/bin/heliotrope", str(program))
        (tmp_path / name.replace("@", "@C1")).write_text(
            text.replace("User=heliotrope", "User=root")
        )
    given = [str(tmp_path / name.replace("@", "@C1")) for name in UNITS]
    done = subprocess.run(
        [tool, "verify", "--man=no", *given], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_systemd_finds_the_units_little_exposed(name: str) -> None:
    tool = shutil.which("systemd-analyze")
    if tool is None:
        absent("no systemd-analyze here: the units are not judged")
    given = [tool, "security", "--offline=true", "--threshold=30", str(DEPLOY / name)]
    done = subprocess.run(given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    found = re.search(r"exposure level for \S+: ([\d.]+)", done.stdout)
    assert found
    assert float(found[1]) <= 3.0


@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_the_units_are_bounded_and_can_do_their_work(name: str) -> None:
    text = (DEPLOY / name).read_text(encoding="utf-8")
    lines = text.splitlines()
    for bound in ("MemoryMax=", "TasksMax=", "LimitNOFILE=", "SystemCallFilter=@system-service"):
        assert any(line.startswith(bound) for line in lines), bound
    assert "CapabilityBoundingSet=" in lines
    # Compiled kernels need memory that is written, then executed.
    assert "MemoryDenyWriteExecute=yes" not in lines
    if "backup" in name:
        return
    assert {"DevicePolicy=closed", "DeviceAllow=char-ttyUSB rw"} <= set(lines)
    assert "PrivateDevices=yes" not in lines
    # `cluster.timekeeping` asks the kernel for the error of its clock.
    assert "ProtectClock=yes" not in lines
    calls = [line for line in lines if line.startswith("SystemCallFilter=")]
    assert any("adjtimex" in call for call in calls)


#: Numbers of calls on x86-64 that alter the resources of a process: `systemd-analyze syscall-filter
#: @resources` names them.
RESOURCE_CALLS = (141, 142, 144, 160, 203, 237, 238, 251, 256, 279, 314)
#: Denies those calls, as a unit does, then computes as the plant does.
CONFINED = """
import asyncio, ctypes, operator, os, struct, sys

def deny(numbers):
    load, equal, back = 0x20, 0x15, 0x06
    code = [(load, 0, 0, 0)]
    code += [(equal, len(numbers) - i, 0, number) for i, number in enumerate(numbers)]
    code += [(back, 0, 0, 0x7FFF0000), (back, 0, 0, 0x00050001)]  # allowed, or EPERM
    program = b"".join(struct.pack("HBBI", *line) for line in code)
    held = ctypes.create_string_buffer(program)
    given = struct.pack("HxxxxxxP", len(code), ctypes.addressof(held))
    libc = ctypes.CDLL(None, use_errno=True)
    assert libc.prctl(38, 1, 0, 0, 0) == 0
    assert libc.prctl(22, 2, ctypes.c_char_p(given), 0, 0) == 0

if __name__ == "__main__":
    deny([int(number) for number in sys.argv[1:]])
    try:
        os.nice(1)
    except PermissionError:
        print("denied", flush=True)
    from heliotrope.plant.workers import WorkerProcesses
    worker = WorkerProcesses(1)
    print(asyncio.run(worker(operator.add, 3, 4)), flush=True)
    worker.close()
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="calls have other numbers here")
def test_a_plant_computes_where_its_unit_denies_calls(tmp_path: Path) -> None:
    program = tmp_path / "confined.py"
    program.write_text(CONFINED)
    given = [sys.executable, program, *map(str, RESOURCE_CALLS)]
    done = subprocess.run(given, capture_output=True, text=True, check=False, timeout=120.0)
    assert done.stdout.split() == ["denied", "7"], done.stderr


@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_the_units_give_options_that_exist(name: str, capsys: Any, monkeypatch: Any) -> None:
    from heliotrope.cli import main

    text = (DEPLOY / name).read_text(encoding="utf-8") + (DEPLOY / "plant.env").read_text()
    command = re.search(r"bin/heliotrope (store backup|\w+)", text)
    assert command
    options = set(re.findall(r"(?<=\s)--[\w-]+", text))
    if "plant" not in name:
        options &= {"--every", "--to"}
    monkeypatch.setattr(sys, "argv", ["heliotrope", *command[1].split(), "--help"])
    with pytest.raises(SystemExit):
        main()
    helped = capsys.readouterr().out
    asked = {word for word in options if word not in ("--now", "--help")}
    assert asked
    assert all(re.search(rf"{word}\b", helped) for word in asked), helped


def test_the_plant_has_time_to_stow() -> None:
    limit = re.search(r"^TimeoutStopSec=(\d+)$", (DEPLOY / UNITS[0]).read_text(), re.M)
    assert limit
    assert int(limit[1]) > 300


# -- broker, links -------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "name"), [("conf", "mosquitto.conf"), ("acl", "mosquitto.acl")])
def test_the_brokers_files_are_those_that_are_tried(kind: str, name: str) -> None:
    """tests/links/test_mqtt.py starts a real Mosquitto with the blocks of the page."""
    page = (ROOT / "docs" / "how-to" / "mqtt.md").read_text(encoding="utf-8")
    block = re.search(rf"```{kind}\n(.*?)^```", page, re.S | re.M)
    assert block
    assert (DEPLOY / name).read_text(encoding="utf-8") == block[1]


def test_the_links_file_is_read(tmp_path: Path) -> None:
    shutil.copy(DEPLOY / "links.toml", tmp_path)
    (tmp_path / "C3.toml").touch()
    keys = tmp_path / "links.keys.toml"
    keys.touch(0o600)
    with pytest.raises(FormatError, match=r"clusters\.C1: a cluster and its plant authenticate"):
        read_links(tmp_path / "links.toml")
    keys.write_text(f'password = "x"\n[clusters]\nC1 = "{"2a" * 32}"\n')
    found = read_links(tmp_path / "links.toml")
    assert found.document.clusters == {"C1": "tcp", "C2": "mqtt", "C3": "C3.toml"}
    assert found.keys["C1"].newest == b"*" * 32
    assert "2a2a" not in repr(found)


def test_the_guide_names_every_setting_of_the_links_file() -> None:
    page = (ROOT / "docs" / "how-to" / "integrate.md").read_text(encoding="utf-8")
    part = page.partition("<!-- links -->")[2].partition("<!-- end of links -->")[0]
    for table in TABLES:
        for name, setting in table.model_fields.items():
            assert f"| `{name}` " in part, name
            assert (setting.description or "") in part, name


# -- the packages --------------------------------------------------------------------------


def test_the_packages_are_pinned_and_have_a_licence() -> None:
    done = subprocess.run(
        [sys.executable, "scripts/audit.py"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "--vulnerabilities looks up known ones" in done.stdout


_LOCKED = re.compile(
    r"^(\S+)==(\S+?)(?: ;[^\\\n]*)?((?: \\\n    --hash=sha256:[0-9a-f]{64})+)$", re.M
)


def _locked(text: str) -> dict[str, str]:
    """Return the version of each package of a lock that has a hash."""
    return {name: version for name, version, _ in _LOCKED.findall(text)}


def test_every_pinned_package_has_hashes() -> None:
    audit = runpy.run_path(str(ROOT / "scripts" / "audit.py"))
    pins = audit["constraints"]((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    text = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    lock = {audit["normal"](name): version for name, version in _locked(text).items()}
    assert lock == pins, "run make lock, and commit what it writes"
    assert len(lock) == len(re.findall(r"^\S+==", text, re.MULTILINE))
    assert "://" not in text
    assert "--require-hashes" in (ROOT / "scripts" / "setup.sh").read_text(encoding="utf-8")


def test_a_package_without_whole_hashes_is_not_locked() -> None:
    text = f"a==1.0 \\\n    --hash=sha256:{'0' * 64}\nb==2.0\nc==3.0 \\\n    --hash=sha256:12\n"
    assert _locked(text) == {"a": "1.0"}


def test_an_altered_package_is_not_installed(tmp_path: Path) -> None:
    """pip compares a wheel with the lock before it installs anything."""
    wheel = tmp_path / "thing-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("thing.py", "")
        about = "Metadata-Version: 2.1\nName: thing\nVersion: 1.0\n"
        archive.writestr("thing-1.0.dist-info/METADATA", about)
        archive.writestr("thing-1.0.dist-info/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        archive.writestr("thing-1.0.dist-info/RECORD", "")
    good = hashlib.sha256(wheel.read_bytes()).hexdigest()
    for sum_, accepted in ((good, True), (good[::-1], False)):
        lock = tmp_path / "requirements.lock"
        lock.write_text(f"thing==1.0 \\\n    --hash=sha256:{sum_}\n")
        options = ["--isolated", "--no-index", "--no-cache-dir", "--find-links", str(tmp_path)]
        options += ["--require-hashes", "--no-deps", "--target", str(tmp_path / sum_)]
        done = subprocess.run(
            [sys.executable, "-m", "pip", "install", *options, "--requirement", str(lock)],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert (done.returncode == 0) is accepted, done.stderr
        assert (tmp_path / sum_ / "thing.py").exists() is accepted


def test_the_bill_of_materials_names_every_package() -> None:
    given = [sys.executable, "scripts/audit.py", "--sbom"]
    done = subprocess.run(given, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    bill = json.loads(done.stdout)
    assert (bill["bomFormat"], bill["specVersion"], bill["version"]) == ("CycloneDX", "1.5", 1)
    assert re.fullmatch(r"urn:uuid:[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}", bill["serialNumber"])
    audit = runpy.run_path(str(ROOT / "scripts" / "audit.py"))
    every = [*audit["audit"](), *audit["vendored"]()]
    assert {one["name"] for one in bill["components"]} == {one.name for one in every}
    known = {bill["metadata"]["component"]["bom-ref"], *(c["bom-ref"] for c in bill["components"])}
    assert len(known) == 1 + len(bill["components"])
    numpy = next(one for one in bill["components"] if one["name"] == "numpy")
    assert numpy["purl"] == f"pkg:pypi/numpy@{numpy['version']}"
    assert "BSD" in numpy["licenses"][0]["license"]["name"]
    for one in bill["dependencies"]:
        assert one["ref"] in known
        assert known.issuperset(one["dependsOn"])
    ours = next(one for one in bill["dependencies"] if "pkg:pypi/heliotrope@" in one["ref"])
    assert numpy["purl"] in ours["dependsOn"]
    uplot, axe = (
        next(one for one in bill["components"] if one["name"] == name)
        for name in ("uplot", "axe-core")
    )
    assert uplot["purl"] == f"pkg:npm/uplot@{uplot['version']}"
    assert uplot["purl"] in ours["dependsOn"]
    assert (axe["scope"], axe["purl"] in ours["dependsOn"]) == ("excluded", False)


def test_each_javascript_library_in_the_repository_is_known(tmp_path: Path) -> None:
    vendored = runpy.run_path(str(ROOT / "scripts" / "audit.py"))["vendored"]
    found = {one.name: one for one in vendored()}
    assert {name: one.licence for name, one in found.items()} == {
        "uplot": "MIT",
        "axe-core": "MPL-2.0",
    }
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", one.version) for one in found.values())
    assert not any(one.problem for one in found.values())
    folder = tmp_path / "src"
    folder.mkdir()
    (folder / "new.min.js").write_text("/*! newcomer v1.2.3 */\n")
    (folder / "nobody.min.js").write_text("var x=1;")
    problems = {one.name: one.problem for one in vendored(tmp_path)}
    assert problems["newcomer"].startswith("its licence is not noted")
    assert problems["nobody.min.js"] == "its first line names no library and version"


def test_a_vulnerability_is_named_and_a_package_that_nobody_knows_is_no_good_news() -> None:
    judge_report = runpy.run_path(str(ROOT / "scripts" / "audit.py"))["judge_report"]
    good = {"name": "good", "version": "1", "vulns": []}
    flaw = {"id": "PYSEC-1", "fix_versions": ["1.2"], "aliases": []}
    bad = {"name": "bad", "version": "1.1", "vulns": [flaw, {**flaw, "fix_versions": []}]}
    unknown = {"name": "unknown", "skip_reason": "Dependency not found on PyPI"}
    assert judge_report({"dependencies": [good, bad]}) == (
        ["bad 1.1: PYSEC-1, mended in 1.2", "bad 1.1: PYSEC-1, mended in no version yet"],
        "2 of 2 packages looked up, 2 vulnerabilities",
    )
    lines, text = judge_report({"dependencies": [unknown, unknown]})
    assert not lines
    assert text == (
        "known vulnerabilities could not be looked up (the service knew none of 2 packages); "
        "run make audit where pypi.org can be reached"
    )
    _, text = judge_report({"dependencies": [good, unknown]})
    assert text.startswith("1 of 2 packages looked up, 0 vulnerabilities; 1 could not be looked up")


@pytest.mark.parametrize(
    ("errors", "why"),
    [
        (
            "Traceback\n  in a library\nConnectionError: pypi.org is unknown\n\n",
            "pypi.org is unknown",
        ),
        ("", "no answer"),
    ],
)
def test_without_the_service_the_audit_says_so_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], errors: str, why: str
) -> None:
    audit = runpy.run_path(str(ROOT / "scripts" / "audit.py"))
    failed = subprocess.CompletedProcess([], 1, stdout="", stderr=errors)
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    assert audit["look_up"]() == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("known vulnerabilities could not be looked up (")
    assert why in line
    assert line.endswith("; run make audit where pypi.org can be reached")


def test_the_audit_can_fail() -> None:
    audit = runpy.run_path(str(ROOT / "scripts" / "audit.py"))
    judge, pins = (
        audit["judge"],
        audit["constraints"]("a==1.0  # why\nB_c==2.0; python_version>'3'\n"),
    )
    assert pins == {"a": "1.0", "b-c": "2.0"}
    assert judge("a", "1.0", "MIT", pins).problem == ""
    assert "installed is 1.1, pinned is 1.0" in judge("a", "1.1", "MIT", pins).problem
    assert "not pinned" in judge("x", "1.1", "MIT", pins).problem
    assert "name no licence" in judge("a", "1.0", "", pins).problem
    assert "none of the allowed" in judge("a", "1.0", "GPL-3.0-only", pins).problem
    assert "none of the allowed" in judge("a", "1.0", "Proprietary", pins).problem


@pytest.mark.parametrize(
    ("licence", "good"),
    [
        ("GNU Lesser General Public License v3 (LGPLv3)", True),
        ("GPL-2.0 OR MIT", True),
        ("GNU Affero General Public License v3", False),
        ("AGPL-3.0", False),
        ("Permit", False),
        ("MPL-2.0 AND (Apache-2.0 OR MIT)", True),
    ],
)
def test_licences(licence: str, good: bool) -> None:
    audit = runpy.run_path(str(ROOT / "scripts" / "audit.py"))
    assert audit["allowed"](licence) is good
