"""Write the pages and pictures of docs/ that are made from the code, or check them.

``python -m scripts.pages [--check]``. Each module of `MODULES` has a function ``pages()`` that
returns text by path, relative to the root; None stands for a file that is to go.
"""

import argparse
import importlib
import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
MODULES = (
    "alarms_page", "api_page", "house", "library_pages", "limits_page", "parameters_page",
    "safety_table", "state_table", "wire_table", "wiring",
)  # fmt: skip


def between(path: str, begin: str, end: str, middle: str) -> str:
    """Return a page with the text between two of its marks replaced."""
    text = (ROOT / path).read_text(encoding="utf-8")
    found = re.search(f"(?<={re.escape(begin)}\n).*(?={re.escape(end)})", text, re.DOTALL)
    assert found is not None, f"{path}: the marks {begin} and {end} are missing"
    return text[: found.start()] + middle + text[found.end() :]


def stale() -> dict[str, str | None]:
    """Return the text of each page that differs from its file, by path; None: the file is to go."""
    wanted: dict[str, str | None] = {}
    for name in MODULES:
        wanted |= importlib.import_module(f"scripts.{name}").pages()
    kept = {path: ROOT / path for path in wanted}
    return {
        path: text
        for path, text in wanted.items()
        if text != (kept[path].read_text(encoding="utf-8") if kept[path].is_file() else None)
    }


def main() -> int:
    """Write or check; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--check", action="store_true", help="write nothing; status 1 if stale")
    check = parser.parse_args().check
    changed = stale()
    for path, text in changed.items():
        print(f"{path} is stale: python -m scripts.pages" if check else path)
        if check:
            continue
        if text is None:
            (ROOT / path).unlink()
        else:
            (ROOT / path).write_text(text, encoding="utf-8")
    return 1 if check and changed else 0


if __name__ == "__main__":
    sys.exit(main())
