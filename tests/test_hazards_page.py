"""The page about hazards names tests that there are, and each hazard has its parts."""

import re
from pathlib import Path

from heliotrope.lcu import messages

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "explanation" / "hazards.md").read_text(encoding="utf-8")


def test_each_file_that_is_named_exists() -> None:
    files = set(re.findall(r"`(tests/[\w/]+\.py)`", PAGE))
    assert len(files) > 20
    assert not [name for name in sorted(files) if not (ROOT / name).is_file()]


def test_each_test_stands_in_a_file_that_its_chapter_names() -> None:
    where: dict[str, set[str]] = {}
    for path in (ROOT / "tests").rglob("test_*.py"):
        for name in re.findall(r"def (test_\w+)\(", path.read_text(encoding="utf-8")):
            where.setdefault(name, set()).add(path.relative_to(ROOT).as_posix())
    count = 0
    for chapter in PAGE.split("\n## ")[1:]:
        files = set(re.findall(r"`(tests/[\w/]+\.py)`", chapter))
        for name in re.findall(r"`(test_\w+)`", chapter):
            count += 1
            assert where.get(name, set()) & files, f"{chapter.splitlines()[0]}: {name}"
    assert count > 80


def test_every_order_that_moves_or_locks_has_a_row_of_unsafe_control_actions() -> None:
    table = PAGE.partition("\n## Unsafe control actions")[2].partition("\n## ")[0]
    rows = {
        line.split("|")[1].strip(" `"): line.strip("|").split("|")
        for line in table.splitlines()
        if line.startswith("| `")
    }
    orders = {
        row[1] for row in messages.MESSAGES if row[2] in (messages.ANYONE, messages.AUTHORITY)
    }
    assert rows.keys() == orders
    # A cell names tests, and not a file in which its test might be.
    assert not [name for name, cells in rows.items() if "tests/" in "".join(cells)]
    named = {name: re.findall(r"`(test_\w+)`", "".join(cells)) for name, cells in rows.items()}
    assert not [name for name, tests in named.items() if not tests and name != "GOTO"]
    assert all(len(cells) == 7 and all(cell.strip() for cell in cells) for cells in rows.values())


def test_each_hazard_has_a_cause_a_safeguard_a_test_and_what_remains() -> None:
    chapters = PAGE.split("\n## ")[1:]
    assert len(chapters) > 20
    for chapter in chapters:
        title = chapter.splitlines()[0]
        for part in ("Cause", "Safeguard", "Test", "What remains"):
            assert f"**{part}" in chapter, f"{title}: no {part}"
