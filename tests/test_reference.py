"""The rendered reference: Markdown only, and every parameter with its own default."""

import ast
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import griffe
import pytest
from mkdocs.exceptions import PluginError

ROOT = Path(__file__).parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
RAW = re.compile(r"^\s*\.\. [a-z]+::|:[a-z]+:`", re.MULTILINE)
#: What a source has at least if one of its docstrings has raw markup.
MAYBE = re.compile(r"\.\. [a-z]+::|:[a-z]+:`")
KINDS = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@pytest.fixture
def docs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The modules that MkDocs loads from the folder of the pages."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    for name in ("hooks", "grouped_parameters"):
        monkeypatch.delitem(sys.modules, name, raising=False)


def test_docstrings_are_markdown() -> None:
    raw = []
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if MAYBE.search(text) else ():
            if isinstance(node, KINDS):
                found = RAW.search(ast.get_docstring(node) or "")
                if found is not None:
                    raw.append(f"{path.relative_to(ROOT)}: {found[0].strip()}")
    assert not raw, "write `name`, $x$ or $$ x $$"


@pytest.mark.parametrize(
    "content", ["<p>.. math:: x = 1</p>", "<p>see :func:<code>fit</code></p>", "<p>:math:`x`</p>"]
)
def test_a_page_with_raw_markup_is_refused(docs: None, content: str) -> None:
    import hooks  # type: ignore[import-not-found]

    page = SimpleNamespace(file=SimpleNamespace(src_uri="reference/library/optics.md"))
    with pytest.raises(PluginError, match=r"reference/library/optics\.md: .* is shown as it is"):
        hooks.on_page_content(content, page=page)
    quoted = "<pre>.. math:: x</pre><p>A plant::</p>"
    assert hooks.on_page_content(quoted, page=page) == "<pre>.. math:: x</pre><p>A plant:</p>"


def test_parameters_described_together_keep_their_defaults(docs: None, tmp_path: Path) -> None:
    from grouped_parameters import GroupedParameters  # type: ignore[import-not-found]

    # Alone, without the package around it: that takes seconds to read.
    source = ROOT / "src" / "heliotrope" / "calibration" / "workflow.py"
    (tmp_path / source.name).write_bytes(source.read_bytes())
    module = griffe.load(
        "workflow",
        search_paths=[str(tmp_path)],
        docstring_parser="numpy",
        extensions=griffe.load_extensions(GroupedParameters),
    )
    shown = {}
    for section in module["evaluate"].docstring.parsed:
        if section.kind is griffe.DocstringSectionKind.parameters:
            shown = {p.name: (str(p.value), str(p.annotation)) for p in section.value}
    assert shown["split"] == ("'random'", "Split")
    assert shown["fraction"] == ("0.7", "float")
    assert shown["seed"] == ("0", "int")
    assert shown["mechanism"] == ("None", "Mechanism")
