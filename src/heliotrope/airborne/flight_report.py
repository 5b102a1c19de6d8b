"""The report of a flight: one self-contained page, and tables for other programs."""

import html
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from heliotrope.airborne import flight_pictures as pictures
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.orientation import Orientation, Orientations
from heliotrope.airborne.reflections import join, write_reflections
from heliotrope.calibration.report import MOST_SECTIONS, STYLE, picture, write_beside
from heliotrope.errors import InputError
from heliotrope.geometry import FloatArray, as_float

_AXES = ("x", "y")


def orientation_rows(found: Orientations) -> list[dict[str, Any]]:
    """Return one record a heliostat, for tables and JSON; angles in mrad and degrees."""
    return [_row(found.names[o.heliostat], o) for o in found.found]


def facet_rows(found: Orientations) -> list[dict[str, Any]]:
    """Return one record a facet: its mean difference, which is its canting error, mrad."""
    return [
        {
            "heliostat": found.names[o.heliostat],
            "facet": f.facet,
            "points": f.count,
            **{f"rot_{a}_mrad": 1e3 * float(f.mean[k]) for k, a in enumerate(_AXES)},
            **{f"sigma_{a}_mrad": 1e3 * float(f.sigma[k]) for k, a in enumerate(_AXES)},
        }
        for o in found.found
        for f in o.facets
    ]


def difference_rows(found: Orientations) -> list[dict[str, Any]]:
    """Return one record a reflection: where it stands on the mirror, and its difference."""
    return [
        {
            "heliostat": found.names[o.heliostat],
            "photo": int(o.reflections.photo[i]),
            "facet": int(o.reflections.facet[i]),
            "x_m": float(o.reflections.x[i]),
            "y_m": float(o.reflections.y[i]),
            **{f"rot_{a}_mrad": 1e3 * float(o.difference[i, k]) for k, a in enumerate(_AXES)},
            "outlier": bool(o.outlier[i]),
        }
        for o in found.found
        for i in range(len(o.reflections))
    ]


def write_flight_report(
    found: Orientations,
    shape: Callable[[int], MirrorShape],
    position: npt.ArrayLike,
    folder: Path,
    *,
    notes: tuple[str, ...] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write the page and the tables beside it; returns the page's path.

    ``index.html`` (all pictures inside it), and ``orientations``, ``facets`` and
    ``differences`` as ``.csv`` and ``.parquet``, and ``reflections.parquet``.

    Parameters
    ----------
    found
        Orientations of the N heliostats.
    shape
        Gives the mirror of a row.
    position
        Of the heliostats, ENU metres, (N, 3).
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
    places = as_float(position)
    if places.shape != (len(found.names), 3):
        raise InputError(
            f"flight report: positions of shape {places.shape} for {len(found.names)} heliostats"
        )
    folder.mkdir(parents=True, exist_ok=True)
    _write_tables(found, folder)
    shown = sorted(found.found, key=lambda o: (-len(o.warnings), -_size(o)))[:MOST_SECTIONS]
    shown.sort(key=lambda o: found.names[o.heliostat])
    sections = []
    for k, o in enumerate(shown):
        sections.append(_section(found.names[o.heliostat], o, shape(o.heliostat)))
        if progress:
            progress(k + 1, len(shown))
    text = _page(found, places, sections, notes)
    page = folder / "index.html"
    write_beside(page, lambda part: part.write_text(text, encoding="utf-8"))
    return page


def _row(name: str, o: Orientation) -> dict[str, Any]:
    row: dict[str, Any] = {
        "heliostat": name,
        "points": o.count,
        "outliers": int(o.outlier.sum()),
        "distance_m": o.distance,
        "azimuth_deg": float(np.degrees(o.azimuth)),
        "elevation_deg": float(np.degrees(o.elevation)),
    }
    for what, values in (
        ("rot", o.correction), ("sigma", o.sigma), ("sigma_plain", o.sigma_plain),
        ("sigma_mean", o.sigma_mean), ("systematic", o.systematic), ("sigma_tot", o.sigma_total),
    ):  # fmt: skip
        for a, value in zip(_AXES, values, strict=True):
            row[f"{what}_{a}_mrad"] = 1e3 * float(value)
    for a, value in zip(_AXES, o.normality, strict=True):
        row[f"shapiro_wilk_p_{a}"] = float(value)
    return {**row, "mean": o.mean, "warnings": "; ".join(o.warnings)}


def _write_tables(found: Orientations, folder: Path) -> None:
    for name, rows in (
        ("orientations", orientation_rows(found)),
        ("facets", facet_rows(found)),
        ("differences", difference_rows(found)),
    ):
        _write_table(rows, folder / name)
    every = join([o.reflections for o in found.found])
    write_reflections(folder / "reflections.parquet", every, found.names)


def _write_table(rows: list[dict[str, Any]], place: Path) -> None:
    import pandas as pd

    table = pd.DataFrame(rows)
    write_beside(place.with_suffix(".csv"), lambda part: table.to_csv(part, index=False))
    write_beside(place.with_suffix(".parquet"), lambda part: table.to_parquet(part, index=False))


def _size(o: Orientation) -> float:
    value = float(np.linalg.norm(o.sigma_total))
    return value if np.isfinite(value) else np.inf


def _section(name: str, o: Orientation, shape: MirrorShape) -> str:
    figure = picture(pictures.heliostat_figure(name, o, shape), f"Differences of {name}", 70)
    told = html.escape(name)
    listed = "".join(f"<li>{html.escape(w)}.</li>" for w in o.warnings)
    return f'<section id="{told}"><h2>{told}</h2>{figure}<ul>{listed}</ul></section>'


def _page(
    found: Orientations, places: FloatArray, sections: list[str], notes: tuple[str, ...]
) -> str:
    linked = "".join(sections)
    field = picture(pictures.field_map(found, places), "Map of the field")
    lines = [
        f"{len(found.found)} heliostats measured, {len(found.left_out)} not.",
        (
            "rotX and rotY: how a mirror stands turned, about its own horizontal and upward axes, "
            "from where it was expected. σ/√n takes the points as independent; σ_mean counts the "
            "slopes as one fixed field; σ_tot holds the systematic part too. All in mrad of the "
            "mirror's normal; the beam turns by twice that."
        ),
        *notes,
    ]
    text = "".join(f"<p>{html.escape(line)}</p>" for line in lines)
    missing = "".join(
        f"<tr><td>{html.escape(n)}</td><td>{html.escape(why)}</td></tr>"
        for n, why in found.left_out.items()
    )
    left_out = f"<h2>Not measured</h2><table>{missing}</table>" if missing else ""
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Flight</title><style>{STYLE}</style><h1>Orientations from the air</h1>"
        f"{text}{field}{_table(found, linked)}{left_out}{linked}</html>"
    )


def _table(found: Orientations, linked: str) -> str:
    head = "".join(
        f"<th>{name}</th>"
        for name in (
            "heliostat", "points", "outliers", "azimuth, °", "elevation, °", "rotX", "rotY",
            "σ", "σ/√n", "σ_mean", "systematic", "σ_tot", "p (rotX, rotY)", "warnings",
        )
    )  # fmt: skip
    body = []
    for o in found.found:
        name = html.escape(found.names[o.heliostat])
        shown = f'<a href="#{name}">{name}</a>' if f'id="{name}"' in linked else name
        pairs = (o.sigma, o.sigma_plain, o.sigma_mean, o.systematic, o.sigma_total)
        cells = [
            shown, str(o.count), str(int(o.outlier.sum())), f"{np.degrees(o.azimuth):.4f}",
            f"{np.degrees(o.elevation):.4f}", *(f"{1e3 * v:+.3f}" for v in o.correction),
            *(f"{1e3 * p[0]:.3f}, {1e3 * p[1]:.3f}" for p in pairs),
            f"{o.normality[0]:.2f}, {o.normality[1]:.2f}", str(len(o.warnings) or ""),
        ]  # fmt: skip
        body.append("<tr>" + "".join(f"<td>{c}</td>" for c in cells) + "</tr>")
    return f"<table><tr>{head}</tr>{''.join(body)}</table>"
