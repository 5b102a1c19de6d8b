"""Plot the flux of a field: unrolled receivers, and field and receivers in three dimensions."""

from typing import TYPE_CHECKING, Any

import numpy as np

from heliotrope.aims.plan import AimPlan
from heliotrope.errors import InputError, UnknownNameError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, normalize, tangent_axes
from heliotrope.optics.flux import FluxView
from heliotrope.optics.plant_flux import EFFICIENCIES, PlantFlux
from heliotrope.optics.surfaces import Cavity, Cylinder, Mesh, Plate, Surface
from heliotrope.plot.charts import _axes, field_map

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Colour maps of flux and of efficiency.
_FLUX, _SHARE = "inferno", "cividis"
#: Maximum number of heliostats drawn in three dimensions; in larger fields only every second,
#: third, … is drawn.
_MOST = 4000
#: Lowest end of a scale of flux, kW/m², for receivers without light.
_DARK = 1e-3
#: Excess over the limit, as a fraction, that is not drawn as one.
_HELD = 1e-3
#: Maximum number of receivers beside a map of the field.
_RECEIVERS = 3


def receiver_map(
    view: FluxView, *, surface: Surface | None = None, ax: "Axes | None" = None
) -> "Axes":
    """Draw the flux on a receiver; a cylinder is unrolled, and a mesh seen from its front.

    Parameters
    ----------
    view
        One of `heliotrope.optics.PlantFlux.maps`.
    surface
        The one of `heliotrope.optics.PlantFlux.surfaces` at the same place; needed only for a mesh
        or a cavity, whose map has no rows and columns.
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    InputError
        If there are fewer than two rows or columns of cells, as in the map of a mesh whose surface
        was not passed.
    """
    if isinstance(surface, Mesh | Cavity):
        ax = _axes(ax)
        mesh = ax.add_collection(_front_view(surface, view))
        ax.autoscale_view()
    elif min(view.flux.shape) < 2:
        raise InputError(
            f"receiver {view.receiver}: only a map with 2 or more rows and columns of cells can be "
            "drawn; pass the surface of a mesh, or draw it with flux_3d"
        )
    else:
        ax = _axes(ax)
        mesh = ax.pcolormesh(view.right, view.up, 1e-3 * view.flux, cmap=_FLUX, rasterized=True)
    mesh.set_clim(0.0, max(1e-3 * float(view.flux.max()), _DARK))
    ax.figure.colorbar(mesh, ax=ax, label="flux, kW/m²")
    ax.set_aspect("equal", adjustable="box")
    ax.set_title(
        f"{view.receiver}: {1e-6 * round(view.power):.4g} MW, "
        f"peak {1e-3 * view.flux.max():.4g} kW/m²",
        fontsize=10,
    )
    ax.set_xlabel(_across(view, surface))
    ax.set_ylabel("up, m")
    return ax


def _across(view: FluxView, surface: Surface | None) -> str:
    """Return the label of a map's columns; only those of a full cylinder are counted from 0."""
    rounded = isinstance(surface, Cylinder) or view.right.min() >= 0.0
    return "clockwise as seen from above, m" if rounded else "right, m"


def standby_figure(plant: Plant, today: FloatArray, points: FloatArray) -> "Figure":
    """Draw standby points (N, 3) from the side that the receiver faces, and today's points."""
    import matplotlib.pyplot as plt
    from matplotlib.patches import Rectangle

    receiver = plant.receivers[0]
    right = normalize(np.cross([0.0, 0.0, 1.0], receiver.normal), "normal of the receiver")
    figure, ax = plt.subplots(figsize=(7.0, 5.5), layout="constrained")
    away = np.linalg.norm(plant.position - receiver.center, axis=-1)
    dots = ax.scatter(
        (points - receiver.center) @ right, points[:, 2], 6.0, c=away, cmap=_SHARE, rasterized=True
    )
    figure.colorbar(dots, ax=ax, label="distance of the heliostat, m")
    ax.scatter((today - receiver.center) @ right, today[:, 2], 60.0, c="red", marker="x")
    corner = (-0.5 * receiver.width, receiver.center[2] - 0.5 * receiver.height)
    ax.add_patch(Rectangle(corner, receiver.width, receiver.height, color="black"))
    ax.set_aspect("equal", adjustable="datalim")
    ax.set_title(f"{plant.name}: standby points; today's in red", fontsize=10)
    ax.set_xlabel("right of the receiver, m")
    ax.set_ylabel("height, m")
    return figure


def efficiency_map(found: PlantFlux, by: str = "total", *, ax: "Axes | None" = None) -> "Axes":
    """Draw a map of heliostats coloured by an efficiency; grey if the aim is out of reach.

    Parameters
    ----------
    found
        Result of `heliotrope.flux`.
    by
        One of "cosine", "shading", "blocking", "lit", "mirror", "air", "intercept" and "total".
    ax
        Axes to draw on; by default new axes.

    Raises
    ------
    UnknownNameError
        If there is no such efficiency.
    """
    if by not in EFFICIENCIES:
        raise UnknownNameError("efficiency", by, EFFICIENCIES)
    values = 100.0 * getattr(found.efficiencies, by)
    centers = np.stack([surface.center for surface in found.surfaces])
    ax = field_map(found.position, values, label=f"{by}, %", targets=centers, whole=True, ax=ax)
    ax.set_title(f"{by} of the field: {100.0 * found.summary[by]:.2f} %", fontsize=10)
    return ax


def flux_3d(found: PlantFlux, by: str = "total", *, ax: "Any | None" = None) -> Any:
    """Draw heliostats coloured by an efficiency, and receivers coloured by their flux.

    Parameters
    ----------
    found
        Result of `heliotrope.flux`.
    by
        As for `efficiency_map`.
    ax
        Three-dimensional matplotlib axes; by default new axes.

    Raises
    ------
    UnknownNameError
        If there is no such efficiency.
    """
    import matplotlib.pyplot as plt
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    if by not in EFFICIENCIES:
        raise UnknownNameError("efficiency", by, EFFICIENCIES)
    if ax is None:
        ax = plt.figure(layout="constrained").add_subplot(projection="3d")
    every = -(-len(found.names) // _MOST)
    place, shares = found.position[::every], getattr(found.efficiencies, by)[::every]
    ax.scatter(*place.T, c=shares, cmap=_SHARE, s=4.0, depthshade=False)
    top = max(found.peak, 1e-9)
    for surface, view in zip(found.surfaces, found.maps, strict=True):
        faces = Poly3DCollection(_faces(surface), linewidths=0.0)
        faces.set_facecolor(plt.get_cmap(_FLUX)(view.flux.ravel() / top))
        ax.add_collection3d(faces)
        middle = surface.center
        ax.plot(*np.stack([middle, [*middle[:2], place[:, 2].min()]]).T, color="0.5", lw=1.5)
    points = np.concatenate([place, [surface.center for surface in found.surfaces]])
    low, high = points.min(axis=0), points.max(axis=0)
    ax.set_xlim(low[0], high[0])
    ax.set_ylim(low[1], high[1])
    ax.set_zlim(low[2], high[2] + 1.0)
    ax.set_box_aspect(np.maximum(high - low, 0.05 * (high - low).max()))
    ax.locator_params(nbins=5)
    ax.set_zticks(np.round([low[2], high[2]]))
    ax.set_xlabel("east, m")
    ax.set_ylabel("north, m")
    return ax


def flux_figure(found: PlantFlux, by: str = "total") -> "Figure":
    """Return a figure of the field's flux: map, up to `_RECEIVERS` receivers, and a 3-D view."""
    import matplotlib.pyplot as plt

    pairs = list(zip(found.maps, found.surfaces, strict=True))[:_RECEIVERS]
    count = len(pairs)
    figure = plt.figure(figsize=(13.0, 5.0 + 3.0 * count), layout="constrained")
    grid = figure.add_gridspec(count + 1, 2)
    efficiency_map(found, by, ax=figure.add_subplot(grid[:, 0]))
    space = figure.add_subplot(grid[count, 1], projection="3d")
    flux_3d(found, by, ax=space)
    for k, (view, surface) in enumerate(pairs):
        receiver_map(view, surface=surface, ax=figure.add_subplot(grid[k, 1]))
    return figure


def aim_figure(*plans: AimPlan) -> "Figure":
    """Draw the flux of each plan and its quantile relative to the limit, one plan in each row.

    White lines surround the cells that the limit binds; cells above the limit are red.

    Parameters
    ----------
    *plans
        One or more results of `heliotrope.aim`.
    """
    import matplotlib.pyplot as plt

    count, first = len(plans), plans[0].light.maps[0]
    tall = np.ptp(first.up) / max(float(np.ptp(first.right)), 1e-9)
    height = float(np.clip(5.5 * tall + 0.9, 2.0, 5.0)) * count
    figure, rows = plt.subplots(
        count, 2, figsize=(13.0, height), layout="constrained", squeeze=False
    )
    for plan, (left, right) in zip(plans, rows, strict=True):
        view = plan.light.maps[0]
        receiver_map(view, surface=plan.light.surfaces[0], ax=left)
        left.set_title(f"{plan.strategy}, {left.get_title()}", fontsize=10)
        _share_map(plan, right)
    return figure


def _share_map(plan: AimPlan, ax: "Axes") -> None:
    """Draw the quantile of a plan's flux relative to the limit."""
    import matplotlib.pyplot as plt

    view = plan.light.maps[0]
    colours = plt.get_cmap(_SHARE).with_extremes(over="red")
    mesh = ax.pcolormesh(
        view.right, view.up, 100.0 * plan.quantile / plan.limit, cmap=colours, vmin=0.0,
        vmax=100.0 * (1.0 + _HELD), rasterized=True,
    )  # fmt: skip
    extend = "max" if plan.excess > _HELD else "neither"
    ax.figure.colorbar(mesh, ax=ax, label="flux quantile, % of limit", extend=extend)
    if plan.scene.binding.any() and not plan.scene.binding.all():
        binding = plan.scene.binding.astype(float)
        ax.contour(view.right, view.up, binding, levels=[0.5], colors="white")
    ax.set_aspect("equal", adjustable="box")
    side = "above" if plan.excess > 0.0 else "below"
    ax.set_title(
        f"{plan.strategy}, hottest cell {100.0 * abs(plan.excess):.2f} % {side} its limit",
        fontsize=10,
    )
    ax.set_xlabel(_across(view, plan.light.surfaces[0]))
    ax.set_ylabel("up, m")


def _front_view(surface: Mesh | Cavity, view: FluxView) -> Any:
    """Return the cells that are lit from the front, in metres right and up of the centre."""
    from matplotlib.collections import PolyCollection

    cells = surface.cells
    if isinstance(surface, Cavity):
        axes = np.stack([surface.aperture.right, surface.aperture.up])
    else:
        across, along = tangent_axes(normalize(cells.area @ cells.normal))
        axes = np.stack([-across, along])
    front = np.cross(axes[0], axes[1])
    # Those further back first.
    order = np.argsort(cells.center @ front)
    order = order[cells.normal[order] @ front > 0.0]
    corners = (_faces(surface)[order] - surface.center) @ axes.T
    # Without smoothing and with edges of their own colour there are no seams between cells.
    look: dict[str, Any] = {
        "edgecolors": "face",
        "linewidths": 0.4,
        "antialiaseds": False,
        "rasterized": True,
    }
    drawn = PolyCollection(corners, cmap=_FLUX, **look)
    drawn.set_array(1e-3 * view.flux.ravel()[order])
    return drawn


def _faces(surface: Plate | Cylinder | Mesh | Cavity) -> Any:
    """Return the corners of each cell, (C, 3 or 4, 3)."""
    if isinstance(surface, Cavity):
        surface = surface.inner
    if isinstance(surface, Mesh):
        return surface.corners
    rows, columns = surface.shape
    z = np.linspace(-0.5, 0.5, rows + 1) * surface.height
    if isinstance(surface, Plate):
        x = np.linspace(-0.5, 0.5, columns + 1) * surface.width
        grid = surface.center + x[:, None] * surface.right + z[:, None, None] * surface.up
    else:
        around = surface.center + surface.radius * surface.outward(surface.edges)
        grid = around + z[:, None, None] * surface.axis
    corners = [grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]]
    return np.stack(corners, axis=2).reshape(-1, 4, 3)
