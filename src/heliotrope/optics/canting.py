"""Divides the mirrors of a scene into canted facets, whatever the plant file specifies."""

from dataclasses import replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from heliotrope.errors import InputError
from heliotrope.field.canting import off_axis, on_axis
from heliotrope.field.mirror_surface import Canting as PlantCanting
from heliotrope.field.mirror_surface import FacetGrid
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, as_vectors, normalize
from heliotrope.optics.plant_scene import scene_of
from heliotrope.optics.scene import FacetTable, Mirrors

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
        Mirrors in their poses; their focal length becomes the focal length of each facet's own
        curvature.
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
    center, half = FacetGrid(columns, rows, 0.0, PlantCanting("none")).places(
        mirrors.width, mirrors.height
    )
    if isinstance(canting, str) or np.ndim(as_float(canting)) == 0:
        focal = mirrors.slant if isinstance(canting, str) else _focal(canting, len(mirrors))
        tilt = on_axis(center, focal)
    else:
        tilt, focal = _off_axis(center, canting, plant, aim), mirrors.slant
    own = np.broadcast_to(mirrors.focal[:, None], center.shape[:2])
    # The mirror's own focal length is used only for casting the shadows of its neighbours.
    return replace(mirrors, focal=focal).with_facets(FacetTable(center, tilt, half, own))


def _focal(canting: npt.ArrayLike, count: int) -> FloatArray:
    focal = float(as_float(canting))
    if not focal > 0.0:
        raise InputError(
            f"canting: the focal length must be above 0, not {focal} m; use inf for flat"
        )
    return np.full(count, focal)


def _off_axis(
    center: FloatArray, sun: npt.ArrayLike, plant: Plant | None, aim: npt.ArrayLike | None
) -> FloatArray:
    """Return the tilts with which the facets send the sunlight to the aim, (H, F, 2)."""
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
            "canting; choose another sun position"
        )
    return off_axis(center, then.center, then.normal, light, then.aim)
