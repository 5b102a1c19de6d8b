"""Pictures of a calibration: the field, all heliostats, and one heliostat in full."""

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from heliotrope.calibration.learn.drift import DAY
from heliotrope.calibration.report.content import CalibrationReport
from heliotrope.calibration.uncertainty import year_map
from heliotrope.geometry import FloatArray, azimuth_elevation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


#: Grey, blue, orange and vermilion of Okabe and Ito, told apart by the colour-blind too.
BEFORE, AFTER, TESTED, OUTLIER = "#999999", "#0072b2", "#e69f00", "#d55e00"
REGIMES = ("#0072b2", "#009e73", "#cc79a7", "#56b4e9", "#f0e442")


def figure_of(rows: int, columns: int, size: tuple[float, float]) -> tuple["Figure", Any]:
    """Return a figure that needs no display, and its axes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, layout="constrained")
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
    known = np.isfinite(values)
    ax.plot(places[~known, 0], places[~known, 1], ".", color="#cccccc", ms=4, label="no sightings")
    if known.any():
        size = 45.0 if known.sum() < 200 else 8.0
        top = max(float(np.percentile(values[known], 95)), 1e-6)
        dots = ax.scatter(
            places[known, 0],
            places[known, 1],
            c=values[known],
            s=size,
            cmap="cividis",
            vmin=0.0,
            vmax=top,
        )
        figure.colorbar(dots, label="median beam error after, mrad", extend="max")
        if known.sum() <= 60:
            for i in np.flatnonzero(known):
                where = (float(places[i, 0]), float(places[i, 1]))
                ax.annotate(
                    result.names[i],
                    where,
                    xytext=(3, 3),
                    textcoords="offset points",
                    fontsize=6,
                )
    for target in result.targets:
        ax.plot(*target[:2], "k^", ms=7)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("east, m")
    ax.set_ylabel("north, m")
    ax.grid(alpha=0.3)
    return figure


def heliostat_figure(result: CalibrationReport, i: int) -> "Figure":
    """Return a picture of one heliostat: target, residuals, parameters, the year."""
    figure, axes = figure_of(3, 3, (13.0, 11.0))
    mine = np.flatnonzero(result.learned.sightings.heliostat == i)
    learned = result.learned
    figure.suptitle(
        f"{result.names[i]}: {len(mine)} sightings, {int(learned.outlier[mine].sum())} outliers"
    )
    groups = _groups(result, mine)
    distance = result.distance[mine]
    before = [(result.before.plane[mine], BEFORE, "before")]
    after = [
        (result.after[mine][mask] * distance[mask][:, None], colour, label)
        for mask, colour, label in groups
    ]
    _target(axes[0, 0], before, "before")
    _target(axes[0, 1], after, "after, each predicted from the others")
    _year(axes[0, 2], result, i)
    azimuth, elevation = azimuth_elevation(learned.sightings.source[mine])
    beam = 1e3 * result.after[mine]
    for ax, values, label in (
        (axes[1, 0], np.degrees(elevation), "sun elevation, °"),
        (axes[1, 1], np.degrees(azimuth), "sun azimuth from north, °"),
        (axes[2, 0], learned.sightings.counts[mine, 0], "first drive, counts"),
        (axes[2, 1], learned.sightings.counts[mine, -1], "second drive, counts"),
    ):
        _residual(ax, values, beam, groups, label)
    _in_time(axes[1, 2], result, i, mine, groups)
    _parameters(axes[2, 2], result, i)
    return figure


def _groups(
    result: CalibrationReport, mine: npt.NDArray[np.intp]
) -> list[tuple[npt.NDArray[np.bool_], str, str]]:
    label, out = result.learned.regime[mine], result.learned.outlier[mine]
    found = []
    for k in np.unique(label[label >= 0]):
        name = "common zeros" if k == 0 else f"regime {k}"
        found.append(((label == k) & ~out, REGIMES[int(k) % len(REGIMES)], name))
    if out.any():
        found.append((out, OUTLIER, "outliers"))
    if (label < 0).any():
        found.append((label < 0, TESTED, "not used"))
    return found


def _target(ax: "Axes", groups: list[tuple[FloatArray, str, str]], title: str) -> None:
    for plane, colour, label in groups:
        if len(plane):
            marker = "x" if label == "outliers" else "."
            ax.plot(plane[:, 0], plane[:, 1], marker, color=colour, label=label)
    ax.axhline(0, color="k", lw=0.5)
    ax.axvline(0, color="k", lw=0.5)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"predicted minus seen, {title}", fontsize=10)
    ax.set_xlabel("right, m")
    ax.set_ylabel("up, m")
    ax.grid(alpha=0.3)
    if len(groups) > 1:
        ax.legend(frameon=False, fontsize=8)


def _residual(
    ax: "Axes",
    x: FloatArray,
    beam: FloatArray,
    groups: list[tuple[npt.NDArray[np.bool_], str, str]],
    label: str,
) -> None:
    good = np.zeros(len(x), dtype=np.bool_)
    for mask, colour, name in groups:
        good |= mask & (name != "outliers")
        ax.plot(x[mask], beam[mask, 0], ".", color=colour, ms=4)
        ax.plot(x[mask], beam[mask, 1], "^", color=colour, ms=3, mfc="none", mew=0.7)
    if good.any():
        # The limits leave outliers out of view, so that they do not flatten the rest.
        limit = max(0.5, 1.3 * float(np.percentile(np.abs(beam[good]), 99)))
        ax.set_ylim(-limit, limit)
    ax.set_xlabel(label)
    ax.set_ylabel("• right, ▵ up: mrad of beam")
    ax.grid(alpha=0.3)


def _in_time(
    ax: "Axes",
    result: CalibrationReport,
    i: int,
    mine: npt.NDArray[np.intp],
    groups: list[tuple[npt.NDArray[np.bool_], str, str]],
) -> None:
    seconds = result.learned.sightings.time[mine]
    known = np.isfinite(seconds)
    if not known.any():
        ax.set_axis_off()
        return
    dates = (seconds * 1e6).astype("datetime64[us]")
    _residual(ax, dates, 1e3 * result.after[mine], groups, "")
    for day in result.learned.members[i].data.steps:
        ax.axvline(np.datetime64(int(day * DAY), "s").astype("datetime64[us]"), color="k", ls=":")
    ax.tick_params(axis="x", labelrotation=30, labelsize=7)
    ax.set_title("in time (dotted: steps of the zeros)", fontsize=10)


def _year(ax: "Axes", result: CalibrationReport, i: int) -> None:
    r = result.results
    machine = result.learned.mechanism[i].with_parameters(
        {n: r.values[i, p] for p, n in enumerate(r.names)}
    )
    found = year_map(machine, r.names, r.covariance[i], result.aim, result.plant.site.latitude_deg)
    shown = 1e3 * found.rms
    if np.isfinite(shown).any():
        mesh = ax.pcolormesh(
            np.degrees(found.hour),
            np.degrees(found.declination),
            shown,
            cmap="cividis",
            vmin=0.0,
            vmax=float(np.nanpercentile(shown, 98)),
            rasterized=True,
        )
        ax.figure.colorbar(mesh, ax=ax, label="expected beam error, mrad RMS")
    ax.set_title("over the year, without new sightings", fontsize=10)
    ax.set_xlabel("hour angle, ° (afternoon positive)")
    ax.set_ylabel("declination, °")


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
    ax.axvline(0, color="k", lw=0.5)
    ax.set_xlabel("value, in standard deviations of its prior (grey)")
