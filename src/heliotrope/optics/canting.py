"""Canting: how the facets of a mirror are tilted towards a focus.

The facets of a heliostat lie in the plane of its mirror, edge to edge. SolarPILOT's canting
methods:

- on-axis, with one focal length for the field, or with each heliostat's slant range: to first order
  in the size of the mirror, the facets are tangent to a paraboloid;
- off-axis, for one moment: at that moment, and only then, every facet sends the centre of the sun
  to the aim.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, as_vectors, bisector, normalize
from heliotrope.optics.scene import FacetTable, Mirrors, scene_of

#: Focal length, "slant" (each heliostat's distance to its aim), or the sun, ENU, (3,).
Canting = Literal["slant"] | float | npt.ArrayLike


def canted(
    mirrors: Mirrors,
    facets: tuple[int, int],
    canting: Canting = "slant",
    *,
    plant: Plant | None = None,
    aim: npt.ArrayLike | None = None,
) -> Mirrors:
    """Return mirrors divided into equal canted facets.

    Parameters
    ----------
    mirrors
        Mirrors in their poses; their focal length becomes that of each facet's own curvature.
    facets
        Columns and rows, 1 to 50 each.
    canting
        On-axis focal length, m (infinity: no canting); "slant": each mirror's distance to its aim;
        or the sun vector for which they are canted off-axis, (3,).
    plant, aim
        Plant that the mirrors belong to, and its aim points, for off-axis canting.

    Raises
    ------
    InputError
        If the numbers are out of range, a heliostat cannot reach its aim at the canting sun
        position, or the plant is missing.
    """
    columns, rows = facets
    if not (1 <= columns <= 50 and 1 <= rows <= 50):
        raise InputError(f"canting: {columns} × {rows} facets; must be 1 to 50 each way")
    x = (np.arange(columns) + 0.5) / columns - 0.5
    y = (np.arange(rows) + 0.5) / rows - 0.5
    grid = np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=-1)
    size = np.stack([mirrors.width, mirrors.height], axis=-1)[:, None]
    center = as_float(size * grid)
    if isinstance(canting, str) or np.ndim(as_float(canting)) == 0:
        focal = mirrors.slant if isinstance(canting, str) else _focal(canting, len(mirrors))
        tilt = -center / (2.0 * focal)[:, None, None]
    else:
        tilt, focal = _off_axis(center, canting, plant, aim), mirrors.slant
    half = np.broadcast_to(0.5 * size / np.array([columns, rows]), center.shape)
    own = np.broadcast_to(mirrors.focal[:, None], center.shape[:2])
    # The mirror's own focal length serves to cast what its neighbours hide.
    return replace(mirrors, focal=focal).with_facets(FacetTable(center, tilt, half, own))


def _focal(canting: npt.ArrayLike, count: int) -> FloatArray:
    focal = float(as_float(canting))
    if not focal > 0.0:
        raise InputError(f"canting: a focal length of {focal} m must be above 0; flat is inf")
    return np.full(count, focal)


def _off_axis(
    center: FloatArray, sun: npt.ArrayLike, plant: Plant | None, aim: npt.ArrayLike | None
) -> FloatArray:
    """Return tilts for which the facets send the sun to the aim, (H, F, 2)."""
    if plant is None:
        raise InputError(
            "canting: off-axis canting needs the plant, because its heliostats must face that sun"
        )
    light = normalize(as_vectors(sun, "canting: sun"))
    if light.shape != (3,) or light[2] <= 0.0:
        raise InputError("canting: pass one sun vector above the horizon, (3,)")
    scene = scene_of(plant, light, aim)
    then = scene.mirrors
    if scene.dark is not None and scene.dark.any():
        name = plant.names[int(np.flatnonzero(scene.dark)[0])]
        raise InputError(
            f"canting: heliostat {name} cannot reach its aim at the sun position chosen for "
            "canting; choose another"
        )
    x, y = center[..., :1], center[..., 1:]
    place = then.center[:, None] + x * then.right[:, None] + y * then.up[:, None]
    normal = bisector(np.broadcast_to(light, place.shape), normalize(then.aim[:, None] - place))
    axes = np.stack([then.right, then.up, then.normal], axis=1)
    right, up, out = np.moveaxis(np.einsum("hij,hfj->hfi", axes, normal), -1, 0)
    return np.stack([right / out, up / out], axis=-1)
