"""The controller under MicroPython: the same steps to the last one, and its memory."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from heliotrope.lcu import states
from lcu.controller_on_micropython import Replay
from lcu.test_micropython import FILES, HERE, NEWEST, OLDEST, compile_with, cross_compiler, run
from lcu_machines import STOW, Bench

#: What a board needs to run, and what it may take (bytes) with all code in memory; code that is
#: frozen into the firmware takes nearly none.
ON_BOARD = {
    "__init__", "config", "controller", "drives", "journal", "lease", "messages", "motion",
    "pointing", "search", "states", "stepper", "ticks", "vectors", "wire",
}  # fmt: skip
LIMIT = 76 * 1024


class Recorder(Bench):
    """A bench that writes down what comes to the board."""

    def __init__(self) -> None:
        self.events: list[tuple[int, str | None]] = []
        super().__init__()

    def deliver(self, data: bytes) -> None:
        self.events.append((self.now, data.hex()))
        super().deliver(data)

    def tick(self, ms: int = 50) -> None:
        super().tick(ms)
        self.events.append((self.now, None))


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    bench = Recorder()
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


def script(events: int) -> str:
    """The replay in parts, between which memory is collected."""
    first = [
        "import gc\nbefore = gc.mem_alloc()",
        "import controller_on_micropython as replay\nafter = gc.mem_alloc()",
        "given = replay.given_from('/given.json')\nday = replay.Replay(given)",
    ]
    middle = [
        f"for event in given['events'][{start}:{start + 60}]:\n    day.event(*event)"
        for start in range(0, events, 60)
    ]
    sizes = "[after - before, gc.mem_alloc() - before]"
    last = ["given = event = None", f"import json\nprint(json.dumps(day.result() + {sizes}))"]
    return "\n# ---\n".join(first + middle + last)


@pytest.mark.parametrize("version", [OLDEST, NEWEST])
def test_a_day_in_short_is_the_same_to_the_step(
    version: str, given: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "lcu").mkdir()
    compiled = version == NEWEST
    for path in FILES:
        if path.stem in ON_BOARD:
            if compiled:
                compile_with(cross_compiler(), path, tmp_path / "lcu" / f"{path.stem}.mpy")
            else:
                shutil.copy(path, tmp_path / "lcu")
    shutil.copy(HERE / "controller_on_micropython.py", tmp_path)
    (tmp_path / "given.json").write_text(json.dumps(given), encoding="utf-8")
    (tmp_path / "main.py").write_text(script(len(given["events"])), encoding="utf-8")
    *found, imported, running = json.loads(run(version, tmp_path, "main.py").splitlines()[-1])
    here = Replay(given)
    for event in given["events"]:
        here.event(*event)
    assert found == here.result()
    assert found[0] == states.STOWING
    assert abs(found[2][0]) > 400_000
    print(f"MicroPython {version}: {imported} bytes imported, {running} bytes running")
    if compiled:
        assert running < LIMIT
