"""Make the table of pins and the figure of docs/how-to/firmware.md from the boards' settings."""

import runpy
from html import escape
from pathlib import Path
from typing import Any

from scripts.pages import between

ROOT = Path(__file__).parents[1]
PAGE = "docs/how-to/firmware.md"
PICTURE = "docs/images/wiring.svg"
BOARDS = ("rp2", "esp32", "stm32")
#: Row of the table: key in PINS, place in it (-1: its only pin), signal, destination.
ROWS = (
    ("bus", 0, "UART out", "transceiver DI"), ("bus", 1, "UART in", "transceiver RO"),
    ("drive", -1, "bus driver", "transceiver DE and /RE"),
    ("flash", 0, "flash clock", "chip CLK"), ("flash", 1, "flash in", "chip DI"),
    ("flash", 2, "flash out", "chip DO"), ("flash", 3, "flash select", "chip /CS"),
    ("steps", 0, "step, primary axis", "driver 1 STEP"),
    ("steps", 1, "direction, primary axis", "driver 1 DIR"),
    ("steps", 2, "step, secondary axis", "driver 2 STEP"),
    ("steps", 3, "direction, secondary axis", "driver 2 DIR"),
    ("supply_good", -1, "supply good", "comparator, high while the supply is good"),
    ("supply", -1, "supply, measured", "divider 100 kΩ : 10 kΩ from 24 V"),
    ("limits", 0, "limit switch, primary axis", "switch to ground, opens when hit"),
    ("limits", 1, "limit switch, secondary axis", "switch to ground, opens when hit"),
    ("switches", 0, "address 1", "switch to ground"),
    ("switches", 1, "address 2", "switch to ground"),
    ("switches", 2, "address 4", "switch to ground"),
    ("switches", 3, "address 8", "switch to ground"),
    ("switches", 4, "address 16", "switch to ground"),
)  # fmt: skip
#: Parts of the figure: title, keys of PINS, place (left or right), lines below the title.
PARTS = (
    ("RS485 transceiver", ("bus", "drive"), "left", "bus A, B · 120 Ω at the ends"),
    ("Supply 24 V", ("supply", "supply_good"), "left", "5 V converter, 4700 µF behind a diode"),
    ("Address switches", ("switches",), "left", "to ground; weights 1 to 16"),
    ("Flash chip, 3.3 V", ("flash",), "right", "W25Q16 or larger: the journal"),
    ("Step drivers 1 and 2", ("steps",), "right", "STEP, DIR; motors with their own supply"),
    ("Limit switches", ("limits",), "right", "to ground; open when hit"),
)


def pins(board: str) -> dict[str, Any]:
    """Return the pins in a board's settings as shipped."""
    return dict(runpy.run_path(str(ROOT / "firmware" / board / "settings.py"))["PINS"])


def _label(board: str, pin: object) -> str:
    return {"rp2": "GP", "esp32": "IO", "stm32": "P"}[board] + str(pin)


def table() -> str:
    """Return the table of pins in Markdown."""
    known = {board: pins(board) for board in BOARDS}
    lines = ["| signal | to | rp2 | esp32 | stm32 |", "|---|---|---|---|---|"]
    for key, place, what, to in ROWS:
        cells = [
            _label(board, known[board][key] if place < 0 else known[board][key][place])
            for board in BOARDS
        ]
        lines.append(f"| {what} | {to} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def picture() -> str:
    """Return the figure: the board in the middle, its parts left and right, pins of the rp2."""
    known = pins("rp2")
    out = [
        (
            '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 900 430" role="img" '
            'font-family="sans-serif" font-size="13">'
        ),
        "<title>Parts of a local controller and the pins of an rp2 board that lead to them</title>",
        '<rect width="900" height="430" fill="#ffffff"/>',
        '<rect x="370" y="20" width="160" height="390" rx="8" fill="#eef3fb" stroke="#1a5fb4"/>',
        '<text x="450" y="215" text-anchor="middle" font-weight="bold">rp2 board</text>',
        '<text x="450" y="235" text-anchor="middle">MicroPython</text>',
    ]
    seen = {"left": 0, "right": 0}
    for title, keys, side, below in PARTS:
        top = 35 + 130 * seen[side]
        seen[side] += 1
        x = 20 if side == "left" else 660
        out += [
            (
                f'<rect x="{x}" y="{top}" width="220" height="100" rx="8" fill="#fbf7ec" '
                'stroke="#8a6d1b"/>'
            ),
            (
                f'<text x="{x + 110}" y="{top + 24}" text-anchor="middle" font-weight="bold">'
                f"{escape(title)}</text>"
            ),
            (
                f'<text x="{x + 110}" y="{top + 44}" text-anchor="middle" font-size="11">'
                f"{escape(below)}</text>"
            ),
        ]
        lines = [
            (what, _label("rp2", known[key] if place < 0 else known[key][place]))
            for key, place, what, _ in ROWS
            if key in keys
        ]
        for i, (what, pin) in enumerate(lines):
            y = top + 12 + i * min(22, 88 / len(lines))
            ends = (240, 370) if side == "left" else (530, 660)
            mark = 364 if side == "left" else 536
            anchor = "end" if side == "left" else "start"
            out += [
                f'<line x1="{ends[0]}" y1="{y:g}" x2="{ends[1]}" y2="{y:g}" stroke="#555"/>',
                (
                    f'<text x="{mark}" y="{y - 3:g}" text-anchor="{anchor}" font-size="10">'
                    f"{escape(what.split(',')[0])} {pin}</text>"
                ),
            ]
    return "\n".join([*out, "</svg>"]) + "\n"


def pages() -> dict[str, str]:
    """Return the page with its table of pins replaced, and the figure, by path."""
    marks = "<!-- pins -->", "<!-- end of pins -->"
    return {PAGE: between(PAGE, *marks, f"\n{table()}\n\n"), PICTURE: picture()}
