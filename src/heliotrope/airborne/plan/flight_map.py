"""The map of a flight plan: clusters, stations, drone routes, and keep-outs."""

from typing import TYPE_CHECKING

import numpy as np

from heliotrope.airborne.plan.flight import timeline
from heliotrope.airborne.plan.flight_plan import FlightPlan
from heliotrope.geometry import azimuth_elevation

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Okabe and Ito's colours, which colour-blind readers can distinguish.
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
#: Muted colours that distinguish neighbouring clusters.
_SHADES = ("#7f9cc4", "#c49a6c", "#8fae7a", "#b58aa5", "#6fa3a3", "#a3a3a3", "#c2b04f")


def flight_map(plan: FlightPlan) -> "Figure":
    """Return the field from above, and the directions from which it is measured.

    Notes
    -----
    The left part shows the heliostats in the colour of their cluster, the cluster names, a dot for
    each station, the routes of each drone's first sorties, the home positions, keep-out volumes and
    the fence. The right part shows the directions to the drone from all stations, with azimuth
    around the circle and elevation inwards.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 6.4), layout="constrained")
    left = figure.add_subplot(1, 2, 1)
    right = figure.add_subplot(1, 2, 2, projection="polar")
    _field(left, plan)
    _routes(left, plan)
    _limits(left, plan)
    _directions(right, plan)
    summary = plan.summary()
    figure.suptitle(
        f"{summary['heliostats']:,} heliostats, {summary['clusters']} "
        f"{'cluster' if summary['clusters'] == 1 else 'clusters'}, "
        f"{summary['calibration_points']} calibration points, {summary['photographs']:,} "
        f"photographs, {summary['sorties']} sorties, {summary['hours']:.1f} h"
    )
    return figure


def _field(ax: "Axes", plan: FlightPlan) -> None:
    place, of = plan.plant.position, plan.clusters.of
    size = float(np.clip(4e4 / len(place), 3.0, 30.0))
    colours = np.array(_SHADES)[of % len(_SHADES)]
    ax.scatter(place[:, 0], place[:, 1], s=size, c=colours, lw=0, label="heliostats")
    if len(plan.labels) <= 80:
        for label, centre in zip(plan.labels, plan.clusters.center, strict=True):
            ax.annotate(label, centre[:2], ha="center", va="center", fontsize=7)
    middle = np.array([s.pattern.center for s in plan.stations])
    ax.plot(middle[:, 0], middle[:, 1], ".", ms=2.5, color="#666666", label="hover patterns")
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_xlabel("east, m")
    ax.set_ylabel("north, m")
    ax.grid(alpha=0.3)


def _routes(ax: "Axes", plan: FlightPlan) -> None:
    """Draw the first sorties of each drone; drawing all sorties would hide the field."""
    for drone, home in enumerate(plan.homes):
        colour = _COLOURS[drone % len(_COLOURS)]
        some = [s for s in plan.sorties if s.drone == drone][:2]
        if some:
            line = timeline(some, plan.stations, plan.settings.craft, drone)
            ax.plot(
                line.place[:, 0],
                line.place[:, 1],
                "-",
                lw=0.8,
                color=colour,
                label=f"drone {drone + 1}, its first {len(some)} of "
                f"{sum(s.drone == drone for s in plan.sorties)} sorties",
            )
        ax.plot(home[0], home[1], "^", ms=8, color=colour)


def _limits(ax: "Axes", plan: FlightPlan) -> None:
    from matplotlib.patches import Circle, Polygon

    airspace = plan.settings.airspace
    for k, keep_out in enumerate(airspace.keep_outs):
        label = "keep-out" if k == 0 else ""
        style = {"fc": "#d55e0055", "ec": "#d55e00", "label": label}
        if len(keep_out.corners) == 1:
            east, north = keep_out.corners[0]
            ax.add_patch(Circle((float(east), float(north)), keep_out.radius, **style))
        else:
            ax.add_patch(Polygon(keep_out.corners, closed=True, **style))
    if airspace.fence is not None:
        ax.add_patch(
            Polygon(airspace.fence, closed=True, fill=False, ec="#000000", ls="--", label="fence")
        )
    ax.legend(fontsize=7, loc="best")


def _directions(ax: "Axes", plan: FlightPlan) -> None:
    towards = np.array([s.pattern.direction for s in plan.stations])
    place, number = np.unique(np.round(towards, 6), axis=0, return_counts=True)
    azimuth, elevation = azimuth_elevation(place)
    share = number / len(plan.labels)
    dots = ax.scatter(
        azimuth,
        90.0 - np.degrees(elevation),
        s=20.0 + 80.0 * share,
        c=100.0 * share,
        cmap="viridis",
        vmin=0.0,
    )
    assert ax.figure is not None
    ax.figure.colorbar(dots, ax=ax, label="clusters seen from there, %", shrink=0.7)
    # The angle runs clockwise from north, as azimuth does.
    ax.set_theta_zero_location("N")  # type: ignore[attr-defined] # of polar axes only
    ax.set_theta_direction(-1)  # type: ignore[attr-defined] # of polar axes only
    ax.set_ylim(0.0, 90.0)
    ax.set_yticks([0.0, 30.0, 60.0, 90.0], ["90°", "60°", "30°", "0°"], fontsize=7)
    ax.set_title("direction to the drone: azimuth, elevation", fontsize=10)
