"""An XML document as a tree of frozen values, kept word for word.

Attributes are kept as the text that stands in the file, so nothing is rounded and
nothing unknown is lost. Comments, processing instructions and text between elements
are kept too; indentation is not.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from heliotrope.errors import FormatError, InputError
from heliotrope.files.text import check_file, write_file


@dataclass(frozen=True)
class Remark:
    """A comment, or a processing instruction if it has a target.

    Attributes
    ----------
    text
        What it says.
    target
        Of a processing instruction; "" for a comment.
    """

    text: str
    target: str = ""


@dataclass(frozen=True)
class Element:
    """An element of an XML document.

    Attributes
    ----------
    tag
        Its name.
    attributes
        Names and values as they stand in the file, in order.
    children
        Elements, remarks and text that is not blank, in order.
    line
        Line of the file; it takes no part in comparisons.
    """

    tag: str
    attributes: tuple[tuple[str, str], ...] = ()
    children: tuple["Element | Remark | str", ...] = ()
    line: int = field(default=0, compare=False)

    def get(self, name: str) -> str | None:
        """Return the value of an attribute, or None if there is none of that name."""
        return dict(self.attributes).get(name)

    def elements(self, *tags: str) -> Iterator["Element"]:
        """Give the child elements, only those with one of ``tags`` if any are given."""
        for child in self.children:
            if isinstance(child, Element) and (not tags or child.tag in tags):
                yield child


@dataclass(frozen=True)
class Document:
    """An XML document.

    Attributes
    ----------
    root
        The outermost element.
    before, after
        Remarks in front of and behind it.
    path
        The file that it was read from; it takes no part in comparisons.
    """

    root: Element
    before: tuple[Remark, ...] = ()
    after: tuple[Remark, ...] = ()
    path: str = field(default="", compare=False)


def read_document(path: str | Path, what: str) -> Document:
    """Read an XML file.

    Parameters
    ----------
    path
        The file.
    what
        What it should be, as an error calls it.

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
    root = tree.getroot()
    before = [_remark(node) for node in root.itersiblings(preceding=True)]
    after = [_remark(node) for node in root.itersiblings()]
    return Document(_element(root), tuple(reversed(before)), tuple(after), str(file))


def _remark(node: Any) -> Remark:
    return Remark(node.text or "", getattr(node, "target", ""))


def _element(node: Any) -> Element:
    children: list[Element | Remark | str] = [node.text] if _says(node.text) else []
    for child in node:
        children.append(_element(child) if isinstance(child.tag, str) else _remark(child))
        if _says(child.tail):
            children.append(child.tail)
    attributes = tuple((str(name), str(value)) for name, value in node.attrib.items())
    return Element(node.tag, attributes, tuple(children), node.sourceline or 0)


def _says(text: str | None) -> bool:
    return bool(text and text.strip())


def write_document(document: Document, path: str | Path) -> None:
    """Write an XML file: whole or not at all.

    Raises
    ------
    InputError
        If a name or a value holds a character that XML cannot, or the file cannot be
        written.
    """
    from lxml import etree

    try:
        root = _node(document.root)
        for remark in document.before:
            root.addprevious(_remark_node(remark))
        for remark in reversed(document.after):
            root.addnext(_remark_node(remark))
    except ValueError as error:
        raise InputError(f"{path}: {error}; remove the character") from None
    etree.indent(root, space="  ")
    tree = root.getroottree()
    write_file(
        path,
        lambda stream: tree.write(
            stream, xml_declaration=True, encoding="UTF-8", pretty_print=True
        ),
    )


def _node(element: Element) -> Any:
    from lxml import etree

    node = etree.Element(element.tag, dict(element.attributes))
    for child in element.children:
        if isinstance(child, str):
            if len(node):
                node[-1].tail = (node[-1].tail or "") + child
            else:
                node.text = (node.text or "") + child
        else:
            node.append(_node(child) if isinstance(child, Element) else _remark_node(child))
    return node


def _remark_node(remark: Remark) -> Any:
    from lxml import etree

    if remark.target:
        return etree.ProcessingInstruction(remark.target, remark.text)
    return etree.Comment(remark.text)
