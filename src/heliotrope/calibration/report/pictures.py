"""Plots of a calibration: the field, all heliostats, and one heliostat in detail."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope import plot
from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.report.content import CalibrationReport
from heliotrope.calibration.uncertainty import year_map
from heliotrope.geometry import azimuth_elevation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Okabe and Ito's grey, blue, orange and vermilion, which colour-blind readers can distinguish.
BEFORE, AFTER, TESTED, OUTLIER = "#999999", "#0072b2", "#e69f00", "#d55e00"
#: Width and height of the picture of one heliostat, inches.
SIZE = (13.0, 11.0)
REGIMES = ("#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#f0e442")


def figure_of(
    rows: int, columns: int, size: tuple[float, float], *, fitted: bool = True
) -> tuple["Figure", Any]:
    """Return a figure that needs no display, and its axes; ``fitted`` makes room for labels."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained" if fitted else None)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def overview(result: CalibrationReport) -> "Figure":
    """Return a picture of all heliostats: median beam error before, after and held out."""
    rows = result.rows
    figure, axes = figure_of(1, 1, (min(24.0, max(6.0, 0.32 * len(rows) + 2.0)), 4.2))
    ax: Axes = axes[0, 0]
    place = np.arange(len(rows))
    for values, label, colour, marker in (
        ([r.before.median for r in rows], "before", BEFORE, "o"),
        ([r.after.median for r in rows], "after, each predicted from the others", AFTER, "s"),
        ([r.held.median for r in rows], "after, held out", TESTED, "D"),
    ):
        if np.isfinite(values).any():
            ax.plot(place, 1e3 * np.array(values), marker, color=colour, label=label, ms=5)
    if rows:
        ax.set_yscale("log")
        ax.set_ylim(bottom=max(0.01, 0.7 * ax.get_ylim()[0]))
    if len(rows) <= 80:
        ax.set_xticks(place, [r.name for r in rows], rotation=90)
    ax.set_ylabel("median beam error, mrad")
    ax.grid(axis="y", alpha=0.3)
    ax.legend(frameon=False, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def field_map(result: CalibrationReport) -> "Figure":
    """Return a map of the field coloured by the median beam error after calibration."""
    figure, axes = figure_of(1, 1, (7.0, 5.5))
    ax: Axes = axes[0, 0]
    places = result.learned.mechanism.position
    errors = dict.fromkeys(result.names, np.nan)
    errors.update({r.name: r.after.median for r in result.rows})
    values = 1e3 * np.array([errors[n] for n in result.names])
    plot.field_map(
        places,
        values,
        label="median beam error after, mrad",
        names=result.names,
        targets=result.targets,
        ax=ax,
    )
    return figure


def heliostat_figure(result: CalibrationReport, i: int) -> "Figure":
    """Return a picture of one heliostat: target, residuals, parameters, the year."""
    # Panel positions are fixed. To fit them to the labels, matplotlib would draw a picture twice
    # more, which took two thirds of the time of a report.
    figure, axes = figure_of(3, 3, SIZE, fitted=False)
    figure.subplots_adjust(0.055, 0.045, 0.985, 0.93, wspace=0.25, hspace=0.27)
    mine = np.flatnonzero(result.learned.sightings.heliostat == i)
    learned = result.learned
    figure.suptitle(
        f"{result.names[i]}: {len(mine)} sightings, {int(learned.outlier[mine].sum())} outliers"
    )
    groups = _groups(result, mine)
    distance = result.distance[mine]
    everything = [plot.Group(np.ones(len(mine), np.bool_), BEFORE, "before")]
    before, after = result.before.plane[mine], result.after[mine] * distance[:, None]
    quantity = "predicted minus seen"
    plot.ellipses(before, groups=everything, title=f"{quantity}, before", ax=axes[0, 0])
    title = f"{quantity}, after, each predicted from the others"
    plot.ellipses(after, groups=groups, title=title, ax=axes[0, 1])
    _year(axes[0, 2], result, i)
    azimuth, elevation = azimuth_elevation(learned.sightings.source[mine])
    for ax, values, label in (
        (axes[1, 0], np.degrees(elevation), "sun elevation, °"),
        (axes[1, 1], np.degrees(azimuth), "sun azimuth from north, °"),
        (axes[2, 0], learned.sightings.counts[mine, 0] / 1e3, "first drive, thousand counts"),
        (axes[2, 1], learned.sightings.counts[mine, -1] / 1e3, "second drive, thousand counts"),
    ):
        plot.residuals(values, result.after[mine], label=label, groups=groups, ax=ax)
    _in_time(axes[1, 2], result, i, mine, groups)
    _parameters(axes[2, 2], result, i)
    return figure


def _groups(result: CalibrationReport, mine: npt.NDArray[np.intp]) -> list[plot.Group]:
    label, out = result.learned.regime[mine], result.learned.outlier[mine]
    groups = []
    for k in np.unique(label[label >= 0]):
        name = "common zeros" if k == 0 else f"regime {k}"
        colour = REGIMES[int(k) % len(REGIMES)]
        groups.append(plot.Group((label == k) & ~out, colour, name))
    if out.any():
        groups.append(plot.Group(out, OUTLIER, "outliers", odd=True))
    if (label < 0).any():
        groups.append(plot.Group(label < 0, TESTED, "not used"))
    return groups


def _in_time(
    ax: "Axes",
    result: CalibrationReport,
    i: int,
    mine: npt.NDArray[np.intp],
    groups: list[plot.Group],
) -> None:
    seconds = result.learned.sightings.time[mine]
    known = np.isfinite(seconds)
    if not known.any():
        ax.set_axis_off()
        return
    dates = (seconds * 1e6).astype("datetime64[us]")
    plot.residuals(dates, result.after[mine], groups=groups, ax=ax)
    for day in result.learned.members[i].data.steps:
        ax.axvline(np.datetime64(int(day * DAY), "s").astype("datetime64[us]"), color="k", ls=":")
    ax.tick_params(axis="x", labelsize=7)
    ax.set_title("in time (dotted: steps of the zeros)", fontsize=10)


def _year(ax: "Axes", result: CalibrationReport, i: int) -> None:
    r = result.results
    machine = result.learned.mechanism[i].with_parameters(
        {n: r.values[i, p] for p, n in enumerate(r.names)}
    )
    year = year_map(machine, r.names, r.covariance[i], result.aim, result.plant.site.latitude_deg)
    plot.year_map(year.hour, year.declination, year.rms, ax=ax)
    ax.set_title("over the year, without new sightings", fontsize=10)


def _parameters(ax: "Axes", result: CalibrationReport, i: int) -> None:
    r = result.results
    learned = result.learned
    priors = np.array([learned.mechanism.parameter(n).prior for n in r.names])
    rows = np.arange(len(r.names))[::-1]
    ax.barh(rows, 2.0 * np.ones(len(rows)), left=-1.0, color="#dddddd", height=0.8)
    ax.errorbar(
        r.values[i] / priors, rows, xerr=r.sigma[i] / priors, fmt="o", color=AFTER, ms=4, capsize=2
    )
    ax.set_yticks(rows, r.names, fontsize=7)
    # Names need more room than the numbers in the other panels: 4.4 points per letter.
    place = ax.get_position()
    room = 4.4 / 72.0 / SIZE[0] * max(map(len, r.names), default=0)
    margin = max(0.0, room - 0.04)
    ax.set_position((place.x0 + margin, place.y0, place.width - margin, place.height))
    ax.axvline(0, color="k", lw=0.5)
    ax.set_xlabel("value, in standard deviations of its prior (grey)")
