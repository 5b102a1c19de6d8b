"""The page about security names tests and attacks that there are."""

import re
from pathlib import Path

from support.attacks import ATTACKS

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "explanation" / "security.md").read_text(encoding="utf-8")


def rows(title: str) -> list[list[str]]:
    """Return the cells of the table of a chapter, without its head."""
    chapter = re.split(r"\n###? ", PAGE.split(f"\n## {title}\n")[1])[0]
    lines = [line for line in chapter.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_each_test_that_is_named_exists() -> None:
    named = set(re.findall(r"`(tests/[\w/]+\.py)`", PAGE))
    assert len(named) > 20
    assert not [name for name in sorted(named) if not (ROOT / name).is_file()]


def test_each_threat_has_a_safeguard_and_a_test() -> None:
    threats = rows("Threats")
    assert len(threats) >= 11
    for threat, safeguard, proof in threats:
        assert threat, safeguard
        assert safeguard, threat
        assert re.search(r"`tests/[\w/]+\.py`", proof), threat


def test_each_attack_that_is_named_exists() -> None:
    known = set(ATTACKS)
    assert len(known) >= 25
    named = {word for _, _, proof in rows("Threats") for word in re.findall(r"\*([\w-]+)\*", proof)}
    assert named
    assert named <= known, named - known
    # And each attack belongs to a threat; `nothing` is what the measurement itself takes.
    assert known - named == {"nothing"}


def test_each_requirement_of_level_2_is_met_or_says_what_is_missing() -> None:
    found = rows("IEC 62443-3-3, SL 2 by requirement")
    asked = "1.7 1.11 1.12 2.5 2.6 2.8 2.9 2.10 3.4 3.8 3.9 4.2 6.2 7.1 7.2 7.3 7.4"
    assert " ".join(row[0].split()[1] for row in found) == asked
    for _, state, how, proof in found:
        assert state in ("met", "partly", "not met")
        assert how
        assert re.search(r"`tests/[\w/]+\.py`", proof)


def test_the_seven_requirements_are_answered() -> None:
    found = rows("IEC 62443-3-3")
    assert [row[0].split()[0] for row in found] == [f"FR{k}" for k in range(1, 8)]
    assert all(len(row) == 3 and all(row) for row in found)
