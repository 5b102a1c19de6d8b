"""Make the diagram and tables of docs/explanation/local-controller.md from the state table."""

import math
from html import escape

from scripts.pages import between

from heliotrope.lcu import names, states

PAGE = "docs/explanation/local-controller.md"
PICTURE = "docs/images/local-controller-states.svg"

KINDS = {names.SAFE: "anyone, always", names.COMMAND: "authority", names.INTERNAL: "itself"}
COLOURS = {names.SAFE: "#b3261e", names.COMMAND: "#1a5fb4", names.INTERNAL: "#666666"}
#: Column and row of each state in the diagram.
PLACES = {
    "UNCONFIGURED": (0.7, 0), "LOCKED": (0, 1.5), "FAULT": (0.7, 3.9), "STOWED": (1.9, 0.75),
    "STOWING": (1.9, 2.5), "APPROACHING": (3, 0), "DEFOCUSED": (3, 2.5), "IDLE": (4.6, 0.75),
    "TRACKING": (5.0, 2.5), "SEARCHING": (4.0, 3.9),
}  # fmt: skip
#: Events that lead from nearly every state to one: listed below the diagram, not drawn.
COMMON = ("LOCK", "FAULTED", "STOW")
WIDE, HIGH, BOX = 220, 120, (132, 34)


def _edges() -> dict[tuple[str, str], list[str]]:
    """Events drawn from one state to another."""
    found: dict[tuple[str, str], list[str]] = {}
    for start, event, end, _ in names.transitions():
        if start != end and event not in COMMON:
            pair = states.STATES[start], states.STATES[end]
            found.setdefault(pair, []).append(event)
    return found


def _centre(name: str) -> tuple[float, float]:
    column, row = PLACES[name]
    return 90 + WIDE * column, 40 + HIGH * row


def _border(name: str, dx: float, dy: float) -> tuple[float, float]:
    """Return the point where a line from the middle of a box in a direction leaves it."""
    x, y = _centre(name)
    scale = min(BOX[0] / 2 / abs(dx) if dx else math.inf, BOX[1] / 2 / abs(dy) if dy else math.inf)
    return x + scale * dx, y + scale * dy


def _arrow(pair: tuple[str, str], events: list[str], both: bool) -> str:
    """Return one arrow with its events; drawn beside its opposite if there are both."""
    (x, y), (u, v) = _centre(pair[0]), _centre(pair[1])
    length = math.hypot(u - x, v - y)
    side = (-(v - y) / length, (u - x) / length)
    dx, dy = u - x, v - y
    shift = 14.0 if both else 0.0
    a, b = _border(pair[0], dx, dy), _border(pair[1], -dx, -dy)
    ends = [(p + shift * side[0], q + shift * side[1]) for p, q in (a, b)]
    colour = COLOURS[names.EVENTS[events[0]][0]]
    (x1, y1), (x2, y2) = ends
    lines = [
        (
            f'<line x1="{x1:.0f}" y1="{y1:.0f}" x2="{x2:.0f}" y2="{y2:.0f}" stroke="{colour}" '
            'marker-end="url(#tip)"/>'
        ),
    ]
    along = 0.4
    middle = (x1 + along * (x2 - x1), y1 + along * (y2 - y1) - 6 * (len(events) - 1))
    for i, event in enumerate(events):
        shade = COLOURS[names.EVENTS[event][0]]
        lines.append(
            f'<text x="{middle[0]:.0f}" y="{middle[1] + 13 * i:.0f}" fill="{shade}" '
            f'class="event">{escape(event)}</text>'
        )
    return "\n".join(lines)


def picture() -> str:
    """Return the diagram as SVG."""
    edges = _edges()
    parts = [
        (
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1290 560" role="img" '
            'font-family="sans-serif">'
        ),
        "<title>States of a local controller</title>",
        (
            "<style>.event{font-size:11px;text-anchor:middle;paint-order:stroke;stroke:#fff;"
            "stroke-width:4px}.state{font-size:13px;font-weight:bold;text-anchor:middle}"
            "line{stroke-width:1.4}</style>"
        ),
        (
            '<defs><marker id="tip" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="8" '
            'markerHeight="8" orient="auto"><path d="M0 0 8 4 0 8z" fill="#444"/></marker></defs>'
        ),
        '<rect width="1290" height="560" fill="#fff"/>',
    ]
    parts += [_arrow(pair, events, (pair[1], pair[0]) in edges) for pair, events in edges.items()]
    for name in states.STATES:
        x, y = _centre(name)
        parts.append(
            f'<rect x="{x - BOX[0] / 2:.0f}" y="{y - BOX[1] / 2:.0f}" width="{BOX[0]}" '
            f'height="{BOX[1]}" rx="8" fill="#f6f3ee" stroke="#444"/>'
            f'<text x="{x:.0f}" y="{y + 5:.0f}" class="state">{name}</text>'
        )
    for i, (kind, text) in enumerate(KINDS.items()):
        parts.append(
            f'<text x="{90 + 160 * i}" y="545" fill="{COLOURS[kind]}" font-size="12">{text}</text>'
        )
    return "\n".join([*parts, "</svg>"]) + "\n"


def table() -> str:
    """Return all transitions as a table."""
    lines = ["| state | event | new state | starts |", "|---|---|---|---|"]
    for start, event, end, motion in names.transitions():
        row = states.STATES[start], event, states.STATES[end], motion
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines)


def _generated() -> str:
    """Return the text between the page's marks."""
    parts = ["![States and what leads from one to another](../images/local-controller-states.svg)"]
    common = ", ".join(COMMON)
    parts.append(
        f"Not drawn: {common}, which lead from nearly everywhere to LOCKED, FAULT and STOWING."
    )
    parts.append("### Events\n")
    rows = [f"| {name} | {KINDS[kind]} | {text} |" for name, (kind, text) in names.EVENTS.items()]
    parts.append("\n".join(["| event | from | meaning |", "|---|---|---|", *rows]))
    parts.append("### Motions\n")
    rows = [f"| {name} | {text} |" for name, text in names.MOTIONS.items()]
    parts.append("\n".join(["| motion | meaning |", "|---|---|", *rows]))
    parts.append(
        "### All transitions\n\nAny event not listed here is refused and changes nothing.\n"
    )
    parts.append(table())
    parts.append("### Bits of the flags, and faults, in STATUS\n")
    rows = [f"| {i} | {name} |" for i, name in enumerate(names.FLAGS)]
    parts.append("\n".join(["| bit | flag |", "|---|---|", *rows]))
    rows = [f"| {i} | {name} |" for i, name in enumerate(names.FAULTS)]
    parts.append("\n".join(["| number | fault |", "|---|---|", *rows]))
    return "\n\n".join(part.rstrip("\n") for part in parts)


def pages() -> dict[str, str]:
    """Return the page with its generated part replaced, and the diagram, by path."""
    marks = "<!-- states: begin -->", "<!-- states: end -->"
    return {PAGE: between(PAGE, *marks, f"{_generated()}\n"), PICTURE: picture()}
