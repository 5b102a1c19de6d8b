"""The report of flights: one self-contained page, and tables for other programs."""

import html
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate import pictures
from heliotrope.airborne.evaluate._report_tables import (
    difference_rows,
    facet_rows,
    flight_row,
    orientation_rows,
    systematic_parts,
)
from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.orientation import Orientation, Orientations
from heliotrope.airborne.evaluate.reflections import join, write_reflections
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.calibration.report import page as report
from heliotrope.calibration.report.page import STYLE, picture
from heliotrope.errors import InputError
from heliotrope.files.text import write_file, write_text
from heliotrope.geometry import FloatArray, as_float

__all__ = [
    "Flown", "difference_rows", "facet_rows", "flight_row", "orientation_rows",
    "systematic_parts", "write_campaign_report", "write_flight_report",
]  # fmt: skip

#: No more flights than this get a map.
MOST_MAPS = 6
_STYLE = """svg { max-width: 100%; height: auto } .wide { overflow-x: auto }
.wide td, .wide th { padding: .1rem .45rem; font-size: 13px; line-height: 1.3 }
"""


@dataclass(frozen=True)
class Flown:
    """One flight (one pose of the mirrors) of a report.

    Attributes
    ----------
    name
        Of the flight; "" if it is the only one.
    found
        Orientations of the N heliostats.
    shape
        Gives the mirror of a row.
    position
        Of the heliostats, ENU metres, (N, 3).
    budget
        That they were measured with; if given, the systematic part is told by its causes.
    places
        Covariances of the mirrors' places that they were measured with, m², (N, 3, 3), or None.
    """

    name: str
    found: Orientations
    shape: Callable[[int], MirrorShape]
    position: FloatArray
    budget: Budget | None = None
    places: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.position.shape != (len(self.found.names), 3):
            raise InputError(
                f"flight report: positions of shape {self.position.shape} for "
                f"{len(self.found.names)} heliostats"
            )

    def rows(self, flight: str = "") -> list[dict[str, Any]]:
        """Return one record a heliostat, with the flight's name if it is given."""
        return orientation_rows(self.found, self.budget, flight, self.places)


def write_flight_report(
    found: Orientations,
    shape: Callable[[int], MirrorShape],
    position: npt.ArrayLike,
    folder: Path,
    *,
    budget: Budget | None = None,
    places: npt.ArrayLike | None = None,
    notes: tuple[str, ...] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the page and the tables of one flight; returns the page's path.

    ``index.html`` (all pictures inside it), and ``orientations``, ``facets``, ``flights`` and
    ``differences`` as ``.csv`` and ``.parquet``, and ``reflections.parquet``.

    Parameters
    ----------
    found, shape, position, budget, places
        As of :class:`Flown`.
    folder
        Where to; it is made.
    notes
        Lines for the top of the page: bad photographs, the offset of RTK.
    progress
        Called with (done, all) after each picture.

    Raises
    ------
    InputError
        If the positions are not those of N heliostats.
    """
    known = None if places is None else as_float(places)
    flown = Flown("", found, shape, as_float(position), budget, known)
    return write_campaign_report([flown], folder, notes=notes, progress=progress)


def write_campaign_report(
    flights: Sequence[Flown],
    folder: Path,
    *,
    notes: tuple[str, ...] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the page and the tables of several flights, as :func:`write_flight_report`.

    Parameters
    ----------
    flights
        With names that differ.
    folder, notes, progress
        As there.

    Raises
    ------
    InputError
        If there is no flight, or two have the same name.
    """
    names = [f.name.replace("/", "-") for f in flights]
    if not names or len(set(names)) < len(names):
        raise InputError(f"flight report: flights {names}; give one or more with different names")
    folder.mkdir(parents=True, exist_ok=True)
    _write_tables(flights, folder)
    every = [(f, o) for f in flights for o in f.found.found]
    worst = sorted(every, key=lambda e: (-len(e[1].warnings), -_size(e[1])))
    # Looked up when it is needed: who wants fewer pictures sets it there.
    shown = {_anchor(f, o) for f, o in worst[: report.MOST_SECTIONS]}
    maps = [_map(f) for f in flights[:MOST_MAPS]]
    sections = []
    for f, o in every:
        if _anchor(f, o) not in shown:
            continue
        sections.append(_section(f, o))
        if progress:
            progress(len(sections), len(shown))
    text = _page(flights, shown, maps, sections, notes)
    page = folder / "index.html"
    write_text(page, text)
    return page


# -- tables for other programs ---------------------------------------------------------


def _write_tables(flights: Sequence[Flown], folder: Path) -> None:
    tables: dict[str, list[dict[str, Any]]] = {
        "flights": [flight_row(f.found, f.name) for f in flights],
        "orientations": [r for f in flights for r in f.rows(f.name)],
        "facets": [r for f in flights for r in facet_rows(f.found, f.name)],
        "differences": [r for f in flights for r in difference_rows(f.found, f.name)],
    }
    for name, rows in tables.items():
        _write_table(rows, folder / name)
    for f in flights:
        # A photograph's number counts within its flight.
        name = f"reflections-{f.name}" if f.name else "reflections"
        own = join([o.reflections for o in f.found.found])
        write_reflections(folder / f"{name.replace('/', '-')}.parquet", own, f.found.names)


def _write_table(rows: list[dict[str, Any]], place: Path) -> None:
    import pandas as pd

    table = pd.DataFrame(rows)
    write_text(place.with_suffix(".csv"), table.to_csv(index=False))
    parquet = place.with_suffix(".parquet")
    write_file(parquet, lambda stream: table.to_parquet(stream, index=False))


# -- the page --------------------------------------------------------------------------


def _size(o: Orientation) -> float:
    value = float(np.linalg.norm(o.sigma_total))
    return value if np.isfinite(value) else np.inf


def _anchor(flight: Flown, o: Orientation) -> str:
    name = flight.found.names[o.heliostat]
    return f"{flight.name}/{name}" if flight.name else name


def _section(flight: Flown, o: Orientation) -> str:
    told = _anchor(flight, o)
    figure = pictures.heliostat_drawing(told, o, flight.shape(o.heliostat))
    listed = "".join(f"<li>{html.escape(w)}.</li>" for w in o.warnings)
    name = html.escape(told)
    return f'<section id="{name}"><h2>{name}</h2>{figure}<ul>{listed}</ul></section>'


def _map(flight: Flown) -> str:
    title = f"flight {flight.name}" if flight.name else ""
    figure = pictures.field_map(flight.found, flight.position, title)
    return picture(figure, f"Map of the field {title}".strip())


def _page(
    flights: Sequence[Flown],
    shown: set[str],
    maps: list[str],
    sections: list[str],
    notes: tuple[str, ...],
) -> str:
    measured = sum(len(f.found.found) for f in flights)
    missing = sum(len(f.found.left_out) for f in flights)
    told = (
        "rotX and rotY: how a mirror stands turned, about its own horizontal and upward axes, from "
        "where it was expected. σ: of a single difference. σ/√n takes the points as independent; "
        "σ_mean counts the slopes as one fixed field; σ_tot holds the systematic part too. All in "
        "mrad of the mirror's normal, rotX and rotY; the beam turns by twice that."
    )
    lines = [f"{measured} heliostats measured, {missing} not.", told, *notes]
    if len(sections) < measured:
        lines.append(
            f"Pictures of {len(sections)} of them, those with the most warnings and the largest "
            "σ_tot; the others' figures are in the tables and in differences.csv."
        )
    text = "".join(f"<p>{html.escape(line)}</p>" for line in lines)
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Flight</title><style>{STYLE}{_STYLE}</style><h1>Orientations from the air</h1>"
        f"{text}{_of_flights(flights)}{_of_maps(maps)}<h2>Heliostats</h2>"
        f"{_of_heliostats(flights, shown)}<details><summary>facets</summary>"
        f"{_of_facets(flights)}</details>{_left_out(flights)}{''.join(sections)}</html>"
    )


def _of_maps(maps: list[str]) -> str:
    if len(maps) < 2:
        return "".join(maps)
    rest = "".join(maps[1:])
    return f"{maps[0]}<details><summary>maps of other flights</summary>{rest}</details>"


def _of_flights(flights: Sequence[Flown]) -> str:
    head = (
        "flight", "heliostats", "not measured", "photographs with reflections", "points",
        "rejected", "distance, m", "mean rotX, rotY", "RMS rotX, rotY", "σ", "σ/√n", "σ_mean",
        "systematic", "σ_tot",
    )  # fmt: skip
    body = []
    for f in flights:
        row = flight_row(f.found, f.name)
        body.append(
            [
                html.escape(f.name) or "–",
                row["heliostats"],
                row["not_measured"],
                row["photographs_with_reflections"],
                row["points"],
                row["outliers"],
                f"{row['distance_m']:.0f}",
                _both(row, "rot_mean", "+"),
                *(
                    _both(row, name)
                    for name in (
                        "rot_rms",
                        "sigma",
                        "sigma_plain",
                        "sigma_mean",
                        "systematic",
                        "sigma_tot",
                    )
                ),
            ]
        )
    return _table(head, body)


def _of_heliostats(flights: Sequence[Flown], shown: set[str]) -> str:
    causes = _causes(flights)
    head = (
        "heliostat", "points", "rejected", "azimuth, °", "elevation, °", "rotX, rotY", "σ", "σ/√n",
        "σ_mean", *(f"σ of {cause}" for cause in causes), "systematic", "σ_tot",
        "p (rotX, rotY)", "warnings",
    )  # fmt: skip
    body = []
    for f in flights:
        for o, row in zip(f.found.found, f.rows(), strict=True):
            name = html.escape(_anchor(f, o))
            body.append(
                [
                    f'<a href="#{name}">{name}</a>' if _anchor(f, o) in shown else name,
                    o.count,
                    int(o.outlier.sum()),
                    f"{row['azimuth_deg']:.4f}",
                    f"{row['elevation_deg']:.4f}",
                    _both(row, "rot", "+"),
                    *(_both(row, w) for w in ("sigma", "sigma_plain", "sigma_mean")),
                    *(_both(row, f"systematic_{cause}") for cause in causes),
                    *(_both(row, w) for w in ("systematic", "sigma_tot")),
                    f"{o.normality[0]:.2f}, {o.normality[1]:.2f}",
                    len(o.warnings) or "",
                ]
            )
    return _table(head, body)


def _causes(flights: Sequence[Flown]) -> list[str]:
    """Return the causes of the systematic part that are known of every flight."""
    if any(f.budget is None for f in flights):
        return []
    told = {f.places is None for f in flights}
    if told == {True}:
        return [c.name for c in fields(Budget)]
    return ["place", "lamp"] if told == {False} else []


def _of_facets(flights: Sequence[Flown]) -> str:
    head = ("heliostat", "facet", "points", "rotX, rotY", "σ of the mean")
    body = [
        [
            html.escape(f"{f.name}/{row['heliostat']}" if f.name else row["heliostat"]),
            row["facet"],
            row["points"],
            _both(row, "rot", "+"),
            _both(row, "sigma"),
        ]
        for f in flights
        for row in facet_rows(f.found)
    ]
    return _table(head, body)


def _left_out(flights: Sequence[Flown]) -> str:
    body = [
        [html.escape(f"{f.name}/{name}" if f.name else name), html.escape(why)]
        for f in flights
        for name, why in f.found.left_out.items()
    ]
    return f"<h2>Not measured</h2>{_table((), body)}" if body else ""


def _both(row: dict[str, Any], name: str, sign: str = "") -> str:
    """Return the figures of rotX and rotY as one cell."""
    return ", ".join(f"{row[f'{name}_{a}_mrad']:{sign}.3f}" for a in ("x", "y"))


def _table(head: Iterable[str], body: Iterable[Sequence[object]]) -> str:
    named = "".join(f"<th>{name}</th>" for name in head)
    rows = "".join("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>" for cells in body)
    return f'<div class="wide"><table>{f"<tr>{named}</tr>" if named else ""}{rows}</table></div>'
