"""MkDocs hook: formulae become MathML when the pages are built, so none needs JavaScript.

Pages are Markdown: what reStructuredText writes in another way would be shown raw, and is refused.
"""

import html
import re
from typing import Any

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((?P<line>.*?)\\\)|\\\[(?P<block>.*?)\\\])</\1>',
    re.DOTALL,
)


def _mathml(match: re.Match[str]) -> str:
    block = match["block"]
    latex = html.unescape((block if block is not None else match["line"]).strip())
    return convert(latex, display="inline" if block is None else "block")


_CODE = re.compile(r"<(pre|code)\b.*?</\1>", re.DOTALL)
_RAW = re.compile(r"\.\. [a-z]+::|:[a-z]+:(?=`|<code)")


def on_page_content(content: str, *, page: Any, **_: Any) -> str:
    """Replace every formula that arithmatex has marked; refuse raw roles and directives."""
    raw = _RAW.search(_CODE.sub("<code", content))
    if raw is not None:
        where = page.file.src_uri
        raise PluginError(
            f"{where}: {raw[0]} is shown as it is; write Markdown: `name`, $x$, $$ x $$"
        )
    # A paragraph that announces an example ends with one colon.
    return _FORMULA.sub(_mathml, content).replace("::</p>", ":</p>")
