"""The report of a calibration: one self-contained page, and files for other programs."""

import base64
import html
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heliotrope.calibration.evaluation import BeamErrors, ErrorSummary, beam_errors, summarise
from heliotrope.calibration.fit.estimator import FitOutcome
from heliotrope.calibration.learn.assessment import Assessment
from heliotrope.calibration.learn.learning import Learned, left_out_errors
from heliotrope.calibration.report import pictures
from heliotrope.calibration.report.results import (
    FieldParameters,
    at_moment,
    calibrated_plant,
    write_json,
    write_parquet,
)
from heliotrope.calibration.uncertainty import BlindSpot, unobservable
from heliotrope.field.formats.plant_file import write_plant
from heliotrope.field.plant import Plant
from heliotrope.files.text import write_text
from heliotrope.geometry import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: No more heliostats than this get a section with pictures: those with the largest errors.
MOST_SECTIONS = 60


@dataclass(frozen=True)
class Row:
    """Figures of one heliostat: errors of the beam, rad."""

    index: int
    name: str
    before: ErrorSummary
    after: ErrorSummary
    held: ErrorSummary
    outcome: FitOutcome


@dataclass(frozen=True)
class CalibrationReport:
    """A calibration with what is needed to show it.

    Attributes
    ----------
    names
        Of the N heliostats.
    learned
        From all sightings.
    plant, group
        The plant, and the group whose heliostats these are.
    assessment
        Of a second learning with a part held out, or None.
    ids
        A name for each sighting, for the list of outliers.
    left_out
        A line for each sighting that could not be used.
    note
        How the held-out part was chosen.
    """

    names: tuple[str, ...]
    learned: Learned
    plant: Plant
    group: str
    assessment: Assessment | None = None
    ids: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    note: str = ""
    comparison: tuple[str, ...] = field(default=())

    @cached_property
    def results(self) -> FieldParameters:
        """The parameters at the moment of the last sighting."""
        return at_moment(self.names, self.learned)

    @cached_property
    def before(self) -> BeamErrors:
        """Errors under the nominal mechanisms."""
        return beam_errors(self.learned.mechanism, self.learned.sightings)

    @cached_property
    def after(self) -> FloatArray:
        """Beam errors, each sighting seen from the others, rad right and up, (M, 2)."""
        return left_out_errors(self.learned)

    @cached_property
    def distance(self) -> FloatArray:
        """From mirror to destination, m; 1 where that is at infinity, (M,)."""
        s = self.learned.sightings
        way = s.destination - self.learned.mechanism[s.heliostat].pose(s.counts).vertex
        return np.where(s.destination_at_infinity, 1.0, np.linalg.norm(way, axis=-1))

    @property
    def targets(self) -> FloatArray:
        """Centres of the targets, (K, 3)."""
        return np.array([t.center for t in self.plant.targets]).reshape(-1, 3)

    @property
    def aim(self) -> FloatArray:
        """Where a heliostat aims in the map of its year: the first target, or the sightings'."""
        if len(self.targets):
            return np.asarray(self.targets[0])
        s = self.learned.sightings
        return np.asarray(np.mean(s.destination[~s.destination_at_infinity], axis=0))

    @property
    def latitude_deg(self) -> float:
        """Of the site."""
        return self.plant.site.latitude_deg

    @cached_property
    def _rows(self) -> tuple[Row, ...]:
        held = {h.name: h.beam for h in self.assessment.heliostats} if self.assessment else {}
        size = np.linalg.norm(self.after, axis=-1)
        nothing = summarise(np.empty(0))
        found = []
        for i, name in enumerate(self.names):
            mine = self.learned.sightings.heliostat == i
            if mine.any():
                outcome = FitOutcome(int(self.learned.static.outcome[i]))
                before = summarise(self.before.beam[mine])
                after = summarise(size[mine])
                found.append(Row(i, name, before, after, held.get(name, nothing), outcome))
        return tuple(found)

    def rows(self) -> tuple[Row, ...]:
        """Return the figures of the heliostats that have sightings."""
        return self._rows


def write_parameters(result: CalibrationReport, path: Path) -> None:
    """Write the parameters with their standard deviations as CSV, one heliostat a row.

    Columns carry the unit: ``tilt_north_rad``, ``tilt_north_sigma_rad``.
    """
    r, c = result.results, result.learned.static
    header = ["name", "sightings", "outcome", "noise_scale"]
    for name in r.names:
        unit = result.learned.mechanism.parameter(name).unit
        suffix = "" if unit == "1" else f"_{unit}"
        header += [f"{name}{suffix}", f"{name}_sigma{suffix}"]
    lines = [",".join(header)]
    sigma = r.sigma
    for i, heliostat in enumerate(result.names):
        cells = [heliostat, str(int(c.count[i])), FitOutcome(int(c.outcome[i])).name.lower()]
        cells.append(f"{r.noise[i]:.17g}")
        for p in range(len(r.names)):
            cells += [f"{r.values[i, p]:.17g}", f"{sigma[i, p]:.17g}"]
        lines.append(",".join(cells))
    write_text(path, "\n".join(lines) + "\n")


def write_report(
    result: CalibrationReport, folder: Path, progress: Callable[[int, int], None] | None = None
) -> Path:
    """Write the page and the files beside it; returns the page's path.

    ``index.html`` (all pictures inside it), ``parameters.csv``, ``calibration.json``,
    ``calibration.parquet``, and ``plant.toml`` with the calibrated heliostats.

    Parameters
    ----------
    result
        What to show.
    folder
        Where to; it is made.
    progress
        Called with (done, all) after each picture.
    """
    folder.mkdir(parents=True, exist_ok=True)
    r = result.results
    write_parameters(result, folder / "parameters.csv")
    ids = result.ids or tuple(str(k) for k in range(len(result.learned.sightings)))
    write_json(folder / "calibration.json", result.names, result.learned, r, ids)
    units = {n: result.learned.mechanism.parameter(n).unit for n in r.names}
    write_parquet(folder / "calibration.parquet", units, r)
    write_plant(calibrated_plant(result.plant, result.group, r), folder / "plant.toml")
    rows = sorted(result.rows(), key=lambda row: -_finite(row.after.median))[:MOST_SECTIONS]
    rows = sorted(rows, key=lambda row: row.name)
    sections = []
    for k, row in enumerate(rows):
        sections.append(_section(result, row))
        if progress:
            progress(k + 1, len(rows) + 1)
    page = folder / "index.html"
    text = _page(result, sections)
    write_text(page, text)
    if progress:
        progress(len(rows) + 1, len(rows) + 1)
    return page


def _finite(value: float) -> float:
    return value if np.isfinite(value) else 0.0


def picture(figure: "Figure", alt: str, dpi: int = 80) -> str:
    """Return a figure as an image inside a page; ``alt`` is for those who do not see it."""
    data = io.BytesIO()
    figure.savefig(data, dpi=dpi, format="png")
    code = base64.b64encode(data.getvalue()).decode("ascii")
    return f'<img loading="lazy" src="data:image/png;base64,{code}" alt="{html.escape(alt)}">'


def blind_spots(result: CalibrationReport, i: int) -> tuple[BlindSpot, ...]:
    """Return what the sightings of heliostat ``i`` say nothing about."""
    r = result.results
    count = len(result.learned.model)
    line = result.aim - result.learned.mechanism.position[i]
    return unobservable(
        r.names[:count], r.covariance[i][:count, :count], result.learned.hyper.spread[:count], line
    )


def _section(result: CalibrationReport, row: Row) -> str:
    name = html.escape(row.name)
    learned, i = result.learned, row.index
    notes = []
    steps = learned.members[i].data.steps
    if len(steps):
        days = ", ".join(str(np.datetime64(int(d), "D")) for d in steps)
        notes.append(f"The zeros took a step about {days}.")
    mine = np.flatnonzero(learned.sightings.heliostat == i)
    labels = learned.regime[mine]
    for k in np.unique(labels[labels > 0]):
        time = learned.sightings.time[mine[labels == k]] / 86400.0
        first, last = (np.datetime64(int(t), "D") for t in (np.nanmin(time), np.nanmax(time)))
        notes.append(f"Regime {k}: {int((labels == k).sum())} sightings, {first} to {last}.")
    out = mine[learned.outlier[mine]]
    if len(out):
        listed = ", ".join(html.escape(result.ids[k]) if result.ids else str(k) for k in out)
        notes.append(f"Outliers, left out: {listed}.")
    notes += [b.text[0].upper() + b.text[1:] + "." for b in blind_spots(result, i)[:4]]
    figure = picture(pictures.heliostat_figure(result, i), f"Errors of {row.name}", 70)
    body = "".join(f"<li>{note}</li>" for note in notes)
    return (
        f'<section id="{name}"><h2>{name}</h2>{figure}<ul>{body}</ul>'
        f"{_parameter_table(result, i)}</section>"
    )


def _parameter_table(result: CalibrationReport, i: int) -> str:
    r = result.results
    lines = []
    for p, name in enumerate(r.names):
        row = result.learned.mechanism.parameter(name)
        factor, unit = (1e3, {"rad": "mrad", "m": "mm"}.get(row.unit, "‰"))
        lines.append(
            f"<tr><td>{name}</td><td>{factor * r.values[i, p]:.3f}</td>"
            f"<td>{factor * r.sigma[i, p]:.3f}</td><td>{factor * row.prior:.1f}</td>"
            f"<td>{unit}</td><td>{html.escape(row.cause)}</td></tr>"
        )
    head = "<tr><th>parameter</th><th>value</th><th>σ</th><th>prior σ</th><th></th><th>cause</th>"
    table = f"<table>{head}</tr>{''.join(lines)}</table>"
    return f"<details><summary>parameters</summary>{table}</details>"


#: Of the pages.
STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem }
table { border-collapse: collapse } td, th { padding: .15rem .8rem; text-align: right }
td:first-child, th:first-child, td:last-child, th:last-child { text-align: left }
tr:nth-child(even) { background: #8881 } img { max-width: 100%; background: #fff }
section { border-top: 1px solid #8886; margin-top: 2rem } :root { color-scheme: light dark }
"""


def _page(result: CalibrationReport, sections: list[str]) -> str:
    body = []
    linked = "".join(sections)
    for row in result.rows():
        numbers = [
            row.before.median, row.after.median, row.after.rms, row.after.p95, row.held.median,
            row.held.p95,
        ]  # fmt: skip
        cells = "".join(
            f"<td>{1e3 * v:.2f}</td>" if np.isfinite(v) else "<td>–</td>" for v in numbers
        )
        name = html.escape(row.name)
        shown = f'<a href="#{name}">{name}</a>' if f'id="{name}"' in linked else name
        out = int(result.learned.outlier[result.learned.sightings.heliostat == row.index].sum())
        body.append(
            f"<tr><td>{shown}</td><td>{row.before.count}</td><td>{out}</td>{cells}"
            f"<td>{row.outcome.text}</td></tr>"
        )
    head = (
        "<tr><th>heliostat</th><th>sightings</th><th>outliers</th><th>before, median</th>"
        "<th>after, median</th><th>RMS</th><th>95 %</th><th>held out, median</th><th>95 %</th>"
        "<th>fit</th></tr>"
    )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>Calibration</title><style>{STYLE}</style><h1>Calibration</h1>"
        f"{_summary(result)}{picture(pictures.overview(result), 'Median beam error')}"
        f"{picture(pictures.field_map(result), 'Map of the field')}"
        f"<table>{head}{''.join(body)}</table>{linked}</html>"
    )


def _summary(result: CalibrationReport) -> str:
    learned = result.learned
    unused = len(result.left_out)
    first = f"{len(result.rows())} heliostats with {len(learned.sightings)} sightings; "
    first += f"{int(learned.outlier.sum())} outliers and {unused} unusable ones left out."
    second = "Errors are of the beam, in mrad (about twice the mirror's). <em>After</em>: each "
    second += "sighting as predicted from all others of its heliostat."
    parts = [first, f"Model: {', '.join(learned.model)}.", second]
    a = result.assessment
    if a is not None and np.isfinite(a.median_of_medians):
        parts.append(
            f"<em>Held out</em> ({html.escape(result.note)}): median of the medians "
            f"{1e3 * a.median_of_medians:.2f} mrad over the heliostats with {a.fewest} sightings "
            f"or more; {100 * a.coverage:.0f} % lie within their 90 % ellipse."
        )
    h = learned.hyper
    moving = "; ".join(
        f"{p.parameter} by {1e3 * a:.2f} mrad within {_span(float(h.tau[g]))}"
        for p, a, g in zip(h.processes, h.amplitude, h.group, strict=True)
    )
    if moving:
        parts.append(f"What wanders: {moving}. Noise of a sighting: {h.noise:.2f} of its sigma.")
    parts += [html.escape(line) for line in result.comparison]
    return "".join(f"<p>{part}</p>" for part in parts)


def _span(days: float) -> str:
    return f"{24 * days:.1f} h" if days < 2.0 else f"{days:.0f} days"
