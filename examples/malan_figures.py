"""Redraw figures 4.6 to 4.9 of Malan's thesis: ``python malan_figures.py FOLDER``.

Figures 4.6 to 4.9 show the path of a heliostat's beam on the plane of the aim over a day with a
single error of one unit: the pedestal leans, an encoder's zero is off, the axes are not
perpendicular, the survey is wrong. Positions, dates and sizes that the thesis does not give are
ours.
"""

import sys
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from heliotrope import sun
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import direct
from heliotrope.optics import image_offsets

SITE = sun.Site(-33.93, 18.87, 120.0)
AIM = np.array([0.0, 0.0, 13.0])
PLACES = {
    "50 m south": (0, -50, 1),
    "50 m east": (50, 0, 1),
    "50 m west": (-50, 0, 1),
    "50 m north": (0, 50, 1),
}
DAYS = {
    "equinox": (date(2026, 3, 20), "#0072b2"),
    "December": (date(2026, 12, 21), "#d55e00"),
    "June": (date(2026, 6, 21), "#009e73"),
}
FIGURES = {
    "4.6": ("pedestal tilt of 1 mrad", {"tilt_north": 1e-3}, {"tilt_east": 1e-3}),
    "4.7": ("zero of an axis off by 1 mrad", {"azimuth_bias": 1e-3}, {"elevation_bias": 1e-3}),
    "4.8": (
        "axes not perpendicular by 1 mrad",
        {"non_orthogonality": 1e-3},
        {"non_orthogonality": -1e-3},
    ),
    "4.9": ("survey wrong by 50 mm", {"position_east": 0.05}, {"position_north": 0.05}),
}


def _figure(columns: int, rows: int, size: tuple[float, float]) -> tuple[Figure, np.ndarray]:
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _path(place: tuple[float, ...], error: dict[str, float], day: date) -> np.ndarray:
    times = sun.daylight(day, SITE, every=timedelta(minutes=10), min_elevation=0.1)
    upright = direct(min_angle=-0.1, max_angle=1.65)
    nominal = kinds.azimuth_elevation(place, drives=(direct(), upright))
    found = image_offsets(nominal, nominal.with_parameters(error), sun.vector(times, SITE), AIM)
    return np.column_stack([found.right, found.up, [t.hour + t.minute / 60 for t in times]])


def paths(number: str) -> Figure:
    """Return one of figures 4.6 to 4.9: image paths for two errors at four places."""
    title, *errors = FIGURES[number]
    figure, axes = _figure(len(PLACES), len(errors), (3.1 * len(PLACES), 3.3 * len(errors)))
    figure.suptitle(f"Figure {number}: {title}; path of the image over a day")
    for row, error in enumerate(errors):
        for column, (name, place) in enumerate(PLACES.items()):
            ax = axes[row, column]
            for label, (day, colour) in DAYS.items():
                x, y, hour = _path(place, error, day).T
                ax.plot(1e3 * x, 1e3 * y, color=colour, label=label)
                whole = np.isclose(hour % 2, 0)
                ax.plot(1e3 * x[whole], 1e3 * y[whole], ".", color=colour, ms=5)
                ax.plot(1e3 * x[:1], 1e3 * y[:1], "o", color=colour, ms=5, mfc="white")
            (parameter, value), *_ = error.items()
            ax.set_title(
                f"{name}\n{parameter} {value * 1e3:+g} "
                f"{'mm' if 'position' in parameter else 'mrad'}",
                fontsize=9,
            )
            ax.plot(0, 0, "k+", ms=10)
            ax.set_aspect("equal", adjustable="datalim")
            ax.margins(0.15)
            ax.grid(alpha=0.3)
            if row == len(errors) - 1:
                ax.set_xlabel("right of the aim, mm")
            if column == 0:
                ax.set_ylabel("above the aim, mm")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles,
        [f"{x} (circle: first, dots: every 2 h UTC)" if x == "equinox" else x for x in labels],
        loc="outside lower center",
        ncols=3,
        frameon=False,
    )
    return figure


def main(folder: str | Path) -> list[Path]:
    """Write the figures into a folder; return their paths."""
    place = Path(folder)
    place.mkdir(parents=True, exist_ok=True)
    made = {number: paths(number) for number in FIGURES}
    written = []
    for number, figure in made.items():
        path = place / f"figure-{number.replace('.', '-')}.png"
        figure.savefig(path, dpi=110)
        written.append(path)
    return written


if __name__ == "__main__":
    for path in main(sys.argv[1] if len(sys.argv) > 1 else "out/malan"):
        print(path)
