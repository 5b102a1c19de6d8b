"""Small drawings as text (SVG): a report of a flight holds hundreds, and each takes a millisecond.

Matplotlib needs four tenths of a second for one such picture, most of it for text; here the
browser sets the text, and every point can say what it is.
"""

import html
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from heliotrope.geometry import FloatArray, as_float

# Room around a panel's frame for labels, px.
_TICK = 4.0


@dataclass
class Panel:
    """Axes of a drawing: a frame with ticks, and what is drawn inside it.

    Attributes
    ----------
    left, top, width, height
        Of the frame, px.
    x, y
        Lowest and highest value shown across and up.
    title, across, up
        Texts above, below, and at the left.
    labels
        Texts of ticks across, at 0, 1, …; numbers if empty.
    """

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]
    title: str = ""
    across: str = ""
    up: str = ""
    labels: tuple[str, ...] = ()
    parts: list[str] = field(default_factory=list)

    def equal(self) -> "Panel":
        """Widen one range so that a metre is as long across as up; returns the panel."""
        scale = min(self.width / (self.x[1] - self.x[0]), self.height / (self.y[1] - self.y[0]))
        for name, size in (("x", self.width), ("y", self.height)):
            low, high = getattr(self, name)
            middle = 0.5 * (low + high)
            setattr(self, name, (middle - 0.5 * size / scale, middle + 0.5 * size / scale))
        return self

    def place(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Return values as px from the frame's upper left corner, (..., 2)."""
        across = (as_float(x) - self.x[0]) / (self.x[1] - self.x[0]) * self.width
        down = (self.y[1] - as_float(y)) / (self.y[1] - self.y[0]) * self.height
        return np.stack(np.broadcast_arrays(across, down), axis=-1)

    def line(
        self,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        colour: str,
        *,
        closed: bool = False,
        width: float = 1.2,
    ) -> None:
        """Draw a line through points (n,)."""
        way = " ".join(f"{a:.1f},{b:.1f}" for a, b in self.place(x, y))
        kind = "polygon" if closed else "polyline"
        self.parts.append(
            f'<{kind} points="{way}" fill="none" stroke="{colour}" stroke-width="{width:g}"/>'
        )

    def dots(
        self,
        x: npt.ArrayLike,
        y: npt.ArrayLike,
        colour: str,
        tips: Sequence[str] = (),
        *,
        size: float = 2.2,
        hollow: bool = False,
    ) -> None:
        """Draw points (n,), each with the text that it shows under the pointer."""
        fill = "white" if hollow else colour
        for k, (a, b) in enumerate(self.place(x, y)):
            tip = f"<title>{html.escape(tips[k])}</title>" if tips else ""
            self.parts.append(
                f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{size:g}" fill="{fill}" '
                f'stroke="{colour}">{tip}</circle>'
            )

    def crosses(
        self, x: npt.ArrayLike, y: npt.ArrayLike, colour: str, tips: Sequence[str] = ()
    ) -> None:
        """Draw crosses (n,)."""
        for k, (a, b) in enumerate(self.place(x, y)):
            tip = f"<title>{html.escape(tips[k])}</title>" if tips else ""
            self.parts.append(
                f'<path d="M{a - 4:.1f} {b - 4:.1f}l8 8m-8 0l8 -8" stroke="{colour}" '
                f'stroke-width="1.6" fill="none">{tip}</path>'
            )

    def arrows(self, x: npt.ArrayLike, y: npt.ArrayLike, step: npt.ArrayLike, colour: str) -> None:
        """Draw arrows from points (n,) by steps (n, 2) of px to the right and up."""
        start = self.place(x, y).reshape(-1, 2)
        for (a, b), (dx, up) in zip(start, as_float(step).reshape(-1, 2), strict=True):
            length = float(np.hypot(dx, up))
            if length < 0.5:
                continue
            # The head: a fifth of the length, but one that can be seen.
            head = min(max(0.25 * length, 3.0), 6.0) / length
            left = (-head * (dx + 0.5 * up), head * (up - 0.5 * dx))
            right = (-head * (dx - 0.5 * up), head * (up + 0.5 * dx))
            self.parts.append(
                f'<path d="M{a:.1f} {b:.1f}l{dx:.1f} {-up:.1f}l{left[0]:.1f} {left[1]:.1f}'
                f'm{-left[0]:.1f} {-left[1]:.1f}l{right[0]:.1f} {right[1]:.1f}" fill="none" '
                f'stroke="{colour}"/>'
            )

    def bars(self, edges: npt.ArrayLike, heights: npt.ArrayLike, colour: str) -> None:
        """Draw a histogram: n + 1 edges and n heights."""
        low = self.place(as_float(edges), 0.0)
        for k, top in enumerate(self.place(as_float(edges)[:-1], heights)):
            wide, tall = low[k + 1, 0] - top[0], low[k, 1] - top[1]
            self.parts.append(
                f'<rect x="{top[0]:.1f}" y="{top[1]:.1f}" width="{wide:.1f}" '
                f'height="{tall:.1f}" fill="{colour}"/>'
            )

    def text(self, x: float, y: float, text: str, colour: str = "#666") -> None:
        """Write beside a point."""
        a, b = self.place(x, y)
        self.parts.append(
            f'<text x="{a + 4:.1f}" y="{b - 4:.1f}" fill="{colour}">{html.escape(text)}</text>'
        )

    def drawn(self) -> str:
        """Return the panel."""
        frame = (
            f'<rect x="{self.left:g}" y="{self.top:g}" width="{self.width:g}" '
            f'height="{self.height:g}" fill="none" stroke="#888"/>'
        )
        inside = (
            f'<svg x="{self.left:g}" y="{self.top:g}" width="{self.width:g}" '
            f'height="{self.height:g}" overflow="hidden">{"".join(self.parts)}</svg>'
        )
        return inside + frame + "".join((*self._ticks(), *self._texts()))

    def _ticks(self) -> list[str]:
        low = self.top + self.height
        across = [(float(k), text) for k, text in enumerate(self.labels)] or numbered(*self.x, 6)
        drawn = []
        for value, text in across:
            a = self.left + float(self.place(value, self.y[0])[0])
            drawn.append(_tick(a, low, 0.0, _TICK))
            drawn.append(_text(a, low + 16.0, text, "middle"))
        for value, text in numbered(*self.y, 5):
            b = self.top + float(self.place(self.x[0], value)[1])
            drawn.append(_tick(self.left, b, -_TICK, 0.0))
            drawn.append(_text(self.left - 7.0, b + 4.0, text, "end"))
        return drawn

    def _texts(self) -> list[str]:
        a, b = self.left - 34.0, self.top + 0.5 * self.height
        title = _text(self.left, self.top - 8.0, self.title, "start")
        across = _text(
            self.left + 0.5 * self.width, self.top + self.height + 32.0, self.across, "middle"
        )
        up = (
            f'<text x="{a:g}" y="{b:g}" text-anchor="middle" '
            f'transform="rotate(-90 {a:g} {b:g})">{html.escape(self.up)}</text>'
        )
        return [title, across, up if self.up else ""]


def drawing(panels: Sequence[Panel], width: float, height: float, title: str) -> str:
    """Return panels as one drawing that can stand in a page or in a file of its own."""
    told = html.escape(title)
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        f'viewBox="0 0 {width:g} {height:g}" role="img" '
        f'aria-label="{told}" font-family="system-ui, sans-serif" font-size="12">'
        f'<rect width="{width:g}" height="{height:g}" fill="white"/>'
        f'<text x="{0.5 * width:g}" y="18" text-anchor="middle" font-size="14">{told}</text>'
        f"{''.join(p.drawn() for p in panels)}</svg>"
    )


def around(values: npt.ArrayLike, share: float = 0.08) -> tuple[float, float]:
    """Return the range of the finite values (...), widened by a share of it at both ends."""
    given = as_float(values)
    given = given[np.isfinite(given)]
    if not len(given):
        return -1.0, 1.0
    low, high = float(given.min()), float(given.max())
    room = share * (high - low) or max(0.1 * abs(high), 1e-3)
    return low - room, high + room


def round_below(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above ``value`` > 0."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= 1.000001 * value))


def numbered(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Return round values between two with their texts, ``most`` at the most."""
    step = round_below((high - low) / most)
    while (high - low) / step > most:
        step = round_below(2.5000001 * step)
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    first = int(np.ceil(low / step - 1e-9))
    last = int(np.floor(high / step + 1e-9))
    return [(k * step, f"{k * step:.{digits}f}".replace("-", "−")) for k in range(first, last + 1)]


def _tick(x: float, y: float, dx: float, dy: float) -> str:
    return f'<path d="M{x:.1f} {y:.1f}l{dx:g} {dy:g}" stroke="#888"/>'


def _text(x: float, y: float, text: str, anchor: str) -> str:
    if not text:
        return ""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(text)}</text>'
