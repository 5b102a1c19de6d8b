"""HelioPoint's figure 8: relative errors of RTK positions along x, y, z."""

import numpy as np

from heliotrope.airborne.evaluate.drawing import Panel, around, drawing
from heliotrope.airborne.evaluate.rtk import RtkCheck

_BAR, _CURVE = "#9cc3e6", "#c0392b"
_WIDTH, _HEIGHT, _STEP = 250.0, 210.0, 320.0


def rtk_drawing(check: RtkCheck) -> str:
    """Return histograms, as SVG, of RTK minus photogrammetry about the mean for each axis.

    The curve is a normal distribution with the standard deviation of the differences; the title
    states the standard deviation of RTK alone.
    """
    gap = 1e3 * (check.difference - check.difference.mean(axis=0))
    low, high = around(gap)
    edges = np.linspace(low, high, max(6, round(np.sqrt(2 * len(gap)))) + 1)
    counts = [np.histogram(gap[:, k], edges)[0] for k in range(3)]
    most = 1.15 * max(int(c.max()) for c in counts)
    fine = np.linspace(low, high, 121)
    panels = []
    for k, axis in enumerate(("x (east)", "y (north)", "z (up)")):
        panel = Panel(
            60.0 + k * _STEP,
            60.0,
            _WIDTH,
            _HEIGHT,
            (low, high),
            (0.0, most),
            title=f"{axis}: RTK's σ {1e3 * check.rtk[k]:.1f} mm",
            across="RTK minus photogrammetry, mm",
            up="photographs" if k == 0 else "",
        )
        panel.bars(edges, counts[k], _BAR)
        sigma = max(1e3 * float(check.sigma[k]), 1e-6)
        area = len(gap) * (edges[1] - edges[0]) / (sigma * np.sqrt(2.0 * np.pi))
        panel.line(fine, area * np.exp(-0.5 * (fine / sigma) ** 2), _CURVE)
        panels.append(panel)
    title = f"Relative errors of RTK positions, {len(gap)} photographs"
    return drawing(panels, 60.0 + 3 * _STEP, 330.0, title)
