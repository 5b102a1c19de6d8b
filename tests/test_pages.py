"""Pages and pictures of docs/ that are made from the code: current, and written when stale."""

import sys
from pathlib import Path
from typing import Any

import pytest
from scripts import library_pages, limits_page, pages


def test_every_page_that_is_made_from_the_code_is_current() -> None:
    assert list(pages.stale()) == [], "run python -m scripts.pages, and read what it changes"


def test_every_module_that_makes_pages_is_asked() -> None:
    scripts = Path(pages.__file__).parent.glob("*.py")
    making = {path.stem for path in scripts if "\ndef pages() ->" in path.read_text("utf-8")}
    assert making == set(pages.MODULES)


def test_a_changed_limit_shows_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    ((path, before),) = limits_page.pages().items()
    monkeypatch.setattr("heliotrope.safety.proof.FLUX_LIMIT", 0.11)
    assert limits_page.pages()[path] != before


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tree of three pages: one is current, one stale, and one of a package that is gone."""
    texts: dict[str, str | None] = {"a.md": "a\n", "b.md": "b\n", "c.md": None}
    made: Any = type("made", (), {"pages": staticmethod(lambda: texts)})
    for name in texts:
        (tmp_path / name).write_text("a\n")
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    monkeypatch.setattr(pages, "MODULES", ("made",))
    monkeypatch.setitem(sys.modules, "scripts.made", made)
    return tmp_path


def test_a_check_names_stale_pages_and_writes_nothing(
    small: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["pages", "--check"])
    assert pages.main() == 1
    said = capsys.readouterr().out.splitlines()
    assert said == [f"{name} is stale: python -m scripts.pages" for name in ("b.md", "c.md")]
    assert (small / "b.md").read_text() == "a\n"


def test_stale_pages_are_written_and_removed(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["pages"])
    assert pages.main() == 0
    assert {path.name: path.read_text() for path in small.iterdir()} == {
        "a.md": "a\n",
        "b.md": "b\n",
    }
    assert pages.stale() == {}


def test_only_the_text_between_the_marks_is_replaced(small: Path) -> None:
    (small / "d.md").write_text("1\n<!-- x -->\n2\n<!-- y -->\n3\n")
    text = pages.between("d.md", "<!-- x -->", "<!-- y -->", "4\n")
    assert text == "1\n<!-- x -->\n4\n<!-- y -->\n3\n"
    with pytest.raises(AssertionError, match=r"d\.md: the marks <!-- z --> and <!-- y --> are mis"):
        pages.between("d.md", "<!-- z -->", "<!-- y -->", "")


def test_the_page_of_a_package_that_is_gone_is_removed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library_pages, "PAGES", "docs/how-to")
    assert library_pages.pages()["docs/how-to/deploy.md"] is None
