"""Common base of array records: comparison by content, and display as a line or a table.

Each class provides a `Card`, with one line for ``repr``, and a table with units and a small plot
for a notebook. Both are short, whatever the size of the arrays.
"""

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from typing import Any

import numpy as np
import numpy.typing as npt

#: Maximum number of rows in a notebook table, and of dots in a picture.
MOST_ROWS, MOST_DOTS = 24, 300
#: Longest line, in characters.
_LONGEST = 200
#: Width and height of a picture, and its margin, pixels.
_SIZE, _MARGIN = 160.0, 8.0


@dataclass(frozen=True)
class Card:
    """How a value is displayed.

    Attributes
    ----------
    line
        One line, without the name of the class.
    header, rows
        Table with units; empty for no table.
    picture
        SVG as drawn by `dots`; "" for no picture.
    """

    line: str
    header: tuple[str, ...] = ()
    rows: Iterable[tuple[str, ...]] = ()
    picture: str = ""


class Value:
    """Base of frozen dataclasses of arrays (``eq=False, repr=False``).

    ``==`` compares their content: arrays are equal if their shapes and numbers are equal; NaN
    equals NaN. Values have no hash.
    """

    @abstractmethod
    def _card(self) -> Card:
        """Return the value's representation."""

    def __repr__(self) -> str:
        line = " ".join(self._card().line.split())
        if len(line) > _LONGEST:
            line = line[: _LONGEST - 1] + "…"
        return f"<{type(self).__name__}: {line}>"

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        card = self._card()
        title = f"<b>{type(self).__name__}</b> {escape(' '.join(card.line.split()))}"
        return f"<div><p>{title}</p>{_table(card)}{card.picture}</div>"

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return _same_fields(self, other)

    __hash__ = None  # type: ignore[assignment]


def _table(card: Card) -> str:
    rows = list(card.rows)
    if not rows:
        return ""
    left = len(rows) - MOST_ROWS
    shown = rows[:MOST_ROWS] + ([(f"… and {left} more",)] if left > 0 else [])
    head = "".join(f"<th>{escape(cell)}</th>" for cell in card.header)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in shown
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def card_of_arrays(value: Any) -> Card:
    """Return the card of a value that consists of named arrays, with their shapes and ranges."""
    arrays = {
        f.name: getattr(value, f.name)
        for f in fields(value)
        if isinstance(getattr(value, f.name), np.ndarray)
    }
    line = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
    rows = [(name, str(array.shape), span(array)) for name, array in arrays.items()]
    return Card(line, ("array", "shape", "from … to"), rows)


def span(values: npt.ArrayLike, scale: float = 1.0, unit: str = "") -> str:
    """Return the range of finite numbers as text: "3.2 … 8.1 mrad"."""
    numbers = np.asarray(values)
    if numbers.dtype.kind not in "biuf":
        return ""
    known = scale * numbers[np.isfinite(numbers)]
    if not known.size:
        return "none"
    low, high = f"{known.min():.4g}", f"{known.max():.4g}"
    return f"{low if low == high else f'{low} … {high}'} {unit}".strip()


def amount(count: int, noun: str) -> str:
    """Return a count with its noun in the singular or plural: "1 target", "3 targets"."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def dots(x: npt.ArrayLike, y: npt.ArrayLike, title: str) -> str:
    """Return a small SVG of points, x to the right and y upwards, to the same scale.

    At most `MOST_DOTS` evenly spaced points are drawn.
    """
    points = np.stack([np.ravel(x), np.ravel(y)], axis=-1).astype(np.float64)
    points = points[np.isfinite(points).all(axis=-1)]
    if not len(points):
        return ""
    chosen = np.unique(np.linspace(0, len(points) - 1, min(len(points), MOST_DOTS)).round())
    points = points[chosen.astype(np.intp)]
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (_SIZE - 2.0 * _MARGIN) / max(float((high - low).max()), 1e-9)
    place = 0.5 * _SIZE + scale * (points - 0.5 * (low + high)) * np.array([1.0, -1.0])
    # A line of length 0 with round ends appears as a dot.
    path = "".join(f"M{a:.0f} {b:.0f}h0" for a, b in place)
    return (
        f'<svg width="{_SIZE:.0f}" height="{_SIZE:.0f}" role="img">'
        f"<title>{escape(title)}</title>"
        f'<path d="{path}" stroke="currentColor" stroke-width="4" stroke-linecap="round"/></svg>'
    )


def _same_fields(a: Any, b: Any) -> bool:
    return all(_alike(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def _alike(a: Any, b: Any) -> bool:
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        one, two = np.asarray(a), np.asarray(b)
        return np.array_equal(one, two, equal_nan=one.dtype.kind == two.dtype.kind == "f")
    if isinstance(a, Mapping) and isinstance(b, Mapping):
        return a.keys() == b.keys() and all(_alike(a[key], b[key]) for key in a)
    if isinstance(a, tuple | list) and isinstance(b, tuple | list):
        return len(a) == len(b) and all(map(_alike, a, b))
    if is_dataclass(a) and type(a) is type(b):
        return _same_fields(a, b)
    return bool(a == b)
