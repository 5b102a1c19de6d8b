"""An XML document as a tree of frozen elements whose attributes are kept as text."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.parsers import expat

from heliotrope.errors import FormatError
from heliotrope.files.kinds import instead
from heliotrope.files.limits import DEPTH, XML_PARTS, XML_TAG, check_count, check_file
from heliotrope.files.text import read_bytes

_LONG_TAG = re.compile(rb"<[^<]{%d}" % XML_TAG)


@dataclass(frozen=True, slots=True)
class XmlElement:
    """An element of an XML document.

    Attributes
    ----------
    tag
        Name of the element.
    attributes
        Names and values, in the order of the file.
    children
        Child elements, in order; comments and text are not kept.
    line
        Line in the file; ignored in comparisons.
    """

    tag: str
    attributes: tuple[tuple[str, str], ...] = ()
    children: tuple["XmlElement", ...] = ()
    line: int = field(default=0, compare=False)

    def get(self, name: str) -> str | None:
        """Return the value of an attribute; None if the attribute does not exist."""
        return dict(self.attributes).get(name)

    def elements(self, *tags: str) -> Iterator["XmlElement"]:
        """Yield the child elements; if ``tags`` are passed, only those with one of these tags."""
        return (child for child in self.children if not tags or child.tag in tags)


@dataclass(frozen=True)
class Document:
    """An XML document.

    Attributes
    ----------
    root
        The outermost element.
    path
        File from which the document was read; ignored in comparisons.
    """

    root: XmlElement
    path: str = field(default="", compare=False)


def read_xml(path: str | Path, what: str) -> Document:
    """Read an XML file.

    Parameters
    ----------
    path
        The file.
    what
        Expected kind of file, as named in errors.

    Raises
    ------
    FormatError
        If the file cannot be read, is not well-formed XML, has a document type (which could define
        entities; none are needed) or exceeds the limits of `heliotrope.files.limits`.
    """
    file = check_file(path, what)
    content = read_bytes(file)
    tags = content.count(b"<")
    check_count(file, tags, 2 * XML_PARTS, "tags", f"divide it; expected {what}")
    # All attributes of a tag are in memory before they can be counted.
    if (tag := _LONG_TAG.search(content)) is not None:
        line = content.count(b"\n", 0, tag.start()) + 1
        raise FormatError(
            file,
            f"a tag or a text exceeds the limit of {XML_TAG // 1024:,} KiB; expected {what}",
            f"line {line}",
        )
    builder = _Builder(file)
    try:
        builder.parser.Parse(content, True)
    except expat.ExpatError as error:
        problem = f"not well-formed XML ({expat.ErrorString(error.code)}); expected {what}"
        other = instead(content[:4096], what, "XML")
        raise FormatError(file, other or problem, "" if other else f"line {error.lineno}") from None
    return Document(builder.root, str(file))


class _Builder:
    """Builder of a document tree, which checks the limits during parsing."""

    def __init__(self, file: Path) -> None:
        self.root = XmlElement("")
        self.parser = expat.ParserCreate(namespace_separator="}")
        self.parser.ordered_attributes = True
        # No entity is expanded and nothing is fetched, because a file may come from anywhere.
        self.parser.StartDoctypeDeclHandler = self._refuse_type
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self._file, self._parts = file, 0
        self._open: list[tuple[str, tuple[tuple[str, str], ...], list[XmlElement], int]] = []

    def _refuse_type(self, *_about: object) -> None:
        raise FormatError(
            self._file,
            "the file has a document type (<!DOCTYPE), which could define entities; remove the "
            "document type",
            f"line {self.parser.CurrentLineNumber}",
        )

    def _start(self, tag: str, attributes: list[str]) -> None:
        line = self.parser.CurrentLineNumber
        self._parts += 1 + len(attributes) // 2
        name, limit = "elements and attributes", XML_PARTS
        check_count(self._file, self._parts, limit, name, "divide the file", f"line {line}")
        if len(self._open) >= DEPTH:
            raise FormatError(
                self._file,
                f"nested too deeply: more than {DEPTH} levels; flatten the structure",
                f"line {line}",
            )
        pairs = zip(map(_qualified, attributes[::2]), attributes[1::2], strict=True)
        self._open.append((_qualified(tag), tuple(pairs), [], line))

    def _end(self, _tag: str) -> None:
        tag, attributes, children, line = self._open.pop()
        element = XmlElement(tag, attributes, tuple(children), line)
        if self._open:
            self._open[-1][2].append(element)
        else:
            self.root = element


def _qualified(name: str) -> str:
    return "{" + name if "}" in name else name
