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


def heliostat_figure(name: str, o: Orientation, shape: MirrorShape) -> "Figure":
    """Return the picture of one heliostat: points on the mirror, differences, facets."""
    figure, axes = figure_of(2, 3, (13.0, 7.2))
    figure.suptitle(
        f"{name}: {o.count} reflections, {int(o.outlier.sum())} outliers, {o.distance:.0f} m"
    )
    _points(axes[0, 0], o, shape)
    _scatter(axes[0, 1], o)
    _facets(axes[0, 2], o)
    for k, ax in enumerate(axes[1, :2]):
        _distribution(ax, 1e3 * o.difference[~o.outlier, k], _NAMES[k], float(o.normality[k]))
    _order(axes[1, 2], o)
    return figure


def field_map(found: Orientations, position: FloatArray) -> "Figure":
    """Return the field: where mirrors stand turned to, and how well that is known.

    Parameters
    ----------
    found
        Of the N heliostats.
    position
        ENU metres, (N, 3).
    """
    figure, axes = figure_of(1, 2, (13.0, 5.6))
    places = as_float(position)
    rows = np.array([o.heliostat for o in found.found], dtype=np.intp)
    values = (
        ("correction, mrad", [1e3 * np.linalg.norm(o.correction) for o in found.found]),
        ("σ_tot (RMS of both), mrad", [1e3 * _rms(o.sigma_total) for o in found.found]),
    )
    for ax, (label, shown) in zip(axes[0], values, strict=True):
        ax.plot(places[:, 0], places[:, 1], ".", color="#cccccc", ms=4)
        if len(rows):
            size = 40.0 if len(rows) < 200 else 8.0
            dots = ax.scatter(places[rows, 0], places[rows, 1], c=shown, s=size, cmap="cividis")
            figure.colorbar(dots, ax=ax, label=label)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("east, m")
        ax.set_ylabel("north, m")
        ax.grid(alpha=0.3)
    if 0 < len(rows) <= 300:
        # Where the normal leans to in ENU, from the expected one.
        lean = np.array([_lean(o) for o in found.found])
        axes[0, 0].quiver(
            places[rows, 0], places[rows, 1], lean[:, 0], lean[:, 1], angles="xy", width=3e-3,
            color="#d55e00",
        )  # fmt: skip
        axes[0, 0].set_title("arrows: where normals lean to, from above", fontsize=10)
    return figure


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _lean(o: Orientation) -> FloatArray:
    x, y = o.correction
    return as_float(y * o.rotation[:, 0] - x * o.rotation[:, 1])


def _points(ax: "Axes", o: Orientation, shape: MirrorShape) -> None:
    for corners in shape.corners:
        closed = np.concatenate([corners, corners[:1]])
        ax.plot(closed[:, 0], closed[:, 1], color="k", lw=0.8)
    good = ~o.outlier
    size = 1e3 * np.linalg.norm(o.difference, axis=-1)
    dots = ax.scatter(
        o.reflections.x[good], o.reflections.y[good], c=size[good], s=22, cmap="cividis"
    )
    ax.figure.colorbar(dots, ax=ax, label="difference, mrad")
    ax.plot(o.reflections.x[~good], o.reflections.y[~good], "x", color=OUTLIER, label="outliers")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title("sampling points, seen from the front", fontsize=10)
    ax.set_xlabel("x, m")
    ax.set_ylabel("y, m")


def _scatter(ax: "Axes", o: Orientation) -> None:
    shown = 1e3 * o.difference
    good = ~o.outlier
    ax.plot(shown[good, 0], shown[good, 1], ".", color=AFTER)
    ax.plot(shown[~good, 0], shown[~good, 1], "x", color=OUTLIER)
    turn = np.linspace(0.0, 2.0 * np.pi, 100)
    ax.plot(
        1e3 * o.sigma[0] * np.cos(turn), 1e3 * o.sigma[1] * np.sin(turn), color=BEFORE, label="σ"
    )
    ax.axhline(0, color="k", lw=0.5)
    ax.axvline(0, color="k", lw=0.5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title("measured less expected normal", fontsize=10)
    ax.set_xlabel("rotX, mrad")
    ax.set_ylabel("rotY, mrad")
    ax.legend(frameon=False, fontsize=8)


def _facets(ax: "Axes", o: Orientation) -> None:
    rows = np.arange(len(o.facets))
    for k, (colour, shift) in enumerate(((AFTER, -0.12), (OUTLIER, 0.12))):
        mean = 1e3 * np.array([f.mean[k] for f in o.facets])
        error = 1e3 * np.array([f.sigma[k] for f in o.facets])
        ax.errorbar(
            rows + shift, mean, yerr=error, fmt="o", color=colour, capsize=2, label=_NAMES[k]
        )
    ax.axhline(0, color="k", lw=0.5)
    ax.set_xticks(rows, [f"{f.facet}\n({f.count})" for f in o.facets])
    ax.set_xlabel("facet (points)")
    ax.set_ylabel("mean difference, mrad")
    ax.set_title("canting of the facets", fontsize=10)
    ax.legend(frameon=False, fontsize=8)


def _distribution(ax: "Axes", values: FloatArray, name: str, p: float) -> None:
    count = len(values)
    if count:
        ax.hist(values, bins=max(5, int(np.sqrt(count)) + 1), density=True, color="#bbccdd")
    if count > 1 and (spread := float(values.std(ddof=1))) > 0.0:
        line = np.linspace(-3.5 * spread, 3.5 * spread, 200)
        height = np.exp(-0.5 * (line / spread) ** 2) / (spread * np.sqrt(2.0 * np.pi))
        ax.plot(line, height, color=AFTER, label=f"normal, σ = {spread:.2f} mrad")
        ax.legend(frameon=False, fontsize=8)
    ax.set_title(f"{name}; Shapiro and Wilk p = {p:.2g}", fontsize=10)
    ax.set_xlabel(f"difference in {name}, mrad")
    ax.set_ylabel("density, 1/mrad")


def _order(ax: "Axes", o: Orientation) -> None:
    good = ~o.outlier
    for k, (colour, marker) in enumerate(((AFTER, "."), (OUTLIER, "^"))):
        ax.plot(
            o.reflections.photo[good], 1e3 * o.difference[good, k], marker, color=colour, ms=4,
            label=_NAMES[k],
        )  # fmt: skip
    ax.axhline(0, color="k", lw=0.5)
    ax.set_title("in the order of the photographs", fontsize=10)
    ax.set_xlabel("photograph")
    ax.set_ylabel("difference, mrad")
    ax.legend(frameon=False, fontsize=8)
