"""Figures 9 to 13 of HelioPoint: one heliostat with both surfaces, and its slope map."""

from typing import TYPE_CHECKING

import numpy as np

from heliotrope.airborne.evaluate.orientation import Orientation
from heliotrope.airborne.evaluate.reference import Compared
from heliotrope.airborne.mirror import MirrorShape
from heliotrope.calibration.report.pictures import AFTER, OUTLIER, TESTED, figure_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_COLOURS = (AFTER, TESTED)


def sampling_figure(compared: Compared) -> "Figure":
    """Return the picture of one heliostat.

    The top row shows the angular differences about x (left) and y (right) with the ideal surface,
    and the middle row with the measured surface. The bottom row shows the measured slope deviations
    SDy and SDx in mrad, with the sampling points; SDy corresponds to rotations about x. If there is
    no slope map, the middle row says so, and the bottom row shows only the sampling points.
    """
    figure, axes = figure_of(3, 2, (9.0, 10.5))
    figure.suptitle(compared.label)
    for row, (words, orientation) in enumerate(
        (("ideal surface", compared.ideal), ("measured surface", compared.measured))
    ):
        for axis in (0, 1):
            _distribution(axes[row, axis], orientation, axis, words)
    shown = compared.measured or compared.ideal
    for k, axis in enumerate((1, 0)):
        _slopes(figure, axes[2, k], compared.shape, shown, axis)
    return figure


def _distribution(ax: "Axes", orientation: Orientation | None, axis: int, words: str) -> None:
    name = ("rotX", "rotY")[axis]
    ax.set_title(f"{name}, {words}", fontsize=10)
    if orientation is None:
        ax.text(0.5, 0.5, "no slope map", ha="center", transform=ax.transAxes)
        ax.set_axis_off()
        return
    kept = 1e3 * orientation.difference[~orientation.outlier, axis]
    ax.hist(kept, bins=max(5, round(np.sqrt(len(kept)))), color=_COLOURS[axis])
    for value in 1e3 * orientation.difference[orientation.outlier, axis]:
        ax.axvline(value, color=OUTLIER, lw=1.0, ls=":")
    sigma, p = 1e3 * orientation.sigma_plain[axis], orientation.normality[axis]
    ax.set_xlabel(f"difference, mrad; σ/√n {sigma:.2f}, p {p:.2f}")
    ax.set_ylabel("reflections")
    ax.grid(alpha=0.3)


def _slopes(
    figure: "Figure", ax: "Axes", shape: MirrorShape, orientation: Orientation | None, axis: int
) -> None:
    """Draw the slope deviations along one axis on the facets, seen from the front."""
    ax.set_aspect("equal")
    ax.set_xlabel("x, m")
    ax.set_ylabel("y, m")
    ax.set_title(f"SD{'xy'[axis]} (rot{'YX'[axis]}), mrad", fontsize=10)
    if shape.slope is not None:
        values = 1e3 * shape.slope[..., axis]
        most = float(np.quantile(np.abs(values), 0.99)) or 1.0
        high, wide = values.shape[1:]
        v, u = np.meshgrid(
            np.linspace(-1.0, 1.0, high + 1), np.linspace(-1.0, 1.0, wide + 1), indexing="ij"
        )
        for k, facet in enumerate(values):
            corner = (
                shape.center[k]
                + u[..., None] * shape.half_width[k]
                + v[..., None] * shape.half_height[k]
            )
            drawn = ax.pcolormesh(
                corner[..., 0], corner[..., 1], facet, cmap="RdBu", vmin=-most, vmax=most
            )
        figure.colorbar(drawn, ax=ax)
    if orientation is not None:
        point = shape.point_at(orientation.reflections.facet, orientation.reflections.xy)
        for rows, colour in ((~orientation.outlier, "black"), (orientation.outlier, OUTLIER)):
            ax.plot(point[rows, 0], point[rows, 1], "*", color=colour, ms=5, ls="none")
    ax.autoscale_view()
