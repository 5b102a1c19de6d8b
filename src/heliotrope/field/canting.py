"""Canting: how the facets of a mirror are tilted towards a focus.

The facets of a heliostat lie in the plane of its mirror. SolarPILOT has two canting
methods:

- on-axis, for one focal length, for one focal length per heliostat, or for each heliostat's
  distance to its aim: to first order in the size of the mirror, the facets are tangent to a
  paraboloid;
- off-axis, for one moment: at that moment, and only then, every facet sends the centre of the sun
  to the aim.
"""

from dataclasses import replace

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets, Heliostats
from heliotrope.field.plant import Plant
from heliotrope.geometry import FloatArray, as_float, bisector, normalize, tangent_axes
from heliotrope.mechanism.tracking import track

_ZENITH = np.array([0.0, 0.0, 1.0])


def on_axis(center: FloatArray, focal: FloatArray) -> FloatArray:
    """Return the on-axis tilts of facets, (N, F, 2), rad.

    Parameters
    ----------
    center
        Centres of the facets in the mirrors' planes, m, (N, F, 2).
    focal
        Focal length of each mirror, m, (N,); infinity: no canting.
    """
    return as_float(-center / (2.0 * focal)[:, None, None])


def off_axis(
    center: FloatArray, vertex: FloatArray, normal: FloatArray, sun: FloatArray, aim: FloatArray
) -> FloatArray:
    """Return the off-axis tilts of facets, (N, F, 2), rad.

    With these tilts, all facets of a mirror send the light from one sun position to its aim.

    Parameters
    ----------
    center
        Centres of the facets in the mirrors' planes, m, (N, F, 2).
    vertex, normal
        Pose of the mirrors when they send the light from that sun position to their aims, ENU, m,
        and unit vectors, (N, 3). The axes of the mirrors to the right are level.
    sun
        Unit vector to the sun, ENU, (3,).
    aim
        ENU m, (N, 3).
    """
    side, up = np.moveaxis(tangent_axes(normal), 1, 0)
    axes = np.stack([-side, up, normal], axis=1)
    place = vertex[:, None] + np.einsum("hfk,hki->hfi", center, axes[:, :2])
    light = np.broadcast_to(sun, place.shape)
    lean = bisector(light, normalize(aim[:, None] - place, "aim − facet"))
    x, y, z = np.moveaxis(np.einsum("hij,hfj->hfi", axes, lean), -1, 0)
    return np.stack([x / z, y / z], axis=-1)


def cant(plant: Plant) -> Plant:
    """Return a plant with its facet grids canted as they specify, for each mirror's own aim.

    Raises
    ------
    InputError
        If there is no aim, or a heliostat cannot reach its aim at the sun position of off-axis
        canting.
    """
    groups = {name: _canted(plant, name, group) for name, group in plant.groups.items()}
    changed = any(groups[name] is not group for name, group in plant.groups.items())
    return plant.with_groups(groups) if changed else plant


def _canted(plant: Plant, name: str, group: Heliostats) -> Heliostats:
    grid = None if group.facets is None else group.facets.grid
    if grid is None or grid.canting.kind == "none":
        return group
    center, half = grid.places(group.width, group.height)
    if grid.canting.focal is not None:
        tilt = on_axis(center, grid.canting.focal)
    else:
        sun = _ZENITH if grid.canting.sun is None else grid.canting.sun
        aim = _aims(plant, name, group)
        tracking = track(group, sun, aim)
        vertex = as_float(tracking.chosen(tracking.vertex))
        if grid.canting.sun is None:
            slant = np.linalg.norm(aim - vertex, axis=-1)
            # Where the zenith is out of reach, the pose is not known, and is not needed exactly.
            away = np.linalg.norm(aim - group.position, axis=-1)
            tilt = on_axis(center, np.where(np.isfinite(slant), slant, away))
        else:
            _check_reach(group, np.asarray(tracking.reachable))
            tilt = off_axis(center, vertex, as_float(tracking.chosen(tracking.normal)), sun, aim)
    return replace(group, facets=Facets.of(center, half, tilt, grid))


def _aims(plant: Plant, name: str, group: Heliostats) -> FloatArray:
    own = np.full((len(group), 3), np.nan) if group.aim is None else group.aim
    if plant.receivers:
        return np.where(np.isfinite(own), own, plant.receivers[0].center)
    missing = ~np.isfinite(own).all(axis=-1)
    if missing.any():
        k = int(np.flatnonzero(missing)[0])
        raise InputError(
            f"groups.{name}.mirror: heliostat {group.names[k]} has no aim point to cant its "
            "facets for; add a receiver, columns aim_east_m, aim_north_m and aim_up_m, or "
            "canting_focal_m"
        )
    return own


def _check_reach(group: Heliostats, reachable: np.ndarray) -> None:
    if not reachable.all():
        k = int(np.flatnonzero(~reachable)[0])
        raise InputError(
            f"heliostat {group.names[k]} cannot reach its aim at the sun position of its off-axis "
            "canting; choose another time"
        )
