"""Divides the surface of a mirror into small elements."""

import numpy as np

from heliotrope.errors import InputError
from heliotrope.field.heliostats import Facets
from heliotrope.geometry import FloatArray, normalize, tangent_axes


def mirror_axes(normal: FloatArray) -> FloatArray:
    """Return the columns x (right, horizontal), y (up) and z (normal) of a mirror, (3, 3)."""
    left, up = tangent_axes(normal)  # looking along the normal, the right is the mirror's left
    return np.stack([-left, up, normal], axis=-1)


def equal_facets(width: float, height: float, count: tuple[int, int], focal: float) -> Facets:
    """Return equal facets of one mirror, canted towards a focus; (1, F, 3).

    Parameters
    ----------
    width, height
        Size of the whole mirror, m.
    count
        Columns and rows.
    focal
        Distance of the focus, m; infinity: all facets lie in one plane. The centres lie on the
        paraboloid z = (x² + y²) / 4f, to which each facet is tangent at its centre.
    """
    for name, side in (("width", width), ("height", height)):
        if not (np.isfinite(side) and side > 0.0):
            raise InputError(f"mirror: {name} must be above 0 and finite, not {side} m")
    columns, rows = count
    if min(columns, rows) < 1:
        raise InputError(
            f"mirror: there must be 1 or more facets in each direction, not {columns} × {rows}"
        )
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * height
    x, y = (a.ravel() for a in np.meshgrid(x, y))
    center = np.stack([x, y, (x**2 + y**2) / (4.0 * focal)], axis=-1)
    normal = normalize(np.stack([-x / (2.0 * focal), -y / (2.0 * focal), np.ones(x.size)], axis=-1))
    right = normalize(np.cross([0.0, 1.0, 0.0], normal))
    up = np.cross(normal, right)
    half_width, half_height = 0.5 * width / columns * right, 0.5 * height / rows * up
    return Facets(center[None], half_width[None], half_height[None])


def grid_of(n: int) -> FloatArray:
    """Return the places of n × n equal elements on a facet, from −1 to 1 along it, (E, 1, 2)."""
    grid = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    return np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 1, 2)


def surface_at(facets: Facets, focal: float, places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return points on facets and their normals, (E, F, 3), in the mirror's frame.

    Parameters
    ----------
    facets
        Facets of one heliostat, F.
    focal
        Focal length of each facet's own curvature, m; infinity: flat.
    places
        Places on the facets, from −1 to 1 along their width and height, (E, F or 1, 2).
    """
    center, a, b = facets.center[0], facets.half_width[0], facets.half_height[0]
    flat = places[..., :1] * a + places[..., 1:] * b
    normal = normalize(np.cross(a, b), "facets: normal")
    sag = np.sum(flat**2, axis=-1, keepdims=True) / (4.0 * focal)
    return center + flat + sag * normal, normalize(normal - flat / (2.0 * focal))
