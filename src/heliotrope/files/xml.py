"""An XML document as a tree of frozen elements whose attributes are kept as text."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from heliotrope.errors import FormatError
from heliotrope.files.text import check_file


@dataclass(frozen=True)
class XmlElement:
    """An element of an XML document.

    Attributes
    ----------
    tag
        Name of the element.
    attributes
        Names and values as they stand in the file, in order.
    children
        Child elements, in order; comments and text are not kept.
    line
        Line of the file; ignored in comparisons.
    """

    tag: str
    attributes: tuple[tuple[str, str], ...] = ()
    children: tuple["XmlElement", ...] = ()
    line: int = field(default=0, compare=False)

    def get(self, name: str) -> str | None:
        """Return the value of an attribute, or None if there is none of that name."""
        return dict(self.attributes).get(name)

    def elements(self, *tags: str) -> Iterator["XmlElement"]:
        """Yield the child elements, only those with one of ``tags`` if any are given."""
        return (child for child in self.children if not tags or child.tag in tags)


@dataclass(frozen=True)
class Document:
    """An XML document.

    Attributes
    ----------
    root
        The outermost element.
    path
        File it was read from; ignored in comparisons.
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
        Kind of file expected, as an error names it.

    Raises
    ------
    FormatError
        If the file cannot be read, is not well-formed XML or has a document type
        (which could define entities; none are needed).
    """
    from lxml import etree

    file = check_file(path, what)
    # Nothing is expanded, fetched or allowed to grow: a file may come from anywhere.
    parser = etree.XMLParser(
        resolve_entities=False, load_dtd=False, no_network=True, huge_tree=False
    )
    try:
        tree: Any = etree.parse(str(file), parser)
    except etree.XMLSyntaxError as error:
        raise FormatError(
            file, f"not well-formed XML ({error.msg}); it should be {what}", f"line {error.lineno}"
        ) from None
    if tree.docinfo.doctype:
        raise FormatError(
            file, "it has a document type (<!DOCTYPE), which could define entities; remove it"
        )
    return Document(_element(tree.getroot()), str(file))


def _element(node: Any) -> XmlElement:
    attributes = tuple((str(name), str(value)) for name, value in node.attrib.items())
    # Comments and processing instructions have no text as tag.
    children = tuple(_element(child) for child in node if isinstance(child.tag, str))
    return XmlElement(node.tag, attributes, children, node.sourceline or 0)
