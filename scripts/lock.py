"""Write the hashes of all pinned packages, or check that they are those of constraints.txt.

python scripts/lock.py [--check]

Without an option it asks the package index for the SHA-256 of every file of every package that
constraints.txt pins, for all platforms, and writes requirements.lock; it needs uv. With
``--check`` nothing is fetched: the exit code is 1 if a package is missing, has another version or
no hash.
"""

import argparse
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
PINS, LOCK = ROOT / "constraints.txt", ROOT / "requirements.lock"
#: Oldest Python for which all pinned versions exist.
OLDEST = "3.11.5"
_HEAD = "# Hashes of the packages that constraints.txt pins; written by scripts/lock.py.\n"
_ENTRY = re.compile(
    r"^(\S+)==(\S+?)(?: ;[^\\\n]*)?((?: \\\n    --hash=sha256:[0-9a-f]{64})+)$", re.M
)


def locked(text: str) -> dict[str, str]:
    """Return the version of each package that has a hash."""
    return {name: version for name, version, _ in _ENTRY.findall(text)}


def differences(pins: dict[str, str], lock: dict[str, str]) -> list[str]:
    """Return a line for each package whose pin and lock differ."""
    return [
        f"{name}: pinned {pins.get(name, 'not')}, with hashes {lock.get(name, 'none')}"
        for name in sorted(pins.keys() | lock.keys())
        if pins.get(name) != lock.get(name)
    ]


def _uv() -> str:
    found = shutil.which("uv")
    return found or sys.exit("lock: no uv found; install the version in constraints.txt")


def write() -> None:
    """Fetch the hashes, and write the lock."""
    done = subprocess.run(  # noqa: S603  # fixed arguments
        [_uv(), "pip", "compile", str(PINS), "--generate-hashes", "--no-deps", "--universal",
         "--no-header", "--no-annotate",
         "--python-version", OLDEST, "--quiet"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        sys.exit(f"lock: uv could not resolve the pins: {done.stderr.strip()[-500:]}")
    LOCK.write_text(_HEAD + done.stdout, encoding="utf-8")


def main() -> None:
    """Write or check."""
    parser = argparse.ArgumentParser(description="Hashes of the pinned packages.")
    parser.add_argument("--check", action="store_true", help="fetch nothing; compare with the pins")
    if not parser.parse_args().check:
        write()
    audit = runpy.run_path(str(ROOT / "scripts" / "audit.py"))
    pins = audit["constraints"](PINS.read_text(encoding="utf-8"))
    lock = {audit["normal"](n): v for n, v in locked(LOCK.read_text(encoding="utf-8")).items()}
    wrong = differences(pins, lock)
    if wrong:
        print(*wrong, "run `python scripts/lock.py`, and commit what it writes", sep="\n")
    else:
        print(f"{len(lock)} packages, all with hashes")
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
