"""Reads numbers with units from the attributes of a HelioK document."""

import math
import re

import numpy as np

from heliotrope.errors import FormatError
from heliotrope.files import Document, XmlElement
from heliotrope.geometry import FloatArray

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3}
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0}

# Not float(), which also accepts "nan", "inf" and "1_000".
_NUMBER = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)(?:\s+(\w+))?\s*")


class Values:
    """Reads attributes of a document in SI units and radians.

    Parameters
    ----------
    document
        The document; its root must be HelioK and name the units.

    Raises
    ------
    FormatError
        If the root is another element, or a unit is missing or not known.
    """

    def __init__(self, document: Document) -> None:
        self.path = document.path or "HelioK document"
        root = document.root
        if root.tag != "HelioK":
            raise self.error(root, f"the root element is <{root.tag}>; expected <HelioK>")
        self.length = self._unit(root, "unitLength", LENGTHS)
        self.angle = self._unit(root, "unitAngle", ANGLES)

    def _unit(self, root: XmlElement, attribute: str, known: dict[str, float]) -> float:
        name = self.text(root, attribute)
        if name not in known:
            raise self.error(root, f"{attribute} {name!r} is not one of {', '.join(known)}")
        return known[name]

    def error(self, element: XmlElement, problem: str) -> FormatError:
        """Return the error that names the file and the line of the element."""
        return FormatError(self.path, problem, f"line {element.line}" if element.line else "")

    def text(self, element: XmlElement, attribute: str) -> str:
        """Return an attribute that must be present and not blank."""
        value = element.get(attribute)
        if value is None or not value.strip():
            raise self.error(element, f"<{element.tag}> has no {attribute}; add the attribute")
        return value

    def child(self, element: XmlElement, tag: str) -> XmlElement:
        """Return the only child element of a given name."""
        children = list(element.elements(tag))
        if len(children) != 1:
            raise self.error(
                element,
                f"<{element.tag}> {element.get('name') or ''} has {len(children)} elements "
                f"<{tag}>; it needs exactly one",
            )
        return children[0]

    def lengths(self, element: XmlElement, attribute: str, count: int) -> FloatArray:
        """Return ``count`` lengths in m."""
        return self._numbers(element, attribute, count, LENGTHS, self.length)

    def angles(self, element: XmlElement, attribute: str, count: int) -> FloatArray:
        """Return ``count`` angles in rad."""
        return self._numbers(element, attribute, count, ANGLES, self.angle)

    def ratios(self, element: XmlElement, attribute: str, count: int) -> FloatArray:
        """Return ``count`` dimensionless numbers."""
        return self._numbers(element, attribute, count, {}, 1.0)

    def _numbers(
        self, element: XmlElement, attribute: str, count: int, units: dict[str, float], unit: float
    ) -> FloatArray:
        parts = self.text(element, attribute).split(",")
        if len(parts) != count:
            raise self.error(
                element,
                f"<{element.tag}> {attribute} has {len(parts)} numbers; it needs {count}, "
                "separated by commas",
            )
        numbers = np.empty(count)
        for i, part in enumerate(parts):
            match = _NUMBER.fullmatch(part)
            value = math.nan if match is None else float(match[1])
            if match is None or not math.isfinite(value):
                raise self.error(
                    element,
                    f"<{element.tag}> {attribute}: {part.strip()!r} is not a finite number; write "
                    "it with digits and a decimal point",
                )
            if match[2] is not None and match[2] not in units:
                known = ", ".join(units) or "none"
                raise self.error(
                    element,
                    f"<{element.tag}> {attribute}: unknown unit {match[2]!r}; known: {known}",
                )
            numbers[i] = value * (unit if match[2] is None else units[match[2]])
        return numbers
