"""Write the flight report: one self-contained page, and tables for other programs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.budget import Budget
from heliotrope.airborne.evaluate.flight import CampaignResult
from heliotrope.airborne.evaluate.flight_file import flight_document
from heliotrope.airborne.evaluate.orientation import Orientation, Orientations
from heliotrope.airborne.evaluate.pictures import field_map, heliostat_drawing
from heliotrope.airborne.evaluate.reflections import join, write_reflections
from heliotrope.airborne.evaluate.tables import (
    MeasuredFlight,
    difference_rows,
    facet_rows,
    flight_row,
    write_table,
)
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.calibration.flights import write_flight
from heliotrope.calibration.sighting_table import write_sightings
from heliotrope.errors import InputError
from heliotrope.files.html import STYLE, picture, render
from heliotrope.files.text import write_text
from heliotrope.geometry import as_float

if TYPE_CHECKING:
    from markupsafe import Markup

Progress = Callable[[int, int], None]

#: Maximum numbers of flights with a map and of heliostats with a picture.
MOST_MAPS, MOST_SECTIONS = 6, 60
_AVERAGED = ("sigma", "sigma_plain", "sigma_mean")
_FLIGHT_HEAD = (
    *("flight", "heliostats", "not measured", "photographs with reflections", "points", "rejected"),
    *("distance, m", "mean rotX, rotY", "RMS rotX, rotY", "σ", "σ/√n", "σ_mean", "systematic"),
    "σ_tot",
)
_HELIOSTAT_HEAD = (
    *("heliostat", "points", "rejected", "azimuth, °", "elevation, °", "rotX, rotY", "σ", "σ/√n"),
    "σ_mean",
)


def write_result(
    result: CampaignResult,
    folder: Path,
    *,
    page: bool = True,
    progress: Progress | None = None,
) -> None:
    """Write the reflections, sightings and orientations of evaluated flights to a folder.

    The files are ``reflections.csv`` (for a campaign ``reflections-FLIGHT.csv``), ``sightings.csv``
    for the calibration, ``flight.json`` for a running plant, and the report of
    `write_campaign_report`.

    Parameters
    ----------
    result
        Result of `heliotrope.airborne.evaluate.flight.evaluate_flight`.
    folder
        Folder, created if it does not exist.
    page
        Whether to write the page with its plots; otherwise only ``orientations.csv``.
    progress
        Called with the numbers of plots (done, total) after each plot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for flight in result.flights:
        name = f"reflections-{flight.data.name}".rstrip("-")
        write_reflections(
            folder / f"{name}.csv", flight.evaluation.reflections, flight.data.stand.names
        )
    sightings = result.sightings()
    if sightings is not None:
        kinds = ["drone"] * len(sightings)
        write_sightings(folder / "sightings.csv", sightings, result.plant.names, kinds)
    document = flight_document(result)
    if document is not None:
        write_flight(folder / "flight.json", document)
    if not page:
        write_table(folder / "orientations.csv", result.orientation_rows())
        return
    notes = (f"{result.campaign.offset_text()}.", *result.not_used, *result.impossible)
    measured = [f.measured for f in result.flights]
    write_campaign_report(measured, folder, notes=notes, progress=progress)


def write_flight_report(
    found: Orientations,
    shape: Callable[[int], MirrorShape],
    position: npt.ArrayLike,
    folder: Path,
    *,
    budget: Budget | None = None,
    places: npt.ArrayLike | None = None,
    notes: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Path:
    """Write the page and the tables of one flight, and return the path of the page.

    The files are ``index.html`` (with all plots), ``orientations``, ``facets``, ``flights`` and
    ``differences`` as ``.csv`` and ``.parquet``, and ``reflections.parquet``.

    Parameters
    ----------
    found, shape, position, budget, places
        See `heliotrope.airborne.evaluate.tables.MeasuredFlight`.
    folder
        Folder, created if it does not exist.
    notes
        Lines for the top of the page, such as unusable photographs and the RTK offset.
    progress
        Called with the numbers of plots (done, total) after each plot.

    Raises
    ------
    InputError
        If there are not N positions, one per heliostat.
    """
    known = None if places is None else as_float(places)
    flown = MeasuredFlight("", found, shape, as_float(position), budget, known)
    return write_campaign_report([flown], folder, notes=notes, progress=progress)


def write_campaign_report(
    flights: Sequence[MeasuredFlight],
    folder: Path,
    *,
    notes: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Path:
    """Write the page and the tables of several flights, like `write_flight_report`.

    Parameters
    ----------
    flights
        Flights, each with a different name.
    folder, notes, progress
        See `write_flight_report`.

    Raises
    ------
    InputError
        If there is no flight, or two flights have the same name.
    """
    names = [f.name.replace("/", "-") for f in flights]
    if not names or len(set(names)) < len(names):
        raise InputError(
            f"flight report: flights {names}; pass one or more flights with different names"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _write_tables(flights, folder)
    every = [(f, o) for f in flights for o in f.found.found]
    worst = sorted(every, key=lambda e: (-len(e[1].warnings), -_size(e[1])))
    shown = {f.label(o) for f, o in worst[:MOST_SECTIONS]}
    maps = [_map(f) for f in flights[:MOST_MAPS]]
    sections = []
    for f, o in every:
        if f.label(o) in shown:
            drawn = heliostat_drawing(f.label(o), o, f.shape(o.heliostat))
            sections.append({"label": f.label(o), "drawing": drawn, "warnings": o.warnings})
            if progress:
                progress(len(sections), len(shown))
    text = render(
        "heliotrope.airborne.evaluate",
        "report.html.j2",
        style=STYLE,
        notes=notes,
        measured=len(every),
        missing=sum(len(f.found.left_out) for f in flights),
        flights=_of_flights(flights),
        heliostats=_of_heliostats(flights, shown),
        facets=_of_facets(flights),
        left_out=[
            (f"{f.name}/{name}" if f.name else name, why)
            for f in flights
            for name, why in f.found.left_out.items()
        ],
        maps=maps,
        sections=sections,
    )
    page = folder / "index.html"
    write_text(page, text)
    return page


def _write_tables(flights: Sequence[MeasuredFlight], folder: Path) -> None:
    tables: dict[str, list[dict[str, Any]]] = {
        "flights": [flight_row(f.found, f.name) for f in flights],
        "orientations": [r for f in flights for r in f.rows(f.name)],
        "facets": [r for f in flights for r in facet_rows(f.found, f.name)],
        "differences": [r for f in flights for r in difference_rows(f.found, f.name)],
    }
    for name, rows in tables.items():
        for suffix in (".csv", ".parquet"):
            write_table(folder / f"{name}{suffix}", rows)
    for f in flights:
        # Photograph numbers count from 0 within each flight.
        name = f"reflections-{f.name}" if f.name else "reflections"
        own = join([o.reflections for o in f.found.found])
        write_reflections(folder / f"{name.replace('/', '-')}.parquet", own, f.found.names)


def _size(o: Orientation) -> float:
    value = float(np.linalg.norm(o.sigma_total))
    return value if np.isfinite(value) else np.inf


def _map(flight: MeasuredFlight) -> "Markup":
    title = f"flight {flight.name}" if flight.name else ""
    figure = field_map(flight.found, flight.position, title)
    return picture(figure, f"Map of the field {title}".strip())


# -- tables of the page ----------------------------------------------------------------


@dataclass(frozen=True)
class _Table:
    """A table: its header, and rows of cells."""

    head: Sequence[str]
    rows: Iterable[Sequence[object]]


def _of_flights(flights: Sequence[MeasuredFlight]) -> _Table:
    body = []
    for f in flights:
        row = flight_row(f.found, f.name)
        counts = ("heliostats", "not_measured", "photographs_with_reflections", "points")
        averages = ("rot_rms", *_AVERAGED, "systematic", "sigma_tot")
        body.append(
            [
                f.name or "–",
                *(row[name] for name in (*counts, "outliers")),
                f"{row['distance_m']:.0f}",
                _both(row, "rot_mean", "+"),
                *(_both(row, name) for name in averages),
            ]
        )
    return _Table(_FLIGHT_HEAD, body)


def _of_heliostats(flights: Sequence[MeasuredFlight], shown: set[str]) -> _Table:
    causes = _causes(flights)
    named = [f"σ of {cause}" for cause in causes]
    head = [*_HELIOSTAT_HEAD, *named, "systematic", "σ_tot", "p (rotX, rotY)", "warnings"]
    body = []
    for f in flights:
        for o, row in zip(f.found.found, f.rows(), strict=True):
            parts = (*_AVERAGED, *(f"systematic_{c}" for c in causes), "systematic", "sigma_tot")
            body.append(
                [
                    render("heliotrope.airborne.evaluate", "link.html.j2", to=f.label(o))
                    if f.label(o) in shown
                    else f.label(o),
                    o.count,
                    int(o.outlier.sum()),
                    f"{row['azimuth_deg']:.4f}",
                    f"{row['elevation_deg']:.4f}",
                    _both(row, "rot", "+"),
                    *(_both(row, part) for part in parts),
                    f"{o.normality[0]:.2f}, {o.normality[1]:.2f}",
                    len(o.warnings) or "",
                ]
            )
    return _Table(head, body)


def _causes(flights: Sequence[MeasuredFlight]) -> list[str]:
    """Return the causes of the systematic error that are known for every flight."""
    if any(f.budget is None for f in flights):
        return []
    without = {f.places is None for f in flights}
    if without == {True}:
        return [c.name for c in fields(Budget)]
    return ["place", "lamp"] if without == {False} else []


def _of_facets(flights: Sequence[MeasuredFlight]) -> _Table:
    body = [
        [
            f"{f.name}/{row['heliostat']}" if f.name else row["heliostat"],
            row["facet"],
            row["points"],
            _both(row, "rot", "+"),
            _both(row, "sigma"),
        ]
        for f in flights
        for row in facet_rows(f.found)
    ]
    return _Table(("heliostat", "facet", "points", "rotX, rotY", "σ of the mean"), body)


def _both(row: dict[str, Any], name: str, sign: str = "") -> str:
    """Format the values of rotX and rotY as one table cell."""
    return ", ".join(f"{row[f'{name}_{a}_mrad']:{sign}.3f}" for a in ("x", "y"))
