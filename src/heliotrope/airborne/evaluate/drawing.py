"""Small SVG drawings, each produced in a few milliseconds; a flight report contains hundreds.

Matplotlib needs 0.4 s for one such picture, most of it for text. Here the browser renders the text,
and every point can have a tooltip.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from heliotrope.files.html import render
from heliotrope.geometry import FloatArray, as_float

# Length of a tick, px.
_TICK = 4.0


@dataclass(frozen=True)
class SvgElement:
    """One element of a drawing: its SVG tag, attributes, tooltip and text."""

    tag: str
    attributes: Mapping[str, object]
    tip: str = ""
    text: str = ""


@dataclass
class Panel:
    """Axes of a drawing: a frame with ticks, and the drawing inside it.

    Attributes
    ----------
    left, top, width, height
        Position and size of the frame, px.
    x, y
        Lowest and highest value shown.
    title, across, up
        Texts above, below, and to the left of the frame.
    labels
        Texts of the ticks on the lower side, at 0, 1, …; numbers are used if empty.
    parts
        The elements inside the frame.
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
    parts: list[SvgElement] = field(default_factory=list)

    def equal(self) -> "Panel":
        """Widen one range so that both axes have the same scale, and return the panel."""
        scale = min(self.width / (self.x[1] - self.x[0]), self.height / (self.y[1] - self.y[0]))
        for name, size in (("x", self.width), ("y", self.height)):
            low, high = getattr(self, name)
            middle = 0.5 * (low + high)
            setattr(self, name, (middle - 0.5 * size / scale, middle + 0.5 * size / scale))
        return self

    def place(self, x: npt.ArrayLike, y: npt.ArrayLike) -> FloatArray:
        """Convert values to pixels from the frame's upper left corner, (..., 2)."""
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
        points = " ".join(f"{a:.1f},{b:.1f}" for a, b in self.place(x, y))
        drawn = {"points": points, "fill": "none", "stroke": colour, "stroke-width": width}
        self.parts.append(SvgElement("polygon" if closed else "polyline", drawn))

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
        """Draw points (n,), each with its tooltip."""
        fill = "white" if hollow else colour
        for k, (a, b) in enumerate(self.place(x, y)):
            drawn = {"cx": f"{a:.1f}", "cy": f"{b:.1f}", "r": size, "fill": fill, "stroke": colour}
            self.parts.append(SvgElement("circle", drawn, tips[k] if tips else ""))

    def crosses(
        self, x: npt.ArrayLike, y: npt.ArrayLike, colour: str, tips: Sequence[str] = ()
    ) -> None:
        """Draw crosses (n,), each with its tooltip."""
        for k, (a, b) in enumerate(self.place(x, y)):
            path = f"M{a - 4:.1f} {b - 4:.1f}l8 8m-8 0l8 -8"
            drawn = {"d": path, "stroke": colour, "stroke-width": 1.6, "fill": "none"}
            self.parts.append(SvgElement("path", drawn, tips[k] if tips else ""))

    def arrows(self, x: npt.ArrayLike, y: npt.ArrayLike, step: npt.ArrayLike, colour: str) -> None:
        """Draw arrows from points (n,) by steps (n, 2), px to the right and up."""
        start = self.place(x, y).reshape(-1, 2)
        for (a, b), (dx, up) in zip(start, as_float(step).reshape(-1, 2), strict=True):
            length = float(np.hypot(dx, up))
            if length < 0.5:
                continue
            # The head is a quarter of the length, but large enough to be seen.
            head = min(max(0.25 * length, 3.0), 6.0) / length
            left = (-head * (dx + 0.5 * up), head * (up - 0.5 * dx))
            right = (-head * (dx - 0.5 * up), head * (up + 0.5 * dx))
            path = (
                f"M{a:.1f} {b:.1f}l{dx:.1f} {-up:.1f}l{left[0]:.1f} {left[1]:.1f}"
                f"m{-left[0]:.1f} {-left[1]:.1f}l{right[0]:.1f} {right[1]:.1f}"
            )
            self.parts.append(SvgElement("path", {"d": path, "fill": "none", "stroke": colour}))

    def bars(self, edges: npt.ArrayLike, heights: npt.ArrayLike, colour: str) -> None:
        """Draw a histogram of n + 1 edges and n heights."""
        low = self.place(as_float(edges), 0.0)
        for k, top in enumerate(self.place(as_float(edges)[:-1], heights)):
            wide, tall = f"{low[k + 1, 0] - top[0]:.1f}", f"{low[k, 1] - top[1]:.1f}"
            corner = {"x": f"{top[0]:.1f}", "y": f"{top[1]:.1f}"}
            drawn = {**corner, "width": wide, "height": tall, "fill": colour}
            self.parts.append(SvgElement("rect", drawn))

    def text(self, x: float, y: float, text: str, colour: str = "#666") -> None:
        """Write text beside a point."""
        a, b = self.place(x, y)
        place = {"x": f"{a + 4:.1f}", "y": f"{b - 4:.1f}", "fill": colour}
        self.parts.append(SvgElement("text", place, text=text))

    def frame(self) -> list[SvgElement]:
        """Return the frame with its ticks and texts."""
        size = {"x": self.left, "y": self.top, "width": self.width, "height": self.height}
        elements = [SvgElement("rect", {**size, "fill": "none", "stroke": "#888"})]
        low = self.top + self.height
        across = [(float(k), text) for k, text in enumerate(self.labels)] or numbered(*self.x, 6)
        for value, text in across:
            a = self.left + float(self.place(value, self.y[0])[0])
            elements += [_tick(a, low, 0.0, _TICK), *_text(a, low + 16.0, text, "middle")]
        for value, text in numbered(*self.y, 5):
            b = self.top + float(self.place(self.x[0], value)[1])
            elements += [
                _tick(self.left, b, -_TICK, 0.0),
                *_text(self.left - 7.0, b + 4.0, text, "end"),
            ]
        elements += _text(self.left, self.top - 8.0, self.title, "start")
        elements += _text(self.left + 0.5 * self.width, low + 32.0, self.across, "middle")
        if self.up:
            a, b = self.left - 34.0, self.top + 0.5 * self.height
            turned = {"x": a, "y": b, "text-anchor": "middle"}
            turned["transform"] = f"rotate(-90 {a:g} {b:g})"
            elements.append(SvgElement("text", turned, text=self.up))
        return elements


def drawing(panels: Sequence[Panel], width: float, height: float, title: str) -> str:
    """Return panels as one SVG drawing, to embed in a page or store as a file."""
    return render(
        "heliotrope.airborne.evaluate",
        "drawing.svg.j2",
        panels=panels,
        width=width,
        height=height,
        title=title,
    )


def around(values: npt.ArrayLike, share: float = 0.08) -> tuple[float, float]:
    """Return the range of the finite values (...), widened by a fraction at both ends."""
    finite = as_float(values)
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return -1.0, 1.0
    low, high = float(finite.min()), float(finite.max())
    room = share * (high - low) or max(0.1 * abs(high), 1e-3)
    return low - room, high + room


def round_below(value: float) -> float:
    """Return the largest round number (1, 2 or 5 times a power of ten) up to ``value`` > 0."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= 1.000001 * value))


def numbered(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Return at most ``most`` round numbers from ``low`` to ``high``, with their texts."""
    step = round_below((high - low) / most)
    while (high - low) / step > most:
        step = round_below(2.5000001 * step)
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    first = int(np.ceil(low / step - 1e-9))
    last = int(np.floor(high / step + 1e-9))
    return [(k * step, f"{k * step:.{digits}f}".replace("-", "−")) for k in range(first, last + 1)]


def _tick(x: float, y: float, dx: float, dy: float) -> SvgElement:
    return SvgElement("path", {"d": f"M{x:.1f} {y:.1f}l{dx:g} {dy:g}", "stroke": "#888"})


def _text(x: float, y: float, text: str, anchor: str) -> list[SvgElement]:
    place = {"x": f"{x:.1f}", "y": f"{y:.1f}", "text-anchor": anchor}
    return [SvgElement("text", place, text=text)] if text else []
