"""MkDocs hook: formulae become MathML when the pages are built, so none needs JavaScript."""

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((?P<line>.*?)\\\)|\\\[(?P<block>.*?)\\\])</\1>',
    re.DOTALL,
)


def _mathml(match: re.Match[str]) -> str:
    block = match["block"]
    latex = html.unescape((block if block is not None else match["line"]).strip())
    return convert(latex, display="inline" if block is None else "block")


def on_page_content(content: str, **_: Any) -> str:
    """Replace every formula that arithmatex has marked."""
    return _FORMULA.sub(_mathml, content)
