"""The page on the sources: its commands run, and every figure of ours is what they print."""

import ast
import contextlib
import functools
import io
import re
import runpy
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from heliotrope.cli import main

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "explanation" / "sources.md"
_COMMAND = re.compile(r"`([^`]+)`( \(slow\))?")
COLUMNS = 5
#: What a number of the last column may be beside a figure: code and addresses of links; equations;
#: tables, figures and sections of the paper; dates; standards.
_NOT_FIGURES = re.compile(
    r"`[^`]*`|\]\([^)]*\)|\(\d+(?:[.,]\d+)?\)"
    r"|\b(?:tables?|figures?|sections?) \d+(?:\.\d+)?(?:(?:,| to| and) \d+(?:\.\d+)?)*"
    r"|\b\d+(?:(?:,| to| and) \d+)* (?:June|September|December)(?: \d{4})?|802\.15\.4"
)
_FIGURE = re.compile(
    r"(?<![\w.])(\d+(?:,\d{3})*(?:\.\d+)?)(?:e(-?\d+)|·10(⁻?[⁰¹²³⁴⁵⁶⁷⁸⁹]+))?(?![\w.]*\d)"
)
_PRINTED = re.compile(r"(?<![\w.])\d[\d,_]*(?:\.\d+)?(?:e[-+]?\d+)?")
_RAISED = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")


def _tables() -> dict[str, list[list[str]]]:
    """Return the rows of each paper's table, by the heading above it."""
    found: dict[str, list[list[str]]] = {}
    paper = ""
    for line in PAGE.read_text(encoding="utf-8").splitlines():
        if line.startswith("## "):
            paper = line[3:]
        elif line.startswith("|"):
            found.setdefault(paper, []).append([c.strip() for c in line.strip("|").split("|")])
    return {paper: rows[2:] for paper, rows in found.items()}


def _run(line: str) -> str:
    words = shlex.split(line)
    out = io.StringIO()
    before = sys.argv
    try:
        with contextlib.redirect_stdout(out):
            if words[:2] == ["python", "-m"]:
                sys.argv = words[2:]
                with pytest.raises(SystemExit) as leaving:
                    runpy.run_module(words[2], run_name="__main__")
                assert leaving.value.code == 0, f"{line} ended with {leaving.value.code}"
            elif words[0] == "python":
                sys.argv = words[1:]
                runpy.run_path(words[1], run_name="__main__")
            else:
                assert words[0] == "heliotrope", f"{line}: neither heliotrope nor python"
                sys.argv = words
                with pytest.raises(SystemExit) as leaving:
                    main()
                assert leaving.value.code in (0, None), f"{line} ended with {leaving.value.code}"
    finally:
        sys.argv = before
    return out.getvalue()


def _named_test_exists(line: str) -> bool:
    path, _, name = shlex.split(line)[1].partition("::")
    file = ROOT / path
    return file.is_file() and (not name or f"def {name}(" in file.read_text(encoding="utf-8"))


def _source_of(line: str) -> str:
    """Return the source of a named test with its parameters, or of the whole file."""
    path, _, name = shlex.split(line)[1].partition("::")
    text = (ROOT / path).read_text(encoding="utf-8")
    made = [
        ast.get_source_segment(text, part)
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name == name
        for part in (*node.decorator_list, node)
    ]
    return "\n".join(one for one in made if one) if name else text


def _figures(text: str) -> list[str]:
    """Return the figures of a cell, as they stand there."""
    return [match[0] for match in _FIGURE.finditer(_NOT_FIGURES.sub(" ", text))]


def _is_printed(figure: str, shown: str) -> bool:
    """Return whether a figure is rounded from a number that is shown."""
    digits, power, raised = _FIGURE.fullmatch(figure).groups()  # type: ignore[union-attr]
    scale = 10.0 ** int(power or (raised or "0").translate(_RAISED))
    value = float(digits.replace(",", ""))
    places = len(digits.partition(".")[2])
    numbers = (float(re.sub("[,_]", "", one)) / scale for one in _PRINTED.findall(shown))
    return any(abs(one - value) <= 0.5 * 10.0**-places * (1.0 + 1e-6) for one in numbers)


def _compare(rows: list[list[str]], shown: Callable[[str], str]) -> None:
    """Compare the figures of rows with what their commands show."""
    wrong = []
    for row in rows:
        seen = "\n".join(shown(line) for line, _ in _COMMAND.findall(row[2]))
        missing = [one for one in _figures(row[4]) if not _is_printed(one, seen)]
        wrong += [f"{row[0]}: no command prints {', '.join(missing)}"] if missing else []
    assert not wrong, "\n".join(wrong)


def _is_slow(row: list[str]) -> bool:
    return any(slow for _, slow in _COMMAND.findall(row[2]))


def _in_a_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Return what shows a command: its output in a folder of its own, or a test's source."""
    monkeypatch.chdir(folder)
    for name in ("examples", "scripts", "benchmarks"):
        (folder / name).symlink_to(ROOT / name)

    @functools.cache
    def shown(line: str) -> str:
        if line.startswith("pytest "):
            # The suite itself runs it.
            assert _named_test_exists(line), f"{line}: there is no such test"
            return _source_of(line)
        printed = _run(line)
        assert printed.strip(), f"{line} prints nothing"
        return printed

    return shown


@pytest.mark.parametrize("paper", _tables())
def test_every_command_runs_and_prints_our_figures(
    paper: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = _in_a_folder(tmp_path, monkeypatch)
    rows = _tables()[paper]
    for row in rows:
        for line, slow in _COMMAND.findall(row[2]):
            if slow:
                words = shlex.split(line)
                path = words[1] if words[1] != "-m" else f"{words[2]}/{words[3]}.py"
                assert (ROOT / path).is_file(), f"{line}: there is no {path}"
            else:
                shown(line)
    _compare([row for row in rows if not _is_slow(row)], shown)


@pytest.mark.slow
@pytest.mark.parametrize("row", [r for rows in _tables().values() for r in rows if _is_slow(r)])
def test_slow_commands_print_our_figures(
    row: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _compare([row], _in_a_folder(tmp_path, monkeypatch))


@pytest.mark.parametrize("paper", _tables())
def test_every_row_is_whole(paper: str) -> None:
    for row in _tables()[paper]:
        assert len(row) == COLUMNS, row
        assert all(row), row
        assert _COMMAND.search(row[2]) or row[1] == "not here", f"{row[0]}: no command"


def test_guos_equations_are_all_there() -> None:
    text = " ".join(row[0] for row in _tables()["Guo"])
    spans = [
        range(int(a), int(b or a) + 1) for a, b in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", text)
    ]
    assert {n for span in spans for n in span} == set(range(1, 48))
    assert {int(n) for n in re.findall(r"figure (\d)", text)} == {1, 2, 3, 4, 5}


def test_the_check_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(AssertionError, match="ended with 2"):
        _run("heliotrope field check nowhere.xml")
    assert not _named_test_exists("pytest tests/test_sources.py::test_nothing_of_the_kind")


def test_a_figure_is_rounded_from_what_is_printed() -> None:
    printed = "10,000 heliostats, 30.51 mrad, 5.23e-05 mm, -237.429, 0.009546"
    for good in ("10,000", "30.5", "5·10⁻⁵", "237.43", "0.010", "31"):
        assert _is_printed(good, printed), good
    for wrong in ("10,001", "30.6", "30.50", "6·10⁻⁵", "237.42", "0.011", "1"):
        assert not _is_printed(wrong, printed), wrong
    with pytest.raises(AssertionError, match=r"row: no command prints 0\.7"):
        _compare([["row", "", "`python x.py`", "", "0.6 and 0.7 mrad"]], lambda _: "0.6 mrad")


def test_references_are_no_figures() -> None:
    text = "as (22) and table 6.1, figures 6.6 to 6.8, on 6, 7 and 8 September 2012: 1.5 to 2 mrad"
    assert _figures(text) == ["1.5", "2"]
    assert _figures("[12](a-13.md) of 1,536 in `f(14)`, 802.15.4 (99.99 % in 1 s)") == [
        "12", "1,536", "99.99", "1",
    ]  # fmt: skip
