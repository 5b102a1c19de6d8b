"""Pictures of a flight's orientations: one heliostat's points and differences, and the field."""

from typing import TYPE_CHECKING

import numpy as np

from heliotrope.airborne.mirror import MirrorShape
from heliotrope.airborne.orientation import Orientation, Orientations
from heliotrope.calibration.pictures import AFTER, BEFORE, OUTLIER, figure_of
from heliotrope.geometry import FloatArray, as_float

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAMES = ("rotX", "rotY")
# Left, bottom, width and height of the axes of a heliostat's picture. They are given, because to
# let the layout be found takes as long as the drawing.
_PLACES = (
    (0.045, 0.11, 0.36, 0.74), (0.455, 0.60, 0.24, 0.28), (0.455, 0.11, 0.24, 0.28),
    (0.755, 0.60, 0.235, 0.28), (0.755, 0.11, 0.235, 0.28),
)  # fmt: skip
_SIZE = (13.0, 5.6)
# Half widths of the mirror that the RMS of the differences is drawn as.
_ARROW = 0.12


def heliostat_figure(name: str, o: Orientation, shape: MirrorShape) -> "Figure":
    """Return the picture of one heliostat.

    Sampling points on the mirror with an arrow each (where the normal leans to, from the one
    expected), the differences about both axes with their distribution, by facet, and in the
    order of the photographs.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE)
    FigureCanvasAgg(figure)
    axes = [figure.add_axes(place) for place in _PLACES]
    figure.suptitle(
        f"{name}: {o.count} reflections, {int(o.outlier.sum())} rejected, {o.distance:.0f} m",
        fontsize=11,
    )
    _points(axes[0], o, shape)
    for k, ax in enumerate(axes[1:3]):
        _distribution(ax, o, k)
    _facets(axes[3], o)
    _order(axes[4], o)
    return figure


def field_map(found: Orientations, position: FloatArray, title: str = "") -> "Figure":
    """Return the field: where mirrors stand turned to, and how well that is known.

    Parameters
    ----------
    found
        Of the N heliostats.
    position
        ENU metres, (N, 3).
    title
        Of the picture.
    """
    figure, axes = figure_of(1, 2, (13.0, 5.6))
    figure.suptitle(title)
    places = as_float(position)
    rows = np.array([o.heliostat for o in found.found], dtype=np.intp)
    values = (
        ("deviation, mrad", [1e3 * np.linalg.norm(o.correction) for o in found.found]),
        ("σ_tot (RMS of both), mrad", [1e3 * rms(o.sigma_total) for o in found.found]),
    )
    for ax, (label, shown) in zip(axes[0], values, strict=True):
        ax.plot(places[:, 0], places[:, 1], ".", color="#cccccc", ms=4)
        if len(rows):
            size = 40.0 if len(rows) < 200 else 8.0
            dots = ax.scatter(places[rows, 0], places[rows, 1], c=shown, s=size, cmap="cividis")
            figure.colorbar(dots, ax=ax, label=label)
        ax.set_aspect("equal", adjustable="datalim")
        # Arrows and names reach beyond the outermost heliostats.
        ax.margins(0.15)
        ax.set_xlabel("east, m")
        ax.set_ylabel("north, m")
        ax.grid(alpha=0.3)
    axes[0, 0].set_title("deviation of the orientation", fontsize=10)
    axes[0, 1].set_title("how well it is known", fontsize=10)
    if 0 < len(rows) <= 300:
        _leans(axes[0, 0], found, places[rows])
    if 0 < len(rows) <= 40:
        for row in rows:
            where = (float(places[row, 0]), float(places[row, 1]))
            axes[0, 1].annotate(
                found.names[row], where, xytext=(4, 4), textcoords="offset points", fontsize=7
            )
    return figure


def rms(values: FloatArray) -> float:
    """Return the root of the mean square of finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else float("nan")


def _leans(ax: "Axes", found: Orientations, places: FloatArray) -> None:
    """Draw where normals lean to, from where they were expected, as seen from above."""
    lean = 1e3 * np.array([_lean(o) for o in found.found])
    size = max(rms(np.linalg.norm(lean[:, :2], axis=-1)), 1e-6)
    span = max(float(np.ptp(places[:, :2], axis=0).max()), 10.0)
    arrows = ax.quiver(
        places[:, 0], places[:, 1], lean[:, 0], lean[:, 1], angles="xy", scale_units="xy",
        scale=size / (0.08 * span), width=3e-3, color=OUTLIER,
    )  # fmt: skip
    key = _round(size)
    ax.quiverkey(arrows, 0.8, 1.03, key, f"{key:g} mrad", labelpos="E", coordinates="axes")


def _round(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above ``value``."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1.0, 2.0, 5.0) if step * power <= 1.000001 * value))


def _lean(o: Orientation) -> FloatArray:
    x, y = o.correction
    return as_float(y * o.rotation[:, 0] - x * o.rotation[:, 1])


def _points(ax: "Axes", o: Orientation, shape: MirrorShape) -> None:
    for k, corners in enumerate(shape.corners):
        closed = np.concatenate([corners, corners[:1]])
        ax.plot(closed[:, 0], closed[:, 1], color="k", lw=0.8)
        if len(shape) > 1:
            left, low = corners[:, :2].min(axis=0)
            ax.annotate(
                str(k), (left, low), xytext=(4, 4), textcoords="offset points", color=BEFORE
            )
    good = ~o.outlier
    # A turn about x moves the normal towards −y, one about y towards x.
    lean = 1e3 * np.stack([o.difference[:, 1], -o.difference[:, 0]], axis=-1)
    size = rms(np.linalg.norm(lean[good], axis=-1))
    if np.isfinite(size) and size > 0.0:
        length = _ARROW * 0.5 * float(np.ptp(shape.corners[..., 0]))
        for rows, colour in ((good, AFTER), (~good, OUTLIER)):
            arrows = ax.quiver(
                o.reflections.x[rows], o.reflections.y[rows], lean[rows, 0], lean[rows, 1],
                angles="xy", scale_units="xy", scale=size / length, width=3e-3, color=colour,
            )  # fmt: skip
            if rows is good:
                key = _round(size)
                ax.quiverkey(
                    arrows, 0.82, 1.04, key, f"{key:g} mrad", labelpos="E", coordinates="axes"
                )
    ax.plot(o.reflections.x[good], o.reflections.y[good], ".", color=AFTER, ms=4)
    ax.plot(o.reflections.x[~good], o.reflections.y[~good], "x", color=OUTLIER, ms=6)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title("points, and where normals lean to", fontsize=10, loc="left")
    ax.set_xlabel("x, m (right, seen from the front)", fontsize=9)
    ax.set_ylabel("y, m", fontsize=9, labelpad=0)
    _quiet(ax)


def _facets(ax: "Axes", o: Orientation) -> None:
    rows = np.arange(len(o.facets))
    for k, (colour, shift) in enumerate(((AFTER, -0.12), (OUTLIER, 0.12))):
        mean = 1e3 * np.array([f.mean[k] for f in o.facets])
        error = 1e3 * np.array([f.sigma[k] for f in o.facets])
        ax.errorbar(
            rows + shift, mean, yerr=error, fmt="o", color=colour, capsize=2, ms=4, label=_NAMES[k]
        )
    ax.axhline(0, color="k", lw=0.5)
    ax.set_xticks(rows, [f"{f.facet}: {f.count}" for f in o.facets])
    ax.set_xlim(-0.6, len(rows) - 0.4)
    ax.set_title("mean of each facet (facet: points), mrad", fontsize=10, loc="left")
    ax.legend(frameon=False, fontsize=8, ncols=2, loc="best")
    _quiet(ax, across=False)


def _distribution(ax: "Axes", o: Orientation, k: int) -> None:
    values, rejected = 1e3 * o.difference[~o.outlier, k], 1e3 * o.difference[o.outlier, k]
    count = len(values)
    title = _NAMES[k]
    if count > 1 and (spread := float(values.std(ddof=1))) > 0.0:
        mean = float(values.mean())
        bins = max(5, int(np.sqrt(count)) + 1)
        _, edges, _ = ax.hist(values, bins=bins, color="#bbccdd")
        line = mean + np.linspace(-3.5 * spread, 3.5 * spread, 100)
        width = float(edges[1] - edges[0])
        height = np.exp(-0.5 * ((line - mean) / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
        ax.plot(line, count * width * height, color=AFTER)
        title += f": σ = {spread:.2f} mrad; Shapiro and Wilk p = {float(o.normality[k]):.2g}"
    ax.plot(rejected, np.zeros(len(rejected)), "x", color=OUTLIER, ms=7, clip_on=False)
    ax.set_title(title, fontsize=10, loc="left")
    ax.set_xlabel(f"difference in {_NAMES[k]}, mrad (× rejected)", fontsize=9)
    ax.set_ylabel("points", fontsize=9, labelpad=0)
    _quiet(ax)


def _order(ax: "Axes", o: Orientation) -> None:
    good = ~o.outlier
    for k, (colour, marker) in enumerate(((AFTER, "."), (OUTLIER, "^"))):
        ax.plot(
            o.reflections.photo[good], 1e3 * o.difference[good, k], marker, color=colour, ms=4,
            label=_NAMES[k],
        )  # fmt: skip
    ax.axhline(0, color="k", lw=0.5)
    ax.set_title("in the order of the photographs, mrad", fontsize=10, loc="left")
    ax.set_xlabel("photograph", fontsize=9)
    _quiet(ax)


def _quiet(ax: "Axes", across: bool = True) -> None:
    """Draw few and small ticks: most of a picture's time goes into them."""
    from matplotlib.ticker import MaxNLocator

    if across:
        ax.xaxis.set_major_locator(MaxNLocator(5))
    ax.yaxis.set_major_locator(MaxNLocator(5))
    ax.tick_params(labelsize=8)
