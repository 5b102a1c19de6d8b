"""Redraw figures 4.6 to 4.9 of Malan's thesis: ``python malan_figures.py FOLDER``.

Each shows the path of a heliostat's image on the plane of the aim over a day, in mrad of the beam.
From the thesis: the two places (up, east, north) = (1, 0, -50) and (1, 30.8, -19.2) m as its
section 4.3 prints them (its section 6.3 has the latter two the other way round), the target 13 m
up, and the errors A to D. The day of figures 4.6 to 4.8 and the set of errors of figure 4.9 are not
given: the day of his measurements and the set of his table 6.1 stand for them.
"""

import functools
import sys
from dataclasses import dataclass
from datetime import date, timedelta
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from heliotrope import sun
from heliotrope.geometry import FloatArray
from heliotrope.mechanism import kinds
from heliotrope.mechanism.drives import direct
from heliotrope.optics import image_offsets

SITE = sun.Site(-33.93, 18.87, 120.0, name="Stellenbosch")
AIM = np.array([0.0, 0.0, 13.0])
#: East, north, up, m.
PLACES = {"south": (0.0, -50.0, 1.0), "southeast": (30.8, -19.2, 1.0)}
DAY = date(2012, 9, 2)
SEASONS = {
    "winter solstice": date(2012, 6, 21),
    "equinox": date(2012, 9, 22),
    "summer solstice": date(2012, 12, 21),
}
MRAD = 1e-3
#: Table 6.1, in our parameters.
TABLE_6_1 = {
    "position_up": 0.11, "position_east": 1.02, "position_north": -0.53,
    "tilt_north": -13.27 * MRAD, "tilt_east": -4.56 * MRAD, "non_orthogonality": -1.92 * MRAD,
    "azimuth_bias": -3.79 * MRAD, "elevation_bias": 1.12 * MRAD,
}  # fmt: skip
#: Title, and errors by the letter in the figure.
FIGURES = {
    "4.6": ("pedestal tilt of 1 mrad to the north (A), south (B), west (C), east (D)", {
        "A": {"tilt_north": MRAD}, "B": {"tilt_north": -MRAD},
        "C": {"tilt_east": -MRAD}, "D": {"tilt_east": MRAD},
    }),
    "4.7": ("elevation bias of 1 (A) and -1 mrad (B), azimuth bias of 1 (C) and -1 mrad (D)", {
        "A": {"elevation_bias": MRAD}, "B": {"elevation_bias": -MRAD},
        "C": {"azimuth_bias": MRAD}, "D": {"azimuth_bias": -MRAD},
    }),
    "4.8": ("axes out of square by -1 (A) and 1 mrad (B)", {
        "A": {"non_orthogonality": -MRAD}, "B": {"non_orthogonality": MRAD},
    }),
}  # fmt: skip
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


@dataclass(frozen=True)
class ImagePath:
    """Path of the image over a day: right of and above the aim, mrad of the beam, (M,)."""

    right: FloatArray
    up: FloatArray

    @property
    def rms(self) -> float:
        """RMS distance from the aim, mrad."""
        return float(np.sqrt(np.mean(self.right**2 + self.up**2)))


def path(place: str, error: dict[str, float], day: date = DAY) -> ImagePath:
    """Return the path of the image of a heliostat with errors, every ten minutes of a day."""
    times = sun.daylight(day, SITE, every=timedelta(minutes=10), min_elevation=0.1)
    drives = (direct(), direct(min_angle=-0.1, max_angle=1.65))
    nominal = kinds.azimuth_elevation(PLACES[place], drives=drives)
    found = image_offsets(nominal, nominal.with_parameters(error), sun.vector(times, SITE), AIM)
    slant = float(np.linalg.norm(AIM - np.array(PLACES[place])))
    return ImagePath(1e3 * found.right / slant, 1e3 * found.up / slant)


@functools.cache
def paths(number: str) -> dict[tuple[str, str], ImagePath]:
    """Return the paths of a figure by place and letter; of figure 4.9 by place and season."""
    if number == "4.9":
        return {("southeast", s): path("southeast", TABLE_6_1, d) for s, d in SEASONS.items()}
    _, errors = FIGURES[number]
    return {(place, letter): path(place, e) for place in PLACES for letter, e in errors.items()}


def draw(number: str) -> Figure:
    """Return a figure."""
    found = paths(number)
    places = list(dict.fromkeys(place for place, _ in found))
    title = "errors of table 6.1 over the seasons" if number == "4.9" else FIGURES[number][0]
    figure = Figure(figsize=(4.6 * len(places), 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(f"Figure {number}: {title}", fontsize=9)
    for ax, place in zip(figure.subplots(1, len(places), squeeze=False)[0], places, strict=True):
        ours = [(label, p) for (where, label), p in found.items() if where == place]
        for (label, p), colour in zip(ours, COLOURS, strict=False):
            ax.plot(p.right, p.up, color=colour, label=label)
            ax.plot(p.right[:1], p.up[:1], "o", color=colour, ms=5, mfc="white")
        ax.plot(0, 0, "k+", ms=10)
        ax.set_title(f"heliostat in the {place}", fontsize=9)
        ax.set_xlabel("right of the aim, mrad")
        ax.set_ylabel("above the aim, mrad")
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.3)
        ax.legend(frameon=False, fontsize=8)
    return figure


def main(folder: str | Path) -> list[Path]:
    """Write the figures into a folder, print the paths' RMS; return the files."""
    where = Path(folder)
    where.mkdir(parents=True, exist_ok=True)
    written = []
    for number in (*FIGURES, "4.9"):
        file = where / f"figure-{number.replace('.', '-')}.png"
        draw(number).savefig(file, dpi=110)
        written.append(file)
        for (place, label), p in paths(number).items():
            print(f"figure {number}, {place:9} {label:16} {p.rms:6.2f} mrad RMS of the beam")
    return written


if __name__ == "__main__":
    for file in main(sys.argv[1] if len(sys.argv) > 1 else "out/malan"):
        print(file)
