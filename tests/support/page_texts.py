"""Finds the texts of the operator's page in its sources: those that are translated, and others.

A text is translated where it is the first argument of ``t`` or ``word``, or where it stands in an
HTML file. A literal counts as shown to people by its place: a child of an element, a title, a
label, an error, what the command bar says; and everywhere else if it reads like a sentence.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser

#: Functions whose first argument is translated.
TRANSLATED = {"t", "word"}
#: Properties, attributes and variables that people read.
SHOWN = {
    "alt", "ariaLabel", "aria-label", "label", "placeholder", "text", "textContent", "title",
}  # fmt: skip
#: Calls with the place of the first argument that people read, and of the last.
CALLS = {
    "Error": (0, 0), "ApiError": (1, 1), "act": (1, 1), "ask": (0, 9), "askAnd": (0, 9),
    "button": (0, 0), "confirmed": (0, 9), "fillText": (0, 0), "h": (2, 99), "key": (0, 0),
    "large": (0, 1), "once": (0, 0), "open": (0, 0), "order": (1, 1), "say": (0, 0),
    "tell": (0, 0),
}  # fmt: skip
#: Calls and properties of code, whose words may look like a sentence.
CODE_CALLS = {"closest", "saveCsv", "querySelector", "querySelectorAll", "set", "toggle"}
CODE_KEYS = {"class", "className", "font", "style"}
ATTRIBUTES = ("alt", "aria-label", "placeholder", "title")
#: Elements whose text no reader's language changes.
UNTRANSLATED = {"script", "style", "pre"}
_WORD = re.compile(r"[A-Za-zÄÖÜäöüß]{2,}")
_SENTENCE = re.compile(r"[A-Za-z]{2,}[,;:.…]? [a-z]{2,}|[a-z]{2,} [A-Z][a-z]+")
_TITLE = re.compile(r"[A-Z][a-z]+(?: \([a-z°]+\)|…)?")
#: Units and names of files and formats, which are the same in every language.
_SAME = re.compile(r"[kMG]?W|W/m²|kW/m²|MWh|kWh/m²|m/s|m|s|min|h|d|mm|mrad|px|ppm|UTC|CSV|°C?|Alt")
_TOKEN = re.compile(
    r"""(?P<space>\s+|//[^\n]*|/\*[^]*?\*/)|(?P<word>[A-Za-z_$][\w$]*)|(?P<number>\d[\w.]*)"""
    r"""|(?P<string>"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*')"""
    r"""|(?P<sign>=>|===|!==|==|!=|<=|>=|&&|\|\||\?\?|\?\.|\.\.\.|[^\s\w])""".replace(
        "[^]", r"[\s\S]"
    )
)
_PATTERN = re.compile(r"/(?:[^/\\\[\n]|\\.|\[(?:[^\]\\\n]|\\.)*\])+/[a-z]*")
_OPENED = {"(": ")", "[": "]", "{": "}"}


@dataclass(frozen=True)
class Literal:
    """A text in a source: its line, whether it is translated, and whether people may read it."""

    text: str
    line: int
    translated: bool
    shown: bool


@dataclass
class _Frame:
    """An open bracket: the call or object it belongs to, and the argument or property."""

    opened: str
    call: str = ""
    place: int = 0
    key: str = ""
    assigned: str = ""
    literals: list[Literal] = field(default_factory=list)


class _Reader:
    """Reads one file of JavaScript."""

    def __init__(self, source: str) -> None:
        self._source, self._at = source, 0
        self._frames = [_Frame("")]
        self._before = ["", ""]
        self.found: list[Literal] = []

    def read(self, until: str = "") -> None:
        """Read to the end, or to the bracket that closes a part of a template."""
        depth = len(self._frames)
        while self._at < len(self._source):
            if self._source[self._at] == "`":
                self._template()
                continue
            if self._source[self._at] == "/" and self._pattern():
                continue
            match = _TOKEN.match(self._source, self._at)
            assert match is not None, self._source[self._at : self._at + 40]
            self._at, text = match.end(), match.group()
            if match.lastgroup == "space":
                continue
            if text == until and len(self._frames) == depth:
                return
            if match.lastgroup == "string":
                self._literal(text[1:-1].replace("\\'", "'").replace('\\"', '"'), match.start())
            self._take(text)

    def _pattern(self) -> bool:
        """Step over a regular expression, if one begins here."""
        divides = re.fullmatch(r"[\w$)\]\"']+", self._before[-1]) and self._before[-1] != "return"
        match = None if divides else _PATTERN.match(self._source, self._at)
        if match is None or self._source.startswith(("//", "/*"), self._at):
            return False
        self._at = match.end()
        self._take('""')
        return True

    def _take(self, text: str) -> None:
        frame = self._frames[-1]
        if text in _OPENED:
            call = self._before[-1] if text == "(" else ""
            self._frames.append(_Frame(text, call if re.fullmatch(r"[\w$]+", call) else ""))
        elif text in _OPENED.values():
            self._frames.pop()
        elif text == ",":
            frame.place, frame.key, frame.assigned = frame.place + 1, "", ""
        elif text == ";":
            frame.assigned = frame.key = ""
        elif text == "=":
            frame.assigned = self._before[-1]
        elif text == ":" and frame.opened == "{" and not frame.key:
            frame.key = self._before[-1].strip("\"'")
        self._before = [*self._before[-2:], text]

    def _template(self) -> None:
        """Read a template: what stands between its values is text."""
        line = self._at
        self._at += 1
        translated = self._begins_translated()
        while True:
            end = self._at
            while self._source[end] != "`" and not self._source.startswith("${", end):
                end += 2 if self._source[end] == "\\" else 1
            self._literal(self._source[self._at : end], line, never=translated)
            if self._source[end] == "`":
                self._at = end + 1
                self._take('""')
                return
            self._at = end + 2
            self._frames.append(_Frame("${"))
            self._before = ["", "", "${"]
            self.read("}")
            self._frames.pop()

    def _begins_translated(self) -> bool:
        return self._before[-1] == "(" and self._before[-2] in TRANSLATED

    def _literal(self, text: str, at: int, *, never: bool = False) -> None:
        translated = self._begins_translated() and not never
        line = self._source.count("\n", 0, at) + 1
        compared = self._before[-1] in ("===", "!==") or self._follows("===", "!==")
        is_key = self._frames[-1].opened == "{" and self._follows(":") and self._before[-1] in ",{"
        shown = not compared and not is_key and self._is_shown(text)
        self.found.append(
            Literal(
                text,
                line,
                translated,
                (shown or (never and bool(_WORD.search(text)))) and not translated,
            )
        )

    def _follows(self, *signs: str) -> bool:
        rest = re.sub(r"^[\"']?\s*", "", self._source[self._at : self._at + 12])
        return rest.startswith(signs)

    def _is_shown(self, text: str) -> bool:
        if not _WORD.search(text) or text[0] in "/#&" or _SAME.fullmatch(text.strip(" {}.,:;()/+")):
            return False
        for frame in reversed(self._frames):
            if frame.key or frame.assigned:
                key = frame.key or frame.assigned
                if key in SHOWN:
                    return True
                if key in CODE_KEYS:
                    return False
            if frame.call and frame.call not in ("if", "while", "for", "return"):
                if frame.call in CODE_CALLS:
                    return False
                first, last = CALLS.get(frame.call, (1, 0))
                if first <= frame.place <= last and frame is self._frames[-1]:
                    return True
                if first <= frame.place <= last and self._frames[-1].opened == "${":
                    return True
                break
            if frame.opened in ("[", "{") and frame is not self._frames[-1]:
                break
        return bool(_SENTENCE.search(text) or _TITLE.fullmatch(text.strip(" ↓↑●▲✕○:")))


def literals(source: str) -> list[Literal]:
    """Return the texts of a file of JavaScript."""
    reader = _Reader(source)
    reader.read()
    return reader.found


class _Page(HTMLParser):
    """Collects the texts of an HTML file."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self._skips = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Take the attributes that people read."""
        given = dict(attrs)
        if given.get("translate") == "no" or tag in UNTRANSLATED:
            self._skips += 1
        self.texts += [text for name in ATTRIBUTES if (text := given.get(name))]

    def handle_endtag(self, tag: str) -> None:
        """Go on after an element that is not translated."""
        self._skips = max(0, self._skips - 1) if self._skips else 0

    def handle_data(self, data: str) -> None:
        """Take a text."""
        if not self._skips and _WORD.search(text := " ".join(data.split())):
            self.texts.append(text)


def html_texts(source: str) -> list[str]:
    """Return the texts of an HTML file, as the page looks them up."""
    page = _Page()
    page.feed(source)
    return page.texts


def css_texts(source: str) -> Iterator[str]:
    """Return the texts that a style sheet adds, which nothing translates."""
    yield from (text for text in re.findall(r'content:\s*"([^"]*)"', source) if _WORD.search(text))
