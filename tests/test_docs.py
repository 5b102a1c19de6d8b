"""The documentation is true: its snippets run, and print what the page says they print."""

import contextlib
import io
import re
import shlex
import sys
from pathlib import Path

import pytest

from heliotrope.calibration.report import page as report
from heliotrope.cli import main
from support.data import juelich

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
_BLOCK = re.compile(
    r"(?P<mark><!-- no-run: (?P<reason>[^\n]*?) -->\n)?```(?P<kind>\w+)\n(?P<body>.*?)^```",
    re.DOTALL | re.MULTILINE,
)
_NUMBER = re.compile(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")


def _blocks(page: Path) -> list[re.Match[str]]:
    return list(_BLOCK.finditer(page.read_text(encoding="utf-8")))


def _words(text: str) -> list[str]:
    return text.split()


def _same_word(wanted: str, found: str) -> bool:
    """Equal, or numbers that agree to one unit of the last digit shown."""
    if wanted == found:
        return True
    split = [_NUMBER.split(word) for word in (wanted, found)]
    numbers = [_NUMBER.findall(word) for word in (wanted, found)]
    if split[0] != split[1] or len(numbers[0]) != len(numbers[1]):
        return False
    for a, b in zip(*numbers, strict=True):
        mantissa, _, exponent = a.partition("e")
        digits = len(mantissa.partition(".")[2])
        unit = 10.0 ** (int(exponent or 0) - digits)
        # Figures that are rounding alone (1e-9 mrad) say their size, no more.
        if abs(float(a.replace(",", ""))) < 1e-6 and abs(float(b.replace(",", ""))) < 1e-6:
            continue
        if abs(float(a.replace(",", "")) - float(b.replace(",", ""))) > 1.001 * unit:
            return False
    return True


def _check(wanted: str, found: str, where: str) -> None:
    a, b = _words(wanted), _words(found)
    assert len(a) == len(b), f"{where}: the page says\n{wanted}\nbut it prints\n{found}"
    for x, y in zip(a, b, strict=True):
        assert _same_word(x, y), f"{where}: {x!r} on the page, {y!r} printed\n{found}"


def _command(line: str) -> str:
    words = shlex.split(line)
    assert words[0] == "heliotrope", f"only heliotrope can be run here, not {words[0]}"
    out = io.StringIO()
    before = sys.argv
    sys.argv = words
    try:
        with contextlib.redirect_stdout(out), pytest.raises(SystemExit) as leaving:
            main()
    finally:
        sys.argv = before
    assert leaving.value.code in (0, None), f"{line} ended with {leaving.value.code}"
    return out.getvalue()


def _console(body: str, where: str) -> None:
    parts = re.split(r"^\$ (.*)\n", body, flags=re.MULTILINE)
    for line, wanted in zip(parts[1::2], parts[2::2], strict=True):
        _check(wanted, _command(line), f"{where}: $ {line}")


@pytest.mark.parametrize("page", PAGES, ids=[str(p.relative_to(ROOT)) for p in PAGES])
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # A report of two heliostats is as true as one of eighteen.
    monkeypatch.setattr(report, "MOST_SECTIONS", 1)
    if "<!-- needs: juelich -->" in page.read_text(encoding="utf-8"):
        (tmp_path / "juelich").symlink_to(juelich())
    names: dict[str, object] = {"__name__": "__page__"}
    printed: str | None = None
    for block in _blocks(page):
        where = f"{page.relative_to(ROOT)}: {block['body'][:50]!r}"
        kind, expected, printed = block["kind"], printed, None
        if block["mark"]:
            print(f"not run: {where}: {block['reason']}")
        elif kind == "python":
            out = io.StringIO()
            with contextlib.redirect_stdout(out):
                exec(compile(block["body"], str(page), "exec"), names)
            printed = out.getvalue()
        elif kind == "text" and expected is not None:
            _check(block["body"], expected, where)
        elif kind == "console":
            _console(block["body"], where)


def test_the_check_can_fail() -> None:
    assert _same_word("0.172", "0.173")
    assert not _same_word("0.172", "0.174")
    assert not _same_word("12.5mrad", "12.5m")
    with pytest.raises(AssertionError, match="on the page"):
        _check("1 2 3", "1 2 5", "here")
    with pytest.raises(AssertionError, match="but it prints"):
        _check("1 2 3", "1 2", "here")


def test_what_is_not_run_is_little() -> None:
    marked = [b["reason"] for page in PAGES for b in _blocks(page) if b["mark"]]
    assert len(marked) <= 4, marked


def test_links_between_pages_lead_somewhere() -> None:
    link = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
    broken = [
        f"{page.relative_to(ROOT)}: {place}"
        for page in PAGES
        for place in link.findall(page.read_text(encoding="utf-8"))
        if "://" not in place and not (page.parent / place).exists()
    ]
    assert not broken
