"""Plots of a flight: the points and differences of one heliostat, and a map of the field."""

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from heliotrope.airborne.evaluate.drawing import Panel, around, drawing, round_below
from heliotrope.airborne.evaluate.orientation import Orientation, Orientations
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.calibration.report.pictures import AFTER, OUTLIER, TESTED, figure_of
from heliotrope.geometry import FloatArray, as_float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAMES = ("rotX", "rotY")
_COLOURS = (AFTER, TESTED)
_BAR = "#bbccdd"
_ENDS = np.array([-1.0, 1.0])
# Size of a heliostat's picture, px.
_SIZE = (1180.0, 500.0)
# Length of the arrow for the RMS difference, in mirror widths.
_ARROW = 0.06
# Maximum number of facet labels side by side.
_MOST_LABELS = 6
#: Maximum numbers of heliostats drawn with arrows and with names on the map.
MOST_ARROWS, MOST_NAMES = 300, 40


def heliostat_drawing(name: str, o: Orientation, shape: MirrorShape) -> str:
    """Return the picture of one heliostat, as SVG.

    It shows the sampling points on the mirror, each with an arrow for the tilt of its normal
    relative to the expected normal. It also shows the differences about both axes: their
    distribution, by facet, and in the order of the photographs.
    """
    panels = [_points(o, shape), _distribution(o, 0), _distribution(o, 1), _facets(o), _order(o)]
    title = f"{name}: {o.count} reflections, {int(o.outlier.sum())} rejected, {o.distance:.0f} m"
    return drawing(panels, *_SIZE, title)


def field_map(orientations: Orientations, position: FloatArray, title: str = "") -> "Figure":
    """Return a map of the field with the deviations of the mirrors and their uncertainties.

    Parameters
    ----------
    orientations
        Orientations of the N heliostats.
    position
        ENU metres, (N, 3).
    title
        Title of the picture.
    """
    figure, axes = figure_of(1, 2, (13.0, 5.6))
    figure.suptitle(title)
    places = as_float(position)
    rows = np.array([o.heliostat for o in orientations.found], dtype=np.intp)
    values = (
        ("deviation, mrad", [1e3 * np.linalg.norm(o.correction) for o in orientations.found]),
        ("σ_tot (RMS of both), mrad", [1e3 * rms(o.sigma_total) for o in orientations.found]),
    )
    for ax, (label, shown) in zip(axes[0], values, strict=True):
        ax.plot(places[:, 0], places[:, 1], ".", color="#cccccc", ms=4, zorder=0)
        if len(rows):
            size = 40.0 if len(rows) < 200 else 8.0
            dots = ax.scatter(places[rows, 0], places[rows, 1], c=shown, s=size, cmap="cividis")
            figure.colorbar(dots, ax=ax, label=label)
        ax.set_aspect("equal", adjustable="datalim")
        # Room for arrows and names beyond the outermost heliostats.
        ax.margins(0.15)
        ax.set_xlabel("east, m")
        ax.set_ylabel("north, m")
        ax.grid(alpha=0.3)
    axes[0, 0].set_title("deviation of the orientation", fontsize=10)
    axes[0, 1].set_title("uncertainty of the orientation", fontsize=10)
    if 0 < len(rows) <= MOST_ARROWS:
        _leans(axes[0, 0], orientations, places[rows])
    if 0 < len(rows) <= MOST_NAMES:
        for row in rows:
            where = (float(places[row, 0]), float(places[row, 1]))
            axes[0, 1].annotate(
                orientations.names[row],
                where,
                xytext=(4, 4),
                textcoords="offset points",
                fontsize=7,
            )
    return figure


def rms(values: FloatArray) -> float:
    """Return the root mean square of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else float("nan")


def _leans(ax: "Axes", orientations: Orientations, places: FloatArray) -> None:
    """Draw the tilt of normals relative to the expected normals, as seen from above."""
    lean = 1e3 * np.array([_lean(o) for o in orientations.found])
    size = max(rms(np.linalg.norm(lean[:, :2], axis=-1)), 1e-6)
    span = max(float(np.ptp(places[:, :2], axis=0).max()), 10.0)
    arrows = ax.quiver(
        places[:, 0],
        places[:, 1],
        lean[:, 0],
        lean[:, 1],
        angles="xy",
        scale_units="xy",
        scale=size / (0.08 * span),
        width=3e-3,
        color=OUTLIER,
    )
    key = round_below(size)
    ax.quiverkey(arrows, 0.8, 1.03, key, f"{key:g} mrad", labelpos="E", coordinates="axes")


def _lean(o: Orientation) -> FloatArray:
    x, y = o.correction
    return as_float(y * o.rotation[:, 0] - x * o.rotation[:, 1])


def _tips(o: Orientation, rows: npt.NDArray[np.bool_]) -> list[str]:
    """Return the tooltip of each reflection."""
    reflections, d = o.reflections, 1e3 * o.difference
    return [
        f"photograph {reflections.photo[i]}, facet {reflections.facet[i]}: rotX {d[i, 0]:+.2f}, "
        f"rotY {d[i, 1]:+.2f} mrad"
        for i in np.flatnonzero(rows)
    ]


def _points(o: Orientation, shape: MirrorShape) -> Panel:
    reflections, good = o.reflections, ~o.outlier
    corners = shape.corners[..., :2]
    x = around(np.concatenate([corners[..., 0].ravel(), reflections.x]))
    y = around(np.concatenate([corners[..., 1].ravel(), reflections.y]))
    panel = Panel(
        56.0,
        60.0,
        440.0,
        390.0,
        x,
        y,
        "sampling points and tilt of the normals",
        "x, m (right, seen from the front)",
        "y, m",
    ).equal()
    for k, outline in enumerate(corners):
        panel.line(outline[:, 0], outline[:, 1], "#444", closed=True)
        left, low = outline.min(axis=0).tolist()
        panel.text(left, low, str(k) if len(shape) > 1 else "")
    # A rotation about x moves the normal towards −y, and a rotation about y towards x.
    lean = 1e3 * np.stack([o.difference[:, 1], -o.difference[:, 0]], axis=-1)
    size = rms(np.linalg.norm(lean[good], axis=-1))
    if size > 0.0:
        scale = _ARROW * panel.width / size
        for rows, colour in ((good, AFTER), (~good, OUTLIER)):
            panel.arrows(reflections.x[rows], reflections.y[rows], scale * lean[rows], colour)
        key = round_below(size)
        step = (panel.y[1] - panel.y[0]) / panel.height
        corner = (panel.x[0] + 10.0 * step, panel.y[1] - 20.0 * step)
        panel.arrows(*corner, [scale * key, 0.0], "#000")
        panel.text(*corner, f"{key:g} mrad")
    panel.dots(reflections.x[good], reflections.y[good], AFTER, _tips(o, good), size=1.8)
    panel.crosses(reflections.x[~good], reflections.y[~good], OUTLIER, _tips(o, ~good))
    return panel


def _distribution(o: Orientation, k: int) -> Panel:
    values, rejected = 1e3 * o.difference[~o.outlier, k], 1e3 * o.difference[o.outlier, k]
    count, title = len(values), _NAMES[k]
    panel = Panel(
        560.0,
        (60.0, 294.0)[k],
        270.0,
        156.0,
        around(1e3 * o.difference[:, k]),
        (0.0, 1.0),
        title,
        f"difference in {_NAMES[k]}, mrad (× rejected)",
        "points",
    )
    if count > 1 and (spread := float(values.std(ddof=1))) > 0.0:
        mean = float(values.mean())
        heights, edges = np.histogram(values, bins=max(5, int(np.sqrt(count)) + 1))
        line = mean + np.linspace(-3.5 * spread, 3.5 * spread, 80)
        width = float(edges[1] - edges[0])
        height = np.exp(-0.5 * ((line - mean) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
        panel.y = (0.0, 1.1 * max(float(heights.max()), count * width * float(height.max())))
        panel.x = around(np.concatenate([values, rejected, mean + 3.0 * spread * _ENDS]), 0.03)
        panel.bars(edges, heights, _BAR)
        panel.line(line, count * width * height, AFTER)
        p = float(o.normality[k])
        panel.title += f": σ = {spread:.2f} mrad; Shapiro and Wilk p = {p:.2g}"
    panel.crosses(rejected, np.full(len(rejected), 0.04 * panel.y[1]), OUTLIER, _tips(o, o.outlier))
    return panel


def _facets(o: Orientation) -> Panel:
    means, errors = (
        1e3 * np.array([getattr(f, what) for f in o.facets]) for what in ("mean", "sigma")
    )
    reach = np.where(np.isfinite(errors), errors, 0.0)
    # Draw as many labels as fit.
    every = 1 + (len(o.facets) - 1) // _MOST_LABELS
    labels = tuple("" if f.facet % every else f"{f.facet}: {f.count}" for f in o.facets)
    panel = Panel(
        890.0,
        60.0,
        270.0,
        156.0,
        (-0.6, len(o.facets) - 0.4),
        around(np.concatenate([means - reach, means + reach, np.zeros((1, 2))])),
        "mean of each facet (● rotX, ○ rotY), mrad",
        "facet: points",
        labels=labels,
    )
    panel.line(panel.x, (0.0, 0.0), "#888", width=0.6)
    for k, colour in enumerate(_COLOURS):
        place = np.arange(len(o.facets)) + 0.12 * (2 * k - 1)
        known = np.flatnonzero(np.isfinite(means[:, k]))
        for i in known:
            ends = means[i, k] + reach[i, k] * _ENDS
            panel.line(np.full(2, place[i]), ends, colour)
        panel.dots(place[known], means[known, k], colour, size=3.5, hollow=k == 1)
    return panel


def _order(o: Orientation) -> Panel:
    good, photo = ~o.outlier, o.reflections.photo.astype(np.float64)
    panel = Panel(
        890.0,
        294.0,
        270.0,
        156.0,
        around(photo),
        around(1e3 * o.difference[good]),
        "in the order of the photographs, mrad",
        "photograph",
    )
    panel.line(panel.x, (0.0, 0.0), "#888", width=0.6)
    for k, colour in enumerate(_COLOURS):
        panel.dots(photo[good], 1e3 * o.difference[good, k], colour, _tips(o, good), hollow=k == 1)
    return panel
