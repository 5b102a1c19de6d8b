"""Write a calibration report: one page with its plots, and files beside it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.report import pictures
from heliotrope.calibration.report.content import CalibrationReport, HeliostatRow
from heliotrope.calibration.report.results import write_json, write_parquet
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.files.html import STYLE, picture, render
from heliotrope.files.text import write_text

#: At most this many heliostats get a section with pictures.
MOST_SECTIONS = 60


def write_parameters(report: CalibrationReport, path: Path) -> None:
    """Write the parameters and their standard deviations as CSV, one record per heliostat.

    Column names include the unit, as in ``tilt_north_rad`` and ``tilt_north_sigma_rad``.
    """
    r, c = report.results, report.learned.static
    header = ["name", "sightings", "outcome", "noise_scale"]
    for name in r.names:
        unit = report.learned.mechanism.parameter(name).unit
        suffix = "" if unit == "1" else f"_{unit}"
        header += [f"{name}{suffix}", f"{name}_sigma{suffix}"]
    lines = [",".join(header)]
    sigma = r.sigma
    for i, heliostat in enumerate(report.names):
        cells = [heliostat, str(int(c.count[i])), FitOutcome(int(c.outcome[i])).name.lower()]
        cells.append(f"{r.noise[i]:.17g}")
        for p in range(len(r.names)):
            cells += [f"{r.values[i, p]:.17g}", f"{sigma[i, p]:.17g}"]
        lines.append(",".join(cells))
    write_text(path, "\n".join(lines) + "\n")


def write_report(
    report: CalibrationReport,
    folder: Path,
    progress: Callable[[int, int], None] | None = None,
    *,
    most: int | None = None,
) -> Path:
    """Write the page and the files beside it, and return the path of the page.

    The files are ``index.html`` (with all plots embedded), ``parameters.csv``,
    ``calibration.json``, ``calibration.parquet``, and ``plant.toml`` with the calibrated
    heliostats.

    Parameters
    ----------
    report
        Content.
    folder
        Created if it does not exist.
    progress
        Called with the numbers of plots (done, total) after each plot.
    most
        Maximum number of heliostats that get their own plots; the largest errors come first. None:
        `MOST_SECTIONS`.
    """
    folder.mkdir(parents=True, exist_ok=True)
    learned, r = report.learned, report.results
    write_parameters(report, folder / "parameters.csv")
    ids = report.ids or tuple(str(k) for k in range(len(learned.sightings)))
    write_json(folder / "calibration.json", report.names, learned, r, ids)
    units = {n: learned.mechanism.parameter(n).unit for n in r.names}
    write_parquet(folder / "calibration.parquet", units, r)
    write_plant(report.calibrated, folder / "plant.toml")
    most = MOST_SECTIONS if most is None else most
    rows = sorted(report.rows, key=lambda row: -np.nan_to_num(row.after.median))[:most]
    rows = sorted(rows, key=lambda row: row.name)
    sections = []
    for k, row in enumerate(rows):
        sections.append(_section(report, row))
        if progress:
            progress(k + 1, len(rows) + 1)
    page = folder / "index.html"
    write_text(page, _page(report, sections))
    if progress:
        progress(len(rows) + 1, len(rows) + 1)
    return page


def _page(report: CalibrationReport, sections: list[dict[str, Any]]) -> str:
    learned, h = report.learned, report.learned.hyper
    drift = [
        {"parameter": p.parameter, "amplitude": a, "span": _span(float(h.tau[g]))}
        for p, a, g in zip(h.processes, h.amplitude, h.group, strict=True)
    ]
    return render(
        "heliotrope.calibration.report",
        "calibration.html.j2",
        style=STYLE,
        rows=report.rows,
        sightings=len(learned.sightings),
        outliers=int(learned.outlier.sum()),
        unusable=len(report.left_out),
        model=learned.model,
        assessment=report.assessment,
        note=report.note,
        drift=drift,
        noise=h.noise,
        comparison=(*report.remarks, *report.comparison),
        overview=picture(pictures.overview(report), "Median beam error"),
        map=picture(pictures.field_map(report), "Map of the field"),
        shown={section["name"] for section in sections},
        sections=sections,
    )


def _span(days: float) -> str:
    return f"{24 * days:.1f} h" if days < 2.0 else f"{days:.0f} days"


def _section(report: CalibrationReport, row: HeliostatRow) -> dict[str, Any]:
    figure = pictures.heliostat_figure(report, row.index)
    return {
        "name": row.name,
        "figure": picture(figure, f"Errors of {row.name}", 70),
        "notes": _notes(report, row.index),
        "parameters": _parameters(report, row.index),
    }


def _notes(report: CalibrationReport, i: int) -> list[str]:
    learned = report.learned
    notes = []
    steps = learned.members[i].data.steps
    if len(steps):
        days = ", ".join(str(np.datetime64(int(d), "D")) for d in steps)
        notes.append(f"The zeros took a step about {days}.")
    mine = np.flatnonzero(learned.sightings.heliostat == i)
    labels = learned.regime[mine]
    for k in np.unique(labels[labels > 0]):
        time = learned.sightings.time[mine[labels == k]] / DAY
        first, last = (np.datetime64(int(t), "D") for t in (np.nanmin(time), np.nanmax(time)))
        notes.append(f"Regime {k}: {int((labels == k).sum())} sightings, {first} to {last}.")
    out = mine[learned.outlier[mine]]
    if len(out):
        listed = ", ".join(report.ids[k] if report.ids else str(k) for k in out)
        notes.append(f"Outliers, left out: {listed}.")
    return notes + [b.text[0].upper() + b.text[1:] + "." for b in report.blind_spots(i)[:4]]


def _parameters(report: CalibrationReport, i: int) -> list[dict[str, Any]]:
    """Return the rows of the parameter table, in mrad, mm or ‰."""
    r = report.results
    rows = []
    for p, name in enumerate(r.names):
        row = report.learned.mechanism.parameter(name)
        rows.append(
            {
                "name": name,
                "value": 1e3 * r.values[i, p],
                "sigma": 1e3 * r.sigma[i, p],
                "prior": 1e3 * row.prior,
                "unit": {"rad": "mrad", "m": "mm"}.get(row.unit, "‰"),
                "cause": row.cause,
            }
        )
    return rows
