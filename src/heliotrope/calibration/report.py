"""The report of a calibration: one page, its pictures, and tables for other programs."""

import html
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliotrope.calibration.estimator import Calibration, Outcome
from heliotrope.calibration.evaluation import Errors, Summary, errors, summary
from heliotrope.calibration.sightings import Sightings
from heliotrope.geometry import FloatArray, azimuth_elevation
from heliotrope.mechanism.chain import Mechanism

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Blue and orange of Okabe and Ito, told apart by the colour-blind too.
BEFORE, AFTER, TESTED = "#999999", "#0072b2", "#d55e00"


@dataclass(frozen=True)
class Result:
    """A calibration with what is needed to show it.

    Attributes
    ----------
    names
        Of the N heliostats.
    mechanism
        Nominal, (N,).
    sightings
        All of them.
    calibration
        Fitted on the training part.
    training
        Mask of it, (M,).
    model
        Name of the model.
    """

    names: tuple[str, ...]
    mechanism: Mechanism
    sightings: Sightings
    calibration: Calibration
    training: "np.ndarray[Any, np.dtype[np.bool_]]"
    model: str

    def errors(self) -> tuple[Errors, Errors]:
        """Return the errors of all sightings before and after."""
        moved = self.mechanism.with_parameters(self.calibration.parameters)
        return errors(self.mechanism, self.sightings), errors(moved, self.sightings)

    def rows(self) -> list[tuple[str, Summary, Summary, Summary, Outcome]]:
        """Return for each heliostat: name, before, after (training), held out, outcome."""
        before, after = self.errors()
        found = []
        for i, name in enumerate(self.names):
            mine = self.sightings.heliostat == i
            found.append(
                (
                    name,
                    summary(before.beam[mine]),
                    summary(after.beam[mine & self.training]),
                    summary(after.beam[mine & ~self.training]),
                    Outcome(int(self.calibration.outcome[i])),
                )
            )
        return found


def write_parameters(result: Result, path: Path) -> None:
    """Write the parameters with their standard deviations as CSV, one heliostat a row.

    Columns carry the unit: ``tilt_north_rad``, ``tilt_north_sigma_rad``.
    """
    c = result.calibration
    header = ["name", "sightings", "outcome", "noise_scale"]
    for name in c.names:
        unit = {"1": ""}.get(result.mechanism.parameter(name).unit)
        unit = f"_{result.mechanism.parameter(name).unit}" if unit is None else unit
        header += [f"{name}{unit}", f"{name}_sigma{unit}"]
    lines = [",".join(header)]
    for i, heliostat in enumerate(result.names):
        cells = [heliostat, str(int(c.count[i])), Outcome(int(c.outcome[i])).name.lower()]
        cells.append(f"{c.scale[i]:.17g}")
        for p in range(len(c.names)):
            cells += [f"{c.values[i, p]:.17g}", f"{c.sigma[i, p]:.17g}"]
        lines.append(",".join(cells))
    write_beside(path, lambda place: place.write_text("\n".join(lines) + "\n", encoding="utf-8"))


def write_beside(path: Path, write: Callable[[Path], object]) -> None:
    """Let ``write`` make a file beside ``path``, then put it in its place at once."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part{path.suffix}")
    try:
        write(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_report(
    result: Result, folder: Path, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write the page, its pictures and ``parameters.csv``; returns the page's path.

    Parameters
    ----------
    result
        What to show.
    folder
        Where to; it is made.
    progress
        Called with (done, all) after each picture.
    """
    before, after = result.errors()
    folder.mkdir(parents=True, exist_ok=True)
    write_parameters(result, folder / "parameters.csv")
    total = len(result.names) + 1
    _save(overview(result), folder / "overview.png")
    for i, name in enumerate(result.names):
        if progress:
            progress(i + 1, total)
        if (result.sightings.heliostat == i).any():
            _save(heliostat_figure(result, i, before, after), folder / f"{name}.png")
    page = folder / "index.html"
    write_beside(page, lambda place: place.write_text(_page(result), encoding="utf-8"))
    if progress:
        progress(total, total)
    return page


def _save(figure: "Figure", path: Path) -> None:
    write_beside(path, lambda place: figure.savefig(place, dpi=110, format="png"))


def _figure(rows: int, columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def overview(result: Result) -> "Figure":
    """Return the picture of all heliostats: median beam error before, after and held out."""
    table = [row for row in result.rows() if row[1].count]
    figure, axes = _figure(1, 1, (max(6.0, 0.32 * len(table) + 2.0), 4.2))
    ax: Axes = axes[0, 0]
    place = np.arange(len(table))
    for column, label, colour, marker in (
        (1, "before", BEFORE, "o"),
        (2, "after, training", AFTER, "s"),
        (3, "after, held out", TESTED, "D"),
    ):
        values = [1e3 * row[column].median for row in table]  # type: ignore[union-attr]
        if np.isfinite(values).any():
            ax.plot(place, values, marker, color=colour, label=label, ms=5)
    ax.set_yscale("log")
    ax.set_ylim(bottom=max(0.01, 0.7 * ax.get_ylim()[0]))
    ax.set_xticks(place, [row[0] for row in table], rotation=90)
    ax.set_ylabel("median beam error, mrad")
    ax.grid(axis="y", alpha=0.3)
    ax.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def heliostat_figure(result: Result, i: int, before: Errors, after: Errors) -> "Figure":
    """Return the picture of one heliostat: errors on the target, residuals against the sun."""
    mine = result.sightings.heliostat == i
    train, test = mine & result.training, mine & ~result.training
    figure, axes = _figure(2, 2, (10.0, 8.0))
    figure.suptitle(f"{result.names[i]}: {int(mine.sum())} sightings, model {result.model}")
    _target_plot(axes[0, 0], [(before.plane[mine], BEFORE, "before")], "before")
    groups = [(after.plane[train], AFTER, "training"), (after.plane[test], TESTED, "held out")]
    _target_plot(axes[0, 1], groups, "after")
    source = result.sightings.source
    azimuth, elevation = azimuth_elevation(source)
    for ax, values, label in (
        (axes[1, 0], np.degrees(azimuth), "sun azimuth from north, °"),
        (axes[1, 1], np.degrees(elevation), "sun elevation, °"),
    ):
        for rows, colour in ((train, AFTER), (test, TESTED)):
            ax.plot(values[rows], 1e3 * after.beam[rows], ".", color=colour)
        ax.set_xlabel(label)
        ax.set_ylabel("beam error after, mrad")
        ax.set_ylim(bottom=0)
        ax.grid(alpha=0.3)
    return figure


def _target_plot(ax: "Axes", groups: list[tuple[FloatArray, str, str]], title: str) -> None:
    for plane, colour, label in groups:
        if len(plane):
            ax.plot(plane[:, 0], plane[:, 1], ".", color=colour, label=label)
    ax.axhline(0, color="k", lw=0.5)
    ax.axvline(0, color="k", lw=0.5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"predicted minus measured, {title}")
    ax.set_xlabel("right, m")
    ax.set_ylabel("up, m")
    ax.grid(alpha=0.3)
    if sum(len(plane) > 0 for plane, _, _ in groups) > 1:
        ax.legend(frameon=False)


_STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem }
table { border-collapse: collapse } td, th { padding: .15rem .8rem; text-align: right }
td:first-child, th:first-child, td:last-child, th:last-child { text-align: left }
tr:nth-child(even) { background: #8881 } img { max-width: 100% }
"""


def _page(result: Result) -> str:
    body = []
    for name, before, after, held, outcome in result.rows():
        numbers = [before.median, after.median, after.rms, held.median, held.p95]
        cells = "".join(
            f"<td>{1e3 * v:.2f}</td>" if np.isfinite(v) else "<td>–</td>" for v in numbers
        )
        link = html.escape(name)
        shown = f'<a href="#{link}">{link}</a>' if before.count else link
        body.append(
            f"<tr><td>{shown}</td><td>{before.count}</td>{cells}<td>{outcome.text}</td></tr>"
        )
    pictures = [
        f'<h2 id="{html.escape(name)}">{html.escape(name)}</h2>'
        f'<img loading="lazy" src="{html.escape(name)}.png" alt="Errors of {html.escape(name)}">'
        for i, name in enumerate(result.names)
        if (result.sightings.heliostat == i).any()
    ]
    head = (
        "<tr><th>heliostat</th><th>sightings</th><th>median before</th><th>median after</th>"
        "<th>RMS after</th><th>held out, median</th><th>held out, 95 %</th><th>fit</th></tr>"
    )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Calibration</title><style>{_STYLE}</style><h1>Calibration</h1>"
        f"<p>{len(result.names)} heliostats, {len(result.sightings)} sightings, model "
        f"{html.escape(result.model)}. Beam errors in mrad (about twice the mirror's).</p>"
        '<img src="overview.png" alt="Median beam error of each heliostat">'
        f"<table>{head}{''.join(body)}</table>{''.join(pictures)}</html>"
    )
