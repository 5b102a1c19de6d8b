"""Plots a field: an overview, and some heliostats near the tower to scale."""

from typing import TYPE_CHECKING

import numpy as np

from heliotrope.field.plant import Plant

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colours of Okabe and Ito, which colour-blind readers can distinguish too; neighbouring clusters
#: differ.
_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
#: Side of the detail that is drawn to scale, in mirror diagonals.
_PART = 14.0


def picture(plant: Plant) -> "Figure":
    """Return the picture of a plant: heliostats by cluster, targets, cameras, receiver.

    On the right, some mirrors near the tower are drawn to scale, each lying flat in its turning
    circle.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14.0, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    whole, part = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    _whole(whole, plant)
    _part(part, plant)
    names = {c for g in plant.groups.values() for c in g.cluster}
    figure.suptitle(f"{plant.name}: {len(plant):,} heliostats, {len(names):,} clusters")
    return figure


def _numbers(plant: Plant) -> np.ndarray:
    """Return the cluster number of each heliostat."""
    order = {name: k for k, name in enumerate(dict.fromkeys(plant.cluster))}
    return np.array([order[name] for name in plant.cluster])


def _whole(ax: "Axes", plant: Plant) -> None:
    cluster = _numbers(plant)
    # As large as fits between neighbours.
    size = float(np.clip(400.0 / np.sqrt(len(plant)), 0.8, 40.0))
    colours = [_COLOURS[k % len(_COLOURS)] for k in cluster]
    ax.scatter(plant.position[:, 0], plant.position[:, 1], s=size, c=colours, linewidths=0.0)
    for k, target in enumerate(plant.targets):
        ax.plot(*target.corners[:2, :2].T, "k-", lw=3.0, label=None if k else "target")
    positions = [c.position for c in plant.cameras if c.position is not None]
    for k, place in enumerate(positions):
        ax.plot(place[0], place[1], "k^", ms=7, mfc="white", label=None if k else "camera")
    for k, receiver in enumerate(plant.receivers):
        ax.plot(*receiver.center[:2], "ks", ms=7, label=None if k else "receiver")
    ax.set_aspect("equal")
    ax.set_xlabel("east, m")
    ax.set_ylabel("north, m")
    ax.legend(frameon=False, loc="upper right", ncols=3, bbox_to_anchor=(1.0, 1.07))


def _part(ax: "Axes", plant: Plant) -> None:
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Circle, Rectangle

    width = np.concatenate([g.width for g in plant.groups.values()])
    height = np.concatenate([g.height for g in plant.groups.values()])
    place, diagonal = plant.position[:, :2], np.hypot(width, height)
    side = _PART * float(diagonal.max())
    # The heliostat nearest to the tower, and close to the axis of the field if it has one.
    east, north = place.mean(axis=0)
    off = np.abs(place[:, 0] * north - place[:, 1] * east) / max(np.hypot(east, north), 1.0)
    middle = place[int(np.argmin(np.linalg.norm(place, axis=1) + off))]
    # Shift the detail outwards from the nearest mirror, so that mirrors fill it.
    middle = middle * (1.0 + 0.35 * side / max(float(np.linalg.norm(middle)), 1e-9))
    rows = np.flatnonzero((np.abs(place - middle) <= 0.5 * side).all(axis=1))
    cluster = _numbers(plant)
    mirrors = [
        Rectangle(
            (place[i, 0] - 0.5 * width[i], place[i, 1] - 0.5 * height[i]), width[i], height[i]
        )
        for i in rows
    ]
    colours = [_COLOURS[cluster[i] % len(_COLOURS)] for i in rows]
    circles = [Circle((place[i, 0], place[i, 1]), 0.5 * diagonal[i]) for i in rows]
    ax.add_collection(PatchCollection(circles, facecolor="none", edgecolor="#999999", lw=0.6))
    ax.add_collection(PatchCollection(mirrors, facecolor=colours, edgecolor="none"))
    for i in rows if len(rows) <= 60 else ():
        ax.annotate(plant.names[i], place[i], fontsize=5, ha="center", va="center", color="white")
    ax.set_xlim(middle[0] - 0.5 * side, middle[0] + 0.5 * side)
    ax.set_ylim(middle[1] - 0.5 * side, middle[1] + 0.5 * side)
    ax.set_aspect("equal")
    ax.set_xlabel("east, m")
    ax.set_title("to scale, with the circles in which mirrors turn", fontsize=9)
