"""Write the page and the table that compare orientations with a reference."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.airborne.evaluate.reference import SURFACES, Compared, offsets, reference_rows
from heliotrope.airborne.evaluate.reference_figures import sampling_figure
from heliotrope.airborne.evaluate.tables import write_table
from heliotrope.files.html import STYLE, picture, render
from heliotrope.files.text import write_text

#: Maximum number of heliostats with a picture.
MOST_PICTURES = 60

Table = dict[str, Sequence[Any]]


def write_reference(compared: Sequence[Compared], folder: Path, *, page: bool = True) -> None:
    """Write ``reference.csv`` and, if ``page`` is true, ``reference.html`` with its pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    write_table(folder / "reference.csv", reference_rows(compared))
    if not page:
        return
    text = render(
        "heliotrope.airborne.evaluate",
        "reference.html.j2",
        style=STYLE,
        offsets=offset_table(compared),
        azimuth=_angles(compared, "azimuth"),
        elevation=_angles(compared, "elevation"),
        sections=[
            {
                "label": pair.label,
                "picture": picture(sampling_figure(pair), f"Sampling and slopes of {pair.label}"),
            }
            for pair in compared[:MOST_PICTURES]
        ],
    )
    write_text(folder / "reference.html", text)


def offset_table(compared: Sequence[Compared]) -> Table:
    """Return the header and rows of table 3, mrad, with the mean, spread and RMS at the end."""
    head = ["heliostat", *(f"{s}, {a}" for s in SURFACES for a in ("rotX", "rotY"))]
    rows = [
        [row["heliostat"], *(_cell(row[f"rot_{a}_{s}_mrad"]) for s in SURFACES for a in "xy")]
        for row in reference_rows(compared)
    ]
    every = [offsets(compared, surface) for surface in SURFACES]
    for name in ("mean", "spread", "rms"):
        cells = []
        for summary in every:
            values = [float("nan")] * 2 if summary is None else getattr(summary, name).tolist()
            cells += [_cell(1e3 * v, "+" if name == "mean" else "") for v in values]
        rows.append([name, *cells])
    return {"head": head, "rows": rows}


def _angles(compared: Sequence[Compared], which: str) -> Table:
    """Return the header and rows of table 4 (azimuth) or table 5 (elevation)."""
    head = ["heliostat", "reference, °"]
    head += [f"{s}, {what}" for s in SURFACES for what in ("°", "deviation, mrad")]
    rows = []
    for row in reference_rows(compared):
        cells = [row["heliostat"], f"{row[f'{which}_reference_deg']:.4f}"]
        for surface in SURFACES:
            cells.append(_cell(row[f"{which}_{surface}_deg"], "", 4))
            cells.append(_cell(row[f"{which}_{surface}_off_mrad"]))
        rows.append(cells)
    return {"head": head, "rows": rows}


def _cell(value: float, sign: str = "+", digits: int = 2) -> str:
    return f"{value:{sign}.{digits}f}" if np.isfinite(value) else "–"
